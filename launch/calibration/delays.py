"""Measure the delays of arms, camera and projector.

The servo lag is the time by which an arm follows its commands. Each arm bridge measures it from
commanded and measured joints. The bridge starts with the lag in the launch file, and its self-check
reports a deviation from that value. Therefore the measured lag is written into the launch file.

The stamp offset is the time by which exposures are later than their timestamps. The camera sees
the marks on both clamps while the arms move the sheet. Their motion is compared with the motion
that follows from the measured joints. The self-check of projected marks on the moving sheet shows
by how much the actual display latency of the projector exceeds the one that the renderer assumes.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline

from flexsheet.launch.calibration.edge_marks import MarkDetector
from flexsheet.launch.experiments.lag import estimate_lag_s
from flexsheet.launch.experiments.simulated_time import (
    CYCLE_S,
    PIXEL_NOISE_PX,
    SimulatedSheet,
    follow_in_simulated_time,
)
from flexsheet.launch.experiments.stroke import (
    SampledMotion,
    make_edge_row,
    make_motion,
    stroke_path,
)
from flexsheet.messages.apparatus import NOMINAL_DISPLAY_LATENCY_S, Apparatus
from flexsheet.messages.bag import BagReader
from flexsheet.messages.calibration import StereoCalibration
from flexsheet.messages.errors import FlexsheetError
from flexsheet.messages.scene import Projector, Scene
from flexsheet.messages.types import ArmState, Frame, Side, Status, StereoPair
from flexsheet.nodes.arm_bridge.geometry import ArmGeometry
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.models.rigid import apply, inverse, pose_matrix, transform
from flexsheet.nodes.models.sheet import corners
from flexsheet.nodes.planner.parameters import PlannerParameters
from flexsheet.nodes.planner.trajectory import SheetTrajectoryPlanner
from flexsheet.nodes.renderer.check_marks import place_marks
from flexsheet.nodes.renderer.frame_renderer import CHECK_MARKS_PERIOD_NS
from flexsheet.nodes.renderer.sheet import SheetPose
from flexsheet.nodes.renderer.sheet_mesh import flat_mesh
from flexsheet.nodes.triangulator.projection_check import LATENCY_MEMORY_S, ProjectionCheck
from flexsheet.nodes.triangulator.triangulation import StereoGeometry, measure
from flexsheet.nodes.twin.pixels import TwinCamera
from flexsheet.nodes.twin.projector import on_plane
from flexsheet.nodes.twin.rig import make_true_camera, pixels_of, slopes_of
from flexsheet.nodes.twin.truth import apply_apparatus, find_display_delay_s

SIDES: tuple[Side, Side] = ("left", "right")
STROKE_S = 5.0
"""Duration of the simulated stroke."""

BLOCK_S, MIN_BLOCKS = 2.0, 4
"""Duration of the parts of a recording whose stamp offsets are averaged, and their least number."""

STAMP_MODEL_STD_S = 5e-4
"""Standard deviation of the stamp offset that backlash and elasticity of the arms cause."""

VALUE_PERIOD_S = 2.0 * LATENCY_MEMORY_S
"""Time between two values of the self-check `display_latency` that are nearly independent."""

LATENCY_MODEL_STD_S = 1e-3
"""Standard deviation of the display latency that remains in a long recording, because the phase of
the exposures relative to the frames is not uniformly distributed."""

MARK_SWING_M, MARK_FREQUENCY_HZ, MARK_SECONDS = 0.02, 1.0, 8.0
"""Simulated motion of the sheet for the stamp offset: amplitude, frequency and duration."""

CHECK_SWING_M, CHECK_FREQUENCY_HZ, CHECK_SECONDS = 0.03, 0.25, 34.0
"""Simulated motion for the display latency. Between two placements of the check marks, the sheet
moves less than the radius within which the self-check assigns points to marks."""

CHECK_PLACES = (-0.3, 0.0, 0.3)
"""Places of simulated check marks, as fractions of the sheet's width and height."""


class DelaysError(FlexsheetError, ValueError):
    """Raised for a recording that does not contain the measured servo lag of an arm."""

    code = "delays-calibration"
    remedy = "Record a stroke in which both arms follow the finger for several seconds."


