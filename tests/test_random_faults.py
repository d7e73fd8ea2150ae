"""Test which gaps of a bag the random faults explain."""

from __future__ import annotations

import pytest

from benchmarks.faults import Result
from benchmarks.random_faults import MARGIN_NS, fault_free_ratio, missing_outside_faults
from tests.lab_bags import Gap

S = 1_000_000_000


def fault(begin_s: float, end_s: float) -> Result:
    return Result("fault", None, 0.0, (round(begin_s * S), round(end_s * S)), (), {}, 0.0)


def gap(begin_s: float, end_s: float) -> Gap:
    return Gap(end_s - begin_s, "arm_left", "bridge", round(begin_s * S), round(end_s * S))


MARGIN_S = MARGIN_NS / S
APART_S = 20.0 + 2.0 * MARGIN_S + 1.0


@pytest.mark.parametrize(
    ("lost", "explained"),
    [
        (gap(9.0, 14.0), True),
        (gap(8.0, 33.0), True),  # two faults without a time between them that is free of faults
        (gap(14.0, APART_S + 21.0), False),
        (gap(36.0, 40.0), False),
    ],
)
def test_a_gap_lies_within_one_fault_or_several_adjacent_ones(lost: Gap, explained: bool) -> None:
    results = [fault(10.0, 12.0), fault(13.0, 30.0), fault(APART_S + 20.0, APART_S + 22.0)]
    assert (missing_outside_faults([lost], results) == []) is explained


def test_the_ratio_without_faults_counts_overlapping_margins_once() -> None:
    results = [fault(100.0, 102.0), fault(103.0, 110.0)]
    assert fault_free_ratio(results) == 0.0
    apart = [fault(0.0, 1.0), fault(99.0, 100.0)]
    covered = 2.0 * (1.0 + 2.0 * MARGIN_S) / (100.0 + 2.0 * MARGIN_S)
    assert fault_free_ratio(apart) == pytest.approx(1.0 - covered)
