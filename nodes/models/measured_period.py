"""Measure the period of messages whose rate is that of the camera."""

from __future__ import annotations

from collections import deque
from statistics import median

INTERVALS = 15
MIN_INTERVALS = 8
MAX_PERIOD_S = 0.1
"""The maximum period. Longer intervals between messages count as interruptions."""

TOLERANCE_RATIO = 0.2
"""The maximum relative deviation from the scene's period at which the scene's period is used."""


class MeasuredPeriod:
    """An estimator of the period of messages.

    scene_period_s: camera period in the scene, s. It is returned until enough messages have been
        added, and while the measured period is close to it.
    """

    def __init__(self, scene_period_s: float) -> None:
        self._scene_period_s = scene_period_s
        self._intervals_s: deque[float] = deque(maxlen=INTERVALS)
        self._last_ns = 0

    def add(self, source_ns: int) -> float:
        """Add a message, and return the period (s).

        source_ns: source timestamp of the message, which is the time of its camera exposure.
        """
        interval_s = (source_ns - self._last_ns) * 1e-9
        self._last_ns = source_ns
        if 0.0 < interval_s <= MAX_PERIOD_S:
            self._intervals_s.append(interval_s)
        if len(self._intervals_s) < MIN_INTERVALS:
            return self._scene_period_s
        measured_s = median(self._intervals_s)
        differs = abs(measured_s / self._scene_period_s - 1.0) > TOLERANCE_RATIO
        return measured_s if differs else self._scene_period_s
