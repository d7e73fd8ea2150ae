"""Compare the force of the simulated sheet on the finger with the force of the virtual object.

The finger pushes at a few positions and rests at several depths. Then it moves in and out without
stopping. The felt force is the force of the sheet on the finger. The simulator's membrane model
computes it from the true poses of the sheet's edges and of the fingertip. The wanted force is the
force of the object. It is read from the published force curve, at the finger's true depth. Errors
are relative to the stored solution of an independent solver (`force_reference`), or to the wanted
force if there is no stored solution.
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

from flexsheet.launch.experiments import ExperimentError, find_recorded
from flexsheet.launch.experiments.driver import Driver
from flexsheet.launch.experiments.force_reference import (
    ReferenceForce,
    ReferenceForceCurve,
    find_reference_curve,
)
from flexsheet.launch.experiments.run import Procedure, Progress
from flexsheet.launch.experiments.stroke import SampledMotion, make_motion
from flexsheet.messages.apparatus import Apparatus
from flexsheet.messages.bag import BagReader
from flexsheet.messages.scene import Scene
from flexsheet.messages.types import FingerPath, SoftBody, TwinArms, TwinFinger
from flexsheet.nodes.planner.compliance import (
    FORCE_JND_FLOOR_N,
    TARGET_ERROR_RATIO,
    WEBER_RATIO,
    WEBER_RATIO_BARE,
)
from flexsheet.nodes.twin.force_history import ForceHistory, apply_history
from flexsheet.nodes.twin.membrane import CELLS, make_edge_plane
from flexsheet.nodes.twin.paths import map_to_surface
from flexsheet.nodes.twin.sheet_pull import find_clamps, solve_sheet
from flexsheet.nodes.twin.truth import apply_apparatus

Floats = NDArray[np.float64]
Times = NDArray[np.int64]

POSITIONS_M = ((0.0, 0.0), (0.025, 0.0), (0.0, 0.02))
"""The positions at which the finger pushes, in metres.

The first value of each pair is the distance along the object. The second value is the arc length
around the object, measured from its front.
"""

DEPTHS_M = (0.0005, 0.001, 0.002, 0.004, 0.007, 0.010, 0.013, 0.016)
"""The depths at which the finger rests, in metres.

Only depths that are smaller than the scene's push depth are used; the push depth is always added.
"""

HOVER_M = 0.03
APPROACH_S = 1.2
PUSH_M_PER_S = 0.05
HOLD_S, EVALUATED_S = 1.0, 0.3
"""The duration (s) of a rest, and the time (s) at its end in which the force is evaluated."""

REST_SAMPLES = 3
MOVING_STEP_S = 0.06

HISTORY_STEP_S = 0.01
"""The time step (s) with which the force history of the rubber is computed."""
HISTORY_DEPTHS = 9
HISTORY_CELLS = 16
"""The numbers of depths and of membrane elements per side for the elastic force curve.

