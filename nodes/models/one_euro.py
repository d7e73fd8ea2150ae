"""Implement the 1 euro filter (Casiez, Roussel and Vogel, "1 € Filter", CHI 2012)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from flexsheet.nodes.arrays import Floats


@dataclass(frozen=True, slots=True)
class OneEuro:
    """A low-pass filter of a vector (n,) whose cut-off frequency increases with the speed.

    min_cutoff_hz: cut-off frequency at rest.
    cutoff_per_speed: increase of the cut-off frequency (Hz) per unit of speed.
    speed_cutoff_hz: cut-off frequency of the low-pass filter of the velocity.
    """

    min_cutoff_hz: float
    cutoff_per_speed: float
    speed_cutoff_hz: float

    def step(
        self,
        filtered: Floats,
        velocity: Floats,
        *,
        value: Floats,
        measured_velocity: Floats,
        step_s: float,
    ) -> tuple[Floats, Floats, float]:
        """Return the filtered value (n,), the filtered velocity (n,) and the weight of `value`.

        filtered, velocity: results (n,) of the previous step.
        value, measured_velocity: new value (n,) and its unfiltered rate of change (n,).
        step_s: time since the previous step, more than 0.
        """
        weight = _low_pass_weight(self.speed_cutoff_hz, step_s)
        velocity = velocity + weight * (measured_velocity - velocity)
        speed = float(np.linalg.norm(velocity))
        weight = _low_pass_weight(self.min_cutoff_hz + self.cutoff_per_speed * speed, step_s)
        return filtered + weight * (value - filtered), velocity, weight


def _low_pass_weight(cutoff_hz: float, step_s: float) -> float:
    """Return the weight (0 to 1) of a new value in a first-order low-pass filter."""
    ratio = 2.0 * math.pi * cutoff_hz * step_s
    return ratio / (1.0 + ratio)
