"""Estimate the finger's position from measured points, and predict it.

Each method is a filter with four functions on an immutable estimate.  `initialize` makes it from
one measurement, and `update` adds a later one.  `moments` gives position, velocity and their
covariance, and `predict` gives positions at future times.  Points are (3,) in the world frame, m,
with covariances (3, 3) m^2.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

<<<<<<< HEAD
ADAPTATION_THRESHOLD = 6.0
"""Maximum mean square of the normalised innovation in steady motion."""

||||||| 8b924ba
ADAPTATION_THRESHOLD = 6.0
"""Mean square of the normalised innovation up to which a motion counts as steady."""

=======
>>>>>>> trk

@dataclass(frozen=True, slots=True)
class Estimate:
    """State (n,) of a filter at one time, and its error covariance (n, n)."""

    at_ns: int
    state: Floats
    covariance: Floats


class Filter(Protocol):
    """Interface of a tracking method."""

    def initialize(self, at_ns: int, measured: Floats, covariance: Floats) -> Estimate:
        """Return the estimate after one measured point."""
        ...

    def update(
        self, before: Estimate, at_ns: int, measured: Floats, covariance: Floats
    ) -> Estimate:
        """Return the estimate after a later measured point."""
        ...

    def moments(self, estimate: Estimate) -> tuple[Floats, Floats, Floats]:
        """Return position (3,), velocity (3,) and their joint covariance (6, 6)."""
        ...

    def predict(self, estimate: Estimate, horizons_s: Floats) -> Floats:
        """Predict positions (n, 3) at times (n,) s after the estimate."""
        ...


@dataclass(frozen=True, slots=True)
class Unfiltered:
    """Method without a filter: the last measured point, constant in predictions."""

    max_speed_m_per_s: float

    def initialize(self, at_ns: int, measured: Floats, covariance: Floats) -> Estimate:
        return Estimate(at_ns, measured, covariance)

    def update(
        self, before: Estimate, at_ns: int, measured: Floats, covariance: Floats
    ) -> Estimate:
        return Estimate(at_ns, measured, covariance)

    def moments(self, estimate: Estimate) -> tuple[Floats, Floats, Floats]:
        full = _with_unknown_velocity(estimate.covariance, self.max_speed_m_per_s)
        return estimate.state, np.zeros(3), full

    def predict(self, estimate: Estimate, horizons_s: Floats) -> Floats:
        return np.repeat(estimate.state[None], len(horizons_s), axis=0)


@dataclass(frozen=True, slots=True)
class OneEuro:
    """Low-pass filter whose cut-off rises with speed (Casiez, Roussel, Vogel, CHI 2012).

    The state is (smoothed position, smoothed velocity, last measured point).  Predictions assume
    that the smoothed velocity stays constant.
    """

    max_speed_m_per_s: float
    min_cutoff_hz: float = 6.0
    cutoff_per_speed: float = 400.0
    velocity_cutoff_hz: float = 4.0

    def initialize(self, at_ns: int, measured: Floats, covariance: Floats) -> Estimate:
        return Estimate(at_ns, np.concatenate([measured, np.zeros(3), measured]), covariance)

    def update(
        self, before: Estimate, at_ns: int, measured: Floats, covariance: Floats
    ) -> Estimate:
        dt = (at_ns - before.at_ns) * 1e-9
        position, velocity, last = before.state.reshape(3, 3)
        velocity = velocity + _low_pass_weight(self.velocity_cutoff_hz, dt) * (
            (measured - last) / dt - velocity
        )
        speed = float(np.linalg.norm(velocity))
        weight = _low_pass_weight(self.min_cutoff_hz + self.cutoff_per_speed * speed, dt)
        position = position + weight * (measured - position)
        smoothed = (1.0 - weight) ** 2 * before.covariance + weight**2 * covariance
        return Estimate(at_ns, np.concatenate([position, velocity, measured]), smoothed)

    def moments(self, estimate: Estimate) -> tuple[Floats, Floats, Floats]:
        full = _with_unknown_velocity(estimate.covariance, self.max_speed_m_per_s)
        return estimate.state[:3], estimate.state[3:6], full

    def predict(self, estimate: Estimate, horizons_s: Floats) -> Floats:
        return estimate.state[:3] + horizons_s[:, None] * estimate.state[3:6]


def _low_pass_weight(cutoff_hz: float, dt: float) -> float:
    """Return the weight of the newest value in a first-order low-pass stepped by dt."""
    return 1.0 / (1.0 + 1.0 / (2.0 * np.pi * cutoff_hz * dt))


def _with_unknown_velocity(position_covariance: Floats, max_speed: float) -> Floats:
    full = np.zeros((6, 6))
    full[:3, :3] = position_covariance
    full[3:, 3:] = np.eye(3) * (max_speed / 3.0) ** 2
    return full
<<<<<<< HEAD


@dataclass(frozen=True, slots=True)
class Tremor:
    """Model of physiological tremor: band-limited noise of parallel, lightly damped oscillators.

    amplitude_m: standard deviation per axis, sum of all modes.
    band_hz: frequency band that the modes share.
    modes: number of oscillators.
    damping: damping ratio of each oscillator.

    The modes sample the band, as in the multiple Fourier linear combiner (Veluvolu, Ang, Sensors
    11, 2011).
    """

    amplitude_m: float
    band_hz: tuple[float, float] = (8.0, 12.0)
    modes: int = 4
    damping: float = 0.02

    @property
    def size(self) -> int:
        """Return the number of states per axis: position and velocity of each mode in turn."""
        return 2 * self.modes

    @property
    def _natural(self) -> Floats:
        """Return natural frequencies (modes,) rad/s, at the centres of equal parts of the band."""
        low, high = self.band_hz
        fractions = (np.arange(self.modes) + 0.5) / self.modes
        return np.asarray(2.0 * np.pi * (low + fractions * (high - low)))

    @property
    def stationary(self) -> Floats:
        """Return the stationary covariance (size, size) of the state."""
        variance = self.amplitude_m**2 / self.modes
        return np.diag(np.stack([np.ones(self.modes), self._natural**2], axis=1).ravel()) * variance

    def transition(self, dt: float) -> Floats:
        """Return the state transition (size, size) over dt, in closed form."""
        natural = self._natural
        stays, sine, decay = self._oscillator_response(np.array([dt]))
        positions, velocities = np.arange(0, self.size, 2), np.arange(1, self.size, 2)
        result = np.zeros((self.size, self.size))
        result[positions, positions] = stays[0]
        result[positions, velocities] = sine[0]
        result[velocities, positions] = -(natural**2) * sine[0]
        result[velocities, velocities] = stays[0] - 2.0 * decay * sine[0]
        return result

    def displacements(self, horizons_s: Floats) -> Floats:
        """Return the weight (n, size) of each state in the displacement after times (n,) s."""
        stays, sine, _ = self._oscillator_response(horizons_s)
        return np.stack([stays, sine], axis=2).reshape(len(horizons_s), self.size)

    def _oscillator_response(self, times_s: Floats) -> tuple[Floats, Floats, Floats]:
        """Return the response of the modes after times (n,) s.

        The first two arrays (n, modes) are the contributions of initial displacement and velocity.
        The third (modes,) contains the decay rates, 1/s.
        """
        natural = self._natural
        decay, swing = self.damping * natural, natural * np.sqrt(1.0 - self.damping**2)
        angles = times_s[:, None] * swing
        left = np.exp(-times_s[:, None] * decay)
        sine = left * np.sin(angles) / swing
        return left * np.cos(angles) + decay * sine, sine, decay


@dataclass(frozen=True, slots=True)
class Kalman:
    """Kalman filter of a finger's motion: white noise in the `order`-th derivative, plus tremor.

    order: 2 assumes constant velocity, 3 constant acceleration, apart from the noise.
    acceleration_decay_per_s: rate at which an acceleration decays (Singer, IEEE Trans. Aerospace
        and Electronic Systems 6, 1970); 0 for constant acceleration.
    noise: root of the noise's spectral density in steady motion, m/s^order per root hertz.
    max_noise: bound up to which the noise grows with the innovation of a point off the steady
        motion (adaptive process noise: Bar-Shalom, Li, Kirubarajan, Estimation with Applications to
        Tracking and Navigation, section 11.2).
    max_speed_m_per_s, max_acceleration_m_per_s2: limits of a finger, which set the initial
        covariance.
    tremor: model of the tremor in the state; None for no such states.
    unmodelled_tremor_m: standard deviation of a tremor outside the state.  It adds to the
        measurement noise and to the covariance of the finger's position.

    The state contains, each (3,): position, velocity, acceleration if order is 3, then each mode's
    displacement and velocity.
    """

    order: int
    noise: float
    max_noise: float
    max_speed_m_per_s: float
    max_acceleration_m_per_s2: float = 20.0
    acceleration_decay_per_s: float = 0.0
    tremor: Tremor | None = None
    unmodelled_tremor_m: float = 0.0
    _observed: Floats = field(init=False, repr=False)

    def __post_init__(self) -> None:
        row = np.zeros((1, self.order + (self.tremor.size if self.tremor else 0)))
        row[0, 0] = 1.0
        row[0, self.order :: 2] = 1.0
        object.__setattr__(self, "_observed", np.kron(row, np.eye(3)))

    def initialize(self, at_ns: int, measured: Floats, covariance: Floats) -> Estimate:
        size = self._observed.shape[1]
        state, full = np.zeros(size), np.zeros((size, size))
        state[:3] = measured
        full[:3, :3] = covariance
        full[3:6, 3:6] = np.eye(3) * (self.max_speed_m_per_s / 3.0) ** 2
        if self.order == 3:
            full[6:9, 6:9] = np.eye(3) * (self.max_acceleration_m_per_s2 / 3.0) ** 2
        if self.tremor:
            modes = slice(3 * self.order, None)
            full[modes, modes] = np.kron(self.tremor.stationary, np.eye(3))
        return Estimate(at_ns, state, full)

    def update(
        self, before: Estimate, at_ns: int, measured: Floats, covariance: Floats
    ) -> Estimate:
        dt = (at_ns - before.at_ns) * 1e-9
        observed = self._observed
        covariance = covariance + self.unmodelled_tremor_m**2 * np.eye(3)
        state, full = self._propagate(before, dt)
        innovation = measured - observed @ state
        spread = observed @ full @ observed.T + covariance
        if innovation @ np.linalg.solve(spread, innovation) > 3.0 * ADAPTATION_THRESHOLD:
            extra = self._adapted_noise(innovation, dt) ** 2 - self.noise**2
            rows = slice(0, 3 * self.order)
            full[rows, rows] += extra * np.kron(_white_noise(self.order, dt), np.eye(3))
            spread = observed @ full @ observed.T + covariance
        gain = np.linalg.solve(spread, observed @ full).T
        residual_gain = np.eye(len(state)) - gain @ observed
        full = residual_gain @ full @ residual_gain.T + gain @ covariance @ gain.T
        return Estimate(at_ns, state + gain @ innovation, 0.5 * (full + full.T))

    def _propagate(self, before: Estimate, dt: float) -> tuple[Floats, Floats]:
        """Propagate state and covariance by dt, for a steady motion."""
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
        axis[: self.order, : self.order] = _integration(
            self.order, dt, self.acceleration_decay_per_s
        )
        if self.tremor:
            axis[self.order :, self.order :] = self.tremor.transition(dt)
        return axis

    def _adapted_noise(self, innovation: Floats, dt: float) -> float:
        """Return the noise for which the expected |innovation|^2 after dt is the given one."""
        variance = _white_noise(self.order, dt)[0, 0]
        noise = float(np.linalg.norm(innovation)) / np.sqrt(3.0 * variance)
        return float(min(max(noise, self.noise), self.max_noise))

    def moments(self, estimate: Estimate) -> tuple[Floats, Floats, Floats]:
        pick = np.zeros((6, len(estimate.state)))
        pick[:3] = self._observed
        pick[3:, 3:] = self._observed[:, :-3]
        both = pick @ estimate.state
        full = pick @ estimate.covariance @ pick.T
        full[:3, :3] += self.unmodelled_tremor_m**2 * np.eye(3)
        return both[:3], both[3:], full

    def predict(self, estimate: Estimate, horizons_s: Floats) -> Floats:
        axes = estimate.state.reshape(-1, 3)
        transitions = [
            _integration(self.order, float(t), self.acceleration_decay_per_s)[0] for t in horizons_s
        ]
        points = np.stack(transitions) @ axes[: self.order]
        if self.tremor:
            points += self.tremor.displacements(horizons_s) @ axes[self.order :]
        return np.asarray(points)


def _integration(order: int, dt: float, acceleration_decay_per_s: float) -> Floats:
    """Return the transition (order, order) of integrators over dt, with decaying acceleration."""
    if order == 2:
        return np.array([[1.0, dt], [0.0, 1.0]])
    rate = acceleration_decay_per_s
    if rate * dt < 1e-6:
        return np.array([[1.0, dt, 0.5 * dt * dt], [0.0, 1.0, dt], [0.0, 0.0, 1.0]])
    decay, loss = math.exp(-rate * dt), -math.expm1(-rate * dt)
    return np.array(
        [[1.0, dt, (rate * dt - loss) / rate**2], [0.0, 1.0, loss / rate], [0.0, 0.0, decay]]
    )


def _white_noise(order: int, dt: float) -> Floats:
    """Return the covariance (order, order) of a chain of integrators driven by unit white noise.

    Source: Bar-Shalom, Li, Kirubarajan, sections 6.2.2 and 6.2.3.  The decay of the acceleration,
    a relative change of the order of rate times dt, is neglected.
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
||||||| 8b924ba


