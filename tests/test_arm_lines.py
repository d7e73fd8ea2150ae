"""Test the example of an arm's driver against a simulated arm that speaks lines of text."""

from __future__ import annotations

import asyncio
import math
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import numpy as np
import pytest
from numpy.typing import NDArray

from flexsheet.nodes.arm_bridge.lines import LineLink, decode_line, encode_line
from flexsheet.nodes.arm_bridge.link import (
    ArmAnswerError,
    ArmFault,
    ArmSilentError,
    Freshness,
)
from flexsheet.nodes.arm_bridge.link_drivers import make_link
from flexsheet.nodes.twin.arms import RV_1A_MECHANICS, Servo

Floats = NDArray[np.float64]

START = RV_1A_MECHANICS.start_rad
CYCLE_S = 0.008


class LineArm:
    """Simulated arm; each command takes one cycle of its servos.

    answer: replaces the answer to the next commands; None: the true one.
    """

    def __init__(self) -> None:
        self.servo = Servo(START.copy(), 0.02)
        self.count, self.faults = 0, "-"
        self.commands: list[list[str]] = []
        self.answer: bytes | None = None

    def obey(self, line: bytes) -> bytes:
        sequence, mode, *joints = line.decode().split()
        self.commands.append([sequence, mode, *joints])
        wanted = np.array([float(angle) for angle in joints])
        self.servo.advance(wanted, CYCLE_S, braking=mode != "move")
        self.count += 1
        if self.answer is not None:
            return self.answer
        angles = " ".join(f"{angle:.9g}" for angle in self.servo.joints_rad)
        return f"{sequence} {self.count} {self.faults} {angles}\n".encode()

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            while line := await reader.readline():
                answer = self.obey(line)
                if not answer:
                    break
                writer.write(answer)
        except ConnectionError:
            pass
        finally:
            writer.close()


@asynccontextmanager
async def connected(timeout_s: float = 5.0) -> AsyncIterator[tuple[LineArm, LineLink]]:
    arm = LineArm()
    server = await asyncio.start_server(arm.serve, "127.0.0.1", 0)
    link = LineLink("127.0.0.1", server.sockets[0].getsockname()[1], timeout_s=timeout_s)
    try:
        yield arm, link
    finally:
        link.close()
        server.close()
        await server.wait_closed()


async def test_the_arm_follows_a_stream_of_joints() -> None:
    goal = START + 0.02
    async with connected() as (arm, link):
        first = await link.exchange(mode="idle", joints_rad=START, now_ns=0)
        assert first.freshness is Freshness.FIRST
        assert first.joints_rad == pytest.approx(START, abs=1e-8)
        status = first
        for cycle in range(1, 60):
            now_ns = round(cycle * CYCLE_S * 1e9)
            status = await link.exchange(mode="move", joints_rad=goal, now_ns=now_ns)
            assert status.freshness is Freshness.FRESH
        assert status.joints_rad == pytest.approx(goal, abs=1e-4)
        assert link.connections == 1
        assert arm.commands[-1][1] == "move"


async def test_faults_of_the_arm_are_reported() -> None:
    async with connected() as (arm, link):
        arm.faults = "servo,joint_range"
        status = await link.exchange(mode="hold", joints_rad=START, now_ns=0)
        assert status.faults == (ArmFault.SERVO, ArmFault.JOINT_RANGE)


@pytest.mark.parametrize(
    "answer",
    [
        b"hello\n",
        b"9 1 - 0 0 0 0 0 0\n",
        b"1 1 - 0 0 0 0 0\n",
        b"1 1 - 0 0 0 0 0 nan\n",
        b"1 1 fire 0 0 0 0 0 0\n",
        b"1 -1 - 0 0 0 0 0 0\n",
        b"\xff\n",
        b"1 " + b"x" * 600 + b"\n",
    ],
)
async def test_a_false_answer_closes_the_connection(answer: bytes) -> None:
    async with connected() as (arm, link):
        arm.answer = answer
        with pytest.raises(ArmAnswerError):
            await link.exchange(mode="move", joints_rad=START, now_ns=0)
        assert not link.connected
        arm.answer = None
        assert link.due(0)
        await link.exchange(mode="idle", joints_rad=START, now_ns=0)
        assert link.connections == 2


async def test_an_arm_that_closes_the_connection_is_silent() -> None:
    async with connected() as (arm, link):
        arm.answer = b""
        for attempt in range(2):
            with pytest.raises(ArmSilentError):
                await link.exchange(mode="move", joints_rad=START, now_ns=0)
            assert link.due(0) == (attempt == 0)


async def test_an_arm_that_does_not_answer_is_silent() -> None:
    async def ignore(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.read()
        writer.close()

    server = await asyncio.start_server(ignore, "127.0.0.1", 0)
    port = server.sockets[0].getsockname()[1]
    link = make_link("lines", "127.0.0.1", port, 0.01)
    with pytest.raises(ArmSilentError, match="no answer"):
        await link.exchange(mode="idle", joints_rad=START, now_ns=0)
    server.close()
    link = make_link("lines", "127.0.0.1", port, 0.5)
    with pytest.raises(ArmSilentError, match="no connection"):
        await link.exchange(mode="idle", joints_rad=START, now_ns=0)


def test_joints_that_are_not_finite_are_never_sent() -> None:
    with pytest.raises(ValueError, match="finite"):
        encode_line(1, "move", np.array([0.0, 0.0, math.nan, 0.0, 0.0, 0.0]))


def test_a_line_keeps_the_joints_to_a_nanoradian() -> None:
    joints = np.array([1.23456789012, -2.0, 0.0, 3.1, 1e-7, -1e-9])
    sequence, mode, *angles = encode_line(7, "move", joints).decode().split()
    status, counters = decode_line(f"7 3 - {' '.join(angles)}\n".encode(), 7)
    assert (sequence, mode, counters) == ("7", "move", (3,))
    assert status.joints_rad == pytest.approx(joints, abs=5e-9)
