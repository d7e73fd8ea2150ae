"""The nodes of a launch file under check: class, ports with their topics, parameters."""

from __future__ import annotations

from itertools import product
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from flexsheet.launch.plans.documents import (
    BadInputError,
    Document,
    Key,
    Problem,
    did_you_mean,
    validate,
)
from flexsheet.launch.plans.hosts import clock_node, is_loopback
from flexsheet.launch.plans.launch_file import RECORDER_NICE, ClocksSpec, LaunchFile, NodeSpec
from flexsheet.launch.plans.planned import LAUNCHER, RUN_DIRECTORY, TOOLS, PlannedPort, tools_on
from flexsheet.messages.calibration import load_calibration, refuse_other_camera
from flexsheet.messages.calibration_file import CalibrationFileError, CalibrationMismatchError
from flexsheet.messages.scene import Scene
from flexsheet.messages.sheet_calibration import load_sheet_calibration, refuse_other_sheet
from flexsheet.messages.topics import TOPICS, Topic
from flexsheet.nodes import NODES, UnknownNodeError, node_class
from flexsheet.nodes.node import (
    Node,
    NodeParameters,
    Port,
    further_port,
    parameters_of,
    ports_of,
)

RUN_FILES = ("plan", "git", "launcher")
"""What a run's directory has files of, beside one named after each node."""

_PARAMETERS_THEMSELVES: tuple[Key, ...] = (("record",), ("clocks",))
"""Keys of the launch file that hold a node's parameters; other nodes have them one key deeper."""


class Member:
    """A node under check: its spec, class, ports with their topics, and validated parameters."""

    def __init__(self, name: str, spec: NodeSpec, key: Key) -> None:
        self.name, self.spec, self.key = name, spec, key
        self.type: type[Node] | None = None
        self.parameters: NodeParameters | None = None
        self.ports: list[tuple[Port, Topic]] = []
        self.unconnected: list[tuple[Port, Topic]] = []
        self.further_inputs: list[Topic] = []

    def topics(self, direction: str) -> list[tuple[str, Topic]]:
        found = [(port.name, topic) for port, topic in self.ports if port.direction == direction]
        if direction == "input":
            found += [(further_port(topic.name), topic) for topic in self.further_inputs]
        return found

    def unconnected_ports(self, direction: str) -> tuple[PlannedPort, ...]:
        return tuple(
            PlannedPort(port=port.name, topic=topic.name, endpoints=())
            for port, topic in self.unconnected
            if port.direction == direction
        )


def members_of(spec: LaunchFile, document: Document, problems: list[Problem]) -> list[Member]:
    members = []
    for name, node_spec in spec.nodes.items():
        members.append(Member(name, node_spec, ("nodes", name)))
        taken = (*map(tools_on, spec.hosts), *map(clock_node, spec.hosts), TOOLS, *RUN_FILES)
        if name in taken or name.partition("_")[0] == LAUNCHER:
            problems.append(
                document.problem(("nodes", name), f'"{name}" is taken', "give another name")
            )
        if node_spec.host not in spec.hosts:
            problems.append(
                document.problem(
                    ("nodes", name, "host"),
                    f'unknown host "{node_spec.host}"',
                    did_you_mean(node_spec.host, list(spec.hosts)),
                )
            )
    if not members:
        problems.append(document.problem(("nodes",), "there is no node", "add one"))
    if spec.record is not None:
        if "recorder" in spec.nodes:
            problems.append(
                document.problem(
                    ("record",),
                    'there is a node "recorder" already',
                    'keep either "record" or the node',
                )
            )
        else:
            recorder = NodeSpec(type="recorder", parameters=spec.record, nice=RECORDER_NICE)
            members.append(Member("recorder", recorder, ("record",)))
    if len(spec.hosts) > 1:
        members += [_clock_member(host, spec.clocks) for host in spec.hosts]
    return members


def _clock_member(host: str, clocks: ClocksSpec) -> Member:
    node_spec = NodeSpec(
        type="clock",
        host=host,
        parameters=clocks.model_dump(),
        topics={"clock_ping_out": "clock_ping"},
    )
    return Member(clock_node(host), node_spec, ("clocks",))


def resolve_member(member: Member, document: Document, problems: list[Problem]) -> None:
    """Find the member's class, connect its ports to topics, check its parameters."""
    key = member.key
    type_name = member.spec.type
    try:
        class_ = node_class(type_name)
    except UnknownNodeError:
        problems.append(
            document.problem(
                (*key, "type"),
                f'unknown node type "{type_name}"',
                did_you_mean(type_name, list(NODES)),
            )
        )
        return
    except (ImportError, AttributeError, SyntaxError) as error:
        problems.append(
            document.problem(
                (*key, "type"), f'"{type_name}" cannot be imported: {error}', "see flexsheet doctor"
            )
        )
        return
    if not (isinstance(class_, type) and issubclass(class_, Node)):
        problems.append(document.problem((*key, "type"), f'"{type_name}" is no node class'))
        return
    member.type = class_
    _connect_ports(member, class_, document, problems)

    parameters_key = key if key in _PARAMETERS_THEMSELVES else (*key, "parameters")
    try:
        member.parameters = parameters_of(class_).model_validate(member.spec.parameters)
    except ValidationError:
        _put(document, parameters_key, member.spec.parameters)
        try:
            validate(parameters_of(class_), document, at=parameters_key)
        except BadInputError as error:
            problems.extend(error.problems)


