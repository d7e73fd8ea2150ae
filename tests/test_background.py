"""Test the priority of worker processes."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor
from multiprocessing import get_context
from threading import Event, Thread

import psutil
import pytest

from flexsheet.launch.running import priority
from flexsheet.nodes import background
from flexsheet.nodes.background import (
    AUTOGROUP,
    MAX_NICE,
    enter_background,
    enter_real_time,
    leave_real_time,
)
from flexsheet.nodes.worker_processes import local_processes


def priority_in(workers: Executor) -> tuple[int, int]:
    """Return niceness and scheduling class of a worker process, in a program that does not import
    this file.
    """
    niceness = workers.submit(os.getpriority, os.PRIO_PROCESS, 0)
    scheduling = workers.submit(os.sched_getscheduler, 0)
    return niceness.result(), scheduling.result()


def test_a_background_process_has_the_lowest_priority() -> None:
    with ProcessPoolExecutor(1, get_context("spawn"), initializer=enter_background) as workers:
        assert priority_in(workers) == (MAX_NICE, os.SCHED_BATCH)


def test_ctrl_c_does_not_interrupt_the_workers_of_a_soft_bodys_table() -> None:
    """The terminal sends SIGINT to all processes. Only the node stops the workers."""
    with local_processes(1) as workers:
        worker = workers.submit(os.getpid).result()
        job = workers.submit(sum, range(20_000_000))
        os.kill(worker, signal.SIGINT)
        assert job.result() == sum(range(20_000_000))


def test_workers_of_a_soft_bodys_table_are_background_processes() -> None:
    with local_processes(1) as workers:
        assert priority_in(workers) == (MAX_NICE, os.SCHED_BATCH)


def session_niceness() -> tuple[bool, str]:
    """Return whether this process has its own session, and the niceness of the session."""
    return os.getsid(0) == os.getpid(), AUTOGROUP.read_text().split()[-1]


@pytest.mark.skipif(not AUTOGROUP.exists(), reason="the kernel does not weight sessions")
def test_a_worker_takes_no_processor_time_from_the_session_of_its_node() -> None:
    with local_processes(1) as workers:
        assert workers.submit(session_niceness).result() == (True, str(MAX_NICE))


class RefusingAutogroup:
    """A file of the kernel that refuses each write."""

    def __init__(self, error: OSError) -> None:
        self.error = error

    def exists(self) -> bool:
        return True

    def write_text(self, _: str) -> int:
        raise self.error


def enter_background_beside(error: OSError) -> tuple[int, int]:
    """Enter the background while the kernel refuses the niceness of the session."""
    # The type is ignored, because a Path that refuses writes even of root does not exist.
    background.AUTOGROUP = RefusingAutogroup(error)  # type: ignore[assignment]
    background.AUTOGROUP_WAIT_S = 0.0
    enter_background()
    return os.getpriority(os.PRIO_PROCESS, 0), os.sched_getscheduler(0)


@pytest.mark.parametrize("error", [BlockingIOError(), PermissionError()], ids=["busy", "refused"])
def test_a_worker_runs_if_the_niceness_of_its_session_cannot_be_set(error: OSError) -> None:
    with ProcessPoolExecutor(1, get_context("fork")) as process:
        found = process.submit(enter_background_beside, error).result()
    assert found == (MAX_NICE, os.SCHED_BATCH)


def test_another_error_of_the_kernel_is_reported() -> None:
    with ProcessPoolExecutor(1, get_context("fork")) as process:
        broken = process.submit(enter_background_beside, OSError("input/output error"))
        with pytest.raises(OSError, match="input/output"):
            broken.result()


STARTS_WORKER = """
import os, sys
from flexsheet.nodes.worker_processes import local_processes
with local_processes(1) as workers:
    print(workers.submit(os.getpid).result(), flush=True)
    sys.stdin.read()
"""


def test_a_worker_ends_when_its_node_is_killed() -> None:
    with subprocess.Popen(
        [sys.executable, "-c", STARTS_WORKER],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
    ) as node:
        assert node.stdout is not None
        worker = psutil.Process(int(node.stdout.readline()))
        node.kill()
    worker.wait(timeout=30)


def policies_in_real_time() -> tuple[set[int], int, int]:
    """Enter real time, and return the policies of threads.

    The policies are those of all threads that existed before, and those of worker threads without
    and with `leave_real_time`.
    """
    ended = Event()
    Thread(target=ended.wait).start()
    enter_real_time(1)
    before = {os.sched_getscheduler(int(one)) for one in os.listdir("/proc/self/task")}
    with ThreadPoolExecutor(1) as plain, ThreadPoolExecutor(1, "", leave_real_time) as normal:
        inherited = plain.submit(os.sched_getscheduler, 0).result()
        left = normal.submit(os.sched_getscheduler, 0).result()
    ended.set()
    return before, inherited, left


@pytest.mark.skipif(not priority._may_set_real_time(1), reason="real time is not permitted")
def test_real_time_applies_to_all_threads_except_workers_that_leave_it() -> None:
    # Forked, so that the tests themselves keep their policy.
    with ProcessPoolExecutor(1, get_context("fork")) as process:
        before, inherited, left = process.submit(policies_in_real_time).result()
    assert before == {os.SCHED_RR}
    assert (inherited, left) == (os.SCHED_RR, os.SCHED_OTHER)
