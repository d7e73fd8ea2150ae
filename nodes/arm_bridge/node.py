"""Carries one edge of the sheet: from the sheet's target to one arm's joints, cycle by cycle."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field

from messages.base import Header
from messages.scene import NonNegative, Positive, Scene
from messages.types import ArmState, EStop, SheetTarget, Side
from nodes.arm_bridge.control import ArmControl, OtherArm, Patience
from nodes.arm_bridge.geometry import ArmGeometry
from nodes.arm_bridge.goal import Goal, goal_of
from nodes.arm_bridge.modbus import ArmLink, ArmLinkError, ArmSilentError
from nodes.node import Input, Node, NodeParameters, Output, periodic


class ArmBridgeParameters(NodeParameters):
    side: Side
    host: str = "127.0.0.1"
    port: int = Field(default=5020, ge=1, le=65535)
    rate_hz: Positive = 140.0
    timeout_s: Positive = 0.03
    servo_lag_s: NonNegative = Field(
        default=0.03, description="how far the arm trails a command that moves evenly"
    )
    target_period_s: Positive = Field(
        default=1.0 / 60.0, description="a sheet target this old is not yet late"
    )
    hold_after_s: Positive = 0.02
    stop_after_s: Positive = 0.1
    furthest_extrapolation_s: Positive = 0.06
    largest_lag_rad: Positive = 0.12


class ArmBridge(Node):
    """Sends one arm's joints over Modbus TCP and publishes what the arm answers."""

    opens_devices: ClassVar[bool] = True
    parameters: ArmBridgeParameters
    scene: Input[Scene]
    sheet_target: Input[SheetTarget]
    other_arm: Input[ArmState]
    estop: Input[EStop]
    arm: Output[ArmState]

    async def setup(self) -> None:
        given = self.parameters
        self._link = ArmLink(given.host, given.port, timeout_s=given.timeout_s)
        patience = Patience(given.hold_after_s, given.stop_after_s)
        self._control = ArmControl(patience, largest_lag_rad=given.largest_lag_rad)
        self._geometry: ArmGeometry | None = None
        self._cycle_ns = self._sent_ns = self._measured_ns = 0
        self._used: tuple[Header | None, int] = (None, 0)
        self._exchange_s, self._failures = 0.0, 0

    async def close(self) -> None:
        """Bid the arm stop; if that fails, its own watchdog stops it."""
        if self._control.last_measured_rad is not None:
            joints_rad, now_ns = self._control.commanded_rad, self.clock.now_ns()
            try:
                await self._link.exchange(mode="stop", joints_rad=joints_rad, now_ns=now_ns)
            except ArmLinkError as error:
                self.log.warning("arm not told to stop", problem=str(error))
        self._link.close()

    def on_scene(self, scene: Scene, header: Header) -> None:
        self._control.interrupt()
        self._geometry = ArmGeometry(scene, self.parameters.side)

    def on_estop(self, estop: EStop, header: Header) -> None:
        refusal = self._control.take_estop(estop, (header.clock_id, header.source_ns))
        if refusal is not None:
            self.log.warning("reset refused", reason=refusal)

    @periodic("rate_hz")
    async def cycle(self) -> None:
        now_ns = self.clock.now_ns()
        if self._geometry is None:
            self.note = "waits for a scene"
            return
        period_s = 1.0 / self.parameters.rate_hz
        step_s = min(max((now_ns - self._cycle_ns) * 1e-9, 0.5 * period_s), 2.0 * period_s)
        self._cycle_ns = now_ns
        if self._link.due(now_ns):
            await self._exchange(self._geometry, step_s)
        mode, reason = self._control.mode, self._control.reason
        self.note = f"{mode} {reason}; {self._failures} failed exchanges"
        self._publish(self._geometry)

    async def _exchange(self, geometry: ArmGeometry, step_s: float) -> None:
        control = self._control
        command = control.step(geometry, self._goal(), self._other(), step_s)
        # A target that comes while the arm answers is not behind the command that it answers.
        self._used = (self.sheet_target.header, self.sheet_target.received_ns)
        self._sent_ns = self.clock.now_ns()
        try:
            status = await self._link.exchange(
                mode=command.mode, joints_rad=command.joints_rad, now_ns=self._sent_ns
            )
        except ArmLinkError as error:
            self._failures += 1
            if control.fail_exchange(str(error), silent=isinstance(error, ArmSilentError)):
                self.log.warning("arm lost", problem=str(error))
            return
        self._measured_ns = self.clock.now_ns()
        self._exchange_s = (self._measured_ns - self._sent_ns) * 1e-9
        control.take_measurement(status.joints_rad, status.faults)

    def _goal(self) -> Goal | None:
        """The newest sheet target, carried on to the moment when this cycle's command acts."""
        target, header = self.sheet_target.message, self.sheet_target.header
        if target is None or header is None:
            return None
        given, received_ns = self.parameters, self.sheet_target.received_ns
        # Another host's clock: the target counts as if it had arrived in no time.
        foreign = header.clock_id != self.clock.id
        return goal_of(
            target,
            valid_at_ns=target.valid_at_ns + (received_ns - header.publish_ns if foreign else 0),
            received_ns=received_ns,
            now_ns=self.clock.now_ns(),
            servo_lag_s=given.servo_lag_s,
            period_s=given.target_period_s,
            furthest_s=given.furthest_extrapolation_s,
        )

    def _other(self) -> OtherArm | None:
        state = self.other_arm.message
        age_s = (self.clock.now_ns() - self.other_arm.received_ns) * 1e-9
        return None if state is None else OtherArm.from_state(state, age_s)

    def _publish(self, geometry: ArmGeometry) -> None:
        control, other = self._control, self._other()
        header, received_ns = self._used
        measured = control.last_measured_rad
        if measured is None:
            return
        distance, force = geometry.sheet_state(
            measured, None if other is None else other.world_from_flange
        )
        self.arm.publish(
            ArmState(
                side=self.parameters.side,
                mode=control.mode,
                faults=control.all_faults,
                joints_rad=measured,
                joints_commanded_rad=control.commanded_rad,
                world_from_flange=geometry.world_from_flange(measured),
                world_from_flange_commanded=geometry.world_from_flange(control.commanded_rad),
                command_age_s=(self.clock.now_ns() - received_ns) * 1e-9 if header else None,
                target_source_ns=header.source_ns if header else 0,
                command_sent_ns=self._sent_ns,
                edge_distance_m=distance,
                edge_force_n=force,
                cycle_s=self._exchange_s,
            ),
            source_ns=self._measured_ns,
        )
