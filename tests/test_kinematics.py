"""Test the RV-1A kinematics against the simulator, on all branches and near singularities."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from flexsheet.nodes.arm_bridge.closed_form import (
    BRANCHES,
    MAX_FIXED_ERROR_RATIO,
    MAX_FREE_ROTATION_RAD,
    SHOULDER_FIXED_M,
    SHOULDER_NEAR_M,
    WRIST_FIXED_RAD,
    WRIST_NEAR_RAD,
    Branch,
)
from flexsheet.nodes.arm_bridge.joint_chain import (
    UnreachableError,
)
from flexsheet.nodes.models.rigid import rotation_from_rpy, rotation_from_vector, transform
from tests.arm_jacobian import jacobian
from tests.examples import examples
from tests.rv_1a import (
    ARM,
    CENTRE_RAD,
    ELBOW_ANGLE_RAD,
    FLANGE_M,
    JOINT_MAX_RAD,
    JOINT_MIN_RAD,
    MAX_WRIST_M,
    branches,
    find_branch,
    forward,
    inverse_kinematics,
    solve_joints_on_branch,
    solve_next_joints,
    twin_forward,
)

Floats = NDArray[np.float64]

in_range = arrays(np.float64, 6, elements=st.floats(1e-6, 1.0 - 1e-6)).map(
    lambda share: JOINT_MIN_RAD + share * (JOINT_MAX_RAD - JOINT_MIN_RAD)
)


def singularities(joints_rad: Floats) -> SimpleNamespace:
    """Return the distances (...) of joints (..., 6) from the three singularities."""
    margins = ARM.singularity_margins(joints_rad)
    return SimpleNamespace(
        shoulder_m=margins["shoulder singularity"] + SHOULDER_NEAR_M,
        elbow_rad=margins["elbow singularity"] + WRIST_NEAR_RAD,
        wrist_rad=margins["wrist singularity"] + WRIST_NEAR_RAD,
    )


any_turn = arrays(np.float64, 6, elements=st.floats(-np.pi, np.pi))


def chain(joints_rad: Floats) -> Floats:
    """Return the pose by scipy's rotations, link by link."""
    links = (
        ("z", (0.0, 0.0, 0.165 + 0.135), 0),
        ("y", (0.0, 0.0, 0.25), 1),
        ("y", (-0.09, 0.0, 0.043), 2),
        ("z", (0.0, 0.0, 0.117), 3),
        ("y", (0.0, 0.0, 0.0527), 4),
        ("z", (0.0, 0.0, 0.0193), 5),
    )
    pose = np.eye(4)
    for axis, shift, joint in links:
        link = np.eye(4)
        link[:3, :3] = Rotation.from_euler(axis, joints_rad[joint]).as_matrix()
        link[:3, 3] = link[:3, :3] @ np.array(shift)
        pose = pose @ link
    return pose


@given(in_range)
def test_forward_agrees_with_the_link_chain(joints: Floats) -> None:
    assert forward(joints) == pytest.approx(chain(joints), abs=1e-12)


def test_home_pose_by_hand() -> None:
    home = forward(np.radians([0.0, 0.0, 90.0, 0.0, 0.0, 0.0]))
    assert home[:3, 3] == pytest.approx([0.16 + 0.072, 0.0, 0.3 + 0.25 + 0.09], abs=1e-12)
    assert home[:3, 2] == pytest.approx([1.0, 0.0, 0.0], abs=1e-12)


def test_reach_is_the_catalogues() -> None:
    outstretched = forward(np.radians([0.0, 0.0, 60.0, 0.0, 0.0, 0.0]))
    wrist = outstretched[:3, 3] - 0.072 * outstretched[:3, 2]
    assert np.linalg.norm(wrist - [0.0, 0.0, 0.3]) == pytest.approx(0.4185, abs=5e-5)


@given(any_turn)
def test_forward_agrees_with_the_twins_product_of_exponentials(joints: Floats) -> None:
    assert forward(joints) == pytest.approx(twin_forward(joints), abs=1e-12)


