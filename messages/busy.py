"""Says whether a computer is too busy for its nodes, and by what, from its launcher's message."""

from __future__ import annotations

from flexsheet.messages.types import CpuPressure, HostStatus

MAX_LOAD_RATIO = 1.5
"""Processes that want to run per core; for computers that cannot measure their nodes' waiting."""

BUSY_REMEDY = (
    "end other programs, give the graph more cores, or start less of it; "
    "as root the simulated arms take precedence (docs/launch-files.md, nice)"
)


def is_busy(host: HostStatus) -> bool:
    """Return whether a computer has too few free processors for the nodes that run on it."""
    return host.load_ratio > MAX_LOAD_RATIO if host.cpu is None else host.cpu.busy


def describe_busy(host: HostStatus) -> str:
    """Say in one sentence what makes a computer busy; empty where it is not."""
    if not is_busy(host):
        return ""
    if host.cpu is None:
        why = f"{host.load_ratio:.1f} processes per core want to run"
    else:
        why = describe_pressure(host.cpu)
    return f"the computer {host.host} is busy: {why}"


def describe_pressure(cpu: CpuPressure) -> str:
    """Say who waits for a processor for how long, and who takes the processors."""
    waits = f"{cpu.node} waits for a processor {cpu.wait_ratio:.0%} of the time"
    if not cpu.programs:
        return waits
    programs = ", ".join(f"{one.name} {one.cores:.1f}" for one in cpu.programs)
    return f"{waits}; cores in use: {programs}"
