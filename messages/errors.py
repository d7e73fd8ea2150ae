"""Define the base class of errors that are shown to users."""

from __future__ import annotations

from typing import ClassVar


class FlexsheetError(Exception):
    """The base class of errors that a user can correct.

    code: name of the error for the command `flexsheet explain`.
    remedy: text that states what the user can do.
    phrase: text that every error of this class contains; "" if there is none.
    exit_code: exit status of a command that ends with this error.
    """

    code: ClassVar[str]
    remedy: ClassVar[str]
    phrase: ClassVar[str] = ""
    exit_code: int = 1

    def __str__(self) -> str:
        """Return the error text.

        Without this method, an error that is also a KeyError would return the text in quotes.
        """
        return Exception.__str__(self)
