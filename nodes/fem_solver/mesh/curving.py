"""Bends the hull's edges onto the true surface where the elements bear it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from nodes.fem_solver.mesh.quality import LEAST_JACOBIAN, least_jacobians
from nodes.fem_solver.mesh.solid import EDGES, boundary_faces

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

MOST_SAG = 0.25
"""An edge's middle is not moved farther than this share of the edge: what is farther off lies on
another side of a thin rim."""


def curved(nodes: Floats, elements: Ints, nearest: Callable[[Floats], Floats]) -> Floats:
    """The nodes (n, 3) with the middles of hull edges moved to their nearest surface points.

    Elements (e, 10) have straight edges before.  An element whose Jacobian would fall under
    `LEAST_JACOBIAN` of the straight one's keeps its edges straight.
    """
    middles = np.unique(boundary_faces(elements)[:, 3:])
    result = nodes.copy()
    result[middles] = nearest(nodes[middles])
    length = np.zeros(len(nodes))
    length[elements[:, 4:]] = np.linalg.norm(
        nodes[elements[:, EDGES[:, 0]]] - nodes[elements[:, EDGES[:, 1]]], axis=2
    )
    far = np.linalg.norm(result - nodes, axis=1) > MOST_SAG * length
    result[far] = nodes[far]
    while True:
        bad = least_jacobians(result, elements) < LEAST_JACOBIAN
        # straight elements have exactly 1: this ends
        still_bent = np.unique(elements[bad][:, 4:])
        moved = still_bent[(result[still_bent] != nodes[still_bent]).any(axis=1)]
        if not len(moved):
            return result
        result[moved] = nodes[moved]
