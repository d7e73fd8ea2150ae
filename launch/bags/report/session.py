"""Read a bag once, from start to end, and compute a summary for `flexsheet bag report`."""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from flexsheet.launch.bags.report.album import Album
from flexsheet.launch.bags.report.series import (
    Events,
    Grid,
    Maxima,
    PointSeries,
    RunningMoments,
    Spread,
    States,
)
from flexsheet.launch.bags.report.strokes import SheetErrors
from flexsheet.launch.experiments.stroke import list_events
from flexsheet.launch.plans.plan_model import ResolvedGraph
from flexsheet.messages.bag import BagError, BagInfo, BagReader
from flexsheet.messages.base import Header, Message
from flexsheet.messages.busy import is_busy
from flexsheet.messages.clock_table import ClockTable
from flexsheet.messages.scene import RV_1A, Scene
from flexsheet.messages.topics import TOPICS, Delivery
from flexsheet.messages.types import (
    ArmState,
    Bookmark,
    Clocks,
    EStop,
    Fingertip,
    Frame,
    HostStatus,
    PortStatus,
    SheetTarget,
    SoftBody,
    Status,
    StereoPair,
    TwinEye,
    TwinFinger,
)
from flexsheet.nodes import NodeRole
from flexsheet.nodes.arrays import Floats, Ints

Progress = Callable[[float, float], None]

MAX_INTERVALS, FINE_INTERVALS = 240, 1200
MIN_INTERVAL_S = 0.25
STEREO_SHOTS, EYE_SHOTS, FRAME_SHOTS = 6, 12, 6
MIN_EARLIER_UPTIME_S = 10.0
SILENT_PERIODS, MIN_SILENCE_S = 10.0, 0.5
SPEED_OVER_NS = 25_000_000
"""The minimum interval (ns) over which speeds are averaged, because timestamps are irregular."""

PHASES = ("wait", "approach", "contact", "hold")
MODES = (
    "starting", "idle", "follow", "hold", "relax", "disconnected", "stopping", "fault", "estop",
)  # fmt: skip
FINGER_STATES = ("tracking", "acquiring", "coasting", "lost")
FAULTY = ("fault", "estop", "disconnected", "stopping")
FAULTY_AT_END = ("disconnected", "stopping")
"""The arm modes that indicate a fault, except at the end of a session.

At the end of a session, an arm enters these modes because it is shut down.
"""

MOVING = ("follow", "hold", "relax")
MAX_END_S = 2.0
"""The maximum time (s) between the loss of an arm and the shutdown of its node at a session's end.

An arm that is lost (disconnected) within this time and does not move again has not failed. Its loss
is reported as the end of the session.
"""


@dataclass(slots=True)
class Flow:
    """The regularity of the messages of a topic, and the number of missing messages.

    age: distribution of the time from the source timestamp to the recording.
    lost: number of missing sequence numbers.
    silences: number of times when no message arrived for longer than permitted.
    longest_silence_s: longest time (s) in which no message arrived.
    """

    age: Spread
    messages: int = 0
    lost: int = 0
    silences: int = 0
    longest_silence_s: float = 0.0
    last_ns: int | None = None
    sequences: dict[str, tuple[int, int]] = field(default_factory=dict)


@dataclass(slots=True)
class PortTotals:
    """The numbers of messages that the subscribers of a topic skipped, lost and refused.

    If a node starts several times, its counts are summed. Messages from before the start of the bag
    are not counted.
    """

    age: Spread
    newest: dict[str, tuple[int, PortStatus]] = field(default_factory=dict)
    offset: Ints = field(default_factory=lambda: np.zeros(3, np.int64))

    def add(self, node: str, epoch: int, port: PortStatus, *, started_earlier: bool) -> None:
        """Add the message counters that a subscriber reports.

        node: name of the subscribing node.
        epoch: start time of the node, ns.
        started_earlier: whether the node was running long before the start of the bag.
        """
        before = self.newest.get(node)
        if before is not None and before[0] != epoch:
            self.offset += count_undelivered(before[1])
        if before is None and started_earlier:
            self.offset -= count_undelivered(port)
        self.newest[node] = (epoch, port)
        if port.age_s is not None:
            self.age.add(0, port.age_s)

    def totals(self) -> tuple[int, int, int]:
        """Return the numbers of skipped, lost and refused messages, summed over all subscribers."""
        now = [count_undelivered(port) for _, port in self.newest.values()]
        skipped, lost, refused = sum(now, self.offset).tolist()
        return skipped, lost, refused


