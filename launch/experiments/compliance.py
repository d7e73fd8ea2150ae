"""Compare the force that the simulated sheet presents with that of the soft body.

The finger pushes at a few positions and rests at several depths; then it moves in and out without
a stop.  At each evaluated instant, the simulator's membrane between the true edges, under the true
fingertip, gives the presented force.  The desired force is that of the published force curve at the
finger's true depth.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator

from flexsheet.launch.experiments import ExperimentError
from flexsheet.launch.experiments.driver import Driver
from flexsheet.launch.experiments.run import Procedure, Progress
from flexsheet.launch.experiments.stroke import SampledMotion, make_motion
from flexsheet.messages.apparatus import Apparatus
from flexsheet.messages.bag import BagReader
from flexsheet.messages.scene import Pose, Scene
from flexsheet.messages.types import FingerPath, SoftBody, TwinArms, TwinFinger
from flexsheet.nodes.models.rigid import transform_from_rpy
from flexsheet.nodes.planner.compliance import (
    FORCE_JND_FLOOR_N,
    TARGET_ERROR_RATIO,
    WEBER_RATIO,
    WEBER_RATIO_BARE,
)
from flexsheet.nodes.twin.membrane import solve
from flexsheet.nodes.twin.paths import map_to_surface
from flexsheet.nodes.twin.sheet_pull import true_rubber
from flexsheet.nodes.twin.truth import apply_apparatus

Floats = NDArray[np.float64]
Times = NDArray[np.int64]

POSITIONS_M = ((0.0, 0.0), (0.025, 0.0), (0.0, 0.02))
"""Along the object, and around it from its front, m."""

DEPTH_RATIOS = (0.04, 0.1, 0.2, 0.4, 0.7, 1.0)
"""Depths at which the finger rests, over the scene's push depth."""

HOVER_M = 0.03
APPROACH_S = 1.2
PUSH_M_PER_S = 0.05
HOLD_S, EVALUATED_S = 1.0, 0.3
"""Time at each depth, and its last part, in which the force is evaluated."""

HELD_SAMPLES = 3
MOVING_STEP_S = 0.06


@dataclass(frozen=True, slots=True)
class Hold:
    """Hold an evaluated interval at a depth, in the path's time (s)."""

    depth_m: float
    begin_s: float
    end_s: float


@dataclass(frozen=True, slots=True)
class Press:
    """Hold one path of the finger with its intervals at rest; empty for the moving press.

    place: name of the pushed position.  surface, normal: (3,) of the undeformed object there, in
    the world.
    """

    path: FingerPath
    place: str
    surface: Floats
    normal: Floats
    holds: tuple[Hold, ...]


def make_presses(scene: Scene) -> list[Press]:
    """Make all paths of the experiment."""
    depths = scene.working_range.push_depth_m * np.array(DEPTH_RATIOS)
    held = [_make_held_press(scene, along, around, depths) for along, around in POSITIONS_M]
    return [*held, _make_moving_press(scene, float(depths[-1]))]


def _make_held_press(scene: Scene, along_m: float, around_m: float, depths: Floats) -> Press:
    times, heights, holds = [0.0, APPROACH_S], [HOVER_M, 0.0], []
    for depth in depths:
        begin_s = times[-1] + (depth + heights[-1]) / PUSH_M_PER_S
        times += [begin_s, begin_s + HOLD_S]
        heights += [-depth, -depth]
        holds.append(Hold(float(depth), begin_s + HOLD_S - EVALUATED_S, begin_s + HOLD_S))
    times.append(times[-1] + (HOVER_M - heights[-1]) / PUSH_M_PER_S)
    heights.append(HOVER_M)
    place = f"at {1e3 * along_m:g}, {1e3 * around_m:g} mm"
    way = np.column_stack([times, heights])
    return _make_press(scene, place, (along_m, around_m), way, tuple(holds))


def _make_moving_press(scene: Scene, deepest_m: float) -> Press:
    way_s = deepest_m / PUSH_M_PER_S
    times = np.cumsum([0.0, APPROACH_S, way_s, way_s, APPROACH_S])
    heights = [HOVER_M, 0.0, -deepest_m, 0.0, HOVER_M]
    return _make_press(scene, "in and out", POSITIONS_M[0], np.column_stack([times, heights]), ())


