"""Show the page's tab with the images of the simulated eye."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from flexsheet.messages.types import Correction
from flexsheet.nodes.console.controls import Html, Request, on_value

CORRECTIONS = ("two_pass", "four_triangles", "one_plane", "none")
IMAGES = (
    ("seen", "Seen by the eye"),
    ("expected", "Expected by the eye"),
    ("frame", "Projector image"),
)


class EyeTab:
    """The tab with the images of the simulated eye, which are hidden until an image exists."""

    def __init__(self, gui: Any, request: Request) -> None:
        self._enabled = gui.add_checkbox(
            "Render images",
            False,
            hint="Render an image every six seconds, which loads the computer",
        )
        self._correction = gui.add_dropdown(
            "Correction",
            CORRECTIONS,
            hint="Correction for the sheet's tilt and deflection. The first method is the best",
        )
        on_value(self._enabled, lambda on: request("eye_view", on))
        on_value(self._correction, lambda name: request("correct", name))
        self.text = Html(gui)
        blank = np.full((3, 4, 3), 235, dtype=np.uint8)
        self._images = {
            name: gui.add_image(blank, label=label, jpeg_quality=85, visible=False)
            for name, label in IMAGES
        }

    def show_correction(self, correction: Correction) -> None:
        """Show the image correction that is active."""
        self._correction.value = correction

    def show_image(self, name: str, image: NDArray[np.uint8]) -> None:
        self._images[name].image = image
        self._images[name].visible = True
