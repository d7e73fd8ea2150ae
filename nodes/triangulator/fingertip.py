"""One stereo pair to one fingertip: marks, pairs of them, triangulation, and why there is none."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

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
class Candidate:
    """What could be the finger's mark.

    looks: (2,) logarithms of its level and of its surroundings', the mean of both views.
    """

    measured: Measured
    looks: Floats

    @property
    def point(self) -> Floats:
        """World position (3,), m."""
        return self.measured.point_world


@dataclass(frozen=True, slots=True)
class Sighting:
    """What was found in a pair of pictures.

    reason, measured: as by `locate`.
    marks: all that look like a mark and are where the finger can be, the likeliest first.
    others: those that look like one and are elsewhere.
    """

    reason: FingertipReason
    measured: Measured | None
    marks: tuple[Candidate, ...] = ()
    others: tuple[Candidate, ...] = ()


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
    images, origins = (left, right), (left_origin_px, right_origin_px)
    sight = Sight(images, origins, geometry, eyesight, volume, _finite(expected))
    found = _seen(sight, _windows(sight))
    return found.reason, found.measured


def look(
    left: Image,
    right: Image,
    *,
    geometry: StereoGeometry,
    eyesight: Eyesight,
    volume: tuple[Floats, Floats],
    expected: Expected | None,
    left_origin_px: Origin = (0, 0),
    right_origin_px: Origin = (0, 0),
) -> Sighting:
    """As `locate`, and all marks that are not the one.

    Where the finger is not found in its window the whole pictures are searched for them.
    """
    images, origins = (left, right), (left_origin_px, right_origin_px)
    sight = Sight(images, origins, geometry, eyesight, volume, _finite(expected))
    windows = _windows(sight)
    found = _seen(sight, windows)
    if found.reason != "ok" and windows != (None, None):
        found = replace(found, others=_found_in(sight, (None, None)).others)
    return found


def _finite(expected: Expected | None) -> Expected | None:
    """An expected place that is no number is none."""
    return expected if expected is not None and np.isfinite(expected.point).all() else None


def _seen(sight: Sight, windows: tuple[Window | None, Window | None]) -> Sighting:
    found = _found_in(sight, windows)
    if found.reason != "ok" and _dazzled(sight, windows):
        return replace(found, reason="saturated")
    return found


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


def _found_in(sight: Sight, windows: tuple[Window | None, Window | None]) -> Sighting:
    """What is in one window of each picture, or in all of it."""
    left, right = (
        find_spots(image, sight.eyesight.looks, window)
        for image, window in zip(sight.images, windows, strict=True)
    )
    if not left and not right:
        return Sighting("no_mark", None)
    if not left or not right:
        return Sighting("mark_in_one_view", None)
    pairs = _pairs(sight, left, right)
    likely = [pair for pair in pairs if pair.lack is None]
    near = [pair for pair in likely if pair.away <= 1.0]
    others = _sound(sight, _closely(sight, [pair for pair in likely if pair.away > 1.0]))
    if near:
        return replace(_chosen(sight, near), others=others)
    if likely:
        nearest = min(likely, key=lambda pair: pair.away)
        measured = _measured(sight, _refined(sight, [nearest])[0])
        return Sighting("too_fast", measured, others=others)
    if not pairs:
        return Sighting("inconsistent", None)
    nearest = min(pairs, key=lambda pair: (pair.lack != "outside_volume", pair.cost))
    measured = _measured(sight, _refined(sight, [nearest])[0])
    return Sighting(nearest.lack or "inconsistent", measured)


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


@dataclass(frozen=True, slots=True)
class Refined:
    """A pair whose spots were looked at closely.

    flaw: what speaks against it, if anything does.
    cost: of the pair and of the refined sizes, in squared standard deviations.
    """

    pair: Pair
    marks: tuple[Mark, Mark]
    flaw: FingertipReason | None
    cost: float


def _chosen(sight: Sight, likely: list[Pair]) -> Sighting:
    """The mark among pairs that could be one, at least one.

    Of several that match about as well only those stay that are discs when looked at closely.
    """
    refined = _closely(sight, likely)
    rivals = [one for one in refined if one.pair.cost < refined[0].pair.cost + MARGIN]
    sound = sorted((one for one in rivals if one.flaw is None), key=lambda one: one.cost)
    marks = _sound(sight, refined)
    if not sound:
        return Sighting(rivals[0].flaw or "merged", _measured(sight, rivals[0].marks), marks)
    if len(sound) > 1 and sound[1].cost < sound[0].cost + MARGIN:
        return Sighting("two_marks", _measured(sight, sound[0].marks), marks)
    reason, measured = _judged(sight, _measured(sight, sound[0].marks))
    return Sighting(reason, measured, marks)


def _closely(sight: Sight, pairs: list[Pair]) -> list[Refined]:
    """Pairs refined, the best first."""
    ordered = sorted(pairs, key=lambda pair: pair.cost)
    found = []
    for pair, marks in zip(ordered, _refined(sight, ordered), strict=True):
        flaw = _flaw(sight, pair, marks)
        cost = math.inf if flaw else pair.cost + _fitted_cost(sight, pair, marks)
        found.append(Refined(pair, marks, flaw, cost))
    return found


def _sound(sight: Sight, refined: Sequence[Refined]) -> tuple[Candidate, ...]:
    """The marks among refined pairs, the best first.

    Spots of two marks may match across.  A pair is left out when better ones have both its spots,
    or one clearly better one has one of them.
    """
    kept: list[Refined] = []
    for one in sorted((one for one in refined if one.flaw is None), key=lambda one: one.cost):
        left = [other for other in kept if other.pair.left is one.pair.left]
        right = [other for other in kept if other.pair.right is one.pair.right]
        clearly = any(other.cost + MARGIN <= one.cost for other in left + right)
        if not clearly and not (left and right):
            kept.append(one)
    found = []
    for one in kept:
        reason, measured = _judged(sight, _measured(sight, one.marks))
        if reason == "ok" and measured is not None:
            found.append(Candidate(measured, _looks(one.pair)))
    return tuple(found)


def _looks(pair: Pair) -> Floats:
    levels = [(spot.peak, max(spot.surround, 1.0)) for spot in (pair.left, pair.right)]
    return np.asarray(np.log(levels).mean(axis=0))


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
    given, hidden = sight.eyesight.noise_px, _hidden_px2(marks) * np.eye(2)
    left, right = (
        (mark.covariance if given is None else given**2 * np.eye(2)) + hidden for mark in marks
    )
    return measure(
        sight.geometry,
        marks[0].centre + sight.origins[0],
        marks[1].centre + sight.origins[1],
        method=sight.eyesight.triangulate,
        left_covariance=left,
        right_covariance=right,
    )


def _hidden_px2(marks: tuple[Mark, Mark]) -> float:
    """Variance of a centre, by how much one mark is smaller than its mate.

    What hides a sliver of a disc, or adds one, makes it smaller or larger by half the sliver's
    width, and moves its centre by as much.  What the method's radii are off by chance is no sliver.
    """
    one, other = marks
    chance = one.radius * math.hypot(one.radius_deviation, other.radius_deviation)
    return max((one.radius - other.radius) ** 2 - chance**2, 0.0)


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
