"""Define filters that estimate and predict the finger's position from measured points.

Points are arrays (3,) in the world frame, in m. Their covariances are matrices (3, 3), in m^2.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.models.one_euro import OneEuro


@dataclass(frozen=True, slots=True)
class Estimate:
    """The state of a filter at the time `at_ns`, and the covariance that belongs to it.

    Each tracking method defines the shapes of `state` and `covariance`.
    """

    at_ns: int
    state: Floats
    covariance: Floats


class Filter(Protocol):
    """The interface that every tracking method implements. Estimates are immutable."""

    def initialize(self, at_ns: int, measured: Floats, covariance: Floats) -> Estimate:
        """Make the first estimate from a measured point (3,), m, with a covariance (3, 3), m^2."""
        ...

    def update(
        self, before: Estimate, at_ns: int, measured: Floats, covariance: Floats
    ) -> Estimate:
        """Return a new estimate from the estimate `before` and a later measured point (3,), m.

        covariance: noise covariance (3, 3), m^2, of the measured point.
        """
        ...

    def moments(self, estimate: Estimate) -> tuple[Floats, Floats, Floats]:
        """Return an estimate's position (3,) m, velocity (3,) m/s, and joint covariance (6, 6)."""
        ...

    def predict(self, estimate: Estimate, horizons_s: Floats) -> Floats:
        """Predict the positions (n, 3), m, at times (n,), s, after the estimate."""
        ...


@dataclass(frozen=True, slots=True)
class Unfiltered:
    """A tracking method that always predicts the last measured point."""

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


LOW_PASS = OneEuro(min_cutoff_hz=6.0, cutoff_per_speed=400.0, speed_cutoff_hz=4.0)


@dataclass(frozen=True, slots=True)
class OneEuroTracking:
    """A tracking method that uses the 1 euro filter and predicts motion at constant velocity.

    The state (9,) contains the filtered position, the filtered velocity and the last measured
    point.
    """

    max_speed_m_per_s: float

    def initialize(self, at_ns: int, measured: Floats, covariance: Floats) -> Estimate:
        return Estimate(at_ns, np.concatenate([measured, np.zeros(3), measured]), covariance)

    def update(
        self, before: Estimate, at_ns: int, measured: Floats, covariance: Floats
    ) -> Estimate:
        dt = (at_ns - before.at_ns) * 1e-9
        position, velocity, last = before.state.reshape(3, 3)
        position, velocity, weight = LOW_PASS.step(
            position,
            velocity,
            value=measured,
            measured_velocity=(measured - last) / dt,
            step_s=dt,
        )
        smoothed = (1.0 - weight) ** 2 * before.covariance + weight**2 * covariance
        return Estimate(at_ns, np.concatenate([position, velocity, measured]), smoothed)

    def moments(self, estimate: Estimate) -> tuple[Floats, Floats, Floats]:
        full = _with_unknown_velocity(estimate.covariance, self.max_speed_m_per_s)
        return estimate.state[:3], estimate.state[3:6], full

    def predict(self, estimate: Estimate, horizons_s: Floats) -> Floats:
        return estimate.state[:3] + horizons_s[:, None] * estimate.state[3:6]


def _with_unknown_velocity(position_covariance: Floats, max_speed: float) -> Floats:
    full = np.zeros((6, 6))
    full[:3, :3] = position_covariance
    full[3:, 3:] = np.eye(3) * (max_speed / 3.0) ** 2
    return full
