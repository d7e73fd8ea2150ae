"""Write the report of a bag: an HTML page with one figure, and the same numbers as JSON."""

from __future__ import annotations

import json
from array import array
from base64 import b64encode
from collections import Counter
from collections.abc import Callable, Iterator
from html import escape
from io import BytesIO
from itertools import chain
from pathlib import Path
from typing import Any, get_args

import numpy as np

from flexsheet.launch.experiments.followed import (
    FollowedSheet,
    Samples,
    Source,
    summarize_contact,
)
from flexsheet.launch.experiments.stroke import ARM_EVENTS, LatencyEvent, list_events, summary
from flexsheet.messages import types
from flexsheet.messages.bag import BagError, BagReader
from flexsheet.messages.base import Header, Message
from flexsheet.messages.busy import is_busy
from flexsheet.messages.clock_table import ClockTable
from flexsheet.messages.files import write_file
from flexsheet.messages.notes import NoteCode
from flexsheet.messages.topics import TOPICS, Delivery
from flexsheet.nodes.arrays import Floats, Ints

Progress = Callable[[float, float], None]
"""A function that is called with the duration read so far and the total duration (s)."""

SILENT_PERIODS, MIN_SILENCE_S = 10.0, 0.5
"""A topic is silent after this number of its longest periods, and at least after this time (s)."""

MAX_STATE_AGE_S = 0.5
"""The maximum time (s) for which a state is assumed to last if no new message arrives."""

MAX_END_S = 2.0
"""The maximum time (s) from the loss of an arm to the end of a node.

An arm that is lost then, and does not move again, has not failed: the session has ended.
"""

MIN_EARLIER_UPTIME_S, MAX_EVENTS = 10.0, 100
FAULTY = ("fault", "estop", "disconnected", "stopping")
ENDING = ("disconnected", "stopping")
MOVING = ("follow", "hold", "relax")


