"""Summarize measured quantities in equal intervals of a bag's duration.

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
"""The range and resolution of the histogram in `Spread`. A bin is 2.3 % wide."""

CELLS = 7 * CELLS_PER_DECADE
MAX_STATE_AGE_S = 0.5
"""The maximum time for which a state is assumed to last without another message."""


@dataclass(frozen=True, slots=True)
class Grid:
    """A division of a bag's duration into `count` equal intervals."""

    start_ns: int
    duration_s: float
    count: int

    def index(self, at_ns: int) -> int:
        """Return the index of the interval that contains a time, or of the nearest interval."""
        fraction = (at_ns - self.start_ns) * 1e-9 / max(self.duration_s, 1e-9)
        return min(max(int(fraction * self.count), 0), self.count - 1)

    def seconds(self) -> Floats:
        """Return the centre times (count,) of the intervals, s since the start of the bag."""
        middles = np.arange(self.count, dtype=np.float64) + 0.5
        return np.asarray(middles * (self.duration_s / self.count))


class Range:
    """The minimum and maximum of a quantity in each interval; NaN if the interval has no values."""

    def __init__(self, grid: Grid) -> None:
        self.minimum = np.full(grid.count, np.nan)
        self.maximum = np.full(grid.count, np.nan)

    def add(self, index: int, value: float) -> None:
        # The negated comparison is also true if the stored value is NaN, its initial value.
        if not value >= self.minimum[index]:
            self.minimum[index] = value
        if not value <= self.maximum[index]:
            self.maximum[index] = value

    def overall(self) -> tuple[float, float] | None:
        """Return the minimum and maximum over all intervals, or None if there are no values."""
        if np.isnan(self.maximum).all():
            return None
        return float(np.nanmin(self.minimum)), float(np.nanmax(self.maximum))


class Spread:
    """The distribution of durations (such as latencies) in each interval, as histograms."""

    def __init__(self, grid: Grid) -> None:
        self.counts: NDArray[np.int32] = np.zeros((grid.count, CELLS), np.int32)
        self.longest_s = 0.0

    def add(self, index: int, duration_s: float) -> None:
        """Add a duration (s) to the interval `index`. It counts as at least `MIN_DURATION_S`."""
        self.longest_s = max(self.longest_s, duration_s)
        cell = CELLS_PER_DECADE * log10(max(duration_s, MIN_DURATION_S) / MIN_DURATION_S)
        self.counts[index, min(int(cell), CELLS - 1)] += 1

    @property
    def count(self) -> int:
        return int(self.counts.sum())

    def quantile_s(self, fraction: float) -> float | None:
        """Return a quantile of all durations, accurate to 2.3 %; None without durations."""
        found = _quantiles(self.counts.sum(axis=0, keepdims=True), fraction)[0]
        return None if np.isnan(found) else float(min(found, self.longest_s))

    def quantiles_s(self, fraction: float) -> Floats:
        """Return a quantile (count,), in s, of the durations in each interval.

        The quantile is NaN for intervals that have no durations.
        """
        return _quantiles(self.counts, fraction)


def _quantiles(counts: NDArray[np.int32], fraction: float) -> Floats:
    """Return quantiles (n,), s, of n histograms, given as rows (n, CELLS) of counts."""
    sums = np.cumsum(counts, axis=1)
    rank = fraction * sums[:, -1:]
    cell = np.argmax(sums >= np.maximum(rank, 1), axis=1)
    before = np.take_along_axis(sums - counts, cell[:, None], axis=1)[:, 0]
    inside = np.take_along_axis(counts, cell[:, None], axis=1)[:, 0]
    part = np.clip((rank[:, 0] - before) / np.maximum(inside, 1), 0.0, 1.0)
    found = MIN_DURATION_S * 10.0 ** ((cell + part) / CELLS_PER_DECADE)
    return np.where(sums[:, -1] > 0, found, np.nan)


class PointSeries:
    """The last position (count, 3) of a moving point in each interval; NaN if there is none."""

    def __init__(self, grid: Grid) -> None:
        self.points = np.full((grid.count, 3), np.nan)

    def add(self, index: int, point: Floats) -> None:
        self.points[index] = point


class States:
    """The most severe state of a device in each interval, and the total time in each state.

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
        """Add the state reported at `at_ns`. Return whether it differs from the previous state."""
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
    """The mean, standard deviation and maximum of values that are not stored."""

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
        """Return mean, standard deviation and maximum, multiplied by `scale`.

        Return None if there are no values.
        """
        if not self.count:
            return None
        mean = self.total / self.count
        variance = max(self.squares / self.count - mean**2, 0.0)
        return {"mean": scale * mean, "std": scale * variance**0.5, "max": scale * self.maximum}


@dataclass(slots=True)
class Events:
    """The first `limit` events of each kind in the order of time, and the number of all events."""

    limit: int = 100
    stored: list[tuple[float, str, str]] = field(default_factory=list)
    counts: dict[str, int] = field(default_factory=dict)

    def add(self, seconds: float, kind: str, text: str) -> None:
        self.counts[kind] = self.counts.get(kind, 0) + 1
        if self.counts[kind] <= self.limit:
            self.stored.append((seconds, kind, text))

    def select(self, kind: str) -> list[tuple[float, str]]:
        return [(seconds, text) for seconds, its, text in self.stored if its == kind]
