"""The Mitsubishi controllers' real-time external control (MXT) over UDP.

A robot program runs `Open "ENET:..." As #1 : Mxt 1,1,<filter ms>`; from then on the controller
takes one command packet in each of its cycles and answers each with what it measured.  Packets
are 196 bytes, little-endian, of fixed-width fields; `PACKET` is their layout, `docs/mxt.md` tells
which part of it is the maker's and what is not settled by public sources.
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
from numpy.typing import NDArray

from flexsheet.nodes.arm_bridge.kinematics import FLANGE_M, forward
from flexsheet.nodes.arm_bridge.link import (
    JOINTS,
    ArmAnswerError,
    ArmRefusedError,
    ArmSilentError,
    ArmStatus,
    CounterMonitor,
    be_cancelled,
    checked_joints,
)

Floats = NDArray[np.float64]

CONTROLLER_CYCLE_S = 0.0071
PACKET_BYTES = 196

COMMAND_NONE, COMMAND_MOVE, COMMAND_END = 0, 1, 255
TYPE_NONE, TYPE_POSE, TYPE_JOINTS, TYPE_PULSES = 0, 1, 2, 3
TYPE_JOINTS_MEASURED = 8

FLAG_RIGHT, FLAG_ABOVE, FLAG_NONFLIP = 4, 2, 1

IMPOSSIBLE_RAD = 4.0 * math.pi
"""No joint turns so far: an answer with such an angle is not one."""


@dataclass(frozen=True, slots=True)
class Field:
    """One entry of the packet; `kind` is a struct code: H (u16), I (u32), f (float32), x (pad)."""

    name: str
    kind: str
    count: int
    about: str


PACKET = (
    Field("command", "H", 1, "0 none, 1 move, 255 end"),
    Field(
        "send_type", "H", 1, "of `data`: 0 none, 1 pose, 2 joints, 3 pulses; in an answer 0 to 11"
    ),
    Field(
        "receive_type", "H", 1, "what the answer's `data` shall be: 0 to 11; 8 joints as measured"
    ),
    Field("reserved", "x", 2, "0"),
    Field("data", "f", 8, "joints in rad, or x y z in mm and a b c in rad; the rest 0"),
    Field("flags", "I", 2, "of a pose: structure (4 right, 2 above, 1 nonflip), and turns"),
    Field("send_io_type", "H", 1, "0: no signals"),
    Field("receive_io_type", "H", 1, "0: no signals"),
    Field("bit_top", "H", 1, "0"),
    Field("bit_mask", "H", 1, "0"),
    Field("io_data", "H", 1, "0"),
    Field("timeouts", "H", 1, "in an answer: the controller's cycles without a command"),
    Field("count", "I", 1, "in an answer: the communications since the program's start"),
    Field("more_1", "x", 44, "a second monitor: type, pad, data; not used"),
    Field("more_2", "x", 44, "a third"),
    Field("more_3", "x", 44, "a fourth"),
)


def struct_format(packet: Sequence[Field]) -> str:
    """The struct format of a packet, little-endian without any padding of the machine's own."""
    return "<" + "".join(f"{field.count}{field.kind}" for field in packet)


_PACKET = struct.Struct(struct_format(PACKET))


@dataclass(frozen=True, slots=True)
class MxtStatus(ArmStatus):
    """What an answer says; count and timeouts are the controller's own counters."""

    count: int
    timeouts: int


def encode(
    command: int, *, send_type: int = 0, data: Sequence[float] = (), flags: int = 0
) -> bytes:
    """A command packet that asks for the measured joints; data: up to 8 numbers."""
    padded = (*data, *([0.0] * (8 - len(data))))
    return _PACKET.pack(command, send_type, TYPE_JOINTS_MEASURED, *padded, flags, *([0] * 8))


def joints_packet(joints_rad: Floats) -> bytes:
    """Move to the joints; ValueError unless six and finite."""
    return encode(COMMAND_MOVE, send_type=TYPE_JOINTS, data=checked_joints(joints_rad))


def pose_packet(joints_rad: Floats) -> bytes:
    """Move the flange to where those joints would bring it, on their branch of solutions."""
    pose = forward(checked_joints(joints_rad))
    rotation = pose[:3, :3]
    # Turns about the fixed axes x, y, z in that order; at b = +-90 degrees only a - c is defined.
    level = math.hypot(rotation[0, 0], rotation[1, 0])
    b = math.atan2(-rotation[2, 0], level)
    if level > 1e-9:
        a, c = (
            math.atan2(rotation[2, 1], rotation[2, 2]),
            math.atan2(rotation[1, 0], rotation[0, 0]),
        )
    else:
        a, c = math.atan2(-rotation[1, 2], rotation[1, 1]), 0.0
    return encode(
        COMMAND_MOVE,
        send_type=TYPE_POSE,
        data=(*(pose[:3, 3] * 1e3).tolist(), a, b, c),
        flags=branch_flags(joints_rad, pose),
    )


