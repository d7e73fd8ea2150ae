"""Limit every command to an arm.

Joint speed, joint acceleration and tool speed are clamped. The tool speed is the maximum speed of
the flange and of the clamped edge of the sheet. Limits of the sheet, of the distance between the
flanges and of the workspace cannot be clamped. If such a limit is violated, a check returns a text
that describes the violation, and the caller stops the arm. Joint angles are arrays (6,), in
radians. Poses are 4x4 matrices, in metres.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.models.motion import BRAKE_FRACTION, closing_speed
from flexsheet.nodes.models.rigid import angle_between
from flexsheet.nodes.models.sheet.tension import edge_force_n

TOOL_SPEED_FRACTION = 0.82
"""The fraction of the maximum tool speed that commands may use. The margin is necessary because the
actual speed of an arm fluctuates (benchmarks/limiter.py)."""

MAX_TRAVEL_STEP_S = 0.01
"""The maximum duration (s) of the motion in one command. After a longer gap between two commands,
the arm would otherwise exceed the tool speed."""

MIN_STEP_S, MAX_STEP_S = 1e-6, 10.0
"""The minimum and the maximum duration (s) of a command. If the duration were shorter, rounding
errors would dominate the computed speeds."""

LENGTH_TOLERANCE_M = 1e-7
MIN_BLEND = 0.02
"""The minimum weight of the desired velocity in a blend with a decelerating velocity."""

ROUNDING_FACTOR = 1.0 + 1e-6
"""The factor by which computed values may exceed a limit because of rounding errors."""

RANGE_BRAKE_FRACTION = 2.0 / 3.0
"""The fraction of a joint's maximum acceleration that is reserved for stopping within its range."""


@dataclass(frozen=True, slots=True)
class JointLimits:
    """The limits of the joints and of the tool speed.

    tool_points: function from joint angles (6,) rad to n points (n, 3), m, on the tool.
    max_tool_speed: maximum speed of the tool points, m/s.
    """

    min_rad: Floats
    max_rad: Floats
    speed_rad_per_s: Floats
    acceleration_rad_per_s2: Floats
    tool_points: Callable[[Floats], Floats]
    max_tool_speed: float


@dataclass(frozen=True, slots=True)
class SheetLimits:
    """The limits of the sheet and of the two arms that hold the sheet."""

    width_m: float
    height_m: float
    thickness_m: float
    young_modulus_pa: float
    max_length_m: float
    max_edge_force_n: float
    max_twist_rad: float
    min_flange_distance_m: float
    workspace_min_m: Floats
    workspace_max_m: Floats
    compliance_m_per_n: float = 0.0
    """The sum of the compliances of both flanges in the direction of the sheet's tension."""

    def sheet_length_m(self, edge_distance_m: float) -> float:
        """Return the length (m) of the stretched sheet between two arms that its tension bends.

        edge_distance_m: distance between the sheet's edges if the arms were rigid.
        """
        if self.compliance_m_per_n == 0.0 or not self.width_m < edge_distance_m < math.inf:
            return edge_distance_m
        # Bracketing secant method (Illinois algorithm).  Importing `scipy.optimize` instead would
        # double the start time of a bridge.
        low_m, low_excess_m = self.width_m, self.width_m - edge_distance_m
        high_m = edge_distance_m
        high_excess_m = self.compliance_m_per_n * self.force_n(high_m)
        while True:
            slope = (high_excess_m - low_excess_m) / (high_m - low_m)
            length_m = high_m - high_excess_m / slope
            excess_m = length_m + self.compliance_m_per_n * self.force_n(length_m) - edge_distance_m
            # The slope of the excess is at least 1, so the excess bounds the error of the length.
            if abs(excess_m) <= LENGTH_TOLERANCE_M:
                return length_m
            if excess_m * high_excess_m > 0.0:
                low_excess_m *= 0.5
            else:
                low_m, low_excess_m = high_m, high_excess_m
            high_m, high_excess_m = length_m, excess_m

    def force_n(self, length_m: float) -> float:
        """Return the force (N) on each edge of a sheet of the given length."""
        return edge_force_n(length_m / self.width_m, self)


