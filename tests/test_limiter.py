"""The limiter: whatever comes in, nothing out of bounds goes out."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray

from nodes.arm_bridge.kinematics import (
    JOINT_MAX_RAD,
    JOINT_MIN_RAD,
    JOINT_SPEED_RAD_PER_S,
    forward,
)
from nodes.arm_bridge.limiter import (
    JointLimits,
    SheetLimits,
    braked,
    limited,
    place_trouble,
    sheet_trouble,
    towards,
    within_range,
)
from nodes.models.rigid import transform, transform_from_rpy

Floats = NDArray[np.float64]

LIMITS = JointLimits(
    JOINT_MIN_RAD + 0.03, JOINT_MAX_RAD - 0.03, JOINT_SPEED_RAD_PER_S, 6.0 * JOINT_SPEED_RAD_PER_S
)
TOOL_SPEED = 0.25
STEP_S = 1.0 / 140.0


def tool_points(joints_rad: Floats) -> Floats:
    pose = forward(joints_rad)
    return np.array([pose[:3, 3], pose[:3, 3] + 0.12 * pose[:3, 1]])


def step(joints: Floats, velocity: Floats, goal: Floats, along: Floats, step_s: float) -> Floats:
    return limited(
        joints,
        velocity,
        goal,
        along,
        tool_points=tool_points,
        max_tool_speed=TOOL_SPEED,
        limits=LIMITS,
        step_s=step_s,
    )


any_number = st.one_of(
    st.floats(-10.0, 10.0), st.sampled_from([np.nan, np.inf, -np.inf, 1e300, -1e300])
)
any_joints = arrays(np.float64, 6, elements=any_number)
start_joints = arrays(np.float64, 6, elements=st.floats(0.02, 0.98)).map(
    lambda share: LIMITS.lowest_rad + share * (LIMITS.highest_rad - LIMITS.lowest_rad)
)


@settings(max_examples=60, deadline=None)
@given(
    start=start_joints,
    commands=st.lists(st.tuples(any_joints, any_joints), min_size=1, max_size=40),
    steps=st.lists(st.floats(0.5, 2.0), min_size=1, max_size=8),
)
def test_nothing_out_of_bounds_ever_goes_out(
    start: Floats, commands: list[tuple[Floats, Floats]], steps: list[float]
) -> None:
    joints, velocity = start, np.zeros(6)
    for number, (goal, along) in enumerate(commands * 3):
        step_s = STEP_S * steps[number % len(steps)]
        before = tool_points(joints)
        velocity = step(joints, velocity, goal, along, step_s)
        joints = joints + velocity * step_s
        assert np.isfinite(joints).all()
        assert (joints >= LIMITS.lowest_rad - 1e-9).all()
        assert (joints <= LIMITS.highest_rad + 1e-9).all()
        assert (np.abs(velocity) <= LIMITS.speed_rad_per_s * (1 + 1e-9)).all()
        speed = np.linalg.norm(tool_points(joints) - before, axis=1).max() / step_s
        assert speed <= TOOL_SPEED * (1 + 1e-6)


@settings(max_examples=100, deadline=None)
@given(
    start=start_joints,
    goals=st.lists(arrays(np.float64, 6, elements=st.floats(-4.0, 4.0)), min_size=1, max_size=6),
    each=st.integers(1, 60),
)
def test_acceleration_is_bounded_and_joints_stop_in_range(
    start: Floats, goals: list[Floats], each: int
) -> None:
    joints, velocity = start, np.zeros(6)
    for goal in [goal for goal in goals for _ in range(each)]:
        before = velocity
        wanted = towards(joints, goal, np.zeros(6), limits=LIMITS, step_s=STEP_S)
        velocity = within_range(joints, velocity, wanted, limits=LIMITS, step_s=STEP_S)
        change = np.abs(velocity - before)
        assert (change <= LIMITS.acceleration_rad_per_s2 * STEP_S * (1 + 1e-6) + 1e-12).all()
        joints = joints + velocity * STEP_S
        assert (joints >= LIMITS.lowest_rad - 1e-12).all()
        assert (joints <= LIMITS.highest_rad + 1e-12).all()


@settings(max_examples=50, deadline=None)
@given(start=start_joints, goal=start_joints)
def test_a_still_goal_is_reached_without_overshoot(start: Floats, goal: Floats) -> None:
    joints, velocity = start, np.zeros(6)
    side = np.sign(goal - start)
    for _ in range(4000):
        wanted = towards(joints, goal, np.zeros(6), limits=LIMITS, step_s=STEP_S)
        velocity = within_range(joints, velocity, wanted, limits=LIMITS, step_s=STEP_S)
        joints = joints + velocity * STEP_S
        assert (side * (joints - goal) <= 1e-9).all()
        if np.abs(joints - goal).max() < 1e-9:
            break
    assert joints == pytest.approx(goal, abs=1e-8)


def test_a_goal_that_moves_evenly_is_followed_without_lag() -> None:
    joints, velocity = np.radians([0.0, 25.0, 118.0, 0.0, -54.0, 0.0]), np.zeros(6)
    rate = np.array([0.1, -0.05, 0.05, 0.2, 0.1, 0.3])
    goal = joints.copy()
    for _ in range(60):
        goal = goal + rate * STEP_S
        velocity = step(joints, velocity, goal, rate, STEP_S)
        joints = joints + velocity * STEP_S
    assert joints == pytest.approx(goal, abs=1e-12)


def test_braking_keeps_to_the_path_and_ends_at_rest() -> None:
    velocity = np.array([1.0, -0.5, 0.2, 0.0, 2.0, -3.0])
    direction = velocity / np.linalg.norm(velocity)
    for _ in range(200):
        slower = braked(velocity, limits=LIMITS, step_s=STEP_S)
        assert slower == pytest.approx(direction * np.linalg.norm(slower), abs=1e-12)
        velocity = slower
    assert (velocity == 0.0).all()


SHEET = SheetLimits(
    width_m=0.24,
    height_m=0.24,
    thickness_m=0.001,
    young_modulus_pa=1e6,
    longest_m=0.2604,
    max_edge_force_n=20.0,
    max_twist_rad=0.2,
    min_flange_distance_m=0.15,
    workspace_min_m=np.array([-0.4, -0.3, -0.3]),
    workspace_max_m=np.array([0.4, 0.3, 0.3]),
)


def edge(x: float, rpy: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Floats:
    return transform_from_rpy([x, 0.0, 0.0], rpy)


@pytest.mark.parametrize(
    ("own", "other", "words"),
    [
        (edge(-0.125), edge(0.125), None),
        (edge(-0.11), edge(0.11), None),
        (edge(-0.135), edge(0.135), "sheet of 270.0 mm, at most 260.4 mm"),
        (edge(-0.13015), edge(0.13015), "edge force 20"),
        (edge(-0.125, (0.3, 0.0, 0.0)), edge(0.125), "edges turned by 17.2 degrees"),
        (
            edge(-0.125, (0.0, 0.0, 0.25)),
            edge(0.125, (0.0, 0.0, 0.25)),
            "edge skewed by 14.3 degrees",
        ),
    ],
)
def test_a_sheet_in_trouble_is_named(own: Floats, other: Floats, words: str | None) -> None:
    for left in (True, False):
        pair = (own, other) if left else (other, own)
        found = sheet_trouble(*pair, left=left, limits=SHEET)
        assert (found is None) if words is None else (found is not None and words in found)


def test_edges_that_have_changed_places_are_in_trouble() -> None:
    found = sheet_trouble(edge(0.12), edge(-0.12), left=True, limits=SHEET)
    assert found is not None
    assert "skewed by 180" in found


def test_flanges_outside_the_workspace_or_too_near_are_in_trouble() -> None:
    far = transform(np.eye(3), [0.3, 0.0, 0.0])
    assert place_trouble(transform(np.eye(3), [-0.15, 0.0, 0.0]), far, SHEET) is None
    outside = place_trouble(transform(np.eye(3), [0.0, 0.0, 0.31]), far, SHEET)
    assert outside is not None
    assert "outside the workspace" in outside
    near = place_trouble(transform(np.eye(3), [0.2, 0.0, 0.0]), far, SHEET)
    assert near is not None
    assert "flanges 100 mm apart" in near
