"""Compute the contact of a flat sheet with a smooth object: tangent, or rolling on it.

All vectors are in the object's frame.  The sheet's frame has x from the left edge to the right, y
along the edges and z out of the object; a point on the sheet is (x, y) in it.  Rolling without slip
or spin moves the sheet's axes along the contact's path by parallel transport.  The contact's path
on the sheet is the development of that on the object: the arc AB is as long as A'B on the sheet
(the paper's Fig. 7b, for any smooth shape).  Source: do Carmo, Differential Geometry of Curves and
Surfaces, section 4-4.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import atan2, sqrt

import numpy as np
from numpy.typing import NDArray

from flexsheet.nodes.models.rigid import angle_between, transform
from flexsheet.nodes.models.shapes import Nearest, Shape

Floats = NDArray[np.float64]

MIN_STEP_RATIO = 1.0 / 512.0
"""Resolution of the search for the last point within the tilt, over the distance searched."""

MIN_INNER_STEP_RATIO, NEAR_LIMIT_RAD = MIN_STEP_RATIO / 4.0**5, np.radians(1.0)
"""Resolution where the search passes far inside the object: a step there is many degrees on the
surface.  It applies until the tilt is within this angle of the limit."""

RIM_RADIUS_M = 0.03
"""Radius around the contact within which the object may rise above the tangent plane."""


@dataclass(frozen=True, slots=True)
class SheetContact:
    """Contact of the sheet with the object.

    point, normal: (3,) of the surface.
    shape_operator: (3, 3), 1/m.
    axes: (3, 3), columns: axes of the sheet; the third is the normal.
    position_sheet_m: (x, y) of the contact on the sheet.
    lift_m: distance of the sheet's plane from the point, where the object is concave.
    """

    point: Floats
    normal: Floats
    shape_operator: Floats
    axes: Floats
    position_sheet_m: Floats
    lift_m: float = 0.0

    @property
    def nearest(self) -> Nearest:
        """Return the contact's surface point as a result of `Shape.closest`."""
        no = np.zeros((), dtype=bool)
        return Nearest(self.point, self.normal, np.zeros(()), self.shape_operator, no, no)

    @property
    def object_from_sheet(self) -> Floats:
        """Return the sheet's pose (4, 4), with its frame at its centre."""
        contact_sheet = np.append(self.position_sheet_m, -self.lift_m)
        return transform(self.axes, self.point - self.axes @ contact_sheet)

    def height_m(self, finger: Floats) -> float:
        """Return the height of a point (3,) above the sheet's plane, negative below it."""
        return float((finger - self.point) @ self.normal) - self.lift_m


def transport_axes(axes: Floats, normal: Floats) -> Floats:
    """Rotate axes (3, 3) by the smallest rotation that maps the third one to `normal`.

    That is parallel transport along the shorter arc between both normals; it is undefined for
    opposite ones.  The result is exactly orthogonal.
    """
    both = axes[:, 2] + normal
    # Two reflections (Householder): one maps the negated third axis to the normal; the one across
    # the plane of the first two axes leaves those unchanged.  This is the smallest rotation.
    result = axes - np.outer(both, both @ axes) * (2.0 / (both @ both))
    result[:, 2] = normal
    return result


def roll_contact(contact: SheetContact, found: Nearest) -> SheetContact:
    """Return the contact after the sheet has rolled to another surface point, a short step away.

    The displacement on the sheet is the chord in the plane half way between both tangent planes,
    scaled from chord to arc.  It is exact on circles, and of third order in the angle elsewhere.
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
    """Return the contact of a sheet at a surface point, waiting for an approaching finger.

    Its axes are those of `home` (3, 3), transported to the normal.  The contact is on the sheet's
    horizontal centre line.  Along x the sheet's centre stays over the object's, within the sheet.
    """
    axes = transport_axes(home, found.normal)
    x = float(np.clip(axes[:, 0] @ found.point, -half_width_m, half_width_m))
    return SheetContact(found.point, found.normal, found.shape_operator, axes, np.array([x, 0.0]))


def compute_rolling_twist(contact: SheetContact, rate: Floats) -> Floats:
    """Return the twist (6,) of the rolling sheet's centre while the contact moves at `rate` (3,).

    Without spin the sheet rotates by n x dn; without slip its point in contact is at rest.
    """
    tangential = rate - contact.normal * (rate @ contact.normal)
    angular = cross(contact.normal, contact.shape_operator @ tangential)
    x, y = contact.position_sheet_m
    to_centre = contact.lift_m * contact.normal - x * contact.axes[:, 0] - y * contact.axes[:, 1]
    return np.concatenate([cross(angular, to_centre), angular])


def compute_tangent_twist(
    contact: SheetContact, rate: Floats, home: Floats, half_width_m: float
) -> Floats:
    """Return the twist (6,) of a sheet that waits while the nearest point moves at `rate` (3,).

    Its axes follow from `home` by the smallest rotation.  With h, the third axis of home, they
    rotate by n x dn and, about the normal n, by -(h x n) dn / (1 + h n).
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
    """Return the cross product (3,); np.cross is several times slower for one pair."""
    (ax, ay, az), (bx, by, bz) = a.tolist(), b.tolist()
    return np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])


def measure_spin_rad(axes: Floats, home: Floats) -> float:
    """Return the rotation about the normal from the transported axes of `home` to `axes`."""
    ready = transport_axes(home, axes[:, 2])
    return atan2(axes[:, 0] @ ready[:, 1], axes[:, 0] @ ready[:, 0])


def limit_tilt(
    shape: Shape, start: Nearest, found: Nearest, front: Floats, max_tilt_rad: float
) -> tuple[Nearest, bool]:
    """Return the last point towards `found` whose normal is within the tilt.

    Also return whether it is another point than `found`.

    start: the surface point from which the search starts, itself within the tilt.  The search
        follows the straight line to `found` in growing steps and projects each onto the surface,
        which keeps it on the sheet's side.  The first step is the smallest one; it suffices for a
        sheet that is at the limit already.
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


def compute_rim_lift_m(shape: Shape, contact: SheetContact) -> float:
    """Return the offset (m) of the tangent plane that clears the object around the contact.

    It is 0 where the object is not concave.  A finger deforms the sheet within `RIM_RADIUS_M`.
    """
    return shape.rise_m(contact.point, contact.normal, RIM_RADIUS_M)


def _normalize(vector: Floats) -> Floats:
    return np.asarray(vector / sqrt(vector @ vector))
