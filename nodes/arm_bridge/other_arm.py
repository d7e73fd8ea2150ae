"""Represent and check the state of the arm at the other edge of the sheet."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from flexsheet.messages.types import ArmMode, ArmState
from flexsheet.nodes.arm_bridge.goal import MAX_PREDICTION_S, MAX_TRAJECTORY_S
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.models.rigid import is_rigid

MAX_FUTURE_S = 0.02
"""The maximum time by which a timestamp may be in the future because of clock errors."""

MAX_TARGET_DIFFERENCE_NS = round(1e9 * MAX_TRAJECTORY_S)
"""The maximum time between the camera exposures of two targets with overlapping trajectories."""

MAX_TRAJECTORY_END_NS = round(1e9 * (MAX_PREDICTION_S + MAX_TRAJECTORY_S))
"""The maximum time from the camera exposure of a target to the end of its trajectory."""


@dataclass(frozen=True)
class OtherArm:
    """The state of the other arm: joint angles (6,) rad, world poses (4, 4), mode, faults and age.

    ready: whether the other arm is permitted to move.
    estop_engaged: whether the other arm's bridge has latched an e-stop.
    agrees: whether the trajectories of both arms belong to the same target or to adjacent targets.
        If so, the age is counted from the end of the other arm's trajectory.
    ended: whether the other arm's bridge has ended.
    """

    joints_rad: Floats
    world_from_flange: Floats
    world_from_flange_commanded: Floats
    mode: ArmMode
    faults: tuple[str, ...]
    age_s: float
    ready: bool
    estop_engaged: bool
    agrees: bool = False
    ended: bool = False

    @classmethod
    def from_state(
        cls,
        state: ArmState,
        age_s: float,
        *,
        target_source_ns: int = 0,
        now_ns: int = 0,
        ended: bool = False,
    ) -> OtherArm:
        """Create the state of the other arm from a message of its bridge.

        age_s: age of the message.
        target_source_ns: camera exposure from which this arm's current target was computed.
        now_ns: present time.
        ended: whether the other arm's bridge has ended.
        """
        other_ns = state.target_source_ns
        ends_ns = min(state.trajectory_ends_ns, other_ns + MAX_TRAJECTORY_END_NS)
        is_adjacent = bool(
            state.trajectory_ends_ns
            and not ended
            and abs(other_ns - target_source_ns) <= MAX_TARGET_DIFFERENCE_NS
        )
        if is_adjacent:
            age_s = min(age_s, max((now_ns - ends_ns) * 1e-9, 0.0))
        return cls(
            state.joints_rad,
            state.world_from_flange,
            state.world_from_flange_commanded,
            state.mode,
            state.faults,
            age_s,
            state.ready,
            state.estop_engaged,
            is_adjacent,
            ended,
        )

    @cached_property
    def invalid_reason(self) -> str | None:
        """Return the reason why this state must not be used, or None if the state is valid."""
        if not np.isfinite(self.joints_rad).all():
            return "its joint angles are not finite"
        if not (is_rigid(self.world_from_flange) and is_rigid(self.world_from_flange_commanded)):
            return "its flange is not a rigid pose"
        if self.age_s < -MAX_FUTURE_S:
            return f"its timestamp is {-self.age_s:.3g} s in the future"
        return None

    @property
    def estopped(self) -> bool:
        """Return whether the other arm's e-stop is engaged, which forbids motion of both arms."""
        return self.mode == "estop" or self.estop_engaged

    @property
    def interlock_reason(self) -> str | None:
        """Return why the other arm's state forbids this arm to move, or None if motion is safe."""
        if self.faults:
            return f"other arm: {self.faults[0]}"
        if self.mode in ("disconnected", "fault", "estop"):
            return f"other arm: {self.mode}"
        if self.mode == "starting":
            return "waiting for the other arm"
        return None
