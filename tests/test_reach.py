"""Test the reach of the arms: margins of poses, paths, and the check of a scene."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from flexsheet.launch.health import layout
from flexsheet.launch.health.layout import (
    Layout,
    check_layout,
    make_layout_result,
)
from flexsheet.launch.plans.plan import load_scene
from flexsheet.messages.scene import Scene, require_cylinder
from flexsheet.nodes.arm_bridge.closed_form import (
    WRIST_NEAR_RAD,
)
from flexsheet.nodes.arm_bridge.geometry import ArmGeometry
from flexsheet.nodes.arm_bridge.reach import (
    LIMITS,
    MAX_STEP_RAD,
    SPEED_LIMITS,
    PathError,
    PathStep,
    SheetPoses,
    compute_flange_poses,
    compute_reach,
    find_best_reach,
    plan_path,
)
from flexsheet.nodes.models.motion import SheetMotion
from flexsheet.nodes.models.rigid import is_rigid, transform_from_rpy
from tests.arm_jacobian import jacobian
from tests.commands import Command
from tests.rv_1a import (
    CENTRE_RAD,
    find_branch,
    solve_next_joints,
    twin_forward,
)

Floats = NDArray[np.float64]

ROOT = Path(__file__).resolve().parent.parent
SCENE_FILE = ROOT / "launch" / "scenes" / "cylinder.yaml"
SCENE = load_scene(SCENE_FILE)
LEFT, RIGHT = ArmGeometry(SCENE, "left"), ArmGeometry(SCENE, "right")
FRONT = find_branch(CENTRE_RAD)


def sheet(position_m: Any, rpy_rad: Any = (0.0, 0.0, 0.0), stretch: float = 1.04) -> SheetMotion:
    return SheetMotion(transform_from_rpy(position_m, rpy_rad), np.zeros(6), stretch, 0.0)


def places(*motions: SheetMotion, twists: Floats | None = None) -> SheetPoses:
    return SheetPoses(
        np.array([motion.world_from_sheet for motion in motions]),
        np.array([motion.stretch_ratio for motion in motions]),
        np.empty((len(motions), 0, 6)) if twists is None else twists,
    )


def edges_by_the_twin(left_rad: Floats, right_rad: Floats) -> tuple[Floats, Floats]:
    """Return world poses of both edges by the simulator's kinematics."""
    left, right = (
        arm.world_from_base @ twin_forward(joints) @ arm.flange_from_edge
        for arm, joints in ((LEFT, left_rad), (RIGHT, right_rad))
    )
    return left, right


def turned_about_the_left_edge(yaw_rad: float) -> SheetMotion:
    """Return a left edge that rotates about the world's z; at -0.6 rad its J5 is 0."""
    turn = transform_from_rpy((0.0, 0.0, 0.0), (0.0, 0.0, yaw_rad))[:3, :3]
    half = np.array([0.5 * 1.04 * 0.24, 0.0, 0.0])
    return sheet(turn @ half - half, (0.0, 0.0, yaw_rad))


near = st.floats(-0.08, 0.08)
lean = st.floats(-0.4, 0.4)


@settings(max_examples=60)
@given(st.tuples(near, near, near), st.tuples(lean, lean, lean), st.floats(1.0, 1.08))
def test_the_joints_hold_the_sheet_by_the_twins_arms(
    position: tuple[float, ...], rpy: tuple[float, ...], stretch: float
) -> None:
    wanted = sheet(position, rpy, stretch)
    both = [
        find_best_reach(arm, other, places(wanted)) for arm, other in ((LEFT, RIGHT), (RIGHT, LEFT))
    ]
    assume(all(np.isfinite(one.joints_rad).all() for one in both))
    left, right = edges_by_the_twin(both[0].joints_rad[0], both[1].joints_rad[0])
    assert right[:3, 3] - left[:3, 3] == pytest.approx(
        0.24 * stretch * wanted.world_from_sheet[:3, 0], abs=1e-9
    )
    assert 0.5 * (left + right)[:3, 3] == pytest.approx(position, abs=1e-9)
    for edge in (left, right):
        assert edge[:3, :3] == pytest.approx(wanted.world_from_sheet[:3, :3], abs=1e-9)


