"""Define the interface of the drivers that exchange commands and answers with an arm."""

from __future__ import annotations

import asyncio
import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, field, replace
from enum import Enum, StrEnum, auto
from typing import ClassVar, Protocol

from flexsheet.messages.errors import FlexsheetError
from flexsheet.nodes.arrays import Floats

JOINTS = 6

MAX_UNCHANGED_S = 0.05
"""The maximum time (s) for which a controller's counters may stay unchanged: seven cycles of 7.1
ms."""

MIN_PAUSE_S, MAX_PAUSE_S = 0.05, 0.2
"""The minimum and the maximum pause (s) before a driver opens a failed connection again."""

_COUNTER_PERIOD = 2**32


class ArmLinkError(FlexsheetError):
    """The error raised if an exchange with an arm fails."""

    remedy = "Check the arm's address, power, cable and program."


class ArmSilentError(ArmLinkError):
    """The error raised if an arm does not accept a connection or does not answer in time."""

    remedy = (
        "First check whether the computer is overloaded (`flexsheet doctor`, row `load`), which is "
        "the usual cause with simulated arms. Then check the arm's address, power, cable and "
        "program."
    )


class ArmRefusedError(ArmLinkError):
    """The error raised if an arm refuses a command."""

    remedy = (
        "Read the reason on the controller's teach pendant. The arm must be enabled, without alarm "
        "and in remote mode."
    )


class ArmAnswerError(ArmLinkError):
    """The error raised if an answer is damaged, invalid or intended for another command."""

    remedy = (
        "Check that no other program controls the arm, and check the version of the arm's program."
    )


class ArmFault(Enum):
    """The faults that an arm's controller reports."""

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
    ArmFault.SERVO: "servo fault",
}
"""The text of each fault, for logs and for `ArmState.faults`."""


class Freshness(StrEnum):
    """The freshness of measured joint angles, determined from the controller's counters."""

    FIRST = "first"
    """The first measurement since the start of the link or of the controller."""
    FRESH = "fresh"
    """A new measurement, because the counters have advanced."""
    REPEATED = "repeated"
    """A repeated measurement. The counters have been unchanged for at most the permitted time."""
    STALLED = "stalled"
    """A repeated measurement. The counters have been unchanged for more than the permitted time."""
    REVERSED = "reversed"
    """A measurement that is older than the previous measurement, because a counter has decreased.
    """

    @property
    def is_usable(self) -> bool:
        """Return whether the measured joint angles may be used."""
        return self not in (Freshness.STALLED, Freshness.REVERSED)


class CounterMonitor:
    """A detector of old or repeated measurements, which compares the controller's 32-bit counters.

    max_unchanged_s: maximum time for which the counters may stay unchanged.
    """

    def __init__(self, max_unchanged_s: float = MAX_UNCHANGED_S) -> None:
        self._max_unchanged_s = max_unchanged_s
        self._last: tuple[int, ...] = ()
        self._advanced_ns: list[int] = []

    def classify(
        self, counters: tuple[int, ...], *, sent_ns: int, received_ns: int, may_restart: bool
    ) -> Freshness:
        """Classify the freshness of an answer by its counters.

        counters: counters of the controller, which must all advance. The first counter is the
            number or the time of the measurements.
        sent_ns, received_ns: times of the command and of its answer on this computer's clock.
        may_restart: whether a decreased counter means that the controller has restarted.
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
    """An arm's answer: measured joint angles (6,) rad, faults, and the freshness of the angles."""

    joints_rad: Floats
    faults: tuple[ArmFault, ...]
    freshness: Freshness = field(default=Freshness.FIRST, kw_only=True)


@dataclass(frozen=True, slots=True)
class BlockField:
    """A field of a Modbus register block or of an MXT packet.

    kind: code of Python's `struct`: H (u16), I (u32), i (i32), f (float32) or x (padding).
    """

    name: str
    kind: str
    count: int
    about: str


class ArmLink(Protocol):
    """The interface for the exchange of commands and answers with one arm.

    The mode `move` commands a motion to joint angles. The modes `hold`, `stop` and `idle` command
    no motion. The mode `idle` restarts the exchange after a fault or a lost connection.
    """

    def due(self, now_ns: int) -> bool:
        """Return whether an exchange may be attempted now."""
        ...

    async def exchange(self, *, mode: str, joints_rad: Floats, now_ns: int) -> ArmStatus:
        """Send a command with joint angles (6,) rad, and return the arm's answer.

        Raises ArmLinkError if the exchange fails.
        """
        ...

    def close(self) -> None:
        """Close the connection; the next exchange opens it again."""
        ...


class ConnectedLink(ABC):
    """A base class for drivers that send commands over one connection and receive one answer each.

    connections: number of connections that were opened.

    A driver implements `connected`, `_connect`, `_request` and `_disconnect`. The base class opens
    the connection, and closes the connection after a failure. The first reconnection is immediate.
    Before each further attempt, the driver waits for a pause. The first pause is MIN_PAUSE_S. Each
    pause is twice as long as the previous one, up to MAX_PAUSE_S.
    """

    period_s: ClassVar[float] = 0.0071
    """The period (s) with which the controller measures the joint angles. Answers may repeat a
    measurement for seven periods, or for MAX_UNCHANGED_S if that time is longer."""

    def __init__(self, host: str, port: int, *, timeout_s: float) -> None:
        self.host, self.port = host, port
        self.connections = 0
        self._timeout_s = timeout_s
        self._pause_s = 0.0
        self._try_again_ns = 0
        self._counters = CounterMonitor(max(MAX_UNCHANGED_S, 7.0 * self.period_s))

    @property
    @abstractmethod
    def connected(self) -> bool:
        """Return whether the connection is open."""

    @abstractmethod
    async def _connect(self) -> None:
        """Open the connection; raise ArmSilentError if this fails."""

    @abstractmethod
    async def _request(
        self, mode: str, joints_rad: Floats, now_ns: int
    ) -> tuple[ArmStatus, tuple[int, ...]]:
        """Send one command, wait for its answer, and return the arm's status and counters.

        mode: `move`, `hold`, `stop` or `idle`, as in `ArmLink`.
        now_ns: time of the command.

        The first counter is the number of the controller's joint measurements. Raises
        ArmSilentError, ArmRefusedError or ArmAnswerError.
        """

    @abstractmethod
    def _disconnect(self) -> None:
        """Close the connection if it is open."""

    def due(self, now_ns: int) -> bool:
        """Return whether an exchange may be attempted now.

        No exchange is attempted during the pause after a failure.
        """
        return self.connected or now_ns >= self._try_again_ns

    async def exchange(self, *, mode: str, joints_rad: Floats, now_ns: int) -> ArmStatus:
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
            self._pause_s = min(max(2.0 * self._pause_s, MIN_PAUSE_S), MAX_PAUSE_S)
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
        self._disconnect()


def validate_joints(joints_rad: Floats) -> tuple[float, ...]:
    """Return joint angles (6,) rad as a tuple; raise ValueError unless six angles are finite."""
    joints = tuple(float(angle) for angle in joints_rad)
    if len(joints) != JOINTS or not all(math.isfinite(angle) for angle in joints):
        raise ValueError(f"a command must contain {JOINTS} finite angles, not {joints}")
    return joints


def propagate_cancellation() -> None:
    """Raise CancelledError if the current task was cancelled.

    In Python 3.11, a time-out can suppress a cancellation in the same iteration of the event loop.
    The cancelled task would then never end.
    """
    task = asyncio.current_task()
    if task is not None and task.cancelling():
        raise asyncio.CancelledError
