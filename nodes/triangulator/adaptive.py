"""Predict a hand's motion by combining the predictions of a bank of steady-state Kalman filters.

Each filter assumes one motion model: white noise in the acceleration or in the jerk, alone or with
an oscillator. The prediction is the weighted sum of the filters' predictions. The weights minimise
the mean square error of the sum at the prediction horizon. They are computed from the covariance of
the filters' errors in the last seconds. Weights can be negative, so the sum can represent motion
spectra that no single model has.

Sources: Bates and Granger, Operational Research Quarterly 20, 1969 (combination by the covariance
    of the errors); Singer, IEEE Trans. Aerospace and Electronic Systems 6, 1970 (decaying
    acceleration); Chu, Fan, Lin, Int. J. Control 77, 2004 (doubling for the Riccati equation).
"""

from __future__ import annotations

import bisect
import math
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from flexsheet.nodes.arrays import Floats

Model = tuple[float, float, float, float]
"""The parameters of a motion model. The first two are the spectral densities of the acceleration
noise (m^2/s^3) and of the jerk noise (m^2/s^5). The last two are the frequency (Hz) and the
standard deviation (m) of the oscillator."""

STATES = 5
"""The number of states of a model per axis: position, velocity and acceleration of the finger
without the oscillator, and displacement and velocity of the oscillator."""

OBSERVED = np.array([1.0, 0.0, 0.0, 1.0, 0.0])
"""The observation vector. The product of this vector and a state is the position of the finger."""

ACCELERATION_DECAY_PER_S = 6.0
"""The exponential decay rate of the acceleration (Singer 1970). A hand cannot maintain an
acceleration for long."""

MAX_OSCILLATOR_WIDTH_HZ = 2.0
"""The maximum half-power bandwidth (Hz) of the oscillator in a motion model of the finger. It
covers the spectral peak of a tremor, and changes of the tremor's frequency. At low frequencies, a
damping ratio of 0.5 sets a smaller bandwidth. Oscillators of low frequency model voluntary motion
around one point."""

SCORED_HORIZONS_S = (0.0, 0.05, 0.1)
"""The prediction horizons (s) at which prediction errors are measured to compute the weights of the
filters. Horizons are rounded up to whole frames, and the first horizon is one frame. Weights for
other horizons are interpolated."""

MAX_AGE_NS = round(2e9 * SCORED_HORIZONS_S[-1])
"""The maximum age of the earlier filter states that are stored to measure prediction errors."""

STAMP_JITTER_NS = 2_000_000
"""The tolerance for jitter of the camera's timestamps."""

MEMORY_S, MEMORY_POINTS = 1.0, 60
"""The time constant and the minimum number of points for averaging the covariance of the filters'
errors."""

RECENT_S, RECENT_POINTS = 0.2, 10
"""The time constant and the minimum number of points for averaging recent mean square errors."""

OUTDATED_RATIO = 1.5
"""The error ratio above which the error covariance is outdated because the motion has changed. The
ratio is the mean square error of the weighted sum divided by the mean square error of the best
model."""

OUTDATED_MEMORY_S, OUTDATED_MEMORY_POINTS = 0.15, 8
"""The time constant and the minimum number of points for averaging the covariance of the filters'
errors if it is outdated."""

PRIOR_POINTS, PRIOR_ERROR_M = 3, 1e-4
"""The weight (in points) and the value of the initial variance of prediction errors. The variance
has the unit m, because each error (m) is divided by the square root of its magnitude."""

MIN_ERROR_M = 1e-9
"""A constant that is added to the magnitude of errors to avoid a division by zero."""

SHRINKAGE = 0.02
"""The regularisation of the weights towards equal weights, as a fraction of the mean square
difference between the predictions. It is necessary because the covariance of the errors is
estimated from only a few seconds."""

COMBINE_EVERY_POINTS = 4
"""The number of measured points after which the weights of the models are computed again."""

MIN_GAIN = 0.1
"""The minimum ratio of the prediction's variance to the variance of a measured point. The gain of
the filtered position is computed from this ratio, whose error is about 0.1."""

START_POINTS = 32
"""The number of points at the start of a track for which the Kalman gains vary with time. Later
points use the steady-state gains."""

INITIAL_SPEED_M_PER_S, INITIAL_ACCELERATION = 0.1, 1.0
"""The standard deviations of speed (m/s) and acceleration (m/s^2) at the start of a track."""

MIN_INTERVAL_S, MAX_INTERVAL_S = 0.004, 0.15
"""The range of frame intervals for which gains are computed."""

