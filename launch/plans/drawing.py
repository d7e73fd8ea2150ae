"""Draw the nodes and topics of a graph as SVG, Mermaid or text."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from flexsheet.launch.plans.plan_model import ResolvedGraph
from flexsheet.messages.topics import TOPICS

Position = tuple[float, float]

WIDTH, HEIGHT = 132, 34
"""The width and height (px) of the box of a node."""

STYLE = """
  text { font: 13px system-ui, sans-serif; fill: #1f2328; text-anchor: middle }
  .label { font-size: 11.5px; fill: #57606a; paint-order: stroke; stroke: #ffffff;
    stroke-width: 4px }
  .host { fill: none; stroke: #8c959f; stroke-dasharray: 5 4 }
  .box { fill: #eef2ff; stroke: #4f5fb0 }
  .device { fill: #f6f8fa; stroke: #8c959f }
  .arrow { fill: none; stroke: #57606a; stroke-width: 1.4 }
  .wire { stroke-dasharray: 4 3 }
  #head { fill: #57606a }
  @media (prefers-color-scheme: dark) {
    text { fill: #e6edf3 }
    .label { fill: #a5adba; stroke: #14151a }
    .box { fill: #232a4d; stroke: #8794dd }
    .device { fill: #22262e }
    .arrow { stroke: #a5adba }
    #head { fill: #a5adba }
  }
"""


@dataclass(frozen=True)
class Arrow:
    """An arrow for the topics from one node to another, or for a connection to a device.

    path: points of the SVG polyline, px.
    label_at: position of the label, px.
    wire: label of a device connection. It is empty if the arrow represents topics.
    """

    writer: str
    reader: str
    topics: tuple[str, ...]
    path: str
    label_at: Position
    wire: str = ""
    is_bidirectional: bool = False


@dataclass(frozen=True)
class GraphDrawing:
    """The geometry (px) of the drawing of a graph.

    hosts: left, top, width and height of each host's frame.
    boxes, devices: centres of the boxes of nodes and devices, by name.
    """

    title: str
    size: tuple[int, int]
    hosts: dict[str, tuple[float, float, float, float]]
    boxes: dict[str, Position]
    devices: dict[str, Position]
    arrows: Sequence[Arrow]


def svg(drawing: GraphDrawing) -> str:
    """Return the drawing as the text of an SVG file for light and dark colour schemes."""
    width, height = drawing.size
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" '
        f'width="{width}" height="{height}" role="img" aria-label="{drawing.title}">',
        f"<style>{STYLE}</style>",
        '<defs><marker id="tip" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" '
        'markerHeight="7" orient="auto-start-reverse"><path id="head" d="M0 0L8 4L0 8z"/>'
        "</marker></defs>",
    ]
    for name, (left, top, w_px, h_px) in drawing.hosts.items():
        lines.append(
            f'<rect class="host" x="{left}" y="{top}" width="{w_px}" height="{h_px}" rx="8"/>'
        )
        lines.append(
            f'<text class="label" x="{left + 10}" y="{top + 18}" '
            f'style="text-anchor:start">{name}</text>'
        )
    for arrow in drawing.arrows:
        start = ' marker-start="url(#tip)"' if arrow.is_bidirectional else ""
        kind = "arrow wire" if arrow.wire else "arrow"
        lines.append(
            f'<polyline class="{kind}" points="{arrow.path}" marker-end="url(#tip)"{start}/>'
        )
    for kind, positions in (("box", drawing.boxes), ("device", drawing.devices)):
        for name, (x, y) in positions.items():
            round_px = 5 if kind == "box" else HEIGHT // 2
            lines.append(
                f'<rect class="{kind}" x="{x - WIDTH / 2:g}" y="{y - HEIGHT / 2:g}" '
                f'width="{WIDTH}" height="{HEIGHT}" rx="{round_px}"/>'
            )
            lines.append(f'<text x="{x}" y="{y + 4.5}">{name}</text>')
    for arrow in drawing.arrows:
        (x, y), label = arrow.label_at, arrow.wire or ", ".join(arrow.topics)
        lines.append(f'<text class="label" x="{x}" y="{y}">{label}</text>')
    return "\n".join([*lines, "</svg>", ""])


MARGIN, COLUMN, ROW, HOST_GAP = 30, 230, 75, 45
"""The outer margin, column pitch, row pitch, and gap between hosts in a drawing, in pixels."""


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


def assign_columns(names: Sequence[str], links: Sequence[tuple[str, str]]) -> dict[str, int]:
    """Assign columns to nodes, so that each node is to the right of the writers of its inputs.

    links: pairs (writer, reader). Cycles are ignored.
    """
    order: list[str] = []
    seen: set[str] = set()

    def visit(name: str) -> None:
        if name not in seen:
            seen.add(name)
            for writer, reader in links:
                if writer == name:
                    visit(reader)
            order.append(name)

    for name in names:
        visit(name)
    position = {name: number for number, name in enumerate(reversed(order))}
    columns = dict.fromkeys(names, 0)
    for name in sorted(names, key=lambda one: position[one]):
        for writer, reader in links:
            if reader == name and position[writer] < position[name]:
                columns[name] = max(columns[name], columns[writer] + 1)
    return columns


def lay_out(plan: ResolvedGraph) -> GraphDrawing:
    """Compute the layout of a graph, with writers to the left of readers and one frame per host."""
    links = list_links(plan)
    columns = assign_columns(list(plan.nodes), list(links))
    boxes: dict[str, Position] = {}
    hosts: dict[str, tuple[float, float, float, float]] = {}
    width = 2 * MARGIN + WIDTH + COLUMN * max(columns.values(), default=0)
    top = float(MARGIN)
    for host in plan.hosts:
        rows = dict.fromkeys(columns.values(), 0)
        for node in plan.nodes_on(host):
            column = columns[node.name]
            boxes[node.name] = (
                MARGIN + WIDTH / 2 + COLUMN * column,
                top + ROW * (rows[column] + 0.75),
            )
            rows[column] += 1
        height = ROW * (max(rows.values(), default=0) + 0.25)
        hosts[f"{host} ({plan.hosts[host]})"] = (MARGIN / 2, top - 10, width - MARGIN, height + 10)
        top += height + HOST_GAP
    arrows = [_connect(boxes, writer, reader, topics) for (writer, reader), topics in links.items()]
    return GraphDrawing(plan.launch_file, (width, round(top)), hosts, boxes, {}, arrows)


def _connect(boxes: dict[str, Position], writer: str, reader: str, topics: Sequence[str]) -> Arrow:
    """Return the arrow between two nodes.

    The arrow is straight if the reader is to the right of the writer. Otherwise, it passes below
    both boxes.

    boxes: centres of the nodes, px.
    """
    (x1, y1), (x2, y2) = boxes[writer], boxes[reader]
    if x2 > x1:
        start, end = (x1 + WIDTH / 2, y1), (x2 - WIDTH / 2, y2)
        points = [start, end]
        label = ((start[0] + end[0]) / 2, (y1 + y2) / 2 - 6)
    else:
        below = max(y1, y2) + HEIGHT
        points = [(x1, y1 + HEIGHT / 2), (x1, below), (x2, below), (x2, y2 + HEIGHT / 2)]
        label = ((x1 + x2) / 2, below + 4)
    path = " ".join(f"{x:g},{y:g}" for x, y in points)
    return Arrow(writer, reader, tuple(topics), path, label)


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


def text_lines(plan: ResolvedGraph) -> Iterator[str]:
    """Yield text lines with the nodes of each host, their topics, and the readers of each topic."""
    links = list_links(plan)
    for host, address in plan.hosts.items():
        yield f"{host} ({address})"
        for node in plan.nodes_on(host):
            yield f"  {node.name} ({node.type})"
            for (writer, reader), topics in links.items():
                if writer == node.name:
                    yield f"    {', '.join(topics)} -> {reader}"
