"""Move one edge of the sheet by sending commands to one arm."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from typing import Any, ClassVar

from flexsheet.messages.base import Header
from flexsheet.messages.notes import NoteCode
from flexsheet.messages.scene import Scene
from flexsheet.messages.types import (
    Arming,
    ArmLatency,
    ArmMode,
    ArmState,
    EStop,
    SheetTarget,
    SheetTrajectory,
    Side,
)
from flexsheet.nodes.arm_bridge.command_scheduler import CommandScheduler
from flexsheet.nodes.arm_bridge.control import ArmControl, Command, Timeouts
from flexsheet.nodes.arm_bridge.geometry import ArmGeometry
from flexsheet.nodes.arm_bridge.goal import Goal, GoalTiming, find_trajectory, make_goal
from flexsheet.nodes.arm_bridge.link import ArmLinkError, ArmSilentError, ArmStatus, Freshness
from flexsheet.nodes.arm_bridge.link_drivers import make_link
from flexsheet.nodes.arm_bridge.other_arm import OtherArm
from flexsheet.nodes.arm_bridge.parameters import ArmBridgeParameters
from flexsheet.nodes.arm_bridge.path_check import PathChecker
from flexsheet.nodes.arm_bridge.report import LastExchange, LatencyMean, make_arm_state
from flexsheet.nodes.arm_bridge.self_checks import ServoCheck
from flexsheet.nodes.models.measured_period import MeasuredPeriod
from flexsheet.nodes.models.servo_lag import LagBounds, ServoLagEstimator
from flexsheet.nodes.node import Input, Node, Output, periodic

MIN_SERVO_LAG_S = 0.002
"""The minimum plausible delay of a servo. A shorter measured delay is a measurement error."""

CHECK_PERIOD_NS = 100_000_000
"""The period of the arm's self-checks. The results are published once per second."""

MODE_CODES: dict[ArmMode, NoteCode] = {
    "starting": NoteCode.ARM_SILENT,
    "disconnected": NoteCode.ARM_SILENT,
    "estop": NoteCode.ARM_ESTOP,
    "fault": NoteCode.ARM_FAULT,
}