@dataclass(frozen=True, slots=True)
class Tremor:
    """Model physiological tremor: band-limited noise, as lightly damped oscillators side by side.

    amplitude_m: standard deviation per axis, of all modes together.
    band_hz: frequency band that the modes share.
    modes: number of oscillators.
    damping: damping ratio of each oscillator.

    A few noise-driven modes stand for the band, as the grid of frequencies does in the multiple
    Fourier linear combiner (Veluvolu, Ang, Sensors 11, 2011).  They predict as well.
    """

    amplitude_m: float
    band_hz: tuple[float, float] = (8.0, 12.0)
    modes: int = 4
    damping: float = 0.02

    @property
    def size(self) -> int:
        """Number of states per axis: position and velocity of each mode in turn."""
        return 2 * self.modes

    @property
    def _natural(self) -> Floats:
        """Natural frequencies (modes,) rad/s, at the centres of equal parts of the band."""
        low, high = self.band_hz
        fractions = (np.arange(self.modes) + 0.5) / self.modes
        return np.asarray(2.0 * np.pi * (low + fractions * (high - low)))

    @property
    def stationary(self) -> Floats:
        """Stationary covariance (size, size) of the state."""
        variance = self.amplitude_m**2 / self.modes
        return np.diag(np.stack([np.ones(self.modes), self._natural**2], axis=1).ravel()) * variance

    def transition(self, dt: float) -> Floats:
        """Return the state transition (size, size) over dt, in closed form."""
        natural = self._natural
        stays, sine, decay = self._oscillator_response(np.array([dt]))
        positions, velocities = np.arange(0, self.size, 2), np.arange(1, self.size, 2)
        result = np.zeros((self.size, self.size))
        result[positions, positions] = stays[0]
        result[positions, velocities] = sine[0]
        result[velocities, positions] = -(natural**2) * sine[0]
        result[velocities, velocities] = stays[0] - 2.0 * decay * sine[0]
        return result

    def displacements(self, horizons_s: Floats) -> Floats:
        """Return the contribution (n, size) of each state to the displacement after times (n,)
        s."""
        stays, sine, _ = self._oscillator_response(horizons_s)
        return np.stack([stays, sine], axis=2).reshape(len(horizons_s), self.size)

    def _oscillator_response(self, times_s: Floats) -> tuple[Floats, Floats, Floats]:
        """Return the response of the modes after times (n,) s.

        The first two arrays (n, modes) are the contributions of initial displacement and velocity.
        The third (modes,) holds the decay rates in 1/s.
        """
        natural = self._natural
        decay, swing = self.damping * natural, natural * np.sqrt(1.0 - self.damping**2)
        angles = times_s[:, None] * swing
        left = np.exp(-times_s[:, None] * decay)
        sine = left * np.sin(angles) / swing
        return left * np.cos(angles) + decay * sine, sine, decay


