"""Exchange commands with a Mitsubishi controller over UDP by real-time external control (MXT).

A robot program runs `Open "ENET:..." As #1 : Mxt 1,1,<filter ms>`. In each cycle, the controller
then reads one command packet and answers with measurements. Packets have 196 bytes of little-endian
fields, which `PACKET` defines. docs/mxt.md states which parts the manufacturer documents.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import socket
import struct
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from flexsheet.nodes.arm_bridge.link import (
    JOINTS,
    ArmAnswerError,
    ArmRefusedError,
    ArmSilentError,
    ArmStatus,
    BlockField,
    CounterMonitor,
    propagate_cancellation,
    validate_joints,
)
from flexsheet.nodes.arrays import Floats

CONTROLLER_CYCLE_S = 0.0071
PACKET_BYTES = 196

COMMAND_NONE, COMMAND_MOVE, COMMAND_END = 0, 1, 255
TYPE_NONE, TYPE_JOINTS, TYPE_JOINTS_MEASURED = 0, 2, 8

MAX_PLAUSIBLE_RAD = 4.0 * math.pi
"""The maximum plausible joint angle. An answer with a larger angle is invalid."""

PACKET = (
    BlockField("command", "H", 1, "0 none, 1 move, 255 end"),
    BlockField(
        "send_type",
        "H",
        1,
        "type of `data`: 0 none, 1 pose, 2 joint angles, 3 pulses; in an answer 0 to 11",
    ),
    BlockField(
        "receive_type",
        "H",
        1,
        "requested type of the answer's `data`: 0 to 11; 8 measured joint angles",
    ),
    BlockField("reserved", "x", 2, "0"),
    BlockField("data", "f", 8, "joint angles in rad; the rest 0"),
    BlockField("flags", "I", 2, "structure and revolutions of a pose; 0"),
    BlockField("send_io_type", "H", 1, "0: no signals"),
    BlockField("receive_io_type", "H", 1, "0: no signals"),
    BlockField("bit_top", "H", 1, "0"),
    BlockField("bit_mask", "H", 1, "0"),
    BlockField("io_data", "H", 1, "0"),
    BlockField("timeouts", "H", 1, "in an answer: the controller's cycles without a command"),
    BlockField("count", "I", 1, "in an answer: the communications since the program's start"),
    BlockField("more_1", "x", 44, "a second quantity, not requested; 0"),
    BlockField("more_2", "x", 44, "a third"),
    BlockField("more_3", "x", 44, "a fourth"),
)


_PACKET = struct.Struct("<" + "".join(f"{field.count}{field.kind}" for field in PACKET))


@dataclass(frozen=True, slots=True)
class MxtStatus(ArmStatus):
    """The contents of an answer packet.

    count: number of communications since the controller's program started.
    timeouts: number of cycles in which no command arrived.
    """

    count: int
    timeouts: int


def encode(command: int, *, send_type: int = 0, data: Sequence[float] = ()) -> bytes:
    """Encode a command packet that requests the measured joint angles.

    send_type, data: type of the data in the command, and up to 8 numbers.
    """
    padded = (*data, *([0.0] * (8 - len(data))))
    return _PACKET.pack(command, send_type, TYPE_JOINTS_MEASURED, *padded, *([0] * 9))


def encode_joints(joints_rad: Floats) -> bytes:
    """Encode a motion to joint angles (6,) rad; raise ValueError unless six angles are finite."""
    return encode(COMMAND_MOVE, send_type=TYPE_JOINTS, data=validate_joints(joints_rad))


def decode_answer(packet: bytes) -> MxtStatus:
    """Decode an answer packet.

    Raises ArmAnswerError if the packet is invalid, and ArmRefusedError if the controller has ended
    external control.
    """
    if len(packet) != PACKET_BYTES:
        raise ArmAnswerError(f"the answer has {len(packet)} bytes instead of {PACKET_BYTES}")
    numbers = _PACKET.unpack(packet)
    (command, send_type, receive_type), data = numbers[:3], numbers[3:11]
    timeouts, count = numbers[18:20]
    if command not in (COMMAND_NONE, COMMAND_MOVE):
        raise ArmRefusedError("the controller has ended external control")
    # According to the manual, both fields contain the type of the answer's data.
    if {send_type, receive_type} - {TYPE_NONE} != {TYPE_JOINTS_MEASURED}:
        raise ArmAnswerError(
            f"the answer has the data types {send_type} and {receive_type} instead of "
            f"{TYPE_JOINTS_MEASURED} (measured joint angles)"
        )
    joints = np.array(data[:JOINTS])
    if not (np.abs(joints) <= MAX_PLAUSIBLE_RAD).all():
        raise ArmAnswerError("a measured joint is not an angle: its value is too large or NaN")
    return MxtStatus(joints_rad=joints, faults=(), count=count, timeouts=timeouts)


def has_advanced(count: int, before: int, steps: int) -> bool:
    """Return whether a 32-bit counter has advanced by at least `steps`."""
    return steps <= (count - before) % 2**32 < 2**31


class MxtLink:
    """A driver for a controller that runs an `Mxt` program.

    stale: number of late answers that were dropped.

    Late answers are detected by the controller's counter, which must advance by the number of
    commands since the last answer. After a lost command, the next answer is therefore dropped too.
    In the mode `idle`, the next answer is not compared with earlier answers.
    """

    def __init__(
        self,
        host: str,
        port: int,
        *,
        timeout_s: float = 2.0 * CONTROLLER_CYCLE_S,
    ) -> None:
        self.host, self.port = host, port
        self.stale = 0
        self._timeout_s = timeout_s
        self._socket: socket.socket | None = None
        self._count: int | None = None
        self._counters = CounterMonitor()
        self._unanswered = 0

    def due(self, now_ns: int) -> bool:
        return True

    async def exchange(self, *, mode: str, joints_rad: Floats, now_ns: int) -> MxtStatus:
        """Send a command with joint angles (6,) rad, and return the arm's answer.

        The controller answers within its cycle time CONTROLLER_CYCLE_S. Raises ArmLinkError if the
        exchange fails.
        """
        if mode == "idle":
            self._count, self._unanswered = None, 0
        loop = asyncio.get_running_loop()
        start_s = loop.time()
        packet = encode_joints(joints_rad) if mode == "move" else encode(COMMAND_NONE)
        try:
            link = await self._open()
            self._drop_late_answers(link)
            self._unanswered += 1
            link.send(packet)
            async with asyncio.timeout(self._timeout_s):
                status = await self._receive(link)
        except TimeoutError as error:
            raise ArmSilentError(
                f"no answer from {self.host}:{self.port} within {self._timeout_s * 1e3:.0f} ms; "
                "check the controller and the network cable"
            ) from error
        except OSError as error:
            raise ArmSilentError(f"{self.host}:{self.port}: {error.strerror}") from error
        finally:
            propagate_cancellation()
        self._count, self._unanswered = status.count, 0
        freshness = self._counters.classify(
            (status.count,),
            sent_ns=now_ns,
            received_ns=now_ns + round((loop.time() - start_s) * 1e9),
            may_restart=mode == "idle",
        )
        return replace(status, freshness=freshness)

    async def _open(self) -> socket.socket:
        """Return the socket, which receives only the controller's packets; open it if necessary."""
        if self._socket is None:
            link = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            link.setblocking(False)
            try:
                await asyncio.get_running_loop().sock_connect(link, (self.host, self.port))
            except BaseException:
                link.close()
                raise
            self._socket = link
        return self._socket

    def _drop_late_answers(self, link: socket.socket) -> None:
        while True:
            try:
                link.recv(2 * PACKET_BYTES)
            except BlockingIOError:
                return
            except ConnectionError:
                # Nobody received an earlier packet; the next exchange shows whether that persists.
                continue
            self.stale += 1

    async def _receive(self, link: socket.socket) -> MxtStatus:
        while True:
            packet = await asyncio.get_running_loop().sock_recv(link, 2 * PACKET_BYTES)
            status = decode_answer(packet)
            if self._count is None or has_advanced(status.count, self._count, self._unanswered):
                return status
            self.stale += 1

    def close(self) -> None:
        """Command the controller to end external control.

        If this command is lost, the controller ends external control after a time-out.
        """
        if self._socket is not None:
            with contextlib.suppress(OSError):
                self._socket.send(encode(COMMAND_END))
            self._socket.close()
        self._socket, self._count = None, None
