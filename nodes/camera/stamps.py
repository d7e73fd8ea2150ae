"""Decide which stamps to trust, and pair the frames of two cameras."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import TypeVar

T = TypeVar("T")

FUTURE_NS = 1_000_000
"""A stamp precedes the frame's arrival from the driver; rounding may violate that by this much."""
OLDEST_NS = 1_000_000_000
"""Maximum age of a stamp; longer than a driver's few buffers hold a frame at 10 Hz and more."""
LAPSES = 3
SLACK = 0.05
"""Tolerance as a fraction of the period.  Two cameras half a period apart would otherwise change
partners with every jitter of their stamps, and lose a frame each time."""


class StampJudge:
    """Decide whether a driver's stamps are readings of our own monotonic clock.

    A stamp is plausible when it lies at most a second before the frame's arrival, not after it, and
    after the previous stamp.  Stamps of the time of day or the device's own clock are years or
    hours off.  A frame with an implausible stamp is dropped by the caller.  After three in a row
    the stamps are not trusted until the device is opened again.
    """

    def __init__(self) -> None:
        self.believed = True
        self._lapses = 0
        self._newest_ns: int | None = None

    def plausible(self, stamp_ns: int, arrival_ns: int) -> bool:
        """Check one frame's stamp, both in ns."""
        good = -FUTURE_NS <= arrival_ns - stamp_ns <= OLDEST_NS and (
            self._newest_ns is None or stamp_ns > self._newest_ns
        )
        if good:
            self._newest_ns, self._lapses = stamp_ns, 0
        else:
            self._lapses += 1
            self.believed = self.believed and self._lapses < LAPSES
        return good


class Pairing:
    """Pair the frames of two free-running cameras of one rate by the times of their exposure.

    Two frames are a pair when they are at most half a period (and `SLACK`) apart.  Otherwise the
    older one has no partner, is dropped and counted in `unpaired`.
    """

    def __init__(self, period_s: float) -> None:
        self._limit_ns = round((0.5 + SLACK) * period_s * 1e9)
        self.unpaired = 0

    def take(
        self, left: deque[T], right: deque[T], moment_ns: Callable[[T], int]
    ) -> tuple[T, T] | None:
        """Return the next pair and remove it from both queues (oldest first); None until there is
        one."""
        while left and right:
            skew_ns = moment_ns(right[0]) - moment_ns(left[0])
            if abs(skew_ns) <= self._limit_ns:
                return left.popleft(), right.popleft()
            (left if skew_ns > 0 else right).popleft()
            self.unpaired += 1
        return None
