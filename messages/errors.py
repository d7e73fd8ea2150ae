"""Base class of the errors that users meet."""

from __future__ import annotations

from typing import ClassVar


class FlexsheetError(Exception):
    """Base of all errors that a user can put right.

    Each subclass sets its own `code`, which `flexsheet explain` accepts, and its `remedy`.
    exit_code: status with which a command ends that such an error stops.
    """

    code: ClassVar[str]
    remedy: ClassVar[str]
    exit_code: int = 1

    def __str__(self) -> str:
        """Return the text; a KeyError would return its representation."""
        return Exception.__str__(self)
