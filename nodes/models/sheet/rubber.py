"""Describe the rubber of a sheet, the input of every force model."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, slots=True)
class Rubber:
    """Hold a sheet clamped along two edges `width_m` apart, each `height_m` long, when slack.

    mooney_share: C2 / (C1 + C2) of incompressible Mooney-Rivlin rubber with E = 6 (C1 + C2), from 0
        (neo-Hookean) to below 1.
    """

    width_m: float
    height_m: float
    thickness_m: float
    young_modulus_pa: float
    mooney_share: float = 0.0

    def __post_init__(self) -> None:
        """Raise ValueError for a size, modulus or Mooney fraction outside its range."""
        sizes = (self.width_m, self.height_m, self.thickness_m, self.young_modulus_pa)
        if not (np.isfinite(sizes).all() and min(sizes) > 0.0):
            raise ValueError(f"sheet's sizes and modulus {sizes} must be finite and above zero")
        if not 0.0 <= self.mooney_share < 1.0:
            raise ValueError(f"mooney_share: {self.mooney_share} is not from 0 to below 1")
