"""Modbus TCP to an arm: one FC23 exchange per cycle, guarded by magic, version, sequence and CRC.

The register map is `COMMAND` and `STATUS` below; the tables of `docs/modbus.md` are written from
them (`launch.reference.registers`).  Numbers of 32 bits take two registers, high word first.  The
CRC-32 (zlib's) covers every register before it in its block, high byte first.
"""

from __future__ import annotations

import asyncio
import logging
import math
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from pymodbus.client import AsyncModbusTcpClient
from pymodbus.exceptions import ModbusException
from pymodbus.framer import FramerSocket
from pymodbus.pdu import DecodePDU, ModbusPDU

from flexsheet.nodes.arm_bridge.link import (
    ArmAnswerError,
    ArmFault,
    ArmLinkError,
    ArmRefusedError,
    ArmSilentError,
    ArmStatus,
    CounterMonitor,
    be_cancelled,
    checked_joints,
)

Floats = NDArray[np.float64]

MAGIC = 0x4653
VERSION = 1
COMMAND_ADDRESS = 0
STATUS_ADDRESS = 100


@dataclass(frozen=True, slots=True)
class Field:
    """One entry of a block; `kind` is a struct code: H (u16), I (u32), f (float32)."""

    name: str
    kind: str
    count: int
    about: str


COMMAND = (
    Field("magic", "H", 1, "0x4653, the letters FS"),
    Field("version", "H", 1, "of this map: 1"),
    Field("sequence", "I", 1, "counts up with every command; an `idle` command may start anew"),
    Field("time_us", "I", 1, "when the command was made, sender's clock, wraps after 71 minutes"),
    Field("mode", "H", 1, "0 idle, 1 move, 2 hold, 3 stop"),
    Field("reserved", "H", 1, "0"),
    Field("joints_rad", "f", 6, "J1 to J6; read only in mode `move`"),
    Field("crc", "I", 1, "CRC-32 of the block's registers before it"),
)

STATUS = (
    Field("magic", "H", 1, "0x4653"),
    Field("version", "H", 1, "of this map: 1"),
    Field("accepted", "I", 1, "sequence of the last accepted command"),
    Field("cycle", "I", 1, "the controller's cycles since its start"),
    Field("time_us", "I", 1, "when the joints were measured, controller's clock"),
    Field("state", "H", 1, "0 idle, 1 moving, 2 holding, 3 stopped, 4 fault"),
    Field(
        "faults",
        "H",
        1,
        "bits: 1 joint out of range, 2 step too large, 4 not finite, 8 watchdog, 16 servo",
    ),
    Field("joints_rad", "f", 6, "measured J1 to J6"),
    Field("refused", "I", 1, "commands refused since the controller's start"),
    Field("crc", "I", 1, "CRC-32 of the block's registers before it"),
)

COMMAND_MODES = {"idle": 0, "move": 1, "hold": 2, "stop": 3}
STATES = ("idle", "moving", "holding", "stopped", "fault")
FAULT_BITS = {
    1: ArmFault.JOINT_RANGE,
    2: ArmFault.STEP_SIZE,
    4: ArmFault.NOT_FINITE,
    8: ArmFault.WATCHDOG,
    16: ArmFault.SERVO,
}


def struct_format(block: Sequence[Field]) -> str:
    """The struct format of a block, big-endian."""
    return ">" + "".join(f"{field.count}{field.kind}" for field in block)


def register_count(block: Sequence[Field]) -> int:
    return struct.calcsize(struct_format(block)) // 2


# Every failure is raised as ArmLinkError; the library's own log would say it again, with hex dumps.
logging.getLogger("pymodbus").setLevel(logging.CRITICAL)

_COMMAND_FORMAT, _STATUS_FORMAT = struct_format(COMMAND), struct_format(STATUS)
_STATUS_REGISTERS = register_count(STATUS)


@dataclass(frozen=True, slots=True)
class ModbusStatus(ArmStatus):
    """What the status block says."""

    accepted: int
    cycle: int
    time_us: int
    state: str
    refused: int


def encode_command(*, sequence: int, time_us: int, mode: str, joints_rad: Floats) -> list[int]:
    """The command block's registers; sequence and time are taken modulo 2^32."""
    body = struct.pack(
        _COMMAND_FORMAT[:-2],
        MAGIC,
        VERSION,
        sequence & 0xFFFFFFFF,
        time_us & 0xFFFFFFFF,
        COMMAND_MODES[mode],
        0,
        *checked_joints(joints_rad),
    )
    whole = body + struct.pack(">I", zlib.crc32(body))
    return list(struct.unpack(f">{len(whole) // 2}H", whole))


def decode_status(registers: Sequence[int]) -> ModbusStatus:
    """The status block of its registers; ArmAnswerError says what is wrong with it."""
    if len(registers) != _STATUS_REGISTERS:
        raise ArmAnswerError(f"status of {len(registers)} registers, wanted {_STATUS_REGISTERS}")
    whole = struct.pack(f">{len(registers)}H", *registers)
    magic, version, accepted, cycle, time_us, state, faults, *rest = struct.unpack(
        _STATUS_FORMAT, whole
    )
    *joints, refused, crc = rest
    if magic != MAGIC:
        raise ArmAnswerError(f"status magic 0x{magic:04x}, wanted 0x{MAGIC:04x}: not our map")
    if version != VERSION:
        raise ArmAnswerError(f"register map version {version}, wanted {VERSION}")
    if crc != zlib.crc32(whole[:-4]):
        raise ArmAnswerError("status block fails its CRC")
    if state >= len(STATES):
        raise ArmAnswerError(f"unknown arm state {state}")
    if not all(math.isfinite(angle) for angle in joints):
        raise ArmAnswerError("measured joints are not finite")
    return ModbusStatus(
        accepted=accepted,
        cycle=cycle,
        time_us=time_us,
        state=STATES[state],
        faults=tuple(fault for bit, fault in FAULT_BITS.items() if faults & bit),
        joints_rad=np.array(joints),
        refused=refused,
    )


