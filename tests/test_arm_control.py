"""Test the arm control's decisions cycle by cycle, without sockets."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from flexsheet.messages.clock import VirtualClock
from flexsheet.messages.notes import NoteCode
from flexsheet.messages.types import ArmState, EStop, Side
from flexsheet.nodes.arm_bridge import other_arm
from flexsheet.nodes.arm_bridge.control import ArmControl, Command, Timeouts
from flexsheet.nodes.arm_bridge.geometry import ArmGeometry
from flexsheet.nodes.arm_bridge.goal import Goal, compute_sync_factor, extrapolate_goal
from flexsheet.nodes.arm_bridge.link import FAULT_TEXTS, ArmFault
from flexsheet.nodes.arm_bridge.node import ArmBridge, ArmBridgeParameters
from flexsheet.nodes.arm_bridge.other_arm import OtherArm
from flexsheet.nodes.arm_bridge.standstill import STANDSTILL_COUNT
from flexsheet.nodes.models.motion import SheetMotion
from flexsheet.nodes.models.rigid import is_rigid, transform_from_rpy, vector_from_rotation
from flexsheet.nodes.models.sheet import edge_poses
from tests.arm_states import as_other_arm, connect_control
from tests.examples import examples
from tests.rv_1a import (
    forward,
)
from tests.scenes import load_cylinder
from tests.twists import twist_between

Floats = NDArray[np.float64]
SCENE = load_cylinder()
STEP_S = 1.0 / 140.0
GUESS = np.radians([0.0, 25.0, 118.0, 0.0, -54.0, 0.0])
HOME = SheetMotion(np.eye(4), np.zeros(6), 1.02, 0.0)
TIMEOUTS = Timeouts(hold_after_s=0.02, stop_after_s=0.1)


def sheet_at(
    y: float = 0.0, *, z: float = 0.0, tilt: float = 0.0, stretch: float = 1.02
) -> SheetMotion:
    return replace(
        HOME, world_from_sheet=transform_from_rpy([0.0, y, z], [tilt, 0, 0]), stretch_ratio=stretch
    )


@dataclass
class Arm:
    """Simulate one controlled arm that reaches its command at once."""

    geometry: ArmGeometry
    control: ArmControl
    joints: Floats
    command: Command

    @classmethod
    def holding(cls, side: Side, motion: SheetMotion = HOME, *, auto_arming: bool = True) -> Arm:
        geometry = ArmGeometry(SCENE, side)
        control = ArmControl(TIMEOUTS, max_tracking_error_rad=0.12, auto_arming=auto_arming)
        joints = geometry.joints_for_sheet(motion, GUESS)
        arm = cls(geometry, control, joints, Command("idle", joints))
        for _ in range(STANDSTILL_COUNT):
            control.on_measurement(joints, ())
        return arm

    def cycle(self, goal: Goal | None, other: OtherArm | None, step_s: float = STEP_S) -> None:
        self.command = self.control.step(self.geometry, goal, other, step_s)
        if self.control.pending_check is not None:
            self.control.on_path_result(self.control.pending_check, None)
        if self.command.mode == "move":
            self.joints = self.command.joints_rad
        self.control.on_measurement(self.joints, ())

    def as_other(self, age_s: float = 0.005) -> OtherArm:
        return as_other_arm(self.control, self.geometry, self.joints, age_s)

    @property
    def edge(self) -> Floats:
        return self.geometry.world_from_edge(self.joints)


def pair(motion: SheetMotion = HOME, *, auto_arming: bool = True) -> tuple[Arm, Arm]:
    arms = (
        Arm.holding("left", motion, auto_arming=auto_arming),
        Arm.holding("right", motion, auto_arming=auto_arming),
    )
    for arm in arms:
        connect_control(arm.control)
    return arms


def run(arms: tuple[Arm, Arm], goal: Goal | None, cycles: int) -> None:
    for _ in range(cycles):
        for arm, other in (arms, arms[::-1]):
            arm.cycle(goal, other.as_other())


def distance(arms: tuple[Arm, Arm]) -> float:
    return float(np.linalg.norm(arms[0].edge[:3, 3] - arms[1].edge[:3, 3]))


def on_time(motion: SheetMotion) -> Goal:
    return Goal(motion, overdue_s=-0.005)


def test_the_first_command_is_the_measured_pose() -> None:
    arms = pair()
    arms[0].cycle(on_time(sheet_at(0.05)), arms[1].as_other())
    assert arms[0].command.mode == "stop"
    before = arms[0].joints
    arms[0].cycle(on_time(sheet_at(0.05)), arms[1].as_other())
    assert arms[0].command.mode == "move"
    assert (arms[0].command.joints_rad == before).all()


def test_before_the_arm_answers_its_command_is_idle() -> None:
    control = ArmControl(TIMEOUTS, max_tracking_error_rad=0.1)
    geometry = ArmGeometry(SCENE, "left")
    command = control.step(geometry, on_time(HOME), None, STEP_S)
    assert command.mode == "idle"
    assert control.mode == "starting"


def test_a_far_target_is_reached_slowly_and_together() -> None:
    arms = pair()
    goal = on_time(sheet_at(0.06, z=0.05, tilt=0.6, stretch=1.06))
    longest, speeds = 0.0, []
    for _ in range(600):
        before = arms[0].edge
        run(arms, goal, 1)
        longest = max(longest, distance(arms))
        speeds.append(np.linalg.norm(arms[0].edge[:3, 3] - before[:3, 3]) / STEP_S)
    assert {arm.control.mode for arm in arms} == {"follow"}
    assert max(speeds) < 0.1
    assert longest <= 0.24 * 1.06 + 1e-6
    for edge, arm in zip(edge_poses(goal.motion.world_from_sheet, 0.24 * 1.06), arms, strict=True):
        assert arm.edge == pytest.approx(edge, abs=1e-7)


def test_the_arm_that_is_ahead_waits_for_the_one_behind() -> None:
    """One arm misses every second cycle, as on a busy computer; both arrive without a fault."""
    arms = pair()
    run(arms, on_time(HOME), 60)
    goal = on_time(sheet_at(0.02, tilt=1.0))
    widest = 0.0
    for cycle in range(900):
        arms[0].cycle(goal, arms[1].as_other())
        if cycle % 2 == 0:
            arms[1].cycle(goal, arms[0].as_other())
        turn = vector_from_rotation(arms[0].edge[:3, :3].T @ arms[1].edge[:3, :3])
        widest = max(widest, float(np.linalg.norm(turn)))
        assert {arm.control.mode for arm in arms} == {"follow"}
    assert widest < 0.12
    for edge, arm in zip(edge_poses(goal.motion.world_from_sheet, 0.24 * 1.02), arms, strict=True):
        assert arm.edge == pytest.approx(edge, abs=1e-6)


poses = st.builds(
    transform_from_rpy,
    st.tuples(st.floats(-0.05, 0.05), st.floats(-0.05, 0.05), st.floats(-0.05, 0.05)),
    st.tuples(st.floats(-1, 1), st.floats(-1, 1), st.floats(-1, 1)),
)


@given(one=poses, other=poses, target=poses)
@examples(100)
def test_never_do_both_arms_wait(one: Floats, other: Floats, target: Floats) -> None:
    shares = (
        compute_sync_factor(one, other, target, left=True),
        compute_sync_factor(other, one, target, left=False),
    )
    assert max(shares) == 1.0


@given(sheet=poses, target=poses, stretch=st.floats(0.5, 1.5))
@examples(100)
def test_arms_that_are_together_do_not_wait_wherever_they_go(
    sheet: Floats, target: Floats, stretch: float
) -> None:
    left, right = edge_poses(sheet, 0.24 * stretch)
    assert (
        compute_sync_factor(left, right, target, left=True)
        == compute_sync_factor(right, left, target, left=False)
        == 1.0
    )


@pytest.mark.parametrize(("lead", "share"), [(0.03, 1.0), (0.085, 0.5), (0.2, 0.0)])
def test_the_leading_arm_slows_by_its_lead_and_the_other_not(lead: float, share: float) -> None:
    target = transform_from_rpy([0.0, 0.0, 0.0], [1.0, 0.0, 0.0])
    ahead = transform_from_rpy([-0.12, 0.0, 0.0], [0.3 + lead, 0.0, 0.0])
    behind = transform_from_rpy([0.12, 0.0, 0.0], [0.3, 0.0, 0.0])
    assert compute_sync_factor(ahead, behind, target, left=True) == pytest.approx(share)
    assert compute_sync_factor(behind, ahead, target, left=False) == 1.0


def test_a_moving_target_is_followed_without_lag() -> None:
    arms = pair()
    run(arms, on_time(HOME), 50)
    rate, at_s = 0.15, 0.0
    for _ in range(200):
        at_s += STEP_S
        motion = replace(sheet_at(tilt=rate * at_s), twist_world=np.array([0, 0, 0, rate, 0, 0]))
        run(arms, on_time(motion), 1)
    left, _ = edge_poses(motion.world_from_sheet, 0.24 * 1.02)
    assert arms[0].edge == pytest.approx(left, abs=1e-8)


def test_a_late_target_is_held_and_a_lost_one_stops() -> None:
    arms = pair()
    moving = replace(sheet_at(), twist_world=np.array([0.0, 0.05, 0.0, 0.0, 0.0, 0.0]))
    run(arms, on_time(HOME), 50)
    for number in range(40):
        shifted = transform_from_rpy([0.0, 0.05 * number * STEP_S, 0.0], [0, 0, 0])
        run(arms, on_time(replace(moving, world_from_sheet=shifted)), 1)
    run(arms, Goal(moving, overdue_s=0.03), 30)
    assert {arm.control.mode for arm in arms} == {"hold"}
    assert all(arm.control.at_rest for arm in arms)
    run(arms, Goal(moving, overdue_s=0.11), 30)
    assert {arm.control.mode for arm in arms} == {"idle"}
    assert all(arm.control.faults == () for arm in arms)


@pytest.mark.parametrize("age_s", [None, 0.2])
def test_without_the_other_arm_nothing_moves(age_s: float | None) -> None:
    arms = pair()
    other = None if age_s is None else arms[1].as_other(age_s)
    for _ in range(20):
        arms[0].cycle(on_time(sheet_at(0.05)), other)
    assert arms[0].control.mode == "idle"
    assert arms[0].command.mode == "idle"
    silent = "waiting for the other arm" if age_s is None else "the other arm is silent"
    assert arms[0].control.reason == silent


def test_the_other_arms_fault_stops_this_one_in_the_same_cycle_and_slackens_the_sheet() -> None:
    arms = pair(sheet_at(stretch=1.06))
    goal = on_time(sheet_at(stretch=1.06))
    run(arms, goal, 30)
    for number in range(60):
        motion = replace(
            sheet_at(0.05 * number * STEP_S, stretch=1.06),
            twist_world=np.array([0.0, 0.05, 0.0, 0.0, 0.0, 0.0]),
        )
        run(arms, on_time(motion), 1)
    arms[0].control.faults = ("drill",)
    arms[0].cycle(goal, arms[1].as_other())
    arms[1].cycle(goal, arms[0].as_other())
    assert [arm.control.mode for arm in arms] == ["stopping", "stopping"]
    run(arms, goal, 2)
    stretched = distance(arms)
    run(arms, goal, 400)
    assert [arm.control.mode for arm in arms] == ["fault", "idle"]
    assert stretched > 0.25
    assert distance(arms) == pytest.approx(0.24, abs=0.0005)
    assert arms[1].control.faults == ()
    assert arms[0].control.reset()
    arms[0].cycle(goal, arms[1].as_other())
    assert arms[0].command.mode == "idle"
    run(arms, goal, 400)
    assert {arm.control.mode for arm in arms} == {"follow"}
    assert distance(arms) == pytest.approx(0.24 * 1.06, abs=1e-6)


def test_the_arm_that_can_still_move_slackens_the_sheet_alone() -> None:
    arms = pair(sheet_at(stretch=1.06))
    run(arms, on_time(sheet_at(stretch=1.06)), 30)
    arms[0].control.on_connection_lost("cable")
    for _ in range(600):
        arms[1].cycle(on_time(HOME), arms[0].as_other())
    assert distance(arms) == pytest.approx(0.24, abs=0.0005)
    assert arms[1].control.mode == "idle"


def test_one_missed_answer_is_forgiven_and_a_second_is_not() -> None:
    arms = pair()
    assert not ArmControl(TIMEOUTS, max_tracking_error_rad=0.1).on_answer_missed("late")
    run(arms, on_time(HOME), 10)
    assert arms[0].control.on_answer_missed("late")
    assert (arms[0].control.mode, arms[0].control.all_faults) == ("hold", ())
    assert not arms[0].control.on_answer_missed("late")
    run(arms, on_time(HOME), 1)
    assert arms[0].control.mode == "follow"
    assert arms[0].control.on_answer_missed("late")


def test_the_estop_latches_until_reset_at_rest() -> None:
    arms = pair()
    goal = on_time(sheet_at(0.05))
    run(arms, goal, 60)
    for arm in arms:
        arm.control.engage_estop("button")
    run(arms, goal, 1)
    assert arms[0].control.mode == "stopping"
    assert not arms[0].control.reset()
    run(arms, goal, 60)
    assert {arm.control.mode for arm in arms} == {"estop"}
    assert arms[0].control.all_faults == ("e-stop: button",)
    place = arms[0].joints
    run(arms, goal, 60)
    assert (arms[0].joints == place).all()
    assert all(arm.control.reset() for arm in arms)
    run(arms, goal, 10)
    assert {arm.control.mode for arm in arms} == {"follow"}


@pytest.mark.parametrize(
    ("motion", "words"),
    [
        (replace(HOME, world_from_sheet=np.diag([1.0, 1.0, -1.0, 1.0])), "not a rigid pose"),
        (replace(HOME, twist_world=np.full(6, np.nan)), "not a rigid pose"),
        (replace(HOME, stretch_ratio=float("inf")), "not a rigid pose"),
    ],
)
def test_a_target_that_makes_no_sense_is_a_fault(motion: SheetMotion, words: str) -> None:
    arms = pair()
    run(arms, on_time(HOME), 10)
    arms[0].cycle(on_time(motion), arms[1].as_other())
    assert words in arms[0].control.faults[0]


@pytest.mark.parametrize(
    ("motion", "words"),
    [
        (sheet_at(z=0.29), "outside the workspace|reach|joint ranges"),
        (sheet_at(stretch=1.2), "mm long, maximum 260.4 mm|the edge force is"),
    ],
)
def test_a_target_past_the_limits_stops_both_within_them(motion: SheetMotion, words: str) -> None:
    arms = pair()
    run(arms, on_time(HOME), 10)
    longest = 0.0
    for _ in range(900):
        run(arms, on_time(motion), 1)
        longest = max(longest, distance(arms))
        for arm in arms:
            place = arm.geometry.world_from_flange(arm.joints)[:3, 3]
            assert (np.abs(place) <= [0.4, 0.3, 0.3]).all()
    assert longest <= 0.24 * 1.09
    assert not {arm.control.mode for arm in arms} & {"follow", "hold"}
    faults = [text for arm in arms for text in arm.control.faults]
    assert any(word in faults[0] for word in words.split("|"))


def test_an_arm_that_does_not_follow_is_a_fault() -> None:
    arms = pair()
    run(arms, on_time(HOME), 10)
    stuck = arms[0].joints
    for _ in range(300):
        command = arms[0].control.step(
            arms[0].geometry, on_time(sheet_at(0.08)), arms[1].as_other(), STEP_S
        )
        arms[0].control.on_measurement(stuck, ())
        if arms[0].control.faults:
            break
    assert "trails its command" in arms[0].control.faults[0]
    assert np.abs(command.joints_rad - stuck).max() < 0.14


def test_an_estop_of_the_other_arm_is_read_from_its_typed_field_not_from_text() -> None:
    arms = pair()
    other = replace(arms[1].as_other(), mode="stopping", faults=("Not-Aus: Taster",))
    assert not other.estopped
    assert not replace(other, faults=("e-stop: button",)).estopped
    assert replace(other, estop_engaged=True).estopped


def test_the_other_arms_poses_are_checked_once_per_state(monkeypatch: pytest.MonkeyPatch) -> None:
    checked: list[Floats] = []

    def count(pose: Floats) -> bool:
        checked.append(pose)
        return is_rigid(pose)

    monkeypatch.setattr(other_arm, "is_rigid", count)
    arms = pair()
    other = arms[1].as_other()
    arms[0].cycle(on_time(HOME), other)
    assert other.invalid_reason is None
    assert len(checked) == 2


def test_only_the_typed_watchdog_fault_restarts_the_arm(monkeypatch: pytest.MonkeyPatch) -> None:
    for fault in ArmFault:
        monkeypatch.setitem(FAULT_TEXTS, fault, "watchdog: no command")
        arms = pair()
        run(arms, on_time(HOME), 10)
        arms[0].control.on_measurement(arms[0].joints, (fault,))
        assert (arms[0].control.faults == ()) == (fault is ArmFault.WATCHDOG)


def test_faults_of_the_arm_are_latched_but_its_watchdog_starts_again() -> None:
    arms = pair()
    run(arms, on_time(HOME), 10)
    arms[0].control.on_measurement(arms[0].joints, (ArmFault.WATCHDOG,))
    assert not arms[0].control.faults
    arms[0].cycle(on_time(HOME), arms[1].as_other())
    assert arms[0].command.mode == "idle"
    arms[0].control.on_measurement(arms[0].joints, (ArmFault.SERVO,))
    assert list(arms[0].control.faults) == ["arm: servo fault"]


poses = st.tuples(*[st.floats(-0.15, 0.15)] * 3, *[st.floats(-0.8, 0.8)] * 3)


@settings(max_examples=12, deadline=None)
@given(
    targets=st.lists(
        st.tuples(poses, st.floats(0.8, 1.3), st.integers(1, 40), st.floats(-0.02, 0.12)),
        min_size=1,
        max_size=6,
    ),
    jitter=st.lists(st.floats(0.5, 2.0), min_size=1, max_size=5),
)
def test_no_target_leads_to_a_command_out_of_bounds(
    targets: list[tuple[tuple[float, ...], float, int, float]], jitter: list[float]
) -> None:
    arms = pair()
    number = 0
    for pose, stretch, cycles, overdue_s in targets:
        world_from_sheet = transform_from_rpy(pose[:3], pose[3:])
        twist = twist_between(np.eye(4), world_from_sheet, 0.3)
        goal = Goal(SheetMotion(world_from_sheet, twist, stretch, 0.0), overdue_s)
        for _ in range(cycles):
            number += 1
            step_s = STEP_S * jitter[number % len(jitter)]
            for arm, other in (arms, arms[::-1]):
                before = arm.joints
                tool = arm.geometry.tool_points(before)
                arm.cycle(goal, other.as_other(), step_s)
                limits = arm.geometry.joint_limits
                assert np.isfinite(arm.joints).all()
                assert (arm.joints >= limits.min_rad - 1e-9).all()
                assert (arm.joints <= limits.max_rad + 1e-9).all()
                speed = np.abs(arm.joints - before) / step_s
                assert (speed <= limits.speed_rad_per_s * (1 + 1e-6)).all()
                moved = np.linalg.norm(arm.geometry.tool_points(arm.joints) - tool, axis=1)
                assert moved.max() / step_s <= 0.25 * (1 + 1e-6)
            assert distance(arms) <= 0.24 * 1.09


def test_the_scene_is_reachable_over_its_strokes() -> None:
    radius = SCENE.object.geometry.radius_m
    for side in ("left", "right"):
        geometry = ArmGeometry(SCENE, side)
        joints = GUESS
        for begin_deg in (-60, 0, 60):
            for angle_deg in range(-60, 61, 5):
                angle = np.radians(angle_deg)
                y = radius * np.radians(angle_deg - begin_deg)
                if abs(y) > SCENE.sheet.usable_half_height_m:
                    continue
                pose = transform_from_rpy([0.0, 0.0, -radius], [-angle, 0.0, 0.0])
                pose[:3, 3] += radius * pose[:3, 2] - y * pose[:3, 1]
                for stretch in (1.0, 1.08):
                    motion = replace(HOME, world_from_sheet=pose, stretch_ratio=stretch)
                    joints = geometry.joints_for_sheet(motion, joints)
                    assert abs(joints[4]) > np.radians(30.0)
                    assert (joints > geometry.joint_limits.min_rad).all()
                    assert (joints < geometry.joint_limits.max_rad).all()


async def test_without_a_scene_the_node_waits() -> None:
    sent: list[object] = []
    node = ArmBridge(
        ArmBridgeParameters(side="left"),
        name="arm_left_bridge",
        clock=VirtualClock(),
        send=lambda topic, message, header: sent.append(message),
        topics={"arm": "arm_left", "other_arm": "arm_right"},
    )
    await node.setup()
    await node.cycle()
    assert [one.code for one in node.notes] == [NoteCode.WAITING_FOR_SCENE]
    assert not any(isinstance(message, ArmState) for message in sent)
    await node.close()


def test_without_a_connection_the_last_measured_pose_is_kept_and_none_is_made_up() -> None:
    control = ArmControl(TIMEOUTS, max_tracking_error_rad=0.1)
    control.on_connection_lost("cable")
    assert control.last_measured_rad is None
    control.on_measurement(GUESS, ())
    control.on_connection_lost("cable")
    assert control.last_measured_rad is not None
    assert (control.last_measured_rad == GUESS).all()


def test_a_reset_from_before_the_stop_does_not_clear_it() -> None:
    control = ArmControl(TIMEOUTS, max_tracking_error_rad=0.1)
    stop, reset = EStop(engaged=True, reason="hand"), EStop(engaged=False, reason="")
    assert control.on_estop(stop, 200, 200) is None
    assert control.on_estop(reset, 100, 210) == "it is older than the stop"
    assert control.estop_reason == "hand"
    assert control.on_estop(reset, 300, 310) is None
    assert control.estop_reason is None


def test_latched_messages_of_several_writers_may_come_in_any_order() -> None:
    """For a restarted bridge the newest stop counts, independent of the order of reception."""
    control = ArmControl(TIMEOUTS, max_tracking_error_rad=0.1)
    stop, reset = EStop(engaged=True, reason="hand"), EStop(engaged=False, reason="")
    assert control.on_estop(stop, 30, 100) is None
    assert control.on_estop(stop, 5, 100) is None
    assert control.on_estop(reset, 20, 100) == "it is older than the stop"
    assert control.estop_reason == "hand"


def test_a_stop_whose_stamp_is_doubtful_or_of_the_future_can_be_reset_afterwards() -> None:
    stop, reset = EStop(engaged=True, reason="hand"), EStop(engaged=False, reason="")
    for stamp_ns, doubt in ((10_000, ""), (5, "clock main is not measured")):
        control = ArmControl(TIMEOUTS, max_tracking_error_rad=0.1)
        assert control.on_estop(stop, stamp_ns, 100, doubt) is None
        assert control.on_estop(reset, 99, 101) == "it is older than the stop"
        assert control.on_estop(reset, 102, 103) is None


def test_a_sheet_that_seems_impossibly_long_is_not_relaxed() -> None:
    arms = pair()
    run(arms, on_time(sheet_at(stretch=1.05)), 300)
    far = arms[0].as_other()
    moved = far.world_from_flange.copy()
    moved[0, 3] -= 0.06
    phantom = replace(far, world_from_flange=moved, mode="fault", faults=("something",))
    before = arms[1].edge
    for _ in range(200):
        arms[1].cycle(on_time(sheet_at(stretch=1.05)), phantom)
    assert arms[1].edge == pytest.approx(before, abs=1e-4)
    assert "measured length of the sheet is not possible" in arms[1].control.reason


def test_a_target_that_arrived_just_now_but_is_old_is_overdue() -> None:
    fresh = extrapolate_goal(HOME, 0.02, -0.01, max_extrapolation_s=0.06)
    old = extrapolate_goal(HOME, 5.0, -0.01, max_extrapolation_s=0.06)
    assert fresh.overdue_s == -0.01
    assert old.overdue_s == pytest.approx(4.94)
    arms = pair()
    run(arms, on_time(HOME), 60)
    run(arms, Goal(sheet_at(0.02), old.overdue_s), 60)
    assert {arm.control.mode for arm in arms} == {"idle"}


def test_a_new_scene_under_a_motion_brings_both_arms_to_rest_first() -> None:
    arms = pair()
    run(arms, on_time(HOME), 60)
    run(arms, on_time(sheet_at(0.03)), 10)
    for arm in arms:
        arm.control.on_scene_changed()
    run(arms, on_time(sheet_at(0.03)), 1)
    assert {arm.control.mode for arm in arms} <= {"stopping", "idle"}
    assert not any(arm.control.faults for arm in arms)
    run(arms, on_time(sheet_at(0.03)), 400)
    assert {arm.control.mode for arm in arms} == {"follow"}
    for edge, arm in zip(
        edge_poses(sheet_at(0.03).world_from_sheet, 0.24 * 1.02), arms, strict=True
    ):
        assert arm.edge == pytest.approx(edge, abs=1e-6)


def test_joints_on_another_branch_are_rejected(monkeypatch: pytest.MonkeyPatch) -> None:
    arms = pair()
    run(arms, on_time(HOME), 60)
    monkeypatch.setattr(
        arms[0].geometry.__class__,
        "joints_for_sheet",
        lambda self, motion, present: present + np.array([0.0, 0.0, 0.0, 3.0, 0.0, -3.0]),
    )
    arms[0].cycle(on_time(HOME), arms[1].as_other())
    assert "jump" in arms[0].control.faults[0]


def test_when_the_other_arm_was_stopped_this_one_rests_and_keeps_the_sheet() -> None:
    arms = pair(sheet_at(stretch=1.06))
    run(arms, on_time(sheet_at(stretch=1.06)), 30)
    arms[0].control.engage_estop("button")
    run(arms, on_time(sheet_at(0.05, stretch=1.06)), 60)
    assert [arm.control.mode for arm in arms] == ["estop", "idle"]
    assert arms[1].control.reason == "other arm: e-stop"
    joints = arms[1].joints
    arms[1].control.faults = ("drill",)
    run(arms, on_time(sheet_at(stretch=1.06)), 60)
    assert arms[1].control.mode == "fault"
    assert (arms[1].joints == joints).all()


def test_an_age_that_is_no_number_stops() -> None:
    for overdue_s, age_s in ((float("nan"), 0.005), (0.0, float("nan"))):
        arms = pair()
        run(arms, on_time(HOME), 60)
        for _ in range(60):
            arms[0].cycle(Goal(sheet_at(0.05), overdue_s), arms[1].as_other(age_s))
        assert arms[0].control.mode == "idle"


def test_an_other_arm_with_an_invalid_pose_prevents_motion() -> None:
    arms = pair()
    run(arms, on_time(HOME), 60)
    other = arms[1].as_other()
    nowhere = np.full((4, 4), np.nan)
    for broken in (
        replace(other, world_from_flange=nowhere),
        replace(other, world_from_flange_commanded=nowhere),
    ):
        run(arms, on_time(HOME), 30)
        before = arms[0].joints
        for _ in range(20):
            arms[0].cycle(on_time(sheet_at(0.05)), broken)
        reason = "state of the other arm: its flange is not a rigid pose"
        assert arms[0].control.reason == reason
        assert arms[0].joints == pytest.approx(before, abs=1e-3)


def test_measured_flanges_outside_the_workspace_or_too_near_are_faults() -> None:
    for shift, words in (((0.0, 0.4, 0.0), "outside the workspace"), ((0.2, 0, 0), "mm apart")):
        arms = pair()
        run(arms, on_time(HOME), 60)
        control, geometry = arms[0].control, arms[0].geometry
        moved = geometry.world_from_flange(arms[0].joints)
        moved[:3, 3] += shift
        geometry.world_from_flange = lambda joints, moved=moved: moved
        control._check_measurement(arms[1].as_other(), arms[0].joints)
        assert control.faults
        assert control.faults[0].startswith("measured: ")
        assert words in control.faults[0]


def test_an_arm_that_does_not_let_go_is_not_led_on() -> None:
    """The command of an arm that freezes while it relaxes stops at the largest tracking error."""
    arms = pair(sheet_at(stretch=1.08))
    run(arms, on_time(sheet_at(stretch=1.08)), 30)
    arms[0].control.faults = ("drill",)
    arms[0].control._max_tracking_error_rad = 0.01
    stuck = arms[0].joints
    for _ in range(600):
        arms[0].control.step(arms[0].geometry, on_time(HOME), arms[1].as_other(), STEP_S)
        arms[0].control.on_measurement(stuck, ())
        assert np.abs(arms[0].control.commanded_rad - stuck).max() < 0.015
    assert arms[0].control.mode == "fault"


def test_only_a_reset_clears_a_fault() -> None:
    arms = pair()
    run(arms, on_time(HOME), 10)
    arms[0].control.faults = ("drill",)
    run(arms, on_time(HOME), 200)
    for event in (
        lambda: arms[0].control.on_connection_lost("cable"),
        lambda: arms[0].control.on_measurement(arms[0].joints, ()),
        arms[0].control.on_scene_changed,
        lambda: run(arms, None, 60),
        lambda: run(arms, on_time(HOME), 60),
    ):
        event()
        assert arms[0].control.faults == ("drill",)
    assert arms[0].control.reset()
    assert arms[0].control.faults == ()


def test_poses_that_are_kept_for_a_cycle_are_those_of_the_joints_asked_for() -> None:
    geometry, joints = ArmGeometry(SCENE, "left"), GUESS.copy()
    first = geometry.world_from_flange(joints)
    joints[1] += 0.1
    second = geometry.world_from_flange(joints)
    assert second == pytest.approx(geometry.world_from_base @ forward(joints), abs=1e-15)
    second[:] = np.nan
    assert geometry.world_from_flange(GUESS) == pytest.approx(first, abs=0.0)
    assert np.isfinite(geometry.world_from_flange(joints)).all()


def test_a_slack_sheet_is_held_until_the_flanges_come_too_near() -> None:
    arms = pair()
    run(arms, on_time(sheet_at(stretch=0.97)), 400)
    assert {arm.control.mode for arm in arms} == {"follow"}
    assert distance(arms) == pytest.approx(0.97 * 0.24, abs=1e-6)
    other = arms[1].as_other()
    assert arms[0].geometry.sheet_state(arms[0].joints, other.world_from_flange)[1] == 0.0
    run(arms, on_time(sheet_at(stretch=0.3)), 1200)
    assert not {arm.control.mode for arm in arms} & {"follow", "hold"}
    assert any("flanges" in text for arm in arms for text in arm.control.faults)
    apart = [arm.geometry.world_from_flange(arm.joints)[:3, 3] for arm in arms]
    assert np.linalg.norm(apart[0] - apart[1]) >= SCENE.arms.min_distance_m - 1e-4


@pytest.mark.parametrize(
    ("shift", "turn", "words"),
    [
        ((0.0, 0.0, 0.0), (0.25, 0.0, 0.0), "the edges are rotated by 14.3 degrees"),
        ((0.0, 0.06, 0.0), (0.0, 0.0, 0.0), "the edge is skewed by"),
        ((0.03, 0.0, 0.0), (0.0, 0.0, 0.0), "the sheet is 274.8 mm long, maximum 260.4 mm"),
        ((0.0154, 0.0, 0.0), (0.0, 0.0, 0.0), "the edge force is 20"),
    ],
)
def test_a_sheet_measured_twisted_or_too_taut_stops_both_at_once(
    shift: tuple[float, ...], turn: tuple[float, ...], words: str
) -> None:
    """Both bridges detect that the other arm was moved off its command."""
    arms = pair()
    run(arms, on_time(HOME), 60)
    moved = transform_from_rpy(shift, turn)
    edge = arms[1].geometry.world_from_edge(arms[1].joints)
    dragged = edge.copy()
    dragged[:3, :3], dragged[:3, 3] = moved[:3, :3] @ edge[:3, :3], edge[:3, 3] + moved[:3, 3]
    flange = dragged @ np.linalg.inv(arms[1].geometry.flange_from_edge)
    other = replace(arms[1].as_other(), world_from_flange=flange)
    arms[0].cycle(on_time(HOME), other)
    assert arms[0].control.mode != "follow"
    assert arms[0].control.faults[0].startswith(f"measured: {words}")
    arms[1].cycle(on_time(HOME), arms[0].as_other())
    assert arms[1].control.reason.startswith("other arm: measured: ")
    assert arms[1].control.mode != "follow"


def lifted(y: float, aside_rad: float) -> SheetMotion:
    """Return the sheet yawed at a height; at 0.16 m both forearms are level, so J5 = 0."""
    pose = transform_from_rpy([0.0, y, 0.0], [0.0, aside_rad, 0.0])
    return replace(HOME, world_from_sheet=pose)


@pytest.mark.parametrize(
    ("aside_rad", "through", "ends"),
    [(0.0, True, ""), (0.005, True, ""), (0.02, False, "jump"), (0.05, False, "")],
)
def test_past_the_wrists_singularity_both_continue_together_or_both_stop(
    aside_rad: float, *, through: bool, ends: str
) -> None:
    """J5 passes zero, or passes near it, without a fast joint or a twisted sheet."""
    arms, speed = pair(lifted(0.1, aside_rad)), 0.05
    run(arms, on_time(lifted(0.1, aside_rad)), 60)
    fifth, widest = [], 0.0
    for number in range(int(0.0645 / speed / STEP_S)):
        motion = lifted(0.1 + speed * number * STEP_S, aside_rad)
        twist = np.array([0.0, speed, 0.0, 0.0, 0.0, 0.0])
        before = [arm.joints for arm in arms]
        run(arms, on_time(replace(motion, twist_world=twist)), 1)
        for arm, joints in zip(arms, before, strict=True):
            rates = np.abs(arm.joints - joints) / STEP_S
            assert (rates <= arm.geometry.joint_limits.speed_rad_per_s * (1 + 1e-9)).all()
        turn = vector_from_rotation(arms[0].edge[:3, :3].T @ arms[1].edge[:3, :3])
        widest = max(widest, float(np.linalg.norm(turn)))
        fifth.append([float(arm.joints[4]) for arm in arms])
    assert widest <= arms[0].geometry.sheet_limits.max_twist_rad
    assert np.degrees(np.abs(fifth).min()) < 6.0
    assert (np.sign(fifth[0]) == -np.sign(fifth[-1])).all() == through
    if ends:
        assert {ends in arm.control.reason for arm in arms} == {True}
        assert not {arm.control.mode for arm in arms} & {"follow", "hold"}
    else:
        assert {arm.control.mode for arm in arms} == {"follow"}
