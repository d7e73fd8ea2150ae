"""Project and undistort points with a pinhole camera and Brown's distortion.

In the camera frame, the x axis points to the right, the y axis down, and the z axis along the
optical axis. Points have the shape (..., 3), in m. Pixel coordinates have the shape (..., 2). As in
OpenCV, their origin is the centre of the top left pixel.
"""

from __future__ import annotations

import numpy as np

from flexsheet.nodes.arrays import Floats


def camera_matrix(fx_px: float, fy_px: float, cx_px: float, cy_px: float) -> Floats:
    """Return the matrix (3, 3) of a pinhole camera from focal lengths and principal point, px."""
    return np.array([[fx_px, 0.0, cx_px], [0.0, fy_px, cy_px], [0.0, 0.0, 1.0]])


MAX_ITERATIONS = 20


def distort(normalized: Floats, distortion: Floats) -> Floats:
    """Apply lens distortion to normalized image coordinates (..., 2).

    distortion: coefficients k1, k2, p1, p2, k3 (Brown 1966, in OpenCV's order).
    """
    k1, k2, p1, p2, k3 = distortion
    x, y = normalized[..., 0], normalized[..., 1]
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return np.stack(
        [
            x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        ],
        axis=-1,
    )


def undistort(distorted: Floats, distortion: Floats) -> Floats:
    """Remove lens distortion from normalized image coordinates (..., 2) by a fixed-point iteration.

    distortion: coefficients k1, k2, p1, p2, k3, as for `distort`.

    The iteration stops when no coordinate changes by more than 1e-13, or after `MAX_ITERATIONS`.
    The iteration converges at points near which the distortion changes slowly. For usual lenses,
    these are all points inside the image.
    """
    k1, k2, p1, p2, k3 = distortion
    point = distorted.copy()
    for _ in range(MAX_ITERATIONS):
        x, y = point[..., 0], point[..., 1]
        r2 = x * x + y * y
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        moved = np.empty_like(distorted)
        moved[..., 0] = (distorted[..., 0] - (2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x))) / radial
        moved[..., 1] = (distorted[..., 1] - (p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y)) / radial
        settled = np.abs(moved - point).max(initial=0.0) < 1e-13
        point = moved
        if settled:
            break
    return point


def project(points_camera: Floats, matrix: Floats, distortion: Floats) -> Floats:
    """Project points (..., 3), m, in the camera frame to pixels (..., 2). Requires z > 0.

    matrix: camera matrix (3, 3).
    distortion: coefficients, as for `distort`.
    """
    normalized = distort(points_camera[..., :2] / points_camera[..., 2:], distortion)
    return normalized @ matrix[:2, :2].T + matrix[:2, 2]


def normalize(pixels: Floats, matrix: Floats, distortion: Floats) -> Floats:
    """Return the undistorted normalized coordinates (..., 2) of pixels (..., 2).

    The ray of normalized coordinates (x, y) has the direction (x, y, 1).

    matrix: camera matrix (3, 3).
    distortion: coefficients, as for `distort`.
    """
    distorted = (pixels - matrix[:2, 2]) / np.array([matrix[0, 0], matrix[1, 1]])
    return undistort(distorted, distortion)
