"""RV-1A kinematics against an independent chain, and closed form against forward."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from nodes.arm_bridge.kinematics import (
    JOINT_MAX_RAD,
    JOINT_MIN_RAD,
    UnreachableError,
    branches,
    damped_least_squares,
    forward,
    inverse_kinematics,
    jacobian,
)
from nodes.models.rigid import rotation_from_rpy, transform

Floats = NDArray[np.float64]

in_range = arrays(np.float64, 6, elements=st.floats(1e-6, 1.0 - 1e-6)).map(
    lambda share: JOINT_MIN_RAD + share * (JOINT_MAX_RAD - JOINT_MIN_RAD)
)
CENTRE = np.radians([0.0, 25.0, 118.0, 0.0, -54.0, 0.0])


def chain(joints_rad: Floats) -> Floats:
    """Link by link, each a turn about an axis and then a shift, by scipy's rotations."""
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


@settings(max_examples=300)
@given(in_range, in_range)
def test_every_branch_gives_the_pose(joints: Floats, present: Floats) -> None:
    pose = forward(joints)
    found = branches(pose, present)
    assert len(found) == 8
    for solution in found:
        assert forward(np.array(solution)) == pytest.approx(pose, abs=1e-9)
        assert max(abs(angle) for angle in solution) <= 2 * np.pi


@settings(max_examples=300)
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


def test_a_turn_of_the_last_joint_past_180_degrees_goes_on() -> None:
    joints = np.array([0.0, 0.4, 2.0, 0.1, 0.5, np.radians(178.0)])
    for angle_deg in range(178, 200):
        joints[5] = np.radians(angle_deg)
        previous = joints - [0, 0, 0, 0, 0, np.radians(1.0)]
        assert inverse_kinematics(forward(joints), previous) == pytest.approx(joints, abs=1e-9)


@pytest.mark.parametrize(
    ("position", "words"),
    [
        ((0.9, 0.0, 0.3), "out of the arm's reach"),
        ((0.0, 0.0, 0.31), "no branch|out of the arm's reach"),
        ((0.45, 0.0, 0.55), "no branch|out of the arm's reach"),
    ],
)
def test_unreachable_poses_say_so(position: tuple[float, float, float], words: str) -> None:
    pose = transform(rotation_from_rpy([0.0, np.pi / 2, 0.0]), position)
    with pytest.raises(UnreachableError, match=words):
        inverse_kinematics(pose, CENTRE)


def test_a_pose_that_is_not_finite_is_unreachable() -> None:
    pose = forward(CENTRE)
    pose[0, 3] = np.nan
    with pytest.raises(UnreachableError):
        inverse_kinematics(pose, CENTRE)


@given(in_range)
def test_jacobian_agrees_with_differences(joints: Floats) -> None:
    step = 1e-6
    for joint in range(6):
        change = np.zeros(6)
        change[joint] = step
        before, after = forward(joints - change), forward(joints + change)
        linear = (after[:3, 3] - before[:3, 3]) / (2 * step)
        turn = Rotation.from_matrix(after[:3, :3] @ before[:3, :3].T).as_rotvec() / (2 * step)
        assert jacobian(joints)[:, joint] == pytest.approx([*linear, *turn], abs=1e-7)


@given(arrays(np.float64, 6, elements=st.floats(-0.05, 0.05)))
def test_damped_least_squares_finds_what_the_closed_form_finds(change: Floats) -> None:
    pose = forward(CENTRE + change)
    solved = damped_least_squares(pose, CENTRE, iterations=50)
    assert solved == pytest.approx(inverse_kinematics(pose, CENTRE), abs=1e-7)
