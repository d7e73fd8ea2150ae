"""Read the bags of a test with several computers: true joints, states, targets and missing
messages.

All computers share one clock.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flexsheet.messages.bag import BagReader
from flexsheet.messages.base import Header, Message
from flexsheet.messages.scene import Scene
from flexsheet.messages.types import ArmState, SheetTarget, TwinArms
from flexsheet.nodes.models.rigid import transform_from_rpy
from tests.rv_1a import (
    RANGE_RAD,
    SPEED_RAD_PER_S,
)

Floats = NDArray[np.float64]
Times = NDArray[np.int64]
Span = tuple[int, int]
"""Start and end, ns."""

SILENT_NS = 100_000_000
"""Maximum age of a state of a bridge that counts as following."""
SPEED_OVER_S = 0.05
"""Interval over which commands are compared, since a busy computer stamps single ones late."""
MOMENT_NS = 10_000_000


@dataclass(frozen=True, slots=True)
class Arm:
    """The recorded data of one arm.

    times_ns (n,), joints_rad (n, 6), edges_world_m (n, 3): true values of the simulator, with its
        epochs (n,).
    said_ns (m,), modes (m,): states that the bridge published.
    sent_ns (m,), commanded_rad (m, 6): last command to the arm.
    """

    times_ns: Times
    joints_rad: Floats
    edges_world_m: Floats
    epochs: Times
    said_ns: Times
    modes: NDArray[np.str_]
    sent_ns: Times
    commanded_rad: Floats

    def between(self, span: Span) -> Floats:
        """Return the true joints (k, 6) in a time span."""
        return self.joints_rad[(self.times_ns >= span[0]) & (self.times_ns <= span[1])]

    def turned_rad(self, span: Span) -> float:
        """Return the maximum rotation (rad) of a joint in a time span; 0 without recorded true
        angles.
        """
        joints = self.between(span)
        return float(np.ptp(joints, axis=0).max()) if len(joints) else 0.0

    def spans(self, mode: str) -> list[Span]:
        """Return the time spans in which an arm has a mode, without periods without messages."""
        spans = []
        begin: int | None = None
        for i, (at_ns, printed) in enumerate(zip(self.said_ns, self.modes, strict=True)):
            silent = i > 0 and at_ns - self.said_ns[i - 1] > SILENT_NS
            if begin is not None and (printed != mode or silent):
                spans.append((begin, int(self.said_ns[i - 1])))
                begin = None
            if begin is None and printed == mode:
                begin = int(at_ns)
        return spans if begin is None else [*spans, (begin, int(self.said_ns[-1]))]

    def follows(self, times_ns: Times) -> NDArray[np.bool_]:
        """Return whether the bridge has reported the mode `follow` within SILENT_NS."""
        newest = np.searchsorted(self.said_ns, times_ns, side="right") - 1
        fresh = (newest >= 0) & (times_ns - self.said_ns[newest] <= SILENT_NS)
        return np.asarray(fresh & (self.modes[newest] == "follow"), dtype=np.bool_)

    def knows(self, times_ns: Times) -> NDArray[np.bool_]:
        """Return whether true angles are recorded just before and just after given times."""
        after = np.searchsorted(self.times_ns, times_ns)
        inside = (after > 0) & (after < len(self.times_ns))
        after = after.clip(1, len(self.times_ns) - 1)
        near = self.times_ns[after] - self.times_ns[after - 1] <= SILENT_NS
        return np.asarray(inside & near, dtype=np.bool_)

    def edge_at(self, times_ns: Times) -> Floats:
        """Return the centres (k, 3), m, of the arm's edge of the sheet."""
        zero = self.times_ns[0]
        x, xp = (times_ns - zero).astype(np.float64), (self.times_ns - zero).astype(np.float64)
        return np.column_stack([np.interp(x, xp, column) for column in self.edges_world_m.T])

    def fastest(self) -> float:
        """Return the maximum ratio of the speed to the specified speed, for true joints and for
        commands.

        Motions during a restart of the simulator are excluded.
        """
        steps_s = np.diff(self.times_ns) * 1e-9
        same = (np.diff(self.epochs) == 0) & (steps_s > 0)
        true = (
            np.abs(np.diff(self.joints_rad, axis=0))[same] / np.maximum(steps_s, 2e-3)[same, None]
        )
        return float(max((true / SPEED_RAD_PER_S).max(initial=0.0), self._fastest_command()))

    def _fastest_command(self) -> float:
        following = self.modes == "follow"
        sent, commanded = self.sent_ns[following], self.commanded_rad[following]
        later = np.searchsorted(sent, sent + round(SPEED_OVER_S * 1e9))
        there = later < len(sent)
        here = np.flatnonzero(there)
        steps_s = (sent[later[there]] - sent[here]) * 1e-9
        speeds = np.abs(commanded[later[there]] - commanded[here]) / steps_s[:, None]
        # Across a time without commands the arm may have been restarted elsewhere.
        return float((speeds[steps_s < 2 * SPEED_OVER_S] / SPEED_RAD_PER_S).max(initial=0.0))

    def leaves_range(self) -> bool:
        """Return whether a joint was outside its range at any time."""
        low, high = RANGE_RAD.T
        return bool(((self.joints_rad < low) | (self.joints_rad > high)).any())


