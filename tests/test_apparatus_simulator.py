"""Test that each parameter of the apparatus affects the simulator, and only the intended
quantity.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from flexsheet.launch.experiments.compliance import ForceReference, make_presses
from flexsheet.launch.experiments.followed import FollowedSheet
from flexsheet.launch.plans.plan import load_scene
from flexsheet.messages.apparatus import Apparatus, FingerTruth, nominal_apparatus
from flexsheet.messages.base import Header
from flexsheet.messages.clock import VirtualClock
from flexsheet.messages.types import FingerPath, Fingertip, Side, StereoPair, TwinArms, TwinFinger
from flexsheet.nodes.models.measured_period import MIN_INTERVALS, MeasuredPeriod
from flexsheet.nodes.models.rigid import pose_matrix, rotation_from_vector, transform
from flexsheet.nodes.triangulator.node import Triangulator
from flexsheet.nodes.triangulator.parameters import TriangulatorParameters
from flexsheet.nodes.twin.arms import (
    Controller,
)
from flexsheet.nodes.twin.arms_node import TwinArmsNode, TwinArmsParameters
from flexsheet.nodes.twin.eye_node import TwinEyeNode, TwinEyeParameters
from flexsheet.nodes.twin.finger_node import TwinFingerNode, TwinFingerParameters
from flexsheet.nodes.twin.membrane import TrueRubber, solve
from flexsheet.nodes.twin.mxt_controller import MxtController
from flexsheet.nodes.twin.nail import Nail
from flexsheet.nodes.twin.pixels import TwinCamera
from flexsheet.nodes.twin.rig import make_true_camera
from flexsheet.nodes.twin.sheet_pull import SheetPull, true_rubber
from flexsheet.nodes.twin.tolerance_table import Profile, sample_apparatus
from flexsheet.nodes.twin.truth import apply_apparatus
from flexsheet.nodes.twin.viewer import HeadSway
from tests.examples import long_except
from tests.node_harness import build_node
from tests.test_compliance_experiment import held

Floats = NDArray[np.float64]
ROOT = Path(__file__).resolve().parent.parent
SCENE = load_scene(ROOT / "launch" / "scenes" / "cylinder.yaml")
JOINTS = np.radians([0.0, 25.0, 118.0, 0.0, -54.0, 0.0])
START_NS = 1_000_000_000
CALIBRATION = ROOT / "launch" / "calibrations" / "twin-bumblebee.yaml"


def apparatus(**sections: Any) -> Apparatus:
    return Apparatus.model_validate({"scene": SCENE.name, **sections})


def header(sequence: int = 1, at_ns: int = START_NS) -> Header:
    return Header(sequence, at_ns, at_ns, "virtual", "test", 1)


@dataclass(frozen=True, slots=True)
class Shot:
    """The messages that the finger simulator published for one exposure."""

    truth: TwinFinger
    pair: StereoPair

    def differs(self, other: Shot) -> set[str]:
        found = set()
        if self.truth.model_dump_json() != other.truth.model_dump_json():
            found.add("truth")
        for side in ("left", "right"):
            if not np.array_equal(getattr(self.pair, side), getattr(other.pair, side)):
                found.add(side)
        return found


async def expose(given: Apparatus | None) -> Shot:
    """Simulate exposures of a finger with tremor and slow random motion."""
    clock = VirtualClock(START_NS)
    sent: list[Any] = []
    node = TwinFingerNode(
        TwinFingerParameters(apparatus=given, clutter="none"),
        name="twin",
        clock=clock,
        send=lambda _topic, message, _header: sent.append(message),
    )
    await node.setup()
    try:
        await node.step("scene", SCENE, header())
        path = FingerPath(
            label="line",
            times_s=np.array([0.0, 1.0]),
            positions_world_m=np.array([[0.0, 0.0, 0.05], [0.1, 0.0, 0.05]]),
            wander_m=5e-4,
            tremor_m=5e-5,
        )
        await node.step("twin__finger_path", path, header())
        pair = node.expose(START_NS + 1_200_000_000)
        assert node.errors == 0, node.last_error
    finally:
        await node.close()
    return Shot(next(one for one in sent if isinstance(one, TwinFinger)), pair)


async def test_a_nominal_apparatus_changes_nothing() -> None:
    assert (await expose(nominal_apparatus(SCENE))).differs(await expose(None)) == set()


@pytest.mark.parametrize(
    ("sections", "changed"),
    [
        ({"camera": {"position_offset_m": [1e-3, 0, 0]}}, {"left", "right"}),
        ({"camera": {"rotation_offset_rad": [0, 2e-3, 0]}}, {"left", "right"}),
        ({"camera": {"right": {"focal_ratio": 1.01}}}, {"right"}),
        ({"camera": {"right": {"centre_offset_px": [2, 0]}}}, {"right"}),
        ({"camera": {"right": {"radial_offset": [0.05, 0]}}}, {"right"}),
        ({"camera": {"right_position_offset_m": [1e-3, 0, 0]}}, {"right"}),
        ({"camera": {"right_rotation_offset_rad": [0, 2e-3, 0]}}, {"right"}),
        ({"camera": {"skew_s": 0.01}}, {"right"}),
        ({"camera": {"stamp_offset_s": 0.01}}, {"left", "right"}),
        ({"camera": {"exposure_jitter_s": 0.01}}, {"left", "right"}),
        ({"finger": {"radius_offset_m": 2e-3}}, {"left", "right"}),
        ({"finger": {"marker_from_pad_m": [0, 0, 0.01]}}, {"left", "right"}),
        ({"finger": {"marker_shape": "disc"}}, {"left", "right"}),
        ({"finger": {"finger_tilt_rad": [0.2, 0.2]}}, {"left", "right"}),
        ({"finger": {"tremor_rms_m": 3e-4}}, {"left", "right", "truth"}),
        ({"finger": {"tremor_frequency_hz": 6.0}}, {"left", "right", "truth"}),
        ({"finger": {"voluntary_bandwidth_hz": 3.0}}, {"left", "right", "truth"}),
        ({"sheet": {"modulus_ratio": 1.2}, "eyes": {"sway_m": 4e-3}}, set()),
        ({"projector": {"latency_offset_s": 0.01}}, set()),
    ],
)
async def test_the_finger_and_its_camera(sections: dict[str, Any], changed: set[str]) -> None:
    assert (await expose(apparatus(**sections))).differs(await expose(None)) == changed


async def test_the_rate_and_read_out_are_those_of_the_apparatus() -> None:
    given = apparatus(camera={"rate_hz": 15.0, "read_out_s": 0.06})
    harness = build_node(TwinFingerNode, TwinFingerParameters(apparatus=given, clutter="none"))
    await harness.step("scene", SCENE)
    assert harness.node.period_ns == pytest.approx(1e9 / 15.0, abs=1)
    assert harness.node._read_out_s == 0.06


def light_centre(camera: TwinCamera, tip: Floats) -> list[Floats]:
    """Return the centre of the marker's light in both images, weighted by brightness."""
    lit, unlit = (
        camera.levels(lambda _: tip, exposure_s=0.004, marker=marker) for marker in (True, False)
    )
    centres = []
    for with_marker, without in zip(lit, unlit, strict=True):
        share = (with_marker - without) / (camera.sensor.marker_level - without)
        y, x = np.mgrid[: share.shape[0], : share.shape[1]]
        centres.append(np.array([(share * x).sum(), (share * y).sum()]) / share.sum())
    return centres


