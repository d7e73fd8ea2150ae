"""Which stamps to believe, and which frames of two cameras belong together."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import TypeVar

T = TypeVar("T")

FUTURE_NS = 1_000_000
"""A stamp is given before the frame can be taken from the driver; rounding may cost this much."""
OLDEST_NS = 1_000_000_000
"""Longer than a driver's few buffers hold a frame at 10 Hz and more."""
LAPSES = 3
SLACK = 0.05
"""A share of the period.  Two cameras just half a period apart would otherwise change partners
with every jitter of their stamps, and lose a frame each time."""


class StampJudge:
    """Whether a driver's stamps are readings of our own monotonic clock.

    A stamp is plausible when it lies at most a second before the frame's arrival, not after it, and
    after the stamp before.  A driver that stamps with the time of day, with the device's own clock
    or not at all is years or hours off.  A lapse is a bad frame, which the caller drops; after
    three in a row the stamps are not believed any more, until the device is opened anew.
    """

    def __init__(self) -> None:
        self.believed = True
        self._lapses = 0
        self._newest_ns: int | None = None

    def plausible(self, stamp_ns: int, arrival_ns: int) -> bool:
        """Judge one frame's stamp, both in ns."""
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
    """Frames of two cameras that run freely at one rate, paired by the moments of their exposure.

    Two frames are a pair when they are at most half a period (and `SLACK`) apart; otherwise the
    older one has lost its partner, is dropped and counted in `unpaired`.
    """

    def __init__(self, period_s: float) -> None:
        self._limit_ns = round((0.5 + SLACK) * period_s * 1e9)
        self.unpaired = 0

    def take(
        self, left: deque[T], right: deque[T], moment_ns: Callable[[T], int]
    ) -> tuple[T, T] | None:
        """The next pair, taken out of both queues (oldest first), or None until more has come."""
        while left and right:
            skew_ns = moment_ns(right[0]) - moment_ns(left[0])
            if abs(skew_ns) <= self._limit_ns:
                return left.popleft(), right.popleft()
            (left if skew_ns > 0 else right).popleft()
            self.unpaired += 1
        return None
