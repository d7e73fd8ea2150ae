"""Verify that no command leads an arm out of its limits, with random and adversarial commands.

    python -m benchmarks.limiter [--commands 1000000] [--seed 0]

Nine commands in ten are joint goals: NaN, jumps, edges of the range, alternating extremes, false
velocities, rotating wrists, motions at the tool's speed limit, and sequences that hypothesis
searched for.  They pass the limiter and then the simulated joint servos.

The others are sheet targets for the controls of two bridges that hold a sheet: jumps, invalid
numbers, late targets, frozen and lagging arms, e-stops and resets.  Measurements are frozen,
lagging, offset, swapped, replayed or stale; a second master commands an arm; faults are combined.
Every path check reports a clear path.  Commands are sent with the jitter of bridges.

The kinematics of this file check the commands, and each millisecond of the simulated joints.
Counted separately are commands that exceed the acceleration to keep range or tool speed, frozen
arms that catch up, and arms that a second master moves.

Prints the violations (there should be none), the worst ratio to each limit, and the time of a
pass.  Takes some minutes on one core.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections import defaultdict, deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import HealthCheck, Phase, given, settings, target
from hypothesis import strategies as st

from flexsheet.launch.plans.plan import load_scene
from flexsheet.messages.scene import Scene
from flexsheet.messages.types import EStop, Side
from flexsheet.nodes.arm_bridge.control import ArmControl, Command, Timeouts
from flexsheet.nodes.arm_bridge.geometry import ArmGeometry
from flexsheet.nodes.arm_bridge.goal import Goal
from flexsheet.nodes.arm_bridge.limiter import (
    MAX_TRAVEL_STEP_S,
    JointLimits,
    clamp_to_range,
    limit_velocity,
)
from flexsheet.nodes.arm_bridge.link import Freshness
from flexsheet.nodes.arm_bridge.other_arm import OtherArm
from flexsheet.nodes.arm_bridge.state_machine import Event
from flexsheet.nodes.arrays import Bools, Floats, Ints
from flexsheet.nodes.models.motion import SheetMotion
from flexsheet.nodes.models.rigid import transform, transform_from_rpy
from flexsheet.nodes.twin.arms import (
    RV_1A_MECHANICS,
    Servo,
    decelerate,
)

Random = np.random.Generator

SCENE_FILE = Path(__file__).resolve().parent.parent / "launch" / "scenes" / "cylinder.yaml"
PERIOD_S = 1.0 / 140.0
JITTER_S = 0.0015
"""The maximum jitter of the delivery of commands, in seconds."""
SERVO_LAG_S = 0.025
LANES = 96
"""The number of arms that are simulated in parallel."""
SIDES: tuple[Side, Side] = ("left", "right")
PAIRS = 32
LIFE = 400
"""The number of commands after which an arm restarts at another position."""
SHEET_FRACTION = 0.2
THAW_S = 0.4
"""The time in which a frozen arm catches up: sixteen lags of its servos, in seconds."""
WITHIN = 1.0 + 1e-6
NOISE_RAD = 5e-6
"""The standard deviation of encoder noise, in radians."""
HISTORY = 150
"""The number of past measurements that a false measurement may repeat."""
FALSE_CHANCE, FALSE_CHANCE_MOVING, SECOND_CHANCE = 0.0005, 0.01, 0.0005
"""Probabilities per arm and cycle of a false measurement, and of a second master."""
MAX_UNCHANGED_CYCLES = 7
"""The number of cycles after which unchanged counters count as stalled."""
HUNTS = 80
"""The number of sequences that hypothesis tries."""
START_GUESS_RAD = RV_1A_MECHANICS.start_rad
RANGE_RAD = RV_1A_MECHANICS.range_rad
SPEED_RAD_PER_S = RV_1A_MECHANICS.speed_rad_per_s
ACCELERATION_RAD_PER_S2 = RV_1A_MECHANICS.acceleration_rad_per_s2


@dataclass
class AdversaryCounts:
    """Counts of cycles and moving cycles under one adversary, and the maximum tool speed."""

    cycles: int = 0
    moved: int = 0
    tool_speed_ratio: float = 0.0


@dataclass
class Tally:
    """Counts of violations by name, maximum ratio to each limit, and times of a pass."""

    commands: int = 0
    violations: dict[str, int] = field(default_factory=lambda: defaultdict(int))
    expected: int = 0
    worst: dict[str, float] = field(default_factory=lambda: defaultdict(float))
    pass_ns: list[int] = field(default_factory=list)
    under: dict[str, AdversaryCounts] = field(default_factory=lambda: defaultdict(AdversaryCounts))

    def check_ratio(self, name: str, share: Floats | float, allowed: Bools | bool = False) -> None:
        """Count the ratios to a limit that exceed 1. Allowed ratios are counted separately."""
        shares = np.atleast_1d(np.asarray(share, dtype=np.float64))
        if shares.size == 0:
            return
        over, free = ~(shares <= WITHIN), np.broadcast_to(allowed, shares.shape)
        self.expected += int((over & free).sum())
        self.violations[name] += int((over & ~free).sum())
        self.worst[name] = max(self.worst[name], float(np.where(free, 0.0, shares).max()))


def compute_flange_poses(joints_rad: Floats) -> tuple[Floats, Floats]:
    """Return the rotations (n, 3, 3) and positions (n, 3), m, of flanges for joints (n, 6), rad.

    The poses are products of the joint transforms of the simulated arm, in the frame of its base.
    """
    q = joints_rad.T
    axes = "zyyzyz"
    offsets = ((0, 0, 0.3), (0, 0, 0.25), (-0.09, 0, 0), (0, 0, 0.16), (0, 0, 0), (0, 0, 0.072))
    turns = np.broadcast_to(np.eye(3), (q.shape[1], 3, 3))
    places = np.zeros((q.shape[1], 3))
    for axis, angle, offset in zip(axes, q, offsets, strict=True):
        s, c, one, nil = np.sin(angle), np.cos(angle), np.ones_like(angle), np.zeros_like(angle)
        rows = (
            (c, -s, nil, s, c, nil, nil, nil, one)
            if axis == "z"
            else (c, nil, s, nil, one, nil, -s, nil, c)
        )
        turns = turns @ np.stack(rows, axis=-1).reshape(-1, 3, 3)
        places = places + turns @ np.array(offset)
    return turns, places


def points_on_tool(joints_rad: Floats, tool: Floats) -> Floats:
    """Return the points (points, 3) of the tool in the base frames of n arms, (n, points, 3)."""
    turns, places = compute_flange_poses(joints_rad)
    found: Floats = np.einsum("nij,pj->npi", turns, tool) + places[:, None, :]
    return found


def find_tool_points(scene: Scene) -> Floats:
    """Return centre and ends of the left clamped edge, and the flange's centre (4, 3) m."""
    clamp = scene.arms.left.flange_from_edge
    pose, half = transform_from_rpy(clamp.position_m, clamp.rpy_rad), 0.5 * scene.sheet.height_m
    edge = pose[:3, 3] + np.array([[0.0], [-half], [half]]) * pose[:3, 1]
    return np.vstack([edge, np.zeros(3)])