@examples(100)
@given(any_turn, in_range)
def test_every_branch_gives_the_pose_by_the_twins_arm(joints: Floats, present: Floats) -> None:
    pose = twin_forward(joints)
    found = branches(pose, present)
    assert len(found) == 8
    for branch, solution in zip(BRANCHES, found, strict=True):
        # Nearer to the wrist's singularity than 1e-7 rad it is taken for singular.
        assert twin_forward(np.array(solution)) == pytest.approx(pose, abs=2e-7)
        assert max(abs(angle) for angle in solution) <= 2 * np.pi
        away = singularities(solution)
        if min(float(away.shoulder_m), float(away.elbow_rad), float(away.wrist_rad)) > 1e-6:
            assert find_branch(solution) == branch


@examples(50)
@given(any_turn)
def test_the_joints_themselves_are_on_their_branch(joints: Floats) -> None:
    away = singularities(joints)
    assume(min(float(away.shoulder_m), float(away.elbow_rad), float(away.wrist_rad)) > 1e-3)
    index = BRANCHES.index(find_branch(joints))
    solution = np.array(branches(forward(joints), joints)[index])
    assert np.abs(np.exp(1j * solution) - np.exp(1j * joints)).max() < 1e-7


@settings(max_examples=30)
@given(st.lists(in_range, min_size=1, max_size=4), st.sampled_from(BRANCHES))
def test_many_poses_at_once_give_what_one_by_one_gives(
    several: list[Floats], branch: Branch
) -> None:
    away = singularities(several)
    assume(min(away.shoulder_m.min(), away.wrist_rad.min()) > 1e-6)
    found = solve_joints_on_branch(np.array([forward(one) for one in several]), branch, CENTRE_RAD)
    for joints, one in zip(several, found, strict=True):
        expected = np.array(branches(forward(joints), CENTRE_RAD)[BRANCHES.index(branch)])
        assert np.abs(np.exp(1j * one) - np.exp(1j * expected)).max() < 1e-7
        if branch == find_branch(joints):
            # Whole turns are chosen so that the joints are in range, as these are.
            assert (one >= JOINT_MIN_RAD - 1e-7).all()
            assert (one <= JOINT_MAX_RAD + 1e-7).all()


def test_poses_out_of_reach_have_no_joints_on_any_branch() -> None:
    poses = np.array([forward(CENTRE_RAD), transform(np.eye(3), [0.9, 0.0, 0.3])])
    for branch in BRANCHES:
        found = solve_joints_on_branch(poses, branch, CENTRE_RAD)
        assert np.isfinite(found[0]).all()
        assert np.isnan(found[1, 1:3]).all()


@examples(100)
@given(in_range)
def test_the_present_joints_are_found_again(joints: Floats) -> None:
    solved = inverse_kinematics(forward(joints), joints)
    assert forward(solved) == pytest.approx(forward(joints), abs=1e-9)
    assert (solved >= JOINT_MIN_RAD).all()
    assert (solved <= JOINT_MAX_RAD).all()
    # Next to a singularity many joints give nearly the same pose; elsewhere only these.
    if np.linalg.svd(jacobian(joints), compute_uv=False)[-1] > 1e-3:
        assert solved == pytest.approx(joints, abs=1e-6)


@pytest.mark.parametrize("wrist_deg", [0.0, 1e-7, 1e-3])
def test_at_the_wrist_singularity_the_free_joint_stays(wrist_deg: float) -> None:
    joints = np.radians([10.0, 20.0, 100.0, 40.0, wrist_deg, -30.0])
    solved = inverse_kinematics(forward(joints), joints)
    assert forward(solved) == pytest.approx(forward(joints), abs=1e-9)
    assert solved == pytest.approx(joints, abs=1e-3)


