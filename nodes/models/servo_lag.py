"""Estimate by how much time an arm lags behind its commands, from commanded and measured joint
angles.

The lags of a grid are tried. For each lag, the measured joint angles are compared with the commands
that were sent by this lag earlier. The estimate is the lag at which the variance of the difference
is smallest. For white noise, this is the maximum-likelihood estimate (Knapp and Carter, The
generalized correlation method for estimation of time delay, 1976). The weight of old samples decays
exponentially. The variance does not depend on a constant difference due to gravity or an encoder
offset. Therefore motion at constant velocity gives no information about the lag.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from flexsheet.nodes.arrays import Floats

GRID_STEP_S = 0.004
"""The step (s) of the grid of lags. A parabola gives the best lag between grid points."""

MEMORY_S = 1.2
"""The time constant, in seconds, with which the weight of samples decays."""

MIN_OBSERVED_S = 1.0
"""The duration of observed motion that is required before the first estimate, s."""

MIN_SPEED_RAD_PER_S = 0.01
"""The minimum standard deviation of the joints' speed. If it is smaller, no estimate is made."""

MAX_MISFIT_RATIO = 0.05
"""The maximum fraction of the motion's variance that the lag leaves unexplained.

If the fraction is larger, no estimate is made, because the arm does not move as commanded or a
joint has the wrong sign.
"""

CORRELATION_S = 0.1
"""The time (s) within which errors of the joint angles are correlated. Samples within this time
count as a single sample."""

MIN_NOISE_RATIO = 0.2
"""The minimum noise variance, as a fraction of the variance of measured minus commanded joint
angles.

This minimum accounts for the errors of the servo model.
"""

MAX_UNCERTAINTY_S = 0.004
"""The maximum standard deviation (s) of an estimate that is used."""

MAX_SLEW_S_PER_S = 0.02
"""The maximum rate (s/s) at which the used lag changes. The limit prevents jumps of the arm's
target positions."""

HISTORY = 256
MIN_COMMANDS = 4
"""The minimum number of recorded commands. If fewer commands are recorded, measurements are not
used."""

MIN_STEP_S = 0.02
"""The minimum time between two measurements that are used, s.

More measurements would need more computing time, but would add little information.
"""

MAX_JOINT_RAD = 10.0
"""The maximum plausible angle of a joint. Larger angles are treated as errors."""

MAX_GAP_S = 0.05
"""The maximum time between two commands, s. After a longer gap, the recorded motion is
discarded."""


@dataclass(frozen=True, slots=True)
class LagBounds:
    """The minimum and the maximum lag (s) of an arm."""

    min_s: float
    max_s: float

    def clip(self, lag_s: float) -> float:
        """Return `lag_s`, limited to the range between the minimum and the maximum."""
        return min(max(lag_s, self.min_s), self.max_s)


@dataclass(frozen=True, slots=True)
class LagEstimate:
    """An estimated lag (s) of an arm, and its standard deviation (s).

    tracking_error_rad: difference between measured joint angles and commanded joint angles that are
        delayed by the lag. The value is the standard deviation of each joint, combined as the norm
        over the joints.
    expected_error_rad: tracking error of a critically damped servo with this lag and motion.
    answer_delay_s: mean time from a command to the measurement.
    command_interval_s: mean interval between commands.

    Both means are weighted by the squared speed, because fast motion determines the lag better.
    """

    lag_s: float
    uncertainty_s: float
    tracking_error_rad: float
    expected_error_rad: float
    answer_delay_s: float
    command_interval_s: float


