"""Decide whether a computer is overloaded, and describe the overload."""

from __future__ import annotations

from flexsheet.messages.types import HostStatus

MAX_LOAD_RATIO = 1.5
"""The maximum load average per core of a computer that is not overloaded."""

BUSY_REMEDY = (
    "end other programs, give the graph more cores, or start fewer nodes; until then, the arms may "
    "pause"
)


def is_busy(host: HostStatus) -> bool:
    """Return whether more processes of a computer want to run than it has cores."""
    return host.load_ratio > MAX_LOAD_RATIO


def describe_busy(host: HostStatus) -> str:
    """Return a sentence that states why a computer is busy, or "" if it is not busy."""
    if not is_busy(host):
        return ""
    load = f"{host.load_ratio:.1f} runnable processes per core"
    return f"the computer {host.host} is busy: {load}"