def light_amount(camera: TwinCamera, tip: Floats) -> float:
    """Return the number of pixels that the marker covers in the left image."""
    lit, unlit = (
        camera.levels(lambda _: tip, exposure_s=0.004, marker=marker)[0] for marker in (True, False)
    )
    return float(((lit - unlit) / (camera.sensor.marker_level - unlit)).sum())


def camera_with(finger: FingerTruth | None) -> TwinCamera:
    return TwinCamera(
        make_true_camera(SCENE.camera),
        finger_radius_m=0.007,
        seed=1,
        nail=None if finger is None else Nail.of(finger),
    )


@pytest.mark.parametrize("shape", ["ball", "disc"])
def test_the_marker_is_on_the_nail(shape: Any) -> None:
    """Without tilt, the finger's z axis points up and towards the user, and the y axis to the
    right.
    """
    tip = np.array([0.01, 0.0, 0.02])
    finger = FingerTruth(marker_from_pad_m=(0.0, 0.002, 0.01), marker_shape=shape)
    nail = np.array([0.002, 0.00866, 0.005]) / np.array([1.0, 0.99998, 0.99998])
    camera = camera_with(finger)
    for eye, centre in zip(camera.eyes, light_centre(camera, tip), strict=True):
        assert np.abs(centre - eye.see(tip + nail)[0]).max() < 0.1


