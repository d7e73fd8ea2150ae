"""Lower the priority of processes that compute results for later use."""

from __future__ import annotations

import os

MAX_NICE = 19


def enter_background() -> None:
    """Give this process the lowest priority: the highest niceness, and batch scheduling.

    A process with batch scheduling never interrupts a running process when it wakes up.
    """
    os.setpriority(os.PRIO_PROCESS, 0, MAX_NICE)
    os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))
