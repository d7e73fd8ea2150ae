"""Define the parts of the display (image, force) that a run can omit.

The module imports no other modules of the package, so commands that need only this list start fast.
"""

from __future__ import annotations

from enum import StrEnum


class Feature(StrEnum):
    """The parts of the display that a run can omit: the projected image and the rendered force."""

    IMAGE = "image"
    FORCE = "force"
