"""Determine which process priorities the user is permitted to set."""

from __future__ import annotations

import os
import resource
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from flexsheet.launch.plans.plan_model import ResolvedNode

MIN_NICE = -20
CAP_SYS_NICE = 23
"""The bit index of the Linux capability that permits any niceness."""


def min_nice_step() -> int:
    """Return the most negative change of niceness that is permitted for a child process."""
    own = os.getpriority(os.PRIO_PROCESS, 0)
    # The limit RLIMIT_NICE is 20 minus the minimum niceness: 25 permits a niceness of -5.
    soft_limit, _ = resource.getrlimit(resource.RLIMIT_NICE)
    allowed = MIN_NICE if _has_cap_sys_nice() else 20 - soft_limit
    return min(0, max(MIN_NICE, allowed) - own)


def _has_cap_sys_nice() -> bool:
    lines = Path("/proc/self/status").read_text().splitlines()
    effective = next(line.split()[1] for line in lines if line.startswith("CapEff:"))
    return bool(int(effective, 16) >> CAP_SYS_NICE & 1)


def min_node_nice() -> int:
    """Return the minimum niceness that a launch file may set for a node on this computer.

    The minimum depends on the permissions of the user. Values down to the niceness of this process
    are always permitted.
    """
    return min(min_nice_step(), os.getpriority(os.PRIO_PROCESS, 0))


def find_real_time_priority(configured: int | None) -> int | None:
    """Return the configured real-time priority, or None if the user may not set it.

    Return None also if this process has a positive niceness, because nodes then must not delay
    other programs.
    """
    if configured is None or os.getpriority(os.PRIO_PROCESS, 0) > 0:
        return None
    return configured if _may_set_real_time(configured) else None


def _may_set_real_time(priority: int) -> bool:
    """Return whether a thread of this user may have a real-time priority.

    The function tries it with a temporary thread, because capabilities, limits and control groups
    together determine the result.
    """
    with ThreadPoolExecutor(1) as pool:
        attempt = pool.submit(os.sched_setscheduler, 0, os.SCHED_RR, os.sched_param(priority))
        return not isinstance(attempt.exception(), PermissionError)


def list_denied(nodes: Sequence[ResolvedNode]) -> list[str]:
    """Return the names of the nodes whose niceness or real-time priority is not permitted."""
    minimum = min_node_nice()
    priorities = {node.realtime_priority for node in nodes}
    denied = {one for one in priorities if one and not _may_set_real_time(one)}
    return [node.name for node in nodes if node.nice < minimum or node.realtime_priority in denied]


def describe_priority_problem(nodes: Sequence[ResolvedNode]) -> str | None:
    """Return a text about the nodes whose niceness or real-time priority is not permitted.

    Returns None if there are no such nodes.
    """
    names = list_denied(nodes)
    if not names:
        return None
    # Root lacks the capability in most containers.
    remedy = (
        "give the container the capability CAP_SYS_NICE"
        if os.geteuid() == 0
        else "start as root or set `nice` and `rtprio` in /etc/security/limits.conf"
    )
    return (
        f"{', '.join(names)}: this user may not set the `nice` or `realtime_priority` of these "
        f"nodes, so they answer later on a busy computer; {remedy}"
    )
