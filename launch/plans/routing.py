"""Determine the writers of topics, connect the inputs of nodes, and assign network endpoints."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from itertools import product

from flexsheet.launch.plans.documents import Document, did_you_mean
from flexsheet.launch.plans.hosts import launcher_on
from flexsheet.launch.plans.launch_file import LaunchFile
from flexsheet.launch.plans.plan_model import LAUNCHER, MAIN, RUN_DIRECTORY, TOOLS, Writer, tools_on
from flexsheet.launch.plans.resolve_nodes import NodeEntry
from flexsheet.messages.topics import TOPICS

WRITABLE_ON_ALL_HOSTS = ("estop",)
"""The topics that command-line tools are allowed to write on every host, such as `estop`."""

LAUNCHER_TOPICS = ("host", "estop")
"""The topics that the launchers on all hosts publish."""

FIRST_PORT, PORT_COUNT = 20_000, 10_000
"""The first TCP port of topics, and the number of ports.

These ports are below the ports that Linux uses for outgoing connections (from 32768).
"""


def list_writers(
    spec: LaunchFile,
    entries: list[NodeEntry],
    document: Document,
    *,
    has_scene: bool,
    has_apparatus: bool,
) -> dict[str, list[tuple[str, str]]]:
    """Return the (writer, host) pairs of each topic, in the order of the launch file.

    If a topic has more writers than allowed, a problem is stored in `document`.

    has_scene: whether the launcher publishes a scene.
    has_apparatus: whether the launcher publishes true parameters of simulated hardware (an
        apparatus).
    """
    writers: dict[str, list[tuple[str, str]]] = {}
    has_editor = any(topic.name == "scene" for one in entries for _, topic in one.topics("output"))
    if has_scene and not has_editor:
        writers["scene"] = [(LAUNCHER, MAIN)]
    if has_apparatus:
        writers["twin/apparatus"] = [(LAUNCHER, MAIN)]
    for entry in entries:
        for port_name, topic in entry.topics("output"):
            others = [name for name, _ in writers.get(topic.name, [])]
            if others and (not topic.many_writers or entry.name in others):
                document.report(
                    (*entry.key, "topics", port_name),
                    f'topic "{topic.name}" is already written by "{others[0]}"',
                    "connect one of the two ports to another topic, or to null",
                )
            else:
                writers.setdefault(topic.name, []).append((entry.name, entry.spec.host))
    for i, name in enumerate(spec.external_topics):
        if name not in TOPICS:
            document.report(
                ("external_topics", i), f'unknown topic "{name}"', did_you_mean(name, list(TOPICS))
            )
        elif name in writers and not TOPICS[name].many_writers:
            document.report(
                ("external_topics", i),
                f'topic "{name}" is already written by "{writers[name][0][0]}"',
                "remove it from external_topics, or remove the node",
            )
        elif not TOPICS[name].many_writers:
            writers[name] = [(TOOLS, MAIN)]
    for name, host in product(LAUNCHER_TOPICS, spec.hosts):
        writers.setdefault(name, []).append((launcher_on(host), host))
    for topic in TOPICS.values():
        if topic.many_writers and topic.open_to_tools:
            writers.setdefault(topic.name, []).append((TOOLS, MAIN))
    for name, host in product(WRITABLE_ON_ALL_HOSTS, spec.hosts):
        if host != MAIN:
            writers.setdefault(name, []).append((tools_on(host), host))
    return writers


def resolve_further_inputs(
    entries: list[NodeEntry], writers: dict[str, list[tuple[str, str]]], document: Document
) -> None:
    """Add the inputs that depend on node parameters, such as the topics of a recorder.

    writers: (writer, host) pairs by topic.
    document: contents of the launch file. Errors such as unknown topics are stored in it.
    """
    written = [topic for topic in TOPICS.values() if topic.name in writers]
    for entry in entries:
        if entry.type is None or entry.parameters is None:
            continue
        for name in entry.type.further_inputs(entry.parameters, written):
            if name in TOPICS:
                entry.further_inputs.append(TOPICS[name])
            else:
                document.report(
                    entry.key, f'unknown topic "{name}"', did_you_mean(name, list(TOPICS))
                )


def check_inputs(
    entries: list[NodeEntry], writers: dict[str, list[tuple[str, str]]], document: Document
) -> None:
    """Report a problem if a required input has no writer.

    An optional input is disconnected if it has no writer.

    The check is omitted if a node has an unknown type, because this node could be the missing
    writer.
    """
    if any(entry.type is None for entry in entries):
        return
    for entry in entries:
        entry.disconnect_optional(writers)
        for port_name, topic in entry.topics("input"):
            if topic.name not in writers:
                remedy = (
                    'name a scene file in "scene"'
                    if topic.name == "scene"
                    else 'add a node that writes it, list it in "external_topics" if a tool '
                    f"writes it, or disconnect the port with topics: {{{port_name}: null}}"
                )
                document.report(
                    (*entry.key, "topics", port_name),
                    f'no node writes topic "{topic.name}"',
                    remedy,
                )


def make_endpoints(
    writers: dict[str, list[tuple[str, str]]], addresses: dict[str, str]
) -> dict[str, tuple[Writer, ...]]:
    """Return the writers of each topic with their network endpoints.

    The endpoints are ipc for connections on one host, and tcp for connections between hosts. If
    there is only one host, topics have no tcp endpoint.

    writers: (writer, host) pairs by topic.
    addresses: IP addresses by host.
    """
    far = sorted(
        (host, writer, topic)
        for topic, entries in writers.items()
        for writer, host in entries
        if addresses.keys() - {host}
    )
    ports = _assign_ports(far)
    return {
        topic: tuple(
            Writer(
                name=writer,
                host=host,
                ipc=f"ipc://{RUN_DIRECTORY}/{writer}.{topic.replace('/', '.')}",
                tcp=_make_tcp_endpoint(addresses[host], ports.get((host, writer, topic))),
            )
            for writer, host in entries
        )
        for topic, entries in writers.items()
    }


def _make_tcp_endpoint(address: str, port: int | None) -> str | None:
    if port is None:
        return None
    return f"tcp://[{address}]:{port}" if ":" in address else f"tcp://{address}:{port}"


def _assign_ports(links: Iterable[tuple[str, str, str]]) -> dict[tuple[str, str, str], int]:
    """Return a TCP port for each (host, writer, topic), computed from a hash of these names.

    If two hashes collide, the later name gets the next free port. A new topic therefore changes
    only ports that collide. The ports of all hosts differ, because several hosts of a graph can be
    the same computer.
    """
    taken: dict[int, tuple[str, str, str]] = {}
    for link in links:
        digest = hashlib.sha256("/".join(link).encode()).digest()
        offset = int.from_bytes(digest[:4], "big") % PORT_COUNT
        while FIRST_PORT + offset in taken:
            offset = (offset + 1) % PORT_COUNT
        taken[FIRST_PORT + offset] = link
    return {link: port for port, link in taken.items()}
