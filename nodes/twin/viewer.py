"""Simulate a viewer who closes one eye and aligns a bead with a point on the sheet."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from flexsheet.messages.apparatus import EyesTruth
from flexsheet.messages.scene import Scene
from flexsheet.messages.types import Side
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.models.rigid import rotation_from_vector
from flexsheet.nodes.twin.eye import Rays, first_hits
from flexsheet.nodes.twin.finger import SineSum
from flexsheet.nodes.twin.membrane import DeformedSheet

MIN_SWAY_FREQUENCY_RATIO = 0.1
"""The ratio of the lowest to the highest frequency of the head's random motion."""

ALIGNMENT_RAD = 1e-3
"""The standard deviation, per axis, of the angle between two points that appear aligned to an eye.

A bead 0.13 m in front of a sheet at 0.4 m is out of focus by 1.2 dioptres. With a pupil of 3 mm the
bead appears as a disc of 3.6 mrad. A person can locate the centre of the disc to about a quarter of
this diameter.
"""


@dataclass(frozen=True, slots=True)
class HeadSway:
    """The slow random motion of a person's head, as a function of time.

    sway_m: standard deviation per axis.
    """

    sway_m: float
    noise: SineSum

    @classmethod
    def drawn(cls, eyes: EyesTruth, seed: int) -> Self | None:
        """Generate a random head motion from the true eye parameters.

        Returns None if the head is at rest.
        """
        if not eyes.sway_m:
            return None
        band_hz = (MIN_SWAY_FREQUENCY_RATIO * eyes.sway_frequency_hz, eyes.sway_frequency_hz)
        return cls(eyes.sway_m, SineSum.drawn(band_hz, np.random.default_rng(seed)))

    def at(self, time_s: float) -> Floats:
        """Return the displacement (3,), in m, of the eyes at `time_s`."""
        return np.asarray(self.sway_m * self.noise.at(time_s)[0])


class Viewer:
    """A simulated person who aligns points by sight."""

    def __init__(
        self, true_scene: Scene, sway: HeadSway | None, random: np.random.Generator
    ) -> None:
        """Store the true eye positions and the motion of the head.

        sway: motion of the head; None if the head is at rest.
        random: generator of the alignment errors.
        """
        self._eyes, self._sway, self._random = true_scene.eyes, sway, random

    def locate_eye(self, side: Side, time_s: float) -> Floats:
        """Return the world position (3,), in m, of an eye at `time_s`."""
        aside_m = (0.5 if side == "right" else -0.5) * self._eyes.interocular_m
        moved = np.zeros(3) if self._sway is None else self._sway.at(time_s)
        return np.asarray(self._eyes.centre_world_m + aside_m * np.eye(3)[0] + moved)

    def align(self, side: Side, bead: Floats, sheet: DeformedSheet, time_s: float) -> Floats | None:
        """Return the point (3,) of the sheet, world frame, m, that an eye sees behind a bead.

        The viewer aligns the bead with this point by sight, with a random error. Returns None if
        the sheet is not behind the bead.

        bead (3,): position of the bead, world frame, m.
        """
        eye = self.locate_eye(side, time_s)
        error = rotation_from_vector(self._random.normal(0.0, ALIGNMENT_RAD, 3))
        direction = error @ (bead - eye)
        # The two pixel steps may have any directions that are linearly independent of the ray.
        rays = Rays(eye, direction, np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0]), 1, 1)
        hits = first_hits(rays, sheet.positions.reshape(-1, 3), sheet.triangles())
        if hits.triangle[0, 0] < 0:
            return None
        return np.asarray(eye + direction / hits.inverse_range[0, 0])
