"""Set the numbers of examples of property tests, and mark long examples."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest
from hypothesis import settings

USUAL = 50
"""Examples of a property test that does not set a number, in `make test`."""


def examples(count: int) -> settings:
    """Return settings with `count` examples, multiplied by the factor of the active profile.

    The command `make test-long` uses the profile "long" of `tests/conftest.py`.
    """
    return settings(max_examples=count * settings.default.max_examples // USUAL)


def long_except(values: Iterable[Any], *short: Any) -> list[Any]:
    """Return the parameters of a test, and mark all except `short` as long.

    values: parameters, or tuples of parameters.
    """
    rows, kept = (
        [value if isinstance(value, tuple) else (value,) for value in each]
        for each in (values, short)
    )
    return [pytest.param(*row, marks=() if row in kept else pytest.mark.long) for row in rows]
