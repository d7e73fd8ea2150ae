"""How far to stretch the sheet so that it yields to the finger as the object would."""

from __future__ import annotations

from dataclasses import dataclass

from messages.scene import SheetSpec
from nodes.models.sheet import (
    edge_force_for_stiffness,
    edge_force_n,
    push_stiffness_n_per_m,
    stretch_for_edge_force,
)


@dataclass(frozen=True, slots=True)
class Compliance:
    """The stretch that presents an object's stiffness; `note` says so where the sheet cannot."""

    stretch_ratio: float
    note: str


RESERVE = 0.85
"""Share of the largest edge force and strain that is planned with.

The bridges stop the arms where commanded or measured poses reach the limits themselves; two arms
that move are never exactly as far apart as planned (one sees the other a cycle or two late).
"""


def stretch_range(sheet: SheetSpec) -> tuple[float, float]:
    """Least and largest stretch: the scene's, and what the arms may pull, less the reserve."""
    strongest = stretch_for_edge_force(
        RESERVE * sheet.max_edge_force_n,
        young_modulus_pa=sheet.young_modulus_pa,
        height_m=sheet.height_m,
        thickness_m=sheet.thickness_m,
    )
    longest = 1.0 + RESERVE * (sheet.max_stretch_ratio - 1.0)
    return sheet.min_stretch_ratio, max(sheet.min_stretch_ratio, min(longest, strongest))


def compliance_for(stiffness_n_per_m: float, sheet: SheetSpec) -> Compliance:
    """The stretch for an object of that stiffness (N/m, small pushes), within the sheet's range."""
    least, largest = stretch_range(sheet)
    wanted = stretch_for_edge_force(
        edge_force_for_stiffness(stiffness_n_per_m, width_m=sheet.width_m),
        young_modulus_pa=sheet.young_modulus_pa,
        height_m=sheet.height_m,
        thickness_m=sheet.thickness_m,
    )
    stretch = min(max(wanted, least), largest)
    force = edge_force_n(
        stretch,
        young_modulus_pa=sheet.young_modulus_pa,
        height_m=sheet.height_m,
        thickness_m=sheet.thickness_m,
    )
    presented = push_stiffness_n_per_m(force, width_m=sheet.width_m)
    note = ""
    if wanted < least:
        note = f"object of {stiffness_n_per_m:.0f} N/m is softer than the sheet's {presented:.0f}"
    elif wanted > largest:
        note = f"object of {stiffness_n_per_m:.0f} N/m is stiffer than the sheet's {presented:.0f}"
    return Compliance(stretch, note)
