"""The bank of filters: its gains, its combination, and where it ends."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from benchmarks.hand_motion import GRID_HZ, draw_tremor, sample_tremor, sample_wander
from flexsheet.nodes.triangulator.adaptive import (
    MODELS,
    OBSERVED,
    START_POINTS,
    AdaptiveBank,
    BankEstimate,
    combine,
    compute_process_noise,
    compute_transition,
    find_gains,
    solve_riccati,
)
from flexsheet.nodes.triangulator.tracking import Tracker, TrackingSettings

Floats = NDArray[np.float64]
Path = Callable[[float], Floats]

BANK = AdaptiveBank(1.5)
AXES = np.linalg.qr(np.random.default_rng(0).standard_normal((3, 3)))[0]
DEVIATIONS_M = np.array([6.5e-6, 7e-6, 5.4e-5])
NOISE = (AXES * DEVIATIONS_M**2) @ AXES.T
HORIZON_S = 0.05


def measured_at(path: Path, times_s: Floats, *, scale: float = 1.0, seed: int = 3) -> Floats:
    """Points (n, 3) of a path with the noise's deviations times `scale`."""
    random = np.random.default_rng(seed)
    noise = scale * DEVIATIONS_M * random.standard_normal((len(times_s), 3))
    return np.array([path(time) for time in times_s.tolist()]) + noise @ AXES.T


def follow(times_s: Floats, points: Floats, noise: Floats = NOISE) -> list[BankEstimate]:
    estimates: list[BankEstimate] = []
    for time_s, point in zip(times_s.tolist(), points, strict=True):
        at_ns = round(1e9 * time_s)
        estimates.append(
            BANK.update(estimates[-1], at_ns, point, noise)
            if estimates
            else BANK.initialize(at_ns, point, noise)
        )
    return estimates


def errors_m(path: Path, times_s: Floats, estimates: list[BankEstimate]) -> Floats:
    """Distances (n,) between the predictions at the horizon and the path."""
    ahead = np.array([HORIZON_S])
    off = [
        BANK.predict(estimate, ahead)[0] - path(time + HORIZON_S)
        for time, estimate in zip(times_s.tolist(), estimates, strict=True)
    ]
    return np.asarray(np.linalg.norm(off, axis=1))


def rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


AMPLITUDE_M = 4e-4


def swing(frequency_hz: float, amplitude_m: float = AMPLITUDE_M) -> Path:
    return lambda time_s: np.array(
        [amplitude_m * np.sin(2.0 * np.pi * frequency_hz * time_s), 0.0, 0.0]
    )


def hand(seed: int, duration_s: float) -> Path:
    """A hand of the development seeds: wander to 2 Hz and a tremor of 0.05 mm."""
    random = np.random.default_rng(seed)
    grid = sample_wander(2.0, duration_s, random)
    grid += 0.05 * sample_tremor(draw_tremor((6.0, 9.0), seed), duration_s, random)
    return lambda time_s: 1e-3 * grid[round(time_s * GRID_HZ)]


# Gains


@pytest.mark.parametrize("dt", [1 / 120, 1 / 60, 1 / 15])
@pytest.mark.parametrize("deviation_m", [5e-6, 6e-4])
def test_steady_states_solve_the_riccati_equation(dt: float, deviation_m: float) -> None:
    transition, noise = compute_transition(dt), compute_process_noise(dt)
    before = solve_riccati(transition, noise, deviation_m**2)
    observed = before @ OBSERVED
    gain = observed / (observed @ OBSERVED + deviation_m**2)[:, None]
    after = before - gain[:, :, None] * observed[:, None, :]
    again = transition @ after @ transition.transpose(0, 2, 1) + noise
    deviations = np.sqrt(np.diagonal(before, axis1=1, axis2=2) + 1e-20)
    assert (np.abs(again - before) / deviations[:, :, None] / deviations[:, None]).max() < 1e-6
    assert np.linalg.eigvalsh(before).min() > -1e-12


def test_gains_of_a_new_track_fall_to_those_of_the_steady_state() -> None:
    variances = (DEVIATIONS_M**2).tolist()
    first, last, steady = (
        find_gains(1 / 60, variances, points) for points in (2, START_POINTS, START_POINTS + 1)
    )
    position = [gain[:, 0] + gain[:, 3] for gain in (first, last, steady)]
    assert (position[0] >= position[1] - 1e-9).all()
    # Only the steadiest model still learns after so many points.
    assert np.abs(position[1] - position[2])[1:].max() < 0.1


