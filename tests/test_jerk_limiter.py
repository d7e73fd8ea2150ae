"""Test the sheet's motion: bounded in speed, acceleration and jerk, and accurate at its target."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from flexsheet.nodes.models.motion import EdgeBound, SheetBounds, SheetMotion
from flexsheet.nodes.models.rigid import is_rigid, transform, transform_from_rpy
from flexsheet.nodes.planner.jerk_limiter import JerkBounds, JerkLimitedState, step_sheet
from tests.examples import examples
from tests.twists import twist_between

Floats = NDArray[np.float64]
STEP_S = 1.0 / 60.0
BOUNDS = SheetBounds(0.18, 2.0, 2.0, 10.0, 0.03, 0.3)
JERKS = JerkBounds(60.0, 300.0, 9.0)
EDGES = EdgeBound(0.175, 0.12)
START = JerkLimitedState.at_rest(SheetMotion(np.eye(4), np.zeros(6), 1.02, 0.0))


def on(now: JerkLimitedState, target: SheetMotion | None) -> JerkLimitedState:
    return step_sheet(now, target, bounds=BOUNDS, jerks=JERKS, edges=EDGES, step_s=STEP_S)


def at(place: Floats, velocity: Floats | None = None) -> SheetMotion:
    moving = np.zeros(3) if velocity is None else velocity
    return SheetMotion(
        transform(np.eye(3), place), np.concatenate([moving, np.zeros(3)]), 1.02, 0.0
    )


@given(st.floats(1e-5, 0.3))
@examples(15)
def test_a_still_target_is_reached_and_hardly_passed(distance: float) -> None:
    motion, places = START, []
    for _ in range(400):
        motion = on(motion, at(np.array([distance, 0.0, 0.0])))
        places.append(motion.sheet.world_from_sheet[0, 3])
    assert places[-1] == pytest.approx(distance, abs=1e-9)
    assert motion.sheet.twist_world == pytest.approx(np.zeros(6), abs=1e-9)
    # Letting an acceleration go takes two steps; a sheet that stops is past by at most so much.
    assert max(places) - distance <= 1.5e-4


def test_a_wandering_trembling_target_is_followed_without_lag() -> None:
    times = STEP_S * np.arange(300)
    wander, tremor = 2 * np.pi * 1.0, 2 * np.pi * 10.0
    path = 0.0037 * times + 5e-4 * np.sin(wander * times) + 5e-5 * np.sin(tremor * times)
    rate = 0.0037 + 5e-4 * wander * np.cos(wander * times) + 5e-5 * tremor * np.cos(tremor * times)
    motion, errors = START, []
    for place, speed in zip(path, rate, strict=True):
        motion = on(motion, at(np.array([place, 0, 0]), np.array([speed, 0, 0])))
        errors.append(
            [
                motion.sheet.world_from_sheet[0, 3] - place,
                motion.sheet.twist_world[0] - speed,
            ]
        )
    off = np.abs(errors)[30:].max(axis=0)
    assert off[0] < 1e-9
    assert off[1] < 0.002


targets = st.one_of(
    st.none(),
    st.builds(
        lambda place, rpy, twist, stretch: SheetMotion(
            transform_from_rpy(place, rpy), np.array(twist), stretch, 0.0
        ),
        st.tuples(*[st.floats(-0.2, 0.2)] * 3),
        st.tuples(*[st.floats(-1.2, 1.2)] * 3),
        st.tuples(*[st.floats(-3, 3)] * 6),
        st.floats(1.0, 1.1),
    ),
)


@given(st.lists(st.tuples(targets, st.integers(1, 12)), min_size=1, max_size=8))
@settings(max_examples=60, deadline=None)
def test_speed_acceleration_and_jerk_are_bounded_for_any_target(
    wishes: list[tuple[SheetMotion | None, int]],
) -> None:
    motion, sheets = START, [START.sheet] * 3
    for target, steps in wishes:
        for _ in range(steps):
            motion = on(motion, target)
            sheets.append(motion.sheet)
            assert is_rigid(motion.sheet.world_from_sheet, 1e-9)
    means = np.array(
        [
            [
                *twist_between(a.world_from_sheet, b.world_from_sheet, STEP_S),
                (b.stretch_ratio - a.stretch_ratio) / STEP_S,
            ]
            for a, b in pairwise(sheets)
        ]
    )
    accelerations = np.diff(means, axis=0) / STEP_S
    jerks = np.diff(accelerations, axis=0) / STEP_S
    parts = (slice(0, 3), slice(3, 6), slice(6, 7))
    speeds = (BOUNDS.speed_m_per_s, BOUNDS.turn_rad_per_s, BOUNDS.stretch_rate_per_s)
    sharpest = (
        BOUNDS.acceleration_m_per_s2,
        BOUNDS.turn_acceleration_rad_per_s2,
        BOUNDS.stretch_acceleration_per_s2,
    )
    most = (JERKS.jerk_m_per_s3, JERKS.turn_jerk_rad_per_s3, JERKS.stretch_jerk_per_s3)
    for part, speed, acceleration, jerk in zip(parts, speeds, sharpest, most, strict=True):
        assert np.linalg.norm(means[:, part], axis=1).max() <= 1.05 * speed
        assert np.linalg.norm(accelerations[:, part], axis=1).max() <= acceleration * (1 + 1e-6)
        assert np.linalg.norm(jerks[:, part], axis=1).max(initial=0.0) <= jerk * (1 + 1e-6)


def test_a_lost_target_brings_the_sheet_to_rest() -> None:
    motion = START
    for step in range(60):
        motion = on(motion, at(np.array([0.1 * step * STEP_S, 0, 0]), np.array([0.1, 0, 0])))
    place = motion.sheet.world_from_sheet[0, 3]
    for _ in range(30):
        motion = on(motion, None)
    assert (motion.sheet.twist_world == 0.0).all()
    assert 0.0 < motion.sheet.world_from_sheet[0, 3] - place < 0.1**2 / 2.0 + 0.1 * 4 * STEP_S