INTERVAL_RATIO, NOISE_RATIO = 1.08, 1.5
"""The ratios between adjacent frame intervals and between adjacent noise variances for which gains
are computed and cached."""

TIME_STEP_S = 1e-5
"""The time resolution of cached state transitions. A finger at 0.1 m/s moves by 1 um in this
time."""

MAX_CORRELATION = 0.3
"""The maximum correlation of the measurement noise between two axes. If it is larger, the axes are
rotated so that their noise is uncorrelated."""


NO_OSCILLATOR = (10.0, 0.0)
MODELS: tuple[Model, ...] = (
    (1e-5, 0.0, *NO_OSCILLATOR),
    (1e-3, 0.0, *NO_OSCILLATOR),
    (0.0, 1e-2, *NO_OSCILLATOR),
    (0.0, 1e0, *NO_OSCILLATOR),
    (0.0, 1e2, *NO_OSCILLATOR),
    *((1e-7, 0.0, frequency_hz, 5e-4) for frequency_hz in (1.0, 2.5)),
    *((0.0, 1e-2, frequency_hz, 1e-4) for frequency_hz in (5.0, 6.5, 8.0, 9.5, 11.5)),
    *((0.0, 1e1, frequency_hz, 1e-4) for frequency_hz in (6.0, 9.0)),
)
"""The motion models: slow and fast motion, voluntary motion around one point, tremor, and tremor
during fast motion. Weighted sums of these models approximate the motion spectra between them."""

ACCELERATION_NOISE, JERK_NOISE, FREQUENCY_HZ, DEVIATION_M = np.array(MODELS).T
FREQUENCY_RAD_PER_S = 2.0 * np.pi * FREQUENCY_HZ


def _integrate_slow(dt: float) -> Floats:
    """Return the matrix (3, 3) that advances position, velocity and acceleration by dt (s).

    The acceleration decays at the rate ACCELERATION_DECAY_PER_S.
    """
    rate = ACCELERATION_DECAY_PER_S
    remaining, gone = math.exp(-rate * dt), -math.expm1(-rate * dt)
    if rate * dt < 1e-4:
        return np.array([[1.0, dt, 0.5 * dt * dt], [0.0, 1.0, dt], [0.0, 0.0, remaining]])
    return np.array(
        [[1.0, dt, (rate * dt - gone) / rate**2], [0.0, 1.0, gone / rate], [0.0, 0.0, remaining]]
    )


def compute_transition(dt: float) -> Floats:
    """Compute the matrices (models, 5, 5) that advance the state of each model by dt (s)."""
    natural = FREQUENCY_RAD_PER_S
    decay = np.minimum(np.pi * MAX_OSCILLATOR_WIDTH_HZ, 0.5 * natural)
    swing = np.sqrt(natural**2 - decay**2)
    left = np.exp(-decay * dt)
    sine = left * np.sin(swing * dt) / swing
    stays = left * np.cos(swing * dt) + decay * sine
    result = np.zeros((len(natural), STATES, STATES))
    result[:, :3, :3] = _integrate_slow(dt)
    result[:, 3, 3] = stays
    result[:, 3, 4] = sine
    result[:, 4, 3] = -(natural**2) * sine
    result[:, 4, 4] = stays - 2.0 * decay * sine
    return result


def compute_process_noise(dt: float) -> Floats:
    """Compute the covariances (models, 5, 5) that process noise adds to the states in dt (s)."""
    acceleration, jerk = np.zeros((3, 3)), np.zeros((3, 3))
    for node, weight in zip(*np.polynomial.legendre.leggauss(4), strict=True):
        slow = _integrate_slow(0.5 * dt * (1.0 + node))
        acceleration += 0.5 * dt * weight * np.outer(slow[:, 1], slow[:, 1])
        jerk += 0.5 * dt * weight * np.outer(slow[:, 2], slow[:, 2])
    result = np.zeros((len(DEVIATION_M), STATES, STATES))
    result[:, :3, :3] = (
        ACCELERATION_NOISE[:, None, None] * acceleration + JERK_NOISE[:, None, None] * jerk
    )
    stationary = _stationary_oscillators()
    swing = compute_transition(dt)[:, 3:, 3:]
    result[:, 3:, 3:] = stationary - swing @ stationary @ swing.transpose(0, 2, 1)
    return result


