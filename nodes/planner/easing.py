"""The sheet's motion, bounded in speed, acceleration and jerk: no step is ever felt.

A vector's motion is known by its place, its mean velocity over the last step and the acceleration
that it had then.  Each step first decides the velocity that one would like (towards the target, no
faster than one can still stop), then the acceleration that leads there without passing it, then
goes as near to that acceleration as the jerk allows.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from flexsheet.nodes.models.motion import (
    EdgeBound,
    SheetBounds,
    SheetMotion,
    closing_speed,
    desired_velocity,
)
from flexsheet.nodes.models.rigid import rotation_from_vector, transform, vector_from_rotation

Floats = NDArray[np.float64]

TAPER_SHARE = 0.5
"""Share of the jerk with which an acceleration is let go as its velocity comes near."""

LINEAR, ANGULAR, GROWTH = slice(0, 3), slice(3, 6), slice(6, 7)


@dataclass(frozen=True, slots=True)
class JerkBounds:
    """How fast the accelerations of the sheet's middle, its turning and its stretch may change."""

    jerk_m_per_s3: float
    turn_jerk_rad_per_s3: float
    stretch_jerk_per_s3: float


@dataclass(frozen=True, slots=True)
class EasedMotion:
    """A sheet's motion with what the next step goes on from.

    mean, acceleration: (7,) over the last step: linear, angular, and of the stretch ratio.
    """

    sheet: SheetMotion
    mean: Floats
    acceleration: Floats

    @staticmethod
    def at_rest(sheet: SheetMotion) -> EasedMotion:
        """A sheet that stands still where it is."""
        still = replace(sheet, twist_world=np.zeros(6), stretch_rate_per_s=0.0)
        return EasedMotion(still, np.zeros(7), np.zeros(7))


def eased(
    mean: Floats,
    acceleration: Floats,
    wanted: Floats,
    *,
    max_acceleration: float,
    max_jerk: float,
    step_s: float,
) -> tuple[Floats, Floats]:
    """Mean velocity and acceleration (n,) of the next step on the way to a wanted velocity (n,).

    The acceleration never exceeds its bound, and never changes by more than max_jerk step_s.
    """
    change = wanted - mean
    size = float(np.linalg.norm(change))
    goal = np.zeros_like(change)
    if size > 0.0:
        taper = closing_speed(np.array(size), TAPER_SHARE * max_jerk, step_s)
        goal = change * (min(float(taper), max_acceleration) / size)
    step = goal - acceleration
    length, most = float(np.linalg.norm(step)), max_jerk * step_s
    if length > most:
        step = step * (most / length)
    there = acceleration + step
    lands = length <= most and float(np.linalg.norm(there * step_s - change)) <= 1e-12 * size
    return wanted.copy() if lands else mean + there * step_s, there


def ease_sheet(
    now: EasedMotion,
    target: SheetMotion | None,
    *,
    bounds: SheetBounds,
    jerks: JerkBounds,
    edges: EdgeBound,
    step_s: float,
) -> EasedMotion:
    """The sheet `step_s` (> 0) later, on its way to `target` (as it is then), or to rest."""
    wanted = np.zeros(7) if target is None else _wanted(now.sheet, target, bounds, edges, step_s)
    limits = (
        (LINEAR, bounds.acceleration_m_per_s2, jerks.jerk_m_per_s3),
        (ANGULAR, bounds.turn_acceleration_rad_per_s2, jerks.turn_jerk_rad_per_s3),
        (GROWTH, bounds.stretch_acceleration_per_s2, jerks.stretch_jerk_per_s3),
    )
    mean, acceleration = np.empty(7), np.empty(7)
    for part, sharpest, most in limits:
        mean[part], acceleration[part] = eased(
            now.mean[part],
            now.acceleration[part],
            wanted[part],
            max_acceleration=sharpest,
            max_jerk=most,
            step_s=step_s,
        )
    before = now.sheet.world_from_sheet
    pose = transform(
        rotation_from_vector(mean[ANGULAR] * step_s) @ before[:3, :3],
        before[:3, 3] + mean[LINEAR] * step_s,
    )
    # The mean is the velocity half a step ago.
    ending = mean + 0.5 * step_s * acceleration
    sheet = SheetMotion(
        pose,
        ending[:6].copy(),
        now.sheet.stretch_ratio + float(mean[6]) * step_s,
        float(ending[6]),
    )
    return EasedMotion(sheet, mean, acceleration)


def _wanted(
    now: SheetMotion, target: SheetMotion, bounds: SheetBounds, edges: EdgeBound, step_s: float
) -> Floats:
    """The mean velocities (7,) of the next step that one would like, the edges' speed kept."""
    away = target.world_from_sheet[:3, 3] - now.world_from_sheet[:3, 3]
    turned = vector_from_rotation(target.world_from_sheet[:3, :3] @ now.world_from_sheet[:3, :3].T)
    linear = desired_velocity(
        away,
        target.twist_world[:3],
        max_speed=bounds.speed_m_per_s,
        max_acceleration=bounds.acceleration_m_per_s2,
        step_s=step_s,
    )
    angular = desired_velocity(
        turned,
        target.twist_world[3:],
        max_speed=bounds.turn_rad_per_s,
        max_acceleration=bounds.turn_acceleration_rad_per_s2,
        step_s=step_s,
    )
    growth = desired_velocity(
        np.array([target.stretch_ratio - now.stretch_ratio]),
        np.array([target.stretch_rate_per_s]),
        max_speed=bounds.stretch_rate_per_s,
        max_acceleration=bounds.stretch_acceleration_per_s2,
        step_s=step_s,
    )
    share = edges.share(float(np.linalg.norm(linear)), float(np.linalg.norm(angular)))
    return np.concatenate([share * linear, share * angular, growth])
