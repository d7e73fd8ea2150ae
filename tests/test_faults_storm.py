"""Test a defective planner that sends invalid targets at a hundred times its normal rate.

The test runs in virtual time, so that the interval of every command is known.
"""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from flexsheet.messages.base import Header, Message
from flexsheet.messages.clock import VirtualClock
from flexsheet.messages.topics import Topic
from flexsheet.messages.types import ArmState, SheetTarget, Side
from flexsheet.nodes.arm_bridge import node as bridge_node
from flexsheet.nodes.arm_bridge.geometry import ArmGeometry
from flexsheet.nodes.arm_bridge.link import CounterMonitor
from flexsheet.nodes.arm_bridge.modbus import ModbusStatus, decode_status, encode_command
from flexsheet.nodes.arm_bridge.node import ArmBridge, ArmBridgeParameters
from flexsheet.nodes.models.rigid import transform_from_rpy
from flexsheet.nodes.twin.arms_node import TwinArmsNode, TwinArmsParameters
from tests.rv_1a import (
    SPEED_RAD_PER_S,
)
from tests.test_arm_loop import paper_scene

Floats = NDArray[np.float64]

SIDES: tuple[Side, Side] = ("left", "right")
TICK_NS, TARGET_HZ, STORM = 166_667, 60, 100
ANSWER_S, BEAT_S = 0.001, 1 / 140.8
MAX_LENGTH_M = 0.24 * 1.09


@dataclass
class Sent:
    """A command that an arm has received."""

    at_s: float
    mode: str
    joints_rad: Floats


@dataclass
class Bench:
    """Both bridges with the simulated controllers, in virtual time. The method `pass_tick` advances
    the time.
    """

    monkeypatch: pytest.MonkeyPatch
    clock: VirtualClock = field(default_factory=lambda: VirtualClock(10**9))
    states: dict[str, list[ArmState]] = field(default_factory=lambda: {side: [] for side in SIDES})
    sent: dict[str, list[Sent]] = field(default_factory=lambda: {side: [] for side in SIDES})
    speeds: list[Floats] = field(default_factory=list)
    bridges: dict[str, ArmBridge] = field(default_factory=dict)
    targets: int = 0
    tick_ns: int = TICK_NS
    _sleepers: list[tuple[int, asyncio.Future[None]]] = field(default_factory=list)
    _beats: dict[str, tuple[int, asyncio.Task[None] | None]] = field(default_factory=dict)

    async def set_up(self) -> None:
        scene, header = paper_scene(), self.header("scene", 1)
        self.twin = TwinArmsNode(
            TwinArmsParameters(left_port=0, right_port=0),
            name="twin", clock=self.clock, send=lambda *_: None,
        )  # fmt: skip
        await self.twin.setup()
        await self.twin.step("scene", scene, header)
        sleep = asyncio.sleep
        self._yield = lambda: sleep(0)
        self.monkeypatch.setattr(bridge_node.asyncio, "sleep", self.sleep)
        for side, other in (SIDES, SIDES[::-1]):
            self.bridges[side] = bridge = ArmBridge(
                ArmBridgeParameters(side=side, port=1, arming="auto"),
                name=f"arm_{side}_bridge", clock=self.clock, send=self.take,
                topics={"arm": f"arm_{side}", "other_arm": f"arm_{other}"},
            )  # fmt: skip
            await bridge.setup()
            bridge._link = Link(self, side)
            await bridge.step("scene", scene, header)
            self._beats[side] = (0, None)

    async def clear_away(self) -> None:
        self.monkeypatch.undo()
        await self.twin.close()

    def header(self, writer: str, number: int) -> Header:
        now_ns = self.clock.now_ns()
        return Header(number, now_ns, now_ns, self.clock.id, writer, 1)

    def take(self, topic: Topic, message: Message, header: Header) -> None:
        if isinstance(message, ArmState):
            self.states[message.side].append(message)
            other = SIDES[message.side == "left"]
            self.bridges[other].deliver("other_arm", message, header)

    async def sleep(self, delay_s: float) -> None:
        """Replace asyncio.sleep."""
        wakes: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._sleepers.append((self.clock.now_ns() + int(delay_s * 1e9), wakes))
        await wakes

    def tell(self, target: SheetTarget) -> None:
        self.targets += 1
        for bridge in self.bridges.values():
            bridge.deliver("sheet_target", target, self.header("planner", self.targets))

    async def pass_tick(self) -> None:
        now_ns = self.clock.now_ns() + self.tick_ns
        self.clock.move_to(now_ns)
        due = [one for one in self._sleepers if one[0] <= now_ns]
        self._sleepers = [one for one in self._sleepers if one[0] > now_ns]
        for _, wakes in due:
            if not wakes.done():
                wakes.set_result(None)
        for side, (due_ns, task) in self._beats.items():
            if now_ns >= due_ns and (task is None or task.done()):
                bridge = self.bridges[side]
                beat = asyncio.create_task(bridge.call("cycle", bridge.cycle))
                self._beats[side] = (now_ns + int(BEAT_S * 1e9), beat)
        for _ in range(4):
            await self._yield()

    async def run(self, seconds: float, targets: Iterator[SheetTarget], *, rate_hz: float) -> None:
        """Advance the time while the planner sends targets at a rate."""
        begin_ns, reported = self.clock.now_ns(), 0
        while (passed_s := (self.clock.now_ns() - begin_ns) * 1e-9) < seconds:
            if passed_s * rate_hz >= reported:
                reported += 1
                self.tell(next(targets))
            await self.pass_tick()

    def modes(self) -> set[str]:
        return {states[-1].mode if states else "none" for states in self.states.values()}


