"""Estimate the force on the clamps, and the stiffness that follows from it alone."""

from __future__ import annotations

CLAMPED_EDGE_FACTOR = 1.08
"""Ratio of the edge force to plain uniaxial tension, since the clamps hold the width.

Fitted to membrane FE of a square sheet clamped at two edges (24x24, neo-Hookean): 5.1, 12.3, 23.4,
43.0 N at stretch 1.02, 1.05, 1.10, 1.20 for 1 MPa, 240 x 240 x 1 mm.  The rule is within 2 %.
"""

PUSH_FACTOR = 0.95
"""Stiffness of a small push over edge force per length: 0.9-1.0 for a fingertip of radius 10 mm."""


def edge_force_n(
    stretch_ratio: float, *, young_modulus_pa: float, height_m: float, thickness_m: float
) -> float:
    """Return the force (N) on each clamped edge of the unpushed sheet; 0 when slack.

    Incompressible neo-Hookean strip, (E/3) A (s - 1/s^2), times CLAMPED_EDGE_FACTOR.
    """
    if stretch_ratio <= 1.0:
        return 0.0
    area = height_m * thickness_m
    strain_term = stretch_ratio - stretch_ratio**-2
    return CLAMPED_EDGE_FACTOR * young_modulus_pa / 3.0 * area * strain_term


def stretch_for_edge_force(
    force_n: float, *, young_modulus_pa: float, height_m: float, thickness_m: float
) -> float:
    """Invert `edge_force_n` for force >= 0 (Newton; the rule is smooth and increasing)."""
    scale = CLAMPED_EDGE_FACTOR * young_modulus_pa / 3.0 * height_m * thickness_m
    wanted = max(force_n, 0.0) / scale
    stretch = 1.0 + wanted / 3.0
    for _ in range(20):
        step = (stretch - stretch**-2 - wanted) / (1.0 + 2.0 * stretch**-3)
        stretch -= step
        if abs(step) < 1e-14:
            break
    return stretch


def push_stiffness_n_per_m(edge_force: float, *, width_m: float) -> float:
    """Return the force per depth (N/m) of a small push at the centre under that edge force (N)."""
    return PUSH_FACTOR * edge_force / width_m


def edge_force_for_stiffness(stiffness_n_per_m: float, *, width_m: float) -> float:
    """Invert `push_stiffness_n_per_m`."""
    return stiffness_n_per_m * width_m / PUSH_FACTOR
