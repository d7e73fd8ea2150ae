"""Carries one edge of the sheet: from the sheet's target to one arm's joints, cycle by cycle."""

from __future__ import annotations

import asyncio
from typing import Any, ClassVar

from flexsheet.messages.base import Header
from flexsheet.messages.methods import KinematicsMethod, chosen
from flexsheet.messages.scene import Scene
from flexsheet.messages.types import Arming, ArmState, EStop, SheetTarget, Side
from flexsheet.nodes.arm_bridge.control import ArmControl, OtherArm, Patience
from flexsheet.nodes.arm_bridge.geometry import ArmGeometry
from flexsheet.nodes.arm_bridge.goal import Goal, Timing, goal_of
from flexsheet.nodes.arm_bridge.kinematics import STEPS
from flexsheet.nodes.arm_bridge.link import ArmLinkError, ArmSilentError
from flexsheet.nodes.arm_bridge.link_drivers import link_for
from flexsheet.nodes.arm_bridge.pacing import Pace
from flexsheet.nodes.arm_bridge.parameters import ArmBridgeParameters
from flexsheet.nodes.arm_bridge.report import Exchanged, arm_state
from flexsheet.nodes.arm_bridge.way import Lookout
from flexsheet.nodes.node import Input, Node, Output, periodic


class ArmBridge(Node):
    """Sends one arm's joints over its network and publishes what the arm answers."""

    opens_devices: ClassVar[bool] = True
    parameters: ArmBridgeParameters
    scene: Input[Scene]
    sheet_target: Input[SheetTarget]
    other_arm: Input[ArmState]
    estop: Input[EStop]
    arming: Input[Arming]
    arm: Output[ArmState]

    @classmethod
    def replay_refusal(cls, parameters: Any) -> str:
        return (
            "it commands an arm, whose answers are in the bag only as this node's output; "
            "`bag verify planner` shows the targets that it got"
        )

    async def setup(self) -> None:
        given = self.parameters
        self._link = link_for(given.driver, given.host, given.port, given.timeout_s)
        patience = Patience(given.hold_after_s, given.stop_after_s)
        self._control = ArmControl(
            patience,
            largest_lag_rad=given.largest_lag_rad,
            by_itself=given.arming == "by_itself",
        )
        self._geometry: ArmGeometry | None = None
        self._newest, self._cycle_ns, self._failures = Exchanged(), 0, 0
        self._cycling = asyncio.Lock()

    async def close(self) -> None:
        """Bid the arm stop; if that fails, its own watchdog stops it."""
        async with self._cycling:
            self._geometry, joints_rad = None, self._control.commanded_rad
            try:
                if self._control.last_measured_rad is not None:
                    now_ns = self.clock.now_ns()
                    await self._link.exchange(mode="stop", joints_rad=joints_rad, now_ns=now_ns)
            except ArmLinkError as error:
                self.log.warning("arm not told to stop", problem=str(error))
            self._link.close()

    def on_scene(self, scene: Scene, header: Header) -> None:
        given = self.parameters
        self._control.interrupt()
        other_side: Side = "right" if given.side == "left" else "left"
        method: KinematicsMethod = chosen(
            given.kinematics, scene.methods.kinematics, "closed_form_continuous"
        )
        self._geometry = ArmGeometry(scene, given.side, joints_for=STEPS[method])
        self._method = method
        self._lookout = Lookout(self._geometry, ArmGeometry(scene, other_side))
        due_s = given.target_period_s or 1.0 / scene.camera.rate_hz
        self._timing = Timing(given.servo_lag_s, due_s, given.furthest_extrapolation_s)
        self._pace = Pace(1.0 / given.rate_hz, due_s, 1.0 / given.resting_rate_hz)

    def on_estop(self, estop: EStop, header: Header) -> None:
        stamp_ns, now_ns = header.source_ns, self.clock.now_ns()
        doubt = self.estop.clock_trouble
        if refusal := self._control.take_estop(estop, stamp_ns, now_ns, doubt):
            self.log.warning("reset refused", reason=refusal)

    def on_arming(self, arming: Arming, header: Header) -> None:
        if refusal := self._control.take_arming(arming, self.arming.age_s()):
            self.log.warning("not made ready", reason=refusal)

    async def on_sheet_target(self, target: SheetTarget, header: Header) -> None:
        """A target is passed on when it comes: at the next beat it would be 7 ms older."""
        if self._control.resting:
            return
        async with self._cycling:
            if self._geometry is not None and self._newest.target is not header:
                await asyncio.sleep(self._pace.wait_s(self.clock.now_ns(), self._cycle_ns))
                await self._serve(self._geometry)

    @periodic("rate_hz")
    async def cycle(self) -> None:
        """Between targets, and without any, the arm hears from us at this rate."""
        if self._geometry is None:
            self.note = "waits for a scene"
            return
        now_ns, target_ns = self.clock.now_ns(), self.sheet_target.received_ns
        if self._control.resting:
            due = self._pace.is_resting_beat(now_ns, self._cycle_ns)
        else:
            due = self._pace.is_beat(now_ns, self._cycle_ns, target_ns)
        if due and not self._cycling.locked():
            async with self._cycling:
                await self._serve(self._geometry)

    async def _serve(self, geometry: ArmGeometry) -> None:
        now_ns = self.clock.now_ns()
        step_s, self._cycle_ns = self._pace.step_s(now_ns, self._cycle_ns), now_ns
        if self._link.due(now_ns):
            await self._exchange(geometry, step_s)
        what, why = self._control.mode, self._control.reason
        self.note = f"{what} {why}; {self._failures} failed exchanges; joints by {self._method}"
        if self._control.last_measured_rad is not None:
            now_ns, newest = self.clock.now_ns(), self._newest
            state = arm_state(self._control, geometry, self._other(), newest, now_ns)
            self.arm.publish(state, source_ns=newest.measured_ns)

    async def _exchange(self, geometry: ArmGeometry, step_s: float) -> None:
        control, newest = self._control, self._newest
        doubt = self.sheet_target.clock_trouble or self.other_arm.clock_trouble
        command = control.step(geometry, self._goal(), self._other(), step_s, doubt)
        if answer := self._lookout.answer(control.question):
            control.take_way(*answer)
        # A target that comes while the arm answers is not behind the command that it answers.
        newest.target, newest.received_ns = self.sheet_target.header, self.sheet_target.received_ns
        mode, joints_rad, now_ns = command.mode, command.joints_rad, self.clock.now_ns()
        newest.sent_ns = now_ns
        try:
            status = await self._link.exchange(mode=mode, joints_rad=joints_rad, now_ns=now_ns)
        except ArmLinkError as error:
            self._failures += 1
            if control.fail_exchange(str(error), silent=isinstance(error, ArmSilentError)):
                self.log.warning("arm lost", problem=str(error))
            return
        newest.answered(self.clock.now_ns())
        control.take_measurement(status.joints_rad, status.faults, status.freshness)

    def _goal(self) -> Goal | None:
        """The newest sheet target, carried on to the moment when this cycle's command acts."""
        target = self.sheet_target.message
        if target is None:
            return None
        return goal_of(
            target,
            received_ns=self.sheet_target.received_ns,
            now_ns=self.clock.now_ns(),
            timing=self._timing,
        )

    def _other(self) -> OtherArm | None:
        state = self.other_arm.message
        return None if state is None else OtherArm.from_state(state, self.other_arm.age_s())
