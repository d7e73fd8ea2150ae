"""Test planner, both bridges and the simulated arms in one loop, over real loopback sockets."""

from __future__ import annotations

import asyncio
import math
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from flexsheet.messages.base import Header, Message
from flexsheet.messages.clock import SystemClock
from flexsheet.messages.scene import Scene
from flexsheet.messages.topics import Topic
from flexsheet.messages.types import ArmState, EStop, Fingertip, SheetTarget
from flexsheet.nodes.arm_bridge.node import ArmBridge, ArmBridgeParameters
from flexsheet.nodes.models.rigid import inverse, transform_from_rpy
from flexsheet.nodes.models.sheet import sheet_from_edges
from flexsheet.nodes.planner.node import Planner
from flexsheet.nodes.planner.parameters import PlannerParameters
from flexsheet.nodes.twin.arms import (
    STATE_MOVING,
    STATE_STOPPED,
)
from flexsheet.nodes.twin.arms_node import TwinArmsNode, TwinArmsParameters
from tests.fingertips import fingertip
from tests.scenes import load_cylinder, make_weightless
from tests.waiting import DEADLINE_S, until

pytestmark = pytest.mark.alone

Floats = NDArray[np.float64]
PATIENT: dict[str, Any] = {"timeout_s": 0.25, "hold_after_s": 0.1, "stop_after_s": 0.6}
PATIENT_TWIN = {"watchdog_s": 0.8}
"""Watchdog for a busy machine, which pauses longer than an arm's computer."""
SCENE_FILE = Path(__file__).parent.parent / "launch" / "scenes" / "cylinder.yaml"


def paper_scene() -> Scene:
    return make_weightless(load_cylinder())


def finger_at(position: Floats, velocity: Floats, *, valid: bool = True) -> Fingertip:
    return fingertip(position, velocity, reason="ok" if valid else "no_marker")


@dataclass
class Sample:
    """Sample at one instant: true sheet between the measured edges, and the finger."""

    at_ns: int
    world_from_sheet: Floats
    edge_distance_m: float


@dataclass
class Rig:
    """All nodes of the arms, connected directly; messages arrive immediately."""

    scene: Scene
    clock: SystemClock = field(default_factory=SystemClock)
    targets: list[tuple[SheetTarget, Header]] = field(default_factory=list)
    states: dict[str, list[tuple[ArmState, Header]]] = field(
        default_factory=lambda: {"arm_left": [], "arm_right": []}
    )
    samples: list[Sample] = field(default_factory=list)
    listeners: dict[str, list[Callable[[Message, Header], None]]] = field(default_factory=dict)
    sequence: int = 0

    def send(self, topic: Topic, message: Message, header: Header) -> None:
        if isinstance(message, SheetTarget):
            self.targets.append((message, header))
        if isinstance(message, ArmState):
            self.states[topic.name].append((message, header))
        for listener in self.listeners.get(topic.name, []):
            listener(message, header)

    def header(self, source_ns: int) -> Header:
        self.sequence += 1
        now_ns = self.clock.now_ns()
        return Header(self.sequence, source_ns, now_ns, self.clock.id, "test", 1)

    def listen(self, topic: str, node: Any, port: str) -> None:
        self.listeners.setdefault(topic, []).append(
            lambda message, header: node.deliver(port, message, header)
        )

    def newest(self, side: str) -> ArmState:
        return self.states[f"arm_{side}"][-1][0]

    def edges(self) -> tuple[Floats, Floats]:
        poses = []
        for side, spec in (("left", self.scene.arms.left), ("right", self.scene.arms.right)):
            clamp = transform_from_rpy(
                spec.flange_from_edge.position_m, spec.flange_from_edge.rpy_rad
            )
            poses.append(self.newest(side).world_from_flange @ clamp)
        return poses[0], poses[1]


