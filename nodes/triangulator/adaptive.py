"""Predict a hand's motion by combining the predictions of a bank of steady-state Kalman filters.

Each filter assumes one motion model: white noise in the acceleration or in the jerk, alone or with
an oscillator.  The weights minimise the mean square of the combined error at the horizon of use, by
the covariance of the filters' errors at that horizon over the last seconds.  They may be negative,
so that the combination learns a spectrum that no single model has.

Sources: Bates and Granger, Operational Research Quarterly 20, 1969 (combination by the covariance
of the errors); Singer, IEEE Trans. Aerospace and Electronic Systems 6, 1970 (decaying
acceleration); Chu, Fan, Lin, Int. J. Control 77, 2004 (doubling for the Riccati equation).
"""

from __future__ import annotations

import bisect
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from flexsheet.nodes.triangulator.filters import Estimate, Filter, OneEuro, Unfiltered

Floats = NDArray[np.float64]
Model = tuple[float, float, float, float]
"""Spectral density of the noise in the acceleration, m^2/s^3, and in the jerk, m^2/s^5; frequency
in Hz and standard deviation in m of an oscillator."""

STATES = 5
"""States of a model, per axis: position, velocity, acceleration; displacement and velocity of the
oscillator."""

OBSERVED = np.array([1.0, 0.0, 0.0, 1.0, 0.0])
"""Row that gives the position of the finger from a state."""

ACCELERATION_DECAY_PER_S = 6.0
"""Rate at which an acceleration decays (Singer 1970), since no hand keeps one for long."""

MAX_OSCILLATOR_WIDTH_HZ = 2.0
"""Half-power width of an oscillator: a tremor's peak and the wander of its frequency.  Slow
oscillators, which stand for voluntary motion around one point, are damped by half."""

SCORED_HORIZONS_S = (0.0, 0.05, 0.1)
"""Horizons at which errors are measured, over whole frames and no less: one frame for the first.
Predictions in between use weights in between."""

MAX_AGE_NS = round(2e9 * SCORED_HORIZONS_S[-1])
"""Maximum age of stored earlier states."""

STAMP_JITTER_NS = 2_000_000
"""Time by which a scored age may fall short of its horizon."""

MEMORY_S, MEMORY_POINTS = 1.0, 60
"""Time constant of the covariance of the filters' errors, and the points that it has at least."""

RECENT_S, RECENT_POINTS = 0.2, 10
OUTDATED_RATIO = 1.5
OUTDATED_MEMORY_S, OUTDATED_MEMORY_POINTS = 0.15, 8
"""Time constant of recent mean-square errors; ratio of the combination's to the best model's above
which the covariance is outdated; and the shorter memory that it then has."""

PRIOR_POINTS, PRIOR_ERROR_M = 3, 1e-4
"""Error of every filter at first, and its weight in points."""

MIN_ERROR_M = 1e-9
"""Size of errors below which they are not scaled up."""

SHRINKAGE = 0.02
"""Weight of equal shares against the covariance of the errors, which is one of a few seconds, as a
fraction of the mean square of the differences between the filters' predictions."""

COMBINE_EVERY_POINTS = 4
"""Number of points after which the weights are computed again."""

MIN_GAIN = 0.1
"""Minimum gain of the filtered position: the innovation's mean square is known to about a tenth."""

START_POINTS = 32
"""Number of points at the start of a track for which gains are those of a Kalman filter that knows
little yet; after them, gains are those of the steady state."""

INITIAL_SPEED_M_PER_S, INITIAL_ACCELERATION = 0.1, 1.0
"""Standard deviations of speed and acceleration (m/s^2) at the start of a track."""

MIN_INTERVAL_S, MAX_INTERVAL_S = 0.004, 0.15
INTERVAL_RATIO, NOISE_RATIO = 1.08, 1.5
"""Range and spacing of the frame intervals, and spacing of the noise variances, for which gains are
computed."""

TIME_STEP_S = 1e-5
"""Resolution of the times for which transitions are cached: a finger at 0.1 m/s moves 1 um."""

MAX_CORRELATION = 0.3
"""Correlation of the measurement noise between axes above which the axes are rotated."""


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
"""Steady and lively motion, voluntary motion around one point, tremor, and tremor of a lively hand.
Few models are enough, since their combinations stand for the spectra between them."""

ACCELERATION_NOISE, JERK_NOISE, FREQUENCY_HZ, DEVIATION_M = np.array(MODELS).T
FREQUENCY_RAD_PER_S = 2.0 * np.pi * FREQUENCY_HZ


