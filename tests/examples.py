"""Number of examples of a property test, and long examples of a parametrized test."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest
from hypothesis import settings

USUAL = 50
"""Examples of a property test that does not set a number, in `make test`."""


def examples(count: int) -> settings:
    """Draw `count` examples in `make test`, and as many times more as the profile draws.

    `make test-long` uses the profile "long" of `tests/conftest.py`.
    """
    return settings(max_examples=count * settings.default.max_examples // USUAL)


def long_except(values: Iterable[Any], *short: Any) -> list[Any]:
    """List parameters of a test, and mark all as long except `short`.

    values: parameters, or tuples of parameters.
    """
    rows, kept = (
        [value if isinstance(value, tuple) else (value,) for value in each]
        for each in (values, short)
    )
    return [pytest.param(*row, marks=() if row in kept else pytest.mark.long) for row in rows]
