"""Detect the fingertip in a stereo pair: blobs, their matches, triangulation, rejection reasons."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from flexsheet.messages.types import FingertipReason
from flexsheet.nodes.triangulator.flat_marker import DiscView, FlatPose, estimate_flat_pose
from flexsheet.nodes.triangulator.marker import (
    FLAT_METHODS,
    SHARP_PX,
    Blob,
    BlobFilter,
    Marker,
    Refine,
    Window,
    detect_blobs,
    is_overexposed,
    window_around,
)
from flexsheet.nodes.triangulator.subpixel import PixelNoise
from flexsheet.nodes.triangulator.tracking import Gate
from flexsheet.nodes.triangulator.triangulation import (
    ClosestApproach,
    StereoGeometry,
    Triangulate,
    TriangulatedPoint,
    measure,
    project_with_jacobian,
    undistort_pixel,
)

Floats = NDArray[np.float64]
Image = NDArray[np.uint8]
Origin = tuple[int, int]

SIZE_SIGMA = 0.2
"""Standard deviation of the logarithm of a blob's radius over the marker's at that depth."""

HEIGHT_SIGMA = 0.25
"""Standard deviation of the log ratio of a marker's heights in both views."""

MISFIT_SIGMA_PX = 0.5
"""Standard deviation of the distance between a marker's rays before its centres are refined."""

MAX_SIZE_DEVIATION = 0.6
"""Maximum log ratio of a blob's size to the expected one: 0.55 to 1.8 times the size."""

SIZE_SIGMAS = 3.5
MARKER_SIZE_SIGMA = 0.035
"""Bound on a refined marker's size deviation, in standard deviations, and the relative standard
deviation of real markers.  A marker beyond the bound is partly occluded or merged with a light."""

STEREO_SIZE_SIGMAS = 4.5
MAX_MOTION_DIFFERENCE_PX = 2.5
"""Bounds on the differences between both views, in size (standard deviations) and in motion.  A
marker beyond them is partly occluded in one view, or merged with a light there."""

WINDOW_MARGIN_PX = 5
"""Width of the surroundings that a search window includes around the marker."""

GATE_RADIUS_SIGMAS = 4.0
"""Radius of a gate in standard deviations of the expected position."""

MAX_FLAT_PAIRS = 4
"""Maximum number of pairs that are refined as flat markers, those with the lowest costs."""

AMBIGUITY_MARGIN = 9.0
"""Minimum cost difference of a unique match to every other, in squared standard deviations."""


@dataclass(frozen=True, slots=True)
class DetectorConfig:
    """Settings of the detection, refinement and triangulation of markers.

    blob_filter: criteria of a blob.
    refine, triangulate: the methods.
    max_reprojection_px: maximum reprojection error of a pair.
    noise_px: standard deviation of a marker's centre; None for the method's estimate.
    marker_radius_m: true radius of the marker.
    max_deviation_m: maximum standard deviation of a point.
    sensor: noise of the pixels.
    """

    blob_filter: BlobFilter
    refine: Refine
    triangulate: Triangulate
    max_reprojection_px: float
    noise_px: float | None = None
    marker_radius_m: float = 0.003
    max_deviation_m: float = 0.002
    sensor: PixelNoise = field(default_factory=PixelNoise)


@dataclass(frozen=True, slots=True)
class BlobPair:
    """Pair of blobs, left and right, that may be one marker.

    depth_m: depth of the intersection of their rays in the left camera's frame.
    gate_fraction: distance from the gate's centre over its radius; 0 without a gate.
    cost: mismatch of rays, sizes, heights and distance from the gate's centre, in squared standard
        deviations.
    rejection_reason: None if the pair may be a marker in the volume.
    """

    left: Blob
    right: Blob
    depth_m: float
    gate_fraction: float
    cost: float
    rejection_reason: FingertipReason | None