The force history of the rubber is computed from this curve.
"""


@dataclass(frozen=True, slots=True)
class RestInterval:
    """The time interval in which the force is evaluated while the finger rests at a depth.

    begin_s, end_s: times from the start of the finger path.
    """

    depth_m: float
    begin_s: float
    end_s: float


@dataclass(frozen=True, slots=True)
class Press:
    """A press of the finger at a position on the object.

    place: name of the position.
    place_m: coordinates (m) of the position on the object's surface, relative to the centre of the
        front. The first is along the object, and the second is the arc length around the object.
    surface, normal: point (3,) and normal (3,) of the undeformed object at this position, in the
        world frame.
    holds: intervals in which the finger rests and the force is evaluated; empty if the finger moves
        in and out without resting.
    """

    path: FingerPath
    place: str
    place_m: tuple[float, float]
    surface: Floats
    normal: Floats
    holds: tuple[RestInterval, ...]


def make_presses(scene: Scene) -> list[Press]:
    """Return all presses of the experiment in a scene, with their finger paths."""
    deepest_m = scene.working_range.push_depth_m
    depths = np.append([depth for depth in DEPTHS_M if depth < deepest_m], deepest_m)
    resting = [_make_resting_press(scene, along, around, depths) for along, around in POSITIONS_M]
    return [*resting, _make_moving_press(scene, deepest_m)]


def _make_resting_press(scene: Scene, along_m: float, around_m: float, depths: Floats) -> Press:
    times, heights, holds = [0.0, APPROACH_S], [HOVER_M, 0.0], []
    for depth in depths:
        begin_s = times[-1] + (depth + heights[-1]) / PUSH_M_PER_S
        times += [begin_s, begin_s + HOLD_S]
        heights += [-depth, -depth]
        holds.append(RestInterval(float(depth), begin_s + HOLD_S - EVALUATED_S, begin_s + HOLD_S))
    times.append(times[-1] + (HOVER_M - heights[-1]) / PUSH_M_PER_S)
    heights.append(HOVER_M)
    place = f"at {1e3 * along_m:g}, {1e3 * around_m:g} mm"
    motion = np.column_stack([times, heights])
    return _make_press(scene, place, (along_m, around_m), motion, tuple(holds))


def _make_moving_press(scene: Scene, deepest_m: float) -> Press:
    stroke_s = deepest_m / PUSH_M_PER_S
    times = np.cumsum([0.0, APPROACH_S, stroke_s, stroke_s, APPROACH_S])
    heights = [HOVER_M, 0.0, -deepest_m, 0.0, HOVER_M]
    return _make_press(scene, "in and out", POSITIONS_M[0], np.column_stack([times, heights]), ())


def _make_press(
    scene: Scene,
    place: str,
    place_m: tuple[float, float],
    motion: Floats,
    holds: tuple[RestInterval, ...],
) -> Press:
    """Return the path of a finger that moves along the surface normal at one point.

    motion: array (n, 2) of times (s) and heights above the surface (m).
    """
    surface, above = map_to_surface(scene, np.array([[*place_m, 0.0], [*place_m, HOVER_M]]))
    normal = (above - surface) / HOVER_M
    path = FingerPath(
        label=f"press {place}" if holds else place,
        times_s=np.ascontiguousarray(motion[:, 0]),
        positions_world_m=surface + np.outer(motion[:, 1], normal),
        wander_m=0.0,
        tremor_m=0.0,
    )
    return Press(path, place, place_m, surface, normal, holds)


def make_compliance_procedure(progress: Progress) -> Procedure:
    """Make the coroutine that presses the finger at all positions of the experiment."""

    async def procedure(driver: Driver, scene: Scene) -> None:
        for press in make_presses(scene):
            progress(f"pushing along the finger path {press.path.label}")
            await driver.follow(press.path)

    return procedure


@dataclass(frozen=True, slots=True)
class ComplianceRecording:
    """The data of a compliance experiment, read from a bag.

    windows_ns: start and end (ns) of each finger path; the keys are the labels of the paths.
    edges: true motions of the left and the right flange, which hold the edges of the sheet. Each
        flange pose (4, 4) is stored as 16 numbers.
    curves: force curves published at `curve_times_ns`. A curve with m points is an array (m, 2) of
        depths (m) and object forces (N).
    methods: for each curve, the name of the soft-body method with which the curve was computed.
    forces: array (k, 2) of times (ns) and values (N) of the k valid measured contact forces.
    """

    scene: Scene
    finger: SampledMotion
    windows_ns: dict[str, tuple[int, int]]
    edges: tuple[SampledMotion, SampledMotion]
    curve_times_ns: list[int]
    curves: list[Floats]
    methods: list[str]
    apparatus: Apparatus | None = None


def read_bag(bag: Path) -> ComplianceRecording:
    """Read the data of a compliance experiment from a bag.

    Raises ExperimentError if the scene or the force curve is missing.
    """
    scene: Scene | None = None
    apparatus: Apparatus | None = None
    finger: list[tuple[int, Floats]] = []
    windows: dict[str, tuple[int, int]] = {}
    flanges: tuple[list[tuple[int, Floats]], list[tuple[int, Floats]]] = ([], [])
    curves: list[tuple[int, Floats, str]] = []
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
                curves.append((header.source_ns, message.force_curve, message.method))
            case _:
                pass
    if scene is None or not curves:
        raise ExperimentError(
            f"{bag}: the bag lacks a scene or a force curve; record the topics scene and soft_body"
        )
    curves.sort(key=lambda entry: entry[0])
    return ComplianceRecording(
        scene=scene,
        apparatus=apparatus,
        finger=make_motion(finger, "twin/finger"),
        windows_ns=windows,
        edges=(make_motion(flanges[0], "twin/arms"), make_motion(flanges[1], "twin/arms")),
        curve_times_ns=[time for time, _, _ in curves],
        curves=[curve for _, curve, _ in curves],
        methods=[method for _, _, method in curves],
    )


@dataclass(frozen=True, slots=True)
class ForceSample:
    """The forces on the finger at one time.

    depth_m: true finger depth.
    wanted_n: published force of the object.
    felt_n: force of the sheet.
    normal_offset_m: depth of the sheet centre below the undeformed surface.
    method: method of the soft body.
    reference: force of the object that an independent solver computed, or None if none is stored.
    """

    depth_m: float
    wanted_n: float
    felt_n: float
    normal_offset_m: float
    method: str
    reference: ReferenceForce | None = None

    @property
    def error_ratio(self) -> float:
        """Return the relative error of the felt force.

        The error is relative to the reference force, or to the wanted force if there is no
        reference. The divisor is at least FORCE_JND_FLOOR_N.
        """
        expected_n = self.wanted_n if self.reference is None else self.reference.force_n
        return _relative_error(self.felt_n, expected_n)

    @property
    def model_error_ratio(self) -> float | None:
        """Return the relative error of the published force `wanted_n`; None without a reference."""
        if self.reference is None:
            return None
        return _relative_error(self.wanted_n, self.reference.force_n)


def _relative_error(force_n: float, expected_n: float) -> float:
    return (force_n - expected_n) / max(expected_n, FORCE_JND_FLOOR_N)


class ForceReference:
    """A model that computes the true forces in a recording with the simulator's membrane model."""

    def __init__(self, recorded: ComplianceRecording) -> None:
        self._recorded = recorded
        self._scene = apply_apparatus(recorded.scene, recorded.apparatus)
        self._clamps = find_clamps(self._scene)
        self._ratios: dict[str, tuple[Times, Floats]] = {}
        self._curves: dict[str, ReferenceForceCurve | None] = {}

    def evaluate(self, at_ns: int, press: Press) -> ForceSample:
        """Return the true forces at the time `at_ns`.

        press: press that contains this time. The depth is measured from its surface point.
        """
        tip, left, right = self._read_poses(at_ns)
        depth_m = float((press.surface - tip) @ press.normal)
        if press.place not in self._curves:
            self._curves[press.place] = find_reference_curve(self._recorded.scene, *press.place_m)
        curve = self._curves[press.place]
        number = max(0, bisect_right(self._recorded.curve_times_ns, at_ns) - 1)
        pressed_n = self._solve_n(left, right, tip, press)
        middle = 0.5 * (left[:3, 3] + right[:3, 3])
        return ForceSample(
            depth_m=depth_m,
            wanted_n=_interpolate_curve_n(self._recorded.curves[number], depth_m),
            felt_n=pressed_n * self._history_ratio(at_ns, press),
            normal_offset_m=float((press.surface - middle) @ press.normal),
            method=self._recorded.methods[number],
            reference=None if curve is None else curve.force(depth_m),
        )

    def _read_poses(self, at_ns: int) -> tuple[Floats, Floats, Floats]:
        """Return the true fingertip (3,) and the poses (4, 4) of both edges at the time `at_ns`."""
        times = np.array([at_ns])
        left, right = (
            edges.interpolate(times)[0].reshape(4, 4) @ clamp
            for edges, clamp in zip(self._recorded.edges, self._clamps, strict=True)
        )
        return self._recorded.finger.interpolate(times)[0], left, right

    def _solve_n(
        self, left: Floats, right: Floats, tip: Floats, press: Press, cells: int = CELLS
    ) -> float:
        """Return the force (N) of an elastic sheet on the finger along the normal of the press.

        left, right: poses (4, 4) of the sheet's edges.
        tip: fingertip (3,).
        cells: number of membrane elements per side.
        """
        pressed = solve_sheet(
            self._scene, self._recorded.apparatus, (left, right), tip, cells=cells
        )
        return float(pressed.finger_force_n @ press.normal)

    def _history_ratio(self, at_ns: int, press: Press) -> float:
        """Return the ratio of the rubber's force to the force of an elastic sheet.

        at_ns: time during the press.
        """
        if ForceHistory.of(self._recorded.apparatus) is None:
            return 1.0
        label = press.path.label
        if label not in self._ratios:
            self._ratios[label] = self._follow_history(press)
        times, ratios = self._ratios[label]
        return float(np.interp(at_ns, times, ratios))

    def _follow_history(self, press: Press) -> tuple[Times, Floats]:
        """Compute how hysteresis and creep of the rubber change the force during a press.

        Return n times (ns), and n ratios of the rubber's force to the force of a purely elastic
        sheet.

        The elastic force is computed at a few depths only, with the edge poses at the deepest point
        of the press. This is sufficient, because the ratio depends only on the shape of the force
        curve.
        """
        begin_ns, end_ns = self._recorded.windows_ns[press.path.label]
        times = np.arange(begin_ns, end_ns + 1, round(HISTORY_STEP_S * 1e9))
        poses = [self._read_poses(int(at)) for at in times]
        indented_m = np.array([_indentation_m(*pose) for pose in poses])
        tip, left, right = poses[int(np.argmax(indented_m))]
        middle = 0.5 * (left[:3, 3] + right[:3, 3])
        depths_m = float(indented_m.max()) * np.linspace(0.0, 1.0, HISTORY_DEPTHS)
        if depths_m[-1] <= 0.0:
            return times, np.ones(len(times))
        normal = make_edge_plane(left, right)[:3, 2]
        at_surface = tip - ((tip - middle) @ normal) * normal
        curve_n = [0.0] + [
            self._solve_n(left, right, at_surface - depth * normal, press, HISTORY_CELLS)
            for depth in depths_m[1:]
        ]
        elastic_n = np.interp(indented_m, depths_m, curve_n)
        history = ForceHistory.of(self._recorded.apparatus)
        assert history is not None
        felt_n = apply_history(history, np.asarray(times * 1e-9, dtype=np.float64), elastic_n)
        return times, np.where(elastic_n > 0.0, felt_n / np.maximum(elastic_n, 1e-9), 1.0)


