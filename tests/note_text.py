"""Describe the notes of a node as its status does."""

from __future__ import annotations

from flexsheet.nodes.node import Node


def note_text(node: Node) -> str:
    return "; ".join(map(str, node.notes))
