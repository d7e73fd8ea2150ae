"""Set up the process of a node: it ends with its launcher and has the configured niceness."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import threading
import time

from flexsheet.nodes.background import set_session_niceness

PARENT_VARIABLE = "FLEXSHEET_PARENT"
LIFELINE_VARIABLE = "FLEXSHEET_LIFELINE"
"""The environment variable that contains the file descriptor of the lifeline.

The lifeline is a pipe to which nothing is written. A read from the pipe returns when the launcher
exits.
"""

NICE_VARIABLE = "FLEXSHEET_NICE"

GRACE_S = 3.0
_PR_SET_PDEATHSIG = 1


def exit_with_parent() -> None:
    """Make this process end when its launcher exits.

    The kernel then sends SIGTERM, even if the event loop of the process hangs. A thread also waits
    for the end of a pipe (lifeline) that the launcher holds open. If the process has not ended
    `GRACE_S` after the pipe has closed, the thread kills the process and its children.
    """
    parent = os.environ.get(PARENT_VARIABLE)
    if parent is None:
        return
    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    if os.getppid() != int(parent):
        sys.exit("this node ends, because its launcher has exited; start the graph again")
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
    """Set the niceness of this process and its session from the node's configuration.

    The configured value is added to the niceness of the launcher; a negative value gives higher
    priority. Raises OSError if the system does not permit this niceness.
    """
    nice = int(os.environ.get(NICE_VARIABLE, "0"))
    total = os.nice(nice)
    # A user may lack the permission to give a negative niceness of the launcher to a session.
    session_nice = total if total > 0 or nice < 0 else nice
    if session_nice:
        set_session_niceness(session_nice)
