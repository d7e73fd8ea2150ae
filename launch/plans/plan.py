"""Check a launch file, and resolve it to nodes with hosts, parameters and endpoints.

`load_graph` returns a `ResolvedGraph` with all defaults and network endpoints, before any process
starts. All errors of the file are reported together. All hosts must resolve the launch file to the
same graph. They compare the hash of the graph to verify this.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection, Sequence
from functools import reduce
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from flexsheet.launch.objects.meshes import make_scene
from flexsheet.launch.plans.apparatus import (
    give_apparatus,
    load_apparatus,
    refuse_apparatus_readers,
)
from flexsheet.launch.plans.documents import (
    BadInputError,
    Document,
    Problem,
    validate,
)
from flexsheet.launch.plans.hosts import check_hosts
from flexsheet.launch.plans.launch_file import (
    LaunchFile,
    apply_console,
    apply_record,
    apply_setting,
    read_launch_file,
    read_scene_file,
)
from flexsheet.launch.plans.needed_nodes import omit_unneeded
from flexsheet.launch.plans.plan_model import (
    MAIN,
    ResolvedGraph,
    ResolvedNode,
    ResolvedPort,
    Writer,
)
from flexsheet.launch.plans.processes import check_processes
from flexsheet.launch.plans.resolve_nodes import (
    CALIBRATION_CHECKS,
    NodeEntry,
    check_calibrations,
    check_device_hosts,
    collect_entries,
    dump_parameters,
    resolve_entry,
)
from flexsheet.launch.plans.routing import (
    check_inputs,
    list_writers,
    make_endpoints,
    resolve_further_inputs,
)
from flexsheet.launch.plans.shipped import SCENES, find_file, name_shipped
from flexsheet.messages.apparatus import Apparatus
from flexsheet.messages.scene import Scene
from flexsheet.nodes.node import NodeParameters, find_role
from flexsheet.nodes.parameter_marks import ParameterMark, find_marked


def load_graph(
    path: Path,
    *,
    settings: Sequence[str] = (),
    record: Path | None = None,
    console: bool = False,
    apparatus: str | None = None,
    needed: Collection[str] = (),
) -> ResolvedGraph:
    """Read, check and resolve a launch file.

    settings: texts "node.parameter=value" with a YAML value, or "scene=FILE". They override the
        values of the launch file.
    record: bag file that the recorder writes, instead of the bag file in the launch file.
    console: whether to add a console and a paused recorder if the launch file does not contain
        them.
    apparatus: true parameters of the simulated hardware, as a file name or "seed:N". If it is None,
        the scene contains the true parameters.
    needed: topics that the caller reads. The nodes that write these topics are started.

    Raises BadInputError, which lists all errors of the file, if the file is invalid.
    """
    document = read_launch_file(path)
    if record is not None:
        apply_record(document, record)
    if console:
        apply_console(document)
    for setting in settings:
        apply_setting(document, setting)
    spec = validate(LaunchFile, document)
    check_hosts(spec.hosts, document)
    scene_document, scene = _load_scene(spec, document)
    entries = collect_entries(spec, document)
    for entry in entries:
        resolve_entry(entry, document)
    scene_file = None if scene_document is None else scene_document.path
    truth = _load_apparatus(apparatus, scene, scene_file, document)
    give_apparatus(entries, truth, document)
    entries, omitted = omit_unneeded(entries, scene, needed, spec.external_topics)
    writers = list_writers(
        spec,
        entries,
        document,
        has_scene=spec.scene is not None,
        has_apparatus=apparatus is not None,
    )
    resolve_further_inputs(entries, writers, document)
    check_inputs(entries, writers, document)
    refuse_apparatus_readers(entries, document)
    check_calibrations(entries, scene, document)
    check_device_hosts(entries, spec, document)
    check_processes(entries, document)
    document.raise_problems()

    addresses = {name: host.address for name, host in spec.hosts.items()}
    endpoints = make_endpoints(writers, addresses)
    nodes = {
        entry.name: _make_node(entry, endpoints, document, resolve_paths=True) for entry in entries
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
            _make_node(entry, endpoints, document, resolve_paths=False).model_dump(mode="json")
            for entry in sorted(entries, key=lambda entry: entry.name)
        ],
    }
    return ResolvedGraph(
        launch_file=str(path),
        launch_text=document.text,
        scene_file=None if scene_document is None else str(scene_document.path),
        scene_text="" if scene_document is None else scene_document.text,
        scene=scene_values,
        apparatus=None if truth is None else truth.model_dump(mode="json"),
        hosts=addresses,
        nodes=nodes,
        omitted=tuple(omitted),
        writers=endpoints,
        keys={name: host.key for name, host in spec.hosts.items() if host.key is not None},
        estop_resetters=resetters,
        hash=hashlib.sha256(json.dumps(portable, sort_keys=True).encode()).hexdigest()[:16],
    )


def _load_scene(spec: LaunchFile, document: Document) -> tuple[Document | None, Scene | None]:
    if spec.scene is None:
        return None, None
    path = find_file(spec.scene, SCENES, document.folder(("scene",)))
    if not path.is_file():
        document.report(
            ("scene",),
            f'"{spec.scene}" does not exist',
            name_shipped(path, SCENES),
        )
        return None, None
    try:
        scene_document = read_scene_file(path)
        return scene_document, make_scene(scene_document)
    except BadInputError as error:
        document.problems.extend(error.problems)
        return None, None


def _load_apparatus(
    text: str | None, scene: Scene | None, scene_file: Path | None, document: Document
) -> Apparatus | None:
    if text is None:
        return None
    if scene is None and document.problems:  # the scene has errors, which are reported
        return None
    if scene is None:
        what = "the option requires a scene, but the launch file names none"
        document.problems.append(Problem("--apparatus", (), what, 'name a scene file in "scene"'))
        return None
    try:
        return load_apparatus(text, scene, scene_file)
    except BadInputError as error:
        document.problems.extend(error.problems)
        return None


def load_scene(path: Path) -> Scene:
    """Read and check a scene file; raise BadInputError if it is invalid."""
    if not path.exists():
        raise BadInputError.single(
            str(path), (), "the file does not exist", name_shipped(path, SCENES)
        )
    return make_scene(read_scene_file(path))


def _make_node(
    entry: NodeEntry,
    endpoints: dict[str, tuple[Writer, ...]],
    document: Document,
    *,
    resolve_paths: bool,
) -> ResolvedNode:
    host = entry.spec.host
    assert entry.type is not None  # otherwise the load has failed
    assert entry.parameters is not None
    parameters = dump_parameters(entry, document, resolve_paths=resolve_paths)
    return ResolvedNode(
        name=entry.name,
        type=entry.spec.type,
        listen_ports=tuple(filter(None, _marked(entry.parameters, ParameterMark.LISTEN_PORT))),
        device_address=_device_address(entry.parameters),
        device_files=_device_files(entry.parameters),
        calibrations={
            ".".join(map(str, key)): str(_value_at(parameters, key))
            for mark in CALIBRATION_CHECKS
            for key in find_marked(entry.parameters, mark)
        },
        role=find_role(entry.type),
        host=host,
        parameters=parameters,
        inputs=tuple(
            ResolvedPort(
                port=port,
                topic=topic.name,
                endpoints=tuple(one.endpoint_for(host) for one in endpoints[topic.name]),
            )
            for port, topic in entry.topics("input")
        )
        + entry.unconnected_ports("input"),
        outputs=tuple(
            ResolvedPort(
                port=port,
                topic=topic.name,
                endpoints=next(
                    one.endpoints for one in endpoints[topic.name] if one.name == entry.name
                ),
            )
            for port, topic in entry.topics("output")
        )
        + entry.unconnected_ports("output"),
        restart=entry.spec.restart,
        start_deadline_s=entry.spec.start_deadline_s,
        liveness_s=entry.spec.liveness_s,
        nice=entry.spec.nice,
        realtime_priority=entry.spec.realtime_priority,
        process=entry.spec.process or entry.name,
    )


def _marked(parameters: NodeParameters, mark: ParameterMark) -> list[Any]:
    return list(find_marked(parameters, mark).values())


def _device_address(parameters: NodeParameters) -> str | None:
    """Return the address "host:port" of the device that a node controls.

    Returns None unless exactly one parameter is marked as the device's host, and exactly one
    parameter as the device's port.
    """
    hosts = _marked(parameters, ParameterMark.DEVICE_HOST)
    ports = _marked(parameters, ParameterMark.DEVICE_PORT)
    return f"{hosts[0]}:{ports[0]}" if len(hosts) == len(ports) == 1 else None


def _device_files(parameters: NodeParameters) -> tuple[str, ...]:
    """Return the sorted device files in the parameters of a node. Stream URLs are not included."""
    files = _marked(parameters, ParameterMark.DEVICE_FILE)
    return tuple(sorted({file for file in files if not urlsplit(file).scheme}))


def _value_at(values: Any, key: tuple[str | int, ...]) -> Any:
    return reduce(lambda inner, part: inner[part], key, values)
