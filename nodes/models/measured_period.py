"""Measure the period of messages that come at the camera's rate."""

from __future__ import annotations

from collections import deque
from statistics import median

INTERVALS = 15
MIN_INTERVALS = 8
MAX_PERIOD_S = 0.1
"""Maximum period; longer intervals count as interruptions."""

TOLERANCE_RATIO = 0.2
"""Maximum relative deviation up to which the period in the scene is used."""


class MeasuredPeriod:
    """Estimator of the period of messages; it starts with the period in the scene."""

    def __init__(self, scene_period_s: float) -> None:
        self._scene_period_s = scene_period_s
        self._intervals_s: deque[float] = deque(maxlen=INTERVALS)
        self._last_ns = 0

    def add(self, source_ns: int) -> float:
        """Add a message, given the time of its camera exposure; return the period (s)."""
        interval_s = (source_ns - self._last_ns) * 1e-9
        self._last_ns = source_ns
        if 0.0 < interval_s <= MAX_PERIOD_S:
            self._intervals_s.append(interval_s)
        if len(self._intervals_s) < MIN_INTERVALS:
            return self._scene_period_s
        measured_s = median(self._intervals_s)
        differs = abs(measured_s / self._scene_period_s - 1.0) > TOLERANCE_RATIO
        return measured_s if differs else self._scene_period_s
