"""Test the times of commands to an arm."""

from __future__ import annotations

import itertools

from hypothesis import given
from hypothesis import strategies as st

from flexsheet.nodes.arm_bridge.command_scheduler import CommandScheduler

PACE = CommandScheduler(period_s=1 / 140, target_period_s=1 / 60, idle_period_s=1 / 40)
MS = 1_000_000


@given(since_ns=st.integers(0, 10**10))
def test_commands_are_never_nearer_than_half_a_beat(since_ns: int) -> None:
    wait_s = PACE.wait_s(1 + since_ns, 1)
    assert wait_s >= 0.0
    assert since_ns * 1e-9 + wait_s >= 0.5 * PACE.period_s * (1 - 1e-12)


@given(since_ns=st.integers(0, 10**12))
def test_a_command_covers_no_less_than_its_least_distance_and_no_long_silence(
    since_ns: int,
) -> None:
    step_s = PACE.step_s(1 + since_ns, 1)
    assert 0.5 * PACE.period_s <= step_s <= 2.0 * PACE.period_s
    if 4 * MS < since_ns < 14 * MS:
        assert step_s == since_ns * 1e-9


def test_the_period_continues_between_targets_and_without_any() -> None:
    assert PACE.is_due(7 * MS, 1, 0)
    assert PACE.is_due(1, 0, 0), "nothing was sent yet"
    assert PACE.is_due(100 * MS, 90 * MS, 0), "targets have ceased"
    assert not PACE.is_due(3 * MS, 1, 0), "too soon after a command"


def test_the_beat_makes_room_for_a_target_that_is_due() -> None:
    assert not PACE.is_due(15 * MS, 8 * MS, 0)
    assert not PACE.is_due(18 * MS, 8 * MS, 0)
    assert PACE.is_due(21 * MS, 14 * MS, 0), "it is late: the arm must hear"


def test_in_steady_state_an_arm_gets_a_command_at_least_every_ten_milliseconds() -> None:
    sent = [1]
    for now_ns in range(0, 400 * MS, MS // 10):
        target_ns = now_ns - now_ns % 16_700_000
        arrives = now_ns == target_ns and now_ns > 0
        if arrives or PACE.is_due(now_ns, sent[-1], target_ns):
            assert PACE.wait_s(now_ns, sent[-1]) == 0.0
            sent.append(now_ns)
    gaps_ms = [(b - a) / MS for a, b in itertools.pairwise(sent[1:])]
    assert max(gaps_ms) < 13.0
    assert min(gaps_ms) >= 3.5


@given(beat_ms=st.floats(1.0, 14.0))
def test_a_resting_arm_gets_commands_often_enough_for_its_watchdog(beat_ms: float) -> None:
    sent = [0]
    for now_ns in range(1, 2_000 * MS, round(beat_ms * MS)):
        if PACE.is_due_when_idle(now_ns, sent[-1]):
            sent.append(now_ns)
    gaps_ms = [(b - a) / MS for a, b in itertools.pairwise(sent[1:])]
    assert min(gaps_ms) >= 25.0
    assert max(gaps_ms) < 25.0 + beat_ms + 0.1
