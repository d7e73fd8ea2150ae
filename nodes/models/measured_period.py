"""Measure the period of messages that are published at the rate of the camera."""

from __future__ import annotations

from collections import deque
from statistics import median

INTERVALS = 15
MIN_INTERVALS = 8
MAX_PERIOD_S = 0.1
"""The maximum measured period, s. Longer intervals between messages count as interruptions."""

TOLERANCE_RATIO = 0.2
"""The maximum relative difference between the measured period and the scene's camera period. If the
difference is smaller, the scene's period is used."""


class MeasuredPeriod:
    """An estimator of the period of messages that are published once per camera image.

    scene_period_s: camera period in the scene, s. The estimator returns this period until enough
        messages have been added. It also returns this period if the measured period is nearly the
        same.
    """

    def __init__(self, scene_period_s: float) -> None:
        self._scene_period_s = scene_period_s
        self._intervals_s: deque[float] = deque(maxlen=INTERVALS)
        self._last_ns = 0

    def add(self, source_ns: int) -> float:
        """Add a message, and return the estimated period (s).

        source_ns: source timestamp of the message: the time of the camera exposure.
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