def count_undelivered(port: PortStatus) -> Ints:
    """Return the numbers (3,) of messages that a subscriber skipped, lost and refused.

    A queue of a topic with the delivery `latest` is short, because only the newest message is
    needed. Messages that this queue drops are therefore counted as skipped and not as lost.
    """
    topic = TOPICS.get(port.topic)
    if topic is not None and topic.delivery is Delivery.LATEST:
        return np.array([port.dropped + port.gaps, 0, port.rejected])
    return np.array([port.dropped, port.gaps, port.rejected])


@dataclass(slots=True)
class HostLoad:
    """A summary of the processor load of a host.

    reports: number of status messages of the host.
    busy: number of status messages in which the host is overloaded.
    worst: status message with the highest load.
    """

    reports: int = 0
    busy: int = 0
    worst: HostStatus | None = None

    def update(self, host: HostStatus) -> None:
        self.reports += 1
        if is_busy(host):
            self.busy += 1
            if self.worst is None or host.load_ratio > self.worst.load_ratio:
                self.worst = host


@dataclass(slots=True)
class NodeSummary:
    """A summary of the status messages of a node: processor use, memory, starts and errors."""

    cpu: RunningMoments = field(default_factory=RunningMoments)
    resident_bytes: int = 0
    starts: int = 0
    epoch: int | None = None
    degraded: int = 0
    errors: int = 0
    last_error: str = ""
    note: str = ""

    def add(self, status: Status, epoch: int) -> bool:
        """Add a status message, and return whether it contains a new error.

        epoch: start time of the node, ns.
        """
        self.cpu.add(np.array([status.cpu_ratio]))
        self.resident_bytes = max(self.resident_bytes, status.resident_bytes)
        if epoch != self.epoch:
            self.epoch, self.starts = epoch, self.starts + 1
        self.degraded += status.state == "degraded"
        news = bool(status.last_error) and status.last_error != self.last_error
        self.errors = max(self.errors, status.errors)
        self.last_error = status.last_error or self.last_error
        self.note = status.note_text
        return news


class Arm:
    """A summary of one arm: its modes, its speeds, and the force at its edge of the sheet."""

    def __init__(self, grid: Grid, fine: Grid) -> None:
        self.modes = States(fine, MODES)
        self.joint_speed = [Maxima(grid) for _ in range(6)]
        self.tool_speed, self.edge_force = Maxima(grid), Maxima(grid)
        self.cycle = Spread(Grid(0, 1.0, 1))
        self.faults: tuple[str, ...] = ()
        self.bridge = ""
        self.undecided: list[tuple[float, str, str]] = []
        self._recent: deque[tuple[int, Floats, Floats]] = deque()

    def add(self, arm: ArmState, source_ns: int, index: int) -> None:
        """Add an arm state to the summary.

        source_ns: time of the joint measurement.
        index: index of the interval to which the state belongs.
        """
        self.cycle.add(0, arm.cycle_s)
        if arm.edge_force_n is not None:
            self.edge_force.add(index, arm.edge_force_n)
        recent = self._recent
        if recent and not 0 < source_ns - recent[-1][0] < 4 * SPEED_OVER_NS:
            if source_ns == recent[-1][0]:
                return
            recent.clear()
        recent.append((source_ns, arm.joints_rad, arm.world_from_flange[:3, 3]))
        while len(recent) > 2 and source_ns - recent[1][0] >= SPEED_OVER_NS:
            recent.popleft()
        passed_s = (source_ns - recent[0][0]) * 1e-9
        if passed_s * 1e9 < SPEED_OVER_NS:
            return
        speeds = np.abs(arm.joints_rad - recent[0][1]) / passed_s
        for range_, speed in zip(self.joint_speed, speeds.tolist(), strict=True):
            range_.add(index, speed)
        distance_m = float(np.linalg.norm(recent[-1][2] - recent[0][2]))
        self.tool_speed.add(index, distance_m / passed_s)


