"""Measure the delays of the arms and the camera.

The servo lag is the time by which an arm lags behind its commands. The node that controls an arm
measures the lag from commanded and measured joint angles. The node also reads an expected lag from
the launch file, and reports if the measured lag deviates from it. Therefore, the measured lag is
written to the launch file.

The stamp offset is the time of an exposure minus its timestamp. The camera sees the marks on both
clamps while the arms move the sheet. The motion of the marks in the images is compared with the
motion that follows from the measured joint angles.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline

from flexsheet.launch.calibration.csv_rows import SIDES
from flexsheet.launch.calibration.edge_marks import MarkDetector
from flexsheet.launch.experiments.lag import estimate_lag_s
from flexsheet.launch.experiments.simulated_time import (
    CYCLE_S,
    LoopSettings,
    SimulatedSheet,
    follow_in_simulated_time,
)
from flexsheet.launch.experiments.stroke import (
    SampledMotion,
    make_edge_row,
    make_motion,
    stroke_path,
)
from flexsheet.messages.apparatus import Apparatus
from flexsheet.messages.bag import BagReader
from flexsheet.messages.calibration import StereoCalibration
from flexsheet.messages.errors import FlexsheetError
from flexsheet.messages.scene import Scene
from flexsheet.messages.types import ArmState, Side, StereoPair
from flexsheet.nodes.arm_bridge.geometry import ArmGeometry
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.planner.parameters import PlannerParameters
from flexsheet.nodes.planner.trajectory import SheetTrajectoryPlanner
from flexsheet.nodes.twin.pixels import TwinCamera
from flexsheet.nodes.twin.rig import make_true_camera
from flexsheet.nodes.twin.truth import apply_apparatus

STROKE_S = 5.0
"""The duration (s) of the simulated stroke of the finger."""

BLOCK_S, MIN_BLOCKS = 2.0, 4
"""A recording is divided into parts of this duration (s), and this number of parts is required.

The stamp offset (exposure time minus timestamp) is measured in each part, and the results are
averaged.
"""

STAMP_MODEL_STD_S = 1.5e-4
"""The standard deviation (s) of the error that backlash and elasticity cause in the stamp offset.

The stamp offset is the time of an exposure minus its timestamp. The error was 0.1 ms rms in
simulated laboratories with seeds 0 to 9.
"""

MARK_SWING_M, MARK_FREQUENCY_HZ, MARK_SECONDS = 0.02, 1.0, 8.0
"""The amplitude (m), frequency (Hz) and duration (s) of the simulated motion of the sheet.

