"""Make states of arms for tests."""

from __future__ import annotations

from typing import Any

import numpy as np

from flexsheet.messages.types import ArmState
from flexsheet.nodes.arm_bridge.control import ArmControl
from flexsheet.nodes.arm_bridge.geometry import ArmGeometry
from flexsheet.nodes.arm_bridge.other_arm import OtherArm
from flexsheet.nodes.arm_bridge.state_machine import Event
from flexsheet.nodes.arrays import Floats


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


def as_other_arm(
    control: ArmControl, geometry: ArmGeometry, joints_rad: Floats, age_s: float = 0.005
) -> OtherArm:
    """Return the state of an arm as the other arm's bridge receives it."""
    return OtherArm(
        joints_rad,
        geometry.world_from_flange(joints_rad),
        geometry.world_from_flange(control.commanded_rad),
        control.mode,
        control.all_faults,
        age_s,
        control.ready,
        control.estop_reason is not None,
    )


def connect_control(control: ArmControl) -> None:
    """Bring a new control to rest as after its first cycles, armed with `auto_arming`."""
    control.handle(Event.CONNECTED)
    if control.auto_arming:
        control.handle(Event.ARM)
