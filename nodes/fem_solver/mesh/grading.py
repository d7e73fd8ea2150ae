"""Define the element sizes of a mesh: small at touchable skin, larger at the back and inside."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flexsheet.nodes.arrays import Bools, Floats, Ints
from flexsheet.nodes.fem_solver.mesh.solid import EDGES

BACK_COARSENING = 2.0
DEPTH_GROWTH = 0.35
"""The increase of the element size (m) per metre of depth below the skin."""
RAMP_RAD = 0.6
"""The angle beyond the touchable skin over which the element size increases."""
EDGE_SIZE_RATIO = 1.1 * np.sqrt(2.0)
"""The maximum ratio of the longest edge of a tetrahedron to the required size. The value is the
ratio of the diagonal to the side of a square, plus 10 % for distortion by maps to curved
surfaces."""


@dataclass(frozen=True, slots=True)
class FinePoint:
    """A surface point around which a mesh is fine.

    point_m: position in the mesh frame. near_m: distance within which elements have the minimum
    size. growth: increase of the element size per distance beyond `near_m` (m/m). max_element_m:
    maximum element size.
    """

    point_m: tuple[float, float, float]
    near_m: float
    growth: float
    max_element_m: float


@dataclass(frozen=True, slots=True)
class Grading:
    """The element sizes of a mesh.

    Skin can be touched if the angle between its normal and the unit vector `towards_user` is at
    most `touch_angle_rad`.

    skin_spacing_m: distance between the nodes of touchable skin. Elements elsewhere are larger.
    fine_point: surface point. If it is given, only the skin near this point has the spacing
        `skin_spacing_m`.
    """

    skin_spacing_m: float
    touch_angle_rad: float
    towards_user: tuple[float, float, float]
    fine_point: FinePoint | None = None

    @property
    def element_m(self) -> float:
        """Return the minimum element size, m.

        The size is two node spacings, because edges have a midpoint node.
        """
        return 2.0 * self.skin_spacing_m

    def touchable(self, normals: Floats) -> Bools:
        """Return whether the finger can touch skin with the unit normals (n, 3)."""
        return np.asarray(self._angles(normals) <= self.touch_angle_rad + 1e-9)

    def sizes(self, points: Floats, normals: Floats, depth_m: Floats) -> Floats:
        """Return the required element sizes (n,), m, at points (n, 3), m, in the mesh frame.

        normals (n, 3): unit normals at the nearest points of the surface. depth_m (n,): depths
        below these points.
        """
        if self.fine_point is not None:
            fine = self.fine_point
            distance = np.linalg.norm(points - np.array(fine.point_m), axis=1)
            grown = self.element_m + fine.growth * np.maximum(distance - fine.near_m, 0.0)
            return np.asarray(np.minimum(grown, max(fine.max_element_m, self.element_m)))
        behind = np.clip((self._angles(normals) - self.touch_angle_rad) / RAMP_RAD, 0.0, 1.0)
        coarser = 1.0 + (BACK_COARSENING - 1.0) * behind
        return np.asarray(self.element_m * coarser + DEPTH_GROWTH * np.maximum(depth_m, 0.0))

    def _angles(self, normals: Floats) -> Floats:
        cosines: Floats = normals @ np.array(self.towards_user)
        return np.asarray(np.arccos(np.clip(cosines, -1.0, 1.0)))


def longest_edges(points: Floats, tetrahedra: Ints) -> Floats:
    """Return the length (e,) of the longest edge of each tetrahedron, in the unit of the points."""
    ends = points[tetrahedra[:, EDGES]]
    return np.asarray(np.linalg.norm(ends[:, :, 0] - ends[:, :, 1], axis=2).max(axis=1))
