"""One stereo pair to one fingertip: marks, pairs of them, triangulation, and why there is none."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from messages.types import FingertipReason
from nodes.triangulator.mark import (
    SHARP_PX,
    Mark,
    MarkLooks,
    Refine,
    Spot,
    Window,
    find_spots,
    overexposed,
    window_around,
)
from nodes.triangulator.subpixel import PixelNoise
from nodes.triangulator.tracking import Expected
from nodes.triangulator.triangulation import (
    Approach,
    Measured,
    StereoGeometry,
    Triangulate,
    measure,
    pixel_and_slope,
    ray_of,
)

Floats = NDArray[np.float64]
Image = NDArray[np.uint8]
Origin = tuple[int, int]

SIZE_DEVIATION = 0.2
"""Of a spot's radius against a mark's at its depth, as a logarithm."""

HEIGHT_DEVIATION = 0.25
"""Between the heights of one mark in both views, as a logarithm: lenses and angles differ."""

MISFIT_DEVIATION_PX = 0.5
"""By which the rays of one mark miss one another before its centres are refined."""

LARGEST_SIZE_OFF = 0.6
"""Logarithm of a size beyond which a spot is no mark: not within 0.55 to 1.8 times its size."""

SIZE_SIGMAS = 3.5
MARK_SIZE_DEVIATION = 0.035
"""A refined mark has its size within so many standard deviations, this being that of marks beside
the method's own; one that has not is partly hidden or runs into a light."""

MATE_SIGMAS = 4.5
MOTION_APART_PX = 2.5
"""A mark has about the same size and motion in both views (the distance hardly changes during an
exposure); one that has not is partly hidden in one of them, or runs into a light there."""

WINDOW_MARGIN_PX = 5
"""Of a window around the mark itself, so that its surroundings are in it."""

REACH_SIGMAS = 4.0
"""A finger that is expected somewhere is near there; its reach is so many standard deviations."""

MARGIN = 9.0
"""A pair is the mark's when every other one is worse by as much, in squared standard deviations:
by three of them in one thing, or a little in many."""


@dataclass(frozen=True, slots=True)
class Eyesight:
    """How marks are found, refined and triangulated.

    noise_px: standard deviation of a mark's centre; None: as the method states for each mark.
    max_reprojection_px: a pair of marks that fit worse are not of one point.
    mark_radius_m: of the mark, which has its size at its depth.
    max_deviation_m: a point less certain is refused.
    """

    looks: MarkLooks
    refine: Refine
    triangulate: Triangulate
    max_reprojection_px: float
    noise_px: float | None = None
    mark_radius_m: float = 0.003
    max_deviation_m: float = 0.002
    sensor: PixelNoise = field(default_factory=PixelNoise)


@dataclass(frozen=True, slots=True)
class Pair:
    """A spot in the left and one in the right picture that could be one mark.

    depth_m: from the left camera, of where their rays meet.
    away: distance from the expected place as a share of the reach; 0 where none is expected.
    cost: how badly they match one another, a mark's looks and the expected place, in squared
        standard deviations.
    lack: why it is no mark in the volume, if so.
    """

    left: Spot
    right: Spot
    depth_m: float
    away: float
    cost: float
    lack: FingertipReason | None


@dataclass(frozen=True, slots=True)
class Sight:
    """What one call of `locate` has to do with: both views, and what is known beforehand."""

    images: tuple[Image, Image]
    origins: tuple[Origin, Origin]
    geometry: StereoGeometry
    eyesight: Eyesight
    volume: tuple[Floats, Floats]
    expected: Expected | None


def locate(
    left: Image,
    right: Image,
    *,
    geometry: StereoGeometry,
    eyesight: Eyesight,
    volume: tuple[Floats, Floats],
    expected: Expected | None,
    left_origin_px: Origin = (0, 0),
    right_origin_px: Origin = (0, 0),
) -> tuple[FingertipReason, Measured | None]:
    """Where the mark is in a pair of pictures (height, width), or why that is not known.

    volume: least and greatest corner of the box where a fingertip can be, world.
    expected: where it should be, and within which reach: only there is it looked for, since no
        other light can be the finger then.  None: all of both pictures is searched, and only one
        pair of spots may look like a mark.
    origins: column and row of the sensor where each picture begins.

    A measurement is given where two rays meet at all, even when the reason is not "ok".
    """
    if expected is not None and not np.isfinite(expected.point).all():
        expected = None
    sight = Sight(
        (left, right), (left_origin_px, right_origin_px), geometry, eyesight, volume, expected
    )
    windows = _windows(sight)
    reason, measured = _found_in(sight, windows)
    if reason != "ok" and _dazzled(sight, windows):
        return "saturated", measured
    return reason, measured


