"""Define the resolved form of a launch file: its nodes, their hosts, and the topics' endpoints.

The module is separate from the resolver (`launch.plans.plan`), so that tools start fast.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Literal

from pydantic import ConfigDict, Field, model_validator

from flexsheet.messages.apparatus import Apparatus
from flexsheet.messages.bus import Source
from flexsheet.messages.limits import LimitedModel
from flexsheet.messages.scene import Scene
from flexsheet.nodes import NodeRole, OmissionReason

MAIN = "main"
"""Host of the launcher's own topics, the recorder and the command-line tools."""

LAUNCHER, TOOLS = "launch", "tools"
"""Writers that are not nodes: the launcher, and command-line tools with experiments."""

RUN_DIRECTORY = "@run"
"""Placeholder of the run's directory in endpoints and parameters until the run starts."""


ROLES_OF_TYPES = {
    "arm_bridge": NodeRole.ARM_BRIDGE,
    "camera": NodeRole.CAMERA,
    "clock": NodeRole.CLOCK,
    "console": NodeRole.CONSOLE,
    "recorder": NodeRole.RECORDER,
    "renderer": NodeRole.RENDERER,
    "twin_finger": NodeRole.FINGER_SIMULATOR,
}
"""Roles by node type, for plans in older bags that have no roles."""


OLD_CALIBRATIONS = ("calibration", "sheet_calibration")
"""Names of calibration parameters, for plans in older bags that list no calibrations."""


class ArmingMode(StrEnum):
    """Values of the parameter `arming` of arm bridges."""

    MANUAL = "manual"
    AUTO = "auto"


class StrictModel(LimitedModel):
    """Base of immutable models that reject unknown keys."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class RestartSpec(StrictModel):
    """Behaviour when a node's process exits.

    The delay doubles from `delay_s` with each restart inside the window, up to `max_delay_s`. After
    `max_restarts` in `window_s` the node has failed, and the run ends.
    """

    policy: Literal["never", "on_failure", "always"] = "on_failure"
    delay_s: float = Field(default=0.2, ge=0, allow_inf_nan=False)
    max_delay_s: float = Field(default=5.0, gt=0, allow_inf_nan=False)
    max_restarts: int = Field(default=5, ge=0)
    window_s: float = Field(default=60.0, gt=0, allow_inf_nan=False)


class Writer(StrictModel):
    """A writer of a topic, and its endpoints: ipc for its own host, tcp for others."""

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
        """Return the endpoint for a subscriber on `host`, with the writer's identity."""
        far = host != self.host and self.tcp is not None
        return Source(self.endpoint_for(host), self.name, self.host if far else None)


class ResolvedPort(StrictModel):
    """A port with its topic and endpoints: an output binds them, an input connects to them."""

    port: str
    topic: str
    endpoints: tuple[str, ...]


class ResolvedNode(StrictModel):
    """All settings that are needed to start a node."""

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
    liveness_s: float | None = Field(default=None, description="None in older bags")
    nice: int = Field(default=0, description="0 in older bags")
    process: str = Field(default="", description="name of its process; the node's in older bags")

    @property
    def arm_side(self) -> str | None:
        """Return the side of the arm whose state the node publishes, or None."""
        sides = {"arm_left": "left", "arm_right": "right"}
        return next((sides[port.topic] for port in self.outputs if port.topic in sides), None)

    @property
    def arming(self) -> ArmingMode | None:
        """Return who arms the node's arm; None for a node without that parameter."""
        value = self.parameters.get("arming")
        return ArmingMode(value) if value in tuple(ArmingMode) else None

    @model_validator(mode="before")
    @classmethod
    def _add_missing_fields(cls, values: Any) -> Any:
        """Derive the fields that plans of older bags do not contain."""
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


@dataclass(frozen=True, slots=True)
class ResolvedProcess:
    """A process with its nodes, which share host, niceness, restart policy and liveness."""

    name: str
    nodes: tuple[ResolvedNode, ...]

    @property
    def settings(self) -> ResolvedNode:
        """Return a node, for the settings that all nodes of the process share."""
        return self.nodes[0]

    @property
    def start_deadline_s(self) -> float:
        return max(node.start_deadline_s for node in self.nodes)


class OmittedNode(StrictModel):
    """Node of the launch file that is not started."""

    name: str
    type: str
    host: str
    reason: OmissionReason


class ResolvedGraph(StrictModel):
    """A resolved launch file: nodes, hosts, and the endpoints of all topics."""

    launch_file: str
    launch_text: str
    scene_file: str | None
    scene_text: str
    scene: dict[str, Any] | None
    apparatus: dict[str, Any] | None = Field(
        default=None, description="true parameters of the simulation; null: those of the scene"
    )
    hosts: dict[str, str] = Field(description="address by name")
    nodes: dict[str, ResolvedNode]
    omitted: tuple[OmittedNode, ...] = Field(default=(), description="nodes that are not started")
    writers: dict[str, tuple[Writer, ...]] = Field(description="by topic")
    keys: dict[str, str] = Field(default={}, description="public key by host; not part of the hash")
    estop_resetters: tuple[str, ...] = Field(
        default=(MAIN,), description="hosts that may reset an e-stop"
    )
    hash: str

    def writer(self, topic: str, name: str) -> Writer | None:
        """Return the writer `name` of `topic`; None if it may not write the topic."""
        return next((one for one in self.writers.get(topic, ()) if one.name == name), None)

    def endpoints_to_read(self, topic: str, host: str = MAIN) -> tuple[str, ...]:
        """Return the endpoints for a subscriber of `topic` on `host`."""
        return tuple(writer.endpoint_for(host) for writer in self.writers.get(topic, ()))

    def sources_to_read(self, topic: str, host: str = MAIN) -> tuple[Source, ...]:
        """Return the endpoints for a subscriber of `topic` on `host`, with their writers."""
        return tuple(writer.source_for(host) for writer in self.writers.get(topic, ()))

    def may_reset_estop(self) -> tuple[str, ...]:
        """Return the writers of e-stops that may reset one."""
        return tuple(
            writer.name
            for writer in self.writers.get("estop", ())
            if writer.host in self.estop_resetters
        )

    def nodes_on(self, host: str | None) -> list[ResolvedNode]:
        """Return the nodes of one host, or of all."""
        return [node for node in self.nodes.values() if host is None or node.host == host]

    def processes_on(
        self, host: str | None, *, without: Collection[str] = ()
    ) -> list[ResolvedProcess]:
        """Return the processes of one host, or of all, in the order of their first nodes.

        without: names of nodes that are not started.
        """
        members: dict[str, list[ResolvedNode]] = {}
        for node in self.nodes_on(host):
            if node.name in without:
                continue
            members.setdefault(node.process or node.name, []).append(node)
        return [ResolvedProcess(name, tuple(nodes)) for name, nodes in members.items()]

    def listening_nodes(self, host: str | None) -> list[tuple[str, int]]:
        """Return (node, TCP port) for each port on which a node listens."""
        return [(node.name, port) for node in self.nodes_on(host) for port in node.listen_ports]

    def scene_message(self) -> Scene | None:
        return None if self.scene is None else Scene.model_validate(self.scene)

    def apparatus_message(self) -> Apparatus | None:
        return None if self.apparatus is None else Apparatus.model_validate(self.apparatus)


def tools_on(host: str) -> str:
    """Return the writer name of the command-line tools on a host."""
    return TOOLS if host == MAIN else f"{TOOLS}_{host}"