@dataclass
class Link:
    """A link to a simulated arm controller that answers after one millisecond, without a
    network.
    """

    bench: Bench
    side: str
    sequence: int = 0
    counters: CounterMonitor = field(default_factory=CounterMonitor)

    def due(self, now_ns: int) -> bool:
        return True

    async def exchange(self, *, mode: str, joints_rad: Floats, now_ns: int) -> ModbusStatus:
        self.sequence += 1
        self.bench.sent[self.side].append(Sent(now_ns * 1e-9, mode, joints_rad.copy()))
        self.bench.twin._advance(self.side)
        controller: Any = self.bench.twin.servers[self.side].controller
        command = encode_command(
            sequence=self.sequence, time_us=0, mode=mode, joints_rad=joints_rad
        )
        assert controller.receive_command(command)
        self.bench.speeds.append(controller.servo.velocity_rad_per_s.copy())
        await self.bench.sleep(ANSWER_S)
        self.bench.twin._advance(self.side)
        status = decode_status(controller.status_registers())
        freshness = self.counters.classify(
            (status.time_us, status.cycle),
            sent_ns=now_ns,
            received_ns=self.bench.clock.now_ns(),
            may_restart=mode == "idle",
        )
        return replace(status, freshness=freshness)

    def close(self) -> None:
        pass


def target(lean_rad: float, now_ns: int, *, twist: Floats | None = None) -> SheetTarget:
    return SheetTarget(
        phase="contact",
        reason="ok",
        valid_at_ns=now_ns,
        world_from_sheet=transform_from_rpy(np.zeros(3), [lean_rad, 0.0, 0.0]),
        twist_world=np.zeros(6) if twist is None else twist,
        stretch_ratio=1.04,
        contact_world_m=np.zeros(3),
        normal_world=np.array([0.0, 0.0, 1.0]),
        contact_sheet_m=np.zeros(2),
        push_depth_m=0.0,
    )


def steady(clock: VirtualClock) -> Iterator[SheetTarget]:
    while True:
        yield target(0.1, clock.now_ns())


def mad(clock: VirtualClock) -> Iterator[SheetTarget]:
    """Yield random targets with impossible speeds, and with timestamps in the past and future."""
    chance = np.random.default_rng(3)
    while True:
        moment_ns = clock.now_ns() + int(chance.uniform(-0.05, 0.05) * 1e9)
        yield target(chance.uniform(-0.4, 0.4), moment_ns, twist=chance.normal(0.0, 3.0, 6))


def accelerations(sent: list[Sent]) -> tuple[Floats, Floats]:
    """Return velocities and accelerations (n, 6) of commands, from the true times between them."""
    joints_rad = np.array([one.joints_rad for one in sent])
    steps_s = np.diff([one.at_s for one in sent])[:, None]
    velocities = np.diff(joints_rad, axis=0) / steps_s
    return velocities, np.diff(velocities, axis=0) / steps_s[1:]


async def test_a_storm_of_targets_breaks_no_limit_and_stops_no_cycle(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    bench = Bench(monkeypatch)
    await bench.set_up()
    ports = [bench.bridges[side].sheet_target for side in SIDES]
    try:
        await bench.run(1.5, steady(bench.clock), rate_hz=TARGET_HZ)
        assert bench.modes() == {"follow"}
        begun_s, reported = bench.clock.now_ns() * 1e-9, bench.targets
        assert [port.counts.dropped for port in ports] == [0, 0]
        await bench.run(1.0, mad(bench.clock), rate_hz=STORM * TARGET_HZ)
        ended_s = bench.clock.now_ns() * 1e-9
        assert bench.targets - reported > 5900
        await bench.run(1.0, steady(bench.clock), rate_hz=TARGET_HZ)
        # Who writes sense again is followed again.
        assert bench.modes() == {"follow"}
        assert [bridge.errors for bridge in bench.bridges.values()] == [0, 0]
    finally:
        await bench.clear_away()
    for port in ports:
        # One may be waiting still.
        assert bench.targets - port.counts.messages - port.counts.dropped in (0, 1)
        assert port.counts.dropped > 5000
    for side in SIDES:
        stormed = [one.at_s for one in bench.sent[side] if begun_s < one.at_s < ended_s]
        intervals_s = np.diff(stormed)
        assert intervals_s.max() < BEAT_S, "no cycle is left out"
        assert intervals_s.min() > 0.5 * BEAT_S, "nor made more often than an arm may be told"
        limits = ArmGeometry(paper_scene(), side).joint_limits
        moves = [one for one in bench.sent[side] if one.at_s > begun_s - 0.5]
        velocities, changes = accelerations(moves)
        assert np.ptp([one.joints_rad for one in moves], axis=0).max() > 1e-3, "it does move"
        assert (np.abs(velocities) <= limits.speed_rad_per_s * 1.000001).all()
        assert (np.abs(changes) <= limits.acceleration_rad_per_s2 * 1.000001).all()
        # Each exchange is told of; the newest may be under way.
        assert len(bench.sent[side]) - len(bench.states[side]) in (0, 1)
        faults = {state.faults for state in bench.states[side][len(bench.states[side]) // 2 :]}
        assert faults == {()}
    assert (np.abs(bench.speeds) <= SPEED_RAD_PER_S).all()
    lengths_m = [one.edge_distance_m or 0.0 for states in bench.states.values() for one in states]
    assert max(lengths_m) <= MAX_LENGTH_M
