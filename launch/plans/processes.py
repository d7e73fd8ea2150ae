"""Check which nodes of a launch file share a process."""

from __future__ import annotations

from itertools import product

from flexsheet.launch.plans.documents import Document
from flexsheet.launch.plans.resolve_nodes import RUN_FILES, NodeEntry
from flexsheet.nodes import NodeRole
from flexsheet.nodes.node import find_role
from flexsheet.nodes.parameter_marks import ParameterMark, find_marked

COMMON_KEYS = ("host", "nice", "restart", "liveness_s")
"""Keys that apply to a process as a whole."""


def check_processes(entries: list[NodeEntry], document: Document) -> None:
    """Check that the nodes of a process agree in its settings, and that arm bridges are alone.

    The simulator of a bridge's own arm may share its process.
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
                f'"{name}" is the name of another node, or reserved',
                "choose another name; log and configuration are named after the process",
            )
        for entry, key in product(others, COMMON_KEYS):
            if getattr(entry.spec, key) != getattr(first.spec, key):
                document.report(
                    (*entry.key, key),
                    f'differs from "{first.name}", which is in the same process "{name}"',
                    f"give both the same {key}, or separate processes",
                )
        for bridge, entry in product(members, members):
            if bridge is not entry and not _may_share(bridge, entry):
                document.report(
                    (*bridge.key, "process"),
                    f'a fault of "{entry.name}" would stop the arm of "{bridge.name}"',
                    "give them separate processes, or set shares_arm_process: true at "
                    f"{bridge.name}",
                )


def _may_share(bridge: NodeEntry, entry: NodeEntry) -> bool:
    """Return whether `entry` may run in the process of `bridge`; True if that is no arm bridge."""
    if bridge.type is None or find_role(bridge.type) is not NodeRole.ARM_BRIDGE:
        return True
    if bridge.spec.shares_arm_process or bridge.parameters is None or entry.parameters is None:
        return True
    ports = find_marked(bridge.parameters, ParameterMark.DEVICE_PORT).values()
    return bool(set(ports) & set(find_marked(entry.parameters, ParameterMark.LISTEN_PORT).values()))