def _stationary_oscillators() -> Floats:
    """Return the stationary covariance (2, 2) of each motion model's oscillator.

    The result has the shape (models, 2, 2). The oscillator is a part of the assumed finger motion.
    Its state is the displacement and the velocity.
    """
    result = np.zeros((len(DEVIATION_M), 2, 2))
    result[:, 0, 0] = DEVIATION_M**2
    result[:, 1, 1] = (DEVIATION_M * FREQUENCY_RAD_PER_S) ** 2
    return result


def solve_riccati(transition: Floats, process_noise: Floats, variance: float) -> Floats:
    """Return the steady-state error covariances (models, 5, 5) just before each measurement.

    variance: variance of the measurement noise, m^2.

    The doubling algorithm (Chu et al. 2004) solves the Riccati equation.
    """
    rows, identity = transition.transpose(0, 2, 1), np.eye(STATES)
    information = np.broadcast_to(np.outer(OBSERVED, OBSERVED) / variance, rows.shape)
    covariance = process_noise
    for _ in range(14):
        inverse = np.linalg.inv(identity + information @ covariance)
        columns, reduced = rows.transpose(0, 2, 1), rows @ inverse
        information = information + reduced @ information @ columns
        covariance = covariance + columns @ covariance @ inverse @ rows
        rows = reduced @ rows
    return 0.5 * (covariance + covariance.transpose(0, 2, 1))


@lru_cache(maxsize=256)
def _solve_gains(interval: int, noise: int) -> Floats:
    """Return the Kalman gains of all motion models for one axis of a new track.

    interval, noise: exponents that define the frame interval (s) and the variance (m^2) of the
        measurement noise. The bases are INTERVAL_RATIO and NOISE_RATIO.

    The result has the shape (START_POINTS, models, 5). The first row is the gain for the second
    point of a track, and each further row is for the next point. The last row is the steady-state
    gain, which all later points use.
    """
    dt, variance = INTERVAL_RATIO**interval, NOISE_RATIO**noise
    transition, process_noise = compute_transition(dt), compute_process_noise(dt)
    after = np.zeros_like(transition)
    after[:, range(3), range(3)] = variance, INITIAL_SPEED_M_PER_S**2, INITIAL_ACCELERATION**2
    after[:, 3:, 3:] = _stationary_oscillators()
    gains = []
    for _ in range(START_POINTS - 1):
        before = transition @ after @ transition.transpose(0, 2, 1) + process_noise
        gains.append(_compute_gain(before, variance))
        after = before - gains[-1][:, :, None] * (before @ OBSERVED)[:, None, :]
    gains.append(_compute_gain(solve_riccati(transition, process_noise, variance), variance))
    return np.array(gains)


def _compute_gain(covariance: Floats, variance: float) -> Floats:
    """Return the Kalman gains (models, 5) for predicted covariances (models, 5, 5).

    variance: variance of the measurement noise, m^2.
    """
    observed = covariance @ OBSERVED
    return np.asarray(observed / (observed @ OBSERVED + variance)[:, None])


@lru_cache(maxsize=1024)
def _stack_gains(interval: int, noises: tuple[int, int, int], index: int) -> Floats:
    return np.stack([_solve_gains(interval, noise)[index] for noise in noises], axis=-1)


def find_gains(dt: float, variances: list[float], points: int) -> Floats:
    """Return the Kalman gains (models, 5, 3) for a frame interval and the noise of three axes.

    dt: frame interval, s.
    variances: variance of the measurement noise on each of the three axes, m^2.
    points: number of points in the track, at least two.

    The first call for an interval or a variance takes some milliseconds, and later calls with
    similar values take microseconds.
    """
    interval = round(
        math.log(min(max(dt, MIN_INTERVAL_S), MAX_INTERVAL_S)) / math.log(INTERVAL_RATIO)
    )
    x, y, z = (round(math.log(variance) / math.log(NOISE_RATIO)) for variance in variances)
    return _stack_gains(interval, (x, y, z), min(points - 2, START_POINTS - 1))


@lru_cache(maxsize=512)
def _find_transition(steps: int) -> Floats:
    return compute_transition(steps * TIME_STEP_S)


@lru_cache(maxsize=512)
def _find_observation(steps: int) -> Floats:
    """Return row vectors (models, 1, 5) that predict the finger's position.

    The product with a filter's state (5,) is the position that the motion model predicts.

    steps: prediction horizon in steps of TIME_STEP_S.
    """
    return (OBSERVED @ _find_transition(steps))[:, None, :]


