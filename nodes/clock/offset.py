"""What another clock shows, from pings: bounds that hold, and a best guess between them.

A ping gives four stamps: sent (t1, ours), received (t2, theirs), answered (t3, theirs), heard (t4,
ours).  No message arrives before it was sent, so the other clock, less ours, was at t1 at most
t2 - t1, and at t4 at least t3 - t4; how far it has moved in between, the two clocks' rates bound.
(Cristian 1989, "Probabilistic clock synchronization"; Marzullo 1984 on intersecting intervals.)
Nothing else is assumed of the network: not that both ways take equally long, not how delays vary.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

WINDOW_NS = 60_000_000_000
BIN_NS = 500_000_000
FIT_SPAN_NS = 5_000_000_000


@dataclass(frozen=True, slots=True)
class Sample:
    """The other clock less ours at `at_ns` of ours: within `half_ns` of `offset_ns`."""

    at_ns: int
    offset_ns: int
    half_ns: int


@dataclass(frozen=True, slots=True)
class Estimate:
    """The other clock less ours at `at_ns` of ours, surely within `half_ns` of `offset_ns`.

    drift_ratio: by how much the other one gains on ours, best guess.
    """

    at_ns: int
    offset_ns: int
    half_ns: int
    drift_ratio: float


def sample_of(t1: int, t2: int, t3: int, t4: int, *, max_drift_ratio: float) -> Sample | None:
    """One ping's sample, stamps in ns as in the module's text; None for an impossible one.

    max_drift_ratio: by how much one clock may gain on the other.
    """
    away_ns, there_ns = t4 - t1, t3 - t2
    moved_ns = max_drift_ratio * away_ns
    delay_ns = away_ns - there_ns
    if away_ns < 0 or there_ns < 0 or delay_ns < -moved_ns:
        return None
    # Twice the offset, to stay with whole numbers.
    twice = (t2 - t1) + (t3 - t4)
    return Sample((t1 + t4) // 2, twice // 2, int(max(0, delay_ns) / 2 + moved_ns / 2) + 1)


def bounds(samples: list[Sample], at_ns: int, *, max_drift_ratio: float) -> tuple[int, int]:
    """Between what the offset (ns) must be at `at_ns`: each sample's bounds, widened by its age.

    The lower one lies above the upper one where the samples contradict each other.
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


def drift_of(samples: list[Sample]) -> tuple[float, float]:
    """Line through samples: offset (ns, at the newest one, less its own) and slope.

    Least squares; samples count by the inverse square of their bounds, so that those whose ping met
    no queue decide.  Slope and offset are 0 while the samples span less than FIT_SPAN_NS.
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
    """The samples of one other clock: of each half second the best, over the last minute.

    max_drift_ratio: by how much one clock may gain on the other.
    resets: how often the samples contradicted each other (a clock was stepped, a machine slept),
    and were forgotten.
    """

    max_drift_ratio: float
    samples: list[Sample] = field(default_factory=list)
    resets: int = 0

    def take(self, sample: Sample) -> None:
        """Keep a sample, if it is the best of its half second."""
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

    def estimate(self, at_ns: int) -> Estimate | None:
        """Where the other clock is at `at_ns` of ours; None before the first sample."""
        if not self.samples:
            return None
        low, high = bounds(self.samples, at_ns, max_drift_ratio=self.max_drift_ratio)
        newest = self.samples[-1]
        fitted, slope = drift_of(self.samples)
        slope = min(max(slope, -self.max_drift_ratio), self.max_drift_ratio)
        guess = newest.offset_ns + round(fitted + slope * (at_ns - newest.at_ns))
        guess = min(max(guess, low), max(low, high))
        return Estimate(at_ns, guess, max(guess - low, high - guess, 0), slope)
