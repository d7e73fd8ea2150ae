"""Parts of the display that a run can omit; a module of its own, so that commands start fast."""

from __future__ import annotations

from enum import StrEnum


class Feature(StrEnum):
    """A part of the display that can be omitted in a run: the projected image or rendered force."""

    IMAGE = "image"
    FORCE = "force"
