"""Resolve the nodes of a launch file to classes, ports with topics, and parameters."""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable
from itertools import product
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from flexsheet.launch.plans.documents import BadInputError, Document, Key, did_you_mean, validate
from flexsheet.launch.plans.hosts import clock_node, is_loopback
from flexsheet.launch.plans.launch_file import RECORDER_NICE, ClocksSpec, LaunchFile, NodeSpec
from flexsheet.launch.plans.plan_model import LAUNCHER, RUN_DIRECTORY, TOOLS, ResolvedPort, tools_on
from flexsheet.messages.calibration import StereoCalibration, refuse_other_camera
from flexsheet.messages.calibration_file import CalibrationFileError, CalibrationMismatchError
from flexsheet.messages.marker_calibration import MarkerCalibration, refuse_other_marker
from flexsheet.messages.scene import Scene
from flexsheet.messages.sheet_calibration import SheetCalibration, refuse_other_sheet
from flexsheet.messages.topics import TOPICS, Topic
from flexsheet.nodes import NODES, NodeImportError, UnknownNodeError, node_class
from flexsheet.nodes.node import (
    Node,
    NodeParameters,
    Port,
    find_parameters_type,
    find_ports,
    find_timers,
    find_unmatched_handlers,
    further_port,
)
from flexsheet.nodes.parameter_marks import ParameterMark, find_marked

RUN_FILES = ("plan", "git", "launcher")
"""The names that nodes must not have, because files in the run's folder have these names."""

_PARAMETER_SECTIONS: tuple[Key, ...] = (("record",), ("clocks",))
"""The keys of a launch file that directly contain the parameters of a node.

Other nodes have their parameters below the key `parameters`.
"""


class NodeEntry:
    """A node of a launch file, while the launch file is resolved.

    type, parameters: class and parameters of the node, which are None until they are resolved.
    ports: connected ports with their topics.
    unconnected: unconnected ports, each with a topic to which the port could be connected.
    """

    def __init__(self, name: str, spec: NodeSpec, key: Key) -> None:
        self.name, self.spec, self.key = name, spec, key
        self.type: type[Node] | None = None
        self.parameters: NodeParameters | None = None
        self.ports: list[tuple[Port, Topic]] = []
        self.unconnected: list[tuple[Port, Topic]] = []
        self.further_inputs: list[Topic] = []

    def topics(self, direction: str) -> list[tuple[str, Topic]]:
        """Return (port name, topic) of all connected ports in a direction ("input" or "output")."""
        found = [(port.name, topic) for port, topic in self.ports if port.direction == direction]
        if direction == "input":
            found += [(further_port(topic.name), topic) for topic in self.further_inputs]
        return found

    def disconnect_optional(self, written: Container[str]) -> None:
        """Disconnect optional inputs whose topics have no writer.

        Inputs that the launch file names explicitly stay connected.

        written: names of the topics that have a writer.
        """
        if self.type is None:
            return
        self.disconnect(
            port.name
            for port, topic in self.ports
            if port.name in self.type.optional_inputs and topic.name not in written
        )

    def disconnect(self, ports: Iterable[str]) -> None:
        """Disconnect the named ports, except for ports to which the launch file assigns a topic."""
        names = set(ports) - self.spec.topics.keys()
        for port, topic in [*self.ports]:
            if port.name in names:
                self.ports.remove((port, topic))
                self.unconnected.append((port, topic))

    def unconnected_ports(self, direction: str) -> tuple[ResolvedPort, ...]:
        """Return the unconnected ports in a direction ("input" or "output")."""
        return tuple(
            ResolvedPort(port=port.name, topic=topic.name, endpoints=())
            for port, topic in self.unconnected
            if port.direction == direction
        )


def collect_entries(spec: LaunchFile, document: Document) -> list[NodeEntry]:
    """Return the nodes of a launch file, including automatically added recorder and clock nodes.

    document: contents of the launch file. Errors in the list of nodes are stored in it.
    """
    entries = []
    for name, node_spec in spec.nodes.items():
        entries.append(NodeEntry(name, node_spec, ("nodes", name)))
        taken = (*map(tools_on, spec.hosts), *map(clock_node, spec.hosts), TOOLS, *RUN_FILES)
        if name in taken or name.partition("_")[0] == LAUNCHER:
            document.report(
                ("nodes", name), f'the name "{name}" is reserved', "choose another name"
            )
        if node_spec.host not in spec.hosts:
            document.report(
                ("nodes", name, "host"),
                f'unknown host "{node_spec.host}"',
                did_you_mean(node_spec.host, list(spec.hosts)),
            )
    if not entries:
        document.report(("nodes",), "the graph has no node", "add a node")
    if spec.record is not None:
        if "recorder" in spec.nodes:
            document.report(
                ("record",),
                'the graph already has a node "recorder"',
                'remove the key "record" or the node "recorder"',
            )
        else:
            recorder = NodeSpec(type="recorder", parameters=spec.record, nice=RECORDER_NICE)
            entries.append(NodeEntry("recorder", recorder, ("record",)))
    if len(spec.hosts) > 1:
        entries += [_clock_entry(host, spec.clocks) for host in spec.hosts]
    return entries


