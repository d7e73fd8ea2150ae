"""Define the sheet's dimensions and material, which every force model needs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, slots=True)
class Rubber:
    """The dimensions and material of an unstretched sheet that is clamped along two edges.

    width_m: distance between the clamped edges.
    height_m: length of an edge.
    mooney_ratio: ratio C2 / (C1 + C2) of the constants of incompressible Mooney-Rivlin rubber, at
        least 0 (neo-Hookean) and less than 1. Young's modulus is E = 6 (C1 + C2).

    Raises ValueError if a value is outside its valid range.
    """

    width_m: float
    height_m: float
    thickness_m: float
    young_modulus_pa: float
    mooney_ratio: float = 0.0

    def __post_init__(self) -> None:
        sizes = (self.width_m, self.height_m, self.thickness_m, self.young_modulus_pa)
        if not (np.isfinite(sizes).all() and min(sizes) > 0.0):
            raise ValueError(
                f"sheet: width_m, height_m, thickness_m and young_modulus_pa {sizes} must be "
                "finite and above 0"
            )
        if not 0.0 <= self.mooney_ratio < 1.0:
            raise ValueError(f"mooney_ratio: {self.mooney_ratio} must be at least 0 and below 1")
