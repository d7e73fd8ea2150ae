"""Compensate the finger's motion between the exposures of two cameras without a common trigger."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.triangulator.triangulation import StereoGeometry, TriangulatedPoint


def compensate_skew(
    measured: TriangulatedPoint,
    geometry: StereoGeometry,
    skew_s: float,
    velocity: Floats,
    velocity_covariance: Floats,
) -> TriangulatedPoint:
    """Correct a triangulated point of a moving finger for the time between both exposures.

    skew_s: time of the right exposure minus the time of the left exposure.
    velocity: velocity (3,), m/s, of the finger in the world, with its covariance (3, 3).

    The corrected point is the finger's position at the mean time of both exposures. To first order,
    a finger with velocity v is measured with the error M v, where M = s (A_r J_r - I/2). Here s is
    `skew_s`, I is the identity matrix, and J_r is the derivative of the right pixel with respect to
    the point. A_r is the derivative of the triangulated point with respect to the right pixel. The
    uncertainty of v is added to the covariance.
    """
    world = geometry.world_from_left[:3, :3]
    in_left, in_right = geometry.transform_to_cameras(measured.point_world)
    left = geometry.project_with_jacobian(0, in_left)[1]
    right = geometry.project_with_jacobian(1, in_right)[1] @ geometry.right_from_left[:3, :3]
    # The singular case was rejected when the point was triangulated.
    right_weight = np.linalg.solve(left.T @ left + right.T @ right, right.T @ right)
    error = skew_s * (world @ right_weight @ world.T - 0.5 * np.eye(3))
    return replace(
        measured,
        point_world=measured.point_world - error @ velocity,
        covariance=measured.covariance + error @ velocity_covariance @ error.T,
    )
