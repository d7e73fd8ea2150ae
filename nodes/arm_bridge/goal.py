"""Where a sheet target leads an arm, and how the two arms keep together on the way.

Plain functions: poses 4x4 in the world, turns in rad, lengths in m, times in s or ns as named.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import sqrt

import numpy as np
from numpy.typing import NDArray

from flexsheet.messages.types import SheetTarget
from flexsheet.nodes.models.motion import SheetBounds, SheetMotion, extrapolate
from flexsheet.nodes.models.rigid import transform, vector_from_rotation

Floats = NDArray[np.float64]

WAIT_FROM_RAD = 0.05
"""How far apart the edges may get before the arm that is ahead slows."""

WAIT_FULL_RAD = 0.12
"""How far apart they may get before it stands still; the limiter stops both at 0.2."""

FURTHEST_FUTURE_S = 0.15
"""No sheet is planned further ahead than fingertips say where they will be, and a little."""

SKEW_LENGTH_M = 0.25
"""An edge that far out of line with the other counts as one radian apart."""


@dataclass(frozen=True, slots=True)
class Goal:
    """The sheet's target at the moment when this command takes effect; age since it arrived."""

    motion: SheetMotion
    overdue_s: float


def goal_ahead(motion: SheetMotion, ahead_s: float, overdue_s: float, *, furthest_s: float) -> Goal:
    """The target carried on by `ahead_s` (of either sign), but no further than `furthest_s`.

    overdue_s: since its arrival, beyond when the next was due.  A target that would have to be
    carried on further is overdue by that much, however lately it has arrived; so is one for a
    moment too far ahead, whose clock cannot be right.
    """
    carried_s = min(max(ahead_s, -furthest_s), furthest_s)
    late_s = max(overdue_s, ahead_s - furthest_s, -ahead_s - FURTHEST_FUTURE_S)
    return Goal(extrapolate(motion, carried_s), late_s)


@dataclass(frozen=True, slots=True)
class Timing:
    """servo_lag_s: how long after it is sent a command acts.  target_period_s: after its arrival
    the next target is due.  furthest_s: how far a target may be carried on."""

    servo_lag_s: float
    target_period_s: float
    furthest_s: float


def goal_of(
    target: SheetTarget,
    *,
    received_ns: int,
    now_ns: int,
    timing: Timing,
) -> Goal:
    """A target's goal for a command that is sent now.

    A target states no rate of stretch, which the arms therefore trail.
    """
    motion = SheetMotion(target.world_from_sheet, target.twist_world, target.stretch_ratio, 0.0)
    ahead_s = (now_ns - target.valid_at_ns) * 1e-9 + timing.servo_lag_s
    overdue_s = (now_ns - received_ns) * 1e-9 - timing.target_period_s
    return goal_ahead(motion, ahead_s, overdue_s, furthest_s=timing.furthest_s)


def pace(own_edge: Floats, other_edge: Floats, target: Floats, *, left: bool) -> float:
    """Share (0..1) of its speed with which an arm goes on, so that it waits for one behind it.

    own_edge, other_edge: world poses of the commanded edges, the own one on the sheet's left or
    right; target: world_from_sheet.  Each bridge moves the sheet by its own cycle, and a cycle late
    on one side is a turn of the sheet's edges to one another.  The arm that leads on the way to the
    target slows in proportion to its lead.  What one arm leads the other trails, so they never wait
    for each other.
    """
    across = other_edge[:3, 3] - own_edge[:3, 3]
    half = (0.5 if left else -0.5) * sqrt(float(across @ across))
    own, other = _middle(own_edge, half), _middle(other_edge, -half)
    lead = _between(other, own)
    apart = sqrt(float(lead @ lead))
    if apart <= WAIT_FROM_RAD:
        return 1.0
    way = _between(own, target) + _between(other, target)
    if float(lead @ way) <= 0.0:
        return 1.0
    return max(0.0, (WAIT_FULL_RAD - apart) / (WAIT_FULL_RAD - WAIT_FROM_RAD))


def slowed(bounds: SheetBounds, share: float) -> SheetBounds:
    """The bounds with that share of their speeds; accelerations stay."""
    if share == 1.0:
        return bounds
    return replace(
        bounds,
        speed_m_per_s=share * bounds.speed_m_per_s,
        turn_rad_per_s=share * bounds.turn_rad_per_s,
        stretch_rate_per_s=share * bounds.stretch_rate_per_s,
    )


def _middle(edge: Floats, along_m: float) -> Floats:
    """The sheet's pose as one edge has it: its middle lies so far along the edge's x axis."""
    return transform(edge[:3, :3], edge[:3, 3] + along_m * edge[:3, 0])


def _between(pose: Floats, other: Floats) -> Floats:
    """The way (6,) from one pose to another: turn (rad), then shift over SKEW_LENGTH_M.

    The way back is the negative, exactly.
    """
    turn = vector_from_rotation(other[:3, :3] @ pose[:3, :3].T)
    return np.concatenate([turn, (other[:3, 3] - pose[:3, 3]) / SKEW_LENGTH_M])
