"""Test bounded following: no lag on a uniform motion, no overshoot, no jump."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from flexsheet.nodes.models.motion import (
    EdgeBound,
    SheetBounds,
    SheetMotion,
    coast_sheet,
    extrapolate,
    follow,
    follow_sheet,
)
from flexsheet.nodes.models.rigid import is_rigid, transform_from_rpy
from tests.examples import examples
from tests.twists import twist_between

Floats = NDArray[np.float64]
STEP_S = 1.0 / 60.0
SPEED, ACCELERATION = 0.2, 3.0
BOUNDS = SheetBounds(SPEED, ACCELERATION, 2.0, 40.0, 0.03, 0.3)
EDGES = EdgeBound(0.2125, 0.12)
AT_REST = SheetMotion(np.eye(4), np.zeros(6), 1.02, 0.0)


def advance(error: Floats, velocity: Floats, target_velocity: Floats) -> tuple[Floats, Floats]:
    return follow(
        error,
        velocity,
        target_velocity,
        max_speed=SPEED,
        max_acceleration=ACCELERATION,
        step_s=STEP_S,
    )


@given(st.floats(-0.5, 0.5))
def test_a_still_target_is_reached_without_overshoot(distance: float) -> None:
    place, velocity, target = np.zeros(1), np.zeros(1), np.array([distance])
    for _ in range(600):
        shift, velocity = advance(target - place, velocity, np.zeros(1))
        place = place + shift
        assert abs(target - place) <= abs(distance) + 1e-12
        assert (target - place) * np.sign(distance) >= -1e-12
    assert place == pytest.approx(target, abs=1e-12)
    assert velocity == pytest.approx([0.0], abs=1e-12)


def test_an_even_target_is_followed_without_lag() -> None:
    place, velocity = np.zeros(3), np.zeros(3)
    target, rate = np.array([0.01, 0.0, 0.0]), np.array([0.05, 0.08, -0.02])
    for _ in range(120):
        target = target + rate * STEP_S
        shift, velocity = advance(target - place, velocity, rate)
        place = place + shift
    assert place == pytest.approx(target, abs=1e-12)
    assert velocity == pytest.approx(rate, abs=1e-12)


@examples(100)
@given(
    st.lists(
        st.tuples(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5), st.floats(-2, 2), st.floats(-2, 2)),
        min_size=1,
        max_size=60,
    )
)
def test_speed_and_acceleration_are_bounded_for_any_target(
    targets: list[tuple[float, float, float, float]],
) -> None:
    place, velocity = np.zeros(2), np.zeros(2)
    places = [place, place]
    for x, y, vx, vy in targets:
        shift, velocity = advance(np.array([x, y]) - place, velocity, np.array([vx, vy]))
        place = place + shift
        places.append(place)
    means = [(after - before) / STEP_S for before, after in pairwise(places)]
    assert max(np.linalg.norm(mean) for mean in means) <= SPEED * (1 + 1e-9)
    changes = [np.linalg.norm(after - before) / STEP_S for before, after in pairwise(means)]
    assert max(changes) <= ACCELERATION * (1 + 1e-6)


@given(
    st.tuples(st.floats(-1, 1), st.floats(-1, 1), st.floats(-1, 1)),
    st.tuples(st.floats(-0.1, 0.1), st.floats(-0.1, 0.1), st.floats(-0.1, 0.1)),
    st.floats(1.0, 1.1),
)
@settings(max_examples=15, deadline=None)
def test_a_sheet_gets_to_any_pose_and_stays_rigid(
    rpy: tuple[float, float, float], place: tuple[float, float, float], stretch: float
) -> None:
    target = SheetMotion(transform_from_rpy(place, rpy), np.zeros(6), stretch, 0.0)
    motion = AT_REST
    for _ in range(400):
        before = motion
        motion = follow_sheet(motion, target, bounds=BOUNDS, edges=EDGES, step_s=STEP_S)
        twist = twist_between(before.world_from_sheet, motion.world_from_sheet, STEP_S)
        assert np.linalg.norm(twist[3:]) <= BOUNDS.turn_rad_per_s * (1 + 1e-6)
        # While one slows for the other both may add up to a little more, for a step or two.
        edge_speed = np.linalg.norm(twist[:3]) + EDGES.reach_m * np.linalg.norm(twist[3:])
        assert edge_speed <= 1.1 * EDGES.speed_m_per_s
        assert is_rigid(motion.world_from_sheet, 1e-12)
    assert motion.world_from_sheet == pytest.approx(target.world_from_sheet, abs=1e-9)
    assert motion.stretch_ratio == pytest.approx(stretch, abs=1e-9)


def test_coasting_ends_at_rest() -> None:
    motion = replace(AT_REST, twist_world=np.array([0.2, 0, 0, 0, 1.5, 0]), stretch_rate_per_s=0.02)
    for _ in range(20):
        motion = coast_sheet(motion, bounds=BOUNDS, step_s=STEP_S)
    assert (motion.twist_world == 0.0).all()
    assert motion.stretch_rate_per_s == 0.0
    # v^2 / 2a, less what a first step that brakes at once takes off.
    assert 0.0 < motion.world_from_sheet[0, 3] <= 0.2**2 / (2 * ACCELERATION)


def test_extrapolation_goes_both_ways() -> None:
    motion = replace(AT_REST, twist_world=np.array([0.1, 0, 0.05, 0.5, 0, 0]))
    there = extrapolate(motion, 0.04)
    assert there.world_from_sheet[:3, 3] == pytest.approx([0.004, 0.0, 0.002])
    back = extrapolate(there, -0.04)
    assert back.world_from_sheet == pytest.approx(np.eye(4), abs=1e-12)
