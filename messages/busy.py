"""Decide whether a computer has too few free processors for its nodes, and describe the cause."""

from __future__ import annotations

from flexsheet.messages.types import CpuPressure, HostStatus

MAX_LOAD_RATIO = 1.5
"""The maximum load average per core.

This limit is used on computers that cannot measure how long processes wait for a processor.
"""

BUSY_REMEDY = (
    "end other programs, give the graph more cores, or start fewer nodes; until then, the arms may "
    "pause"
)


def is_busy(host: HostStatus) -> bool:
    """Return whether a computer has too few free processors for the nodes that run on it."""
    return host.load_ratio > MAX_LOAD_RATIO if host.cpu is None else host.cpu.busy


def describe_busy_remedy(*, nice_denied: bool) -> str:
    """Return the advice for the user of a busy computer.

    nice_denied: whether the nodes lack the process priority that the launch file requires.
    """
    if not nice_denied:
        return BUSY_REMEDY
    return (
        f"{BUSY_REMEDY}; with the capability CAP_SYS_NICE, the launcher can give the simulated "
        "arms priority"
    )


def describe_busy(host: HostStatus) -> str:
    """Return a sentence that states why a computer is busy, or "" if it is not busy."""
    if not is_busy(host):
        return ""
    if host.cpu is None:
        why = f"{host.load_ratio:.1f} runnable processes per core"
    else:
        why = describe_pressure(host.cpu)
    return f"the computer {host.host} is busy: {why}"


def describe_pressure(cpu: CpuPressure) -> str:
    """Describe which node waits longest for a processor, and which programs use the cores."""
    waits = f"{cpu.node} waits for a processor {cpu.wait_ratio:.0%} of the time"
    if not cpu.programs:
        return waits
    programs = ", ".join(f"{one.name} {one.cores:.1f}" for one in cpu.programs)
    return f"{waits}; cores in use: {programs}"
