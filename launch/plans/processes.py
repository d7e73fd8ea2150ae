"""Check that the nodes of a launch file that share a process are allowed to do so."""

from __future__ import annotations

from itertools import product

from flexsheet.launch.plans.documents import Document
from flexsheet.launch.plans.resolve_nodes import RUN_FILES, NodeEntry
from flexsheet.nodes import NodeRole
from flexsheet.nodes.node import find_role
from flexsheet.nodes.parameter_marks import ParameterMark, find_marked

COMMON_KEYS = ("host", "nice", "realtime_priority", "restart", "liveness_s")
"""The keys of a node that must be equal for all nodes in one process."""


def check_processes(entries: list[NodeEntry], document: Document) -> None:
    """Report a problem if the nodes in one process are not allowed to share it.

    The process settings of the nodes must be equal. An arm bridge (node that controls an arm) is
    only allowed to share its process with the simulator of its arm. The setting
    `shares_arm_process` of the bridge permits other nodes.
    """
    names = {entry.name for entry in entries}
    processes: dict[str, list[NodeEntry]] = {}
    for entry in entries:
        name = entry.spec.process
        if name is not None:
            processes.setdefault(name, []).append(entry)
    for name, members in processes.items():
        first, *others = members
        if name in RUN_FILES or (name in names and all(one.name != name for one in members)):
            document.report(
                (*first.key, "process"),
                f'"{name}" is the name of another node, or is reserved',
                "choose another name, because log and configuration files have the process's name",
            )
        for entry, key in product(others, COMMON_KEYS):
            if getattr(entry.spec, key) != getattr(first.spec, key):
                document.report(
                    (*entry.key, key),
                    f'the value differs from that of "{first.name}" in the same process "{name}"',
                    f"set the same {key} for both nodes, or use separate processes",
                )
        for bridge, entry in product(members, members):
            if bridge is not entry and not _may_share(bridge, entry):
                document.report(
                    (*bridge.key, "process"),
                    f'a fault of "{entry.name}" would stop the arm of "{bridge.name}"',
                    f"use separate processes, or set shares_arm_process: true for {bridge.name}",
                )


def _may_share(bridge: NodeEntry, entry: NodeEntry) -> bool:
    if bridge.type is None or find_role(bridge.type) is not NodeRole.ARM_BRIDGE:
        return True
    if bridge.spec.shares_arm_process or bridge.parameters is None or entry.parameters is None:
        return True
    ports = find_marked(bridge.parameters, ParameterMark.DEVICE_PORT).values()
    return bool(set(ports) & set(find_marked(entry.parameters, ParameterMark.LISTEN_PORT).values()))
