"""Compute the edge force, the sag, and the stiffness at small deflections of a sheet."""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from flexsheet.nodes.models.sheet.rubber import Rubber

CLAMP_FACTOR, CLAMP_FACTOR_PER_ASPECT = 1.004, 0.0735
"""The coefficients a and b of the factor a + b height / width, by which the edge force of uniaxial
tension is multiplied.

The factor is above 1 because the clamps prevent the sheet from narrowing. The formula agrees with
membrane finite elements within 0.3 % for height / width from 0.5 to 1.5 and stretch ratios up to
1.12.
"""

SAG_PROFILE = (0.9635, 0.23, 1.96)
"""The coefficients a, b and c of the sag profile a + b v^2 + c v^4, where v = y / height.

The profile is the ratio of the sag to the sag of a sheet with uniform tension. Free edges sag more
than the centre. The formula agrees with membrane finite elements within 1 %. This is valid for a
square sheet with stretch ratios from 1.02 to 1.08 and |v| up to 0.25.
"""

GRAVITY_M_PER_S2 = 9.81
"""The gravitational acceleration, m/s^2, along the negative y axis of the world."""

PUSH_FACTOR = 0.95
"""The ratio of the stiffness of a small push to the edge force per sheet width.

For a fingertip with a radius of 10 mm, the ratio is 0.9 to 1.0.
"""


def strain_measure(stretch_ratio: float, mooney_ratio: float = 0.0) -> float:
    """Return the nominal stress of rubber in uniaxial tension, divided by Young's modulus.

    The result is (s - s^-2)/3 (1 - m + m/s) with the stretch ratio s and the Mooney ratio m. The
    result is 0 if the sheet is slack.
    """
    s = max(stretch_ratio, 1.0)
    return (s - s**-2) / 3.0 * (1.0 - mooney_ratio + mooney_ratio / s)


class SlackSheet(Protocol):
    """The interface of objects with the dimensions and the modulus of an unstretched sheet.

    width_m: distance between the clamped edges.
    height_m: length of an edge.
    """

    @property
    def width_m(self) -> float: ...

    @property
    def height_m(self) -> float: ...

    @property
    def thickness_m(self) -> float: ...

    @property
    def young_modulus_pa(self) -> float: ...


def edge_force_n(stretch_ratio: float, sheet: SlackSheet, *, mooney_ratio: float = 0.0) -> float:
    """Return the force (N) on each clamped edge of an untouched sheet, or 0 if it is slack."""
    return _area_modulus_n(sheet) * strain_measure(stretch_ratio, mooney_ratio)


def stretch_for_edge_force(force_n: float, sheet: SlackSheet) -> float:
    """Return the stretch ratio at which the force on a neo-Hookean sheet's edge is `force_n`."""
    target = max(force_n, 0.0) / (_area_modulus_n(sheet) / 3.0)
    stretch = 1.0 + target / 3.0
    for _ in range(20):
        step = (stretch - stretch**-2 - target) / (1.0 + 2.0 * stretch**-3)
        stretch -= step
        if abs(step) < 1e-14:
            break
    return stretch


def _area_modulus_n(sheet: SlackSheet) -> float:
    return _clamp_factor(sheet) * (sheet.young_modulus_pa * sheet.thickness_m * sheet.height_m)


def _clamp_factor(sheet: SlackSheet) -> float:
    return CLAMP_FACTOR + CLAMP_FACTOR_PER_ASPECT * sheet.height_m / sheet.width_m


def push_stiffness_n_per_m(edge_force: float, *, width_m: float) -> float:
    """Return the stiffness (N/m) that a finger feels in a small push at the sheet's centre.

    edge_force: force on each clamp, N.
    width_m: distance of the clamps.
    """
    return PUSH_FACTOR * edge_force / width_m


def edge_force_for_stiffness(stiffness_n_per_m: float, *, width_m: float) -> float:
    """Return the edge force (N) for a required stiffness at small deflections of the centre."""
    return stiffness_n_per_m * width_m / PUSH_FACTOR


def compute_sag_m(
    rubber: Rubber,
    normal: NDArray[np.float64],
    *,
    density_kg_per_m3: float,
    edge_distance_m: float,
    across: float | NDArray[np.float64],
    along: float | NDArray[np.float64] = 0.0,
) -> NDArray[np.float64]:
    """Return the displacement (m) of an untouched sheet along its normal due to its weight.

    normal: unit normal (3,) of the sheet in the world frame.
    across: positions between the clamps, from 0 to 1. The array can have any shape.
    along: positions along the clamps, from -0.5 to 0.5, as fractions of the height. The array has
        the same shape as `across`.

    The shape of the sheet is the parabola z = 4 sag u (1 - u), with u = `across`. Let L be the
    distance between the edges, and N the tension per length. Equilibrium requires 8 N sag / L^2 =
    load per area. N increases with the length L (1 + 8/3 (sag/L)^2) of the parabola. Therefore the
    sag of a slack sheet is also finite.
    """
    stretch = edge_distance_m / rubber.width_m
    load_pa = -GRAVITY_M_PER_S2 * density_kg_per_m3 * rubber.thickness_m / stretch * normal[1]
    u = np.asarray(across, dtype=np.float64)
    if load_pa == 0.0:
        return np.zeros(u.shape)
    stiffness = _clamp_factor(rubber) * rubber.young_modulus_pa * rubber.thickness_m
    tension = stiffness * strain_measure(stretch, rubber.mooney_ratio)
    # r = sag/L solves  (8/3 stiffness) r^3 + tension r = |load| L / 8, which has one real root.
    stiffening = 8.0 / 3.0 * stiffness
    half_q = abs(load_pa) * edge_distance_m / (16.0 * stiffening)
    third_p = tension / stiffening / 3.0
    root = np.cbrt(half_q + np.sqrt(half_q**2 + third_p**3))
    sag_m = math.copysign((root - third_p / root) * edge_distance_m, load_pa)
    v_squared = np.square(along)
    profile = SAG_PROFILE[0] + v_squared * (SAG_PROFILE[1] + v_squared * SAG_PROFILE[2])
    return np.asarray(4.0 * sag_m * u * (1.0 - u) * profile)