@dataclass(frozen=True, slots=True)
class Candidate:
    """Detection that may be the finger's marker.

    appearance: (2,) logarithms of its level and of its surroundings' level, mean of both views.
    """

    measured: TriangulatedPoint
    appearance: Floats

    @property
    def point(self) -> Floats:
        """Return the world position (3,), m."""
        return self.measured.point_world


@dataclass(frozen=True, slots=True)
class StereoDetection:
    """Detections in an image pair.

    reason, measured: result of `detect`.
    markers: candidates inside the gate, sorted by cost.
    clutter: candidates outside the gate.
    """

    reason: FingertipReason
    measured: TriangulatedPoint | None
    markers: tuple[Candidate, ...] = ()
    clutter: tuple[Candidate, ...] = ()


@dataclass(frozen=True, slots=True)
class DetectionInput:
    """Arguments of `detect`."""

    images: tuple[Image, Image]
    origins: tuple[Origin, Origin]
    geometry: StereoGeometry
    config: DetectorConfig
    volume: tuple[Floats, Floats]
    gate: Gate | None


def detect(
    left: Image,
    right: Image,
    *,
    geometry: StereoGeometry,
    config: DetectorConfig,
    volume: tuple[Floats, Floats],
    gate: Gate | None,
    left_origin_px: Origin = (0, 0),
    right_origin_px: Origin = (0, 0),
) -> tuple[FingertipReason, TriangulatedPoint | None]:
    """Detect the marker in an image pair; return the reason ("ok" if valid) and the point.

    left, right: images (height, width).
    volume: minimum and maximum corner of the finger's volume, world frame, m.
    gate: region to search.  None searches both images, which must then contain one marker only.
    left_origin_px, right_origin_px: column and row of the sensor where each image begins.

    The point is also given for other reasons than "ok" if two rays meet.
    """
    images, origins = (left, right), (left_origin_px, right_origin_px)
    inputs = DetectionInput(images, origins, geometry, config, volume, _finite_gate(gate))
    found = _detect_in(inputs, _search_windows(inputs))
    return found.reason, found.measured


def detect_all(
    left: Image,
    right: Image,
    *,
    geometry: StereoGeometry,
    config: DetectorConfig,
    volume: tuple[Floats, Floats],
    gate: Gate | None,
    left_origin_px: Origin = (0, 0),
    right_origin_px: Origin = (0, 0),
) -> StereoDetection:
    """Detect the fingertip, see `detect`, and all other markers.

    If the fingertip is not found inside its gate, the full images are searched for other markers.
    """
    images, origins = (left, right), (left_origin_px, right_origin_px)
    inputs = DetectionInput(images, origins, geometry, config, volume, _finite_gate(gate))
    windows = _search_windows(inputs)
    found = _detect_in(inputs, windows)
    if found.reason != "ok" and windows != (None, None):
        found = replace(found, clutter=_match_in(inputs, (None, None)).clutter)
    return found


def _finite_gate(gate: Gate | None) -> Gate | None:
    """Return the gate; None if its centre is not finite."""
    return gate if gate is not None and np.isfinite(gate.point).all() else None


def _detect_in(
    inputs: DetectionInput, windows: tuple[Window | None, Window | None]
) -> StereoDetection:
    found = _match_in(inputs, windows)
    if found.reason != "ok" and _is_overexposed(inputs, windows):
        return replace(found, reason="saturated")
    return found


def _search_windows(inputs: DetectionInput) -> tuple[Window | None, Window | None]:
    """Return the window of the gate in each image; None twice without a gate or outside a view."""
    if inputs.gate is None:
        return None, None
    geometry, found = inputs.geometry, list[Window]()
    in_left = geometry.left_from_world[:3, :3] @ inputs.gate.point
    in_left += geometry.left_from_world[:3, 3]
    in_right = geometry.right_from_left[:3, :3] @ in_left + geometry.right_from_left[:3, 3]
    for view, point in enumerate((in_left, in_right)):
        depth_m = float(point[2]) - inputs.gate.radius_m
        if depth_m <= 0:
            return None, None
        pixel = project_with_jacobian(point, geometry.matrices[view], geometry.distortions[view])[0]
        reach_px = _focal_px(geometry) * (
            (inputs.gate.radius_m + inputs.config.marker_radius_m) / depth_m
        )
        window = window_around(
            pixel - inputs.origins[view],
            inputs.images[view].shape,
            max(inputs.config.blob_filter.window_half_px, math.ceil(reach_px) + WINDOW_MARGIN_PX),
        )
        if window is None:
            return None, None
        found.append(window)
    return found[0], found[1]


