"""Test the estimated lag of one motion behind another, with a known lag and without a relation."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from flexsheet.launch.experiments.lag import estimate_lag_s

Floats = NDArray[np.float64]
RATE_HZ = 60.0


def wander(times_s: Floats, seed: int, *, band_hz: tuple[float, float] = (0.15, 1.2)) -> Floats:
    """Return a slow random motion (n, 3) of 0.5 mm, as a function of time."""
    generator = np.random.default_rng(seed)
    frequencies = generator.uniform(*band_hz, (7, 3))
    phases = generator.uniform(0.0, 2.0 * np.pi, (7, 3))
    swings = np.sin(2.0 * np.pi * times_s[:, None, None] * frequencies + phases)
    return np.asarray(5e-4 * np.sqrt(2.0 / 7.0) * swings.sum(axis=1))


def stroke(times_s: Floats, seed: int = 0) -> Floats:
    """Return 60 degrees around a cylinder in ten seconds, with tremor."""
    angle = np.radians(6.0) * times_s
    around = 0.035 * np.stack([np.zeros_like(angle), np.sin(angle), np.cos(angle)], axis=1)
    return np.asarray(around + wander(times_s, seed))


@given(late_s=st.floats(-0.12, 0.12), seed=st.integers(0, 1000))
@settings(max_examples=40, deadline=None)
def test_a_known_lag_comes_out_between_the_samples(late_s: float, seed: int) -> None:
    times = np.arange(0.0, 10.0, 1.0 / RATE_HZ)
    found = estimate_lag_s(times, stroke(times - late_s, seed), stroke(times, seed))
    assert found == pytest.approx(late_s, abs=2e-4)


@given(seed=st.integers(0, 1000), offset_m=st.floats(-0.01, 0.01))
@settings(max_examples=20, deadline=None)
def test_noise_offsets_and_dropped_frames_hardly_matter(seed: int, offset_m: float) -> None:
    generator = np.random.default_rng(seed)
    times = np.sort(generator.uniform(0.0, 10.0, 550))
    noise = generator.normal(0.0, 1e-4, (len(times), 3))
    found = estimate_lag_s(
        times, stroke(times - 0.03, seed) + offset_m + noise, stroke(times, seed)
    )
    # 0.6 ms is its standard deviation at a fifth of the motion, over many seeds.
    assert found == pytest.approx(0.03, abs=4e-3)


def test_a_lag_of_the_papers_size_is_found_in_one_axis() -> None:
    times = np.arange(0.0, 10.0, 0.01)
    late = stroke(times - 0.067)[:, 1]
    assert estimate_lag_s(times, late, stroke(times)[:, 1]) == pytest.approx(0.067, abs=1e-3)


def test_quick_taps_are_not_confused_with_their_neighbours() -> None:
    times = np.arange(0.0, 4.0, 1.0 / RATE_HZ)

    def taps(at: Floats) -> Floats:
        return np.asarray(0.004 * np.cos(2.0 * np.pi * at / 0.185))

    assert estimate_lag_s(times, taps(times - 0.02), taps(times), max_lag_s=0.09) == pytest.approx(
        0.02, abs=2e-4
    )


def test_a_uniform_motion_gives_no_lag() -> None:
    times = np.arange(0.0, 5.0, 0.01)
    even = np.stack([0.1 * times, -0.02 * times], axis=1)
    assert estimate_lag_s(times, even - 0.003, even) is None


def test_another_motion_gives_no_lag() -> None:
    times = np.arange(0.0, 30.0, 1.0 / RATE_HZ)
    assert estimate_lag_s(times, wander(times, 1, band_hz=(1.0, 4.0)), wander(times, 2)) is None
    noise = np.random.default_rng(3).normal(0.0, 1e-3, (len(times), 3))
    assert estimate_lag_s(times, noise, wander(times, 2)) is None
    assert estimate_lag_s(times, np.zeros((len(times), 3)), wander(times, 2)) is None


def test_a_lag_beyond_the_range_is_not_given_as_its_edge() -> None:
    times = np.arange(0.0, 10.0, 1.0 / RATE_HZ)
    assert estimate_lag_s(times, stroke(times - 0.4), stroke(times), max_lag_s=0.05) is None


@pytest.mark.parametrize(
    ("times", "follower", "leader", "printed"),
    [
        (np.arange(100) * 0.01, np.zeros((100, 3)), np.zeros((99, 3)), "expected one row per time"),
        (np.arange(100) * 0.01, np.zeros((100, 3)), np.zeros((100, 2)), "the same axes"),
        (np.arange(100) * 0.01, np.full(100, np.nan), np.zeros(100), "finite"),
        (np.zeros(100), np.zeros(100), np.zeros(100), "increase"),
        (np.arange(50) * 0.01, np.zeros(50), np.zeros(50), r"more than 0\.6 s"),
        (np.arange(0), np.zeros(0), np.zeros(0), "at least 8 samples"),
    ],
)
def test_a_missing_lag_is_reported(
    times: Floats, follower: Floats, leader: Floats, printed: str
) -> None:
    with pytest.raises(ValueError, match=printed):
        estimate_lag_s(times, follower, leader)