class Session:
    """The data of a recorded session.

    spans: states of each device, as (begin in s, end in s, state).
    events: (time in s, kind, text).
    ports: numbers (3,) of messages that a node dropped, missed and refused, by topic, node and
        start of the node: those counted before the bag, and those counted at last.
    """

    def __init__(self, reader: BagReader) -> None:
        self.info = reader.info()
        self.clock_id = reader.metadata.get("recording", {}).get("clock_id", "")
        self.sheet = FollowedSheet()
        self.stamps: dict[str, array[int]] = {}
        self.missing: Counter[str] = Counter()
        self.latencies: dict[str, Samples] = {}
        self.max_force_n: dict[str, float] = {}
        self.spans = {"e-stop": [(0.0, 0.0, "released")]}
        self.events: list[tuple[float, str, str]] = []
        self.nodes: dict[str, dict[str, Any]] = {}
        self.ports: dict[tuple[str, str, int], tuple[Ints, Ints]] = {}
        self.busy: dict[str, list[bool]] = {}
        self.fingertips: Counter[str] = Counter()
        self.beyond_range = self.late_frames = 0
        self._table = ClockTable(self.clock_id)
        self._sequences: dict[tuple[str, str, int], int] = {}
        self._exposures: dict[str, int] = {}
        self._faults: dict[str, tuple[str, ...]] = {}
        self._undecided: dict[str, list[tuple[float, str, str]]] = {}
        self._epochs: dict[str, int] = {}
        self._ends_s: dict[str, float] = {}

    def seconds(self, at_ns: int) -> float:
        """Convert a recorded time (ns) to the time (s) since the start of the bag."""
        return (at_ns - self.info.start_ns) * 1e-9

    def add(self, topic: str, message: Message, header: Header, log_ns: int) -> None:
        """Add one message of the bag, which was recorded at `log_ns`."""
        seconds = self.seconds(log_ns)
        self.stamps.setdefault(topic, array("q")).append(log_ns)
        writer = (topic, header.writer, header.epoch)
        before = self._sequences.get(writer, header.sequence - 1)
        self.missing[topic] += max(0, header.sequence - before - 1)
        self._sequences[writer] = header.sequence
        if isinstance(message, types.Clocks) and header.clock_id == self.clock_id:
            self._table.update(message)
        # Durations between two timestamps of one message need no conversion between clocks.
        for event, exposure_ns, at_ns in list_events(message, header):
            if self._exposures.get(event) != exposure_ns:
                self._exposures[event] = exposure_ns
                delay_s = np.array([(at_ns - exposure_ns) * 1e-9])
                self.latencies.setdefault(event, Samples()).add(log_ns, delay_s)
        message, header, _ = self._table.localize(message, header, log_ns)
        self.sheet.add(message, header.source_ns)
        match message:
            case types.ArmState():
                self._add_arm(message, seconds)
            case types.SheetTarget():
                self._add_state("sheet", message.phase, seconds)
            case types.Fingertip():
                self._add_state("finger", message.state, seconds)
                self.fingertips[message.reason] += 1
            case types.SoftBody():
                self.beyond_range += not message.in_range
            case types.Frame():
                self.late_frames = message.late_frames
            case types.Status():
                self._add_status(message, header.epoch, seconds)
            case types.HostStatus():
                self.busy.setdefault(message.host, []).append(is_busy(message))
            case types.EStop():
                state = "engaged" if message.engaged else "released"
                if self._add_state("e-stop", state, seconds):
                    text = f"e-stop {state} by {header.writer}: {message.reason}"
                    self.events.append((seconds, "estop", text))
            case types.Bookmark():
                self.events.append((seconds, "bookmark", message.label))

    def _add_state(self, name: str, state: str, seconds: float) -> bool:
        """Add the state of a device, and return whether it differs from the previous state."""
        spans = self.spans.setdefault(name, [(seconds, seconds, state)])
        begin_s, end_s, before = spans[-1]
        lasts = seconds - end_s <= MAX_STATE_AGE_S
        if lasts:
            spans[-1] = (begin_s, seconds, before)
        if not lasts or before != state:
            spans.append((seconds, seconds, state))
        return before != state

    def _add_arm(self, arm: types.ArmState, seconds: float) -> None:
        undecided = self._undecided.setdefault(arm.side, [])
        if arm.mode in MOVING:
            self.events += undecided
            undecided.clear()
        if self._add_state(f"{arm.side} arm", arm.mode, seconds) and arm.mode in FAULTY:
            text = f"{arm.side} arm: {arm.mode}" + (f", {arm.reason}" if arm.reason else "")
            events = undecided if arm.mode in ENDING else self.events
            events.append((seconds, "arm", text))
        # In the mode `disconnected`, the new fault is the reason of the lost connection.
        lost = arm.mode == "disconnected" and not arm.estop_engaged
        for fault in arm.faults:
            if fault not in self._faults.get(arm.side, ()):
                events = undecided if lost else self.events
                events.append((seconds, "fault", f"{arm.side} arm: {fault}"))
        self._faults[arm.side] = arm.faults
        if arm.edge_force_n is not None:
            self.max_force_n[arm.side] = max(arm.edge_force_n, self.max_force_n.get(arm.side, 0.0))

    def _add_status(self, status: types.Status, epoch: int, seconds: float) -> None:
        node = self.nodes.setdefault(
            status.node, {"starts": 0, "max_cpu": 0.0, "errors": 0, "last_error": "", "notes": {}}
        )
        if self._epochs.get(status.node) != epoch:
            self._epochs[status.node] = epoch
            node["starts"] += 1
            if node["starts"] > 1:
                self.events.append((seconds, "restart", f"{status.node} was restarted"))
        if status.last_error not in ("", node["last_error"]):
            node["last_error"] = status.last_error
            self.events.append((seconds, "error", f"{status.node}: {status.last_error}"))
        node["max_cpu"] = max(node["max_cpu"], status.cpu_ratio)
        node["errors"] = max(node["errors"], status.errors)
        node["notes"] |= {str(note.code): note.detail for note in status.notes}
        self._ends_s[status.node] = seconds if status.state == "stopping" else np.inf
        earlier = status.uptime_s - seconds > MIN_EARLIER_UPTIME_S
        for port in status.inputs:
            counts = np.array([port.dropped, port.gaps, port.rejected])
            key = (port.topic, status.node, epoch)
            base, _ = self.ports.get(key, (counts if earlier else 0 * counts, counts))
            self.ports[key] = base, counts

    def finish(self) -> None:
        """Add the losses of arms and the silences of topics to the events."""
        end_s = min(self._ends_s.values(), default=np.inf) - MAX_END_S
        for seconds, kind, text in chain.from_iterable(self._undecided.values()):
            self.events.append((seconds, "end" if seconds >= end_s else kind, text))
        for topic in self.stamps:
            for begin_s, silence_s in self.find_silences(topic):
                self.events.append((begin_s, "gap", f"{topic} silent for {silence_s:.2f} s"))
        self.events.sort()
        self.errors = {source: self.sheet.compute_errors(source) for source in get_args(Source)}

    def find_silences(self, name: str) -> list[tuple[float, float]]:
        """Return the start and the duration (s) of each silence of a topic with a known rate."""
        min_hz, stamps = _find_min_rate_hz(name), np.array(self.stamps.get(name, ()), np.int64)
        if min_hz is None:
            return []
        pauses_s = np.diff(stamps) * 1e-9
        silent = np.flatnonzero(pauses_s > max(SILENT_PERIODS / min_hz, MIN_SILENCE_S))
        return [(self.seconds(int(stamps[i])), float(pauses_s[i])) for i in silent]


