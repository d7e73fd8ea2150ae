"""What a launch file may say, and what the command line says over it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from pydantic import Field
from ruamel.yaml.error import YAMLError

from flexsheet.launch.plans.documents import (
    BadInputError,
    Document,
    Problem,
    did_you_mean,
    parse_value,
)
from flexsheet.launch.plans.plan_model import MAIN, RestartSpec, Strict
from flexsheet.nodes import NodeRole, UnknownNodeError, node_class
from flexsheet.nodes.node import role_of

RECORDER_NICE = 5
"""What it reads waits for it in queues; nothing else waits."""

CONSOLE_NICE = 10
"""Who looks on must not slow what is looked at."""

RECORDINGS = Path("runs") / "%Y%m%d-%H%M%S.mcap"
"""Where a recorder that waits for the console puts its bags, from where the command was given."""

Name = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]*$", max_length=32)]


class HostSpec(Strict):
    """One computer."""

    address: str = Field(description="IP address that its nodes listen on")
    key: str | None = Field(default=None, description="its public key: flexsheet keys show")
    may_reset_estop: bool | None = Field(
        default=None, description="whether its nodes may; null: on the main host alone"
    )


class NodeSpec(Strict):
    """One node as the launch file has it."""

    type: str = Field(description='a name of the table of nodes, or "module:Class"')
    host: str = MAIN
    parameters: dict[str, Any] = Field(default={})
    topics: dict[str, str | None] = Field(
        default={}, description="port: topic, where they differ; null leaves a port unconnected"
    )
    restart: RestartSpec = RestartSpec()
    start_deadline_s: float = Field(default=60.0, gt=0, allow_inf_nan=False)
    liveness_s: float | None = Field(
        default=15.0,
        ge=2.0,
        allow_inf_nan=False,
        description="a node without a sign of life for so long hangs and is killed; null: never",
    )
    nice: int = Field(
        default=0,
        ge=-20,
        le=19,
        description="how much it gives way to others on a busy computer; below 0: it takes "
        "precedence, where the user may give it",
    )


class ClocksSpec(Strict):
    """What is asked of the hosts' clocks where there are several; see docs/clocks.md."""

    max_offset_uncertainty_s: float = Field(
        default=0.005, gt=0, allow_inf_nan=False, description="beyond it the arms do not move"
    )
    max_drift_ratio: float = Field(
        default=5e-4, gt=0, lt=0.1, description="by how much one clock may gain on another"
    )
    rate_hz: float = Field(default=8.0, ge=1, le=100, description="of the pings")


class LaunchFile(Strict):
    """A launch file's keys."""

    scene: str | None = Field(default=None, description="scene file, relative to this one")
    hosts: dict[Name, HostSpec] = Field(default={MAIN: HostSpec(address="127.0.0.1")})
    nodes: dict[Name, NodeSpec]
    external_topics: list[str] = Field(
        default=[], description="topics that a tool writes into the graph, as `bag play` does"
    )
    clocks: ClocksSpec = ClocksSpec()
    record: dict[str, Any] | None = Field(
        default=None, description="parameters of a recorder on the main host"
    )


def apply_setting(document: Document, setting: str) -> None:
    origin = f"--set {setting}"
    target, equals, text = setting.partition("=")
    node, dot, parameter = target.partition(".")
    if not (equals and dot and node and parameter):
        raise BadInputError([Problem(origin, (), "is not a setting", "write node.parameter=value")])
    names = document.values.get("nodes")
    known = list(names) if isinstance(names, dict) else []
    inner = tuple(parameter.split("."))
    try:
        value = parse_value(text)
    except YAMLError as error:
        reason = str(error).splitlines()[0]
        raise BadInputError(
            [Problem(origin, (), f'"{text}" is not a value in YAML: {reason}', "quote it?")]
        ) from error
    if node in known:
        if not isinstance(document.values["nodes"][node], dict):
            raise BadInputError([document.problem(("nodes", node), "holds no keys")])
        document.set(("nodes", node, "parameters", *inner), value, origin)
    elif node == "recorder" and "record" in document.values:
        document.set(("record", *inner), value, origin)
    else:
        raise BadInputError(
            [Problem(origin, (), f'there is no node "{node}"', did_you_mean(node, known))]
        )


def apply_record(document: Document, bag: Path) -> None:
    origin = f"--record {bag}"
    if bag.exists():
        raise BadInputError(
            [Problem(origin, (), "exists already", "a bag is never written over; name another")]
        )
    names = document.values.get("nodes")
    for name, spec in names.items() if isinstance(names, dict) else ():
        if isinstance(spec, dict) and _role(spec.get("type")) is NodeRole.RECORDER:
            document.set(("nodes", name, "parameters", "bag"), str(bag), origin)
            return
    document.set(("record", "bag"), str(bag), origin)


def apply_console(document: Document) -> None:
    origin = "--console"
    nodes = document.values.get("nodes")
    specs = [one for one in nodes.values() if isinstance(one, dict)] if nodes else []
    roles = {_role(spec.get("type")) for spec in specs}
    if NodeRole.CONSOLE not in roles:
        added: dict[str, Any] = {"type": "console", "nice": CONSOLE_NICE}
        if NodeRole.FINGER_SIMULATOR not in roles:
            added["parameters"] = {"control_finger": False}
        document.set(("nodes", "console"), added, origin)
    if NodeRole.RECORDER not in roles and "record" not in document.values:
        parameters = {"bag": str(RECORDINGS.absolute()), "start_paused": True}
        recorder = {"type": "recorder", "nice": RECORDER_NICE, "parameters": parameters}
        document.set(("nodes", "recorder"), recorder, origin)


def _role(type_name: object) -> NodeRole | None:
    """The role of a node type; None also for one that resolving will report as unknown."""
    try:
        return role_of(node_class(str(type_name)))
    except (UnknownNodeError, ImportError, AttributeError, TypeError):
        return None