def _is_overexposed(inputs: DetectionInput, windows: tuple[Window | None, Window | None]) -> bool:
    """Return whether an image or its search window is overexposed."""
    return any(
        is_overexposed(image) or is_overexposed(image, window)
        for image, window in zip(inputs.images, windows, strict=True)
    )


def _match_in(
    inputs: DetectionInput, windows: tuple[Window | None, Window | None]
) -> StereoDetection:
    """Detect markers in one window of each image, or in the full images (None)."""
    left, right = (
        detect_blobs(image, inputs.config.blob_filter, window)
        for image, window in zip(inputs.images, windows, strict=True)
    )
    if not left and not right:
        return StereoDetection("no_marker", None)
    if not left or not right:
        return StereoDetection("marker_in_one_view", None)
    pairs = _match_blobs(inputs, left, right)
    likely = [pair for pair in pairs if pair.rejection_reason is None]
    near = [pair for pair in likely if pair.gate_fraction <= 1.0]
    clutter = _unique_candidates(
        inputs, _refine_and_rank(inputs, [pair for pair in likely if pair.gate_fraction > 1.0])
    )
    if near:
        return replace(_select_pair(inputs, near), clutter=clutter)
    if likely:
        nearest = min(likely, key=lambda pair: pair.gate_fraction)
        measured = _triangulate(inputs, _refine_markers(inputs, [nearest])[0])
        return StereoDetection("too_fast", measured, clutter=clutter)
    if not pairs:
        return StereoDetection("inconsistent", None)
    nearest = min(pairs, key=lambda pair: (pair.rejection_reason != "outside_volume", pair.cost))
    measured = _triangulate(inputs, _refine_markers(inputs, [nearest])[0])
    return StereoDetection(nearest.rejection_reason or "inconsistent", measured)


def _match_blobs(
    inputs: DetectionInput, left: Sequence[Blob], right: Sequence[Blob]
) -> list[BlobPair]:
    """Make all pairs of blobs whose rays meet in front of the cameras, with their costs.

    A pair outside the volume, or with a depth that contradicts its size, gets a rejection reason.
    """
    geometry, config, gate = inputs.geometry, inputs.config, inputs.gate
    left_rays, right_rays = (
        [undistort_pixel(np.add(blob.centre, origin), matrix, distortion) for blob in blobs]
        for blobs, origin, matrix, distortion in zip(
            (left, right), inputs.origins, geometry.matrices, geometry.distortions, strict=True
        )
    )
    focal_px, world = _focal_px(geometry), geometry.world_from_left
    approach = ClosestApproach.of(geometry.right_from_left)
    pairs = []
    for one, left_ray in zip(left, left_rays, strict=True):
        for other, right_ray in zip(right, right_rays, strict=True):
            if left_ray is None or right_ray is None:
                continue
            met = approach.between(left_ray, right_ray)
            if met is None:
                continue
            point, gap_m = met
            depth_m = float(point[2])
            misfit_px = 0.5 * focal_px * gap_m / depth_m
            sizes = [_size_deviation(inputs, blob.radius, depth_m) for blob in (one, other)]
            point_world = world[:3, :3] @ point + world[:3, 3]
            rejection_reason: FingertipReason | None = None
            if misfit_px > config.max_reprojection_px or max(sizes) > MAX_SIZE_DEVIATION:
                rejection_reason = "inconsistent"
            elif not _inside(inputs.volume, point_world):
                rejection_reason = "outside_volume"
            gate_fraction = 0.0
            if gate is not None:
                gate_fraction = math.dist(point_world, gate.point) / max(gate.radius_m, 1e-6)
            cost = (
                (misfit_px / MISFIT_SIGMA_PX) ** 2
                + (sizes[0] ** 2 + sizes[1] ** 2) / SIZE_SIGMA**2
                + (math.log(one.height / other.height) / HEIGHT_SIGMA) ** 2
                + (GATE_RADIUS_SIGMAS * gate_fraction) ** 2
            )
            pairs.append(BlobPair(one, other, depth_m, gate_fraction, cost, rejection_reason))
    return pairs


