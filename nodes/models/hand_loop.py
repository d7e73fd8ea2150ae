"""Predict whether a hand that touches the sheet is stable, from the sampled closed loop.

A finger pushes into the sheet.  The planner moves the sheet along its normal by `slope` times the
measured depth.  If slope > 0, it moves away from the finger (a retreat, for soft objects).  If
slope < 0, it moves towards the finger (an advance, for stiff ones).  The camera measures the depth
once per period T.  The sheet follows after a delay, so it can add energy.  The hand has the mass m,
damping b and stiffness k, the sheet the stiffness ks.  With the depth x and the sheet's offset s:

    m x'' + b x' + k x + ks (x - s) = 0
    s(t) = slope (y_j + y'_j (t - j T - delay))

Here y_j is the low-pass filtered depth x(j T) of measurement j, and y'_j is its rate.  The state
changes over one period by an exact linear map.  The loop is stable if all eigenvalues of this map
are inside the unit circle.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from flexsheet.nodes.arrays import Floats

MIN_DECAY_PER_S = 0.5
"""Minimum decay rate of the slowest mode at which the loop counts as stable."""

GAIN_MARGIN = 1.5
DELAY_MARGIN_S = 0.02
"""Required stability margins: factor on the gain, and additional delay (s)."""

MAX_SLOPE = 20.0
"""Upper limit of the search for the critical slope, far above any slope in use."""

SLOPES = 32
"""Number of slopes at which the search evaluates the decay rate."""

DELAYS_S = (0.02, 0.04, 0.06, 0.08, 0.1, 0.13, 0.17)
FILTERS_S = (0.03, 0.08, 0.16)
SHEET_STIFFNESSES_N_PER_M = (50.0, 120.0, 300.0)
"""Grid of `OffsetBoundsTable`: delays, filter time constants and stiffnesses of the sheet."""


@dataclass(frozen=True, slots=True)
class Hand:
    """Mechanical impedance of a hand at the fingertip, along the sheet's normal."""

    mass_kg: float
    damping_ns_per_m: float
    stiffness_n_per_m: float


HANDS = {
    "relaxed finger": Hand(0.006, 0.8, 80.0),
    "light finger of low damping": Hand(0.006, 0.5, 50.0),
    "firm finger": Hand(0.006, 3.0, 400.0),
    "wrist": Hand(0.15, 2.0, 150.0),
    "wrist of low damping": Hand(0.15, 1.4, 100.0),
    "hand and forearm": Hand(0.5, 5.0, 200.0),
    "arm": Hand(1.0, 15.0, 600.0),
    "arm of low damping": Hand(1.5, 5.2, 100.0),
}
"""Hands that cover the range of measurements in the literature.

Finger: Hajian and Howe 1997.  Wrist: from its resonance of 6 to 12 Hz, Lakie 2015.  Arm:
Mussa-Ivaldi, Hogan and Bizzi 1985.  Damping ratios of wrist and arm: 0.15 to 0.4.
"""

LIMITING_HANDS = tuple(hand for name, hand in HANDS.items() if "low damping" in name)
"""Hands with low damping, which become unstable first and thus determine the bounds."""


@dataclass(frozen=True, slots=True)
class SampledLoop:
    """Timing and filter of the path from the finger's depth to the sheet's offset.

    period_s: time between two measurements.
    delay_s: time from a measurement until the sheet reaches the position that follows from it.
    filter_s: time constant of the depth's low-pass filter; 0 for none.
    lead_s: time by which the filtered depth is extrapolated (prediction); 0 for none.
    """

    period_s: float
    delay_s: float
    filter_s: float = 0.0
    lead_s: float = 0.0

    @property
    def filter_weight(self) -> float:
        """Return the weight of the newest depth in the low-pass filter."""
        return 1.0 - float(np.exp(-self.period_s / self.filter_s)) if self.filter_s > 0.0 else 1.0


