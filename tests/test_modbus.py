"""Test the register map: encoding of the bridge, accepted values, and documentation."""

from __future__ import annotations

import asyncio
import struct
import zlib
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymodbus.client import AsyncModbusTcpClient
from pymodbus.exceptions import ModbusIOException

from flexsheet.nodes.arm_bridge.link import (
    ArmAnswerError,
    ArmFault,
    ArmRefusedError,
    ArmSilentError,
)
from flexsheet.nodes.arm_bridge.modbus import (
    COMMAND,
    COMMAND_ADDRESS,
    STATUS,
    STATUS_ADDRESS,
    VERSION,
    ModbusLink,
    count_registers,
    decode_status,
    encode_command,
)
from flexsheet.nodes.twin import arms as twin_arms
from flexsheet.nodes.twin.arms import (
    ArmServer,
    Controller,
    Fault,
)
from tests.examples import examples
from tests.network import TcpRelay
from tests.waiting import DEADLINE_S
from website import arms_page

JOINTS = np.radians([0.0, 25.0, 118.0, 0.0, -54.0, 0.0])


def test_the_register_map_has_the_addresses_of_the_fields() -> None:
    assert "| 8–19 | `joints_rad` | float32 × 6 |" in arms_page.render_registers()


def status_registers(**changed: int | float) -> list[int]:
    """Return a valid status block with changes; `crc` is computed unless given."""
    values: dict[str, int | float] = {
        "magic": 0x4653, "version": 1, "accepted": 7, "cycle": 9, "time_us": 11, "state": 1,
        "faults": 0, "j1": 0.1, "j2": 0.2, "j3": 0.3, "j4": 0.4, "j5": 0.5, "j6": 0.6,
        "refused": 2,
    }  # fmt: skip
    crc = changed.pop("crc", None)
    body = struct.pack(">HHIIIHH6fI", *(values | changed).values())
    body += struct.pack(">I", zlib.crc32(body) if crc is None else crc)
    return list(struct.unpack(f">{len(body) // 2}H", body))


def test_a_sound_status_is_decoded() -> None:
    status = decode_status(status_registers(faults=3))
    assert (status.accepted, status.cycle, status.time_us, status.refused) == (7, 9, 11, 2)
    assert status.state == "moving"
    assert status.faults == (ArmFault.JOINT_RANGE, ArmFault.STEP_SIZE)
    assert status.joints_rad == pytest.approx([0.1, 0.2, 0.3, 0.4, 0.5, 0.6], abs=1e-7)


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"magic": 0x1234}, "magic number 0x1234 instead of 0x4653"),
        ({"version": 2}, "register map version 2, not 1"),
        ({"crc": 1}, "its CRC is wrong"),
        ({"state": 9}, "unknown arm state 9"),
        ({"j3": float("nan")}, "not finite"),
    ],
)
def test_an_unsound_status_is_rejected(changed: dict[str, int | float], words: str) -> None:
    with pytest.raises(ArmAnswerError, match=words):
        decode_status(status_registers(**changed))


def test_a_status_of_another_length_is_rejected() -> None:
    with pytest.raises(ArmAnswerError, match="the status has 3 registers"):
        decode_status([1, 2, 3])


@given(st.integers(0, 25), st.integers(0, 15))
def test_any_flipped_bit_is_noticed(register: int, bit: int) -> None:
    registers = status_registers()
    registers[register] ^= 1 << bit
    with pytest.raises(ArmAnswerError):
        decode_status(registers)


@given(st.integers(0, 2**40), st.integers(0, 2**60))
def test_a_command_is_taken_by_the_arm_and_no_damaged_one(sequence: int, time_us: int) -> None:
    sequence = sequence * 2 + 1
    controller = quiet_controller()
    controller.accepted = (sequence - 1) % 2**32
    registers = encode_command(sequence=sequence, time_us=time_us, mode="move", joints_rad=JOINTS)
    assert len(registers) == count_registers(COMMAND)
    damaged = registers.copy()
    damaged[10] ^= 1
    assert not controller.receive_command(damaged)
    assert controller.receive_command(registers)
    assert not controller.receive_command(registers)
    assert controller.wanted_rad == pytest.approx(JOINTS, abs=1e-6)