@dataclass(frozen=True, slots=True)
class Kalman:
    """Filter a hand's motion by a Kalman filter: white noise in the `order`-th derivative, plus
    tremor.

    order: 2 assumes constant velocity, 3 constant acceleration, apart from the noise.
    acceleration_decay_per_s: rate at which an acceleration decays (Singer, IEEE Trans. Aerospace
        and Electronic Systems 6, 1970), since no hand keeps one for long.  0 keeps it.
    noise: root of the noise's spectral density in steady motion, m/s^order per root hertz.
    max_noise: bound up to which the noise grows with the innovation of a point off the steady
        motion (adaptive process noise: Bar-Shalom, Li, Kirubarajan, Estimation with Applications to
        Tracking and Navigation, section 11.2).
    max_speed_m_per_s, max_acceleration_m_per_s2: limits of a finger, which set the initial
        covariance.
    tremor: model of the tremor in the state; None leaves it out.
    unmodelled_tremor_m: standard deviation of a tremor outside the state.  It adds to the
        measurement noise and to the covariance of the finger's position.

    The state holds, each (3,): position, velocity, acceleration if order is 3, then each mode's
    displacement and velocity.
    """

    order: int
    noise: float
    max_noise: float
    max_speed_m_per_s: float
    max_acceleration_m_per_s2: float = 20.0
    acceleration_decay_per_s: float = 0.0
    tremor: Tremor | None = None
    unmodelled_tremor_m: float = 0.0
    _observed: Floats = field(init=False, repr=False)

    def __post_init__(self) -> None:
        row = np.zeros((1, self.order + (self.tremor.size if self.tremor else 0)))
        row[0, 0] = 1.0
        row[0, self.order :: 2] = 1.0
        object.__setattr__(self, "_observed", np.kron(row, np.eye(3)))

    def initialize(self, at_ns: int, measured: Floats, covariance: Floats) -> Estimate:
        size = self._observed.shape[1]
        state, full = np.zeros(size), np.zeros((size, size))
        state[:3] = measured
        full[:3, :3] = covariance
        full[3:6, 3:6] = np.eye(3) * (self.max_speed_m_per_s / 3.0) ** 2
        if self.order == 3:
            full[6:9, 6:9] = np.eye(3) * (self.max_acceleration_m_per_s2 / 3.0) ** 2
        if self.tremor:
            modes = slice(3 * self.order, None)
            full[modes, modes] = np.kron(self.tremor.stationary, np.eye(3))
        return Estimate(at_ns, state, full)

    def update(
        self, before: Estimate, at_ns: int, measured: Floats, covariance: Floats
    ) -> Estimate:
        dt = (at_ns - before.at_ns) * 1e-9
        observed = self._observed
        covariance = covariance + self.unmodelled_tremor_m**2 * np.eye(3)
        state, full = self._propagate(before, dt)
        innovation = measured - observed @ state
        spread = observed @ full @ observed.T + covariance
        if innovation @ np.linalg.solve(spread, innovation) > 3.0 * ADAPTATION_THRESHOLD:
            extra = self._adapted_noise(innovation, dt) ** 2 - self.noise**2
            rows = slice(0, 3 * self.order)
            full[rows, rows] += extra * np.kron(_white_noise(self.order, dt), np.eye(3))
            spread = observed @ full @ observed.T + covariance
        gain = np.linalg.solve(spread, observed @ full).T
        keep = np.eye(len(state)) - gain @ observed
        full = keep @ full @ keep.T + gain @ covariance @ gain.T
        return Estimate(at_ns, state + gain @ innovation, 0.5 * (full + full.T))

    def _propagate(self, before: Estimate, dt: float) -> tuple[Floats, Floats]:
        """Return state and covariance dt later, for a steady motion."""
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
        axis[: self.order, : self.order] = _integration(
            self.order, dt, self.acceleration_decay_per_s
        )
        if self.tremor:
            axis[self.order :, self.order :] = self.tremor.transition(dt)
        return axis

    def _adapted_noise(self, innovation: Floats, dt: float) -> float:
        """Return the noise that explains an innovation (3,): |v|^2 is 3 times its variance over
        dt."""
        variance = _white_noise(self.order, dt)[0, 0]
        wanted = float(np.linalg.norm(innovation)) / np.sqrt(3.0 * variance)
        return float(min(max(wanted, self.noise), self.max_noise))

    def moments(self, estimate: Estimate) -> tuple[Floats, Floats, Floats]:
        pick = np.zeros((6, len(estimate.state)))
        pick[:3] = self._observed
        pick[3:, 3:] = self._observed[:, :-3]
        both = pick @ estimate.state
        full = pick @ estimate.covariance @ pick.T
        full[:3, :3] += self.unmodelled_tremor_m**2 * np.eye(3)
        return both[:3], both[3:], full

    def predict(self, estimate: Estimate, horizons_s: Floats) -> Floats:
        axes = estimate.state.reshape(-1, 3)
        carried = [
            _integration(self.order, float(t), self.acceleration_decay_per_s)[0] for t in horizons_s
        ]
        points = np.stack(carried) @ axes[: self.order]
        if self.tremor:
            points += self.tremor.displacements(horizons_s) @ axes[self.order :]
        return np.asarray(points)


def _integration(order: int, dt: float, acceleration_decay_per_s: float) -> Floats:
    """Return the transition (order, order) of integrators over dt, with decaying acceleration."""
    if order == 2:
        return np.array([[1.0, dt], [0.0, 1.0]])
    rate = acceleration_decay_per_s
    if rate * dt < 1e-6:
        return np.array([[1.0, dt, 0.5 * dt * dt], [0.0, 1.0, dt], [0.0, 0.0, 1.0]])
    left, gone = math.exp(-rate * dt), -math.expm1(-rate * dt)
    return np.array(
        [[1.0, dt, (rate * dt - gone) / rate**2], [0.0, 1.0, gone / rate], [0.0, 0.0, left]]
    )


def _white_noise(order: int, dt: float) -> Floats:
    """Return the covariance (order, order) that unit white noise leaves in a chain of integrators.

    Source: Bar-Shalom, Li, Kirubarajan, sections 6.2.2 and 6.2.3.  The decay of the acceleration
        changes it by a fraction of the order of rate times dt, which is neglected.
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
=======
>>>>>>> trk
