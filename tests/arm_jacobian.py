"""Compute the arm's Jacobian by central differences, independently of its analytic rates."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tests.rv_1a import (
    forward,
)

STEP_RAD = 1e-5


def jacobian(joints_rad: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (6, 6): joint speeds to the flange's velocity and angular velocity in the base."""
    columns = []
    for joint in range(6):
        change = STEP_RAD * np.eye(6)[joint]
        before, after = forward(joints_rad - change), forward(joints_rad + change)
        shift = after[:3, 3] - before[:3, 3]
        rotation = Rotation.from_matrix(after[:3, :3] @ before[:3, :3].T).as_rotvec()
        columns.append(np.concatenate([shift, rotation]) / (2.0 * STEP_RAD))
    return np.array(columns).T
