"""Detect the fingertip's marker in a stereo image pair.

Bright blobs are detected in each image and matched in pairs. The centres of likely pairs are
refined to subpixel accuracy and triangulated. Pairs that cannot be the marker are rejected with a
reason.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from flexsheet.messages.types import FingertipReason
from flexsheet.nodes.arrays import Floats, Image
from flexsheet.nodes.triangulator.flat_marker import DiscView, FlatPose, estimate_flat_pose
from flexsheet.nodes.triangulator.marker import (
    SHARP_PX,
    Blob,
    BlobFilter,
    Marker,
    Window,
    detect_blobs,
    fit_flat_markers,
    is_overexposed,
    subpixel_fit,
    window_around,
)
from flexsheet.nodes.triangulator.subpixel import PixelNoise
from flexsheet.nodes.triangulator.tracking import Gate
from flexsheet.nodes.triangulator.triangulation import (
    ClosestApproach,
    StereoGeometry,
    TriangulatedPoint,
    measure,
)

Origin = tuple[int, int]

SIZE_SIGMA = 0.2
"""The standard deviation of the logarithm of a blob's size ratio. The size ratio is the radius of
the blob divided by the expected radius."""

HEIGHT_SIGMA = 0.25
"""The standard deviation of the logarithm of the ratio of a marker's heights in both views. The
height is the difference between the grey levels of the marker and of its surroundings."""

MISFIT_SIGMA_PX = 0.5
"""The standard deviation of a marker's reprojection error before its centres are refined."""

MAX_SIZE_DEVIATION = 0.6
"""The maximum absolute logarithm of a blob's size ratio. It permits radii of 0.55 to 1.8 times the
expected radius."""

SIZE_SIGMAS = 3.5
"""The maximum deviation of a refined marker's radius from the expected radius, in standard
deviations. A larger deviation means that the marker is partly occluded, or merged with a bright
spot."""

MARKER_SIZE_SIGMA = 0.035
"""The relative standard deviation of the radii of manufactured markers."""

STEREO_SIZE_SIGMAS = 4.5
"""The maximum difference of a marker's radius between both views, in standard deviations. A larger
difference means that the marker is partly occluded in one view."""

MAX_MOTION_DIFFERENCE_PX = 2.5
"""The maximum difference between both views in a marker's motion during the exposure."""

WINDOW_MARGIN_PX = 5
"""The margin of a search window around the region in which the marker is expected."""

GATE_RADIUS_SIGMAS = 4.0
"""The radius of a gate (see `tracking.Gate`), in standard deviations of the expected position."""

MAX_FLAT_PAIRS = 4
"""The maximum number of blob pairs that are refined as flat markers."""

AMBIGUITY_MARGIN = 9.0
"""The minimum cost difference between the best and the second best pair, in squared standard
deviations. If the difference is smaller, the marker is ambiguous."""


@dataclass(frozen=True, slots=True)
class DetectorConfig:
    """The settings for the detection, refinement and triangulation of markers.

    blob_filter: criteria for a blob that may be the marker.
    max_reprojection_px: maximum reprojection error of a pair.
    marker_radius_m: true radius of the marker.
    max_deviation_m: maximum standard deviation of a triangulated point.
    sensor: noise of the pixels.
    """

    blob_filter: BlobFilter
    max_reprojection_px: float
    marker_radius_m: float = 0.003
    max_deviation_m: float = 0.002
    sensor: PixelNoise = field(default_factory=PixelNoise)


@dataclass(frozen=True, slots=True)
class BlobPair:
    """A pair of blobs in the left and the right image that may show the same marker.

    depth_m: depth in the left camera's frame at which the rays of both blobs meet.
    gate_fraction: distance from the predicted position, divided by the radius of the search region
        (gate); 0 if there is no prediction.
    cost: measure of the mismatch between both blobs, and of the distance from the predicted
        position. It is a sum of squared differences, each divided by its variance.
    rejection_reason: reason why the pair cannot be a marker in the finger's working volume; None if
        the pair is acceptable.
    """

    left: Blob
    right: Blob
    depth_m: float
    gate_fraction: float
    cost: float
    rejection_reason: FingertipReason | None


