"""Handle signals that end a process. The handlers run in the event loop."""

from __future__ import annotations

import asyncio
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def handle_signals(
    handler: Callable[[], object], *numbers: int, ignore_afterwards: bool = False
) -> Iterator[None]:
    """Call `handler` in the running event loop for each of the given signals.

    ignore_afterwards: whether the signals are ignored after the context exits. Otherwise the
        previous signal handlers are restored. True is intended for a process that ends after its
        clean-up.

    The handler is active until the context exits. The signals are blocked during the change back,
    because asyncio temporarily installs a handler that raises KeyboardInterrupt.
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
    """Make the signal SIGINT raise KeyboardInterrupt until the context exits."""
    former = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, former)
