"""Simulate tracking, planning and both arms in simulated time, without running nodes.

The nodes' methods are called at the simulated times at which the nodes would call them. These are
the exposure, the arrival of the image, the time when the sheet target takes effect, and each arm
cycle. The results are reproducible, and do not depend on the load of the computer. The path check
before the first motion, the synchronization of the arms, and stops are not simulated. Images are
simulated only on request. The soft body applies no force, so the sheet's stretch does not change.

The ground truth comes from the simulator: camera, servos, flange compliance and sheet surface.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from flexsheet.launch.experiments.followed import summarize_path
from flexsheet.launch.experiments.node_calibrations import NodeCalibrations
from flexsheet.launch.experiments.stroke import (
    SampledMotion,
    StrokeRecording,
    make_edge_row,
    make_motion,
    object_pose,
    sheet_errors,
    stroke_path,
    stroke_window_s,
    summary,
)
from flexsheet.launch.experiments.true_geometry import place_edges
from flexsheet.messages.apparatus import Apparatus, ArmTruth, CameraTruth, nominal_apparatus
from flexsheet.messages.base import Header, Message
from flexsheet.messages.clock import VirtualClock
from flexsheet.messages.scene import Scene
from flexsheet.messages.topics import Topic
from flexsheet.messages.types import FingerPath, Fingertip, Phase, Side, SoftBody, StereoPair
from flexsheet.nodes.arm_bridge.geometry import ArmGeometry
from flexsheet.nodes.arm_bridge.goal import FOLLOW_BOUNDS, extrapolate_goal
from flexsheet.nodes.arm_bridge.limiter import limit_velocity
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.models.hand_loop import OffsetBoundsTable
from flexsheet.nodes.models.interpolation import interpolate_path
from flexsheet.nodes.models.motion import SheetMotion, follow_sheet
from flexsheet.nodes.models.rigid import apply, inverse, pose_matrix
from flexsheet.nodes.models.servo_lag import LagBounds, ServoLagEstimator
from flexsheet.nodes.models.shapes import make_shape
from flexsheet.nodes.planner.compliance_controller import ComplianceController
from flexsheet.nodes.planner.parameters import PlannerParameters
from flexsheet.nodes.planner.sheet_force import make_force_model
from flexsheet.nodes.planner.timing import update_horizon_s
from flexsheet.nodes.planner.trajectory import PlannedStep, SheetTrajectoryPlanner
from flexsheet.nodes.triangulator.node import Triangulator
from flexsheet.nodes.triangulator.parameters import TriangulatorParameters
from flexsheet.nodes.triangulator.tracking import (
    PREDICTION_STEP_S,
    Tracker,
    TrackingSettings,
    make_horizons_s,
)
from flexsheet.nodes.triangulator.triangulation import StereoGeometry, measure
from flexsheet.nodes.twin import rig
from flexsheet.nodes.twin.arms import ArmMechanics, PlacedArm, Servo
from flexsheet.nodes.twin.clutter import CLUTTER
from flexsheet.nodes.twin.finger import FingerMotion, find_tremor_m, join_points
from flexsheet.nodes.twin.hand import CoupledFinger, EdgeTrack, VoluntaryPath
from flexsheet.nodes.twin.nail import Nail
from flexsheet.nodes.twin.pixels import TwinCamera
from flexsheet.nodes.twin.sheet_pull import SheetPull
from flexsheet.nodes.twin.sheet_surface import SheetSurface
from flexsheet.nodes.twin.truth import apply_apparatus

CYCLE_S = 0.0071
"""The period of the commands to the arms, in seconds."""

READ_OUT_S, COMPUTING_S, SENDING_S = 0.004, 0.002, 0.001
"""The durations (s) of camera read-out, computation and transmission, which are successive.

The read-out duration applies unless the true hardware parameters (the apparatus) define it. The
computation ends when the target is published. The transmission ends when an arm command uses the
target.
"""

PIXEL_NOISE_PX = 0.02
PREDICTION_S = 0.12
SERVO_LAG_S = 0.025
"""The servo lag (s) of simulated arms if the true hardware parameters do not define it."""

MAX_LAG_S, MAX_EXTRAPOLATION_S = 0.1, 0.06
"""The maximum measured servo lag, and the maximum extrapolation time of a target, in seconds.