@dataclass(frozen=True, slots=True)
class Candidate:
    """A detected marker that may be the finger's marker.

    measured: triangulated position.
    appearance: logarithms (2,) of the grey levels of the marker and of its surroundings, averaged
        over both views.
    """

    measured: TriangulatedPoint
    appearance: Floats

    @property
    def point(self) -> Floats:
        """Return the marker's world position (3,), m."""
        return self.measured.point_world


@dataclass(frozen=True, slots=True)
class StereoDetection:
    """The markers that were detected in an image pair.

    reason: "ok", or the reason why the finger was not found.
    measured: triangulated point of the finger's marker or of a rejected marker; None if no point
        was triangulated.
    markers: candidates inside the gate, the region around the predicted position of the finger's
        marker. They are sorted by cost.
    clutter: candidates outside the gate.
    """

    reason: FingertipReason
    measured: TriangulatedPoint | None
    markers: tuple[Candidate, ...] = ()
    clutter: tuple[Candidate, ...] = ()

    def correct_points(
        self, correct: Callable[[TriangulatedPoint], TriangulatedPoint]
    ) -> StereoDetection:
        """Return a copy of this detection with `correct` applied to all triangulated points."""
        measured = None if self.measured is None else correct(self.measured)
        markers, clutter = (
            tuple(replace(one, measured=correct(one.measured)) for one in candidates)
            for candidates in (self.markers, self.clutter)
        )
        return replace(self, measured=measured, markers=markers, clutter=clutter)


@dataclass(frozen=True, slots=True)
class DetectionInput:
    """An image pair, and the settings with which markers are detected in it.

    images: left and right image (height, width), which can be cut-outs of the camera images.
    volume: minimum and maximum corner (3,), m, of the finger's working volume in the world frame.
    gate: ball in which the finger's marker is expected; None to search both full images, which must
        contain only one marker.
    origins: position (x, y), px, of each image's first pixel in the camera image.
    """

    images: tuple[Image, Image]
    geometry: StereoGeometry
    config: DetectorConfig
    volume: tuple[Floats, Floats]
    gate: Gate | None = None
    origins: tuple[Origin, Origin] = ((0, 0), (0, 0))


def detect_all(inputs: DetectionInput) -> StereoDetection:
    """Detect the finger's marker and all other markers in an image pair.

    If the finger is not found inside the gate, the full images are searched for other markers.
    """
    if inputs.gate is not None and not np.isfinite(inputs.gate.point).all():
        inputs = replace(inputs, gate=None)
    windows = _search_windows(inputs)
    found = _match_in(inputs, windows)
    if found.reason != "ok":
        if any(
            is_overexposed(image) or is_overexposed(image, window)
            for image, window in zip(inputs.images, windows, strict=True)
        ):
            found = replace(found, reason="saturated")
        if windows != (None, None):
            found = replace(found, clutter=_match_in(inputs, (None, None)).clutter)
    return found


def _search_windows(inputs: DetectionInput) -> tuple[Window | None, Window | None]:
    """Return the windows of the left and right image in which the finger's marker is expected.

    The windows contain the image of the gate, which is a ball around the predicted position.
    Returns (None, None) if there is no gate, or if it is outside an image.
    """
    if inputs.gate is None:
        return None, None
    geometry, found = inputs.geometry, list[Window]()
    for view, point in enumerate(geometry.transform_to_cameras(inputs.gate.point)):
        depth_m = float(point[2]) - inputs.gate.radius_m
        if depth_m <= 0:
            return None, None
        pixel = geometry.project_with_jacobian(view, point)[0]
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


