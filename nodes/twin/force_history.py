"""Apply the hysteresis and creep of rubber to the force of the simulated elastic sheet.

Creep follows quasi-linear viscoelasticity (Fung, Biomechanics, 1981). The force is the sum of all
past changes of the elastic force. Each change is multiplied by a relaxation function of its age.
The function is a sum of exponentials with one time constant per decade of time. Therefore the force
decreases by a constant fraction per decade. The function is one at the age `REFERENCE_S`, at which
the modulus is measured.

Hysteresis does not depend on the rate of change. It multiplies the force by 1 + h while the elastic
force increases, and by 1 - h while it decreases. After a reversal, the factor changes gradually,
while the force changes by the fraction `REVERSAL_RATIO`.
"""

from __future__ import annotations

import math
from typing import Self

import numpy as np

from flexsheet.messages.apparatus import Apparatus
from flexsheet.nodes.arrays import Floats

REFERENCE_S = 1.0
"""The age (s) of a change of the force at which the relaxation function is one."""

TIME_CONSTANTS_S = 10.0 ** np.arange(-1.0, 4.0)
"""The time constants (s) of the relaxation function. They cover ages from about 50 ms to some
hours."""

REVERSAL_RATIO = 0.1
"""The relative change of the elastic force, after a reversal, in which the deviation of the
hysteresis factor from its new value decreases to 1/e."""

MIN_FORCE_N = 1e-3
"""The elastic force (N) below which changes of the force do not affect the hysteresis."""

CREEP_LOSS_RATIO = math.pi**2 / (4.0 * math.log(10.0))
"""The fraction of the energy that a load cycle loses by creep, divided by the relative creep per
decade."""

MOVING_IN_S, TURNING_RATIO = 1.0, 1.25
"""The time (s) in which the elastic force of a push rises to the force at which the hysteresis is
evaluated. The second value is the ratio of the maximum force, at which the finger reverses, to this
force."""


class ForceHistory:
    """The state of hysteresis and creep for one force that the sheet exerts.

    hysteresis_ratio: fraction of the loading energy that is lost in a cycle from zero force. It
        includes the loss by creep.
    creep_ratio_per_decade: relative decrease of the force per decade of time.
    """

    def __init__(self, hysteresis_ratio: float, creep_ratio_per_decade: float) -> None:
        lost = max(hysteresis_ratio - CREEP_LOSS_RATIO * creep_ratio_per_decade, 0.0)
        lost *= 1.0 + 2.0 * REVERSAL_RATIO
        self._amplitude = lost / (2.0 - lost)
        self._creep = creep_ratio_per_decade
        self._relaxing = np.zeros(len(TIME_CONSTANTS_S))
        self._elastic_n: float | None = None
        self._direction, self._time_s = 0.0, 0.0

    @classmethod
    def of(cls, apparatus: Apparatus | None) -> Self | None:
        """Make the force history from the true sheet parameters.

        apparatus: true parameters of the simulated hardware.

        Returns None if the sheet has neither hysteresis nor creep.
        """
        if apparatus is None:
            return None
        sheet = apparatus.sheet
        if not sheet.hysteresis_ratio and not sheet.creep_ratio_per_decade:
            return None
        return cls(sheet.hysteresis_ratio, sheet.creep_ratio_per_decade)

    def update(self, time_s: float, elastic_n: float) -> float:
        """Add the elastic force at `time_s`, and return the force (N) with hysteresis and creep.

        The elastic force is assumed to change linearly between calls. The first force is assumed to
        have acted for `REFERENCE_S`. Raises ValueError if the time decreases.
        """
        if self._elastic_n is None:
            self._relaxing = elastic_n * np.exp(-REFERENCE_S / TIME_CONSTANTS_S)
        else:
            elapsed_s = time_s - self._time_s
            if elapsed_s < 0.0:
                raise ValueError(
                    f"force history: time {time_s} s is before {self._time_s} s, the time of the "
                    "previous call; give times in ascending order"
                )
            change_n = elastic_n - self._elastic_n
            ratios = elapsed_s / TIME_CONSTANTS_S
            # Mean of the exponential over the interval, since the force changes linearly in it.
            kept = -np.expm1(-ratios) / ratios if elapsed_s else np.ones(len(ratios))
            self._relaxing = self._relaxing * np.exp(-ratios) + change_n * kept
            self._turn(self._elastic_n, elastic_n)
        self._time_s, self._elastic_n = time_s, elastic_n
        final = 1.0 - self._creep * float(np.exp(-REFERENCE_S / TIME_CONSTANTS_S).sum())
        relaxed_n = final * elastic_n + self._creep * float(self._relaxing.sum())
        return relaxed_n * (1.0 + self._amplitude * self._direction)

    def _turn(self, before_n: float, now_n: float) -> None:
        sizes = max(abs(before_n), MIN_FORCE_N), max(abs(now_n), MIN_FORCE_N)
        travel = math.log(sizes[1] / sizes[0])
        wanted = math.copysign(1.0, travel)
        self._direction = wanted + (self._direction - wanted) * math.exp(
            -abs(travel) / REVERSAL_RATIO
        )


def apply_history(history: ForceHistory, times_s: Floats, elastic_n: Floats) -> Floats:
    """Return the forces (n,), N, of rubber with hysteresis and creep.

    times_s, elastic_n: times (n,) and elastic forces (n,) at these times.
    """
    return np.array(
        [history.update(float(t), float(f)) for t, f in zip(times_s, elastic_n, strict=True)]
    )


def compute_history_ratios(apparatus: Apparatus) -> Floats:
    """Return the ratios (2,) of the sheet's force to its elastic force, in loading and unloading.

    The ratios differ from 1 because of hysteresis and creep. They are evaluated at one elastic
    force. For loading, the elastic force increases linearly up to this force and on to
    `TURNING_RATIO` times this force. For unloading, it then decreases again.
    """
    history = ForceHistory.of(apparatus)
    if history is None:
        return np.ones(2)
    elastic = np.concatenate([np.linspace(0.0, TURNING_RATIO, 51), np.linspace(1.0, 0.0, 41)])
    times_s = MOVING_IN_S * np.concatenate([elastic[:51], 2.0 * TURNING_RATIO - elastic[51:]])
    forces = apply_history(history, times_s, elastic)
    return np.array([np.interp(1.0, elastic[:51], forces[:51]), forces[51]])