class CheckedServos:
    """The simulated joint servos of n arms, whose limits are checked in each millisecond."""

    def __init__(self, joints_rad: Floats, scene: Scene, tally: Tally) -> None:
        self.servo = Servo(joints_rad.copy(), SERVO_LAG_S)
        self.servo.velocity_rad_per_s = np.zeros_like(joints_rad)
        self._tool, self._fastest = find_tool_points(scene), scene.arms.max_tool_speed_m_per_s
        self._tally = tally
        self.speed_ratio = np.zeros(len(joints_rad))
        """The maximum ratio to the tool speed of each arm in the last `advance`."""

    def advance(
        self,
        wanted_rad: Floats,
        duration_s: float,
        moving: Floats,
        *,
        catching_up: Bools | bool = False,
    ) -> None:
        """Advance all arms by `duration_s`.

        moving (n,): 1 for an arm that obeys, 0 for an arm that decelerates, -1 for a frozen arm.
        catching_up (n,): true for an arm that was frozen and now catches up at full speed.
        """
        steps = int(np.ceil(duration_s / 1e-3))
        step_s = duration_s / steps
        servo, tally = self.servo, self._tally
        self.speed_ratio = np.zeros(len(servo.joints_rad))
        for _ in range(steps):
            joints, velocity = servo.joints_rad, servo.velocity_rad_per_s
            before = points_on_tool(joints, self._tool)
            servo.advance(wanted_rad, step_s)
            self._hold_back(joints, velocity, moving, step_s)
            after = points_on_tool(servo.joints_rad, self._tool)
            below = (RANGE_RAD[:, 0] - servo.joints_rad).max(axis=1)
            above = (servo.joints_rad - RANGE_RAD[:, 1]).max(axis=1)
            tally.check_ratio("simulated position", 1.0 + np.maximum(below, above))
            change = np.abs(servo.velocity_rad_per_s - velocity) / step_s
            tally.check_ratio(
                "simulated speed", (np.abs(servo.velocity_rad_per_s) / SPEED_RAD_PER_S)
            )
            share = (change / ACCELERATION_RAD_PER_S2).max(axis=1)
            tally.check_ratio("simulated acceleration", share[moving >= 0])
            speed = np.linalg.norm(after - before, axis=2).max(axis=1) / step_s
            tally.check_ratio("simulated tool speed", speed / self._fastest, allowed=catching_up)
            self.speed_ratio = np.maximum(self.speed_ratio, speed / self._fastest)

    def _hold_back(self, joints: Floats, velocity: Floats, moving: Floats, step_s: float) -> None:
        """Undo the step of frozen arms, and decelerate stopping arms."""
        servo, still, braking = self.servo, moving < 0, moving == 0
        servo.joints_rad[still], servo.velocity_rad_per_s[still] = joints[still], 0.0
        slower = decelerate(velocity, step_s, ACCELERATION_RAD_PER_S2)
        servo.velocity_rad_per_s[braking] = slower[braking]
        servo.joints_rad[braking] = (joints + slower * step_s)[braking]