def read_session(bag: Path, progress: Progress = lambda done_s, whole_s: None) -> Session:
    """Read a complete or incomplete bag. Raises BagError if no message can be read."""
    session = Session(BagReader(bag))
    readable = {one.name for one in session.info.topics if one.readable}
    for number, (topic, message, header, log_ns) in enumerate(BagReader(bag, readable)):
        session.add(topic, message, header, log_ns)
        if number % 200 == 0:
            progress(session.seconds(log_ns), session.info.duration_s)
    session.finish()
    return session


def compute_numbers(session: Session) -> dict[str, Any]:
    """Compute all numbers of the report, as JSON values. Numbers without data are None."""
    info, sheet = session.info, session.sheet
    fingertip_m = sheet.compute_fingertip_errors_m()
    recorded = {one.name: one for one in info.topics}
    return {
        "bag": {**info.metadata.get("recording", {}), "path": str(info.path)},
        "duration_s": info.duration_s,
        "messages": info.count,
        "problem": info.problem,
        "scene": None if session.sheet.scene is None else session.sheet.scene.name,
        "topics": {
            name: _describe_topic(session, name, recorded.get(name))
            for name in sorted({*recorded, *(topic for topic, _, _ in session.ports)})
        },
        "latency_ms": {
            event: _percentiles(1e3 * samples.values[:, 0])
            for event, samples in session.latencies.items()
        },
        "sheet": {
            "contact": {
                **summarize_contact(session.errors["measured"], ""),
                **summarize_contact(session.errors["true"], "true_"),
            },
            "followed": sheet.summarize_runs(),
        },
        "fingertip_mm": summary(fingertip_m, 1e3) if len(fingertip_m) else None,
        "fingertips": dict(session.fingertips),
        "pushes_beyond_range": session.beyond_range,
        "late_frames": session.late_frames,
        "max_edge_force_n": session.max_force_n,
        "nodes": session.nodes,
        "busy_fraction": {host: float(np.mean(busy)) for host, busy in session.busy.items()},
        "events": [
            {"seconds": seconds, "kind": kind, "text": text}
            for seconds, kind, text in session.events[:MAX_EVENTS]
        ],
    }


