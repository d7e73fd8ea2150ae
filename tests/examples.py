"""Number of examples of a property test whose examples are expensive."""

from __future__ import annotations

from hypothesis import settings

USUAL = 50
"""Examples of a property test that does not set a number, in `make test`."""


def examples(count: int) -> settings:
    """Draw `count` examples in `make test`, and as many times more as the profile draws.

    `make test-long` uses the profile "long" of `tests/conftest.py`.
    """
    return settings(max_examples=count * settings.default.max_examples // USUAL)
