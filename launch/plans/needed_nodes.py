"""Omit the nodes of a graph that its scene and its other nodes do not need.

If the scene contains no material, no soft body is computed. If it contains no projector, no image
is rendered. A node whose class sets `Node.on_demand` is omitted if no other node reads its topics.
A recorder counts as a reader of the topics in its parameters, but not as a reader of its default
topics.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator

from flexsheet.launch.plans.plan_model import OmittedNode
from flexsheet.launch.plans.resolve_nodes import NodeEntry
from flexsheet.messages.scene import Scene
from flexsheet.messages.topics import TOPICS
from flexsheet.nodes import OmissionReason
from flexsheet.nodes.recorder.parameters import RecorderParameters

REASON_TEXTS = {
    OmissionReason.RIGID_OBJECT: "the scene's object is rigid: it has no material",
    OmissionReason.NO_IMAGE: "the scene has no image: it has no projector",
    OmissionReason.NO_READER: "no node of the graph reads the topics that this node publishes",
    OmissionReason.NO_WRITER: "no node of the graph publishes the topics that this node reads",
}


def omit_unneeded(
    entries: list[NodeEntry],
    scene: Scene | None,
    needed: Collection[str],
    external: Collection[str] = (),
) -> tuple[list[NodeEntry], list[OmittedNode]]:
    """Return the nodes that are started, and the omitted nodes with the reasons for their omission.

    A port is disconnected if the node's parameters and the scene make the port unnecessary. If a
    node of the graph publishes scenes, the scene is ignored, because a later scene can need more
    nodes.

    needed: topics that command-line tools read.
    external: topics that command-line tools write.
    """
    fixed = scene
    if any(topic.name == "scene" for entry in entries for _, topic in entry.topics("output")):
        fixed = None
    kept, omitted = list(entries), list[OmittedNode]()
    for entry in entries:
        if entry.type is None or entry.parameters is None:
            continue
        entry.disconnect(entry.type.unused_outputs(entry.parameters))
        if fixed is not None:
            entry.disconnect(entry.type.unused_inputs(entry.parameters, fixed))
    while True:
        found = next(_find_unneeded(kept, fixed, needed, external), None)
        if found is None:
            return kept, omitted
        entry, reason = found
        kept.remove(entry)
        omitted.append(
            OmittedNode(name=entry.name, type=entry.spec.type, host=entry.spec.host, reason=reason)
        )


def _find_unneeded(
    entries: list[NodeEntry],
    scene: Scene | None,
    needed: Collection[str],
    external: Collection[str],
) -> Iterator[tuple[NodeEntry, OmissionReason]]:
    writers = {topic.name for entry in entries for _, topic in entry.topics("output")}
    writers |= EXTERNAL_TOPICS.union(external)
    for entry in entries:
        if entry.type is None or entry.parameters is None or entry.spec.always:
            continue
        reason = None if scene is None else entry.type.omission_reason(entry.parameters, scene)
        if reason is not None:
            yield entry, reason
        elif entry.type.on_demand:
            outputs = {topic.name for _, topic in entry.topics("output")} - {"status"}
            readers = (_list_read_topics(other) for other in entries if other is not entry)
            if not outputs & set(needed).union(*readers):
                yield entry, OmissionReason.NO_READER
            elif not _required_inputs(entry) <= writers:
                yield entry, OmissionReason.NO_WRITER


EXTERNAL_TOPICS = frozenset(name for name, topic in TOPICS.items() if topic.many_writers) | {
    "scene",
    "twin/apparatus",
}
"""The topics that the launcher or command-line tools can write."""


def _required_inputs(entry: NodeEntry) -> set[str]:
    assert entry.type is not None
    optional = entry.type.optional_inputs
    return {topic.name for port, topic in entry.topics("input") if port not in optional}


def _list_read_topics(entry: NodeEntry) -> set[str]:
    """Return the topics that a node reads.

    If the node is a recorder, only the topics in its parameters are returned.
    """
    if entry.type is None or entry.parameters is None:
        return set()
    if isinstance(entry.parameters, RecorderParameters):
        return {*entry.parameters.topics, *entry.parameters.include}
    further = entry.type.further_inputs(entry.parameters, tuple(TOPICS.values()))
    return {topic.name for _, topic in entry.topics("input")} | set(further)
