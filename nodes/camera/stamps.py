"""Check the timestamps of camera drivers, and pair the frames of two cameras."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import TypeVar

T = TypeVar("T")

MAX_FUTURE_NS = 1_000_000
"""The maximum time (ns) by which rounding may make a timestamp later than the frame's arrival."""
MAX_AGE_NS = 1_000_000_000
"""The maximum age (ns) of a timestamp when the frame arrives. At 10 frames per second, drivers with
several frame buffers need this time."""
MAX_IMPLAUSIBLE = 3
SLACK = 0.05
"""The tolerance for the pairing of frames, as a fraction of the frame period. Without it, frames of
cameras that expose half a period apart would be dropped because of jitter."""


class StampCheck:
    """A plausibility check of a camera driver's timestamps.

    The timestamps must be times of this computer's monotonic clock. A timestamp is plausible if it
    is later than the previous timestamp, and at most MAX_AGE_NS before the frame's arrival.
    Timestamps of another clock differ by hours or years.

    trusted: whether the timestamps may be used; False after MAX_IMPLAUSIBLE consecutive implausible
        timestamps.
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
    """A matcher that pairs the frames of two cameras by their exposure times.

    unpaired: number of dropped frames.

    The cameras have equal frame rates, but no common trigger. Two frames are a pair if the time
    between their exposures is at most half a period, plus a tolerance. Otherwise the older frame is
    dropped.
    """

    def __init__(self, period_s: float) -> None:
        self._limit_ns = round((0.5 + SLACK) * period_s * 1e9)
        self.unpaired = 0

    def pop_pair(
        self, left: deque[T], right: deque[T], exposure_ns: Callable[[T], int]
    ) -> tuple[T, T] | None:
        """Remove the next image pair from both queues and return it, or None if there is no pair.

        left, right: frames in the order of their exposures.
        exposure_ns: function that returns the exposure time of a frame.
        """
        while left and right:
            skew_ns = exposure_ns(right[0]) - exposure_ns(left[0])
            if abs(skew_ns) <= self._limit_ns:
                return left.popleft(), right.popleft()
            (left if skew_ns > 0 else right).popleft()
            self.unpaired += 1
        return None
