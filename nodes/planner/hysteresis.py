"""Model the hysteresis of the sheet's rubber.

While the finger moves inwards (loading), the force is 1 + h times the elastic force. While the
finger moves outwards, the force is 1 - h times the elastic force. Here h = r / (2 - r), and r is
the fraction of the loading energy that the rubber loses. After the finger reverses its direction,
the factor changes linearly with the finger's travel.
"""

from __future__ import annotations

REVERSAL_RATIO = 0.2
"""The travel of the finger after which the hysteresis has fully reversed, as a fraction of the
depth. The travel begins when the finger reverses its direction."""

MIN_REVERSAL_M = 4e-4
"""The minimum travel (m) of the finger after which the hysteresis has fully reversed. If the value
were smaller, tremor would reverse the hysteresis at small depths."""


class HysteresisCorrection:
    """A model of the sheet's hysteresis: the ratio of the actual force to the elastic force.

    ratio: fraction of the loading energy that the rubber loses in a cycle.
    """

    def __init__(self, ratio: float) -> None:
        self._amplitude = ratio / (2.0 - ratio)
        self._depth_m, self._direction = 0.0, 1.0

    def update(self, depth_m: float) -> float:
        """Update the model with a new finger depth (m), and return the force ratio.

        The ratio is the actual force divided by the elastic force. It is above 1 while the depth
        increases, and below 1 while the depth decreases.
        """
        if depth_m <= 0.0:
            self._depth_m, self._direction = 0.0, 1.0
            return 1.0
        travel_m = max(REVERSAL_RATIO * depth_m, MIN_REVERSAL_M)
        moved = 2.0 * (depth_m - self._depth_m) / travel_m
        self._direction = min(max(self._direction + moved, -1.0), 1.0)
        self._depth_m = depth_m
        return 1.0 + self._amplitude * self._direction