def test_reach_and_paths_use_encoder_angles() -> None:
    """Limits of joint ranges apply to encoder angles, and kinematics to corrected angles."""
    offsets = np.array([0.05, -0.04, 0.03, 0.02, -0.06, 0.1])
    values = SCENE.model_dump()
    values["arms"]["left"]["joint_offsets_rad"] = offsets.tolist()
    left = ArmGeometry(Scene.model_validate(values), "left")
    wanted = sheet((0.01, 0.02, 0.0), (0.1, 0.0, 0.0))
    plain = compute_reach(LEFT, RIGHT, places(wanted), FRONT)
    offset = compute_reach(left, RIGHT, places(wanted), FRONT)
    assert offset.joints_rad == pytest.approx(plain.joints_rad - offsets, abs=1e-9)
    flange = compute_flange_poses(left, places(wanted))[0]
    assert left.world_from_flange(offset.joints_rad[0]) == pytest.approx(flange, abs=1e-9)
    assert offset.margins["wrist singularity"] == pytest.approx(plain.margins["wrist singularity"])
    moved = offset.margins["J1 range"] - plain.margins["J1 range"]
    assert abs(moved[0]) == pytest.approx(0.05, abs=1e-9)
    joints = offset.joints_rad[0], find_best_reach(RIGHT, LEFT, places(wanted)).joints_rad[0]
    goal = sheet((0.0, 0.0, 0.0))
    path = plan_path(left, RIGHT, [wanted, goal], left_rad=joints[0], right_rad=joints[1])
    end = left.world_from_flange(path[-1].left_rad)
    assert end == pytest.approx(compute_flange_poses(left, places(goal))[0], abs=1e-9)


@settings(max_examples=30)
@given(near, near, lean, st.lists(st.floats(-0.3, 0.3), min_size=6, max_size=6))
def test_speeds_are_those_of_the_jacobian(y: float, z: float, roll: float, twist: Any) -> None:
    where = places(sheet((0.0, y, z), (roll, 0.0, 0.0)), twists=np.array(twist).reshape(1, 1, 6))
    reach = compute_reach(LEFT, RIGHT, where, FRONT)
    assume(reach.margins["wrist singularity"][0] > 0.0)
    flange = compute_flange_poses(LEFT, where)[0]
    linear, angular = np.split(np.array(twist), 2)
    at_flange = linear + np.cross(angular, flange[:3, 3] - where.world_from_sheet[0, :3, 3])
    turn = LEFT.base_from_world[:3, :3]
    velocity = np.concatenate([turn @ at_flange, turn @ angular])
    rates = np.linalg.solve(jacobian(reach.joints_rad[0]), velocity)
    used = 1.0 - np.array([reach.margins[f"J{joint} speed"][0] for joint in range(1, 7)])
    assert used * LEFT.joint_limits.speed_rad_per_s == pytest.approx(np.abs(rates), abs=1e-5)


@pytest.mark.parametrize(
    ("wanted", "limit"),
    [
        (sheet((0.35, 0.0, 0.0)), "reach"),
        (sheet((0.12, 0.0, 0.0)), "J3 range"),
        (sheet((0.0, 0.0, 0.0), stretch=1.09), "edge force"),
        (sheet((0.0, 0.0, 0.0), stretch=0.3), "flange distance"),
        (turned_about_the_left_edge(-0.6), "wrist singularity"),
        (turned_about_the_left_edge(0.6), "J5 range"),
    ],
)
def test_each_limit_binds_where_it_should(wanted: SheetMotion, limit: str) -> None:
    reach = compute_reach(LEFT, RIGHT, places(sheet((0.0, 0.0, 0.0)), wanted), FRONT)
    assert reach.reachable.tolist() == [True, False]
    assert LIMITS[reach.binding[1]] == limit
    assert reach.margins[limit][1] < 0.0 < reach.margins[limit][0]


def test_the_workspace_limits_before_the_arm() -> None:
    arms = SCENE.arms.model_copy(update={"workspace_max_m": np.array([0.4, 0.3, 0.1])})
    smaller = ArmGeometry(SCENE.model_copy(update={"arms": arms}), "left")
    where = places(sheet((0.0, 0.0, 0.09)), sheet((0.0, 0.0, 0.11)))
    reach = compute_reach(smaller, RIGHT, where, FRONT)
    assert [LIMITS[one] if one >= 0 else "" for one in reach.binding] == ["", "workspace"]
    assert reach.margins["workspace"] == pytest.approx([0.01, -0.01])
    assert compute_reach(LEFT, RIGHT, where, FRONT).reachable.all()