@dataclass(frozen=True, slots=True)
class RefinedPair:
    """Pair with refined markers.

    rejection_reason: None for a valid marker.
    cost: sum for the pair and for the refined sizes, in squared standard deviations.
    """

    pair: BlobPair
    markers: tuple[Marker, Marker]
    rejection_reason: FingertipReason | None
    cost: float


def _select_pair(inputs: DetectionInput, likely: list[BlobPair]) -> StereoDetection:
    """Select the marker among one or more pairs.

    Of pairs with about the same cost, only those that are discs after refinement remain: round
    ones, or flat ones seen at an angle.
    """
    refined = _refine_and_rank(inputs, likely)
    rivals = [one for one in refined if one.pair.cost < refined[0].pair.cost + AMBIGUITY_MARGIN]
    rejected = [one for one in rivals if one.rejection_reason is not None]
    if rejected:
        flat = _refine_flat(inputs, rejected[:MAX_FLAT_PAIRS])
        refined, rivals = [*flat, *refined], [*flat, *rivals]
    valid = sorted(
        (one for one in rivals if one.rejection_reason is None), key=lambda one: one.cost
    )
    markers = _unique_candidates(inputs, refined)
    if not valid:
        return StereoDetection(
            rivals[0].rejection_reason or "merged", _triangulate(inputs, rivals[0].markers), markers
        )
    if len(valid) > 1 and valid[1].cost < valid[0].cost + AMBIGUITY_MARGIN:
        return StereoDetection("two_markers", _triangulate(inputs, valid[0].markers), markers)
    reason, measured = _validate(inputs, _triangulate(inputs, valid[0].markers))
    return StereoDetection(reason, measured, markers)


def _refine_and_rank(inputs: DetectionInput, pairs: list[BlobPair]) -> list[RefinedPair]:
    """Refine pairs, sorted by their cost before the refinement."""
    ordered = sorted(pairs, key=lambda pair: pair.cost)
    found = []
    for pair, markers in zip(ordered, _refine_markers(inputs, ordered), strict=True):
        rejection_reason = _rejection_reason(inputs, pair, markers)
        cost = math.inf if rejection_reason else pair.cost + _size_cost(inputs, pair, markers)
        found.append(RefinedPair(pair, markers, rejection_reason, cost))
    return found


def _refine_flat(inputs: DetectionInput, rejected: Sequence[RefinedPair]) -> list[RefinedPair]:
    """Refine rejected pairs as flat markers; return those that are such markers."""
    refine = FLAT_METHODS.get(inputs.config.refine)
    if refine is None:
        return []
    pairs = [one.pair for one in rejected]
    found = []
    for pair, markers in zip(pairs, _refine_markers(inputs, pairs, refine), strict=True):
        if any(marker.rejection_reason is not None for marker in markers):
            continue
        flat = _check_flat_pair(inputs, markers)
        if flat is not None:
            cost = pair.cost + _size_cost(inputs, pair, flat)
            found.append(RefinedPair(pair, flat, None, cost))
    return found


