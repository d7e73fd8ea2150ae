"""Whether a process that gives no sign of life hangs, or gets no processor."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Self

RUNNABLE = "R"


@dataclass(frozen=True, slots=True)
class ProcessorTime:
    """What the kernel counts of a process's main thread, in seconds.

    run_s: on a processor.  wait_s: runnable without one, as far as it has run since.  state: as in
    /proc/PID/stat (R, S, D, T, ...).
    """

    run_s: float
    wait_s: float
    state: str

    @classmethod
    def of(cls, process: int) -> Self | None:
        """Of a process as it is now; None where the kernel does not count, or it has ended."""
        try:
            run, wait, slices = Path(f"/proc/{process}/schedstat").read_text().split()
            stat = Path(f"/proc/{process}/stat").read_text()
        except (OSError, ValueError):
            return None
        # A kernel without these statistics shows zeros.
        if slices == "0":
            return None
        return cls(int(run) * 1e-9, int(wait) * 1e-9, stat[stat.rindex(")") + 2])


def starved_s(before: ProcessorTime | None, now: ProcessorTime | None, elapsed_s: float) -> float:
    """How long of `elapsed_s` between two readings a process waited for a processor.

    A wait that lasts is counted by the kernel when it is over; one that is runnable meanwhile has
    waited whenever it did not run.
    """
    if before is None or now is None:
        return 0.0
    waited_s = now.wait_s - before.wait_s
    if now.state == RUNNABLE:
        waited_s = max(waited_s, elapsed_s - (now.run_s - before.run_s))
    return min(max(waited_s, 0.0), elapsed_s)
