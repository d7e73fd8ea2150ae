"""Test the trajectories of targets: their bounds, the arms' agreement, and bad networks."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from pydantic import ValidationError

from flexsheet.messages.base import Header, Message
from flexsheet.messages.clock import VirtualClock
from flexsheet.messages.topics import Topic
from flexsheet.messages.types import ArmState, SheetTarget, SheetTrajectory
from flexsheet.nodes.arm_bridge.control import OTHER_BRIDGE_ENDED, PLANNER_ENDED
from flexsheet.nodes.arm_bridge.geometry import ArmGeometry
from flexsheet.nodes.arm_bridge.goal import (
    FOLLOW_BOUNDS,
    MAX_PREDICTION_S,
    MAX_TRAJECTORY_S,
    GoalTiming,
    find_trajectory,
    make_goal,
)
from flexsheet.nodes.arm_bridge.limiter import check_sheet
from flexsheet.nodes.arm_bridge.link import ArmStatus, Freshness
from flexsheet.nodes.arm_bridge.node import ArmBridge, ArmBridgeParameters
from flexsheet.nodes.arm_bridge.other_arm import OtherArm
from flexsheet.nodes.models.motion import SheetMotion, follow_trajectory, measure_length
from flexsheet.nodes.models.rigid import transform_from_rpy
from flexsheet.nodes.planner.parameters import PlannerParameters
from flexsheet.nodes.planner.trajectory import plan_continuation
from tests.arm_states import arm_state
from tests.examples import long_except
from tests.test_arm_control import GUESS, HOME, SCENE

Floats = NDArray[np.float64]

SIDES = ("left", "right")
START_NS = 1_000_000_000
PERIOD_NS, CYCLE_NS = 16_666_667, 7_142_857
HORIZON_NS = 70_000_000
LEAN_RAD, STROKE_S = 1.0, 3.0
SERVO_CYCLES = 4
BOUNDS = PlannerParameters().bounds
TIMING = GoalTiming(servo_lag_s=0.03, target_period_s=1.0 / 60.0, max_extrapolation_s=0.06)


def make_target(valid_at_ns: int, **changes: Any) -> SheetTarget:
    """Return the target at a time of a sheet that tilts back and forth, at first at rest."""
    phase = np.pi * (valid_at_ns - START_NS) * 1e-9 / STROKE_S
    rate = 0.5 * LEAN_RAD * np.pi / STROKE_S * np.sin(phase)
    lean_rad = 0.5 * LEAN_RAD * (1.0 - np.cos(phase))
    pose = transform_from_rpy(np.zeros(3), [lean_rad, 0.0, 0.0])
    twist = np.array([0.0, 0.0, 0.0, rate, 0.0, 0.0])
    values: dict[str, Any] = {
        "phase": "contact",
        "reason": "ok",
        "valid_at_ns": valid_at_ns,
        "world_from_sheet": pose,
        "twist_world": twist,
        "stretch_ratio": 1.02,
        "trajectory": plan_continuation(SheetMotion(pose, twist, 1.02, 0.0), BOUNDS),
        "contact_world_m": np.zeros(3),
        "normal_world": pose[:3, 2].copy(),
        "contact_sheet_m": np.zeros(2),
        "push_depth_m": 0.0,
    }
    return SheetTarget.model_construct(**values | changes)


twists = st.tuples(*[st.floats(-0.1, 0.1)] * 3, *[st.floats(-1.0, 1.0)] * 3).map(np.array)


@given(twist=twists, keep_s=st.floats(0.0, 0.2), brake_s=st.floats(0.01, 0.2))
@settings(deadline=None)
def test_a_trajectory_brakes_evenly_to_rest(twist: Floats, keep_s: float, brake_s: float) -> None:
    start, step_s = replace(HOME, twist_world=twist), 0.002
    motions = [
        follow_trajectory(start, number * step_s, keep_s=keep_s, brake_s=brake_s)
        for number in range(-10, 260)
    ]
    for before, after in pairwise(motions):
        change = measure_length(after.twist_world - before.twist_world)
        assert change <= measure_length(twist) / brake_s * step_s + 1e-12
        shift = after.world_from_sheet[:3, 3] - before.world_from_sheet[:3, 3]
        mean = 0.5 * (before.twist_world + after.twist_world)[:3]
        assert shift == pytest.approx(mean * step_s, abs=1e-5)
    assert not motions[-1].twist_world.any()
    assert motions[9].twist_world == pytest.approx(twist)


@given(twist=twists)
@settings(deadline=None)
def test_the_planners_trajectories_are_followed(twist: Floats) -> None:
    trajectory = plan_continuation(replace(HOME, twist_world=twist), BOUNDS)
    assert trajectory is not None
    assert find_trajectory(make_target(0, twist_world=twist, trajectory=trajectory)) == trajectory


def test_a_sheet_that_cannot_stop_in_time_has_no_trajectory() -> None:
    twist = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0])
    slow = replace(BOUNDS, turn_acceleration_rad_per_s2=4.0)
    assert plan_continuation(replace(HOME, twist_world=twist), slow) is None


@pytest.mark.parametrize("changes", [{"keep_s": 0.3}, {"brake_s": 0.0}, {"keep_s": float("nan")}])
def test_a_message_refuses_a_trajectory_out_of_its_bounds(changes: dict[str, float]) -> None:
    with pytest.raises(ValidationError):
        SheetTrajectory(**{"keep_s": 0.1, "brake_s": 0.1} | changes)


@pytest.mark.parametrize(
    ("twist", "keep_s", "brake_s"),
    [
        ([0.0, 0.0, 0.0, 0.5, 0.0, 0.0], 0.3, 0.2),
        ([0.0, 0.0, 0.0, 1.0, 0.0, 0.0], 0.1, 0.05),
        ([0.3, 0.0, 0.0, 0.0, 0.0, 0.0], 0.1, 0.2),
        ([0.0, 0.0, 0.0, np.nan, 0.0, 0.0], 0.1, 0.1),
        ([0.0, 0.0, 0.0, 0.5, 0.0, 0.0], np.nan, 0.1),
        ([0.0, 0.0, 0.0, 0.5, 0.0, 0.0], 0.1, np.nan),
        ([0.0, 0.0, 0.0, 0.5, 0.0, 0.0], -0.1, 0.1),
    ],
    ids=["too long", "brakes hard", "too fast", "NaN twist", "NaN", "NaN brake", "negative"],
)
def test_a_bridge_does_not_follow_a_bad_trajectory(
    twist: list[float], keep_s: float, brake_s: float
) -> None:
    trajectory = SheetTrajectory.model_construct(keep_s=keep_s, brake_s=brake_s)
    target = make_target(0, twist_world=np.array(twist), trajectory=trajectory)
    assert find_trajectory(target) is None
    assert find_trajectory(make_target(0, trajectory=None)) is None


@given(ahead_s=st.floats(-30.0, 30.0), received_s=st.floats(0.0, 0.5))
@settings(deadline=None)
def test_a_trajectory_is_followed_from_its_target_until_its_end(
    ahead_s: float, received_s: float
) -> None:
    """A replayed or delayed target is overdue by its time, whenever it arrives."""
    target = make_target(40 * START_NS)
    now_ns = target.valid_at_ns + round(1e9 * (ahead_s - TIMING.servo_lag_s))
    trajectory = find_trajectory(target)
    assert trajectory is not None
    goal = make_goal(
        target,
        received_ns=now_ns - round(1e9 * received_s),
        now_ns=now_ns,
        timing=TIMING,
        trajectory=trajectory,
    )
    end_s = trajectory.keep_s + trajectory.brake_s
    assert end_s <= MAX_TRAJECTORY_S
    if -MAX_PREDICTION_S < ahead_s < end_s:
        assert goal.overdue_s < 0.0
    else:
        assert goal.overdue_s >= min(ahead_s - end_s, -ahead_s - MAX_PREDICTION_S) - 1e-6
        assert goal.overdue_s >= -1e-6
    lean = abs(np.arctan2(goal.motion.world_from_sheet[2, 1], goal.motion.world_from_sheet[2, 2]))
    assert lean <= LEAN_RAD + FOLLOW_BOUNDS.turn_rad_per_s * MAX_TRAJECTORY_S


OWN_NS, NOW_NS, AGE_S = 10 * START_NS, 10 * START_NS + 200_000_000, 0.15


@pytest.mark.parametrize(
    ("source_ns", "ends_ns", "age_s", "agrees"),
    [
        (OWN_NS, NOW_NS + 100_000_000, 0.0, True),
        (OWN_NS - 3 * PERIOD_NS, NOW_NS + 1, 0.0, True),
        (OWN_NS + PERIOD_NS, NOW_NS + 100_000_000, 0.0, True),
        (OWN_NS, 0, AGE_S, False),
        (OWN_NS - 500_000_000, NOW_NS + 100_000_000, AGE_S, False),
        (OWN_NS + 500_000_000, NOW_NS + 100_000_000, AGE_S, False),
        (OWN_NS, NOW_NS - 50_000_000, 0.05, True),
        (OWN_NS, NOW_NS - 900_000_000, AGE_S, True),
    ],
    ids=["same", "before", "after", "none", "old", "new", "just ended", "ended"],
)
def test_the_arms_agree_on_adjacent_targets_and_age_from_the_trajectorys_end(
    source_ns: int, ends_ns: int, age_s: float, agrees: bool
) -> None:
    state = arm_state("right", target_source_ns=source_ns, trajectory_ends_ns=ends_ns)
    other = OtherArm.from_state(state, AGE_S, target_source_ns=OWN_NS, now_ns=NOW_NS)
    assert other.age_s == pytest.approx(age_s)
    assert other.agrees == agrees


def test_no_state_claims_a_trajectory_for_longer_than_any_lasts() -> None:
    state = arm_state("right", target_source_ns=OWN_NS, trajectory_ends_ns=2**62)
    now_ns = OWN_NS + round(1e9 * (MAX_TRAJECTORY_S + MAX_PREDICTION_S)) + 1
    other = OtherArm.from_state(state, 0.6, target_source_ns=OWN_NS, now_ns=now_ns + 2 * 10**8)
    assert other.age_s == pytest.approx(0.2)
    future = OtherArm.from_state(state, -1.0, target_source_ns=OWN_NS, now_ns=OWN_NS)
    assert future.invalid_reason == "its timestamp is 1 s in the future"


class Servo:
    """Link to an arm whose joints are those commanded some cycles before."""

    def __init__(self, joints_rad: Floats) -> None:
        self.commanded = [joints_rad] * (SERVO_CYCLES + 1)

    def due(self, now_ns: int) -> bool:
        return True

    async def exchange(self, *, mode: str, joints_rad: Floats, now_ns: int) -> ArmStatus:
        moved_rad = joints_rad if mode == "move" else self.commanded[-1]
        self.commanded.append(moved_rad.copy())
        joints = self.commanded[-1 - SERVO_CYCLES]
        return ArmStatus(joints, (), freshness=Freshness.FRESH)

    def close(self) -> None: ...


Stall = Callable[[], float]


@dataclass
class Network:
    """Streams in order: each message has a delay, and a lost one delays all behind it."""

    delay: Stall
    queue: list[tuple[int, int, ArmBridge, str, Message, Header]] = field(default_factory=list)
    free_ns: dict[tuple[str, int], int] = field(default_factory=dict)
    count: int = 0

    def send(self, to: ArmBridge, port: str, message: Message, header: Header) -> None:
        stream = (port, id(to))
        arrives_ns = header.publish_ns + round(1e9 * self.delay())
        self.free_ns[stream] = arrives_ns = max(arrives_ns, self.free_ns.get(stream, 0))
        self.count += 1
        heapq.heappush(self.queue, (arrives_ns, self.count, to, port, message, header))

    def deliver(self, now_ns: int) -> None:
        while self.queue and self.queue[0][0] <= now_ns:
            _, _, to, port, message, header = heapq.heappop(self.queue)
            to.inputs[port].accept(message, header)


@dataclass
class Pair:
    """Both bridges with their servos, a virtual clock and a network."""

    network: Network
    clock: VirtualClock = field(default_factory=lambda: VirtualClock(START_NS, clock_id="clock"))
    bridges: dict[str, ArmBridge] = field(default_factory=dict)
    servos: dict[str, Servo] = field(default_factory=dict)
    states: dict[str, list[ArmState]] = field(default_factory=lambda: {side: [] for side in SIDES})
    cycles: int = 0

    async def start(self) -> None:
        for side in SIDES:
            bridge = ArmBridge(
                ArmBridgeParameters(side=side, arming="auto"),
                name=f"bridge_{side}",
                clock=self.clock,
                send=self._collect,
                topics={"arm": f"arm_{side}", "other_arm": f"arm_{_other(side)}"},
            )
            await bridge.setup()
            await bridge.step("scene", SCENE, self._header(0))
            joints = ArmGeometry(SCENE, side).joints_for_sheet(HOME, GUESS)
            self.servos[side] = bridge._link = Servo(joints)
            bridge._path_checker = SimpleNamespace(
                poll=lambda request: None if request is None else (request, None)
            )
            self.bridges[side] = bridge

    def _header(self, source_ns: int) -> Header:
        self.cycles += 1
        return Header(self.cycles, source_ns, self.clock.now_ns(), "clock", "test", 1)

    def _collect(self, topic: Topic, message: Message, header: Header) -> None:
        if isinstance(message, ArmState):
            self.states[message.side].append(message)
            if self.bridges.keys() == set(SIDES):
                self.network.send(self.bridges[_other(message.side)], "other_arm", message, header)

    async def run(self, seconds: float, targets: Iterator[SheetTarget]) -> None:
        """Run both bridges; one target of the iterator is sent to each arm per period."""
        first_ns = self.clock.now_ns()
        next_target_ns = first_ns
        while self.clock.now_ns() < first_ns + round(1e9 * seconds):
            self.clock.move_to(self.clock.now_ns() + CYCLE_NS)
            if self.clock.now_ns() >= next_target_ns:
                next_target_ns += PERIOD_NS
                target = next(targets)
                header = self._header(target.valid_at_ns - HORIZON_NS)
                for bridge in self.bridges.values():
                    self.network.send(bridge, "sheet_target", target, header)
            self.network.deliver(self.clock.now_ns())
            for bridge in self.bridges.values():
                assert bridge._geometry is not None
                await bridge._run_cycle(bridge._geometry)

    def targets(self, **changes: Any) -> Iterator[SheetTarget]:
        while True:
            yield make_target(self.clock.now_ns() + HORIZON_NS - 30_000_000, **changes)

    def check_limits(self) -> None:
        """Assert joint speed, twist and length of the commanded sheet in each cycle."""
        left, right = (self.bridges[side]._geometry for side in SIDES)
        assert left is not None
        assert right is not None
        for side in SIDES:
            steps = np.diff(self.servos[side].commanded, axis=0)
            assert (np.abs(steps).max(axis=0) <= left.joint_limits.speed_rad_per_s * 0.0143).all()
        limits = replace(left.sheet_limits, max_twist_rad=left.sheet_limits.max_twist_rad + 0.01)
        commanded = (self.servos[side].commanded for side in SIDES)
        for joints in zip(*commanded, strict=True):
            edges = left.world_from_edge(joints[0]), right.world_from_edge(joints[1])
            assert check_sheet(*edges, left=True, limits=limits) is None


def _other(side: str) -> str:
    return "right" if side == "left" else "left"


def make_bad_cables(seed: int) -> Stall:
    """Return delays of cables with 20 +- 10 ms and 1 % loss; a lost packet is sent again."""
    random = np.random.default_rng(seed)

    def delay() -> float:
        delay_s = max(0.0, random.normal(0.02, 0.01)) + max(0.0, random.normal(0.02, 0.01))
        return delay_s + (random.uniform(0.06, 0.14) if random.random() < 0.01 else 0.0)

    return delay


async def start_pair(delay: Stall, **changes: Any) -> Pair:
    pair = Pair(Network(delay))
    await pair.start()
    await pair.run(1.0, pair.targets(**changes))
    return pair


@pytest.mark.parametrize("seed", long_except([1, 2], 1))
async def test_a_stroke_goes_on_with_lost_and_late_packets(seed: int) -> None:
    pair = await start_pair(make_bad_cables(seed))
    for states in pair.states.values():
        states.clear()
    await pair.run(4.0, pair.targets())
    for side, states in pair.states.items():
        geometry = pair.bridges[side]._geometry
        assert geometry is not None
        assert all(state.ready and not state.faults for state in states)
        following = [state.mode == "follow" for state in states]
        assert np.mean(following) > 0.97
        edges = [geometry.world_from_edge(state.joints_commanded_rad) for state in states]
        leans = [np.arctan2(edge[2, 1], edge[1, 1]) for edge in edges]
        assert np.ptp(leans) > 0.7 * LEAN_RAD
    pair.check_limits()


async def test_without_trajectories_it_does_not_go_on() -> None:
    pair = await start_pair(make_bad_cables(1), trajectory=None)
    modes = [state.mode for states in pair.states.values() for state in states[50:]]
    assert modes.count("follow") < 0.2 * len(modes)
    pair.check_limits()


async def test_when_all_targets_stop_the_arms_brake_hold_and_stop() -> None:
    pair = await start_pair(lambda: 0.002)
    assert {states[-1].mode for states in pair.states.values()} == {"follow"}
    began = {side: len(pair.states[side]) for side in SIDES}
    last = make_target(pair.clock.now_ns() + HORIZON_NS)
    await pair.run(0.8, iter([last] * 100))
    for side in SIDES:
        states = pair.states[side][began[side] :]
        modes = [state.mode for state in states]
        assert modes.index("follow") < modes.index("hold") < modes.index("idle")
        followed_s = modes.index("hold") * CYCLE_NS * 1e-9
        assert 0.2 < followed_s < MAX_TRAJECTORY_S + HORIZON_NS * 1e-9
        joints = [state.joints_commanded_rad for state in states[modes.index("hold") :]]
        assert np.ptp(joints, axis=0).max() < 1e-3
    pair.check_limits()


async def test_an_arm_falls_back_when_the_other_follows_no_trajectory() -> None:
    """Without the other's consent a late target holds, as one without a trajectory does."""
    pair = await start_pair(lambda: 0.002)
    began, send = len(pair.states["left"]), pair.network.send

    def send_without_consent(to: ArmBridge, port: str, message: Message, header: Header) -> None:
        if port == "other_arm":
            send(to, port, message.model_copy(update={"trajectory_ends_ns": 0}), header)

    pair.network.send = send_without_consent  # type: ignore[method-assign]
    await pair.run(0.3, pair.targets())
    modes = [state.mode for state in pair.states["left"][began:]]
    assert modes.index("hold") * CYCLE_NS * 1e-9 < 0.06
    assert modes[-1] == "idle"
    pair.check_limits()