def test_at_the_shoulder_singularity_the_first_joint_stays() -> None:
    # Elbow folded until the wrist centre is above the shoulder: J2 for the present J3.
    present = np.radians([35.0, 0.0, 120.0, 0.0, 30.0, 0.0])
    out = 0.16 * np.sin(present[2]) - 0.09 * np.cos(present[2])
    up = 0.25 + 0.09 * np.sin(present[2]) + 0.16 * np.cos(present[2])
    present[1] = -np.arctan2(out, up)
    solved = inverse_kinematics(forward(present), present)
    assert solved == pytest.approx(present, abs=1e-6)


def test_a_rotation_of_the_last_joint_past_180_degrees_continues() -> None:
    joints = np.array([0.0, 0.4, 2.0, 0.1, 0.5, np.radians(178.0)])
    for angle_deg in range(178, 200):
        joints[5] = np.radians(angle_deg)
        previous = joints - [0, 0, 0, 0, 0, np.radians(1.0)]
        assert inverse_kinematics(forward(joints), previous) == pytest.approx(joints, abs=1e-9)


@pytest.mark.parametrize(
    ("position", "limit", "words"),
    [
        ((0.9, 0.0, 0.3), "reach", "wrist would be 828 mm from the shoulder, maximum 418.5 mm"),
        (
            (0.0, 0.0, 0.31),
            "J3",
            "nearest solution has J3 at 201.5 degrees, but its range is 60 to 155",
        ),
        (
            (0.503, 0.0, 0.3),
            "J3",
            "nearest solution has J3 at 42.0 degrees, but its range is 60 to 155",
        ),
    ],
)
def test_unreachable_poses_name_the_violated_limit(
    position: tuple[float, float, float], limit: str, words: str
) -> None:
    pose = transform(rotation_from_rpy([0.0, np.pi / 2, 0.0]), position)
    for solve in (inverse_kinematics, solve_next_joints):
        with pytest.raises(UnreachableError, match=words) as caught:
            solve(pose, CENTRE_RAD)
        assert caught.value.limit == limit


def test_the_elbow_never_comes_near_its_singularity() -> None:
    # J3 ends 30 degrees before the arm is straight: moving outwards it is the range that binds.
    assert np.degrees(JOINT_MIN_RAD[2] - ELBOW_ANGLE_RAD) == pytest.approx(30.64, abs=0.01)
    assert np.degrees(ELBOW_ANGLE_RAD + np.pi - JOINT_MAX_RAD[2]) > 50.0
    rotation = rotation_from_rpy([0.0, np.pi / 2, 0.0])
    joints = inverse_kinematics(transform(rotation, [0.42, 0.0, 0.3]), CENTRE_RAD)
    for out in np.arange(0.42, MAX_WRIST_M + FLANGE_M - 1e-6, 0.0005):
        before, joints = joints, solve_next_joints(transform(rotation, [out, 0.0, 0.3]), joints)
        assert np.abs(joints - before).max() < 0.02
    assert np.degrees(joints[2]) == pytest.approx(60.0, abs=0.5)
    with pytest.raises(UnreachableError) as caught:
        solve_next_joints(transform(rotation, [MAX_WRIST_M + FLANGE_M + 1e-5, 0.0, 0.3]), joints)
    assert caught.value.limit == "J3"


def test_a_pose_that_is_not_finite_is_unreachable() -> None:
    pose = forward(CENTRE_RAD)
    pose[0, 3] = np.nan
    with pytest.raises(UnreachableError):
        inverse_kinematics(pose, CENTRE_RAD)


@pytest.mark.parametrize(
    ("joint", "angle_rad", "distance"),
    [(4, 0.0, "wrist_rad"), (2, ELBOW_ANGLE_RAD, "elbow_rad"), (1, 0.0, "shoulder_m")],
)
def test_each_singularity_is_at_distance_zero(joint: int, angle_rad: float, distance: str) -> None:
    joints = np.array([0.3, 0.4, 2.0, 0.2, 0.5, 0.1])
    joints[joint] = angle_rad
    if distance == "shoulder_m":
        joints[1] = _above_the_shoulder(joints[2])
    assert float(getattr(singularities(joints), distance)) == pytest.approx(0.0, abs=1e-12)
    assert np.linalg.det(jacobian(joints)) == pytest.approx(0.0, abs=1e-9)
    others = {"wrist_rad", "elbow_rad", "shoulder_m"} - {distance}
    assert all(float(getattr(singularities(joints), other)) > 0.01 for other in others)


