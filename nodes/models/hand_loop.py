"""Predict whether the sampled control loop of sheet and hand is stable.

A finger pushes into the sheet. The planner moves the sheet along its normal by `slope` times the
measured depth. If slope > 0, the sheet moves away from the finger (a retreat, for soft objects). If
slope < 0, the sheet moves towards the finger (an advance, for stiff objects). The camera measures
the depth once per period T. The sheet follows after a delay, so the control loop can add energy.
The hand has the mass m, damping b and stiffness k. The sheet has the stiffness ks. With the depth x
and the sheet's offset s:

    m x'' + b x' + k x + ks (x - s) = 0
    s(t) = slope (y_j + y'_j (t - j T - delay))

Here y_j is the filtered depth of measurement j, and y'_j is the filter's estimate of the rate of
the depth. The alpha-beta filter estimates the depth and its rate. The filtered depth does not lag
behind a depth with a constant rate. A linear map, which is computed exactly, describes how the
state changes over one period. The control loop is stable if all eigenvalues of this map are inside
the unit circle.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import scipy

from flexsheet.nodes.arrays import Floats

MIN_DECAY_PER_S = 0.5
"""The minimum decay rate (1/s) of the slowest mode. If the rate is lower, the control loop counts
as unstable."""

GAIN_MARGIN = 1.5
DELAY_MARGIN_S = 0.02
"""The additional delay (s) that the control loop must tolerate. `GAIN_MARGIN` is the factor of
additional gain that the loop must tolerate."""

MAX_SLOPE = 20.0
"""The upper limit of the slope (sheet offset divided by finger depth) in the search for the
critical slope. The planner uses much smaller slopes."""

SLOPES = 32
"""The number of slopes at which the search evaluates the decay rate."""

DELAYS_S = (0.02, 0.04, 0.06, 0.08, 0.1, 0.13, 0.17)
BANDWIDTHS_RAD_PER_S = (4.5, 5.5, 6.5, 8.0, 10.0, 12.5, 16.0, 20.0)
SHEET_STIFFNESSES_N_PER_M = (50.0, 120.0, 300.0)
"""The sheet stiffnesses (N/m) for which `OffsetBoundsTable` contains bounds. The other two axes of
the table are `DELAYS_S` and `BANDWIDTHS_RAD_PER_S`."""

FILTER_DAMPING_RATIO = 0.5
"""The damping ratio of the filter that smooths the finger's depth. If the ratio were larger, the
control loop would become unstable at smaller sheet offsets."""


@dataclass(frozen=True, slots=True)
class Hand:
    """The mechanical impedance of a hand at the fingertip, along the sheet's normal."""

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
"""Models of hands that cover the range of the measurements in the literature.

Sources: Hajian and Howe 1997 (finger), Lakie 2015 (wrist, from its resonance at 6 to 12 Hz), and
Mussa-Ivaldi, Hogan and Bizzi 1985 (arm). The damping ratios of wrist and arm are 0.15 to 0.4.
"""

LIMITING_HANDS = tuple(hand for name, hand in HANDS.items() if "low damping" in name)
"""The hands with low damping. They determine the bounds on the slope, because their control loops
become unstable at smaller slopes than those of other hands."""


@dataclass(frozen=True, slots=True)
class SampledLoop:
    """The timing and the depth filter of the control loop from finger depth to sheet offset.

    period_s: time between two measurements.
    delay_s: time from a measurement until the sheet reaches the position computed from it.
    bandwidth_rad_per_s: natural frequency of the depth filter; infinite if there is no filter.
    lead_s: time by which the filtered depth is extrapolated with its estimated rate.
    """

    period_s: float
    delay_s: float
    bandwidth_rad_per_s: float = math.inf
    lead_s: float = 0.0


def compute_filter_gains(bandwidth_rad_per_s: float, step_s: float) -> tuple[float, float]:
    """Return the gains alpha and beta of the filter that smooths the finger's depth.

    The filter has the poles of a continuous filter with the damping ratio `FILTER_DAMPING_RATIO`.
    If the bandwidth is infinite, the filter returns the measured depth and the rate of its last
    change.

    step_s: time between two measurements.
    """
    if math.isinf(bandwidth_rad_per_s):
        return 1.0, 1.0
    angle = bandwidth_rad_per_s * step_s
    radius = math.exp(-FILTER_DAMPING_RATIO * angle)
    turn = math.sqrt(1.0 - FILTER_DAMPING_RATIO**2) * angle
    return 1.0 - radius**2, 1.0 + radius**2 - 2.0 * radius * math.cos(turn)


