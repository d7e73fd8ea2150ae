"""Handle in the event loop those signals that end a process."""

from __future__ import annotations

import asyncio
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def handle_signals(
    handler: Callable[[], object], *numbers: int, ignore_afterwards: bool = False
) -> Iterator[None]:
    """Call `handler` in the running event loop for each of these signals, until the context ends.

    ignore_afterwards: whether to ignore the signals afterwards instead of restoring their actions,
        for a process that ends after its clean-up.

    When the event loop removes its handler of SIGINT, it installs Python's default, which raises an
    exception. The signals are therefore blocked until the former actions are restored.
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
    """Make SIGINT raise KeyboardInterrupt until the context ends."""
    former = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, former)