# Joint goals.


@dataclass
class Lane:
    """One arm under one adversary, with the limiter's last input and output."""

    joints_rad: Floats
    velocity: Floats
    goals: Iterator[tuple[Floats, Floats]]


Adversary = Callable[[Random, JointLimits, Lane], Iterator[tuple[Floats, Floats]]]
STROKE_CYCLES = 4000
STILL = np.zeros(6)


def _anywhere(random: Random, limits: JointLimits, beyond: float = 0.0) -> Floats:
    width = limits.max_rad - limits.min_rad
    return limits.min_rad + random.uniform(-beyond, 1.0 + beyond, 6) * width


def random_goals(
    random: Random, limits: JointLimits, lane: Lane
) -> Iterator[tuple[Floats, Floats]]:
    """Yield random goals within and beyond the range, each for some cycles."""
    while True:
        goal = _anywhere(random, limits, 0.5)
        for _ in range(random.integers(1, 60)):
            yield goal, STILL


def invalid_goals(
    random: Random, limits: JointLimits, lane: Lane
) -> Iterator[tuple[Floats, Floats]]:
    """Yield invalid and huge numbers among valid goals."""
    odd = np.array([np.nan, np.inf, -np.inf, 1e300, -1e300, 1e-300, 0.0])
    while True:
        goal, along = _anywhere(random, limits), random.normal(0.0, 1.0, 6)
        for values in (goal, along):
            hit = random.random(6) < random.choice([0.0, 0.1, 1.0])
            values[hit] = random.choice(odd, int(hit.sum()))
        yield goal, along