def test_a_flat_marker_is_seen_as_an_ellipse() -> None:
    """The area of the marker is that of a ball times the cosine of the angle to the ray."""
    tip = np.array([0.0, 0.0, 0.02])
    ball = light_amount(camera_with(None), tip)
    areas, cosines = [], []
    for tilts_rad in ((0.0, 0.0), (0.0, 0.9), (1.0, 0.0)):
        finger = FingerTruth(marker_shape="disc", marker_tilt_rad=tilts_rad)
        camera = camera_with(finger)
        areas.append(light_amount(camera, tip) / ball)
        ray = camera.eyes[0].camera_from_world[:3, :3].T @ (
            -(camera.eyes[0].camera_from_world @ np.append(tip, 1.0))[:3]
        )
        normal = camera.nail.marker_normal
        assert normal is not None
        cosines.append(float(normal @ ray / np.linalg.norm(ray)))
    assert areas == pytest.approx(cosines, rel=0.04)
    assert min(areas) < 0.75 * max(areas)


def test_a_flat_marker_that_faces_away_is_not_seen() -> None:
    finger = FingerTruth(marker_shape="disc", marker_tilt_rad=(np.pi, 0.0))
    assert light_amount(camera_with(finger), np.array([0.0, 0.0, 0.02])) == 0.0


async def arms_of(given: Apparatus | None, joints_file: Path) -> tuple[TwinArms, TwinArmsNode]:
    """Start the simulated arms, and return their first true poses."""
    sent: list[TwinArms] = []
    node = TwinArmsNode(
        TwinArmsParameters(
            left_port=0, right_port=0, joints_file=str(joints_file), apparatus=given
        ),
        name="twin",
        clock=VirtualClock(START_NS),
        send=lambda _topic, message, _header: sent.append(message),
    )
    await node.setup()
    try:
        await node.step("scene", SCENE, header())
        assert node.errors == 0, node.last_error
        node.clock.move_to(START_NS + 1_000_000)
        await node.cycle()
    finally:
        await node.close()
    return sent[-1], node


async def test_nominal_arms_stand_where_the_scenes_do(tmp_path: Path) -> None:
    plain, _ = await arms_of(None, tmp_path / "one")
    nominal, _ = await arms_of(nominal_apparatus(SCENE), tmp_path / "other")
    assert plain.model_dump_json() == nominal.model_dump_json()


async def test_bases_and_joints_move_the_flanges(tmp_path: Path) -> None:
    file = tmp_path / "joints"
    plain, _ = await arms_of(None, file)
    shift, turn = [1e-3, -2e-3, 0.5e-3], [0.0, 0.0, 0.01]
    left = {"base_position_offset_m": shift, "base_rotation_offset_rad": turn}
    moved, _ = await arms_of(apparatus(arms={"left": left}), file)
    base = np.array(SCENE.arms.left.world_from_base.position_m)
    rotation = rotation_from_vector(turn)
    expected = transform(rotation, base + np.array(shift) - rotation @ base)
    wanted = expected @ plain.world_from_flange_left
    assert moved.world_from_flange_left == pytest.approx(wanted, abs=1e-9)
    assert np.array_equal(moved.world_from_flange_right, plain.world_from_flange_right)

    offsets = [1e-3, 0, 0, 0, 0, 0]
    moved, _ = await arms_of(apparatus(arms={"right": {"joint_offsets_rad": offsets}}), file)
    assert moved.joints_right_rad - plain.joints_right_rad == pytest.approx(offsets, abs=1e-12)
    assert np.array_equal(moved.world_from_flange_left, plain.world_from_flange_left)
    assert not np.allclose(moved.world_from_flange_right, plain.world_from_flange_right)


