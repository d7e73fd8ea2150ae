"""A resolved launch file: what is started where, and where each topic is read.

Apart from what resolves it (`launch.plans.plan`), because tools that look into a graph that runs
need no more than this, and start at once.
"""

from __future__ import annotations

from typing import Any, Literal

from pydantic import ConfigDict, Field, model_validator

from flexsheet.messages.bus import Source
from flexsheet.messages.limits import LimitedModel
from flexsheet.messages.scene import Scene
from flexsheet.nodes import NodeRole

MAIN = "main"
"""The host of the launcher's own topics, of the recorder and of the command-line tools."""

LAUNCHER, TOOLS = "launch", "tools"
"""Writers that are no nodes: the launching process, and command-line tools and experiments."""

RUN_DIRECTORY = "@run"
"""Stands for the run's directory in endpoints and parameters; known only when the run starts."""


ROLES_OF_TYPES = {
    "arm_bridge": NodeRole.ARM_BRIDGE,
    "camera": NodeRole.CAMERA,
    "clock": NodeRole.CLOCK,
    "console": NodeRole.CONSOLE,
    "recorder": NodeRole.RECORDER,
    "renderer": NodeRole.RENDERER,
    "twin_finger": NodeRole.FINGER_SIMULATOR,
}
"""Roles of the node types that plans in bags name, from before plans held roles."""


OLD_CALIBRATIONS = ("calibration", "sheet_calibration")
"""Parameters that hold calibration files in plans from before plans listed calibrations."""


class Strict(LimitedModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class RestartSpec(Strict):
    """What happens when a node's process ends by itself.

    The delay doubles from `delay_s` with each restart inside the window, up to `max_delay_s`; after
    `max_restarts` in `window_s` the node has failed for good and the whole run ends.
    """

    policy: Literal["never", "on_failure", "always"] = "on_failure"
    delay_s: float = Field(default=0.2, ge=0, allow_inf_nan=False)
    max_delay_s: float = Field(default=5.0, gt=0, allow_inf_nan=False)
    max_restarts: int = Field(default=5, ge=0)
    window_s: float = Field(default=60.0, gt=0, allow_inf_nan=False)


class Writer(Strict):
    """One writer of a topic and what it binds: ipc for its own host, tcp for the others."""

    name: str
    host: str
    ipc: str
    tcp: str | None

    @property
    def endpoints(self) -> tuple[str, ...]:
        return (self.ipc,) if self.tcp is None else (self.ipc, self.tcp)

    def endpoint_for(self, host: str) -> str:
        if host == self.host or self.tcp is None:
            return self.ipc
        return self.tcp

    def source_for(self, host: str) -> Source:
        """Where a subscriber on `host` connects to, and whose words alone it takes there."""
        far = host != self.host and self.tcp is not None
        return Source(self.endpoint_for(host), self.name, self.host if far else None)


class ResolvedPort(Strict):
    """A port, its topic, and the endpoints: bound for an output, connected to for an input."""

    port: str
    topic: str
    endpoints: tuple[str, ...]


class ResolvedNode(Strict):
    """All that is needed to start one node."""

    name: str
    type: str
    host: str
    parameters: dict[str, Any]
    inputs: tuple[ResolvedPort, ...]
    outputs: tuple[ResolvedPort, ...]
    restart: RestartSpec
    start_deadline_s: float
    listen_ports: tuple[int, ...] = Field(default=(), description="TCP, on loopback")
    device_address: str | None = Field(
        default=None, description='"host:port" of the device that the node controls'
    )
    device_files: tuple[str, ...] = Field(default=(), description="paths that the node opens")
    calibrations: dict[str, str] = Field(default={}, description="file by parameter")
    role: NodeRole | None = Field(default=None, description="declared by the node's class")
    liveness_s: float | None = Field(default=None, description="none in bags from before")
    nice: int = Field(default=0, description="bags from before there was one have none")

    @property
    def arm_side(self) -> str | None:
        """Which arm's state the node publishes, "left" or "right"; None: of none."""
        sides = {"arm_left": "left", "arm_right": "right"}
        return next((sides[port.topic] for port in self.outputs if port.topic in sides), None)

    @model_validator(mode="before")
    @classmethod
    def _add_missing_fields(cls, values: Any) -> Any:
        """Derive the fields that plans in older bags lack: role, device address, calibrations."""
        if not isinstance(values, dict):
            return values
        derived: dict[str, Any] = {"role": ROLES_OF_TYPES.get(str(values.get("type")))}
        parameters = values.get("parameters")
        if isinstance(parameters, dict):
            host, port = parameters.get("host"), parameters.get("port")
            if host is not None and port is not None:
                derived["device_address"] = f"{host}:{port}"
            derived["calibrations"] = {
                name: parameters[name] for name in OLD_CALIBRATIONS if parameters.get(name)
            }
        return {**derived, **values}


class ResolvedGraph(Strict):
    """A resolved launch file."""

    launch_file: str
    launch_text: str
    scene_file: str | None
    scene_text: str
    scene: dict[str, Any] | None
    hosts: dict[str, str] = Field(description="address by name")
    nodes: dict[str, ResolvedNode]
    writers: dict[str, tuple[Writer, ...]] = Field(description="by topic")
    keys: dict[str, str] = Field(default={}, description="public key by host; no part of the hash")
    estop_resetters: tuple[str, ...] = Field(default=(MAIN,), description="hosts that may")
    hash: str

    def writer(self, topic: str, name: str) -> Writer | None:
        """The writer `name` of `topic`; None when it may not write it."""
        return next((one for one in self.writers.get(topic, ()) if one.name == name), None)

    def endpoints_to_read(self, topic: str, host: str = MAIN) -> tuple[str, ...]:
        """Where a subscriber of `topic` on `host` connects to."""
        return tuple(writer.endpoint_for(host) for writer in self.writers.get(topic, ()))

    def sources_to_read(self, topic: str, host: str = MAIN) -> tuple[Source, ...]:
        """The same, with who may write there."""
        return tuple(writer.source_for(host) for writer in self.writers.get(topic, ()))

    def may_reset_estop(self) -> tuple[str, ...]:
        """Writers of e-stops whose hosts may reset one."""
        return tuple(
            writer.name
            for writer in self.writers.get("estop", ())
            if writer.host in self.estop_resetters
        )

    def nodes_on(self, host: str | None) -> list[ResolvedNode]:
        """The nodes of one host, or of all."""
        return [node for node in self.nodes.values() if host is None or node.host == host]

    def listening_nodes(self, host: str | None) -> list[tuple[str, int]]:
        """(node, TCP port) for each port on which a node itself listens."""
        return [(node.name, port) for node in self.nodes_on(host) for port in node.listen_ports]

    def scene_message(self) -> Scene | None:
        return None if self.scene is None else Scene.model_validate(self.scene)


def tools_on(host: str) -> str:
    """The command-line tools of a host, as a writer."""
    return TOOLS if host == MAIN else f"{TOOLS}_{host}"
