"""Split meshes at sharp edges, for a viewer that shades each vertex with a single normal."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from flexsheet.nodes.arrays import Floats

Triangles = NDArray[np.int32]

CREASE_RAD = 0.7
"""The minimum angle between the normals of two triangles at which their common edge is sharp."""


def split_creases(vertices: Floats, triangles: Triangles) -> tuple[NDArray[np.int64], Triangles]:
    """Duplicate the vertices at sharp edges, so that each side of an edge has its own vertices.

    vertices, triangles: mesh with n vertices (n, 3) and t triangles (t, 3).

    Returns the indices (k,) of the original vertices for the k new vertices. The second result
    contains the triangles (t, 3) with indices of the new vertices.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    a, b, c = (vertices[triangles[:, i]] for i in range(3))
    normals = np.cross(b - a, c - a)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    # Corner i of triangle t has the index 3 t + i. Its edge ends at the next corner.
    corners = np.arange(triangles.size)
    after = corners - corners % 3 + (corners + 1) % 3
    start, end = triangles.ravel()[corners], triangles.ravel()[after]
    order = np.lexsort((np.maximum(start, end), np.minimum(start, end)))
    first, second = order[:-1], order[1:]
    shared = (start[first] == end[second]) & (end[first] == start[second])
    first, second = first[shared], second[shared]
    smooth = (normals[first // 3] * normals[second // 3]).sum(axis=1) > np.cos(CREASE_RAD)
    first, second = first[smooth], second[smooth]
    # Across a smooth edge, the two corners at each of its ends are the same vertex.
    one = np.concatenate([first, after[first]])
    other = np.concatenate([after[second], second])
    graph = coo_matrix((np.ones(len(one)), (one, other)), shape=(len(corners), len(corners)))
    count, label = connected_components(graph, directed=False)
    source = np.empty(count, dtype=np.int64)
    source[label] = triangles.ravel()
    return source, label.reshape(-1, 3).astype(np.int32)
