"""Test the real-time external control: packets, link, and the simulated controller."""

from __future__ import annotations

import asyncio
import itertools
import re
import struct
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, suppress
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from flexsheet.messages.clock import SystemClock
from flexsheet.nodes.arm_bridge.link import (
    ArmAnswerError,
    ArmLinkError,
    ArmRefusedError,
    ArmSilentError,
    BlockField,
)
from flexsheet.nodes.arm_bridge.mxt import (
    COMMAND_END,
    COMMAND_MOVE,
    COMMAND_NONE,
    PACKET,
    PACKET_BYTES,
    TYPE_JOINTS,
    MxtLink,
    decode_answer,
    encode,
    encode_joints,
    has_advanced,
)
from flexsheet.nodes.twin.arms import (
    CONTROLLER_CYCLE_S,
    Fault,
)
from flexsheet.nodes.twin.mxt_controller import (
    MxtController,
    MxtServer,
)
from tests.examples import examples
from tests.rv_1a import (
    RANGE_RAD,
    SPEED_RAD_PER_S,
)
from tests.waiting import DEADLINE_S
from website.arms_page import render_packet

Floats = NDArray[np.float64]
JOINTS = np.radians([0.0, 25.0, 118.0, 0.0, -54.0, 0.0])
ME = ("127.0.0.1", 4711)


def offsets() -> Iterator[tuple[int, BlockField]]:
    at = 0
    for field in PACKET:
        yield at, field
        at += field.count * struct.calcsize(f"<{field.kind}")
    assert at == PACKET_BYTES


def test_the_document_has_the_layout_of_the_code() -> None:
    text = render_packet()
    kinds = {"H": "u16", "I": "u32", "i": "i32", "f": "float32", "x": "pad"}
    for at, field in offsets():
        kind = kinds[field.kind] + (f" × {field.count}" if field.count > 1 else "")
        assert f"| {at} | `{field.name}` | {kind} | {field.about} |" in text


def test_the_bytes_of_a_command_are_the_makers() -> None:
    """The offsets are those of the manufacturer's struct: command 0, types 2 and 4, data 8,
    counters 58 and 60."""
    packet = encode_joints(np.array([0.5, -0.25, 1.5, 2.0, -1.0, 0.0]))
    assert len(packet) == 196
    assert packet[:8].hex() == "0100020008000000"
    assert packet[8:32].hex() == "0000003f000080be0000c03f00000040000080bf00000000"
    assert not any(packet[32:])
    assert encode(COMMAND_NONE)[:8].hex() == "0000000008000000"
    assert encode(COMMAND_END)[:4].hex() == "ff000000"


def answer(
    *,
    command: int = 1,
    types: tuple[int, int] = (8, 8),
    joints: tuple[float, ...] = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6),
    timeouts: int = 3,
    count: int = 9,
) -> bytes:
    head = struct.pack("<HHHH", command, *types, 0) + struct.pack("<6f", *joints)
    head += bytes(58 - len(head)) + struct.pack("<HI", timeouts, count)
    return head + bytes(196 - len(head))


def test_a_sound_answer_is_decoded() -> None:
    status = decode_answer(answer())
    assert status.joints_rad == pytest.approx([0.1, 0.2, 0.3, 0.4, 0.5, 0.6], abs=1e-7)
    assert (status.timeouts, status.count, status.faults) == (3, 9, ())
    for types in ((8, 0), (0, 8)):
        decode_answer(answer(types=types))


@pytest.mark.parametrize(
    ("packet", "words"),
    [
        (b"", "the answer has 0 bytes"),
        (answer()[:-1], "the answer has 195 bytes"),
        (answer() + b"x", "the answer has 197 bytes"),
        (bytes(312), "the answer has 312 bytes"),
        (answer(types=(2, 8)), "types 2 and 8"),
        (answer(types=(0, 0)), "types 0 and 0"),
        (answer(joints=(0, 0, float("nan"), 0, 0, 0)), "is not an angle"),
        (answer(joints=(0, 0, 0, 0, 0, 1e6)), "is not an angle"),
    ],
)
def test_an_unsound_answer_is_rejected(packet: bytes, words: str) -> None:
    with pytest.raises(ArmAnswerError, match=words):
        decode_answer(packet)


