"""Compute the twist between two poses, for tests that compare motions."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from flexsheet.nodes.models.rigid import vector_from_rotation

Floats = NDArray[np.float64]


def twist_between(world_from_before: Floats, world_from_after: Floats, duration_s: float) -> Floats:
    """Return the constant twist that moves one pose to the other in `duration_s` (> 0)."""
    linear = (world_from_after[:3, 3] - world_from_before[:3, 3]) / duration_s
    rotation = world_from_after[:3, :3] @ world_from_before[:3, :3].T
    return np.concatenate([linear, vector_from_rotation(rotation) / duration_s])
