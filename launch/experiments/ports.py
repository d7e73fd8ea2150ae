"""Choose free TCP ports for simulated arms, so that several graphs can run on one computer."""

from __future__ import annotations

import socket
from pathlib import Path

from flexsheet.launch.plans.plan import load_graph
from flexsheet.nodes import NodeRole

LOOPBACK = "127.0.0.1"


def choose_ports(launch_file: Path) -> list[str]:
    """Return launch settings that give free TCP ports to simulated arms and to their control nodes.

    If the graph has no simulated arms, the list is empty.
    """
    graph = load_graph(launch_file)
    simulators = graph.nodes_of_type("twin_arms")
    if not simulators:
        return []
    left, right = _find_free_ports(2)
    settings = []
    for node in simulators:
        settings += [f"{node.name}.left_port={left}", f"{node.name}.right_port={right}"]
    for node in graph.nodes.values():
        if node.role is NodeRole.ARM_BRIDGE:
            port = left if node.parameters["side"] == "left" else right
            settings.append(f"{node.name}.port={port}")
    return settings


def _find_free_ports(count: int) -> list[int]:
    sockets = [socket.socket() for _ in range(count)]
    try:
        for one in sockets:
            one.bind((LOOPBACK, 0))
        return [one.getsockname()[1] for one in sockets]
    finally:
        for one in sockets:
            one.close()