The arm bridges use the same values.
"""

SETTLING_S = 2.0
"""The time (s) for which the finger rests at the start, so that the sheet can reach it."""


@dataclass(frozen=True, slots=True)
class LoopSettings:
    """The settings of a simulation run.

    planner: parameters of the planner, with their names as keys.
    lag_known: whether the nodes that control the arms know the true servo lag; otherwise they
        measure it.
    computing_s: time from the end of the camera's read-out to the published target.
    calibrations: calibrated parameters that the nodes use. If None, the nodes know camera, marker
        and exposure times exactly.
    with_images: whether the marker is detected in rendered images; otherwise noise is added to the
        true pixels of the marker.
    """

    seed: int = 0
    planner: Mapping[str, Any] = field(default_factory=dict)
    lag_known: bool = False
    computing_s: float = COMPUTING_S
    calibrations: NodeCalibrations | None = None
    with_images: bool = False


class MeasuredFinger:
    """A simulated camera that measures noisy marker pixels and tracks the finger."""

    def __init__(self, scene: Scene, apparatus: Apparatus, settings: LoopSettings) -> None:
        given, self._truth = settings.calibrations, apparatus.camera
        self._geometry = StereoGeometry.of(scene.camera, None if given is None else given.stereo)
        if given is None:
            self._camera, self._truth = scene.camera, CameraTruth()
            self._marker_m = self._believed_marker_m = np.zeros(3)
            self._stamp_offset_s = 0.0
        else:
            self._camera = rig.make_true_camera(apply_apparatus(scene, apparatus).camera)
            self._marker_m = Nail.of(apparatus.finger).marker_offset_m
            self._believed_marker_m = given.find_marker_offset_m(scene)
            self._stamp_offset_s = given.stamp_offset_s
        self._left_from_world = inverse(pose_matrix(self._camera.world_from_left))
        self._random = np.random.default_rng(settings.seed)
        speed_m_per_s = scene.finger.max_speed_m_per_s
        self._tracker = Tracker(TrackingSettings(speed_m_per_s))
        self._horizons_s = make_horizons_s(PREDICTION_S)

    def predict_path(self, at_ns: int, position_world: Floats, velocity: Floats) -> Floats:
        """Simulate a measurement of the finger, and return its predicted positions (n, 3), in m.

        The simulated cameras expose their images slightly after the timestamp `at_ns`.

        position_world, velocity: true position (m) and velocity (m/s) of the finger at the
            timestamp, (3,).
        """
        truth, random = self._truth, self._random
        late_s = truth.stamp_offset_s - self._stamp_offset_s
        if truth.exposure_jitter_s:
            late_s += truth.exposure_jitter_s * float(random.standard_normal())
        marker = position_world + self._marker_m
        markers = marker + np.array([[late_s], [late_s + truth.skew_s]]) * velocity
        pixels = [
            exact + PIXEL_NOISE_PX * random.standard_normal(2)
            for exact in rig.stereo_pixels(self._camera, self._left_from_world, markers)
        ]
        covariance = PIXEL_NOISE_PX**2 * np.eye(2)
        found = measure(self._geometry, *pixels, covariance=covariance)
        if found is not None:
            pad = found.point_world - self._believed_marker_m
            self._tracker.update(at_ns, pad, found.covariance)
        return self._tracker.predict_at(at_ns, self._horizons_s).path


class FilmedFinger:
    """A simulated camera that takes images, with the triangulator node that detects the finger."""

    def __init__(self, scene: Scene, apparatus: Apparatus, settings: LoopSettings) -> None:
        true_scene, self._truth = apply_apparatus(scene, apparatus), apparatus.camera
        self._exposure_s = scene.camera.exposure_s
        self._random = np.random.default_rng(settings.seed)
        self._camera = TwinCamera(
            rig.make_true_camera(true_scene.camera),
            finger_radius_m=true_scene.finger.radius_m,
            seed=settings.seed,
            clutter=CLUTTER["lab"],
            nail=Nail.of(apparatus.finger),
            skew_s=apparatus.camera.skew_s,
        )
        self._found: Fingertip | None = None
        self._node = Triangulator(
            TriangulatorParameters(), name="triangulator", clock=VirtualClock(), send=self._keep
        )
        given = settings.calibrations or NodeCalibrations()
        self._node.calibration, self._node.marker_calibration = given.stereo, given.marker
        self._node.on_scene(scene, self._stamp(0))

    def _keep(self, _: Topic, message: Message, __: Header) -> None:
        if isinstance(message, Fingertip):
            self._found = message

    @staticmethod
    def _stamp(at_ns: int) -> Header:
        return Header(1, at_ns, at_ns, "virtual", "camera", 1)

    def predict_path(self, at_ns: int, position_world: Floats, velocity: Floats) -> Floats:
        """Take images of the finger at a timestamp, and return its predicted positions (n, 3), m.

        position_world, velocity: true position (m) and velocity (m/s) of the finger at the
            timestamp, (3,).
        """
        late_s = self._truth.stamp_offset_s
        if self._truth.exposure_jitter_s:
            late_s += self._truth.exposure_jitter_s * float(self._random.standard_normal())
        left, right = self._camera.picture(
            lambda offset_s: position_world + (late_s + offset_s) * velocity,
            exposure_s=self._exposure_s,
            time_s=1e-9 * at_ns,
        )
        pair = StereoPair(
            device=self._camera.camera.device,
            exposure_s=self._exposure_s,
            dropped_frames=0,
            left=left,
            right=right,
        )
        processed = self._node.measure_fingertip(pair, self._stamp(at_ns))
        assert processed is not None
        assert self._found is not None
        self._node.search_surroundings(processed)
        return self._found.predicted_path_world_m


class SimulatedArm:
    """A simulated arm with a servo model, commanded by the methods of the arm bridge.

    The arm bridge is the node that controls an arm.
    """

    def __init__(
        self,
        scene: Scene,
        side: Side,
        truth: ArmTruth,
        sheet: SheetMotion,
        *,
        lag_known: bool,
        seed: int = 0,
    ) -> None:
        self._geometry = ArmGeometry(scene, side)
        self._truth, self._sheet = truth, sheet
        self._goal_rad = self._commanded_rad = self._acting_rad = self._geometry.joints_for_sheet(
            sheet, self._geometry.start_rad
        )
        self._velocity = np.zeros(6)
        lag_s = SERVO_LAG_S if truth.servo_lag_s is None else truth.servo_lag_s
        mechanics = ArmMechanics(getattr(scene.arms, side).model)
        self._servo = Servo(self._commanded_rad.copy(), lag_s, truth.backlash_rad or 0.0, mechanics)
        self._lag = ServoLagEstimator(SERVO_LAG_S, LagBounds(0.002, MAX_LAG_S))
        self._known_lag_s: float | None = None
        if lag_known:
            waits_s = 0.5 * (truth.controller_period_s or 0.0)
            self._known_lag_s = lag_s + truth.command_latency_s + waits_s
        self._pending: deque[tuple[float, Floats]] = deque()
        self._random = np.random.default_rng((seed, ("left", "right").index(side)))
        self._now_s = 0.0

    def sheet_to(self, other: SimulatedArm) -> SheetMotion:
        """Return the motion of the sheet between two arms, computed from their joint angles."""
        edges = [arm._geometry.world_from_edge(arm._servo.joints_rad) for arm in (self, other)]
        return self._geometry.sheet_between(*edges)

    @property
    def lag_s(self) -> float:
        """Return the servo lag (s), measured or known, that the node of the arm uses."""
        return self._lag.lag_s if self._known_lag_s is None else self._known_lag_s

    @property
    def lag_uncertainty_s(self) -> float | None:
        """Return the standard deviation (s) of the measured servo lag, or None if it is unknown."""
        return None if self._lag.estimate is None else self._lag.estimate.uncertainty_s

    def advance(self, until_s: float) -> Floats:
        """Advance the simulated servo to a time (s), and return the true joint angles (6,), rad."""
        while self._pending and self._pending[0][0] <= until_s:
            due_s, joints_rad = self._pending.popleft()
            self._run_servo(due_s)
            self._acting_rad = joints_rad
        self._run_servo(until_s)
        return np.asarray(self._servo.driven_rad + np.array(self._truth.joint_offsets_rad))

    def _run_servo(self, until_s: float) -> None:
        if until_s > self._now_s:
            self._servo.advance(self._acting_rad, until_s - self._now_s)
            self._now_s = until_s

    def command(self, target: SheetMotion, valid_at_s: float, now_s: float, step_s: float) -> None:
        """Send the command of one arm cycle to the servo.

        target: motion of the sheet for the time `valid_at_s`, s.
        now_s: present time.
        step_s: duration of the cycle.
        """
        goal = extrapolate_goal(
            target, now_s - valid_at_s + self.lag_s, 0.0, max_extrapolation_s=MAX_EXTRAPOLATION_S
        )
        geometry = self._geometry
        self._sheet = follow_sheet(
            self._sheet,
            goal.motion,
            bounds=FOLLOW_BOUNDS,
            edges=geometry.edge_bound,
            step_s=step_s,
        )
        goal_rad = geometry.joints_for_sheet(self._sheet, self._commanded_rad)
        self._velocity = limit_velocity(
            self._commanded_rad,
            self._velocity,
            goal_rad,
            (goal_rad - self._goal_rad) / step_s,
            limits=geometry.joint_limits,
            step_s=step_s,
        )
        self._goal_rad = goal_rad
        self._commanded_rad = self._commanded_rad + self._velocity * step_s
        due_s, period_s = now_s + self._truth.command_latency_s, self._truth.controller_period_s
        if period_s:
            due_s = math.ceil(due_s / period_s) * period_s
            if self._truth.controller_jitter_s:
                due_s += self._truth.controller_jitter_s * float(self._random.standard_normal())
                due_s = max(due_s, self._pending[-1][0] if self._pending else self._now_s)
        self._pending.append((due_s, self._commanded_rad))
        self._lag.on_command(now_s, self._commanded_rad)
        self._lag.on_measurement(now_s, self._servo.joints_rad)


class SimulatedSheet:
    """The simulated arms with the sheet between them."""

    def __init__(
        self, scene: Scene, apparatus: Apparatus, sheet: SheetMotion, settings: LoopSettings
    ) -> None:
        true_scene, truth = apply_apparatus(scene, apparatus), apparatus.arms
        known, seed = settings.lag_known, settings.seed
        self.arms = (
            SimulatedArm(scene, "left", truth.left, sheet, lag_known=known, seed=seed),
            SimulatedArm(scene, "right", truth.right, sheet, lag_known=known, seed=seed),
        )
        self._models = PlacedArm.of(true_scene.arms.left), PlacedArm.of(true_scene.arms.right)
        self._pull = SheetPull.of(true_scene.sheet, apparatus)
        self._width_m = scene.sheet.width_m
        self.rows: tuple[list[tuple[int, Floats]], ...] = ([], [])
        self.reported_rows: tuple[list[tuple[int, Floats]], ...] = ([], [])
        self.on_edges: Callable[[float, Floats, Floats], None] | None = None

    def record(self, now_s: float) -> None:
        """Advance the servos to a time (s), and record the true poses of the sheet's edges."""
        flanges = [
            model.world_from_flange(arm.advance(now_s))
            for model, arm in zip(self._models, self.arms, strict=True)
        ]
        clamps = [model.flange_from_edge for model in self._models]
        if self._pull is not None:
            flanges = list(self._pull.displace(*flanges, *clamps, time_s=now_s))
        for rows, flange, clamp in zip(self.rows, flanges, clamps, strict=True):
            rows.append((round(1e9 * now_s), make_edge_row(flange, clamp)))
        sheet = self.arms[0].sheet_to(self.arms[1])
        reported = place_edges(sheet.world_from_sheet, sheet.stretch_ratio * self._width_m)
        for rows, edge in zip(self.reported_rows, reported, strict=True):
            rows.append((round(1e9 * now_s), make_edge_row(edge, np.eye(4))))
        if self.on_edges is not None:
            left, right = (flange @ clamp for flange, clamp in zip(flanges, clamps, strict=True))
            self.on_edges(now_s, left, right)


