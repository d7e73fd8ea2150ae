"""Check the timestamps of camera drivers, and pair the frames of two cameras."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import TypeVar

T = TypeVar("T")

MAX_FUTURE_NS = 1_000_000
"""Maximum time by which a timestamp may be later than the frame's arrival, due to rounding."""
MAX_AGE_NS = 1_000_000_000
"""Maximum age of a timestamp when the frame arrives.  It allows for a driver with a few frame
buffers at 10 Hz or more."""
MAX_IMPLAUSIBLE = 3
SLACK = 0.05
"""Tolerance of the pairing, as a fraction of the period.  It is needed for cameras that expose half
a period apart.  Without it, jitter would change the pairs repeatedly, and drop a frame each time.
"""


class StampCheck:
    """Check whether a driver's timestamps are readings of this host's monotonic clock.

    A timestamp is plausible if it is later than the previous one, and at most MAX_AGE_NS before the
    frame's arrival.  Timestamps of another clock differ by hours or years.  The caller drops a
    frame with an implausible timestamp.  After MAX_IMPLAUSIBLE such frames in a row, `trusted` is
    false, and timestamps are ignored until the device is reopened.
    """

    def __init__(self) -> None:
        self.trusted = True
        self._implausible = 0
        self._newest_ns: int | None = None

    def is_plausible(self, stamp_ns: int, arrival_ns: int) -> bool:
        """Return whether the timestamp of a frame that arrived at `arrival_ns` is plausible."""
        good = -MAX_FUTURE_NS <= arrival_ns - stamp_ns <= MAX_AGE_NS and (
            self._newest_ns is None or stamp_ns > self._newest_ns
        )
        if good:
            self._newest_ns, self._implausible = stamp_ns, 0
        else:
            self._implausible += 1
            self.trusted = self.trusted and self._implausible < MAX_IMPLAUSIBLE
        return good


class Pairing:
    """Pairing of the frames of two cameras with equal rates by their exposure times.

    The cameras have no common trigger.  Two frames are a pair if their exposures are at most half a
    period (plus `SLACK`) apart.  Otherwise the older one is dropped and counted in `unpaired`.
    """

    def __init__(self, period_s: float) -> None:
        self._limit_ns = round((0.5 + SLACK) * period_s * 1e9)
        self.unpaired = 0

    def pop_pair(
        self, left: deque[T], right: deque[T], exposure_ns: Callable[[T], int]
    ) -> tuple[T, T] | None:
        """Remove the next pair from both queues and return it; None if there is none.

        left, right: frames, oldest first.  exposure_ns: returns the exposure time of a frame.
        """
        while left and right:
            skew_ns = exposure_ns(right[0]) - exposure_ns(left[0])
            if abs(skew_ns) <= self._limit_ns:
                return left.popleft(), right.popleft()
            (left if skew_ns > 0 else right).popleft()
            self.unpaired += 1
        return None