def _above_the_shoulder(q3: float) -> float:
    """Return the J2 that brings the wrist centre onto the axis of J1."""
    out = 0.16 * np.sin(q3) - 0.09 * np.cos(q3)
    up = 0.25 + 0.09 * np.sin(q3) + 0.16 * np.cos(q3)
    return float(-np.arctan2(out, up))


@examples(100)
@given(in_range, arrays(np.float64, 6, elements=st.floats(-0.02, 0.02)))
def test_away_from_singularities_the_next_joints_are_exact(joints: Floats, step: Floats) -> None:
    target = np.clip(joints + step, JOINT_MIN_RAD + 1e-6, JOINT_MAX_RAD - 1e-6)
    near = [singularities(one) for one in (joints, target)]
    assume(all(one.wrist_rad > WRIST_NEAR_RAD and one.shoulder_m > 0.03 for one in near))
    assert solve_next_joints(forward(target), joints) == pytest.approx(target, abs=1e-8)


def wrist_path(past_rad: float, step_rad: float, bend_rad: float = 0.0) -> list[Floats]:
    """Return poses on which the flange's axis passes that of the forearm at a distance.

    The wrist's centre is fixed. Seen along the forearm, the axis draws a line with a bend of
    `bend_rad` at the nearest point.
    """
    base = forward(np.array([*CENTRE_RAD[:3], 0.0, 0.0, 0.0]))
    centre = base[:3, 3] - FLANGE_M * base[:3, 2]
    poses = []
    for along in np.arange(-0.3, 0.3, step_rad):
        turn = bend_rad if along > 0 else 0.0
        x, y = along * np.cos(turn), past_rad + along * np.sin(turn)
        rotation = base[:3, :3] @ rotation_from_vector([-y, x, 0.0])
        poses.append(transform(rotation, centre + FLANGE_M * rotation[:, 2]))
    return poses


def follow(poses: list[Floats]) -> tuple[Floats, Floats]:
    """Return joints (n, 6) along the poses, and the orientation errors (n,) rad."""
    present = inverse_kinematics(poses[0], CENTRE_RAD)
    joints, errors = [present], [0.0]
    for pose in poses[1:]:
        present = solve_next_joints(pose, present)
        found = forward(present)
        wrist, wanted = (one[:3, 3] - FLANGE_M * one[:3, 2] for one in (found, pose))
        assert wrist == pytest.approx(wanted, abs=1e-9)
        errors.append(float(Rotation.from_matrix(found[:3, :3].T @ pose[:3, :3]).magnitude()))
        joints.append(present)
    return np.array(joints), np.array(errors)


@pytest.mark.parametrize("past_deg", [0.0, 1e-9, 0.01, 0.3, 0.7])
def test_a_path_past_the_wrists_singularity_goes_straight_through(past_deg: float) -> None:
    step_rad = 0.002
    joints, errors = follow(wrist_path(np.radians(past_deg), step_rad))
    assert errors.max() <= min(
        3.0 * np.radians(past_deg) + 1e-8, MAX_FIXED_ERROR_RATIO * WRIST_FIXED_RAD
    )
    assert errors[[0, -1]] == pytest.approx([0.0, 0.0], abs=1e-7)
    # J5 changes its sign, J4 and J6 turn little and not fast.
    assert joints[0, 4] * joints[-1, 4] < 0
    assert np.ptp(joints[:, 3]) <= np.radians(40.0)
    steps = np.abs(np.diff(joints, axis=0)).max()
    assert steps <= (5 * step_rad + MAX_FREE_ROTATION_RAD if past_deg < 0.5 else 0.2)


