"""What a figure was measured on, so that it can be told from another machine's."""

from __future__ import annotations

import os
import platform
from pathlib import Path

CPU_INFO = Path("/proc/cpuinfo")

QUIET_SHARE = 0.5
"""Of the cores; where others want more of them, times are theirs as much as ours."""


def machine_name() -> str:
    """Processor, cores and Python, in a line."""
    name = platform.processor() or platform.machine()
    if CPU_INFO.exists():
        lines = [line for line in CPU_INFO.read_text().splitlines() if "model name" in line]
        name = lines[0].partition(":")[2].strip() if lines else name
    return f"{os.cpu_count()} cores {name}, Python {platform.python_version()}"


def busy_words() -> str | None:
    """A warning where others keep the machine busy; None: it is quiet."""
    load, cores = os.getloadavg()[0], os.cpu_count() or 1
    if load <= QUIET_SHARE * cores:
        return None
    return (
        f"this machine is busy (load {load:.1f} on {cores} cores): times are too long, and which "
        "method is cheaper may be wrong; measure on a quiet one"
    )
