"""Determine which process priorities the user is permitted to set."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

from flexsheet.launch.plans.plan_model import ResolvedNode

MIN_NICE = -20


def permitted_nice(step: int) -> int:
    """Return a configured change of niceness, or 0 if the user may not set it."""
    niceness = max(_own_niceness() + step, MIN_NICE)
    permitted = step >= 0 or _is_permitted(os.setpriority, os.PRIO_PROCESS, 0, niceness)
    return step if permitted else 0


def permitted_real_time(configured: int | None) -> int | None:
    """Return the configured real-time priority, or None if the user may not set it.

    Return None also if this process has a positive niceness, because nodes then must not delay
    other programs.
    """
    if configured is None or _own_niceness() > 0:
        return None
    return configured if _may_set_real_time(configured) else None


def describe_priority_problem(nodes: Sequence[ResolvedNode]) -> str | None:
    """Return a text about the nodes whose niceness or real-time priority is not permitted.

    Returns None if there are no such nodes. The niceness of this process is always permitted.
    """
    steps = {node.nice for node in nodes if node.nice < min(_own_niceness(), 0)}
    priorities = {node.realtime_priority for node in nodes} - {None}
    denied_steps = {one for one in steps if permitted_nice(one) != one}
    denied_priorities = {one for one in priorities if one and not _may_set_real_time(one)}
    names = [
        node.name
        for node in nodes
        if node.nice in denied_steps or node.realtime_priority in denied_priorities
    ]
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


def _own_niceness() -> int:
    return os.getpriority(os.PRIO_PROCESS, 0)


def _may_set_real_time(priority: int) -> bool:
    return _is_permitted(os.sched_setscheduler, 0, os.SCHED_RR, os.sched_param(priority))


def _is_permitted(action: Callable[..., object], *arguments: object) -> bool:
    """Return whether this user may change the priority of a thread by a system call.

    The function tries it with a temporary thread, because capabilities, limits and control groups
    together determine the result.
    """
    with ThreadPoolExecutor(1) as pool:
        return not isinstance(pool.submit(action, *arguments).exception(), PermissionError)
