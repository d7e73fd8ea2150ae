"""Run long computations in a thread and abandon them when their result is no longer needed."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable
from functools import partial
from typing import TypeVar

from flexsheet.nodes.fem_solver.precompute import Interrupted

T = TypeVar("T")

POLL_S = 0.05


async def run_unless_superseded(
    compute: Callable[[Callable[..., None]], T],
    progress: Callable[..., None],
    is_superseded: Callable[[], bool],
) -> T:
    """Run `compute` in a thread and return its result.

    compute: receives `progress` with a stop event as its first argument. Raises Interrupted once
    `is_superseded` returns true. The thread is then abandoned, because meshing takes up to 8 s, and
    its errors are ignored.
    """
    stop = threading.Event()
    task = asyncio.create_task(asyncio.to_thread(compute, partial(progress, stop)))
    try:
        while not task.done():
            await asyncio.wait({task}, timeout=POLL_S)
            if not task.done() and is_superseded():
                raise Interrupted
        return task.result()
    finally:
        stop.set()
        task.add_done_callback(lambda ended: ended.cancelled() or ended.exception())
