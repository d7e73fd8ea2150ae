"""What a figure was measured on, so that it can be told from another machine's."""

from __future__ import annotations

import os
import platform
from pathlib import Path

CPU_INFO = Path("/proc/cpuinfo")


def machine_name() -> str:
    """Processor, cores and Python, in a line."""
    name = platform.processor() or platform.machine()
    if CPU_INFO.exists():
        lines = [line for line in CPU_INFO.read_text().splitlines() if "model name" in line]
        name = lines[0].partition(":")[2].strip() if lines else name
    return f"{os.cpu_count()} cores {name}, Python {platform.python_version()}"
