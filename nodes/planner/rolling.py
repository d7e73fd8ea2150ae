"""A flat sheet on a smooth object: tangent, rolling without slip or spin, never turned too far.

All in the object's frame.  The sheet's frame has x from the left edge to the right, y along the
edges and z out of the object; a place on the sheet is (x, y) in it.  Rolling carries the sheet's
axes along the contact's path by parallel transport, and the contact's way on the sheet is the
path's development: the arc AB on the object is as long as A'B on the sheet (the paper's Fig. 7b,
for any smooth shape; do Carmo, Differential Geometry of Curves and Surfaces, section 4-4).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from nodes.models.rigid import angle_between, transform, twist_between
from nodes.models.shapes import Nearest, Shape

Floats = NDArray[np.float64]

RATE_STEP_S = 1e-3
"""Half the time over which twists are taken as differences: finer than any motion of a hand."""

SEARCH_POINTS = 9
SEARCH_ROUNDS = 3
"""The last place within the tilt is found to 1/512 of the way."""

RIM_RADII_M = (0.012, 0.03)
RIM_POINTS = 12
"""Where it is looked whether the object rises above its own tangent plane."""


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


def moved_along(contact: Contact, rate: Floats, duration_s: float) -> Nearest:
    """The surface point to first order `duration_s` later, when it moves at `rate` (3,) m/s."""
    point = contact.point + duration_s * rate
    normal = _unit(contact.normal + duration_s * (contact.shape_operator @ rate))
    nowhere = np.zeros((), dtype=bool)
    return Nearest(point, normal, np.zeros(()), contact.shape_operator, nowhere, nowhere)


def rolling_twist(contact: Contact, rate: Floats) -> Floats:
    """Twist (6,) of the rolling sheet's middle while the contact moves at `rate` (3,) m/s."""
    before, after = (
        rolled(contact, moved_along(contact, rate, time_s)).object_from_sheet
        for time_s in (-RATE_STEP_S, RATE_STEP_S)
    )
    return twist_between(before, after, 2.0 * RATE_STEP_S)


def tangent_twist(contact: Contact, rate: Floats, home: Floats, half_width_m: float) -> Floats:
    """Twist (6,) of the sheet held ready while the point under the finger moves at `rate`."""
    before, after = (
        replace(
            tangent(home, moved_along(contact, rate, time_s), half_width_m), lift_m=contact.lift_m
        ).object_from_sheet
        for time_s in (-RATE_STEP_S, RATE_STEP_S)
    )
    return twist_between(before, after, 2.0 * RATE_STEP_S)


def spin_rad(axes: Floats, home: Floats) -> float:
    """How far the sheet is turned about its normal from how it would be held ready there."""
    ready = turned(home, axes[:, 2])
    return float(np.arctan2(axes[:, 0] @ ready[:, 1], axes[:, 0] @ ready[:, 0]))


def within_tilt(
    shape: Shape, start: Floats, found: Nearest, front: Floats, tilt_rad: float
) -> tuple[Nearest, bool]:
    """The last point towards `found` whose normal is within the tilt, and whether it is another.

    start: surface point (3,) to come from, itself within the tilt.  The way is looked at along the
    straight line from there, point by point, so that the side is kept on which the sheet is.
    """
    most = np.cos(tilt_rad)
    if found.normal @ front >= most:
        return found, False
    begin, end = 0.0, 1.0
    best = shape.closest(start, previous=start)
    for _ in range(SEARCH_ROUNDS):
        shares = np.linspace(begin, end, SEARCH_POINTS)[1:]
        places = start + shares[:, None] * (found.point - start)
        there = shape.closest(places, previous=np.tile(start, (len(places), 1)))
        outside = ~(there.normal @ front >= most)
        inside = int(np.argmax(outside)) if outside.any() else len(shares)
        if inside:
            best = _pick(there, inside - 1)
        step = (end - begin) / (SEARCH_POINTS - 1)
        begin = begin + inside * step
        end = min(begin + step, 1.0)
    return best, True


def rim_lift_m(shape: Shape, contact: Contact) -> float:
    """How far the tangent plane must stand off its point to clear the object around it (m).

    0 where the object is not hollow.  Looked at on two rings about the point, as wide as the part
    of the sheet that a finger pulls down with it.
    """
    turns = np.arange(RIM_POINTS) * (2.0 * np.pi / RIM_POINTS)
    ring = np.stack([np.cos(turns), np.sin(turns)], axis=1)
    places = np.concatenate([radius * ring for radius in RIM_RADII_M]) @ contact.axes[:, :2].T
    return max(0.0, -float(shape.signed_distance(contact.point + places).min()))


def _pick(found: Nearest, index: int) -> Nearest:
    return Nearest(
        found.point[index],
        found.normal[index],
        found.height_m[index],
        found.shape_operator[index],
        found.on_edge[index],
        found.undecided[index],
    )


def _unit(vector: Floats) -> Floats:
    return np.asarray(vector / np.linalg.norm(vector))
