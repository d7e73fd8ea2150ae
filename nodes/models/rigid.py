"""Rigid transforms.

A transform ``a_from_b`` is a 4x4 homogeneous matrix that takes coordinates in frame b to frame a.
Twists are 6-vectors, linear part first (m/s), then angular (rad/s), both seen in the world frame.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]


def rotation_from_rpy(rpy_rad: ArrayLike) -> Floats:
    """Rotation matrix of roll, pitch, yaw about the fixed x, y, z axes, in that order (URDF)."""
    roll, pitch, yaw = np.asarray(rpy_rad, dtype=np.float64)
    cr, sr, cp, sp = np.cos(roll), np.sin(roll), np.cos(pitch), np.sin(pitch)
    cy, sy = np.cos(yaw), np.sin(yaw)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def rotation_from_vector(vector_rad: ArrayLike) -> Floats:
    """Rotation matrix about `vector_rad` by its length (Rodrigues); exact near zero."""
    vector = np.asarray(vector_rad, dtype=np.float64)
    angle = float(np.linalg.norm(vector))
    cross = skew(vector)
    if angle < 1e-8:
        return np.eye(3) + cross + 0.5 * (cross @ cross)
    turn = np.sin(angle) / angle * cross + (1.0 - np.cos(angle)) / angle**2 * (cross @ cross)
    return np.asarray(np.eye(3) + turn, dtype=np.float64)


def vector_from_rotation(rotation: Floats) -> Floats:
    """Rotation vector (rad), length 0..pi, of a rotation matrix; also sound near 0 and pi."""
    quaternion = quaternion_from_rotation(rotation)
    length = float(np.linalg.norm(quaternion[1:]))
    if length < 1e-12:
        return 2.0 * quaternion[1:]
    scale = 2.0 * float(np.arctan2(length, quaternion[0])) / length
    return scale * quaternion[1:]


def quaternion_from_rotation(rotation: Floats) -> Floats:
    """Unit quaternion (w, x, y, z), w >= 0, of a rotation matrix.

    Takes the largest of the four components first (Shepperd's method), so that no division is by a
    small number.
    """
    trace = float(np.trace(rotation))
    weights = np.array([trace, rotation[0, 0], rotation[1, 1], rotation[2, 2]])
    largest = int(np.argmax(weights))
    if largest == 0:
        quaternion = np.array(
            [
                1.0 + trace,
                rotation[2, 1] - rotation[1, 2],
                rotation[0, 2] - rotation[2, 0],
                rotation[1, 0] - rotation[0, 1],
            ]
        )
    else:
        i = largest - 1
        j, k = (i + 1) % 3, (i + 2) % 3
        quaternion = np.empty(4)
        quaternion[0] = rotation[k, j] - rotation[j, k]
        quaternion[1 + i] = 1.0 + rotation[i, i] - rotation[j, j] - rotation[k, k]
        quaternion[1 + j] = rotation[j, i] + rotation[i, j]
        quaternion[1 + k] = rotation[k, i] + rotation[i, k]
    quaternion /= np.linalg.norm(quaternion)
    return -quaternion if quaternion[0] < 0 else quaternion


def skew(vector: ArrayLike) -> Floats:
    """Matrix S with S @ u = vector x u."""
    x, y, z = np.asarray(vector, dtype=np.float64)
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def transform(rotation: Floats, position: ArrayLike) -> Floats:
    """The 4x4 transform with that rotation and position (m)."""
    result = np.eye(4)
    result[:3, :3] = rotation
    result[:3, 3] = position
    return result


def transform_from_rpy(position_m: ArrayLike, rpy_rad: ArrayLike) -> Floats:
    """The transform of a pose as scenes give it."""
    return transform(rotation_from_rpy(rpy_rad), position_m)


def inverse(a_from_b: Floats) -> Floats:
    """b_from_a of a rigid a_from_b."""
    rotation = a_from_b[:3, :3].T
    return transform(rotation, -rotation @ a_from_b[:3, 3])


def apply(a_from_b: Floats, points_b: Floats) -> Floats:
    """Points (..., 3) of frame b in frame a."""
    return points_b @ a_from_b[:3, :3].T + a_from_b[:3, 3]


def is_rigid(matrix: Floats, tolerance: float = 1e-6) -> bool:
    """Whether a matrix is 4x4 and finite, its rotation proper, its last row (0 0 0 1)."""
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        return False
    rotation = matrix[:3, :3]
    return bool(
        np.allclose(rotation @ rotation.T, np.eye(3), atol=tolerance)
        and np.linalg.det(rotation) > 0
        and np.allclose(matrix[3], [0.0, 0.0, 0.0, 1.0], atol=tolerance)
    )


def moved(world_from_body: Floats, twist_world: Floats, duration_s: float) -> Floats:
    """The body's pose after `duration_s` of a constant twist about its own origin."""
    rotation = rotation_from_vector(twist_world[3:] * duration_s) @ world_from_body[:3, :3]
    return transform(rotation, world_from_body[:3, 3] + twist_world[:3] * duration_s)


def twist_between(world_from_before: Floats, world_from_after: Floats, duration_s: float) -> Floats:
    """The constant twist that takes one pose to the other in `duration_s` (> 0)."""
    linear = (world_from_after[:3, 3] - world_from_before[:3, 3]) / duration_s
    turn = world_from_after[:3, :3] @ world_from_before[:3, :3].T
    return np.concatenate([linear, vector_from_rotation(turn) / duration_s])


def angle_between(a: Floats, b: Floats) -> float:
    """Angle (rad, 0..pi) between two vectors; exact for small angles, unlike the arc cosine."""
    return float(np.arctan2(np.linalg.norm(np.cross(a, b)), np.dot(a, b)))
