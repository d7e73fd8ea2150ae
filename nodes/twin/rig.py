"""Simulate the true geometry and the true lenses of the stereo camera.

The section `camera` of a scene corresponds to a data sheet. The simulated device deviates from the
data sheet, and only a calibration determines the deviations. The camera model shares no code with
the nodes, because the simulator is used to test the nodes.
"""

from __future__ import annotations

import hashlib
import math
from typing import TypeVar

import numpy as np

from flexsheet.messages.scene import Lens, StereoCamera
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.models.rigid import apply, rotation_from_vector, transform

T = TypeVar("T", float, Floats)

FOCAL_DEVIATION = 0.005
"""The relative standard deviation of the focal length between devices of one model."""

ASPECT_DEVIATION = 0.0005
"""The standard deviation of the relative difference between the focal lengths fx and fy. It is
small because pixels are nearly square."""

CENTRE_DEVIATION_PX = 4.0
"""The standard deviation (px) of the principal point between devices, for an image width of 640
px."""

# k1 and k2 of typical lenses with 66 degrees of horizontal field of view, which data sheets omit.
RADIAL = (-0.30, 0.11)
"""The mean of the radial distortion coefficients k1 and k2."""

RADIAL_DEVIATION = (0.015, 0.01)
"""The standard deviation of the radial distortion coefficients k1 and k2."""

TANGENTIAL_DEVIATION = 0.0004
OFFSET_DEVIATION_M = 0.0001
"""The standard deviation, per axis, of the right camera's position relative to the data sheet."""

ROTATION_DEVIATION_RAD = 0.004
"""The standard deviation, per axis, of the right camera's rotation relative to the data sheet."""

NEWTON_STEPS = 12


def make_true_camera(camera: StereoCamera) -> StereoCamera:
    """Return true camera parameters that deviate at random from the parameters in the scene.

    The random seed is derived from the device name. The deviations are normally distributed and
    limited to two standard deviations. The pose of the left camera, image size, rate and exposure
    do not change.
    """
    name = hashlib.sha256(camera.device.encode()).digest()
    random = np.random.default_rng(np.frombuffer(name, dtype=np.uint32))

    def deviation(*shape: int) -> Floats:
        return np.clip(random.standard_normal(shape), -2.0, 2.0)

    def built(lens: Lens) -> Lens:
        focal, aspect, centre_x, centre_y, k1, k2, p1, p2 = deviation(8)
        centre_px = CENTRE_DEVIATION_PX * camera.width_px / 640.0
        added = (
            RADIAL[0] + RADIAL_DEVIATION[0] * k1,
            RADIAL[1] + RADIAL_DEVIATION[1] * k2,
            TANGENTIAL_DEVIATION * p1,
            TANGENTIAL_DEVIATION * p2,
            0.0,
        )
        k = tuple(float(old + new) for old, new in zip(lens.distortion, added, strict=True))
        fx_px = lens.fx_px * (1.0 + FOCAL_DEVIATION * focal)
        fy_px = lens.fy_px * (1.0 + FOCAL_DEVIATION * focal + ASPECT_DEVIATION * aspect)
        return Lens(
            fx_px=float(fx_px),
            fy_px=float(fy_px),
            cx_px=float(lens.cx_px + centre_px * centre_x),
            cy_px=float(lens.cy_px + centre_px * centre_y),
            distortion=(k[0], k[1], k[2], k[3], k[4]),
        )

    left, right = built(camera.left), built(camera.right)
    turn = rotation_from_vector(ROTATION_DEVIATION_RAD * deviation(3))
    moved = transform(turn, OFFSET_DEVIATION_M * deviation(3))
    return camera.model_copy(
        update={"left": left, "right": right, "right_from_left": moved @ camera.right_from_left}
    )