@pytest.mark.parametrize("command", [2, 255, 65535])
def test_the_end_of_external_control_is_reported(command: int) -> None:
    with pytest.raises(ArmRefusedError, match="ended external control"):
        decode_answer(answer(command=command))


any_bytes = st.one_of(
    st.binary(max_size=400),
    st.binary(min_size=196, max_size=196),
    st.builds(
        lambda tail, command, types: struct.pack("<HHH", command, *types) + tail,
        st.binary(min_size=190, max_size=190),
        st.sampled_from([0, 1, 255]),
        st.tuples(st.sampled_from([0, 1, 2, 8]), st.sampled_from([0, 2, 8])),
    ),
)


@examples(200)
@given(any_bytes)
def test_any_bytes_are_a_status_or_an_error(packet: bytes) -> None:
    with suppress(ArmLinkError):
        status = decode_answer(packet)
        assert status.joints_rad.shape == (6,)
        assert np.isfinite(status.joints_rad).all()


@given(st.integers(0, 2**32 - 1), st.integers(1, 2**31 - 1))
def test_a_counter_wraps_around_and_never_decreases(count: int, steps: int) -> None:
    assert has_advanced((count + steps) % 2**32, count, 1)
    assert has_advanced((count + steps) % 2**32, count, steps)
    assert not has_advanced((count + steps) % 2**32, count, steps + 1)
    assert not has_advanced(count, (count + steps) % 2**32, 1)
    assert not has_advanced(count, count, 1)


@pytest.mark.parametrize("bad", [[0.0] * 5, [0.0] * 5 + [float("nan")], [0.0] * 5 + [np.inf]])
def test_what_is_not_six_angles_is_never_sent(bad: list[float]) -> None:
    with pytest.raises(ValueError, match="6 finite angles"):
        encode_joints(np.array(bad))


# The simulated controller.


def controller(**changed: float) -> MxtController:
    given = {
        "servo_lag_s": 0.015,
        "filter_s": 0.01,
        "noise_rad": 0.0,
        "timeout_s": 0.1,
    } | changed
    return MxtController(JOINTS, **given)


def ask(arm: MxtController, packet: bytes, sender: tuple[str, int] = ME) -> bytes | None:
    """Exchange one packet; return the answer, if any."""
    arm.receive_command(packet, sender)
    arm.advance(CONTROLLER_CYCLE_S)
    answers, arm.answers = arm.answers, []
    assert len(answers) <= 1
    return answers[0][0] if answers else None


def joints_of(packet: bytes | None) -> Floats:
    assert packet is not None
    return decode_answer(packet).joints_rad


def test_it_answers_each_packet_at_the_end_of_its_cycle_and_counts() -> None:
    arm = controller()
    arm.receive_command(encode(COMMAND_NONE), ME)
    arm.advance(0.007)
    assert arm.answers == []
    arm.advance(0.0002)
    assert len(arm.answers) == 1
    arm.answers.clear()
    counts = [decode_answer(ask(arm, encode_joints(JOINTS)) or b"").count for _ in range(3)]
    assert counts[1:] == [counts[0] + 1, counts[0] + 2]


def test_it_follows_set_points_through_filter_and_servo() -> None:
    arm = controller()
    assert joints_of(ask(arm, encode(COMMAND_NONE))) == pytest.approx(JOINTS, abs=1e-6)
    rate = np.full(6, 0.3)
    for number in range(200):
        wanted = JOINTS + rate * number * CONTROLLER_CYCLE_S
        ask(arm, encode_joints(wanted))
    trailing_s = (wanted - arm.servo.joints_rad) / rate
    assert trailing_s == pytest.approx(np.full(6, 0.025), abs=0.002)


def near(change: Floats | float) -> Floats:
    return JOINTS + change


