"""Distinguish a process that hangs from one that gets no processor."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Self

RUNNABLE = "R"


@dataclass(frozen=True, slots=True)
class ProcessorTime:
    """The kernel's counters of a process's main thread, in seconds.

    run_s: time on a processor. wait_s: time runnable without one, up to its last run. state: letter
    of /proc/PID/stat (R, S, D, T, ...).
    """

    run_s: float
    wait_s: float
    state: str

    @classmethod
    def read(cls, process: int) -> Self | None:
        """Read the counters of a process; None without counters or once it has ended."""
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
    """Return how long a process waited for a processor between two readings, s.

    The result is at most `elapsed_s`. The kernel counts a wait only when it ends. A process that is
    runnable now has therefore waited whenever it did not run.
    """
    if before is None or now is None:
        return 0.0
    waited_s = now.wait_s - before.wait_s
    if now.state == RUNNABLE:
        waited_s = max(waited_s, elapsed_s - (now.run_s - before.run_s))
    return min(max(waited_s, 0.0), elapsed_s)
