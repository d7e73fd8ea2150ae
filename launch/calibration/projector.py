"""Calibrate the intrinsics and the pose of the projector from points that its pixels light.

A projector is an inverse camera, because each of its pixels lights a point. The points are on the
sheet, and the two cameras of the stereo camera measure their positions. Therefore, the poses of the
sheet need not be known.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from flexsheet.launch.calibration.gray_code import DecodeError, decode_patterns, find_pixels
from flexsheet.messages.errors import FlexsheetError
from flexsheet.messages.scene import Lens, Pose, Projector, StereoCamera
from flexsheet.nodes.arrays import Bools, Floats, Image
from flexsheet.nodes.models.camera import camera_matrix, normalize, project
from flexsheet.nodes.models.rigid import (
    apply,
    inverse,
    pose_matrix,
    rotation_from_vector,
    rpy_from_rotation,
    transform,
    vector_from_rotation,
)

Indices = NDArray[np.intp]

GRID_PX = 20
"""The distance (px) in the projector image between neighbouring pixels that are measured."""

MIN_POSES, MIN_POINTS = 3, 200
MIN_DEPTH_RANGE_M = 0.03
MIN_COVERAGE = 0.25
MAX_RMS_PX = 0.7
COVERAGE_CELLS = (8, 6)
OUTLIER_RATIO = 4.0
TYPICAL_ERRORS = np.array([0.01] * 3 + [0.01] * 3 + [0.02] + [20.0] * 2)
"""The typical errors (9,) of a projector whose pose in the scene was measured with a tape.