def _interpolate_curve_n(rows: Floats, depth_m: float) -> float:
    curve = PchipInterpolator(rows[:, 0], rows[:, 1])
    return float(curve(np.clip(depth_m, 0.0, rows[-1, 0])))


def _indentation_m(tip: Floats, left: Floats, right: Floats) -> float:
    """Return the depth (m) of the fingertip behind the plane of the unloaded sheet; at least 0.

    tip: fingertip (3,). left, right: poses (4, 4) of the sheet's edges.
    """
    plane = make_edge_plane(left, right)
    return max(float((plane[:3, 3] - tip) @ plane[:3, 2]), 0.0)


def compliance_result(bag: Path, progress: Progress) -> dict[str, Any]:
    """Evaluate a bag, and return the results of `experiment compliance --json` in mm, N and %."""
    recorded = read_bag(bag)
    reference = ForceReference(recorded)
    resting: list[dict[str, Any]] = []
    moving: list[ForceSample] = []
    for press in make_presses(recorded.scene):
        label = press.path.label
        progress(f"evaluating: {label}")
        begin_ns, end_ns = find_recorded(recorded.windows_ns, "finger path", label)
        for hold in press.holds:
            times = begin_ns + (np.linspace(hold.begin_s, hold.end_s, REST_SAMPLES) * 1e9)
            row = _make_row(press, hold, [reference.evaluate(int(at), press) for at in times])
            resting.append(row)
        if not press.holds:
            moving = list(_evaluate_moving(reference, press, begin_ns, end_ns))
    errors = np.abs([row["error_percent"] for row in resting])
    compared = [row for row in resting if row["reference_n"] is not None]
    errors_moving = 100.0 * np.array([one.error_ratio for one in moving])
    return {
        "rows": resting,
        "reference": "independent finite elements (experiments/force_reference.json)"
        if compared
        else "the soft body's own force, because no independent solution fits the scene",
        "median_percent": float(np.median(errors)),
        "worst_percent": float(errors.max()),
        "against_reference": _summarize_against_reference(compared),
        "methods": sorted({row["method"] for row in resting}),
        "target_percent": 100.0 * TARGET_ERROR_RATIO,
        "noticed_percent": [100.0 * WEBER_RATIO, 100.0 * WEBER_RATIO_BARE],
        "moving": {
            "speed_mm_per_s": 1e3 * PUSH_M_PER_S,
            "rows": [
                {
                    "depth_mm": 1e3 * one.depth_m,
                    "wanted_n": one.wanted_n,
                    "felt_n": one.felt_n,
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
) -> Iterator[ForceSample]:
    for at_ns in range(begin_ns, end_ns, round(MOVING_STEP_S * 1e9)):
        sample = reference.evaluate(at_ns, press)
        if max(sample.wanted_n, sample.felt_n) >= FORCE_JND_FLOOR_N:
            yield sample


def _summarize_against_reference(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the median and the maximum error (%) at each position.

    rows: result rows that have a reference force.
    """
    result = []
    for place in dict.fromkeys(row["at"] for row in rows):
        felt, model = (
            np.abs([row[key] for row in rows if row["at"] == place])
            for key in ("error_percent", "model_error_percent")
        )
        result.append(
            {
                "at": place,
                "median_percent": float(np.median(felt)),
                "worst_percent": float(felt.max()),
                "model_worst_percent": float(model.max()),
            }
        )
    return result


def _make_row(press: Press, hold: RestInterval, samples: Sequence[ForceSample]) -> dict[str, Any]:
    references = [one.reference for one in samples if one.reference is not None]
    models = [one.model_error_ratio for one in samples if one.model_error_ratio is not None]
    known = len(references) == len(samples)
    return {
        "at": press.place,
        "depth_mm": 1e3 * hold.depth_m,
        "reference_n": float(np.mean([one.force_n for one in references])) if known else None,
        "wanted_n": float(np.mean([one.wanted_n for one in samples])),
        "felt_n": float(np.mean([one.felt_n for one in samples])),
        "error_percent": 100.0 * float(np.mean([one.error_ratio for one in samples])),
        "model_error_percent": 100.0 * float(np.mean(models)) if known else None,
        "reference_uncertainty_percent": 100.0
        * float(np.mean([one.uncertainty_ratio for one in references]))
        if known
        else None,
        "method": samples[-1].method,
        "normal_offset_mm": 1e3 * float(np.mean([one.normal_offset_m for one in samples])),
    }