def _integrate_slow(dt: float) -> Floats:
    """Return the transition (3, 3) of position, velocity and decaying acceleration over dt."""
    rate = ACCELERATION_DECAY_PER_S
    remaining, gone = math.exp(-rate * dt), -math.expm1(-rate * dt)
    if rate * dt < 1e-4:
        return np.array([[1.0, dt, 0.5 * dt * dt], [0.0, 1.0, dt], [0.0, 0.0, remaining]])
    return np.array(
        [[1.0, dt, (rate * dt - gone) / rate**2], [0.0, 1.0, gone / rate], [0.0, 0.0, remaining]]
    )


def compute_transition(dt: float) -> Floats:
    """Compute the transition (models, 5, 5) over dt."""
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
    """Compute the covariance (models, 5, 5) that the models' noise adds over dt."""
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
    """Return the stationary covariance (models, 2, 2) of the oscillators."""
    result = np.zeros((len(DEVIATION_M), 2, 2))
    result[:, 0, 0] = DEVIATION_M**2
    result[:, 1, 1] = (DEVIATION_M * FREQUENCY_RAD_PER_S) ** 2
    return result


def solve_riccati(transition: Floats, process_noise: Floats, variance: float) -> Floats:
    """Return the steady-state covariance (models, 5, 5) before a measurement of that variance.

    Each iteration of the doubling algorithm doubles the number of frames.
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
    """Return gains (points, models, 5) for one axis, by the logarithms of interval and variance.

    They are those for the points 2 to START_POINTS of a track, and last those of the steady state.
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
    """Return the gain (models, 5) from the covariance (models, 5, 5) before a measurement."""
    observed = covariance @ OBSERVED
    return np.asarray(observed / (observed @ OBSERVED + variance)[:, None])


@lru_cache(maxsize=1024)
def _stack_gains(interval: int, noises: tuple[int, int, int], index: int) -> Floats:
    return np.stack([_solve_gains(interval, noise)[index] for noise in noises], axis=-1)


def find_gains(dt: float, variances: list[float], points: int) -> Floats:
    """Return the gains (models, 5, 3) for a frame interval and the noise of three axes, m^2.

    points: number of the track's points, two or more; after START_POINTS the state is steady.

    The first call for an interval or a noise solves its Riccati equations, which takes some
    milliseconds; later calls for values near them take microseconds.
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
    """Return the rows (models, 1, 5) that give the finger's position some time steps later."""
    return (OBSERVED @ _find_transition(steps))[:, None, :]


@lru_cache(maxsize=64)
def _find_rows(horizons: bytes) -> Floats:
    """Return the rows (n, models * 5) that give positions at horizons (n,) s from weighted states.

    horizons: the bytes of the array.
    """
    rows = [OBSERVED @ compute_transition(float(time)) for time in np.frombuffer(horizons)]
    return np.array(rows).reshape(len(rows), -1)


@lru_cache(maxsize=512)
def _find_shares(horizons: bytes, ages_ms: tuple[int, ...]) -> Floats:
    """Return the shares (scored horizons + 1, n, 1) in the predictions at horizons (n,) s.

    They are those of each scored horizon's weights, by its age, and that of the filtered position's
    offset, which fades towards the first of them.
    """
    times_ms = 1e3 * np.frombuffer(horizons)
    anchors_ms, counts = np.unique(ages_ms, return_counts=True)
    together = np.interp(times_ms, anchors_ms, counts)
    shares = [np.interp(times_ms, anchors_ms, anchors_ms == age) / together for age in ages_ms]
    offset = np.interp(times_ms, [0.0, ages_ms[0]], [1.0, 0.0])
    return np.stack([*shares, offset])[:, :, None]