@pytest.mark.parametrize("bend_deg", [-60.0, 45.0, 120.0])
def test_a_bend_at_the_wrists_singularity_costs_no_more_than_the_held_error(
    bend_deg: float,
) -> None:
    joints, errors = follow(wrist_path(1e-4, 0.002, np.radians(bend_deg)))
    assert errors.max() <= MAX_FIXED_ERROR_RATIO * WRIST_FIXED_RAD
    assert errors[-1] == pytest.approx(0.0, abs=1e-7)
    # J4 has to turn by the bend, while the axis moves a degree; the exact solution does so at once.
    assert np.abs(np.diff(joints, axis=0)).max() < 0.2


def test_far_past_the_wrists_singularity_the_path_is_exact() -> None:
    joints, errors = follow(wrist_path(1.01 * WRIST_NEAR_RAD, 0.005))
    assert errors.max() < 1e-7
    assert np.abs(joints[:, 4]).min() >= WRIST_NEAR_RAD
    assert np.ptp(joints[:, 3]) > np.radians(100.0)


@pytest.mark.parametrize("past_m", [0.0, 0.0002, 0.0006])
def test_a_path_past_the_shoulders_singularity_goes_straight_over(past_m: float) -> None:
    joints = np.array([0.3, 0.0, 2.0, 0.2, 0.5, 0.1])
    joints[1] = _above_the_shoulder(joints[2])
    over = forward(joints)
    ahead, aside = (
        np.array([np.cos(0.3), np.sin(0.3), 0.0]),
        np.array([-np.sin(0.3), np.cos(0.3), 0]),
    )
    present = None
    for along in np.arange(0.06, -0.06, -0.0005):
        pose = transform(over[:3, :3], over[:3, 3] + along * ahead + past_m * aside)
        if present is None:
            present = inverse_kinematics(pose, joints)
        before, present = present, solve_next_joints(pose, present)
        assert np.abs(present - before).max() < 0.1
        found = forward(present)
        off = float(np.linalg.norm(found[:3, 3] - pose[:3, 3]))
        assert off <= MAX_FIXED_ERROR_RATIO * SHOULDER_FIXED_M
        assert found[:3, :3] == pytest.approx(pose[:3, :3], abs=1e-9)
    assert found == pytest.approx(pose, abs=1e-9)
    assert abs(present[0] - 0.3) < 0.1


def test_held_still_at_a_singularity_the_arm_stays() -> None:
    joints = np.radians([10.0, 20.0, 100.0, 40.0, 0.0, -30.0])
    pose, present = forward(joints), joints
    for _ in range(200):
        present = solve_next_joints(pose, present)
    assert present == pytest.approx(joints, abs=1e-6)


def test_where_a_branch_ends_another_is_used_or_the_range_is_named() -> None:
    # J4 at the end of its range: the flipped wrist has the same pose.
    joints = np.radians([0.0, 25.0, 110.0, 159.9, 40.0, 10.0])
    beyond = joints + np.radians([0.0, 0.0, 0.0, 0.5, 0.0, 0.0])
    found = solve_next_joints(forward(beyond), joints)
    assert find_branch(found).wrist != find_branch(joints).wrist
    assert forward(found) == pytest.approx(forward(beyond), abs=1e-9)


weird = st.floats(allow_nan=True, allow_infinity=True, width=64)


@examples(100)
@given(arrays(np.float64, (4, 4), elements=weird), in_range)
def test_joints_are_in_range_or_the_error_names_it(pose: Floats, present: Floats) -> None:
    for solve in (solve_next_joints, inverse_kinematics):
        try:
            with np.errstate(all="ignore"):
                found = solve(pose, present)
        except UnreachableError:
            continue
        else:
            assert (found >= JOINT_MIN_RAD).all()
            assert (found <= JOINT_MAX_RAD).all()
