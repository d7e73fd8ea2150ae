"""What the bridge asks of a driver that carries commands to an arm, whatever its protocol."""

from __future__ import annotations

import asyncio
import math
from dataclasses import dataclass, field
from enum import Enum, StrEnum, auto
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

JOINTS = 6

MAX_UNCHANGED_S = 0.05
"""Counters that stand still for longer are stalled.  Within a controller's cycle (7.1 ms) two
exchanges may see the same counters; 50 ms are seven such cycles."""

_CIRCLE = 2**32


class ArmLinkError(Exception):
    """The exchange with an arm failed; the text says how, in one line."""


class ArmSilentError(ArmLinkError):
    """No connection, or no answer in time."""


class ArmRefusedError(ArmLinkError):
    """The arm answered that it does not take the command."""


class ArmAnswerError(ArmLinkError):
    """The answer is not of this protocol, is damaged, or belongs to another command."""


class ArmFault(Enum):
    """Faults that an arm's controller reports."""

    JOINT_RANGE = auto()
    STEP_SIZE = auto()
    NOT_FINITE = auto()
    WATCHDOG = auto()
    SERVO = auto()


FAULT_TEXTS = {
    ArmFault.JOINT_RANGE: "joint out of range",
    ArmFault.STEP_SIZE: "step too large",
    ArmFault.NOT_FINITE: "command not finite",
    ArmFault.WATCHDOG: "watchdog: no command",
    ArmFault.SERVO: "servo",
}
"""The text of each fault, for logs and for `ArmState.faults`."""


class Freshness(StrEnum):
    """What the controller's counters say about the age of the measured joints."""

    FIRST = "first"
    """First answer, or first after the controller has restarted: there is nothing to compare."""
    FRESH = "fresh"
    """The counters have advanced: the joints have been measured again."""
    REPEATED = "repeated"
    """The counters of the answer before; not for longer than MAX_UNCHANGED_S."""
    STALLED = "stalled"
    """The counters have stood still for longer than MAX_UNCHANGED_S."""
    REVERSED = "reversed"
    """A counter runs backwards: the joints are older than those of the answer before."""

    @property
    def is_believed(self) -> bool:
        """Whether the measured joints may be used."""
        return self not in (Freshness.STALLED, Freshness.REVERSED)


class CounterMonitor:
    """Compares a controller's 32-bit counters from answer to answer; they may wrap."""

    def __init__(self) -> None:
        self._last: tuple[int, ...] = ()
        self._advanced_ns: list[int] = []

    def judge(
        self, counters: tuple[int, ...], *, sent_ns: int, received_ns: int, may_restart: bool
    ) -> Freshness:
        """Return the freshness of an answer with these counters.

        counters: the first one counts measurements (or is their time); all must go on.  sent_ns,
        received_ns: when the command was sent and its answer came, by this computer's clock.
        may_restart: a counter that runs backwards means a restarted controller.
        """
        steps = [(new - old) % _CIRCLE for new, old in zip(counters, self._last, strict=False)]
        reverses = any(step >= _CIRCLE // 2 for step in steps)
        if not self._last or (reverses and may_restart):
            self._last, self._advanced_ns = counters, [received_ns] * len(counters)
            return Freshness.FIRST
        if reverses:
            return Freshness.REVERSED
        self._last = counters
        for number, step in enumerate(steps):
            if step > 0:
                self._advanced_ns[number] = received_ns
        # The time between two answers is at least that from receiving one to asking for the other.
        if (sent_ns - min(self._advanced_ns)) * 1e-9 > MAX_UNCHANGED_S:
            return Freshness.STALLED
        return Freshness.FRESH if steps[0] > 0 else Freshness.REPEATED


@dataclass(frozen=True, slots=True)
class ArmStatus:
    """What an arm answers: joints (6,) rad as measured, what is wrong with it, and how fresh."""

    joints_rad: Floats
    faults: tuple[ArmFault, ...]
    freshness: Freshness = field(default=Freshness.FIRST, kw_only=True)


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
