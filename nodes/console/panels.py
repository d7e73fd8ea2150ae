"""Make the texts and tables of the page as HTML that is also suitable for screen readers.

Every colour is accompanied by a symbol. The CSS classes are defined in page.css.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from html import escape
from math import isnan

from flexsheet.messages.notes import SELF_CHECK_REMEDIES, describe_self_check
from flexsheet.messages.topics import TOPICS
from flexsheet.messages.types import Fingertip, PortStatus, Status
from flexsheet.nodes.console.controller import EyeViewState

GOOD, WARN, BAD = ("fs-good", "●"), ("fs-warn", "▲"), ("fs-bad", "✕")
SLOW_RATIO = 0.5
"""The minimum ratio of a topic's actual rate to its minimum rate. If the ratio is lower, the topic
is shown as slow."""

MAX_STATUS_AGE_S = 3.0
"""The maximum age (s) of a node's last status message. If the message is older, the node is shown
as silent."""

MODES = {
    "starting": "starting",
    "disconnected": "not connected",
    "idle": "at rest",
    "follow": "following the finger",
    "hold": "holding still",
    "stopping": "stopping",
    "fault": "at fault",
    "relax": "relaxing the sheet",
    "estop": "stopped",
}
"""The text that the page shows for each mode of an arm."""


@dataclass(frozen=True, slots=True)
class Line:
    """The style of a line in a chart.

    color: colour that is visible on light and dark pages.
    dash: lengths of dashes and gaps, px.
    """

    color: str
    dash: tuple[int, ...] = ()


LINES = (
    Line("#2485b5"),
    Line("#c26a00", (8, 4)),
    Line("#cc4b37", (2, 3)),
    Line("#3d8f4f", (12, 3, 2, 3)),
    Line("#8d6bd6", (5, 2)),
)


def _mark(kind: tuple[str, str], text: str) -> str:
    return f'<span class="{kind[0]}">{kind[1]}&nbsp;{escape(text)}</span>'


def _table(
    caption: str, head: Iterable[str], rows: Iterable[Iterable[str]], *, numbers: Iterable[int] = ()
) -> str:
    """Make an HTML table; `numbers` are the indices of the columns that contain numbers."""
    alignments = dict.fromkeys(numbers, ' class="fs-number"')
    heads = "".join(
        f'<th scope="col"{alignments.get(i, "")}>{escape(one)}</th>' for i, one in enumerate(head)
    )
    body = "".join(
        "<tr>"
        + "".join(f"<td{alignments.get(i, '')}>{value}</td>" for i, value in enumerate(row))
        + "</tr>"
        for row in rows
    )
    return (
        f'<table class="fs-table"><caption>{escape(caption)}</caption>'
        f"<thead><tr>{heads}</tr></thead><tbody>{body}</tbody></table>"
    )


def make_paragraph(html: str) -> str:
    """Wrap HTML in a paragraph that has the style of the page."""
    return f'<p class="fs-words">{html}</p>'


def make_latency_table(latencies: Mapping[str, tuple[float, float]]) -> str:
    """Make the legend of the latency chart, with the values of each series.

    latencies: latest and maximum value (ms) by the name of the series; NaN for missing values.
    """
    rows = []
    for line, (name, (newest, worst)) in zip(LINES, latencies.items(), strict=True):
        dashes = f' stroke-dasharray="{" ".join(map(str, line.dash))}"' if line.dash else ""
        sample = (
            '<svg width="34" height="8" aria-hidden="true"><line x1="0" y1="4" x2="30" y2="4" '
            f'stroke="{line.color}" stroke-width="2.5"{dashes}/></svg>'
        )
        texts = ["–" if isnan(value) else f"{value:.0f}" for value in (newest, worst)]
        rows.append((f"{sample} {escape(name)}", *texts))
    head = ("from the exposure until", "now, ms", "worst, ms")
    return _table("Latencies", head, rows, numbers=(1, 2))


def make_nodes_table(statuses: Mapping[str, tuple[Status, float]]) -> str:
    """Make the table of the nodes with state, processor load, and last error or note.

    statuses: latest status message of each node and its age (s), by the name of the node.
    """
    rows = []
    for name, (status, age_s) in sorted(statuses.items()):
        if age_s > MAX_STATUS_AGE_S:
            state = _mark(BAD, f"silent for {age_s:.0f} s")
        elif status.state == "degraded":
            state = _mark(BAD, "degraded")
        elif status.state == "running":
            state = _mark(GOOD, "running")
        else:
            state = _mark(WARN, status.state)
        text = escape(status.note_text)
        if status.errors:
            count = f"{status.errors} error{'s' if status.errors > 1 else ''}"
            text += f"<br>{_mark(BAD, f'{count}: {status.last_error}')}"
        for check in status.self_checks:
            if check.suspected:
                remedy = SELF_CHECK_REMEDIES[check.cause]
                text += f"<br>{_mark(WARN, f'{describe_self_check(check)}. {remedy}')}"
        rows.append((escape(name), state, f"{100 * status.cpu_ratio:.0f}", text))
    return _table("Nodes", ("node", "state", "CPU, %", "note"), rows, numbers=(2,))


def make_topics_table(
    statuses: Mapping[str, tuple[Status, float]], sampling_readers: Collection[str] = ()
) -> str:
    """Make the table of the topics with rate, maximum message age, and number of lost messages.

    statuses: latest status message of each node and its age (s), by the name of the node.
    sampling_readers: nodes that skip messages by design. The ages and losses of their messages are
        ignored.
    """
    written: dict[str, list[PortStatus]] = {}
    read: dict[str, list[PortStatus]] = {}
    for node, (status, age_s) in statuses.items():
        if age_s > MAX_STATUS_AGE_S:
            continue
        for port in status.outputs:
            written.setdefault(port.topic, []).append(port)
        for port in status.inputs if node not in sampling_readers else ():
            read.setdefault(port.topic, []).append(port)
    rows = []
    for name, topic in TOPICS.items():
        if name not in written or topic.message is Status:
            continue
        rate_hz = sum(port.rate_hz for port in written[name])
        readers = read.get(name, [])
        ages = [port.age_s for port in readers if port.age_s is not None]
        oldest = "" if not ages or topic.rate_hz is None else f"{1e3 * max(ages):.0f}"
        lost = sum(port.gaps for port in readers)
        rejected = sum(port.rejected for port in readers)
        dropped = sum(port.dropped for port in readers)
        if rejected:
            state = _mark(BAD, f"{rejected} refused")
        elif topic.rate_hz is None:
            state = _mark(GOOD, "on\N{NO-BREAK SPACE}change")
        elif rate_hz == 0.0:
            state = _mark(WARN, "silent")
        elif rate_hz < SLOW_RATIO * topic.rate_hz[0]:
            state = _mark(WARN, "slow")
        else:
            state = _mark(GOOD, "flows")
        rate = "" if topic.rate_hz is None else f"{rate_hz:.0f}"
        rows.append((escape(name), state, rate, oldest, str(dropped), str(lost)))
    head = ("topic", "state", "Hz", "age, ms", "skipped", "lost")
    return _table("Topics", head, rows, numbers=(2, 3, 4, 5)) + make_paragraph(
        "Age: maximum time since the exposure over all readers. Skipped: messages that a newer "
        "message replaced before they were read. Lost: messages lost in transit. Both numbers "
        "count from the start."
    )


def finger(fingertip: Fingertip | None) -> str:
    """Describe as HTML the position of the fingertip, or the reason why it is unknown."""
    return f'<div class="fs-finger">{make_paragraph(_finger(fingertip))}</div>'


def _finger(fingertip: Fingertip | None) -> str:
    if fingertip is None:
        return "No fingertip has been received."
    if not fingertip.valid:
        return _mark(WARN, f"not tracked: {fingertip.reason.replace('_', ' ')}")
    x, y, z = (round(1e3 * metres) for metres in fingertip.position_world_m.tolist())
    return (
        f"{_mark(GOOD, 'tracked')} {abs(x)} mm {'left' if x < 0 else 'right'} and {abs(y)} mm "
        f"{'below' if y < 0 else 'above'} the screen's centre, {abs(z)} mm "
        f"{'behind' if z < 0 else 'in front of'} it"
    )


def eye(
    *, possible: bool, enabled: bool, state: EyeViewState, waited_s: float, ago_s: float | None
) -> str:
    """Describe as HTML the state of the eye view, the image that the user sees.

    possible: whether the graph has a simulated eye.
    enabled: whether viewers have requested images.
    waited_s: time since the last change of `state`.
    ago_s: age of the latest image; None if there is no image.
    """
    if not possible:
        return make_paragraph("This graph has no simulated eye (a node of type twin_eye).")
    if not enabled:
        return make_paragraph("Tick the box to show the images that the user's eye sees.")
    last = "" if ago_s is None else f" The last image is {ago_s:.0f} s old."
    match state:
        case EyeViewState.DRAWING:
            return make_paragraph(f"Waiting for a frame of the renderer: {waited_s:.0f} s.{last}")
        case EyeViewState.TRACING:
            return make_paragraph(
                "Waiting for the simulated eye, which needs a second of processor time, and longer "
                f"on a busy computer: {waited_s:.0f} s.{last}"
            )
        case EyeViewState.RESTING if ago_s is None:
            return make_paragraph(
                "No frame or image arrived in time. Waiting for the next request."
            )
        case EyeViewState.RESTING:
            return make_paragraph(
                f"Rendered {ago_s:.0f} s ago; a new image follows within six seconds."
            )


def recorder(note: str | None, bookmarks: tuple[str, ...]) -> str:
    """Describe as HTML the state of the recorder and the newest bookmarks.

    note: status note of the recorder node; None if there is no recorder.
    bookmarks: labels of the bookmarks.
    """
    if note is None:
        return make_paragraph(_mark(WARN, "this graph has no recorder"))
    listed = f"<br>Bookmarks: {escape(', '.join(bookmarks))}." if bookmarks else ""
    return make_paragraph(f"Recorder: {escape(note)}.{listed}")


def problem(text: str) -> str:
    """Make the HTML of the box that shows an error; empty if there is no error."""
    if not text:
        return ""
    sentence = escape(text[:1].upper() + text[1:])
    return f'<div role="alert" class="fs-banner fs-ground-bad fs-problem">{sentence}</div>'