def _make_press(
    scene: Scene, place: str, place_m: tuple[float, float], way: Floats, holds: tuple[Hold, ...]
) -> Press:
    """Make a press; way: times (s) and heights above the surface (m), (n, 2)."""
    surface, above = map_to_surface(scene, np.array([[*place_m, 0.0], [*place_m, HOVER_M]]))
    normal = (above - surface) / HOVER_M
    path = FingerPath(
        label=f"press {place}" if holds else place,
        times_s=np.ascontiguousarray(way[:, 0]),
        positions_world_m=surface + np.outer(way[:, 1], normal),
        wander_m=0.0,
        tremor_m=0.0,
    )
    return Press(path, place, surface, normal, holds)


def compliance_procedure(progress: Progress) -> Procedure:
    """Make a procedure that pushes at each position, then in and out."""

    async def procedure(driver: Driver, scene: Scene) -> None:
        for press in make_presses(scene):
            progress(press.path.label)
            await driver.follow(press.path)

    return procedure


@dataclass(frozen=True, slots=True)
class ComplianceRecording:
    """Hold a bag's data for the evaluation.

    windows_ns: (begin, end) of each path, by label.  edges: rows (16,), poses of the clamped edges.
    curves: the object's force over depth, (m, 2) each, at `curve_times_ns`.
    """

    scene: Scene
    finger: SampledMotion
    windows_ns: dict[str, tuple[int, int]]
    edges: tuple[SampledMotion, SampledMotion]
    curve_times_ns: list[int]
    curves: list[Floats]
    apparatus: Apparatus | None = None


def read_bag(bag: Path) -> ComplianceRecording:
    """Read the data from a bag; ExperimentError if it lacks scene or force curve."""
    scene: Scene | None = None
    apparatus: Apparatus | None = None
    finger: list[tuple[int, Floats]] = []
    windows: dict[str, tuple[int, int]] = {}
    flanges: tuple[list[tuple[int, Floats]], list[tuple[int, Floats]]] = ([], [])
    curves: list[tuple[int, Floats]] = []
    topics = ["scene", "twin/apparatus", "twin/finger", "twin/arms", "soft_body"]
    for _, message, header, _ in BagReader(bag, topics=topics):
        match message:
            case Scene():
                scene = message
            case Apparatus():
                apparatus = message
            case TwinFinger():
                finger.append((header.source_ns, message.position_world_m))
                begin_ns = header.source_ns - round(message.path_time_s * 1e9)
                windows[message.path_label] = (begin_ns, header.source_ns)
            case TwinArms():
                flanges[0].append((header.source_ns, message.world_from_flange_left.ravel()))
                flanges[1].append((header.source_ns, message.world_from_flange_right.ravel()))
            case SoftBody() if len(message.force_curve) > 0:
                curves.append((header.source_ns, message.force_curve))
            case _:
                pass
    if scene is None or not curves:
        raise ExperimentError(f"{bag}: has no scene or no force curve of a soft body; record both")
    curves.sort(key=lambda entry: entry[0])
    return ComplianceRecording(
        scene=scene,
        apparatus=apparatus,
        finger=make_motion(finger, "twin/finger"),
        windows_ns=windows,
        edges=(make_motion(flanges[0], "twin/arms"), make_motion(flanges[1], "twin/arms")),
        curve_times_ns=[time for time, _ in curves],
        curves=[curve for _, curve in curves],
    )


@dataclass(frozen=True, slots=True)
class PresentedForce:
    """Hold one instant: finger depth, desired and presented force, and the sheet's depth."""

    depth_m: float
    wanted_n: float
    presented_n: float
    normal_offset_m: float

    @property
    def error_ratio(self) -> float:
        """Return the relative error; desired forces below the JND floor count as that floor."""
        return (self.presented_n - self.wanted_n) / max(self.wanted_n, FORCE_JND_FLOOR_N)