def limit_velocity(
    joints_rad: Floats,
    velocity: Floats,
    goal_rad: Floats,
    goal_velocity: Floats,
    *,
    limits: JointLimits,
    step_s: float,
) -> Floats:
    """Return joint velocities (6,) rad/s for the next step towards a moving goal.

    velocity: result of the previous call.
    goal_rad: joint angles (6,) of the goal at the end of the step. If they are not finite, the arm
        decelerates.

    For any goal, joints_rad + result * step_s is within the joint ranges. Joint and tool speeds are
    within their limits. If the tool would be too fast, the result is a blend of the desired
    velocity and a decelerating velocity. The acceleration exceeds its limit only if the joint range
    or the tool speed requires it. Raises ValueError if `step_s` is not between MIN_STEP_S and
    MAX_STEP_S.
    """
    if not MIN_STEP_S <= step_s <= MAX_STEP_S:
        raise ValueError(
            f"step_s is {step_s} s, but a command covers {MIN_STEP_S} to {MAX_STEP_S} s"
        )
    if np.isfinite(goal_rad).all() and np.isfinite(goal_velocity).all():
        desired = find_desired_velocity(
            joints_rad, goal_rad, goal_velocity, limits=limits, step_s=step_s
        )
    else:
        desired = decelerate(velocity, limits=limits, step_s=step_s)
    desired = clamp_to_range(joints_rad, velocity, desired, limits=limits, step_s=step_s)
    here = limits.tool_points(joints_rad)
    max_shift_m = limits.max_tool_speed * min(step_s, MAX_TRAVEL_STEP_S)

    def shifts(candidate: Floats) -> Floats:
        return limits.tool_points(joints_rad + candidate * step_s) - here

    fast = shifts(desired)
    if _longest(fast) <= max_shift_m:
        return desired
    slower = clamp_to_range(
        joints_rad,
        velocity,
        decelerate(velocity, limits=limits, step_s=step_s),
        limits=limits,
        step_s=step_s,
    )
    slow = shifts(slower)
    if (shift_m := _longest(slow)) <= max_shift_m:
        blend = _find_blend(slow, fast, max_shift_m)
        while blend > MIN_BLEND:
            between = slower + blend * (desired - slower)
            if _longest(shifts(between)) <= max_shift_m:
                return between
            blend *= 0.8
        return slower
    while shift_m > max_shift_m:
        slower = slower * (0.99 * max_shift_m / shift_m)
        shift_m = _longest(shifts(slower))
    return slower


def find_desired_velocity(
    joints_rad: Floats,
    goal_rad: Floats,
    goal_velocity: Floats,
    *,
    limits: JointLimits,
    step_s: float,
) -> Floats:
    """Return the joint velocities (6,) rad/s that reach a moving goal without overshoot."""
    max_speed = limits.speed_rad_per_s
    goal = _clamp(goal_rad, limits.min_rad, limits.max_rad)
    along = _clamp(goal_velocity, -max_speed, max_speed)
    offset = goal - along * step_s - joints_rad
    brake = BRAKE_FRACTION * limits.acceleration_rad_per_s2
    closing = np.sign(offset) * closing_speed(np.abs(offset), brake, step_s)
    return _clamp(along + closing, -max_speed, max_speed)


def clamp_to_range(
    joints_rad: Floats, velocity: Floats, desired: Floats, *, limits: JointLimits, step_s: float
) -> Floats:
    """Limit velocities (6,) rad/s so that the joints can stop within their ranges.

    velocity: velocities of the previous step.

    The result respects the maximum acceleration.
    """
    max_acceleration = limits.acceleration_rad_per_s2
    up = _find_max_speed(limits.max_rad - joints_rad, max_acceleration, step_s)
    down = _find_max_speed(joints_rad - limits.min_rad, max_acceleration, step_s)
    reach = max_acceleration * step_s
    result = _clamp(_clamp(desired, -down, up), velocity - reach, velocity + reach)
    lower = (limits.min_rad - joints_rad) / step_s
    upper = (limits.max_rad - joints_rad) / step_s
    # Outside the range, where a motion may start, only motion back into it is allowed.
    return _clamp(result, np.minimum(lower, 0.0), np.maximum(upper, 0.0))


def _clamp(values: Floats, lowest: Floats, highest: Floats) -> Floats:
    """Limit array elements to a range; for six elements, numpy.clip takes five times as long."""
    return np.minimum(np.maximum(values, lowest), highest)


def _find_max_speed(distance: Floats, acceleration: Floats, step_s: float) -> Floats:
    return closing_speed(np.maximum(distance, 0.0), RANGE_BRAKE_FRACTION * acceleration, step_s)


def decelerate(velocity: Floats, *, limits: JointLimits, step_s: float) -> Floats:
    """Return the joint velocities (6,) rad/s after one step of deceleration.

    All velocities are reduced by the same factor.
    """
    stopping_s = float(np.max(np.abs(velocity) / limits.acceleration_rad_per_s2))
    return velocity * max(0.0, 1.0 - step_s / stopping_s) if stopping_s > 0.0 else velocity


def bound_step(
    joints_rad: Floats,
    desired_rad: Floats,
    *,
    limits: JointLimits,
    step_s: float,
) -> Floats:
    """Return the joint angles (6,) rad that one step towards `desired_rad` can reach.

    Joint speeds and tool speed limit the step. If the limits permit the whole step, the same object
    `desired_rad` is returned. Otherwise, the result is between `joints_rad` and `desired_rad`. If
    `desired_rad` is not finite, the result is `joints_rad`.
    """
    if desired_rad is joints_rad:
        return desired_rad
    step = desired_rad - joints_rad
    ratio = float((np.abs(step) / (limits.speed_rad_per_s * step_s)).max())
    if not np.isfinite(ratio):
        return joints_rad
    if ratio > ROUNDING_FACTOR:
        step = step / ratio
    here = limits.tool_points(joints_rad)
    max_shift_m = limits.max_tool_speed * min(step_s, MAX_TRAVEL_STEP_S)
    shift = _longest(
        limits.tool_points(joints_rad + step if ratio > ROUNDING_FACTOR else desired_rad) - here
    )
    if ratio <= ROUNDING_FACTOR and shift <= ROUNDING_FACTOR * max_shift_m:
        return desired_rad
    while shift > max_shift_m:
        step = step * (0.99 * max_shift_m / shift)
        shift = _longest(limits.tool_points(joints_rad + step) - here)
    result: Floats = joints_rad + step
    return result