class SimulatedLoop:
    """A simulation of camera, tracking, planner, arms and sheet in simulated time."""

    def __init__(
        self,
        scene: Scene,
        apparatus: Apparatus,
        settings: LoopSettings,
        compliance: ComplianceController,
    ) -> None:
        self._truth, self._compliance = apparatus, compliance
        parameters = PlannerParameters.model_validate(dict(settings.planner))
        self.planner = SheetTrajectoryPlanner(scene, parameters)
        self.sheet = SimulatedSheet(scene, apparatus, self.planner.motion, settings)
        track = FilmedFinger if settings.with_images else MeasuredFinger
        self._tracked = track(scene, apparatus, settings)
        self._fixed_horizon_s = parameters.prediction_horizon_s
        self.fingertip = np.zeros(3)
        self.period_s = 1.0 / (apparatus.camera.rate_hz or scene.camera.rate_hz)
        read_out_s = apparatus.camera.read_out_s
        read_out_s = READ_OUT_S if read_out_s is None else read_out_s
        self._age_s = 0.5 * scene.camera.exposure_s + read_out_s + settings.computing_s
        self._horizon_s = self._age_s + SENDING_S + SERVO_LAG_S
        if self._fixed_horizon_s is not None:
            self._horizon_s = self._fixed_horizon_s
        self._target, self._valid_at_s, self._commanded_s = self.planner.motion, 0.0, 0.0

    @property
    def delay_s(self) -> float:
        """Return the delay (s) that the planner assumes from an exposure to the sheet's motion."""
        return self._horizon_s

    def run_cycles(self, until_s: float) -> None:
        """Run the command cycles of both arms up to a time (s)."""
        while self._commanded_s + CYCLE_S < until_s:
            self._commanded_s += CYCLE_S
            self._run_cycle(self._commanded_s, CYCLE_S)

    def step(
        self, exposed_s: float, position: Floats, velocity: Floats | None = None
    ) -> PlannedStep:
        """Measure the finger at an exposure, plan the sheet's motion, and move the arms.

        position, velocity: true position (m) and velocity (m/s) of the finger at the timestamp,
        (3,). The filtered position is stored in `fingertip`.
        """
        predicted = self._tracked.predict_path(
            round(1e9 * exposed_s), position, np.zeros(3) if velocity is None else velocity
        )
        self.fingertip = predicted[0]
        arms = self.sheet.arms
        needed_s = self._age_s + SENDING_S + 0.5 * (arms[0].lag_s + arms[1].lag_s)
        before_s = self._horizon_s
        if self._fixed_horizon_s is None:
            self._horizon_s = update_horizon_s(before_s, needed_s, PREDICTION_S)
        arrives_s = exposed_s + self._age_s + SENDING_S
        self.run_cycles(arrives_s)
        planner = self.planner
        self._compliance.set_delay(self._horizon_s, in_contact=planner.in_contact)
        planned = planner.follow_finger(
            *interpolate_path(predicted, PREDICTION_STEP_S, self._horizon_s),
            self._compliance,
            self.period_s + self._horizon_s - before_s,
            predicted[0],
        )
        self._target, self._valid_at_s = planned.motion, exposed_s + self._horizon_s
        self._run_cycle(arrives_s, arrives_s - self._commanded_s)
        self._commanded_s = arrives_s
        return planned

    def _run_cycle(self, now_s: float, step_s: float) -> None:
        self.sheet.record(now_s)
        for arm in self.sheet.arms:
            arm.command(self._target, self._valid_at_s, now_s, step_s)