@pytest.mark.parametrize(
    ("packets", "words"),
    [
        ([encode_joints(JOINTS)], "before a packet that only requests the state"),
        (
            [encode(COMMAND_NONE), encode_joints(near(0.02))],
            "the first set-point differs by more than 0.01 rad from the measured joint angles",
        ),
        (
            [encode(COMMAND_NONE), encode_joints(JOINTS), encode_joints(near(0.06))],
            "the step from the previous set-point is too large",
        ),
        ([encode(COMMAND_NONE), encode(COMMAND_MOVE)], "type 0"),
        ([encode(COMMAND_NONE), encode(COMMAND_MOVE, send_type=3)], "type 3"),
        ([encode(COMMAND_NONE), encode(7)], "the packet has the unknown command 7"),
        (
            [encode(COMMAND_NONE), encode(COMMAND_MOVE, send_type=TYPE_JOINTS, data=[np.nan] * 6)],
            "not finite",
        ),
        (
            [encode(COMMAND_NONE), encode(COMMAND_MOVE, send_type=TYPE_JOINTS, data=[9.0] * 6)],
            "outside the allowed range",
        ),
        ([encode(COMMAND_NONE), encode(COMMAND_MOVE, send_type=1, data=[9e3] * 3)], "type 1"),
        ([encode(COMMAND_NONE), *[b""] * 20], "no packet arrived in 14 cycles"),
    ],
)
def test_what_it_must_not_do_ends_its_program(packets: list[bytes], words: str) -> None:
    arm = controller()
    for packet in packets:
        ask(arm, packet)
    assert words in arm.error
    assert ask(arm, encode(COMMAND_NONE)) is None, "it says nothing more"
    arm.advance(0.3)
    assert arm.servo.joints_rad == pytest.approx(JOINTS, abs=0.02)
    assert arm.servo.velocity_rad_per_s == pytest.approx(np.zeros(6), abs=1e-9)
    arm.restart()
    assert ask(arm, encode(COMMAND_NONE)) is not None


def test_its_operator_starts_the_program_again_after_a_while() -> None:
    arm = controller(restart_after_s=0.5)
    ask(arm, encode_joints(JOINTS))
    assert arm.error
    arm.advance(0.4)
    assert arm.error
    arm.advance(0.2)
    assert not arm.error


def test_a_gap_of_fifty_milliseconds_is_counted_and_lived_through() -> None:
    arm = controller()
    ask(arm, encode(COMMAND_NONE))
    ask(arm, encode_joints(JOINTS))
    arm.advance(0.05)
    late = ask(arm, encode_joints(JOINTS))
    assert late is not None
    assert decode_answer(late).timeouts == 7
    assert arm.error == ""


def test_another_master_is_ignored_until_the_first_has_ended() -> None:
    arm, other = controller(), ("127.0.0.1", 4712)
    ask(arm, encode(COMMAND_NONE))
    assert ask(arm, encode_joints(JOINTS), other) is None
    assert (arm.refused, arm.error) == (1, "")
    ask(arm, encode(COMMAND_END))
    assert ask(arm, encode(COMMAND_NONE), other) is not None


@examples(75)
@given(st.lists(any_bytes, max_size=12), st.booleans())
def test_no_bytes_crash_the_controller_or_move_the_arm_out_of_bounds(
    packets: list[bytes], opened: bool
) -> None:
    arm = controller(restart_after_s=0.02)
    if opened:
        ask(arm, encode(COMMAND_NONE))
        ask(arm, encode_joints(JOINTS))
    for packet in packets:
        before = arm.servo.joints_rad
        ask(arm, packet)
        assert np.isfinite(arm.servo.joints_rad).all()
        assert (arm.servo.joints_rad >= RANGE_RAD[:, 0]).all()
        assert (arm.servo.joints_rad <= RANGE_RAD[:, 1]).all()
        moved = np.abs(arm.servo.joints_rad - before) / CONTROLLER_CYCLE_S
        assert (moved <= SPEED_RAD_PER_S * (1 + 1e-9)).all()


# The link, over real sockets on the loopback.


@asynccontextmanager
async def linked(fault: Fault = "none") -> AsyncIterator[tuple[MxtLink, MxtServer]]:
    arm, clock = controller(), SystemClock()
    arm.fault = fault
    moved_ns = clock.now_ns()

    def advance() -> None:
        nonlocal moved_ns
        now_ns = clock.now_ns()
        # A pause of a busy machine is no packet that the controller misses.
        arm.advance(min((now_ns - moved_ns) * 1e-9, CONTROLLER_CYCLE_S))
        moved_ns = now_ns

    server = MxtServer(arm, host="127.0.0.1", port=0, before=advance)
    await server.start()
    # Longer than the driver's own time-out: the machine that tests may be busy.
    link = MxtLink("127.0.0.1", server.port, timeout_s=DEADLINE_S)
    try:
        yield link, server
    finally:
        link.close()
        await server.stop()