def make_loop_matrices(
    hand: Hand, loop: SampledLoop, *, sheet_stiffness_n_per_m: float, slopes: Floats
) -> Floats:
    """Return the state-transition matrices (k, n, n) of the control loop over one sampling period.

    slopes (k,): sheet offset divided by the measured finger depth, one value for each matrix.

    The n states are the depth and its rate, the filter's estimates of both, and recent sheet
    offsets from newest to oldest. The offsets include the last two that the sheet has reached, and
    all that it has not reached yet.
    """
    whole, fraction = divmod(loop.delay_s / loop.period_s, 1.0)
    waiting = int(whole) + 1
    size = 5 + waiting
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

    # `measure` adds a measurement: it updates the filter and extends the state by an offset.
    measure = np.zeros((len(slopes), size + 1, size))
    measure[:, :2, :2] = np.eye(2)
    alpha, beta = compute_filter_gains(loop.bandwidth_rad_per_s, loop.period_s)
    measure[:, 2, [0, 2, 3]] = alpha, 1.0 - alpha, (1.0 - alpha) * loop.period_s
    measure[:, 3, [0, 2, 3]] = beta / loop.period_s, -beta / loop.period_s, 1.0 - beta
    measure[:, 4] = slopes[:, None] * (measure[:, 2] + loop.lead_s * measure[:, 3])
    measure[:, 5:, 4:] = np.eye(1 + waiting)

    # `move` moves the hand for one period: for its `fraction` with the oldest offset, then with
    # the next one.  The oldest offset took effect (1 - fraction) T before this period.  The rate
    # of an offset is its difference from the preceding offset.
    start = np.zeros((4, size + 1))
    start[:2, :2] = np.eye(2)
    start[2, -2:] = 2.0 - fraction, fraction - 1.0
    start[3, -2:] = np.array([1.0, -1.0]) / loop.period_s
    between = first @ start
    between[2:] = 0.0
    between[2, -3] = 1.0
    between[3, -3:-1] = np.array([1.0, -1.0]) / loop.period_s
    move = np.zeros((size, size + 1))
    move[:2] = (second @ between)[:2]
    move[2:, 2:-1] = np.eye(size - 2)
    return np.asarray(move @ measure)


def compute_decays_per_s(
    hand: Hand, loop: SampledLoop, *, sheet_stiffness_n_per_m: float, slopes: Floats
) -> Floats:
    """Return the decay rates (k,), 1/s, of the slowest mode of the control loop for k slopes (k,).

    A slope is the offset of the sheet along its normal, divided by the finger's depth. A negative
    rate means that the mode grows.
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
    """Return the slope at which the control loop of sheet and hand becomes unstable.

    The slope is the offset of the sheet along its normal, divided by the finger's depth. The result
    is the smallest magnitude of an unstable slope, and is at most `max_slope`.

    towards_finger: whether to search the negative slopes, at which the sheet moves towards the
        finger.

    The decay rate of the slowest mode is interpolated between slopes on a grid. Slopes above the
    result are not evaluated, even if the loop is stable at some of them.
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
    """The maximum slopes at which the control loop of the sheet is stable with every hand.

    The slope is the offset of the sheet along its normal, divided by the finger's depth.

    bandwidths_rad_per_s (f,): bandwidths of the filter of the measured depth, ascending.
    sheet_stiffnesses_n_per_m (k,): stiffnesses of the sheet under the finger.
    max_advances, max_retreats (f, k): maximum slopes of motion towards the finger and away from it.
    """

    bandwidths_rad_per_s: Floats
    sheet_stiffnesses_n_per_m: Floats
    max_advances: Floats
    max_retreats: Floats

    def max_advance(self, bandwidth_rad_per_s: float, stiffnesses_n_per_m: Floats) -> Floats:
        """Return the maximum stable slopes (n,) of sheet motion towards the finger.

        A slope is the offset of the sheet along its normal, divided by the finger's depth.

        stiffnesses_n_per_m (n,): stiffnesses of the sheet.
        """
        return self._interpolate(self.max_advances, bandwidth_rad_per_s, stiffnesses_n_per_m)

    def max_retreat(self, bandwidth_rad_per_s: float, stiffnesses_n_per_m: Floats) -> Floats:
        """Return the maximum stable slopes (n,) of sheet motion away from the finger.

        A slope is the offset of the sheet along its normal, divided by the finger's depth.

        stiffnesses_n_per_m (n,): stiffnesses of the sheet.
        """
        return self._interpolate(self.max_retreats, bandwidth_rad_per_s, stiffnesses_n_per_m)

    def _interpolate(
        self, slopes: Floats, bandwidth_rad_per_s: float, stiffnesses_n_per_m: Floats
    ) -> Floats:
        row = int(np.argmin(np.abs(self.bandwidths_rad_per_s - bandwidth_rad_per_s)))
        return np.asarray(
            np.interp(stiffnesses_n_per_m, self.sheet_stiffnesses_n_per_m, slopes[row])
        )


