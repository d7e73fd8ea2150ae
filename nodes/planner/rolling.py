"""Compute the contact of a flat sheet that touches a smooth object, or rolls on the object.

All vectors are in the object's frame. In the sheet's frame, the x axis points from the left edge to
the right edge. The y axis is parallel to the edges, and the z axis points out of the object.
Rolling without slip or spin moves the sheet's axes along the contact's path by parallel transport.
The contact's path on the sheet has the same length as its path on the object (Furukawa et al. 2007,
Fig. 7b, for any smooth shape). Source: do Carmo, Differential Geometry of Curves and Surfaces,
section 4-4.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import atan2, sqrt

import numpy as np

from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.models.rigid import angle_between, transform
from flexsheet.nodes.models.shapes import Nearest, Shape

MIN_STEP_RATIO = 1.0 / 512.0
"""The resolution of the search in `limit_tilt`, as a fraction of the search distance."""

MIN_INNER_STEP_RATIO, NEAR_LIMIT_RAD = MIN_STEP_RATIO / 4.0**5, np.radians(1.0)
"""The resolution of the search in `limit_tilt` while the tilt is below its maximum by more than
NEAR_LIMIT_RAD. Deep inside the object, a small step can rotate the normal by many degrees."""


@dataclass(frozen=True, slots=True)
class SheetContact:
    """A contact of the sheet with the object.

    point, normal: surface point (3,) m and unit normal (3,).
    shape_operator: derivative (3, 3), in 1/m, of the normal along the surface.
    axes: axes of the sheet as columns (3, 3); the third column is the normal.
    position_sheet_m: (x, y) of the contact on the sheet.
    lift_m: distance between the sheet's plane and the point; 0 unless the object is concave there.
    """

    point: Floats
    normal: Floats
    shape_operator: Floats
    axes: Floats
    position_sheet_m: Floats
    lift_m: float = 0.0

    @property
    def nearest(self) -> Nearest:
        """Return the surface point of the contact in the format that `Shape.closest` returns."""
        no = np.zeros((), dtype=bool)
        return Nearest(self.point, self.normal, np.zeros(()), self.shape_operator, no, no)

    @property
    def object_from_sheet(self) -> Floats:
        """Return the pose (4, 4) of the sheet's centre in the object's frame."""
        contact_sheet = np.append(self.position_sheet_m, -self.lift_m)
        return transform(self.axes, self.point - self.axes @ contact_sheet)

    def height_m(self, finger: Floats) -> float:
        """Return the height (m) of a point (3,) m above the sheet's plane; negative below it."""
        return float((finger - self.point) @ self.normal) - self.lift_m


def transport_axes(axes: Floats, normal: Floats) -> Floats:
    """Rotate axes (3, 3) by the smallest rotation that maps the third axis to `normal` (3,).

    The rotation is the parallel transport along the shorter arc between both normals. If the
    normals are opposite, the result is undefined. Rounding errors do not accumulate.
    """
    both = axes[:, 2] + normal
    # The rotation is the product of two Householder reflections.  The first reflection
    # negates the third axis.  The second reflection maps the negated axis to the normal.
    result = axes - np.outer(both, both @ axes) * (2.0 / (both @ both))
    result[:, 2] = normal
    return result


def roll_contact(contact: SheetContact, found: Nearest) -> SheetContact:
    """Return the contact after the sheet has rolled without slip to the surface point `found`.

    The distance on the sheet is the length of a circular arc through both points. Its direction is
    the direction of the chord, projected onto the plane halfway between the tangent planes. The
    result is exact on circles. On other curves, the error is of third order in the angle between
    the normals.
    """
    axes = transport_axes(contact.axes, found.normal)
    middle = transport_axes(contact.axes, _normalize(contact.normal + found.normal))
    chord = found.point - contact.point
    half_angle = 0.5 * angle_between(contact.normal, found.normal)
    arc_over_chord = 1.0 if half_angle < 1e-9 else half_angle / np.sin(half_angle)
    displacement = arc_over_chord * (chord @ middle[:, :2])
    return SheetContact(
        found.point,
        found.normal,
        found.shape_operator,
        axes,
        contact.position_sheet_m + displacement,
        contact.lift_m,
    )


def make_tangent_contact(home: Floats, found: Nearest, half_width_m: float) -> SheetContact:
    """Return the contact of a sheet that waits at a surface point for an approaching finger.

    home: axes (3, 3) of the sheet before they are rotated to the surface normal.
    half_width_m: maximum distance of the contact from the sheet's centre.

    The contact is on the sheet's horizontal centre line. Along this line, the sheet's centre is as
    close as possible to the object's origin.
    """
    axes = transport_axes(home, found.normal)
    x = float(np.clip(axes[:, 0] @ found.point, -half_width_m, half_width_m))
    return SheetContact(found.point, found.normal, found.shape_operator, axes, np.array([x, 0.0]))


