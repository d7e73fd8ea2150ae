"""Create, convert and apply rigid transforms, which consist of a rotation and a translation.

A transform `a_from_b` is a homogeneous matrix (4, 4) that maps coordinates in frame b to frame a. A
twist is a vector (6,) in the world frame: linear velocity (m/s), then angular velocity (rad/s).
"""

from __future__ import annotations

from math import atan2, cos, hypot, inf, isfinite, nan, sin, sqrt
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from flexsheet.nodes.arrays import Floats

_UNIT: Floats = np.eye(4)


def rotation_from_rpy(rpy_rad: ArrayLike) -> Floats:
    """Return the rotation matrix (3, 3) of rotations about the fixed x, y and z axes, as in URDF.

    rpy_rad (3,): roll, pitch and yaw.
    """
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
    """Return roll, pitch and yaw (3,), rad, of a rotation matrix (3, 3).

    At a pitch of +-90 degrees, roll and yaw have the same axis. The yaw is then zero.
    """
    level = float(np.hypot(rotation[0, 0], rotation[1, 0]))
    pitch = float(np.arctan2(-rotation[2, 0], level))
    if level < 1e-9:
        return np.array([np.arctan2(-rotation[1, 2], rotation[1, 1]), pitch, 0.0])
    roll = np.arctan2(rotation[2, 1], rotation[2, 2])
    return np.array([roll, pitch, np.arctan2(rotation[1, 0], rotation[0, 0])])


def rotation_from_vector(vector_rad: ArrayLike) -> Floats:
    """Return the matrix (3, 3) of a rotation vector (3,) by Rodrigues' formula.

    The result is accurate for short vectors. It is NaN if the vector is not finite.
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
    """Return the rotation vector (3,), rad, of a rotation matrix (3, 3).

    The length of the vector is from 0 to pi. The result is accurate near both limits.
    """
    w, x, y, z = quaternion_from_rotation(rotation).tolist()
    length = sqrt(x * x + y * y + z * z)
    scale = 2.0 if length < 1e-12 else 2.0 * atan2(length, w) / length
    return np.array([scale * x, scale * y, scale * z])


def quaternion_from_rotation(rotation: Floats) -> Floats:
    """Return the unit quaternion (w, x, y, z), w >= 0, of a rotation matrix (3, 3).

    Shepperd's method computes the largest component first, to avoid division by a small number.
    """
    r = rotation.tolist()
    diagonal = r[0][0], r[1][1], r[2][2]
    trace = diagonal[0] + diagonal[1] + diagonal[2]
    i = max(range(3), key=diagonal.__getitem__)
    j, k = (i + 1) % 3, (i + 2) % 3
    quaternion = [r[k][j] - r[j][k], 0.0, 0.0, 0.0]
    if trace >= diagonal[i]:
        quaternion = [1.0 + trace, r[2][1] - r[1][2], r[0][2] - r[2][0], r[1][0] - r[0][1]]
    else:
        quaternion[1 + i] = 1.0 + diagonal[i] - diagonal[j] - diagonal[k]
        quaternion[1 + j] = r[j][i] + r[i][j]
        quaternion[1 + k] = r[k][i] + r[i][k]
    length = sqrt(sum(part * part for part in quaternion)) or nan
    if quaternion[0] < 0.0:
        length = -length
    return np.array([part / length for part in quaternion])


def skew(vector: ArrayLike) -> Floats:
    """Return the skew-symmetric matrix S (3, 3) of a vector (3,), such that S @ u = vector x u."""
    x, y, z = np.asarray(vector, dtype=np.float64).tolist()
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def transform(rotation: Floats, position: ArrayLike) -> Floats:
    """Return the transform (4, 4) with a rotation (3, 3) and a position (3,), m."""
    result = _UNIT.copy()
    result[:3, :3] = rotation
    result[:3, 3] = position
    return result


def transform_from_rpy(position_m: ArrayLike, rpy_rad: ArrayLike) -> Floats:
    """Return the transform (4, 4) of a position (3,), m, and roll, pitch, yaw (3,), rad."""
    return transform(rotation_from_rpy(rpy_rad), position_m)


class Pose(Protocol):
    """The interface of objects that describe a pose: position (m) and roll, pitch, yaw (rad)."""

    @property
    def position_m(self) -> ArrayLike: ...

    @property
    def rpy_rad(self) -> ArrayLike: ...


def pose_matrix(pose: Pose) -> Floats:
    """Return the transform (4, 4) that a pose describes, such as world_from_object."""
    return transform_from_rpy(pose.position_m, pose.rpy_rad)


def inverse(a_from_b: Floats) -> Floats:
    """Return the inverse b_from_a (4, 4) of a rigid transform a_from_b."""
    rotation = a_from_b[:3, :3].T
    return transform(rotation, -rotation @ a_from_b[:3, 3])


def apply(a_from_b: Floats, points_b: Floats) -> Floats:
    """Transform points (..., 3) from frame b to frame a."""
    return points_b @ a_from_b[:3, :3].T + a_from_b[:3, 3]


def is_rigid(matrix: Floats, tolerance: float = 1e-6) -> bool:
    """Return whether a matrix (4, 4) is a finite rigid transform with the last row (0 0 0 1).

    tolerance: maximum magnitude of the dot product of two different rows of the rotation matrix.
    """
    if matrix.shape != (4, 4):
        return False
    # Comparisons with NaN are false.  For such a small matrix, numpy takes ten times as long.
    (ax, ay, az, x), (bx, by, bz, y), (cx, cy, cz, z), (p, q, r, one) = matrix.tolist()
    unit = tolerance + 1e-5
    return (
        isfinite(x)
        and isfinite(y)
        and isfinite(z)
        and abs(ax * ax + ay * ay + az * az - 1.0) <= unit
        and abs(bx * bx + by * by + bz * bz - 1.0) <= unit
        and abs(cx * cx + cy * cy + cz * cz - 1.0) <= unit
        and abs(ax * bx + ay * by + az * bz) <= tolerance
        and abs(ax * cx + ay * cy + az * cz) <= tolerance
        and abs(bx * cx + by * cy + bz * cz) <= tolerance
        and (ay * bz - az * by) * cx + (az * bx - ax * bz) * cy + (ax * by - ay * bx) * cz > 0.0
        and max(abs(p), abs(q), abs(r)) <= tolerance
        and abs(one - 1.0) <= unit
    )


def moved(world_from_body: Floats, twist_world: Floats, duration_s: float) -> Floats:
    """Return the pose (4, 4) of a body that has moved for `duration_s` with a constant twist.

    twist_world (6,): velocity of the body's origin (m/s), then angular velocity (rad/s).
    """
    rotation = rotation_from_vector(twist_world[3:] * duration_s) @ world_from_body[:3, :3]
    return transform(rotation, world_from_body[:3, 3] + twist_world[:3] * duration_s)


def angle_between(a: Floats, b: Floats) -> float:
    """Return the angle (rad, 0 to pi) between two vectors (3,). Small angles are also accurate."""
    (ax, ay, az), (bx, by, bz) = a.tolist(), b.tolist()
    across = hypot(ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx)
    return atan2(across, ax * bx + ay * by + az * bz)
