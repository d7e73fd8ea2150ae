"""Correct the sheet's indentation for the hysteresis of its rubber.

Loading needs 1 + h of the elastic force and unloading gives 1 - h of it, with h = r / (2 - r) for
rubber that loses the share r of the loading's energy. After a reversal of the finger the factor
changes linearly with its travel.
"""

from __future__ import annotations

REVERSAL_RATIO = 0.2
"""Travel over which the factor reverses completely, over the depth."""

MIN_REVERSAL_M = 4e-4
"""Minimum travel of a reversal, so that tremor at small depths does not reverse it."""


class HysteresisCorrection:
    """Factor between the sheet's force and its elastic force, by the finger's depth so far.

    ratio: share of the loading's energy that a cycle loses.
    """

    def __init__(self, ratio: float) -> None:
        self._amplitude = ratio / (2.0 - ratio)
        self._depth_m, self._direction = 0.0, 1.0

    def update(self, depth_m: float) -> float:
        """Add a depth of the finger and return the force over the elastic force there.

        The first contact is loading. The same depth again changes nothing.
        """
        if depth_m <= 0.0:
            self._depth_m, self._direction = 0.0, 1.0
            return 1.0
        travel_m = max(REVERSAL_RATIO * depth_m, MIN_REVERSAL_M)
        moved = 2.0 * (depth_m - self._depth_m) / travel_m
        self._direction = min(max(self._direction + moved, -1.0), 1.0)
        self._depth_m = depth_m
        return 1.0 + self._amplitude * self._direction