def drop(pair: Pair, port: str, *sides: str) -> None:
    """End the connection of a port at some bridges: no message, and the end is noticed."""
    send, bridges = pair.network.send, [pair.bridges[side] for side in sides]

    def send_other(to: ArmBridge, to_port: str, message: Message, header: Header) -> None:
        if to_port != port or to not in bridges:
            send(to, to_port, message, header)

    pair.network.send = send_other  # type: ignore[method-assign]
    pair.network.queue.clear()
    for bridge in bridges:
        bridge.inputs[port].has_ended = True


@pytest.mark.parametrize("sides", [SIDES, ("left",)], ids=["both", "one"])
async def test_both_arms_brake_at_once_when_the_planner_ends(sides: tuple[str, ...]) -> None:
    """At one arm only, the end is a fault of the network, and the other arm may stop later."""
    pair = await start_pair(lambda: 0.002)
    began, before = len(pair.states["left"]), pair.network.send
    drop(pair, "sheet_target", *sides)
    await pair.run(0.06, pair.targets())
    for side in sides:
        states = pair.states[side][began:]
        assert [state.mode for state in states] == ["hold"] * len(states)
        assert {state.reason for state in states} == {PLANNER_ENDED}
    await pair.run(0.4, pair.targets())
    ends = {states[-1].mode for states in pair.states.values()}
    assert ends == {"idle"}
    assert {pair.states[side][-1].reason for side in sides} <= {
        PLANNER_ENDED,
        "other arm: " + PLANNER_ENDED,
    }
    # New targets of a planner that has started again.
    pair.network.send = before  # type: ignore[method-assign]
    for side in sides:
        pair.bridges[side].sheet_target.has_ended = False
    await pair.run(1.0, pair.targets())
    assert {states[-1].mode for states in pair.states.values()} == {"follow"}
    assert not any(state.faults for states in pair.states.values() for state in states)
    pair.check_limits()


