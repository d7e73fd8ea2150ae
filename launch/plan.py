"""A launch file, checked and resolved: which node runs where, with what, and who talks to whom.

The launch file is the graph.  `load_plan` turns it into a `Plan` in which every endpoint is known
before any process starts; everything that is wrong with the file is reported at once.  Every host
computes the same plan from the same file, and the plan's hash says so.
"""

from __future__ import annotations

import hashlib
import ipaddress
import json
from collections.abc import Iterable, Sequence
from itertools import product
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, Field, ValidationError
from ruamel.yaml.error import YAMLError

from launch.documents import (
    BadInputError,
    Document,
    Key,
    Problem,
    did_you_mean,
    parse_value,
    read_document,
    validate,
)
from launch.meshes import scene_of
from launch.planned import (
    LAUNCHER,
    MAIN,
    RUN_DIRECTORY,
    TOOLS,
    Plan,
    PlannedNode,
    PlannedPort,
    RestartSpec,
    Strict,
    Writer,
    tools_on,
)
from messages.calibration import load_calibration, refuse_other_camera
from messages.calibration_file import CalibrationFileError, CalibrationMismatchError
from messages.scene import Scene
from messages.security import is_key
from messages.sheet_calibration import load_sheet_calibration, refuse_other_sheet
from messages.topics import TOPICS, Topic
from nodes import NODES, UnknownNodeError, node_class
from nodes.node import Node, NodeParameters, Port, parameters_of, ports_of

SAID_FROM_ANYWHERE = ("estop",)
"""What tools on the other hosts may write too: a stop, by whoever stands beside the arm."""

LAUNCHERS_TOPICS = ("host", "estop")
"""What the launcher of each host writes: how the host is, and an e-stop that it keeps."""

RECORDER_NICE = 5
"""What it reads waits for it in queues; nothing else waits."""

CONSOLE_NICE = 10
"""Who looks on must not slow what is looked at."""

RECORDINGS = Path("runs") / "%Y%m%d-%H%M%S.mcap"
"""Where a recorder that waits for the console puts its bags, from where the command was given."""

FIRST_PORT, PORTS = 20_000, 10_000
"""TCP ports lie below the range that Linux gives to outgoing connections (32768 and up)."""

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
        default=0, ge=0, le=19, description="how much it gives way to others on a busy computer"
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
    from_tools: list[str] = Field(
        default=[], description="topics that a tool writes into the graph, as `bag play` does"
    )
    clocks: ClocksSpec = ClocksSpec()
    record: dict[str, Any] | None = Field(
        default=None, description="parameters of a recorder on the main host"
    )


_PARAMETERS_THEMSELVES: tuple[Key, ...] = (("record",), ("clocks",))
"""Keys of the launch file that hold a node's parameters; other nodes have them one key deeper."""


class _Member:
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
            found += [(f"in/{topic.name}", topic) for topic in self.further_inputs]
        return found

    def unconnected_ports(self, direction: str) -> tuple[PlannedPort, ...]:
        return tuple(
            PlannedPort(port=port.name, topic=topic.name, endpoints=())
            for port, topic in self.unconnected
            if port.direction == direction
        )


def load_plan(
    path: Path,
    *,
    settings: Sequence[str] = (),
    record: Path | None = None,
    console: bool = False,
) -> Plan:
    """Read, check and resolve a launch file.

    settings: "node.parameter=value" each, value in YAML, over what the file says.
    record: a bag to record to, over what the file says.
    console: add a console, and a recorder that waits for its word, where the file has none.
    Raises BadInputError with everything that is wrong.
    """
    document = read_document(path)
    if record is not None:
        _apply_record(document, record)
    if console:
        _apply_console(document)
    for setting in settings:
        _apply_setting(document, setting)
    spec = validate(LaunchFile, document)
    problems: list[Problem] = []
    check_hosts(spec.hosts, document, problems)
    scene_document, scene = _load_scene(spec, document, problems)
    members = _members(spec, document, problems)
    for member in members:
        _resolve_member(member, document, problems)
    writers = _writers(spec, members, document, problems, has_scene=scene is not None)
    _resolve_further_inputs(members, writers, document, problems)
    _check_inputs(members, writers, document, problems)
    _check_calibrations(members, scene, document, problems)
    _check_wires(members, spec, document, problems)
    if problems:
        raise BadInputError(problems)

    addresses = {name: host.address for name, host in spec.hosts.items()}
    endpoints = _endpoints(writers, addresses)
    nodes = {
        member.name: _planned(member, endpoints, document, resolve_paths=True) for member in members
    }
    scene_values = None if scene is None else scene.model_dump(mode="json")
    resetters = tuple(
        name
        for name, host in spec.hosts.items()
        if (name == MAIN if host.may_reset_estop is None else host.may_reset_estop)
    )
    portable = {
        "hosts": addresses,
        "estop_resetters": resetters,
        "scene": scene_values,
        "nodes": [
            _planned(member, endpoints, document, resolve_paths=False).model_dump(mode="json")
            for member in sorted(members, key=lambda member: member.name)
        ],
    }
    return Plan(
        launch_file=str(path),
        launch_text=document.text,
        scene_file=None if scene_document is None else str(scene_document.path),
        scene_text="" if scene_document is None else scene_document.text,
        scene=scene_values,
        hosts=addresses,
        nodes=nodes,
        writers=endpoints,
        keys={name: host.key for name, host in spec.hosts.items() if host.key is not None},
        estop_resetters=resetters,
        hash=hashlib.sha256(json.dumps(portable, sort_keys=True).encode()).hexdigest()[:16],
    )