def _windows(sight: Sight) -> tuple[Window | None, Window | None]:
    """Where in both pictures the mark can be; None twice: anywhere, or not in both."""
    if sight.expected is None:
        return None, None
    geometry, found = sight.geometry, list[Window]()
    in_left = geometry.left_from_world[:3, :3] @ sight.expected.point
    in_left += geometry.left_from_world[:3, 3]
    in_right = geometry.right_from_left[:3, :3] @ in_left + geometry.right_from_left[:3, 3]
    for view, point in enumerate((in_left, in_right)):
        depth_m = float(point[2]) - sight.expected.reach_m
        if depth_m <= 0:
            return None, None
        pixel = pixel_and_slope(point, geometry.matrices[view], geometry.distortions[view])[0]
        reach_px = _focal_px(geometry) * (
            (sight.expected.reach_m + sight.eyesight.mark_radius_m) / depth_m
        )
        window = window_around(
            pixel - sight.origins[view],
            sight.images[view].shape,
            max(sight.eyesight.looks.window_half_px, math.ceil(reach_px) + WINDOW_MARGIN_PX),
        )
        if window is None:
            return None, None
        found.append(window)
    return found[0], found[1]


def _dazzled(sight: Sight, windows: tuple[Window | None, Window | None]) -> bool:
    """Whether a picture, or the place where the mark should be, is too bright to tell."""
    return any(
        overexposed(image) or overexposed(image, window)
        for image, window in zip(sight.images, windows, strict=True)
    )


def _found_in(
    sight: Sight, windows: tuple[Window | None, Window | None]
) -> tuple[FingertipReason, Measured | None]:
    """As `locate`, in one window of each picture, or in all of it."""
    left, right = (
        find_spots(image, sight.eyesight.looks, window)
        for image, window in zip(sight.images, windows, strict=True)
    )
    if not left and not right:
        return "no_mark", None
    if not left or not right:
        return "mark_in_one_view", None
    pairs = _pairs(sight, left, right)
    likely = [pair for pair in pairs if pair.lack is None]
    near = [pair for pair in likely if pair.away <= 1.0]
    if near:
        return _chosen(sight, near)
    if likely:
        nearest = min(likely, key=lambda pair: pair.away)
        return "too_fast", _measured(sight, _refined(sight, [nearest])[0])
    if not pairs:
        return "inconsistent", None
    nearest = min(pairs, key=lambda pair: (pair.lack != "outside_volume", pair.cost))
    return nearest.lack or "inconsistent", _measured(sight, _refined(sight, [nearest])[0])


def _pairs(sight: Sight, left: Sequence[Spot], right: Sequence[Spot]) -> list[Pair]:
    """All pairs of spots whose rays meet in front of the cameras.

    A mark's rays meet in the volume, and there it has the size that is seen.
    """
    geometry, eyesight, expected = sight.geometry, sight.eyesight, sight.expected
    left_rays, right_rays = (
        [ray_of(np.add(spot.centre, origin), matrix, distortion) for spot in spots]
        for spots, origin, matrix, distortion in zip(
            (left, right), sight.origins, geometry.matrices, geometry.distortions, strict=True
        )
    )
    focal_px, world = _focal_px(geometry), geometry.world_from_left
    approach = Approach.of(geometry.right_from_left)
    pairs = []
    for one, left_ray in zip(left, left_rays, strict=True):
        for other, right_ray in zip(right, right_rays, strict=True):
            if left_ray is None or right_ray is None:
                continue
            met = approach.of_rays(left_ray, right_ray)
            if met is None:
                continue
            point, gap_m = met
            depth_m = float(point[2])
            misfit_px = 0.5 * focal_px * gap_m / depth_m
            sizes = [_size_off(sight, spot.radius, depth_m) for spot in (one, other)]
            point_world = world[:3, :3] @ point + world[:3, 3]
            lack: FingertipReason | None = None
            if misfit_px > eyesight.max_reprojection_px or max(sizes) > LARGEST_SIZE_OFF:
                lack = "inconsistent"
            elif not _inside(sight.volume, point_world):
                lack = "outside_volume"
            away = 0.0
            if expected is not None:
                away = math.dist(point_world, expected.point) / max(expected.reach_m, 1e-6)
            cost = (
                (misfit_px / MISFIT_DEVIATION_PX) ** 2
                + (sizes[0] ** 2 + sizes[1] ** 2) / SIZE_DEVIATION**2
                + (math.log(one.height / other.height) / HEIGHT_DEVIATION) ** 2
                + (REACH_SIGMAS * away) ** 2
            )
            pairs.append(Pair(one, other, depth_m, away, cost, lack))
    return pairs