def test_a_pose_too_fast_to_follow_is_still_reached() -> None:
    fast = np.array([[[0.0, 0.0, 0.3, 0.0, 0.0, 0.0]], [[0.0, 0.0, 0.2, 0.0, 0.0, 0.0]]])
    where = places(sheet((0.0, 0.0, 0.0)), sheet((0.0, 0.0, 0.0)), twists=fast)
    reach = compute_reach(LEFT, RIGHT, where, FRONT)
    assert reach.reachable.tolist() == [True, True]
    assert reach.trackable.tolist() == [False, True]
    assert LIMITS[reach.binding[0]] in SPEED_LIMITS
    most = LEFT.max_tool_speed
    assert reach.margins["tool speed"] == pytest.approx([1.0 - 0.3 / most, 1.0 - 0.2 / most])


def test_an_empty_list_of_poses_is_reached() -> None:
    none = SheetPoses(np.empty((0, 4, 4)), np.empty(0), np.empty((0, 2, 6)))
    assert compute_reach(LEFT, RIGHT, none, FRONT).reachable.all()


def plan(start: SheetMotion, goal: SheetMotion) -> list[PathStep]:
    left, right = (
        find_best_reach(arm, other, places(start)).joints_rad[0]
        for arm, other in ((LEFT, RIGHT), (RIGHT, LEFT))
    )
    return plan_path(LEFT, RIGHT, [start, goal], left_rad=left, right_rad=right)


def assert_sound(path: list[PathStep], start: SheetMotion, goal: SheetMotion) -> None:
    """Assert that both edges agree with the sheet along the path, without discontinuous joints."""
    assert path[0].sheet.world_from_sheet == pytest.approx(start.world_from_sheet)
    assert path[-1].sheet.world_from_sheet == pytest.approx(goal.world_from_sheet)
    assert path[-1].sheet.stretch_ratio == pytest.approx(goal.stretch_ratio)
    for step in path:
        pose = step.sheet.world_from_sheet
        assert is_rigid(pose)
        left, right = edges_by_the_twin(step.left_rad, step.right_rad)
        across = right[:3, 3] - left[:3, 3]
        assert across == pytest.approx(0.24 * step.sheet.stretch_ratio * pose[:3, 0], abs=1e-9)
        assert left[:3, :3] == pytest.approx(right[:3, :3], abs=1e-9)
    left_joints, right_joints = [step.left_rad for step in path], [step.right_rad for step in path]
    for arm, rows in ((LEFT, left_joints), (RIGHT, right_joints)):
        joints = np.array(rows)
        assert np.abs(np.diff(joints, axis=0)).max(initial=0.0) <= MAX_STEP_RAD
        assert (joints >= arm.joint_limits.min_rad).all()
        assert (joints <= arm.joint_limits.max_rad).all()
        assert (np.abs(joints[:, 4]) >= WRIST_NEAR_RAD).all()


@settings(max_examples=25, deadline=None)
@given(st.tuples(near, near, st.floats(-1.0, 1.0)), st.tuples(near, near, st.floats(-1.0, 1.0)))
def test_a_path_between_two_poses_keeps_the_edges_together(
    here: tuple[float, ...], there: tuple[float, ...]
) -> None:
    start = sheet((0.0, here[0], here[1]), (here[2], 0.0, 0.0), 1.02)
    goal = sheet((0.0, there[0], there[1]), (there[2], 0.0, 0.0), 1.07)
    assert_sound(plan(start, goal), start, goal)


def test_a_path_can_end_at_the_present_pose() -> None:
    start = sheet((0.0, 0.0, 0.0))
    assert_sound(plan(start, start), start, start)


def test_a_path_starts_with_the_given_joints() -> None:
    start, goal = sheet((0.0, 0.0, 0.0)), sheet((0.0, 0.03, 0.05), (0.4, 0.0, 0.0))
    joints = find_best_reach(LEFT, RIGHT, places(start)).joints_rad[0]
    assert plan(start, goal)[0].left_rad == pytest.approx(joints, abs=1e-9)


