"""Define the interface of drivers that send commands to an arm, for any protocol."""

from __future__ import annotations

import asyncio
import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, field, replace
from enum import Enum, StrEnum, auto
from typing import ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from flexsheet.messages.errors import FlexsheetError

Floats = NDArray[np.float64]

JOINTS = 6

MAX_UNCHANGED_S = 0.05
"""Maximum time for which a controller's counters may stay unchanged: seven of its cycles of 7.1 ms.
Two exchanges within one cycle may return the same counters."""

_COUNTER_PERIOD = 2**32


class ArmLinkError(FlexsheetError):
    """A failed exchange with an arm, with the reason in one line."""

    code = "arm-link"
    remedy = "Check the arm's address, power, cable and program."


class ArmSilentError(ArmLinkError):
    """No connection to an arm, or no answer from it in time."""

    code = "arm-silent"
    remedy = (
        "First check whether the computer is busy (`flexsheet doctor`, row `load`): the usual "
        "cause with simulated arms. Then check the arm's address, power, cable and program."
    )


class ArmRefusedError(ArmLinkError):
    """An arm's answer that rejects the command."""

    code = "arm-refused"
    remedy = "Read the reason on the controller's teach pendant: enabled, no alarm, in remote mode?"


class ArmAnswerError(ArmLinkError):
    """An arm's answer that is damaged, follows another protocol or answers another command."""

    code = "arm-answer"
    remedy = (
        "Check whether another program controls the same arm, and the version of the arm's program."
    )


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
"""Text of each fault, for logs and for `ArmState.faults`."""


class Freshness(StrEnum):
    """Whether measured joints are new, according to the counters in the controller's answer."""

    FIRST = "first"
    """This is the first answer since the start of the link or of the controller."""
    FRESH = "fresh"
    """The counters have advanced, so the joints are measured again."""
    REPEATED = "repeated"
    """The counters equal those of the previous answer, but only for a permitted time so far."""
    STALLED = "stalled"
    """The counters have not advanced for too long (`max_unchanged_s`)."""
    REVERSED = "reversed"
    """A counter runs backwards, so the joints are older than the previous ones."""

    @property
    def is_usable(self) -> bool:
        """Return whether the measured joints may be used."""
        return self not in (Freshness.STALLED, Freshness.REVERSED)


