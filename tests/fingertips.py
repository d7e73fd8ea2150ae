"""Make fingertip messages for tests: a finger at constant velocity."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from flexsheet.messages.types import Fingertip, FingertipReason

Floats = NDArray[np.float64]
STEP_S = 0.01


def fingertip(
    position: Floats, velocity: Floats | None = None, *, reason: FingertipReason = "ok"
) -> Fingertip:
    moving = np.zeros(3) if velocity is None else velocity
    return Fingertip(
        valid=reason == "ok",
        state="tracking" if reason == "ok" else "coasting",
        reason=reason,
        position_world_m=position,
        velocity_world_m_per_s=moving,
        covariance=np.eye(6) * 1e-8,
        predicted_path_world_m=position + np.arange(13)[:, None] * STEP_S * moving,
        prediction_step_s=STEP_S,
        measured_world_m=position,
        reprojection_px=0.1,
    )