def load_keys(path: Path) -> dict[str, str]:
    """The public key of each host in a launch file, which may have changed since it was started.

    Raises BadInputError.
    """
    document = read_document(path)
    spec = validate(LaunchFile, document)
    problems: list[Problem] = []
    check_hosts(spec.hosts, document, problems)
    if problems:
        raise BadInputError(problems)
    return {name: host.key for name, host in spec.hosts.items() if host.key is not None}


def launcher_on(host: str) -> str:
    """The launcher of a host, as a writer."""
    return LAUNCHER if host == MAIN else f"{LAUNCHER}_{host}"


def load_scene(path: Path) -> Scene:
    """Read and check a scene file; raises BadInputError."""
    return scene_of(read_document(path))


def is_loopback(address: str) -> bool:
    return ipaddress.ip_address(address).is_loopback


def _apply_setting(document: Document, setting: str) -> None:
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


def _apply_record(document: Document, bag: Path) -> None:
    origin = f"--record {bag}"
    if bag.exists():
        raise BadInputError(
            [Problem(origin, (), "exists already", "a bag is never written over; name another")]
        )
    names = document.values.get("nodes")
    for name, spec in names.items() if isinstance(names, dict) else ():
        if isinstance(spec, dict) and spec.get("type") == "recorder":
            document.set(("nodes", name, "parameters", "bag"), str(bag), origin)
            return
    document.set(("record", "bag"), str(bag), origin)


def _apply_console(document: Document) -> None:
    origin = "--console"
    nodes = document.values.get("nodes")
    specs = [one for one in nodes.values() if isinstance(one, dict)] if nodes else []
    types = {str(spec.get("type")) for spec in specs}
    if "console" not in types:
        added: dict[str, Any] = {"type": "console", "nice": CONSOLE_NICE}
        if "twin_finger" not in types:
            added["parameters"] = {"drives_finger": False}
        document.set(("nodes", "console"), added, origin)
    if "recorder" not in types and "record" not in document.values:
        parameters = {"bag": str(RECORDINGS.absolute()), "waits": True}
        recorder = {"type": "recorder", "nice": RECORDER_NICE, "parameters": parameters}
        document.set(("nodes", "recorder"), recorder, origin)


def check_hosts(hosts: dict[str, HostSpec], document: Document, problems: list[Problem]) -> None:
    """Addresses and keys: each a good one, each of one host."""
    if MAIN not in hosts:
        problems.append(
            document.problem(
                ("hosts",), f'no host is named "{MAIN}"', "the launcher and the tools need it"
            )
        )
    _check_keys(hosts, document, problems)
    seen: dict[str, str] = {}
    for name, host in hosts.items():
        key: Key = ("hosts", name, "address")
        try:
            address = ipaddress.ip_address(host.address)
        except ValueError:
            problems.append(
                document.problem(key, f'"{host.address}" is no IP address', 'as in "192.0.2.10"')
            )
            continue
        if address.is_unspecified or address.is_multicast:
            problems.append(
                document.problem(
                    key, f'"{host.address}" names no single host', "give the address of its own"
                )
            )
        other = seen.setdefault(host.address, name)
        if other != name:
            problems.append(
                document.problem(
                    key, f'"{host.address}" is the address of host "{other}" too', "make them one"
                )
            )


