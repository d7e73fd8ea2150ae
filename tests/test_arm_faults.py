"""Test faults of an arm or its network during a stroke, over real sockets.

All time-outs are scaled alike, so that pauses of a busy computer are no faults.
`test_arm_control.py` tests the real ones without a clock.
"""

from __future__ import annotations

import asyncio
import zlib
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from flexsheet.messages.base import Header, Message
from flexsheet.messages.types import ArmState, EStop
from flexsheet.nodes.arm_bridge.link_drivers import make_link
from flexsheet.nodes.arm_bridge.modbus import MAGIC
from flexsheet.nodes.twin import arms as twin_arms
from flexsheet.nodes.twin.arms import (
    STATE_FAULT,
    Fault,
    Servo,
)
from tests.network import TcpRelay
from tests.rv_1a import (
    SPEED_RAD_PER_S,
)
from tests.rv_1a import (
    twin_forward as forward,
)
from tests.test_arm_loop import (
    AT_FRONT,
    Path3,
    Rig,
    both_follow,
    play_finger,
    running_rig,
)
from tests.waiting import until

pytestmark = pytest.mark.alone

MAX_LENGTH_M = 0.24 * 1.09
TIMEOUT_S, LATE_S = 0.25, 0.4
PATIENT = {"timeout_s": TIMEOUT_S, "hold_after_s": 0.1, "stop_after_s": 0.6}
PATIENT_TWIN = {"watchdog_s": 0.8}
STOPPED = {"stopping", "relax", "idle", "fault"}


@dataclass
class Stroke:
    """Stroke in the background that reverses until the test ends."""

    rig: Rig
    nodes: dict[str, Any]
    cut: TcpRelay

    def mode(self, side: str) -> str:
        return self.rig.newest(side).mode

    def modes(self) -> set[str]:
        return {self.mode("left"), self.mode("right")}

    def reasons(self) -> str:
        return "; ".join((*self.rig.newest("left").faults, *self.rig.newest("right").faults))

    def suffer(self, fault: Fault, side: str = "left") -> None:
        self.nodes["twin"].servers[side].controller.fault = fault

    async def goes_on(self) -> None:
        """Wait until both arms follow again without a reset."""
        await until(lambda: self.modes() == {"follow"})
        assert self.reasons() == ""

    async def lasts(self, states: int) -> list[ArmState]:
        """Return the next `states` states of each arm."""
        counts = {side: len(self.rig.states[side]) for side in ("arm_left", "arm_right")}
        await until(
            lambda: all(len(self.rig.states[name]) >= counts[name] + states for name in counts)
        )
        return [state for name in counts for state, _ in self.rig.states[name][counts[name] :]]

    def max_length_m(self) -> float:
        """Return the largest measured length of the sheet."""
        return max(
            state.edge_distance_m or 0.0
            for states in self.rig.states.values()
            for state, _ in states
        )


def to_and_fro(radius: float, seconds: float) -> Path3:
    """Return strokes of +-30 degrees with this period, 1 mm deep in the skin."""

    def path(at_s: float) -> np.ndarray:
        angle, reach = np.radians(30.0) * np.sin(2.0 * np.pi * at_s / seconds), radius - 0.001
        return np.array([0.0, reach * np.sin(angle), reach * np.cos(angle) - radius])

    return path


