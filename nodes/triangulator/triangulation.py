"""From a mark in two pictures to a point in space, with its covariance.

The methods take undistorted normalized coordinates (n, 2) of both views and `right_from_left`, and
give points (n, 3) in the left camera's frame, metres.  Where the rays are parallel the point is at
infinity: elements are then infinite or NaN, which the caller must refuse.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from messages.calibration import StereoCalibration
from messages.scene import Lens, StereoCamera
from nodes.models import camera, rigid

Floats = NDArray[np.float64]
Triangulate = Callable[[Floats, Floats, Floats], Floats]


class CalibrationMismatchError(ValueError):
    """A calibration of another device or picture size than the scene's camera."""


@dataclass(frozen=True, slots=True)
class StereoGeometry:
    """A rig as arrays: matrices 3x3, distortions (5,), transforms 4x4."""

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
        """The scene's rig, its optics taken from a calibration file if one is given.

        Where the rig stands always comes from the scene.  Raises CalibrationMismatchError.
        """
        optics: StereoCamera | StereoCalibration = scene_camera
        if calibration is not None:
            _refuse_other_camera(scene_camera, calibration)
            optics = calibration
        world_from_left = rigid.transform_from_rpy(
            scene_camera.world_from_left.position_m, scene_camera.world_from_left.rpy_rad
        )
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

    def project(self, points_world: Floats) -> tuple[Floats, Floats]:
        """Left and right pixels (..., 2) of world points (..., 3) in front of both cameras."""
        in_left = rigid.apply(self.left_from_world, points_world)
        in_right = rigid.apply(self.right_from_left, in_left)
        return (
            camera.project(in_left, self.matrices[0], self.distortions[0]),
            camera.project(in_right, self.matrices[1], self.distortions[1]),
        )

    def normalize(self, left_px: Floats, right_px: Floats) -> tuple[Floats, Floats]:
        """Undistorted normalized coordinates (..., 2) of pixels in both views."""
        return (
            camera.normalize(left_px, self.matrices[0], self.distortions[0]),
            camera.normalize(right_px, self.matrices[1], self.distortions[1]),
        )


def _matrix(lens: Lens) -> Floats:
    return camera.camera_matrix(lens.fx_px, lens.fy_px, lens.cx_px, lens.cy_px)


def _refuse_other_camera(scene_camera: StereoCamera, calibration: StereoCalibration) -> None:
    if calibration.device != scene_camera.device:
        raise CalibrationMismatchError(
            f'calibration is of device "{calibration.device}", the scene\'s camera is '
            f'"{scene_camera.device}": name the right file in the parameter "calibration", or '
            "calibrate this camera"
        )
    measured = (calibration.width_px, calibration.height_px)
    wanted = (scene_camera.width_px, scene_camera.height_px)
    if measured != wanted:
        raise CalibrationMismatchError(
            f"calibration of {calibration.device} is for {measured[0]}x{measured[1]} px, the "
            f"scene's camera gives {wanted[0]}x{wanted[1]} px: calibrate at this size"
        )


def _rays(normalized: Floats) -> Floats:
    """Directions (n, 3) of normalized coordinates (n, 2), unit depth."""
    rays = np.ones((len(normalized), 3))
    rays[:, :2] = normalized
    return rays


def midpoint(left: Floats, right: Floats, right_from_left: Floats) -> Floats:
    """The middle of the shortest line between the two rays (closed form)."""
    left_from_right = rigid.inverse(right_from_left)
    origin = left_from_right[:3, 3]
    a = _rays(left)
    b = _rays(right) @ left_from_right[:3, :3].T
    aa, bb, ab = (a * a).sum(axis=1), (b * b).sum(axis=1), (a * b).sum(axis=1)
    ao, bo = a @ origin, b @ origin
    with np.errstate(divide="ignore", invalid="ignore"):
        determinant = aa * bb - ab * ab
        s = (bb * ao - ab * bo) / determinant
        t = (ab * ao - aa * bo) / determinant
        return np.asarray(0.5 * (s[:, None] * a + origin + t[:, None] * b))


