"""List the parts of the display that a run can omit.

The module is separate, so that commands can import it fast.
"""

from __future__ import annotations

from enum import StrEnum


class Feature(StrEnum):
    """The parts of the display that a run can omit."""

    IMAGE = "image"
    FORCE = "force"
