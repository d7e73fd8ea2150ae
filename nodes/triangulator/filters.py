"""Methods of tracking: from measured points to where the finger is, and where it will be.

Each is a filter with the same four functions on an immutable estimate: `started` from one
measurement, `updated` by a later one, `moments` (position, velocity, their covariance) and `ahead`
(positions after leads).  Points are (3,) in the world frame, m, with covariances (3, 3) m^2.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

CALM_INNOVATION = 6.0
"""Mean square of the normalised innovation up to which a hand counts as going evenly."""


@dataclass(frozen=True, slots=True)
class Estimate:
    """What a filter knows at one time: its state (n,) and what it thinks its errors are (n, n)."""

    at_ns: int
    state: Floats
    covariance: Floats


class Filter(Protocol):
    """One way to follow a point."""

    def started(self, at_ns: int, measured: Floats, covariance: Floats) -> Estimate:
        """From one measured point."""
        ...

    def updated(
        self, before: Estimate, at_ns: int, measured: Floats, covariance: Floats
    ) -> Estimate:
        """With a later measured point."""
        ...

    def moments(self, estimate: Estimate) -> tuple[Floats, Floats, Floats]:
        """Position (3,), velocity (3,) and their covariance (6, 6), at the estimate's time."""
        ...

    def ahead(self, estimate: Estimate, leads_s: Floats) -> Floats:
        """Positions (n, 3) at times (n,) s after the estimate's."""
        ...


@dataclass(frozen=True, slots=True)
class Unfiltered:
    """No tracking: the finger is where it was measured, and stays there."""

    max_speed_m_per_s: float

    def started(self, at_ns: int, measured: Floats, covariance: Floats) -> Estimate:
        return Estimate(at_ns, measured, covariance)

    def updated(
        self, before: Estimate, at_ns: int, measured: Floats, covariance: Floats
    ) -> Estimate:
        return Estimate(at_ns, measured, covariance)

    def moments(self, estimate: Estimate) -> tuple[Floats, Floats, Floats]:
        full = _with_unknown_velocity(estimate.covariance, self.max_speed_m_per_s)
        return estimate.state, np.zeros(3), full

    def ahead(self, estimate: Estimate, leads_s: Floats) -> Floats:
        return np.repeat(estimate.state[None], len(leads_s), axis=0)


@dataclass(frozen=True, slots=True)
class Exponential:
    """The exponentially weighted mean of what was measured; a finger stays where it is.

    time_constant_s: age at which a measurement's weight has fallen to 1/e.
    """

    max_speed_m_per_s: float
    time_constant_s: float = 0.02

    def started(self, at_ns: int, measured: Floats, covariance: Floats) -> Estimate:
        return Estimate(at_ns, measured, covariance)

    def updated(
        self, before: Estimate, at_ns: int, measured: Floats, covariance: Floats
    ) -> Estimate:
        share = 1.0 - np.exp(-(at_ns - before.at_ns) * 1e-9 / self.time_constant_s)
        state = before.state + share * (measured - before.state)
        # Of the measurements' noise alone: how far a mean trails the finger it cannot know.
        kept = (1.0 - share) ** 2 * before.covariance + share**2 * covariance
        return Estimate(at_ns, state, kept)

    def moments(self, estimate: Estimate) -> tuple[Floats, Floats, Floats]:
        full = _with_unknown_velocity(estimate.covariance, self.max_speed_m_per_s)
        return estimate.state, np.zeros(3), full

    def ahead(self, estimate: Estimate, leads_s: Floats) -> Floats:
        return np.repeat(estimate.state[None], len(leads_s), axis=0)


