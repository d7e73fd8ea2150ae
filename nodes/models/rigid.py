"""Rigid transforms.

A transform ``a_from_b`` is a 4x4 homogeneous matrix that maps coordinates in frame b to frame a.
Twists are 6-vectors, linear part first (m/s), then angular (rad/s), both in the world frame.
"""

from __future__ import annotations

from math import atan2, cos, hypot, inf, nan, sin, sqrt

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]

_UNIT: Floats = np.eye(4)


def rotation_from_rpy(rpy_rad: ArrayLike) -> Floats:
    """Return the rotation matrix of roll, pitch, yaw about the fixed x, y, z axes, in that order
    (URDF)."""
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


def rpy_from_rotation(rotation: Floats) -> Floats:
    """Return roll, pitch, yaw (rad) of a rotation matrix: inverse of `rotation_from_rpy`.

    With the pitch at +-90 degrees, roll and yaw have the same axis; the yaw is then zero.
    """
    level = float(np.hypot(rotation[0, 0], rotation[1, 0]))
    pitch = float(np.arctan2(-rotation[2, 0], level))
    if level < 1e-9:
        return np.array([np.arctan2(-rotation[1, 2], rotation[1, 1]), pitch, 0.0])
    roll = np.arctan2(rotation[2, 1], rotation[2, 2])
    return np.array([roll, pitch, np.arctan2(rotation[1, 0], rotation[0, 0])])


def rotation_from_vector(vector_rad: ArrayLike) -> Floats:
    """Return the rotation about `vector_rad` by its length (Rodrigues); accurate near zero.

    The matrix is all NaN for a vector without a finite length.
    """
    x, y, z = np.asarray(vector_rad, dtype=np.float64).tolist()
    angle = sqrt(x * x + y * y + z * z)
    if angle < 1e-8:
        first, second = 1.0, 0.5
    elif angle < inf:
        first, second = sin(angle) / angle, (1.0 - cos(angle)) / (angle * angle)
    else:
        return np.full((3, 3), nan)
    xy, xz, yz = second * x * y, second * x * z, second * y * z
    x2, y2, z2 = second * x * x, second * y * y, second * z * z
    x, y, z = first * x, first * y, first * z
    return np.array(
        [
            [1.0 - y2 - z2, xy - z, xz + y],
            [xy + z, 1.0 - x2 - z2, yz - x],
            [xz - y, yz + x, 1.0 - x2 - y2],
        ]
    )


def vector_from_rotation(rotation: Floats) -> Floats:
    """Return the rotation vector (rad), length 0..pi; accurate near 0 and pi too."""
    w, x, y, z = quaternion_from_rotation(rotation).tolist()
    length = sqrt(x * x + y * y + z * z)
    scale = 2.0 if length < 1e-12 else 2.0 * atan2(length, w) / length
    return np.array([scale * x, scale * y, scale * z])


def quaternion_from_rotation(rotation: Floats) -> Floats:
    """Return the unit quaternion (w, x, y, z), w >= 0, of a rotation matrix.

    The largest of the four components comes first (Shepperd's method), so that nothing is divided
    by a small number.
    """
    turn = rotation.tolist()
    diagonal = turn[0][0], turn[1][1], turn[2][2]
    trace = diagonal[0] + diagonal[1] + diagonal[2]
    i = max(range(3), key=diagonal.__getitem__)
    j, k = (i + 1) % 3, (i + 2) % 3
    quaternion = [turn[k][j] - turn[j][k], 0.0, 0.0, 0.0]
    if trace >= diagonal[i]:
        quaternion = [
            1.0 + trace,
            turn[2][1] - turn[1][2],
            turn[0][2] - turn[2][0],
            turn[1][0] - turn[0][1],
        ]
    else:
        quaternion[1 + i] = 1.0 + diagonal[i] - diagonal[j] - diagonal[k]
        quaternion[1 + j] = turn[j][i] + turn[i][j]
        quaternion[1 + k] = turn[k][i] + turn[i][k]
    length = sqrt(sum(part * part for part in quaternion)) or nan
    if quaternion[0] < 0.0:
        length = -length
    return np.array([part / length for part in quaternion])


def skew(vector: ArrayLike) -> Floats:
    """Return the matrix S with S @ u = vector x u."""
    x, y, z = np.asarray(vector, dtype=np.float64).tolist()
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def transform(rotation: Floats, position: ArrayLike) -> Floats:
    """Return the 4x4 transform with that rotation and position (m)."""
    result = np.eye(4)
    result[:3, :3] = rotation
    result[:3, 3] = position
    return result


def transform_from_rpy(position_m: ArrayLike, rpy_rad: ArrayLike) -> Floats:
    """Return the transform of a pose in the form of scenes."""
    return transform(rotation_from_rpy(rpy_rad), position_m)


def inverse(a_from_b: Floats) -> Floats:
    """Return b_from_a of a rigid a_from_b."""
    rotation = a_from_b[:3, :3].T
    return transform(rotation, -rotation @ a_from_b[:3, 3])


def apply(a_from_b: Floats, points_b: Floats) -> Floats:
    """Transform points (..., 3) of frame b to frame a."""
    return points_b @ a_from_b[:3, :3].T + a_from_b[:3, 3]


def is_rigid(matrix: Floats, tolerance: float = 1e-6) -> bool:
    """Whether a matrix is 4x4, finite and orthonormal, with determinant 1 and last row (0 0 0
    1)."""
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        return False
    rotation = matrix[:3, :3]
    # The same test as numpy.allclose, in a tenth of its time.
    allowed = tolerance + 1e-5 * _UNIT
    return bool(
        (np.abs(rotation @ rotation.T - _UNIT[:3, :3]) <= allowed[:3, :3]).all()
        and np.linalg.det(rotation) > 0
        and (np.abs(matrix[3] - _UNIT[3]) <= allowed[3]).all()
    )


def moved(world_from_body: Floats, twist_world: Floats, duration_s: float) -> Floats:
    """Return the body's pose after `duration_s` of a constant twist about its own origin."""
    rotation = rotation_from_vector(twist_world[3:] * duration_s) @ world_from_body[:3, :3]
    return transform(rotation, world_from_body[:3, 3] + twist_world[:3] * duration_s)


def angle_between(a: Floats, b: Floats) -> float:
    """Return the angle (rad, 0..pi) between two vectors; accurate for small angles, unlike
    arccos."""
    (ax, ay, az), (bx, by, bz) = a.tolist(), b.tolist()
    across = hypot(ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx)
    return atan2(across, ax * bx + ay * by + az * bz)
