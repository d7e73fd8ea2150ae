"""Test that false measurements (frozen, lagging, offset, swapped, replayed) cause no fast motion.

The arms are simulated joint servos of the twin; their tool speed comes from its kinematics.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from flexsheet.messages.types import Side
from flexsheet.nodes.arm_bridge.control import ArmControl, Command
from flexsheet.nodes.arm_bridge.geometry import ArmGeometry
from flexsheet.nodes.arm_bridge.goal import Goal
from flexsheet.nodes.arm_bridge.limiter import MAX_TRAVEL_STEP_S, JointLimits, bound_step
from flexsheet.nodes.arm_bridge.link import MAX_UNCHANGED_S, CounterMonitor, Freshness
from flexsheet.nodes.arm_bridge.other_arm import OtherArm
from flexsheet.nodes.arm_bridge.standstill import (
    MAX_RESTART_SHIFT_M,
    STANDSTILL_COUNT,
    StandstillMonitor,
)
from flexsheet.nodes.models.rigid import transform_from_rpy
from flexsheet.nodes.twin.arms import (
    Servo,
)
from tests.arm_states import as_other_arm, connect_control
from tests.examples import examples, long_except
from tests.rv_1a import (
    JOINT_SPEED_RAD_PER_S,
    SPEED_RAD_PER_S,
)
from tests.rv_1a import (
    twin_forward as forward,
)
from tests.test_arm_control import GUESS, HOME, SCENE, STEP_S, TIMEOUTS, on_time, sheet_at

Floats = NDArray[np.float64]
NOISE_RAD = 5e-6
MAX_TOOL_SPEED = SCENE.arms.max_tool_speed_m_per_s
SIDES: tuple[Side, Side] = ("left", "right")
Reading = Callable[[Floats], Floats]


@dataclass
class ServoArm:
    """Simulate a controlled arm with servos; `reading` falsifies its measured joints."""

    geometry: ArmGeometry
    control: ArmControl
    servo: Servo
    random: np.random.Generator
    reading: Reading = field(default=lambda joints: joints)
    command: Command = field(default_factory=lambda: Command("idle", np.zeros(6)))
    stuck: bool = False
    reported: Floats = field(default_factory=lambda: np.zeros(6))
    max_tool_speed: float = 0.0
    max_step_ratio: float = 0.0
    freshness: Freshness = Freshness.FRESH

    @classmethod
    def holding(cls, side: Side) -> ServoArm:
        geometry = ArmGeometry(SCENE, side)
        joints = geometry.joints_for_sheet(HOME, GUESS)
        control = ArmControl(TIMEOUTS, max_tracking_error_rad=0.12, auto_arming=True)
        arm = cls(geometry, control, Servo(joints, 0.025), np.random.default_rng(len(side)))
        for _ in range(STANDSTILL_COUNT):
            arm.measure()
        connect_control(control)
        return arm

    def measure(self) -> None:
        noisy = self.servo.joints_rad + NOISE_RAD * self.random.standard_normal(6)
        self.reported = self.reading(noisy)
        self.control.on_measurement(self.reported, (), self.freshness)

    def tool_points(self) -> Floats:
        """Return both ends of the edge and the flange (3, 3) m, by the simulator's kinematics."""
        clamp = SCENE.arms.left.flange_from_edge
        edge = transform_from_rpy(clamp.position_m, clamp.rpy_rad)
        half = 0.5 * SCENE.sheet.height_m
        points = np.vstack([edge[:3, 3] + half * edge[:3, 1], edge[:3, 3] - half * edge[:3, 1]])
        pose = forward(self.servo.joints_rad)
        return np.vstack([points @ pose[:3, :3].T + pose[:3, 3], pose[:3, 3]])

    def cycle(self, goal: Goal | None, other: OtherArm | None) -> None:
        held, was_moving = self.command.joints_rad, self.command.mode == "move"
        self.command = self.control.step(self.geometry, goal, other, STEP_S)
        if self.control.pending_check is not None:
            self.control.on_path_result(self.control.pending_check, None)
        if was_moving and self.command.mode == "move":
            step = np.abs(self.command.joints_rad - held)
            ratio = float((step / (SPEED_RAD_PER_S * STEP_S)).max())
            self.max_step_ratio = max(self.max_step_ratio, ratio)
        points = self.tool_points()
        for _ in range(0 if self.stuck else 4):
            braking = self.command.mode != "move"
            self.servo.advance(self.command.joints_rad, STEP_S / 4, braking=braking)
            before_points, points = points, self.tool_points()
            speed = np.linalg.norm(points - before_points, axis=1).max() / (STEP_S / 4)
            self.max_tool_speed = max(self.max_tool_speed, float(speed))
        self.measure()

    def as_other(self) -> OtherArm:
        measured = self.control.measured_rad
        assert measured is not None
        return as_other_arm(self.control, self.geometry, measured)


