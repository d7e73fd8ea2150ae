"""The tab that looks through the user's eye."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from flexsheet.messages.types import Correction
from flexsheet.nodes.console.controls import Ask, Html, on_value

CORRECTIONS = ("two_pass", "four_triangles", "one_plane", "none")
PICTURES = (
    ("seen", "What the eye sees of the sheet"),
    ("expected", "What it ought to see"),
    ("frame", "What the projector is given"),
)


class EyeTab:
    """Pictures, each shown once there is one."""

    def __init__(self, gui: Any, ask: Ask) -> None:
        self._look = gui.add_checkbox(
            "Take pictures", False, hint="One every six seconds: each costs the graph some work"
        )
        self._correction = gui.add_dropdown(
            "Correction",
            CORRECTIONS,
            hint="For the tilt and the dent of the sheet, from the best to none at all",
        )
        on_value(self._look, lambda on: ask("look", on))
        on_value(self._correction, lambda name: ask("correct", name))
        self._words = Html(gui)
        blank = np.full((3, 4, 3), 235, dtype=np.uint8)
        self._pictures = {
            name: gui.add_image(blank, label=label, jpeg_quality=85, visible=False)
            for name, label in PICTURES
        }

    def show_correction(self, correction: Correction) -> None:
        """The one that the scene chose, or a viewer."""
        self._correction.value = correction

    def show_words(self, html: str) -> None:
        self._words.show(html)

    def show_picture(self, name: str, image: NDArray[np.uint8]) -> None:
        self._pictures[name].image = image
        self._pictures[name].visible = True
