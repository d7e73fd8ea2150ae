"""What the bridge asks of a driver that carries commands to an arm, whatever its protocol."""

from __future__ import annotations

import asyncio
import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

JOINTS = 6


class ArmLinkError(Exception):
    """The exchange with an arm failed; the text says how, in one line."""


class ArmSilentError(ArmLinkError):
    """No connection, or no answer in time."""


class ArmRefusedError(ArmLinkError):
    """The arm answered that it does not take the command."""


class ArmAnswerError(ArmLinkError):
    """The answer is not of this protocol, is damaged, or belongs to another command."""


@dataclass(frozen=True, slots=True)
class ArmStatus:
    """What an arm answers: joints (6,) rad as measured, and what is wrong with it."""

    joints_rad: Floats
    faults: tuple[str, ...]


class ArmLink(Protocol):
    """One arm at the other end of a network; one exchange at a time.

    Modes are `idle` (no motion; begins anew after a fault or a loss), `move` (to the joints given),
    `hold` and `stop` (stay).
    """

    def due(self, now_ns: int) -> bool:
        """Whether an exchange may be tried now."""
        ...

    async def exchange(self, *, mode: str, joints_rad: Floats, now_ns: int) -> ArmStatus:
        """Send one command and return the status that answers it; raises ArmLinkError."""
        ...

    def close(self) -> None:
        """Let the arm go; the next exchange begins anew."""
        ...


def checked_joints(joints_rad: Floats) -> tuple[float, ...]:
    """The six angles as numbers; ValueError unless there are six and all finite.

    The limiter lets nothing else through; here is the last place to notice if it did.
    """
    joints = tuple(float(angle) for angle in joints_rad)
    if len(joints) != JOINTS or not all(math.isfinite(angle) for angle in joints):
        raise ValueError(f"joints to send must be {JOINTS} finite angles, not {joints}")
    return joints


def be_cancelled() -> None:
    """Raise the cancellation that Python 3.11's time-outs swallow.

    They do when an answer or a time-out comes in the same turn of the loop; the task would then
    never end.
    """
    task = asyncio.current_task()
    if task is not None and task.cancelling():
        raise asyncio.CancelledError
