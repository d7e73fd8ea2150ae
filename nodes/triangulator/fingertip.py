"""One stereo pair to one fingertip: marks, triangulation, and the reasons why there is none."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from messages.types import FingertipReason
from nodes.models import rigid
from nodes.triangulator.mark import Centroid, MarkLooks, find_mark_near
from nodes.triangulator.tracking import Expected
from nodes.triangulator.triangulation import Measured, StereoGeometry, Triangulate, measure

Floats = NDArray[np.float64]
Image = NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class Eyesight:
    """How marks are found and triangulated.

    noise_px: standard deviation of a mark's centre in a picture.
    max_reprojection_px: a pair of marks that fit worse are not of one point.
    """

    looks: MarkLooks
    centroid: Centroid
    triangulate: Triangulate
    noise_px: float
    max_reprojection_px: float


def locate(
    left: Image,
    right: Image,
    *,
    geometry: StereoGeometry,
    eyesight: Eyesight,
    volume: tuple[Floats, Floats],
    expected: Expected | None,
) -> tuple[FingertipReason, Measured | None]:
    """Where the mark is in a pair of pictures (height, width), or why that is not known.

    volume: least and greatest corner of the box where a fingertip can be, world.  The measurement
    is given where the rays meet at all, even when the reason is not "ok".
    """
    places: tuple[Floats | None, Floats | None] = (None, None)
    if expected is not None and _in_front(geometry, expected.point):
        places = geometry.project(expected.point)
    left_marks, right_marks = (
        find_mark_near(image, eyesight.looks, eyesight.centroid, place)
        for image, place in zip((left, right), places, strict=True)
    )
    if not left_marks and not right_marks:
        return "no_mark", None
    if len(left_marks) > 1 or len(right_marks) > 1:
        return "two_marks", None
    if not left_marks or not right_marks:
        return "mark_in_one_view", None
    measured = measure(
        geometry,
        left_marks[0],
        right_marks[0],
        method=eyesight.triangulate,
        noise_px=eyesight.noise_px,
    )
    if measured is None or measured.reprojection_px > eyesight.max_reprojection_px:
        return "inconsistent", measured
    if (measured.point_world < volume[0]).any() or (measured.point_world > volume[1]).any():
        return "outside_volume", measured
    return "ok", measured


def _in_front(geometry: StereoGeometry, point_world: Floats) -> bool:
    in_left = rigid.apply(geometry.left_from_world, point_world)
    return bool(in_left[2] > 0 and rigid.apply(geometry.right_from_left, in_left)[2] > 0)
