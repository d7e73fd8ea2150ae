"""Compute the sheet errors of Furukawa et al. 2007 (Fig. 9) at every exposure during contact.

The errors are defined in `launch.experiments.stroke`. They are computed in blocks, so the required
memory does not depend on the duration of the bag. If the planner lowers the sheet to render
compliance, the errors are relative to the object's surface lowered by the commanded
`normal_offset_m`. For strokes of the finger in an experiment, the errors are relative to the
surface itself, as in the paper.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from flexsheet.launch.bags.report.followed import FollowedFinger
from flexsheet.launch.bags.report.series import Grid, Maxima, RunningMoments
from flexsheet.launch.experiments.stroke import (
    SampledMotion,
    make_edge_row,
    make_motion,
    object_pose,
    sheet_errors,
    stroke_window_s,
)
from flexsheet.messages.apparatus import Apparatus
from flexsheet.messages.bag import BagReader
from flexsheet.messages.scene import ArmSpec, Scene
from flexsheet.messages.types import ArmState, Fingertip, SheetTarget, TwinArms, TwinFinger
from flexsheet.nodes.arrays import Bools, Floats, Ints
from flexsheet.nodes.models.rigid import apply, inverse, pose_matrix
from flexsheet.nodes.models.shapes import Shape, make_shape
from flexsheet.nodes.twin.sheet_surface import SheetSurface
from flexsheet.nodes.twin.truth import apply_apparatus

BLOCK = 2000
"""The number of finger samples for which errors are computed together."""

TOPICS_READ = (
    "scene",
    "twin/apparatus",
    "sheet_target",
    "twin/finger",
    "arm_left",
    "arm_right",
    "twin/arms",
)
"""The topics from which errors relative to the true finger are computed.

In a bag of the simulator, the timestamps of these topics are on one clock.
"""

SAME_RUN_NS = 1_000_000_000

SILENT_NS = 100_000_000
"""The maximum age (ns) of the last state of an arm that follows the finger.

If the last state is older, the arm does not count as following the finger.
"""


@dataclass(slots=True)
class FingerRun:
    """A motion of the simulated finger along a path.

    zero_ns: start time of the path.
    done_ns: time of the last camera exposure during the motion.
    end_ns: time of the last exposure before the finger gets another path. The finger rests at the
        end of the path from `done_ns` to `end_ns`.
    stroke_s: duration of the finger's stroke; None if the path is not a stroke of an experiment.
    sums: statistics of the sheet's errors during the stroke, relative to the measured finger and to
        the true finger.
    """

    label: str
    zero_ns: int
    done_ns: int
    end_ns: int
    stroke_s: float | None
    sums: dict[str, RunningMoments] = field(default_factory=dict)
    followed: FollowedFinger = field(default_factory=FollowedFinger)

    @property
    def stroke_window_ns(self) -> tuple[int, int]:
        """Return the start and the end time (ns) of the stroke of the finger.

        If the path is not a stroke of an experiment, both times are equal.
        """
        if self.stroke_s is None:
            return self.zero_ns, self.zero_ns
        begin_s, finish_s = stroke_window_s(self.stroke_s)
        finish_ns = self.zero_ns + round(finish_s * 1e9)
        return self.zero_ns + round(begin_s * 1e9), min(finish_ns, self.end_ns)

    def figures(self) -> dict[str, Any]:
        """Return the label and duration of the finger path, and the sheet's errors along it."""
        seconds = (self.done_ns - self.zero_ns) * 1e-9
        return {"path": self.label, "seconds": seconds, **self.followed.figures()}


class MotionBuffer:
    """A buffer for positions of a finger and poses of both sheet edges.

    The positions remain in the buffer until the edges are known at the same times.
    """

    def __init__(self) -> None:
        self.finger: list[tuple[int, Floats]] = []
        self.edges: tuple[list[tuple[int, Floats]], ...] = ([], [])

    def pop_complete(
        self,
    ) -> tuple[SampledMotion, tuple[SampledMotion, SampledMotion], Ints] | None:
        """Remove and return the samples that are complete.

        Return the motion of the finger, the motions of both edges, and the times (ns) of the finger
        samples at which both edges are known. Later samples remain in the buffer. Return None if
        there are too few samples.
        """
        if len(self.finger) < 2 or min(map(len, self.edges)) < 2:
            return None
        finger = make_motion(self.finger, "finger")
        left, right = (make_motion(edge, "edge") for edge in self.edges)
        until_ns = min(left.times_ns[-1], right.times_ns[-1])
        self.finger = [sample for sample in self.finger if sample[0] > until_ns]
        for edge in self.edges:
            before = [i for i, (at_ns, _) in enumerate(edge) if at_ns <= until_ns]
            del edge[: before[-1] if before else 0]
        inside = left.covers(finger.times_ns) & right.covers(finger.times_ns)
        return finger, (left, right), finger.times_ns[inside]


