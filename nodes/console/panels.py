"""The page's tables, as HTML that a screen reader can read; colours never stand alone."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from html import escape

from messages.topics import TOPICS
from messages.types import ArmState, PortStatus, Status

GOOD, WARN, BAD = ("#166534", "●"), ("#92400e", "▲"), ("#b91c1c", "✕")
TEXT, QUIET = "#1f2937", "#4b5563"
SLOW_SHARE = 0.5
"""Of the least rate that the table of topics expects: below it a topic is called slow."""

STALE_S = 3.0
"""A node that has not said how it is for so long is called silent."""

FAULTY_MODES = ("fault", "estop", "disconnected", "stopping")


def _mark(kind: tuple[str, str], text: str) -> str:
    return f'<span style="color:{kind[0]};font-weight:600">{kind[1]} {escape(text)}</span>'


def _table(caption: str, head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    heads = "".join(
        f'<th scope="col" style="text-align:left;padding:2px 6px 2px 0;color:{QUIET};'
        f'font-weight:600">{escape(one)}</th>'
        for one in head
    )
    cell = '<td style="padding:2px 6px 2px 0;vertical-align:top;border-top:1px solid #e5e7eb">'
    body = "".join(
        "<tr>" + "".join(f"{cell}{value}</td>" for value in row) + "</tr>" for row in rows
    )
    return (
        '<table style="width:94%;margin:0 10px 10px;border-collapse:collapse;font-size:12px;'
        f'color:{TEXT};font-variant-numeric:tabular-nums">'
        '<caption style="text-align:left;font-weight:700;padding:4px 0">'
        f"{escape(caption)}</caption>"
        f"<thead><tr>{heads}</tr></thead><tbody>{body}</tbody></table>"
    )


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
        rows.append((escape(name), state, f"{100 * status.cpu_ratio:.0f} %", said))
    return _table("Nodes", ("node", "state", "CPU", "says"), rows)


def topics_table(statuses: Mapping[str, tuple[Status, float]]) -> str:
    """Each topic with its rate, the oldest message among its readers, and what was lost."""
    written: dict[str, list[PortStatus]] = {}
    read: dict[str, list[PortStatus]] = {}
    for node, (status, age_s) in statuses.items():
        if age_s > STALE_S:
            continue
        for port in status.outputs:
            written.setdefault(port.topic, []).append(port)
        # What the console and the recorder leave unread is meant to be.
        for port in status.inputs if node != "console" else ():
            read.setdefault(port.topic, []).append(port)
    rows = []
    for name, topic in TOPICS.items():
        if name not in written or name == "status":
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
            state = _mark(GOOD, "on change")
        elif rate_hz == 0.0:
            state = _mark(WARN, "silent")
        elif rate_hz < SLOW_SHARE * topic.rate_hz[0]:
            state = _mark(WARN, "slow")
        else:
            state = _mark(GOOD, "flows")
        rate = "" if topic.rate_hz is None else f"{rate_hz:.0f}"
        rows.append((escape(name), state, rate, oldest, str(dropped), str(lost)))
    head = ("topic", "state", "Hz", "age, ms", "skipped", "lost")
    return _table("Topics", head, rows)


def banner(scene: str, arms: Mapping[str, ArmState], stopped: str | None, where: str) -> str:
    """What the arms do, over everything else.  stopped: the reason of an e-stop, or None."""
    if stopped is not None:
        text, ground = f"E-STOP is engaged: {stopped}", "#b91c1c"
    elif any(arm.mode in FAULTY_MODES for arm in arms.values()):
        ground = "#92400e"
        text = "; ".join(
            f"{side} arm: {arm.mode}" + (f" ({', '.join(arm.faults)})" if arm.faults else "")
            for side, arm in arms.items()
        )
    elif arms:
        modes = sorted({arm.mode for arm in arms.values()})
        text, ground = f"Arms: {' / '.join(modes)}", "#166534"
    else:
        text, ground = "Waiting for the arms", "#374151"
    forces = [arm.edge_force_n for arm in arms.values() if arm.edge_force_n is not None]
    force = f", the sheet pulls with {max(forces):.1f} N" if forces else ""
    return (
        f'<div role="status" aria-live="polite" style="background:{ground};color:#ffffff;'
        'padding:6px 10px;border-radius:6px;font-size:13px;font-weight:600">'
        f"{escape(text)}</div>"
        f'<div style="color:{TEXT};font-size:12px;padding:4px 2px">{escape(where)}, scene '
        f"<b>{escape(scene)}</b>{escape(force)}</div>"
    )


def problem(text: str) -> str:
    """An error of what was asked for, or nothing."""
    if not text:
        return ""
    return (
        '<div role="alert" style="background:#fef2f2;color:#991b1b;border:1px solid #991b1b;'
        f'padding:6px 10px;border-radius:6px;font-size:12px">{escape(text)}</div>'
    )