def make_loop_matrices(
    hand: Hand, loop: SampledLoop, *, sheet_stiffness_n_per_m: float, slopes: Floats
) -> Floats:
    """Return the matrices (k, n, n) that map the state over one period, for slopes (k,).

    The state contains depth, speed and the newest two filtered depths.  The offsets that have not
    yet taken effect follow with their rates, newest first.
    """
    whole, fraction = divmod(loop.delay_s / loop.period_s, 1.0)
    waiting = int(whole) + 1
    size = 4 + 2 * waiting
    flow = np.zeros((4, 4))
    flow[0, 1] = flow[2, 3] = 1.0
    flow[1, :3] = (
        -(hand.stiffness_n_per_m + sheet_stiffness_n_per_m) / hand.mass_kg,
        -hand.damping_ns_per_m / hand.mass_kg,
        sheet_stiffness_n_per_m / hand.mass_kg,
    )
    first, second = scipy.linalg.expm(
        flow * loop.period_s * np.array([fraction, 1.0 - fraction])[:, None, None]
    )

    # `measure` adds a measurement: it extends the state by filtered depth, offset and its rate.
    measure = np.zeros((len(slopes), size + 2, size))
    measure[:, :2, :2] = np.eye(2)
    weight = loop.filter_weight
    measure[:, 2, 0], measure[:, 2, 2], measure[:, 3, 2] = weight, 1.0 - weight, 1.0
    rate = (measure[:, 2] - measure[:, 3]) / loop.period_s
    measure[:, 4] = slopes[:, None] * (measure[:, 2] + loop.lead_s * rate)
    measure[:, 5] = slopes[:, None] * rate
    measure[:, 6:, 4:] = np.eye(2 * waiting)

    # `move` moves the hand for one period: for its `fraction` with the oldest offset, then with
    # the next one.  The oldest offset took effect (1 - fraction) T before this period.
    start = np.zeros((4, size + 2))
    start[:2, :2] = np.eye(2)
    start[2, -2], start[2, -1], start[3, -1] = 1.0, (1.0 - fraction) * loop.period_s, 1.0
    between = first @ start
    between[2:] = 0.0
    between[2, -4] = between[3, -3] = 1.0
    move = np.zeros((size, size + 2))
    move[:2] = (second @ between)[:2]
    move[2:, 2:-2] = np.eye(size - 2)
    return np.asarray(move @ measure)


def compute_decays_per_s(
    hand: Hand, loop: SampledLoop, *, sheet_stiffness_n_per_m: float, slopes: Floats
) -> Floats:
    """Return the decay rate (k,) of the slowest mode for each slope, 1/s.

    A negative rate means that the mode grows.
    """
    matrices = make_loop_matrices(
        hand, loop, sheet_stiffness_n_per_m=sheet_stiffness_n_per_m, slopes=slopes
    )
    radii = np.abs(np.linalg.eigvals(matrices)).max(axis=1)
    return np.asarray(-np.log(np.maximum(radii, 1e-12)) / loop.period_s)


def compute_critical_slope(
    hand: Hand,
    loop: SampledLoop,
    *,
    sheet_stiffness_n_per_m: float,
    towards_finger: bool,
    max_slope: float = MAX_SLOPE,
) -> float:
    """Return the smallest magnitude of slope at which the loop is unstable, at most `max_slope`.

    The decay rate is interpolated between slopes on a grid.  Stability at even larger slopes is
    ignored.  towards_finger: search among negative slopes, which move the sheet to the finger.
    """
    magnitudes = np.concatenate([[0.0], np.geomspace(0.01 * max_slope, max_slope, SLOPES)])
    decays = compute_decays_per_s(
        hand,
        loop,
        sheet_stiffness_n_per_m=sheet_stiffness_n_per_m,
        slopes=-magnitudes if towards_finger else magnitudes,
    )
    unstable = np.flatnonzero(decays < MIN_DECAY_PER_S)
    if len(unstable) == 0:
        return max_slope
    at = int(unstable[0])
    if at == 0:
        return 0.0
    t = (decays[at - 1] - MIN_DECAY_PER_S) / (decays[at - 1] - decays[at])
    return float(magnitudes[at - 1] + t * (magnitudes[at] - magnitudes[at - 1]))