def compute_rolling_twist(contact: SheetContact, rate: Floats) -> Floats:
    """Return the twist (6,) of the sheet's centre while the sheet rolls on the object without slip.

    rate: velocity (3,) m/s at which the contact point moves on the object.

    The twist consists of linear velocity (m/s) and angular velocity (rad/s). The angular velocity
    is n x dn/dt with the surface normal n. The material point of the sheet at the contact is at
    rest.
    """
    tangential = rate - contact.normal * (rate @ contact.normal)
    angular = cross(contact.normal, contact.shape_operator @ tangential)
    x, y = contact.position_sheet_m
    to_centre = contact.lift_m * contact.normal - x * contact.axes[:, 0] - y * contact.axes[:, 1]
    return np.concatenate([cross(angular, to_centre), angular])


def compute_tangent_twist(
    contact: SheetContact, rate: Floats, home: Floats, half_width_m: float
) -> Floats:
    """Return the twist (6,) of a sheet that waits at a surface point while this point moves.

    rate: velocity (3,) m/s of the surface point.
    home, half_width_m: as in `make_tangent_contact`.

    The angular velocity is n x dn/dt + s n. The first term rotates the surface normal n. The second
    term is a spin about the normal with the rate s = -(h x n) . dn/dt / (1 + h . n). Here h is the
    third axis of `home`.
    """
    point, normal, axes = contact.point, contact.normal, contact.axes
    tangential = rate - normal * (rate @ normal)
    normal_rate = contact.shape_operator @ tangential
    front = home[:, 2]
    spin = -(cross(front, normal) @ normal_rate) / (1.0 + front @ normal)
    angular = cross(normal, normal_rate) + spin * normal
    x_axis_rate = cross(angular, axes[:, 0])
    unlimited_x = float(axes[:, 0] @ point)
    x = min(max(unlimited_x, -half_width_m), half_width_m)
    x_rate = x_axis_rate @ point + axes[:, 0] @ tangential if x == unlimited_x else 0.0
    linear = tangential - x_rate * axes[:, 0] - x * x_axis_rate + contact.lift_m * normal_rate
    return np.concatenate([linear, angular])


def cross(a: Floats, b: Floats) -> Floats:
    """Return the cross product (3,) of two vectors (3,).

    For single vectors, this function is several times as fast as np.cross.
    """
    (ax, ay, az), (bx, by, bz) = a.tolist(), b.tolist()
    return np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])


def measure_spin_rad(axes: Floats, home: Floats) -> float:
    """Return the angle (rad) by which a sheet is rotated about its normal.

    axes (3, 3): axes of the sheet as columns; the third column is the normal.
    home (3, 3): axes of an unrotated sheet. Before the comparison, they are rotated by the smallest
        rotation that makes their normal equal to the normal of `axes`.
    """
    ready = transport_axes(home, axes[:, 2])
    return atan2(axes[:, 0] @ ready[:, 1], axes[:, 0] @ ready[:, 0])


def limit_tilt(
    shape: Shape, start: Nearest, found: Nearest, front: Floats, max_tilt_rad: float
) -> tuple[Nearest, bool]:
    """Return the surface point nearest to `found` at which the sheet's tilt is within its limit.

    The points on the way from `start` to `found` are searched. They are projections of the straight
    line between both points onto the surface.

    front: unit vector (3,) from which the tilt of the surface normal is measured.

    The second result is whether the returned point differs from `found`.
    """
    limit, near = np.cos(max_tilt_rad), np.cos(max(max_tilt_rad - NEAR_LIMIT_RAD, 0.0))
    if found.normal @ front >= limit:
        return found, False
    reached, step = 0.0, MIN_STEP_RATIO
    best, displacement = start, found.point - start.point
    while step >= MIN_STEP_RATIO or (step >= MIN_INNER_STEP_RATIO and best.normal @ front > near):
        tried = shape.closest(start.point + (reached + step) * displacement, previous=start.point)
        if tried.normal @ front >= limit:
            best, reached = tried, reached + step
            step = min(2.0 * step, 1.0 - reached)
        else:
            step *= 0.25
    return best, True


def _normalize(vector: Floats) -> Floats:
    return np.asarray(vector / sqrt(vector @ vector))
