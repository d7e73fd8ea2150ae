"""Convert a sheet target to the goal of the next command, and synchronize the two arms.

Poses are 4x4 matrices in the world frame.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import sqrt

import numpy as np

from flexsheet.messages.types import SheetTarget, SheetTrajectory
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.models.motion import (
    SheetBounds,
    SheetMotion,
    extrapolate,
    follow_trajectory,
    measure_length,
)
from flexsheet.nodes.models.rigid import transform, vector_from_rotation

# The joints can follow these accelerations (J6 22 rad/s^2, J2 9.4 rad/s^2).  With larger
# accelerations, each arm would overshoot a target that reverses by a different distance.
FOLLOW_BOUNDS = SheetBounds(
    speed_m_per_s=0.22,
    acceleration_m_per_s2=2.6,
    turn_rad_per_s=2.5,
    turn_acceleration_rad_per_s2=16.0,
    stretch_rate_per_s=0.1,
    stretch_acceleration_per_s2=1.0,
)

SLOW_FROM_RAD = 0.05
"""The lead (rad) above which an arm slows down so that the other arm can catch up. The lead is the
rotation by which an arm is ahead on the path to the target. `SKEW_LENGTH_M` converts an offset to a
rotation."""

WAIT_FROM_RAD = 0.12
"""The lead (rad) at which an arm waits for the other arm (see `SLOW_FROM_RAD`). At a lead of 0.2
rad, the limiter stops both arms."""

MAX_PREDICTION_S = 0.15
"""The maximum time (s) by which a target's timestamp may be in the future. This time is the sum of
the prediction horizon and a margin."""

MAX_TRAJECTORY_S = 0.4
"""The maximum duration (s) of a trajectory that an arm follows even if no new message arrives."""

SKEW_LENGTH_M = 0.25
"""The offset (m) between two sheet poses that has the same weight as a rotation of 1 rad."""


@dataclass(frozen=True, slots=True)
class Goal:
    """The desired motion of the sheet at the time when a command takes effect.

    overdue_s: time since the next target was due; negative before that time.
    planner_ended: whether the planner, or a node that provides its inputs, has ended.
    """

    motion: SheetMotion
    overdue_s: float
    planner_ended: bool = False


def extrapolate_goal(
    motion: SheetMotion, ahead_s: float, overdue_s: float, *, max_extrapolation_s: float
) -> Goal:
    """Return the goal that results from extrapolating the motion of a target by `ahead_s`.

    overdue_s: time since the next target was due.
    max_extrapolation_s: maximum of the absolute extrapolation time.

    If `ahead_s` exceeds this maximum, or if the target's timestamp is too far in the future,
    `Goal.overdue_s` is increased. The arm then stops as it does when targets are overdue.
    """
    carried_s = min(max(ahead_s, -max_extrapolation_s), max_extrapolation_s)
    late_s = max(overdue_s, ahead_s - max_extrapolation_s, -ahead_s - MAX_PREDICTION_S)
    return Goal(extrapolate(motion, carried_s), late_s)


@dataclass(frozen=True, slots=True)
class GoalTiming:
    """The time constants for computing the sheet motion at the time when a command takes effect.

    servo_lag_s: time from the transmission of a command until it takes effect.
    target_period_s: time from the arrival of a target until the next target is due.
    max_extrapolation_s: maximum time by which a target is extrapolated.
    """

    servo_lag_s: float
    target_period_s: float
    max_extrapolation_s: float


def find_trajectory(target: SheetTarget) -> SheetTrajectory | None:
    """Return the trajectory of a target, or None if there is no permitted trajectory.

    The speeds and decelerations of a permitted trajectory are within FOLLOW_BOUNDS. Its duration is
    at most MAX_TRAJECTORY_S.
    """
    trajectory, bounds = target.trajectory, FOLLOW_BOUNDS
    if trajectory is None or not trajectory.brake_s > 0.0 <= trajectory.keep_s:
        return None
    speed, turn = measure_length(target.twist_world[:3]), measure_length(target.twist_world[3:])
    is_allowed = (
        trajectory.keep_s + trajectory.brake_s <= MAX_TRAJECTORY_S
        and speed <= min(bounds.speed_m_per_s, bounds.acceleration_m_per_s2 * trajectory.brake_s)
        and turn
        <= min(bounds.turn_rad_per_s, bounds.turn_acceleration_rad_per_s2 * trajectory.brake_s)
    )
    return trajectory if is_allowed else None


def make_goal(
    target: SheetTarget,
    *,
    received_ns: int,
    now_ns: int,
    timing: GoalTiming,
    trajectory: SheetTrajectory | None = None,
    planner_ended: bool = False,
) -> Goal:
    """Compute the goal, the desired sheet motion when a command that is sent now takes effect.

    target: desired sheet motion at an earlier or later time.
    received_ns, now_ns: arrival time of the target, and present time.
    trajectory: motion after the target, from `find_trajectory`. None if the other arm does not
        follow the same trajectory; the target is then extrapolated with constant velocity.

    With a trajectory, the next target is overdue when the trajectory has ended. Without a
    trajectory, it is overdue one target period after the arrival of the last target.
    """
    motion = SheetMotion(target.world_from_sheet, target.twist_world, target.stretch_ratio, 0.0)
    ahead_s = (now_ns - target.valid_at_ns) * 1e-9 + timing.servo_lag_s
    if trajectory is not None:
        keep_s, brake_s = trajectory.keep_s, trajectory.brake_s
        at_s = max(ahead_s, -timing.max_extrapolation_s)
        return Goal(
            follow_trajectory(motion, at_s, keep_s=keep_s, brake_s=brake_s),
            max(ahead_s - keep_s - brake_s, -ahead_s - MAX_PREDICTION_S),
        )
    overdue_s = (now_ns - received_ns) * 1e-9 - timing.target_period_s
    goal = extrapolate_goal(
        motion, ahead_s, overdue_s, max_extrapolation_s=timing.max_extrapolation_s
    )
    return replace(goal, planner_ended=planner_ended)


def compute_sync_factor(
    own_edge: Floats, other_edge: Floats, target: Floats, *, left: bool
) -> float:
    """Return the speed factor (0..1) with which this arm lets the other arm catch up.

    own_edge, other_edge: world poses (4, 4) of the commanded edges.
    target: target pose world_from_sheet (4, 4).
    left: whether this arm holds the left edge.

    If one bridge had a late control cycle, the sheet would be twisted. The arm that is ahead on the
    path to the target therefore slows down in proportion to its lead.
    """
    across = other_edge[:3, 3] - own_edge[:3, 3]
    half = (0.5 if left else -0.5) * sqrt(float(across @ across))
    own, other = _sheet_centre(own_edge, half), _sheet_centre(other_edge, -half)
    lead = _difference(other, own)
    lead_rad = sqrt(float(lead @ lead))
    if lead_rad <= SLOW_FROM_RAD:
        return 1.0
    remaining = _difference(own, target) + _difference(other, target)
    if float(lead @ remaining) <= 0.0:
        return 1.0
    return max(0.0, (WAIT_FROM_RAD - lead_rad) / (WAIT_FROM_RAD - SLOW_FROM_RAD))


def scale_speeds(bounds: SheetBounds, factor: float) -> SheetBounds:
    """Multiply the speed bounds by a factor, and leave the acceleration bounds unchanged."""
    if factor == 1.0:
        return bounds
    return replace(
        bounds,
        speed_m_per_s=factor * bounds.speed_m_per_s,
        turn_rad_per_s=factor * bounds.turn_rad_per_s,
        stretch_rate_per_s=factor * bounds.stretch_rate_per_s,
    )


def _sheet_centre(edge: Floats, along_m: float) -> Floats:
    """Return the pose (4, 4) of the sheet's centre from the pose (4, 4) of an edge.

    along_m: coordinate of the sheet's centre on the x axis of the edge.
    """
    return transform(edge[:3, :3], edge[:3, 3] + along_m * edge[:3, 0])


def _difference(pose: Floats, other: Floats) -> Floats:
    """Return the difference of two poses as a vector (6,).

    The elements are the rotation vector (rad), and the offset divided by SKEW_LENGTH_M.
    """
    rotation = vector_from_rotation(other[:3, :3] @ pose[:3, :3].T)
    return np.concatenate([rotation, (other[:3, 3] - pose[:3, 3]) / SKEW_LENGTH_M])