def test_a_blocked_path_names_the_limit_and_the_position() -> None:
    random = np.random.default_rng(0)
    for _ in range(101):  # only a detour connects the poses of the last pair
        start, goal = (
            sheet(
                random.uniform([-0.1, -0.15, -0.2], [0.1, 0.2, 0.2]),
                random.uniform([-1.2, -0.5, -0.5], [1.2, 0.5, 0.5]),
            )
            for _ in range(2)
        )
    with pytest.raises(PathError) as barred:
        plan(start, goal)
    assert barred.value.limit == "J5 range"
    assert 0.4 < barred.value.fraction < 0.6


@pytest.mark.parametrize(
    ("goal", "side", "limit"),
    [
        (sheet((0.35, 0.0, 0.0)), "left", "J3 range"),
        (sheet((-0.35, 0.0, 0.0)), "right", "J3 range"),
        (sheet((0.0, 0.0, 0.0), stretch=1.09), "left", "edge force"),
    ],
)
def test_an_impossible_path_has_a_reason(goal: SheetMotion, side: str, limit: str) -> None:
    with pytest.raises(PathError, match=f"{side} arm") as caught:
        plan(sheet((0.0, 0.0, 0.0)), goal)
    assert (caught.value.side, caught.value.limit) == (side, limit)
    assert 0.0 < caught.value.fraction <= 1.0


def test_an_arm_moved_through_the_wrists_singularity_continues_and_the_check_fails() -> None:
    # The bridge follows with a bounded error; a layout must keep clear of it all the same.
    present = find_best_reach(LEFT, RIGHT, places(turned_about_the_left_edge(0.0))).joints_rad[0]
    signs = []
    for yaw in np.linspace(0.0, -0.9, 200):
        pose = compute_flange_poses(LEFT, places(turned_about_the_left_edge(yaw)))[0]
        before, present = present, solve_next_joints(LEFT.base_from_world @ pose, present)
        assert np.abs(present - before).max() < 0.02
        signs.append(np.sign(present[4]))
    assert signs[0] == -signs[-1]
    asked = places(*(turned_about_the_left_edge(yaw) for yaw in (-0.4, -0.6)))
    assert compute_reach(LEFT, RIGHT, asked, FRONT).reachable.tolist() == [True, False]


def barred_scene() -> Scene:
    """Return a scene whose left base is so far away that many poses are not reachable."""
    content = SCENE.model_dump()
    base = content["arms"]["left"]["world_from_base"]
    base["position_m"] = base["position_m"] + np.array([-0.1, -0.05, 0.06])
    return Scene.model_validate(content)


@pytest.fixture(scope="module")
def demo() -> Layout:
    return check_layout(SCENE)


@pytest.fixture(scope="module")
def barred() -> Layout:
    return check_layout(barred_scene())


def test_the_demo_scene_is_within_reach(demo: Layout) -> None:
    assert demo.reachable
    assert demo.blocked_paths == ()
    result = make_layout_result(demo)
    assert result["fraction"] == 1.0
    assert result["fraction_at_working_speed"] == 1.0
    # Its edges are 0.12 m long each way: quick strokes round so small an object turn them too fast.
    assert SCENE.working_range.speed_m_per_s < result["speed_everywhere_m_per_s"] < 0.06
    json.dumps(result, allow_nan=False)


def test_the_samples_cover_the_working_range(demo: Layout) -> None:
    tilt, most = demo.samples.tilt_rad, SCENE.working_range.tilt_rad
    assert (tilt.min(), tilt.max()) == pytest.approx((-most, most), abs=1e-6)
    assert np.diff(np.unique(np.round(tilt, 3))).max() < 0.15
    assert demo.samples.depth_m.max() == SCENE.working_range.push_depth_m
    # Along the whole object, and rolled up and down the sheet.
    assert np.ptp(demo.samples.contact_world_m[:, 0]) == pytest.approx(0.12, abs=1e-6)
    contact = demo.samples.contact_world_m - demo.samples.poses.world_from_sheet[:, :3, 3]
    along = np.einsum("ni,ni->n", contact, demo.samples.poses.world_from_sheet[:, :3, 1])
    rolled = most * require_cylinder(SCENE).radius_m
    assert along.max() > rolled
    assert np.abs(along).max() <= SCENE.sheet.usable_half_height_m + 1e-9


def test_a_base_too_far_off_is_found_out(barred: Layout) -> None:
    assert not barred.reachable
    assert barred.right.reachable.all()
    assert not barred.left.reachable.all()
    binding = {one["limit"] for one in make_layout_result(barred)["arms"]["left"]["binding"]}
    assert {"reach", "J3 range"} <= binding


