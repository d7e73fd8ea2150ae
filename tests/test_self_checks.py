"""Test that wrong assumptions about the apparatus are named, and that a nominal one is not.

The truth is projected by the optics of a drawn apparatus, with its calibration's residuals and
noise; the checks see only what a triangulator or a bridge sees.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flexsheet.launch.health.doctor_hosts import check_apparatus
from flexsheet.launch.health.probe import HostProbe, Reachability
from flexsheet.launch.plans.plan import load_scene
from flexsheet.messages.notes import BUSY_FIRST, SELF_CHECK_REMEDIES
from flexsheet.messages.sheet_calibration import Fitted, SheetCalibration
from flexsheet.messages.types import SelfCheck, StereoPair
from flexsheet.nodes.arm_bridge.self_checks import ServoCheck
from flexsheet.nodes.console import panels
from flexsheet.nodes.models.rigid import transform
from flexsheet.nodes.models.servo_lag import LagBounds, ServoLagEstimator
from flexsheet.nodes.planner.self_checks import check_stiffness
from flexsheet.nodes.triangulator.node import Triangulator
from flexsheet.nodes.triangulator.parameters import TriangulatorParameters
from flexsheet.nodes.triangulator.self_checks import CameraCheck
from flexsheet.nodes.triangulator.triangulation import StereoGeometry, dlt
from flexsheet.nodes.twin.arms import Servo
from flexsheet.nodes.twin.clutter import CLUTTER, FixedPoint, SecondMarker
from flexsheet.nodes.twin.pixels import TwinCamera
from flexsheet.nodes.twin.tolerance_table import sample_apparatus
from flexsheet.nodes.twin.truth import apply_apparatus
from tests.console_parts import status_of
from tests.node_harness import build_node

SCENE = load_scene(Path(__file__).parents[1] / "launch" / "scenes" / "cylinder.yaml")
GEOMETRY = StereoGeometry.of(SCENE.camera)
MARKS = np.array([[-0.09, 0.06, 0.0], [0.09, 0.06, 0.0], [0.0, -0.09, 0.02]])
TOUCH_POINT = np.array([0.06, -0.06, 0.02])
FINGER_HZ, MARKS_EVERY = 20, 2
NOISE_PX = 0.05
"""Standard deviation of a marker's centre per coordinate."""

NOMINAL_SEEDS = (100, 101, 102, 103)
FAULT_SEEDS = (110, 111, 112)
TEN_MINUTES_S = 600.0
"""Virtual time."""


@dataclass(frozen=True)
class Fault:
    """Change of a calibrated apparatus.

    camera_m, right_camera_m: shift of the stereo camera (world) and of its right camera (its
    frame). marker_m: shift of the marker.
    """

    camera_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    right_camera_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    marker_m: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass
class View:
    """Points that a triangulator finds for true points, with reprojection errors."""

    seed: int
    fault: Fault
    random: np.random.Generator = field(init=False)
    true: StereoGeometry = field(init=False)

    def __post_init__(self) -> None:
        self.random = np.random.default_rng((self.seed, 20))
        apparatus = sample_apparatus(SCENE, self.seed, calibrated=True)
        camera = apply_apparatus(SCENE, apparatus).camera
        moved = camera.world_from_left.model_copy(
            update={"position_m": camera.world_from_left.position_m + np.array(self.fault.camera_m)}
        )
        right = transform(np.eye(3), np.array(self.fault.right_camera_m)) @ camera.right_from_left
        self.true = StereoGeometry.of(
            camera.model_copy(update={"world_from_left": moved, "right_from_left": right})
        )

    def see(self, points: Any) -> tuple[Any, Any]:
        """Return the triangulated points (n, 3) and reprojection errors (n,)."""
        left, right = (
            pixels + NOISE_PX * self.random.standard_normal(pixels.shape)
            for pixels in self.true.project(points)
        )
        found = dlt(*GEOMETRY.normalize(left, right), GEOMETRY.right_from_left)
        world = found @ GEOMETRY.world_from_left[:3, :3].T + GEOMETRY.world_from_left[:3, 3]
        again = np.concatenate(GEOMETRY.project(world), axis=1)
        errors = again - np.concatenate([left, right], axis=1)
        return world, np.sqrt(0.5 * (errors**2).sum(axis=1))