def extremes(random: Random, limits: JointLimits, lane: Lane) -> Iterator[tuple[Floats, Floats]]:
    """Yield goals that alternate between the ends of each joint's range, at different periods."""
    while True:
        up, each = random.random(6) < 0.5, int(random.integers(1, 40))
        goal = np.where(up, limits.max_rad, limits.min_rad)
        other = np.where(up, limits.min_rad, limits.max_rad)
        for number in range(8 * each):
            yield (goal, other)[number // each % 2], STILL


def edges(random: Random, limits: JointLimits, lane: Lane) -> Iterator[tuple[Floats, Floats]]:
    """Yield the ends of the range, and goals slightly inside and outside of them."""
    while True:
        end = np.where(random.random(6) < 0.5, limits.max_rad, limits.min_rad)
        for _ in range(random.integers(5, 80)):
            yield end + random.choice([0.0, 1e-12, -1e-12, 1e-3, -1e-3, 1.0, -1.0], 6), STILL


def false_velocities(
    random: Random, limits: JointLimits, lane: Lane
) -> Iterator[tuple[Floats, Floats]]:
    """Yield goals with false velocities."""
    while True:
        goal = lane.joints_rad + random.normal(0.0, 0.3, 6)
        claim = random.choice([1.0, -1.0, 1e6, -1e6], 6) * limits.speed_rad_per_s
        for _ in range(random.integers(1, 40)):
            yield goal, claim


def spins(random: Random, limits: JointLimits, lane: Lane) -> Iterator[tuple[Floats, Floats]]:
    """Yield goals near the wrist singularity: J4 and J6 rotate in opposite directions."""
    while True:
        goal = lane.joints_rad.copy()
        goal[4] = 0.0
        for _ in range(random.integers(5, 30)):
            yield goal, STILL
        side = random.choice([-1.0, 1.0])
        goal[3], goal[5] = side * 3.0, -side * 3.4
        for _ in range(random.integers(5, 60)):
            yield goal, STILL
        goal = goal.copy()
        goal[4] = random.choice([-1.5, 1.5])
        for _ in range(random.integers(5, 30)):
            yield goal, STILL


def pushes(random: Random, limits: JointLimits, lane: Lane) -> Iterator[tuple[Floats, Floats]]:
    """Yield motions back and forth of each joint that move the tool at its maximum speed."""
    while True:
        direction = random.normal(0.0, 1.0, 3)
        nudged = lane.joints_rad + np.vstack([np.zeros(6), 1e-4 * np.eye(6)])
        turns, places = compute_flange_poses(nudged)
        tips = places + 0.12 * turns[:, :, 1]
        way = np.sign((tips[1:] - tips[0]) @ direction)
        for sign in (1.0, -1.0):
            for _ in range(random.integers(3, 40)):
                yield lane.joints_rad + sign * way, sign * way * limits.speed_rad_per_s


def walks(random: Random, limits: JointLimits, lane: Lane) -> Iterator[tuple[Floats, Floats]]:
    """Yield a moving goal with its true velocity, which changes at random times."""
    goal, speed = lane.joints_rad.copy(), np.zeros(6)
    while True:
        if random.random() < 0.05:
            speed = random.uniform(-1.5, 1.5, 6) * limits.speed_rad_per_s
        goal = goal + speed * PERIOD_S
        yield goal, speed


ADVERSARIES = (random_goals, invalid_goals, extremes, edges, false_velocities, spins, pushes, walks)


def joint_goals(
    commands: int,
    random: Random,
    scene: Scene,
    found_sequences: Sequence[Sequence[Floats]],
    tally: Tally,
) -> None:
    """Pass joint goals through the limiter to simulated arms.

    commands: number of goals.
    """
    geometry = ArmGeometry(scene, "left")
    limits = geometry.joint_limits

    def replay(random: Random, limits: JointLimits, lane: Lane) -> Iterator[tuple[Floats, Floats]]:
        """Yield a variation of a sequence that hypothesis found."""
        while True:
            shift = random.normal(0.0, random.choice([0.0, 0.02]), 6)
            for goal in found_sequences[int(random.integers(len(found_sequences)))]:
                yield goal + shift, STILL

    adversaries: tuple[Adversary, ...] = (*ADVERSARIES, replay) if found_sequences else ADVERSARIES

    def lane_at(number: int) -> Lane:
        lane = Lane(_anywhere(random, limits), np.zeros(6), iter(()))
        lane.goals = adversaries[number % len(adversaries)](random, limits, lane)
        return lane

    begun = 0
    while tally.commands + LANES <= commands or begun == 0:
        lanes = [lane_at(begun + number) for number in range(LANES)]
        begun += LANES
        arms = CheckedServos(np.array([lane.joints_rad for lane in lanes]), scene, tally)
        delay_s = 0.0
        for _ in range(min(LIFE, max(1, (commands - tally.commands) // LANES))):
            step_s = PERIOD_S * float(random.choice([0.5, 1.0, 2.0, random.uniform(0.5, 2.0)]))
            held = np.array([lane.joints_rad for lane in lanes])
            old = np.array([lane.velocity for lane in lanes])
            later_s = random.uniform(0.0, JITTER_S)
            arms.advance(held, step_s + later_s - delay_s, np.ones(LANES))
            delay_s = later_s
            for lane in lanes:
                goal, along = next(lane.goals)
                began_ns = time.thread_time_ns()
                lane.velocity = limit_velocity(
                    lane.joints_rad,
                    lane.velocity,
                    goal,
                    along,
                    limits=limits,
                    step_s=step_s,
                )
                tally.pass_ns.append(time.thread_time_ns() - began_ns)
                lane.joints_rad = lane.joints_rad + lane.velocity * step_s
            now = np.array([lane.joints_rad for lane in lanes])
            new = np.array([lane.velocity for lane in lanes])
            check_commands(
                tally,
                geometry,
                tool=find_tool_points(scene),
                held=held,
                now=now,
                velocities=(old, new),
                step_s=step_s,
            )
            tally.commands += LANES


def check_commands(
    tally: Tally,
    geometry: ArmGeometry,
    *,
    tool: Floats,
    held: Floats,
    now: Floats,
    velocities: tuple[Floats, Floats],
    step_s: float,
) -> None:
    """Check commands `now` (n, 6) that follow commands `held` (n, 6), and their velocities."""
    limits, fastest = geometry.joint_limits, geometry.max_tool_speed
    old, new = velocities
    beyond = np.maximum(limits.min_rad - now, now - limits.max_rad).max(axis=1)
    tally.check_ratio("commanded position", 1.0 + beyond)
    tally.check_ratio("commanded speed", np.abs(new) / limits.speed_rad_per_s)
    here = points_on_tool(held, tool)

    def compute_tool_ratio(velocity: Floats) -> Floats:
        gone = points_on_tool(held + velocity * step_s, tool) - here
        furthest: Floats = np.linalg.norm(gone, axis=2).max(axis=1)
        return furthest / (min(step_s, MAX_TRAVEL_STEP_S) * fastest)

    tally.check_ratio("commanded tool speed", compute_tool_ratio(new))
    # Allowed if the full deceleration would exceed tool speed or range.
    most = limits.acceleration_rad_per_s2 * step_s
    slowest = np.sign(old) * np.maximum(np.abs(old) - most, 0.0)
    stopping_s = (np.abs(old) / limits.acceleration_rad_per_s2).max(axis=1, keepdims=True)
    slowed = old * np.maximum(0.0, 1.0 - step_s / np.maximum(stopping_s, 1e-12))
    there = held + slowest * step_s
    slowed = clamp_to_range(held, old, slowed, limits=limits, step_s=step_s)
    forced = (compute_tool_ratio(slowed) > 1.0) | (
        (there < limits.min_rad) | (there > limits.max_rad)
    ).any(axis=1)
    share = (np.abs(new - old) / most).max(axis=1)
    tally.check_ratio("commanded acceleration", share, allowed=forced)


def search_sequences(scene: Scene) -> list[list[Floats]]:
    """Search for sequences of goals near the limits with hypothesis, and return the worst."""
    geometry = ArmGeometry(scene, "left")
    limits = geometry.joint_limits
    width = limits.max_rad - limits.min_rad
    found: list[tuple[float, float, list[Floats]]] = []
    share = st.one_of(st.floats(-0.2, 1.2), st.sampled_from([0.0, 1.0]))
    legs = st.lists(st.tuples(st.tuples(*[share] * 6), st.integers(1, 20)), min_size=1, max_size=5)

    @settings(
        max_examples=HUNTS,
        derandomize=True,
        database=None,
        deadline=None,
        phases=[Phase.generate, Phase.target],
        suppress_health_check=list(HealthCheck),
    )
    @given(start=st.tuples(*[st.floats(0.0, 1.0)] * 6), legs=legs)
    def search(start: tuple[float, ...], legs: list[tuple[tuple[float, ...], int]]) -> None:
        tally = Tally()
        joints, velocity = limits.min_rad + np.array(start) * width, np.zeros(6)
        arm = CheckedServos(joints[None, :], scene, tally)
        goals = [
            limits.min_rad + np.array(leg) * width for leg, count in legs for _ in range(count)
        ]
        for goal in goals:
            velocity = limit_velocity(
                joints, velocity, goal, STILL,
                limits=limits, step_s=2.0 * PERIOD_S,
            )  # fmt: skip
            joints = joints + velocity * 2.0 * PERIOD_S
            arm.advance(joints[None, :], 2.0 * PERIOD_S, np.ones(1))
        speed, place = tally.worst["simulated tool speed"], tally.worst["simulated position"]
        target(speed, label="tool speed")
        target(place, label="position")
        found.append((speed, place, goals))

    search()
    by_speed = sorted(found, key=lambda row: row[0])[-12:]
    by_place = sorted(found, key=lambda row: row[1])[-12:]
    return [goals for _, _, goals in (*by_speed, *by_place)]


# Sheet targets.


History = deque[Floats]
"""The measured joints (n, 6) of all arms, in order of time."""


@dataclass
class FalseMeasurement:
    """A source of false measurements of an arm for some cycles, of one kind at a time."""

    kinds: tuple[str, ...]
    cycles: int
    lag: int
    shift_rad: Floats
    order: Ints
    held_rad: Floats | None = None
    begun: int = 0

    @classmethod
    def draw(cls, random: Random) -> FalseMeasurement:
        count = 1 if random.random() < 0.7 else 2
        kinds = random.choice(list(FALSE_KINDS), count, replace=False)
        size = float(random.choice([0.003, 0.01, 0.03, 0.1, 0.5]))
        return cls(
            tuple(str(kind) for kind in kinds),
            int(random.integers(3, 200)),
            int(random.integers(2, HISTORY)),
            random.uniform(-size, size, 6) * (random.random(6) < random.choice([0.2, 1.0])),
            random.permutation(6),
        )

    def report(self, history: History, arm: int) -> tuple[Floats, Freshness]:
        """Return the joints (6,), rad, that the arm reports, and the freshness of the counters."""
        joints, freshness = history[-1][arm], Freshness.FRESH
        for kind in self.kinds:
            joints, fresh = FALSE_KINDS[kind](self, history, arm, joints)
            freshness = fresh if fresh != Freshness.FRESH else freshness
        self.begun += 1
        self.cycles -= 1
        return joints, freshness

    def frozen(self, history: History, arm: int, joints: Floats) -> tuple[Floats, Freshness]:
        """Repeat the first measurement while the counters advance."""
        self.held_rad = joints if self.held_rad is None else self.held_rad
        return self.held_rad, Freshness.FRESH

    def stale(self, history: History, arm: int, joints: Floats) -> tuple[Floats, Freshness]:
        """Repeat the first measurement with the same counters."""
        held, _ = self.frozen(history, arm, joints)
        stalled = self.begun >= MAX_UNCHANGED_CYCLES
        return held, Freshness.STALLED if stalled else Freshness.REPEATED

    def lagging(self, history: History, arm: int, joints: Floats) -> tuple[Floats, Freshness]:
        return history[-min(self.lag, len(history))][arm], Freshness.FRESH

    def offset(self, history: History, arm: int, joints: Floats) -> tuple[Floats, Freshness]:
        return joints + self.shift_rad, Freshness.FRESH

    def joints_swapped(
        self, history: History, arm: int, joints: Floats
    ) -> tuple[Floats, Freshness]:
        return joints[self.order], Freshness.FRESH

    def arms_swapped(self, history: History, arm: int, joints: Floats) -> tuple[Floats, Freshness]:
        return history[-1][arm ^ 1], Freshness.FRESH

    def replayed(self, history: History, arm: int, joints: Floats) -> tuple[Floats, Freshness]:
        """Repeat a part of the past with new counters."""
        past = (2 * self.begun + self.lag - self.begun % self.lag) % HISTORY
        return history[-1 - min(past, len(history) - 1)][arm], Freshness.FRESH

    def replayed_whole(
        self, history: History, arm: int, joints: Floats
    ) -> tuple[Floats, Freshness]:
        """Repeat a part of the past with the old counters."""
        return self.replayed(history, arm, joints)[0], Freshness.REVERSED


FALSE_KINDS: dict[str, Callable[..., tuple[Floats, Freshness]]] = {
    "frozen": FalseMeasurement.frozen,
    "stale": FalseMeasurement.stale,
    "lagging": FalseMeasurement.lagging,
    "offset": FalseMeasurement.offset,
    "joints swapped": FalseMeasurement.joints_swapped,
    "arms swapped": FalseMeasurement.arms_swapped,
    "replayed": FalseMeasurement.replayed,
    "replayed with counters": FalseMeasurement.replayed_whole,
}


@dataclass
class SecondMaster:
    """A second client that commands the same arm for some cycles, at up to half the tool speed.

    refuses: whether the controller rejects the commands of the bridge. Otherwise the controller
        executes the commands of both clients in turn.
    """

    joints_rad: Floats
    goals: Iterator[tuple[Floats, Floats]]
    cycles: int
    refuses: bool
    velocity: Floats = field(default_factory=lambda: np.zeros(6))

    def command(self, geometry: ArmGeometry, step_s: float) -> Floats:
        goal, along = next(self.goals)
        self.velocity = limit_velocity(
            self.joints_rad,
            self.velocity,
            goal,
            along,
            limits=replace(geometry.joint_limits, max_tool_speed=0.5 * geometry.max_tool_speed),
            step_s=step_s,
        )
        self.joints_rad = self.joints_rad + self.velocity * step_s
        self.cycles -= 1
        return self.joints_rad


@dataclass
class Bridge:
    """The control of one bridge, and the remaining cycles of the faults of its arm."""

    geometry: ArmGeometry
    control: ArmControl
    frozen: int = 0
    unanswered: int = 0
    lie: FalseMeasurement | None = None
    second: SecondMaster | None = None

    @property
    def adversary(self) -> str:
        """Return the name of this arm's current adversary."""
        if self.second is not None:
            return "second master"
        if self.lie is not None:
            return " + ".join(sorted(self.lie.kinds)) if len(self.lie.kinds) == 1 else "combined"
        return "frozen arm" if self.frozen else "silent arm" if self.unanswered else "none"

    def state(self, age_s: float) -> OtherArm:
        """Return the state that the other bridge receives."""
        joints_rad = self.control.last_measured_rad
        assert joints_rad is not None
        return OtherArm(
            joints_rad,
            self.geometry.world_from_flange(joints_rad),
            self.geometry.world_from_flange(self.control.commanded_rad),
            self.control.mode,
            self.control.all_faults,
            age_s,
            self.control.ready,
            self.control.estop_reason is not None,
        )

    def receive(self, history: History, arm: int) -> None:
        """Pass the arm's answer to the control, or a failed exchange."""
        if self.second is not None and self.second.refuses:
            self.control.on_exchange_failed("the arm refused the command", silent=False)
        elif self.unanswered == 0:
            joints, freshness = history[-1][arm], Freshness.FRESH
            if self.lie is not None:
                joints, freshness = self.lie.report(history, arm)
                self.lie = self.lie if self.lie.cycles > 0 else None
            self.control.on_measurement(joints, (), freshness)
        else:
            self.unanswered -= 1
            self.control.on_exchange_failed("no answer", silent=True)

    def other_command(self, random: Random, joints_rad: Floats, step_s: float) -> Floats | None:
        """Return the joints (6,), rad, from a second master, or None without a second master."""
        if self.second is None and random.random() < SECOND_CHANCE:
            self.second = second_master(random, self.geometry, joints_rad)
        if self.second is None:
            return None
        second, theirs = self.second, self.second.command(self.geometry, step_s)
        self.second = second if second.cycles > 0 else None
        return theirs if second.refuses or second.cycles % 2 else None

    def draw_faults(self, random: Random, stamp_ns: int) -> None:
        """Draw faults of the arm, e-stops and resets."""
        chance = random.random()
        false = FALSE_CHANCE if self.control.at_rest else FALSE_CHANCE_MOVING
        if self.lie is None and random.random() < false:
            self.lie = FalseMeasurement.draw(random)
        if chance < 0.0005:
            self.frozen = int(random.integers(1, 60))
        elif chance < 0.001:
            self.unanswered = int(random.integers(1, 5))
        elif chance < 0.0015:
            self.control.on_estop(EStop(engaged=True, reason="drill"), stamp_ns, stamp_ns)
        elif chance > 0.98 and (self.control.faults or self.control.estop_reason):
            self.control.on_estop(EStop(engaged=False, reason=""), stamp_ns, stamp_ns)


def sheet_goals(random: Random, scene: Scene) -> Iterator[Goal]:
    """Yield sheet targets that jump, move, are invalid, overstretch the sheet, or are late."""
    while True:
        reach = random.choice([0.02, 0.1, 0.3])
        place, turn = random.normal(0.0, reach, 3), random.normal(0.0, 2.0 * reach, 3)
        stretch = random.choice([1.0, 1.03, 1.06, random.uniform(0.5, 1.5)])
        pose = transform_from_rpy(place, turn)
        twist = random.normal(0.0, random.choice([0.0, 0.2, 5.0]), 6)
        rate = random.choice([0.0, 0.0, random.normal(0.0, 1.0)])
        late_s = float(random.choice([-0.01] * 20 + [0.03, 0.2, np.nan]))
        if random.random() < 0.03:
            pose[random.integers(4), random.integers(4)] = random.choice([np.nan, np.inf, 7.0])
        if random.random() < 0.02:
            stretch = float(random.choice([np.nan, -1.0, 1e9]))
        for number in range(int(random.integers(1, 60))):
            moved = transform(pose[:3, :3], pose[:3, 3] + twist[:3] * number * PERIOD_S)
            motion = SheetMotion(moved, twist, float(stretch), float(rate))
            # Invalid poses are not passed to transform(), which would correct their last row.
            yield Goal(
                motion if np.isfinite(pose).all() else replace(motion, world_from_sheet=pose),
                late_s,
            )


def sheet_targets(commands: int, random: Random, scene: Scene, tally: Tally) -> None:
    """Run pairs of bridges with simulated arms.

    commands: number of commands that all bridges send together.
    """
    end = tally.commands + commands
    while tally.commands < end:
        left = (end - tally.commands) // (2 * PAIRS) + 1
        bridge_pairs(min(4 * LIFE, left), random, scene, tally)


def bridge_pairs(cycles: int, random: Random, scene: Scene, tally: Tally) -> None:
    """Run pairs of arms that hold a sheet, from a start in the scene's centre."""
    timeouts = Timeouts(hold_after_s=0.02, stop_after_s=0.1)
    home = SheetMotion(np.eye(4), np.zeros(6), 1.02, 0.0)
    geometries = [ArmGeometry(scene, side) for side in SIDES]
    starts = [geometry.joints_for_sheet(home, START_GUESS_RAD) for geometry in geometries]
    bridges = [
        Bridge(geometry, ArmControl(timeouts, max_tracking_error_rad=0.12, auto_arming=True))
        for _ in range(PAIRS)
        for geometry in geometries
    ]
    arms = CheckedServos(np.array(starts * PAIRS), scene, tally)
    history: History = deque([arms.servo.joints_rad], maxlen=HISTORY)
    for bridge, joints in zip(bridges, starts * PAIRS, strict=True):
        bridge.control.on_measurement(joints, ())
        bridge.control.handle(Event.CONNECTED)
        bridge.control.handle(Event.ARM)
    wanted, moving = arms.servo.joints_rad.copy(), np.zeros(2 * PAIRS)
    thaw_s = np.zeros(2 * PAIRS)
    sent: list[Floats | None] = [None] * len(bridges)
    goals = [sheet_goals(random, scene) for _ in range(PAIRS)]
    for cycle in range(cycles):
        step_s = PERIOD_S * float(random.uniform(0.5, 2.0))
        arms.advance(wanted, step_s, moving, catching_up=thaw_s > 0.0)
        noise = NOISE_RAD * random.standard_normal(arms.servo.joints_rad.shape)
        history.append(arms.servo.joints_rad + noise)
        note_adversaries(tally, bridges, arms.speed_ratio, moving=moving, catching_up=thaw_s > 0.0)
        thaw_s = thaw_s - step_s
        pair_goals = [next(goal) for goal in goals]
        for number, bridge in enumerate(bridges):
            control, other = bridge.control, number ^ 1
            bridge.receive(history, number)
            age_s = float(random.choice([0.005] * 20 + [0.03, 0.2]))
            seen, before = bridges[other].state(age_s), sent[number]
            began_ns = time.thread_time_ns()
            command = control.step(bridge.geometry, pair_goals[number // 2], seen, step_s)
            if command.mode == "move":
                tally.pass_ns.append(time.thread_time_ns() - began_ns)
            if control.pending_check is not None:
                control.on_path_result(control.pending_check, None)
            check_bridge(
                tally,
                bridge.geometry,
                command,
                before=before,
                step_s=step_s,
            )
            moves = command.mode == "move"
            sent[number] = command.joints_rad if moves else None
            wanted[number], moving[number] = command.joints_rad, float(moves)
            theirs = bridge.other_command(random, arms.servo.joints_rad[number], step_s)
            if bridge.second is not None:
                thaw_s[number] = THAW_S
            if theirs is not None:
                wanted[number], moving[number] = theirs, 1.0
            if bridge.frozen > 0:
                bridge.frozen -= 1
                moving[number], thaw_s[number] = -1.0, THAW_S
            bridge.draw_faults(random, cycle)
        tally.commands += len(bridges)


def note_adversaries(
    tally: Tally, bridges: list[Bridge], speed_ratio: Floats, *, moving: Floats, catching_up: Bools
) -> None:
    """Record the tool speeds (n,) of the arms by adversary, without arms that catch up."""
    for number, bridge in enumerate(bridges):
        under = tally.under[bridge.adversary]
        under.cycles += 1
        under.moved += bool(moving[number] > 0.0)
        if not catching_up[number]:
            under.tool_speed_ratio = max(under.tool_speed_ratio, float(speed_ratio[number]))


def second_master(random: Random, geometry: ArmGeometry, joints_rad: Floats) -> SecondMaster:
    """Return a second master that starts at the arm's joints."""
    lane = Lane(joints_rad.copy(), np.zeros(6), iter(()))
    goals = walks(random, geometry.joint_limits, lane)
    return SecondMaster(
        joints_rad.copy(), goals, int(random.integers(5, 200)), refuses=bool(random.random() < 0.5)
    )


def check_bridge(
    tally: Tally,
    geometry: ArmGeometry,
    command: Command,
    *,
    before: Floats | None,
    step_s: float,
) -> None:
    """Check a command of a bridge.

    before: previous command (6,), rad, or None if the previous command did not move the arm.
    """
    if command.mode != "move":
        return
    joints, limits = command.joints_rad, geometry.joint_limits
    tally.check_ratio("finite", 0.0 if np.isfinite(joints).all() else 2.0)
    beyond = np.maximum(limits.min_rad - joints, joints - limits.max_rad).max()
    tally.check_ratio("commanded position", 1.0 + float(beyond))
    if before is not None:
        furthest = step_s * limits.speed_rad_per_s
        tally.check_ratio("commanded speed", float((np.abs(joints - before) / furthest).max()))


def stroke_passes(scene: Scene) -> list[int]:
    """Measure the CPU time (ns) of inverse kinematics and limiter along strokes."""
    geometry, times = ArmGeometry(scene, "left"), []
    home = SheetMotion(np.eye(4), np.zeros(6), 1.02, 0.0)
    joints, velocity = geometry.joints_for_sheet(home, START_GUESS_RAD), np.zeros(6)
    before = joints
    for cycle in range(STROKE_CYCLES):
        tilt_rad = np.sin(cycle * PERIOD_S) * scene.working_range.tilt_rad
        turned = transform_from_rpy(np.zeros(3), [tilt_rad, 0.0, 0.0])
        began_ns = time.thread_time_ns()
        goal = geometry.joints_for_sheet(replace(home, world_from_sheet=turned), joints)
        velocity = limit_velocity(
            joints,
            velocity,
            goal,
            (goal - before) / PERIOD_S,
            limits=geometry.joint_limits,
            step_s=PERIOD_S,
        )
        times.append(time.thread_time_ns() - began_ns)
        joints, before = joints + velocity * PERIOD_S, goal
    return times


def report(tally: Tally, sheets: Tally, stroke_ns: list[int], seconds: float) -> dict[str, Any]:
    """Return the counts as a dictionary for output."""
    names = sorted(set(tally.worst) | set(sheets.worst))
    violations = {name: tally.violations[name] + sheets.violations[name] for name in names}
    return {
        "commands": tally.commands + sheets.commands,
        "violation_count": sum(violations.values()),
        "violations": violations,
        "worst_ratio": {
            name: round(max(tally.worst[name], sheets.worst[name]), 4) for name in names
        },
        "harder_braking": tally.expected,
        "excused_ms": sheets.expected,
        "under": {
            name: {
                "cycles": under.cycles,
                "moved": under.moved,
                "tool_speed_ratio": round(under.tool_speed_ratio, 4),
            }
            for name, under in sorted(sheets.under.items())
        },
        "stroke_us": percentiles_us(stroke_ns),
        "limiter_us": percentiles_us(tally.pass_ns),
        "bridge_pass_us": percentiles_us(sheets.pass_ns),
        "seconds": round(seconds, 1),
    }


def percentiles_us(times_ns: Sequence[int]) -> dict[str, float]:
    """Return p50 and p99 of the processor time, us."""
    p50, p99 = np.percentile(times_ns, [50.0, 99.0]) * 1e-3 if len(times_ns) else (0.0, 0.0)
    return {"p50": round(float(p50), 1), "p99": round(float(p99), 1)}


def run(commands: int, seed: int, *, searching: bool = True) -> dict[str, Any]:
    """Run the benchmark with a number of commands, and return the report.

    searching: whether hypothesis searches for sequences of goals first.
    """
    began_s = time.perf_counter()
    scene, random = load_scene(SCENE_FILE), np.random.default_rng(seed)
    check = random.uniform(-1.0, 1.0, (5, 6))
    for joints, turn, place in zip(check, *compute_flange_poses(check), strict=True):
        assert np.allclose(RV_1A_MECHANICS.forward(joints), transform(turn, place), atol=1e-12)
    joints_tally, sheets_tally = Tally(), Tally()
    found_sequences = search_sequences(scene) if searching else []
    sheets = int(SHEET_FRACTION * commands)
    joint_goals(commands - sheets, random, scene, found_sequences, joints_tally)
    sheet_targets(commands - joints_tally.commands, random, scene, sheets_tally)
    seconds = time.perf_counter() - began_s
    return report(joints_tally, sheets_tally, stroke_passes(scene), seconds)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--commands", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    result = run(options.commands, options.seed)
    print(json.dumps(result, indent=1))
    return 1 if result["violation_count"] else 0


if __name__ == "__main__":
    sys.exit(main())