def combine(covariance: Floats) -> Floats:
    """Return weights (..., models) of sum 1 that minimise the mean square of the combined error.

    covariance: (..., models, models) of the models' errors, in any unit.  The measurement noise in
        them is equal for all models, so that it changes nothing.
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
class BankEstimate(Estimate):
    """States of the filter bank (models, 5, 3) at one time, with the learnt weights.

    covariance: (3, 3) m^2 of the newest measured point, in the world frame.
    axes: columns (3, 3) in the world frame along which the measurement noise is uncorrelated; the
        states are along them.
    points: number of points since the track began.
    past_ns, past: earlier times and states, oldest first, over the longest scored horizon.
    error_covariance: (scored horizons, 3, models, models) m of the models' prediction errors by
        axis, each divided by the root of its size at the time.
    weights: (scored horizons, 3, models), with sum 1 over the models.
    recent: mean squares (scored horizons, 3, models + 1) m^2 of the errors of each model and of the
        combination in the last instants.
    scored_ages_ms: ages of the states whose predictions of the newest point were scored.
    innovation: mean square (3,) m^2 of the combined innovation.
    position, variance: filtered position (3,) m along the axes, and its error variance (3,) m^2.
    velocity_variance: (3,) m^2/s^2.
    """

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
    """Filter and predict by the bank; see the module."""

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
        self, before: Estimate, at_ns: int, measured: Floats, covariance: Floats
    ) -> BankEstimate:
        assert isinstance(before, BankEstimate)
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
        # The innovation's mean square is the sum of the prediction's and the point's variances, so
        # that it gives the gain; a larger innovation means that the motion has just changed.
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
        # A combination that is worse than its best model has been learnt from another motion.
        is_outdated = recent[:, :, -1] > OUTDATED_RATIO * recent[:, :, :-1].min(axis=2)
        sooner = max(forgotten, _forget(dt, OUTDATED_MEMORY_S, OUTDATED_MEMORY_POINTS))
        fresh = np.where(is_outdated, sooner, forgotten)[:, :, None, None]
        # A calm hand after a lively one must not wait until the larger errors are forgotten.
        sizes = np.sqrt(np.einsum("sam,sam->sa", errors, errors) / len(MODELS))
        errors /= np.sqrt(sizes + MIN_ERROR_M)[:, :, None]
        error_covariance = (1.0 - fresh) * before.error_covariance
        error_covariance += errors[..., None] * fresh * errors[:, :, None]
        # The weights change slowly, and solving for them takes as long as all the rest.
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

    def moments(self, estimate: Estimate) -> tuple[Floats, Floats, Floats]:
        assert isinstance(estimate, BankEstimate)
        axes, full = estimate.axes, np.zeros((6, 6))
        full[:3, :3] = (axes * estimate.variance) @ axes.T
        full[3:, 3:] = (axes * estimate.velocity_variance) @ axes.T
        velocities = estimate.state[:, 1] + estimate.state[:, 4]
        velocity = (estimate.weights[0].T * velocities).sum(axis=0)
        return axes @ estimate.position, axes @ velocity, full

    def predict(self, estimate: Estimate, horizons_s: Floats) -> Floats:
        assert isinstance(estimate, BankEstimate)
        horizons = horizons_s.tobytes()
        weighted = estimate.weights.transpose(0, 2, 1)[:, :, None] * estimate.state
        paths = np.empty((len(weighted) + 1, len(horizons_s), 3))
        np.matmul(_find_rows(horizons), weighted.reshape(len(weighted), -1, 3), out=paths[:-1])
        paths[-1] = estimate.position - (weighted[0, :, 0] + weighted[0, :, 3]).sum(axis=0)
        shares = _find_shares(horizons, estimate.scored_ages_ms)
        return np.asarray((shares * paths).sum(axis=0) @ estimate.axes.T)


def _forget(dt: float, memory_s: float, memory_points: int) -> float:
    """Return the weight of a new value in a mean over a time, and at least over some points."""
    return min(-math.expm1(-dt / memory_s), 1.0 / memory_points)


def predict_by_model(estimate: BankEstimate, horizons_s: Floats) -> Floats:
    """Return the positions (n, models, 3) that each model predicts at times (n,) s."""
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
    """Return the errors (scored horizons, 3, models) m with which earlier states predicted a point.

    The first are the innovations (models, 3) after the newest state.  Each other horizon takes the
    newest state that is as old, else the oldest.  The second result contains their ages in ms.
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
    """Rotate an estimate's axes if the noise of a new point is correlated between them.

    Returns the estimate and the noise variances (3,) m^2 along its axes.
    """
    noise = estimate.axes.T @ covariance @ estimate.axes
    variances = np.diagonal(noise)
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = noise.tolist()
    limit = MAX_CORRELATION**2
    if xy * xy < limit * xx * yy and xz * xz < limit * xx * zz and yz * yz < limit * yy * zz:
        return estimate, variances
    variances, axes = np.linalg.eigh(covariance)
    rotation = estimate.axes.T @ axes
    # Mean squares along the new axes, as if errors along the old ones were uncorrelated.
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


TRACKING_METHODS: dict[str, Callable[[float], Filter]] = {
    "none": Unfiltered,
    "one_euro": OneEuro,
    "adaptive": AdaptiveBank,
}
"""Filters by name, made for a finger's maximum speed (m/s)."""