def _check_keys(hosts: dict[str, HostSpec], document: Document, problems: list[Problem]) -> None:
    seen: dict[str, str] = {}
    for name, host in hosts.items():
        where: Key = ("hosts", name, "key")
        if host.key is None:
            if any(other.key is not None for other in hosts.values()):
                problems.append(
                    document.problem(
                        ("hosts", name),
                        "has no key, others have",
                        f"make one there (flexsheet keys new {name}), then: "
                        f"flexsheet keys install FILE {name} KEY",
                    )
                )
        elif not is_key(host.key):
            problems.append(
                document.problem(
                    where,
                    f'"{host.key}" is no public key',
                    f"40 characters, as this prints: flexsheet keys show {name}",
                )
            )
        elif seen.setdefault(host.key, name) != name:
            problems.append(
                document.problem(
                    where, f'is the key of host "{seen[host.key]}" too', "each host has its own"
                )
            )


def _check_wires(
    members: list[_Member], spec: LaunchFile, document: Document, problems: list[Problem]
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


def _load_scene(
    spec: LaunchFile, document: Document, problems: list[Problem]
) -> tuple[Document | None, Scene | None]:
    if spec.scene is None:
        return None, None
    path = document.path.parent / spec.scene
    if not path.is_file():
        problems.append(
            document.problem(
                ("scene",), f'"{spec.scene}" is no file', f"it is looked for at {path}"
            )
        )
        return None, None
    try:
        scene_document = read_document(path)
        return scene_document, scene_of(scene_document)
    except BadInputError as error:
        problems.extend(error.problems)
        return None, None


def _members(spec: LaunchFile, document: Document, problems: list[Problem]) -> list[_Member]:
    members = []
    for name, node_spec in spec.nodes.items():
        members.append(_Member(name, node_spec, ("nodes", name)))
        taken = (*map(tools_on, spec.hosts), *map(clock_node, spec.hosts), TOOLS)
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
            members.append(_Member("recorder", recorder, ("record",)))
    if len(spec.hosts) > 1:
        members += [_clock_member(host, spec.clocks) for host in spec.hosts]
    return members


def _clock_member(host: str, clocks: ClocksSpec) -> _Member:
    node_spec = NodeSpec(
        type="clock",
        host=host,
        parameters=clocks.model_dump(),
        topics={"clock_ping_out": "clock_ping"},
    )
    return _Member(clock_node(host), node_spec, ("clocks",))


def clock_node(host: str) -> str:
    """The node that measures the other hosts' clocks for a host."""
    return f"clock_{host}"


def _resolve_member(member: _Member, document: Document, problems: list[Problem]) -> None:
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
    member: _Member, class_: type[Node], document: Document, problems: list[Problem]
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


def _writers(
    spec: LaunchFile,
    members: list[_Member],
    document: Document,
    problems: list[Problem],
    *,
    has_scene: bool,
) -> dict[str, list[tuple[str, str]]]:
    """(writer, host) of every topic, in the order of the file."""
    writers: dict[str, list[tuple[str, str]]] = {}
    has_editor = any(topic.name == "scene" for one in members for _, topic in one.topics("output"))
    if has_scene and not has_editor:
        writers["scene"] = [(LAUNCHER, MAIN)]
    for member in members:
        for port_name, topic in member.topics("output"):
            others = [name for name, _ in writers.get(topic.name, [])]
            if others and (not topic.many_writers or member.name in others):
                problems.append(
                    document.problem(
                        (*member.key, "topics", port_name),
                        f'topic "{topic.name}" is written by "{others[0]}" already',
                        "a topic has one writer",
                    )
                )
            else:
                writers.setdefault(topic.name, []).append((member.name, member.spec.host))
    for i, name in enumerate(spec.from_tools):
        if name not in TOPICS:
            problems.append(
                document.problem(
                    ("from_tools", i), f'unknown topic "{name}"', did_you_mean(name, list(TOPICS))
                )
            )
        elif name in writers and not TOPICS[name].many_writers:
            problems.append(
                document.problem(
                    ("from_tools", i),
                    f'topic "{name}" is written by "{writers[name][0][0]}" already',
                    "a topic has one writer",
                )
            )
        elif not TOPICS[name].many_writers:
            writers[name] = [(TOOLS, MAIN)]
    for name, host in product(LAUNCHERS_TOPICS, spec.hosts):
        writers.setdefault(name, []).append((launcher_on(host), host))
    for topic in TOPICS.values():
        if topic.many_writers and topic.open_to_tools:
            writers.setdefault(topic.name, []).append((TOOLS, MAIN))
    for name, host in product(SAID_FROM_ANYWHERE, spec.hosts):
        if host != MAIN:
            writers.setdefault(name, []).append((tools_on(host), host))
    return writers


def _resolve_further_inputs(
    members: list[_Member],
    writers: dict[str, list[tuple[str, str]]],
    document: Document,
    problems: list[Problem],
) -> None:
    """Ask the members that subscribe by their parameters (the recorder) which topics they want."""
    written = [topic for topic in TOPICS.values() if topic.name in writers]
    for member in members:
        if member.type is None or member.parameters is None:
            continue
        for name in member.type.further_inputs(member.parameters, written):
            if name in TOPICS:
                member.further_inputs.append(TOPICS[name])
            else:
                problems.append(
                    document.problem(
                        member.key, f'unknown topic "{name}"', did_you_mean(name, list(TOPICS))
                    )
                )


def _check_inputs(
    members: list[_Member],
    writers: dict[str, list[tuple[str, str]]],
    document: Document,
    problems: list[Problem],
) -> None:
    for member in members:
        for port_name, topic in member.topics("input"):
            if topic.name not in writers:
                remedy = (
                    'name a scene file in "scene"'
                    if topic.name == "scene"
                    else 'add the node that does, list it in "from_tools" for a tool to write, '
                    f"or leave the port out with topics: {{{port_name}: null}}"
                )
                problems.append(
                    document.problem(
                        (*member.key, "topics", port_name),
                        f'nobody writes topic "{topic.name}"',
                        remedy,
                    )
                )


def _check_calibrations(
    members: list[_Member], scene: Scene | None, document: Document, problems: list[Problem]
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


def _endpoints(
    writers: dict[str, list[tuple[str, str]]], addresses: dict[str, str]
) -> dict[str, tuple[Writer, ...]]:
    """The endpoints of every writer: ipc for its host, tcp where there are others.

    Each topic can be read on each host, for the tools there; nothing is sent to who does not ask.
    """
    far = sorted(
        (host, writer, topic)
        for topic, entries in writers.items()
        for writer, host in entries
        if addresses.keys() - {host}
    )
    ports = _ports(far)
    return {
        topic: tuple(
            Writer(
                name=writer,
                host=host,
                ipc=f"ipc://{RUN_DIRECTORY}/{writer}.{topic.replace('/', '.')}",
                tcp=_tcp(addresses[host], ports.get((host, writer, topic))),
            )
            for writer, host in entries
        )
        for topic, entries in writers.items()
    }


def _tcp(address: str, port: int | None) -> str | None:
    if port is None:
        return None
    return f"tcp://[{address}]:{port}" if ":" in address else f"tcp://{address}:{port}"


def _ports(links: Iterable[tuple[str, str, str]]) -> dict[tuple[str, str, str], int]:
    """A TCP port for each (host, writer, topic), from the hash of its name.

    Two that fall on one port are told apart in the order of their names, so that adding a topic
    moves no other's port unless they meet.  Ports are unique over all hosts: hosts may share a
    machine.
    """
    taken: dict[int, tuple[str, str, str]] = {}
    for link in links:
        digest = hashlib.sha256("/".join(link).encode()).digest()
        offset = int.from_bytes(digest[:4], "big") % PORTS
        while FIRST_PORT + offset in taken:
            offset = (offset + 1) % PORTS
        taken[FIRST_PORT + offset] = link
    return {link: port for port, link in taken.items()}


def _planned(
    member: _Member,
    endpoints: dict[str, tuple[Writer, ...]],
    document: Document,
    *,
    resolve_paths: bool,
) -> PlannedNode:
    host = member.spec.host
    return PlannedNode(
        name=member.name,
        type=member.spec.type,
        host=host,
        parameters=_parameters(member, document, resolve_paths=resolve_paths),
        inputs=tuple(
            PlannedPort(
                port=port,
                topic=topic.name,
                endpoints=tuple(one.endpoint_for(host) for one in endpoints[topic.name]),
            )
            for port, topic in member.topics("input")
        )
        + member.unconnected_ports("input"),
        outputs=tuple(
            PlannedPort(
                port=port,
                topic=topic.name,
                endpoints=next(
                    one.endpoints for one in endpoints[topic.name] if one.name == member.name
                ),
            )
            for port, topic in member.topics("output")
        )
        + member.unconnected_ports("output"),
        restart=member.spec.restart,
        start_deadline_s=member.spec.start_deadline_s,
        liveness_s=member.spec.liveness_s,
        nice=member.spec.nice,
    )


def _parameters(member: _Member, document: Document, *, resolve_paths: bool) -> dict[str, Any]:
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