# The combination


def test_weights_have_sum_one_and_pick_the_model_that_is_right() -> None:
    random = np.random.default_rng(4)
    errors = random.standard_normal((400, len(MODELS)))
    errors[:, 5] *= 0.01
    weights = combine(errors.T @ errors / 400)
    assert weights.sum() == pytest.approx(1.0)
    assert weights[5] > 0.8


def test_noise_that_all_models_share_does_not_change_the_weights() -> None:
    random = np.random.default_rng(5)
    errors = random.standard_normal((400, len(MODELS)))
    covariance = errors.T @ errors / 400
    assert combine(covariance + 50.0) == pytest.approx(combine(covariance), abs=1e-4)


def test_models_with_opposite_errors_are_averaged() -> None:
    random = np.random.default_rng(6)
    errors = np.repeat(random.standard_normal((400, 1)), len(MODELS), axis=1)
    errors[:, 1:] *= -1.0
    weights = combine(errors.T @ errors / 400 + 1e-9 * np.eye(len(MODELS)))
    assert weights[0] == pytest.approx(0.5, abs=0.05)


# What is said of the error


@pytest.mark.parametrize("rate_hz", [15, 30, 60, 120])
@pytest.mark.parametrize("scale", [1.0, 10.0])
def test_the_position_is_as_uncertain_as_it_says(rate_hz: int, scale: float) -> None:
    times_s = np.arange(0.0, 12.0, 1.0 / rate_hz)
    path = hand(11, 12.2)
    estimates = follow(times_s, measured_at(path, times_s, scale=scale), scale**2 * NOISE)
    squares = []
    for time_s, estimate in list(zip(times_s.tolist(), estimates, strict=True))[2 * rate_hz :]:
        position, _, covariance = BANK.moments(estimate)
        error = position - path(time_s)
        squares.append(error @ np.linalg.solve(covariance[:3, :3], error) / 3.0)
    assert 0.6 < np.mean(squares) < 1.4


# Symmetry


def test_a_rotated_rig_predicts_the_same_finger() -> None:
    times_s = np.arange(0.0, 4.0, 1 / 60)
    path = hand(12, 4.2)
    points = measured_at(path, times_s)
    plain = follow(times_s, points)[-1]
    turn = np.linalg.qr(np.random.default_rng(7).standard_normal((3, 3)))[0]
    rotated = follow(times_s, points @ turn.T, turn @ NOISE @ turn.T)[-1]
    ahead = np.array([0.0, 0.03, 0.1])
    assert BANK.predict(rotated, ahead) == pytest.approx(
        BANK.predict(plain, ahead) @ turn.T, abs=1e-9
    )


