"""Clocks that nodes are given: the machine's own, and one that a test or a replay moves by hand."""

from __future__ import annotations

import time
from pathlib import Path
from platform import node as host_name
from typing import Protocol


class Clock(Protocol):
    """A monotonic clock.  `id` names it; stamps of equal `id` may be subtracted."""

    @property
    def id(self) -> str: ...

    def now_ns(self) -> int: ...


def read_boot_id() -> str:
    """The kernel's random identity of this boot; CLOCK_MONOTONIC restarts with it."""
    return Path("/proc/sys/kernel/random/read_boot_id").read_text().strip()


def read_namespace_offset() -> str:
    """By what a time namespace moves CLOCK_MONOTONIC, as "+36000.0"; empty outside of one."""
    try:
        lines = Path("/proc/self/timens_offsets").read_text().splitlines()
    except FileNotFoundError:
        return ""
    for name, seconds, nanoseconds in (line.split() for line in lines):
        if name == "monotonic" and (seconds, nanoseconds) != ("0", "0"):
            return f"+{seconds}.{nanoseconds}"
    return ""


class SystemClock:
    """CLOCK_MONOTONIC of this host: shared by all its processes, never set back."""

    def __init__(self) -> None:
        self._id = f"{host_name()}-{read_boot_id()[:8]}{read_namespace_offset()}"

    @property
    def id(self) -> str:
        return self._id

    def now_ns(self) -> int:
        return time.monotonic_ns()


class VirtualClock:
    """A clock that stands still until it is moved, for replay and for tests."""

    def __init__(self, start_ns: int = 0, *, clock_id: str = "virtual") -> None:
        self._now_ns = start_ns
        self._id = clock_id

    @property
    def id(self) -> str:
        return self._id

    def now_ns(self) -> int:
        return self._now_ns

    def move_to(self, now_ns: int) -> None:
        """Set the time; it never goes back (an earlier time leaves it where it is)."""
        self._now_ns = max(self._now_ns, now_ns)
