"""Simulate the slow motion of a person's head."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from flexsheet.messages.apparatus import EyesTruth
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.twin.finger import SineSum

MIN_SWAY_FREQUENCY_RATIO = 0.1
"""The lowest frequency of the head's sway, relative to the highest."""


@dataclass(frozen=True, slots=True)
class HeadSway:
    """A random motion of the head, as a function of time.

    sway_m: standard deviation per axis.
    """

    sway_m: float
    noise: SineSum

    @classmethod
    def drawn(cls, eyes: EyesTruth, seed: int) -> Self | None:
        """Generate the random motion for true eye parameters; None for a head at rest."""
        if not eyes.sway_m:
            return None
        band_hz = (MIN_SWAY_FREQUENCY_RATIO * eyes.sway_frequency_hz, eyes.sway_frequency_hz)
        return cls(eyes.sway_m, SineSum.drawn(band_hz, np.random.default_rng(seed)))

    def at(self, time_s: float) -> Floats:
        """Return the displacement (3,) of the eyes at `time_s`, m."""
        return np.asarray(self.sway_m * self.noise.at(time_s)[0])
