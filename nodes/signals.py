"""Signals that end a process, handled by its event loop."""

from __future__ import annotations

import asyncio
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def handle_signals(
    handler: Callable[[], object], *numbers: int, ignore_afterwards: bool = False
) -> Iterator[None]:
    """Call `handler` in the running loop at each of these signals; then restore their actions.

    ignore_afterwards: ignore them instead, for a process that ends next and has to tidy up.

    A loop that removes its handler of SIGINT installs Python's own, which raises an exception in
    whatever runs.  So the signals are blocked until the former actions are back.
    """
    loop = asyncio.get_running_loop()
    former = {number: signal.getsignal(number) for number in numbers}
    for number in numbers:
        loop.add_signal_handler(number, handler)
    try:
        yield
    finally:
        blocked = signal.pthread_sigmask(signal.SIG_BLOCK, numbers)
        for number, action in former.items():
            loop.remove_signal_handler(number)
            signal.signal(number, signal.SIG_IGN if ignore_afterwards else action)
        signal.pthread_sigmask(signal.SIG_SETMASK, blocked)


@contextmanager
def keyboard_interrupts() -> Iterator[None]:
    """Let SIGINT raise KeyboardInterrupt meanwhile, for what has to be cleaned up after it."""
    former = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, former)
