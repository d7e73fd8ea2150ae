"""A flat sheet on a smooth object: tangent, rolling without slip or spin, never turned too far.

All in the object's frame.  The sheet's frame has x from the left edge to the right, y along the
edges and z out of the object; a place on the sheet is (x, y) in it.  Rolling carries the sheet's
axes along the contact's path by parallel transport, and the contact's way on the sheet is the
path's development: the arc AB on the object is as long as A'B on the sheet (the paper's Fig. 7b,
for any smooth shape; do Carmo, Differential Geometry of Curves and Surfaces, section 4-4).
"""

from __future__ import annotations

from dataclasses import dataclass
from math import atan2, sqrt

import numpy as np
from numpy.typing import NDArray

from flexsheet.nodes.models.rigid import angle_between, transform
from flexsheet.nodes.models.shapes import Nearest, Shape

Floats = NDArray[np.float64]

FINEST = 1.0 / 512.0
"""Share of the way to which the last place within the tilt is found."""

FINEST_INSIDE, NEAR_THE_TILT_RAD = FINEST / 4.0**5, np.radians(1.0)
"""Where the way passes what is far inside, a step along it is many degrees on the surface: to this
share then, until the tilt is near."""

RIM_RADIUS_M = 0.03
"""So far around it is looked whether the object rises above its own tangent plane."""


@dataclass(frozen=True, slots=True)
class Contact:
    """Where the sheet touches: a surface point with its normal and shape operator, and the sheet.

    axes: (3, 3), the sheet's as columns, the third the normal.
    on_sheet: (x, y) m of the touching point on the sheet.
    lift_m: how far the plane stands off the point, where the object is hollow there.
    """

    point: Floats
    normal: Floats
    shape_operator: Floats
    axes: Floats
    on_sheet: Floats
    lift_m: float = 0.0

    @property
    def place(self) -> Nearest:
        """The surface point, as a shape found it."""
        nowhere = np.zeros((), dtype=bool)
        return Nearest(self.point, self.normal, np.zeros(()), self.shape_operator, nowhere, nowhere)

    @property
    def object_from_sheet(self) -> Floats:
        """The sheet's pose (4, 4), its frame at its middle."""
        off_plane = np.append(self.on_sheet, -self.lift_m)
        return transform(self.axes, self.point - self.axes @ off_plane)

    def height_m(self, finger: Floats) -> float:
        """Of a point (3,) over the sheet's plane; negative behind it."""
        return float((finger - self.point) @ self.normal) - self.lift_m


def turned(axes: Floats, normal: Floats) -> Floats:
    """Axes (3, 3) after the least rotation that takes their third to `normal`, exactly orthogonal.

    That is parallel transport along the shorter arc between both normals; opposite ones have none.
    """
    both = axes[:, 2] + normal
    # A reflection that takes minus the third axis to the normal; with the one across the third
    # axis before it, which leaves the others alone, it is the least rotation (Householder).
    result = axes - np.outer(both, both @ axes) * (2.0 / (both @ both))
    result[:, 2] = normal
    return result


def rolled(contact: Contact, found: Nearest) -> Contact:
    """The contact after the sheet has rolled to another surface point, a short step away.

    The way on the sheet is the chord, seen half way between both tangent planes and stretched from
    chord to arc: exact on circles, and of third order in the angle rolled elsewhere.
    """
    axes = turned(contact.axes, found.normal)
    middle = turned(contact.axes, _unit(contact.normal + found.normal))
    chord = found.point - contact.point
    half_angle = 0.5 * angle_between(contact.normal, found.normal)
    arc_of_chord = 1.0 if half_angle < 1e-9 else half_angle / np.sin(half_angle)
    way = arc_of_chord * (chord @ middle[:, :2])
    return Contact(
        found.point,
        found.normal,
        found.shape_operator,
        axes,
        contact.on_sheet + way,
        contact.lift_m,
    )


