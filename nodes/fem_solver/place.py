"""Where a fingertip meets a smooth shape, also deep inside it, where no place is the nearest."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nodes.models.shapes import Shape

Floats = NDArray[np.float64]

LEAST_ROOM = 0.3
"""The nearest place counts as long as the fingertip is this share of the surface's radius of
curvature or more away from its centre of curvature; from there on it would move ever faster."""


@dataclass(frozen=True, slots=True)
class Push:
    """Where a fingertip meets the undeformed object.

    normal: outward, of the surface point that is pushed.  depth_m: of the fingertip below it, along
    the normal; negative outside.  beyond_m: how far the fingertip is past the end of the surface.
    drag_m (3,): how far the fingertip went along the surface since it stuck there; None: it slides.
    """

    surface: Floats
    normal: Floats
    depth_m: float
    beyond_m: float = 0.0
    drag_m: Floats | None = None


@dataclass(frozen=True, slots=True)
class Entry:
    """Where a finger is in the object: the place (3,) that it pushes, and its normal (3,)."""

    point: Floats
    normal: Floats


def locate(shape: Shape, point: Floats, held: Entry | None) -> tuple[Push, Entry | None]:
    """The push of a fingertip at `point` (3,), and what to hand in as `held` the next time.

    The place is the nearest one, except close to its centre of curvature, and where the nearest
    one is on the far side of where the finger went in: there `held` stays.  So a finger pushed
    through a body does not come out of the other side.  ValueError for a point that is not finite.
    """
    if not np.isfinite(point).all():
        raise ValueError(f"fingertip {point} is not finite")
    found = shape.closest(point, previous=None if held is None else held.point)
    height = float(found.height_m)
    if height > 0.0:
        return _push(point, found.point, found.normal, bool(found.on_edge)), None
    if held is not None:
        bend = float(np.linalg.eigvalsh(found.shape_operator)[-1])
        if 1.0 + height * bend < LEAST_ROOM or found.normal @ held.normal <= 0.0:
            return _push(point, held.point, held.normal, False), held
    push = _push(point, found.point, found.normal, bool(found.on_edge))
    return push, Entry(found.point, found.normal)


def locate_stuck(shape: Shape, point: Floats, held: Entry | None) -> tuple[Push, Entry | None]:
    """The push of a fingertip at `point` (3,) that sticks to the surface where it first touched it.

    held: that place, from the time before.  ValueError as `locate`.
    """
    push, entry = locate(shape, point, held)
    if entry is None or held is None:
        return push, entry
    depth = float((held.point - point) @ held.normal)
    if depth <= 0.0:
        # it has left the place that it stuck to, and touches another
        return push, entry
    drag = point - held.point + depth * held.normal
    return Push(held.point, held.normal, depth, push.beyond_m, drag), held


def slipped(shape: Shape, held: Entry, drag: Floats, share: float) -> Entry:
    """Where a finger sticks after it slid on until only `share` of its drag (3,) is left."""
    found = shape.closest(held.point + (1.0 - share) * drag, previous=held.point)
    return Entry(found.point, found.normal)


def _push(point: Floats, foot: Floats, normal: Floats, on_edge: bool) -> Push:
    """Of a fingertip above or below the tangent plane at a foot."""
    depth = float((foot - point) @ normal)
    surface = point + depth * normal
    return Push(
        surface=surface,
        normal=normal,
        depth_m=depth,
        beyond_m=float(np.linalg.norm(surface - foot)) if on_edge else 0.0,
    )