def _check_flat_pair(
    inputs: DetectionInput, markers: tuple[Marker, Marker]
) -> tuple[Marker, Marker] | None:
    """Return two ellipses with the centre of the flat marker; None if they are no such marker.

    The centres are those of the marker, without the effect of perspective.  The radius is the major
    semi-axis.  The mismatch of both shapes increases the covariance, because an occluder that
    covers a strip changes the semi-axis by as much as the centre.
    """
    measured = _triangulate(inputs, markers)
    if measured is None:
        return None
    pose = _flat_pose(inputs, measured.point_world, markers)
    majors_px = [marker.radius + math.hypot(*marker.elongation) for marker in markers]
    deviation = math.hypot(MARKER_SIZE_SIGMA, *(marker.radius_deviation for marker in markers))
    if not pose.mismatch_px <= SIZE_SIGMAS * deviation * max(majors_px):
        return None
    noise_px = max(markers[0].radius_deviation * major_px for major_px in majors_px)
    variance_px2 = max(pose.mismatch_px**2 - noise_px**2, 0.0)
    one, other = (
        replace(
            marker,
            centre=marker.centre - offset_px,
            covariance=marker.covariance + variance_px2 * np.eye(2),
            radius=major_px,
        )
        for marker, offset_px, major_px in zip(
            markers, pose.centre_offsets_px, majors_px, strict=True
        )
    )
    return one, other


def _flat_pose(
    inputs: DetectionInput, point_world: Floats, markers: tuple[Marker, Marker]
) -> FlatPose:
    """Return the pose of a flat marker at a point (3,), m."""
    geometry = inputs.geometry
    left_from_world, right_from_left = geometry.left_from_world, geometry.right_from_left
    in_left = left_from_world[:3, :3] @ point_world + left_from_world[:3, 3]
    in_right = right_from_left[:3, :3] @ in_left + right_from_left[:3, 3]
    views = []
    for view, (turn, point) in enumerate(
        ((np.eye(3), in_left), (right_from_left[:3, :3], in_right))
    ):
        matrix, distortion = geometry.matrices[view], geometry.distortions[view]
        (e, f), radius = markers[view].elongation, markers[view].radius
        axes = np.array([[radius + e, f], [f, radius - e]])
        jacobian = project_with_jacobian(point, matrix, distortion)[1]
        views.append(DiscView(turn, point, jacobian, axes))
    return estimate_flat_pose(views, inputs.config.marker_radius_m)


def _unique_candidates(
    inputs: DetectionInput, refined: Sequence[RefinedPair]
) -> tuple[Candidate, ...]:
    """Return the unique markers among refined pairs, sorted by cost.

    A pair is dropped if pairs with lower cost contain both its blobs, or if one with much lower
    cost contains one of them.  Such pairs arise when blobs of two markers match crosswise.
    """
    unique: list[RefinedPair] = []
    for one in sorted(
        (one for one in refined if one.rejection_reason is None), key=lambda one: one.cost
    ):
        left = [other for other in unique if other.pair.left is one.pair.left]
        right = [other for other in unique if other.pair.right is one.pair.right]
        is_much_worse = any(other.cost + AMBIGUITY_MARGIN <= one.cost for other in left + right)
        if not is_much_worse and not (left and right):
            unique.append(one)
    found = []
    for one in unique:
        reason, measured = _validate(inputs, _triangulate(inputs, one.markers))
        if reason == "ok" and measured is not None:
            found.append(Candidate(measured, _appearance(one.pair)))
    return tuple(found)


def _appearance(pair: BlobPair) -> Floats:
    levels = [(blob.peak, max(blob.surround, 1.0)) for blob in (pair.left, pair.right)]
    return np.asarray(np.log(levels).mean(axis=0))


def _refine_markers(
    inputs: DetectionInput, pairs: Sequence[BlobPair], refine: Refine | None = None
) -> list[tuple[Marker, Marker]]:
    """Refine the markers of all pairs at once, by the configured method or another."""
    config = inputs.config
    images = [image for _ in pairs for image in inputs.images]
    blobs = [blob for pair in pairs for blob in (pair.left, pair.right)]
    refine = config.refine if refine is None else refine
    markers = refine(images, blobs, config.blob_filter, config.sensor)
    return list(zip(markers[::2], markers[1::2], strict=True))


