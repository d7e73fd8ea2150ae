"""Test the selection of the method when results are late."""

from __future__ import annotations

from flexsheet.nodes.fem_solver.deadline_fallback import LATE_STEPS, RETRY_STEPS, DeadlineFallback


def test_in_time_the_best_stays() -> None:
    pace = DeadlineFallback(["good", "quick"], 0.004)
    assert not any(pace.record(0.003) for _ in range(2000))
    assert pace.name == "good"
    assert not pace.is_fallback


def test_single_late_answers_change_nothing() -> None:
    pace = DeadlineFallback(["good", "quick"], 0.004)
    for _ in range(100):
        changes = [pace.record(0.02) for _ in range(LATE_STEPS - 1)]
        assert not any([*changes, pace.record(0.001)])


def test_after_late_results_the_faster_method_is_used_until_a_retry() -> None:
    pace = DeadlineFallback(["good", "quick"], 0.004)
    assert [pace.record(0.02) for _ in range(LATE_STEPS)] == [False] * (LATE_STEPS - 1) + [True]
    assert pace.name == "quick"
    assert pace.is_fallback
    changes = [pace.record(0.001) for _ in range(RETRY_STEPS)]
    assert changes.index(True) == RETRY_STEPS - 1
    assert pace.name == "good"
    assert not any(pace.record(0.001) for _ in range(100))


def test_of_two_late_methods_the_faster_is_used() -> None:
    pace = DeadlineFallback(["good", "other"], 0.004)
    for _ in range(LATE_STEPS):
        pace.record(0.01)
    for _ in range(LATE_STEPS):
        pace.record(0.05)
    assert pace.name == "good"


def test_the_only_one_stays_however_late() -> None:
    pace = DeadlineFallback(["linear"], 0.004)
    assert not any(pace.record(1.0) for _ in range(2 * RETRY_STEPS))
