"""From a mark in two pictures to a point in space, with its covariance.

The methods take undistorted normalized coordinates (n, 2) of both views and `right_from_left`, and
give points (n, 3) in the left camera's frame, metres.  Where the rays are parallel the point is at
infinity: elements are then infinite or NaN, which the caller must refuse.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from messages.calibration import StereoCalibration, refuse_other_camera
from messages.scene import Lens, StereoCamera
from nodes.models import camera, rigid

Floats = NDArray[np.float64]
Triangulate = Callable[[Floats, Floats, Floats], Floats]

NEWTON_STEPS = 12
LEAST_SLOPE = 0.05
"""Of the distortion: a lens that presses the picture together more has folded it over."""

LEAST_SINE = 1e-6
"""Of the angle between two rays that meet; the volume is refused long before."""

FARTHEST_M = 1e4
"""Points farther are at infinity: their rays are parallel but for rounding."""


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
            refuse_other_camera(calibration, scene_camera)
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


@dataclass(frozen=True, slots=True)
class Approach:
    """Where single rays of a rig pass one another: the rig as plain numbers.

    turned: rows of the rotation left_from_right.  origin: of the right camera in the left's frame.
    """

    turned: tuple[tuple[float, float, float], ...]
    origin: tuple[float, float, float]

    @staticmethod
    def of(right_from_left: Floats) -> Approach:
        left_from_right = rigid.inverse(right_from_left).tolist()
        return Approach(
            tuple((row[0], row[1], row[2]) for row in left_from_right[:3]),
            (left_from_right[0][3], left_from_right[1][3], left_from_right[2][3]),
        )

    def of_rays(
        self, left: tuple[float, float], right: tuple[float, float]
    ) -> tuple[Floats, float] | None:
        """The middle (3,) of the shortest line between two rays, as `midpoint`, and its length.

        None where they are parallel or it lies behind a camera.
        """
        (ax, ay), (ox, oy, oz) = left, self.origin
        bx, by, bz = (row[0] * right[0] + row[1] * right[1] + row[2] for row in self.turned)
        aa, bb, ab = ax * ax + ay * ay + 1.0, bx * bx + by * by + bz * bz, ax * bx + ay * by + bz
        ao, bo = ax * ox + ay * oy + oz, bx * ox + by * oy + bz * oz
        determinant = aa * bb - ab * ab
        if not determinant > LEAST_SINE**2 * aa * bb:
            return None
        s = (bb * ao - ab * bo) / determinant
        t = (ab * ao - aa * bo) / determinant
        if s <= 0.0 or t <= 0.0:
            return None
        px, py, pz = ox + t * bx, oy + t * by, oz + t * bz
        middle = np.array([0.5 * (s * ax + px), 0.5 * (s * ay + py), 0.5 * (s + pz)])
        return middle, math.hypot(s * ax - px, s * ay - py, s - pz)


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


def pixel_and_slope(point: Floats, matrix: Floats, distortion: Floats) -> tuple[Floats, Floats]:
    """The pixel (2,) of a point (3,) in a camera's frame, and its slope (2, 3) px/m.

    One point at a time in plain numbers: a tenth of what arrays of two elements cost.
    """
    px, py, pz = point.tolist()
    fx, fy, cx, cy = _focus(matrix)
    x, y = px / pz, py / pz
    u, v, xx, xy, yx, yy = _distorted(x, y, distortion.tolist())
    return np.array([fx * u + cx, fy * v + cy]), np.array(
        [
            [fx * xx / pz, fx * xy / pz, -fx * (xx * x + xy * y) / pz],
            [fy * yx / pz, fy * yy / pz, -fy * (yx * x + yy * y) / pz],
        ]
    )


def ray_of(pixel: Floats, matrix: Floats, distortion: Floats) -> tuple[float, float] | None:
    """Undistorted normalized coordinates of one pixel (2,), by Newton's method.

    None where the lens has no ray for it: the pixel is no number, or lies where the distortion
    folds the picture over.
    """
    fx, fy, cx, cy = _focus(matrix)
    k = distortion.tolist()
    px, py = pixel.tolist()
    u, v = (px - cx) / fx, (py - cy) / fy
    x, y = u, v
    for _ in range(NEWTON_STEPS):
        du, dv, xx, xy, yx, yy = _distorted(x, y, k)
        du, dv = du - u, dv - v
        determinant = xx * yy - xy * yx
        if not determinant > LEAST_SLOPE:
            return None
        x -= (yy * du - xy * dv) / determinant
        y -= (xx * dv - yx * du) / determinant
        if abs(du) + abs(dv) < 1e-12:
            return x, y
    return None


def _focus(matrix: Floats) -> tuple[float, float, float, float]:
    (fx, _, cx), (_, fy, cy), _ = matrix.tolist()
    return fx, fy, cx, cy


def _distorted(
    x: float, y: float, distortion: list[float]
) -> tuple[float, float, float, float, float, float]:
    """Brown's distortion of one ray, and its slopes du/dx, du/dy, dv/dx, dv/dy."""
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
class Measured:
    """A triangulated mark: world position (3,) m, covariance (3, 3) m^2, image error px rms.

    The covariance is that of the marks' centres, to first order.  Where the rays are nearly
    parallel it grows with the fourth power of the depth, and the point is to be refused by it.
    """

    point_world: Floats
    covariance: Floats
    reprojection_px: float

    @property
    def deviation_m(self) -> float:
        """Root of the total variance."""
        return float(np.sqrt(np.trace(self.covariance)))


def measure(
    geometry: StereoGeometry,
    left_px: Floats,
    right_px: Floats,
    *,
    method: Triangulate,
    left_covariance: Floats,
    right_covariance: Floats,
) -> Measured | None:
    """The point behind a mark's two pixels (2,), which have covariances (2, 2) px^2.

    None if it is not in front of both cameras; a pixel that is no finite number has no point
    either, nor has one that the lens cannot have drawn.  The methods take both views as equally
    good, (J'J)^-1 J' with J the slope of the four pixel coordinates, and so does the covariance.
    """
    left = ray_of(left_px, geometry.matrices[0], geometry.distortions[0])
    right = ray_of(right_px, geometry.matrices[1], geometry.distortions[1])
    if left is None or right is None:
        return None
    rig = geometry.right_from_left
    point = method(np.array([left]), np.array([right]), rig)[0]
    in_right = rig[:3, :3] @ point + rig[:3, 3]
    if not (0.0 < point[2] < FARTHEST_M and 0.0 < in_right[2] < FARTHEST_M):
        return None
    left_drawn, left_slope = pixel_and_slope(point, geometry.matrices[0], geometry.distortions[0])
    right_drawn, right_slope = pixel_and_slope(
        in_right, geometry.matrices[1], geometry.distortions[1]
    )
    slope = np.concatenate((left_slope, right_slope @ rig[:3, :3]))
    known, information = cv2.invert(slope.T @ slope)
    if not known:  # the rays are parallel to the last digit
        return None
    inverse = information @ slope.T
    world = geometry.world_from_left
    left_part = world[:3, :3] @ inverse[:, :2]
    right_part = world[:3, :3] @ inverse[:, 2:]
    shifts = np.concatenate((left_drawn - left_px, right_drawn - right_px))
    return Measured(
        point_world=world[:3, :3] @ point + world[:3, 3],
        covariance=left_part @ left_covariance @ left_part.T
        + right_part @ right_covariance @ right_part.T,
        reprojection_px=float(np.sqrt(0.5 * (shifts @ shifts))),
    )
