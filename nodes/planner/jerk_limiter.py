"""Move the sheet towards a target with limited speed, acceleration and jerk.

Position, orientation and stretch are limited separately. Each step first determines a velocity from
which the sheet can stop at the target. The desired acceleration reaches this velocity without
overshoot. The present acceleration then changes towards the desired acceleration as far as the jerk
limit permits.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.models.motion import (
    EdgeBound,
    SheetBounds,
    SheetMotion,
    closing_speed,
    desired_velocity,
    measure_length,
)
from flexsheet.nodes.models.rigid import rotation_from_vector, transform, vector_from_rotation

TAPER_FRACTION = 0.5
"""The fraction of the maximum jerk with which the acceleration decreases to 0 near the desired
velocity."""

LINEAR, ANGULAR, STRETCH = slice(0, 3), slice(3, 6), slice(6, 7)


@dataclass(frozen=True, slots=True)
class JerkBounds:
    """The maximum jerk of the sheet's translation, rotation and stretch ratio."""

    jerk_m_per_s3: float
    turn_jerk_rad_per_s3: float
    stretch_jerk_per_s3: float


@dataclass(frozen=True, slots=True)
class JerkLimitedState:
    """The motion of the sheet and the state of the jerk limiter.

    mean_velocity, acceleration: averages (7,) over the last time step. Three elements describe the
        translation, three the rotation, and one the stretch ratio.
    """

    sheet: SheetMotion
    mean_velocity: Floats
    acceleration: Floats

    @staticmethod
    def at_rest(sheet: SheetMotion) -> JerkLimitedState:
        still = replace(sheet, twist_world=np.zeros(6), stretch_rate_per_s=0.0)
        return JerkLimitedState(still, np.zeros(7), np.zeros(7))


def limit_jerk(
    mean_velocity: Floats,
    acceleration: Floats,
    goal_velocity: Floats,
    *,
    max_acceleration: float,
    max_jerk: float,
    step_s: float,
) -> tuple[Floats, Floats]:
    """Return the mean velocity and the acceleration (n,) of the next step for n coordinates.

    mean_velocity, acceleration: values (n,) of the last step.
    goal_velocity: desired velocity (n,).

    The acceleration stays within its limit, and changes by at most max_jerk * step_s.
    """
    change = goal_velocity - mean_velocity
    size = measure_length(change)
    goal = np.zeros_like(change)
    if size > 0.0:
        taper = closing_speed(size, TAPER_FRACTION * max_jerk, step_s)
        goal = change * (min(float(taper), max_acceleration) / size)
    step = goal - acceleration
    length, max_length = measure_length(step), max_jerk * step_s
    if length > max_length:
        step = step * (max_length / length)
    after = acceleration + step
    error = measure_length(after * step_s - change)
    reached = length <= max_length and error <= 1e-12 * size
    return goal_velocity.copy() if reached else mean_velocity + after * step_s, after


def step_sheet(
    now: JerkLimitedState,
    target: SheetMotion | None,
    *,
    bounds: SheetBounds,
    jerks: JerkBounds,
    edges: EdgeBound,
    step_s: float,
) -> JerkLimitedState:
    """Return the state of the sheet after one step of `step_s` towards its target.

    target: motion of the target at the end of the step. If it is None, the sheet decelerates to
        rest.
    """
    goals = (
        np.zeros(7)
        if target is None
        else _desired_velocities(now.sheet, target, bounds, edges, step_s)
    )
    limits = (
        (LINEAR, bounds.acceleration_m_per_s2, jerks.jerk_m_per_s3),
        (ANGULAR, bounds.turn_acceleration_rad_per_s2, jerks.turn_jerk_rad_per_s3),
        (STRETCH, bounds.stretch_acceleration_per_s2, jerks.stretch_jerk_per_s3),
    )
    mean, acceleration = np.empty(7), np.empty(7)
    for part, max_acceleration, max_jerk in limits:
        mean[part], acceleration[part] = limit_jerk(
            now.mean_velocity[part],
            now.acceleration[part],
            goals[part],
            max_acceleration=max_acceleration,
            max_jerk=max_jerk,
            step_s=step_s,
        )
    before = now.sheet.world_from_sheet
    pose = transform(
        rotation_from_vector(mean[ANGULAR] * step_s) @ before[:3, :3],
        before[:3, 3] + mean[LINEAR] * step_s,
    )
    # The mean velocity is that at half of the step.
    final = mean + 0.5 * step_s * acceleration
    sheet = SheetMotion(
        pose,
        final[:6].copy(),
        now.sheet.stretch_ratio + float(mean[6]) * step_s,
        float(final[6]),
    )
    return JerkLimitedState(sheet, mean, acceleration)


def _desired_velocities(
    now: SheetMotion, target: SheetMotion, bounds: SheetBounds, edges: EdgeBound, step_s: float
) -> Floats:
    """Return the desired mean velocities (7,) of the next step within the edges' speed limit.

    The elements are the linear velocity (3), the angular velocity (3) and the stretch rate.
    """
    displacement = target.world_from_sheet[:3, 3] - now.world_from_sheet[:3, 3]
    rotation = vector_from_rotation(
        target.world_from_sheet[:3, :3] @ now.world_from_sheet[:3, :3].T
    )
    linear = desired_velocity(
        displacement,
        target.twist_world[:3],
        max_speed=bounds.speed_m_per_s,
        max_acceleration=bounds.acceleration_m_per_s2,
        step_s=step_s,
    )
    angular = desired_velocity(
        rotation,
        target.twist_world[3:],
        max_speed=bounds.turn_rad_per_s,
        max_acceleration=bounds.turn_acceleration_rad_per_s2,
        step_s=step_s,
    )
    stretch_rate = desired_velocity(
        np.array([target.stretch_ratio - now.stretch_ratio]),
        np.array([target.stretch_rate_per_s]),
        max_speed=bounds.stretch_rate_per_s,
        max_acceleration=bounds.stretch_acceleration_per_s2,
        step_s=step_s,
    )
    scales = divide_edge_speed(
        edges,
        (measure_length(linear), measure_length(angular)),
        (measure_length(displacement), measure_length(rotation)),
    )
    return np.concatenate([scales[0] * linear, scales[1] * angular, stretch_rate])


def divide_edge_speed(
    edges: EdgeBound, speeds: tuple[float, float], distances: tuple[float, float]
) -> tuple[float, float]:
    """Return the factors (0..1) for linear and angular speed that respect the edges' speed limit.

    speeds: linear and angular speed (m/s, rad/s).
    distances: remaining distance (m) and remaining angle (rad).

    The speed limit is divided in proportion to the remaining distances. A part that one motion does
    not need is available to the other motion.
    """
    limit, reach = edges.speed_m_per_s, edges.reach_m
    linear, angular = speeds[0], reach * speeds[1]
    if linear + angular <= limit:
        return 1.0, 1.0
    path_m = distances[0] + reach * distances[1]
    fraction = distances[0] / path_m if path_m > 0.0 else linear / (linear + angular)
    max_linear = max(fraction * limit, limit - angular)
    max_angular = max((1.0 - fraction) * limit, limit - linear)
    return (
        min(1.0, max_linear / linear) if linear > 0.0 else 1.0,
        min(1.0, max_angular / angular) if angular > 0.0 else 1.0,
    )