def _rejection_reason(
    inputs: DetectionInput, pair: BlobPair, markers: tuple[Marker, Marker]
) -> FingertipReason | None:
    """Return the rejection reason of a refined pair; None for a valid marker."""
    for marker in markers:
        if marker.rejection_reason is not None:
            return marker.rejection_reason
        deviation = math.hypot(MARKER_SIZE_SIGMA, marker.radius_deviation)
        if _size_deviation(inputs, marker.radius, pair.depth_m) > SIZE_SIGMAS * deviation:
            return "blurred" if marker.blur > SHARP_PX else "merged"
    one, other = markers
    apart_px = min(
        math.dist(one.motion, other.motion),
        math.hypot(one.motion[0] + other.motion[0], one.motion[1] + other.motion[1]),
    )
    deviation = math.hypot(one.radius_deviation, other.radius_deviation)
    if apart_px > MAX_MOTION_DIFFERENCE_PX or abs(math.log(one.radius / other.radius)) > (
        STEREO_SIZE_SIGMAS * deviation
    ):
        return "merged"
    return None


def _size_cost(inputs: DetectionInput, pair: BlobPair, markers: tuple[Marker, Marker]) -> float:
    """Return the mismatch of the refined sizes, in squared standard deviations."""
    sizes = (
        _size_deviation(inputs, marker.radius, pair.depth_m)
        / math.hypot(MARKER_SIZE_SIGMA, marker.radius_deviation)
        for marker in markers
    )
    return sum(size**2 for size in sizes)


def _size_deviation(inputs: DetectionInput, radius_px: float, depth_m: float) -> float:
    """Return the magnitude of the log ratio of a radius to the marker's radius at that depth."""
    expected_px = _focal_px(inputs.geometry) * inputs.config.marker_radius_m / depth_m
    return abs(math.log(radius_px / expected_px))


def _focal_px(geometry: StereoGeometry) -> float:
    """Return the mean focal length of both cameras, px."""
    return 0.5 * float(geometry.matrices[0][0, 0] + geometry.matrices[1][0, 0])


def _inside(volume: tuple[Floats, Floats], point_world: Floats) -> bool:
    return bool((point_world >= volume[0]).all() and (point_world <= volume[1]).all())


def _triangulate(
    inputs: DetectionInput, markers: tuple[Marker, Marker]
) -> TriangulatedPoint | None:
    """Triangulate two refined markers."""
    noise_px, occlusion = inputs.config.noise_px, _occlusion_variance_px2(markers) * np.eye(2)
    left, right = (
        (marker.covariance if noise_px is None else noise_px**2 * np.eye(2)) + occlusion
        for marker in markers
    )
    return measure(
        inputs.geometry,
        markers[0].centre + inputs.origins[0],
        markers[1].centre + inputs.origins[1],
        method=inputs.config.triangulate,
        left_covariance=left,
        right_covariance=right,
    )


def _occlusion_variance_px2(markers: tuple[Marker, Marker]) -> float:
    """Return the variance of a centre from partial occlusion, by the size difference of both views.

    An occluder that covers a strip of a disc shifts its centre by half the strip's width, and
    reduces the radius by the same amount.  The variance of the method's radii is subtracted.
    """
    one, other = markers
    noise_px = one.radius * math.hypot(one.radius_deviation, other.radius_deviation)
    return max((one.radius - other.radius) ** 2 - noise_px**2, 0.0)


def _validate(
    inputs: DetectionInput, measured: TriangulatedPoint | None
) -> tuple[FingertipReason, TriangulatedPoint | None]:
    """Check reprojection error, uncertainty and volume; return the reason and the point."""
    config = inputs.config
    if (
        measured is None
        or measured.reprojection_px > config.max_reprojection_px
        or measured.deviation_m > config.max_deviation_m
    ):
        return "inconsistent", measured
    if not _inside(inputs.volume, measured.point_world):
        return "outside_volume", measured
    return "ok", measured
