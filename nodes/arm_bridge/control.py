"""Compute the command of one arm in each control cycle.

Two arms hold an elastic sheet between them. Each arm has its own node, the bridge. The command
moves the arm towards the target, stops the arm or slackens the sheet. This module uses no sockets
and no clock. The module `state_machine` defines the states. Both bridges apply the same speed
bounds to the sheet, so the arms stay synchronized on long paths.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from flexsheet.messages.clock_table import MAX_STAMP_AHEAD_NS
from flexsheet.messages.types import Arming, ArmMode, EStop
from flexsheet.nodes.arm_bridge.geometry import ArmGeometry
from flexsheet.nodes.arm_bridge.goal import (
    FOLLOW_BOUNDS,
    Goal,
    compute_sync_factor,
    scale_speeds,
)
from flexsheet.nodes.arm_bridge.joint_chain import UnreachableError
from flexsheet.nodes.arm_bridge.limiter import (
    SheetLimits,
    bound_step,
    check_flange,
    check_tracking_error,
    limit_velocity,
)
from flexsheet.nodes.arm_bridge.link import FAULT_TEXTS, ArmFault, Freshness
from flexsheet.nodes.arm_bridge.other_arm import OtherArm
from flexsheet.nodes.arm_bridge.path_check import (
    START_BOUNDS,
    Alignment,
    PathCheckRequest,
    measure_distance,
)
from flexsheet.nodes.arm_bridge.standstill import (
    MAX_RESTART_SHIFT_M,
    StandstillMonitor,
)
from flexsheet.nodes.arm_bridge.state_machine import (
    CHECKING_STATES,
    MODES,
    MOTION_STATES,
    PAUSING_STATES,
    READY_STATES,
    RELAXING,
    TRACKING,
    TRANSITIONS,
    Event,
    State,
)
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.models.motion import (
    SheetMotion,
    coast_sheet,
    follow_sheet,
)
from flexsheet.nodes.models.rigid import is_rigid

PLANNER_ENDED = "the connection to the planner has ended"
OTHER_BRIDGE_ENDED = "the connection to the other arm's bridge has ended"

MAX_REST_RAD_PER_S = 1e-6
"""The maximum joint speed at which an arm is considered to be at rest."""

# At this stretch rate the sheet becomes slack in about a second.
RELAX_BOUNDS = replace(START_BOUNDS, stretch_rate_per_s=0.05)

SETTLED_M, SETTLED_RAD, SETTLED_STRETCH = 0.001, 0.01, 0.003
"""The deviations from the target in position (m), rotation (rad) and stretch ratio below which the
slow start ends. The sheet then moves within FOLLOW_BOUNDS, which permit higher speeds than
START_BOUNDS."""

MEASURED_SLACK_M = 0.002
"""The tolerance (m) of the position limits for measured flange positions. Without the tolerance,
small vibrations of the servos would violate the limits."""

SLACK_STRETCH = 1.0005
"""The maximum stretch ratio (length / rest length) at which the sheet is considered slack. At this
ratio, the tension is 0.1 N."""

NO_MOTION = np.zeros(6)
NO_GOAL = np.full(6, np.nan)

IMPLAUSIBLE_LENGTH_RATIO = 1.1
"""The ratio of the measured to the maximum sheet length above which the measurement is considered
wrong."""

MAX_JOINT_JUMP_RAD = 0.35
"""The maximum change (rad) of a joint's goal angle in one cycle. A larger change indicates that the
inverse kinematics have switched to another solution."""

RELAX_DELAY_S = 0.5
"""The time (s) after which the arms slacken the sheet if they have no target or are not armed."""

STALE_REASONS = {
    Freshness.STALLED: "the counters of its status stand still, so its joint angles are not used",
    Freshness.REVERSED: "the counters of its status run backwards, so its joint angles are not "
    "used",
}

MAX_WAIT_FOR_OTHER_S = 1.0
"""The time (s) after which an armed arm is disarmed if the other arm is not armed."""

MAX_ARMING_AGE_S = 1.0
"""The maximum age of an arming command. An older command is refused, because the operator may no
longer intend it."""

ALIGNED_RAD = 1e-4
"""The maximum joint motion (rad) that may remain at the end of an alignment (see `path_check`)."""

MAX_BEYOND_RANGE_RAD = 0.02
"""The tolerance (rad) of the joint ranges for measured joint angles. Angles beyond the tolerance
are treated as measurement errors."""

RECHECK_PERIOD_S = 0.5
"""The time (s) after which a blocked path is checked again. The target may have moved in the
meantime."""


@dataclass(frozen=True, slots=True)
class Timeouts:
    """The maximum delays of messages from the planner and from the other arm.

    hold_after_s: delay, s, after which the arm decelerates.
    stop_after_s: delay, s, after which the arm is disarmed.
    """

    hold_after_s: float
    stop_after_s: float


@dataclass(frozen=True, slots=True)
class Command:
    """A command for the arm's controller.

    mode: `move`, `hold`, `stop` or `idle`.
    joints_rad: joint angles (6,) for the mode `move`.
    """

    mode: str
    joints_rad: Floats


class ArmControl:
    """A controller that computes the commands to one arm.

    faults: texts of the latched faults; only `reset` clears the faults.
    reason: text that tells the operator why the arm does not follow the target.
    auto_arming: whether the arm is armed as soon as no interlock forbids motion. Otherwise the
        operator must arm the arm after the start and after each interlock.
    pending_check: path that must be checked; the method `on_path_result` receives the result.
    """

    def __init__(
        self, timeouts: Timeouts, *, max_tracking_error_rad: float, auto_arming: bool = False
    ) -> None:
        self.auto_arming = auto_arming
        self.faults: tuple[str, ...] = ()
        self.reason = "waiting for the arm to answer"
        self.estop_reason: str | None = None
        self.measured_rad: Floats | None = None
        self.last_measured_rad: Floats | None = None
        self.commanded_rad = np.zeros(6)
        self.pending_check: PathCheckRequest | None = None
        self._state = State.STARTING
        self._timeouts = timeouts
        self._max_tracking_error_rad = max_tracking_error_rad
        self._interlock_reason: str | None = self.reason
        self._disarm_reason: str | None = None
        self._last_interlock = ""
        self._waited_s = 0.0
        self._silence = ""
        self._clear_path: tuple[PathCheckRequest, Alignment | None] | None = None
        self._alignment: Alignment | None = None
        self._aligned_s = 0.0
        self._geometry: ArmGeometry
        self._relaxed_limits: SheetLimits
        self._step_s: float
        self._blocked: tuple[str, float] | None = None
        self._together = False
        self._velocity = np.zeros(6)
        self._standstill = StandstillMonitor()
        self._has_commanded = False
        self._sheet: SheetMotion | None = None
        self._settled = False
        self._must_idle = False
        self._engaged_ns = 0
        self._missed = False
        self._goal_rad: Floats | None = None
        self._relax_from: float | None = None

    @property
    def state(self) -> State:
        """Return the present state of the state machine."""
        return self._state

    @property
    def mode(self) -> ArmMode:
        """Return the arm's mode for ArmState messages.

        An arm in the state TAUT has the mode "fault" if it has faults. Otherwise, `MODES` contains
        the mode for each state of the state machine.
        """
        return "fault" if self._state is State.TAUT and self.faults else MODES[self._state]

    @property
    def ready(self) -> bool:
        """Return whether the arm is permitted to move."""
        return self._state in READY_STATES

    @property
    def all_faults(self) -> tuple[str, ...]:
        """Return the published texts about the arm's faults, its e-stop and a lost connection."""
        estop = () if self.estop_reason is None else (f"e-stop: {self.estop_reason}",)
        lost = (self.reason,) if self._state is State.DISCONNECTED else ()
        return (*self.faults, *estop, *lost)

    @property
    def path_blocked(self) -> bool:
        """Return whether the arm rests because no permitted path to the target was found."""
        return self._blocked is not None and self._state in CHECKING_STATES

    @property
    def at_rest(self) -> bool:
        """Return whether the commanded joint angles are constant."""
        return float(np.abs(self._velocity).max()) <= MAX_REST_RAD_PER_S

    @property
    def is_idle(self) -> bool:
        """Return whether the arm rests and waits for an operator's command."""
        return self._state is State.IDLE and self.at_rest

    def handle(self, event: Event) -> None:
        """Change the state as `TRANSITIONS` specifies for an event in the present state."""
        target = TRANSITIONS[self._state, event]
        if target is None:
            return
        preserves_path = target in TRACKING | RELAXING
        if self._state in TRACKING | RELAXING and not preserves_path:
            self._drop_path()
        self._state = target

    def on_answer_missed(self, text: str) -> bool:
        """Record a missing answer to a command; return whether the motion may continue.

        text: reason that is shown to the operator.

        After the first missing answer, the motion continues from the unanswered command. If the
        next answer is missing too, the result is False.
        """
        if self._missed or self.measured_rad is None:
            return False
        self._missed = True
        self._standstill.forget()
        before = self._state
        self.handle(Event.ANSWER_MISSED)
        if self._state is not before:
            self.reason = text
        return True

    def on_exchange_failed(self, text: str, *, silent: bool) -> bool:
        """Record a failed exchange; return True if the connection to the arm has just been lost.

        text: reason that is shown to the operator.
        silent: True if the arm has not answered.
        """
        if silent and self.last_measured_rad is None:
            # The arm has never answered, so it may still be starting, which is no fault.
            self.reason = f"waiting for the arm: {text}"
            return False
        if silent and self.on_answer_missed(text):
            return False
        newly = self._state is not State.DISCONNECTED
        self.on_connection_lost(text)
        return newly

    def on_connection_lost(self, text: str) -> None:
        """Disarm the arm and discard its motion; a latched fault or e-stop remains."""
        self.measured_rad = None
        self._standstill.forget()
        self._inhibit(text, Event.CONNECTION_LOST)
        self.reason = text
        self._discard_motion()

    def on_measurement(
        self,
        joints_rad: Floats,
        arm_faults: tuple[ArmFault, ...],
        freshness: Freshness = Freshness.FRESH,
    ) -> None:
        """Store the measured joint angles (6,) rad and the faults that the controller reports.

        Stale joint angles are ignored.
        """
        self._missed = False
        self._standstill.on_measurement(joints_rad, freshness)
        if self.last_measured_rad is None or freshness in (Freshness.FIRST, Freshness.FRESH):
            self.last_measured_rad = joints_rad
        if not freshness.is_usable and not self.faults:
            self.faults = (f"arm: {STALE_REASONS[freshness]}",)
        self.measured_rad = self.last_measured_rad
        if not self._has_commanded and not self._standstill.has_jumped:
            self.commanded_rad = self.measured_rad
        if arm_faults == (ArmFault.WATCHDOG,):
            # A command was late, so the arm has stopped: restart from its position.
            self._restart_idle()
            self.reason = "the arm's watchdog stopped it"
            self._inhibit(self.reason, Event.WATCHDOG_TRIPPED)
        elif arm_faults and not self.faults:
            self.faults = tuple(f"arm: {FAULT_TEXTS[fault]}" for fault in arm_faults)

    def _restart_idle(self) -> None:
        self._discard_motion()
        self._standstill.restart()
        self._must_idle = True

    def on_scene_changed(self) -> None:
        """Stop the arm after a change of the scene, and discard all path checks."""
        self.pending_check = self._clear_path = self._blocked = None
        self.handle(Event.SCENE_CHANGED)

    def engage_estop(self, reason: str) -> None:
        """Latch an e-stop; the next `step` stops the arm."""
        self.estop_reason = reason

    def on_estop(
        self, estop: EStop, stamp_ns: int, now_ns: int, clock_problem: str = ""
    ) -> str | None:
        """Engage or reset the e-stop; return the reason if a reset is refused, otherwise None.

        stamp_ns: timestamp of the message.
        clock_problem: reason why the timestamp is uncertain; empty if the timestamp is certain.

        Messages of several nodes may arrive in any order. A reset is therefore refused if its
        timestamp is before the last stop or in the future.
        """
        if estop.engaged:
            # With a timestamp in the future, the stop would block every reset until that time.
            engaged_ns = now_ns if clock_problem else min(stamp_ns, now_ns)
            self._engaged_ns = max(self._engaged_ns, engaged_ns)
            self.engage_estop(estop.reason)
        elif clock_problem:
            return clock_problem
        elif stamp_ns > now_ns + MAX_STAMP_AHEAD_NS:
            return "it is stamped in the future"
        elif stamp_ns < self._engaged_ns:
            return "it is older than the stop"
        elif not self.reset():
            return "the arm still moves"
        return None

    def reset(self) -> bool:
        """Clear the e-stop and all faults if the arm is at rest; return whether it was at rest."""
        if not self.at_rest:
            return False
        self.estop_reason, self.faults = None, ()
        if self.measured_rad is not None:
            self._restart_idle()
        self.handle(Event.RESET)
        self.reason = "restarts after a reset"
        return True

    def on_arming(self, arming: Arming, age_s: float) -> str | None:
        """Execute an operator's arming command; return the reason if it is refused, otherwise None.

        age_s: age of the command.
        """
        if not arming.ready:
            self._disarm_reason = f"disabled: {arming.reason}" if arming.reason else "disabled"
            return None
        if not age_s <= MAX_ARMING_AGE_S:
            return f"the arming command is {age_s:.1f} s old"
        if self._interlock_reason is not None:
            return self._interlock_reason
        if not self.at_rest:
            return "the arm still moves"
        self._disarm_reason = None
        self._arm()
        return None

    def _arm(self) -> None:
        self._waited_s = 0.0
        self.handle(Event.ARM)

    def _inhibit(self, reason: str, event: Event = Event.INTERLOCK) -> None:
        self._interlock_reason = reason
        self._disarm(reason, event)

    def _disarm(self, reason: str, event: Event) -> None:
        was_ready = self.ready
        self.handle(event)
        if was_ready and not self.ready:
            self._last_interlock, self._waited_s = reason, 0.0

    def _check_interlocks(
        self, goal: Goal | None, other: OtherArm | None, clock_problem: str
    ) -> None:
        """Disarm the arm if an interlock forbids motion.

        Otherwise, arm the arm if `auto_arming` is true.
        """
        silent = other is None or not other.age_s <= self._timeouts.stop_after_s
        stopped = self.estop_reason is not None or (other is not None and other.estopped)
        reason = self._find_interlock(goal, None if silent else other)
        if reason is not None:
            self._inhibit(reason)
        elif self._disarm_reason is not None:
            self._interlock_reason = None
            self._disarm(self._disarm_reason, Event.INTERLOCK)
        else:
            self._interlock_reason = None
            if self.auto_arming:
                self._arm()
        if clock_problem:
            self._inhibit(clock_problem)
        if silent or stopped or clock_problem:
            # From now on the arm must not slacken the sheet (see the state TAUT).
            self.handle(Event.ISOLATED)
        self._settle()

    def _find_interlock(self, goal: Goal | None, other: OtherArm | None) -> str | None:
        """Return the interlock (reason) that forbids motion, or None if motion is permitted.

        other: state of the other arm; None if the other arm's messages are late.
        """
        if self.estop_reason is not None:
            return f"e-stop: {self.estop_reason}"
        if self.faults:
            return self.faults[0]
        if other is None:
            return self._silence
        if other.interlock_reason is not None:
            return other.interlock_reason
        if self._disarm_reason is None and (
            goal is None or not goal.overdue_s <= self._timeouts.stop_after_s
        ):
            if goal is None:
                return "waiting for a sheet target"
            return PLANNER_ENDED if goal.planner_ended else "no sheet target"
        return None

    def _settle(self) -> None:
        """Report a latched e-stop or fault, and then the arm's standstill, to the state machine."""
        for _ in range(2):
            if self.estop_reason is not None:
                self.handle(Event.ESTOP)
            elif self.faults:
                self._disarm(self.faults[0], Event.FAULT)
            if self.at_rest:
                self.handle(Event.AT_REST)

    def step(
        self,
        geometry: ArmGeometry,
        goal: Goal | None,
        other: OtherArm | None,
        step_s: float,
        clock_problem: str = "",
    ) -> Command:
        """Compute the command for the next `step_s` seconds.

        goal: target of the sheet; None before the first target.
        other: state of the other arm; None before its first message.
        clock_problem: reason why the ages of messages are unknown; empty if the ages are known.
        """
        self._geometry, self._step_s = geometry, step_s
        measured = self.measured_rad
        if measured is None or self._must_idle:
            self._must_idle = self._must_idle and measured is None
            return self._send("idle", self.commanded_rad)
        self.handle(Event.CONNECTED)
        if other is None:
            self._silence = "waiting for the other arm"
        else:
            self._silence = OTHER_BRIDGE_ENDED if other.ended else "the other arm is silent"
        if other is not None and (invalid := other.invalid_reason) is not None:
            self._silence, other = f"state of the other arm: {invalid}", None
        self._check_measurement(other, measured)
        self._check_interlocks(goal, other, clock_problem)
        if (stop := self._find_stop(other, clock_problem)) is not None:
            return self._decelerate(stop)
        if self.faults:
            return self._slacken(self.faults[0], other)
        if other is None or not other.age_s <= self._timeouts.stop_after_s:
            return self._decelerate(self._silence)
        if other.interlock_reason is not None:
            return self._slacken(other.interlock_reason, other)
        if goal is None or not self.ready or not other.ready:
            return self._wait_for_arming(other)
        return self._move_to_target(goal, other, measured)

    def _find_stop(self, other: OtherArm | None, clock_problem: str) -> str | None:
        """Return why the arm must stop without a motion that slackens the sheet.

        Returns None if there is no reason for such a stop.
        """
        if self.estop_reason is not None:
            return f"e-stop: {self.estop_reason}"
        if other is not None and other.estopped:
            return "other arm: e-stop"
        return clock_problem if clock_problem and not self.faults else None

    def _wait_for_arming(self, other: OtherArm) -> Command:
        """Return the command that stops the arm because this arm or the other arm is not armed.

        If this arm is not armed, the sheet is slackened after RELAX_DELAY_S.
        """
        self._waited_s += self._step_s
        if self.ready:
            return self._wait_for_other()
        reason = self._interlock_reason or self._disarm_reason
        if reason is None:
            since = self._last_interlock
            reason = f"not ready since: {since}" if since else "not ready"
        if self._waited_s > RELAX_DELAY_S:
            return self._slacken(reason, other)
        return self._decelerate(reason)

    def _wait_for_other(self) -> Command:
        """Return the command that stops this arm because the other arm is not armed.

        If arming is manual, this arm is disarmed when it has moved or has waited too long.
        """
        reason = "the other arm is not ready"
        has_started = self._sheet is not None or not self.at_rest
        if not self.auto_arming and (has_started or self._waited_s > MAX_WAIT_FOR_OTHER_S):
            self._inhibit(reason)
        else:
            self.handle(Event.WAIT_FOR_OTHER)
        return self._decelerate(reason)

    def _move_to_target(self, goal: Goal, other: OtherArm, measured: Floats) -> Command:
        self._waited_s = 0.0
        if not _is_valid(goal.motion):
            return self._latch_fault("sheet target is not a rigid pose")
        if self._state in PAUSING_STATES:
            return self._decelerate("decelerates before the next motion")
        self.handle(Event.TARGET)
        if self._sheet is None:
            return self._check_path(goal, other, measured)
        return self._track_target(goal, self._sheet, other)

    def _track_target(self, goal: Goal, sheet: SheetMotion, other: OtherArm) -> Command:
        """Return the command that moves the sheet towards its target.

        The sheet decelerates if the target or the other arm's state is late, or if the planner or
        the other arm's bridge has ended.
        """
        late_s = max(goal.overdue_s, other.age_s - self._timeouts.hold_after_s)
        is_late = goal.planner_ended or other.ended or late_s > self._timeouts.hold_after_s
        self.handle(Event.LATE if is_late else Event.IN_TIME)
        if is_late:
            self.reason = _find_late_reason(goal, other)
        else:
            self._together = self._together or other.mode == "follow"
            self.reason = "" if self._together else "waits for the other arm"
        if self._alignment is not None:
            return self._align(self._alignment, other)
        if is_late:
            sheet = coast_sheet(sheet, bounds=FOLLOW_BOUNDS, step_s=self._step_s)
        else:
            speed_factor = compute_sync_factor(
                self._geometry.world_from_edge(self.commanded_rad),
                other.world_from_flange_commanded @ self._geometry.other_flange_from_edge,
                goal.motion.world_from_sheet,
                left=self._geometry.left,
            )
            speed_factor = speed_factor if self._together else 0.0
            sheet = self._advance_sheet(goal.motion, sheet, speed_factor)
        return self._command_sheet(sheet, other)

    def _check_measurement(self, other: OtherArm | None, measured: Floats) -> None:
        """Latch a fault if the measured joints lag behind the command or violate a limit."""
        if self.faults or self._state not in TRACKING:
            return
        violation = check_tracking_error(self.commanded_rad, measured, self._max_tracking_error_rad)
        if violation is not None:
            self.faults = (violation,)
        elif other is not None:
            violation = self._geometry.check_limits(
                self._geometry.world_from_flange(measured),
                other.world_from_flange,
                self._limits,
                slack_m=MEASURED_SLACK_M,
            )
            if violation is not None:
                self.faults = (f"measured: {violation}",)

    def _check_path(self, goal: Goal, other: OtherArm, measured: Floats) -> Command:
        """Start the motion if the path to the target has been checked; otherwise request a check.

        The other bridge checks the same path. No arm moves before both checks have passed.
        """
        if not self._stands_still(measured):
            return self._decelerate("waits for the arm to stand still")
        if (refusal := self._restart_refusal(measured)) is not None:
            return self._decelerate(refusal)
        sheet = self._geometry.measure_sheet(measured, other.world_from_flange)
        if self._clear_path is not None:
            request, alignment = self._clear_path
            if request.leads_to(goal.motion) and request.begins_at(measured, other.joints_rad):
                self._restart_at(measured)
                return self._start_motion(sheet, alignment, other)
        reason = "checks the path to the target"
        if self._blocked is not None:
            reason, since_s = self._blocked
            self._blocked = reason, since_s + self._step_s
        if self.pending_check is None and (
            self._blocked is None or self._blocked[1] > RECHECK_PERIOD_S
        ):
            self.pending_check = PathCheckRequest(sheet, goal.motion, measured, other.joints_rad)
        return self._decelerate(reason)

    def on_path_result(self, request: PathCheckRequest, result: Alignment | str | None) -> None:
        """Store the result of a path check. A result for an outdated request is ignored.

        result: straight joint motion (alignment) from the present pose to the start of the path;
            None if none is necessary. If the path is blocked, the result is the reason.
        """
        if request is not self.pending_check:
            return
        self.pending_check = None
        if isinstance(result, str):
            self._clear_path, self._blocked = None, (result, 0.0)
        else:
            self._clear_path, self._blocked = (request, result), None

    def _start_motion(
        self, sheet: SheetMotion, alignment: Alignment | None, other: OtherArm
    ) -> Command:
        self.handle(Event.PATH_CLEAR)
        self._sheet = sheet if alignment is None else alignment.sheet
        self._alignment, self._aligned_s = alignment, 0.0
        self._relaxed_limits = self._geometry.relax_limits(
            self._geometry.world_from_flange(self.commanded_rad), other.world_from_flange
        )
        self.reason = "waits for the other arm"
        return self._send("move", self.commanded_rad)

    def _align(self, alignment: Alignment, other: OtherArm) -> Command:
        """Return the next command of the joint motion to the start of the sheet's path.

        The motion pauses while a message is late, or while the other arm is not ready.
        """
        if self._state is State.FOLLOW and self._together:
            self._aligned_s += self._step_s
        goal_rad = alignment.joints_at(self._aligned_s)
        command = self._command_joints(goal_rad, other)
        left_rad = float(np.abs(self.commanded_rad - alignment.to_rad).max())
        if self._aligned_s >= alignment.duration_s and left_rad <= ALIGNED_RAD and self._together:
            self._alignment = None
        return command

    def _advance_sheet(
        self, target: SheetMotion, sheet: SheetMotion, speed_factor: float
    ) -> SheetMotion:
        """Return the sheet's motion after one step towards the target.

        speed_factor: factor for the speed bounds; below 1 if this arm is ahead of the other arm.

        After a start, the sheet moves slowly until it has reached the target.
        """
        if not self._settled:
            distance_m, angle_rad = measure_distance(sheet, target)
            stretch = abs(target.stretch_ratio - sheet.stretch_ratio)
            is_near = distance_m < SETTLED_M and angle_rad < SETTLED_RAD
            self._settled = is_near and stretch < SETTLED_STRETCH
        bounds = scale_speeds(FOLLOW_BOUNDS if self._settled else START_BOUNDS, speed_factor)
        edges = self._geometry.edge_bound
        return follow_sheet(sheet, target, bounds=bounds, edges=edges, step_s=self._step_s)

    def _command_sheet(self, sheet: SheetMotion, other: OtherArm) -> Command:
        """Return the command that moves this arm's edge to the given pose of the sheet."""
        try:
            goal_rad = self._geometry.joints_for_sheet(sheet, self.commanded_rad)
        except UnreachableError as error:
            return self._latch_fault(str(error))
        jump_rad = float(np.abs(goal_rad - self.commanded_rad).max())
        if jump_rad > MAX_JOINT_JUMP_RAD:
            text = f"the joint angles would jump by {np.degrees(jump_rad):.0f} degrees in one cycle"
            return self._latch_fault(text)
        self._sheet = sheet
        return self._command_joints(goal_rad, other)

    @property
    def _limits(self) -> SheetLimits:
        return self._geometry.sheet_limits if self._alignment is None else self._relaxed_limits

    def _command_joints(self, goal_rad: Floats, other: OtherArm) -> Command:
        """Return the command that moves towards joint angles (6,) rad.

        If the motion would violate a limit, a fault is latched and the arm stops.
        """
        velocity = self._limit_velocity(goal_rad)
        flange = self._geometry.world_from_flange(self.commanded_rad + velocity * self._step_s)
        violation = self._geometry.check_limits(
            flange, other.world_from_flange_commanded, self._limits
        )
        if violation is not None:
            return self._latch_fault(f"commanded: {violation}")
        self._goal_rad = goal_rad
        return self._move(velocity)

    def _latch_fault(self, text: str) -> Command:
        self.faults = (text,)
        self._inhibit(text, Event.FAULT)
        return self._decelerate(text)

    def _slacken(self, reason: str, other: OtherArm | None) -> Command:
        """Return the command that stops the arm, and then moves the arm until the sheet is slack.

        reason: text that is shown to the operator.
        """
        self._settle()
        measured = self.measured_rad
        starts = self._state is State.TAUT
        if not (starts or self._state is State.RELAX) or other is None or measured is None:
            return self._decelerate(reason)
        between = self._geometry.measure_sheet(measured, other.world_from_flange)
        limits = self._geometry.sheet_limits
        if between.stretch_ratio <= SLACK_STRETCH:
            self.handle(Event.RELAX_ENDED)
            return self._decelerate(reason)
        if between.stretch_ratio > IMPLAUSIBLE_LENGTH_RATIO * limits.max_length_m / limits.width_m:
            text = f"{reason}; the measured length of the sheet is not possible"
            return self._decelerate(text)
        if starts and not self._stands_still(measured):
            return self._decelerate(reason)
        refusal = (
            self._restart_refusal(measured)
            if starts
            else check_tracking_error(self.commanded_rad, measured, self._max_tracking_error_rad)
        )
        if refusal is not None:
            # The arm does not follow commands.  It would jump when it follows commands again.
            self.handle(Event.RELAX_ENDED)
            return self._decelerate(f"{reason}; {refusal}")
        if starts or self._sheet is None or self._relax_from is None:
            self._restart_at(measured)
            self._sheet, self._relax_from = between, between.stretch_ratio
        # Each arm executes half of a commanded change of stretch.  The other arm rests, so this arm
        # commands twice the change: from a stretch ratio s to 2 - s instead of to 1.
        target = replace(
            self._sheet,
            twist_world=np.zeros(6),
            stretch_ratio=2.0 - self._relax_from,
            stretch_rate_per_s=0.0,
        )
        sheet = follow_sheet(
            self._sheet,
            target,
            bounds=RELAX_BOUNDS,
            edges=self._geometry.edge_bound,
            step_s=self._step_s,
        )
        try:
            goal_rad = self._geometry.joints_for_sheet(sheet, self.commanded_rad)
        except UnreachableError:
            return self._decelerate(reason)
        velocity = self._limit_velocity(goal_rad)
        flange = self._geometry.world_from_flange(self.commanded_rad + velocity * self._step_s)
        if check_flange(flange, other.world_from_flange, limits) is not None:
            return self._decelerate(reason)
        self._sheet, self._goal_rad = sheet, goal_rad
        self.handle(Event.RELAX)
        self.reason = reason
        return self._move(velocity)

    def _decelerate(self, reason: str) -> Command:
        """Return the command that decelerates the arm along its path, or keeps the arm at rest.

        reason: text that is shown to the operator.
        """
        self.handle(Event.RELAX_BLOCKED)
        self._drop_path()
        self._settle()
        self.reason = reason
        if self.at_rest:
            mode = "idle" if self.mode == "idle" else "stop"
            return self._send(mode, self.commanded_rad)
        return self._move(self._limit_velocity(NO_GOAL))

    def _limit_velocity(self, goal_rad: Floats) -> Floats:
        """Return joint velocities (6,) rad/s towards the moving goal `goal_rad` (6,).

        The goal is assumed to continue at its last velocity. If the goal is not finite, the arm
        decelerates.
        """
        before = self.commanded_rad if self._goal_rad is None else self._goal_rad
        return limit_velocity(
            self.commanded_rad,
            self._velocity,
            goal_rad,
            (goal_rad - before) / self._step_s,
            limits=self._geometry.joint_limits,
            step_s=self._step_s,
        )

    def _move(self, velocity: Floats) -> Command:
        self._velocity = velocity
        return self._send("move", self.commanded_rad + velocity * self._step_s)

    def _send(self, mode: str, joints_rad: Floats) -> Command:
        """Return the command for joint angles (6,) rad after the final checks.

        A fault is latched if the state permits no motion, or if the motion exceeds the maximum
        joint speeds or tool speed.
        """
        before = self.commanded_rad
        if mode == "move" and self._state not in MOTION_STATES:
            self.faults = self.faults or (f"commanded: a motion in the state {self._state.name}",)
            mode, joints_rad = "stop", before
        bounded = bound_step(
            before,
            joints_rad,
            limits=self._geometry.joint_limits,
            step_s=self._step_s,
        )
        if bounded is not joints_rad:
            self._velocity = (bounded - before) / self._step_s
            self.faults = self.faults or ("commanded: a step beyond the joint or tool speed",)
        if self.faults:
            self._disarm(self.faults[0], Event.FAULT)
        self.commanded_rad = bounded
        self._has_commanded = self._has_commanded or mode == "move"
        if mode != "move":
            self._velocity = np.zeros(6)
        velocity = NO_MOTION if self.at_rest else self._velocity
        self._standstill.on_command(bounded, velocity, self._step_s)
        return Command(mode, bounded)

    def _is_at_command(self, measured: Floats) -> bool:
        shift_m = self._geometry.bound_edge_shift_m(self.commanded_rad, measured)
        return shift_m <= MAX_RESTART_SHIFT_M

    def _stands_still(self, measured: Floats) -> bool:
        return self._standstill.is_standing(at_command=self._is_at_command(measured))

    def _restart_refusal(self, measured: Floats) -> str | None:
        """Return why no motion may start, or None if a motion may start.

        measured: measured joint angles (6,) rad.

        If the arm is away from its last commanded position, a motion may start only if the
        measurements are plausible. If the measured angles were wrong, the arm would jump.
        """
        lowest, highest = self._geometry.range_rad
        beyond = max(float((lowest - measured).max()), float((measured - highest).max()))
        if beyond > MAX_BEYOND_RANGE_RAD:
            return (
                f"the measured joint angles are {np.degrees(beyond):.1f} degrees beyond their range"
            )
        if self._is_at_command(measured):
            return None
        monitor = self._standstill
        if monitor.is_alive and not monitor.has_jumped:
            return None
        angle_deg = float(np.degrees(np.abs(self.commanded_rad - measured).max()))
        defect = "jumped before" if monitor.has_jumped else "are frozen"
        return (
            f"the arm is {angle_deg:.1f} degrees off its command according to measured joint "
            f"angles that {defect}; check the arm, then restart its bridge"
        )

    def _restart_at(self, measured: Floats) -> None:
        """Replace the last commanded joint angles by the measured joint angles (6,) rad.

        If the arm is not at rest, a fault is latched instead.
        """
        if not self._stands_still(measured) or self._restart_refusal(measured) is not None:
            self.faults = self.faults or ("commanded: a start before the arm stands still",)
            self._inhibit(self.faults[0], Event.FAULT)
            return
        self._discard_motion()
        self.commanded_rad = measured.copy()
        self._standstill.has_jumped = False

    def _discard_motion(self) -> None:
        self._velocity = np.zeros(6)
        self._drop_path()

    def _drop_path(self) -> None:
        self._sheet = self._goal_rad = self._relax_from = self._clear_path = self._alignment = None
        self._settled = self._together = False


def _find_late_reason(goal: Goal, other: OtherArm) -> str:
    if goal.planner_ended:
        return PLANNER_ENDED
    if other.ended:
        return OTHER_BRIDGE_ENDED
    return "the sheet target or the other arm is late"


def _is_valid(motion: SheetMotion) -> bool:
    rates = (*motion.twist_world, motion.stretch_ratio, motion.stretch_rate_per_s)
    return is_rigid(motion.world_from_sheet) and bool(np.isfinite(rates).all())
