"""States of arms for tests: an arm that follows, at rest, without a fault."""

from __future__ import annotations

from typing import Any

import numpy as np

from flexsheet.messages.types import ArmState


def arm_state(side: str, **changes: Any) -> ArmState:
    """An arm's state; `changes` are fields of it."""
    values: dict[str, Any] = {
        "side": side,
        "mode": "follow",
        "faults": (),
        "joints_rad": np.zeros(6),
        "joints_commanded_rad": np.zeros(6),
        "world_from_flange": np.eye(4),
        "world_from_flange_commanded": np.eye(4),
        "command_age_s": None,
        "target_source_ns": 0,
        "command_sent_ns": 0,
        "edge_distance_m": None,
        "edge_force_n": None,
        "cycle_s": 0.001,
    }
    return ArmState(**values | changes)
