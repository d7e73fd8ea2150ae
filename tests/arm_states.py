"""Make states of arms for tests."""

from __future__ import annotations

from typing import Any

import numpy as np

from flexsheet.messages.types import ArmState
from flexsheet.nodes.arm_bridge.control import ArmControl
from flexsheet.nodes.arm_bridge.state_machine import Event


def arm_state(side: str, **changes: Any) -> ArmState:
    """Make an arm's state; `changes` are fields of it."""
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


def connect_control(control: ArmControl) -> None:
    """Bring a new control to rest as after its first cycles, armed with `auto_arming`."""
    control.handle(Event.CONNECTED)
    if control.auto_arming:
        control.handle(Event.ARM)
