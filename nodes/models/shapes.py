"""Rigid shapes of the virtual objects: signed distance, closest point, normal, curvature.

Points and normals are (3,) arrays in the object's frame, lengths in metres.  Each shape answers
`closest(point)`; what is undefined (the axis of a cylinder, an edge) is decided here once, always
the same way, so that the sheet never meets it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class SurfacePoint:
    """The surface point nearest to a query.

    distance_m: of the query, negative inside the object.
    on_edge: the nearest point lies on a rim, or several are equally near; the normal was decided.
    """

    point: Floats
    normal: Floats
    distance_m: float
    on_edge: bool


class Shape(Protocol):
    def closest(self, point: Floats, *, fallback_normal: Floats) -> SurfacePoint:
        """The nearest touchable surface point; `fallback_normal` decides where all are equal."""
        ...


@dataclass(frozen=True, slots=True)
class CylinderShape:
    """Circular cylinder about the x axis.

    Only its side is touchable: the sheet is held along x, so a finger beyond an end cap is given
    the rim's nearest point of the side, flagged `on_edge`.
    """

    radius_m: float
    length_m: float

    def closest(self, point: Floats, *, fallback_normal: Floats) -> SurfacePoint:
        """See `Shape`.  On the axis the direction comes from `fallback_normal` (its y, z part)."""
        radial = np.array([0.0, point[1], point[2]])
        radius = float(np.hypot(point[1], point[2]))
        undecided = radius < 1e-6
        if undecided:
            radial = np.array([0.0, fallback_normal[1], fallback_normal[2]])
        normal = radial / np.linalg.norm(radial)
        half = 0.5 * self.length_m
        beyond = abs(point[0]) - half
        surface = normal * self.radius_m
        surface[0] = np.clip(point[0], -half, half)
        distance = radius - self.radius_m
        if beyond > 0:
            distance = float(np.hypot(max(distance, 0.0), beyond))
        return SurfacePoint(surface, normal, distance, undecided or bool(beyond > 0))

    def angle_rad(self, point: Floats) -> float:
        """Angle of a point about the axis, 0 on +z, growing towards +y."""
        return float(np.arctan2(point[1], point[2]))

    def normal_curvatures(self) -> tuple[float, float]:
        """Principal curvatures (1/m): along the axis, and around it; positive is convex."""
        return 0.0, 1.0 / self.radius_m
