"""Times that a planner and a bridge are given: late, stepped, from the future."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flexsheet.nodes.arm_bridge.goal import extrapolate_goal
from flexsheet.nodes.models.motion import SheetMotion
from flexsheet.nodes.planner.lead import next_lead_s
from flexsheet.nodes.planner.order import STEPPED_AFTER, Order

FRAME_NS = 16_666_667


def test_one_that_comes_late_is_left_out_and_time_goes_on() -> None:
    order = Order()
    assert order.step_s(FRAME_NS, 0.02) == 0.02
    assert order.step_s(3 * FRAME_NS, 0.02) == pytest.approx(2 * FRAME_NS * 1e-9)
    assert order.step_s(2 * FRAME_NS, 0.02) is None
    assert order.step_s(3 * FRAME_NS, 0.02) is None
    assert order.step_s(4 * FRAME_NS, 0.02) == pytest.approx(FRAME_NS * 1e-9)


@pytest.mark.parametrize("back_s", [0.1, 5.0, 500.0])
def test_after_a_step_back_time_begins_anew(back_s: float) -> None:
    order = Order()
    for frame in range(100):
        order.step_s(10**12 + frame * FRAME_NS, 0.02)
    begin_ns = 10**12 + 100 * FRAME_NS - round(back_s * 1e9)
    steps = [order.step_s(begin_ns + frame * FRAME_NS, 0.02) for frame in range(6)]
    assert steps[: STEPPED_AFTER - 1] == [None] * (STEPPED_AFTER - 1)
    assert steps[STEPPED_AFTER - 1] == 0.02
    assert steps[STEPPED_AFTER:] == pytest.approx([FRAME_NS * 1e-9] * 3)


@given(st.lists(st.integers(0, 10**10), min_size=1, max_size=60))
def test_every_step_is_positive_whatever_the_stamps(stamps_ns: list[int]) -> None:
    order = Order()
    for stamp_ns in stamps_ns:
        step_s = order.step_s(stamp_ns, 0.02)
        assert step_s is None or step_s >= 1e-3


@given(
    lead_s=st.floats(0.0, 0.12),
    wanted_s=st.floats(-1e3, 1e3),
    furthest_s=st.floats(0.01, 0.12),
)
def test_the_lead_goes_slowly_and_no_further_than_fingertips_say(
    lead_s: float, wanted_s: float, furthest_s: float
) -> None:
    later = next_lead_s(lead_s, wanted_s, furthest_s)
    assert abs(later - lead_s) < 0.5 * FRAME_NS * 1e-9
    for _ in range(400):
        later = next_lead_s(later, wanted_s, furthest_s)
    assert later == pytest.approx(min(max(wanted_s, 0.0), furthest_s), abs=1e-6)


def test_a_target_for_a_moment_too_far_ahead_is_overdue() -> None:
    still = SheetMotion(np.eye(4), np.zeros(6), 1.02, 0.0)
    assert extrapolate_goal(still, -0.05, -0.01, max_extrapolation_s=0.06).overdue_s < 0.0
    assert extrapolate_goal(still, -30.0, -0.01, max_extrapolation_s=0.06).overdue_s > 29.0