async def exchange(link: MxtLink, mode: str = "move", joints: Floats = JOINTS) -> int:
    return (await link.exchange(mode=mode, joints_rad=joints, now_ns=0)).count


async def test_commands_are_answered_one_by_one_and_move_the_arm() -> None:
    async with linked() as (link, server):
        counts = [await exchange(link, "idle")]
        for number in range(8):
            counts.append(await exchange(link, joints=JOINTS + 0.001 * number))
        assert counts == [counts[0] + number for number in range(9)]
        assert server.controller.error == ""
        assert server.controller.wanted_rad == pytest.approx(JOINTS + 0.007, abs=1e-6)


async def test_closing_ends_external_control() -> None:
    async with linked() as (link, server):
        await exchange(link, "idle")
        link.close()
        again = MxtLink("127.0.0.1", server.port, timeout_s=0.2)
        for _ in range(20):
            with suppress(ArmSilentError):
                await exchange(again, "idle")
                break
        else:
            pytest.fail("the controller did not let go")
        again.close()


@pytest.mark.parametrize(
    ("fault", "error", "words"),
    [
        ("silent", ArmSilentError, "no answer from .* within 30 ms"),
        ("slow", ArmSilentError, "no answer from .* within 30 ms"),
        ("exception", ArmAnswerError, "types 3 and 3"),
        ("bad_crc", ArmAnswerError, "the answer has 192 bytes"),
        ("repeated", ArmSilentError, "no answer"),
    ],
)
async def test_a_bad_answer_is_an_error(
    fault: Fault, error: type[ArmLinkError], words: str
) -> None:
    async with linked() as (link, server):
        await exchange(link, "idle")
        await exchange(link)
        server.controller.fault = fault
        if error is ArmSilentError:
            link._timeout_s = 0.03
        with pytest.raises(error, match=words):
            await exchange(link)


async def test_late_answers_are_thrown_away() -> None:
    async with linked() as (link, server):
        await exchange(link, "idle")
        server.controller.fault = "slow"
        link._timeout_s = 0.03
        for _ in range(2):
            with pytest.raises(ArmSilentError):
                await exchange(link)
        server.controller.fault, link._timeout_s = "none", DEADLINE_S
        counts = [await exchange(link) for _ in range(12)]
        assert all(later > sooner for sooner, later in itertools.pairwise(counts))
        assert link.stale >= 1


async def test_an_older_answer_does_not_replace_the_newest() -> None:
    """The network delivers an answer twice: the second is identified by its counter."""

    class Twice(asyncio.DatagramProtocol):
        count = 4

        def connection_made(self, transport: asyncio.DatagramTransport) -> None:
            self.transport = transport

        def datagram_received(self, data: bytes, addr: tuple[str, int]) -> None:
            self.transport.sendto(answer(count=self.count), addr)
            self.count += 1
            self.transport.sendto(answer(count=self.count), addr)

    loop = asyncio.get_running_loop()
    transport, _ = await loop.create_datagram_endpoint(Twice, local_addr=("127.0.0.1", 0))
    link = MxtLink("127.0.0.1", transport.get_extra_info("sockname")[1], timeout_s=DEADLINE_S)
    try:
        assert await exchange(link, "idle") == 4
        assert await exchange(link) > 4
    finally:
        link.close()
        transport.close()


async def test_a_missing_server_is_an_error_in_one_line() -> None:
    link = MxtLink("127.0.0.1", 1, timeout_s=DEADLINE_S)
    for _ in range(3):
        with pytest.raises(ArmSilentError, match=r"127\.0\.0\.1:1: Connection refused"):
            await exchange(link, "idle")
    link.close()


async def test_a_cancellation_is_not_swallowed() -> None:
    async with linked() as (link, _):
        await exchange(link, "idle")
        for turns in range(1, 8):
            task = asyncio.create_task(exchange(link))
            for _ in range(turns):
                await asyncio.sleep(0)
            done = task.done()
            task.cancel()
            await asyncio.wait([task])
            assert done or task.cancelled()
        await exchange(link, "idle")


def test_the_document_lists_the_rejections() -> None:
    root = Path(__file__).parent.parent
    text = (root / "docs" / "mxt.md").read_text()
    source = (root / "nodes/twin/mxt_controller.py").read_text()
    for words in re.findall(r'MxtError\("([^"]+)"\)', source):
        assert words in text, words
