"""Estimate the offset of another clock from pings, with guaranteed bounds.

A ping has four timestamps. The ping is sent at t1 on the local clock and received at t2 on the
other clock. The reply is sent at t3 on the other clock and received at t4 on the local clock. A
message always arrives after it was sent. The offset is the time of the other clock minus the time
of the local clock. It is therefore at most t2 - t1 at time t1, and at least t3 - t4 at time t4.
Between both times, the offset changes at most by the maximum drift. No assumption about the
network's delays is necessary.

Sources: Cristian 1989, "Probabilistic clock synchronization"; Marzullo 1984 on the intersection of
intervals.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

WINDOW_NS = 60_000_000_000
BIN_NS = 500_000_000
FIT_SPAN_NS = 5_000_000_000


@dataclass(frozen=True, slots=True)
class Sample:
    """A measurement of the clock offset by one ping, with its bounds.

    At the time `at_ns` of the local clock, the time of the other clock minus the time of the local
    clock was offset_ns +- half_ns.
    """

    at_ns: int
    offset_ns: int
    half_ns: int


@dataclass(frozen=True, slots=True)
class OffsetEstimate:
    """An estimate of a clock offset: the time of another clock minus the time of the local clock.

    drift_ratio: estimated rate of change of the offset.

    At the time `at_ns` of the local clock, the guaranteed bounds are offset_ns +- half_ns.
    """

    at_ns: int
    offset_ns: int
    half_ns: int
    drift_ratio: float


def make_sample(t1: int, t2: int, t3: int, t4: int, *, max_drift_ratio: float) -> Sample | None:
    """Compute the clock offset from a ping's four timestamps (ns).

    t1, t4: times on the local clock when the ping was sent and when its reply was received.
    t2, t3: times on the other clock when the ping was received and when its reply was sent.
    max_drift_ratio: maximum relative drift of the clocks.

    Returns None if the timestamps are inconsistent.
    """
    round_trip_ns, remote_ns = t4 - t1, t3 - t2
    drift_ns = max_drift_ratio * round_trip_ns
    delay_ns = round_trip_ns - remote_ns
    if round_trip_ns < 0 or remote_ns < 0 or delay_ns < -drift_ns:
        return None
    doubled_offset_ns = (t2 - t1) + (t3 - t4)
    return Sample(
        (t1 + t4) // 2, doubled_offset_ns // 2, int(max(0, delay_ns) / 2 + drift_ns / 2) + 1
    )


def compute_bounds(samples: list[Sample], at_ns: int, *, max_drift_ratio: float) -> tuple[int, int]:
    """Return the lower and the upper bound of the clock offset (ns) at time `at_ns`.

    max_drift_ratio: maximum relative drift of the clocks.

    Every sample limits the offset. If the samples are inconsistent, the lower bound is above the
    upper bound.
    """
    errors = [one.half_ns + int(max_drift_ratio * abs(at_ns - one.at_ns)) + 1 for one in samples]
    low = max(one.offset_ns - error for one, error in zip(samples, errors, strict=True))
    high = min(one.offset_ns + error for one, error in zip(samples, errors, strict=True))
    return low, high


def fit_drift(samples: list[Sample]) -> tuple[float, float]:
    """Fit the drift: fit a line to the clock offsets by weighted least squares.

    Returns the value of the line at the newest sample, minus the offset of this sample (ns), and
    the slope of the line. The weights are the inverse squares of the half-widths of the samples'
    bounds. Pings that waited in a queue have wide bounds and therefore small weights. Both results
    are 0 if the samples span less than `FIT_SPAN_NS`.
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
    """The offset measurements of another clock during the last minute.

    Only the most accurate sample of each half second is stored.

    max_drift_ratio: maximum relative drift of the clocks.
    resets: number of times when all samples were deleted because a new sample was inconsistent with
        them. This happens, for example, after a clock was set.
    """

    max_drift_ratio: float
    samples: list[Sample] = field(default_factory=list)
    resets: int = 0

    def add(self, sample: Sample) -> None:
        """Store a new sample, unless a stored sample of the same half second is more accurate."""
        samples = self.samples
        if samples and sample.at_ns <= samples[-1].at_ns:
            return
        while samples and samples[0].at_ns < sample.at_ns - WINDOW_NS:
            samples.pop(0)
        if samples:
            low, high = compute_bounds(samples, sample.at_ns, max_drift_ratio=self.max_drift_ratio)
            if sample.offset_ns - sample.half_ns > high or sample.offset_ns + sample.half_ns < low:
                self.resets += 1
                samples.clear()
        if samples and sample.at_ns // BIN_NS == samples[-1].at_ns // BIN_NS:
            if sample.half_ns > samples[-1].half_ns:
                return
            samples.pop()
        samples.append(sample)

    def estimate(self, at_ns: int) -> OffsetEstimate | None:
        """Estimate the clock offset at time `at_ns` of the local clock.

        Returns None before the first sample.
        """
        if not self.samples:
            return None
        low, high = compute_bounds(self.samples, at_ns, max_drift_ratio=self.max_drift_ratio)
        newest = self.samples[-1]
        fitted, slope = fit_drift(self.samples)
        slope = min(max(slope, -self.max_drift_ratio), self.max_drift_ratio)
        guess = newest.offset_ns + round(fitted + slope * (at_ns - newest.at_ns))
        guess = min(max(guess, low), max(low, high))
        return OffsetEstimate(at_ns, guess, max(guess - low, high - guess, 0), slope)
