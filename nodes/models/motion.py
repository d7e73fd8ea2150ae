"""Bound motion: follow a moving target without lag and without jumps.

On the target the follower stays on it, since the target's velocity is fed forward.  Off the target
it approaches with bounded speed and acceleration, and without overshoot if the target moves at
constant velocity.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import sqrt

import numpy as np
from numpy.typing import NDArray

from flexsheet.nodes.models.rigid import (
    moved,
    rotation_from_vector,
    skew,
    transform,
    vector_from_rotation,
)

Floats = NDArray[np.float64]

BRAKE_FRACTION = 1.0 / 3.0
"""Fraction of the acceleration for braking onto the target; the rest follows the target."""


def closing_speed(distance: Floats, deceleration: Floats | float, step_s: float) -> Floats:
    """Return the largest speeds at which a point can still stop within these distances (>= 0).

    In discrete time it moves by speed * step_s per step and slows by deceleration * step_s after
    each. It arrives exactly, from w^2/(2 a) + w dt/2 = distance; the last distance takes one step.
    """
    half = 0.5 * deceleration * step_s
    speed = np.sqrt(half * half + 2.0 * deceleration * distance) - half
    return np.minimum(speed, distance / step_s)


def follow(
    error: Floats,
    velocity: Floats,
    target_velocity: Floats,
    *,
    max_speed: float,
    max_acceleration: float,
    step_s: float,
) -> tuple[Floats, Floats]:
    """Step a vector (n,) towards a target that moves with `target_velocity`.

    error: target at the end of the step minus the current point.

    Returns the displacement over the step and the velocity after it.  Neither the mean speed of the
    step nor the velocity changes faster than `max_acceleration`.
    """
    target_velocity = _clamp_length(target_velocity, max_speed)
    wanted = desired_velocity(
        error,
        target_velocity,
        max_speed=max_speed,
        max_acceleration=max_acceleration,
        step_s=step_s,
    )
    distance = _length(error - target_velocity * step_s)
    reach = (1.0 - BRAKE_FRACTION) * max_acceleration * step_s
    mean = velocity + _clamp_length(wanted - velocity, reach)
    landed = _length(error - mean * step_s) <= 1e-12 + 1e-9 * distance
    settles = _length(target_velocity - mean) <= BRAKE_FRACTION * max_acceleration * (
        step_s * (1.0 + 1e-9)
    )
    return mean * step_s, target_velocity if landed and settles else mean


def desired_velocity(
    error: Floats,
    target_velocity: Floats,
    *,
    max_speed: float,
    max_acceleration: float,
    step_s: float,
) -> Floats:
    """Return the velocity (n,) that approaches the target as fast as it can still stop there."""
    offset = error - target_velocity * step_s
    distance = _length(offset)
    if distance == 0.0:
        return _clamp_length(target_velocity, max_speed)
    brake = BRAKE_FRACTION * max_acceleration
    speed = float(closing_speed(np.array(distance), brake, step_s))
    return _clamp_length(target_velocity + offset * (speed / distance), max_speed)


def _length(vector: Floats) -> float:
    """Return the norm of a short vector, in a fifth of NumPy's time."""
    return sqrt(float(vector @ vector))


def _clamp_length(vector: Floats, longest: float) -> Floats:
    """Shorten a vector to the length `longest`, unless it is shorter."""
    length = _length(vector)
    return vector if length <= longest else vector * (longest / length)


@dataclass(frozen=True, slots=True)
class SheetMotion:
    """Hold the sheet's pose, twist (m/s, rad/s), stretch ratio and its rate (1/s)."""

    world_from_sheet: Floats
    twist_world: Floats
    stretch_ratio: float
    stretch_rate_per_s: float


@dataclass(frozen=True, slots=True)
class SheetBounds:
    """Hold the limits of the motion of the sheet's centre, orientation and stretch."""

    speed_m_per_s: float
    acceleration_m_per_s2: float
    turn_rad_per_s: float
    turn_acceleration_rad_per_s2: float
    stretch_rate_per_s: float
    stretch_acceleration_per_s2: float


@dataclass(frozen=True, slots=True)
class EdgeBound:
    """Hold the maximum speed of any point of a clamped edge, and the edge's half length.

    Both translation and rotation of the sheet are scaled alike.  If an arm limited its edge alone,
    joint by joint, it would leave the sheet's path and move away from the other arm.
    """

    speed_m_per_s: float
    reach_m: float

    def speed_scale(self, speed_m_per_s: float, turn_rad_per_s: float) -> float:
        """Return the factor (0..1) on linear and angular speed that keeps the edges within the
        limit."""
        edge = speed_m_per_s + self.reach_m * turn_rad_per_s
        return 1.0 if edge <= self.speed_m_per_s else self.speed_m_per_s / edge