def _describe_topic(session: Session, name: str, info: Any) -> dict[str, Any]:
    silences_s = [silence_s for _, silence_s in session.find_silences(name)]
    ports = [last - base for key, (base, last) in session.ports.items() if key[0] == name]
    dropped, gaps, refused = sum(ports, np.zeros(3, np.int64)).tolist()
    return {
        "messages": info.count if info else 0,
        "rate_hz": info.rate_hz if info else None,
        "min_rate_hz": _find_min_rate_hz(name),
        "silences": len(silences_s),
        "longest_silence_s": max(silences_s, default=None),
        "missing": session.missing[name],
        "dropped": dropped,
        "gaps": gaps,
        "refused": refused,
    }


def _find_min_rate_hz(name: str) -> float | None:
    """Return the minimum rate of a topic; None if it has many writers or no known rate."""
    topic = TOPICS.get(name)
    return topic.rate_hz[0] if topic and topic.rate_hz and not topic.many_writers else None


def _percentiles(values: Floats) -> dict[str, float]:
    p50, p99 = np.quantile(values, (0.5, 0.99)).tolist()
    return {"p50": p50, "p99": p99, "max": float(values.max())}


MARK = "<!-- made by: flexsheet bag report -->"
"""The comment in a report, without which an existing file is not overwritten."""

SLOW_RATIO = 0.5
"""The fraction of a topic's minimum rate below which the rate is reported as a problem."""

MAX_UNSEEN_RATIO = 0.05
BRIEFLY_BUSY_FRACTION = 0.05
"""The maximum fraction of time for which an overload is not a problem."""

ROUNDING = 1.02
"""The factor by which measured values can exceed their limits because of rounding."""

BAD, DOUBTFUL = "bad", "doubtful"
Problems = Iterator[tuple[str, str]]

RED, BLUE, GREY = "#c0392b", "#0072b2", "#b0b8bf"
STATE_COLOURS = dict.fromkeys((*FAULTY, "lost"), RED)
STATE_COLOURS |= dict.fromkeys(("follow", "contact", "tracking"), BLUE)
STYLE = """body { margin: auto; max-width: 70rem; font-family: sans-serif } .bad { color: #b91c1c }
table { border-collapse: collapse } th, td { border: 1px solid #ccc; text-align: left }"""


def report(bag: Path, output: Path | None, progress: Progress) -> dict[str, Any]:
    """Read a bag, and return the numbers and problems of the session.

    output: HTML file to write, with a JSON file of the same name and the suffix .report.json beside
        it; None if no file is to be written.

    Raises BagError if the bag cannot be read, or if `output` exists and is not a report.
    """
    if output is not None and output.is_file() and MARK.encode() not in output.read_bytes()[:300]:
        what = "the file is not a report, so it is not overwritten"
        raise BagError(f"{output}: {what}; give another file with -o")
    session = read_session(bag, progress)
    result = make_result(session)
    if output is not None:
        write_file(output.with_suffix(".report.json"), json.dumps(result, indent=1) + "\n")
        write_file(output, render_page(session, result))
    return result


def make_result(session: Session) -> dict[str, Any]:
    """Return the problems and the numbers of a session, for `bag report --json`.

    The key `findings` contains the problems, failures first. The gravity of a problem is "bad" for
    a failure, and "doubtful" for what the user should check.
    """
    numbers = compute_numbers(session)
    found = [
        *_check_recording(numbers),
        *_check_arms(session, numbers),
        *_check_nodes(numbers),
        *chain.from_iterable(_check_topic(*item) for item in numbers["topics"].items()),
        *_check_tolerances(session, numbers),
    ]
    ordered = sorted(found, key=lambda one: one[0] != BAD)
    return {"findings": [{"gravity": one, "text": text} for one, text in ordered], **numbers}


def _check_recording(numbers: dict[str, Any]) -> Problems:
    for host, busy in numbers["busy_fraction"].items():
        if busy > BRIEFLY_BUSY_FRACTION:
            remedy = "end other programs, or start fewer nodes"
            yield BAD, f"The computer {host} was busy in {busy:.0%} of the time; {remedy}."
    if problem := numbers["problem"]:
        yield BAD, f"The bag is incomplete ({problem}); its readable part is evaluated."
    if lost := int(numbers["bag"].get("lost_messages", 0)):
        yield BAD, f"The recorder lost {lost} messages before this bag (disk full)."