The errors are of the rotation (rad), position (m), focal length (relative) and principal point
(px). Only their ratios matter.
"""


class ProjectorError(FlexsheetError, ValueError):
    """Raised if images or points do not determine the intrinsics and pose of the projector."""

    exit_code = 2


@dataclass(frozen=True, slots=True)
class ProjectorPoints:
    """The points that projector pixels light, measured by two cameras.

    world: positions (n, 3) of the n points in the world, m.
    pixels: projector pixel (n, 2) that lights each point.
    pose: index (n,) of the sheet's pose in which each point was measured.
    """

    world: Floats
    pixels: Floats
    pose: Indices


@dataclass(frozen=True, slots=True)
class ProjectorFit:
    """A calibrated projector, with residuals in projector pixels and in metres on the sheet.

    held_out_rms_px: rms residual from cross-validation. Each sheet pose is compared with a fit to
        all other poses.
    before_rms_px: rms residual of the projector parameters before the calibration.
    coverage_ratio: fraction of the projected image that contains points.
    shift_covariance_px2: covariance (2, 2) of the mean image displacement that results from the
        calibration's error. It is estimated with the jackknife, by omitting each sheet pose once.
    """

    projector: Projector
    rms_px: float
    held_out_rms_px: float
    before_rms_px: float
    rms_m: float
    coverage_ratio: float
    depth_range_m: float
    poses: int
    points: int
    outliers: int
    shift_covariance_px2: Floats = field(default_factory=lambda: np.zeros((2, 2)))


def measure_points(
    poses: Sequence[tuple[Sequence[Image], Sequence[Image]]],
    camera: StereoCamera,
    projector: Projector,
) -> ProjectorPoints:
    """Triangulate the points that projector pixels light, from images of each sheet pose.

    poses: for each pose, the images of the Gray-code patterns from the left and the right camera.
    camera: stereo camera with calibrated intrinsics and with `world_from_left` from the scene.
    projector: projector, of which only the image size is used.

    Raises ProjectorError if the patterns cannot be decoded.
    """
    size = projector.width_px, projector.height_px
    columns, rows = (np.arange(GRID_PX // 2, side, GRID_PX, dtype=np.float64) for side in size)
    grid_pixels = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    parts: list[tuple[Floats, Floats, Indices]] = []
    for number, views in enumerate(poses):
        found = []
        for side, images in zip(("left", "right"), views, strict=True):
            try:
                found.append(find_pixels(decode_patterns(images, *size), grid_pixels))
            except DecodeError as error:
                raise ProjectorError(f"pose {number + 1}, {side} camera: {error}") from error
        both = found[0][1] & found[1][1]
        world = triangulate_points(found[0][0][both], found[1][0][both], camera)
        parts.append((world, grid_pixels[both], np.full(int(both.sum()), number)))
    return ProjectorPoints(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def triangulate_points(left: Floats, right: Floats, camera: StereoCamera) -> Floats:
    """Triangulate n points from their pixels (n, 2) in the left and the right image.

    Return the points (n, 3) in the world, in m. Each point is midway between the rays of the two
    cameras.
    """
    from_right = inverse(camera.right_from_left)
    slopes = [
        normalize(
            pixels,
            camera_matrix(lens.fx_px, lens.fy_px, lens.cx_px, lens.cy_px),
            np.array(lens.distortion),
        )
        for pixels, lens in ((left, camera.left), (right, camera.right))
    ]
    a, b = (np.column_stack([slope, np.ones(len(slope))]) for slope in slopes)
    b = b @ from_right[:3, :3].T
    base = from_right[:3, 3]
    aa, ab, bb = ((p * q).sum(axis=1) for p, q in ((a, a), (a, b), (b, b)))
    da, db = a @ base, b @ base
    denominator = aa * bb - ab * ab
    on_a = ((bb * da - ab * db) / denominator)[:, None] * a
    on_b = base + ((ab * da - aa * db) / denominator)[:, None] * b
    return apply(pose_matrix(camera.world_from_left), 0.5 * (on_a + on_b))


def project_points(projector: Projector, world: Floats) -> Floats:
    """Return the projector pixels (n, 2) that illuminate the world points (n, 3), in m."""
    lens, pose = projector.lens, projector.world_from_projector
    local = apply(inverse(pose_matrix(pose)), world)
    matrix = camera_matrix(lens.fx_px, lens.fy_px, lens.cx_px, lens.cy_px)
    return project(local, matrix, np.array(lens.distortion))


def calibrate_projector(points: ProjectorPoints, guess: Projector) -> ProjectorFit:
    """Fit the intrinsics and the pose of a projector to the points that its pixels light.

    guess: initial values of the projector.

    Raises ProjectorError if there are too few points or poses, or if the points cover too little of
    the image or of the depth range. Also raises ProjectorError if the residuals are too large.
    """
    inliers = np.ones(len(points.world), np.bool_)
    poses, depth_m = len(np.unique(points.pose)), _measure_depth_range(points, guess)
    coverage = _measure_coverage(points.pixels, guess)
    if poses < MIN_POSES or len(points.world) < MIN_POINTS:
        raise ProjectorError(
            f"there are {len(points.world)} points in {poses} poses; capture at least {MIN_POSES} "
            f"poses and {MIN_POINTS} points that both cameras see"
        )
    if depth_m < MIN_DEPTH_RANGE_M:
        raise ProjectorError(
            f"the depth range of the points is {1e3 * depth_m:.0f} mm; tilt and move the sheet "
            f"over at least {1e3 * MIN_DEPTH_RANGE_M:.0f} mm along the projection"
        )
    if coverage < MIN_COVERAGE:
        raise ProjectorError(
            f"the points cover {100 * coverage:.0f} % of the projector's image, but at least "
            f"{100 * MIN_COVERAGE:.0f} % are required; move the sheet over the image"
        )
    for _ in range(3):
        projector = _fit_projector(points, inliers, guess)
        residual_px = np.linalg.norm(
            project_points(projector, points.world) - points.pixels, axis=1
        )
        now = residual_px <= OUTLIER_RATIO * np.median(residual_px)
        if (now == inliers).all():
            break
        inliers = now
    rms = _rms(residual_px[inliers])
    if rms > MAX_RMS_PX or inliers.mean() < 0.8:
        raise ProjectorError(
            f"the fit has a residual of {rms:.2f} px rms, and {int((~inliers).sum())} of "
            f"{len(inliers)} points are outliers; keep the sheet still during each pose, and check "
            "the cameras (flexsheet calibrate check)"
        )
    held_out, shifts = [], []
    for pose in np.unique(points.pose):
        here = inliers & (points.pose == pose)
        if not here.any():
            continue
        refit = _fit_projector(points, inliers & (points.pose != pose), guess)
        found = project_points(refit, points.world)
        held_out.append(np.linalg.norm(found[here] - points.pixels[here], axis=1))
        shifts.append((found - project_points(projector, points.world))[inliers].mean(axis=0))
    scatter = np.array(shifts) - np.mean(shifts, axis=0)
    position = projector.world_from_projector.position_m
    distance_m = float(np.median(np.linalg.norm(points.world - position, axis=1)))
    before = np.linalg.norm(project_points(guess, points.world) - points.pixels, axis=1)
    return ProjectorFit(
        projector=projector,
        rms_px=rms,
        held_out_rms_px=_rms(np.concatenate(held_out)),
        before_rms_px=_rms(before[inliers]),
        rms_m=rms * distance_m / projector.lens.fx_px,
        coverage_ratio=coverage,
        depth_range_m=depth_m,
        poses=poses,
        points=int(inliers.sum()),
        outliers=int((~inliers).sum()),
        shift_covariance_px2=(len(shifts) - 1) / len(shifts) * scatter.T @ scatter,
    )


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _measure_depth_range(points: ProjectorPoints, guess: Projector) -> float:
    """Return the depth range (m) of the central 90 % of the points.

    The depth is measured along the projector's axis.
    """
    pose = guess.world_from_projector
    along = apply(inverse(pose_matrix(pose)), points.world)[:, 2]
    return float(np.ptp(np.quantile(along, [0.05, 0.95]))) if len(along) else 0.0


def _measure_coverage(pixels: Floats, projector: Projector) -> float:
    size = np.array([projector.width_px, projector.height_px])
    cells = np.floor(pixels / size * COVERAGE_CELLS).astype(int)
    return len(np.unique(cells, axis=0)) / (COVERAGE_CELLS[0] * COVERAGE_CELLS[1])


def _fit_projector(points: ProjectorPoints, inliers: Bools, guess: Projector) -> Projector:
    """Fit a projector's pose, focal length, principal point and distortion by least squares.

    The fitted distortion coefficients are k1, k2, p1 and p2. The aspect ratio and k3 are fixed to
    the values of `guess`. OpenCV's fit is not used, because it rejects a principal point outside
    the image. If a projector has lens shift, its principal point is outside the image.

    inliers: mask (n,) that selects the points to use.
    """
    world, pixels = points.world[inliers], points.pixels[inliers]
    lens, pose = guess.lens, guess.world_from_projector
    from_world = inverse(pose_matrix(pose))
    aspect, k3 = lens.fy_px / lens.fx_px, lens.distortion[4]
    start = [
        *vector_from_rotation(from_world[:3, :3]),
        *from_world[:3, 3],
        *(lens.fx_px, lens.cx_px, lens.cy_px),
        *lens.distortion[:4],
    ]

    def split(x: Floats) -> tuple[Floats, Floats]:
        return camera_matrix(x[6], aspect * x[6], x[7], x[8]), np.array([*x[9:13], k3])

    def residuals(x: Floats) -> Floats:
        projected, _ = cv2.projectPoints(world, x[:3], x[3:6], *split(x))
        return np.asarray((projected.reshape(-1, 2) - pixels).ravel())

    def derivatives(x: Floats) -> Floats:
        """Return the derivatives (2n, 13) of the residuals with respect to the 13 unknowns.

        The unknowns are rotation (3), translation (3), focal length, principal point (2), and the
        distortion coefficients k1, k2, p1 and p2.
        """
        _, by = cv2.projectPoints(world, x[:3], x[3:6], *split(x))
        focal = by[:, 6:7] + aspect * by[:, 7:8]
        return np.hstack([by[:, :6], focal, by[:, 8:14]])

    solved = least_squares(residuals, start, jac=derivatives, x_scale="jac", method="lm")
    matrix, distortion = split(solved.x)
    fitted = transform(rotation_from_vector(solved.x[:3]), solved.x[3:6])
    return _make_projector(guess, matrix, distortion, inverse(fitted))


def _make_projector(
    template: Projector, matrix: Floats, distortion: Floats, world_from_projector: Floats
) -> Projector:
    k = [float(value) for value in distortion]
    return template.model_copy(
        update={
            "lens": Lens(
                fx_px=float(matrix[0, 0]),
                fy_px=float(matrix[1, 1]),
                cx_px=float(matrix[0, 2]),
                cy_px=float(matrix[1, 2]),
                distortion=(k[0], k[1], k[2], k[3], k[4]),
            ),
            "world_from_projector": Pose(
                position_m=world_from_projector[:3, 3],
                rpy_rad=rpy_from_rotation(world_from_projector[:3, :3]),
            ),
        }
    )