def test_the_first_limiting_pose_is_the_nearest_to_the_front(barred: Layout) -> None:
    samples, binding = barred.samples, barred.left.binding
    for one in make_layout_result(barred)["arms"]["left"]["binding"]:
        same = binding == LIMITS.index(one["limit"])
        assert abs(one["first_tilt_rad"]) == pytest.approx(
            float(np.abs(samples.tilt_rad[same]).min()), abs=1e-5
        )


def make_ball(tilt_rad: float) -> Scene:
    """Return the scene with the ball of the tutorial and another tilt."""
    content = SCENE.model_dump()
    content["object"]["geometry"] = {"shape": "sphere", "radius_m": 0.04}
    content["working_range"] = {
        "push_depth_m": 0.05,
        "tilt_rad": tilt_rad,
        "speed_m_per_s": 0.035,
    }
    return Scene.model_validate(content)


def test_a_speed_that_is_too_high_gives_a_warning(
    flexsheet: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    ball = make_ball(0.6)
    found = check_layout(ball)
    assert found.reachable
    slower = ball.working_range.model_copy(update={"speed_m_per_s": found.speed_m_per_s(1.0)})
    assert slower.speed_m_per_s < ball.working_range.speed_m_per_s
    assert check_layout(ball.model_copy(update={"working_range": slower})).followed.all()
    monkeypatch.setattr(layout, "check_layout", lambda *_: found)
    code, out, err = flexsheet("doctor", "--scene", SCENE_FILE)
    assert code == 0
    assert f"flexsheet doctor --scene {SCENE_FILE} --compliance" in err
    assert re.search(r"^warning: the arms follow \d+ mm/s at only [\d.]+ % of", out, re.M)


@pytest.mark.parametrize(
    ("geometry", "reachable"),
    [
        ({"shape": "sphere", "radius_m": 0.04}, True),
        ({"shape": "plane", "width_m": 0.1, "height_m": 0.1}, True),
        ({"shape": "rounded_box", "size_m": (0.08, 0.06, 0.05), "edge_radius_m": 0.02}, True),
        ({"shape": "ellipsoid", "semi_axes_m": (0.06, 0.04, 0.03)}, True),
    ],
)
def test_every_shape_can_be_asked(geometry: dict[str, Any], reachable: bool) -> None:
    range_ = SCENE.working_range.model_copy(update={"tilt_rad": 0.3, "push_depth_m": 0.02})
    content = SCENE.model_copy(update={"working_range": range_}).model_dump()
    content["object"]["geometry"] = geometry
    scene = Scene.model_validate(content)
    found = check_layout(scene)
    assert len(found.samples.poses) > 20
    assert found.reachable is reachable


def test_the_exit_code_of_a_reachable_scene_is_0(flexsheet: Command) -> None:
    code, out, _ = flexsheet("doctor", "--scene", SCENE_FILE, "--json")
    assert code == 0
    assert json.loads(out)["reachable"] is True


def test_the_command_fails_and_names_the_limits(
    flexsheet: Command,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    barred: Layout,
) -> None:
    def known_layout(scene: Scene, *_: object) -> Layout:
        moved, wanted = (one.arms.left.world_from_base for one in (scene, barred_scene()))
        assert moved.position_m == pytest.approx(wanted.position_m)
        return barred

    monkeypatch.setattr(layout, "check_layout", known_layout)
    far = tmp_path / "far.yaml"
    text = SCENE_FILE.read_text()
    far.write_text(text.replace("position_m: [-0.5, -0.45, 0.0]", "position_m: [-0.6, -0.5, 0.06]"))
    code, out, _ = flexsheet("doctor", "--scene", far)
    assert code == 1
    assert re.search(r"^reachable +NO$", out, re.M)
    assert re.search(r"^left +reach +[\d.]+ %", out, re.M)
    assert re.search(r"^left arm's joint solution +shoulder front, elbow ", out, re.M)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["nowhere.yaml"], "nowhere.yaml"),
    ],
)
def test_bad_input_to_the_command_is_named(
    flexsheet: Command, arguments: list[object], words: str
) -> None:
    code, _, err = flexsheet("doctor", "--scene", *arguments)
    assert code == 2
    assert words in err