@asynccontextmanager
async def running_rig(
    twin_parameters: dict[str, Any] | None = None, **bridge_parameters: Any
) -> AsyncIterator[tuple[Rig, dict[str, Any]]]:
    """Run the planner, two bridges and the simulated arms; yield the rig and the nodes."""
    rig = Rig(paper_scene())
    twin = TwinArmsNode(
        TwinArmsParameters(left_port=0, right_port=0, **(PATIENT_TWIN | (twin_parameters or {}))),
        name="twin",
        clock=rig.clock,
        send=rig.send,
    )
    await twin.setup()
    await twin.step("scene", rig.scene, rig.header(0))
    assert twin.errors == 0, twin.last_error
    nodes: dict[str, Any] = {"twin": twin}
    for side in ("left", "right"):
        other = "right" if side == "left" else "left"
        nodes[side] = ArmBridge(
            ArmBridgeParameters(
                side=side,
                port=twin.servers[side].port,
                **({"arming": "auto"} | PATIENT | bridge_parameters),
            ),
            name=f"bridge_{side}",
            clock=rig.clock,
            send=rig.send,
            topics={"arm": f"arm_{side}", "other_arm": f"arm_{other}"},
        )
    nodes["planner"] = Planner(PlannerParameters(), name="planner", clock=rig.clock, send=rig.send)
    for side in ("left", "right"):
        other = "right" if side == "left" else "left"
        rig.listen("sheet_target", nodes[side], "sheet_target")
        rig.listen(f"arm_{other}", nodes[side], "other_arm")
    for name in ("left", "right", "planner"):
        await nodes[name].setup()
        await nodes[name].step("scene", rig.scene, rig.header(0))

    async def cycle(node: Any, period_s: float) -> None:
        due_s = asyncio.get_running_loop().time()
        while True:
            await node.call("cycle", node.cycle)
            due_s = max(due_s + period_s, asyncio.get_running_loop().time())
            await asyncio.sleep(due_s - asyncio.get_running_loop().time())

    tasks = [asyncio.create_task(cycle(nodes[name], 1 / 140)) for name in ("left", "right", "twin")]
    try:
        yield rig, nodes
        for node in nodes.values():
            assert node.errors == 0, node.last_error
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        for name in ("left", "right", "planner", "twin"):
            await nodes[name].close()
        await asyncio.sleep(0.02)


Path3 = Callable[[float], Floats]


