"""Define the frame of a finger: origin at the pad, x towards the hand, and z out of the nail."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.models.rigid import rotation_from_vector


def world_from_finger(
    direction_world: Sequence[float], tilt_rad: Sequence[float] | Floats = (0.0, 0.0)
) -> Floats:
    """Return the rotation matrix (3, 3) from a finger's frame to the world frame.

    direction_world: vector (3,) from the fingertip to the hand. If the finger is not tilted, its z
        axis is perpendicular to the world's x axis.
    tilt_rad: rotation (2,) of the finger about the world's x and y axes, as a rotation vector.
    """
    x = np.asarray(direction_world, dtype=np.float64)
    x = x / np.linalg.norm(x)
    z = np.cross(x, [1.0, 0.0, 0.0])
    z /= np.linalg.norm(z)
    level = np.column_stack([x, np.cross(z, x), z])
    return np.asarray(rotation_from_vector((*tilt_rad, 0.0)) @ level)
