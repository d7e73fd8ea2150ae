"""Triangulate a marker from two images, and compute the covariance of its position.

Undistorted normalized coordinates are pixels without lens distortion, divided by the focal length.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from flexsheet.messages.calibration import StereoCalibration, refuse_other_camera
from flexsheet.messages.errors import FlexsheetError
from flexsheet.messages.scene import Lens, StereoCamera
from flexsheet.messages.types import StereoPair
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.models import camera, rigid

NEWTON_STEPS = 12
MIN_DISTORTION_SLOPE = 0.05
"""The minimum determinant of the distortion's Jacobian. If the determinant is near zero, the lens
model is not invertible."""

MIN_SINE = 1e-6
"""The sine of the angle between two rays below which the rays are treated as parallel."""

MAX_DISTANCE_M = 1e4
"""The maximum depth of a point. Rays to more distant points are parallel within rounding errors."""


@dataclass(frozen=True, slots=True)
class StereoGeometry:
    """The geometry of a stereo camera.

    It consists of camera matrices (3, 3), lens distortions (5,) and transforms (4, 4).
    """

    device: str
    width_px: int
    height_px: int
    matrices: tuple[Floats, Floats]
    distortions: tuple[Floats, Floats]
    right_from_left: Floats
    world_from_left: Floats
    left_from_world: Floats

    @staticmethod
    def of(
        scene_camera: StereoCamera, calibration: StereoCalibration | None = None
    ) -> StereoGeometry:
        """Make the geometry of the scene's stereo camera.

        calibration: source of the intrinsics and of `right_from_left`; None to use the scene. The
            left camera's pose always comes from the scene.

        Raises CalibrationMismatchError if the calibration belongs to another camera.
        """
        optics: StereoCamera | StereoCalibration = scene_camera
        if calibration is not None:
            refuse_other_camera(calibration, scene_camera)
            optics = calibration
        world_from_left = rigid.pose_matrix(scene_camera.world_from_left)
        return StereoGeometry(
            device=scene_camera.device,
            width_px=scene_camera.width_px,
            height_px=scene_camera.height_px,
            matrices=(_matrix(optics.left), _matrix(optics.right)),
            distortions=(np.array(optics.left.distortion), np.array(optics.right.distortion)),
            right_from_left=optics.right_from_left,
            world_from_left=world_from_left,
            left_from_world=rigid.inverse(world_from_left),
        )

    def transform_to_cameras(self, points_world: Floats) -> tuple[Floats, Floats]:
        """Transform world points (..., 3), m, to the frames of the left and the right camera."""
        in_left = rigid.apply(self.left_from_world, points_world)
        return in_left, rigid.apply(self.right_from_left, in_left)

    def project_with_jacobian(self, view: int, point: Floats) -> tuple[Floats, Floats]:
        """Return the pixel (2,) of a point (3,), m, in the camera's frame, and its Jacobian (2, 3).

        view: 0 for the left camera, 1 for the right camera.
        """
        return project_with_jacobian(point, self.matrices[view], self.distortions[view])

    def undistort(self, view: int, pixel: Floats) -> tuple[float, float] | None:
        """Return the undistorted normalized coordinates of a pixel (2,).

        Returns None if the pixel is invalid for the lens model.

        view: 0 for the left camera, 1 for the right camera.
        """
        return undistort_pixel(pixel, self.matrices[view], self.distortions[view])

    def project(self, points_world: Floats) -> tuple[Floats, Floats]:
        """Project world points (..., 3), m, to pixels (..., 2) of both views.

        The points must be in front of both cameras.
        """
        in_left, in_right = self.transform_to_cameras(points_world)
        return (
            camera.project(in_left, self.matrices[0], self.distortions[0]),
            camera.project(in_right, self.matrices[1], self.distortions[1]),
        )

    def normalize(self, left_px: Floats, right_px: Floats) -> tuple[Floats, Floats]:
        """Convert pixels (..., 2) of both views to undistorted normalized coordinates (..., 2)."""
        return (
            camera.normalize(left_px, self.matrices[0], self.distortions[0]),
            camera.normalize(right_px, self.matrices[1], self.distortions[1]),
        )


def _matrix(lens: Lens) -> Floats:
    return camera.camera_matrix(lens.fx_px, lens.fy_px, lens.cx_px, lens.cy_px)


class ImageMismatchError(FlexsheetError, ValueError):
    """Raised if images cannot come from the scene's camera."""

    remedy = "Change the camera in the scene to the camera that took the images."


