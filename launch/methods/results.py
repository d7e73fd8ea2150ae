"""Describe the computer on which a measurement ran, and convert results to valid JSON."""

from __future__ import annotations

import math
import os
import platform
from pathlib import Path
from typing import Any

CPU_INFO = Path("/proc/cpuinfo")

MAX_LOAD_PER_CORE = 0.5
"""The maximum load average per core at which timings are reliable."""


def replace_non_finite(value: Any) -> Any:
    """Replace NaN and infinity by None in nested values, because JSON does not support them."""
    if isinstance(value, dict):
        return {key: replace_non_finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [replace_non_finite(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def machine_name() -> str:
    """Return one line with the processor's name, the number of cores and the Python version."""
    name = platform.processor() or platform.machine()
    if CPU_INFO.exists():
        lines = [line for line in CPU_INFO.read_text().splitlines() if "model name" in line]
        name = lines[0].partition(":")[2].strip() if lines else name
    return f"{os.cpu_count()} cores {name}, Python {platform.python_version()}"


def describe_load() -> str | None:
    """Return a warning if other processes make timings unreliable; otherwise return None."""
    load, cores = os.getloadavg()[0], os.cpu_count() or 1
    if load <= MAX_LOAD_PER_CORE * cores:
        return None
    return (
        f"other processes load this computer ({load:.1f} on {cores} cores), so times are too long "
        "and may rank methods wrongly; repeat the measurement on an idle computer"
    )
