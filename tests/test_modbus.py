"""The register map: what the bridge encodes, what it accepts, and what the document says of it."""

from __future__ import annotations

import asyncio
import re
import struct
import zlib
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nodes.arm_bridge.link import ArmAnswerError, ArmRefusedError, ArmSilentError
from nodes.arm_bridge.modbus import (
    COMMAND,
    COMMAND_ADDRESS,
    FAULT_BITS,
    STATUS,
    STATUS_ADDRESS,
    Field,
    ModbusLink,
    decode_status,
    encode_command,
    register_count,
)
from nodes.twin.arms import ArmServer, Controller, Fault

JOINTS = np.radians([0.0, 25.0, 118.0, 0.0, -54.0, 0.0])
DOCUMENT = Path(__file__).parent.parent / "docs" / "modbus.md"


def rows(address: int, block: tuple[Field, ...]) -> list[str]:
    """The document's table rows of a block."""
    kinds = {"H": "u16", "I": "u32", "f": "float32"}
    lines = []
    for field in block:
        registers = field.count * struct.calcsize(f">{field.kind}") // 2
        span = str(address) if registers == 1 else f"{address}–{address + registers - 1}"
        kind = kinds[field.kind] + (f" × {field.count}" if field.count > 1 else "")
        lines.append(f"| {span} | `{field.name}` | {kind} | {field.about} |")
        address += registers
    return lines


@pytest.mark.parametrize(
    ("address", "block"), [(COMMAND_ADDRESS, COMMAND), (STATUS_ADDRESS, STATUS)]
)
def test_the_document_has_the_map_of_the_code(address: int, block: tuple[Field, ...]) -> None:
    text = DOCUMENT.read_text()
    for row in rows(address, block):
        assert row in text
    assert f"{register_count(block)} registers" in text
    for bit, words in FAULT_BITS.items():
        assert re.search(rf"\| {bit} \| {words} \|", text)


def status_registers(**changed: int | float) -> list[int]:
    """A sound status block but for what is changed; `crc` is computed unless given."""
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
    assert status.faults == ("joint out of range", "step too large")
    assert status.joints_rad == pytest.approx([0.1, 0.2, 0.3, 0.4, 0.5, 0.6], abs=1e-7)


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"magic": 0x1234}, "magic 0x1234, wanted 0x4653"),
        ({"version": 2}, "register map version 2, wanted 1"),
        ({"crc": 1}, "fails its CRC"),
        ({"state": 9}, "unknown arm state 9"),
        ({"j3": float("nan")}, "not finite"),
    ],
)
def test_an_unsound_status_is_refused(changed: dict[str, int | float], words: str) -> None:
    with pytest.raises(ArmAnswerError, match=words):
        decode_status(status_registers(**changed))


def test_a_status_of_another_length_is_refused() -> None:
    with pytest.raises(ArmAnswerError, match="status of 3 registers"):
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
    assert len(registers) == register_count(COMMAND)
    damaged = registers.copy()
    damaged[10] ^= 1
    assert not controller.take(damaged)
    assert controller.take(registers)
    assert not controller.take(registers)
    assert controller.wanted_rad == pytest.approx(JOINTS, abs=1e-6)


def quiet_controller() -> Controller:
    return Controller(JOINTS, servo_lag_s=0.025, noise_rad=0.0, watchdog_s=0.1)


@asynccontextmanager
async def linked(fault: Fault = "none") -> AsyncIterator[tuple[ModbusLink, Controller]]:
    controller = quiet_controller()
    controller.fault = fault
    server = ArmServer(controller, host="127.0.0.1", port=0, before=lambda: None)
    await server.start()
    link = ModbusLink("127.0.0.1", server.port, timeout_s=0.03)
    try:
        yield link, controller
    finally:
        link.close()
        await server.stop()


async def exchange(link: ModbusLink, now_s: float = 0.0) -> int:
    status = await link.exchange(mode="move", joints_rad=JOINTS, now_ns=int(now_s * 1e9))
    return status.accepted


async def test_commands_are_answered_one_by_one() -> None:
    async with linked() as (link, controller):
        assert [await exchange(link) for _ in range(5)] == [1, 2, 3, 4, 5]
        assert controller.refused == 0
        assert link.connections == 1


async def test_a_silent_arm_is_closed_and_reopened_with_back_off() -> None:
    async with linked("silent") as (link, controller):
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
        assert pauses == pytest.approx([0.0, 0.05, 0.1, 0.2, 0.4, 0.8, 1.0], abs=0.02)
        controller.fault = "none"
        assert await exchange(link, now_s) == 8
        assert link.connected


async def test_a_late_answer_is_never_taken_for_the_next_one() -> None:
    async with linked("slow") as (link, controller):
        with pytest.raises(ArmSilentError):
            await exchange(link)
        controller.fault = "none"
        for awaited in range(2, 40):
            assert await exchange(link) == awaited


async def test_an_exception_keeps_the_connection() -> None:
    async with linked("exception") as (link, controller):
        with pytest.raises(ArmRefusedError, match="Modbus exception 4"):
            await exchange(link)
        controller.fault = "none"
        await exchange(link)
        assert link.connections == 1


async def test_nobody_listening_is_an_error_in_one_line() -> None:
    link = ModbusLink("127.0.0.1", 1, timeout_s=0.03)
    with pytest.raises(ArmSilentError, match=r"no connection to 127\.0\.0\.1:1"):
        await exchange(link)


async def test_an_answer_to_another_command_closes_the_connection(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async with linked() as (link, controller):
        await exchange(link)
        monkeypatch.setattr(controller, "take", lambda registers: True)
        with pytest.raises(ArmAnswerError, match="answer to command 1, awaited 2"):
            await exchange(link)
        assert not link.connected


async def test_a_sequence_that_is_not_newer_is_refused() -> None:
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