def check_images(pair: StereoPair, geometry: StereoGeometry) -> None:
    """Raise ImageMismatchError if images cannot come from this stereo camera.

    pair: full or cropped images.
    """
    if pair.device != geometry.device:
        raise ImageMismatchError(
            f'the images come from the device "{pair.device}", but the camera of the scene is '
            f'"{geometry.device}"'
        )
    views = (("left", pair.left, pair.left_origin_px), ("right", pair.right, pair.right_origin_px))
    for side, image, (column, row) in views:
        height, width = image.shape
        inside = column >= 0 and row >= 0
        if not inside or column + width > geometry.width_px or row + height > geometry.height_px:
            raise ImageMismatchError(
                f"the {side} image has {width}x{height} px from column {column}, row {row}, but the"
                f" scene's camera {pair.device} has {geometry.width_px}x{geometry.height_px} px"
            )


@dataclass(frozen=True, slots=True)
class ClosestApproach:
    """A solver for the closest points of two camera rays.

    rotation_rows: rows of the rotation from the right to the left camera's axes.
    origin: position of the right camera in the left camera's frame, m.

    The geometry is stored as Python numbers, which are faster than small arrays.
    """

    rotation_rows: tuple[tuple[float, float, float], ...]
    origin: tuple[float, float, float]

    @staticmethod
    def of(right_from_left: Floats) -> ClosestApproach:
        left_from_right = rigid.inverse(right_from_left).tolist()
        return ClosestApproach(
            tuple((row[0], row[1], row[2]) for row in left_from_right[:3]),
            (left_from_right[0][3], left_from_right[1][3], left_from_right[2][3]),
        )

    def between(
        self, left: tuple[float, float], right: tuple[float, float]
    ) -> tuple[Floats, float] | None:
        """Return the midpoint (3,), m, and the length (m) of the shortest segment between two rays.

        left, right: undistorted normalized coordinates (x, y) of the rays.

        Returns None if the rays are parallel, or if the segment is behind a camera.
        """
        (ax, ay), (ox, oy, oz) = left, self.origin
        bx, by, bz = (row[0] * right[0] + row[1] * right[1] + row[2] for row in self.rotation_rows)
        aa, bb, ab = ax * ax + ay * ay + 1.0, bx * bx + by * by + bz * bz, ax * bx + ay * by + bz
        ao, bo = ax * ox + ay * oy + oz, bx * ox + by * oy + bz * oz
        determinant = aa * bb - ab * ab
        if not determinant > MIN_SINE**2 * aa * bb:
            return None
        s = (bb * ao - ab * bo) / determinant
        t = (ab * ao - aa * bo) / determinant
        if s <= 0.0 or t <= 0.0:
            return None
        px, py, pz = ox + t * bx, oy + t * by, oz + t * bz
        middle = np.array([0.5 * (s * ax + px), 0.5 * (s * ay + py), 0.5 * (s + pz)])
        return middle, math.hypot(s * ax - px, s * ay - py, s - pz)


