"""Detect errors in the scene's description of the hardware from noisy residuals.

A residual is a measured value minus its expected value. The weights of the residuals in their mean
decay exponentially with time. An error is suspected when the mean has exceeded a threshold for some
time without interruption.
"""

from __future__ import annotations

import math

import numpy as np

from flexsheet.nodes.arrays import Floats

MAX_GAP_S = 1.0
"""The maximum weight (s) of a residual in the mean. The weight is the time since the previous
residual."""

CLEAR_RATIO = 0.8
"""The fraction of the threshold below which an error is no longer suspected.

The fraction is below 1 (hysteresis), so that the result does not change repeatedly near the
threshold.
"""


class ResidualMonitor:
    """A monitor that reports an error if the mean of a residual vector stays large.

    mean: weighted mean of the residuals, in their unit; zeros before the first residual.
    suspected: whether the mean has exceeded the threshold for the required time.
    """

    def __init__(
        self, components: int, *, threshold: float, memory_s: float = 1.5, confirm_s: float = 1.5
    ) -> None:
        """Create a monitor that has no residuals yet.

        components: length of the residual vector.
        threshold: maximum magnitude of the mean, in the unit of the residuals.
        memory_s: time constant of the exponential weights of the mean.
        confirm_s: time for which the mean must exceed the threshold before an error is suspected.
        """
        self.mean, self.suspected, self.threshold = np.zeros(components), False, threshold
        self._memory_s, self._confirm_s = memory_s, confirm_s
        self._weight_s, self._above_s = 0.0, 0.0
        self._last_ns: int | None = None

    @property
    def has_data(self) -> bool:
        """Return whether the residuals cover enough time to compare the mean with the threshold."""
        return self._weight_s >= 0.5 * self._memory_s

    @property
    def deviation(self) -> float:
        """Return the magnitude of the mean residual, in the unit of the residuals."""
        return float(np.linalg.norm(self.mean))

    def add(self, residual: Floats, at_ns: int) -> None:
        """Update the mean with a residual measured at `at_ns`. Ignore it if it is not finite."""
        if not np.isfinite(residual).all():
            return
        step_s = 0.0 if self._last_ns is None else (at_ns - self._last_ns) * 1e-9
        self._last_ns = at_ns
        if step_s <= 0.0:
            return
        step_s = min(step_s, MAX_GAP_S)
        self._weight_s = self._weight_s * math.exp(-step_s / self._memory_s) + step_s
        self.mean = self.mean + step_s / self._weight_s * (residual - self.mean)
        if not self.has_data:
            return
        limit = self.threshold * (CLEAR_RATIO if self.suspected else 1.0)
        self._above_s = self._above_s + step_s if self.deviation > limit else 0.0
        self.suspected = self._above_s >= self._confirm_s or (
            self.suspected and self._above_s > 0.0
        )