@dataclass(frozen=True, slots=True)
class OneEuro:
    """Low-pass whose cut-off rises with speed (Casiez, Roussel, Vogel, CHI 2012).

    The state is (smoothed position, smoothed velocity, last measured point); the finger is taken to
    keep the smoothed velocity.
    """

    max_speed_m_per_s: float
    min_cutoff_hz: float = 6.0
    cutoff_per_speed: float = 400.0
    velocity_cutoff_hz: float = 4.0

    def started(self, at_ns: int, measured: Floats, covariance: Floats) -> Estimate:
        return Estimate(at_ns, np.concatenate([measured, np.zeros(3), measured]), covariance)

    def updated(
        self, before: Estimate, at_ns: int, measured: Floats, covariance: Floats
    ) -> Estimate:
        dt = (at_ns - before.at_ns) * 1e-9
        position, velocity, last = before.state.reshape(3, 3)
        velocity = velocity + _low_pass_share(self.velocity_cutoff_hz, dt) * (
            (measured - last) / dt - velocity
        )
        speed = float(np.linalg.norm(velocity))
        share = _low_pass_share(self.min_cutoff_hz + self.cutoff_per_speed * speed, dt)
        position = position + share * (measured - position)
        kept = (1.0 - share) ** 2 * before.covariance + share**2 * covariance
        return Estimate(at_ns, np.concatenate([position, velocity, measured]), kept)

    def moments(self, estimate: Estimate) -> tuple[Floats, Floats, Floats]:
        full = _with_unknown_velocity(estimate.covariance, self.max_speed_m_per_s)
        return estimate.state[:3], estimate.state[3:6], full

    def ahead(self, estimate: Estimate, leads_s: Floats) -> Floats:
        return estimate.state[:3] + leads_s[:, None] * estimate.state[3:6]


def _low_pass_share(cutoff_hz: float, dt: float) -> float:
    """Share of the newest value in a first-order low-pass stepped by dt."""
    return 1.0 / (1.0 + 1.0 / (2.0 * np.pi * cutoff_hz * dt))


def _with_unknown_velocity(position_covariance: Floats, max_speed: float) -> Floats:
    full = np.zeros((6, 6))
    full[:3, :3] = position_covariance
    full[3:, 3:] = np.eye(3) * (max_speed / 3.0) ** 2
    return full


@dataclass(frozen=True, slots=True)
class Tremor:
    """Physiological tremor: noise in a band, as slightly damped swings side by side in it.

    amplitude_m: standard deviation per axis, of all swings together.  A few swings that noise keeps
    up stand for the band as the grid of frequencies does in the multiple Fourier linear combiner
    (Veluvolu, Ang, Sensors 11, 2011), and are as good to predict.
    """

    amplitude_m: float
    band_hz: tuple[float, float] = (8.0, 12.0)
    swings: int = 4
    damping: float = 0.02

    @property
    def size(self) -> int:
        """Of its state per axis: position and velocity of each swing in turn."""
        return 2 * self.swings

    @property
    def _natural(self) -> Floats:
        """Natural frequencies (swings,) rad/s, in the middle of equal parts of the band."""
        low, high = self.band_hz
        shares = (np.arange(self.swings) + 0.5) / self.swings
        return np.asarray(2.0 * np.pi * (low + shares * (high - low)))

    @property
    def stationary(self) -> Floats:
        """Covariance (size, size) of its state when nothing is known of it."""
        variance = self.amplitude_m**2 / self.swings
        return (
            np.diag(np.stack([np.ones(self.swings), self._natural**2], axis=1).ravel()) * variance
        )

    def transition(self, dt: float) -> Floats:
        """From its state to that after dt, in closed form (size, size)."""
        natural = self._natural
        stays, sine, decay = self._swung(np.array([dt]))
        positions, velocities = np.arange(0, self.size, 2), np.arange(1, self.size, 2)
        result = np.zeros((self.size, self.size))
        result[positions, positions] = stays[0]
        result[positions, velocities] = sine[0]
        result[velocities, positions] = -(natural**2) * sine[0]
        result[velocities, velocities] = stays[0] - 2.0 * decay * sine[0]
        return result

    def displacements(self, leads_s: Floats) -> Floats:
        """What each part of the state adds to the displacement after leads (n,): (n, size)."""
        stays, sine, _ = self._swung(leads_s)
        return np.stack([stays, sine], axis=2).reshape(len(leads_s), self.size)

    def _swung(self, times_s: Floats) -> tuple[Floats, Floats, Floats]:
        """After times (n,): shares of displacement and velocity that are left (n, swings), and the
        rates (swings,) at which swings die out."""
        natural = self._natural
        decay, swing = self.damping * natural, natural * np.sqrt(1.0 - self.damping**2)
        angles = times_s[:, None] * swing
        left = np.exp(-times_s[:, None] * decay)
        sine = left * np.sin(angles) / swing
        return left * np.cos(angles) + decay * sine, sine, decay