@lru_cache(maxsize=64)
def _find_rows(horizons: bytes) -> Floats:
    """Return the matrix (n, models * 5) that predicts the finger's position at n horizons.

    The matrix is multiplied by the states of all models, of which each is multiplied by the weight
    of its model.

    horizons: horizons (n,), s, as the bytes of a float64 array, which can be a cache key.
    """
    rows = [OBSERVED @ compute_transition(float(time)) for time in np.frombuffer(horizons)]
    return np.array(rows).reshape(len(rows), -1)


@lru_cache(maxsize=512)
def _find_factors(horizons: bytes, ages_ms: tuple[int, ...]) -> Floats:
    """Return factors that interpolate predictions between m horizons with known model weights.

    For each of these m horizons, there are weights of the motion models, and thus a weighted
    prediction. A prediction for another horizon is the sum of the m weighted predictions,
    multiplied by the factors.

    horizons: n horizons (n,), s, of the result, as the bytes of a float64 array, which can be a
        cache key.
    ages_ms: the m horizons (m,), ms.

    The result has the shape (m + 1, n, 1). The last factor is for the correction that makes the
    prediction continuous with the filtered position. It decreases from 1 at the horizon 0 to 0 at
    the first of the m horizons.
    """
    times_ms = 1e3 * np.frombuffer(horizons)
    anchors_ms, counts = np.unique(ages_ms, return_counts=True)
    together = np.interp(times_ms, anchors_ms, counts)
    factors = [np.interp(times_ms, anchors_ms, anchors_ms == age) / together for age in ages_ms]
    offset = np.interp(times_ms, [0.0, ages_ms[0]], [1.0, 0.0])
    return np.stack([*factors, offset])[:, :, None]


def combine(covariance: Floats) -> Floats:
    """Return the weights (..., models) that minimise the mean square error of the weighted sum.

    covariance: covariance (..., models, models) of the models' prediction errors, in any unit.

    The sum of the weights is 1. Measurement noise does not change the result, because the noise is
    the same for all models.
    """
    count = covariance.shape[-1]
    own = covariance.trace(axis1=-2, axis2=-1) / count
    differences = own - covariance.sum(axis=(-2, -1)) / count**2
    ridge = SHRINKAGE * differences + 1e-9 * own
    solved = np.linalg.solve(
        covariance + ridge[..., None, None] * np.eye(count), np.ones((count, 1))
    )[..., 0]
    return np.asarray(solved / solved.sum(axis=-1, keepdims=True))


@dataclass(frozen=True, slots=True)
class BankEstimate:
    """The estimate of a filter bank at one time: the states (models, 5, 3), and their weights.

    The prediction errors are measured at h horizons, SCORED_HORIZONS_S.

    covariance: noise covariance (3, 3), m^2, of the newest measured point in the world frame.
    axes: axes of the states as columns (3, 3) in the world frame. The measurement noise is
        uncorrelated along these axes.
    points: number of points since the start of the track.
    past_ns, past: times and states of earlier estimates, oldest first. They cover the h horizons.
    error_covariance: covariance (h, 3, models, models), m, of the models' prediction errors along
        each axis. To limit the influence of large errors, each error is first divided by the square
        root of its magnitude.
    weights: weights (h, 3, models), whose sum over the models is 1.
    recent: mean square prediction errors (h, 3, models + 1), m^2, in the recent past. The last
        column is for the weighted sum of the predictions.
    scored_ages_ms: ages (h,), ms, of the predictions that were compared with the newest point.
    innovation: mean square error (3,), m^2, of the weighted prediction of the next point.
    position, variance: filtered position (3,) m along the axes, and its error variance (3,) m^2.
    velocity_variance: error variance (3,), m^2/s^2, of the velocity along the axes.
    """

    at_ns: int
    state: Floats
    covariance: Floats
    axes: Floats
    points: int
    past_ns: tuple[int, ...]
    past: tuple[Floats, ...]
    error_covariance: Floats
    weights: Floats
    recent: Floats
    scored_ages_ms: tuple[int, ...]
    innovation: Floats
    position: Floats
    variance: Floats
    velocity_variance: Floats


