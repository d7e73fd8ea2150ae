"""Curve the boundary edges of a mesh by moving their midpoints to the true surface."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from flexsheet.nodes.arrays import Floats, Ints
from flexsheet.nodes.fem_solver.mesh.quality import MIN_JACOBIAN_RATIO, min_jacobian_ratios
from flexsheet.nodes.fem_solver.mesh.solid import EDGES, boundary_faces

MAX_SAG_RATIO = 0.25
"""The maximum displacement of an edge's midpoint, divided by the length of the edge. If the nearest
surface point is farther away, it is on the opposite side of a thin part."""


def curve_edges(nodes: Floats, elements: Ints, nearest: Callable[[Floats], Floats]) -> Floats:
    """Move midpoints of boundary edges to the nearest surface points; return all nodes (n, 3), m.

    nodes (n, 3): nodes of a mesh with straight edges, m. elements (e, 10): node indices. nearest:
    function that returns the nearest surface points. The edges of an element remain straight if its
    Jacobian determinant would decrease below `MIN_JACOBIAN_RATIO` times the determinant of the
    straight element.
    """
    middles = np.unique(boundary_faces(elements)[:, 3:])
    result = nodes.copy()
    result[middles] = nearest(nodes[middles])
    length = np.zeros(len(nodes))
    length[elements[:, 4:]] = np.linalg.norm(
        nodes[elements[:, EDGES[:, 0]]] - nodes[elements[:, EDGES[:, 1]]], axis=2
    )
    far = np.linalg.norm(result - nodes, axis=1) > MAX_SAG_RATIO * length
    result[far] = nodes[far]
    while True:
        bad = min_jacobian_ratios(result, elements) < MIN_JACOBIAN_RATIO
        # The loop terminates, because straight elements have a ratio of 1.
        still_bent = np.unique(elements[bad][:, 4:])
        moved = still_bent[(result[still_bent] != nodes[still_bent]).any(axis=1)]
        if not len(moved):
            return result
        result[moved] = nodes[moved]