def branch_flags(joints_rad: Floats, base_from_flange: Floats) -> int:
    """The structure flag of joints: shoulder right, wrist nonflip; above, as J3 always is."""
    wrist = base_from_flange[:3, 3] - FLANGE_M * base_from_flange[:3, 2]
    ahead = wrist[0] * math.cos(joints_rad[0]) + wrist[1] * math.sin(joints_rad[0])
    shoulder = FLAG_RIGHT if ahead >= 0.0 else 0
    return shoulder | FLAG_ABOVE | (FLAG_NONFLIP if joints_rad[4] >= 0.0 else 0)


def decode_answer(packet: bytes) -> MxtStatus:
    """The status of an answer; ArmAnswerError says what is wrong with it."""
    if len(packet) != PACKET_BYTES:
        raise ArmAnswerError(f"answer of {len(packet)} bytes, wanted {PACKET_BYTES}")
    command, send_type, receive_type, *data, _, _, _, _, _, _, _, timeouts, count = _PACKET.unpack(
        packet
    )
    if command not in (COMMAND_NONE, COMMAND_MOVE):
        raise ArmRefusedError("the controller has ended external control")
    # The manual puts the answer's type in both fields, to read "whichever"; an empty one is none.
    if {send_type, receive_type} - {TYPE_NONE} != {TYPE_JOINTS_MEASURED}:
        raise ArmAnswerError(
            f"answer of types {send_type} and {receive_type}, wanted {TYPE_JOINTS_MEASURED}"
        )
    joints = np.array(data[:JOINTS])
    if not (np.abs(joints) <= IMPOSSIBLE_RAD).all():
        raise ArmAnswerError("measured joints are not angles")
    return MxtStatus(joints_rad=joints, faults=(), count=count, timeouts=timeouts)


def has_gone_on(count: int, before: int, steps: int) -> bool:
    """Whether a 32-bit counter has gone on by `steps` or more, but less than half its circle."""
    return steps <= (count - before) % 2**32 < 2**31


class MxtLink:
    """An `ArmLink` to a controller that runs an `Mxt` program.

    The socket, and with it the port that the controller answers to, stays for good.  An answer that
    comes after its time is thrown away ahead of the next command, or told by the controller's
    counter, which must go on by all the commands sent since the last answer.  A command that was
    lost is therefore two unanswered ones.  `idle` begins anew, whatever the counter says.
    """

    def __init__(
        self,
        host: str,
        port: int,
        *,
        timeout_s: float = 2.0 * CONTROLLER_CYCLE_S,
        poses: bool = False,
    ) -> None:
        self.host, self.port = host, port
        self.stale = 0
        self._timeout_s = timeout_s
        self._move_packet = pose_packet if poses else joints_packet
        self._socket: socket.socket | None = None
        self._count: int | None = None
        self._counters = CounterMonitor()
        self._unanswered = 0

    def due(self, now_ns: int) -> bool:
        """Always: there is no connection to wait for."""
        return True

    async def exchange(self, *, mode: str, joints_rad: Floats, now_ns: int) -> MxtStatus:
        """Send one command and return the status that answers it; raises ArmLinkError.

        The controller answers in its own cycle, so that this may take as long.
        """
        if mode == "idle":
            self._count, self._unanswered = None, 0
        loop = asyncio.get_running_loop()
        begun_s = loop.time()
        packet = self._move_packet(joints_rad) if mode == "move" else encode(COMMAND_NONE)
        try:
            link = await self._open()
            self._throw_away_late(link)
            self._unanswered += 1
            link.send(packet)
            async with asyncio.timeout(self._timeout_s):
                status = await self._answer(link)
        except TimeoutError as error:
            raise ArmSilentError(
                f"no answer from {self.host}:{self.port} within {self._timeout_s * 1e3:.0f} ms"
            ) from error
        except OSError as error:
            raise ArmSilentError(f"{self.host}:{self.port}: {error.strerror}") from error
        finally:
            be_cancelled()
        self._count, self._unanswered = status.count, 0
        freshness = self._counters.judge(
            (status.count,),
            sent_ns=now_ns,
            received_ns=now_ns + round((loop.time() - begun_s) * 1e9),
            may_restart=mode == "idle",
        )
        return replace(status, freshness=freshness)

    async def _open(self) -> socket.socket:
        """The socket; bound to the controller's address, others' packets do not reach it."""
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

    def _throw_away_late(self, link: socket.socket) -> None:
        while True:
            try:
                link.recv(2 * PACKET_BYTES)
            except BlockingIOError:
                return
            except ConnectionError:
                # Nobody listened to an earlier packet; whether anybody does now is seen below.
                continue
            self.stale += 1

    async def _answer(self, link: socket.socket) -> MxtStatus:
        while True:
            packet = await asyncio.get_running_loop().sock_recv(link, 2 * PACKET_BYTES)
            status = decode_answer(packet)
            if self._count is None or has_gone_on(status.count, self._count, self._unanswered):
                return status
            self.stale += 1

    def close(self) -> None:
        """End external control; should that packet get lost, the controller's time-out does it."""
        if self._socket is not None:
            with contextlib.suppress(OSError):
                self._socket.send(encode(COMMAND_END))
            self._socket.close()
        self._socket, self._count = None, None