def _clock_entry(host: str, clocks: ClocksSpec) -> NodeEntry:
    node_spec = NodeSpec(
        type="clock",
        host=host,
        parameters=clocks.model_dump(),
        topics={"clock_ping_out": "clock_ping"},
    )
    return NodeEntry(clock_node(host), node_spec, ("clocks",))


def resolve_entry(entry: NodeEntry, document: Document) -> None:
    """Find the node's class, connect its ports, and check its parameters.

    document: contents of the launch file. Errors are stored in it.
    """
    key = entry.key
    type_name = entry.spec.type
    try:
        class_ = node_class(type_name)
    except UnknownNodeError:
        document.report(
            (*key, "type"), f'unknown node type "{type_name}"', did_you_mean(type_name, list(NODES))
        )
        return
    except NodeImportError as error:
        document.report((*key, "type"), str(error))
        return
    if not (isinstance(class_, type) and issubclass(class_, Node)):
        document.report(
            (*key, "type"),
            f'"{type_name}" is not a node class',
            "name a class that derives from Node",
        )
        return
    entry.type = class_
    _connect_ports(entry, class_, document)

    parameters_key = key if key in _PARAMETER_SECTIONS else (*key, "parameters")
    try:
        entry.parameters = find_parameters_type(class_).model_validate(entry.spec.parameters)
    except ValidationError:
        _ensure_key(document, parameters_key, entry.spec.parameters)
        try:
            validate(find_parameters_type(class_), document, at=parameters_key)
        except BadInputError as error:
            document.problems.extend(error.problems)


def _ensure_key(document: Document, key: Key, value: dict[str, Any]) -> None:
    """Insert `value` at `key`, unless the document already contains that key."""
    target: Any = document.values
    for part in key[:-1]:
        target = target[part]
    target.setdefault(key[-1], value)


def _connect_ports(entry: NodeEntry, class_: type[Node], document: Document) -> None:
    ports = find_ports(class_)
    if class_.live_parameters and "parameter" not in ports:
        document.report(
            (*entry.key, "type"),
            f'"{entry.spec.type}" has live_parameters, but no input for their changes',
            "declare parameter: Input[ParameterChange] in the class",
        )
    handlers = [f"on_{port.name}" for port in ports.values() if port.direction == "input"]
    for name in find_unmatched_handlers(class_):
        document.report(
            (*entry.key, "type"),
            f'the method {name} of "{entry.spec.type}" handles no input',
            did_you_mean(name, handlers),
        )
    parameters = list(find_parameters_type(class_).model_fields)
    for timer in find_timers(class_):
        if timer.rate_parameter not in parameters:
            document.report(
                (*entry.key, "type"),
                f'the method {timer.method} of "{entry.spec.type}" is periodic with the rate '
                f'"{timer.rate_parameter}", which is not a parameter of the node',
                did_you_mean(timer.rate_parameter, parameters),
            )
    for name in entry.spec.topics:
        if name not in ports:
            document.report(
                (*entry.key, "topics", name),
                f'"{entry.spec.type}" has no port "{name}"',
                did_you_mean(name, list(ports)),
            )
    for port in ports.values():
        topic_name = entry.spec.topics.get(port.name, port.name.replace("__", "/"))
        fitting = [one for one in TOPICS.values() if one.message is port.message]
        if topic_name is None and fitting:
            entry.unconnected.append((port, fitting[0]))
            continue
        topic_name = str(topic_name)
        key = (*entry.key, "topics", port.name)
        topic = TOPICS.get(topic_name)
        if topic is None and port.name in entry.spec.topics:
            document.report(
                key, f'unknown topic "{topic_name}"', did_you_mean(topic_name, list(TOPICS))
            )
        elif topic is None:
            names = " or ".join(one.name for one in fitting)
            document.report(
                key,
                f'port "{port.name}" is not connected',
                f'name its topic in "topics": {names}'
                if fitting
                else f"no topic has the message type {port.message.__name__}; add a topic to "
                "messages/topics.py, or use a message type of `flexsheet topic list --all`",
            )
        elif topic.message is not port.message:
            document.report(
                key,
                f'topic "{topic.name}" has message type {topic.message.__name__}, '
                f'but port "{port.name}" requires {port.message.__name__}',
                "connect a topic of the required type",
            )
        else:
            entry.ports.append((port, topic))


