"""Compute the sheet's normal offset from the low-pass filtered depth of the fingertip.

The filter keeps the closed loop of sheet and hand stable.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from flexsheet.nodes.models.hand_loop import compute_filter_gains
from flexsheet.nodes.planner.oscillation_watchdog import OscillationWatchdog

OffsetAtDepth = Callable[[float], float]


class StabilizedOffset:
    """A filter that computes the sheet's offset behind the object's tangent plane.

    The measured depth is smoothed by the filter in the module `hand_loop`. Prediction does not
    compensate the full delay of the control loop. With full prediction, the loop would be least
    stable at the frequencies of hand oscillations. The offset never exceeds the depth, so the sheet
    stays in contact with a finger that moves away.
    """

    def __init__(self) -> None:
        self.watchdog = OscillationWatchdog()
        self._filtered_m = self._rate_m_per_s = self._offset_m = self._time_s = 0.0
        self._passive_m: float | None = None
        self._commanded: deque[tuple[float, float]] = deque()

    def update(
        self,
        measured_depth_m: float,
        offset_at_depth: OffsetAtDepth,
        *,
        step_s: float,
        bandwidth_rad_per_s: float,
        delay_s: float,
    ) -> tuple[float, float]:
        """Process a measured depth, and return the sheet's offset (m) and its rate (m/s).

        offset_at_depth: function from the depth (m) to the offset (m).
        step_s: time since the last measurement.
        bandwidth_rad_per_s: bandwidth of the depth filter; infinite if there is no filter.
        delay_s: time from a measurement until the sheet has moved.
        """
        if measured_depth_m <= 0.0:
            self._restart()
            return 0.0, 0.0
        alpha, beta = compute_filter_gains(bandwidth_rad_per_s, step_s)
        predicted_m = self._filtered_m + step_s * self._rate_m_per_s
        error_m = measured_depth_m - predicted_m
        self._filtered_m = predicted_m + alpha * error_m
        self._rate_m_per_s += beta / step_s * error_m
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
        """Return the offset (m) that was commanded `delay_s` ago, or 0 before the first command."""
        while len(self._commanded) > 1 and self._commanded[1][0] <= self._time_s - delay_s:
            self._commanded.popleft()
        if not self._commanded or self._commanded[0][0] > self._time_s - delay_s:
            return 0.0
        return self._commanded[0][1]

    def _restart(self) -> None:
        self.watchdog.reset()
        self._filtered_m = self._rate_m_per_s = self._offset_m = 0.0
        self._passive_m = None
        self._commanded.clear()
