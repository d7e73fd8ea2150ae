"""Wait for conditions that other tasks, threads or processes fulfil."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable

import pytest

DEADLINE_S = 120.0
"""Timeout that only a failing test reaches, even on a busy machine."""

NOTHING_COMES_S = 0.3
"""Time to wait before concluding that an event does not occur."""

Condition = Callable[[], object]


async def until(
    condition: Condition, what: object = "the condition", *, period_s: float = 0.005
) -> None:
    """Wait until the condition holds; fail the test after DEADLINE_S."""
    try:
        async with asyncio.timeout(DEADLINE_S):
            while not condition():  # noqa: ASYNC110  # other processes set no event
                await asyncio.sleep(period_s)
    except TimeoutError:
        pytest.fail(f"not within {DEADLINE_S:g} s: {what}")


def wait_until(condition: Condition, what: object = "the condition") -> None:
    """Wait without an event loop until the condition holds; fail the test after DEADLINE_S."""
    end_s = time.monotonic() + DEADLINE_S
    while not condition():
        if time.monotonic() > end_s:
            pytest.fail(f"not within {DEADLINE_S:g} s: {what}")
        time.sleep(0.01)
