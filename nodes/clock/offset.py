"""Estimate the offset of another clock from pings: guaranteed bounds, and a best estimate within.

A ping gives four stamps: sent (t1, own), received (t2, other), answered (t3, other), received back
    (t4, own).  No message arrives before it was sent.  The other clock minus ours was therefore at
    most t2 - t1 at t1, and at least t3 - t4 at t4; the clock rates bound its change in between.
    (Cristian 1989, "Probabilistic clock synchronization"; Marzullo 1984 on intersecting intervals.)
    Nothing else is assumed of the network: neither equal delays in both directions, nor how delays
    vary.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

WINDOW_NS = 60_000_000_000
BIN_NS = 500_000_000
FIT_SPAN_NS = 5_000_000_000


@dataclass(frozen=True, slots=True)
class Sample:
    """Hold the other clock minus ours at `at_ns` of ours: within `half_ns` of `offset_ns`."""

    at_ns: int
    offset_ns: int
    half_ns: int


@dataclass(frozen=True, slots=True)
class OffsetEstimate:
    """Hold the other clock minus ours at `at_ns` of ours, certainly within `half_ns` of
    `offset_ns`.

    drift_ratio: rate at which the other clock gains on ours, best estimate.
    """

    at_ns: int
    offset_ns: int
    half_ns: int
    drift_ratio: float


def make_sample(t1: int, t2: int, t3: int, t4: int, *, max_drift_ratio: float) -> Sample | None:
    """Make a ping's sample, stamps in ns as in the module's text; None for an impossible one.

    max_drift_ratio: maximum rate at which one clock may gain on the other.
    """
    away_ns, there_ns = t4 - t1, t3 - t2
    moved_ns = max_drift_ratio * away_ns
    delay_ns = away_ns - there_ns
    if away_ns < 0 or there_ns < 0 or delay_ns < -moved_ns:
        return None
    # Twice the offset, which keeps integers.
    twice = (t2 - t1) + (t3 - t4)
    return Sample((t1 + t4) // 2, twice // 2, int(max(0, delay_ns) / 2 + moved_ns / 2) + 1)


def bounds(samples: list[Sample], at_ns: int, *, max_drift_ratio: float) -> tuple[int, int]:
    """Return the bounds of the offset (ns) at `at_ns`: each sample's bounds, widened by its age.

    The lower bound exceeds the upper one where the samples contradict each other.
    """
    low = max(
        one.offset_ns - one.half_ns - int(max_drift_ratio * abs(at_ns - one.at_ns)) - 1
        for one in samples
    )
    high = min(
        one.offset_ns + one.half_ns + int(max_drift_ratio * abs(at_ns - one.at_ns)) + 1
        for one in samples
    )
    return low, high


def fit_drift(samples: list[Sample]) -> tuple[float, float]:
    """Fit a line through samples: offset (ns, at the newest one, less its own) and slope.

    Least squares, weighted by the inverse square of the bounds, so that pings without queueing
    decide. Slope and offset are 0 while the samples span less than FIT_SPAN_NS.
    """
    newest = samples[-1]
    if newest.at_ns - samples[0].at_ns < FIT_SPAN_NS:
        return 0.0, 0.0
    when = np.array([one.at_ns - newest.at_ns for one in samples], dtype=np.float64)
    offset = np.array([one.offset_ns - newest.offset_ns for one in samples], dtype=np.float64)
    weight = np.array([1.0 / max(1, one.half_ns) ** 2 for one in samples])
    weight /= weight.sum()
    middle, mean = float(weight @ when), float(weight @ offset)
    spread = float(weight @ (when - middle) ** 2)
    if spread <= 0.0:
        return 0.0, 0.0
    slope = float(weight @ ((when - middle) * (offset - mean))) / spread
    return mean - slope * middle, slope


@dataclass(slots=True)
class OtherClock:
    """Hold the samples of one other clock: the best of each half second, over the last minute.

    max_drift_ratio: maximum rate at which one clock may gain on the other.
    resets: how often the samples contradicted each other (a clock was stepped, a machine slept) and
        were deleted.
    """

    max_drift_ratio: float
    samples: list[Sample] = field(default_factory=list)
    resets: int = 0

    def add(self, sample: Sample) -> None:
        """Store a sample if it is the best of its half second."""
        samples = self.samples
        if samples and sample.at_ns <= samples[-1].at_ns:
            return
        while samples and samples[0].at_ns < sample.at_ns - WINDOW_NS:
            samples.pop(0)
        if samples:
            low, high = bounds(samples, sample.at_ns, max_drift_ratio=self.max_drift_ratio)
            if sample.offset_ns - sample.half_ns > high or sample.offset_ns + sample.half_ns < low:
                self.resets += 1
                samples.clear()
        if samples and sample.at_ns // BIN_NS == samples[-1].at_ns // BIN_NS:
            if sample.half_ns > samples[-1].half_ns:
                return
            samples.pop()
        samples.append(sample)

    def estimate(self, at_ns: int) -> OffsetEstimate | None:
        """Estimate the other clock at `at_ns` of ours; None before the first sample."""
        if not self.samples:
            return None
        low, high = bounds(self.samples, at_ns, max_drift_ratio=self.max_drift_ratio)
        newest = self.samples[-1]
        fitted, slope = fit_drift(self.samples)
        slope = min(max(slope, -self.max_drift_ratio), self.max_drift_ratio)
        guess = newest.offset_ns + round(fitted + slope * (at_ns - newest.at_ns))
        guess = min(max(guess, low), max(low, high))
        return OffsetEstimate(at_ns, guess, max(guess - low, high - guess, 0), slope)