def dlt(left: Floats, right: Floats, right_from_left: Floats) -> Floats:
    """Linear least squares of both projections in homogeneous form (direct linear transform).

    Hartley and Zisserman, Multiple View Geometry, 2nd ed., section 12.2.
    """
    projections = (np.eye(3, 4), right_from_left[:3])
    rows = np.empty((len(left), 4, 4))
    for view, (seen, projection) in enumerate(zip((left, right), projections, strict=True)):
        rows[:, 2 * view : 2 * view + 2] = seen[:, :, None] * projection[2] - projection[:2]
    homogeneous = np.linalg.svd(rows)[2][:, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(homogeneous[:, :3] / homogeneous[:, 3:])


def optimal(left: Floats, right: Floats, right_from_left: Floats) -> Floats:
    """Least squared image error: pixels are moved onto the epipolar constraint, then rays meet.

    Lindstrom, Triangulation Made Easy (CVPR 2010), the variant of two iterations.  Optimal for
    equal noise in both views, that is for cameras of nearly equal focal length.
    """
    essential = rigid.skew(right_from_left[:3, 3]) @ right_from_left[:3, :3]
    upper = essential[:2, :2]
    x, y = _rays(right), _rays(left)
    n = (y @ essential.T)[:, :2]
    m = (x @ essential)[:, :2]
    a = np.einsum("ni,ij,nj->n", n, upper, m)
    b = 0.5 * ((n * n).sum(axis=1) + (m * m).sum(axis=1))
    c = np.einsum("ni,ij,nj->n", x, essential, y)
    d = np.sqrt(np.maximum(b * b - a * c, 0.0))
    with np.errstate(divide="ignore", invalid="ignore"):
        factor = c / (b + d)
        n, m = n - factor[:, None] * (m @ upper.T), m - factor[:, None] * (n @ upper)
        factor = factor * 2.0 * d / ((n * n).sum(axis=1) + (m * m).sum(axis=1))
        corrected_right = x[:, :2] - factor[:, None] * n
        corrected_left = y[:, :2] - factor[:, None] * m
    return midpoint(corrected_left, corrected_right, right_from_left)


TRIANGULATION_METHODS: dict[str, Triangulate] = {
    "midpoint": midpoint,
    "dlt": dlt,
    "optimal": optimal,
}


def covariance_in_left(geometry: StereoGeometry, point_left: Floats, noise_px: float) -> Floats:
    """Covariance (3, 3) m^2 of a triangulated point (3,), in the left camera's frame.

    First order: (J'J)^-1 noise^2 with J the slope of the four pixel coordinates; distortion, whose
    slope differs from one by parts in a hundred, is left out.
    """
    point_right = rigid.apply(geometry.right_from_left, point_left)
    slopes = []
    for matrix, point, rotation in (
        (geometry.matrices[0], point_left, np.eye(3)),
        (geometry.matrices[1], point_right, geometry.right_from_left[:3, :3]),
    ):
        x, y, z = point
        slope = np.array([[1.0, 0.0, -x / z], [0.0, 1.0, -y / z]]) / z
        slopes.append(np.diag(matrix)[:2, None] * slope @ rotation)
    slope = np.concatenate(slopes)
    return np.asarray(noise_px**2 * np.linalg.inv(slope.T @ slope))


@dataclass(frozen=True, slots=True)
class Measured:
    """A triangulated mark: world position (3,) m, covariance (3, 3) m^2, image error px rms."""

    point_world: Floats
    covariance: Floats
    reprojection_px: float


def measure(
    geometry: StereoGeometry,
    left_px: Floats,
    right_px: Floats,
    *,
    method: Triangulate,
    noise_px: float,
) -> Measured | None:
    """The point behind a mark's two pixels (2,); None if it is not in front of both cameras.

    A pixel that is no finite number has no point either.
    """
    if not (np.isfinite(left_px).all() and np.isfinite(right_px).all()):
        return None
    left, right = geometry.normalize(left_px[None], right_px[None])
    point = method(left, right, geometry.right_from_left)[0]
    if not np.isfinite(point).all():
        return None
    if point[2] <= 0 or rigid.apply(geometry.right_from_left, point)[2] <= 0:
        return None
    point_world = rigid.apply(geometry.world_from_left, point)
    drawn = geometry.project(point_world)
    shifts = np.concatenate([drawn[0] - left_px, drawn[1] - right_px])
    rotation = geometry.world_from_left[:3, :3]
    return Measured(
        point_world=point_world,
        covariance=rotation @ covariance_in_left(geometry, point, noise_px) @ rotation.T,
        reprojection_px=float(np.sqrt(0.5 * (shifts @ shifts))),
    )
