"""Simulate a person who aligns a bead with a point of the sheet, with one eye closed."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from flexsheet.messages.scene import Scene
from flexsheet.messages.types import Side
from flexsheet.nodes.models.rigid import rotation_from_vector
from flexsheet.nodes.twin.eye import Rays, first_hits
from flexsheet.nodes.twin.head import HeadSway
from flexsheet.nodes.twin.membrane import DeformedSheet

Floats = NDArray[np.float64]

ALIGNMENT_RAD = 1e-3
"""Standard deviation, per axis, of the angle between two points that an eye sees as one.

A bead 0.13 m in front of a sheet at 0.4 m is out of focus by 1.2 dioptres, which blurs it to a disc
of 3.6 mrad with a pupil of 3 mm; a person finds its centre to about a quarter of that.
"""


class Viewer:
    """Person with the true eyes of `true_scene`, whose head moves by `sway`; None: it rests."""

    def __init__(
        self, true_scene: Scene, sway: HeadSway | None, random: np.random.Generator
    ) -> None:
        self._eyes, self._sway, self._random = true_scene.eyes, sway, random

    def locate_eye(self, side: Side, time_s: float) -> Floats:
        """Return the position (3,) of an eye at `time_s`, m."""
        aside_m = (0.5 if side == "right" else -0.5) * self._eyes.interocular_m
        moved = np.zeros(3) if self._sway is None else self._sway.at(time_s)
        return np.asarray(self._eyes.centre_world_m + aside_m * np.eye(3)[0] + moved)

    def align(self, side: Side, bead: Floats, sheet: DeformedSheet, time_s: float) -> Floats | None:
        """Return the point (3,) of the sheet that appears behind a bead (3,); None beside it."""
        eye = self.locate_eye(side, time_s)
        error = rotation_from_vector(self._random.normal(0.0, ALIGNMENT_RAD, 3))
        direction = error @ (bead - eye)
        # A fan of one ray; its other vectors only have to be independent of the direction.
        rays = Rays(eye, direction, np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0]), 1, 1)
        hits = first_hits(rays, sheet.positions.reshape(-1, 3), sheet.triangles())
        if hits.triangle[0, 0] < 0:
            return None
        return np.asarray(eye + direction / hits.inverse_range[0, 0])
