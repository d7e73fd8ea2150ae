"""Estimate the finger's position from measured points, and predict it.

Each method is a filter with four functions that make or use an immutable estimate.  `initialize`
makes the estimate from one measurement, and `update` adds a later one.  `moments` returns position,
velocity and their covariance, and `predict` returns positions at future times.  Points are (3,) in
the world frame, m, with covariances (3, 3) m^2.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from flexsheet.nodes.arrays import Floats


@dataclass(frozen=True, slots=True)
class Estimate:
    """State of a filter at one time, and a covariance, whose shapes depend on the method."""

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
        """Return position (3,) m, velocity (3,) m/s and their joint covariance (6, 6)."""
        ...

    def predict(self, estimate: Estimate, horizons_s: Floats) -> Floats:
        """Predict positions (n, 3) at times (n,) s after the estimate."""
        ...


@dataclass(frozen=True, slots=True)
class Unfiltered:
    """Tracking method without a filter: every prediction is the last measured point."""

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
    """Return the weight of the newest value in a first-order low-pass filter with step dt, s."""
    return 1.0 / (1.0 + 1.0 / (2.0 * np.pi * cutoff_hz * dt))


def _with_unknown_velocity(position_covariance: Floats, max_speed: float) -> Floats:
    full = np.zeros((6, 6))
    full[:3, :3] = position_covariance
    full[3:, 3:] = np.eye(3) * (max_speed / 3.0) ** 2
    return full
