"""Define the parts of a scene that a run can leave out; separate, so that commands start fast."""

from __future__ import annotations

from enum import StrEnum


class Feature(StrEnum):
    """Parts of a scene that can be left out for one run: its image, or the rendered force."""

    IMAGE = "image"
    FORCE = "force"