async def test_flanges_yield_to_the_sheets_pull(tmp_path: Path) -> None:
    file = tmp_path / "joints"
    plain, _ = await arms_of(None, file)
    given = apparatus(arms={"left": {"flange_compliance_m_per_n": 100e-6}})
    moved, _ = await arms_of(given, file)
    assert np.array_equal(moved.world_from_flange_right, plain.world_from_flange_right)
    yielded = moved.world_from_flange_left[:3, 3] - plain.world_from_flange_left[:3, 3]
    half = 0.5 * SCENE.sheet.width_m * SCENE.sheet.min_stretch_ratio
    left = transform(np.eye(3), np.array([-half, 0.0, 0.0]) + yielded)
    right = transform(np.eye(3), [half, 0.0, 0.0])
    force = solve(true_rubber(SCENE.sheet, given), left, right).left_force_n
    assert yielded[0] > 0.0, "towards the sheet"
    assert yielded == pytest.approx(100e-6 * force, rel=0.04, abs=1e-6)


def test_rigid_arms_need_no_pull() -> None:
    assert SheetPull.of(SCENE.sheet, nominal_apparatus(SCENE)) is None


async def test_controllers_are_those_of_the_apparatus(tmp_path: Path) -> None:
    left = {"servo_lag_s": 0.05, "backlash_rad": 5e-4, "controller_period_s": 0.0071}
    _, node = await arms_of(apparatus(arms={"left": left}), tmp_path / "joints")
    servos = {side: server.controller.servo for side, server in node.servers.items()}
    assert (servos["left"].lag_s, servos["left"].backlash_rad) == (0.05, 5e-4)
    given = TwinArmsParameters()
    assert (servos["right"].lag_s, servos["right"].backlash_rad) == (
        given.servo_lag_s,
        given.backlash_rad,
    )


def move_time_s(**options: float) -> float:
    """Return the time from a set-point until the arm begins to move, with a resolution of 0.1
    ms.
    """
    arm = Controller(JOINTS, servo_lag_s=0.025, noise_rad=0.0, watchdog_s=1.0, **options)
    arm.advance(0.0005)
    arm.state, arm.wanted_rad = 1, JOINTS + 0.1
    arm._pending.append((arm._due_s(), arm.wanted_rad))
    arm._acting_rad = JOINTS
    for step in range(1000):
        arm.advance(1e-4)
        if (arm.servo.joints_rad != JOINTS).any():
            return 1e-4 * step
    raise AssertionError("the arm does not move")


def test_set_points_act_after_latency_and_at_the_cycle() -> None:
    assert move_time_s() == pytest.approx(0.0, abs=1.1e-4)
    assert move_time_s(latency_s=0.01) == pytest.approx(0.01, abs=1.1e-4)
    assert move_time_s(cycle_s=0.0071) == pytest.approx(0.0066, abs=1.1e-4)
    jittered = {
        round(move_time_s(cycle_s=0.0071, cycle_jitter_s=1e-3, seed=n), 4) for n in range(4)
    }
    assert len(jittered) > 1


def test_the_makers_controller_has_latency_and_another_cycle() -> None:
    def controller(**options: float) -> MxtController:
        return MxtController(
            JOINTS, servo_lag_s=0.02, filter_s=0.0, noise_rad=0.0, timeout_s=1.0, **options
        )

    def moving_after_s(arm: MxtController) -> float:
        arm.wanted_rad = JOINTS + 0.01
        for step in range(1000):
            arm.advance(1e-3)
            if (arm.servo.joints_rad != JOINTS).any():
                return 1e-3 * step
        raise AssertionError("the arm does not move")

    assert moving_after_s(controller()) == pytest.approx(0.0071, abs=2e-3)
    assert moving_after_s(controller(cycle_s=0.002)) == pytest.approx(0.002, abs=2e-3)


