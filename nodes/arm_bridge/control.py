"""What an arm does in each cycle: follow the sheet's target, hold, stop, relax; decided here.

No sockets and no clock: the node hands in what it knows and how long the cycle is, and sends what
comes back.  The sheet's motion is bounded in the sheet's own frame first, in both bridges alike, so
that the two arms stay together on long ways; then each arm's joints go through the limiter.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from flexsheet.messages.clock_table import MAX_STAMP_AHEAD_NS
from flexsheet.messages.types import Arming, ArmMode, ArmState, EStop
from flexsheet.nodes.arm_bridge.geometry import ArmGeometry
from flexsheet.nodes.arm_bridge.goal import Goal, pace, slowed
from flexsheet.nodes.arm_bridge.kinematics import JOINT_MAX_RAD, JOINT_MIN_RAD, UnreachableError
from flexsheet.nodes.arm_bridge.limiter import (
    SheetLimits,
    bounded_step,
    braked,
    limited,
    place_trouble,
    relaxed_limits,
    sheet_trouble,
    step_trouble,
    with_tool_speed,
    within_range,
)
from flexsheet.nodes.arm_bridge.link import FAULT_TEXTS, ArmFault, Freshness
from flexsheet.nodes.arm_bridge.standstill import (
    MAX_RESTART_SHIFT_M,
    StandstillMonitor,
    edge_shift_m,
)
from flexsheet.nodes.arm_bridge.way import START_BOUNDS, Alignment, Way, lag
from flexsheet.nodes.models.motion import (
    EdgeBound,
    SheetBounds,
    SheetMotion,
    coast_sheet,
    follow_sheet,
)
from flexsheet.nodes.models.rigid import is_rigid

Floats = NDArray[np.float64]

REST_RAD_PER_S = 1e-6
"""Slower than this an arm is at rest: a ten-thousandth of a degree a second."""

# Accelerations that the joints can follow (J6 by 22 rad/s^2, J2 by 9.4): beyond, the joints would
# run on past a target that turns back, each arm by as much as its cycles happen to lie.
FOLLOW_BOUNDS = SheetBounds(
    speed_m_per_s=0.22,
    acceleration_m_per_s2=2.6,
    turn_rad_per_s=2.5,
    turn_acceleration_rad_per_s2=16.0,
    stretch_rate_per_s=0.1,
    stretch_acceleration_per_s2=1.0,
)
# Letting go is no haste either, but a taut sheet is what hurts: slack in about a second.
RELAX_BOUNDS = replace(START_BOUNDS, stretch_rate_per_s=0.05)

# On its target, for good: from then until it next stops, the sheet goes with the target.
SETTLED_M, SETTLED_RAD, SETTLED_STRETCH = 0.001, 0.01, 0.003

MEASURED_SLACK_M = 0.002
"""How far a measured flange may be past a place where it may still be sent: servos ripple."""

SLACK_STRETCH = 1.0005
"""A sheet this long pulls with a tenth of a newton: let go."""

NO_MOTION = np.zeros(6)

FAR_BEYOND = 1.1
"""A sheet that seems longer than so many times its limit is no sheet: nothing relaxes."""

JUMP_RAD = 0.35
"""Joints that would have to go further than this at once are on another branch of solutions."""

LET_GO_AFTER_S = 0.5
"""An arm without a target lets the sheet go after so long: a moment's gap is not worth it."""

NOT_BELIEVED = {
    Freshness.STALLED: "the counters of its status stand still, its joints are not believed",
    Freshness.REVERSED: "the counters of its status run backwards, its joints are not believed",
}

READY_TOGETHER_S = 1.0
"""An arm that was told to be ready is no longer, if the other has not become so by then."""

OLDEST_ARMING_S = 1.0
"""An older word was held up on the way; who gave it may no longer mean it."""


ALIGNED_RAD = 1e-4
"""Joints this near to the end of an alignment are there."""

MAX_FUTURE_S = 0.02
"""A state of the other arm from further in the future cannot be right.  Measured clocks are off by
less, and a state that was believed would stay fresh for as long as it lies ahead."""

MAX_BEYOND_RANGE_RAD = 0.02
"""Measured joints further beyond the maker's ranges are not those of an arm."""

LOOK_AGAIN_S = 0.5
"""How long a barred way stays barred before it is looked at again, the target having moved on."""


