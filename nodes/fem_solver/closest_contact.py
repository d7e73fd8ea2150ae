"""Find the contact point of a fingertip on a smooth shape.

If the fingertip is deep inside the shape, the nearest surface point is ambiguous. Therefore the
choice depends on the previous contact point, called the anchor.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.models.shapes import Shape

MIN_CURVATURE_MARGIN = 0.3
"""The minimum distance of the fingertip from the centre of curvature, divided by the radius of
curvature. At smaller distances, the nearest point is ill-conditioned. The previous contact point is
then used instead."""


@dataclass(frozen=True, slots=True)
class ContactQuery:
    """The contact of a fingertip with the undeformed object.

    surface (3,), normal (3,): pushed surface point, m, and its outward normal. depth_m: depth of
    the fingertip below this point along the normal; negative if the fingertip is outside the
    object. beyond_m: distance of the fingertip beyond the edge of the surface.
    """

    surface: Floats
    normal: Floats
    depth_m: float
    beyond_m: float = 0.0


@dataclass(frozen=True, slots=True)
class ContactAnchor:
    """A surface point (3,), m, that the finger pushes, and its outward normal (3,)."""

    point: Floats
    normal: Floats


def locate(
    shape: Shape, point: Floats, anchor: ContactAnchor | None
) -> tuple[ContactQuery, ContactAnchor | None]:
    """Return the contact of a fingertip at `point` (3,), m, and the anchor for the next call.

    anchor: anchor that the previous call returned; None before the first call. The contact point is
    usually the nearest surface point. In two cases, the anchor is the contact point instead: the
    fingertip is near the centre of curvature, or the nearest point is on the far side of the body.
    Therefore a finger that is pushed through a body remains in contact with the side that it
    entered. Raises ValueError if a coordinate of the point is not finite.
    """
    if not np.isfinite(point).all():
        raise ValueError(
            f"the fingertip position {point} is not finite; check the fingertip messages"
        )
    found = shape.closest(point, previous=None if anchor is None else anchor.point)
    height = float(found.height_m)
    if height > 0.0:
        return _make_query(point, found.point, found.normal, bool(found.on_edge)), None
    if anchor is not None:
        bend = float(np.linalg.eigvalsh(found.shape_operator)[-1])
        if 1.0 + height * bend < MIN_CURVATURE_MARGIN or found.normal @ anchor.normal <= 0.0:
            return _make_query(point, anchor.point, anchor.normal, False), anchor
    query = _make_query(point, found.point, found.normal, bool(found.on_edge))
    return query, ContactAnchor(found.point, found.normal)


def _make_query(
    point: Floats, surface_point: Floats, normal: Floats, on_edge: bool
) -> ContactQuery:
    """Return the contact of a fingertip at `point` (3,) with a tangent plane of the object.

    surface_point, normal (3,): point at which the plane touches the object, and its outward normal.
    on_edge: whether this point is on the edge of the touchable surface.
    """
    depth = float((surface_point - point) @ normal)
    surface = point + depth * normal
    return ContactQuery(
        surface=surface,
        normal=normal,
        depth_m=depth,
        beyond_m=float(np.linalg.norm(surface - surface_point)) if on_edge else 0.0,
    )
