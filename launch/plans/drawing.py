"""Draw the nodes and topics of a graph as a Mermaid flowchart."""

from __future__ import annotations

from flexsheet.launch.plans.plan_model import ResolvedGraph
from flexsheet.messages.topics import TOPICS


def list_links(plan: ResolvedGraph) -> dict[tuple[str, str], list[str]]:
    """Return the topics that connect each pair of nodes (writer, reader).

    Topics that can have any number of writers, such as estop and status, are omitted. Inputs of
    nodes that read all published topics, such as a recorder, are also omitted.
    """
    links: dict[tuple[str, str], list[str]] = {}
    for node in plan.nodes.values():
        for port in node.inputs:
            if port.port.startswith("in/") or not port.endpoints or TOPICS[port.topic].many_writers:
                continue
            for writer in plan.writers.get(port.topic, ()):
                if writer.name in plan.nodes and writer.name != node.name:
                    links.setdefault((writer.name, node.name), []).append(port.topic)
    return links


def mermaid(plan: ResolvedGraph) -> str:
    """Return the graph as a Mermaid flowchart."""
    lines = ["flowchart LR"]
    for host, address in plan.hosts.items():
        nodes = plan.nodes_on(host)
        lines += [
            f'  subgraph host_{host}["{host} ({address})"]',
            *(f"    {n.name}" for n in nodes),
        ]
        lines.append("  end")
    for (writer, reader), topics in list_links(plan).items():
        lines.append(f'  {writer} -->|"{", ".join(topics)}"| {reader}')
    return "\n".join([*lines, ""])
