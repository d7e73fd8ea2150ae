"""What a node's process does first: it ends with its launcher, and gives way as it is told."""

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
"""File descriptor of a pipe that nobody writes to: it reads as closed when the launcher is gone."""

NICE_VARIABLE = "FLEXSHEET_NICE"

AUTOGROUP = Path("/proc/self/autogroup")
"""Where Linux weighs sessions against one another, a process's own niceness counts for little: each
node is a session of its own, and the session has to be told."""

AUTOGROUP_TRIES, AUTOGROUP_WAIT_S = 20, 0.11
"""Without privileges the kernel lets one be told in a tenth of a second, of all that ask."""

GRACE_S = 3.0
_PR_SET_PDEATHSIG = 1


def exit_with_parent() -> None:
    """End with the launcher, however it ends: asked to first, killed after `GRACE_S`.

    The kernel's death signal reaches a process that hangs in its loop; the lifeline's thread also
    kills one that does not listen, with all that it started.
    """
    parent = os.environ.get(PARENT_VARIABLE)
    if parent is None:
        return
    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    if os.getppid() != int(parent):
        sys.exit("the launcher is gone")
    lifeline = int(os.environ[LIFELINE_VARIABLE])
    threading.Thread(target=_end_with, args=(lifeline,), name="lifeline", daemon=True).start()


def _end_with(lifeline: int) -> None:
    os.read(lifeline, 1)
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(GRACE_S)
    os.killpg(os.getpgrp(), signal.SIGKILL)


def apply_niceness() -> None:
    """Be nicer than the launcher by what the launcher allows this node, and so its session.

    Less than 0 takes precedence.  OSError where the system does not let it.
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
