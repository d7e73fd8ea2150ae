"""Test the priority of worker processes."""

from __future__ import annotations

import os
import signal
from concurrent.futures import Executor, ProcessPoolExecutor
from multiprocessing import get_context

from flexsheet.nodes.background import MAX_NICE, enter_background
from flexsheet.nodes.fem_solver.precompute_table import local_processes


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