def _chosen(sight: Sight, likely: list[Pair]) -> tuple[FingertipReason, Measured | None]:
    """The mark among pairs that could be one, at least one.

    Of several that match about as well only those stay that are discs when looked at closely.
    """
    rivals = _rivals(likely)
    marks = _refined(sight, rivals)
    flaws = [_flaw(sight, pair, both) for pair, both in zip(rivals, marks, strict=True)]
    sound = [i for i, flaw in enumerate(flaws) if flaw is None]
    if not sound:
        return flaws[0] or "merged", _measured(sight, marks[0])
    if len(sound) > 1:
        costs = [rivals[i].cost + _fitted_cost(sight, rivals[i], marks[i]) for i in sound]
        best = int(np.argmin(costs))
        if any(cost < costs[best] + MARGIN for i, cost in enumerate(costs) if i != best):
            return "two_marks", _measured(sight, marks[sound[best]])
        sound = [sound[best]]
    return _judged(sight, _measured(sight, marks[sound[0]]))


def _rivals(pairs: list[Pair]) -> list[Pair]:
    """The best pair, and after it those that are not worse by the margin."""
    order = sorted(pairs, key=lambda pair: pair.cost)
    return [pair for pair in order if pair.cost < order[0].cost + MARGIN]


def _refined(sight: Sight, pairs: Sequence[Pair]) -> list[tuple[Mark, Mark]]:
    """The marks of pairs, all refined at once."""
    eyesight = sight.eyesight
    images = [image for _ in pairs for image in sight.images]
    spots = [spot for pair in pairs for spot in (pair.left, pair.right)]
    marks = eyesight.refine(images, spots, eyesight.looks, eyesight.sensor)
    return list(zip(marks[::2], marks[1::2], strict=True))


def _flaw(sight: Sight, pair: Pair, marks: tuple[Mark, Mark]) -> FingertipReason | None:
    """What speaks against a refined pair: a flaw of either mark, a wrong size, or no likeness."""
    for mark in marks:
        if mark.flaw is not None:
            return mark.flaw
        deviation = math.hypot(MARK_SIZE_DEVIATION, mark.radius_deviation)
        if _size_off(sight, mark.radius, pair.depth_m) > SIZE_SIGMAS * deviation:
            return "blurred" if mark.blur > SHARP_PX else "merged"
    one, other = marks
    apart_px = min(
        math.dist(one.motion, other.motion),
        math.hypot(one.motion[0] + other.motion[0], one.motion[1] + other.motion[1]),
    )
    deviation = math.hypot(one.radius_deviation, other.radius_deviation)
    if apart_px > MOTION_APART_PX or abs(math.log(one.radius / other.radius)) > (
        MATE_SIGMAS * deviation
    ):
        return "merged"
    return None


def _fitted_cost(sight: Sight, pair: Pair, marks: tuple[Mark, Mark]) -> float:
    """How badly the refined sizes match a mark's, in squared standard deviations."""
    sizes = (
        _size_off(sight, mark.radius, pair.depth_m)
        / math.hypot(MARK_SIZE_DEVIATION, mark.radius_deviation)
        for mark in marks
    )
    return sum(size**2 for size in sizes)


def _size_off(sight: Sight, radius_px: float, depth_m: float) -> float:
    """Logarithm of a radius over what a mark's is at that depth, without its sign."""
    expected_px = _focal_px(sight.geometry) * sight.eyesight.mark_radius_m / depth_m
    return abs(math.log(radius_px / expected_px))


def _focal_px(geometry: StereoGeometry) -> float:
    """Of both cameras, whose focal lengths are nearly equal."""
    return 0.5 * float(geometry.matrices[0][0, 0] + geometry.matrices[1][0, 0])


def _inside(volume: tuple[Floats, Floats], point_world: Floats) -> bool:
    return bool((point_world >= volume[0]).all() and (point_world <= volume[1]).all())


def _measured(sight: Sight, marks: tuple[Mark, Mark]) -> Measured | None:
    """The point behind two refined marks."""
    given = sight.eyesight.noise_px
    left, right = (mark.covariance if given is None else given**2 * np.eye(2) for mark in marks)
    return measure(
        sight.geometry,
        marks[0].centre + sight.origins[0],
        marks[1].centre + sight.origins[1],
        method=sight.eyesight.triangulate,
        left_covariance=left,
        right_covariance=right,
    )


def _judged(sight: Sight, measured: Measured | None) -> tuple[FingertipReason, Measured | None]:
    """Whether a measurement is one of a fingertip.

    One that is too uncertain is refused: rays that are nearly parallel meet anywhere.
    """
    eyesight = sight.eyesight
    if (
        measured is None
        or measured.reprojection_px > eyesight.max_reprojection_px
        or measured.deviation_m > eyesight.max_deviation_m
    ):
        return "inconsistent", measured
    if not _inside(sight.volume, measured.point_world):
        return "outside_volume", measured
    return "ok", measured