def pixels_of(lens: Lens, slopes: Floats) -> Floats:
    """Return the pixels (..., 2) at which a lens with Brown's distortion images rays.

    slopes (..., 2): x/z and y/z of the rays.
    """
    return np.stack(project_ray(lens, slopes[..., 0], slopes[..., 1]), axis=-1)


def project_ray(lens: Lens, u: T, v: T) -> tuple[T, T]:
    """Return the pixel column and row of a ray, or arrays of both for arrays of rays.

    u, v: x/z and y/z of the ray. For a single ray, Python floats are much faster than arrays.
    """
    k1, k2, p1, p2, k3 = lens.distortion
    r2 = u * u + v * v
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    x = u * radial + 2.0 * p1 * u * v + p2 * (r2 + 2.0 * u * u)
    y = v * radial + p1 * (r2 + 2.0 * v * v) + 2.0 * p2 * u * v
    return lens.fx_px * x + lens.cx_px, lens.fy_px * y + lens.cy_px


def _slopes_of_distortion(lens: Lens, u: T, v: T) -> tuple[T, T, T]:
    """Return the partial derivatives of Brown's lens distortion with respect to the ray.

    The distortion maps the undistorted image coordinates (u, v) = (x/z, y/z) of a ray to distorted
    coordinates (p, q). Returns dp/du, dp/dv and dq/dv. The fourth derivative dq/du equals dp/dv.
    """
    k1, k2, p1, p2, k3 = lens.distortion
    r2 = u * u + v * v
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2.0 * (k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3))
    xx = radial + slope * u * u + 2.0 * p1 * v + 6.0 * p2 * u
    yy = radial + slope * v * v + 6.0 * p1 * v + 2.0 * p2 * u
    return xx, slope * u * v + 2.0 * p1 * u + 2.0 * p2 * v, yy


def stereo_pixels(
    camera: StereoCamera, left_from_world: Floats, points: Floats
) -> tuple[Floats, Floats]:
    """Return the pixel (2,) of a moving point in the left image, and in the right image.

    points (2, 3): world positions of the point at the exposures of both images, m.
    """
    in_left = apply(left_from_world, points)
    left, right = in_left[0], apply(camera.right_from_left, in_left)[1]
    return (
        pixels_of(camera.left, left[:2] / left[2]),
        pixels_of(camera.right, right[:2] / right[2]),
    )


def pixels_per_slope(lens: Lens, slope_x: float, slope_y: float) -> float:
    """Return the image scale near a ray, in pixels per unit of the slopes x/z and y/z.

    The scale is the square root of the determinant of the projection's derivative.
    """
    xx, xy, yy = _slopes_of_distortion(lens, slope_x, slope_y)
    return math.sqrt(lens.fx_px * lens.fy_px * abs(xx * yy - xy * xy))


def slopes_of(lens: Lens, pixels: Floats) -> Floats:
    """Return the slopes x/z and y/z (..., 2) of the rays through pixels (..., 2).

    The function inverts `pixels_of` by Newton's method. The result is valid in the part of the
    image in which each pixel belongs to a single ray.
    """
    x_px, y_px = pixels[..., 0], pixels[..., 1]
    # Separate arrays, because numpy is about twice as fast with contiguous ones.
    u, v = (x_px - lens.cx_px) / lens.fx_px, (y_px - lens.cy_px) / lens.fy_px
    for _ in range(NEWTON_STEPS):
        seen_x, seen_y = project_ray(lens, u, v)
        off_u, off_v = (seen_x - x_px) / lens.fx_px, (seen_y - y_px) / lens.fy_px
        xx, xy, yy = _slopes_of_distortion(lens, u, v)
        determinant = xx * yy - xy * xy
        u = u - (yy * off_u - xy * off_v) / determinant
        v = v - (xx * off_v - xy * off_u) / determinant
        if max(np.abs(off_u).max(initial=0.0), np.abs(off_v).max(initial=0.0)) < 1e-12:
            break
    return np.stack([u, v], axis=-1)