@dataclass(frozen=True, slots=True)
class AdaptiveBank:
    """A tracking method that combines the predictions of several Kalman filters."""

    max_speed_m_per_s: float

    def initialize(self, at_ns: int, measured: Floats, covariance: Floats) -> BankEstimate:
        variances, axes = np.linalg.eigh(covariance)
        state = np.zeros((len(MODELS), STATES, 3))
        state[:, 0] = measured @ axes
        shape = (len(SCORED_HORIZONS_S), 3, len(MODELS))
        prior = PRIOR_ERROR_M * np.eye(len(MODELS))
        return BankEstimate(
            at_ns,
            state,
            covariance,
            axes=axes,
            points=1,
            past_ns=(),
            past=(),
            error_covariance=np.broadcast_to(prior, (*shape, len(MODELS))),
            weights=np.full(shape, 1.0 / len(MODELS)),
            recent=np.zeros((*shape[:2], len(MODELS) + 1)),
            scored_ages_ms=(1,) * len(SCORED_HORIZONS_S),
            innovation=variances,
            position=state[0, 0],
            variance=variances,
            velocity_variance=np.full(3, (self.max_speed_m_per_s / 3.0) ** 2),
        )

    def update(
        self, before: BankEstimate, at_ns: int, measured: Floats, covariance: Floats
    ) -> BankEstimate:
        before, variances = _align(before, covariance)
        dt, points = (at_ns - before.at_ns) * 1e-9, before.points + 1
        forgotten = max(_forget(dt, MEMORY_S, MEMORY_POINTS), 1.0 / (PRIOR_POINTS + points))
        point = measured @ before.axes
        gains = find_gains(dt, variances.tolist(), points)
        prior = _find_transition(round(dt / TIME_STEP_S)) @ before.state
        innovations = point - (prior[:, 0] + prior[:, 3])
        state = prior + gains * innovations[:, None, :]
        combined = (before.weights[0].T * innovations).sum(axis=0)
        innovation = before.innovation + forgotten * (combined**2 - before.innovation)
        # The mean square innovation is the sum of the variances of the prediction and of the newly
        # measured point.  The gain follows from it.  A larger innovation than the mean shows that
        # the motion has just changed, so it replaces the mean.
        expected = np.maximum(innovation, combined**2) - variances
        expected = np.maximum(expected, MIN_GAIN * variances)
        gain = expected / (expected + variances)
        past_ns, past = (*before.past_ns, before.at_ns), (*before.past, before.state)
        errors, ages_ms = _prediction_errors(past_ns, past, at_ns, point, innovations)
        first = at_ns - past_ns[0] > MAX_AGE_NS
        both = np.concatenate(
            [errors, (before.weights * errors).sum(axis=2, keepdims=True)], axis=2
        )
        recent = before.recent + _forget(dt, RECENT_S, RECENT_POINTS) * (both**2 - before.recent)
        # If the combination is worse than its best model, its weights fit an earlier motion.
        is_outdated = recent[:, :, -1] > OUTDATED_RATIO * recent[:, :, :-1].min(axis=2)
        sooner = max(forgotten, _forget(dt, OUTDATED_MEMORY_S, OUTDATED_MEMORY_POINTS))
        fresh = np.where(is_outdated, sooner, forgotten)[:, :, None, None]
        # Scale the errors by their size.  Otherwise the large errors of a fast motion would
        # determine the weights for a long time after the hand has become slow.
        sizes = np.sqrt(np.einsum("sam,sam->sa", errors, errors) / len(MODELS))
        errors /= np.sqrt(sizes + MIN_ERROR_M)[:, :, None]
        error_covariance = (1.0 - fresh) * before.error_covariance
        error_covariance += errors[..., None] * fresh * errors[:, :, None]
        # The weights change slowly, and their computation takes as long as the rest of the update.
        weights = before.weights
        if points % COMBINE_EVERY_POINTS == 0:
            weights = combine(error_covariance)
        return BankEstimate(
            at_ns,
            state,
            covariance,
            axes=before.axes,
            points=points,
            past_ns=past_ns[first:],
            past=past[first:],
            error_covariance=error_covariance,
            weights=weights,
            recent=recent,
            scored_ages_ms=ages_ms,
            innovation=innovation,
            position=point - (1.0 - gain) * combined,
            variance=gain * variances,
            velocity_variance=expected / max(dt, MIN_INTERVAL_S) ** 2,
        )

    def moments(self, estimate: BankEstimate) -> tuple[Floats, Floats, Floats]:
        axes, full = estimate.axes, np.zeros((6, 6))
        full[:3, :3] = (axes * estimate.variance) @ axes.T
        full[3:, 3:] = (axes * estimate.velocity_variance) @ axes.T
        velocities = estimate.state[:, 1] + estimate.state[:, 4]
        velocity = (estimate.weights[0].T * velocities).sum(axis=0)
        return axes @ estimate.position, axes @ velocity, full

    def predict(self, estimate: BankEstimate, horizons_s: Floats) -> Floats:
        horizons = horizons_s.tobytes()
        weighted = estimate.weights.transpose(0, 2, 1)[:, :, None] * estimate.state
        paths = np.empty((len(weighted) + 1, len(horizons_s), 3))
        np.matmul(_find_rows(horizons), weighted.reshape(len(weighted), -1, 3), out=paths[:-1])
        paths[-1] = estimate.position - (weighted[0, :, 0] + weighted[0, :, 3]).sum(axis=0)
        factors = _find_factors(horizons, estimate.scored_ages_ms)
        return np.asarray((factors * paths).sum(axis=0) @ estimate.axes.T)


