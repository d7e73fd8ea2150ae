"""Run long computations in processes of this computer that end at once after an interruption."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing.synchronize import Event

from flexsheet.nodes.background import enter_background


@contextmanager
def local_processes(count: int) -> Iterator[Executor]:
    """Yield an executor with `count` processes on this computer.

    If the context exits with an exception, the processes stop and do not finish their jobs.
    """
    context = multiprocessing.get_context("spawn")
    stop = context.Event()
    executor = ProcessPoolExecutor(count, context, initializer=_init_worker, initargs=(stop,))
    try:
        yield executor
    except BaseException:
        stop.set()
        raise
    finally:
        executor.shutdown(wait=True, cancel_futures=True)


def _init_worker(stop: Event) -> None:
    # Ctrl-C reaches all processes of a terminal, but the parent process stops its workers itself.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    enter_background()
    threading.Thread(target=_exit_on, args=(stop,), name="stop", daemon=True).start()


def _exit_on(stop: Event) -> None:
    """Exit the worker process as soon as the event `stop` is set.

    This is necessary because a job checks only after each push depth whether it must stop. One push
    depth can take a minute. The parent process stores finished results.
    """
    stop.wait()
    os._exit(0)