@dataclass(frozen=True, slots=True)
class Kalman:
    """Kalman filter of a hand: white noise in the `order`-th derivative, and tremor on top.

    order: 2 moves at constant velocity, 3 at constant acceleration, but for the noise.
    forgetting_per_s: rate at which an acceleration dies out (Singer, IEEE Trans. Aerospace and
        Electronic Systems 6, 1970): no hand keeps one for long.  0 keeps it.
    noise: root of the spectral density of that noise for a hand that goes evenly, m/s^order per
        root hertz.  Where a measured point lies off an even motion the noise grows with its
        innovation up to `largest_noise` (adaptive process noise: Bar-Shalom, Li, Kirubarajan,
        Estimation with Applications to Tracking and Navigation, section 11.2).
    max_speed_m_per_s, max_acceleration_m_per_s2: of a finger; what a new track knows of it.
    tremor: followed as a part of the motion; None follows none.
    unfollowed_m: standard deviation of a tremor that is not followed; it counts as noise of what is
        measured, and as part of how far the finger may be from the estimate.

    The state is derivative by derivative, each (3,): position, velocity, (acceleration,) then each
    swing's displacement and velocity.
    """

    order: int
    noise: float
    largest_noise: float
    max_speed_m_per_s: float
    max_acceleration_m_per_s2: float = 20.0
    forgetting_per_s: float = 0.0
    tremor: Tremor | None = None
    unfollowed_m: float = 0.0
    _observed: Floats = field(init=False, repr=False)

    def __post_init__(self) -> None:
        row = np.zeros((1, self.order + (self.tremor.size if self.tremor else 0)))
        row[0, 0] = 1.0
        row[0, self.order :: 2] = 1.0
        object.__setattr__(self, "_observed", np.kron(row, np.eye(3)))

    def started(self, at_ns: int, measured: Floats, covariance: Floats) -> Estimate:
        size = self._observed.shape[1]
        state, full = np.zeros(size), np.zeros((size, size))
        state[:3] = measured
        full[:3, :3] = covariance
        full[3:6, 3:6] = np.eye(3) * (self.max_speed_m_per_s / 3.0) ** 2
        if self.order == 3:
            full[6:9, 6:9] = np.eye(3) * (self.max_acceleration_m_per_s2 / 3.0) ** 2
        if self.tremor:
            swings = slice(3 * self.order, None)
            full[swings, swings] = np.kron(self.tremor.stationary, np.eye(3))
        return Estimate(at_ns, state, full)

    def updated(
        self, before: Estimate, at_ns: int, measured: Floats, covariance: Floats
    ) -> Estimate:
        dt = (at_ns - before.at_ns) * 1e-9
        observed = self._observed
        covariance = covariance + self.unfollowed_m**2 * np.eye(3)
        state, full = self._carried(before, dt)
        innovation = measured - observed @ state
        spread = observed @ full @ observed.T + covariance
        if innovation @ np.linalg.solve(spread, innovation) > 3.0 * CALM_INNOVATION:
            extra = self._agility(innovation, dt) ** 2 - self.noise**2
            rows = slice(0, 3 * self.order)
            full[rows, rows] += extra * np.kron(_white_noise(self.order, dt), np.eye(3))
            spread = observed @ full @ observed.T + covariance
        gain = np.linalg.solve(spread, observed @ full).T
        keep = np.eye(len(state)) - gain @ observed
        full = keep @ full @ keep.T + gain @ covariance @ gain.T
        return Estimate(at_ns, state + gain @ innovation, 0.5 * (full + full.T))

    def _carried(self, before: Estimate, dt: float) -> tuple[Floats, Floats]:
        """State and covariance dt later, of a hand that goes evenly."""
        axis = self._transition(dt)
        step = np.kron(axis, np.eye(3))
        noise = np.zeros_like(axis)
        noise[: self.order, : self.order] = self.noise**2 * _white_noise(self.order, dt)
        if self.tremor:
            rows = slice(self.order, None)
            swing, rest = axis[rows, rows], self.tremor.stationary
            noise[rows, rows] = rest - swing @ rest @ swing.T
        full = step @ before.covariance @ step.T + np.kron(noise, np.eye(3))
        return step @ before.state, full

    def _transition(self, dt: float) -> Floats:
        size = self._observed.shape[1] // 3
        axis = np.zeros((size, size))
        axis[: self.order, : self.order] = _integration(self.order, dt, self.forgetting_per_s)
        if self.tremor:
            axis[self.order :, self.order :] = self.tremor.transition(dt)
        return axis

    def _agility(self, innovation: Floats, dt: float) -> float:
        """The noise that an innovation (3,) speaks for: |v|^2 is 3 times its variance over dt."""
        variance = _white_noise(self.order, dt)[0, 0]
        wanted = float(np.linalg.norm(innovation)) / np.sqrt(3.0 * variance)
        return float(min(max(wanted, self.noise), self.largest_noise))

    def moments(self, estimate: Estimate) -> tuple[Floats, Floats, Floats]:
        pick = np.zeros((6, len(estimate.state)))
        pick[:3] = self._observed
        pick[3:, 3:] = self._observed[:, :-3]
        both = pick @ estimate.state
        full = pick @ estimate.covariance @ pick.T
        full[:3, :3] += self.unfollowed_m**2 * np.eye(3)
        return both[:3], both[3:], full

    def ahead(self, estimate: Estimate, leads_s: Floats) -> Floats:
        axes = estimate.state.reshape(-1, 3)
        carried = [_integration(self.order, float(t), self.forgetting_per_s)[0] for t in leads_s]
        points = np.stack(carried) @ axes[: self.order]
        if self.tremor:
            points += self.tremor.displacements(leads_s) @ axes[self.order :]
        return np.asarray(points)


