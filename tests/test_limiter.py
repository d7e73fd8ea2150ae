"""Test that the limiter's output is within its limits for any input."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray

from benchmarks.limiter import run
from flexsheet.nodes.arm_bridge.limiter import (
    MAX_TRAVEL_STEP_S,
    JointLimits,
    SheetLimits,
    check_flange,
    check_sheet,
    check_tracking_error,
    clamp_to_range,
    decelerate,
    find_desired_velocity,
    limit_velocity,
)
from flexsheet.nodes.models.rigid import transform, transform_from_rpy
from tests.examples import examples
from tests.rv_1a import (
    JOINT_MAX_RAD,
    JOINT_MIN_RAD,
    JOINT_SPEED_RAD_PER_S,
    forward,
)

Floats = NDArray[np.float64]

TOOL_SPEED = 0.25
STEP_S = 1.0 / 140.0


def tool_points(joints_rad: Floats) -> Floats:
    pose = forward(joints_rad)
    return np.array([pose[:3, 3], pose[:3, 3] + 0.12 * pose[:3, 1]])


LIMITS = JointLimits(
    JOINT_MIN_RAD + 0.03,
    JOINT_MAX_RAD - 0.03,
    JOINT_SPEED_RAD_PER_S,
    6.0 * JOINT_SPEED_RAD_PER_S,
    tool_points,
    TOOL_SPEED,
)


def step(joints: Floats, velocity: Floats, goal: Floats, along: Floats, step_s: float) -> Floats:
    return limit_velocity(
        joints,
        velocity,
        goal,
        along,
        limits=LIMITS,
        step_s=step_s,
    )


any_number = st.one_of(
    st.floats(-10.0, 10.0), st.sampled_from([np.nan, np.inf, -np.inf, 1e300, -1e300])
)
any_joints = arrays(np.float64, 6, elements=any_number)
start_joints = arrays(np.float64, 6, elements=st.floats(0.02, 0.98)).map(
    lambda share: LIMITS.min_rad + share * (LIMITS.max_rad - LIMITS.min_rad)
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
        assert (joints >= LIMITS.min_rad - 1e-9).all()
        assert (joints <= LIMITS.max_rad + 1e-9).all()
        assert (np.abs(velocity) <= LIMITS.speed_rad_per_s * (1 + 1e-9)).all()
        speed = np.linalg.norm(tool_points(joints) - before, axis=1).max() / step_s
        assert speed <= TOOL_SPEED * (1 + 1e-6)


@examples(50)
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
        wanted = find_desired_velocity(joints, goal, np.zeros(6), limits=LIMITS, step_s=STEP_S)
        velocity = clamp_to_range(joints, velocity, wanted, limits=LIMITS, step_s=STEP_S)
        change = np.abs(velocity - before)
        assert (change <= LIMITS.acceleration_rad_per_s2 * STEP_S * (1 + 1e-6) + 1e-12).all()
        joints = joints + velocity * STEP_S
        assert (joints >= LIMITS.min_rad - 1e-12).all()
        assert (joints <= LIMITS.max_rad + 1e-12).all()


@settings(max_examples=50, deadline=None)
@given(start=start_joints, goal=start_joints)
def test_a_still_goal_is_reached_without_overshoot(start: Floats, goal: Floats) -> None:
    joints, velocity = start, np.zeros(6)
    side = np.sign(goal - start)
    for _ in range(4000):
        wanted = find_desired_velocity(joints, goal, np.zeros(6), limits=LIMITS, step_s=STEP_S)
        velocity = clamp_to_range(joints, velocity, wanted, limits=LIMITS, step_s=STEP_S)
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
        slower = decelerate(velocity, limits=LIMITS, step_s=STEP_S)
        assert slower == pytest.approx(direction * np.linalg.norm(slower), abs=1e-12)
        velocity = slower
    assert (velocity == 0.0).all()


SHEET = SheetLimits(
    width_m=0.24,
    height_m=0.24,
    thickness_m=0.001,
    young_modulus_pa=1e6,
    max_length_m=0.2604,
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
        (edge(-0.135), edge(0.135), "the sheet is 270.0 mm long, maximum 260.4 mm"),
        (edge(-0.13015), edge(0.13015), "the edge force is 20"),
        (
            edge(-0.125, (0.3, 0.0, 0.0)),
            edge(0.125),
            "the edges are rotated by 17.2 degrees relative to each other",
        ),
        (
            edge(-0.125, (0.0, 0.0, 0.25)),
            edge(0.125, (0.0, 0.0, 0.25)),
            "the edge is skewed by 14.3 degrees",
        ),
    ],
)
def test_a_violation_of_the_sheet_is_named(own: Floats, other: Floats, words: str | None) -> None:
    for left in (True, False):
        pair = (own, other) if left else (other, own)
        found = check_sheet(*pair, left=left, limits=SHEET)
        assert (found is None) if words is None else (found is not None and words in found)


def test_swapped_edges_are_a_violation() -> None:
    found = check_sheet(edge(0.12), edge(-0.12), left=True, limits=SHEET)
    assert found is not None
    assert "skewed by 180" in found


def test_flanges_outside_the_workspace_or_too_near_are_a_violation() -> None:
    far = transform(np.eye(3), [0.3, 0.0, 0.0])
    assert check_flange(transform(np.eye(3), [-0.15, 0.0, 0.0]), far, SHEET) is None
    outside = check_flange(transform(np.eye(3), [0.0, 0.0, 0.31]), far, SHEET)
    assert outside is not None
    assert "outside the workspace" in outside
    near = check_flange(transform(np.eye(3), [0.2, 0.0, 0.0]), far, SHEET)
    assert near is not None
    assert "the flanges are 100 mm apart" in near


@given(st.one_of(st.floats(max_value=0.99e-6), st.floats(min_value=10.1), st.just(float("nan"))))
def test_a_step_that_is_no_duration_of_one_is_an_error(step_s: float) -> None:
    joints = np.radians([0.0, 25.0, 118.0, 0.0, -54.0, 0.0])
    with pytest.raises(ValueError, match=r"a command covers 1e-06 to 10\.0 s"):
        step(joints, np.zeros(6), joints, np.zeros(6), step_s)


whatever = st.one_of(
    st.floats(),
    st.floats(-4.0, 4.0),
    st.sampled_from([np.nan, np.inf, -np.inf, 1e308, -1e308, 5e-324, -5e-324, -0.0]),
)


@examples(75)
@given(
    joints=arrays(np.float64, 6, elements=st.floats(-4.0, 4.0)),
    share=arrays(np.float64, 6, elements=st.floats(-1.0, 1.0)),
    goal=arrays(np.float64, 6, elements=whatever),
    along=arrays(np.float64, 6, elements=whatever),
    step_s=st.one_of(st.floats(1e-6, 10.0), st.floats(1e-3, 0.05)),
)
def test_from_any_state_no_goal_and_no_step_leads_out_of_bounds(
    joints: Floats, share: Floats, goal: Floats, along: Floats, step_s: float
) -> None:
    """Goals are NaN, infinite, huge and denormal; joints are also out of range, with any speed,
    even if the arm cannot stop in range."""
    velocity = step(joints, share * LIMITS.speed_rad_per_s, goal, along, step_s)
    after = joints + velocity * step_s
    assert np.isfinite(velocity).all()
    assert (np.abs(velocity) <= LIMITS.speed_rad_per_s * (1 + 1e-9)).all()
    assert (after >= np.minimum(LIMITS.min_rad, joints) - 1e-9).all()
    assert (after <= np.maximum(LIMITS.max_rad, joints) + 1e-9).all()
    way = np.linalg.norm(tool_points(after) - tool_points(joints), axis=1).max()
    assert way <= TOOL_SPEED * min(step_s, MAX_TRAVEL_STEP_S) * (1 + 1e-6) + 1e-15


def test_after_a_long_gap_a_command_leads_no_further_than_after_an_even_one() -> None:
    joints, velocity = np.radians([0.0, 25.0, 118.0, 0.0, -54.0, 0.0]), np.zeros(6)
    far = joints + np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    for _ in range(60):
        velocity = step(joints, velocity, far, np.zeros(6), STEP_S)
        joints = joints + velocity * STEP_S
    for gap_s in (0.5 * STEP_S, STEP_S, 2.0 * STEP_S):
        moved = step(joints, velocity, far, np.zeros(6), gap_s) * gap_s
        way = np.linalg.norm(tool_points(joints + moved) - tool_points(joints), axis=1).max()
        assert way <= TOOL_SPEED * min(gap_s, MAX_TRAVEL_STEP_S) * (1 + 1e-9)
        assert way >= 0.9 * TOOL_SPEED * min(gap_s, MAX_TRAVEL_STEP_S)


def test_non_finite_values_are_a_violation() -> None:
    sound, odd = edge(-0.12), edge(0.12)
    for row, column in ((0, 0), (1, 2), (0, 3), (2, 3)):
        broken = odd.copy()
        broken[row, column] = np.nan
        assert check_sheet(sound, broken, left=True, limits=SHEET) is not None
        assert check_sheet(broken, sound, left=False, limits=SHEET) is not None
        if column == 3:
            assert check_flange(sound, broken, SHEET) is not None
            assert check_flange(broken, sound, SHEET) is not None
    assert check_tracking_error(np.full(6, np.nan), np.zeros(6), 0.1) is not None


def test_a_command_far_from_the_measured_joints_is_a_violation() -> None:
    joints = np.zeros(6)
    assert check_tracking_error(joints + 0.1, joints, 0.12) is None
    assert (
        check_tracking_error(joints + 0.13, joints, 0.12)
        == "the arm trails its command by 7.4 degrees"
    )


def test_measured_poses_have_a_tolerance_and_commanded_ones_none() -> None:
    far = transform(np.eye(3), [0.3, 0.0, 0.0])
    outside = transform(np.eye(3), [0.0, 0.0, 0.301])
    assert check_flange(outside, far, SHEET) is not None
    assert check_flange(outside, far, SHEET, slack_m=0.002) is None
    near = transform(np.eye(3), [0.1515, 0.0, 0.0])
    assert check_flange(near, far, SHEET) is not None
    assert check_flange(near, far, SHEET, slack_m=0.002) is None


@examples(50)
@given(tilt=st.tuples(*[st.floats(-3.0, 3.0)] * 3), shift=st.tuples(*[st.floats(-0.2, 0.2)] * 3))
def test_the_turn_between_edges_is_the_angle_of_their_rotation(
    tilt: tuple[float, ...], shift: tuple[float, ...]
) -> None:
    turned = transform_from_rpy(shift, tilt)
    angle = np.arccos(np.clip(0.5 * (np.trace(turned[:3, :3]) - 1.0), -1.0, 1.0))
    found = check_sheet(transform(np.eye(3), [-0.1, 0.0, 0.0]), turned, left=True, limits=SHEET)
    if angle > 0.201 and np.linalg.norm(turned[:3, 3] - [-0.1, 0.0, 0.0]) < 0.2401:
        assert found is not None
        assert f"rotated by {np.degrees(angle):.1f}" in found or "force" in found


@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.long)])
def test_no_random_or_adversarial_command_moves_an_arm_out_of_its_limits(seed: int) -> None:
    """Run a short `python -m benchmarks.limiter`."""
    result = run(5000, seed, searching=False)
    assert result["commands"] >= 5000
    assert not any(result["violations"].values()), result
    assert result["worst_ratio"]["simulated tool speed"] > 0.8, "no motion was checked"
    assert result["worst_ratio"]["commanded speed"] > 0.9
    assert result["harder_braking"] < 0.05 * result["commands"]