class ForceReference:
    """Compute presented forces at instants of a recording by the simulator's membrane."""

    def __init__(self, recorded: ComplianceRecording) -> None:
        scene = apply_apparatus(recorded.scene, recorded.apparatus)
        self._recorded, self._radius_m = recorded, scene.finger.radius_m
        self._clamps = (
            _transform(scene.arms.left.flange_from_edge),
            _transform(scene.arms.right.flange_from_edge),
        )
        self._rubber = true_rubber(scene.sheet, recorded.apparatus)

    def evaluate(self, at_ns: int, press: Press) -> PresentedForce:
        """Return the forces at an instant; depths count from the pressed position."""
        recorded, times = self._recorded, np.array([at_ns])
        tip = recorded.finger.at(times)[0]
        depth_m = float((press.surface - tip) @ press.normal)
        left, right = (
            edges.at(times)[0].reshape(4, 4) @ clamp
            for edges, clamp in zip(recorded.edges, self._clamps, strict=True)
        )
        pressed = solve(
            self._rubber,
            left,
            right,
            finger_tip=tip,
            finger_radius_m=self._radius_m,
        )
        middle = 0.5 * (left[:3, 3] + right[:3, 3])
        return PresentedForce(
            depth_m=depth_m,
            wanted_n=self._wanted_n(at_ns, depth_m),
            presented_n=float(pressed.finger_force_n @ press.normal),
            normal_offset_m=float((press.surface - middle) @ press.normal),
        )

    def _wanted_n(self, at_ns: int, depth_m: float) -> float:
        number = max(0, bisect_right(self._recorded.curve_times_ns, at_ns) - 1)
        rows = self._recorded.curves[number]
        curve = PchipInterpolator(rows[:, 0], rows[:, 1])
        return float(curve(np.clip(depth_m, 0.0, rows[-1, 0])))


def _transform(pose: Pose) -> Floats:
    return transform_from_rpy(pose.position_m, pose.rpy_rad)


def compliance_result(bag: Path, progress: Progress) -> dict[str, Any]:
    """Return the figures of `experiment compliance --json` in mm, N and %."""
    recorded = read_bag(bag)
    reference = ForceReference(recorded)
    held: list[dict[str, Any]] = []
    moving: list[PresentedForce] = []
    for press in make_presses(recorded.scene):
        label = press.path.label
        if label not in recorded.windows_ns:
            have = ", ".join(recorded.windows_ns) or "none"
            raise ExperimentError(f'the bag has no finger path "{label}"; it has: {have}')
        progress(f"evaluating: {label}")
        begin_ns, end_ns = recorded.windows_ns[label]
        for hold in press.holds:
            times = begin_ns + (np.linspace(hold.begin_s, hold.end_s, HELD_SAMPLES) * 1e9)
            held.append(_row(press, hold, [reference.evaluate(int(at), press) for at in times]))
        if not press.holds:
            moving = list(_evaluate_moving(reference, press, begin_ns, end_ns))
    errors = np.array([row["error_percent"] for row in held])
    errors_moving = 100.0 * np.array([one.error_ratio for one in moving])
    return {
        "rows": held,
        "worst_percent": float(np.abs(errors).max()),
        "aimed_percent": 100.0 * TARGET_ERROR_RATIO,
        "noticed_percent": [100.0 * WEBER_RATIO, 100.0 * WEBER_RATIO_BARE],
        "moving": {
            "speed_mm_per_s": 1e3 * PUSH_M_PER_S,
            "rows": [
                {
                    "depth_mm": 1e3 * one.depth_m,
                    "wanted_n": one.wanted_n,
                    "presented_n": one.presented_n,
                }
                for one in moving
            ],
            "rms_percent": float(np.sqrt(np.mean(errors_moving**2))),
            "worst_percent": float(np.abs(errors_moving).max()),
        },
        "apparatus": "nominal" if recorded.apparatus is None else recorded.apparatus.origin,
        "bag": str(bag),
    }


def _evaluate_moving(
    reference: ForceReference, press: Press, begin_ns: int, end_ns: int
) -> Iterator[PresentedForce]:
    for at_ns in range(begin_ns, end_ns, round(MOVING_STEP_S * 1e9)):
        felt = reference.evaluate(at_ns, press)
        if max(felt.wanted_n, felt.presented_n) >= FORCE_JND_FLOOR_N:
            yield felt


def _row(press: Press, hold: Hold, felt: Sequence[PresentedForce]) -> dict[str, Any]:
    return {
        "place": press.place,
        "depth_mm": 1e3 * hold.depth_m,
        "wanted_n": float(np.mean([one.wanted_n for one in felt])),
        "presented_n": float(np.mean([one.presented_n for one in felt])),
        "error_percent": 100.0 * float(np.mean([one.error_ratio for one in felt])),
        "retreat_mm": 1e3 * float(np.mean([one.normal_offset_m for one in felt])),
    }
