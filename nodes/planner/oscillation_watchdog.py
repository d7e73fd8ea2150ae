"""Detect finger oscillations that the moving sheet causes, and stop the motion of the sheet."""

from __future__ import annotations

from collections import deque

import numpy as np

WINDOW_S = 1.4
"""The duration of the window whose two halves are compared. Each half contains one period of an
oscillation of 1.4 Hz."""

MIN_AMPLITUDE_M = 2e-4
"""The root mean square amplitude of the depth below which an oscillation cannot be felt."""

GROWTH_RATIO = 1.15
"""The ratio of two amplitudes that triggers the watchdog. It is the amplitude in the second half of
the window divided by the amplitude in the first half."""

STEADY_RATIO = 0.95
"""The ratio of two amplitudes above which an oscillation does not decay. It is the amplitude in the
second half of the window divided by the amplitude in the first half."""

SUSTAINED_S = 1.5
"""The time after which an oscillation that does not decay triggers the watchdog."""

FADE_S = 0.3
"""The time (s) in which the watchdog reduces the motion of the sheet's offset to zero."""

SLOW_S = 0.35
"""The time constant of the filter that removes slow changes of depth and offset."""


class OscillationWatchdog:
    """A watchdog that stops changes of the sheet's offset if they drive an oscillation.

    The sheet transfers energy to the finger if the integral of the offset over the depth is
    positive in a cycle. A voluntary motion of the finger transfers energy to the sheet instead, and
    does not trigger the watchdog.

    weight: factor for the offset's motion, from 1 (follows the finger) to 0 (at rest).
    triggers: number of oscillations that were stopped.
    """

    def __init__(self) -> None:
        self.triggers = 0
        self.reset()

    def reset(self) -> None:
        """Discard all measurements, and allow the full motion of the sheet's offset again."""
        self.weight = 1.0
        self._slow: tuple[float, float] | None = None
        self._last = (0.0, 0.0)
        self._samples: deque[tuple[float, float, float]] = deque()
        self._span_s = self._driven_s = 0.0
        self._fading = False

    def update(self, depth_m: float, offset_m: float, step_s: float) -> float:
        """Process a new measurement, and return the factor by which the offset's motion is scaled.

        The factor is 1 in normal operation. If the sheet's motion drives an oscillation of the
        finger, the factor decreases to 0.

        depth_m: measured depth of the finger.
        offset_m: offset of the sheet at the time of the measurement.
        step_s: time since the last measurement.
        """
        if self._slow is None:
            self._slow = (depth_m, offset_m)
        blend = -float(np.expm1(-step_s / SLOW_S))
        slow_depth, slow_offset = self._slow
        self._slow = (
            slow_depth + blend * (depth_m - slow_depth),
            slow_offset + blend * (offset_m - slow_offset),
        )
        now = (depth_m - self._slow[0], offset_m - self._slow[1])
        # The force on the finger falls with the offset.  The sheet's work on the finger is thus
        # proportional to the integral of the offset over the depth.
        work = 0.5 * (now[1] + self._last[1]) * (now[0] - self._last[0])
        self._last = now
        self._samples.append((step_s, now[0], work))
        self._span_s += step_s
        while self._span_s > WINDOW_S:
            self._span_s -= self._samples.popleft()[0]
        self._decide(step_s)
        if self._fading:
            self.weight = max(0.0, self.weight - step_s / FADE_S)
        return self.weight

    def _decide(self, step_s: float) -> None:
        if self._fading or self._span_s < 0.8 * WINDOW_S:
            return
        _, depths, works = np.array(self._samples).T
        half = len(depths) // 2
        before, after = (
            float(np.sqrt(np.mean(part**2))) for part in (depths[:half], depths[half:])
        )
        driven = after > MIN_AMPLITUDE_M and float(works.sum()) > 0.0 and _oscillates(depths)
        steady = driven and after > STEADY_RATIO * before
        self._driven_s = self._driven_s + step_s if steady else 0.0
        if driven and (after > GROWTH_RATIO * before or self._driven_s > SUSTAINED_S):
            self._fading = True
            self.triggers += 1


def _oscillates(depths: np.ndarray) -> bool:
    """Return whether the deviation of the finger's depth from its slow mean oscillates.

    depths: n deviations (n,), m.

    An oscillation changes its sign at least twice. A single push changes its sign less often.
    Values smaller than MIN_AMPLITUDE_M are ignored.
    """
    large = depths[np.abs(depths) > MIN_AMPLITUDE_M]
    return int(np.count_nonzero(np.diff(np.sign(large)))) >= 2