@dataclass(frozen=True, slots=True)
class MeasuredLag:
    """Delay, such as the servo lag of an arm, and its standard deviation (s)."""

    lag_s: float
    uncertainty_s: float


@dataclass(frozen=True, slots=True)
class MeasuredDelays:
    """Measured delays; None for one that the data do not contain.

    servo: lag of each arm, including the command latency. stamp_offset: exposure time minus
    timestamp. display: time from the swap of an image to the middle of its display.
    """

    servo: dict[Side, MeasuredLag]
    stamp_offset: MeasuredLag | None
    display: MeasuredLag | None


def read_measured_lags(bag: Path) -> dict[Side, MeasuredLag]:
    """Read the last servo lag of each arm from a bag; raises DelaysError if one is missing."""
    found: dict[Side, MeasuredLag] = {}
    for _, message, _, _ in BagReader(bag, topics=["arm_left", "arm_right"]):
        if not isinstance(message, ArmState) or message.servo_lag_s is None:
            continue
        if message.servo_lag_uncertainty_s is not None:
            found[message.side] = MeasuredLag(message.servo_lag_s, message.servo_lag_uncertainty_s)
    for side in SIDES:
        if side not in found:
            raise DelaysError(f"{bag}: the {side} arm's bridge measured no servo lag")
    return found


def read_delays(
    bag: Path, scene: Scene, calibration: StereoCalibration | None, added_s: float
) -> MeasuredDelays:
    """Read the delays that a bag of the running graph contains.

    The stamp offset requires images of the clamps, the display latency requires projected check
    marks. added_s: time that the camera node added to the timestamps. Raises DelaysError if a servo
    lag is missing.
    """
    servo = read_measured_lags(bag)
    stamp = read_stamp_offset(bag, scene, calibration)
    values: list[tuple[float, float]] = []
    assumed_s: float | None = None
    for _, message, header, _ in BagReader(bag, topics=["status", "frame"]):
        if isinstance(message, Frame) and message.light_ns:
            assumed_s = 1e-9 * (message.light_ns - (message.swapped_ns or message.drawn_ns))
        elif isinstance(message, Status):
            values += [
                (1e-9 * header.source_ns, check.value)
                for check in message.self_checks
                if check.cause == "display_latency"
            ]
    display = None
    if assumed_s is not None:
        display = average_latency(values, assumed_s, stamp or MeasuredLag(0.0, 0.0))
    if stamp is not None:
        stamp = replace(stamp, lag_s=stamp.lag_s + added_s)
    return MeasuredDelays(servo, stamp, display)