def test_noise_that_turns_while_the_finger_moves_costs_little() -> None:
    times_s = np.arange(0.0, 8.0, 1 / 60)
    path = hand(13, 8.2)
    points = measured_at(path, times_s)
    estimate = BANK.initialize(0, points[0], NOISE)
    estimates = [estimate]
    for i, time_s in enumerate(times_s[1:].tolist(), start=1):
        angle = 0.8 * time_s / 8.0
        turn = np.array(
            [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
        )
        true = path(time_s)
        point = true + turn @ (points[i] - true)
        estimate = BANK.update(estimate, round(1e9 * time_s), point, turn @ NOISE @ turn.T)
        estimates.append(estimate)
    fixed = rms(errors_m(path, times_s, follow(times_s, points))[120:])
    assert np.abs(estimates[-1].axes - estimates[0].axes).max() > 0.1
    assert rms(errors_m(path, times_s, estimates)[120:]) < 1.5 * fixed


# Where it ends


@pytest.mark.parametrize("frequency_hz", [0.5, 2.0, 3.5, 7.0, 13.0, 20.0, 25.0])
def test_a_steady_swing_is_predicted_within_and_beyond_the_models_frequencies(
    frequency_hz: float,
) -> None:
    path, times_s = swing(frequency_hz), np.arange(0.0, 6.0, 1 / 60)
    errors = errors_m(path, times_s, follow(times_s, measured_at(path, times_s)))
    assert rms(errors[240:]) < 0.4 * AMPLITUDE_M


@pytest.mark.parametrize("frequency_hz", [38.0, 47.0])
def test_a_swing_beyond_half_the_frame_rate_is_not_predicted_but_bounded(
    frequency_hz: float,
) -> None:
    path, times_s = swing(frequency_hz), np.arange(0.0, 6.0, 1 / 60)
    estimates = follow(times_s, measured_at(path, times_s))
    ahead = np.array([0.058])  # no whole number of frames, where an alias would be met by chance
    off = [
        BANK.predict(estimate, ahead)[0] - path(time + 0.058)
        for time, estimate in zip(times_s.tolist(), estimates, strict=True)
    ]
    error = rms(np.linalg.norm(off, axis=1)[240:])
    assert 0.5 * AMPLITUDE_M < error < 3.0 * AMPLITUDE_M


def test_a_tremor_that_changes_its_frequency_is_learnt_again() -> None:
    def path(time_s: float) -> Floats:
        return swing(6.0 if time_s < 5.0 else 11.0)(time_s)

    times_s = np.arange(0.0, 10.0, 1 / 60)
    errors = errors_m(path, times_s, follow(times_s, measured_at(path, times_s)))
    assert rms(errors[300:330]) > 2.0 * rms(errors[240:290])
    assert rms(errors[480:]) < 2.0 * rms(errors[240:290])


def test_a_step_passes_within_the_memory() -> None:
    def path(time_s: float) -> Floats:
        return np.array([0.0 if time_s < 4.0 else 3e-3, 0.0, 0.0])

    times_s = np.arange(0.0, 8.0, 1 / 60)
    errors = errors_m(path, times_s, follow(times_s, measured_at(path, times_s)))
    assert errors.max() < 0.02
    assert rms(errors[420:]) < 4.0 * rms(errors[180:235])


@pytest.mark.parametrize("lost", [0.1, 0.3])
def test_lost_frames_and_uneven_stamps_cost_little(lost: float) -> None:
    random = np.random.default_rng(8)
    path, even_s = hand(14, 10.2), np.arange(0.0, 10.0, 1 / 60)
    regular = errors_m(path, even_s, follow(even_s, measured_at(path, even_s)))
    uneven_s = even_s[random.random(len(even_s)) > lost]
    uneven_s = uneven_s + random.uniform(0.0, 0.002, len(uneven_s))
    irregular = errors_m(path, uneven_s, follow(uneven_s, measured_at(path, uneven_s)))
    late = uneven_s > 2.0
    assert rms(irregular[late]) < 1.6 * rms(regular[120:])


def test_another_frame_rate_is_followed_at_once() -> None:
    path = hand(15, 12.2)
    times_s = np.concatenate(
        [np.arange(0.0, 4.0, 1 / 60), np.arange(4.0, 8.0, 1 / 15), np.arange(8.0, 12.0, 1 / 120)]
    )
    points = measured_at(path, times_s)
    errors = errors_m(path, times_s, follow(times_s, points))
    for begin_s, end_s in ((4.0, 8.0), (8.0, 12.0)):
        chosen = (times_s >= begin_s) & (times_s < end_s)
        restarted = errors_m(path, times_s[chosen], follow(times_s[chosen], points[chosen]))
        late = times_s[chosen] > begin_s + 0.5
        assert rms(errors[chosen][late]) < 1.3 * rms(restarted[late])
        assert errors[chosen][:3].max() < 4.0 * rms(restarted)


def test_a_new_track_is_predicted_from_its_first_points() -> None:
    def path(time_s: float) -> Floats:
        return np.array([0.3 * time_s, 0.0, 0.0])

    times_s = np.arange(0.0, 0.2, 1 / 60)
    errors = errors_m(path, times_s, follow(times_s, measured_at(path, times_s)))
    assert (errors[2:] < 0.1 * 0.3 * HORIZON_S).all()


def test_a_point_that_is_not_finite_never_enters() -> None:
    tracker = Tracker(TrackingSettings(max_speed_m_per_s=1.5))
    path, times_s = hand(16, 2.2), np.arange(0.0, 2.0, 1 / 60)
    points = measured_at(path, times_s)
    for i, time_s in enumerate(times_s.tolist()):
        bad = i % 7 == 3
        point = np.full(3, np.nan) if bad else points[i]
        assert not (tracker.update(round(1e9 * time_s), point, NOISE) == "ok" and bad)
    track = tracker.predict_at(round(1e9 * times_s[-1]), np.array([0.0, 0.1]))
    assert np.isfinite(track.path).all()
    assert np.isfinite(track.covariance).all()
