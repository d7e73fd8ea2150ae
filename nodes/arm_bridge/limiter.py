"""What stands between any command and an arm.

Speed, acceleration and tool speed are clamped, so that the arm merely gets there later; what no
clamp makes safe (a sheet overstretched or twisted, flanges too near, a place outside the workspace)
is named, and the caller stops the arm.  Plain functions: joints (6,) rad, poses 4x4, metres.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from flexsheet.nodes.models.motion import BRAKE_FRACTION, closing_speed
from flexsheet.nodes.models.rigid import angle_between
from flexsheet.nodes.models.sheet import edge_force_n

Floats = NDArray[np.float64]

TOOL_SPEED_SHARE = 0.82
"""Share of the tool speed that commands may use: an arm that is sent to a place at a time, and not
a velocity, ripples about its mean speed.  Most where wrist joints turn fast against one another:
each ripples by its own speed, of which little is left at the tool (benchmarks/limiter.py)."""

EVEN_STEP_S = 0.01
"""After a longer gap than that a command leads no further than in this time: what a late one makes
up at once, the arm would do faster than it may."""

SHORTEST_STEP_S, LONGEST_STEP_S = 1e-6, 10.0
"""What a command may cover; speeds over less are rounding errors, and over more no control."""

LEAST_SHARE = 0.02
"""Below this share of the way from braking to the wanted velocity it is not worth looking."""

WITHIN = 1.0 + 1e-6
"""A step that is longer than its limit by rounding errors is within it."""

RELAXED_M, RELAXED_RAD = 0.002, 0.01
"""By how much a limit that is exceeded at the start of a motion may be exceeded further: servos
ripple, and measurements are noisy."""

RANGE_BRAKE_SHARE = 2.0 / 3.0
"""Share of a joint's acceleration kept for stopping short of the end of its range."""


@dataclass(frozen=True, slots=True)
class JointLimits:
    """Range, speed and acceleration of each joint, (6,)."""

    lowest_rad: Floats
    highest_rad: Floats
    speed_rad_per_s: Floats
    acceleration_rad_per_s2: Floats


@dataclass(frozen=True, slots=True)
class SheetLimits:
    """What the sheet and the two arms that share it may suffer."""

    width_m: float
    height_m: float
    thickness_m: float
    young_modulus_pa: float
    longest_m: float
    max_edge_force_n: float
    max_twist_rad: float
    min_flange_distance_m: float
    workspace_min_m: Floats
    workspace_max_m: Floats

    def force_n(self, length_m: float) -> float:
        """Force on each edge of a sheet of that length."""
        return edge_force_n(
            length_m / self.width_m,
            young_modulus_pa=self.young_modulus_pa,
            width_m=self.width_m,
            height_m=self.height_m,
            thickness_m=self.thickness_m,
        )


def limited(
    joints_rad: Floats,
    velocity: Floats,
    goal_rad: Floats,
    goal_velocity: Floats,
    *,
    tool_points: Callable[[Floats], Floats],
    max_tool_speed: float,
    limits: JointLimits,
    step_s: float,
) -> Floats:
    """Joint velocities (6,) for the next step towards a goal that moves: the whole limiter.

    goal_rad is where the joints should be at the end of the step; a goal that is not finite brakes.
    velocity is what the last call returned.  tool_points: joints to points (n, 3) in metres, none
    of which may exceed `max_tool_speed`.  Whatever the goal, joints_rad + result * step_s is in
    range, and speed and tool speed are kept.  So is the acceleration, unless range or tool speed
    could not be kept otherwise.  ValueError when step_s is no duration of a step.
    """
    if not SHORTEST_STEP_S <= step_s <= LONGEST_STEP_S:
        raise ValueError(
            f"a step of {step_s} s: a command covers {SHORTEST_STEP_S} to {LONGEST_STEP_S} s"
        )
    if np.isfinite(goal_rad).all() and np.isfinite(goal_velocity).all():
        wanted = towards(joints_rad, goal_rad, goal_velocity, limits=limits, step_s=step_s)
    else:
        wanted = braked(velocity, limits=limits, step_s=step_s)
    return with_tool_speed(
        joints_rad,
        velocity,
        within_range(joints_rad, velocity, wanted, limits=limits, step_s=step_s),
        tool_points=tool_points,
        max_tool_speed=max_tool_speed,
        limits=limits,
        step_s=step_s,
    )


def towards(
    joints_rad: Floats,
    goal_rad: Floats,
    goal_velocity: Floats,
    *,
    limits: JointLimits,
    step_s: float,
) -> Floats:
    """The velocities (6,) one would like: onto the goal at once, or closing in to stop there."""
    fastest = limits.speed_rad_per_s
    goal = _between(goal_rad, limits.lowest_rad, limits.highest_rad)
    along = _between(goal_velocity, -fastest, fastest)
    offset = goal - along * step_s - joints_rad
    brake = BRAKE_FRACTION * limits.acceleration_rad_per_s2
    closing = np.sign(offset) * closing_speed(np.abs(offset), brake, step_s)
    return _between(along + closing, -fastest, fastest)