def _longest(shifts: Floats) -> float:
    return math.sqrt(float((shifts * shifts).sum(axis=1).max()))


def _find_blend(slow: Floats, fast: Floats, max_shift_m: float) -> float:
    """Return the maximum weight of `fast` in a blend of two sets of displacements.

    slow, fast: displacements (n, 3), m, of n points.

    The blend is slow + weight * (fast - slow). In the blend, no point moves by more than
    `max_shift_m`.
    """
    change = fast - slow
    square, mixed = (change * change).sum(axis=1), (slow * change).sum(axis=1)
    left = (slow * slow).sum(axis=1) - max_shift_m * max_shift_m
    root = np.sqrt(mixed * mixed - square * np.minimum(left, 0.0))
    return float(((root - mixed) / np.maximum(square, 1e-30)).min()) * (1.0 - 1e-3)


def measure_twist_rad(edge: Floats, other_edge: Floats) -> float:
    """Return the twist (rad): the angle of the rotation between the poses (4, 4) of two edges."""
    # The Frobenius norm of the difference of two rotations is sqrt(8) sin(angle / 2).
    apart = (other_edge[:3, :3] - edge[:3, :3]).ravel()
    return 2.0 * math.asin(min(1.0, math.sqrt(float(apart @ apart) / 8.0)))


def check_sheet(edge: Floats, other_edge: Floats, *, left: bool, limits: SheetLimits) -> str | None:
    """Describe the limit that the sheet violates; return None if no limit is violated.

    edge, other_edge: world poses (4, 4) of this arm's edge and of the other edge.
    left: whether this arm holds the left edge.

    Values that are not finite violate every limit.
    """
    across = other_edge[:3, 3] - edge[:3, 3]
    distance = limits.sheet_length_m(math.sqrt(float(across @ across)))
    if not distance <= limits.max_length_m:
        return (
            f"the sheet is {distance * 1e3:.1f} mm long, maximum {limits.max_length_m * 1e3:.1f} mm"
        )
    force = limits.force_n(distance)
    if not force <= limits.max_edge_force_n:
        return f"the edge force is {force:.1f} N, maximum {limits.max_edge_force_n:.1f} N"
    twist = measure_twist_rad(edge, other_edge)
    if not twist <= limits.max_twist_rad:
        return (
            f"the edges are rotated by {np.degrees(twist):.1f} degrees relative to each other, "
            f"maximum {np.degrees(limits.max_twist_rad):.1f}"
        )
    skew_rad = angle_between(across if left else -across, edge[:3, 0])
    if not skew_rad <= limits.max_twist_rad:
        return (
            f"the edge is skewed by {np.degrees(skew_rad):.1f} degrees relative to the "
            f"line between both edges, maximum {np.degrees(limits.max_twist_rad):.1f}"
        )
    return None


def check_flange(
    flange_world: Floats, other_flange: Floats, limits: SheetLimits, *, slack_m: float = 0.0
) -> str | None:
    """Describe the violated limit of workspace or flange distance; return None if there is none.

    flange_world, other_flange: world poses (4, 4) of this arm's flange and of the other flange.
    slack_m: tolerance on both limits.

    Values that are not finite violate both limits.
    """
    position = flange_world[:3, 3]
    lowest, highest = limits.workspace_min_m - slack_m, limits.workspace_max_m + slack_m
    if not ((position >= lowest) & (position <= highest)).all():
        x, y, z = position * 1e3
        return f"the flange at ({x:.0f}, {y:.0f}, {z:.0f}) mm is outside the workspace"
    apart = other_flange[:3, 3] - position
    distance = math.sqrt(float(apart @ apart))
    if not distance >= limits.min_flange_distance_m - slack_m:
        return (
            f"the flanges are {distance * 1e3:.0f} mm apart, "
            f"minimum {limits.min_flange_distance_m * 1e3:.0f} mm"
        )
    return None


def check_tracking_error(
    joints_rad: Floats, measured_rad: Floats, max_error_rad: float
) -> str | None:
    """Describe the tracking error if it exceeds its maximum; otherwise return None.

    joints_rad, measured_rad: commanded and measured joint angles (6,).
    """
    lag = float(np.abs(joints_rad - measured_rad).max())
    if not lag <= max_error_rad:
        return f"the arm trails its command by {np.degrees(lag):.1f} degrees"
    return None
