"""Test stamps that a planner and a bridge receive: late, stepped, in the future."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flexsheet.nodes.arm_bridge.goal import extrapolate_goal
from flexsheet.nodes.models.motion import SheetMotion
from flexsheet.nodes.planner.timing import RESTART_COUNT, MonotonicTimestampFilter, update_horizon_s

FRAME_NS = 16_666_667


def test_a_late_fingertip_is_dropped() -> None:
    timestamps = MonotonicTimestampFilter()
    assert timestamps.update(FRAME_NS, 0.02) == 0.02
    assert timestamps.update(3 * FRAME_NS, 0.02) == pytest.approx(2 * FRAME_NS * 1e-9)
    assert timestamps.update(2 * FRAME_NS, 0.02) is None
    assert timestamps.update(3 * FRAME_NS, 0.02) is None
    assert timestamps.update(4 * FRAME_NS, 0.02) == pytest.approx(FRAME_NS * 1e-9)


@pytest.mark.parametrize("back_s", [0.1, 5.0, 500.0])
def test_after_a_step_back_the_filter_restarts(back_s: float) -> None:
    timestamps = MonotonicTimestampFilter()
    for frame in range(100):
        timestamps.update(10**12 + frame * FRAME_NS, 0.02)
    begin_ns = 10**12 + 100 * FRAME_NS - round(back_s * 1e9)
    steps = [timestamps.update(begin_ns + frame * FRAME_NS, 0.02) for frame in range(6)]
    assert steps[: RESTART_COUNT - 1] == [None] * (RESTART_COUNT - 1)
    assert steps[RESTART_COUNT - 1] == 0.02
    assert steps[RESTART_COUNT:] == pytest.approx([FRAME_NS * 1e-9] * 3)


@given(st.lists(st.integers(0, 10**10), min_size=1, max_size=60))
def test_every_step_is_positive_for_any_stamps(stamps_ns: list[int]) -> None:
    timestamps = MonotonicTimestampFilter()
    for stamp_ns in stamps_ns:
        step_s = timestamps.update(stamp_ns, 0.02)
        assert step_s is None or step_s >= 1e-3


@given(
    horizon_s=st.floats(0.0, 0.12),
    wanted_s=st.floats(-1e3, 1e3),
    max_s=st.floats(0.01, 0.12),
)
def test_the_horizon_changes_slowly_and_ends_with_the_predicted_path(
    horizon_s: float, wanted_s: float, max_s: float
) -> None:
    later = update_horizon_s(horizon_s, wanted_s, max_s)
    assert abs(later - horizon_s) < 0.5 * FRAME_NS * 1e-9
    for _ in range(400):
        later = update_horizon_s(later, wanted_s, max_s)
    assert later == pytest.approx(min(max(wanted_s, 0.0), max_s), abs=1e-6)


def test_a_target_for_a_moment_too_far_ahead_is_overdue() -> None:
    still = SheetMotion(np.eye(4), np.zeros(6), 1.02, 0.0)
    assert extrapolate_goal(still, -0.05, -0.01, max_extrapolation_s=0.06).overdue_s < 0.0
    assert extrapolate_goal(still, -30.0, -0.01, max_extrapolation_s=0.06).overdue_s > 29.0
