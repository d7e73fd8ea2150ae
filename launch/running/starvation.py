"""Distinguish a process that hangs from a process that waits for a processor core."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Self

RUNNABLE = "R"


@dataclass(frozen=True, slots=True)
class ProcessorTime:
    """The kernel counters of the main thread of a process since its start.

    run_s: time on a processor core.
    wait_s: time that the thread waited for a core. It includes only waits that ended before the
        thread last ran.
    state: letter of the thread's state in /proc/PID/stat, such as R (ready or running).
    """

    run_s: float
    wait_s: float
    state: str

    @classmethod
    def read(cls, process: int) -> Self | None:
        """Read the counters of the process with this id; return None if the process has ended."""
        try:
            run, wait, slices = Path(f"/proc/{process}/schedstat").read_text().split()
            stat = Path(f"/proc/{process}/stat").read_text()
        except (OSError, ValueError):
            return None
        # A kernel without these statistics writes zeros.
        if slices == "0":
            return None
        return cls(int(run) * 1e-9, int(wait) * 1e-9, stat[stat.rindex(")") + 2])


def compute_starved_s(
    before: ProcessorTime | None, now: ProcessorTime | None, elapsed_s: float
) -> float:
    """Return the time (s) that a process waited for a processor core between two readings.

    The result is at most `elapsed_s`. The kernel adds a wait to its counter only when the wait
    ends. If the process is still waiting, all time in which it had no core counts as a wait.
    """
    if before is None or now is None:
        return 0.0
    waited_s = now.wait_s - before.wait_s
    if now.state == RUNNABLE:
        waited_s = max(waited_s, elapsed_s - (now.run_s - before.run_s))
    return min(max(waited_s, 0.0), elapsed_s)