Arms = tuple[ServoArm, ServoArm]


def servo_pair() -> Arms:
    return ServoArm.holding("left"), ServoArm.holding("right")


def stroke_goal(time_s: float) -> Goal:
    """Return the sheet's motion by +-50 mm at 0.4 Hz."""
    rate = 2.0 * np.pi * 0.4
    twist = np.array([0.0, 0.05 * rate * np.cos(rate * time_s), 0.0, 0.0, 0.0, 0.0])
    motion = replace(sheet_at(0.05 * np.sin(rate * time_s)), twist_world=twist)
    return on_time(motion)


def stroke(arms: Arms, seconds: float, *, begin_s: float = 0.0) -> float:
    """Run both arms along the stroke; return the time at its end."""
    cycles = round(seconds / STEP_S)
    for number in range(cycles):
        goal = stroke_goal(begin_s + number * STEP_S)
        left, right = (arm.as_other() for arm in arms)
        arms[0].cycle(goal, right)
        arms[1].cycle(goal, left)
    return begin_s + cycles * STEP_S


def frozen(arm: ServoArm) -> Reading:
    """Repeat the last measurement."""
    joints = arm.reported.copy()
    return lambda _: joints


def offset(arm: ServoArm) -> Reading:
    return lambda joints: joints + np.array([0.04, 0.0, -0.04, 0.0, 0.03, 0.0])


def swapped(arm: ServoArm) -> Reading:
    return lambda joints: joints[[1, 0, 2, 5, 4, 3]]


def lagging(arm: ServoArm) -> Reading:
    """Delay measurements by 0.3 s."""
    history = [arm.reported.copy()] * 42

    def late(joints: Floats) -> Floats:
        history.append(joints)
        return history.pop(0)

    return late


READINGS = [frozen, offset, swapped, lagging]


def assert_no_leap(arms: Arms) -> None:
    for arm in arms:
        assert arm.max_step_ratio <= 1.0
        assert arm.max_tool_speed <= MAX_TOOL_SPEED


@pytest.mark.parametrize("reading", long_except(READINGS, offset, lagging))
def test_no_arm_leaps_by_a_false_measurement(reading: Callable[[ServoArm], Reading]) -> None:
    """The same holds after the fault, after a reset with a false measurement, and later."""
    arms = servo_pair()
    time_s = stroke(arms, 1.2)
    assert {arm.control.mode for arm in arms} == {"follow"}
    arms[0].reading = reading(arms[0])
    time_s = stroke(arms, 1.0, begin_s=time_s)
    assert_no_leap(arms)
    for _ in range(2):
        for arm in arms:
            if arm.control.faults:
                arm.control.reset()
        time_s = stroke(arms, 1.0, begin_s=time_s)
        assert_no_leap(arms)
    arms[0].reading = lambda joints: joints
    time_s = stroke(arms, 1.0, begin_s=time_s)
    for arm in arms:
        assert not arm.control.faults or arm.control.reset()
    stroke(arms, 1.5, begin_s=time_s)
    assert_no_leap(arms)
    assert {arm.control.mode for arm in arms} == {"follow"}, [arm.control.reason for arm in arms]