class ArmBridge(Node):
    """A node that sends commands to one arm, and publishes the arm's measured state."""

    opens_devices: ClassVar[bool] = True
    watched_inputs: ClassVar[frozenset[str]] = frozenset({"sheet_target", "other_arm"})
    parameters: ArmBridgeParameters
    scene: Input[Scene]
    sheet_target: Input[SheetTarget]
    other_arm: Input[ArmState]
    estop: Input[EStop]
    arming: Input[Arming]
    arm: Output[ArmState]
    arm_latency: Output[ArmLatency]

    @classmethod
    def replay_refusal(cls, parameters: Any) -> str:
        return (
            "it commands an arm, and the bag does not contain the arm's answers as an input; "
            "`bag verify planner` checks the targets that the arm received"
        )

    async def setup(self) -> None:
        given = self.parameters
        self._link = make_link(given.driver, given.host, given.port, given.timeout_s)
        timeouts = Timeouts(given.hold_after_s, given.stop_after_s)
        self._control = ArmControl(
            timeouts,
            max_tracking_error_rad=given.max_tracking_error_rad,
            auto_arming=given.arming == "auto",
        )
        self._lag = ServoLagEstimator(
            given.servo_lag_s,
            LagBounds(
                min(MIN_SERVO_LAG_S, given.servo_lag_s),
                max(given.max_servo_lag_s, given.servo_lag_s),
            ),
        )
        self._servo_check = ServoCheck(given.side, given.servo_lag_s, 1.0 / given.rate_hz)
        self._geometry: ArmGeometry | None = None
        self._last, self._cycle_ns, self._failures = LastExchange(), 0, 0
        self._latency, self._checked_ns = LatencyMean(), 0
        self._cycling = asyncio.Lock()

    async def close(self) -> None:
        """Send a stop command to the arm, and close the connection."""
        async with self._cycling:
            self._geometry, joints_rad = None, self._control.commanded_rad
            try:
                if self._control.last_measured_rad is not None:
                    now_ns = self.clock.now_ns()
                    await self._link.exchange(mode="stop", joints_rad=joints_rad, now_ns=now_ns)
            except ArmLinkError as error:
                self.log.warning("the arm has not received the stop command", problem=str(error))
            self._link.close()

    def on_scene(self, scene: Scene, header: Header) -> None:
        given = self.parameters
        self._control.on_scene_changed()
        other_side: Side = "right" if given.side == "left" else "left"
        self._geometry = ArmGeometry(scene, given.side)
        self._path_checker = PathChecker(self._geometry, ArmGeometry(scene, other_side))
        target_period_s = given.target_period_s or 1.0 / scene.camera.rate_hz
        self._timing = GoalTiming(given.servo_lag_s, target_period_s, given.max_extrapolation_s)
        self._scheduler = CommandScheduler(
            1.0 / given.rate_hz, target_period_s, 1.0 / given.resting_rate_hz
        )
        self._target_period = MeasuredPeriod(target_period_s)

    def _measure_target_period(self, source_ns: int) -> None:
        if self.parameters.target_period_s is not None:
            return
        period_s = self._target_period.add(source_ns)
        if period_s != self._timing.target_period_s:
            self._timing = replace(self._timing, target_period_s=period_s)
            self._scheduler = replace(self._scheduler, target_period_s=period_s)

    def on_estop(self, estop: EStop, header: Header) -> None:
        stamp_ns, now_ns = header.source_ns, self.clock.now_ns()
        clock_problem = self.estop.clock_problem
        if refusal := self._control.on_estop(estop, stamp_ns, now_ns, clock_problem):
            self.log.warning("the reset of the e-stop is refused", reason=refusal)

    def on_arming(self, arming: Arming, header: Header) -> None:
        if refusal := self._control.on_arming(arming, self.arming.age_s()):
            self.log.warning("the enabling of the arm is refused", reason=refusal)

    async def on_sheet_target(self, target: SheetTarget, header: Header) -> None:
        """Send a command as soon as a target arrives, without waiting for the next period."""
        if self._geometry is not None:
            self._measure_target_period(header.source_ns)
        if self._control.is_idle:
            return
        async with self._cycling:
            if self._geometry is not None and self._last.target is not header:
                await asyncio.sleep(self._scheduler.wait_s(self.clock.now_ns(), self._cycle_ns))
                await self._run_cycle(self._geometry)

    @periodic("rate_hz")
    async def cycle(self) -> None:
        """Send periodic commands to the arm while no targets arrive."""
        if self._geometry is None:
            self.set_note(NoteCode.WAITING_FOR_SCENE)
            return
        now_ns, target_ns = self.clock.now_ns(), self.sheet_target.received_ns
        if self._control.is_idle:
            due = self._scheduler.is_due_when_idle(now_ns, self._cycle_ns)
        else:
            due = self._scheduler.is_due(now_ns, self._cycle_ns, target_ns)
        if due and not self._cycling.locked():
            async with self._cycling:
                await self._run_cycle(self._geometry)

    async def _run_cycle(self, geometry: ArmGeometry) -> None:
        now_ns = self.clock.now_ns()
        step_s, self._cycle_ns = self._scheduler.step_s(now_ns, self._cycle_ns), now_ns
        other = self._read_other()
        if self._link.due(now_ns):
            await self._exchange(geometry, other, step_s)
        control = self._control
        failures = f"{self._failures} (two in a row stop the arm)" if self._failures else ""
        self.set_notes(
            {
                self._find_note_code(): f"{control.mode} {control.reason}".rstrip(),
                NoteCode.COMMANDS_UNANSWERED: failures,
            }
        )
        if control.last_measured_rad is not None:
            now_ns, last = self.clock.now_ns(), self._last
            state = make_arm_state(control, geometry, other, last, lag=self._lag, now_ns=now_ns)
            self.arm.publish(state, source_ns=last.measured_ns)

    def _find_note_code(self) -> NoteCode:
        control = self._control
        if control.path_blocked:
            return NoteCode.ARM_BLOCKED
        if control.mode in MODE_CODES:
            return MODE_CODES[control.mode]
        if not (control.ready or control.auto_arming):
            return NoteCode.ARM_NOT_READY
        return NoteCode.ARM_WAITS if control.reason else NoteCode.INFO

    async def _exchange(self, geometry: ArmGeometry, other: OtherArm | None, step_s: float) -> None:
        control, last = self._control, self._last
        clock_problem = self.sheet_target.clock_problem or self.other_arm.clock_problem
        target = self.sheet_target.message
        trajectory = None
        if target is not None and not self.sheet_target.has_ended:
            trajectory = find_trajectory(target)
        goal = self._read_goal(trajectory if other is not None and other.agrees else None)
        command = control.step(geometry, goal, other, step_s, clock_problem)
        if result := self._path_checker.poll(control.pending_check):
            control.on_path_result(*result)
        # Store the target now, because a newer target may arrive during the exchange.
        last.target, last.received_ns = self.sheet_target.header, self.sheet_target.received_ns
        last.trajectory_ends_ns = 0
        if target is not None and trajectory is not None:
            duration_s = trajectory.keep_s + trajectory.brake_s - self._lag.lag_s
            last.trajectory_ends_ns = max(1, target.valid_at_ns + round(1e9 * duration_s))
        mode, joints_rad, now_ns = command.mode, command.joints_rad, self.clock.now_ns()
        last.sent_ns = now_ns
        try:
            status = await self._link.exchange(mode=mode, joints_rad=joints_rad, now_ns=now_ns)
        except ArmLinkError as error:
            if control.last_measured_rad is not None:  # The arm has started.
                self._failures += 1
            if control.on_exchange_failed(str(error), silent=isinstance(error, ArmSilentError)):
                self.log.warning("the connection to the arm is lost", problem=str(error))
            return
        last.on_answer(self.clock.now_ns())
        control.on_measurement(status.joints_rad, status.faults, status.freshness)
        if self.parameters.measure_servo_lag:
            self._measure_lag(command, status)

    def _measure_lag(self, command: Command, status: ArmStatus) -> None:
        if command.mode != "move":
            self._lag.restart()
            return
        last = self._last
        self._lag.on_command(last.sent_ns * 1e-9, command.joints_rad)
        if status.freshness is Freshness.FRESH:
            # The arm reads its joints between the command and the arrival of its answer.
            self._lag.on_measurement(0.5e-9 * (last.sent_ns + last.measured_ns), status.joints_rad)
            if last.measured_ns - self._checked_ns >= CHECK_PERIOD_NS:
                self._checked_ns = last.measured_ns
                self.self_checks = self._servo_check.update(self._lag.estimate, last.measured_ns)
        if self._control.mode == "follow" and (latency_s := self._latency.add(last, self._lag)):
            self.arm_latency.publish(ArmLatency(side=self.parameters.side, latency_s=latency_s))

    def _read_goal(self, trajectory: SheetTrajectory | None) -> Goal | None:
        """Return the desired sheet motion at the time when the next command takes effect.

        The result is None if no target has arrived.

        trajectory: trajectory of the last target. None if the other arm does not follow this
            trajectory.
        """
        target = self.sheet_target.message
        if target is None:
            return None
        return make_goal(
            target,
            received_ns=self.sheet_target.received_ns,
            now_ns=self.clock.now_ns(),
            timing=replace(self._timing, servo_lag_s=self._lag.lag_s),
            trajectory=trajectory,
            planner_ended=self.sheet_target.has_ended,
        )

    def _read_other(self) -> OtherArm | None:
        state = self.other_arm.message
        if state is None:
            return None
        header = self.sheet_target.header
        return OtherArm.from_state(
            state,
            self.other_arm.age_s(),
            target_source_ns=0 if header is None else header.source_ns,
            now_ns=self.clock.now_ns(),
            ended=self.other_arm.has_ended,
        )