def _check_arms(session: Session, numbers: dict[str, Any]) -> Problems:
    for kind, text in (
        ("estop", "An e-stop was engaged or reset"),
        ("fault", "An arm had a fault"),
        ("arm", "An arm stopped operating"),
    ):
        if events := [one for one in session.events if one[1] == kind]:
            seconds, _, first = events[0]
            yield BAD, f"{text} (number: {len(events)}), first at {seconds:.2f} s: {first}."
    for side, force_n in numbers["max_edge_force_n"].items():
        limit_n = (
            np.inf if session.sheet.scene is None else session.sheet.scene.sheet.max_edge_force_n
        )
        if force_n > ROUNDING * limit_n:
            allowed = f"the scene allows {limit_n:.3g} N"
            yield BAD, f"{side} arm: the edge force reached {force_n:.3g} N; {allowed}."


def _check_nodes(numbers: dict[str, Any]) -> Problems:
    for name, node in numbers["nodes"].items():
        if node["errors"]:
            yield BAD, f"{name} had {node['errors']} errors; the last: {node['last_error']}."
        if node["starts"] > 1:
            yield BAD, f"{name} was started {node['starts']} times."
        for code, detail in node["notes"].items():
            if code != NoteCode.INFO:
                yield DOUBTFUL, f"{name} reported {code}: {detail}"


def _check_topic(name: str, topic: dict[str, Any]) -> Problems:
    rate_hz, min_hz = topic["rate_hz"], topic["min_rate_hz"]
    # A reader of a topic with the delivery `latest` needs only the newest message.
    latest = name in TOPICS and TOPICS[name].delivery is Delivery.LATEST
    lost = 0 if latest else topic["dropped"] + topic["gaps"]
    slow = min_hz and rate_hz and topic["messages"] > 10 and rate_hz < SLOW_RATIO * min_hz
    longest_s = topic["longest_silence_s"]
    for found, gravity, text in (
        (topic["refused"], BAD, f"{topic['refused']} messages were refused by their readers"),
        (lost, DOUBTFUL, f"{lost} messages were lost before their readers"),
        (topic["missing"], DOUBTFUL, f"{topic['missing']} messages never reached the recorder"),
        (longest_s, DOUBTFUL, f"no message for up to {longest_s or 0:.2f} s"),
        (slow, DOUBTFUL, f"rate {rate_hz or 0:.3g} Hz; at least {min_hz or 0:.3g} Hz is expected"),
    ):
        if found:
            yield gravity, f"{name}: {text}."


def _check_tolerances(session: Session, numbers: dict[str, Any]) -> Problems:
    if session.sheet.scene is not None:
        tolerances, contact = session.sheet.scene.tolerances, numbers["sheet"]["contact"]
        allowed_ms, allowed_mm = 1e3 * tolerances.latency_s, 1e3 * tolerances.sheet_position_m
        for event in ARM_EVENTS.values():
            p99 = numbers["latency_ms"].get(event, {}).get("p99", 0.0)
            if p99 > allowed_ms:
                text = f"Exposure to {event} took {p99:.1f} ms (99 %)"
                yield DOUBTFUL, f"{text}; the scene allows {allowed_ms:.3g} ms."
        if (errors := contact["true_delta_d_mm"]) and errors["mean"] > allowed_mm:
            text = f"The true sheet's mean error in contact was {errors['mean']:.3g} mm"
            yield DOUBTFUL, f"{text}; the scene allows {allowed_mm:.3g} mm."
    total = sum(numbers["fingertips"].values())
    unseen = total - numbers["fingertips"].get("ok", 0)
    if unseen > MAX_UNSEEN_RATIO * total:
        yield DOUBTFUL, f"{unseen} of {total} images had no valid fingertip."
    if beyond := numbers["pushes_beyond_range"]:
        yield DOUBTFUL, f"{beyond} pushes were deeper than the range of the soft body's method."
    for path in numbers["sheet"]["followed"]:
        if count := path["drop_outs"]:
            yield DOUBTFUL, f"{path['path']}: the arms stopped {count} times in contact."
    if late := numbers["late_frames"]:
        yield DOUBTFUL, f"{late} frames were late by more than half a period."


