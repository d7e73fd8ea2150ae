"""Test arms of other dimensions and layouts: RV-2FR in closed form, and a UR5e from a URDF."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from flexsheet.launch.experiments import simulated_time
from flexsheet.launch.experiments.simulated_time import follow_in_simulated_time
from flexsheet.launch.objects.arm_models import UrdfError, read_urdf
from flexsheet.launch.plans.documents import BadInputError
from flexsheet.launch.plans.plan import load_scene
from flexsheet.messages.scene import RV_1A, RV_2FR, JointChain, Scene
from flexsheet.messages.types import FingerPath
from flexsheet.nodes.arm_bridge.closed_form import ClosedFormKinematics
from flexsheet.nodes.arm_bridge.geometry import ArmGeometry
from flexsheet.nodes.arm_bridge.joint_chain import NumericKinematics, UnreachableError
from flexsheet.nodes.arm_bridge.path_check import Alignment, PathCheckRequest, check_path
from flexsheet.nodes.arm_bridge.reach import SheetPoses, find_best_reach, plan_path
from flexsheet.nodes.models.motion import SheetMotion
from flexsheet.nodes.models.rigid import transform, transform_from_rpy
from flexsheet.nodes.twin.arms import ArmMechanics

Floats = NDArray[np.float64]

ROOT = Path(__file__).resolve().parent.parent
SCENES = ROOT / "launch" / "scenes"
URDF = ROOT / "launch" / "arms" / "ur5e.urdf"

UR5E_DH = (
    (0.1625, 0.0, np.pi / 2),
    (0.0, -0.425, 0.0),
    (0.0, -0.3922, 0.0),
    (0.1333, 0.0, np.pi / 2),
    (0.0997, 0.0, -np.pi / 2),
    (0.0996, 0.0, 0.0),
)
"""Published Denavit-Hartenberg parameters of the UR5e: d (m), a (m), alpha (rad) of each joint."""

START_DEG = (156.0, -71.0, 135.0, 116.0, -66.0, 107.0)


def scene_text(model: str, x_m: float, y_m: float) -> str:
    """Return the scene of the cylinder with two arms of a model, at other base positions."""
    text = (SCENES / "cylinder.yaml").read_text(encoding="utf-8")
    for sign in ("-", ""):
        old = f"    world_from_base: {{position_m: [{sign}0.5, -0.45, 0.0]"
        assert old in text
        new = f"    model: {model}\n    world_from_base: {{position_m: [{sign}{x_m}, {y_m}, 0.0]"
        text = text.replace(old, new)
    return text


def write_scene(folder: Path, model: str, x_m: float, y_m: float) -> Path:
    path = folder / "scene.yaml"
    path.write_text(scene_text(model, x_m, y_m), encoding="utf-8")
    return path


def ur5e_model(start_deg: tuple[float, ...] = START_DEG) -> str:
    start = ", ".join(f"{angle:.6f}" for angle in np.radians(start_deg))
    return f"{{urdf: {URDF}, base: base_link, tip: tool0, start_rad: [{start}]}}"


@pytest.fixture(scope="module", params=["rv-2fr", "ur5e"])
def scene(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Scene:
    folder = tmp_path_factory.mktemp("scene")
    if request.param == "rv-2fr":
        return load_scene(write_scene(folder, "rv-2fr", 0.55, -0.45))
    pytest.importorskip("yourdfpy")
    return load_scene(write_scene(folder, ur5e_model(), 0.6, -0.35))


@pytest.fixture(scope="module")
def ur5e() -> JointChain:
    pytest.importorskip("yourdfpy")
    return read_urdf(URDF, "base_link", "tool0", tuple(np.radians(START_DEG)))


def multiply_dh(joints_rad: Floats) -> Floats:
    """Return base_from_flange by the rows of the Denavit-Hartenberg table, with scipy."""
    pose = np.eye(4)
    for (d, a, alpha), angle in zip(UR5E_DH, joints_rad, strict=True):
        about_z = Rotation.from_rotvec([0.0, 0.0, angle]).as_matrix()
        about_x = Rotation.from_rotvec([alpha, 0.0, 0.0]).as_matrix()
        pose = pose @ transform(about_z, [0.0, 0.0, d]) @ transform(about_x, [a, 0.0, 0.0])
    return pose


def test_the_urdf_has_the_published_dimensions(ur5e: JointChain) -> None:
    kinematics, mechanics = NumericKinematics(ur5e), ArmMechanics(ur5e)
    for joints in np.random.default_rng(1).uniform(-np.pi, np.pi, (20, 6)):
        expected = multiply_dh(joints)
        # The published frames 1 to 3 differ from those of the URDF only by where they stand.
        assert kinematics.forward(joints) == pytest.approx(expected, abs=1e-9)
        assert mechanics.forward(joints) == pytest.approx(expected, abs=1e-9)
    assert ur5e.speed_rad_per_s == pytest.approx(np.full(6, np.pi))


def test_the_rv_2fr_has_the_reach_of_its_data_sheet() -> None:
    """The data sheet gives 504 mm to the wrist centre, and 649 mm for the long RV-2FRL."""
    assert round(1e3 * ClosedFormKinematics(RV_2FR).max_wrist_m) in {504, 505}
    long = RV_2FR.model_copy(update={"upper_arm_m": 0.31, "forearm_m": 0.335})
    assert round(1e3 * ClosedFormKinematics(long).max_wrist_m) == 649


@pytest.mark.parametrize("model", [RV_1A, RV_2FR])
def test_closed_form_chain_and_simulator_agree(model: Any) -> None:
    closed, numeric = ClosedFormKinematics(model), NumericKinematics(model.chain())
    random, mechanics = np.random.default_rng(2), ArmMechanics(model)
    low, high = np.array(model.min_rad), np.array(model.max_rad)
    for joints in random.uniform(low, high, (20, 6)):
        pose = closed.forward(joints)
        assert numeric.forward(joints) == pytest.approx(pose, abs=1e-12)
        assert mechanics.forward(joints) == pytest.approx(pose, abs=1e-12)
        for solution in closed.branches(pose, model.start_rad):
            assert closed.forward(solution) == pytest.approx(pose, abs=1e-7)
    start = np.array(model.start_rad)
    for step in random.uniform(-0.05, 0.05, (20, 6)):
        pose = closed.forward(start + step)
        assert numeric.solve_next_joints(pose, start) == pytest.approx(start + step, abs=1e-6)
        assert closed.solve_next_joints(pose, start) == pytest.approx(start + step, abs=1e-6)


def test_the_jacobian_is_the_derivative_of_the_pose(ur5e: JointChain) -> None:
    kinematics, step_rad = NumericKinematics(ur5e), 1e-6
    joints = np.random.default_rng(3).uniform(-np.pi, np.pi, (5, 6))
    for slopes, one in zip(kinematics.jacobian(joints), joints, strict=True):
        for joint, change in enumerate(step_rad * np.eye(6)):
            before, after = multiply_dh(one - change), multiply_dh(one + change)
            spin = Rotation.from_matrix(after[:3, :3] @ before[:3, :3].T).as_rotvec()
            moved = np.concatenate([after[:3, 3] - before[:3, 3], spin]) / (2.0 * step_rad)
            assert slopes[:, joint] == pytest.approx(moved, abs=1e-7)


def test_all_solutions_of_a_pose_are_distinct_and_include_the_joints(ur5e: JointChain) -> None:
    kinematics, start = NumericKinematics(ur5e), np.radians(START_DEG)
    pose = multiply_dh(start)
    found = kinematics.solve_all(pose)
    assert found[0] == pytest.approx(start, abs=1e-6)
    assert len(found) == 8
    for joints in found:
        assert multiply_dh(joints) == pytest.approx(pose, abs=1e-6)


@pytest.mark.parametrize(
    ("change", "limit", "text"),
    [
        ([1.2, 0.0, 0.0], "reach", "out of the arm's reach"),
        ([np.nan, 0.0, 0.0], "reach", "not finite"),
    ],
)
def test_a_pose_out_of_reach_is_a_typed_error(
    ur5e: JointChain, change: list[float], limit: str, text: str
) -> None:
    kinematics, start = NumericKinematics(ur5e), np.radians(START_DEG)
    pose = multiply_dh(start)
    pose[:3, 3] += np.sign(pose[:3, 3]) * change
    with pytest.raises(UnreachableError, match=text) as raised:
        kinematics.solve_next_joints(pose, start)
    assert raised.value.limit == limit


def test_a_joint_out_of_range_is_a_typed_error(ur5e: JointChain) -> None:
    start = np.radians(START_DEG)
    narrow = ur5e.model_copy(update={"max_rad": (*ur5e.max_rad[:2], 2.4, *ur5e.max_rad[3:])})
    kinematics = NumericKinematics(narrow)
    goal = start + 0.1 * np.eye(6)[2]
    with pytest.raises(UnreachableError, match="J3 would be at") as raised:
        kinematics.solve_next_joints(multiply_dh(goal), start)
    assert raised.value.limit == "J3"


@pytest.mark.parametrize("joint", [4, 2])
def test_a_singular_pose_is_a_typed_error(ur5e: JointChain, joint: int) -> None:
    """At a wrist angle of 0 two axes are parallel; at an elbow angle of 0 the arm is straight."""
    kinematics = NumericKinematics(ur5e)
    singular = np.radians(START_DEG)
    singular[joint] = 0.0
    near = singular.copy()
    near[joint] = 0.02
    with pytest.raises(UnreachableError) as raised:
        kinematics.solve_next_joints(multiply_dh(singular), near)
    assert raised.value.limit == "singularity"
    margins = kinematics.singularity_margins(np.array([singular, np.radians(START_DEG)]))
    assert margins["singularity"][0] < 0.0 < margins["singularity"][1]


def sheet(position_m: Any, tilt_rad: float = 0.0, stretch: float = 1.04) -> SheetMotion:
    return SheetMotion(
        transform_from_rpy(position_m, [tilt_rad, 0.0, 0.0]), np.zeros(6), stretch, 0.0
    )


def test_both_arms_reach_the_strokes_on_one_branch(scene: Scene) -> None:
    left, right = ArmGeometry(scene, "left"), ArmGeometry(scene, "right")
    poses = [
        sheet([0.0, y, z], tilt).world_from_sheet
        for y in (-0.05, 0.0, 0.05)
        for z in (-0.02, 0.02)
        for tilt in (-0.5, 0.0, 0.5)
    ]
    twists = np.zeros((len(poses), 1, 6))
    twists[:, 0, 1] = 0.05
    samples = SheetPoses(np.array(poses), np.full(len(poses), 1.04), twists)
    for arm, other in ((left, right), (right, left)):
        reach = find_best_reach(arm, other, samples)
        assert reach.trackable.all()
        for pose, joints in zip(samples.world_from_sheet, reach.joints_rad, strict=True):
            edge = arm.world_from_edge(joints)
            half = 0.5 * 1.04 * scene.sheet.width_m * (-1.0 if arm.left else 1.0)
            assert edge[:3, 3] == pytest.approx(pose[:3, 3] + half * pose[:3, 0], abs=1e-6)


def test_a_path_is_checked_as_for_other_arms(scene: Scene) -> None:
    left, right = ArmGeometry(scene, "left"), ArmGeometry(scene, "right")
    start, goal = sheet([0.0, 0.0, 0.0], stretch=1.02), sheet([0.0, 0.06, 0.02], 0.5, 1.05)
    joints = [arm.joints_for_sheet(start, arm.start_rad) for arm in (left, right)]
    assert isinstance(check_path(left, right, PathCheckRequest(start, goal, *joints)), Alignment)
    path = plan_path(left, right, [start, goal], left_rad=joints[0], right_rad=joints[1])
    assert path[-1].sheet.world_from_sheet == pytest.approx(goal.world_from_sheet)
    far = sheet([0.0, 0.9, 0.0])
    blocked = check_path(left, right, PathCheckRequest(start, far, *joints))
    assert isinstance(blocked, str)
    assert "no path" in blocked


def test_two_arms_hold_the_sheet_and_stroke_within_their_limits(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The loop of camera, tracking, planner, limiter and simulated servos, in simulated time."""
    commands: dict[str, list[tuple[float, Floats]]] = {"left": [], "right": []}

    class RecordedArm(simulated_time.SimulatedArm):
        def command(self, target: Any, valid_at_s: float, now_s: float, step_s: float) -> None:
            super().command(target, valid_at_s, now_s, step_s)
            commands[self._geometry.side].append((step_s, self._commanded_rad))

    monkeypatch.setattr(simulated_time, "SimulatedArm", RecordedArm)
    times_s = np.linspace(0.0, 2.0, 61)
    angle = np.radians(8.0) * np.sin(2.0 * np.pi * times_s / 2.0)
    radius_m = 0.0353553
    positions = np.column_stack(
        [np.zeros(61), radius_m * np.sin(angle), radius_m * (np.cos(angle) - 1.0)]
    )
    path = FingerPath(
        label="stroke",
        times_s=times_s,
        positions_world_m=positions,
        wander_m=0.0,
        tremor_m=0.0,
        joined_by="spline",
    )
    found = follow_in_simulated_time(scene, path)
    assert found["following_ratio"] == 1.0
    assert found["contact"]["true_delta_d_mm"]["mean"] < 0.25
    assert found["contact"]["true_delta_theta_deg"]["mean"] < 0.5
    for side, rows in commands.items():
        geometry = ArmGeometry(scene, side)  # type: ignore[arg-type]
        model, true_arm = geometry.model, ArmMechanics(getattr(scene.arms, side).model)
        steps_s = np.array([step_s for step_s, _ in rows])[1:]
        joints = np.array([joints_rad for _, joints_rad in rows])
        assert (joints >= model.min_rad).all()
        assert (joints <= model.max_rad).all()
        speeds = np.abs(np.diff(joints, axis=0)) / steps_s[:, None]
        assert (speeds <= np.array(model.speed_rad_per_s)).all()
        assert speeds.max() > 0.05
        points = np.array(
            [(true_arm.forward(one) @ geometry.flange_from_edge)[:3, 3] for one in joints]
        )
        tool = np.linalg.norm(np.diff(points, axis=0), axis=1) / steps_s
        assert tool.max() <= scene.arms.max_tool_speed_m_per_s