class SheetErrors:
    """An accumulator of sheet errors.

    Messages must be added in order. The method `finish` must be called after the last message.
    """

    def __init__(self, grid: Grid) -> None:
        self._grid = grid
        self._scene: Scene | None = None
        self._shape: Shape | None = None
        self._apparatus: Apparatus | None = None
        self._surfaces: dict[str, SheetSurface] = {}
        self._edge_poses: dict[str, Floats] = {}
        self._true_edge_poses: dict[str, Floats] = {}
        self.measured, self.true = MotionBuffer(), MotionBuffer()
        self._contact: list[tuple[int, Floats]] = []
        self._following: list[tuple[int, Floats]] = []
        self._arms: dict[str, tuple[int, bool]] = {}
        self._target_holds = True
        self.distance = {"measured": Maxima(grid), "true": Maxima(grid)}
        self.angle = {"measured": Maxima(grid), "true": Maxima(grid)}
        self.contact = {name: RunningMoments() for name in ("d", "theta", "true_d", "true_theta")}
        self.runs: list[FingerRun] = []

    def add(self, message: Any, source_ns: int) -> None:
        """Process a message of the bag. All source timestamps must be on one clock."""
        match message:
            case Scene():
                self.finish()
                self._scene, self._shape = message, make_shape(dict(message.object.geometry))
                arms = message.arms
                self._edge_poses = {"left": _edge(arms.left), "right": _edge(arms.right)}
                self._set_true_edges()
                self.measured, self.true = MotionBuffer(), MotionBuffer()
                self._contact, self._following = [], []
            case Apparatus():
                self._apparatus = message
                self._set_true_edges()
            case SheetTarget():
                touches = float(message.phase == "contact")
                self._contact.append(
                    (message.valid_at_ns, np.array([touches, message.normal_offset_m]))
                )
                self._target_holds = message.phase in ("hold", "wait")
            case Fingertip() if message.valid:
                self.measured.finger.append((source_ns, message.position_world_m))
            case TwinFinger():
                self.true.finger.append((source_ns, message.position_world_m))
                self._following.append((source_ns, np.array([self._is_following(source_ns)])))
                self._add_run(message, source_ns)
            case ArmState():
                self._arms[message.side] = source_ns, message.mode == "follow"
                self._add_edge(self.measured, message.side, message.world_from_flange, source_ns)
            case TwinArms():
                self._add_edge(self.true, "left", message.world_from_flange_left, source_ns)
                self._add_edge(self.true, "right", message.world_from_flange_right, source_ns)
        if max(len(self.measured.finger), len(self.true.finger)) >= BLOCK:
            self.finish()

    def _set_true_edges(self) -> None:
        if self._scene is not None:
            arms = apply_apparatus(self._scene, self._apparatus).arms
            self._true_edge_poses = {"left": _edge(arms.left), "right": _edge(arms.right)}
            self._surfaces = {
                "measured": SheetSurface.of(self._scene),
                "true": SheetSurface.of(self._scene, self._apparatus),
            }

    def _add_edge(self, side: MotionBuffer, name: str, flange: Floats, source_ns: int) -> None:
        if self._scene is not None:
            poses = self._true_edge_poses if side is self.true else self._edge_poses
            row = make_edge_row(flange, poses[name])
            side.edges[name == "right"].append((source_ns, row))

    def _is_following(self, at_ns: int) -> float:
        """Return 1 if the finger moves the sheet target and both arms follow the target, else 0."""
        arms = [self._arms.get(side) for side in ("left", "right")]
        both = all(arm is not None and arm[1] and at_ns - arm[0] <= SILENT_NS for arm in arms)
        return float(both and not self._target_holds)

    def _add_run(self, finger: TwinFinger, source_ns: int) -> None:
        if not finger.path_label or finger.path_time_s < 0.0:
            return
        zero_ns = source_ns - round(finger.path_time_s * 1e9)
        last = self.runs[-1] if self.runs else None
        if (
            last is None
            or last.label != finger.path_label
            or (abs(last.zero_ns - zero_ns) > SAME_RUN_NS)
        ):
            last = FingerRun(finger.path_label, zero_ns, zero_ns, source_ns, finger.path_stroke_s)
            self.runs.append(last)
        last.zero_ns, last.end_ns = zero_ns, source_ns
        if not finger.path_done:
            last.done_ns = source_ns

    def finish(self) -> None:
        """Compute the errors at all buffered finger samples at which both sheet edges are known."""
        scene, shape = self._scene, self._shape
        if scene is None or shape is None:
            self.measured, self.true = MotionBuffer(), MotionBuffer()
            self._contact, self._following = [], []
            return
        for name, side in (("measured", self.measured), ("true", self.true)):
            complete = side.pop_complete()
            if complete is None:
                # If no edges are recorded, limit the size of the buffer.
                del side.finger[:-BLOCK]
                continue
            finger, edges, times_ns = complete
            if len(times_ns):
                errors = partial(
                    sheet_errors,
                    scene,
                    finger,
                    edges,
                    times_ns,
                    shape=shape,
                    surface=self._surfaces[name],
                )
                if any(run.stroke_s is not None for run in self.runs):
                    found = errors()
                    self._add_strokes(name, times_ns, *found)
                touches, normal_offset_m = self._read_contact(times_ns)
                found = errors(normal_offset_m=normal_offset_m)
                self._add_errors(name, times_ns[touches], found[0][touches], found[1][touches])
                if name == "true":
                    local = apply(inverse(object_pose(scene)), finger.interpolate(times_ns))
                    self._add_followed(times_ns, *found, shape.closest(local).height_m)
        for edges_of in (*self.measured.edges, *self.true.edges):
            del edges_of[: -10 * BLOCK]
        del self._contact[: -2 * BLOCK]
        del self._following[: -2 * BLOCK]

    def _add_errors(self, name: str, times_ns: Ints, d: Floats, theta: Floats) -> None:
        prefix = "true_" if name == "true" else ""
        self.contact[f"{prefix}d"].add(d)
        self.contact[f"{prefix}theta"].add(theta)
        for at_ns, one_d, one_theta in zip(
            times_ns.tolist(), d.tolist(), theta.tolist(), strict=True
        ):
            index = self._grid.index(at_ns)
            self.distance[name].add(index, one_d)
            self.angle[name].add(index, one_theta)

    def _add_strokes(self, name: str, times_ns: Ints, d: Floats, theta: Floats) -> None:
        prefix = "true_" if name == "true" else ""
        for run in self.runs:
            begin_ns, finish_ns = run.stroke_window_ns
            inside = (times_ns >= begin_ns) & (times_ns <= finish_ns)
            if run.stroke_s is not None and inside.any():
                run.sums.setdefault(f"{prefix}delta_d", RunningMoments()).add(d[inside])
                run.sums.setdefault(f"{prefix}delta_theta", RunningMoments()).add(theta[inside])

    def _add_followed(self, times_ns: Ints, d: Floats, theta: Floats, heights: Floats) -> None:
        following = make_motion(self._following, "twin/finger").interpolate(times_ns)[:, 0] > 0.5
        for run in self.runs:
            inside = (times_ns >= run.zero_ns) & (times_ns <= run.done_ns)
            if inside.any():
                run.followed.add(d[inside], theta[inside], heights[inside], following[inside])

    def _read_contact(self, times_ns: Ints) -> tuple[Bools, Floats]:
        """Return contact flags (n,) and normal offsets (n,), in m, of the sheet target at n times.

        Both are zero at times without data.
        """
        if len(self._contact) < 2:
            return np.zeros(len(times_ns), np.bool_), np.zeros(len(times_ns))
        contact = make_motion(self._contact, "sheet_target")
        touches, normal_offset_m = contact.interpolate(times_ns).T
        covered = contact.covers(times_ns)
        return (touches > 0.999) & covered, np.where(covered, normal_offset_m, 0.0)


def read_followed(bag: Path) -> list[dict[str, Any]]:
    """Return the errors of the sheet along each path of the simulated finger in a bag."""
    errors = SheetErrors(Grid(0, 1.0, 1))
    for _, message, header, _ in BagReader(bag, topics=TOPICS_READ):
        errors.add(message, header.source_ns)
    errors.finish()
    return [run.figures() for run in errors.runs if run.followed.exposures]


def _edge(arm: ArmSpec) -> Floats:
    return pose_matrix(arm.flange_from_edge)
