"""What a finger feels of the object: the twin's sheet as the arms held it, against the soft body.

The finger is pushed in at a few places, and held at several depths; then it goes in and out without
a stop.  At each instant that is judged, the twin's membrane between the arms' true edges, pushed in
by the true fingertip, says what force the finger met.  Wanted is the object's force at the finger's
true depth, by the force curve that the soft body published there.
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
from flexsheet.launch.experiments.stroke import Track, track
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
from flexsheet.nodes.twin.membrane import Rubber, solve
from flexsheet.nodes.twin.paths import map_to_surface

Floats = NDArray[np.float64]
Times = NDArray[np.int64]

PLACES_M = ((0.0, 0.0), (0.025, 0.0), (0.0, 0.02))
"""Along the object, and around it from its front."""

PRESS_DEPTH_FRACTIONS = (0.04, 0.1, 0.2, 0.4, 0.7, 1.0)
"""Of the scene's push depth, at which the finger is held."""

HOVER_M = 0.03
APPROACH_S = 1.2
PUSH_M_PER_S = 0.05
HOLD_S, JUDGED_S = 1.0, 0.3
"""How long the finger is held at a depth, and the last part of it, in which the force is judged."""

HELD_SAMPLES = 3
MOVING_STEP_S = 0.06


@dataclass(frozen=True, slots=True)
class Hold:
    """The finger at a depth, from and until a time of its path (s)."""

    depth_m: float
    begin_s: float
    end_s: float


@dataclass(frozen=True, slots=True)
class Press:
    """Hold one path of the finger: a push at a position with the depths at which it pauses.

    place: the position's name. surface, normal: (3,) of the undeformed object there, world frame.
    holds: empty for a path without pauses.
    """

    path: FingerPath
    place: str
    surface: Floats
    normal: Floats
    holds: tuple[Hold, ...]


def presses(scene: Scene) -> list[Press]:
    """All that the finger does."""
    depths = scene.working_range.push_depth_m * np.array(PRESS_DEPTH_FRACTIONS)
    held = [_held(scene, along, around, depths) for along, around in PLACES_M]
    return [*held, _in_and_out(scene, float(depths[-1]))]


def _held(scene: Scene, along_m: float, around_m: float, depths: Floats) -> Press:
    times, heights, holds = [0.0, APPROACH_S], [HOVER_M, 0.0], []
    for depth in depths:
        begin_s = times[-1] + (depth + heights[-1]) / PUSH_M_PER_S
        times += [begin_s, begin_s + HOLD_S]
        heights += [-depth, -depth]
        holds.append(Hold(float(depth), begin_s + HOLD_S - JUDGED_S, begin_s + HOLD_S))
    times.append(times[-1] + (HOVER_M - heights[-1]) / PUSH_M_PER_S)
    heights.append(HOVER_M)
    place = f"at {1e3 * along_m:g}, {1e3 * around_m:g} mm"
    way = np.column_stack([times, heights])
    return _press(scene, place, (along_m, around_m), way, tuple(holds))


def _in_and_out(scene: Scene, deepest_m: float) -> Press:
    way_s = deepest_m / PUSH_M_PER_S
    times = np.cumsum([0.0, APPROACH_S, way_s, way_s, APPROACH_S])
    heights = [HOVER_M, 0.0, -deepest_m, 0.0, HOVER_M]
    return _press(scene, "in and out", PLACES_M[0], np.column_stack([times, heights]), ())


def _press(
    scene: Scene, place: str, place_m: tuple[float, float], way: Floats, holds: tuple[Hold, ...]
) -> Press:
    """Make a press; way: times (s) and heights over the surface (m), (n, 2)."""
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
    """Push at each place; then in and out."""

    async def procedure(driver: Driver, scene: Scene) -> None:
        for press in presses(scene):
            progress(press.path.label)
            await driver.follow(press.path)

    return procedure


@dataclass(frozen=True, slots=True)
class Recorded:
    """What the judgement reads from a bag.

    windows_ns: (begin, end) of each path, by label.  edges: (16,) rows, the clamped edges' poses.
    curves: times (n,) and the object's force over depth, (m, 2) each.
    """

    scene: Scene
    finger: Track
    windows_ns: dict[str, tuple[int, int]]
    edges: tuple[Track, Track]
    curve_times_ns: list[int]
    curves: list[Floats]


