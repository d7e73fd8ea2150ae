"""What a bridge says of its arm."""

from __future__ import annotations

from dataclasses import dataclass

from flexsheet.messages.base import Header
from flexsheet.messages.types import ArmState
from flexsheet.nodes.arm_bridge.control import ArmControl, OtherArm
from flexsheet.nodes.arm_bridge.geometry import ArmGeometry


@dataclass(slots=True)
class Exchanged:
    """The newest exchange with the arm; all ns are this clock's, 0: never.

    target, received_ns: the header of the sheet target behind the command, and when it came.
    sent_ns, measured_ns: when the command went out, and when an answer last came.
    """

    target: Header | None = None
    received_ns: int = 0
    sent_ns: int = 0
    measured_ns: int = 0
    duration_s: float = 0.0

    def answered(self, now_ns: int) -> None:
        self.measured_ns, self.duration_s = now_ns, (now_ns - self.sent_ns) * 1e-9


def arm_state(
    control: ArmControl,
    geometry: ArmGeometry,
    other: OtherArm | None,
    newest: Exchanged,
    now_ns: int,
) -> ArmState:
    """The state of an arm that has been measured at least once."""
    measured = control.last_measured_rad
    assert measured is not None
    if other is not None and other.invalid_reason is not None:
        other = None
    distance_m, force_n = geometry.sheet_state(
        measured, None if other is None else other.world_from_flange
    )
    target = newest.target
    return ArmState(
        side=geometry.side,
        mode=control.mode,
        faults=control.all_faults,
        ready=control.ready,
        estop_engaged=control.estop_reason is not None,
        reason=control.reason,
        path_blocked=control.path_blocked,
        auto_arming=control.auto_arming,
        joints_rad=measured,
        joints_commanded_rad=control.commanded_rad,
        world_from_flange=geometry.world_from_flange(measured),
        world_from_flange_commanded=geometry.world_from_flange(control.commanded_rad),
        command_age_s=None if target is None else (now_ns - newest.received_ns) * 1e-9,
        target_source_ns=0 if target is None else target.source_ns,
        command_sent_ns=newest.sent_ns,
        edge_distance_m=distance_m,
        edge_force_n=force_n,
        cycle_s=newest.duration_s,
    )