class FalseStatus(TcpRelay):
    """Proxy that repeats a part of the arm's status with a valid CRC and echo."""

    REPLY_BYTES, BLOCK_AT = 61, 9
    JOINTS, COUNTERS = slice(20, 44), slice(8, 16)

    def __init__(self, target_port: int) -> None:
        super().__init__(target_port)
        self.repeats: tuple[slice, ...] = ()
        self._last = b""

    async def _pass_on(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with suppress(ConnectionError):
            while data := await reader.read(4096):
                writer.write(self._changed(data))
        writer.transport.abort()

    def _changed(self, data: bytes) -> bytes:
        block = bytearray(data[self.BLOCK_AT :])
        if len(data) != self.REPLY_BYTES or block[:2] != MAGIC.to_bytes(2, "big"):
            return data
        for part in self.repeats:
            block[part] = self._last[part]
        block[-4:] = zlib.crc32(block[:-4]).to_bytes(4, "big")
        self._last = bytes(block)
        return data[: self.BLOCK_AT] + bytes(block)


@asynccontextmanager
async def mid_stroke(
    seconds: float = 6.0, proxy: type[TcpRelay] = TcpRelay, **bridge: Any
) -> AsyncIterator[Stroke]:
    """Run both arms with a stroking finger; the left bridge reaches its arm by a proxy."""
    async with (
        running_rig(PATIENT_TWIN, **(PATIENT | bridge)) as (rig, nodes),
        proxy(nodes["twin"].servers["left"].port) as cut,
    ):
        left = nodes["left"]
        left._link.close()
        left._link = make_link("modbus", "127.0.0.1", cut.port, TIMEOUT_S)
        await both_follow(rig, nodes["planner"], AT_FRONT)
        path = to_and_fro(rig.scene.object.geometry.radius_m, seconds)
        task = asyncio.create_task(play_finger(rig, nodes["planner"], path, 60.0))
        stroke = Stroke(rig, nodes, cut)
        try:
            await stroke.lasts(40)
            yield stroke
            assert stroke.max_length_m() <= MAX_LENGTH_M
        finally:
            task.cancel()
            with suppress(asyncio.CancelledError):
                await task


@pytest.mark.parametrize(
    ("repeats", "words"),
    [
        ((FalseStatus.JOINTS,), "trails its command"),
        ((FalseStatus.JOINTS, FalseStatus.COUNTERS), "counters of its status stand still"),
    ],
    ids=["joints", "joints and counters"],
)
async def test_a_status_that_is_repeated_makes_no_arm_leap(
    repeats: tuple[slice, ...], words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    speeds: list[float] = []
    advance = Servo.advance

    def watched(servo: Servo, wanted: np.ndarray, duration_s: float, **kinds: Any) -> None:
        before = forward(servo.joints_rad)[:3, 3]
        advance(servo, wanted, duration_s, **kinds)
        if duration_s > 1e-4:
            shift = np.linalg.norm(forward(servo.joints_rad)[:3, 3] - before)
            speeds.append(float(shift) / duration_s)

    async with mid_stroke(2.5, FalseStatus) as stroke:
        assert isinstance(stroke.cut, FalseStatus)
        monkeypatch.setattr(Servo, "advance", watched)
        stroke.cut.repeats = repeats
        await until(lambda: words in stroke.reasons())
        await until(lambda: stroke.modes() <= {"idle", "fault"})
        states = await stroke.lasts(150)
        # "stopping" is the deceleration within the limits that the next lines verify.
        assert {state.mode for state in states} <= {"idle", "fault", "relax", "stopping"}
        steps = [
            np.abs(np.diff([state.joints_commanded_rad for state, _ in states], axis=0)).max()
            for states in stroke.rig.states.values()
        ]
        # Two beats at the speed of the fastest joint.
        assert max(steps) <= 2.0 / 140.0 * SPEED_RAD_PER_S.max()
        assert max(speeds) <= 0.25


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ("silent", "no answer"),
        ("slow", "no answer"),
        # tests/test_modbus.py tests the error texts of these.
        *(
            pytest.param(fault, words, marks=pytest.mark.long)
            for fault, words in (
                ("exception", "Modbus exception 4"),
                ("bad_crc", "its CRC is wrong"),
                ("old_version", "register map version 0, not 1"),
            )
        ),
        ("repeated", "answer to command"),
    ],
)
async def test_an_arm_without_a_sound_answer_is_lost_and_the_other_stops(
    fault: Fault, words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(twin_arms, "LATE_S", LATE_S)
    async with mid_stroke() as stroke:
        stroke.suffer(fault)
        await until(lambda: stroke.mode("left") == "disconnected")
        assert words in stroke.reasons()
        await until(lambda: stroke.mode("right") in STOPPED)
        await until(lambda: stroke.mode("right") == "idle")
        assert stroke.rig.newest("right").faults == ()
        stroke.suffer("none")
        await stroke.goes_on()


async def test_a_frozen_arm_is_a_fault_until_a_reset() -> None:
    async with mid_stroke(max_tracking_error_rad=0.06) as stroke:
        stroke.suffer("frozen")
        await until(lambda: bool(stroke.reasons()))
        await until(lambda: stroke.modes() <= {"idle", "fault"})
        assert "fault" in stroke.modes()
        stroke.suffer("none")
        states = await stroke.lasts(40)
        # At rest the arms may slacken the sheet once; they follow nothing.
        assert {state.mode for state in states} <= {"idle", "fault", "relax"}
        await until(lambda: stroke.modes() <= {"idle", "fault"})
        for side in ("left", "right"):
            message = EStop(engaged=False, reason="seen to")
            header = stroke.rig.header(stroke.rig.clock.now_ns())
            await stroke.nodes[side].step("estop", message, header)
        await stroke.goes_on()


async def test_an_arm_that_moves_fifty_milliseconds_late_is_lived_with_in_a_slow_stroke() -> None:
    async with mid_stroke(8.0) as stroke:
        stroke.suffer("lagging")
        states = await stroke.lasts(200)
        assert {state.mode for state in states} <= {"follow", "hold"}
        assert stroke.reasons() == ""


async def test_an_arm_that_moves_fifty_milliseconds_late_stops_both_in_a_fast_stroke() -> None:
    async with mid_stroke(1.2, max_tracking_error_rad=0.1) as stroke:
        stroke.suffer("lagging")
        await until(lambda: "trails its command" in stroke.reasons())
        await until(lambda: stroke.modes() <= {"idle", "fault"})


async def test_an_arm_whose_state_comes_late_makes_the_other_hold() -> None:
    async with mid_stroke() as stroke:
        loop, listeners = asyncio.get_running_loop(), stroke.rig.listeners["arm_left"]
        (reported,) = listeners

        def later(message: Message, header: Header) -> None:
            # Longer than any trajectory, shorter than the time after which the arm stops.
            loop.call_later(0.5, reported, message, header)

        listeners[:] = [later]
        await until(lambda: stroke.mode("right") == "hold")
        assert stroke.reasons() == ""
        listeners[:] = [reported]
        await stroke.goes_on()


async def test_a_connection_that_is_reset_once_is_forgiven() -> None:
    async with mid_stroke() as stroke:
        stroke.cut.close_all()
        states = await stroke.lasts(60)
        assert {state.mode for state in states} <= {"follow", "hold"}
        assert stroke.nodes["left"]._link.connections >= 2
        await stroke.goes_on()


async def test_a_cable_that_loses_everything_stops_both_arms() -> None:
    async with mid_stroke() as stroke:
        controller = stroke.nodes["twin"].servers["left"].controller
        stroke.cut.half_open = True
        await until(lambda: controller.state == STATE_FAULT)
        await until(lambda: stroke.mode("left") == "disconnected")
        await until(lambda: stroke.mode("right") == "idle")
        stroke.cut.half_open = False
        await stroke.goes_on()


async def test_a_cable_that_is_drawn_stops_both_until_it_is_back() -> None:
    async with mid_stroke() as stroke:
        stroke.cut.refuse = True
        stroke.cut.close_all()
        await until(lambda: stroke.mode("left") == "disconnected")
        await until(lambda: stroke.mode("right") == "idle")
        stroke.cut.refuse = False
        await stroke.goes_on()


Listeners = dict[str, list[Callable[[Message, Header], None]]]


def without(listeners: Listeners, topics: tuple[str, ...], keep: int) -> Listeners:
    """Return the listeners with only the first `keep` of these topics."""
    return {
        topic: reported[:keep] if topic in topics else reported
        for topic, reported in listeners.items()
    }


@pytest.mark.parametrize(
    "topics",
    [
        pytest.param(("sheet_target",), marks=pytest.mark.long),
        ("sheet_target", "arm_left", "arm_right"),
    ],
)
async def test_a_network_cut_between_the_computers_holds_then_stops_then_continues(
    topics: tuple[str, ...],
) -> None:
    async with mid_stroke() as stroke:
        whole = stroke.rig.listeners
        began = {name: len(states) for name, states in stroke.rig.states.items()}
        stroke.rig.listeners = without(whole, topics, keep=0)
        await until(lambda: stroke.modes() == {"idle"})
        for name, states in stroke.rig.states.items():
            modes = [state.mode for state, _ in states[began[name] :]]
            firsts = [modes.index(mode) for mode in ("hold", "idle")]
            assert firsts == sorted(firsts)
        assert stroke.reasons() == ""
        stroke.rig.listeners = whole
        await stroke.goes_on()


async def test_when_only_one_arms_computer_is_cut_off_both_stop() -> None:
    async with mid_stroke() as stroke:
        whole = stroke.rig.listeners
        # The left bridge listens first to targets; its own state no longer reaches the right one.
        cut = without(whole, ("arm_left", "arm_right"), keep=0)
        cut["sheet_target"] = whole["sheet_target"][1:]
        stroke.rig.listeners = cut
        await until(lambda: stroke.modes() == {"idle"})
        stroke.rig.listeners = whole
        await stroke.goes_on()
