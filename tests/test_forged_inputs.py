"""Test that forged fingertips and forged states of the other arm do not move an arm beyond a limit.

Planner, bridges and simulated controllers run in virtual time. Speeds are those of the simulated
joints and tools.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from numpy.typing import NDArray

from flexsheet.messages.base import Header, Message
from flexsheet.messages.topics import Topic
from flexsheet.messages.types import ArmState, EStop, Fingertip, SheetTarget
from flexsheet.nodes.arm_bridge.geometry import ArmGeometry
from flexsheet.nodes.arm_bridge.path_check import (
    Alignment,
    PathChecker,
    PathCheckRequest,
    check_path,
)
from flexsheet.nodes.models.rigid import transform_from_rpy
from flexsheet.nodes.planner.node import Planner
from flexsheet.nodes.planner.parameters import PlannerParameters
from tests.examples import examples, long_except
from tests.fingertips import fingertip
from tests.rv_1a import (
    RANGE_RAD,
    SPEED_RAD_PER_S,
)
from tests.rv_1a import (
    twin_forward as forward,
)
from tests.test_arm_loop import paper_scene
from tests.test_faults_storm import MAX_LENGTH_M, SIDES, Bench

Floats = NDArray[np.float64]
Random = np.random.Generator
SCENE = paper_scene()
MAX_TOOL_SPEED = SCENE.arms.max_tool_speed_m_per_s
TICK_NS, FINGER_HZ = 1_000_000, 60
AT_FRONT = np.array([0.0, 0.0, -0.001])
STOPPED = {"idle", "stopping", "hold", "relax", "fault"}


def tool_points(side: str, joints_rad: Floats) -> Floats:
    """Return both ends of the clamped edge, and the flange, as points (3, 3), m, in the arm's base
    frame.
    """
    arm = SCENE.arms.left if side == "left" else SCENE.arms.right
    clamp = transform_from_rpy(arm.flange_from_edge.position_m, arm.flange_from_edge.rpy_rad)
    half = 0.5 * SCENE.sheet.height_m * clamp[:3, 1]
    points = np.vstack([clamp[:3, 3] + half, clamp[:3, 3] - half, np.zeros(3)])
    pose = forward(joints_rad)
    return np.asarray(points @ pose[:3, :3].T + pose[:3, 3])


class Immediate(PathChecker):
    """A path checker without delay, for virtual time."""

    def poll(
        self, question: PathCheckRequest | None
    ) -> tuple[PathCheckRequest, Alignment | str] | None:
        if question is None:
            return None
        return question, check_path(self._arm, self._other, question)


def edge_distance_m(joints_rad: Mapping[str, Floats]) -> float:
    """Return the distance (m) between the centres of both edges, from the simulated joint
    angles.
    """
    places = []
    for side, arm in (("left", SCENE.arms.left), ("right", SCENE.arms.right)):
        world_from_base = transform_from_rpy(
            arm.world_from_base.position_m, arm.world_from_base.rpy_rad
        )
        middle = np.append(arm.flange_from_edge.position_m, 1.0)
        places.append(world_from_base @ forward(joints_rad[side]) @ middle)
    return float(np.linalg.norm(places[0] - places[1]))


@dataclass
class ForgedBench(Bench):
    """A test bench with a planner, which can replace the states of the other arm."""

    forge_state: Callable[[ArmState, Header], tuple[ArmState, Header]] | None = None
    targets_published: list[SheetTarget] = field(default_factory=list)
    _points: dict[str, Floats] = field(default_factory=dict)
    max_tool_speed: float = 0.0
    max_joint_ratio: float = 0.0
    max_length_m: float = 0.0
    fingertips: int = 0

    async def set_up(self) -> None:
        self.tick_ns = TICK_NS
        await super().set_up()
        self.planner = Planner(
            PlannerParameters(), name="planner", clock=self.clock, send=self.take
        )
        await self.planner.setup()
        for side, other in (SIDES, SIDES[::-1]):
            self.bridges[side]._path_checker = Immediate(
                ArmGeometry(SCENE, side), ArmGeometry(SCENE, other)
            )
        await self.planner.step("scene", SCENE, self.header("scene", 1))

    def take(self, topic: Topic, message: Message, header: Header) -> None:
        if isinstance(message, SheetTarget):
            self.targets_published.append(message)
            for bridge in self.bridges.values():
                bridge.deliver("sheet_target", message, header)
        elif isinstance(message, ArmState):
            self.states[message.side].append(message)
            if self.forge_state is not None:
                message, header = self.forge_state(message, header)
            other = "right" if topic.name == "arm_left" else "left"
            self.bridges[other].deliver("other_arm", message, header)

    async def pass_tick(self) -> None:
        await super().pass_tick()
        for side in SIDES:
            self.twin._advance(side)
            servo: Any = self.twin.servers[side].controller.servo
            ratio = float(np.abs(servo.velocity_rad_per_s / SPEED_RAD_PER_S).max())
            self.max_joint_ratio = max(self.max_joint_ratio, ratio)
            assert (servo.joints_rad >= RANGE_RAD[:, 0]).all()
            assert (servo.joints_rad <= RANGE_RAD[:, 1]).all()
            points = tool_points(side, servo.joints_rad)
            shift = np.linalg.norm(points - self._points.get(side, points), axis=1).max()
            self.max_tool_speed = max(self.max_tool_speed, float(shift) / (TICK_NS * 1e-9))
            self._points[side] = points
        servos: Any = {side: self.twin.servers[side].controller.servo for side in SIDES}
        length_m = edge_distance_m({side: servo.joints_rad for side, servo in servos.items()})
        self.max_length_m = max(self.max_length_m, length_m)

    async def point(
        self,
        seconds: float,
        tip: Callable[[], tuple[Fingertip, Header]],
        *,
        at_most_until: Callable[[], bool] = lambda: False,
    ) -> None:
        """Advance the time while the planner receives fingertips."""
        begin_ns, reported = self.clock.now_ns(), 0
        while (passed_s := (self.clock.now_ns() - begin_ns) * 1e-9) < seconds:
            if at_most_until():
                return
            if passed_s * FINGER_HZ >= reported:
                reported += 1
                await self.planner.step("fingertip", *tip())
            await self.pass_tick()

    def tip_header(self, age_s: float = 0.008) -> Header:
        self.fingertips += 1
        now_ns = self.clock.now_ns()
        source_ns = now_ns - round(age_s * 1e9)
        return Header(self.fingertips, source_ns, now_ns, self.clock.id, "triangulator", 1)

    def honest(self) -> tuple[Fingertip, Header]:
        return fingertip(AT_FRONT), self.tip_header()

    def assert_within_limits(self) -> None:
        assert self.max_tool_speed <= MAX_TOOL_SPEED
        assert self.max_joint_ratio <= 1.0
        assert self.max_length_m <= MAX_LENGTH_M
        for states in self.states.values():
            for state in states:
                # Whoever does not follow says why.
                assert state.mode == "follow" or state.reason or state.faults
        for node in (self.planner, *self.bridges.values()):
            assert node.errors == 0, node.last_error

    async def reset(self) -> None:
        for bridge in self.bridges.values():
            message = EStop(engaged=False, reason="test")
            await bridge.step("estop", message, self.header("tools", 1))


# Forged fingertips.

FINGERTIPS = (
    "jump", "nan", "infinite", "stale", "future", "fast", "path", "path nan", "behind", "huge",
    "covariance",
)  # fmt: skip


ODD = {"nan": [np.nan], "infinite": [np.inf, -np.inf], "huge": [1e300, -1e300, 1e12]}


def forged_tip(bench: ForgedBench, kind: str, random: Random) -> tuple[Fingertip, Header]:
    honest, header = bench.honest()
    if kind == "jump":
        return fingertip(random.normal(0.0, 0.2, 3)), header
    if kind in ODD:
        odd = float(random.choice(ODD[kind]))
        values = [AT_FRONT.copy(), np.zeros(3)]
        values[int(random.integers(2))][random.integers(3)] = odd
        tip = honest.model_copy(
            update={"position_world_m": values[0], "velocity_world_m_per_s": values[1]}
        )
        path = honest.predicted_path_world_m.copy()
        path[random.integers(len(path))] = odd
        return tip.model_copy(update={"predicted_path_world_m": path}), header
    if kind in ("stale", "future"):
        age_s = random.choice([0.5, 30.0, 1e6]) * (1.0 if kind == "stale" else -1.0)
        tip = fingertip(random.normal(0.0, 0.1, 3))
        return tip, replace(header, source_ns=header.source_ns - round(age_s * 1e9))
    if kind == "fast":
        speed = random.choice([3.0, 100.0, 1e9])
        return fingertip(AT_FRONT, random.normal(0.0, speed, 3)), header
    if kind == "path":
        return honest.model_copy(
            update={"predicted_path_world_m": random.normal(0.0, 0.1, (13, 3))}
        ), header
    if kind == "path nan":
        return honest.model_copy(
            update={"predicted_path_world_m": np.full((13, 3), np.nan)}
        ), header
    if kind == "behind":
        return fingertip(np.array([0.0, 0.0, -random.uniform(0.01, 0.3)])), header
    return honest.model_copy(update={"covariance": np.full((6, 6), np.nan)}), header


def run_bench(test: Callable[[ForgedBench], Awaitable[None]]) -> None:
    """Run a test with a new test bench."""

    async def main() -> None:
        with pytest.MonkeyPatch.context() as patch:
            bench = ForgedBench(patch)
            await bench.set_up()
            try:
                await test(bench)
            finally:
                await bench.clear_away()

    asyncio.run(main())


seeds = st.integers(0, 2**32 - 1)


@examples(3)
@given(kinds=st.lists(st.sampled_from(FINGERTIPS), min_size=1, max_size=4), seed=seeds)
def test_forged_fingertips_move_no_arm_beyond_a_limit(kinds: list[str], seed: int) -> None:
    async def test(bench: ForgedBench) -> None:
        random = np.random.default_rng(seed)
        await bench.point(0.4, bench.honest)
        assert bench.modes() == {"follow"}

        def tip() -> tuple[Fingertip, Header]:
            # One in three is true, so that the forged ones are leaps from it.
            if random.random() < 0.33:
                return bench.honest()
            return forged_tip(bench, kinds[int(random.integers(len(kinds)))], random)

        await bench.point(0.8, tip)
        bench.assert_within_limits()
        for target in bench.targets_published:
            assert np.isfinite(target.world_from_sheet).all()
            assert np.isfinite(target.twist_world).all()
            assert target.phase in ("approach", "contact") or target.reason != "ok"

    run_bench(test)


@pytest.mark.parametrize(
    "kind",
    long_except(["nan", "infinite", "stale", "future", "path nan"], "nan", "stale", "path nan"),
)
def test_a_fingertip_that_cannot_be_holds_the_sheet_and_the_target_reports_why(kind: str) -> None:
    async def test(bench: ForgedBench) -> None:
        random = np.random.default_rng(len(kind))
        await bench.point(0.4, bench.honest)
        before = bench.targets_published[-1].world_from_sheet
        reported = len(bench.targets_published)
        await bench.point(0.3, lambda: forged_tip(bench, kind, random))
        for target in bench.targets_published[reported:]:
            assert target.phase == "hold"
            assert target.reason != "ok"
            assert target.world_from_sheet == pytest.approx(before, abs=1e-3)
        await bench.point(0.3, bench.honest)
        assert bench.modes() == {"follow"}
        bench.assert_within_limits()

    run_bench(test)


# Forged states of the other arm.

Forge = Callable[[ArmState, Random], dict[str, Any]]


def moved_pose(pose: Floats, random: Random) -> Floats:
    """Return the pose with a small or a large random displacement and rotation."""
    shift = random.normal(0.0, random.choice([0.005, 0.05, 0.5]), 3)
    turn = random.normal(0.0, random.choice([0.02, 0.3, 2.0]), 3)
    return np.asarray(transform_from_rpy(shift, turn) @ pose)


STATES: dict[str, Forge] = {
    "elsewhere": lambda state, random: {
        "world_from_flange": moved_pose(state.world_from_flange, random),
        "world_from_flange_commanded": moved_pose(state.world_from_flange_commanded, random),
    },
    "commanded elsewhere": lambda state, random: {
        "world_from_flange_commanded": moved_pose(state.world_from_flange_commanded, random)
    },
    "not rigid": lambda state, random: {
        "world_from_flange": state.world_from_flange * random.uniform(0.5, 2.0)
    },
    "mirrored": lambda state, random: {
        "world_from_flange_commanded": state.world_from_flange_commanded
        @ np.diag([1.0, 1.0, -1.0, 1.0])
    },
    "nan": lambda state, random: {
        str(random.choice(["joints_rad"])): np.full(6, random.choice([np.nan, np.inf]))
    },
    "nan pose": lambda state, random: {"world_from_flange": np.full((4, 4), np.nan)},
    "huge": lambda state, random: {"joints_rad": np.full(6, 1e300)},
    "not ready": lambda state, random: {"ready": bool(random.random() < 0.5)},
    "mode": lambda state, random: {
        "mode": str(random.choice(["follow", "idle", "hold", "fault", "disconnected", "relax"]))
    },
    "faults": lambda state, random: {"faults": ("forged",)},
    "joints": lambda state, random: {"joints_rad": random.uniform(-3.0, 3.0, 6)},
}


def forger(
    kinds: list[str], random: Random, share: float
) -> Callable[[ArmState, Header], tuple[ArmState, Header]]:
    """Return a function that replaces a fraction of the states."""

    def forge(state: ArmState, header: Header) -> tuple[ArmState, Header]:
        if random.random() > share:
            return state, header
        kind = kinds[int(random.integers(len(kinds)))]
        if kind == "future":
            ahead_ns = int(random.choice([10**8, 10**10, 10**15]))
            return state, replace(header, source_ns=header.source_ns + ahead_ns)
        return state.model_copy(update=STATES[kind](state, random)), header

    return forge


@examples(2)
@example(kinds=["not rigid"], seed=0, share=0.05)
@given(
    kinds=st.lists(st.sampled_from([*STATES, "future"]), min_size=1, max_size=3),
    seed=seeds,
    share=st.sampled_from([0.05, 0.5, 1.0]),
)
def test_forged_states_of_the_other_arm_move_no_arm_beyond_a_limit(
    kinds: list[str], seed: int, share: float
) -> None:
    async def test(bench: ForgedBench) -> None:
        await bench.point(0.4, bench.honest)
        bench.forge_state = forger(kinds, np.random.default_rng(seed), share)
        await bench.point(0.4, bench.honest)
        await bench.reset()
        await bench.point(0.4, bench.honest)
        bench.assert_within_limits()

    run_bench(test)


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("not rigid", "state of the other arm: its flange is not a rigid pose"),
        ("mirrored", "state of the other arm: its flange is not a rigid pose"),
        ("nan pose", "state of the other arm: its flange is not a rigid pose"),
        ("nan", "state of the other arm: its joint angles are not finite"),
        ("faults", "other arm: forged"),
    ],
)
def test_an_invalid_state_of_the_other_arm_stops_and_is_named(kind: str, words: str) -> None:
    async def test(bench: ForgedBench) -> None:
        await bench.point(0.4, bench.honest)
        assert bench.modes() == {"follow"}
        bench.forge_state = forger([kind], np.random.default_rng(1), 1.0)
        await bench.point(0.3, bench.honest)
        for side in SIDES:
            assert bench.states[side][-1].mode in STOPPED
            assert words in bench.states[side][-1].reason
        bench.forge_state = None
        await bench.point(1.5, bench.honest, at_most_until=lambda: bench.modes() == {"follow"})
        assert bench.modes() == {"follow"}
        bench.assert_within_limits()

    run_bench(test)


def test_a_state_from_the_future_does_not_hide_that_the_other_arm_is_silent() -> None:
    async def test(bench: ForgedBench) -> None:
        await bench.point(0.4, bench.honest)
        last: list[tuple[ArmState, Header]] = []

        def once(state: ArmState, header: Header) -> tuple[ArmState, Header]:
            if not last:
                last.append((state, replace(header, source_ns=header.source_ns + 10**12)))
            return last[0]

        bench.forge_state = once
        await bench.point(0.3, bench.honest)
        for side in SIDES:
            assert bench.states[side][-1].mode in STOPPED
            assert "in the future" in bench.states[side][-1].reason

    run_bench(test)