class CounterMonitor:
    """Monitor of a controller's 32-bit counters, which detects measurements that are not new."""

    def __init__(self, max_unchanged_s: float = MAX_UNCHANGED_S) -> None:
        self._max_unchanged_s = max_unchanged_s
        self._last: tuple[int, ...] = ()
        self._advanced_ns: list[int] = []

    def classify(
        self, counters: tuple[int, ...], *, sent_ns: int, received_ns: int, may_restart: bool
    ) -> Freshness:
        """Return the freshness of an answer with these counters.

        counters: all must advance; the first is the number of measurements, or their time.
        sent_ns, received_ns: times of the command and of its answer, on this computer's clock.
        may_restart: whether a counter that runs backwards means a restarted controller.
        """
        steps = [
            (new - old) % _COUNTER_PERIOD for new, old in zip(counters, self._last, strict=False)
        ]
        reverses = any(step >= _COUNTER_PERIOD // 2 for step in steps)
        if not self._last or (reverses and may_restart):
            self._last, self._advanced_ns = counters, [received_ns] * len(counters)
            return Freshness.FIRST
        if reverses:
            return Freshness.REVERSED
        self._last = counters
        for number, step in enumerate(steps):
            if step > 0:
                self._advanced_ns[number] = received_ns
        # The time between two answers is at least that from receiving one to requesting the next.
        if (sent_ns - min(self._advanced_ns)) * 1e-9 > self._max_unchanged_s:
            return Freshness.STALLED
        return Freshness.FRESH if steps[0] > 0 else Freshness.REPEATED


@dataclass(frozen=True, slots=True)
class ArmStatus:
    """Answer of an arm: measured joints (6,) rad, faults, and whether the joints are new.

    currents_percent: motor currents (6,), percent of the rated ones; None if they are not reported.
    """

    joints_rad: Floats
    faults: tuple[ArmFault, ...]
    freshness: Freshness = field(default=Freshness.FIRST, kw_only=True)
    currents_percent: Floats | None = field(default=None, kw_only=True)


@dataclass(frozen=True, slots=True)
class BlockField:
    """Field of a register block or packet.

    kind: code of Python's `struct`: H (u16), I (u32), i (i32), f (float32) or x (padding).
    """

    name: str
    kind: str
    count: int
    about: str


class ArmLink(Protocol):
    """Interface for the exchange of commands and answers with one arm, one exchange at a time.

    Modes: `idle` (no motion; restarts after a fault or a lost connection), `move` (to the given
    joints), `hold` and `stop` (no motion).
    """

    def due(self, now_ns: int) -> bool:
        """Return whether an exchange may be tried now."""
        ...

    async def exchange(self, *, mode: str, joints_rad: Floats, now_ns: int) -> ArmStatus:
        """Send one command and return the status that answers it; raises ArmLinkError."""
        ...

    def close(self) -> None:
        """Close the connection; the next exchange opens it again."""
        ...


class ConnectedLink(ABC):
    """Base class of drivers that use one connection, on which each command gets one answer.

    A driver implements `connected`, `_connect`, `_request` and `_disconnect`.  This class uses them
    to implement `ArmLink`.  It opens the connection when it is needed, and closes it after a
    failure.  After the first failure it reconnects at once, then after pauses that double up to
    `max_pause_s`.  Counters in the answers show whether the measured joints are new.
    """

    period_s: ClassVar[float] = 0.0071
    """Period with which the controller measures its joints.  Answers may repeat a measurement for
    seven periods, or for MAX_UNCHANGED_S if that is longer."""

    def __init__(
        self,
        host: str,
        port: int,
        *,
        timeout_s: float,
        min_pause_s: float = 0.05,
        max_pause_s: float = 1.0,
    ) -> None:
        self.host, self.port = host, port
        self.connections = 0
        self._timeout_s = timeout_s
        self._min_pause_s, self._max_pause_s = min_pause_s, max_pause_s
        self._pause_s = 0.0
        self._try_again_ns = 0
        self._counters = CounterMonitor(max(MAX_UNCHANGED_S, 7.0 * self.period_s))

    @property
    @abstractmethod
    def connected(self) -> bool:
        """Return whether the connection is open."""

    @abstractmethod
    async def _connect(self) -> None:
        """Open the connection; raises ArmSilentError."""

    @abstractmethod
    async def _request(
        self, mode: str, joints_rad: Floats, now_ns: int
    ) -> tuple[ArmStatus, tuple[int, ...]]:
        """Send one command, wait for its answer, and return the status and its counters.

        mode, joints_rad: see `ArmLink`.  now_ns: time of the command.  The counters are 32-bit
        counters of the controller; the first one counts its joint measurements.  Raises
        ArmSilentError, ArmRefusedError or ArmAnswerError.
        """

    @abstractmethod
    def _disconnect(self) -> None:
        """Close the connection, if any."""

    def due(self, now_ns: int) -> bool:
        """Return whether a connection is open, or the pause before the next attempt is over."""
        return self.connected or now_ns >= self._try_again_ns

    async def exchange(self, *, mode: str, joints_rad: Floats, now_ns: int) -> ArmStatus:
        """Send one command and return the status that answers it; raises ArmLinkError."""
        loop = asyncio.get_running_loop()
        start_s = loop.time()
        try:
            if not self.connected:
                self.close()
                await self._connect()
                self.connections += 1
            status, counters = await self._request(mode, joints_rad, now_ns)
        except ArmRefusedError:
            raise
        except ArmLinkError:
            self.close()
            self._try_again_ns = now_ns + int(self._pause_s * 1e9)
            doubled_s = max(2.0 * self._pause_s, self._min_pause_s)
            self._pause_s = min(doubled_s, self._max_pause_s)
            raise
        except asyncio.CancelledError:
            # A late answer could otherwise be taken for the answer to the next command.
            self.close()
            raise
        finally:
            propagate_cancellation()
        self._pause_s = 0.0
        freshness = self._counters.classify(
            counters,
            sent_ns=now_ns,
            received_ns=now_ns + round((loop.time() - start_s) * 1e9),
            may_restart=mode == "idle",
        )
        return replace(status, freshness=freshness)

    def close(self) -> None:
        """Close the connection; the next exchange opens it again."""
        self._disconnect()


def validate_joints(joints_rad: Floats) -> tuple[float, ...]:
    """Return joints as numbers; raises ValueError unless there are six, all finite.

    The limiter already ensures this.  Drivers check it once more before they send a command.
    """
    joints = tuple(float(angle) for angle in joints_rad)
    if len(joints) != JOINTS or not all(math.isfinite(angle) for angle in joints):
        raise ValueError(f"joints to send must be {JOINTS} finite angles, not {joints}")
    return joints


def propagate_cancellation() -> None:
    """Raise CancelledError again if a time-out of Python 3.11 has suppressed it.

    This happens if an answer or a time-out arrives in the same iteration of the event loop as the
    cancellation.  Otherwise the task would never end.
    """
    task = asyncio.current_task()
    if task is not None and task.cancelling():
        raise asyncio.CancelledError