@dataclass(frozen=True, slots=True)
class OffsetBoundsTable:
    """A table of the maximum stable slopes (`OffsetBounds`) for d delays of the control loop.

    The slope is the offset of the sheet along its normal, divided by the finger's depth. The table
    is valid for one camera period.

    delays_s (d,): delays from the measurement of a depth to the motion of the sheet.
    bandwidths_rad_per_s (f,): bandwidths of the filter of the measured depth.
    sheet_stiffnesses_n_per_m (k,): stiffnesses of the sheet under the finger.
    max_advances, max_retreats (d, f, k): maximum slopes towards the finger and away from it.
    """

    delays_s: Floats
    bandwidths_rad_per_s: Floats
    sheet_stiffnesses_n_per_m: Floats
    max_advances: Floats
    max_retreats: Floats

    def at_delay(self, delay_s: float) -> OffsetBounds:
        """Return the stability bounds for the smallest delay in the table of at least `delay_s`.

        The bounds are 0 if all delays of the table are smaller.
        """
        row = int(np.searchsorted(self.delays_s, delay_s - 1e-9))
        axes = self.bandwidths_rad_per_s, self.sheet_stiffnesses_n_per_m
        if row == len(self.delays_s):
            none = np.zeros(self.max_advances.shape[1:])
            return OffsetBounds(*axes, none, none)
        return OffsetBounds(*axes, self.max_advances[row], self.max_retreats[row])


def compute_offset_bounds(period_s: float, *, advance_limit: float) -> OffsetBoundsTable:
    """Compute the maximum slopes at which the control loop of the sheet is stable with all hands.

    The slope is the offset of the sheet along its normal, divided by the finger's depth. In an
    advance, the sheet moves towards the finger. In a retreat, it moves away.

    period_s: period of the camera.
    advance_limit: upper limit of the slopes of an advance.

    The loop must be stable even if its delay is larger by `DELAY_MARGIN_S` and its gain by the
    factor `GAIN_MARGIN`. For an advance, the critical slope is divided by the gain margin. A
    retreat slope cannot exceed 1, so for a retreat the sheet's stiffness is multiplied by the gain
    margin instead.
    """
    shape = len(DELAYS_S), len(BANDWIDTHS_RAD_PER_S), len(SHEET_STIFFNESSES_N_PER_M)
    advances, retreats = np.empty(shape), np.empty(shape)
    for at in np.ndindex(shape):
        loop = SampledLoop(period_s, DELAYS_S[at[0]] + DELAY_MARGIN_S, BANDWIDTHS_RAD_PER_S[at[1]])
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
        np.array(BANDWIDTHS_RAD_PER_S),
        np.array(SHEET_STIFFNESSES_N_PER_M),
        # Bounds must not rise with stiffness or delay, so that they are valid between grid points.
        _descend(advances),
        _descend(retreats),
    )


def _descend(slopes: Floats) -> Floats:
    """Reduce stability bounds so that they never increase with the delay or the sheet's stiffness.

    slopes (d, f, k): maximum stable slopes for d delays, f bandwidths and k stiffnesses.
    """
    result = np.minimum.accumulate(np.minimum.accumulate(slopes, axis=0), axis=2)
    return np.asarray(result)
