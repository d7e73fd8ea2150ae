"""List the tracking methods by name."""

from __future__ import annotations

from collections.abc import Callable

from flexsheet.nodes.triangulator.adaptive import AdaptiveBank
from flexsheet.nodes.triangulator.filters import Filter, Kalman, OneEuro, Tremor, Unfiltered

TREMOR_SIGMA_M = 3.5e-5
"""Standard deviation per axis of the tremor of a finger that is held out or moves slowly."""

TRACKING_METHODS: dict[str, Callable[[float], Filter]] = {
    "none": Unfiltered,
    "one_euro": OneEuro,
    "constant_velocity": lambda max_speed: Kalman(
        2, 0.005, 3.0, max_speed, unmodelled_tremor_m=2.0 * TREMOR_SIGMA_M
    ),
    "constant_acceleration": lambda max_speed: Kalman(
        3,
        0.1,
        10.0,
        max_speed,
        acceleration_decay_per_s=10.0,
        unmodelled_tremor_m=2.0 * TREMOR_SIGMA_M,
    ),
    "singer_tremor": lambda max_speed: Kalman(
        3, 0.08, 10.0, max_speed, acceleration_decay_per_s=10.0, tremor=Tremor(TREMOR_SIGMA_M)
    ),
    "adaptive": AdaptiveBank,
}
"""Filters by name, made for a finger's maximum speed (m/s)."""
