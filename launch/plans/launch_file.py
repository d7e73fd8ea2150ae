"""Define the keys of launch files, and apply command-line options to launch files."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from pydantic import Field
from ruamel.yaml.error import YAMLError

from flexsheet.launch.plans.documents import (
    BadInputError,
    Document,
    did_you_mean,
    parse_value,
    read_document,
)
from flexsheet.launch.plans.plan_model import MAIN, RestartSpec, StrictModel
from flexsheet.launch.plans.shipped import LAUNCH_FILES, find_file, name_shipped
from flexsheet.nodes import NodeImportError, NodeRole, UnknownNodeError, node_class
from flexsheet.nodes.node import find_role

RECORDER_NICE = 5
"""The default niceness of the recorder.

A delay of the recorder affects no other node, because messages for the recorder wait in queues.
"""

CONSOLE_NICE = 10
"""The niceness of the console that the option --console adds.

A process with high niceness has low priority, so the console does not delay other nodes.
"""

RECORDINGS = Path("runs") / "%Y%m%d-%H%M%S.mcap"
"""The strftime pattern for the paths of bag files that are recorded from the console.

The path is relative to the working folder.
"""

MERGED_LEVELS = 4
"""The depth to which a launch file is merged with the file that it extends.

The keys nodes.NAME.parameters.KEY are at this depth.
"""

SCENE_KEY_SET = frozenset({"object", "sheet", "arms", "camera", "working_range"})
"""The keys by which a scene file is distinguished from a launch file."""

Name = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]*$", max_length=32)]


class HostSpec(StrictModel):
    """The settings of one host (computer) of the graph."""

    address: str = Field(description="IP address on which the host's nodes listen")
    key: str | None = Field(
        default=None, description="public key of the host, as printed by flexsheet keys"
    )
    may_reset_estop: bool | None = Field(
        default=None,
        description="whether nodes of the host are allowed to reset an emergency stop; null: only "
        "nodes of the main host are allowed",
    )


class NodeSpec(StrictModel):
    """The settings of one node in a launch file."""

    type: str = Field(description='node type: a shipped one, or "module:Class"')
    host: str = MAIN
    process: Name | None = Field(
        default=None,
        description="name of a process that several nodes share; null: the node has its own "
        "process",
    )
    shares_arm_process: bool = Field(
        default=False,
        description="arm bridge only: allow nodes other than its simulator in the same process; "
        "a fault of such a node stops the arm",
    )
    parameters: dict[str, Any] = Field(default={})
    always: bool = Field(
        default=False, description="start the node even if neither the scene nor the graph needs it"
    )
    topics: dict[str, str | None] = Field(
        default={},
        description="topic of each port whose name differs from the topic; null: the port is not "
        "connected",
    )
    restart: RestartSpec = RestartSpec()
    start_deadline_s: float = Field(default=60.0, gt=0, allow_inf_nan=False)
    liveness_s: float | None = Field(
        default=15.0,
        ge=2.0,
        allow_inf_nan=False,
        description="maximum time without a heartbeat, s, after which the node is killed; null: "
        "no limit",
    )
    nice: int = Field(
        default=0,
        ge=-20,
        le=19,
        description="niceness of the process, added to that of the launcher; values below 0 "
        "(higher priority) need root or CAP_SYS_NICE",
    )
    realtime_priority: int | None = Field(
        default=None,
        ge=1,
        le=49,
        description="real-time priority of the process when its nodes are ready: it then "
        "interrupts all processes with a lower or no real-time priority; needs root, CAP_SYS_NICE "
        "or rtprio in limits.conf; null: the process has no real-time priority",
    )


class ClocksSpec(StrictModel):
    """The required accuracy of the clock comparison between hosts.

    docs/clocks.md describes the comparison.
    """

    max_offset_uncertainty_s: float = Field(
        default=0.005,
        gt=0,
        allow_inf_nan=False,
        description="maximum uncertainty of a clock offset, s; the arms do not move while it is "
        "exceeded",
    )
    max_drift_ratio: float = Field(
        default=5e-4,
        gt=0,
        lt=0.1,
        description="maximum relative drift of one clock against another",
    )
    rate_hz: float = Field(default=8.0, ge=1, le=100, description="rate of clock measurements, Hz")


class LaunchFile(StrictModel):
    """The keys of a launch file, with their types and defaults."""

    extends: str | None = Field(
        default=None,
        description="launch file from which missing values are inherited: a path relative to this "
        "file, or the name of a shipped launch file, such as demo",
    )
    scene: str | None = Field(
        default=None,
        description="scene file, relative to the launch file, or the name of a shipped scene",
    )
    hosts: dict[Name, HostSpec] = Field(default={MAIN: HostSpec(address="127.0.0.1")})
    nodes: dict[Name, NodeSpec]
    external_topics: list[str] = Field(
        default=[], description="topics that command-line tools such as `bag play` publish"
    )
    clocks: ClocksSpec = ClocksSpec()
    record: dict[str, Any] | None = Field(
        default=None, description="parameters of a recorder node that is added to the main host"
    )


def read_scene_file(path: Path) -> Document:
    """Read a scene file, without checking its values.

    Raises BadInputError if the file cannot be read, or if it is a launch file.
    """
    document = read_document(path)
    keys = document.values.keys()
    if {"nodes", "extends"} & keys and not SCENE_KEY_SET & keys:
        named = document.values.get("scene")
        remedy = f"give its scene: {named}" if isinstance(named, str) else "give a scene file"
        raise BadInputError.single(str(path), (), "the file is a launch file, not a scene", remedy)
    return document


def is_scene_file(path: Path) -> bool:
    """Return whether a YAML file is a scene, and not a launch file, calibration or apparatus.

    Raises BadInputError if the file cannot be read.
    """
    keys = read_document(path).values.keys()
    return bool({"object", "working_range"} & keys) and "nodes" not in keys


def read_launch_file(path: Path, extending: tuple[Path, ...] = ()) -> Document:
    """Read a launch file, and merge it with the files that it extends.

    extending: files that extend this file directly or indirectly. They are needed to detect
        circular references.

    Raises BadInputError if a file is invalid.
    """
    if not path.exists():
        raise BadInputError.single(
            str(path), (), "the file does not exist", name_shipped(path, LAUNCH_FILES)
        )
    document = read_document(path)
    if SCENE_KEY_SET & document.values.keys() and "nodes" not in document.values:
        raise BadInputError.single(
            str(path),
            (),
            "the file is a scene, not a launch file",
            f"use it with a launch file: flexsheet launch demo --scene {path}",
        )
    name = document.values.get("extends")
    if not isinstance(name, str):
        return document
    base = find_file(name, LAUNCH_FILES, path.parent)
    if not base.is_file():
        raise document.error(
            ("extends",),
            f'"{name}" does not exist',
            name_shipped(name, LAUNCH_FILES),
        )
    chain = (*extending, path.resolve())
    if base.resolve() in chain:
        raise document.error(
            ("extends",),
            f"circular reference: {base} also extends this file",
            "remove the key `extends` from one of the files",
        )
    document.extend(read_launch_file(base, chain), MERGED_LEVELS)
    nodes = document.values.get("nodes")
    if isinstance(nodes, dict):
        document.values["nodes"] = {node: spec for node, spec in nodes.items() if spec is not None}
    return document


def apply_scene(document: Document, scene: Path) -> None:
    """Replace the scene of a launch file, as the option --scene does."""
    document.set(("scene",), str(scene.absolute()), f"--scene {scene}")


def apply_setting(document: Document, setting: str) -> None:
    """Apply one value of the option --set to a launch file.

    setting: NODE.PARAMETER=VALUE or scene=FILE.

    Raises BadInputError if the setting is invalid.
    """
    origin = f"--set {setting}"
    target, equals, text = setting.partition("=")
    if target == "scene" and text:
        apply_scene(document, Path(text))
        return
    node, dot, parameter = target.partition(".")
    if not (equals and dot and node and parameter):
        raise BadInputError.single(
            origin, (), "node, parameter or value is missing", "write node.parameter=value"
        )
    names = document.values.get("nodes")
    known = list(names) if isinstance(names, dict) else []
    inner = tuple(parameter.split("."))
    try:
        value = parse_value(text)
    except YAMLError as error:
        reason = str(error).splitlines()[0]
        raise BadInputError.single(
            origin, (), f'"{text}" is not a valid YAML value: {reason}', "quote the value"
        ) from error
    if node in known:
        if not isinstance(document.values["nodes"][node], dict):
            raise document.error(
                ("nodes", node), "the value is not a mapping", "write the node's keys below it"
            )
        document.set(("nodes", node, "parameters", *inner), value, origin)
    elif node == "recorder" and "record" in document.values:
        document.set(("record", *inner), value, origin)
    else:
        remedy = "add --console" if node == "console" else did_you_mean(node, known)
        raise BadInputError.single(origin, (), f'unknown node "{node}"', remedy)


def apply_record(document: Document, bag: Path) -> None:
    """Set the bag file of the recorder, as the option --record does.

    If the graph has no recorder, a recorder is added.
    """
    origin = f"--record {bag}"
    if bag.exists():
        raise BadInputError.single(
            origin, (), "the file already exists", "name a new file; bags are never overwritten"
        )
    names = document.values.get("nodes")
    for name, spec in names.items() if isinstance(names, dict) else ():
        if isinstance(spec, dict) and _find_role(spec.get("type")) is NodeRole.RECORDER:
            document.set(("nodes", name, "parameters", "bag"), str(bag), origin)
            return
    document.set(("record", "bag"), str(bag), origin)


def apply_console(document: Document) -> None:
    """Add a console and a recorder that starts paused, as the option --console does."""
    origin = "--console"
    nodes = document.values.get("nodes")
    specs = [one for one in nodes.values() if isinstance(one, dict)] if nodes else []
    roles = {_find_role(spec.get("type")) for spec in specs}
    if NodeRole.CONSOLE not in roles:
        document.set(("nodes", "console"), {"type": "console", "nice": CONSOLE_NICE}, origin)
    if NodeRole.RECORDER not in roles and "record" not in document.values:
        parameters = {"bag": str(RECORDINGS.absolute()), "start_paused": True}
        recorder = {"type": "recorder", "nice": RECORDER_NICE, "parameters": parameters}
        document.set(("nodes", "recorder"), recorder, origin)


def _find_role(type_name: object) -> NodeRole | None:
    try:
        return find_role(node_class(str(type_name)))
    except (UnknownNodeError, NodeImportError, TypeError):
        return None
