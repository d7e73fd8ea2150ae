"""The page's words and tables, as HTML that a screen reader can read; colours never stand alone.

The classes are those of page.css.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from html import escape
from math import isnan

from flexsheet.messages.topics import TOPICS
from flexsheet.messages.types import Fingertip, PortStatus, Status
from flexsheet.nodes.console.desk import LookState

GOOD, WARN, BAD = ("fs-good", "●"), ("fs-warn", "▲"), ("fs-bad", "✕")
SLOW_SHARE = 0.5
"""Of the least rate that the table of topics expects: below it a topic is called slow."""

STALE_S = 3.0
"""A node that has not said how it is for so long is called silent."""

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
"""What an arm is, in words."""


@dataclass(frozen=True, slots=True)
class Line:
    """How a series is drawn: its colour, readable on light and dark, and its dashes (px)."""

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
    """numbers: which columns are flushed right."""
    flushed = dict.fromkeys(numbers, ' class="fs-number"')
    heads = "".join(
        f'<th scope="col"{flushed.get(i, "")}>{escape(one)}</th>' for i, one in enumerate(head)
    )
    body = "".join(
        "<tr>"
        + "".join(f"<td{flushed.get(i, '')}>{value}</td>" for i, value in enumerate(row))
        + "</tr>"
        for row in rows
    )
    return (
        f'<table class="fs-table"><caption>{escape(caption)}</caption>'
        f"<thead><tr>{heads}</tr></thead><tbody>{body}</tbody></table>"
    )


def words(html: str) -> str:
    """Return a paragraph of the page."""
    return f'<p class="fs-words">{html}</p>'


def latency_table(latencies: Mapping[str, tuple[float, float]]) -> str:
    """The chart's legend, with numbers.

    latencies: by series, the newest and the worst (ms); NaN where nothing has come.
    """
    rows = []
    for line, (name, (newest, worst)) in zip(LINES, latencies.items(), strict=True):
        dashes = f' stroke-dasharray="{" ".join(map(str, line.dash))}"' if line.dash else ""
        drawn = (
            '<svg width="34" height="8" aria-hidden="true"><line x1="0" y1="4" x2="30" y2="4" '
            f'stroke="{line.color}" stroke-width="2.5"{dashes}/></svg>'
        )
        told = ["–" if isnan(value) else f"{value:.0f}" for value in (newest, worst)]
        rows.append((f"{drawn} {escape(name)}", *told))
    head = ("from the exposure until", "now, ms", "worst, ms")
    return _table("Latency in numbers", head, rows, numbers=(1, 2))


def nodes_table(statuses: Mapping[str, tuple[Status, float]]) -> str:
    """Each node with its state, its share of a core, and its last error or note.

    statuses: by node, its newest status and how long ago (s) that was.
    """
    rows = []
    for name, (status, age_s) in sorted(statuses.items()):
        if age_s > STALE_S:
            state = _mark(BAD, f"silent for {age_s:.0f} s")
        elif status.state == "degraded":
            state = _mark(BAD, "degraded")
        elif status.state == "running":
            state = _mark(GOOD, "running")
        else:
            state = _mark(WARN, status.state)
        said = escape(status.note)
        if status.errors:
            count = f"{status.errors} error{'s' if status.errors > 1 else ''}"
            said += f"<br>{_mark(BAD, f'{count}: {status.last_error}')}"
        rows.append((escape(name), state, f"{100 * status.cpu_ratio:.0f}", said))
    return _table("Nodes", ("node", "state", "CPU, %", "says"), rows, numbers=(2,))


def topics_table(
    statuses: Mapping[str, tuple[Status, float]], sampling_readers: Collection[str] = ()
) -> str:
    """Return a table of the topics: rate, oldest message among the readers, losses.

    statuses: as of `nodes_table`.  sampling_readers: nodes that skip messages by design and are
    not counted as readers.
    """
    written: dict[str, list[PortStatus]] = {}
    read: dict[str, list[PortStatus]] = {}
    for node, (status, age_s) in statuses.items():
        if age_s > STALE_S:
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
        elif rate_hz < SLOW_SHARE * topic.rate_hz[0]:
            state = _mark(WARN, "slow")
        else:
            state = _mark(GOOD, "flows")
        rate = "" if topic.rate_hz is None else f"{rate_hz:.0f}"
        rows.append((escape(name), state, rate, oldest, str(dropped), str(lost)))
    head = ("topic", "state", "Hz", "age, ms", "skipped", "lost")
    return _table("Topics", head, rows, numbers=(2, 3, 4, 5)) + words(
        "Age: of the message that the slowest reader has, from its exposure. Skipped: a newer one "
        "was there already. Lost: on the way. Both since the start."
    )


def finger(fingertip: Fingertip | None) -> str:
    """Where the fingertip is, or why that is not known; always of the same height."""
    return f'<div class="fs-finger">{words(_finger(fingertip))}</div>'


def _finger(fingertip: Fingertip | None) -> str:
    if fingertip is None:
        return "No fingertip has come yet."
    if not fingertip.valid:
        return _mark(WARN, f"not tracked: {fingertip.reason.replace('_', ' ')}")
    x, y, z = (round(1e3 * metres) for metres in fingertip.position_world_m.tolist())
    return (
        f"{_mark(GOOD, 'tracked')} {abs(x)} mm {'left' if x < 0 else 'right'} and {abs(y)} mm "
        f"{'below' if y < 0 else 'above'} the screen's middle, {abs(z)} mm "
        f"{'behind' if z < 0 else 'before'} it"
    )


def eye(
    *, possible: bool, wanted: bool, state: LookState, waited_s: float, ago_s: float | None
) -> str:
    """Return what the eye's pictures wait for.

    waited_s: since `state` began.  ago_s: since the newest picture; None: there is none.
    """
    if not possible:
        return words("Nothing in this graph looks at the sheet; the twin's eye (twin_eye) would.")
    if not wanted:
        return words("Tick the box to see what the user's eye sees.")
    taken = "" if ago_s is None else f" The last picture came {ago_s:.0f} s ago."
    match state:
        case LookState.DRAWING:
            return words(f"Waits for the renderer to draw a frame: {waited_s:.0f} s.{taken}")
        case LookState.TRACING:
            return words(
                "Waits for the simulated eye to trace the picture, which takes a second of a "
                f"processor and longer on a busy computer: {waited_s:.0f} s.{taken}"
            )
        case LookState.RESTING if ago_s is None:
            return words("Waits for its turn: no frame or no picture came in time.")
        case LookState.RESTING:
            return words(f"Taken {ago_s:.0f} s ago, the next one follows within six seconds.")


def recorder(note: str | None, bookmarks: tuple[str, ...]) -> str:
    """Return the recorder's note and the newest bookmarks.  note: None without a recorder."""
    if note is None:
        return words(_mark(WARN, "this graph has no recorder"))
    listed = f"<br>Bookmarks: {escape(', '.join(bookmarks))}." if bookmarks else ""
    return words(f"Recorder: {escape(note)}.{listed}")


def problem(text: str) -> str:
    """An error of what was asked for, or nothing."""
    if not text:
        return ""
    said = escape(text[:1].upper() + text[1:])
    return f'<div role="alert" class="fs-banner fs-ground-bad fs-problem">{said}</div>'