This motion is used to measure the stamp offset (exposure time minus timestamp).
"""


class DelaysError(FlexsheetError, ValueError):
    """Raised if a recording does not contain the measured servo lag of an arm."""

    remedy = "Record a stroke in which both arms follow the finger for several seconds."


@dataclass(frozen=True, slots=True)
class MeasuredLag:
    """A measured delay (s), such as the servo lag of an arm, and its standard deviation (s)."""

    lag_s: float
    uncertainty_s: float


@dataclass(frozen=True, slots=True)
class MeasuredDelays:
    """The measured delays of the arms and the camera.

    servo: servo lag of each arm, including the latency of the commands to the arm.
    stamp_offset: exposure time minus timestamp; None if it could not be measured.
    """

    servo: dict[Side, MeasuredLag]
    stamp_offset: MeasuredLag | None


def read_measured_lags(bag: Path) -> dict[Side, MeasuredLag]:
    """Read the last measured servo lag of each arm from a bag.

    Raises DelaysError if a servo lag is missing.
    """
    found: dict[Side, MeasuredLag] = {}
    for _, message, _, _ in BagReader(bag, topics=["arm_left", "arm_right"]):
        if not isinstance(message, ArmState) or message.servo_lag_s is None:
            continue
        if message.servo_lag_uncertainty_s is not None:
            found[message.side] = MeasuredLag(message.servo_lag_s, message.servo_lag_uncertainty_s)
    for side in SIDES:
        if side not in found:
            raise DelaysError(
                f"{bag}: the bridge of the {side} arm did not measure a servo lag; record a "
                "stroke in which this arm moves for several seconds"
            )
    return found


def read_delays(
    bag: Path, scene: Scene, calibration: StereoCalibration | None, added_s: float
) -> MeasuredDelays:
    """Measure the servo lags and the stamp offset (exposure time minus timestamp) from a bag.

    The stamp offset requires images of the marks on the clamps.

    added_s: time that the camera node had already added to the timestamps.

    Raises DelaysError if a servo lag is missing.
    """
    servo = read_measured_lags(bag)
    stamp = read_stamp_offset(bag, scene, calibration)
    if stamp is not None:
        stamp = replace(stamp, lag_s=stamp.lag_s + added_s)
    return MeasuredDelays(servo, stamp)


def read_stamp_offset(
    bag: Path, scene: Scene, calibration: StereoCalibration | None
) -> MeasuredLag | None:
    """Measure the stamp offset (exposure time minus timestamp) from images of the clamps in a bag.

    Return None if the bag does not contain enough images of moving clamps.
    """
    geometries = {side: ArmGeometry(scene, side) for side in SIDES}
    rows: dict[Side, list[tuple[int, Floats]]] = {side: [] for side in SIDES}
    for _, message, header, _ in BagReader(bag, topics=["arm_left", "arm_right"]):
        if isinstance(message, ArmState):
            edge = geometries[message.side].world_from_edge(message.joints_rad)
            rows[message.side].append((header.source_ns, make_edge_row(edge, np.eye(4))))
    if any(len(one) < 2 for one in rows.values()):
        return None
    edges = tuple(make_motion(rows[side], f"the {side} arm's joints") for side in SIDES)
    return estimate_stamp_offset(
        (
            (header.source_ns, message)
            for _, message, header, _ in BagReader(bag, topics=["stereo"])
            if isinstance(message, StereoPair)
        ),
        edges,
        MarkDetector(scene, calibration),
    )


def estimate_stamp_offset(
    pairs: Iterable[tuple[int, StereoPair]],
    edges: Sequence[SampledMotion],
    detector: MarkDetector,
) -> MeasuredLag | None:
    """Estimate the stamp offset (exposure time minus timestamp) from images of marks on the clamps.

    Return None if the marks are visible and moving in fewer than MIN_BLOCKS parts of the recording.

    pairs: image pairs with their timestamps (ns).
    edges: motion of each clamp, computed from measured joint angles.
    """
    seen: list[list[tuple[int, Floats]]] = [[] for _ in edges]
    for at_ns, pair in pairs:
        times = np.array([at_ns])
        for marks, edge in zip(seen, edges, strict=True):
            if edge.covers(times).all():
                found = detector.find(
                    pair.left,
                    pair.right,
                    near_world_m=edge.interpolate(times)[0, :3],
                    left_origin_px=pair.left_origin_px,
                    right_origin_px=pair.right_origin_px,
                )
                if found is not None:
                    marks.append((at_ns, found))
    offsets_s: list[float] = []
    for marks, edge in zip(seen, edges, strict=True):
        if len(marks) < 2:
            continue
        zero_ns = edge.times_ns[0]
        points = make_motion(marks, "marks")
        times_s, leader_s = (1e-9 * (one.times_ns - zero_ns) for one in (points, edge))
        for begin_s in np.arange(times_s[0], times_s[-1] - 0.9 * BLOCK_S, BLOCK_S):
            inside = (times_s >= begin_s) & (times_s < begin_s + BLOCK_S)
            lag_s = _estimate_block(times_s[inside], points.values[inside], leader_s, edge)
            if lag_s is not None:
                offsets_s.append(-lag_s)
    return _average(offsets_s, STAMP_MODEL_STD_S) if len(offsets_s) >= MIN_BLOCKS else None


def _estimate_block(
    times_s: Floats, points: Floats, leader_s: Floats, edge: SampledMotion
) -> float | None:
    near = (leader_s > times_s.min(initial=math.inf) - 0.5) & (
        leader_s < times_s.max(initial=-math.inf) + 0.5
    )
    known_s, centres = leader_s[near], edge.values[near, :3]
    try:
        lag_s = estimate_lag_s(times_s, points, centres, leader_times_s=known_s, max_lag_s=0.1)
    except ValueError:
        return None  # The marks were hidden for most of this time.
    if lag_s is None:
        return None
    # Backlash displaces the marks against the direction of motion, as a lag does, so fit both.
    motion = CubicSpline(known_s, centres)
    for _ in range(3):
        at_s = times_s - lag_s
        velocities = motion(at_s, 1)
        axis = np.linalg.svd(velocities, full_matrices=False)[2][0]
        along, speed = motion(at_s) @ axis, velocities @ axis
        design = np.column_stack([np.ones(len(at_s)), along, np.sign(speed), speed])
        # While the motion reverses, the joints cross their backlash one after the other.
        fast = np.abs(speed) > 0.3 * np.abs(speed).max()
        shifts = (points @ axis - along)[fast]
        lag_s -= float(np.linalg.lstsq(design[fast], shifts, rcond=None)[0][3])
    return lag_s


def _average(values: Sequence[float], model_std_s: float) -> MeasuredLag:
    error_s = float(np.std(values, ddof=1)) / math.sqrt(len(values))
    return MeasuredLag(float(np.mean(values)), math.hypot(error_s, model_std_s))


def measure_lags_in_simulation(scene: Scene, apparatus: Apparatus) -> dict[Side, MeasuredLag]:
    """Simulate a stroke of the finger, and return the measured servo lags of both arms.

    The node that controls an arm measures its servo lag. Raises DelaysError if a servo lag cannot
    be measured.
    """
    found = follow_in_simulated_time(scene, stroke_path(scene, STROKE_S), apparatus)
    lags_ms, uncertainties_ms = found["servo_lag_ms"], found["servo_lag_uncertainty_ms"]
    lags = {}
    for side, lag_ms, uncertainty_ms in zip(SIDES, lags_ms, uncertainties_ms, strict=True):
        if uncertainty_ms is None:
            raise DelaysError(
                f"the servo lag of the {side} arm could not be measured in the simulated stroke; "
                f"check arms.{side} in the apparatus"
            )
        lags[side] = MeasuredLag(1e-3 * lag_ms, 1e-3 * uncertainty_ms)
    return lags


def measure_in_simulation(
    scene: Scene, apparatus: Apparatus, *, calibration: StereoCalibration | None, seed: int
) -> MeasuredDelays:
    """Measure the servo lags of simulated arms and the stamp offset of a simulated camera.

    The stamp offset is the time of an exposure minus its timestamp.

    calibration: stereo calibration that is used to triangulate the marks. If it is None, the
        scene's camera model is used.
    """
    servo = measure_lags_in_simulation(scene, apparatus)
    stamp = simulate_stamp_offset(scene, apparatus, calibration=calibration, seed=seed)
    return MeasuredDelays(servo, stamp)


def swing_sheet(
    scene: Scene, apparatus: Apparatus, *, swing_m: float, frequency_hz: float, seconds: float
) -> tuple[tuple[SampledMotion, ...], tuple[SampledMotion, ...]]:
    """Simulate arms that move the sheet periodically along its y axis, after one second at rest.

    Return the true motions of both clamps, and the motions that follow from measured joint angles.

    swing_m: amplitude of the motion.
    """
    start = SheetTrajectoryPlanner(scene, PlannerParameters()).motion
    sheet = SimulatedSheet(scene, apparatus, start, LoopSettings())
    along, rate = start.world_from_sheet[:3, 1], 2.0 * math.pi * frequency_hz
    for now_s in np.arange(1, round((seconds + 1.0) / CYCLE_S)) * CYCLE_S:
        sheet.record(float(now_s))
        phase = rate * max(float(now_s) - 1.0, 0.0)
        moved = start.world_from_sheet.copy()
        moved[:3, 3] += swing_m * math.sin(phase) * along
        speed = swing_m * rate * math.cos(phase) if phase else 0.0
        target = replace(
            start, world_from_sheet=moved, twist_world=np.concatenate([speed * along, np.zeros(3)])
        )
        for arm in sheet.arms:
            arm.command(target, float(now_s), float(now_s), CYCLE_S)
    true = tuple(make_motion(rows, "edge") for rows in sheet.rows)
    return true, tuple(make_motion(rows, "edge") for rows in sheet.reported_rows)


def draw_exposures(
    scene: Scene, apparatus: Apparatus, end_ns: int, seed: int
) -> Iterable[tuple[int, int]]:
    """Yield the timestamp (ns) and the true time (ns) of each simulated exposure.

    end_ns: time after which no exposures are simulated.
    """
    truth, random = apparatus.camera, np.random.default_rng((seed, 1))
    for stamp_s in np.arange(
        0.2, 1e-9 * end_ns - 0.2, 1.0 / (truth.rate_hz or scene.camera.rate_hz)
    ):
        late_s = truth.stamp_offset_s + truth.exposure_jitter_s * random.standard_normal()
        yield round(1e9 * stamp_s), round(1e9 * (stamp_s + late_s))


def simulate_stamp_offset(
    scene: Scene, apparatus: Apparatus, *, calibration: StereoCalibration | None, seed: int
) -> MeasuredLag | None:
    """Measure the stamp offset (exposure time minus timestamp) of a simulated camera.

    The camera observes marks on the moving clamps. Return None if too few marks are detected.
    """
    true, reported = swing_sheet(
        scene, apparatus, swing_m=MARK_SWING_M, frequency_hz=MARK_FREQUENCY_HZ, seconds=MARK_SECONDS
    )
    true_scene = apply_apparatus(scene, apparatus)
    camera = TwinCamera(
        make_true_camera(true_scene.camera), finger_radius_m=true_scene.finger.radius_m, seed=seed,
        skew_s=apparatus.camera.skew_s,
    )  # fmt: skip
    offsets = []
    for number in range(len(SIDES)):

        def see(number: int = number) -> Iterable[tuple[int, StereoPair]]:
            for stamp_ns, exposed_ns in draw_exposures(
                scene, apparatus, int(true[0].times_ns[-1]), seed + number
            ):

                def place(instant_s: float, at_ns: int = exposed_ns) -> Floats:
                    times = np.array([at_ns + round(1e9 * instant_s)])
                    return np.asarray(true[number].interpolate(times)[0, :3])

                left, right = camera.picture(place, exposure_s=scene.camera.exposure_s)
                yield stamp_ns, StereoPair.model_construct(left=left, right=right)

        # The marks are simulated in sequence, because the simulated camera shows only one mark.
        detector = MarkDetector(scene, calibration)
        offsets.append(estimate_stamp_offset(see(), (reported[number],), detector))
    known = [one for one in offsets if one is not None]
    if not known:
        return None
    return MeasuredLag(
        float(np.mean([one.lag_s for one in known])), max(one.uncertainty_s for one in known)
    )
