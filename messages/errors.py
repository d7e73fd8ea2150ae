"""Define the base class of errors that are shown to users."""

from __future__ import annotations

from typing import ClassVar


class FlexsheetError(Exception):
    """The base class of errors that a user can correct.

    remedy: sentence that states what the user can do; "" if the text of each error states it.
    exit_code: exit status of a command that ends with this error.
    """

    remedy: ClassVar[str] = ""
    exit_code: int = 1

    def __str__(self) -> str:
        """Return the error text.

        Without this method, an error that is also a KeyError would return the text in quotes.
        """
        return Exception.__str__(self)


def describe_error(error: Exception) -> str:
    """Return the text of an error and the remedy of its class, separated by a full stop."""
    text, remedy = str(error), getattr(error, "remedy", "")
    return f"{text.removesuffix('.')}. {remedy}" if remedy else text
