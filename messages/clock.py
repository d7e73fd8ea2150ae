"""Define the clocks of nodes: the system clock, and a virtual clock for tests and replays."""

from __future__ import annotations

import time
from pathlib import Path
from platform import node as host_name
from typing import Protocol


class Clock(Protocol):
    """The interface of a monotonic clock.

    Two timestamps may be subtracted only if their clocks have the same `id`.
    """

    @property
    def id(self) -> str: ...

    def now_ns(self) -> int: ...


def read_namespace_offset() -> str:
    """Return the offset (s) of CLOCK_MONOTONIC in the time namespace of this process.

    The result is text such as "+36000.0", or an empty string if there is no offset.
    """
    try:
        lines = Path("/proc/self/timens_offsets").read_text().splitlines()
    except FileNotFoundError:
        return ""
    for name, seconds, nanoseconds in (line.split() for line in lines):
        if name == "monotonic" and (seconds, nanoseconds) != ("0", "0"):
            return f"+{seconds}.{nanoseconds}"
    return ""


class SystemClock:
    """The system clock CLOCK_MONOTONIC, which all processes of this host share."""

    def __init__(self) -> None:
        # The kernel assigns a random identifier to each boot.
        boot_id = Path("/proc/sys/kernel/random/boot_id").read_text()
        self.id = f"{host_name()}-{boot_id[:8]}{read_namespace_offset()}"

    def now_ns(self) -> int:
        return time.monotonic_ns()


class VirtualClock:
    """A clock for replays and tests, whose time changes only when `move_to` is called."""

    def __init__(self, start_ns: int = 0, *, clock_id: str = "virtual") -> None:
        self._now_ns = start_ns
        self.id = clock_id

    def now_ns(self) -> int:
        return self._now_ns

    def move_to(self, now_ns: int) -> None:
        """Set the time to `now_ns`. If `now_ns` is earlier than the current time, do nothing."""
        self._now_ns = max(self._now_ns, now_ns)