async def play_finger(
    rig: Rig,
    planner: Planner,
    path: Path3,
    seconds: float,
    *,
    noise_m: float = 0.0,
    latency_s: float = 0.008,
) -> None:
    """Pass 60 fingertips per second to the planner, each `latency_s` after its exposure."""
    random = np.random.default_rng(5)
    loop = asyncio.get_running_loop()
    begin_s, begin_ns = loop.time(), rig.clock.now_ns()
    count = int(seconds * 60)
    for number in range(count):
        at_s = number / 60
        early_s = begin_s + at_s + latency_s - loop.time()
        if early_s < -1 / 60 and number + 1 < count:
            # A busy machine misses frames; none is handed over late.
            continue
        await asyncio.sleep(max(0.0, early_s))
        velocity = (path(at_s + 1e-4) - path(at_s - 1e-4)) / 2e-4
        position = path(at_s) + noise_m * random.standard_normal(3)
        message = finger_at(position, velocity)
        await planner.step("fingertip", message, rig.header(begin_ns + int(at_s * 1e9)))
        if rig.states["arm_left"] and rig.states["arm_right"]:
            left, right = rig.edges()
            distance = float(np.linalg.norm(left[:3, 3] - right[:3, 3]))
            stamps = [rig.states[f"arm_{side}"][-1][1].source_ns for side in ("left", "right")]
            rig.samples.append(Sample(sum(stamps) // 2, sheet_from_edges(left, right), distance))


def still(position: Floats) -> Path3:
    return lambda _: position


def stroke_path(radius: float, depth: float, seconds: float) -> Path3:
    """Make a stroke from the front of the cylinder to 60 degrees, smoothed, `depth` within its
    skin."""

    def path(at_s: float) -> Floats:
        share = min(max(at_s / seconds, 0.0), 1.0)
        angle = math.radians(60.0) * share * share * (3.0 - 2.0 * share)
        reach = radius - depth
        return np.array([0.0, reach * math.sin(angle), reach * math.cos(angle) - radius])

    return path


@asynccontextmanager
async def pointing(rig: Rig, planner: Planner, position: Floats) -> AsyncIterator[None]:
    """Keep the finger at a position until the context ends."""
    task = asyncio.create_task(play_finger(rig, planner, still(position), DEADLINE_S))
    try:
        yield
    finally:
        task.cancel()
        with suppress(asyncio.CancelledError):
            await task


async def both_follow(rig: Rig, planner: Planner, position: Floats) -> None:
    """Bring the sheet to a resting finger, and wait until both arms follow."""

    def following() -> bool:
        return all(
            bool(rig.states[f"arm_{side}"]) and rig.newest(side).mode == "follow"
            for side in ("left", "right")
        )

    await play_finger(rig, planner, still(position), 0.3)
    async with pointing(rig, planner, position):
        await until(following, "both arms to follow")


AT_FRONT = np.array([0.0, 0.0, -0.001])


def presented_errors(rig: Rig, path: Path3, begin_ns: int) -> tuple[Floats, Floats]:
    """Return position (m) and angle (rad) errors of the rendered contact point per sample.

    The contact point is where the measured sheet's plane is tangent to the cylinder; the finger at
    the same instant is projected on the cylinder.
    """
    radius = rig.scene.object.geometry.radius_m
    distances, angles = [], []
    for sample in rig.samples:
        if sample.at_ns < begin_ns:
            continue
        finger = path((sample.at_ns - begin_ns) * 1e-9)
        wanted = math.atan2(finger[1], finger[2] + radius)
        normal = sample.world_from_sheet[:3, 2]
        shown = math.atan2(normal[1], normal[2])
        point = np.array([0.0, radius * math.sin(wanted), radius * math.cos(wanted) - radius])
        off_plane = float(normal @ (point - sample.world_from_sheet[:3, 3]))
        distances.append(math.hypot(radius * (shown - wanted), off_plane))
        angles.append(abs(shown - wanted))
    return np.array(distances), np.array(angles)


async def test_a_stroke_is_presented_where_the_finger_is() -> None:
    async with running_rig() as (rig, nodes):
        planner = nodes["planner"]
        await both_follow(rig, planner, AT_FRONT)
        await play_finger(rig, planner, still(AT_FRONT), 0.5)
        path = stroke_path(rig.scene.object.geometry.radius_m, 0.001, 4.0)
        begin_ns = rig.clock.now_ns()
        rig.samples.clear()
        await play_finger(rig, planner, path, 4.0)
        distances, angles = presented_errors(rig, path, begin_ns)
        assert distances.mean() < 0.0004
        assert np.degrees(angles.mean()) < 0.4
        # Rolling: the way on the sheet equals the arc.
        contact_y = inverse(rig.samples[-1].world_from_sheet) @ np.append(path(4.0), 1.0)
        arc = rig.scene.object.geometry.radius_m * math.radians(60.0)
        assert contact_y[1] == pytest.approx(arc, abs=0.0005)
        stretches = np.array([sample.edge_distance_m for sample in rig.samples])
        assert np.ptp(stretches) < 0.0005


async def estop(rig: Rig, nodes: dict[str, Any], *, engaged: bool) -> None:
    for side in ("left", "right"):
        message = EStop(engaged=engaged, reason="test")
        await nodes[side].step("estop", message, rig.header(rig.clock.now_ns()))


async def test_the_estop_stays_until_it_is_reset() -> None:
    async with running_rig() as (rig, nodes):
        planner = nodes["planner"]
        await both_follow(rig, planner, AT_FRONT)
        async with pointing(rig, planner, AT_FRONT):
            await estop(rig, nodes, engaged=True)
            await until(lambda: {rig.newest(side).mode for side in ("left", "right")} == {"estop"})
            count = len(rig.states["arm_left"])
            await until(lambda: len(rig.states["arm_left"]) > count + 30)
            assert rig.newest("left").mode == "estop"
            await estop(rig, nodes, engaged=False)
            await until(lambda: {rig.newest(side).mode for side in ("left", "right")} == {"follow"})


async def test_without_new_targets_the_arms_hold_and_then_stop() -> None:
    async with running_rig() as (rig, nodes):
        planner = nodes["planner"]
        await both_follow(rig, planner, AT_FRONT)
        await until(lambda: rig.newest("left").mode == "hold")
        await until(lambda: {rig.newest(side).mode for side in ("left", "right")} == {"idle"})
        assert all(rig.newest(side).faults == () for side in ("left", "right"))


async def test_a_fault_relaxes_the_sheet_on_both_arms() -> None:
    async with running_rig() as (rig, nodes):
        planner = nodes["planner"]
        await both_follow(rig, planner, AT_FRONT)
        nodes["left"]._control.faults = ("drill",)
        await until(lambda: rig.newest("right").mode in ("stopping", "relax"))

        def slack() -> bool:
            left, right = rig.edges()
            return float(np.linalg.norm(left[:3, 3] - right[:3, 3])) <= 0.2405

        await until(slack)
        await until(lambda: rig.newest("left").mode == "fault")
        assert rig.newest("right").faults == ()


async def test_a_bridge_that_ends_commands_its_arm_to_stop() -> None:
    async with running_rig() as (rig, nodes):
        await both_follow(rig, nodes["planner"], AT_FRONT)
        controllers = [server.controller for server in nodes["twin"].servers.values()]
        assert {controller.state for controller in controllers} == {STATE_MOVING}
    assert {controller.state for controller in controllers} == {STATE_STOPPED}