def follow_in_simulated_time(
    scene: Scene,
    path: FingerPath,
    apparatus: Apparatus | None = None,
    settings: LoopSettings | None = None,
) -> dict[str, Any]:
    """Simulate the sheet's motion along a finger path, and return the errors of the sheet.

    The result has the keys of `summarize_path`. The key `servo_lag_ms` contains the servo
    lags that the control nodes of both arms have measured at the end. The key
    `servo_lag_uncertainty_ms` contains their standard deviations.
    """
    truth, given = apparatus or nominal_apparatus(scene), settings or LoopSettings()
    finger = join_points(path.times_s, path.positions_world_m, path.joined_by)
    compliance = ComplianceController(scene, make_force_model(scene.sheet), "force_curve")
    loop = SimulatedLoop(scene, truth, given, compliance)
    times_ns: list[int] = []
    positions: list[Floats] = []
    following: list[bool] = []
    for number in range(1, int((finger.duration_s + SETTLING_S) / loop.period_s)):
        exposed_s = number * loop.period_s
        position = finger.at(max(exposed_s - SETTLING_S, 0.0))[0]
        step = loop.step(exposed_s, position)
        if exposed_s >= SETTLING_S:
            times_ns.append(round(1e9 * exposed_s))
            positions.append(position)
            following.append(step.command.phase not in ("hold", "wait"))
    points = np.array(positions)
    left, right = (make_motion(rows, "edge") for rows in loop.sheet.rows)
    times = np.array(times_ns, dtype=np.int64)
    shape = make_shape(dict(scene.object.geometry))
    errors = sheet_errors(
        scene,
        SampledMotion(times, points),
        (left, right),
        times,
        shape=shape,
        surface=SheetSurface.of(scene, truth),
    )
    heights_m = shape.closest(apply(inverse(object_pose(scene)), points)).height_m
    deviations_s = [arm.lag_uncertainty_s for arm in loop.sheet.arms]
    return {
        **summarize_path(*errors, heights_m, np.array(following)),
        "servo_lag_ms": [1e3 * arm.lag_s for arm in loop.sheet.arms],
        "servo_lag_uncertainty_ms": [None if one is None else 1e3 * one for one in deviations_s],
    }