def check_device_hosts(entries: list[NodeEntry], spec: LaunchFile, document: Document) -> None:
    """Report a problem if a device is not connected to the host of its node.

    Device protocols are not encrypted, so their data must not cross the network between hosts.
    """
    for entry in entries:
        if entry.parameters is None:
            continue
        marked = find_marked(entry.parameters, ParameterMark.DEVICE_HOST)
        for (key, address), (name, host) in product(marked.items(), spec.hosts.items()):
            if host.address == address and name != entry.spec.host and not is_loopback(address):
                document.report(
                    (*entry.key, "parameters", *key),
                    f'{address} is the address of host "{name}": the device data would cross the '
                    "network without encryption",
                    f"run {entry.name} on that host (host: {name})",
                )


CALIBRATION_CHECKS: dict[
    ParameterMark, tuple[Callable[[Path], Any], Callable[[Any, Scene], None]]
] = {
    ParameterMark.CAMERA_CALIBRATION: (
        StereoCalibration.load,
        lambda measured, scene: refuse_other_camera(measured, scene.camera),
    ),
    ParameterMark.SHEET_CALIBRATION: (
        SheetCalibration.load,
        lambda measured, scene: refuse_other_sheet(measured, scene.sheet),
    ),
    ParameterMark.MARKER_CALIBRATION: (MarkerCalibration.load, refuse_other_marker),
}
"""The two functions that load and check each kind of calibration file.

The first function loads the file. The second function rejects the calibration if it belongs to
another scene.
"""


def check_calibrations(entries: list[NodeEntry], scene: Scene | None, document: Document) -> None:
    """Report a problem if a node's calibration file is invalid or does not fit the scene."""
    for entry, (mark, (load, refuse)) in product(entries, CALIBRATION_CHECKS.items()):
        if entry.parameters is None:
            continue
        for marked, calibration in find_marked(entry.parameters, mark).items():
            key = (*entry.key, "parameters", *marked)
            path = Path(_absolute(calibration, document.folder(key)))
            try:
                measured = load(path)
                if scene is not None:
                    refuse(measured, scene)
            except CalibrationFileError as error:
                document.report(key, str(error))
            except CalibrationMismatchError as error:
                document.report(key, f"{path}: {error}")


def dump_parameters(entry: NodeEntry, document: Document, *, resolve_paths: bool) -> dict[str, Any]:
    """Return all parameters of a node as JSON values, including defaults.

    resolve_paths: whether to make paths absolute. Otherwise, paths remain relative to the folder of
        the launch file.
    """
    assert entry.parameters is not None  # otherwise the load has failed
    values = entry.parameters.model_dump(mode="json")
    if not resolve_paths:
        return values
    section = entry.key if entry.key in _PARAMETER_SECTIONS else (*entry.key, "parameters")
    for name in entry.parameters.model_fields_set:
        base = document.folder((*section, name))
        values[name] = _with_absolute_paths(getattr(entry.parameters, name), values[name], base)
    return values


def _with_absolute_paths(value: Any, dumped: Any, base: Path) -> Any:
    """Return the JSON form of a parameter value, with relative paths replaced by absolute paths.

    value: parameter value.
    dumped: JSON form of the value.
    base: base folder of relative paths.
    """
    if isinstance(value, Path):
        return _absolute(value, base)
    if isinstance(value, BaseModel):
        explicit = {
            name: _with_absolute_paths(getattr(value, name), dumped[name], base)
            for name in value.model_fields_set
        }
        return {**dumped, **explicit}
    if isinstance(value, tuple | list):
        return [
            _with_absolute_paths(one, plain, base) for one, plain in zip(value, dumped, strict=True)
        ]
    return dumped


def _absolute(path: Path, base: Path) -> str:
    if path.parts and path.parts[0] == RUN_DIRECTORY:
        return str(path)
    return str((base / path.expanduser()).resolve())