def _forget(dt: float, memory_s: float, memory_points: int) -> float:
    """Return the weight of a new value in an exponential average.

    dt: time since the last value, s.
    memory_s: time constant of the average.
    memory_points: minimum number of points in the average.
    """
    return min(-math.expm1(-dt / memory_s), 1.0 / memory_points)


def predict_by_model(estimate: BankEstimate, horizons_s: Floats) -> Floats:
    """Return the positions (n, models, 3), m, that each model predicts at horizons (n,), s."""
    rows = _find_rows(horizons_s.tobytes())
    by_model = np.einsum("nms,msa->nma", rows.reshape(-1, len(MODELS), STATES), estimate.state)
    return np.asarray(by_model @ estimate.axes.T)


def _prediction_errors(
    times_ns: tuple[int, ...],
    states: tuple[Floats, ...],
    at_ns: int,
    point: Floats,
    innovations: Floats,
) -> tuple[Floats, tuple[int, ...]]:
    """Return the errors of earlier predictions for a newly measured point.

    times_ns, states: times of earlier estimates, and their filter states, oldest first.
    at_ns, point: time of the new point, and its position (3,), m, in the axes of the states.
    innovations: errors (models, 3), m, of the predictions from the newest state.

    Returns the errors (h, 3, models), m, for the h horizons SCORED_HORIZONS_S. A second result is
    the age (ms) of the state from which each prediction was made. For the first horizon, the errors
    are the innovations. For any other horizon, the newest state that is at least as old as the
    horizon is used. If all states are newer, the oldest state is used.
    """
    errors = np.empty((len(SCORED_HORIZONS_S), 3, len(MODELS)))
    errors[0] = innovations.T
    ages_ms = [max(round((at_ns - times_ns[-1]) * 1e-6), 1)]
    for error, horizon_s in zip(errors[1:], SCORED_HORIZONS_S[1:], strict=True):
        newest_ns = at_ns - round(1e9 * horizon_s) + STAMP_JITTER_NS
        index = max(bisect.bisect(times_ns, newest_ns) - 1, 0)
        age_ns = at_ns - times_ns[index]
        ages_ms.append(max(round(age_ns * 1e-6), 1))
        rows = _find_observation(round(age_ns * 1e-9 / TIME_STEP_S))
        np.subtract(point[:, None], (rows @ states[index])[:, 0].T, out=error)
    return errors, tuple(ages_ms)


def _align(estimate: BankEstimate, covariance: Floats) -> tuple[BankEstimate, Floats]:
    """Rotate the axes of an estimate to axes along which the noise of a new point is uncorrelated.

    covariance: noise covariance (3, 3), m^2, of the new point.

    Returns the rotated estimate, and the noise variances (3,), m^2, along the rotated axes.
    """
    noise = estimate.axes.T @ covariance @ estimate.axes
    variances = np.diagonal(noise)
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = noise.tolist()
    limit = MAX_CORRELATION**2
    if xy * xy < limit * xx * yy and xz * xz < limit * xx * zz and yz * yz < limit * yy * zz:
        return estimate, variances
    variances, axes = np.linalg.eigh(covariance)
    rotation = estimate.axes.T @ axes
    # This converts mean squares to the new axes, assuming uncorrelated errors along the old axes.
    mix = rotation.T**2
    rotated = replace(
        estimate,
        state=estimate.state @ rotation,
        axes=axes,
        past=tuple(state @ rotation for state in estimate.past),
        error_covariance=np.einsum("ij,sjmn->simn", mix, estimate.error_covariance),
        weights=mix @ estimate.weights,
        recent=mix @ estimate.recent,
        innovation=mix @ estimate.innovation,
        position=estimate.position @ rotation,
        variance=mix @ estimate.variance,
        velocity_variance=mix @ estimate.velocity_variance,
    )
    return rotated, variances
