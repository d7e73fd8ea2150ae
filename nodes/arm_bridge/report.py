"""What a bridge says of its arm."""

from __future__ import annotations

from messages.types import ArmState
from nodes.arm_bridge.control import ArmControl, OtherArm
from nodes.arm_bridge.geometry import ArmGeometry


def arm_state(
    control: ArmControl,
    geometry: ArmGeometry,
    other: OtherArm | None,
    *,
    target_source_ns: int,
    command_age_s: float | None,
    command_sent_ns: int,
    cycle_s: float,
) -> ArmState:
    """The state of an arm that has been measured at least once; the rest as in `ArmState`."""
    measured = control.last_measured_rad
    assert measured is not None
    distance_m, force_n = geometry.sheet_state(
        measured, None if other is None else other.world_from_flange
    )
    return ArmState(
        side="left" if geometry.left else "right",
        mode=control.mode,
        faults=control.all_faults,
        joints_rad=measured,
        joints_commanded_rad=control.commanded_rad,
        world_from_flange=geometry.world_from_flange(measured),
        world_from_flange_commanded=geometry.world_from_flange(control.commanded_rad),
        command_age_s=command_age_s,
        target_source_ns=target_source_ns,
        command_sent_ns=command_sent_ns,
        edge_distance_m=distance_m,
        edge_force_n=force_n,
        cycle_s=cycle_s,
    )
