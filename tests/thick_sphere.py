"""Mesh an eighth of a thick sphere with the solver's lattice, for tests."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from flexsheet.nodes.fem_solver.mesh.bisection import CELL, make_lattice
from flexsheet.nodes.fem_solver.mesh.curving import curve_edges
from flexsheet.nodes.fem_solver.mesh.solid import (
    add_midside_nodes,
    boundary_faces,
    orient_tetrahedra,
)

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

INNER, OUTER = 1.0, 2.0


def eighth(layers: int) -> tuple[Floats, Ints]:
    """Return nodes and elements between the spheres for x, y, z >= 0, with curved edges on the
    spheres.

    layers: number of lattice cells across the wall; each arc has twice as many.
    """
    cells = 2 * layers
    vertices, tetrahedra = make_lattice((cells, cells, cells))
    u = vertices / (CELL * cells)
    out = np.abs(u).max(axis=1)
    kept = tetrahedra[((u >= 0).all(axis=1) & (out >= 0.5))[tetrahedra].all(axis=1)]
    used, index = np.unique(kept, return_inverse=True)
    u, out = u[used], out[used]
    way = np.tan(0.25 * np.pi * u / out[:, None])
    radius = INNER + (OUTER - INNER) * (2.0 * out - 1.0)
    corners = radius[:, None] * way / np.linalg.norm(way, axis=1, keepdims=True)
    corners[u == 0.0] = 0.0
    near = 0.3 * (OUTER - INNER) / layers

    def nearest(points: Floats) -> Floats:
        radius = np.linalg.norm(points, axis=1)
        wanted = np.where(radius < INNER, INNER, np.where(radius > OUTER - near, OUTER, radius))
        return points * (wanted / radius)[:, None]

    nodes, elements = add_midside_nodes(corners, orient_tetrahedra(corners, index.reshape(-1, 4)))
    return curve_edges(nodes, elements, nearest), elements


def symmetry(nodes: Floats) -> Ints:
    """Return the degrees of freedom across the planes of symmetry."""
    return np.flatnonzero((nodes == 0.0).ravel())


def faces_at(nodes: Floats, elements: Ints, radius: float) -> Ints:
    """Return the outward six-node faces on a sphere."""
    faces = boundary_faces(elements)
    there = np.isclose(np.linalg.norm(nodes, axis=1), radius, rtol=1e-9)
    return faces[there[faces].all(axis=1)]