def _put(document: Document, key: Key, value: dict[str, Any]) -> None:
    """Make sure that `key` is there to be checked (a node without parameters has no such key)."""
    target: Any = document.values
    for part in key[:-1]:
        target = target[part]
    target.setdefault(key[-1], value)


def _connect_ports(
    member: Member, class_: type[Node], document: Document, problems: list[Problem]
) -> None:
    ports = ports_of(class_)
    for name in member.spec.topics:
        if name not in ports:
            problems.append(
                document.problem(
                    (*member.key, "topics", name),
                    f'"{member.spec.type}" has no port "{name}"',
                    did_you_mean(name, list(ports)),
                )
            )
    for port in ports.values():
        topic_name = member.spec.topics.get(port.name, port.name.replace("__", "/"))
        fitting = [one for one in TOPICS.values() if one.message is port.message]
        if topic_name is None and fitting:
            member.unconnected.append((port, fitting[0]))
            continue
        topic_name = str(topic_name)
        key = (*member.key, "topics", port.name)
        topic = TOPICS.get(topic_name)
        if topic is None and port.name in member.spec.topics:
            problems.append(
                document.problem(
                    key, f'unknown topic "{topic_name}"', did_you_mean(topic_name, list(TOPICS))
                )
            )
        elif topic is None:
            names = " or ".join(one.name for one in fitting)
            problems.append(
                document.problem(
                    key,
                    f'port "{port.name}" is not connected',
                    f'say in "topics" which it is: {names or "no topic fits"}',
                )
            )
        elif topic.message is not port.message:
            problems.append(
                document.problem(
                    key,
                    f'topic "{topic.name}" carries {topic.message.__name__}, '
                    f'port "{port.name}" takes {port.message.__name__}',
                    "connect a topic of that type",
                )
            )
        else:
            member.ports.append((port, topic))


def check_wires(
    members: list[Member], spec: LaunchFile, document: Document, problems: list[Problem]
) -> None:
    """A device's own protocol knows no keys: it stays on the wire of the host it belongs to."""
    for member in members:
        address = getattr(member.parameters, "host", None)
        if member.type is None or not member.type.opens_devices or not isinstance(address, str):
            continue
        for name, host in spec.hosts.items():
            if host.address == address and name != member.spec.host and not is_loopback(address):
                problems.append(
                    document.problem(
                        (*member.key, "parameters", "host"),
                        f'{address} is host "{name}": what it says would cross the network '
                        "without keys",
                        f"run {member.name} there (host: {name})",
                    )
                )


def check_calibrations(
    members: list[Member], scene: Scene | None, document: Document, problems: list[Problem]
) -> None:
    """Parameters that name a calibration's file are read, and held against the scene."""

    def check_camera(path: Path) -> None:
        measured = load_calibration(path)
        if scene is not None:
            refuse_other_camera(measured, scene.camera)

    def check_sheet(path: Path) -> None:
        measured = load_sheet_calibration(path)
        if scene is not None:
            refuse_other_sheet(measured, scene.sheet)

    checks = {"calibration": check_camera, "sheet_calibration": check_sheet}
    for member, (name, check) in product(members, checks.items()):
        calibration = getattr(member.parameters, name, None)
        if not isinstance(calibration, Path):
            continue
        key = (*member.key, "parameters", name)
        path = Path(_absolute(calibration, _base(document, key)))
        try:
            check(path)
        except (CalibrationFileError, CalibrationMismatchError) as error:
            said = str(error) if str(path) in str(error) else f"{path}: {error}"
            problems.append(document.problem(key, said))


def in_full(member: Member, document: Document, *, resolve_paths: bool) -> dict[str, Any]:
    """The parameters in full, defaults too; paths that the file gives are relative to the file."""
    assert member.parameters is not None  # a member without parameters is a problem
    values = member.parameters.model_dump(mode="json")
    if not resolve_paths:
        return values
    section = member.key if member.key in _PARAMETERS_THEMSELVES else (*member.key, "parameters")
    for name in member.parameters.model_fields_set:
        base = _base(document, (*section, name))
        values[name] = _with_absolute_paths(getattr(member.parameters, name), values[name], base)
    return values


def _base(document: Document, key: Key) -> Path:
    """What paths at `key` are relative to: the file, or where the command was given."""
    return Path.cwd() if key in document.overrides else document.path.parent


def _with_absolute_paths(value: Any, dumped: Any, base: Path) -> Any:
    """`dumped`, the plain form of `value`, with each path in it made absolute from `base`."""
    if isinstance(value, Path):
        return _absolute(value, base)
    if isinstance(value, BaseModel):
        given = {
            name: _with_absolute_paths(getattr(value, name), dumped[name], base)
            for name in value.model_fields_set
        }
        return {**dumped, **given}
    if isinstance(value, tuple | list):
        return [
            _with_absolute_paths(one, plain, base) for one, plain in zip(value, dumped, strict=True)
        ]
    return dumped


def _absolute(path: Path, base: Path) -> str:
    if path.parts and path.parts[0] == RUN_DIRECTORY:
        return str(path)
    return str((base / path.expanduser()).resolve())