def test_a_frozen_measurement_is_a_named_fault() -> None:
    arms = servo_pair()
    time_s = stroke(arms, 1.2)
    arms[0].reading = frozen(arms[0])
    time_s = stroke(arms, 1.0, begin_s=time_s)
    assert "trails its command" in arms[0].control.faults[0]
    assert arms[0].control.reset()
    stroke(arms, 1.0, begin_s=time_s)
    assert "measured joint angles that are frozen" in arms[0].control.reason
    assert arms[0].command.mode != "move"


def test_an_arm_that_is_really_frozen_lets_the_sheet_go_by_the_other_arm() -> None:
    arms = servo_pair()
    goal = on_time(sheet_at(stretch=1.06))
    for _ in range(300):
        left, right = (arm.as_other() for arm in arms)
        arms[0].cycle(goal, right)
        arms[1].cycle(goal, left)
    time_s = 0.0
    arms[0].stuck = True
    modes = set()
    for _ in range(700):
        time_s += STEP_S
        left, right = (arm.as_other() for arm in arms)
        tilted = on_time(sheet_at(0.2 * time_s, stretch=1.06))
        arms[0].cycle(tilted, right)
        arms[1].cycle(tilted, left)
        modes.add(arms[1].control.mode)
    assert "relax" in modes
    edges = [arm.geometry.world_from_edge(arm.servo.joints_rad) for arm in arms]
    assert np.linalg.norm(edges[0][:3, 3] - edges[1][:3, 3]) <= 0.2405
    assert arms[1].max_tool_speed <= MAX_TOOL_SPEED


@pytest.mark.parametrize(
    ("freshness", "words"),
    [(Freshness.STALLED, "stand still"), (Freshness.REVERSED, "run backwards")],
)
def test_a_measurement_that_is_not_fresh_is_not_believed(freshness: Freshness, words: str) -> None:
    arms = servo_pair()
    time_s = stroke(arms, 1.2)
    believed = arms[0].control.measured_rad
    arms[0].freshness, arms[0].reading = freshness, lambda joints: joints + 0.3
    stroke(arms, STEP_S, begin_s=time_s)
    assert words in arms[0].control.faults[0]
    assert arms[0].control.measured_rad is believed
    stroke(arms, 1.0, begin_s=time_s)
    assert arms[0].control.mode == "fault"
    assert arms[1].control.mode in ("idle", "relax")
    assert_no_leap(arms)


def test_nothing_starts_before_fresh_measurements_confirm_a_standstill() -> None:
    for freshness in (Freshness.FIRST, Freshness.REPEATED):
        arms = servo_pair()
        arms[0].control.on_connection_lost("cable")
        arms[0].control.on_measurement(arms[0].reported, (), Freshness.FIRST)
        arms[0].freshness = freshness
        stroke(arms, 0.5)
        assert arms[0].control.reason == "waits for the arm to stand still"
        assert arms[0].command.mode != "move"
    arms[0].freshness = Freshness.FRESH
    stroke(arms, 0.5)
    assert arms[0].control.mode == "follow"


# Counters.

MS = 10**6


def classify(
    monitor: CounterMonitor, counters: tuple[int, ...], at_ns: int, *, may_restart: bool
) -> Freshness:
    """Classify an answer that arrives at once."""
    return monitor.classify(counters, sent_ns=at_ns, received_ns=at_ns, may_restart=may_restart)


def test_counters_of_answers_that_came_late_are_not_stalled() -> None:
    """Two answers of one cycle: one arrives 0.1 s late, the other at once or late."""
    for received_ns in (101 * MS, 300 * MS):
        monitor = CounterMonitor()
        monitor.classify((5, 6), sent_ns=0, received_ns=100 * MS, may_restart=False)
        found = monitor.classify(
            (6, 6), sent_ns=100 * MS, received_ns=received_ns, may_restart=False
        )
        assert found == Freshness.FRESH


