"""Drop late fingertip messages, and adapt the prediction horizon to the measured delays."""

from __future__ import annotations

from flexsheet.messages.types import Side

RESTART_COUNT = 3
"""The number of consecutive late fingertip messages that indicate that a clock was set back."""

MIN_STEP_NS = 1_000_000
"""The minimum plausible interval (ns) between two exposures. No camera has a higher frame rate."""

AGE_WEIGHT = 0.05
"""The weight of the newest value in the exponential average of the age of fingertip measurements.
At 60 measurements per second, the time constant is 0.33 s."""

DELAY_WEIGHT = 0.11
"""The weight of the newest value in the exponential average of an arm's latency. At 5 values per
second, the time constant is 1.7 s."""


class MonotonicTimestampFilter:
    """A filter that drops each fingertip message whose timestamp is before the last accepted one.

    `RESTART_COUNT` consecutive late messages indicate that the clock was set back. The filter then
    restarts.
    """

    def __init__(self) -> None:
        self._last_ns: int | None = None
        self._late_ns: list[int] = []

    def update(self, source_ns: int, first_step_s: float) -> float | None:
        """Return the time (s) since the last accepted message; None if the new message is dropped.

        source_ns: time of the exposure from which the new message was computed.
        first_step_s: result for the first message and after a restart.
        """
        last_ns = self._last_ns
        if last_ns is not None and source_ns < last_ns + MIN_STEP_NS:
            rising = not self._late_ns or source_ns > self._late_ns[-1]
            self._late_ns = [*self._late_ns, source_ns] if rising else [source_ns]
            if len(self._late_ns) < RESTART_COUNT:
                return None
            last_ns = None
        self._last_ns, self._late_ns = source_ns, []
        return first_step_s if last_ns is None else (source_ns - last_ns) * 1e-9


class ActuationDelayEstimator:
    """An estimator of the time from the publication of a fingertip message to the arms' motion.

    delay_s: mean delay of both arms, or the initial value before any report.

    The delay is the latency that an arm reports, minus the mean age of the fingertip measurements
    at publication.
    """

    def __init__(self, initial_s: float, max_s: float) -> None:
        self.delay_s = self._initial_s = min(initial_s, max_s)
        self._max_s = max_s
        self._age_s: float | None = None
        self._delays_s: dict[Side, float] = {}

    def on_fingertip(self, age_s: float) -> None:
        """Record the age (s) that a valid fingertip measurement had when it was published."""
        before_s = age_s if self._age_s is None else self._age_s
        self._age_s = before_s + AGE_WEIGHT * (age_s - before_s)

    def on_latency(self, side: Side, latency_s: float) -> None:
        """Update the delay with the latency (s) from exposure to motion that an arm reports.

        An implausible latency is ignored.
        """
        if self._age_s is None or not 0.0 <= latency_s - self._age_s <= self._max_s:
            return
        before_s = self._delays_s.get(side, self._initial_s)
        self._delays_s[side] = before_s + DELAY_WEIGHT * (latency_s - self._age_s - before_s)
        self.delay_s = sum(self._delays_s.values()) / len(self._delays_s)


def update_horizon_s(horizon_s: float, needed_s: float, max_s: float) -> float:
    """Return the prediction horizon (s) of the next target, which changes slowly.

    horizon_s: prediction horizon of the last target.
    needed_s: time from the exposure until the sheet reaches the target.
    max_s: duration of the fingertip's predicted path.
    """
    return horizon_s + AGE_WEIGHT * (min(max(needed_s, 0.0), max_s) - horizon_s)
