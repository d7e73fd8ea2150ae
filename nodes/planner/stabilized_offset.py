"""Compute the sheet's offset from measured depths, so that the loop with the hand is stable."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

import numpy as np

from flexsheet.nodes.planner.oscillation_watchdog import OscillationWatchdog

OffsetAtDepth = Callable[[float], float]


class StabilizedOffset:
    """Offset of the sheet behind the object's tangent plane, during one contact after another.

    The depth is measured, not predicted, and passes a low-pass filter: a prediction in this path
    moves the worst frequency up to that of a hand.  The offset never exceeds the depth, so that the
    sheet stays with a finger that leaves.
    """

    def __init__(self) -> None:
        self.watchdog = OscillationWatchdog()
        self._filtered_m = self._offset_m = self._time_s = 0.0
        self._passive_m: float | None = None
        self._commanded: deque[tuple[float, float]] = deque()

    def update(
        self,
        measured_depth_m: float,
        offset_at_depth: OffsetAtDepth,
        *,
        step_s: float,
        filter_s: float,
        delay_s: float,
    ) -> tuple[float, float]:
        """Return the offset (m) and its rate (m/s) after a measurement.

        step_s: since the last measurement. delay_s: from a measurement until the sheet has moved.
        """
        if measured_depth_m <= 0.0:
            self._restart()
            return 0.0, 0.0
        weight = -float(np.expm1(-step_s / filter_s)) if filter_s > 0.0 else 1.0
        self._filtered_m += weight * (measured_depth_m - self._filtered_m)
        offset_m = offset_at_depth(self._filtered_m)
        follow = self.watchdog.update(measured_depth_m, self._offset_at(delay_s), step_s)
        if follow < 1.0:
            if self._passive_m is None:
                self._passive_m = self._offset_m
            offset_m = self._passive_m + follow * (offset_m - self._passive_m)
        offset_m = min(offset_m, measured_depth_m)
        rate_m_per_s = (offset_m - self._offset_m) / step_s
        self._offset_m = offset_m
        self._time_s += step_s
        self._commanded.append((self._time_s, offset_m))
        return offset_m, rate_m_per_s

    def _offset_at(self, delay_s: float) -> float:
        """Return the offset at which the sheet is, commanded `delay_s` ago; 0 before the first."""
        while len(self._commanded) > 1 and self._commanded[1][0] <= self._time_s - delay_s:
            self._commanded.popleft()
        if not self._commanded or self._commanded[0][0] > self._time_s - delay_s:
            return 0.0
        return self._commanded[0][1]

    def _restart(self) -> None:
        self.watchdog.reset()
        self._filtered_m = self._offset_m = 0.0
        self._passive_m = None
        self._commanded.clear()
