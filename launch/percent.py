"""Format fractions as percentages."""

from __future__ import annotations

MAX_DIGITS = 4
"""The maximum number of digits after the decimal point."""


def format_percent(ratio: float, digits: int = 1) -> str:
    """Return a fraction from 0 to 1 as a percentage that is 0 or 100 only if the fraction is.

    A fraction that would be rounded to 0 or 1 gets more digits, such as "99.97 %".

    digits: minimum number of digits after the decimal point.
    """
    exact = ratio in (0.0, 1.0)
    for count in range(digits, MAX_DIGITS + 1):
        text = f"{100.0 * ratio:.{count}f}"
        if exact or float(text) not in (0.0, 100.0):
            return f"{text} %"
    return "less than 0.0001 %" if ratio < 0.5 else "more than 99.9999 %"
