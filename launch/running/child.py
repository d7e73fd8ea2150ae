"""Set up a node's process: it exits with its launcher and has the configured niceness."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import threading
import time
from pathlib import Path

PARENT_VARIABLE = "FLEXSHEET_PARENT"
LIFELINE_VARIABLE = "FLEXSHEET_LIFELINE"
"""File descriptor of a pipe that is never written; it closes when the launcher exits."""

NICE_VARIABLE = "FLEXSHEET_NICE"

AUTOGROUP = Path("/proc/self/autogroup")
"""File with the niceness by which Linux schedules sessions against each other.

Each node is a separate session, so the niceness of its process alone has little effect."""

AUTOGROUP_TRIES, AUTOGROUP_WAIT_S = 20, 0.11
"""Without privileges the kernel accepts one write in 0.1 s, over all processes."""

GRACE_S = 3.0
_PR_SET_PDEATHSIG = 1


def exit_with_parent() -> None:
    """End this process when its launcher exits: SIGTERM first, SIGKILL after `GRACE_S`.

    The kernel's death signal also ends a process whose loop hangs. If the process ignores the
    signal, the lifeline's thread kills it and all processes that it started.
    """
    parent = os.environ.get(PARENT_VARIABLE)
    if parent is None:
        return
    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    if os.getppid() != int(parent):
        sys.exit("the launcher has exited")
    lifeline = int(os.environ[LIFELINE_VARIABLE])
    threading.Thread(
        target=_end_with_lifeline, args=(lifeline,), name="lifeline", daemon=True
    ).start()


def _end_with_lifeline(lifeline: int) -> None:
    os.read(lifeline, 1)
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(GRACE_S)
    os.killpg(os.getpgrp(), signal.SIGKILL)


def apply_niceness() -> None:
    """Add the niceness of this node's configuration to the process and its session.

    A negative niceness takes precedence. Raises OSError if the system does not permit it.
    """
    nice = int(os.environ.get(NICE_VARIABLE, "0"))
    if nice == 0:
        return
    os.nice(nice)
    if not AUTOGROUP.exists():
        return
    for left in reversed(range(AUTOGROUP_TRIES)):
        try:
            AUTOGROUP.write_text(str(nice))
            return
        except BlockingIOError:
            if left == 0:
                raise
            time.sleep(AUTOGROUP_WAIT_S)