class Session:
    """A summary of a recorded session.

    scene: last recorded scene; None if the bag contains no scene.
    """

    def __init__(
        self, reader: BagReader, info: BagInfo, bookmarks: list[tuple[float, str]]
    ) -> None:
        self.info, self.metadata = info, reader.metadata
        self.plan, self.git = _read_plan(reader), _read_json(reader, "git.json")
        length_s = max(info.duration_s, 1e-3)
        stretches = int(np.clip(length_s / MIN_INTERVAL_S, 1, MAX_INTERVALS))
        self.grid = Grid(info.start_ns, length_s, stretches)
        self.fine = Grid(info.start_ns, length_s, FINE_INTERVALS)
        self.clock_id = reader.metadata.get("recording", {}).get("clock_id", "")
        self.scene: Scene | None = None
        self.scenes: list[str] = []
        self.events = Events()
        self.flows: dict[str, Flow] = {}
        self.ports: dict[str, PortTotals] = {}
        self.nodes: dict[str, NodeSummary] = {}
        self.hosts: dict[str, HostStatus] = {}
        self.loads: dict[str, HostLoad] = {}
        self.latencies: dict[str, Spread] = {}
        self.phases, self.finger = States(self.fine, PHASES), States(self.fine, FINGER_STATES)
        self.estop = States(self.fine, ("released", "engaged"))
        self.arms = {side: Arm(self.grid, self.fine) for side in ("left", "right")}
        self.reasons: dict[str, int] = {}
        self.finger_path, self.true_path = PointSeries(self.fine), PointSeries(self.fine)
        self.sheet_path = PointSeries(self.fine)
        self.push, self.force = Maxima(self.grid), Maxima(self.grid)
        self.body_methods: dict[str, int] = {}
        self.out_of_range = 0
        self.corrections: dict[str, int] = {}
        self.draw = Spread(Grid(0, 1.0, 1))
        self.frames = self.late_frames = 0
        self.errors = SheetErrors(self.grid)
        self.bookmarks = bookmarks
        self.stereo = Album(STEREO_SHOTS, bookmarks)
        self.eye, self.drawn = Album(EYE_SHOTS, bookmarks), Album(FRAME_SHOTS, bookmarks)
        self._table = ClockTable(self.clock_id)
        self._exposures: dict[str, int] = {}
        self._restarts: dict[str, int] = {}
        self._stopped_s: dict[str, float] = {}
        self._finger_text = ""
        self._late_before: int | None = None

    def joint_speeds_rad_per_s(self, side: str) -> tuple[float, ...]:
        """Return the maximum joint speeds (6,), in rad/s, of an arm in the scene.

        If no scene was recorded, return the maximum joint speeds of an RV-1A arm.
        """
        model = RV_1A if self.scene is None else getattr(self.scene.arms, side).model
        return tuple(model.speed_rad_per_s)

    def add(self, topic: str, message: Message, header: Header, log_ns: int) -> None:
        """Add one message of the bag to the summary.

        log_ns: time when the message was recorded, ns.
        """
        self._add_flow(topic, header, log_ns)
        if isinstance(message, Clocks) and header.clock_id == self.clock_id:
            self._table.update(message)
        # Durations between two timestamps of one message need no conversion between clocks.
        seconds, index = self.seconds(log_ns), self.grid.index(log_ns)
        for event, exposure_ns, at_ns in list_events(message, header):
            if self._exposures.get(event) != exposure_ns:
                self._exposures[event] = exposure_ns
                if event not in self.latencies:
                    self.latencies[event] = Spread(self.grid)
                self.latencies[event].add(index, (at_ns - exposure_ns) * 1e-9)
        if header.clock_id != self.clock_id:
            message, header, _ = self._table.localize(message, header, log_ns)
        self.errors.add(message, header.source_ns)
        match message:
            case ArmState():
                self._add_arm(message, header, log_ns)
            case SheetTarget():
                self._add_target(message, log_ns)
            case Fingertip():
                self._add_fingertip(message, log_ns)
            case TwinFinger():
                self.true_path.add(self.fine.index(log_ns), message.position_world_m)
            case Status():
                self._add_status(message, header, seconds)
            case SoftBody():
                self.body_methods[message.method] = self.body_methods.get(message.method, 0) + 1
                self.out_of_range += not message.in_range
                self.force.add(index, float(np.linalg.norm(message.force_world_n)))
            case Frame() | StereoPair() | TwinEye():
                self._add_picture(message, seconds)
            case _:
                self._add_rare(message, header, log_ns)

    def seconds(self, at_ns: int) -> float:
        """Convert a recorded time (ns) to the time (s) since the start of the bag."""
        return (at_ns - self.info.start_ns) * 1e-9

    def _add_flow(self, topic: str, header: Header, log_ns: int) -> None:
        flow = self.flows.get(topic)
        if flow is None:
            flow = self.flows[topic] = Flow(Spread(Grid(0, 1.0, 1)))
        flow.messages += 1
        before = flow.sequences.get(header.writer)
        if before is not None and before[0] == header.epoch and header.sequence > before[1] + 1:
            flow.lost += header.sequence - before[1] - 1
        flow.sequences[header.writer] = (header.epoch, header.sequence)
        if header.clock_id == self.clock_id:
            flow.age.add(0, (log_ns - header.source_ns) * 1e-9)
        if flow.last_ns is not None and topic in SILENCE_LIMITS_S:
            silence_s = (log_ns - flow.last_ns) * 1e-9
            flow.longest_silence_s = max(flow.longest_silence_s, silence_s)
            if silence_s > SILENCE_LIMITS_S[topic]:
                flow.silences += 1
                text = f"{topic} silent for {silence_s:.2f} s"
                self.events.add(self.seconds(flow.last_ns), "gap", text)
        flow.last_ns = log_ns

    def finish(self) -> None:
        """Complete the summary of the session after all messages of the bag have been added."""
        self.errors.finish()
        for arm in self.arms.values():
            ends_s = [
                self._stopped_s[node]
                for node in (arm.bridge, *self._list_simulators(arm.bridge))
                if node in self._stopped_s
            ]
            for seconds, kind, text in arm.undecided:
                at_end = bool(ends_s) and seconds >= min(ends_s) - MAX_END_S
                self.events.add(seconds, "end" if at_end else kind, text)

    def _list_simulators(self, bridge: str) -> list[str]:
        """Return the names of the nodes that simulate an arm; empty for a real arm.

        bridge: name of the node that controls the arm.
        """
        nodes = {} if self.plan is None else self.plan.nodes
        if bridge not in nodes or nodes[bridge].device_address is None:
            return []
        host, address = nodes[bridge].host, str(nodes[bridge].device_address)
        port = int(address.rpartition(":")[2])
        return [
            node.name
            for node in nodes.values()
            if node.role is NodeRole.ARM_SIMULATOR
            and node.host == host
            and port in node.listen_ports
        ]

    def _add_arm(self, arm: ArmState, header: Header, log_ns: int) -> None:
        mine, seconds = self.arms[arm.side], self.seconds(log_ns)
        mine.bridge = header.writer
        if arm.mode in MOVING:
            for event in mine.undecided:
                self.events.add(*event)
            mine.undecided.clear()
        found = []
        if mine.modes.add(self.fine.index(log_ns), log_ns, arm.mode) and arm.mode in FAULTY:
            text = f"{arm.side} arm: {arm.mode}" + (f", {arm.reason}" if arm.reason else "")
            found.append((arm.mode in FAULTY_AT_END, "arm", text))
        # In the mode `disconnected`, the new fault is the reason of the lost connection.
        lost = arm.mode == "disconnected" and not arm.estop_engaged
        for fault in arm.faults:
            if fault not in mine.faults:
                found.append((lost, "fault", f"{arm.side} arm: {fault}"))
        for undecided, kind, text in found:
            if undecided:
                mine.undecided.append((seconds, kind, text))
            else:
                self.events.add(seconds, kind, text)
        mine.faults = arm.faults
        mine.add(arm, header.source_ns, self.grid.index(log_ns))

    def _add_target(self, target: SheetTarget, log_ns: int) -> None:
        fine = self.fine.index(log_ns)
        self.phases.add(fine, log_ns, target.phase)
        self.sheet_path.add(fine, target.world_from_sheet[:3, 3])
        self.push.add(self.grid.index(log_ns), target.push_depth_m)

    def _add_fingertip(self, finger: Fingertip, log_ns: int) -> None:
        fine = self.fine.index(log_ns)
        self.finger.add(fine, log_ns, finger.state)
        self.reasons[finger.reason] = self.reasons.get(finger.reason, 0) + 1
        self._finger_text = f"finger {finger.state}" + (
            "" if finger.reason == "ok" else f" ({finger.reason})"
        )
        if finger.valid:
            self.finger_path.add(fine, finger.position_world_m)

    def _add_status(self, status: Status, header: Header, seconds: float) -> None:
        self._stopped_s.pop(status.node, None)
        if status.state == "stopping":
            self._stopped_s[status.node] = seconds
        summary = self.nodes.setdefault(status.node, NodeSummary())
        starts = summary.starts
        if summary.add(status, header.epoch):
            self.events.add(seconds, "error", f"{status.node}: {status.last_error}")
        if starts and summary.starts > starts:
            self.events.add(seconds, "restart", f"{status.node} was restarted")
        earlier = status.uptime_s - seconds > MIN_EARLIER_UPTIME_S
        for port in status.inputs:
            if port.topic not in self.ports:
                self.ports[port.topic] = PortTotals(Spread(Grid(0, 1.0, 1)))
            self.ports[port.topic].add(status.node, header.epoch, port, started_earlier=earlier)

    def _add_picture(self, message: Frame | StereoPair | TwinEye, seconds: float) -> None:
        match message:
            case StereoPair():
                pair = (("left camera", message.left), ("right camera", message.right))
                self.stereo.add(seconds, self._finger_text, pair)
            case TwinEye():
                pair = (
                    ("seen by the eye", message.seen),
                    ("expected by the eye", message.expected),
                )
                self.eye.add(seconds, add_correction(message.label, message.correction), pair)
            case Frame():
                self.frames += 1
                if self._late_before is None:
                    self._late_before = message.late_frames
                late = message.late_frames - self._late_before
                self.late_frames = max(self.late_frames, late)
                name = message.correction
                self.corrections[name] = self.corrections.get(name, 0) + 1
                self.draw.add(0, message.draw_s)
                if message.pixels:
                    shown = f"{add_correction(message.label, message.correction)}, {message.stereo}"
                    self.drawn.add(seconds, shown, (("projector", message.pixels[0]),))

    def _add_rare(self, message: Message, header: Header, log_ns: int) -> None:
        seconds = self.seconds(log_ns)
        match message:
            case Scene():
                self.scene = message
                if not self.scenes or self.scenes[-1] != message.name:
                    self.scenes.append(message.name)
                    self.events.add(seconds, "scene", f'scene "{message.name}"')
            case EStop():
                state = "engaged" if message.engaged else "released"
                # Ignore an unchanged e-stop, which is published again for late subscribers.
                if self.estop.add(self.fine.index(log_ns), log_ns, state) or (
                    message.engaged and "estop" not in self.events.counts
                ):
                    text = f"e-stop {state} by {header.writer}: {message.reason}"
                    self.events.add(seconds, "estop", text)
            case Bookmark():
                self.events.add(seconds, "bookmark", message.label)
            case HostStatus():
                self.hosts[message.host] = message
                self.loads.setdefault(message.host, HostLoad()).update(message)
                for node in message.nodes:
                    key = f"{message.run} {node.name}"
                    if node.restarts > self._restarts.get(key, 0):
                        why = "it hung" if node.hangs else "its process ended"
                        text = f"{node.name} was restarted on {message.host}: {why}"
                        self.events.add(seconds, "restart", text)
                    self._restarts[key] = node.restarts


