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
class Grading:
    """The element sizes of a mesh.

    Skin can be touched if the angle between its normal and the unit vector `towards_user` is at
    most `touch_angle_rad`. The nodes of touchable skin are `skin_spacing_m` apart. Elements
    elsewhere are larger.
    """

    skin_spacing_m: float
    touch_angle_rad: float
    towards_user: tuple[float, float, float]

    @property
    def element_m(self) -> float:
        """Return the minimum element size, m.

        The size is two node spacings, because edges have a midpoint node.
        """
        return 2.0 * self.skin_spacing_m

    def touchable(self, normals: Floats) -> Bools:
        """Return whether the finger can touch skin with the unit normals (n, 3)."""
        return np.asarray(self._angles(normals) <= self.touch_angle_rad + 1e-9)

    def sizes(self, normals: Floats, depth_m: Floats) -> Floats:
        """Return the required element sizes (n,), m, at n points of the object.

        normals (n, 3): unit normal of the skin nearest to each point. depth_m (n,): depth below it.
        """
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
