"""Check whether two ellipses show one flat round marker, and correct their centres.

Perspective shifts the centre of an ellipse. The image of a disc with radius R and normal n
satisfies A A^T = R^2 J (I - n n^T) J^T. The matrix A (2, 2) maps the unit circle to the ellipse's
edge (module `ellipse`). The matrix J (2, 3) is the derivative of the disc centre's pixel
coordinates with respect to its position. Each ellipse permits two normals, mirrored about the line
of sight. The image of the other camera determines the correct normal. If a marker is partly
covered, or merged with a bright spot, usually no normal agrees with both views.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from flexsheet.nodes.arrays import Floats


@dataclass(frozen=True, slots=True)
class DiscView:
    """A flat disc as seen by one camera, where its image is an ellipse.

    camera_from_left: rotation (3, 3) from the left camera's axes to the axes of this camera.
    point: centre (3,) m of the disc in this camera's frame.
    jacobian: derivative (2, 3), px/m, of the centre's pixel coordinates with respect to `point`.
    axes: symmetric matrix A (2, 2), px. The points of the ellipse's edge are centre + A (cos t, sin
        t).
    """

    camera_from_left: Floats
    point: Floats
    jacobian: Floats
    axes: Floats


@dataclass(frozen=True, slots=True)
class FlatPose:
    """The orientation of a flat disc, estimated from its images in two cameras.

    normal: normal (3,) of the disc in the left camera's axes.
    mismatch_px: maximum difference between the semi-axes of a measured and a computed ellipse.
    centre_offsets_px: offsets (2, 2), one row per camera, by which perspective shifts the centre of
        the ellipse from the image of the disc's centre.
    """

    normal: Floats
    mismatch_px: float
    centre_offsets_px: Floats


def estimate_flat_pose(views: Sequence[DiscView], radius_m: float) -> FlatPose:
    """Find the orientation of a disc that best explains the ellipses in two views."""
    found = [list(_possible_normals(view, radius_m)) for view in views]
    normals = [normal for normals in found for normal in normals]
    for one in found[0]:
        for other in found[1]:
            mean = one + other
            normals.append(mean / max(math.hypot(*mean), 1e-9))
    mismatches = [
        max(_mismatch_px(view, view.camera_from_left @ normal, radius_m) for view in views)
        for normal in normals
    ]
    best = int(np.argmin(mismatches))
    offsets = [_centre_offset_px(view, normals[best], radius_m) for view in views]
    return FlatPose(normals[best], mismatches[best], np.array(offsets))


def _possible_normals(view: DiscView, radius_m: float) -> Iterator[Floats]:
    """Yield the two normals (3,) of a disc, in the left camera's axes, that fit one ellipse."""
    sideways, triangle = np.linalg.qr(view.jacobian.T)
    back = np.linalg.solve(triangle.T, view.axes) / radius_m
    values, vectors = np.linalg.eigh(back @ back.T)
    sine = math.sqrt(min(max(1.0 - float(values[0]), 0.0), 1.0))
    across = sideways @ vectors[:, 0]
    towards = np.cross(sideways[:, 0], sideways[:, 1])
    towards = -math.copysign(1.0, float(towards @ view.point)) * towards
    for sign in (1.0, -1.0):
        normal = sign * sine * across + math.sqrt(1.0 - sine * sine) * towards
        yield view.camera_from_left.T @ normal


def _mismatch_px(view: DiscView, normal: Floats, radius_m: float) -> float:
    """Return the difference (px) between the measured image of a disc and the expected ellipse.

    The difference is the largest over all directions of the semi-axes.

    normal: assumed normal (3,) of the disc in the camera's axes, which determines the ellipse.
    """
    along = view.jacobian @ normal
    square = radius_m**2 * (view.jacobian @ view.jacobian.T - np.outer(along, along))
    # Square root of a symmetric 2 x 2 matrix.
    root = math.sqrt(max(float(np.linalg.det(square)), 0.0))
    axes = (square + root * np.eye(2)) / math.sqrt(float(np.trace(square)) + 2.0 * root)
    return float(np.linalg.norm(view.axes - axes, 2))


def _centre_offset_px(view: DiscView, normal: Floats, radius_m: float) -> Floats:
    """Return the offset (2,), px, from the image of a disc's centre to the centre of its ellipse.

    normal: normal (3,) of the disc in the left camera's axes.

    The centre of the ellipse is computed from the dual conic of the disc. The lens distortion is
    linearised.
    """
    in_camera, point = view.camera_from_left @ normal, view.point
    conic = radius_m**2 * (np.eye(3) - np.outer(in_camera, in_camera)) - np.outer(point, point)
    slopes = conic[:2, 2] / conic[2, 2] - point[:2] / point[2]
    return np.asarray(view.jacobian[:, :2] @ slopes * point[2])