def add_correction(label: str, correction: str) -> str:
    """Append the name of the image correction to the label of an image.

    Return the label unchanged if it already contains the name.
    """
    return label if correction in label else ", ".join(filter(None, (label, correction)))


def _list_silence_limits() -> dict[str, float]:
    """Return, for each topic, the maximum permitted time (s) between two messages.

    Only topics with an expected rate and a single writer have a limit.
    """
    return {
        topic.name: max(SILENT_PERIODS / topic.rate_hz[0], MIN_SILENCE_S)
        for topic in TOPICS.values()
        if topic.rate_hz is not None and not topic.many_writers
    }


SILENCE_LIMITS_S = _list_silence_limits()


def read_session(bag: Path, progress: Progress = lambda done_s, whole_s: None) -> Session:
    """Read a complete or incomplete bag, and return a summary.

    Raises BagError if no message can be read.
    """
    reader = BagReader(bag)
    info = reader.info()
    readable = {one.name for one in info.topics if one.readable}
    bookmarks = [
        ((log_ns - info.start_ns) * 1e-9, message.label)
        for _, message, _, log_ns in BagReader(bag, {"bookmark"} & readable)
        if isinstance(message, Bookmark)
    ]
    session = Session(reader, info, bookmarks)
    selected = BagReader(bag, readable)
    for number, (topic, message, header, log_ns) in enumerate(selected):
        session.add(topic, message, header, log_ns)
        if number % 200 == 0:
            progress(session.seconds(log_ns), info.duration_s)
    session.finish()
    return session


def _read_plan(reader: BagReader) -> ResolvedGraph | None:
    try:
        return ResolvedGraph.model_validate_json(reader.attachment("plan.json"))
    except (BagError, ValidationError):
        return None  # from another version of flexsheet; the page reports that the plan is missing


def _read_json(reader: BagReader, name: str) -> dict[str, Any]:
    try:
        found = json.loads(reader.attachment(name))
    except (BagError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}
