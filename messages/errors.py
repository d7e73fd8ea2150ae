"""Define the base class of errors that are shown to users."""

from __future__ import annotations

from typing import ClassVar


class FlexsheetError(Exception):
    """Base class of errors that a user can correct.

    code: name of the error for `flexsheet explain`.  remedy: action for the user.
    exit_code: exit status of a command that ends with this error.
    """

    code: ClassVar[str]
    remedy: ClassVar[str]
    exit_code: int = 1

    def __str__(self) -> str:
        """Return the text; a KeyError would return its representation."""
        return Exception.__str__(self)