@pytest.mark.parametrize(
    ("model", "text"),
    [
        ("rv-9x", 'unknown arm "rv-9x"'),
        ("{urdf: none.urdf, base: a, tip: b, start_rad: [0, 0, 0, 0, 0, 0]}", "check the path"),
        (ur5e_model().replace("tool0", "tool9"), "no chain of joints leads from link"),
        (
            ur5e_model().replace("tip: tool0", "tip: wrist_2_link"),
            "has 5 rotary joints; 6 are required",
        ),
        (ur5e_model((0.0, 0.0, 200.0, 0.0, 0.0, 0.0)), "J3: start_rad"),
    ],
)
def test_an_unusable_model_names_the_key(tmp_path: Path, model: str, text: str) -> None:
    pytest.importorskip("yourdfpy")
    with pytest.raises(BadInputError, match=text) as raised:
        load_scene(write_scene(tmp_path, model, 0.6, -0.35))
    assert "arms.left.model" in str(raised.value)


@pytest.mark.parametrize(
    ("old", "new", "text"),
    [
        ("<", "", "the file is not valid URDF"),
        ('type="revolute"', 'type="prismatic"', "only independent rotary joints"),
        (' velocity="3.141592653589793"', "", "velocity"),
        ('<axis xyz="0 0 1"/>', '<axis xyz="0 0 0"/>', "the axis is zero; give a direction"),
    ],
)
def test_an_unusable_urdf_says_what_is_wrong(tmp_path: Path, old: str, new: str, text: str) -> None:
    pytest.importorskip("yourdfpy")
    path = tmp_path / "arm.urdf"
    path.write_text(URDF.read_text(encoding="utf-8").replace(old, new, 1), encoding="utf-8")
    with pytest.raises(UrdfError, match=text):
        read_urdf(path, "base_link", "tool0", tuple(np.radians(START_DEG)))
