"""A launch file, checked and resolved: which node runs where, with what, and who talks to whom.

The launch file is the graph.  `load_plan` turns it into a `Plan` in which every endpoint is known
before any process starts; everything that is wrong with the file is reported at once.  Every host
computes the same plan from the same file, and the plan's hash says so.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path

from flexsheet.launch.objects.meshes import make_scene
from flexsheet.launch.plans.documents import (
    BadInputError,
    Document,
    Problem,
    read_document,
    validate,
)
from flexsheet.launch.plans.hosts import check_hosts
from flexsheet.launch.plans.launch_file import (
    LaunchFile,
    apply_console,
    apply_record,
    apply_setting,
)
from flexsheet.launch.plans.members import (
    Member,
    check_calibrations,
    check_wires,
    in_full,
    members_of,
    resolve_member,
)
from flexsheet.launch.plans.planned import MAIN, Plan, PlannedNode, PlannedPort, Writer
from flexsheet.launch.plans.wires import (
    check_inputs,
    endpoints_of,
    resolve_further_inputs,
    writers_of,
)
from flexsheet.messages.scene import Scene
from flexsheet.nodes.node import listen_ports, role_of


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
        apply_record(document, record)
    if console:
        apply_console(document)
    for setting in settings:
        apply_setting(document, setting)
    spec = validate(LaunchFile, document)
    problems: list[Problem] = []
    check_hosts(spec.hosts, document, problems)
    scene_document, scene = _load_scene(spec, document, problems)
    members = members_of(spec, document, problems)
    for member in members:
        resolve_member(member, document, problems)
    writers = writers_of(spec, members, document, problems, has_scene=scene is not None)
    resolve_further_inputs(members, writers, document, problems)
    check_inputs(members, writers, document, problems)
    check_calibrations(members, scene, document, problems)
    check_wires(members, spec, document, problems)
    if problems:
        raise BadInputError(problems)

    addresses = {name: host.address for name, host in spec.hosts.items()}
    endpoints = endpoints_of(writers, addresses)
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
        return scene_document, make_scene(scene_document)
    except BadInputError as error:
        problems.extend(error.problems)
        return None, None


def load_scene(path: Path) -> Scene:
    """Read and check a scene file; raises BadInputError."""
    return make_scene(read_document(path))


def _planned(
    member: Member,
    endpoints: dict[str, tuple[Writer, ...]],
    document: Document,
    *,
    resolve_paths: bool,
) -> PlannedNode:
    host = member.spec.host
    return PlannedNode(
        name=member.name,
        type=member.spec.type,
        listen_ports=() if member.parameters is None else listen_ports(member.parameters),
        role=None if member.type is None else role_of(member.type),
        host=host,
        parameters=in_full(member, document, resolve_paths=resolve_paths),
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