def quiet_controller() -> Controller:
    return Controller(JOINTS, servo_lag_s=0.025, noise_rad=0.0, watchdog_s=0.1)


SHORT_S = 0.03
"""Time-out in tests without an answer; in others a busy machine needs more time."""


@asynccontextmanager
async def linked(
    fault: Fault = "none", *, timeout_s: float = DEADLINE_S
) -> AsyncIterator[tuple[ModbusLink, Controller]]:
    controller = quiet_controller()
    controller.fault = fault
    server = ArmServer(controller, host="127.0.0.1", port=0, before=lambda: None)
    await server.start()
    link = ModbusLink("127.0.0.1", server.port, timeout_s=timeout_s)
    try:
        yield link, controller
    finally:
        link.close()
        await server.stop()


def set_timeout(link: ModbusLink, timeout_s: float) -> None:
    """Change the time-out of a link and of its open connection."""
    link._timeout_s = timeout_s
    if link._client is not None:
        link._client.ctx.comm_params.timeout_connect = timeout_s


async def exchange(link: ModbusLink, now_s: float = 0.0) -> int:
    status = await link.exchange(mode="move", joints_rad=JOINTS, now_ns=int(now_s * 1e9))
    return status.accepted


async def test_commands_are_answered_one_by_one() -> None:
    async with linked() as (link, controller):
        assert [await exchange(link) for _ in range(5)] == [1, 2, 3, 4, 5]
        assert controller.refused == 0
        assert link.connections == 1


async def test_a_silent_arm_is_closed_and_reopened_with_back_off() -> None:
    async with linked("silent", timeout_s=SHORT_S) as (link, controller):
        now_s, pauses = 0.0, []
        for _ in range(7):
            assert link.due(int(now_s * 1e9))
            with pytest.raises(ArmSilentError, match="within 30 ms"):
                await exchange(link, now_s)
            assert not link.connected
            pause_s = 0.0
            while not link.due(int((now_s + pause_s) * 1e9)):
                pause_s += 0.01
            pauses.append(pause_s)
            now_s += pause_s
        assert pauses == pytest.approx([0.0, 0.05, 0.1, 0.2, 0.2, 0.2, 0.2], abs=0.02)
        controller.fault = "none"
        set_timeout(link, DEADLINE_S)
        assert await exchange(link, now_s) == 8
        assert link.connected


async def test_a_late_answer_is_never_used_for_the_next_request() -> None:
    async with linked("slow", timeout_s=SHORT_S) as (link, controller):
        with pytest.raises(ArmSilentError):
            await exchange(link)
        controller.fault = "none"
        set_timeout(link, DEADLINE_S)
        for awaited in range(2, 40):
            assert await exchange(link) == awaited


async def test_an_exception_keeps_the_connection() -> None:
    async with linked("exception") as (link, controller):
        with pytest.raises(ArmRefusedError, match="Modbus exception 4"):
            await exchange(link)
        controller.fault = "none"
        await exchange(link)
        assert link.connections == 1


async def test_a_missing_server_is_an_error_in_one_line() -> None:
    link = ModbusLink("127.0.0.1", 1, timeout_s=DEADLINE_S)
    with pytest.raises(ArmSilentError, match=r"no connection to 127\.0\.0\.1:1"):
        await exchange(link)


