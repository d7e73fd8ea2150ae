"""Test the progress and remaining time of a precomputation."""

from __future__ import annotations

from flexsheet.nodes.cache import EtaEstimator


def test_time_left_is_reckoned_from_what_steps_took() -> None:
    far = EtaEstimator()
    assert far.text(0, 10, 100.0) == "0 %"
    assert far.text(1, 10, 105.0) == "10 %, about 45 s left"
    assert far.text(2, 10, 150.0) == "20 %, about 3 min left"
    assert far.text(10, 10, 400.0) == "100 %"


def test_cached_steps_do_not_affect_the_estimate() -> None:
    far = EtaEstimator()
    assert far.text(0, 20, 0.0) == "0 %"
    assert far.text(10, 20, 0.2) == "50 %"
    assert far.text(10, 20, 8.0) == "50 %"
    assert far.text(12, 20, 10.0) == "60 %, about 40 s left"


def test_a_new_total_restarts_the_estimate() -> None:
    far = EtaEstimator()
    far.text(0, 10, 0.0)
    far.text(5, 10, 50.0)
    assert far.text(0, 10, 60.0) == "0 %"
    assert far.text(1, 10, 62.0) == "10 %, about 18 s left"
    assert far.text(0, 4, 70.0) == "0 %"
    assert far.text(2, 4, 73.0) == "50 %, about 3 s left"