def record_in_simulated_time(
    scene: Scene,
    apparatus: Apparatus,
    settings: LoopSettings,
    path: FingerPath,
    span_s: tuple[float, float],
) -> StrokeRecording:
    """Simulate a finger path with tremor, and return the same data as a recorded bag.

    span_s: interval of the path in which fingertips are recorded, s. `settings.calibrations` must
    not be None.
    """
    given = settings.calibrations
    force_model = make_force_model(scene.sheet, None if given is None else given.sheet)
    compliance = ComplianceController(scene, force_model, "force_curve")
    loop = SimulatedLoop(scene, apparatus, settings, compliance)
    motion = FingerMotion.of(apparatus.finger, path.positions_world_m[0], seed=settings.seed)
    motion = motion.followed_by(
        0.0,
        times_s=path.times_s,
        points=path.positions_world_m,
        wander_m=path.wander_m,
        tremor_m=find_tremor_m(apparatus.finger, path.tremor_m),
        max_speed_m_per_s=scene.finger.max_speed_m_per_s,
    )
    begin_s, end_s = span_s
    rows: list[tuple[int, Floats]] = []
    number, done = 0, False
    while not done:
        number += 1
        exposed_s = number * loop.period_s
        finger = motion.at(max(exposed_s - SETTLING_S, 0.0))
        loop.step(exposed_s, finger.position, finger.velocity)
        done = finger.path_done
        if begin_s <= finger.path_time_s <= end_s:
            rows.append((round(1e9 * exposed_s), np.concatenate([finger.position, loop.fingertip])))
    samples = make_motion(rows, "fingertip")
    true, measured = (
        SampledMotion(samples.times_ns, samples.values[:, columns])
        for columns in (slice(0, 3), slice(3, 6))
    )
    reported, edges = (
        (make_motion(left, "edge"), make_motion(right, "edge"))
        for left, right in (loop.sheet.reported_rows, loop.sheet.rows)
    )
    return StrokeRecording(
        scene=scene,
        fingertip=measured,
        finger=true,
        windows_ns={path.label: (int(samples.times_ns[0]), int(samples.times_ns[-1]))},
        measured_edges=reported,
        true_edges=edges,
        delays_s={},
        drops=0,
        surface=SheetSurface.of(scene, None),
        true_surface=SheetSurface.of(scene, apparatus),
    )


