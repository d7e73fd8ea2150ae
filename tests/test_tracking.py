"""The Kalman filter and its gate."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from nodes.triangulator.tracking import (
    Tracker,
    TrackingSettings,
    agility,
    corrected,
    predicted,
    reachable,
    started,
)

Floats = NDArray[np.float64]
FRAME_NS = 16_666_667
NOISE = np.diag([1e-5, 2e-5, 8e-5]) ** 2
SETTINGS = TrackingSettings(
    acceleration_noise=0.5,
    largest_acceleration_noise=1.0,
    max_speed_m_per_s=1.5,
    forget_after_s=0.1,
    confirm_frames=3,
)


def is_covariance(matrix: Floats) -> bool:
    return bool(np.allclose(matrix, matrix.T) and np.linalg.eigvalsh(matrix).min() > 0)


@given(
    steps_ns=st.lists(st.integers(1_000, 90_000_000), min_size=1, max_size=30),
    noise=st.floats(1e-3, 100.0),
)
@settings(max_examples=40, deadline=None)
def test_the_covariance_stays_one(steps_ns: list[int], noise: float) -> None:
    track = started(0, np.zeros(3), NOISE, 1.5)
    for step_ns in steps_ns:
        track = predicted(track, track.at_ns + step_ns, noise)
        track = corrected(track, np.full(3, 1e-4), NOISE)
        assert is_covariance(track.covariance)


def test_predicting_in_two_steps_is_predicting_in_one() -> None:
    track = corrected(started(0, np.zeros(3), NOISE, 1.5), np.ones(3) * 1e-3, NOISE)
    once = predicted(track, 50_000_000, 0.7)
    twice = predicted(predicted(track, 20_000_000, 0.7), 50_000_000, 0.7)
    assert np.allclose(once.state, twice.state)
    assert np.allclose(once.covariance, twice.covariance, rtol=1e-10)


def test_a_steady_finger_is_followed_better_than_it_is_measured() -> None:
    generator = np.random.default_rng(3)
    velocity = np.array([0.1, -0.05, 0.02])
    tracker = Tracker(SETTINGS)
    errors, measured_errors, velocity_errors, normalized = [], [], [], []
    for frame in range(1, 600):
        truth = velocity * frame * FRAME_NS * 1e-9
        measured = truth + np.sqrt(np.diag(NOISE)) * generator.standard_normal(3)
        assert tracker.take(frame * FRAME_NS, measured, NOISE)
        assert tracker.track is not None
        if frame > 20:
            error = tracker.track.position - truth
            errors.append(error)
            measured_errors.append(measured - truth)
            velocity_errors.append(tracker.track.velocity - velocity)
            full = np.concatenate([error, tracker.track.velocity - velocity])
            normalized.append(full @ np.linalg.solve(tracker.track.covariance, full))
    assert np.std(errors) < np.std(measured_errors)
    assert np.abs(np.mean(velocity_errors, axis=0)).max() < 1e-3
    # The filter allows for acceleration that this finger has not, so it is less sure than it could.
    assert 1.0 < np.mean(normalized) < 7.0


def test_the_same_finger_without_frames_in_between() -> None:
    tracker = Tracker(SETTINGS)
    velocity = np.array([0.2, 0.0, 0.0])
    for frame in (1, 2, 3, 4, 5, 9, 10, 14):
        assert tracker.take(frame * FRAME_NS, velocity * frame * FRAME_NS * 1e-9, NOISE)
    assert tracker.track is not None
    assert np.allclose(tracker.track.velocity, velocity, atol=2e-3)
    ahead = tracker.expected(17 * FRAME_NS)
    assert ahead is not None
    assert np.allclose(ahead.position, velocity * 17 * FRAME_NS * 1e-9, atol=1e-4)


def test_a_single_jump_is_refused_and_forgotten() -> None:
    tracker = Tracker(SETTINGS)
    for frame in range(1, 5):
        assert tracker.take(frame * FRAME_NS, np.zeros(3), NOISE)
    assert not tracker.take(5 * FRAME_NS, np.array([0.1, 0.0, 0.0]), NOISE)
    assert tracker.track is not None
    assert np.allclose(tracker.track.position, 0.0, atol=1e-9)
    assert tracker.take(6 * FRAME_NS, np.zeros(3), NOISE)
    assert not tracker.take(7 * FRAME_NS, np.array([0.1, 0.0, 0.0]), NOISE)
    assert not tracker.take(8 * FRAME_NS, np.array([-0.1, 0.0, 0.0]), NOISE)


def test_a_jump_that_stays_becomes_the_track() -> None:
    tracker = Tracker(SETTINGS)
    assert tracker.take(FRAME_NS, np.zeros(3), NOISE)
    there = np.array([0.12, 0.0, 0.0])
    taken = [tracker.take(frame * FRAME_NS, there, NOISE) for frame in (2, 3, 4, 5)]
    assert taken == [False, False, True, True]
    assert tracker.track is not None
    assert np.allclose(tracker.track.position, there, atol=1e-6)


def test_an_old_track_is_not_carried_on() -> None:
    tracker = Tracker(SETTINGS)
    assert tracker.expected(0) is None
    assert tracker.take(FRAME_NS, np.zeros(3), NOISE)
    assert tracker.expected(FRAME_NS + 99_000_000) is not None
    assert tracker.expected(FRAME_NS + 101_000_000) is None
    assert tracker.take(FRAME_NS + 101_000_000, np.array([0.5, 0.0, 0.0]), NOISE)
    assert tracker.track is not None
    assert np.allclose(tracker.track.velocity, 0.0)


@pytest.mark.parametrize(("way_m", "reached"), [(0.024, True), (0.027, False)])
def test_the_gate_stands_at_the_fastest_fingers_way(way_m: float, reached: bool) -> None:
    assert reachable(np.array([way_m, 0.0, 0.0]), FRAME_NS, NOISE, 1.5) is reached


def test_noise_widens_the_gate() -> None:
    way = np.array([0.03, 0.0, 0.0])
    assert not reachable(way, FRAME_NS, NOISE, 1.5)
    assert reachable(way, FRAME_NS, np.eye(3) * 1e-3**2, 1.5)


CALM = replace(SETTINGS, acceleration_noise=0.003)


def predicted_errors_m(positions: Floats, settings: TrackingSettings, lead_frames: int) -> Floats:
    """How far (n,) the track, carried on by some frames, is from where the finger then is."""
    generator = np.random.default_rng(7)
    tracker = Tracker(settings)
    errors = []
    for frame in range(len(positions) - lead_frames):
        measured = positions[frame] + np.sqrt(np.diag(NOISE)) * generator.standard_normal(3)
        assert tracker.take((frame + 1) * FRAME_NS, measured, NOISE)
        assert tracker.track is not None
        ahead = tracker.track.velocity * lead_frames * FRAME_NS * 1e-9
        errors.append(tracker.track.position + ahead - positions[frame + lead_frames])
    return np.linalg.norm(errors, axis=1)


def test_tremor_is_not_predicted_the_wrong_way() -> None:
    """A stroke with a 10 Hz tremor: the calm filter leaves less than one that follows it all."""
    times_s = np.arange(400) / 60.0
    stroke = np.outer(times_s, [0.0, 0.0037, 0.0])
    stroke[:, 1] += 5e-5 * np.sin(2 * np.pi * 10.0 * times_s)
    calm = predicted_errors_m(stroke, CALM, 3)[60:].mean()
    quick = predicted_errors_m(stroke, SETTINGS, 3)[60:].mean()
    assert calm < 0.6 * quick


def test_a_start_and_a_stop_are_followed_as_quickly_as_by_the_agile_filter() -> None:
    """0.5 m/s from one frame to the next, and back to rest: caught up with within four frames."""
    speed = np.zeros(120)
    speed[40:80] = 0.5
    reach = np.outer(np.cumsum(speed) / 60.0, [0.0, 0.0, 1.0])
    errors = predicted_errors_m(reach, CALM, 0)
    for begin in (40, 80):
        assert errors[begin + 4 : begin + 30].max() < 1e-3
    assert agility(
        started(0, np.zeros(3), NOISE * 1e-6, 1e-9), FRAME_NS, np.full(3, 0.01), NOISE, CALM
    ) == pytest.approx(CALM.largest_acceleration_noise)


@given(st.floats(1e-6, 1.0), st.integers(1_000_000, 90_000_000))
@settings(max_examples=50, deadline=None)
def test_agility_stays_within_its_settings(way_m: float, step_ns: int) -> None:
    track = corrected(started(0, np.zeros(3), NOISE, 1.5), np.zeros(3), NOISE)
    noise = agility(track, step_ns, np.array([way_m, 0.0, 0.0]), NOISE, CALM)
    assert CALM.acceleration_noise <= noise <= CALM.largest_acceleration_noise