def within_range(
    joints_rad: Floats, velocity: Floats, wanted: Floats, *, limits: JointLimits, step_s: float
) -> Floats:
    """The wanted velocities, clamped to acceleration and so that every joint can stop in range."""
    sharpest = limits.acceleration_rad_per_s2
    up = _room(limits.highest_rad - joints_rad, sharpest, step_s)
    down = _room(joints_rad - limits.lowest_rad, sharpest, step_s)
    reach = sharpest * step_s
    result = _between(_between(wanted, -down, up), velocity - reach, velocity + reach)
    lowest = (limits.lowest_rad - joints_rad) / step_s
    highest = (limits.highest_rad - joints_rad) / step_s
    # Outside the range (as after a start there) the way back is open, the way on is not.
    return _between(result, np.minimum(lowest, 0.0), np.maximum(highest, 0.0))


def _between(values: Floats, lowest: Floats, highest: Floats) -> Floats:
    """As numpy.clip, at a fifth of its cost for six numbers."""
    return np.minimum(np.maximum(values, lowest), highest)


def _room(distance: Floats, acceleration: Floats, step_s: float) -> Floats:
    return closing_speed(np.maximum(distance, 0.0), RANGE_BRAKE_SHARE * acceleration, step_s)


def braked(velocity: Floats, *, limits: JointLimits, step_s: float) -> Floats:
    """Velocities (6,) one step nearer to rest: all joints slow in proportion, along their path."""
    stopping_s = float(np.max(np.abs(velocity) / limits.acceleration_rad_per_s2))
    return velocity * max(0.0, 1.0 - step_s / stopping_s) if stopping_s > 0.0 else velocity


def with_tool_speed(
    joints_rad: Floats,
    velocity: Floats,
    wanted: Floats,
    *,
    tool_points: Callable[[Floats], Floats],
    max_tool_speed: float,
    limits: JointLimits,
    step_s: float,
) -> Floats:
    """The wanted velocities (6,), held back until no tool point moves faster than it may.

    What lies between the wanted velocities and those of braking is within acceleration and range
    like both; the nearest to the wanted ones is taken.  If even braking is too fast, it is cut: the
    speed limit comes before the smooth ride.
    """
    here = tool_points(joints_rad)
    furthest = max_tool_speed * min(step_s, EVEN_STEP_S)

    def shifts(candidate: Floats) -> Floats:
        return tool_points(joints_rad + candidate * step_s) - here

    fast = shifts(wanted)
    if _longest(fast) <= furthest:
        return wanted
    slower = within_range(
        joints_rad,
        velocity,
        braked(velocity, limits=limits, step_s=step_s),
        limits=limits,
        step_s=step_s,
    )
    slow = shifts(slower)
    if (way := _longest(slow)) <= furthest:
        share = _share_within(slow, fast, furthest)
        while share > LEAST_SHARE:
            between = slower + share * (wanted - slower)
            if _longest(shifts(between)) <= furthest:
                return between
            share *= 0.8
        return slower
    while way > furthest:
        slower = slower * (0.99 * furthest / way)
        way = _longest(shifts(slower))
    return slower


def bounded_step(
    joints_rad: Floats,
    wanted_rad: Floats,
    *,
    tool_points: Callable[[Floats], Floats],
    max_tool_speed: float,
    limits: JointLimits,
    step_s: float,
) -> Floats:
    """Joints (6,) no further from `joints_rad` than joint speeds and tool speed allow in a step.

    Returns `wanted_rad` itself where it is near enough, else joints on the straight line to it; the
    present joints where it is not finite.
    """
    if wanted_rad is joints_rad:
        return wanted_rad
    step = wanted_rad - joints_rad
    ratio = float((np.abs(step) / (limits.speed_rad_per_s * step_s)).max())
    if not np.isfinite(ratio):
        return joints_rad
    if ratio > WITHIN:
        step = step / ratio
    here = tool_points(joints_rad)
    furthest = max_tool_speed * min(step_s, EVEN_STEP_S)
    shift = _longest(tool_points(joints_rad + step if ratio > WITHIN else wanted_rad) - here)
    if ratio <= WITHIN and shift <= WITHIN * furthest:
        return wanted_rad
    while shift > furthest:
        step = step * (0.99 * furthest / shift)
        shift = _longest(tool_points(joints_rad + step) - here)
    result: Floats = joints_rad + step
    return result


def _longest(shifts: Floats) -> float:
    """The length of the longest of vectors (n, 3)."""
    return math.sqrt(float((shifts * shifts).sum(axis=1).max()))