@dataclass(frozen=True, slots=True)
class Patience:
    """How late things may be before the arm holds, and before it stops (seconds)."""

    hold_after_s: float
    stop_after_s: float


@dataclass(frozen=True, slots=True)
class OtherArm:
    """The other arm as its bridge tells: joints (6,), flange in the world, whether it is well."""

    joints_rad: Floats
    world_from_flange: Floats
    world_from_flange_commanded: Floats
    mode: ArmMode
    faults: tuple[str, ...]
    age_s: float
    ready: bool
    estop_engaged: bool

    @classmethod
    def from_state(cls, state: ArmState, age_s: float) -> OtherArm:
        """What the other bridge's message says, `age_s` after it came."""
        return cls(
            state.joints_rad,
            state.world_from_flange,
            state.world_from_flange_commanded,
            state.mode,
            state.faults,
            age_s,
            state.ready,
            state.estop_engaged,
        )

    @property
    def invalid_reason(self) -> str | None:
        """Why nothing can be done with this state, or None; it is then as good as none."""
        if not np.isfinite(self.joints_rad).all():
            return "its joints are not finite"
        if not (is_rigid(self.world_from_flange) and is_rigid(self.world_from_flange_commanded)):
            return "its flange is not a rigid pose"
        if self.age_s < -MAX_FUTURE_S:
            return f"it is of {-self.age_s:.3g} s in the future"
        return None

    @property
    def estopped(self) -> bool:
        """Whether somebody has stopped it: then nothing moves, not even to let go."""
        return self.mode == "estop" or self.estop_engaged

    @property
    def trouble(self) -> str | None:
        """Why this arm must not move with it, or None."""
        if self.faults:
            return f"other arm: {self.faults[0]}"
        if self.mode in ("disconnected", "fault", "estop"):
            return f"other arm: {self.mode}"
        if self.mode == "starting":
            return "waiting for the other arm"
        return None


@dataclass(frozen=True, slots=True)
class Command:
    """What to tell the arm's controller: mode of the register map, joints (6,) rad."""

    mode: str
    joints_rad: Floats


