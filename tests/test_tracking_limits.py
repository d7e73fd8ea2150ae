"""Test each disturbance of the tracking: a mild one has no effect, a severe one is reported."""

from __future__ import annotations

import asyncio

import pytest

from benchmarks import tracking_limits
from benchmarks.tracking_bench import bench_scene
from benchmarks.tracking_endurance import evaluate_sequence, follow
from benchmarks.tracking_limits import FAILURES, measure
from tests.examples import long_except

SIGMAS = 6.0
"""Maximum error of a valid fingertip, in reported standard deviations."""

MILD = {
    "one-view": 2.5,
    "edge": 6.0,
    "two-marks": 15.0,
    "highlight": -1.0,
    "volume": -3.0,
    "baseline": 60.0,
    "defocus": 1.0,
    "saturated": 1.2,
    "rate": 30.0,
    "gap": 50.0,
    "clock": 20.0,
}
FRAME_MS = 1000.0 / 60.0
CONFIRMED_MS = 2.0 * FRAME_MS
"""Time from the first image to the third, which starts a track."""

SEVERE = {
    "one-view": (0.5, {"merged", "inconsistent"}, CONFIRMED_MS),
    "edge": (-5.0, {"marker_in_one_view"}, CONFIRMED_MS),
    "two-marks": (6.0, {"merged", "two_markers"}, CONFIRMED_MS),
    "hidden": (30.0, {"no_marker", "two_markers", "too_fast"}, CONFIRMED_MS),
    "highlight": (0.25, {"merged", "blurred"}, CONFIRMED_MS),
    # What comes after begins beyond the volume, and the way back takes a while.
    "volume": (10.0, {"outside_volume"}, 150.0),
    "baseline": (2.0, {"inconsistent"}, None),
    "defocus": (3.0, {"blurred", "no_marker", "marker_in_one_view"}, CONFIRMED_MS),
    "saturated": (8.0, {"saturated"}, CONFIRMED_MS),
}


@pytest.fixture(autouse=True)
def briefly(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tracking_limits, "BEFORE_S", 0.3)
    monkeypatch.setattr(tracking_limits, "DURING_S", 0.25)
    monkeypatch.setattr(tracking_limits, "AFTER_S", 0.25)
    monkeypatch.setattr(tracking_limits, "AFTERMATH_S", 0.2)


def test_every_failure_is_tried() -> None:
    assert {*MILD, "hidden"} == set(FAILURES)  # a hidden mark is never mild
    assert {*SEVERE, "rate", "gap", "clock"} == set(FAILURES)


@pytest.mark.parametrize(
    "name", long_except(MILD, "edge", "highlight", "defocus", "rate", "gap", "clock")
)
def test_a_little_of_it_does_no_harm(name: str) -> None:
    row = measure(name, MILD[name], repetitions=1)
    assert row.valid_share == 1.0, row.reasons
    assert row.worst_sigmas is not None
    assert row.worst_sigmas < SIGMAS
    assert row.recovery_ms in (None, (0.0, 0.0))


@pytest.mark.parametrize(
    "name", long_except(SEVERE, "edge", "two-marks", "hidden", "volume", "saturated")
)
def test_a_severe_disturbance_is_reported_and_recovered(name: str) -> None:
    severity, reasons, recovery_ms = SEVERE[name]
    row = measure(name, severity, repetitions=1)
    assert row.valid_share == 0.0
    assert {*row.reasons} <= {*reasons, "unconfirmed"}
    if recovery_ms is None:
        assert row.recovery_ms is None
    else:
        assert row.recovery_ms is not None
        assert max(row.recovery_ms) <= recovery_ms + 1e-3


@pytest.mark.parametrize(
    ("name", "severity", "reasons", "lost"),
    [
        ("rate", 6.0, {"unconfirmed"}, None),
        ("gap", 250.0, {"unconfirmed"}, 2),
        ("clock", 500.0, {"unconfirmed"}, 2),
        ("clock", -500.0, {"late"}, 2),
        ("clock", -20.0, {"late"}, 1),
    ],
)
def test_bad_times_cost_a_few_frames_and_no_wrong_position(
    name: str, severity: float, reasons: set[str], lost: int | None
) -> None:
    row = measure(name, severity, repetitions=1)
    assert {*row.reasons} == reasons
    assert row.worst_sigmas is None or row.worst_sigmas < SIGMAS
    if lost is None:
        assert row.valid_share < 0.4
    else:
        assert sum(row.reasons.values()) <= lost + 2
        assert row.recovery_ms is not None
        assert row.recovery_ms[1] <= lost * FRAME_MS + 1e-3


@pytest.mark.parametrize(
    "sequences", [((2, 450),), pytest.param(((2, 900), (3, 600)), marks=pytest.mark.long)]
)
def test_no_clutter_is_confused_with_the_finger(
    sequences: tuple[tuple[int, int], ...],
) -> None:
    """Repeat `benchmarks.tracking_endurance` on few frames.

    sequences: seeds and numbers of frames.
    """
    count = 0
    for seed, frames in sequences:
        seen, _ = asyncio.run(follow(seed, frames))
        tally = evaluate_sequence(seen, bench_scene(), seed)
        assert tally.wrong_markers == []
        assert max(tally.jumps_mm) < 1.5
        assert tally.valid > 0.4 * frames
        assert tally.outages > 3
        count += tally.frames
    assert count == sum(frames for _, frames in sequences)
