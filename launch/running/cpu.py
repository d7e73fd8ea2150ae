"""Measure how long nodes wait for a processor core, and which programs use the cores.

For each thread, Linux counts the time in which the thread was ready to run but did not get a core
(`/proc/PID/schedstat`). The main thread of a node runs its event loop, so this wait delays the
whole node. System-wide counters (load, /proc/pressure) do not show whether nodes are delayed. They
also count programs of high niceness, which are expected to wait.
"""

from __future__ import annotations

import os
import time
from collections import defaultdict, deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from flexsheet.messages.types import CpuPressure, ProgramCpu

MAX_WAIT_RATIO = 0.25
"""The maximum fraction of time that a node can wait for a core on a computer without overload."""

WINDOW_S = 3.0
BACKGROUND_NICE = 5
"""The minimum niceness of nodes whose waiting time is ignored.

These nodes are expected to wait.
"""

MAX_PROGRAMS = 3
MIN_CORES = 0.1
PROC = Path("/proc")
_TICKS_PER_S = os.sysconf("SC_CLK_TCK")


@dataclass(frozen=True, slots=True)
class Waits:
    """The total time (s) that each process has waited for a core until `time_s`, by process id."""

    time_s: float
    waited_s: dict[int, float]


class CpuWatch:
    """A monitor that measures how long processes wait for a processor core.

    Waiting times are measured over the last WINDOW_S seconds, or since the last call if that is
    longer ago. The monitor also finds the programs that use the cores. Call `update` once a second.

    proc: folder of the kernel's counters.
    now_s: function that returns the time (s) of the monotonic clock.
    min_s: time (s) for which a process must be watched before its waiting time is known.
    """

    def __init__(
        self,
        proc: Path = PROC,
        now_s: Callable[[], float] = time.monotonic,
        *,
        min_s: float = 0.0,
    ) -> None:
        self._proc, self._now_s, self._min_s = proc, now_s, min_s
        self._history: deque[Waits] = deque()
        self._cpu_before: tuple[float, dict[tuple[str, int], float]] | None = None

    @property
    def can_measure(self) -> bool:
        """Whether the kernel counts waiting times."""
        return (self._proc / "self" / "schedstat").exists()

    def update(
        self,
        watched: Mapping[str, int],
        named: Mapping[str, int] | None = None,
        *,
        measure_programs: bool = False,
    ) -> CpuPressure | None:
        """Return the name and waiting time of the node that waited longest for the processor.

        The waiting time is measured over the last WINDOW_S seconds. Returns None if no waiting time
        is known. If the computer is overloaded, the programs that use the most processor time are
        included.

        watched: process ids of the measured nodes, by node name.
        named: process ids of all nodes, by node name. In the list of programs, these processes have
            the names of their nodes. If it is None, `watched` is used.
        measure_programs: whether to list the programs even if the computer is not overloaded.
        """
        now_s = self._now_s()
        counted = {pid: self._waited_s(pid) for pid in watched.values()}
        waited_s = {pid: waited for pid, waited in counted.items() if waited is not None}
        # A caller that is itself delayed may call less often than once in the window.
        while len(self._history) > 1 and self._history[1].time_s <= now_s - WINDOW_S:
            self._history.popleft()
        # The kernel counts a wait when it ends, including its part before the window.
        ratios = {
            name: min(1.0, (waited_s[pid] - before.waited_s[pid]) / (now_s - before.time_s))
            for name, pid in watched.items()
            if pid in waited_s
            and (before := self._first_with(pid))
            and now_s - before.time_s > self._min_s
        }
        self._history.append(Waits(now_s, waited_s))
        node = max(ratios, key=lambda name: ratios[name], default="")
        busy = bool(node) and ratios[node] > MAX_WAIT_RATIO
        programs: tuple[ProgramCpu, ...] = ()
        if busy or measure_programs:
            programs = self._programs(now_s, watched if named is None else named)
        if not node:
            return None
        return CpuPressure(busy=busy, wait_ratio=ratios[node], node=node, programs=programs)

    def _first_with(self, pid: int) -> Waits | None:
        return next((one for one in self._history if pid in one.waited_s), None)

    def _waited_s(self, pid: int) -> float | None:
        """Return how long (s) a process's main thread has waited for a core; None if unknown."""
        try:
            fields = (self._proc / str(pid) / "schedstat").read_text().split()
        except OSError:
            return None  # the process has ended, or the kernel has no such counters
        return int(fields[1]) * 1e-9

    def _programs(self, now_s: float, named: Mapping[str, int]) -> tuple[ProgramCpu, ...]:
        """Return the programs that have used the most processor time since the last call.

        The result is empty if the last call was more than WINDOW_S seconds ago.

        named: process ids of nodes, by node name. The result contains the node names instead of the
            names of their programs.
        """
        names = {pid: name for name, pid in named.items()}
        used = {(names.get(pid, program), pid): s for program, pid, s in self._cpu_times()}
        before, self._cpu_before = self._cpu_before, (now_s, used)
        if before is None or not 0.0 < now_s - before[0] <= WINDOW_S:
            return ()
        cores: dict[str, float] = defaultdict(float)
        for key, seconds in used.items():
            if key in before[1]:
                cores[key[0]] += (seconds - before[1][key]) / (now_s - before[0])
        largest = sorted(cores.items(), key=lambda one: -one[1])[:MAX_PROGRAMS]
        return tuple(ProgramCpu(name=name, cores=one) for name, one in largest if one >= MIN_CORES)

    def _cpu_times(self) -> Iterator[tuple[str, int, float]]:
        """Yield the program name, process id and total processor time (s) of each process."""
        for folder in self._proc.iterdir():
            if not folder.name.isdigit():
                continue
            found = _read_cpu_time(folder)
            if found is not None:
                yield found[0], int(folder.name), found[1]


class CpuMeter:
    """A meter of the processor time that a group of threads uses.

    proc: folder of the kernel's counters.
    now_s: function that returns the time (s) of the monotonic clock.
    """

    def __init__(self, proc: Path = PROC, now_s: Callable[[], float] = time.monotonic) -> None:
        self._proc, self._now_s = proc, now_s
        self._before: tuple[float, dict[int, float]] | None = None

    def measure_cores(self, threads: Mapping[int, Iterable[int]]) -> float:
        """Return the number of cores that the threads have used since the last call.

        A thread that was not measured in the last call counts as 0.

        threads: ids of the threads, by process id.
        """
        now_s = self._now_s()
        found = {
            thread: _read_cpu_time(self._proc / str(pid) / "task" / str(thread))
            for pid, ids in threads.items()
            for thread in ids
        }
        used_s = {thread: one[1] for thread, one in found.items() if one is not None}
        before, self._before = self._before, (now_s, used_s)
        if before is None or before[0] >= now_s:
            return 0.0
        common = used_s.keys() & before[1].keys()
        return sum(used_s[one] - before[1][one] for one in common) / (now_s - before[0])


def _read_cpu_time(folder: Path) -> tuple[str, float] | None:
    """Return the name and the total processor time (s) of a process or thread.

    Returns None if it has ended.

    folder: folder of the process or thread in /proc.
    """
    try:
        text = (folder / "stat").read_text(errors="replace")
    except OSError:
        return None
    # The name in brackets can itself contain brackets, so it is split at the last one. User and
    # system time are fields 14 and 15.
    head, _, tail = text.rpartition(")")
    user, system = tail.split()[11:13]
    return head.partition("(")[2], (int(user) + int(system)) / _TICKS_PER_S