def test_a_thickness_gradient_shifts_the_middle_and_keeps_the_balance() -> None:
    edges = [transform(np.eye(3), [0.126 * side, 0.0, 0.0]) for side in (-1.0, 1.0)]
    plain, uneven = (
        solve(TrueRubber(0.24, 0.24, 0.001, 1e6, thickness_gradient=gradient), *edges, cells=8)
        for gradient in ((0.0, 0.0), (0.2, 0.0))
    )
    middle = uneven.positions[4, 4] - plain.positions[4, 4]
    assert middle[0] > 1e-4, "the thin left side stretches more"
    assert uneven.left_force_n == pytest.approx(-uneven.right_force_n, abs=1e-3)
    assert uneven.left_force_n[0] == pytest.approx(plain.left_force_n[0], rel=0.02)


async def test_the_eye_is_where_the_apparatus_has_it() -> None:
    given = apparatus(
        eyes={"centre_offset_m": [1e-3, 0, 0], "interocular_offset_m": -4e-3},
        projector={"position_offset_m": [0, 0, 2e-3]},
    )
    for viewpoint, x_m in (("centre", 1e-3), ("left", 1e-3 - 0.03), ("right", 1e-3 + 0.03)):
        harness = build_node(TwinEyeNode, TwinEyeParameters(apparatus=given, viewpoint=viewpoint))
        await harness.node.setup()
        try:
            true = harness.node._true_scene(SCENE)
            assert harness.node._true_scene(SCENE) is true
            believed = SCENE.projector.world_from_projector.position_m
            moved = true.projector.world_from_projector.position_m - believed
            assert moved == pytest.approx([0, 0, 2e-3])
            eye = harness.node._true_eye(true, 0.0, viewpoint)
            assert eye == pytest.approx([x_m, 0.0, 0.4])
        finally:
            await harness.node.close()


async def test_the_eye_of_a_nominal_apparatus_is_the_scenes() -> None:
    harness = build_node(TwinEyeNode, TwinEyeParameters(apparatus=nominal_apparatus(SCENE)))
    await harness.node.setup()
    try:
        true = harness.node._true_scene(SCENE)
        assert true.model_dump_json() == SCENE.model_dump_json()
        eye = harness.node._true_eye(true, 3.0, "centre")
        assert np.array_equal(eye, SCENE.eyes.centre_world_m)
    finally:
        await harness.node.close()


def test_the_head_sways_as_much_as_stated() -> None:
    sway = HeadSway.drawn(apparatus(eyes={"sway_m": 4e-3}).eyes, 3)
    assert sway is not None
    places = np.array([sway.at(float(time_s)) for time_s in np.arange(0.0, 600.0, 0.5)])
    assert places.std(axis=0) == pytest.approx([4e-3] * 3, rel=0.15)
    assert HeadSway.drawn(apparatus().eyes, 3) is None


def test_reports_take_the_true_edges() -> None:
    given = apparatus(arms={"left": {"edge_position_offset_m": [0, 0, 1e-3]}})
    still = np.eye(4)
    arms = TwinArms(joints_left_rad=np.zeros(6), joints_right_rad=np.zeros(6),
                    world_from_flange_left=still, world_from_flange_right=still)  # fmt: skip
    for order in ((SCENE, given), (given, SCENE)):
        sheet = FollowedSheet()
        for number, message in enumerate((*order, arms, arms)):
            sheet.add(message, START_NS + number)
        for arm, off_m in ((SCENE.arms.left, 1e-3), (SCENE.arms.right, 0.0)):
            side: Side = "left" if arm is SCENE.arms.left else "right"
            edge = sheet._make_edge(SCENE, "true", side)
            assert edge is not None
            believed = pose_matrix(arm.flange_from_edge)
            expected = believed[:3, 3] + [0.0, 0.0, off_m]
            assert edge.values[0, :3] == pytest.approx(expected)
            assert edge.values[0, 3:] == pytest.approx(believed[:3, 1:3].T.ravel())


def test_the_presented_force_is_that_of_the_true_sheet() -> None:
    press = make_presses(SCENE)[0]
    recorded = held(press, 0.02, 0.0)
    plain = ForceReference(recorded).evaluate(0, press)
    given = apparatus(sheet={"modulus_ratio": 1.2})
    stiff = type(recorded)(
        scene=recorded.scene,
        finger=recorded.finger,
        windows_ns={},
        edges=recorded.edges,
        curve_times_ns=recorded.curve_times_ns,
        curves=recorded.curves,
        methods=recorded.methods,
        apparatus=given,
    )
    felt = ForceReference(stiff).evaluate(0, press)
    assert felt.felt_n == pytest.approx(1.2 * plain.felt_n, rel=1e-3)
    assert felt.wanted_n == plain.wanted_n


