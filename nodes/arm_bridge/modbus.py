"""Exchange commands with an arm by Modbus TCP.

Each control cycle sends one request (function code 23). `COMMAND` and `STATUS` define the register
map, from which `website.registers_page` generates the tables of docs/modbus.md. Numbers of 32 bits
occupy two registers, the high register first. The CRC-32 (as in zlib) covers all preceding
registers in the same block. The high byte of each register comes first.
"""

from __future__ import annotations

import logging
import math
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pymodbus.client import AsyncModbusTcpClient
from pymodbus.exceptions import ModbusException
from pymodbus.framer import FramerSocket
from pymodbus.pdu import DecodePDU, ModbusPDU

from flexsheet.nodes.arm_bridge.link import (
    ArmAnswerError,
    ArmFault,
    ArmRefusedError,
    ArmSilentError,
    ArmStatus,
    BlockField,
    ConnectedLink,
    validate_joints,
)
from flexsheet.nodes.arrays import Floats

MAGIC = 0x4653
VERSION = 1
COMMAND_ADDRESS = 0
STATUS_ADDRESS = 100

COMMAND = (
    BlockField("magic", "H", 1, "0x4653, the letters FS"),
    BlockField("version", "H", 1, "version of this map: 1"),
    BlockField(
        "sequence", "I", 1, "increases with every command; an `idle` command may restart it"
    ),
    BlockField("time_us", "I", 1, "time of the command, sender's clock, wraps after 71 minutes"),
    BlockField("mode", "H", 1, "0 idle, 1 move, 2 hold, 3 stop"),
    BlockField("reserved", "H", 1, "0"),
    BlockField("joints_rad", "f", 6, "J1 to J6; read only in mode `move`"),
    BlockField("crc", "I", 1, "CRC-32 of the block's registers before it"),
)

