"""Test the format of fractions."""

from __future__ import annotations

import pytest

from flexsheet.messages.units import format_percent


@pytest.mark.parametrize(
    ("ratio", "text"),
    [
        (0.0, "0.0 %"),
        (1.0, "100.0 %"),
        (0.5, "50.0 %"),
        (0.999, "99.9 %"),
        (0.9997, "99.97 %"),
        (0.99996, "99.996 %"),
        (0.0003, "0.03 %"),
        (1.0 - 1e-9, "more than 99.9999 %"),
        (1e-9, "less than 0.0001 %"),
    ],
)
def test_only_all_and_nothing_are_shown_as_all_and_nothing(ratio: float, text: str) -> None:
    assert format_percent(ratio) == text


def test_the_minimum_number_of_digits_can_be_chosen() -> None:
    assert format_percent(0.25, 0) == "25 %"
    assert format_percent(0.996, 0) == "99.6 %"
