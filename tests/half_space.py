"""Mesh a piece of a half-space with small elements at the origin of its surface, for tests."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from flexsheet.nodes.fem_solver.mesh.bisection import CELL, bisect, make_lattice
from flexsheet.nodes.fem_solver.mesh.grading import longest_edges
from flexsheet.nodes.fem_solver.mesh.solid import add_midside_nodes, orient_tetrahedra

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


def half_space(
    *, half_width: float, smallest: float, fine_radius: float, growth: float, whole: bool
) -> tuple[Floats, Ints]:
    """Return nodes and elements of a block of `half_width` to each side and in depth, with its top
    at z = 0.

    The edge length is `smallest` within `fine_radius` of the origin, then proportional to the
    distance.

    growth: longest edge over the distance from the origin.

    whole: all four quarters about the z axis, instead of x, y >= 0 only.
    """
    vertices, tetrahedra = make_lattice((1, 1, 1))
    inside = vertices[:, 2] <= 0
    if not whole:
        inside &= (vertices[:, :2] >= 0).all(axis=1)
    kept = tetrahedra[inside[tetrahedra].all(axis=1)]
    used, index = np.unique(kept, return_inverse=True)
    scale = 1 << 6
    vertices = vertices[used] * scale

    def place(vertices: Ints) -> Floats:
        return np.asarray(vertices * (half_width / (CELL * scale)))

    def too_large(vertices: Ints, tetrahedra: Ints) -> NDArray[np.bool_]:
        points = place(vertices)
        away = np.linalg.norm(points, axis=1)[tetrahedra].min(axis=1)
        wanted = np.where(away < fine_radius, smallest, np.maximum(smallest, growth * away))
        return np.asarray(longest_edges(points, tetrahedra) > 1.5 * wanted)

    vertices, tetrahedra = bisect(vertices, index.reshape(-1, 4), too_large)
    corners = place(vertices)
    return add_midside_nodes(corners, orient_tetrahedra(corners, tetrahedra))