STATUS = (
    BlockField("magic", "H", 1, "0x4653"),
    BlockField("version", "H", 1, "version of this map: 1"),
    BlockField("accepted", "I", 1, "sequence of the last accepted command"),
    BlockField("cycle", "I", 1, "the controller's cycles since its start"),
    BlockField("time_us", "I", 1, "time of the joint measurement, controller's clock"),
    BlockField("state", "H", 1, "0 idle, 1 moving, 2 holding, 3 stopped, 4 fault"),
    BlockField(
        "faults",
        "H",
        1,
        "bits: 1 joint out of range, 2 step too large, 4 not finite, 8 watchdog, 16 servo",
    ),
    BlockField("joints_rad", "f", 6, "measured J1 to J6"),
    BlockField("refused", "I", 1, "commands refused since the controller's start"),
    BlockField("crc", "I", 1, "CRC-32 of the block's registers before it"),
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


def make_struct_format(block: Sequence[BlockField]) -> str:
    """Return the big-endian format of a register block for Python's `struct` module."""
    return ">" + "".join(f"{field.count}{field.kind}" for field in block)


def count_registers(block: Sequence[BlockField]) -> int:
    """Return the number of 16-bit registers in a block."""
    return struct.calcsize(make_struct_format(block)) // 2


# Failures are raised as ArmLinkError; the log of pymodbus would repeat them with hex dumps.
logging.getLogger("pymodbus").setLevel(logging.CRITICAL)

_COMMAND_FORMAT, _STATUS_FORMAT = make_struct_format(COMMAND), make_struct_format(STATUS)
_STATUS_REGISTERS = count_registers(STATUS)


@dataclass(frozen=True, slots=True)
class ModbusStatus(ArmStatus):
    """The contents of a status block; see `STATUS` for a description of the fields."""

    accepted: int
    cycle: int
    time_us: int
    state: str
    refused: int


def encode_command(*, sequence: int, time_us: int, mode: str, joints_rad: Floats) -> list[int]:
    """Encode a command block as a list of 16-bit registers.

    The sequence number and the time are encoded modulo 2^32. Raises ValueError unless there are six
    finite joint angles.
    """
    body = struct.pack(
        _COMMAND_FORMAT[:-2],
        MAGIC,
        VERSION,
        sequence & 0xFFFFFFFF,
        time_us & 0xFFFFFFFF,
        COMMAND_MODES[mode],
        0,
        *validate_joints(joints_rad),
    )
    whole = body + struct.pack(">I", zlib.crc32(body))
    return list(struct.unpack(f">{len(whole) // 2}H", whole))


def decode_status(registers: Sequence[int]) -> ModbusStatus:
    """Decode the registers of a status block; raise ArmAnswerError if the block is invalid."""
    if len(registers) != _STATUS_REGISTERS:
        raise ArmAnswerError(
            f"the status has {len(registers)} registers instead of {_STATUS_REGISTERS}"
        )
    whole = struct.pack(f">{len(registers)}H", *registers)
    magic, version, accepted, cycle, time_us, state, faults, *rest = struct.unpack(
        _STATUS_FORMAT, whole
    )
    *joints, refused, crc = rest
    if magic != MAGIC:
        raise ArmAnswerError(
            f"the status has the magic number 0x{magic:04x} instead of 0x{MAGIC:04x}, so its "
            "register map is unknown"
        )
    if version != VERSION:
        raise ArmAnswerError(f"the status has the register map version {version}, not {VERSION}")
    if crc != zlib.crc32(whole[:-4]):
        raise ArmAnswerError("the status block is damaged: its CRC is wrong")
    if state >= len(STATES):
        raise ArmAnswerError(f"the status has the unknown arm state {state}")
    if not all(math.isfinite(angle) for angle in joints):
        raise ArmAnswerError("the measured joint angles are not finite")
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
    """A Modbus framer that fails the pending request if an answer cannot be decoded.

    With the framer of pymodbus, the request would wait until its time-out.
    """

    def __init__(self, client: AsyncModbusTcpClient) -> None:
        super().__init__(DecodePDU(False))
        self._client = client
        self.undecodable = False

    def handleFrame(  # name given by pymodbus
        self, data: bytes, exp_devid: int, exp_tid: int
    ) -> tuple[int, ModbusPDU | None]:
        try:
            return super().handleFrame(data, exp_devid, exp_tid)
        except ModbusException as error:
            self.undecodable = True
            awaited = self._client.ctx.response_future
            if not awaited.done():
                awaited.set_exception(error)
                # Mark the exception as read; asyncio would report it if no task waits for it.
                awaited.exception()
            return len(data), None


class ModbusLink(ConnectedLink):
    """A driver for one arm that uses one Modbus TCP connection.

    After a failure, the connection is closed if an answer may still arrive. Otherwise pymodbus
    3.16.1 could return the late answer as the answer to the next request. The sequence number and
    the CRC detect other wrong answers.
    """

    def __init__(self, host: str, port: int, *, timeout_s: float = 0.03) -> None:
        super().__init__(host, port, timeout_s=timeout_s)
        self._client: AsyncModbusTcpClient | None = None
        self._framer: _Framer | None = None
        self._sequence = 0

    @property
    def connected(self) -> bool:
        return self._client is not None and self._client.connected

    async def _connect(self) -> None:
        client = AsyncModbusTcpClient(
            self.host, port=self.port, timeout=self._timeout_s, retries=0, reconnect_delay=0
        )
        self._framer = _Framer(client)
        client.ctx.framer = self._framer
        if not await client.connect():
            client.close()
            raise ArmSilentError(
                f"no connection to {self.host}:{self.port}; "
                "check the controller and the network cable"
            )
        self._client = client

    async def _request(
        self, mode: str, joints_rad: Floats, now_ns: int
    ) -> tuple[ModbusStatus, tuple[int, ...]]:
        assert self._client is not None
        self._sequence = (self._sequence + 1) & 0xFFFFFFFF
        values = encode_command(
            sequence=self._sequence, time_us=now_ns // 1000, mode=mode, joints_rad=joints_rad
        )
        try:
            answer = await self._client.readwrite_registers(
                read_address=STATUS_ADDRESS,
                read_count=_STATUS_REGISTERS,
                write_address=COMMAND_ADDRESS,
                values=values,
            )
        except ModbusException as error:
            if self._framer is not None and self._framer.undecodable:
                raise ArmAnswerError(
                    f"the answer of {self.host}:{self.port} is not Modbus"
                ) from error
            raise ArmSilentError(
                f"no answer from {self.host}:{self.port} within {self._timeout_s * 1e3:.0f} ms; "
                "check the controller and the network cable"
            ) from error
        if answer.isError():
            code = getattr(answer, "exception_code", "?")
            raise ArmRefusedError(f"the arm refused the command: Modbus exception {code}")
        status = decode_status(answer.registers)
        if status.accepted != self._sequence:
            raise ArmAnswerError(
                f"expected the answer to command {self._sequence}, found {status.accepted}"
            )
        return status, (status.time_us, status.cycle)

    def _disconnect(self) -> None:
        if self._client is not None:
            self._client.close()
            self._client = None