async def test_an_answer_to_another_command_closes_the_connection(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async with linked() as (link, controller):
        await exchange(link)
        monkeypatch.setattr(controller, "receive_command", lambda registers: True)
        with pytest.raises(ArmAnswerError, match="expected the answer to command 2, found 1"):
            await exchange(link)
        assert not link.connected


async def test_a_sequence_that_is_not_newer_is_rejected() -> None:
    async with linked() as (link, controller):
        await exchange(link)
        controller.accepted = 1000
        with pytest.raises(ArmRefusedError, match="Modbus exception 3"):
            await exchange(link)
        assert controller.refused == 1


async def test_a_cancellation_is_not_swallowed_by_an_answer_that_comes_with_it() -> None:
    async with linked() as (link, _controller):
        for turns in range(1, 12):
            await exchange(link)
            task = asyncio.create_task(exchange(link))
            for _ in range(turns):
                await asyncio.sleep(0)
            done = task.done()
            task.cancel()
            await asyncio.wait([task])
            assert done or task.cancelled()


def test_the_map_is_frozen() -> None:
    """These are the bytes of version 1. A change requires another version of the map."""
    command = encode_command(
        sequence=0x01020304,
        time_us=0x0A0B0C0D,
        mode="move",
        joints_rad=np.array([0.5, -0.25, 1.5, 2.0, -1.0, 0.0]),
    )
    assert VERSION == 1
    assert (COMMAND_ADDRESS, STATUS_ADDRESS) == (0, 100)
    assert (count_registers(COMMAND), count_registers(STATUS)) == (22, 26)
    assert struct.pack(">22H", *command).hex() == (
        "46530001" "01020304" "0a0b0c0d" "00010000"
        "3f000000" "be800000" "3fc00000" "40000000" "bf800000" "00000000" "ae302983"
    )  # fmt: skip
    block = bytes.fromhex(
        "46530001" "01020304" "00000007" "0a0b0c0d" "00040009"
        "3f000000" "be800000" "3fc00000" "40000000" "bf800000" "00000000" "00000005" "353a33bc"
    )  # fmt: skip
    status = decode_status(list(struct.unpack(">26H", block)))
    assert (status.accepted, status.cycle, status.time_us) == (0x01020304, 7, 0x0A0B0C0D)
    assert (status.state, status.refused) == ("fault", 5)
    assert status.faults == (ArmFault.JOINT_RANGE, ArmFault.WATCHDOG)
    assert status.joints_rad.tolist() == [0.5, -0.25, 1.5, 2.0, -1.0, 0.0]


@pytest.mark.parametrize("bad", [[0.0] * 5, [0.0] * 5 + [float("nan")], [0.0] * 5 + [np.inf]])
def test_what_is_not_six_angles_is_never_sent(bad: list[float]) -> None:
    with pytest.raises(ValueError, match="6 finite angles"):
        encode_command(sequence=1, time_us=0, mode="move", joints_rad=np.array(bad))


any_register = st.integers(0, 0xFFFF)


@examples(150)
@given(st.lists(any_register, max_size=30) | st.lists(any_register, min_size=26, max_size=26))
def test_any_registers_are_a_status_or_an_error(registers: list[int]) -> None:
    with suppress(ArmAnswerError):
        assert np.isfinite(decode_status(registers).joints_rad).all()


async def test_the_librarys_fault_that_the_link_guards_against_is_there(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A late answer is used for the next request if the connection stays open.

    If this test fails, the library has fixed it. The guard is still needed, since the network can
    be late as well.
    """
    # Far beyond the client's time-out, which a busy machine may notice late.
    monkeypatch.setattr(twin_arms, "LATE_S", 1.0)
    async with linked("slow") as (link, _):
        client = AsyncModbusTcpClient(
            link.host, port=link.port, timeout=0.1, retries=0, reconnect_delay=0
        )
        await client.connect()

        async def ask(sequence: int) -> int:
            answer = await client.readwrite_registers(
                read_address=STATUS_ADDRESS,
                read_count=count_registers(STATUS),
                write_address=COMMAND_ADDRESS,
                values=encode_command(sequence=sequence, time_us=0, mode="move", joints_rad=JOINTS),
            )
            return decode_status(answer.registers).accepted

        try:
            with pytest.raises(ModbusIOException):
                await ask(1)
            client.ctx.comm_params.timeout_connect = DEADLINE_S
            assert await ask(2) == 1, "the answer to the first, believed to be the second's"
        finally:
            client.close()


class LateServer:
    """Server that answers the first command only after the second, and then both in order."""

    def __init__(self) -> None:
        self.connections = 0
        self.closed = asyncio.Event()
        self._blocks: list[list[int]] = []

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.connections += 1
        with suppress(asyncio.IncompleteReadError, ConnectionError):
            while True:
                head = await reader.readexactly(6)
                request = await reader.readexactly(struct.unpack(">H", head[4:])[0])
                controller = quiet_controller()
                controller.accepted = struct.unpack(">I", request[15:19])[0]
                self._blocks.append(controller.status_registers())
                if len(self._blocks) == 1:
                    continue
                # The transaction's number is the newest request's, as pymodbus stamps it.
                block = struct.pack(">26H", *self._blocks.pop(0))
                answer = bytes([request[0], 23, len(block)]) + block
                writer.write(head[:4] + struct.pack(">H", len(answer)) + answer)
                await writer.drain()
        writer.close()
        with suppress(ConnectionError):
            await writer.wait_closed()
        self.closed.set()


async def test_an_answer_late_on_the_servers_side_is_detected_by_its_echo() -> None:
    late = LateServer()
    server = await asyncio.start_server(late.serve, "127.0.0.1", 0)
    link = ModbusLink("127.0.0.1", server.sockets[0].getsockname()[1], timeout_s=0.05)
    try:
        with pytest.raises(ArmSilentError):
            await exchange(link)
        set_timeout(link, DEADLINE_S)
        await asyncio.wait_for(late.closed.wait(), DEADLINE_S)
        late.closed.clear()
        with pytest.raises(ArmAnswerError, match="expected the answer to command 2, found 1"):
            await exchange(link)
        assert not link.connected
        assert late.connections == 2
        await asyncio.wait_for(late.closed.wait(), DEADLINE_S)
    finally:
        link.close()
        server.close()
        await server.wait_closed()


async def test_a_repeated_answer_is_not_believed() -> None:
    async with linked() as (link, controller):
        for _ in range(3):
            await exchange(link)
        controller.fault = "repeated"
        with pytest.raises(ArmAnswerError, match="expected the answer to command 4, found 3"):
            await exchange(link)
        assert not link.connected


async def test_an_arm_that_is_cut_off_is_reconnected() -> None:
    """A closed and a half-open connection each give one error, and the next exchange reopens it."""
    async with linked() as (link, _), TcpRelay(link.port) as cut:
        through = ModbusLink("127.0.0.1", cut.port)

        async def answered() -> int:
            set_timeout(through, DEADLINE_S)
            return await exchange(through)

        async def assert_silent() -> None:
            set_timeout(through, SHORT_S)
            with pytest.raises(ArmSilentError):
                await exchange(through)

        try:
            assert await answered() == 1
            cut.half_open = True
            await assert_silent()
            cut.half_open = False
            assert await answered() == 3
            cut.close_all()
            await assert_silent()
            assert await answered() == 5
            cut.refuse = True
            cut.close_all()
            for _ in range(3):
                await assert_silent()
            cut.refuse = False
            assert await answered() == 9
        finally:
            through.close()


@pytest.mark.parametrize("answer", ["97", "17", "1734", "174200", "2b0e01", "00" * 40])
async def test_an_answer_that_is_not_modbus_is_one_error_and_no_trace(
    answer: str, caplog: pytest.LogCaptureFixture
) -> None:
    """The frame is valid, but not its content; an exception in the loop would be logged."""
    served: list[asyncio.Task[None] | None] = []

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        served.append(asyncio.current_task())
        while request := await reader.read(1024):
            body = request[6:7] + bytes.fromhex(answer)
            writer.write(request[:4] + struct.pack(">H", len(body)) + body)
        writer.close()

    server = await asyncio.start_server(serve, "127.0.0.1", 0)
    link = ModbusLink("127.0.0.1", server.sockets[0].getsockname()[1], timeout_s=DEADLINE_S)
    try:
        for connection in (1, 2, 3):
            with pytest.raises(ArmAnswerError, match="is not Modbus"):
                await exchange(link)
            assert not link.connected
            assert link.connections == connection
    finally:
        link.close()
        await asyncio.gather(*(one for one in served if one is not None))
        server.close()
        await server.wait_closed()
    assert caplog.records == []
