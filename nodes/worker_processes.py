"""Run long computations in processes of this computer that end at once after an interruption."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing.synchronize import Event

from flexsheet.nodes.background import enter_background


@contextmanager
def local_processes(count: int) -> Iterator[Executor]:
    """Yield an executor with `count` processes on this computer.

    If the context exits with an exception, or if this process ends, the processes stop and do not
    finish their jobs.
    """
    context = multiprocessing.get_context("spawn")
    stop = context.Event()
    executor = ProcessPoolExecutor(count, context, initializer=_init_worker, initargs=(stop,))
    # Each process computes with one thread, because more would compete with the other processes.
    os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1")
    try:
        yield executor
    except BaseException:
        stop.set()
        raise
    finally:
        executor.shutdown(wait=True, cancel_futures=True)


def _init_worker(stop: Event) -> None:
    # Until the process has its own session, Ctrl-C reaches it, but its parent stops it itself.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    assert parent is not None
    for name, wait in (("stop", stop.wait), ("parent", parent.join)):
        threading.Thread(target=_exit_after, args=(wait,), name=name, daemon=True).start()
    enter_background()


def _exit_after(wait: Callable[[], object]) -> None:
    """Exit the worker process as soon as the function `wait` returns.

    This is necessary because a job checks only after each push depth whether it must stop. One push
    depth can take a minute. The parent process stores finished results.
    """
    wait()
    os._exit(0)
