"""Find the nearest points on flat triangles, as a reference for smooth shapes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from flexsheet.nodes.models.shapes.triangles import MeshError, nearest_in_triangles

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]


class Facets:
    """A search for the nearest points on the triangles of a mesh."""

    def __init__(self, vertices: Floats, triangles: Indices) -> None:
        """Build the search tree. Raises MeshError for a mesh without triangles."""
        if not len(triangles):
            raise MeshError("the mesh has no triangles")
        self.corners = vertices[triangles]
        self._centre = self.corners.mean(axis=1)
        self._reach = float(np.linalg.norm(self.corners - self._centre[:, None], axis=2).max())
        self._tree = cKDTree(self._centre)

    def nearest(self, points: Floats) -> tuple[Indices, Floats]:
        """Return the triangles (n,) nearest to points (n, 3), and the barycentric coordinates (n,
        3).
        """
        reach = self._tree.query(points)[0] + self._reach
        lists = self._tree.query_ball_point(points, reach * (1.0 + 1e-12))
        chosen, weights = np.empty(len(points), dtype=np.int64), np.empty((len(points), 3))
        for i, (point, near) in enumerate(zip(points, lists, strict=True)):
            corners = self.corners[near]
            inside = nearest_in_triangles(np.broadcast_to(point, (len(near), 3)), corners)
            offset = (inside[:, None, :] @ corners)[:, 0] - point
            best = int((offset * offset).sum(1).argmin())
            chosen[i], weights[i] = near[best], inside[best]
        return chosen, weights
