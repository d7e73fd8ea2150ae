"""The rubber sheet: where its edges are, and how it pushes back.

Sheet frame: origin at the centre, x from the left clamped edge to the right one, y along the edges,
z towards the user.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nodes.models.rigid import inverse, transform

Floats = NDArray[np.float64]

CLAMPED_EDGE_FACTOR = 1.08
"""How much more force the clamps' hold across the width adds to plain uniaxial tension.

Fitted to membrane FE of a square sheet clamped at two edges (24x24, neo-Hookean): 5.1, 12.3, 23.4,
43.0 N at stretch 1.02, 1.05, 1.10, 1.20 for 1 MPa, 240 x 240 x 1 mm; the rule is within 2 %.
"""

PUSH_FACTOR = 0.95
"""Small-push stiffness over edge force per length: 0.9-1.0 for a fingertip of radius 10 mm."""


def edge_force_n(
    stretch_ratio: float, *, young_modulus_pa: float, height_m: float, thickness_m: float
) -> float:
    """Force (N) on each clamped edge of the unpushed sheet; 0 when slack.

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
    """Inverse of `edge_force_n` for force >= 0 (Newton; the rule is smooth and increasing)."""
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
    """Force per depth (N/m) of a small push at the sheet's centre under that edge force (N)."""
    return PUSH_FACTOR * edge_force / width_m


def edge_force_for_stiffness(stiffness_n_per_m: float, *, width_m: float) -> float:
    """Inverse of `push_stiffness_n_per_m`."""
    return stiffness_n_per_m * width_m / PUSH_FACTOR


def edge_poses(world_from_sheet: Floats, edge_distance_m: float) -> tuple[Floats, Floats]:
    """world_from_edge of the left and the right clamped edge, axes as the sheet's."""
    offset = 0.5 * edge_distance_m * world_from_sheet[:3, 0]
    rotation, centre = world_from_sheet[:3, :3], world_from_sheet[:3, 3]
    return transform(rotation, centre - offset), transform(rotation, centre + offset)


def sheet_from_edges(world_from_left_edge: Floats, world_from_right_edge: Floats) -> Floats:
    """world_from_sheet between two edges: centre in the middle, x through both, y their mean.

    The edges may differ in tilt and twist; x goes exactly from one to the other, y is the mean of
    the edges' y axes made perpendicular to it.  Degenerate when the edges coincide.
    """
    left, right = world_from_left_edge, world_from_right_edge
    x_axis = right[:3, 3] - left[:3, 3]
    x_axis = x_axis / np.linalg.norm(x_axis)
    y_axis = left[:3, 1] + right[:3, 1]
    y_axis = y_axis - x_axis * (x_axis @ y_axis)
    y_axis = y_axis / np.linalg.norm(y_axis)
    rotation = np.column_stack([x_axis, y_axis, np.cross(x_axis, y_axis)])
    return transform(rotation, 0.5 * (left[:3, 3] + right[:3, 3]))


def corners(world_from_left_edge: Floats, world_from_right_edge: Floats, height_m: float) -> Floats:
    """The sheet's corners (4, 3) in the world: left bottom, right bottom, right top, left top."""
    half = 0.5 * height_m
    left, right = world_from_left_edge, world_from_right_edge
    return np.array(
        [
            left[:3, 3] - half * left[:3, 1],
            right[:3, 3] - half * right[:3, 1],
            right[:3, 3] + half * right[:3, 1],
            left[:3, 3] + half * left[:3, 1],
        ]
    )


def flange_pose(world_from_edge: Floats, flange_from_edge: Floats) -> Floats:
    """world_from_flange of the arm that holds an edge there."""
    return world_from_edge @ inverse(flange_from_edge)