class ArmControl:
    """One arm's state from cycle to cycle.

    mode, faults and reason are for people and for the other arm: faults hold what is wrong with
    this arm (latched until `reset`, but for a lost connection), reason why it does not follow.
    ready: whether it may move.  A person makes it so, and whatever hinders the motion (a target or
    the other arm silent for long, a lost connection, a fault, a stop) ends it: when all is well
    again the arm stays where it is.  With `by_itself` it is ready whenever nothing hinders it.
    question: the way of which it wants to know, by `take_way`, whether it is clear; None: of none.
    """

    def __init__(
        self, patience: Patience, *, largest_lag_rad: float, by_itself: bool = False
    ) -> None:
        self.mode: ArmMode = "starting"
        self.faults: tuple[str, ...] = ()
        self.reason = "waiting for the arm to answer"
        self.estop_reason: str | None = None
        self.measured_rad: Floats | None = None
        self.last_measured_rad: Floats | None = None
        self.commanded_rad = np.zeros(6)
        self.question: Way | None = None
        self.ready = by_itself
        self._by_itself = by_itself
        self._hindrance: str | None = self.reason
        self._unready_since = ""
        self._stood_down: str | None = None
        self._waited_s = 0.0
        self._silence = ""
        self._clear_way: tuple[Way, Alignment | None] | None = None
        self._alignment: Alignment | None = None
        self._aligned_s = 0.0
        self._relaxed_limits: SheetLimits
        self._barred: tuple[str, float] | None = None
        self._together = False
        self._patience = patience
        self._largest_lag_rad = largest_lag_rad
        self._velocity = np.zeros(6)
        self._standstill = StandstillMonitor()
        self._has_commanded = False
        self._sheet: SheetMotion | None = None
        self._settled = False
        self._clear_arm = False
        self._has_pulled = False
        self._interrupted = False
        self._engaged_ns = 0
        self._missed = False
        self._goal_rad: Floats | None = None
        self._relax_from: float | None = None

    @property
    def all_faults(self) -> tuple[str, ...]:
        """What the other arm must stop for: own faults, e-stop, a lost connection."""
        estop = () if self.estop_reason is None else (f"e-stop: {self.estop_reason}",)
        lost = (self.reason,) if self.mode == "disconnected" else ()
        return (*self.faults, *estop, *lost)

    @property
    def path_blocked(self) -> bool:
        """Whether it stands because no path to the target is clear."""
        return self._barred is not None and self.mode == "hold"

    @property
    def auto_arming(self) -> bool:
        """Whether it becomes ready without a person's word."""
        return self._by_itself

    @property
    def at_rest(self) -> bool:
        return float(np.abs(self._velocity).max()) <= REST_RAD_PER_S

    @property
    def resting(self) -> bool:
        """Whether nothing will move before somebody says so; then the arm needs to hear less."""
        return self.mode == "idle" and not self.ready and not self._has_pulled and self.at_rest

    def miss_answer(self, text: str) -> bool:
        """One exchange without an answer is forgiven while moving; False for a second in a row.

        The arm's own watchdog guards the meantime, and the next command goes on from this one.
        """
        if self._missed or self.measured_rad is None:
            return False
        self._missed = True
        self._standstill.forget()
        if self.mode == "follow":
            self.mode, self.reason = "hold", text
        return True

    def fail_exchange(self, text: str, *, silent: bool) -> bool:
        """An exchange has failed; True when with it the arm counts as lost, for the first time."""
        if silent and self.last_measured_rad is None:
            # It has never answered: it may still be starting, which is no fault.
            self.reason = f"waiting for the arm: {text}"
            return False
        if silent and self.miss_answer(text):
            return False
        newly = self.mode != "disconnected"
        self.lose_connection(text)
        return newly

    def lose_connection(self, text: str) -> None:
        """The arm cannot be reached: forget all but a latched fault or e-stop."""
        self.measured_rad = None
        self._standstill.forget()
        self.mode, self.reason = "disconnected", text
        self._hinder(text)
        self._has_pulled = False
        self._forget_motion()

    def take_measurement(
        self,
        joints_rad: Floats,
        arm_faults: tuple[ArmFault, ...],
        freshness: Freshness = Freshness.FRESH,
    ) -> None:
        """Take over what the arm answered: joints (6,) where they are believed, and its faults."""
        self._missed = False
        self._standstill.on_measurement(joints_rad, freshness)
        if self.last_measured_rad is None or freshness in (Freshness.FIRST, Freshness.FRESH):
            self.last_measured_rad = joints_rad
        if not freshness.is_believed and not self.faults:
            self.faults = (f"arm: {NOT_BELIEVED[freshness]}",)
        self.measured_rad = self.last_measured_rad
        if not self._has_commanded and not self._standstill.has_jumped:
            self.commanded_rad = self.measured_rad
        if arm_faults == (ArmFault.WATCHDOG,):
            # The cycle came late, the arm has stopped by itself: begin again from where it stands.
            self._stop_short()
            self.mode, self.reason = "stopping", "the arm's watchdog stopped it"
            self._hinder(self.reason)
            self._has_pulled = False
        elif arm_faults and not self.faults:
            self.faults = tuple(f"arm: {FAULT_TEXTS[fault]}" for fault in arm_faults)

    def _stop_short(self) -> None:
        """The arm stands without a command of this bridge: tell it to be idle."""
        self._forget_motion()
        self._standstill.restart()
        self._clear_arm = True

    def interrupt(self) -> None:
        """Come to rest and begin anew: the scene has changed under the motion."""
        self._interrupted = True
        self.question = self._clear_way = self._barred = None
        if self.mode in ("follow", "hold"):
            self.mode = "stopping"

    def engage_estop(self, reason: str) -> None:
        self.estop_reason = reason

    def take_estop(
        self, estop: EStop, stamp_ns: int, now_ns: int, clock_trouble: str = ""
    ) -> str | None:
        """Engage or reset; returns why a reset is refused.

        stamp_ns: when the message was made, which clock_trouble says not to be sure of.  Several
        nodes may write e-stops, and the last word of each comes anew to a late reader, in any
        order: a reset from before the last stop does not clear it.  One that is stamped in the
        future would clear the stops that come until then.
        """
        if estop.engaged:
            # A stamp from the future would bar every reset to come.
            engaged_ns = now_ns if clock_trouble else min(stamp_ns, now_ns)
            self._engaged_ns = max(self._engaged_ns, engaged_ns)
            self.engage_estop(estop.reason)
        elif clock_trouble:
            return clock_trouble
        elif stamp_ns > now_ns + MAX_STAMP_AHEAD_NS:
            return "it is stamped in the future"
        elif stamp_ns < self._engaged_ns:
            return "it is older than the stop"
        elif not self.reset():
            return "the arm still moves"
        return None

    def reset(self) -> bool:
        """Clear e-stop and faults; refused (False) while the arm still moves."""
        if not self.at_rest:
            return False
        self.estop_reason, self.faults = None, ()
        if self.measured_rad is not None:
            self._stop_short()
        return True

    def take_arming(self, arming: Arming, age_s: float) -> str | None:
        """A person's word that the arm may move, or shall no longer; returns why it is refused."""
        if not arming.ready:
            self._stood_down = f"stood down: {arming.reason}" if arming.reason else "stood down"
            return None
        if not age_s <= OLDEST_ARMING_S:
            return f"the word is {age_s:.1f} s old"
        if self._hindrance not in (None, self._stood_down):
            return self._hindrance
        if not self.at_rest:
            return "the arm still moves"
        self._stood_down = self._hindrance = None
        self._make_ready()
        return None

    def _make_ready(self) -> None:
        self.ready, self._waited_s = True, 0.0

    def _hinder(self, why: str) -> None:
        """Something keeps the arm from moving: it is ready no longer."""
        self._hindrance = why
        if self.ready:
            self.ready, self._unready_since, self._waited_s = False, why, 0.0

    def _look_for_hindrance(self, goal: Goal | None, other: OtherArm | None) -> None:
        """Whether the arm is, and stays, ready."""
        silent = other is None or not other.age_s <= self._patience.stop_after_s
        stopped = self.estop_reason is not None or (other is not None and other.estopped)
        why = self._stood_down
        if self.estop_reason is not None:
            why = f"e-stop: {self.estop_reason}"
        elif self.faults:
            why = self.faults[0]
        elif other is None or silent:
            why = self._silence
        elif other.trouble is not None:
            why = other.trouble
        elif goal is None or not goal.overdue_s <= self._patience.stop_after_s:
            why = why or ("waiting for a sheet target" if goal is None else "no sheet target")
        if why is not None:
            self._hinder(why)
        else:
            self._hindrance = None
            if self._by_itself:
                self._make_ready()
        # To let go is a motion too: it belongs to the stop, and never comes after a silence.
        self._has_pulled = self._has_pulled and not (silent or stopped)

    def step(
        self,
        geometry: ArmGeometry,
        goal: Goal | None,
        other: OtherArm | None,
        step_s: float,
        clock_trouble: str = "",
    ) -> Command:
        """Decide and compute this cycle's command; `step_s` is the time that it covers.

        clock_trouble: why it cannot be known how old goal and other arm are; empty: it is.
        """
        measured = self.measured_rad
        if measured is None or self._clear_arm:
            self._clear_arm = self._clear_arm and measured is None
            return self._send("idle", self.commanded_rad, geometry, step_s)
        self._silence = "the other arm is silent" if other else "waiting for the other arm"
        if other is not None and (invalid := other.invalid_reason) is not None:
            self._silence, other = f"state of the other arm: {invalid}", None
        self._watch(geometry, other, measured)
        self._look_for_hindrance(goal, other)
        if clock_trouble:
            self._hinder(clock_trouble)
            self._has_pulled = False
        if self.estop_reason is not None:
            return self._stop("estop", f"e-stop: {self.estop_reason}", geometry, step_s)
        if other is not None and other.estopped:
            rest_mode: ArmMode = "fault" if self.faults else "idle"
            return self._stop(rest_mode, "other arm: e-stop", geometry, step_s)
        if self.faults:
            return self._stop_and_relax("fault", self.faults[0], geometry, other, step_s)
        if clock_trouble:
            return self._stop("idle", clock_trouble, geometry, step_s)
        return self._serve(geometry, goal, other, measured, step_s)

    def _serve(
        self,
        geometry: ArmGeometry,
        goal: Goal | None,
        other: OtherArm | None,
        measured: Floats,
        step_s: float,
    ) -> Command:
        """Nothing is wrong with this arm: go with the target, if there are target and other arm."""
        if other is None or not other.age_s <= self._patience.stop_after_s:
            return self._stop("idle", self._silence, geometry, step_s)
        if other.trouble is not None:
            return self._stop_and_relax("idle", other.trouble, geometry, other, step_s)
        if goal is None or not self.ready or not other.ready:
            return self._stand(geometry, other, step_s)
        self._waited_s = 0.0
        if self._relax_from is not None:
            return self._stop("idle", "after relaxing", geometry, step_s)
        if not _is_sound(goal.motion):
            return self._fail("sheet target is not a rigid pose", geometry, step_s)
        if self._interrupted or (self._sheet is None and not self.at_rest):
            self._has_pulled = self._has_pulled and not self._interrupted
            self._interrupted = self._interrupted and not self.at_rest
            return self._stop("idle", "comes to rest", geometry, step_s)
        if self._sheet is None:
            return self._set_out(geometry, goal, other, measured, step_s)
        return self._follow(goal, self._sheet, geometry, other, step_s)

    def _stand(self, geometry: ArmGeometry, other: OtherArm, step_s: float) -> Command:
        """Not ready: stop, let the sheet go if that is still to be done, and stay."""
        self._waited_s += step_s
        if self.ready:
            return self._wait_for_other(geometry, step_s)
        why = self._hindrance
        if why is None:
            why = f"not ready since: {self._unready_since}" if self._unready_since else "not ready"
        if self._waited_s > LET_GO_AFTER_S:
            return self._stop_and_relax("idle", why, geometry, other, step_s)
        return self._stop("idle", why, geometry, step_s)

    def _wait_for_other(self, geometry: ArmGeometry, step_s: float) -> Command:
        """The other arm may not move: this one stops too; not yet begun, it waits a moment."""
        began = self._sheet is not None or not self.at_rest
        if not self._by_itself and (began or self._waited_s > READY_TOGETHER_S):
            self._hinder("the other arm is not ready")
        return self._stop("idle", "the other arm is not ready", geometry, step_s)

    def _follow(
        self,
        goal: Goal,
        sheet: SheetMotion,
        geometry: ArmGeometry,
        other: OtherArm,
        step_s: float,
    ) -> Command:
        """Go with the target; come to rest gently while it, or the other arm, is late."""
        late = max(goal.overdue_s, other.age_s - self._patience.hold_after_s)
        if late > self._patience.hold_after_s:
            self.mode, self.reason = "hold", "sheet target or other arm late"
            if self._alignment is not None:
                return self._align(self._alignment, geometry, other, step_s)
            sheet = coast_sheet(sheet, bounds=FOLLOW_BOUNDS, step_s=step_s)
        else:
            self._together = self._together or other.mode == "follow"
            self.mode, self.reason = "follow", "" if self._together else "waits for the other arm"
            if self._alignment is not None:
                return self._align(self._alignment, geometry, other, step_s)
            share = pace(
                geometry.world_from_edge(self.commanded_rad),
                other.world_from_flange_commanded @ geometry.other_flange_from_edge,
                goal.motion.world_from_sheet,
                left=geometry.left,
            )
            share = share if self._together else 0.0
            sheet = self._towards(goal.motion, sheet, geometry.edge_bound, share, step_s)
        return self._carry(sheet, geometry, other, step_s)

    def _watch(self, geometry: ArmGeometry, other: OtherArm | None, measured: Floats) -> None:
        """Latch a fault when the measured poses are not as they must be while moving."""
        if self.faults or self._sheet is None or self.mode not in ("follow", "hold"):
            return
        trouble = step_trouble(self.commanded_rad, measured, self._largest_lag_rad)
        if trouble is not None:
            self.faults = (trouble,)
        elif other is not None:
            flange = geometry.world_from_flange(measured)
            trouble = place_trouble(
                flange, other.world_from_flange, self._limits(geometry), slack_m=MEASURED_SLACK_M
            ) or sheet_trouble(
                flange @ geometry.flange_from_edge,
                other.world_from_flange @ geometry.other_flange_from_edge,
                left=geometry.left,
                limits=self._limits(geometry),
            )
            if trouble is not None:
                self.faults = (f"measured: {trouble}",)

    def _set_out(
        self,
        geometry: ArmGeometry,
        goal: Goal,
        other: OtherArm,
        measured: Floats,
        step_s: float,
    ) -> Command:
        """Begin if the way to the target is known to be clear; else stand, and ask whether it is.

        The other bridge asks the same of the same two arms.  Neither moves before both follow.
        """
        if not self._stands_still(measured):
            return self._stop("hold", "waits until the arm stands still", geometry, step_s)
        if (doubt := self._restart_doubt(measured)) is not None:
            return self._stop("hold", doubt, geometry, step_s)
        sheet = geometry.sheet_between(
            geometry.world_from_edge(measured),
            other.world_from_flange @ geometry.other_flange_from_edge,
        )
        if self._clear_way is not None:
            way, alignment = self._clear_way
            if way.leads_to(goal.motion) and way.begins_at(measured, other.joints_rad):
                self._restart_at(measured)
                return self._begin(sheet, alignment, geometry, other, step_s)
        reason = "looks whether the way is clear"
        if self._barred is not None:
            reason, since_s = self._barred
            self._barred = reason, since_s + step_s
        if self.question is None and (self._barred is None or self._barred[1] > LOOK_AGAIN_S):
            self.question = Way(sheet, goal.motion, measured, other.joints_rad)
        return self._stop("hold", reason, geometry, step_s)

    def take_way(self, way: Way, found: Alignment | str | None) -> None:
        """Take the answer to the question: how to begin, or why not; None: to begin as it stands.

        The answer to a question that is no longer asked is thrown away.
        """
        if way is not self.question:
            return
        self.question = None
        if isinstance(found, str):
            self._clear_way, self._barred = None, (found, 0.0)
        else:
            self._clear_way, self._barred = (way, found), None

    def _begin(
        self,
        sheet: SheetMotion,
        alignment: Alignment | None,
        geometry: ArmGeometry,
        other: OtherArm,
        step_s: float,
    ) -> Command:
        """The first command of a motion is the measured pose."""
        self._sheet = sheet if alignment is None else alignment.sheet
        self._alignment, self._aligned_s = alignment, 0.0
        flange = geometry.world_from_flange(self.commanded_rad)
        self._relaxed_limits = relaxed_limits(
            geometry.sheet_limits,
            flange,
            flange @ geometry.flange_from_edge,
            other.world_from_flange,
            other.world_from_flange @ geometry.other_flange_from_edge,
            left=geometry.left,
        )
        self._has_pulled = True
        self.mode, self.reason = "follow", "waits for the other arm"
        return self._send("move", self.commanded_rad, geometry, step_s)

    def _align(
        self, alignment: Alignment, geometry: ArmGeometry, other: OtherArm, step_s: float
    ) -> Command:
        """Go on with the alignment, if this arm does not wait; then with the sheet."""
        if self.mode == "follow" and self._together:
            self._aligned_s += step_s
        goal_rad = alignment.joints_at(self._aligned_s)
        command = self._lead(goal_rad, geometry, other, step_s)
        left_rad = float(np.abs(self.commanded_rad - alignment.to_rad).max())
        if self._aligned_s >= alignment.duration_s and left_rad <= ALIGNED_RAD and self._together:
            self._alignment = None
        return command

    def _towards(
        self,
        target: SheetMotion,
        sheet: SheetMotion,
        edges: EdgeBound,
        share: float,
        step_s: float,
    ) -> SheetMotion:
        """The sheet's next motion: gently until it is on its target, from then on with it.

        share: of the speeds, less than 1 for the arm that is ahead of the other.
        """
        if not self._settled:
            distance, angle = lag(sheet, target)
            longer = abs(target.stretch_ratio - sheet.stretch_ratio)
            near = distance < SETTLED_M and angle < SETTLED_RAD
            self._settled = near and longer < SETTLED_STRETCH
        bounds = FOLLOW_BOUNDS if self._settled else START_BOUNDS
        return follow_sheet(sheet, target, bounds=slowed(bounds, share), edges=edges, step_s=step_s)

    def _carry(
        self, sheet: SheetMotion, geometry: ArmGeometry, other: OtherArm, step_s: float
    ) -> Command:
        """Bring this arm's edge to the sheet's motion, through the limiter."""
        try:
            goal_rad = geometry.joints_for_sheet(sheet, self.commanded_rad)
        except UnreachableError as error:
            return self._fail(str(error), geometry, step_s)
        jump = float(np.abs(goal_rad - self.commanded_rad).max())
        if jump > JUMP_RAD:
            return self._fail(
                f"joints would leap by {np.degrees(jump):.0f} degrees", geometry, step_s
            )
        self._sheet = sheet
        return self._lead(goal_rad, geometry, other, step_s)

    def _limits(self, geometry: ArmGeometry) -> SheetLimits:
        """The limits of the sheet that hold now: while the arms align, wide enough to begin."""
        return geometry.sheet_limits if self._alignment is None else self._relaxed_limits

    def _lead(
        self, goal_rad: Floats, geometry: ArmGeometry, other: OtherArm, step_s: float
    ) -> Command:
        """Go towards joints (6,), through the limiter; a sheet that would suffer is a fault."""
        velocity = self._limited(goal_rad, geometry, step_s)
        flange = geometry.world_from_flange(self.commanded_rad + velocity * step_s)
        limits = self._limits(geometry)
        trouble = place_trouble(flange, other.world_from_flange_commanded, limits) or sheet_trouble(
            flange @ geometry.flange_from_edge,
            other.world_from_flange_commanded @ geometry.other_flange_from_edge,
            left=geometry.left,
            limits=limits,
        )
        if trouble is not None:
            return self._fail(f"commanded: {trouble}", geometry, step_s)
        self._goal_rad = goal_rad
        return self._move(velocity, geometry, step_s)

    def _fail(self, text: str, geometry: ArmGeometry, step_s: float) -> Command:
        self.faults = (text,)
        return self._stop("fault", text, geometry, step_s)

    def _stop_and_relax(
        self,
        rest_mode: ArmMode,
        reason: str,
        geometry: ArmGeometry,
        other: OtherArm | None,
        step_s: float,
    ) -> Command:
        """Stop; once at rest let the sheet go slack, moving this edge towards the other one."""
        measured = self.measured_rad
        braking = not self.at_rest and self._relax_from is None
        alone = other is None or not other.age_s <= self._patience.stop_after_s
        if braking or alone or not self._has_pulled or other is None or measured is None:
            return self._stop(rest_mode, reason, geometry, step_s)
        between = geometry.sheet_between(
            geometry.world_from_edge(measured),
            other.world_from_flange @ geometry.other_flange_from_edge,
        )
        limits = geometry.sheet_limits
        if between.stretch_ratio <= SLACK_STRETCH:
            self._has_pulled = False
            return self._stop(rest_mode, reason, geometry, step_s)
        if between.stretch_ratio > FAR_BEYOND * limits.longest_m / limits.width_m:
            return self._stop(rest_mode, f"{reason}; no sheet can be so long", geometry, step_s)
        starts = self._relax_from is None or self._sheet is None
        if starts and not self._stands_still(measured):
            return self._stop(rest_mode, reason, geometry, step_s)
        doubt = (
            self._restart_doubt(measured)
            if starts
            else step_trouble(self.commanded_rad, measured, self._largest_lag_rad)
        )
        if doubt is not None:
            # It does not obey: to go on would be a leap once it does.
            self._has_pulled = False
            return self._stop(rest_mode, f"{reason}; {doubt}", geometry, step_s)
        if self._relax_from is None or self._sheet is None:
            self._restart_at(measured)
            self._sheet, self._relax_from = between, between.stretch_ratio
        # Alone, this arm has to give way by the whole of the stretch, twice its share.
        target = replace(
            self._sheet,
            twist_world=np.zeros(6),
            stretch_ratio=2.0 - self._relax_from,
            stretch_rate_per_s=0.0,
        )
        sheet = follow_sheet(
            self._sheet, target, bounds=RELAX_BOUNDS, edges=geometry.edge_bound, step_s=step_s
        )
        try:
            goal_rad = geometry.joints_for_sheet(sheet, self.commanded_rad)
        except UnreachableError:
            return self._stop(rest_mode, reason, geometry, step_s)
        velocity = self._limited(goal_rad, geometry, step_s)
        flange = geometry.world_from_flange(self.commanded_rad + velocity * step_s)
        if place_trouble(flange, other.world_from_flange, limits) is not None:
            return self._stop(rest_mode, reason, geometry, step_s)
        self._sheet, self._goal_rad = sheet, goal_rad
        self.mode, self.reason = "relax", reason
        return self._move(velocity, geometry, step_s)

    def _stop(
        self, rest_mode: ArmMode, reason: str, geometry: ArmGeometry, step_s: float
    ) -> Command:
        """Brake along the path; at rest stay in `rest_mode`."""
        self._leave_way()
        self.reason = reason
        if self.at_rest:
            self.mode = rest_mode
            mode = "idle" if rest_mode == "idle" else "stop"
            return self._send(mode, self.commanded_rad, geometry, step_s)
        self.mode = "stopping"
        slower = braked(self._velocity, limits=geometry.joint_limits, step_s=step_s)
        velocity = with_tool_speed(
            self.commanded_rad,
            self._velocity,
            within_range(
                self.commanded_rad,
                self._velocity,
                slower,
                limits=geometry.joint_limits,
                step_s=step_s,
            ),
            tool_points=geometry.tool_points,
            max_tool_speed=geometry.max_tool_speed,
            limits=geometry.joint_limits,
            step_s=step_s,
        )
        return self._move(velocity, geometry, step_s)

    def _limited(self, goal_rad: Floats, geometry: ArmGeometry, step_s: float) -> Floats:
        """Joint velocities towards a goal that moves as it did since the last cycle."""
        before = self.commanded_rad if self._goal_rad is None else self._goal_rad
        return limited(
            self.commanded_rad,
            self._velocity,
            goal_rad,
            (goal_rad - before) / step_s,
            tool_points=geometry.tool_points,
            max_tool_speed=geometry.max_tool_speed,
            limits=geometry.joint_limits,
            step_s=step_s,
        )

    def _move(self, velocity: Floats, geometry: ArmGeometry, step_s: float) -> Command:
        self._velocity = velocity
        return self._send("move", self.commanded_rad + velocity * step_s, geometry, step_s)

    def _send(self, mode: str, joints_rad: Floats, geometry: ArmGeometry, step_s: float) -> Command:
        """Return the command for these joints; every command is made here.

        Whatever has been decided, it leads no further from the last commanded joints than joint
        speeds and tool speed allow.  A decision that would lead further is a fault.
        """
        before = self.commanded_rad
        bounded = bounded_step(
            before,
            joints_rad,
            tool_points=geometry.tool_points,
            max_tool_speed=geometry.max_tool_speed,
            limits=geometry.joint_limits,
            step_s=step_s,
        )
        if bounded is not joints_rad:
            self._velocity = (bounded - before) / step_s
            self.faults = self.faults or ("commanded: a step beyond the joint or tool speed",)
        self.commanded_rad = bounded
        self._has_commanded = self._has_commanded or mode == "move"
        if mode != "move":
            self._velocity = np.zeros(6)
        velocity = NO_MOTION if self.at_rest else self._velocity
        self._standstill.on_command(bounded, velocity, step_s)
        return Command(mode, bounded)

    def _is_where_sent(self, measured: Floats) -> bool:
        """Whether the arm stands at its last command, near enough to start from the measurement."""
        return edge_shift_m(self.commanded_rad, measured) <= MAX_RESTART_SHIFT_M

    def _stands_still(self, measured: Floats) -> bool:
        return self._standstill.is_standing(where_sent=self._is_where_sent(measured))

    def _restart_doubt(self, measured: Floats) -> str | None:
        """Why the last commanded joints may not be forgotten for the measured ones, or None.

        For an arm that stands still.  One that stands where it was sent to may start from there.
        Elsewhere, either the arm has not obeyed or the measurement is wrong, which is a leap if it
        is believed.
        """
        beyond = max(
            float((JOINT_MIN_RAD - measured).max()), float((measured - JOINT_MAX_RAD).max())
        )
        if beyond > MAX_BEYOND_RANGE_RAD:
            return f"measured joints are {np.degrees(beyond):.1f} degrees beyond their range"
        if self._is_where_sent(measured):
            return None
        monitor = self._standstill
        if monitor.is_alive and not monitor.has_jumped:
            return None
        angle = float(np.degrees(np.abs(self.commanded_rad - measured).max()))
        why = "leapt before" if monitor.has_jumped else "are frozen"
        return (
            f"the arm stands {angle:.1f} degrees off its command by measured joints that {why}: "
            "check the arm, then restart its bridge"
        )

    def _restart_at(self, measured: Floats) -> None:
        """Forget the last commanded joints: the next command goes on from the measured ones.

        A decision to do so for an arm that does not stand still is a fault, and they are kept.
        """
        if not self._stands_still(measured) or self._restart_doubt(measured) is not None:
            self.faults = self.faults or ("commanded: a start before the arm stands still",)
            return
        self._forget_motion()
        self.commanded_rad = measured.copy()
        self._standstill.has_jumped = False

    def _forget_motion(self) -> None:
        self._velocity = np.zeros(6)
        self._leave_way()

    def _leave_way(self) -> None:
        self._sheet = self._goal_rad = self._relax_from = self._clear_way = self._alignment = None
        self._settled = self._together = False


def _is_sound(motion: SheetMotion) -> bool:
    rates = (*motion.twist_world, motion.stretch_ratio, motion.stretch_rate_per_s)
    return is_rigid(motion.world_from_sheet) and bool(np.isfinite(rates).all())
