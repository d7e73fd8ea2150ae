"""Show the page's tab with the images that the simulated eye sees."""

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
    """Tab with the images that the simulated eye sees; each is hidden until it exists."""

    def __init__(self, gui: Any, request: Request) -> None:
        self._enabled = gui.add_checkbox(
            "Render images", False, hint="One image every six seconds; each one loads the graph"
        )
        self._correction = gui.add_dropdown(
            "Correction",
            CORRECTIONS,
            hint="Correction of the sheet's tilt and deflection; the best one is first",
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
        """Show which image correction is active: the scene's or the one that a viewer chose."""
        self._correction.value = correction

    def show_image(self, name: str, image: NDArray[np.uint8]) -> None:
        self._images[name].image = image
        self._images[name].visible = True