def test_counters_that_continue_are_fresh_also_over_their_end() -> None:
    monitor, found = CounterMonitor(), []
    for number in range(6):
        counters = ((2**32 - 30_000 + 10_000 * number) % 2**32, number)
        found.append(classify(monitor, counters, number * 10 * MS, may_restart=False))
    assert found == [Freshness.FIRST, *[Freshness.FRESH] * 5]


def test_counters_that_stand_still_are_repeated_then_stalled() -> None:
    for counters in ((5, 6), (5, 7)):
        monitor = CounterMonitor()
        assert classify(monitor, (5, 6), 0, may_restart=True) == Freshness.FIRST
        assert classify(monitor, counters, 40 * MS, may_restart=True) == Freshness.REPEATED
        late_ns = round(MAX_UNCHANGED_S * 1e9) + MS
        assert classify(monitor, counters, late_ns, may_restart=True) == Freshness.STALLED
        assert classify(monitor, (9, 9), late_ns + MS, may_restart=True) == Freshness.FRESH


def test_a_measurement_time_that_continues_without_cycles_is_stalled_too() -> None:
    monitor = CounterMonitor()
    found = [
        classify(monitor, (number, 3), number * 10 * MS, may_restart=False) for number in range(8)
    ]
    assert found[:6] == [Freshness.FIRST, *[Freshness.FRESH] * 5]
    assert found[6:] == [Freshness.STALLED] * 2


def test_counters_that_run_backwards_are_a_restart_only_where_one_is_possible() -> None:
    for counters in ((4, 7), (6, 5)):
        monitor = CounterMonitor()
        classify(monitor, (5, 6), 0, may_restart=True)
        assert classify(monitor, counters, MS, may_restart=False) == Freshness.REVERSED
        assert classify(monitor, counters, MS, may_restart=True) == Freshness.FIRST


# Standstill.


def test_a_standstill_takes_fresh_unchanged_measurements_after_the_last_motion() -> None:
    monitor = StandstillMonitor()
    for number in range(STANDSTILL_COUNT):
        assert not monitor.is_standing(at_command=True)
        monitor.on_measurement(GUESS + number * 1e-6, Freshness.FRESH)
    assert monitor.is_standing(at_command=True)
    assert monitor.is_alive
    monitor.on_command(GUESS, np.full(6, 0.1), STEP_S)
    assert not monitor.is_standing(at_command=True)
    for number in range(3 * STANDSTILL_COUNT):
        monitor.on_measurement(GUESS + number * 0.6e-3, Freshness.FRESH)
        assert not monitor.is_standing(at_command=True)
    for freshness in (Freshness.REPEATED, Freshness.STALLED, Freshness.REVERSED, Freshness.FIRST):
        for _ in range(3 * STANDSTILL_COUNT):
            monitor.on_measurement(GUESS, freshness)
        assert not monitor.is_standing(at_command=True)
    for _ in range(STANDSTILL_COUNT):
        monitor.on_measurement(GUESS, Freshness.FRESH)
    assert monitor.is_standing(at_command=True)
    assert not monitor.is_alive, "exactly the same each time"


def test_a_jump_is_a_change_off_the_commanded_path_that_is_too_fast() -> None:
    def after(*readings: float, commands: int = 40) -> bool:
        """Move joint 1 at 0.5 rad/s and report it."""
        monitor = StandstillMonitor()
        velocity = np.array([0.5, 0.0, 0.0, 0.0, 0.0, 0.0])
        joints = np.zeros(6)
        for _ in range(commands):
            joints = joints + velocity * STEP_S
            monitor.on_command(joints, velocity, STEP_S)
            monitor.on_measurement(joints - 0.025 * velocity, Freshness.FRESH)
        for reading in readings:
            monitor.on_command(joints, np.zeros(6), STEP_S)
            monitor.on_measurement(np.array([joints[0] + reading, 0, 0, 0, 0, 0]), Freshness.FRESH)
        return monitor.has_jumped

    assert not after(0.0, 0.0), "catches up with its command"
    assert after(0.04), "leads its command"
    assert after(-0.2), "far behind all recent commands"
    assert not after(*np.linspace(-0.0125, 0.05, 60)), "moved by hand"


