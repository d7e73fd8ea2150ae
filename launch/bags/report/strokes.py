"""The paper's errors (its Fig. 9) at every exposure at which the sheet touches, a block at a time.

The definitions are those of `launch.experiments.stroke`; here they are applied to any session of a
cylinder, in memory that does not grow with it.  Where the planner lets the sheet yield, it is
judged by how far it was to; in the experiment's own strokes by the surface, as the paper does.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from launch.bags.report.series import Grid, Moments, Range
from launch.experiments.stroke import (
    Track,
    edge_row,
    sheet_errors,
    stroke_label,
    stroke_window_s,
    track,
)
from messages.scene import ArmSpec, Cylinder, Scene
from messages.types import ArmState, Fingertip, SheetTarget, TwinArms, TwinFinger
from nodes.models.rigid import transform_from_rpy

Floats = NDArray[np.float64]

BLOCK = 2000
"""Samples of the finger that are worked out together."""

SAME_RUN_NS = 1_000_000_000


@dataclass(slots=True)
class Stroke:
    """One stroke of the experiment: when (ns), and its sums, measured and true."""

    seconds: float
    zero_ns: int
    end_ns: int
    sums: dict[str, Moments] = field(default_factory=dict)

    @property
    def window_ns(self) -> tuple[int, int]:
        """As `stroke_span_ns` has it."""
        begin_s, finish_s = stroke_window_s(self.seconds)
        finish_ns = self.zero_ns + round(finish_s * 1e9)
        return self.zero_ns + round(begin_s * 1e9), min(finish_ns, self.end_ns)


class Side:
    """What a finger and both edges did lately, until the errors are worked out."""

    def __init__(self) -> None:
        self.finger: list[tuple[int, Floats]] = []
        self.edges: tuple[list[tuple[int, Floats]], ...] = ([], [])

    def ripe(self) -> tuple[Track, tuple[Track, Track], NDArray[np.int64]] | None:
        """Tracks, and the times at which everything is known; what is not, stays for later."""
        if len(self.finger) < 2 or min(map(len, self.edges)) < 2:
            return None
        finger = track(self.finger, "finger")
        left, right = (track(edge, "edge") for edge in self.edges)
        until_ns = min(left.times_ns[-1], right.times_ns[-1])
        self.finger = [sample for sample in self.finger if sample[0] > until_ns]
        for edge in self.edges:
            before = [i for i, (at_ns, _) in enumerate(edge) if at_ns <= until_ns]
            del edge[: before[-1] if before else 0]
        inside = left.covers(finger.times_ns) & right.covers(finger.times_ns)
        return finger, (left, right), finger.times_ns[inside]


class SheetErrors:
    """Takes messages in order; `finish` at the end."""

    def __init__(self, grid: Grid) -> None:
        self._grid = grid
        self._scene: Scene | None = None
        self._edge_poses: dict[str, Floats] = {}
        self.measured, self.true = Side(), Side()
        self._contact: list[tuple[int, Floats]] = []
        self.distance = {"measured": Range(grid), "true": Range(grid)}
        self.angle = {"measured": Range(grid), "true": Range(grid)}
        self.contact = {name: Moments() for name in ("d", "theta", "true_d", "true_theta")}
        self.strokes: list[Stroke] = []

    @property
    def shape(self) -> str | None:
        """Of the object, as far as one is known."""
        return None if self._scene is None else self._scene.object.geometry.shape

    def take(self, message: Any, source_ns: int) -> None:
        """Heed a message; all stamps are of one clock."""
        match message:
            case Scene():
                self.finish()
                self._scene = message
                arms = message.arms
                self._edge_poses = {"left": _edge(arms.left), "right": _edge(arms.right)}
                self.measured, self.true, self._contact = Side(), Side(), []
            case SheetTarget():
                touches = float(message.phase == "contact")
                self._contact.append((source_ns, np.array([touches, message.retreat_m])))
            case Fingertip() if message.valid:
                self.measured.finger.append((source_ns, message.position_world_m))
            case TwinFinger():
                self.true.finger.append((source_ns, message.position_world_m))
                self._follow_stroke(message, source_ns)
            case ArmState():
                self._take_edge(self.measured, message.side, message.world_from_flange, source_ns)
            case TwinArms():
                self._take_edge(self.true, "left", message.world_from_flange_left, source_ns)
                self._take_edge(self.true, "right", message.world_from_flange_right, source_ns)
        if max(len(self.measured.finger), len(self.true.finger)) >= BLOCK:
            self.finish()

    def _take_edge(self, side: Side, name: str, flange: Floats, source_ns: int) -> None:
        if self._scene is not None:
            row = edge_row(flange, self._edge_poses[name])
            side.edges[name == "right"].append((source_ns, row))

    def _follow_stroke(self, finger: TwinFinger, source_ns: int) -> None:
        seconds = seconds_of(finger.path_label)
        if seconds is None:
            return
        zero_ns = source_ns - round(finger.path_time_s * 1e9)
        last = self.strokes[-1] if self.strokes else None
        if last is None or last.seconds != seconds or abs(last.zero_ns - zero_ns) > SAME_RUN_NS:
            last = Stroke(seconds, zero_ns, source_ns)
            self.strokes.append(last)
        last.zero_ns, last.end_ns = zero_ns, source_ns

    def finish(self) -> None:
        """Work out what is ripe."""
        scene = self._scene
        if scene is None or not isinstance(scene.object.geometry, Cylinder):
            self.measured, self.true, self._contact = Side(), Side(), []
            return
        for name, side in (("measured", self.measured), ("true", self.true)):
            ripe = side.ripe()
            if ripe is None:
                # Without edges nothing ever gets ripe.
                del side.finger[:-BLOCK]
                continue
            finger, edges, times_ns = ripe
            if len(times_ns):
                self._add_strokes(name, times_ns, *sheet_errors(scene, finger, edges, times_ns))
                touched_ns, retreat_m = self._touched(times_ns)
                if len(touched_ns):
                    found = sheet_errors(scene, finger, edges, touched_ns, retreat_m)
                    self._add(name, touched_ns, *found)
        for edges_of in (*self.measured.edges, *self.true.edges):
            del edges_of[: -10 * BLOCK]
        del self._contact[: -2 * BLOCK]

    def _add(self, name: str, times_ns: NDArray[np.int64], d: Floats, theta: Floats) -> None:
        prefix = "true_" if name == "true" else ""
        self.contact[f"{prefix}d"].take(d)
        self.contact[f"{prefix}theta"].take(theta)
        for at_ns, one_d, one_theta in zip(
            times_ns.tolist(), d.tolist(), theta.tolist(), strict=True
        ):
            index = self._grid.index(at_ns)
            self.distance[name].take(index, one_d)
            self.angle[name].take(index, one_theta)

    def _add_strokes(
        self, name: str, times_ns: NDArray[np.int64], d: Floats, theta: Floats
    ) -> None:
        prefix = "true_" if name == "true" else ""
        for stroke in self.strokes:
            begin_ns, finish_ns = stroke.window_ns
            inside = (times_ns >= begin_ns) & (times_ns <= finish_ns)
            if inside.any():
                stroke.sums.setdefault(f"{prefix}delta_d", Moments()).take(d[inside])
                stroke.sums.setdefault(f"{prefix}delta_theta", Moments()).take(theta[inside])

    def _touched(self, times_ns: NDArray[np.int64]) -> tuple[NDArray[np.int64], Floats]:
        """Those of the times at which the sheet was in contact, and how far it was to yield."""
        if len(self._contact) < 2:
            return times_ns[:0], np.empty(0)
        contact = track(self._contact, "sheet_target")
        touches, retreat_m = contact.at(times_ns).T
        inside = (touches > 0.999) & contact.covers(times_ns)
        return times_ns[inside], retreat_m[inside]


def seconds_of(label: str) -> float | None:
    """How long the stroke of that label takes; None for a path that is none."""
    _, _, rest = label.partition("stroke ")
    try:
        seconds = float(rest.removesuffix(" s"))
    except ValueError:
        return None
    return seconds if stroke_label(seconds) == label else None


def _edge(arm: ArmSpec) -> Floats:
    pose = arm.flange_from_edge
    return transform_from_rpy(pose.position_m, pose.rpy_rad)