def _match_in(
    inputs: DetectionInput, windows: tuple[Window | None, Window | None]
) -> StereoDetection:
    """Detect blobs in both images, match them as stereo pairs, and select the finger's marker.

    windows: windows of the left and right image that are searched; None means the full image.
    """
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
    """Return all pairs of a left and a right blob that could show the same point.

    The closest points of the two rays must be in front of both cameras. A pair receives a rejection
    reason if its reprojection error is too large, or if its radii are wrong. A pair outside the
    finger's working volume also receives a rejection reason.
    """
    geometry, config, gate = inputs.geometry, inputs.config, inputs.gate
    left_rays, right_rays = (
        [geometry.undistort(view, np.add(blob.centre, inputs.origins[view])) for blob in blobs]
        for view, blobs in enumerate((left, right))
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
    """A pair of blobs, with the left and the right marker that are located to subpixel accuracy.

    rejection_reason: reason why the pair cannot be the finger's marker; None if it can.
    cost: cost of the blob pair, plus the squared deviations of the radii from their expected
        values, each divided by its variance.
    measured: triangulated marker; None if the pair cannot be the marker, or if the rays through the
        centres do not meet.
    """

    pair: BlobPair
    markers: tuple[Marker, Marker]
    rejection_reason: FingertipReason | None
    cost: float
    measured: TriangulatedPoint | None = None


def _select_pair(inputs: DetectionInput, likely: list[BlobPair]) -> StereoDetection:
    """Select the finger's marker from blob pairs that probably show round markers.

    A pair may fail the checks of a round marker after its refinement to subpixel accuracy. It is
    then refined a second time as a flat marker that is seen at an angle.
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
        return StereoDetection("two_markers", valid[0].measured, markers)
    reason, measured = _validate(inputs, valid[0].measured)
    return StereoDetection(reason, measured, markers)


def _refine_and_rank(inputs: DetectionInput, pairs: list[BlobPair]) -> list[RefinedPair]:
    """Refine the markers of blob pairs to subpixel accuracy.

    The result is in the order of the costs that the pairs had before the refinement.
    """
    ordered = sorted(pairs, key=lambda pair: pair.cost)
    found = []
    for pair, markers in zip(ordered, _refine_markers(inputs, ordered), strict=True):
        rejection_reason = _rejection_reason(inputs, pair, markers)
        if rejection_reason is not None:
            found.append(RefinedPair(pair, markers, rejection_reason, math.inf))
            continue
        cost = pair.cost + _size_cost(inputs, pair, markers)
        found.append(RefinedPair(pair, markers, None, cost, _triangulate(inputs, markers)))
    return found


def _refine_flat(inputs: DetectionInput, rejected: Sequence[RefinedPair]) -> list[RefinedPair]:
    pairs = [one.pair for one in rejected]
    found = []
    for pair, markers in zip(pairs, _refine_markers(inputs, pairs, flat=True), strict=True):
        if any(marker.rejection_reason is not None for marker in markers):
            continue
        flat = _check_flat_pair(inputs, markers)
        if flat is not None:
            cost = pair.cost + _size_cost(inputs, pair, flat)
            found.append(RefinedPair(pair, flat, None, cost, _triangulate(inputs, flat)))
    return found


def _check_flat_pair(
    inputs: DetectionInput, markers: tuple[Marker, Marker]
) -> tuple[Marker, Marker] | None:
    """Check whether two ellipses show one flat marker, and correct their centres for perspective.

    Returns both markers with corrected centres, and with the major semi-axis as radius. Returns
    None if the ellipses do not show one flat marker. The measured shapes differ from the ideal
    ellipses, for example if an obstacle covers part of the marker. This difference is added to the
    covariance of the centres.
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
    geometry = inputs.geometry
    rotations = np.eye(3), geometry.right_from_left[:3, :3]
    views = []
    for view, point in enumerate(geometry.transform_to_cameras(point_world)):
        (e, f), radius = markers[view].elongation, markers[view].radius
        axes = np.array([[radius + e, f], [f, radius - e]])
        jacobian = geometry.project_with_jacobian(view, point)[1]
        views.append(DiscView(rotations[view], point, jacobian, axes))
    return estimate_flat_pose(views, inputs.config.marker_radius_m)


def _unique_candidates(
    inputs: DetectionInput, refined: Sequence[RefinedPair]
) -> tuple[Candidate, ...]:
    """Return the valid markers of refined blob pairs, sorted by cost, without false pairs.

    Two markers in both images can form four pairs, of which two are false. A pair counts as false
    if each of its blobs also belongs to a pair with a lower cost. It also counts as false if one
    blob belongs to a pair with a much lower cost.
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
        reason, measured = _validate(inputs, one.measured)
        if reason == "ok" and measured is not None:
            found.append(Candidate(measured, _appearance(one.pair)))
    return tuple(found)


def _appearance(pair: BlobPair) -> Floats:
    levels = [(blob.peak, max(blob.surround, 1.0)) for blob in (pair.left, pair.right)]
    return np.asarray(np.log(levels).mean(axis=0))


def _refine_markers(
    inputs: DetectionInput, pairs: Sequence[BlobPair], *, flat: bool = False
) -> list[tuple[Marker, Marker]]:
    """Refine the markers of all pairs in one call, as discs or as flat markers."""
    images = [image for _ in pairs for image in inputs.images]
    blobs = [blob for pair in pairs for blob in (pair.left, pair.right)]
    refine = fit_flat_markers if flat else subpixel_fit
    markers = refine(images, blobs, inputs.config.sensor)
    return list(zip(markers[::2], markers[1::2], strict=True))


def _rejection_reason(
    inputs: DetectionInput, pair: BlobPair, markers: tuple[Marker, Marker]
) -> FingertipReason | None:
    """Return why a pair of blobs cannot be the marker after its refinement, or None if it can."""
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
    sizes = (
        _size_deviation(inputs, marker.radius, pair.depth_m)
        / math.hypot(MARKER_SIZE_SIGMA, marker.radius_deviation)
        for marker in markers
    )
    return sum(size**2 for size in sizes)


def _size_deviation(inputs: DetectionInput, radius_px: float, depth_m: float) -> float:
    expected_px = _focal_px(inputs.geometry) * inputs.config.marker_radius_m / depth_m
    return abs(math.log(radius_px / expected_px))


def _focal_px(geometry: StereoGeometry) -> float:
    return 0.5 * float(geometry.matrices[0][0, 0] + geometry.matrices[1][0, 0])


def _inside(volume: tuple[Floats, Floats], point_world: Floats) -> bool:
    return bool((point_world >= volume[0]).all() and (point_world <= volume[1]).all())


def _triangulate(
    inputs: DetectionInput, markers: tuple[Marker, Marker]
) -> TriangulatedPoint | None:
    """Triangulate a marker from its refined centres in both views, or return None if this fails."""
    occlusion = _occlusion_variance_px2(markers) * np.eye(2)
    return measure(
        inputs.geometry,
        markers[0].centre + inputs.origins[0],
        markers[1].centre + inputs.origins[1],
        covariance=markers[0].covariance + occlusion,
        right_covariance=markers[1].covariance + occlusion,
    )


def _occlusion_variance_px2(markers: tuple[Marker, Marker]) -> float:
    """Estimate the variance (px^2) that partial occlusion adds to the centre of a marker.

    An obstacle that covers a strip of a disc shifts the centre and reduces the radius by half the
    strip's width. The variance is therefore the squared difference of the radii in both views,
    minus the variance of the estimated radii.
    """
    one, other = markers
    noise_px = one.radius * math.hypot(one.radius_deviation, other.radius_deviation)
    return max((one.radius - other.radius) ** 2 - noise_px**2, 0.0)


def _validate(
    inputs: DetectionInput, measured: TriangulatedPoint | None
) -> tuple[FingertipReason, TriangulatedPoint | None]:
    """Check the reprojection error, standard deviation and position of a triangulated point.

    The first result is "ok", or the reason to reject the point. The second result is the point.
    """
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