def tangent(home: Floats, found: Nearest, half_width_m: float) -> Contact:
    """The sheet held ready at a surface point, its axes as little turned from `home` as can be.

    The finger will meet the sheet's middle line; along x the sheet's middle stays over the
    object's, as far as the sheet reaches.
    """
    axes = turned(home, found.normal)
    x = float(np.clip(axes[:, 0] @ found.point, -half_width_m, half_width_m))
    return Contact(found.point, found.normal, found.shape_operator, axes, np.array([x, 0.0]))


def rolling_twist(contact: Contact, rate: Floats) -> Floats:
    """Twist (6,) of the rolling sheet's middle while the contact moves at `rate` (3,) m/s.

    Without spin the sheet turns by n x dn; without slip its point that touches is at rest.
    """
    along = rate - contact.normal * (rate @ contact.normal)
    turning = cross(contact.normal, contact.shape_operator @ along)
    x, y = contact.on_sheet
    to_middle = contact.lift_m * contact.normal - x * contact.axes[:, 0] - y * contact.axes[:, 1]
    return np.concatenate([cross(turning, to_middle), turning])


def tangent_twist(contact: Contact, rate: Floats, home: Floats, half_width_m: float) -> Floats:
    """Twist (6,) of the sheet held ready while the point under the finger moves at `rate`.

    Its axes stay turned from `home` by the least rotation, which spins them about the normal n by
    -(h x n) dn / (1 + h n) besides n x dn, h the third of home.
    """
    point, normal, axes = contact.point, contact.normal, contact.axes
    along = rate - normal * (rate @ normal)
    turn_rate = contact.shape_operator @ along
    front = home[:, 2]
    spin = -(cross(front, normal) @ turn_rate) / (1.0 + front @ normal)
    turning = cross(normal, turn_rate) + spin * normal
    x_axis_rate = cross(turning, axes[:, 0])
    ahead = float(axes[:, 0] @ point)
    x = min(max(ahead, -half_width_m), half_width_m)
    x_rate = x_axis_rate @ point + axes[:, 0] @ along if x == ahead else 0.0
    shift = along - x_rate * axes[:, 0] - x * x_axis_rate + contact.lift_m * turn_rate
    return np.concatenate([shift, turning])


def cross(a: Floats, b: Floats) -> Floats:
    """The cross product (3,), at a fraction of the library's cost."""
    (ax, ay, az), (bx, by, bz) = a.tolist(), b.tolist()
    return np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])


def spin_rad(axes: Floats, home: Floats) -> float:
    """How far the sheet is turned about its normal from how it would be held ready there."""
    ready = turned(home, axes[:, 2])
    return atan2(axes[:, 0] @ ready[:, 1], axes[:, 0] @ ready[:, 0])


def within_tilt(
    shape: Shape, start: Nearest, found: Nearest, front: Floats, tilt_rad: float
) -> tuple[Nearest, bool]:
    """The last point towards `found` whose normal is within the tilt, and whether it is another.

    start: surface point to come from, itself within the tilt.  The way is felt along the straight
    line from there, in steps that grow, so that the side is kept on which the sheet is; a sheet
    that is at the tilt already learns so from the first.
    """
    most, near = np.cos(tilt_rad), np.cos(max(tilt_rad - NEAR_THE_TILT_RAD, 0.0))
    if found.normal @ front >= most:
        return found, False
    reached, step = 0.0, FINEST
    best, way = start, found.point - start.point
    while step >= FINEST or (step >= FINEST_INSIDE and best.normal @ front > near):
        there = shape.closest(start.point + (reached + step) * way, previous=start.point)
        if there.normal @ front >= most:
            best, reached = there, reached + step
            step = min(2.0 * step, 1.0 - reached)
        else:
            step *= 0.25
    return best, True


def rim_lift_m(shape: Shape, contact: Contact) -> float:
    """How far the tangent plane must stand off its point to clear the object around it (m).

    0 where the object is not hollow.  Around is as far as a finger pulls the sheet down with it.
    """
    return shape.rise_m(contact.point, contact.normal, RIM_RADIUS_M)


def _unit(vector: Floats) -> Floats:
    return np.asarray(vector / sqrt(vector @ vector))
