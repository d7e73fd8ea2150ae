"""Compute the motion of a point that follows a moving target with bounded speed and acceleration.

The velocity of the target is fed forward. Therefore a point that has reached the target does not
lag behind it. If the target's velocity is constant, the point approaches it without overshoot.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import sqrt

import numpy as np

from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.models.rigid import (
    moved,
    rotation_from_vector,
    transform,
    vector_from_rotation,
)

BRAKE_FRACTION = 1.0 / 3.0
"""The fraction of the maximum acceleration that is used to brake near the target.

The remaining acceleration is used to follow changes of the target's velocity.
"""


def closing_speed(distance: Floats | float, deceleration: Floats | float, step_s: float) -> Floats:
    """Return the maximum speeds (n,) at which a point can stop within distances (n,) >= 0 (m).

    In each step, the point moves by speed * step_s, and then its speed decreases by deceleration *
    step_s. The speed w is the solution of w^2/(2 a) + w dt/2 = distance, where a is the
    deceleration and dt is the step. The speed is at most distance / dt.
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
    """Compute one step of a point that follows a moving target with limited acceleration.

    Returns the displacement (n,) of the point in this step, and its velocity (n,) afterwards.

    error (n,): target at the end of the step minus the current point.
    velocity, target_velocity (n,): current velocities of the point and of the target.
    max_acceleration: limit of the change of the velocity between two steps, divided by `step_s`.
    """
    target_velocity = _clamp_length(target_velocity, max_speed)
    desired = desired_velocity(
        error,
        target_velocity,
        max_speed=max_speed,
        max_acceleration=max_acceleration,
        step_s=step_s,
    )
    distance = measure_length(error - target_velocity * step_s)
    reach = (1.0 - BRAKE_FRACTION) * max_acceleration * step_s
    mean = velocity + _clamp_length(desired - velocity, reach)
    landed = measure_length(error - mean * step_s) <= 1e-12 + 1e-9 * distance
    settles = measure_length(target_velocity - mean) <= BRAKE_FRACTION * max_acceleration * (
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
    """Return the fastest velocity (n,) at which a point can approach a moving target.

    With the available deceleration, the point must be able to reach the target at the target's
    velocity.

    error (n,): target at the end of the step minus the current point, in any unit u. Velocities
        have the unit u/s.
    """
    offset = error - target_velocity * step_s
    distance = measure_length(offset)
    if distance == 0.0:
        return _clamp_length(target_velocity, max_speed)
    brake = BRAKE_FRACTION * max_acceleration
    speed = float(closing_speed(distance, brake, step_s))
    return _clamp_length(target_velocity + offset * (speed / distance), max_speed)


def measure_length(vector: Floats) -> float:
    """Return the Euclidean norm of a small vector (n,), faster than `numpy.linalg.norm`."""
    return sqrt(float(vector @ vector))


def _clamp_length(vector: Floats, longest: float) -> Floats:
    length = measure_length(vector)
    return vector if length <= longest else vector * (longest / length)


@dataclass(frozen=True, slots=True)
class SheetMotion:
    """The state of the sheet's motion.

    world_from_sheet: pose (4, 4), m.
    twist_world: linear and angular velocity (6,), m/s and rad/s.
    """

    world_from_sheet: Floats
    twist_world: Floats
    stretch_ratio: float
    stretch_rate_per_s: float


@dataclass(frozen=True, slots=True)
class SheetBounds:
    """The limits of the motion of the sheet's centre, its orientation and its stretch."""

    speed_m_per_s: float
    acceleration_m_per_s2: float
    turn_rad_per_s: float
    turn_acceleration_rad_per_s2: float
    stretch_rate_per_s: float
    stretch_acceleration_per_s2: float


@dataclass(frozen=True, slots=True)
class EdgeBound:
    """A limit on the speed of all points of the sheet's clamped edges.

    reach_m: half the length of an edge.

    The sheet's translation and rotation are scaled by the same factor if the limit is exceeded. If
    each arm limited the speed of its edge separately, the distance between the edges would change.
    """

    speed_m_per_s: float
    reach_m: float

    def speed_scale(self, speed_m_per_s: float, turn_rad_per_s: float) -> float:
        """Return the factor (0 to 1) for the sheet's linear and angular speed.

        With this factor, no point of the clamped edges exceeds the maximum speed.
        """
        edge = speed_m_per_s + self.reach_m * turn_rad_per_s
        return 1.0 if edge <= self.speed_m_per_s else self.speed_m_per_s / edge


def follow_sheet(
    now: SheetMotion, target: SheetMotion, *, bounds: SheetBounds, edges: EdgeBound, step_s: float
) -> SheetMotion:
    """Return the sheet's motion after one step towards `target`.

    target: motion of the target at the end of the step.
    step_s: duration of the step.
    """
    away = target.world_from_sheet[:3, 3] - now.world_from_sheet[:3, 3]
    rotation = vector_from_rotation(
        target.world_from_sheet[:3, :3] @ now.world_from_sheet[:3, :3].T
    )
    speed, turn_speed = (
        measure_length(
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
    """Return the sheet's motion after one step of maximum deceleration.

    bounds: limits of the deceleration.
    step_s: duration of the step.
    """
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
    """Return the motion after a time `duration_s`, which may be negative, at constant velocity."""
    return replace(
        motion,
        world_from_sheet=moved(motion.world_from_sheet, motion.twist_world, duration_s),
        stretch_ratio=motion.stretch_ratio + motion.stretch_rate_per_s * duration_s,
    )


def follow_trajectory(
    motion: SheetMotion, time_s: float, *, keep_s: float, brake_s: float
) -> SheetMotion:
    """Return the motion at the time `time_s` after a given motion, if no further target arrives.

    The twist (velocity) is constant for the time `keep_s`, and then decreases uniformly to zero
    within the time `brake_s`. The stretch ratio is constant.
    """
    braked_s = min(max(time_s - keep_s, 0.0), brake_s)
    travelled_s = min(time_s, keep_s) + braked_s - 0.5 * braked_s * braked_s / brake_s
    return replace(
        motion,
        world_from_sheet=moved(motion.world_from_sheet, motion.twist_world, travelled_s),
        twist_world=motion.twist_world * (1.0 - braked_s / brake_s),
        stretch_rate_per_s=0.0,
    )


def _decelerate(velocity: Floats, change: float) -> Floats:
    speed = measure_length(velocity)
    return np.zeros_like(velocity) if speed <= change else velocity * (1.0 - change / speed)


def _orthonormal(pose: Floats) -> Floats:
    """Return a pose (4, 4) with orthonormal axes, by Gram-Schmidt on the x and y axes."""
    (ax, bx, _, px), (ay, by, _, py), (az, bz, _, pz), last = pose.tolist()
    length = sqrt(ax * ax + ay * ay + az * az)
    ax, ay, az = ax / length, ay / length, az / length
    along = ax * bx + ay * by + az * bz
    bx, by, bz = bx - along * ax, by - along * ay, bz - along * az
    length = sqrt(bx * bx + by * by + bz * bz)
    bx, by, bz = bx / length, by / length, bz / length
    return np.array(
        [
            [ax, bx, ay * bz - az * by, px],
            [ay, by, az * bx - ax * bz, py],
            [az, bz, ax * by - ay * bx, pz],
            last,
        ]
    )