def test_the_true_sheet_has_the_slipped_width() -> None:
    given = apparatus(sheet={"clamp_slip_m": [1e-3, 2e-3], "thickness_gradient_ratio": [0.03, 0]})
    rubber = true_rubber(apply_apparatus(SCENE, given).sheet, given)
    assert rubber.width_m == pytest.approx(SCENE.sheet.width_m + 3e-3)
    assert rubber.thickness_gradient == (0.03, 0.0)


def test_a_bridge_learns_the_period_of_another_camera() -> None:
    period = MeasuredPeriod(1.0 / 60.0)
    for number in range(1, 20):
        assert period.add(round(number * 1e9 / 58.0)) == 1.0 / 60.0
    period = MeasuredPeriod(1.0 / 60.0)
    learnt = [period.add(round(number * 1e9 / 15.0)) for number in range(1, 20)]
    assert learnt[MIN_INTERVALS - 2] == 1.0 / 60.0
    assert learnt[-1] == pytest.approx(1.0 / 15.0, rel=1e-6)
    assert period.add(round(30e9)) == pytest.approx(1.0 / 15.0, rel=1e-6), "an interruption"


async def test_a_track_outlasts_a_missed_image_at_any_rate() -> None:
    harness = build_node(Triangulator, TriangulatorParameters())
    await harness.step("scene", SCENE)
    for number in range(1, 20):
        harness.node._adapt_timeout(round(number * 1e9 / 60.0))
    assert harness.node.tracker.settings.track_timeout_s == 0.1
    for number in range(1, 20):
        harness.node._adapt_timeout(round(1e9 + number * 1e9 / 15.0))
    assert harness.node.tracker.settings.track_timeout_s == pytest.approx(2.5 / 15.0, rel=1e-6)


async def test_a_frame_may_be_exposed_while_the_last_is_read_out() -> None:
    fast = build_node(TwinFingerNode, TwinFingerParameters(clutter="none"))
    given = apparatus(camera={"rate_hz": 48.0, "read_out_s": 0.01875})
    slow = build_node(TwinFingerNode, TwinFingerParameters(clutter="none", apparatus=given))
    for harness in (fast, slow):
        await harness.step("scene", SCENE)
    assert fast.node._max_late_ns == 4_000_000
    assert slow.node._max_late_ns == pytest.approx(4e6 + 22.75e6 - 1e9 / 48.0, abs=2)


@pytest.mark.parametrize("seed", long_except([0, 1, 2], 2))
async def test_slow_cameras_are_tracked(seed: int) -> None:
    """A calibrated camera measures the flat marker for each seed. Seed 2 has a rate of 15 Hz."""
    given = sample_apparatus(SCENE, seed, profile=Profile.PAPER, calibrated=True)
    rate_hz = given.camera.rate_hz
    assert rate_hz is not None
    assert rate_hz <= (15.0 if seed == 2 else 48.0)
    finger = build_node(TwinFingerNode, TwinFingerParameters(apparatus=given, clutter="lab"))
    tracker = build_node(Triangulator, TriangulatorParameters(calibration=CALIBRATION))
    await finger.node.setup()
    await tracker.node.setup()
    try:
        await finger.step("scene", SCENE)
        await tracker.step("scene", SCENE)
        for number in range(1, 12):
            stamp_ns = 1_000 + round(number * 1e9 / rate_hz)
            pair = finger.node.expose(stamp_ns)
            header = Header(number, stamp_ns, stamp_ns, "clock", "test", 1)
            await tracker.node.step("stereo", pair, header)
            assert tracker.node.errors == 0, tracker.node.last_error
    finally:
        await finger.node.close()
        await tracker.node.close()
    truth = finger.messages(TwinFinger)[-1][0].position_world_m
    tip = tracker.messages(Fingertip)[-1][0]
    assert (tip.valid, tip.state) == (True, "tracking"), tip.reason
    assert np.linalg.norm(tip.position_world_m - truth) < 1.5e-3
