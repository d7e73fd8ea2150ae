"""Control an arm by lines of text over TCP, as an example of a driver.

Most controllers can run a program that reads and writes lines on a socket. A command is one line,
and its answer is one line. Spaces separate the fields. A command and its answer have these forms:

    SEQUENCE MODE Q1 Q2 Q3 Q4 Q5 Q6
    SEQUENCE COUNT FAULTS Q1 Q2 Q3 Q4 Q5 Q6

SEQUENCE is the number of the command, which its answer repeats. MODE is `idle`, `move`, `hold` or
`stop`. COUNT is the number of joint measurements of the controller, modulo 2**32. FAULTS is `-` if
there is no fault. Otherwise FAULTS is a list of `ArmFault` names in lower case, separated by
commas. Q1 to Q6 are the joint angles in radians.
"""

from __future__ import annotations

import asyncio
import math

import numpy as np

from flexsheet.nodes.arm_bridge.link import (
    JOINTS,
    ArmAnswerError,
    ArmFault,
    ArmSilentError,
    ArmStatus,
    ConnectedLink,
    validate_joints,
)
from flexsheet.nodes.arrays import Floats

MAX_LINE_BYTES = 512


def encode_line(sequence: int, mode: str, joints_rad: Floats) -> bytes:
    """Encode a command as a line; raise ValueError unless there are six finite joint angles."""
    angles = " ".join(f"{angle:.9g}" for angle in validate_joints(joints_rad))
    return f"{sequence} {mode} {angles}\n".encode("ascii")


def decode_line(line: bytes, sequence: int) -> tuple[ArmStatus, tuple[int, ...]]:
    """Decode the answer to a command; return the arm's status and its measurement counter.

    sequence: number of the command.

    Raises ArmAnswerError if the answer is invalid.
    """
    try:
        answered, count, faults, *angles = line.decode("ascii").split()
        joints = np.array([float(angle) for angle in angles])
        found = () if faults == "-" else tuple(ArmFault[one.upper()] for one in faults.split(","))
        numbers = int(answered), int(count)
    except (KeyError, ValueError) as error:
        raise ArmAnswerError(f"the answer {line[:80]!r} is not a status line") from error
    if numbers[0] != sequence:
        raise ArmAnswerError(f"expected the answer to command {sequence}, found {numbers[0]}")
    if len(joints) != JOINTS or not all(math.isfinite(angle) for angle in joints):
        raise ArmAnswerError(f"the answer {line[:80]!r} does not have {JOINTS} finite joint angles")
    if not 0 <= numbers[1] < 2**32:
        raise ArmAnswerError(f"the answer has the count {numbers[1]}; it must be 0 to 2**32 - 1")
    return ArmStatus(joints, found), (numbers[1],)


class LineLink(ConnectedLink):
    """A driver for a controller program that exchanges lines of text over TCP."""

    period_s = 0.008

    def __init__(self, host: str, port: int, *, timeout_s: float = 0.03) -> None:
        super().__init__(host, port, timeout_s=timeout_s)
        self._sequence = 0
        self._streams: tuple[asyncio.StreamReader, asyncio.StreamWriter] | None = None

    @property
    def connected(self) -> bool:
        return self._streams is not None and not self._streams[1].is_closing()

    async def _connect(self) -> None:
        try:
            async with asyncio.timeout(self._timeout_s):
                self._streams = await asyncio.open_connection(
                    self.host, self.port, limit=MAX_LINE_BYTES
                )
        except OSError as error:
            raise ArmSilentError(
                f"no connection to {self.host}:{self.port}: {error}; "
                "check the controller and the network cable"
            ) from error

    async def _request(
        self, mode: str, joints_rad: Floats, now_ns: int
    ) -> tuple[ArmStatus, tuple[int, ...]]:
        assert self._streams is not None
        reader, writer = self._streams
        self._sequence += 1
        writer.write(encode_line(self._sequence, mode, joints_rad))
        try:
            async with asyncio.timeout(self._timeout_s):
                line = await reader.readline()
        except TimeoutError as error:
            raise ArmSilentError(
                f"no answer from {self.host}:{self.port} within {self._timeout_s * 1e3:.0f} ms; "
                "check the controller and the network cable"
            ) from error
        except (OSError, ValueError) as error:
            raise ArmAnswerError(
                f"the answer of {self.host}:{self.port} cannot be read: {error}"
            ) from error
        if not line.endswith(b"\n"):
            raise ArmSilentError(
                f"{self.host}:{self.port} has closed the connection; check the controller"
            )
        return decode_line(line, self._sequence)

    def _disconnect(self) -> None:
        if self._streams is not None:
            self._streams[1].close()
        self._streams = None