class _Framer(FramerSocket):
    """The library's, whose error on an answer that is none fails the request that awaits one.

    Else it would be raised into the loop, which ends the connection, prints a trace each time, and
    lets the request wait for its time-out.
    """

    def __init__(self, client: AsyncModbusTcpClient) -> None:
        super().__init__(DecodePDU(False))
        self._client = client
        self.undecodable = False

    def handleFrame(  # pymodbus calls it so
        self, data: bytes, exp_devid: int, exp_tid: int
    ) -> tuple[int, ModbusPDU | None]:
        try:
            return super().handleFrame(data, exp_devid, exp_tid)
        except ModbusException as error:
            self.undecodable = True
            awaited = self._client.ctx.response_future
            if not awaited.done():
                awaited.set_exception(error)
                # Nobody may be waiting: then the next request tells, and not the future's end.
                awaited.exception()
            return len(data), None


class ModbusLink:
    """An `ArmLink`: one connection to one arm.

    Any failure that leaves an answer outstanding closes the connection, because pymodbus 3.16.1 can
    hand a late answer to the next request; the echoed sequence and the CRC catch what remains.  It
    opens again at once after a first failure, then with a pause that doubles to `longest_pause_s`.
    """

    def __init__(
        self,
        host: str,
        port: int,
        *,
        timeout_s: float = 0.03,
        first_pause_s: float = 0.05,
        longest_pause_s: float = 1.0,
    ) -> None:
        self.host, self.port = host, port
        self._timeout_s = timeout_s
        self._first_pause_s, self._longest_pause_s = first_pause_s, longest_pause_s
        self._pause_s = 0.0
        self._try_again_ns = 0
        self._client: AsyncModbusTcpClient | None = None
        self._framer: _Framer | None = None
        self._sequence = 0
        self._counters = CounterMonitor()
        self.connections = 0

    @property
    def connected(self) -> bool:
        return self._client is not None and self._client.connected

    def due(self, now_ns: int) -> bool:
        """Whether there is a connection, or the pause before the next attempt is over."""
        return self.connected or now_ns >= self._try_again_ns

    async def exchange(self, *, mode: str, joints_rad: Floats, now_ns: int) -> ModbusStatus:
        """Send one command and return the status that answers it; raises ArmLinkError."""
        loop = asyncio.get_running_loop()
        begun_s = loop.time()
        try:
            client = await self._open()
            self._sequence = (self._sequence + 1) & 0xFFFFFFFF
            status = await self._ask(client, mode, joints_rad, now_ns)
        except ArmRefusedError:
            raise
        except ArmLinkError:
            self.close()
            self._try_again_ns = now_ns + int(self._pause_s * 1e9)
            longer_s = max(2.0 * self._pause_s, self._first_pause_s)
            self._pause_s = min(longer_s, self._longest_pause_s)
            raise
        except asyncio.CancelledError:
            # The answer is outstanding still, and would be taken for the next one's.
            self.close()
            raise
        finally:
            be_cancelled()
        self._pause_s = 0.0
        freshness = self._counters.judge(
            (status.time_us, status.cycle),
            sent_ns=now_ns,
            received_ns=now_ns + round((loop.time() - begun_s) * 1e9),
            may_restart=mode == "idle",
        )
        return replace(status, freshness=freshness)

    async def _open(self) -> AsyncModbusTcpClient:
        if self._client is not None and self._client.connected:
            return self._client
        self.close()
        client = AsyncModbusTcpClient(
            self.host, port=self.port, timeout=self._timeout_s, retries=0, reconnect_delay=0
        )
        self._framer = _Framer(client)
        client.ctx.framer = self._framer
        if not await client.connect():
            client.close()
            raise ArmSilentError(f"no connection to {self.host}:{self.port}")
        self._client = client
        self.connections += 1
        return client

    async def _ask(
        self, client: AsyncModbusTcpClient, mode: str, joints_rad: Floats, now_ns: int
    ) -> ModbusStatus:
        values = encode_command(
            sequence=self._sequence, time_us=now_ns // 1000, mode=mode, joints_rad=joints_rad
        )
        try:
            answer = await client.readwrite_registers(
                read_address=STATUS_ADDRESS,
                read_count=_STATUS_REGISTERS,
                write_address=COMMAND_ADDRESS,
                values=values,
            )
        except ModbusException as error:
            if self._framer is not None and self._framer.undecodable:
                raise ArmAnswerError(f"answer of {self.host}:{self.port} is not Modbus") from error
            raise ArmSilentError(
                f"no answer from {self.host}:{self.port} within {self._timeout_s * 1e3:.0f} ms"
            ) from error
        if answer.isError():
            code = getattr(answer, "exception_code", "?")
            raise ArmRefusedError(f"the arm refused the command: Modbus exception {code}")
        status = decode_status(answer.registers)
        if status.accepted != self._sequence:
            raise ArmAnswerError(f"answer to command {status.accepted}, awaited {self._sequence}")
        return status

    def close(self) -> None:
        """Close the connection, if any."""
        if self._client is not None:
            self._client.close()
            self._client = None
