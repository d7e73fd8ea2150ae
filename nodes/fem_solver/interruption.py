"""Long computations in a thread, given up as soon as their result is not wanted any more."""

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
    """Run `compute` in a thread and return its result; Interrupted once it is superseded.

    The thread is not waited for then: meshing alone takes up to 8 s of a processor.  It is given
    `progress` with an event before all other arguments, by which it is asked to stop; what it
    raises is dropped.
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
