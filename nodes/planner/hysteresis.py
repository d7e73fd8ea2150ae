"""Correct the sheet's indentation for the hysteresis of its rubber.

While the finger moves inwards (loading), the force is 1 + h times the elastic force, and 1 - h
times while it moves outwards. Here h = r / (2 - r), and r is the fraction of the energy of loading
that the rubber loses. After the finger reverses, the factor changes linearly with its travel.
"""

from __future__ import annotations

REVERSAL_RATIO = 0.2
"""Travel over which the factor changes completely, as a fraction of the depth."""

MIN_REVERSAL_M = 4e-4
"""Minimum of this travel, so that tremor at small depths does not reverse the factor."""


class HysteresisCorrection:
    """Ratio of the sheet's force to its elastic force, which follows from the finger's depths.

    ratio: fraction of the energy of loading that is lost in a cycle.
    """

    def __init__(self, ratio: float) -> None:
        self._amplitude = ratio / (2.0 - ratio)
        self._depth_m, self._direction = 0.0, 1.0

    def update(self, depth_m: float) -> float:
        """Add a depth of the finger, and return the ratio of force to elastic force there.

        A contact begins with loading. A repeated depth changes nothing.
        """
        if depth_m <= 0.0:
            self._depth_m, self._direction = 0.0, 1.0
            return 1.0
        travel_m = max(REVERSAL_RATIO * depth_m, MIN_REVERSAL_M)
        moved = 2.0 * (depth_m - self._depth_m) / travel_m
        self._direction = min(max(self._direction + moved, -1.0), 1.0)
        self._depth_m = depth_m
        return 1.0 + self._amplitude * self._direction
