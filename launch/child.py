"""What a node's process does so as not to outlive its launcher."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import threading
import time

PARENT_VARIABLE = "FLEXSHEET_PARENT"
LIFELINE_VARIABLE = "FLEXSHEET_LIFELINE"
"""File descriptor of a pipe that nobody writes to: it reads as closed when the launcher is gone."""

GRACE_S = 3.0
_PR_SET_PDEATHSIG = 1


def follow_launcher() -> None:
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