def stroke_in_simulated_time(
    scene: Scene, apparatus: Apparatus, settings: LoopSettings, seconds: float
) -> dict[str, dict[str, float]]:
    """Simulate the experiment `stroke` (one finger stroke); return its errors in mm and degrees.

    Keys with the prefix `true_` contain true errors. The same keys without the prefix contain the
    errors that the devices measure.

    `settings.calibrations` must not be None.
    """
    recorded = record_in_simulated_time(
        scene, apparatus, settings, stroke_path(scene, seconds), stroke_window_s(seconds)
    )
    true, measured = recorded.finger, recorded.fingertip
    results = {}
    for prefix, tip, edges, surface in (
        ("true_", true, recorded.true_edges, recorded.true_surface),
        ("", measured, recorded.measured_edges, recorded.surface),
    ):
        errors = sheet_errors(scene, tip, edges, true.times_ns, surface=surface)
        results[f"{prefix}delta_d_mm"] = summary(errors[0], 1e3)
        results[f"{prefix}delta_theta_deg"] = summary(errors[1], math.degrees(1.0))
    off = np.linalg.norm(measured.values - true.values, axis=1)
    return {**results, "fingertip_mm": summary(off, 1e3)}


@dataclass(frozen=True, slots=True)
class TouchRecording:
    """A recorded touch of a simulated hand that the sheet pushes.

    times_s (n,): times of the n exposures.
    positions_m (n, 3): true fingertip positions.
    phases (n,): contact phase of the planner.
    steps (k, 3): time (s), indentation (m) and force (N) of the sheet in each of k time steps.
    watchdog_triggers: number of oscillations that the planner stopped; None if the number is
        unknown.
    delay_s: time from an exposure to the sheet's motion.
    """

    times_s: Floats
    positions_m: Floats
    phases: list[Phase]
    steps: Floats
    watchdog_triggers: int | None
    delay_s: float