def move_finger(seed: int, times_s: Any) -> Any:
    """Return true fingertips (n, 3): strokes, and a rest of 1.5 s at the known point every 5 s."""
    random = np.random.default_rng((seed, 21))
    tremor = 6e-5 * random.standard_normal((len(times_s), 3))
    pace = 2.0 * np.pi * random.uniform(0.2, 0.6, 3)
    stroke = np.array([0.04, 0.03, 0.01]) * np.sin(np.outer(times_s, pace)) + [0.0, 0.0, 0.04]
    phase = times_s % 5.0
    weight = np.clip(np.minimum(phase - 2.0, 4.5 - phase) / 0.5, 0.0, 1.0)[:, None]
    # A finger that rests on a rigid point does not tremble.
    return (1.0 - weight) * (stroke + tremor) + weight * TOUCH_POINT


def observe(seed: int, seconds: float, fault: Fault) -> Iterator[tuple[SelfCheck, ...]]:
    """Yield the checks twice a second."""
    view, check = View(seed, fault), CameraCheck(MARKS, TOUCH_POINT)
    times_s = np.arange(0.0, seconds, 1.0 / FINGER_HZ)
    # What a calibration of the marker leaves (docs/apparatus.md).
    left_m = 3e-4 * np.clip(np.random.default_rng((seed, 22)).standard_normal(3), -3.0, 3.0)
    fingers, errors_px = view.see(move_finger(seed, times_s) + np.array(fault.marker_m) + left_m)
    marks, _ = view.see(np.repeat(MARKS[None], len(times_s), axis=0).reshape(-1, 3))
    marks = marks.reshape(-1, len(MARKS), 3)
    for number, time_s in enumerate(times_s):
        at_ns = round(1e9 * time_s)
        check.on_finger(fingers[number], float(errors_px[number]), at_ns)
        if number % MARKS_EVERY == 0:
            check.on_marks(list(marks[number]), at_ns)
        if number % (FINGER_HZ // 2) == 0:
            yield check.results()


def suspected(checks: tuple[SelfCheck, ...]) -> set[str]:
    return {one.cause for one in checks if one.suspected}


@pytest.mark.parametrize("seed", FAULT_SEEDS)
@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_a_camera_shift_of_1_mm_is_named_within_ten_seconds(
    seed: int, axis: int, sign: float
) -> None:
    shift = [0.0, 0.0, 0.0]
    shift[axis] = sign * 1e-3
    *_, last = observe(seed, 10.0, Fault(camera_m=(shift[0], shift[1], shift[2])))
    assert suspected(last) == {"camera_moved"}


@pytest.mark.parametrize("seed", FAULT_SEEDS)
@pytest.mark.parametrize("axis", range(3))
def test_a_marker_shift_of_3_mm_is_named_within_ten_seconds(seed: int, axis: int) -> None:
    shift = [0.0, 0.0, 0.0]
    shift[axis] = 3e-3
    *_, last = observe(seed, 10.0, Fault(marker_m=(shift[0], shift[1], shift[2])))
    assert suspected(last) == {"marker_offset"}


@pytest.mark.parametrize("seed", FAULT_SEEDS)
def test_a_moved_camera_of_the_pair_is_named(seed: int) -> None:
    *_, last = observe(seed, 10.0, Fault(right_camera_m=(0.0, 1e-3, 0.0)))
    assert "cameras_misaligned" in suspected(last)
    assert "marker_offset" not in suspected(last)


@pytest.mark.parametrize(
    "seed",
    [
        NOMINAL_SEEDS[0],
        *(pytest.param(seed, marks=pytest.mark.long) for seed in NOMINAL_SEEDS[1:]),
    ],
)
def test_a_calibrated_camera_and_marker_raise_no_suspicion_in_ten_minutes(seed: int) -> None:
    reports = list(observe(seed, TEN_MINUTES_S, Fault()))
    assert {one.cause for one in reports[-1]} == {
        "cameras_misaligned",
        "camera_moved",
        "marker_offset",
    }
    assert not set().union(*map(suspected, reports))


def test_one_mark_that_moves_alone_is_not_a_moved_camera() -> None:
    check = CameraCheck(MARKS, None)
    for number in range(100):
        check.on_marks([MARKS[0] + [3e-3, 0.0, 0.0], MARKS[1], MARKS[2]], 100_000_000 * number)
    (result,) = check.results()
    assert (result.cause, result.suspected) == ("camera_moved", False)


def test_without_marks_and_touches_only_the_reprojection_is_checked() -> None:
    check = CameraCheck(np.zeros((0, 3)), None)
    for number in range(100):
        check.on_finger(TOUCH_POINT, 0.03, 50_000_000 * number)
        check.on_marks([MARKS[0]], 50_000_000 * number)
    assert [one.cause for one in check.results()] == ["cameras_misaligned"]


def test_a_suspicion_ends_when_its_cause_ends() -> None:
    check = CameraCheck(MARKS, None)
    for number in range(400):
        shift = 1e-3 if number < 100 else 0.0
        check.on_marks(list(MARKS + shift), 100_000_000 * number)
        if number == 99:
            assert suspected(check.results()) == {"camera_moved"}
    assert suspected(check.results()) == set()


CONFIGURED_LAG_S = 0.03


def move_arm(
    seed: int, seconds: float, extra_lag_s: float, *, round_trip_s: float = 0.001
) -> Iterator[tuple[SelfCheck, ...]]:
    """Yield the checks of an arm whose servo has the drawn lag and an extra one.

    round_trip_s: time until the bridge reads the answer, which the arm sends at once.
    """
    random = np.random.default_rng((seed, 23))
    truth = sample_apparatus(SCENE, seed, calibrated=True).arms.left
    assert truth.servo_lag_s is not None
    assert truth.controller_period_s is not None
    late_s = truth.command_latency_s + 0.5 * truth.controller_period_s + 0.5 / 140.0 + extra_lag_s
    pace = 2.0 * np.pi * random.uniform(0.2, 1.2, (3, 6))
    phase, size = random.uniform(0.0, 2.0 * np.pi, (3, 6)), random.uniform(0.005, 0.03, (3, 6))
    # Response of 1 / (1 + s L / 2)^2, a critically damped servo, to each sine.
    half = 0.5 * pace * truth.servo_lag_s
    amplitude, delay = size / (1.0 + half**2), 2.0 * np.arctan(half)
    estimator = ServoLagEstimator(CONFIGURED_LAG_S, LagBounds(0.002, 0.1))
    check, now_s = ServoCheck("left", CONFIGURED_LAG_S, 1.0 / 70.0), 0.0
    results: tuple[SelfCheck, ...] = ()
    number = 0
    while now_s < seconds:
        number += 1
        now_s += random.uniform(0.8, 1.2) / 70.0
        estimator.on_command(now_s, (size * np.sin(pace * now_s + phase)).sum(axis=0))
        read_s, answer_s = now_s + 0.0001, now_s + 0.5 * round_trip_s
        moved = (amplitude * np.sin(pace * (read_s - late_s) + phase - delay)).sum(axis=0)
        estimator.on_measurement(answer_s, moved + 5e-6 * random.standard_normal(6))
        results = check.update(estimator.estimate, round(1e9 * answer_s))
        if number % 35 == 0:
            yield results


@pytest.mark.parametrize("seed", FAULT_SEEDS)
def test_a_lag_that_is_20_ms_longer_is_named_within_ten_seconds(seed: int) -> None:
    *_, last = move_arm(seed, 10.0, 0.02)
    assert suspected(last) == {"servo_lag"}


@pytest.mark.parametrize(
    ("seed", "minutes"),
    [(100, 2), *(pytest.param(seed, 10, marks=pytest.mark.long) for seed in (100, 101))],
)
def test_a_calibrated_arm_raises_no_suspicion(seed: int, minutes: int) -> None:
    reports = list(move_arm(seed, 60.0 * minutes, 0.0))
    assert {one.cause for one in reports[-1]} == {"servo_lag", "arm_not_following"}
    assert not set().union(*map(suspected, reports))


def test_late_answers_of_an_overloaded_computer_are_not_a_shorter_lag() -> None:
    *_, last = move_arm(100, 20.0, 0.0, round_trip_s=0.024)
    assert suspected(last) == set()
    *_, last = move_arm(110, 10.0, 0.03, round_trip_s=0.008)
    assert suspected(last) == {"servo_lag"}


MOTION_S = 10.0


def move_arm_on_overloaded_computer(
    seed: int, *, stall_ratio: float, stall_s: float, extra_lag_s: float
) -> list[tuple[SelfCheck, ...]]:
    """Return the checks of an arm that moves for MOTION_S and then rests for the same time.

    During the motion, bridge and simulator wait for a processor core. stall_ratio: fraction of
    their steps that wait. stall_s: mean waiting time.
    """
    random, period_s = np.random.default_rng((seed, 24)), 1.0 / 140.0
    pace = 2.0 * np.pi * random.uniform(0.2, 1.2, (3, 6))
    phase, size = random.uniform(0.0, 2.0 * np.pi, (3, 6)), random.uniform(0.005, 0.03, (3, 6))
    servo = Servo((size * np.sin(phase)).sum(axis=0), CONFIGURED_LAG_S + extra_lag_s)
    configured_s = CONFIGURED_LAG_S + 0.5 * period_s
    estimator = ServoLagEstimator(configured_s, LagBounds(0.002, 0.1))
    check = ServoCheck("left", configured_s, period_s)

    def wait_s() -> float:
        is_stalled = sent_s < MOTION_S and random.random() < stall_ratio
        return 1e-4 + (float(random.exponential(stall_s)) if is_stalled else 0.0)

    results = []
    active, servo_s, sent_s, received_s, checked_s = servo.joints_rad, 0.0, 0.0, 0.0, 0.0
    while sent_s < 2.0 * MOTION_S:
        sent_s = max(sent_s + period_s, received_s) + wait_s()
        command = (size * np.sin(pace * min(sent_s, MOTION_S) + phase)).sum(axis=0)
        arrived_s = sent_s + wait_s()
        servo.advance(active, arrived_s - servo_s)
        servo_s, active = arrived_s, command
        received_s = arrived_s + wait_s()
        estimator.on_command(sent_s, command)
        estimator.on_measurement(0.5 * (sent_s + received_s), servo.joints_rad)
        if received_s > checked_s + 0.1:
            checked_s = received_s
            results.append(check.update(estimator.estimate, round(1e9 * received_s)))
    return results


@pytest.mark.parametrize(("seed", "stall_ratio"), [(100, 0.3), (101, 0.3), (102, 0.4)])
@pytest.mark.parametrize(("extra_lag_s", "causes"), [(0.0, set()), (0.02, {"servo_lag"})])
def test_an_overloaded_computer_is_not_a_longer_lag(
    seed: int, stall_ratio: float, extra_lag_s: float, causes: set[str]
) -> None:
    results = move_arm_on_overloaded_computer(
        seed, stall_ratio=stall_ratio, stall_s=0.01, extra_lag_s=extra_lag_s
    )
    lag = next(one for one in results[-1] if one.cause == "servo_lag")
    assert lag.value - lag.expected == pytest.approx(extra_lag_s, abs=0.005)
    assert set().union(*map(suspected, results)) == causes


async def test_the_triangulator_names_a_moved_camera_from_images() -> None:
    """Fixed beads in the images are the reference marks; they are found beside the finger."""
    beads = tuple(SecondMarker(FixedPoint((float(x), float(y), float(z)))) for x, y, z in MARKS)
    camera = SCENE.camera
    pose = camera.world_from_left.model_copy(
        update={"position_m": camera.world_from_left.position_m + np.array([1e-3, 0.0, 0.0])}
    )
    reported = []
    for true in (camera, camera.model_copy(update={"world_from_left": pose})):
        shown = TwinCamera(
            true, finger_radius_m=0.007, seed=100, clutter=replace(CLUTTER["none"], markers=beads)
        )
        bench = build_node(
            Triangulator,
            TriangulatorParameters(reference_marks_world_m=[tuple(one) for one in MARKS.tolist()]),
        )
        await bench.node.setup()
        await bench.step("scene", SCENE)
        for number in range(150):
            bench.clock.move_to(bench.clock.now_ns() + 33_333_333)
            time_s = number / 30.0
            left, right = shown.picture(
                lambda _, time_s=time_s: np.array([0.03 * np.sin(2.0 * time_s), 0.0, 0.04]),
                exposure_s=0.004,
                time_s=time_s,
            )
            pair = StereoPair(
                device=true.device, exposure_s=0.004, dropped_frames=0, left=left, right=right
            )
            await bench.step("stereo", pair, sequence=number + 1)
        reported.append({one.cause: one for one in bench.node.self_checks})
    nominal, moved = reported
    assert not any(one.suspected for one in nominal.values())
    assert nominal["camera_moved"].value < 3e-4
    assert moved["camera_moved"].suspected
    assert moved["camera_moved"].value == pytest.approx(1e-3, abs=2e-4)
    assert not moved["cameras_misaligned"].suspected


def test_doctor_and_console_show_the_cause_with_its_remedy() -> None:
    check = SelfCheck(
        cause="servo_lag",
        subject="left",
        unit="s",
        value=0.052,
        expected=0.03,
        threshold=0.01,
        suspected=True,
    )
    status = status_of("arm_left_bridge").model_copy(update={"self_checks": (check,)})
    text = panels.make_nodes_table({status.node: (status, 0.0)})
    assert "measured 52.00 ms, expected 30.00" in text
    assert "servo_lag_s" in text
    probe = HostProbe("main", Reachability.RESPONDING, nodes={status.node: status})
    (finding,) = check_apparatus(probe)
    assert (finding.check, finding.state) == ("self-check", "warning")
    assert finding.remedy == SELF_CHECK_REMEDIES["servo_lag"]
    assert finding.remedy.startswith(BUSY_FIRST)
    fine = status.model_copy(
        update={"self_checks": (check.model_copy(update={"suspected": False}),)}
    )
    probe = HostProbe("main", Reachability.RESPONDING, nodes={status.node: fine})
    assert [one.state for one in check_apparatus(probe)] == ["ok"]


@pytest.mark.parametrize(("ratio", "suspected"), [(0.8, True), (0.97, False), (1.2, True)])
def test_a_wrong_modulus_is_named_where_the_sheet_is_calibrated(
    ratio: float, suspected: bool
) -> None:
    sheet = SCENE.sheet
    calibration = SheetCalibration.model_construct(
        modulus_thickness_n_per_m=Fitted(
            value=ratio * sheet.young_modulus_pa * sheet.thickness_m, standard_deviation=2.0
        )
    )
    (check,) = check_stiffness(sheet, calibration)
    assert (check.cause, check.suspected) == ("sheet_stiffness", suspected)
    assert check_stiffness(sheet, None) == ()
