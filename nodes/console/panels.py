"""Make the texts and tables of the page as HTML that is also suitable for screen readers.

Every colour is accompanied by a symbol. The CSS classes are defined in page.css.
"""

from __future__ import annotations

from collections.abc import Mapping
from html import escape

from flexsheet.messages.notes import SELF_CHECK_REMEDIES, describe_self_check
from flexsheet.messages.types import Fingertip, Status
from flexsheet.nodes.console.controller import EyeViewState

GOOD, WARN, BAD = ("fs-good", "●"), ("fs-warn", "▲"), ("fs-bad", "✕")
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


def _mark(kind: tuple[str, str], text: str) -> str:
    return f'<span class="{kind[0]}">{kind[1]}&nbsp;{escape(text)}</span>'


def make_paragraph(html: str) -> str:
    """Wrap HTML in a paragraph that has the style of the page."""
    return f'<p class="fs-words">{html}</p>'


def make_nodes_table(statuses: Mapping[str, tuple[Status, float]]) -> str:
    """Make the table of the nodes with state, last error and notes.

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
        rows.append(f"<tr><td>{escape(name)}</td><td>{state}</td><td>{text}</td></tr>")
    heads = "".join(f'<th scope="col">{head}</th>' for head in ("node", "state", "note"))
    return (
        f'<table class="fs-table"><caption>Nodes</caption><thead><tr>{heads}</tr></thead>'
        f"<tbody>{''.join(rows)}</tbody></table>"
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
