"""Set the priority of processes and threads: background computation, or real time."""

from __future__ import annotations

import os
import time
from contextlib import suppress
from pathlib import Path

MAX_NICE = 19
AUTOGROUP = Path("/proc/self/autogroup")
"""The file that contains the niceness of this process's session.

Linux distributes processor time among sessions, and each node has its own session. The niceness of
a node's process alone therefore has little effect.
"""

AUTOGROUP_TRIES, AUTOGROUP_WAIT_S = 20, 0.11
"""The number of attempts to write AUTOGROUP, and the time (s) between two attempts.

The kernel accepts only one write per 0.1 s from all unprivileged processes together.
"""

THREADS = "/proc/self/task"
"""The folder with the thread IDs of this process."""


def set_session_niceness(niceness: int) -> None:
    """Set the niceness of this process's session, if the kernel weights sessions.

    Raises OSError if the system does not permit this niceness.
    """
    if not AUTOGROUP.exists():
        return
    for left in reversed(range(AUTOGROUP_TRIES)):
        try:
            AUTOGROUP.write_text(str(niceness))
            return
        except BlockingIOError:
            if left == 0:
                raise
            # No event announces when the kernel accepts the next write.
            time.sleep(AUTOGROUP_WAIT_S)


def enter_background() -> None:
    """Give this process the lowest priority: the highest niceness, and batch scheduling.

    The process gets its own session, because Linux first divides processor time among sessions
    (if autogroups are enabled). If the kernel does not accept the niceness of the session, the
    process has its own niceness only. A process with batch scheduling never interrupts a running
    process when it wakes up.
    """
    os.setpriority(os.PRIO_PROCESS, 0, MAX_NICE)
    os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))
    os.setsid()
    # If many processes start at once, the kernel refuses some writes; some containers refuse all.
    # The work itself can continue.
    with suppress(BlockingIOError, PermissionError):
        set_session_niceness(MAX_NICE)


def enter_real_time(priority: int) -> None:
    """Give all threads of this process a real-time priority (policy SCHED_RR).

    Threads and processes that are started later inherit it, so worker threads should call
    `leave_real_time`. Raises PermissionError if the user may not set this priority.
    """
    for thread in os.listdir(THREADS):
        # A thread may have ended since the folder was read.
        with suppress(ProcessLookupError):
            os.sched_setscheduler(int(thread), os.SCHED_RR, os.sched_param(priority))


def leave_real_time() -> None:
    """Give the calling thread the normal scheduling policy if it has real-time priority."""
    if os.sched_getscheduler(0) == os.SCHED_RR:
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