def dlt(left: Floats, right: Floats, right_from_left: Floats) -> Floats:
    """Triangulate points by the direct linear transform (homogeneous linear least squares).

    left, right: undistorted normalized coordinates (n, 2) in both views.
    right_from_left: transform (4, 4) from the left to the right camera's frame.

    Returns points (n, 3), m, in the left camera's frame.

    Source: Hartley and Zisserman, Multiple View Geometry, 2nd ed., section 12.2.
    """
    projections = (np.eye(3, 4), right_from_left[:3])
    rows = np.empty((len(left), 4, 4))
    for view, (seen, projection) in enumerate(zip((left, right), projections, strict=True)):
        rows[:, 2 * view : 2 * view + 2] = seen[:, :, None] * projection[2] - projection[:2]
    homogeneous = np.linalg.svd(rows)[2][:, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(homogeneous[:, :3] / homogeneous[:, 3:])


def project_with_jacobian(
    point: Floats, matrix: Floats, distortion: Floats
) -> tuple[Floats, Floats]:
    """Return the pixel (2,) of a point (3,), m, in the camera's frame, and its Jacobian.

    The Jacobian (2, 3) is in px/m. The function computes with Python numbers, which are ten times
    as fast as arrays with two elements.
    """
    px, py, pz = point.tolist()
    fx, fy, cx, cy = _intrinsics(matrix)
    x, y = px / pz, py / pz
    u, v, xx, xy, yx, yy = _distort(x, y, distortion.tolist())
    return np.array([fx * u + cx, fy * v + cy]), np.array(
        [
            [fx * xx / pz, fx * xy / pz, -fx * (xx * x + xy * y) / pz],
            [fy * yx / pz, fy * yy / pz, -fy * (yx * x + yy * y) / pz],
        ]
    )


def undistort_pixel(
    pixel: Floats, matrix: Floats, distortion: Floats
) -> tuple[float, float] | None:
    """Return the undistorted normalized coordinates of one pixel (2,), by Newton's method.

    Returns None if the pixel is not finite, or outside the range in which the lens model is
    invertible.
    """
    fx, fy, cx, cy = _intrinsics(matrix)
    k = distortion.tolist()
    px, py = pixel.tolist()
    u, v = (px - cx) / fx, (py - cy) / fy
    x, y = u, v
    for _ in range(NEWTON_STEPS):
        du, dv, xx, xy, yx, yy = _distort(x, y, k)
        du, dv = du - u, dv - v
        determinant = xx * yy - xy * yx
        if not determinant > MIN_DISTORTION_SLOPE:
            return None
        x -= (yy * du - xy * dv) / determinant
        y -= (xx * dv - yx * du) / determinant
        if abs(du) + abs(dv) < 1e-12:
            return x, y
    return None


def _intrinsics(matrix: Floats) -> tuple[float, float, float, float]:
    (fx, _, cx), (_, fy, cy), _ = matrix.tolist()
    return fx, fy, cx, cy


def _distort(
    x: float, y: float, distortion: list[float]
) -> tuple[float, float, float, float, float, float]:
    """Apply Brown's lens distortion to a ray (x, y); return u, v, du/dx, du/dy, dv/dx, dv/dy.

    (u, v) are the distorted normalized coordinates.
    """
    k1, k2, p1, p2, k3 = distortion
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    bend = 2.0 * (k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3))
    across = bend * x * y + 2.0 * (p1 * x + p2 * y)
    return (
        x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
        y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        radial + bend * x * x + 2.0 * p1 * y + 6.0 * p2 * x,
        across,
        across,
        radial + bend * y * y + 6.0 * p1 * y + 2.0 * p2 * x,
    )


@dataclass(frozen=True, slots=True)
class TriangulatedPoint:
    """A triangulated marker: position (3,), m, covariance (3, 3), m^2, and reprojection error (px).

    The reprojection error is a root mean square. The covariance is computed to first order from the
    covariances of the centres in both images.
    """

    point_world: Floats
    covariance: Floats
    reprojection_px: float

    @property
    def deviation_m(self) -> float:
        """Return the square root (m) of the sum of the variances along x, y and z."""
        return float(np.sqrt(np.trace(self.covariance)))


def measure(
    geometry: StereoGeometry,
    left_px: Floats,
    right_px: Floats,
    *,
    covariance: Floats,
    right_covariance: Floats | None = None,
) -> TriangulatedPoint | None:
    """Triangulate a marker from its pixels (2,) in both views.

    covariance: covariance (2, 2), px^2, of the left pixel.
    right_covariance: covariance (2, 2), px^2, of the right pixel; None if it equals `covariance`.

    Both views have equal weights. The covariances are therefore propagated by (J^T J)^-1 J^T, with
    the Jacobian J of the four pixel coordinates with respect to the point.

    Returns None if the point is not in front of both cameras, or if a pixel is invalid for the lens
    model.
    """
    left, right = geometry.undistort(0, left_px), geometry.undistort(1, right_px)
    if left is None or right is None:
        return None
    rig = geometry.right_from_left
    point = dlt(np.array([left]), np.array([right]), rig)[0]
    in_right = rig[:3, :3] @ point + rig[:3, 3]
    if not (0.0 < point[2] < MAX_DISTANCE_M and 0.0 < in_right[2] < MAX_DISTANCE_M):
        return None
    left_projected, left_slope = geometry.project_with_jacobian(0, point)
    right_projected, right_slope = geometry.project_with_jacobian(1, in_right)
    slope = np.concatenate((left_slope, right_slope @ rig[:3, :3]))
    is_regular, information = cv2.invert(slope.T @ slope)
    if not is_regular:  # The rays are parallel within rounding errors.
        return None
    inverse = information @ slope.T
    world = geometry.world_from_left
    of_right = covariance if right_covariance is None else right_covariance
    left_part = world[:3, :3] @ inverse[:, :2]
    right_part = world[:3, :3] @ inverse[:, 2:]
    shifts = np.concatenate((left_projected - left_px, right_projected - right_px))
    return TriangulatedPoint(
        point_world=world[:3, :3] @ point + world[:3, 3],
        covariance=left_part @ covariance @ left_part.T + right_part @ of_right @ right_part.T,
        reprojection_px=float(np.sqrt(0.5 * (shifts @ shifts))),
    )
