"""Define the parts of the display that a run can omit, in a module that commands import fast."""

from __future__ import annotations

from enum import StrEnum


class Feature(StrEnum):
    """A part of the display that can be omitted in a run: the projected image or rendered force."""

    IMAGE = "image"
    FORCE = "force"
