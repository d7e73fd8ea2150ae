"""Find the contact point of a fingertip on a smooth shape, also deep inside it.

Deep inside, the nearest surface point is ambiguous.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flexsheet.nodes.models.shapes import Shape

Floats = NDArray[np.float64]

MIN_CURVATURE_MARGIN = 0.3
"""Minimum distance of the fingertip from the centre of curvature, over the radius of curvature.
Below it the nearest point is ill-conditioned, and the anchor is not moved."""


@dataclass(frozen=True, slots=True)
class ContactQuery:
    """Contact of a fingertip with the undeformed object.

    surface (3,), normal (3,): pushed surface point and its outward normal. depth_m: depth of the
    fingertip below that point along the normal, negative outside. beyond_m: distance of the
    fingertip past the end of the surface. drag_m (3,): displacement of the fingertip along the
    surface since it stuck there; None for a sliding finger.
    """

    surface: Floats
    normal: Floats
    depth_m: float
    beyond_m: float = 0.0
    drag_m: Floats | None = None


@dataclass(frozen=True, slots=True)
class ContactAnchor:
    """Surface point (3,) that a finger pushes, and its normal (3,)."""

    point: Floats
    normal: Floats


def locate(
    shape: Shape, point: Floats, anchor: ContactAnchor | None
) -> tuple[ContactQuery, ContactAnchor | None]:
    """Return the contact of a fingertip at `point` (3,) and the anchor for the next call.

    The contact point is the nearest surface point, except in two cases that use the anchor: near
    the centre of curvature, and where the nearest point is on the far side of the body. A finger
    pushed through a body therefore stays in contact with the side that it entered. Raises
    ValueError for a point that is not finite.
    """
    if not np.isfinite(point).all():
        raise ValueError(f"fingertip position {point} is not finite")
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


def locate_sticking(
    shape: Shape, point: Floats, anchor: ContactAnchor | None
) -> tuple[ContactQuery, ContactAnchor | None]:
    """Return the contact of a fingertip at `point` (3,) that sticks to its first contact point.

    anchor: that point, from the previous call. Raises ValueError as `locate`.
    """
    query, new_anchor = locate(shape, point, anchor)
    if new_anchor is None or anchor is None:
        return query, new_anchor
    depth = float((anchor.point - point) @ anchor.normal)
    if depth <= 0.0:
        # The finger left its anchor and touches another point.
        return query, new_anchor
    drag = point - anchor.point + depth * anchor.normal
    return ContactQuery(anchor.point, anchor.normal, depth, query.beyond_m, drag), anchor


def slide_anchor(
    shape: Shape, anchor: ContactAnchor, drag: Floats, fraction: float
) -> ContactAnchor:
    """Return the anchor after the finger slid until `fraction` of its drag (3,) remains."""
    found = shape.closest(anchor.point + (1.0 - fraction) * drag, previous=anchor.point)
    return ContactAnchor(found.point, found.normal)


def _make_query(
    point: Floats, surface_point: Floats, normal: Floats, on_edge: bool
) -> ContactQuery:
    """Return the contact of a fingertip with the tangent plane at a surface point."""
    depth = float((surface_point - point) @ normal)
    surface = point + depth * normal
    return ContactQuery(
        surface=surface,
        normal=normal,
        depth_m=depth,
        beyond_m=float(np.linalg.norm(surface - surface_point)) if on_edge else 0.0,
    )