def bags(folder: Path, host: str) -> list[Path]:
    """Return the bags of a host, in the order of creation."""
    return sorted(folder.glob(f"{host}*.mcap"), key=lambda bag: bag.stat().st_mtime_ns)


def _all(folder: Path, host: str, *topics: str) -> Iterator[tuple[str, Message, Header]]:
    for bag in bags(folder, host):
        for topic, message, header, _ in BagReader(bag, topics or None):
            yield topic, message, header


def read_arm(
    folder: Path, side: str, scene: Scene, *, host: str | None = None, truth: str | None = None
) -> Arm:
    """Read the data of an arm from bags.

    host: host that recorded the bags; None: the host of the arm.
    truth: topic of the true joint angles; None: the topic of the arm's own simulator.
    """
    mount = (scene.arms.left if side == "left" else scene.arms.right).flange_from_edge
    flange_from_edge = transform_from_rpy(mount.position_m, mount.rpy_rad)
    true: list[tuple[int, Floats, Floats, int]] = []
    printed: list[tuple[int, str, int, Floats]] = []
    for _, message, header in _all(
        folder, host or side, f"arm_{side}", truth or f"twin/arms_{side}"
    ):
        match message:
            case TwinArms():
                joints, flange = (
                    (message.joints_left_rad, message.world_from_flange_left)
                    if side == "left"
                    else (message.joints_right_rad, message.world_from_flange_right)
                )
                edge = (flange @ flange_from_edge)[:3, 3]
                true.append((header.source_ns, joints, edge, header.epoch))
            case ArmState():
                one = (message.mode, message.command_sent_ns, message.joints_commanded_rad)
                printed.append((header.publish_ns, *one))
    return Arm(
        np.array([row[0] for row in true], dtype=np.int64),
        np.array([row[1] for row in true]).reshape(-1, 6),
        np.array([row[2] for row in true]).reshape(-1, 3),
        np.array([row[3] for row in true], dtype=np.int64),
        np.array([row[0] for row in printed], dtype=np.int64),
        np.array([row[1] for row in printed], dtype=np.str_),
        np.array([row[2] for row in printed], dtype=np.int64),
        np.array([row[3] for row in printed]).reshape(-1, 6),
    )


def wanted(folder: Path) -> tuple[Times, Floats]:
    """Return the times (n,) and positions (n, 3), m, of the sheet targets in the bags of the host
    `main`.
    """
    found = [
        (message.valid_at_ns, message.world_from_sheet[:3, 3])
        for _, message, _ in _all(folder, "main", "sheet_target")
        if isinstance(message, SheetTarget)
    ]
    times = np.array([at for at, _ in found], dtype=np.int64)
    return times, np.array([centre for _, centre in found]).reshape(-1, 3)


@dataclass(frozen=True, slots=True)
class SheetHold:
    """The errors of the sheet's position in a time span.

    errors_m (k,): distance between the true sheet centre and each target.
    followed: fraction of the time in which both arms followed.
    """

    errors_m: Floats
    followed: float

    def quantile_mm(self, share: float) -> float | None:
        return 1e3 * float(np.quantile(self.errors_m, share)) if len(self.errors_m) else None


def measure_hold(arms: tuple[Arm, Arm], targets: tuple[Times, Floats], span: Span) -> SheetHold:
    """Compute the errors of the sheet's position in a time span."""
    left, right = arms
    times, centres = targets
    keep = (times >= span[0]) & (times <= span[1]) & left.knows(times) & right.knows(times)
    middle = 0.5 * (left.edge_at(times[keep]) + right.edge_at(times[keep]))
    moments = np.arange(span[0], span[1], MOMENT_NS, dtype=np.int64)
    followed = left.follows(moments) & right.follows(moments)
    return SheetHold(
        np.asarray(np.linalg.norm(middle - centres[keep], axis=1)),
        float(followed.mean()) if len(followed) else 0.0,
    )


@dataclass(frozen=True, slots=True, order=True)
class Gap:
    """A gap in the messages of one writer, found by sequence numbers.

    from_ns, to_ns: publication of the last message before the gap, and of the first message after
        it.
    """

    seconds: float
    topic: str
    writer: str
    from_ns: int
    to_ns: int


def gaps(folder: Path) -> list[Gap]:
    """Find the gaps. A restart of a killed writer does not count."""
    last: dict[tuple[str, str, str, int], Header] = {}
    found = []
    for topic, _, header in _all(folder, "main"):
        key = (topic, header.writer, header.clock_id, header.epoch)
        before, last[key] = last.get(key), header
        if before is not None and header.sequence > before.sequence + 1:
            seconds = (header.publish_ns - before.publish_ns) * 1e-9
            found.append(Gap(seconds, topic, header.writer, before.publish_ns, header.publish_ns))
    return found
