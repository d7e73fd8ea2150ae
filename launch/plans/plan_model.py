"""Define the data model of a resolved launch file, which is called the plan of a graph.

A plan contains the nodes with their hosts and all defaults, and the network endpoints of every
topic. The model is separate from the resolver (`launch.plans.plan`), so that tools start fast.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Literal

from pydantic import ConfigDict, Field

from flexsheet.messages.apparatus import Apparatus
from flexsheet.messages.bus import Source
from flexsheet.messages.limits import LimitedModel
from flexsheet.messages.scene import Scene
from flexsheet.nodes import NodeRole, OmissionReason, node_class

MAIN = "main"
"""The name of the main host, which runs the recorder and the command-line tools."""

LAUNCHER, TOOLS = "launch", "tools"
"""The names under which the launcher and all command-line tools publish messages."""

RUN_DIRECTORY = "@run"
"""The placeholder for the path of the run's folder in endpoints and parameters."""


class ArmingMode(StrEnum):
    """The values of the parameter `arming` of the arm bridge (node that controls an arm).

    auto: the arm moves without a command.
    manual: the arm moves only after a command of the user.
    """

    MANUAL = "manual"
    AUTO = "auto"


class StrictModel(LimitedModel):
    """The base class of models that are immutable and reject unknown keys."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class RestartSpec(StrictModel):
    """A restart policy that is applied when the process of a node exits.

    The first restart in `window_s` is immediate. The delay before the second restart is `delay_s`
    and doubles with each further restart, up to `max_delay_s`. If the process exits after it has
    restarted `max_restarts` times in `window_s`, the node has failed and the run ends.
    """

    policy: Literal["never", "on_failure", "always"] = "on_failure"
    delay_s: float = Field(default=0.2, ge=0, allow_inf_nan=False)
    max_delay_s: float = Field(default=5.0, gt=0, allow_inf_nan=False)
    max_restarts: int = Field(default=5, ge=0)
    window_s: float = Field(default=60.0, gt=0, allow_inf_nan=False)


class Writer(StrictModel):
    """A writer of a topic, with its endpoints.

    The ipc endpoint is for readers on the same host. The tcp endpoint is for other hosts.
    """

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
        """Return the source (writer name and endpoint) for a subscriber on `host`.

        The source of a TCP connection also names the writer's host for authentication.
        """
        far = host != self.host and self.tcp is not None
        return Source(self.endpoint_for(host), self.name, self.host if far else None)


class ResolvedPort(StrictModel):
    """A port of a node, with its topic and its endpoints.

    An output port binds the endpoints, and an input port connects to them.
    """

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
    listen_ports: tuple[int, ...] = Field(
        default=(), description="TCP ports on the loopback interface"
    )
    device_address: str | None = Field(
        default=None, description='"host:port" of the device that the node controls'
    )
    device_files: tuple[str, ...] = Field(
        default=(), description="paths of files and devices that the node opens"
    )
    calibrations: dict[str, str] = Field(
        default={}, description="calibration file by parameter name"
    )
    role: NodeRole | None = Field(default=None, description="role that the node class declares")
    liveness_s: float | None = Field(
        default=None, description="maximum time without a heartbeat, s; null: no limit"
    )
    nice: int = Field(default=0, description="niceness of the process")
    realtime_priority: int | None = Field(
        default=None, description="real-time priority of the process; null: it has none"
    )
    process: str = Field(default="", description="process name; empty if it is the node's name")

    @property
    def arm_side(self) -> str | None:
        """Return "left" or "right" if the node publishes the state of an arm, otherwise None."""
        sides = {"arm_left": "left", "arm_right": "right"}
        return next((sides[port.topic] for port in self.outputs if port.topic in sides), None)

    @property
    def arming(self) -> ArmingMode | None:
        """Return the value of the parameter `arming`, or None if the node has no such parameter."""
        value = self.parameters.get("arming")
        return ArmingMode(value) if value in tuple(ArmingMode) else None


@dataclass(frozen=True, slots=True)
class ResolvedProcess:
    """A process and its nodes.

    The nodes have the same niceness, restart policy and heartbeat timeout.
    """

    name: str
    nodes: tuple[ResolvedNode, ...]

    @property
    def settings(self) -> ResolvedNode:
        """Return the node whose process settings apply to the whole process: the first node."""
        return self.nodes[0]

    @property
    def start_deadline_s(self) -> float:
        return max(node.start_deadline_s for node in self.nodes)


class OmittedNode(StrictModel):
    """A node of the launch file that is not started, and the reason for its omission."""

    name: str
    type: str
    host: str
    reason: OmissionReason


class ResolvedGraph(StrictModel):
    """A resolved launch file, with nodes, hosts, default values and the endpoints of all topics."""

    launch_file: str
    launch_text: str
    scene_file: str | None
    scene_text: str
    scene: dict[str, Any] | None
    apparatus: dict[str, Any] | None = Field(
        default=None,
        description="true parameters of the simulated hardware; null: equal to the scene",
    )
    hosts: dict[str, str] = Field(description="network address by host name")
    nodes: dict[str, ResolvedNode]
    omitted: tuple[OmittedNode, ...] = Field(default=(), description="nodes that are not started")
    writers: dict[str, tuple[Writer, ...]] = Field(description="writers by topic name")
    keys: dict[str, str] = Field(default={}, description="public key by host; not part of the hash")
    estop_resetters: tuple[str, ...] = Field(
        default=(MAIN,), description="hosts that may reset an e-stop"
    )
    hash: str

    def writer(self, topic: str, name: str) -> Writer | None:
        """Return the writer `name` of a topic; return None if the topic has no such writer."""
        return next((one for one in self.writers.get(topic, ()) if one.name == name), None)

    def sources_to_read(self, topic: str, host: str = MAIN) -> tuple[Source, ...]:
        """Return the sources (writer names and endpoints) of a topic for a subscriber on `host`."""
        return tuple(writer.source_for(host) for writer in self.writers.get(topic, ()))

    def may_reset_estop(self) -> tuple[str, ...]:
        """Return the names of the writers that are allowed to reset an emergency stop."""
        return tuple(
            writer.name
            for writer in self.writers.get("estop", ())
            if writer.host in self.estop_resetters
        )

    def nodes_on(self, host: str | None) -> list[ResolvedNode]:
        """Return the nodes on one host, or all nodes if `host` is None."""
        return [node for node in self.nodes.values() if host is None or node.host == host]

    def nodes_of_type(self, node_type: str) -> list[ResolvedNode]:
        """Return the nodes of a type and of its subclasses."""
        base = node_class(node_type)
        return [one for one in self.nodes.values() if issubclass(node_class(one.type), base)]

    def processes_on(
        self, host: str | None, *, without: Collection[str] = ()
    ) -> list[ResolvedProcess]:
        """Return the processes on `host`, in the order of their first nodes.

        host: name of a host. If it is None, the processes on all hosts are returned.
        without: names of nodes that are not started.
        """
        members: dict[str, list[ResolvedNode]] = {}
        for node in self.nodes_on(host):
            if node.name in without:
                continue
            members.setdefault(node.process or node.name, []).append(node)
        return [ResolvedProcess(name, tuple(nodes)) for name, nodes in members.items()]

    def listening_nodes(self, host: str | None) -> list[tuple[str, int]]:
        """Return the node name and the TCP port of each listening port on a host.

        If `host` is None, the ports on all hosts are returned.
        """
        return [(node.name, port) for node in self.nodes_on(host) for port in node.listen_ports]

    def scene_message(self) -> Scene | None:
        return None if self.scene is None else Scene.model_validate(self.scene)

    def apparatus_message(self) -> Apparatus | None:
        return None if self.apparatus is None else Apparatus.model_validate(self.apparatus)


def tools_on(host: str) -> str:
    """Return the name under which command-line tools on a host publish messages."""
    return TOOLS if host == MAIN else f"{TOOLS}_{host}"