def follow_sheet(
    now: SheetMotion, target: SheetMotion, *, bounds: SheetBounds, edges: EdgeBound, step_s: float
) -> SheetMotion:
    """Return the sheet `step_s` (> 0) later, moved towards `target`, which holds at the step's
    end."""
    away = target.world_from_sheet[:3, 3] - now.world_from_sheet[:3, 3]
    rotation = vector_from_rotation(
        target.world_from_sheet[:3, :3] @ now.world_from_sheet[:3, :3].T
    )
    speed, turn_speed = (
        _length(
            desired_velocity(
                error,
                velocity,
                max_speed=max_speed,
                max_acceleration=max_acceleration,
                step_s=step_s,
            )
        )
        for error, velocity, max_speed, max_acceleration in (
            (away, target.twist_world[:3], bounds.speed_m_per_s, bounds.acceleration_m_per_s2),
            (
                rotation,
                target.twist_world[3:],
                bounds.turn_rad_per_s,
                bounds.turn_acceleration_rad_per_s2,
            ),
        )
    )
    scale = edges.speed_scale(speed, turn_speed)
    shift, linear = follow(
        away,
        now.twist_world[:3],
        target.twist_world[:3],
        max_speed=bounds.speed_m_per_s if scale == 1.0 else scale * speed,
        max_acceleration=bounds.acceleration_m_per_s2,
        step_s=step_s,
    )
    turn, angular = follow(
        rotation,
        now.twist_world[3:],
        target.twist_world[3:],
        max_speed=bounds.turn_rad_per_s if scale == 1.0 else scale * turn_speed,
        max_acceleration=bounds.turn_acceleration_rad_per_s2,
        step_s=step_s,
    )
    growth, rate = follow(
        np.array([target.stretch_ratio - now.stretch_ratio]),
        np.array([now.stretch_rate_per_s]),
        np.array([target.stretch_rate_per_s]),
        max_speed=bounds.stretch_rate_per_s,
        max_acceleration=bounds.stretch_acceleration_per_s2,
        step_s=step_s,
    )
    pose = transform(
        rotation_from_vector(turn) @ now.world_from_sheet[:3, :3],
        now.world_from_sheet[:3, 3] + shift,
    )
    return SheetMotion(
        _orthonormal(pose),
        np.concatenate([linear, angular]),
        now.stretch_ratio + float(growth[0]),
        float(rate[0]),
    )


def coast_sheet(now: SheetMotion, *, bounds: SheetBounds, step_s: float) -> SheetMotion:
    """Return the sheet `step_s` later while it stops as fast as the bounds allow."""
    linear = _decelerate(now.twist_world[:3], bounds.acceleration_m_per_s2 * step_s)
    angular = _decelerate(now.twist_world[3:], bounds.turn_acceleration_rad_per_s2 * step_s)
    rate = _decelerate(
        np.array([now.stretch_rate_per_s]), bounds.stretch_acceleration_per_s2 * step_s
    )
    twist = np.concatenate([linear, angular])
    return SheetMotion(
        _orthonormal(moved(now.world_from_sheet, twist, step_s)),
        twist,
        now.stretch_ratio + float(rate[0]) * step_s,
        float(rate[0]),
    )


def extrapolate(motion: SheetMotion, duration_s: float) -> SheetMotion:
    """Extrapolate the motion with its twist and rate by `duration_s` (of either sign)."""
    return replace(
        motion,
        world_from_sheet=moved(motion.world_from_sheet, motion.twist_world, duration_s),
        stretch_ratio=motion.stretch_ratio + motion.stretch_rate_per_s * duration_s,
    )


def _decelerate(velocity: Floats, change: float) -> Floats:
    speed = _length(velocity)
    return np.zeros_like(velocity) if speed <= change else velocity * (1.0 - change / speed)


def _orthonormal(pose: Floats) -> Floats:
    """Remove the rotation's rounding error (Gram-Schmidt on x, then y)."""
    x_axis = pose[:3, 0] / _length(pose[:3, 0])
    y_axis = pose[:3, 1] - x_axis * (x_axis @ pose[:3, 1])
    y_axis = y_axis / _length(y_axis)
    return transform(np.column_stack([x_axis, y_axis, skew(x_axis) @ y_axis]), pose[:3, 3])