class ServoLagEstimator:
    """An estimator of the lag of one arm behind its commands.

    estimate: newest estimate; None before the first estimate.
    lag_s: lag that callers should use, in seconds. It is always within the bounds. The value starts
        at the initial lag and changes slowly towards the estimate.
    """

    def __init__(self, initial_s: float, bounds: LagBounds) -> None:
        self.estimate: LagEstimate | None = None
        self.lag_s = bounds.clip(initial_s)
        self._bounds = bounds
        steps = math.ceil((bounds.max_s - bounds.min_s) / GRID_STEP_S)
        # One step beyond each bound lets the parabola find a minimum at the bound.
        self._lags_s = bounds.min_s + GRID_STEP_S * np.arange(-1, steps + 2)
        self._times_s, self._joints = np.zeros(HISTORY), np.zeros((HISTORY, 6))
        self.restart()

    def restart(self) -> None:
        """Discard the recorded motion, for example after a gap. Keep `lag_s` and `estimate`."""
        self._count = 0
        count = len(self._lags_s)
        self._weight = 0.0
        self._means, self._squares = np.zeros((count, 6)), np.zeros(count)
        self._speed_mean, self._speed_square = np.zeros(6), 0.0
        self._position_mean, self._position_square = np.zeros(6), 0.0
        self._bend_square = 0.0
        # Answer delay and command interval, and the weight of these means.
        self._timing_s, self._timing_weight = np.zeros(2), 0.0
        self._last_s: float | None = None

    def on_command(self, at_s: float, joints_rad: Floats) -> None:
        """Record commanded joint angles (6,), rad, that were sent at the time `at_s`."""
        if not (math.isfinite(at_s) and _are_joints(joints_rad)):
            self.restart()
            return
        if self._count and not 0.0 < at_s - self._times_s[self._count - 1] <= MAX_GAP_S:
            self.restart()
        if self._count == HISTORY:
            self._count = HISTORY // 2
            self._times_s[: self._count] = self._times_s[self._count :]
            self._joints[: self._count] = self._joints[self._count :]
        self._times_s[self._count], self._joints[self._count] = at_s, joints_rad
        self._count += 1

    def on_measurement(self, at_s: float, joints_rad: Floats) -> None:
        """Add joint angles (6,), rad, that were measured at the time `at_s`.

        The newest command must be older than the measurement.
        """
        if not (math.isfinite(at_s) and _are_joints(joints_rad)):
            return
        times = self._times_s[: self._count]
        if len(times) < MIN_COMMANDS or not 0.0 <= at_s - times[-1] <= MAX_GAP_S:
            return
        wanted_s = at_s - self._lags_s
        if wanted_s[-1] < times[0]:
            return
        step_s = 0.0 if self._last_s is None else at_s - self._last_s
        if 0.0 < step_s < MIN_STEP_S:
            return
        self._last_s = at_s
        if not 0.0 < step_s <= 2.0 * MAX_GAP_S:
            return
        timing_s = np.array([at_s - times[-1], times[-1] - times[-2]])
        self._add(joints_rad, np.asarray(wanted_s, dtype=np.float64), timing_s, step_s)
        found = self._solve()
        if found is None:
            return
        self.estimate = found
        change_s = found.lag_s - self.lag_s
        limit_s = MAX_SLEW_S_PER_S * step_s
        self.lag_s = self._bounds.clip(self.lag_s + min(max(change_s, -limit_s), limit_s))

    def _add(self, measured: Floats, wanted_s: Floats, timing_s: Floats, step_s: float) -> None:
        """Add one measurement to the weighted means and variances of the error for all lags.

        measured (6,): measured joint angles, rad.
        wanted_s: measurement time minus each lag. The error is the measured angles minus the angles
            that were commanded at these times.
        timing_s (2,): answer delay and command interval, s.
        step_s: time since the last measurement, which is the weight of this measurement.
        """
        times, joints = self._times_s[: self._count], self._joints[: self._count]
        # For times after the newest command, that command is used.
        index = np.clip(np.searchsorted(times, wanted_s) - 1, 0, len(times) - 2)
        spans = np.diff(times)
        share = np.clip((wanted_s - times[index]) / spans[index], 0.0, 1.0)
        commanded = joints[index] + share[:, None] * (joints[index + 1] - joints[index])
        speeds = (joints[index[1] + 1] - joints[index[1]]) / spans[index[1]]
        speeds_before = (joints[index[-1] + 1] - joints[index[-1]]) / spans[index[-1]]
        bend = (speeds - speeds_before) / (wanted_s[1] - wanted_s[-1])
        kept = math.exp(-step_s / MEMORY_S)
        self._weight = kept * self._weight + step_s
        gain = step_s / self._weight
        errors = measured - commanded
        deviation = errors - self._means
        self._means += gain * deviation
        self._squares += gain * ((1.0 - gain) * (deviation * deviation).sum(axis=1) - self._squares)
        self._speed_mean, self._speed_square = _update(
            self._speed_mean, self._speed_square, speeds, gain
        )
        self._position_mean, self._position_square = _update(
            self._position_mean, self._position_square, commanded[1], gain
        )
        self._bend_square += gain * (float(bend @ bend) - self._bend_square)
        weight = step_s * float(speeds @ speeds)
        self._timing_weight = kept * self._timing_weight + weight
        if weight > 0.0:
            self._timing_s += weight / self._timing_weight * (timing_s - self._timing_s)

    def _solve(self) -> LagEstimate | None:
        """Return the lag with the smallest error variance, or None if it is not determined."""
        if self._weight < MIN_OBSERVED_S * (1.0 - math.exp(-1.0)):
            return None
        if not self._speed_square >= MIN_SPEED_RAD_PER_S**2:
            return None
        best = int(np.argmin(self._squares))
        smallest = float(self._squares[best])
        if not smallest <= MAX_MISFIT_RATIO * self._position_square:
            return None
        shift = 0.0
        if 0 < best < len(self._squares) - 1:
            below, above = self._squares[best - 1], self._squares[best + 1]
            curvature = float(below + above - 2.0 * smallest)
            shift = 0.5 * float(below - above) / curvature if curvature > 0.0 else 0.0
        lag_s = self._bounds.clip(
            float(self._lags_s[best]) + GRID_STEP_S * min(max(shift, -0.5), 0.5)
        )
        # The model 1 / (1 + s L / 2)^2 of a servo differs from the delay exp(-s L) by (s L)^2 / 4.
        expected = 0.25 * lag_s**2 * math.sqrt(self._bend_square)
        # A servo's distortion of the motion, which grows with the lag squared, is not noise.
        noise = max(smallest - expected**2, MIN_NOISE_RATIO * smallest)
        samples = max(self._weight / CORRELATION_S, 1.0)
        uncertainty_s = math.sqrt(noise / (samples * self._speed_square))
        if not uncertainty_s <= MAX_UNCERTAINTY_S:
            return None
        return LagEstimate(
            lag_s,
            uncertainty_s,
            math.sqrt(smallest),
            expected,
            answer_delay_s=float(self._timing_s[0]),
            command_interval_s=float(self._timing_s[1]),
        )


def _are_joints(joints_rad: Floats) -> bool:
    return bool((np.abs(joints_rad) <= MAX_JOINT_RAD).all())


def _update(mean: Floats, square: float, value: Floats, gain: float) -> tuple[Floats, float]:
    """Update a running mean (6,) and a variance with a new value (6,), and return both.

    square: sum of the variances of the six components.
    gain: weight of the new value, from 0 to 1.
    """
    deviation = value - mean
    return mean + gain * deviation, square + gain * (
        (1.0 - gain) * float(deviation @ deviation) - square
    )