@dataclass(frozen=True, slots=True)
class OffsetBounds:
    """Maximum slopes at which every hand is stable; slope: sheet offset divided by finger depth.

    filters_s (f,): time constants of the depth's low-pass filter.
    sheet_stiffnesses_n_per_m (k,): stiffness of the sheet under the finger.
    max_advances, max_retreats (f, k): maximum slopes towards the finger and away from it.
    """

    filters_s: Floats
    sheet_stiffnesses_n_per_m: Floats
    max_advances: Floats
    max_retreats: Floats

    def max_advance(self, filter_s: float, stiffnesses_n_per_m: Floats) -> Floats:
        """Return the maximum slope (n,) towards the finger for stiffnesses (n,) of the sheet."""
        return self._interpolate(self.max_advances, filter_s, stiffnesses_n_per_m)

    def max_retreat(self, filter_s: float, stiffnesses_n_per_m: Floats) -> Floats:
        """Return the maximum slope (n,) away from the finger for stiffnesses (n,) of the sheet."""
        return self._interpolate(self.max_retreats, filter_s, stiffnesses_n_per_m)

    def _interpolate(self, slopes: Floats, filter_s: float, stiffnesses_n_per_m: Floats) -> Floats:
        row = int(np.argmin(np.abs(self.filters_s - filter_s)))
        return np.asarray(
            np.interp(stiffnesses_n_per_m, self.sheet_stiffnesses_n_per_m, slopes[row])
        )


@dataclass(frozen=True, slots=True)
class OffsetBoundsTable:
    """Table of `OffsetBounds` over delays (d,), for one camera period; the slopes are (d, f, k)."""

    delays_s: Floats
    filters_s: Floats
    sheet_stiffnesses_n_per_m: Floats
    max_advances: Floats
    max_retreats: Floats

    def at_delay(self, delay_s: float) -> OffsetBounds:
        """Return the bounds at the next longer delay of the table; beyond the last, bounds of 0."""
        row = int(np.searchsorted(self.delays_s, delay_s - 1e-9))
        axes = self.filters_s, self.sheet_stiffnesses_n_per_m
        if row == len(self.delays_s):
            none = np.zeros(self.max_advances.shape[1:])
            return OffsetBounds(*axes, none, none)
        return OffsetBounds(*axes, self.max_advances[row], self.max_retreats[row])


def compute_offset_bounds(period_s: float, *, advance_limit: float) -> OffsetBoundsTable:
    """Compute the maximum slopes at which every hand is stable with margins of gain and delay.

    For an advance, the gain margin divides the critical slope.  For a retreat, it multiplies the
    sheet's stiffness instead, because a slope cannot exceed 1.  The sheet never retreats by more
    than the finger moves.
    """
    shape = len(DELAYS_S), len(FILTERS_S), len(SHEET_STIFFNESSES_N_PER_M)
    advances, retreats = np.empty(shape), np.empty(shape)
    for at in np.ndindex(shape):
        loop = SampledLoop(period_s, DELAYS_S[at[0]] + DELAY_MARGIN_S, FILTERS_S[at[1]])
        stiffness = SHEET_STIFFNESSES_N_PER_M[at[2]]
        advances[at] = min(
            compute_critical_slope(
                hand,
                loop,
                sheet_stiffness_n_per_m=stiffness,
                towards_finger=True,
                max_slope=GAIN_MARGIN * advance_limit,
            )
            / GAIN_MARGIN
            for hand in LIMITING_HANDS
        )
        retreats[at] = min(
            compute_critical_slope(
                hand,
                loop,
                sheet_stiffness_n_per_m=GAIN_MARGIN * stiffness,
                towards_finger=False,
                max_slope=1.0,
            )
            for hand in LIMITING_HANDS
        )
    return OffsetBoundsTable(
        np.array(DELAYS_S),
        np.array(FILTERS_S),
        np.array(SHEET_STIFFNESSES_N_PER_M),
        # Bounds must not rise with stiffness or delay.  They then also hold between grid points.
        _descend(advances),
        _descend(retreats),
    )


def _descend(slopes: Floats) -> Floats:
    """Reduce slopes (d, f, k) so that they never rise with the delay or the stiffness."""
    result = np.minimum.accumulate(np.minimum.accumulate(slopes, axis=0), axis=2)
    return np.asarray(result)