def touch_in_simulated_time(
    scene: Scene,
    path: FingerPath,
    curve: Floats,
    make_finger: Callable[[VoluntaryPath], CoupledFinger],
    *,
    bounds: OffsetBoundsTable,
    settings: LoopSettings | None = None,
) -> TouchRecording:
    """Simulate a hand that touches the sheet while the sheet's force displaces the finger.

    path: voluntary path, along which the finger would move without the force of the sheet.
    curve: (n, 2), n pairs of depth (m) and force (N) of the object.
    make_finger: function that makes the simulated finger and hand from the voluntary path.
    bounds: limits of the sheet's offset along its normal, within which the planner keeps the
        control loop stable.
    """
    voluntary = join_points(path.times_s, path.positions_world_m, path.joined_by)
    compliance = ComplianceController(
        scene, make_force_model(scene.sheet), "force_curve", bounds=bounds
    )
    compliance.update(make_soft_body(curve), in_contact=False)
    loop = SimulatedLoop(scene, nominal_apparatus(scene), settings or LoopSettings(), compliance)
    finger = make_finger(lambda at_s: voluntary.at(at_s - SETTLING_S))
    finger.log, edges = [], EdgeTrack()
    times_s, positions, phases = list[float](), list[Floats](), list[Phase]()

    def move(now_s: float, left: Floats, right: Floats) -> None:
        edges.add(now_s, left, right)
        if edges:
            finger.advance(now_s, edges)

    loop.sheet.on_edges = move
    for number in range(1, int((voluntary.duration_s + SETTLING_S + 0.5) / loop.period_s)):
        exposed_s = number * loop.period_s
        loop.run_cycles(exposed_s)
        seen = finger if not edges else finger.predict(exposed_s, edges)
        position, _ = seen.position()
        planned = loop.step(exposed_s, position)
        times_s.append(exposed_s)
        positions.append(position)
        phases.append(planned.command.phase)
    return TouchRecording(
        np.array(times_s),
        np.array(positions),
        phases,
        np.array(finger.log),
        loop.planner.watchdog_triggers,
        loop.delay_s,
    )


def make_soft_body(curve: Floats, stiffness_n_per_m: float = 0.0) -> SoftBody:
    """Return an undeformed soft body with a force curve.

    curve: (n, 2), n pairs of depth (m) and force (N).
    """
    return SoftBody(
        mesh_id="",
        method="curve",
        in_range=True,
        push_depth_m=0.0,
        force_world_n=np.zeros(3),
        stiffness_n_per_m=stiffness_n_per_m,
        force_curve=curve,
        displacement_world_m=np.zeros((0, 3), dtype=np.float32),
    )