def read_bag(bag: Path) -> Recorded:
    """ExperimentError for a bag without what is needed."""
    scene: Scene | None = None
    finger: list[tuple[int, Floats]] = []
    windows: dict[str, tuple[int, int]] = {}
    flanges: tuple[list[tuple[int, Floats]], list[tuple[int, Floats]]] = ([], [])
    curves: list[tuple[int, Floats]] = []
    topics = ["scene", "twin/finger", "twin/arms", "soft_body"]
    for _, message, header, _ in BagReader(bag, topics=topics):
        match message:
            case Scene():
                scene = message
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
        raise ExperimentError(f"{bag}: no scene, or no soft body's force curve, was recorded")
    curves.sort(key=lambda entry: entry[0])
    return Recorded(
        scene=scene,
        finger=track(finger, "twin/finger"),
        windows_ns=windows,
        edges=(track(flanges[0], "twin/arms"), track(flanges[1], "twin/arms")),
        curve_times_ns=[time for time, _ in curves],
        curves=[curve for _, curve in curves],
    )


@dataclass(frozen=True, slots=True)
class Felt:
    """One instant: the finger's depth, what it met and should have met, and the sheet's retreat."""

    depth_m: float
    wanted_n: float
    presented_n: float
    normal_offset_m: float

    @property
    def error_ratio(self) -> float:
        """Rendered over wanted force, minus one; the reference is at least `FORCE_JND_FLOOR_N`."""
        return (self.presented_n - self.wanted_n) / max(self.wanted_n, FORCE_JND_FLOOR_N)


class Judge:
    """Forces at instants of a recording, by the twin's membrane."""

    def __init__(self, recorded: Recorded) -> None:
        scene = recorded.scene
        self._recorded = recorded
        self._clamps = (
            _transform(scene.arms.left.flange_from_edge),
            _transform(scene.arms.right.flange_from_edge),
        )
        sheet = scene.sheet
        self._rubber = Rubber(
            sheet.width_m, sheet.height_m, sheet.thickness_m, sheet.young_modulus_pa
        )

    def felt(self, at_ns: int, press: Press) -> Felt:
        """Depths count from the place that is pressed: past a middle another one is as near."""
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
            finger_radius_m=recorded.scene.finger.radius_m,
        )
        middle = 0.5 * (left[:3, 3] + right[:3, 3])
        return Felt(
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
    """The figures of `experiment compliance --json`; lengths in mm, forces in N, errors in %."""
    recorded = read_bag(bag)
    judge = Judge(recorded)
    held: list[dict[str, Any]] = []
    moving: list[Felt] = []
    for press in presses(recorded.scene):
        label = press.path.label
        if label not in recorded.windows_ns:
            have = ", ".join(recorded.windows_ns) or "none"
            raise ExperimentError(f'the bag has no finger path "{label}"; it has: {have}')
        progress(f"judging: {label}")
        begin_ns, end_ns = recorded.windows_ns[label]
        for hold in press.holds:
            times = begin_ns + (np.linspace(hold.begin_s, hold.end_s, HELD_SAMPLES) * 1e9)
            held.append(_row(press, hold, [judge.felt(int(at), press) for at in times]))
        if not press.holds:
            moving = list(_while_moving(judge, press, begin_ns, end_ns))
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
        "bag": str(bag),
    }


def _while_moving(judge: Judge, press: Press, begin_ns: int, end_ns: int) -> Iterator[Felt]:
    for at_ns in range(begin_ns, end_ns, round(MOVING_STEP_S * 1e9)):
        felt = judge.felt(at_ns, press)
        if max(felt.wanted_n, felt.presented_n) >= FORCE_JND_FLOOR_N:
            yield felt


def _row(press: Press, hold: Hold, felt: Sequence[Felt]) -> dict[str, Any]:
    return {
        "place": press.place,
        "depth_mm": 1e3 * hold.depth_m,
        "wanted_n": float(np.mean([one.wanted_n for one in felt])),
        "presented_n": float(np.mean([one.presented_n for one in felt])),
        "error_percent": 100.0 * float(np.mean([one.error_ratio for one in felt])),
        "retreat_mm": 1e3 * float(np.mean([one.normal_offset_m for one in felt])),
    }
