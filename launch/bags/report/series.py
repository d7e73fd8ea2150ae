"""Summarize measured quantities in equal time intervals of a bag.

The required memory does not depend on the duration of the bag.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from math import log10

import numpy as np
from numpy.typing import NDArray

from flexsheet.nodes.arrays import Floats

MIN_DURATION_S, MAX_DURATION_S, CELLS_PER_DECADE = 1e-5, 1e2, 100
"""The range of durations (s) in the histogram of `Spread`, and the number of bins per decade.

Each bin is 2.3 % wide.
"""

CELLS = 7 * CELLS_PER_DECADE
MAX_STATE_AGE_S = 0.5
"""The maximum time (s) for which a state is assumed to last if no new message arrives."""


@dataclass(frozen=True, slots=True)
class Grid:
    """A division of the duration of a bag into `count` equal intervals."""

    start_ns: int
    duration_s: float
    count: int

    def index(self, at_ns: int) -> int:
        """Return the index of the interval that contains a time.

        If the time is outside the bag, return the index of the nearest interval.
        """
        fraction = (at_ns - self.start_ns) * 1e-9 / max(self.duration_s, 1e-9)
        return min(max(int(fraction * self.count), 0), self.count - 1)

    def seconds(self) -> Floats:
        """Return the centres of the intervals, in s since the start of the bag."""
        middles = np.arange(self.count, dtype=np.float64) + 0.5
        return np.asarray(middles * (self.duration_s / self.count))


class Maxima:
    """The maximum of a quantity in each interval, or NaN if an interval contains no values."""

    def __init__(self, grid: Grid) -> None:
        self.maximum = np.full(grid.count, np.nan)

    def add(self, index: int, value: float) -> None:
        # The negated comparison is also true if the stored value is NaN, its initial value.
        if not value <= self.maximum[index]:
            self.maximum[index] = value

    def overall(self) -> float | None:
        """Return the maximum over all intervals, or None if there are no values."""
        return None if np.isnan(self.maximum).all() else float(np.nanmax(self.maximum))


class Spread:
    """The distribution of durations, such as latencies, in each interval.

    Each distribution is stored as a histogram.
    """

    def __init__(self, grid: Grid) -> None:
        self.counts: NDArray[np.int32] = np.zeros((grid.count, CELLS), np.int32)
        self.longest_s = 0.0

    def add(self, index: int, duration_s: float) -> None:
        """Add a duration (s) to the histogram of the interval `index`.

        A duration below `MIN_DURATION_S` is counted in the first bin.
        """
        self.longest_s = max(self.longest_s, duration_s)
        cell = CELLS_PER_DECADE * log10(max(duration_s, MIN_DURATION_S) / MIN_DURATION_S)
        self.counts[index, min(int(cell), CELLS - 1)] += 1

    @property
    def count(self) -> int:
        return int(self.counts.sum())

    def quantile_s(self, fraction: float) -> float | None:
        """Return a quantile (s) of all durations, accurate to 2.3 %.

        Return None if no durations were added.

        fraction: fraction of the durations that are below the quantile.
        """
        found = _quantiles(self.counts.sum(axis=0, keepdims=True), fraction)[0]
        return None if np.isnan(found) else float(min(found, self.longest_s))

    def quantiles_s(self, fraction: float) -> Floats:
        """Return a quantile (s) of the durations for each interval.

        The quantile of an interval is NaN if no durations were added to it.

        fraction: fraction of the durations that are below the quantile.
        """
        return _quantiles(self.counts, fraction)


def _quantiles(counts: NDArray[np.int32], fraction: float) -> Floats:
    """Return a quantile (n,), in s, of each of n histograms.

    counts: number of durations in each bin, as rows (n, CELLS).
    fraction: fraction of the durations that are below the quantile.
    """
    sums = np.cumsum(counts, axis=1)
    rank = fraction * sums[:, -1:]
    cell = np.argmax(sums >= np.maximum(rank, 1), axis=1)
    before = np.take_along_axis(sums - counts, cell[:, None], axis=1)[:, 0]
    inside = np.take_along_axis(counts, cell[:, None], axis=1)[:, 0]
    part = np.clip((rank[:, 0] - before) / np.maximum(inside, 1), 0.0, 1.0)
    found = MIN_DURATION_S * 10.0 ** ((cell + part) / CELLS_PER_DECADE)
    return np.where(sums[:, -1] > 0, found, np.nan)


class PointSeries:
    """The last known position of a point in each of `count` intervals.

    The positions (count, 3) are in m. Unknown positions are NaN.
    """

    def __init__(self, grid: Grid) -> None:
        self.points = np.full((grid.count, 3), np.nan)

    def add(self, index: int, point: Floats) -> None:
        self.points[index] = point


class States:
    """The most severe state of a device in each interval, and the total duration of each state.

    order: expected states, from the least to the most severe.
    """

    NOTHING = -1

    def __init__(self, grid: Grid, order: Sequence[str]) -> None:
        self.names = list(order)
        self.codes: NDArray[np.int8] = np.full(grid.count, self.NOTHING, np.int8)
        self.seconds = dict.fromkeys(self.names, 0.0)
        self.state: str | None = None
        self._since_ns = 0

    def add(self, index: int, at_ns: int, state: str) -> bool:
        """Add a reported state, and return whether it differs from the previous state.

        index: index of the time interval that contains the report.
        at_ns: time of the report, ns.
        """
        if state not in self.seconds:
            self.names.append(state)
            self.seconds[state] = 0.0
        if self.state is not None:
            passed_s = (at_ns - self._since_ns) * 1e-9
            self.seconds[self.state] += min(max(passed_s, 0.0), MAX_STATE_AGE_S)
        changed = self.state is not None and self.state != state
        self.state, self._since_ns = state, at_ns
        self.codes[index] = max(int(self.codes[index]), self.names.index(state))
        return changed


@dataclass(slots=True)
class RunningMoments:
    """An accumulator of the mean, the standard deviation and the maximum of values.

    The values themselves are not stored.
    """

    count: int = 0
    total: float = 0.0
    squares: float = 0.0
    maximum: float = 0.0

    def add(self, values: Floats) -> None:
        if len(values):
            self.count += len(values)
            self.total += float(values.sum())
            self.squares += float((values**2).sum())
            self.maximum = max(self.maximum, float(values.max()))

    def summary(self, scale: float) -> dict[str, float] | None:
        """Return the mean, the standard deviation and the maximum, each multiplied by `scale`.

        Return None if no values were added.
        """
        if not self.count:
            return None
        mean = self.total / self.count
        variance = max(self.squares / self.count - mean**2, 0.0)
        return {"mean": scale * mean, "std": scale * variance**0.5, "max": scale * self.maximum}


@dataclass(slots=True)
class Events:
    """A list of the first `limit` events of each kind, and the number of all events per kind."""

    limit: int = 100
    stored: list[tuple[float, str, str]] = field(default_factory=list)
    counts: dict[str, int] = field(default_factory=dict)

    def add(self, seconds: float, kind: str, text: str) -> None:
        self.counts[kind] = self.counts.get(kind, 0) + 1
        if self.counts[kind] <= self.limit:
            self.stored.append((seconds, kind, text))

    def select(self, kind: str) -> list[tuple[float, str]]:
        return [(seconds, text) for seconds, its, text in self.stored if its == kind]