async def test_an_arm_brakes_at_once_when_the_other_bridge_ends() -> None:
    pair = await start_pair(lambda: 0.002)
    began = len(pair.states["left"])
    drop(pair, "other_arm", "left")
    killed = pair.bridges.pop("right")
    await pair.run(0.3, pair.targets())
    states = pair.states["left"][began:]
    assert {state.mode for state in states[:4]} == {"hold"}
    assert {state.reason for state in states[:4]} == {OTHER_BRIDGE_ENDED}
    assert states[-1].mode == "idle"
    assert not states[-1].ready
    assert not any(state.faults for state in states)
    # The other arm rests at its last command.
    pair.bridges["right"], commanded = killed, pair.servos["right"].commanded
    commanded += [commanded[-1]] * (len(pair.servos["left"].commanded) - len(commanded))
    pair.check_limits()


async def test_a_short_interruption_makes_the_arms_neither_stop_nor_disarm() -> None:
    pair = await start_pair(lambda: 0.002)
    began = len(pair.states["left"])
    for bridge in pair.bridges.values():
        bridge.sheet_target.has_ended = True
    await pair.run(0.015, pair.targets())
    for bridge in pair.bridges.values():
        bridge.sheet_target.has_ended = False
    await pair.run(0.2, pair.targets())
    for states in pair.states.values():
        assert all(state.ready for state in states[began:])
        assert states[-1].mode == "follow"
    pair.check_limits()


