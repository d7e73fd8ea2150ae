"""Follows the fingertip from picture to picture: a Kalman filter of constant velocity, with a gate.

Its process noise is small while the hand goes evenly and grows when it starts, stops or turns.

A state is (position, velocity), 6 numbers in the world frame, m and m/s, with a 6x6 covariance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

POSITION, VELOCITY = np.arange(3), np.arange(3, 6)

EVEN_MOTION = 12.0
"""Mean square of the normalised innovation up to which a hand counts as going evenly."""

GATE_SIGMAS = 5.0
"""Measurement noise that the gate forgives on top of a finger's fastest motion."""


@dataclass(frozen=True, slots=True)
class Track:
    """The estimate at one time: state (6,), covariance (6, 6)."""

    at_ns: int
    state: Floats
    covariance: Floats

    @property
    def position(self) -> Floats:
        return self.state[:3]

    @property
    def velocity(self) -> Floats:
        return self.state[3:]


@dataclass(frozen=True, slots=True)
class TrackingSettings:
    """How a finger moves.

    acceleration_noise: root of the spectral density of a white acceleration, m/s^2 per root hertz,
        of a hand that goes evenly.  Tremor is not to be followed: an arm cannot, and a velocity
        that holds it predicts it the wrong way.
    largest_acceleration_noise: the same of a hand that starts, stops or turns; see `agility`.
    max_speed_m_per_s: faster is no finger.
    forget_after_s: without a measurement for so long the next one starts a new track.
    confirm_frames: measurements in a row that must agree with one another, but not with the track,
        before they replace it.
    """

    acceleration_noise: float
    largest_acceleration_noise: float
    max_speed_m_per_s: float
    forget_after_s: float
    confirm_frames: int


def started(at_ns: int, measured: Floats, covariance: Floats, max_speed: float) -> Track:
    """A track from one measurement (3,): at rest, but its velocity as uncertain as a finger's."""
    full = np.zeros((6, 6))
    full[:3, :3] = covariance
    full[3:, 3:] = np.eye(3) * (max_speed / 3.0) ** 2
    return Track(at_ns, np.concatenate([measured, np.zeros(3)]), full)


def predicted(track: Track, at_ns: int, acceleration_noise: float) -> Track:
    """The track carried on at constant velocity to a later (or equal) time.

    Process noise of a white acceleration, exact over the step (Bar-Shalom, Li, Kirubarajan,
    Estimation with Applications to Tracking and Navigation, section 6.2.2).
    """
    dt = (at_ns - track.at_ns) * 1e-9
    step = np.eye(6)
    step[:3, 3:] = np.eye(3) * dt
    density = acceleration_noise**2
    full = step @ track.covariance @ step.T
    full[POSITION, POSITION] += density * dt**3 / 3
    full[POSITION, VELOCITY] += density * dt**2 / 2
    full[VELOCITY, POSITION] += density * dt**2 / 2
    full[VELOCITY, VELOCITY] += density * dt
    return Track(at_ns, step @ track.state, full)


def corrected(track: Track, measured: Floats, covariance: Floats) -> Track:
    """The track after a measured position (3,) with covariance (3, 3) (Joseph's form)."""
    gain = np.linalg.solve(track.covariance[:3, :3] + covariance, track.covariance[:3, :]).T
    state = track.state + gain @ (measured - track.state[:3])
    keep = np.eye(6)
    keep[:, :3] -= gain
    full = keep @ track.covariance @ keep.T + gain @ covariance @ gain.T
    return Track(track.at_ns, state, 0.5 * (full + full.T))


def agility(
    track: Track, at_ns: int, measured: Floats, covariance: Floats, settings: TrackingSettings
) -> float:
    """The acceleration noise with which to carry a track on to a measured point (3,).

    The settings' own while the point lies where an even motion leads, by the mean square of the
    normalised innovation; else as much as its innovation speaks for, |v|^2 = 3 q^2 dt^3, up to the
    largest (adaptive process noise: Bar-Shalom, Li, Kirubarajan, section 11.2).
    """
    calm = settings.acceleration_noise
    ahead = predicted(track, at_ns, calm)
    innovation = measured - ahead.position
    spread = ahead.covariance[:3, :3] + covariance
    if innovation @ np.linalg.solve(spread, innovation) <= 3.0 * EVEN_MOTION:
        return calm
    dt = (at_ns - track.at_ns) * 1e-9
    wanted = float(np.linalg.norm(innovation)) / (np.sqrt(3.0) * dt**1.5)
    return float(min(max(wanted, calm), settings.largest_acceleration_noise))


def with_tremor(track: Track, tremor_m: float) -> Floats:
    """Covariance (6, 6) of the finger itself about a track that leaves its tremor out."""
    covariance = track.covariance.copy()
    covariance[POSITION, POSITION] += tremor_m**2
    return covariance


def reachable(way: Floats, duration_ns: int, covariance: Floats, max_speed: float) -> bool:
    """Whether a finger can go the way (3,) to a measured point in a time, but for its noise."""
    slack_m = GATE_SIGMAS * float(np.sqrt(np.trace(covariance)))
    return float(np.linalg.norm(way)) <= max_speed * duration_ns * 1e-9 + slack_m


class Tracker:
    """A track, and the rule by which measurements enter it."""

    def __init__(self, settings: TrackingSettings) -> None:
        self.settings = settings
        self.track: Track | None = None
        self._refused: tuple[int, Floats] | None = None
        self._agreeing = 0

    def expected(self, at_ns: int) -> Track | None:
        """Where the finger should be at a time; None without a track that is fresh enough."""
        if self.track is None or self._forgotten(at_ns):
            return None
        return predicted(self.track, at_ns, self.settings.acceleration_noise)

    def _forgotten(self, at_ns: int) -> bool:
        assert self.track is not None
        return (at_ns - self.track.at_ns) * 1e-9 > self.settings.forget_after_s

    def take(self, at_ns: int, measured: Floats, covariance: Floats) -> bool:
        """Let a measurement (3,) with its covariance (3, 3) in; False if no finger moves so fast.

        Times must increase.  A refused jump is not forgotten: when the following measurements
        agree with it, the finger was there, and the track starts anew.
        """
        settings, speed = self.settings, self.settings.max_speed_m_per_s
        if self.track is None or self._forgotten(at_ns):
            self._start(at_ns, measured, covariance)
            return True
        since_ns = at_ns - self.track.at_ns
        if reachable(measured - self.track.position, since_ns, covariance, speed):
            noise = agility(self.track, at_ns, measured, covariance, settings)
            ahead = predicted(self.track, at_ns, noise)
            self.track = corrected(ahead, measured, covariance)
            self._refused, self._agreeing = None, 0
            return True
        agrees = self._refused is not None and reachable(
            measured - self._refused[1], at_ns - self._refused[0], covariance, speed
        )
        self._agreeing = self._agreeing + 1 if agrees else 1
        self._refused = (at_ns, measured)
        if self._agreeing < settings.confirm_frames:
            return False
        self._start(at_ns, measured, covariance)
        return True

    def _start(self, at_ns: int, measured: Floats, covariance: Floats) -> None:
        self.track = started(at_ns, measured, covariance, self.settings.max_speed_m_per_s)
        self._refused, self._agreeing = None, 0