def read_stamp_offset(
    bag: Path, scene: Scene, calibration: StereoCalibration | None
) -> MeasuredLag | None:
    """Measure the stamp offset from the images of the clamps in a bag; None without such images."""
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
    """Estimate exposure time minus timestamp from images of the marks at the clamps' centres.

    pairs: image pairs with their timestamps, ns. edges: motion of each seen clamp from
    measured joints. Return None if the marks are visible or move for less than MIN_BLOCKS
    parts of the recording.
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
    # Backlash displaces the marks against the direction of motion, which resembles a lag. Fit it.
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


def average_latency(
    values: Sequence[tuple[float, float]], assumed_s: float, stamp_offset: MeasuredLag
) -> MeasuredLag | None:
    """Average values (time, deviation) of the self-check `display_latency`, s.

    assumed_s: latency that the renderer assumed. stamp_offset: remaining offset of the timestamps,
    by which the marks seem to appear earlier. Return None for fewer than two independent values.
    """
    chosen: list[float] = []
    due_s = -math.inf
    for at_s, value in values:
        if at_s >= due_s:
            chosen.append(value)
            due_s = at_s + VALUE_PERIOD_S
    if len(chosen) < 2:
        return None
    found = _average(chosen, math.hypot(LATENCY_MODEL_STD_S, stamp_offset.uncertainty_s))
    return replace(found, lag_s=max(found.lag_s + assumed_s + stamp_offset.lag_s, 0.0))


def measure_lags_in_simulation(scene: Scene, apparatus: Apparatus) -> dict[Side, MeasuredLag]:
    """Simulate a stroke of the finger, and return the servo lags that both bridges measure."""
    found = follow_in_simulated_time(scene, stroke_path(scene, STROKE_S), apparatus)
    lags_ms, uncertainties_ms = found["servo_lag_ms"], found["servo_lag_uncertainty_ms"]
    lags = {}
    for side, lag_ms, uncertainty_ms in zip(SIDES, lags_ms, uncertainties_ms, strict=True):
        if uncertainty_ms is None:
            raise DelaysError(f"simulated stroke: the {side} arm's lag could not be measured")
        lags[side] = MeasuredLag(1e-3 * lag_ms, 1e-3 * uncertainty_ms)
    return lags


def measure_in_simulation(
    scene: Scene, apparatus: Apparatus, *, calibration: StereoCalibration | None, seed: int
) -> MeasuredDelays:
    """Measure all delays of a simulated laboratory; without a projector, no display latency."""
    servo = measure_lags_in_simulation(scene, apparatus)
    stamp = simulate_stamp_offset(scene, apparatus, calibration=calibration, seed=seed)
    return MeasuredDelays(servo, stamp, None)


def swing_sheet(
    scene: Scene, apparatus: Apparatus, *, swing_m: float, frequency_hz: float, seconds: float
) -> tuple[tuple[SampledMotion, ...], tuple[SampledMotion, ...]]:
    """Simulate arms that move the sheet along its y axis, after one second at rest.

    Return the true motion of both clamps, and that from measured joints.
    """
    start = SheetTrajectoryPlanner(scene, PlannerParameters().trajectory_settings()).motion
    sheet = SimulatedSheet(scene, apparatus, start, lag_known=False)
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


def _draw_exposures(
    scene: Scene, apparatus: Apparatus, end_ns: int, seed: int
) -> Iterable[tuple[int, int]]:
    """Yield timestamps and true times of simulated exposures, ns."""
    truth, random = apparatus.camera, np.random.default_rng((seed, 1))
    for stamp_s in np.arange(
        0.2, 1e-9 * end_ns - 0.2, 1.0 / (truth.rate_hz or scene.camera.rate_hz)
    ):
        late_s = truth.stamp_offset_s + truth.exposure_jitter_s * random.standard_normal()
        yield round(1e9 * stamp_s), round(1e9 * (stamp_s + late_s))


def simulate_stamp_offset(
    scene: Scene, apparatus: Apparatus, *, calibration: StereoCalibration | None, seed: int
) -> MeasuredLag | None:
    """Measure the stamp offset with simulated images of the marks on the moving clamps."""
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
            for stamp_ns, exposed_ns in _draw_exposures(
                scene, apparatus, int(true[0].times_ns[-1]), seed + number
            ):

                def place(instant_s: float, at_ns: int = exposed_ns) -> Floats:
                    times = np.array([at_ns + round(1e9 * instant_s)])
                    return np.asarray(true[number].interpolate(times)[0, :3])

                left, right = camera.picture(place, exposure_s=scene.camera.exposure_s)
                yield stamp_ns, StereoPair.model_construct(left=left, right=right)

        # One mark after the other is simulated, as the simulated camera shows one.
        detector = MarkDetector(scene, calibration)
        offsets.append(estimate_stamp_offset(see(), (reported[number],), detector))
    known = [one for one in offsets if one is not None]
    if not known:
        return None
    return MeasuredLag(
        float(np.mean([one.lag_s for one in known])), max(one.uncertainty_s for one in known)
    )


def simulate_latency_check(
    scene: Scene,
    apparatus: Apparatus,
    *,
    calibration: StereoCalibration | None,
    seed: int,
    added_s: float,
) -> list[tuple[float, float]]:
    """Return values (time, deviation) of the self-check `display_latency` on a moving sheet, s.

    The simulated projector lights check marks on the true sheet. The renderer assumes the nominal
    latency. added_s: time that is added to the camera's timestamps.
    """
    projector = _add_check_marks(scene)
    true, reported = swing_sheet(
        scene, apparatus, swing_m=CHECK_SWING_M, frequency_hz=CHECK_FREQUENCY_HZ,
        seconds=CHECK_SECONDS,
    )  # fmt: skip
    random, height_m = np.random.default_rng((seed, 2)), scene.sheet.height_m
    true_scene = apply_apparatus(scene, apparatus)
    assert true_scene.projector is not None
    camera, geometry = (
        make_true_camera(true_scene.camera),
        StereoGeometry.of(scene.camera, calibration),
    )
    left_from_world = inverse(pose_matrix(camera.world_from_left))
    light_pose = pose_matrix(true_scene.projector.world_from_projector)
    check = ProjectionCheck(projector)
    waiting: list[Frame] = []
    shown: list[tuple[int, Floats]] = []
    values: list[tuple[float, float]] = []
    drawn_ns = round(2e8 * random.uniform())
    end_ns = int(true[0].times_ns[-1])
    for stamp_ns, exposed_ns in _draw_exposures(scene, apparatus, end_ns, seed):
        while drawn_ns < exposed_ns:
            light_ns = drawn_ns + round(1e9 * NOMINAL_DISPLAY_LATENCY_S)
            left, right = (_pose_at(edge, light_ns) for edge in reported)
            world_from_sheet = transform(left[:3, :3], 0.5 * (left[:3, 3] + right[:3, 3]))
            pose = SheetPose(world_from_sheet, corners(left, right, height_m), None)
            marks = place_marks(projector, world_from_sheet, flat_mesh(pose), None)
            frame = Frame.model_construct(
                drawn_ns=drawn_ns, swapped_ns=0, light_ns=light_ns,
                world_from_sheet=world_from_sheet, marks_px=marks.centres_px,
                marks_world_m=marks.world_m, marks_finger_ratio=marks.finger_ratio,
            )  # fmt: skip
            waiting.append(frame)
            late_ns = round(1e9 * find_display_delay_s(frame, apparatus))
            shown.append((light_ns + late_ns, marks.centres_px))
            # Marks are placed in the first frame after they are due.
            drawn_ns += CHECK_MARKS_PERIOD_NS + round(random.uniform(0.0, 1.0 / 60.0) * 1e9)
        visible = [pixels for light_ns, pixels in shown[-8:] if light_ns <= exposed_ns]
        if not visible:
            continue
        while waiting and waiting[0].light_ns <= exposed_ns + CHECK_MARKS_PERIOD_NS:
            check.on_frame(waiting.pop(0))
        left, right = (_pose_at(edge, exposed_ns) for edge in true)
        plane = transform(left[:3, :3], 0.5 * (left[:3, 3] + right[:3, 3]))
        slopes = slopes_of(true_scene.projector.lens, visible[-1])
        rays = np.column_stack([slopes, np.ones(len(slopes))]) @ light_pose[:3, :3].T
        points = []
        for ray in rays:
            point = on_plane(light_pose[:3, 3], ray, plane)[0]
            in_left = apply(left_from_world, point[None])
            in_right = apply(camera.right_from_left, in_left)
            pixels = [
                pixels_of(lens, one[0, :2] / one[0, 2]) + PIXEL_NOISE_PX * random.standard_normal(2)
                for lens, one in ((camera.left, in_left), (camera.right, in_right))
            ]
            found = measure(geometry, pixels[0], pixels[1], covariance=np.eye(2))
            if found is not None:
                points.append(found.point_world)
        at_ns = stamp_ns + round(1e9 * added_s)
        check.on_points(points, np.zeros(3), at_ns)
        latency = check.results(camera_checked=True).get("display_latency")
        if latency is not None:
            values.append((1e-9 * at_ns, latency.value))
    return values


def _pose_at(edge: SampledMotion, at_ns: int) -> Floats:
    """Return the pose (4, 4) of a clamped edge at a time, ns."""
    row = edge.interpolate(np.array([at_ns]))[0]
    y, z = row[3:6] / np.linalg.norm(row[3:6]), row[6:9] / np.linalg.norm(row[6:9])
    return transform(np.column_stack([np.cross(y, z), y, z]), row[:3])


def _add_check_marks(scene: Scene) -> Projector:
    """Return the projector with check marks on the whole sheet."""
    assert scene.projector is not None
    sheet = scene.sheet
    places = tuple(
        (x * sheet.width_m, y * sheet.height_m) for x in CHECK_PLACES for y in CHECK_PLACES if x
    )
    return scene.projector.model_copy(update={"check_marks_sheet_m": places})
