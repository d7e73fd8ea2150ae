"""Where the sheet touches the cylinder: approach (the paper's Fig. 7a), rolling (7b), holding.

All in the object's frame, the axis along x.  A place around the axis is an angle, 0 on +z and
growing towards +y (`CylinderShape.angle_rad`).  A place on the sheet along its height is `y`, seen
in the sheet's frame, 0 at its middle line.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, pi, sin

import numpy as np
from numpy.typing import NDArray

from messages.types import Phase
from nodes.models.rigid import transform
from nodes.models.shapes import CylinderShape

Floats = NDArray[np.float64]

BEYOND_TILT = "finger beyond the tilt that the arms present"


SHALLOW, DEEP = 0.15, 0.5
"""Depths over the radius: up to the first the finger's own angle counts, from the second on not."""


@dataclass(frozen=True, slots=True)
class Reach:
    """How far the sheet can go, and when the finger counts as touching.

    front_rad, tilt_rad: the sheet is presented at angles within `tilt_rad` of `front_rad`.
    half_height_m: largest |y| at which the sheet can be touched.
    touch_m, release_m: distances from the object (m) at which contact begins and ends.
    axis_m: a finger nearer to the axis than this, or beyond it, leaves the direction undecided.
    """

    front_rad: float
    tilt_rad: float
    half_height_m: float
    touch_m: float
    release_m: float
    axis_m: float


@dataclass(frozen=True, slots=True)
class Presentation:
    """What to present: the tangent plane at an angle, and which line of the sheet touches there.

    angle_rad, angle_rate: where around the axis (rad, rad/s).  y_m: the line on the sheet.
     rolling: whether `y_m` follows the angle (contact) or stays (approach).
    """

    phase: Phase
    reason: str
    angle_rad: float
    y_m: float
    angle_rate: float
    rolling: bool
    push_depth_m: float