def _share_within(slow: Floats, fast: Floats, furthest: float) -> float:
    """How far to go from shifts (n, 3) that are within a length to such that are not.

    As if they went straight over; from |slow + share (fast - slow)| = furthest.
    """
    change = fast - slow
    square, mixed = (change * change).sum(axis=1), (slow * change).sum(axis=1)
    left = (slow * slow).sum(axis=1) - furthest * furthest
    root = np.sqrt(mixed * mixed - square * np.minimum(left, 0.0))
    return float(((root - mixed) / np.maximum(square, 1e-30)).min()) * (1.0 - 1e-3)


def relaxed_limits(
    limits: SheetLimits,
    flange: Floats,
    edge: Floats,
    other_flange: Floats,
    other_edge: Floats,
    *,
    left: bool,
) -> SheetLimits:
    """The limits, widened where the arms (world poses) stand beyond them or nearly so.

    A motion that begins beyond a limit may lead back, and no further.  `left`: as `sheet_trouble`.
    """
    across = other_edge[:3, 3] - edge[:3, 3]
    apart = other_flange[:3, 3] - flange[:3, 3]
    longest_m = math.sqrt(float(across @ across)) + RELAXED_M
    skewed = angle_between(across if left else -across, edge[:3, 0])
    return replace(
        limits,
        longest_m=max(limits.longest_m, longest_m),
        max_edge_force_n=max(limits.max_edge_force_n, limits.force_n(longest_m)),
        max_twist_rad=max(
            limits.max_twist_rad, max(skewed, _twist(edge, other_edge)) + RELAXED_RAD
        ),
        min_flange_distance_m=min(
            limits.min_flange_distance_m, math.sqrt(float(apart @ apart)) - RELAXED_M
        ),
        workspace_min_m=np.minimum(limits.workspace_min_m, flange[:3, 3] - RELAXED_M),
        workspace_max_m=np.maximum(limits.workspace_max_m, flange[:3, 3] + RELAXED_M),
    )


def _twist(edge: Floats, other_edge: Floats) -> float:
    """Angle between two edges' orientations, rad."""
    # Of two rotations' difference the Frobenius norm is sqrt(8) sin(half the angle between them).
    apart = (other_edge[:3, :3] - edge[:3, :3]).ravel()
    return 2.0 * math.asin(min(1.0, math.sqrt(float(apart @ apart) / 8.0)))


def sheet_trouble(
    edge: Floats, other_edge: Floats, *, left: bool, limits: SheetLimits
) -> str | None:
    """What is wrong with the sheet between two edges (world poses), or None.

    edge is this arm's, and `left` says which side that is.  What is not finite is wrong.
    """
    across = other_edge[:3, 3] - edge[:3, 3]
    distance = math.sqrt(float(across @ across))
    if not distance <= limits.longest_m:
        return f"sheet of {distance * 1e3:.1f} mm, at most {limits.longest_m * 1e3:.1f} mm"
    force = limits.force_n(distance)
    if not force <= limits.max_edge_force_n:
        return f"edge force {force:.1f} N, at most {limits.max_edge_force_n:.1f} N"
    twist = _twist(edge, other_edge)
    if not twist <= limits.max_twist_rad:
        return (
            f"edges turned by {np.degrees(twist):.1f} degrees to one another, "
            f"at most {np.degrees(limits.max_twist_rad):.1f}"
        )
    skewed = angle_between(across if left else -across, edge[:3, 0])
    if not skewed <= limits.max_twist_rad:
        return (
            f"edge skewed by {np.degrees(skewed):.1f} degrees to the line between both, "
            f"at most {np.degrees(limits.max_twist_rad):.1f}"
        )
    return None


def place_trouble(
    flange_world: Floats, other_flange: Floats, limits: SheetLimits, *, slack_m: float = 0.0
) -> str | None:
    """Whether a flange (world pose) leaves the workspace or comes too near to the other arm's.

    slack_m: by how much both limits may be overstepped.  What is not finite is trouble.
    """
    place = flange_world[:3, 3]
    lowest, highest = limits.workspace_min_m - slack_m, limits.workspace_max_m + slack_m
    if not ((place >= lowest) & (place <= highest)).all():
        x, y, z = place * 1e3
        return f"flange at ({x:.0f}, {y:.0f}, {z:.0f}) mm is outside the workspace"
    apart = other_flange[:3, 3] - place
    distance = math.sqrt(float(apart @ apart))
    if not distance >= limits.min_flange_distance_m - slack_m:
        return (
            f"flanges {distance * 1e3:.0f} mm apart, "
            f"at least {limits.min_flange_distance_m * 1e3:.0f} mm"
        )
    return None


def step_trouble(joints_rad: Floats, measured_rad: Floats, largest_rad: float) -> str | None:
    """Whether a command (6,) is further from the measured joints than an arm may trail."""
    lag = float(np.abs(joints_rad - measured_rad).max())
    if not lag <= largest_rad:
        return f"the arm trails its command by {np.degrees(lag):.1f} degrees"
    return None
