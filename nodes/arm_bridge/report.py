"""Compute the state message and the mean latency of an arm."""

from __future__ import annotations

from dataclasses import dataclass

from flexsheet.messages.base import Header
from flexsheet.messages.types import ArmState
from flexsheet.nodes.arm_bridge.control import ArmControl
from flexsheet.nodes.arm_bridge.geometry import ArmGeometry
from flexsheet.nodes.arm_bridge.other_arm import OtherArm
from flexsheet.nodes.models.servo_lag import ServoLagEstimator

REPORTED_TARGETS = 12
"""The number of targets over which the reported latency is averaged. At 60 targets per second,
there are five reports per second."""


@dataclass(slots=True)
class LastExchange:
    """The times of the newest sheet target, and of the newest exchange with the arm.

    An exchange consists of a command and the arm's answer. All times are in ns on this computer's
    clock.

    target: header of the message with the sheet target.
    received_ns: arrival time of this message.
    trajectory_ends_ns: end of the target's trajectory; 0 if there is no trajectory.
    sent_ns, measured_ns: times of the last command and of the last answer; 0 before the first
        exchange.
    duration_s: duration of the last exchange.
    """

    target: Header | None = None
    received_ns: int = 0
    trajectory_ends_ns: int = 0
    sent_ns: int = 0
    measured_ns: int = 0
    duration_s: float = 0.0

    def on_answer(self, now_ns: int) -> None:
        """Store the arrival time of the arm's answer (ns), and the duration of the exchange."""
        self.measured_ns, self.duration_s = now_ns, (now_ns - self.sent_ns) * 1e-9


class LatencyMean:
    """A running mean of the latency from the camera exposure until the arm has moved."""

    def __init__(self) -> None:
        self._target: Header | None = None
        self._sum_s, self._count = 0.0, 0

    def add(self, exchange: LastExchange, lag: ServoLagEstimator) -> float | None:
        """Add the latency of a new sheet target to the mean latency.

        The latency is the time from the camera exposure to the command, plus the arm's servo lag.
        Nothing is added if the target was added before, or if the servo lag is unknown. Returns the
        mean latency (s) after every REPORTED_TARGETS targets, and None in between.
        """
        target, before = exchange.target, self._target
        self._target = target
        if target is None or target is before or lag.estimate is None:
            return None
        self._sum_s += (exchange.sent_ns - target.source_ns) * 1e-9 + lag.lag_s
        self._count += 1
        if self._count < REPORTED_TARGETS:
            return None
        mean_s, self._sum_s, self._count = self._sum_s / self._count, 0.0, 0
        return mean_s


def make_arm_state(
    control: ArmControl,
    geometry: ArmGeometry,
    other: OtherArm | None,
    exchange: LastExchange,
    *,
    lag: ServoLagEstimator,
    now_ns: int,
) -> ArmState:
    """Make the state message of an arm that has answered at least once.

    now_ns: time of the message.
    """
    measured = control.last_measured_rad
    assert measured is not None
    if other is not None and other.invalid_reason is not None:
        other = None
    distance_m, force_n = geometry.sheet_state(
        measured, None if other is None else other.world_from_flange
    )
    target = exchange.target
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
        command_age_s=None if target is None else (now_ns - exchange.received_ns) * 1e-9,
        target_source_ns=0 if target is None else target.source_ns,
        trajectory_ends_ns=exchange.trajectory_ends_ns if control.ready else 0,
        command_sent_ns=exchange.sent_ns,
        edge_distance_m=distance_m,
        edge_force_n=force_n,
        cycle_s=exchange.duration_s,
        servo_lag_s=lag.lag_s,
        servo_lag_uncertainty_s=None if lag.estimate is None else lag.estimate.uncertainty_s,
    )