class Encounter:
    """The finger's dealings with the cylinder: away, in touch, and back.

    While in touch, the contact began at `_anchor_angle` with the sheet's point `_anchor_y` there
    (A and A' of the paper); the arc from there equals the way on the sheet.
    """

    def __init__(self, shape: CylinderShape, reach: Reach) -> None:
        self._shape, self._reach = shape, reach
        self._touching = False
        self._anchor_angle = self._anchor_y = 0.0
        self._angle = reach.front_rad
        self._finger = np.zeros(3)

    @property
    def angle_rad(self) -> float:
        """The angle presented last."""
        return self._angle

    def step(self, finger: Floats, velocity: Floats, sheet_y_at: float) -> Presentation:
        """What to present to a finger (3,) m that moves with `velocity` (3,) m/s.

        sheet_y_at: y of the sheet's point that lies nearest to the surface point under the finger
            now; used as A' when this step begins a contact.
        """
        if self._touching and self._above_sheet(finger) > self._reach.release_m:
            self._touching = False
        if self._touching:
            return self._roll(finger, velocity)
        height = float(np.hypot(finger[1], finger[2])) - self._shape.radius_m
        if height + self._shape.radius_m < self._reach.axis_m:
            return self._hold("finger on the object's axis", self._shape.radius_m)
        angle, limited = self._reachable(self._shape.angle_rad(finger))
        self._angle = angle
        beyond = abs(finger[0]) - 0.5 * self._shape.length_m
        if height <= self._reach.touch_m and beyond <= 0.0 and not limited:
            half = self._reach.half_height_m
            self._touching = True
            self._anchor_angle, self._anchor_y = angle, min(max(sheet_y_at, -half), half)
            self._finger = finger
            return self._roll(finger, velocity)
        rate = 0.0 if limited else _angle_rate(finger, velocity)
        return Presentation(
            "approach", BEYOND_TILT if limited else "", angle, 0.0, rate, False, 0.0
        )

    def _roll(self, finger: Floats, velocity: Floats) -> Presentation:
        """In touch: roll to the finger, or say what keeps the sheet from it."""
        depth = max(0.0, -self._above_sheet(finger))
        before, self._finger = self._finger, finger
        if abs(finger[0]) > 0.5 * self._shape.length_m:
            return self._hold("finger past the object's end", depth)
        if depth > 2.0 * self._shape.radius_m:
            return self._hold("finger through the object", depth)
        carried, rate = self._carried(finger, finger - before, velocity, depth)
        angle, limited = self._reachable(carried)
        y, half = self._sheet_y(angle), self._reach.half_height_m
        if abs(y) > half:
            edge_y = half if y > 0 else -half
            self._angle = self._anchor_angle + (edge_y - self._anchor_y) / self._shape.radius_m
            return self._hold("finger past the sheet's usable height", depth)
        self._angle = angle
        if limited:
            return self._hold(BEYOND_TILT, depth)
        return Presentation("contact", "", angle, y, rate, True, depth)

    def _carried(
        self, finger: Floats, moved: Floats, velocity: Floats, depth: float
    ) -> tuple[float, float]:
        """Angle (rad) and rate (rad/s) to which a finger in touch carries the sheet.

        On the surface it is the finger's own angle about the axis.  Deep inside that angle means
        little (at the axis every side is as near), and what the finger feels is the dented sheet;
        there the sheet rolls by how far the finger moves along it.  In between the two are blended,
        so that stroking while pushing makes no step.
        """
        shallow, deep = SHALLOW * self._shape.radius_m, DEEP * self._shape.radius_m
        share = min(max((deep - depth) / (deep - shallow), 0.0), 1.0)
        along = np.array([0.0, cos(self._angle), -sin(self._angle)])
        angle = self._angle + (1.0 - share) * float(moved @ along) / self._shape.radius_m
        rate = (1.0 - share) * float(velocity @ along) / self._shape.radius_m
        if share > 0.0:
            aside = self._shape.angle_rad(finger) - self._angle
            angle += share * ((aside + pi) % (2.0 * pi) - pi)
            rate += share * _angle_rate(finger, velocity)
        return angle, rate

    def _above_sheet(self, finger: Floats) -> float:
        """Height (m) of a finger over the plane presented last; negative when it pushes."""
        return float(finger @ normal_at(self._angle)) - self._shape.radius_m

    def _hold(self, reason: str, depth: float) -> Presentation:
        y = self._sheet_y(self._angle) if self._touching else 0.0
        return Presentation("hold", reason, self._angle, y, 0.0, self._touching, depth)

    def _sheet_y(self, angle: float) -> float:
        """Arc AB equals A'B: the sheet's y at the contact, rolled without slipping."""
        return self._anchor_y + self._shape.radius_m * (angle - self._anchor_angle)

    def _reachable(self, angle: float) -> tuple[float, bool]:
        """The angle within the tilt that can be presented, and whether it had to be limited.

        Angles count from the front, -pi..pi; behind the object the side presented last is kept.
        """
        front, most = self._reach.front_rad, self._reach.tilt_rad
        aside = (angle - front + pi) % (2.0 * pi) - pi
        if abs(aside) <= most:
            return front + aside, False
        if abs(aside - (self._angle - front)) > pi:
            aside = -aside
        return front + (most if aside > 0 else -most), True


def normal_at(angle_rad: float) -> Floats:
    """Outward normal (3,) of the cylinder at an angle."""
    return np.array([0.0, sin(angle_rad), cos(angle_rad)])


def sheet_on_cylinder(shape: CylinderShape, angle_rad: float, y_m: float) -> Floats:
    """object_from_sheet: tangent at the angle, with the sheet's line at `y_m` on the contact line.

    The sheet's x axis is the cylinder's; its middle stays over the object's.
    """
    normal = normal_at(angle_rad)
    along = np.array([0.0, cos(angle_rad), -sin(angle_rad)])
    rotation = np.column_stack([[1.0, 0.0, 0.0], along, normal])
    return transform(rotation, shape.radius_m * normal - y_m * along)


def sheet_twist(
    shape: CylinderShape, angle_rad: float, y_m: float, angle_rate: float, *, rolling: bool
) -> Floats:
    """Twist (6,) of the sheet's centre in the object's frame as the angle changes.

    With c = R n(a) - y t(a), n' = t, t' = -n: rolling has y' = R, so that the centre moves along
    the normal only, a' y n; in approach y stays, and it moves with a' (R t + y n).
    """
    normal = normal_at(angle_rad)
    along = np.array([0.0, cos(angle_rad), -sin(angle_rad)])
    linear = y_m * normal if rolling else shape.radius_m * along + y_m * normal
    return angle_rate * np.concatenate([linear, [-1.0, 0.0, 0.0]])


def _angle_rate(finger: Floats, velocity: Floats) -> float:
    """Rate (rad/s) of a moving point's angle about the axis, off which it lies."""
    across = velocity[1] * finger[2] - velocity[2] * finger[1]
    return float(across / (finger[1] ** 2 + finger[2] ** 2))