def corrupt(
    kind: str, random: np.random.Generator, targets: Iterator[SheetTarget]
) -> Iterator[Any]:
    """Return a stream of targets of which a third are bad."""
    seen: list[SheetTarget] = []
    for target in targets:
        seen.append(target)
        if random.random() > 0.3:
            yield target
            continue
        changes: dict[str, dict[str, Any]] = {
            "stale": {"valid_at_ns": target.valid_at_ns - 400_000_000},
            "future": {"valid_at_ns": target.valid_at_ns + 10**9},
            "jumping": {
                "world_from_sheet": transform_from_rpy(
                    random.uniform(-0.03, 0.03, 3), random.uniform(-0.5, 0.5, 3)
                ),
                "twist_world": random.uniform(-1.0, 1.0, 6),
            },
            "NaN": {"twist_world": np.full(6, np.nan)},
            "NaN trajectory": {
                "trajectory": SheetTrajectory.model_construct(keep_s=np.nan, brake_s=np.nan)
            },
            "too long": {"trajectory": SheetTrajectory.model_construct(keep_s=9.0, brake_s=9.0)},
            "replayed": dict(seen[0]),
            "reordered": dict(seen[-min(len(seen), 3)]),
        }
        yield target.model_copy(update=changes[kind])


@pytest.mark.parametrize(
    "kind",
    long_except(
        [
            "stale",
            "future",
            "jumping",
            "NaN",
            "NaN trajectory",
            "too long",
            "replayed",
            "reordered",
        ],
        *("jumping", "NaN", "NaN trajectory", "too long", "reordered"),
    ),
)
async def test_no_bad_target_leads_to_a_command_beyond_a_limit(kind: str) -> None:
    random = np.random.default_rng(7)
    pair = await start_pair(make_bad_cables(3))
    await pair.run(1.0, corrupt(kind, random, pair.targets()))
    pair.check_limits()
    if kind in ("NaN trajectory", "too long", "reordered"):
        assert not any(state.faults for states in pair.states.values() for state in states)
