"""Order measured fingertips by the times of their exposures, and adapt the prediction horizon."""

from __future__ import annotations

from flexsheet.messages.types import Side

RESTART_COUNT = 3
"""Number of late fingertips in a row, with rising timestamps, that indicate a step of the clock."""

MIN_STEP_NS = 1_000_000
"""Minimum plausible interval between two exposures; no camera is faster."""

AGE_WEIGHT = 0.05
"""Weight of the newest age in the running mean; at 60 Hz the mean spans a third of a second."""

DELAY_WEIGHT = 0.11
"""Weight of an arm's newest report in the running mean; at 5 Hz the mean spans 1.8 s."""


class MonotonicTimestampFilter:
    """Filter that passes measured fingertips only in the order of their exposures.

    A late fingertip is dropped, because the sheet is already planned for a later time.
    `RESTART_COUNT` late ones in a row mean that the clock has stepped back; the filter then
    restarts with the last one.
    """

    def __init__(self) -> None:
        self._last_ns: int | None = None
        self._late_ns: list[int] = []

    def update(self, source_ns: int, first_step_s: float) -> float | None:
        """Return the time (s) since the last passed fingertip; None if this one is dropped.

        first_step_s: returned for the first fingertip and after a restart.
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
    """Estimator of the delay from a fingertip's publication until the arms have moved accordingly.

    It is the latency that the arms report, less the mean age of published fingertips.
    delay_s: mean over both arms, from 0 to the maximum; before any report, the initial value.
    """

    def __init__(self, initial_s: float, max_s: float) -> None:
        self.delay_s = self._initial_s = min(initial_s, max_s)
        self._max_s = max_s
        self._age_s: float | None = None
        self._delays_s: dict[Side, float] = {}

    def on_fingertip(self, age_s: float) -> None:
        """Add a fingertip that leads to a target; age_s: its age when it was published."""
        before_s = age_s if self._age_s is None else self._age_s
        self._age_s = before_s + AGE_WEIGHT * (age_s - before_s)

    def on_latency(self, side: Side, latency_s: float) -> None:
        """Add a reported latency from exposure until the arm has moved; ignore implausible ones."""
        if self._age_s is None or not 0.0 <= latency_s - self._age_s <= self._max_s:
            return
        before_s = self._delays_s.get(side, self._initial_s)
        self._delays_s[side] = before_s + DELAY_WEIGHT * (latency_s - self._age_s - before_s)
        self.delay_s = sum(self._delays_s.values()) / len(self._delays_s)


def update_horizon_s(horizon_s: float, needed_s: float, max_s: float) -> float:
    """Return the prediction horizon (s) of the next target.

    The horizon changes slowly, so that the sheet does not jump after one late fingertip.

    horizon_s: prediction horizon of the last target.
    needed_s: time from the exposure until the sheet reaches the target.
    max_s: duration of the fingertip's predicted path.
    """
    return horizon_s + AGE_WEIGHT * (min(max(needed_s, 0.0), max_s) - horizon_s)