joints_in_range = st.tuples(*[st.floats(0.02, 0.98)] * 6).map(
    lambda part: LIMITS.min_rad + np.array(part) * (LIMITS.max_rad - LIMITS.min_rad)
)
GEOMETRY = ArmGeometry(SCENE, "left")
LIMITS: JointLimits = GEOMETRY.joint_limits


@examples(100)
@given(joints=joints_in_range, step=st.tuples(*[st.floats(-0.02, 0.02)] * 6))
def test_the_edge_shifts_by_no_more_than_the_bound(joints: Floats, step: tuple[float, ...]) -> None:
    moved = joints + np.array(step)
    shift = np.linalg.norm(GEOMETRY.tool_points(moved) - GEOMETRY.tool_points(joints), axis=1)
    assert shift.max() <= GEOMETRY.bound_edge_shift_m(joints, moved) + 1e-12


def test_a_restart_within_its_tolerance_is_slower_than_the_tool_may_be() -> None:
    random = np.random.default_rng(3)
    for _ in range(40):
        arm = ServoArm.holding("left")
        step = random.choice([-1.0, 1.0], 6) * random.dirichlet(np.ones(6)) / GEOMETRY._levers_m
        arm.command = Command("move", arm.servo.joints_rad + MAX_RESTART_SHIFT_M * step)
        arm.servo.lag_s = 0.015
        for _ in range(100):
            points = arm.tool_points()
            arm.servo.advance(arm.command.joints_rad, 1e-3)
            speed = np.linalg.norm(arm.tool_points() - points, axis=1).max() / 1e-3
            assert speed <= MAX_TOOL_SPEED


any_number = st.one_of(st.floats(-4.0, 4.0), st.sampled_from([np.nan, np.inf, -np.inf, 1e300]))


@examples(100)
@given(joints=joints_in_range, wanted=st.tuples(*[any_number] * 6), step_s=st.floats(1e-4, 0.1))
def test_a_bounded_step_keeps_joint_speeds_and_tool_speed(
    joints: Floats, wanted: tuple[float, ...], step_s: float
) -> None:
    found = bound_step(
        joints,
        np.array(wanted),
        limits=LIMITS,
        step_s=step_s,
    )
    assert (np.abs(found - joints) <= JOINT_SPEED_RAD_PER_S * step_s).all()
    shift = np.linalg.norm(GEOMETRY.tool_points(found) - GEOMETRY.tool_points(joints), axis=1)
    furthest = GEOMETRY.max_tool_speed * min(step_s, MAX_TRAVEL_STEP_S)
    assert shift.max() <= furthest * (1.0 + 1e-6) + 1e-12


@pytest.mark.parametrize("leap", [0.5, np.nan])
def test_no_decision_commands_a_leap(leap: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """`_send` bounds the command of a defective decision."""
    arms = servo_pair()
    time_s = stroke(arms, 1.2)
    control, geometry = arms[0].control, arms[0].geometry
    monkeypatch.setattr(control, "_limit_velocity", lambda *_: np.full(6, leap / STEP_S))
    monkeypatch.setattr(geometry, "sheet_limits", replace(geometry.sheet_limits))
    monkeypatch.setattr(geometry, "check_limits", lambda *_, **__: None)
    before = arms[0].command.joints_rad
    arms[0].cycle(stroke_goal(time_s), arms[1].as_other())
    assert control.faults == ("commanded: a step beyond the joint or tool speed",)
    step = arms[0].command.joints_rad - before
    assert (np.abs(step) <= JOINT_SPEED_RAD_PER_S * STEP_S).all()
    monkeypatch.undo()
    stroke(arms, 1.0, begin_s=time_s)
    assert control.mode == "fault"
    assert_no_leap(arms)