def draw_figure(session: Session) -> bytes:
    """Draw states, latencies and errors over time, and return the PNG image."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, 10.0), layout="constrained")
    FigureCanvasAgg(figure)
    states, latency, error = figure.subplots(3, 1, sharex=True)
    for row, spans in enumerate(session.spans.values()):
        for begin_s, end_s, state in spans:
            colour = STATE_COLOURS.get(state, GREY)
            states.barh(row, max(end_s - begin_s, 1e-3), left=begin_s, color=colour)
    for seconds, kind, _ in session.events:
        states.plot(seconds, len(session.spans), "v", color=GREY if kind == "bookmark" else RED)
    states.set_yticks(range(len(session.spans) + 1), [*session.spans, "events"])
    for event in (*ARM_EVENTS.values(), LatencyEvent.FRAME_DRAWN):
        if event in session.latencies:
            samples = session.latencies[event]
            seconds_s = 1e-9 * (samples.times_ns - session.info.start_ns)
            latency.plot(seconds_s, 1e3 * samples.values[:, 0], ".", ms=2, label=event)
    for source, errors in session.errors.items():
        if errors is not None:
            seconds_s = 1e-9 * (errors.times_ns[errors.contact] - session.info.start_ns)
            error.plot(seconds_s, 1e3 * errors.delta_d_m[errors.contact], ".", ms=2, label=source)
    latency.set(ylabel="latency from exposure, ms", ylim=(0.0, None))
    error.set(ylabel="Δd in contact, mm", ylim=(0.0, None), xlabel="time in the bag, s")
    for axes in (latency, error):
        if axes.lines:
            axes.legend(loc="upper right")
    buffer = BytesIO()
    figure.savefig(buffer, format="png", dpi=100)
    return buffer.getvalue()


def render_page(session: Session, result: dict[str, Any]) -> str:
    """Return the report as a self-contained HTML page."""
    name = escape(session.info.path.name)
    problems = "".join(
        f'<li class="{one["gravity"]}">{escape(one["text"])}</li>' for one in result["findings"]
    )
    events = "".join(
        f"<li>{one['seconds']:.2f} s: {escape(one['text'])}</li>" for one in result["events"]
    )
    data = b64encode(draw_figure(session)).decode()
    return f"""<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8">{MARK}<title>{name}</title>
<style>{STYLE}</style></head><body>
<h1>{name}</h1>
<p>{result["duration_s"]:.2f} s, {result["messages"]} messages.</p>
<h2>Problems</h2><ul>{problems or "<li>No problem was found.</li>"}</ul>
<h2>Time</h2><img src="data:image/png;base64,{data}" alt="States of sheet, arms and finger;
latencies; and errors of the sheet over time">
<p>Blue: following, in contact or tracking; red: faulty or lost; grey: other states.</p>
<ul>{events}</ul>
<h2>Numbers</h2><table>{"".join(_list_rows("", result))}</table>
</body></html>
"""


def _list_rows(prefix: str, value: Any) -> Iterator[str]:
    """Yield a table row for each group of plain values in a tree of dictionaries and lists."""
    value = value if isinstance(value, dict) else dict(enumerate(value))
    cells = [
        f"{key} {one:.4g}" if isinstance(one, float) else f"{key} {one}"
        for key, one in value.items()
        if not isinstance(one, dict | list | None)
    ]
    if cells:
        yield f"<tr><th>{escape(prefix)}</th><td>{escape(', '.join(cells))}</td></tr>"
    for key, one in value.items():
        if isinstance(one, dict | list) and key not in ("findings", "events"):
            yield from _list_rows(f"{prefix} {key}".strip(), one)