def _integration(order: int, dt: float, forgetting_per_s: float) -> Floats:
    """Transition (order, order) of a chain of integrators over dt, its acceleration dying out."""
    if order == 2:
        return np.array([[1.0, dt], [0.0, 1.0]])
    rate = forgetting_per_s
    if rate * dt < 1e-6:
        return np.array([[1.0, dt, 0.5 * dt * dt], [0.0, 1.0, dt], [0.0, 0.0, 1.0]])
    left, gone = math.exp(-rate * dt), -math.expm1(-rate * dt)
    return np.array(
        [[1.0, dt, (rate * dt - gone) / rate**2], [0.0, 1.0, gone / rate], [0.0, 0.0, left]]
    )


def _white_noise(order: int, dt: float) -> Floats:
    """Covariance (order, order) that white noise of density one leaves in a chain of integrators.

    Bar-Shalom, Li, Kirubarajan, sections 6.2.2 and 6.2.3; that an acceleration dies out changes
    it by a share of the order of the rate times dt, which is left out.
    """
    if order == 2:
        return np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    return np.array(
        [
            [dt**5 / 20, dt**4 / 8, dt**3 / 6],
            [dt**4 / 8, dt**3 / 3, dt**2 / 2],
            [dt**3 / 6, dt**2 / 2, dt],
        ]
    )


HAND_TREMOR_M = 3.5e-5
"""Standard deviation per axis of the tremor of a finger that is held out or moves slowly."""

TRACKING_METHODS: dict[str, Callable[[float], Filter]] = {
    "none": Unfiltered,
    "exponential": Exponential,
    "one_euro": OneEuro,
    "constant_velocity": lambda max_speed: Kalman(
        2, 0.005, 3.0, max_speed, unfollowed_m=2.0 * HAND_TREMOR_M
    ),
    "constant_acceleration": lambda max_speed: Kalman(
        3, 0.1, 10.0, max_speed, forgetting_per_s=10.0, unfollowed_m=2.0 * HAND_TREMOR_M
    ),
    "hand": lambda max_speed: Kalman(
        3, 0.08, 10.0, max_speed, forgetting_per_s=10.0, tremor=Tremor(HAND_TREMOR_M)
    ),
}
"""Filters by name, for a finger's greatest speed (m/s).  Their noises are those that predict a
wandering, trembling hand best over 20-50 ms without falling behind in reaches and taps
(`flexsheet chart tracking`)."""
