"""Read stored curves of force against depth that an independent solver computed for a cylinder.

The stored file names method and commit of the solver. The curves are dimensionless:
lengths are in finger radii, forces in Young's modulus times the squared finger radius. Therefore
each curve is valid for all scenes with the same proportions.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.interpolate import PchipInterpolator

from flexsheet.messages.scene import Cylinder, Scene, StripSupport

REFERENCE_FILE = Path(__file__).with_name("force_reference.json")
SAME_RATIO = 1e-3
"""The relative difference up to which lengths, angles or Poisson's ratios are considered equal."""


@dataclass(frozen=True, slots=True)
class ReferenceForce:
    """The force (N) of the object on the finger, with its relative uncertainty."""

    force_n: float
    uncertainty_ratio: float


class ReferenceForceCurve:
    """A force-depth curve of an independent solver for one position on a scene's object."""

    def __init__(self, curve: dict[str, Any], *, finger_radius_m: float, modulus_pa: float) -> None:
        """Convert a stored dimensionless curve to SI units.

        curve: stored dimensionless curve, with at least two depths. modulus_pa: Young's modulus of
        the object.
        """
        self._depths_m = finger_radius_m * np.array(curve["depths"])
        forces = modulus_pa * finger_radius_m**2 * np.array(curve["forces"])
        # As in Hertz' theory, force / depth^1.5 hardly changes, so its interpolation is precise.
        self._hertz = PchipInterpolator(self._depths_m, forces / self._depths_m**1.5)
        self._uncertainty = np.array(curve["uncertainty_ratio"])

    def force(self, depth_m: float) -> ReferenceForce | None:
        """Return the force at a depth, or None if the depth is outside the range of the curve.

        The accepted range is slightly larger: its lower limit is 1 % lower, and its upper limit is
        1 % higher.
        """
        if not 0.99 * self._depths_m[0] <= depth_m <= 1.01 * self._depths_m[-1]:
            return None
        return ReferenceForce(
            float(self._hertz(depth_m)) * depth_m**1.5,
            float(np.interp(depth_m, self._depths_m, self._uncertainty)),
        )


def find_reference_curve(
    scene: Scene, along_m: float, around_m: float, file: Path = REFERENCE_FILE
) -> ReferenceForceCurve | None:
    """Return the stored curve for a position on a scene's object, or None if there is none.

    along_m: position along the axis.
    around_m: arc length from the side that faces the user.
    """
    geometry, support = scene.object.geometry, scene.object.support
    material = scene.object.material
    if (
        not isinstance(geometry, Cylinder)
        or not isinstance(support, StripSupport)
        or material is None
        or not file.exists()
    ):
        return None
    radius = scene.finger.radius_m
    wanted = {
        "radius": geometry.radius_m / radius,
        "length": geometry.length_m / radius,
        "support_angle_rad": support.angle_rad,
        "poisson_ratio": material.poisson_ratio,
        "along": along_m / radius,
        "angle_rad": around_m / geometry.radius_m,
    }
    for curve in json.loads(file.read_text())["curves"]:
        if all(
            abs(curve[key] - value) <= SAME_RATIO * max(abs(value), 1e-3)
            for key, value in wanted.items()
        ):
            return ReferenceForceCurve(
                curve, finger_radius_m=radius, modulus_pa=material.young_modulus_pa
            )
    return None
