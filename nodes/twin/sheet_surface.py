"""Compute the surface of the unloaded sheet: the plane between its edges, and its sag by gravity.

The simulator's membrane model computes the sag. It shares no code with the sag model of the nodes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Self

import numpy as np
import scipy

from flexsheet.messages.apparatus import Apparatus
from flexsheet.messages.scene import Scene
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.models.rigid import transform
from flexsheet.nodes.twin.membrane import TrueRubber, make_edge_plane, solve
from flexsheet.nodes.twin.sheet_pull import true_rubber
from flexsheet.nodes.twin.truth import apply_apparatus

CELLS = 8
"""The number of intervals between nodes along each side of the sheet's mesh. In the usable part of
the sheet, the sag differs by 0.3 % from the sag with 32 intervals."""

STRETCH_NODES = 4
LEANS = np.array([0.35, 0.7, 1.0])
"""The vertical components of the sheet's unit normal in the sag table. If the component is 0, the
sag is 0."""

STRETCH_MARGIN = 0.005
"""The amount by which the sag table exceeds the scene's range of stretch ratios at both ends."""


@dataclass(frozen=True, slots=True)
class SheetPlanes:
    """The planes through the clamped edges of the sheet, or tangent to the sheet, at n times.

    points (n, 3): a point on each plane, m. In a plane through the edges, it is midway between
        them.
    normals (n, 3): unit normals of the planes.
    x_axes (n, 3): unit vectors from the left to the right clamped edge.
    distances_m (n,): distances between the clamped edges.
    """

    points: Floats
    normals: Floats
    x_axes: Floats
    distances_m: Floats

    @classmethod
    def through(cls, left: Floats, right: Floats) -> Self:
        """Return the plane through the edges with the poses `left` and `right` (4, 4)."""
        x_axis, _, normal, middle = make_edge_plane(left, right)[:3].T
        distance_m = np.linalg.norm(right[:3, 3] - left[:3, 3])
        return cls(middle[None], normal[None], x_axis[None], np.array([distance_m]))


class SagTable:
    """A table of the unloaded sheet's sag as a function of stretch ratio, tilt and position."""

    def __init__(
        self, rubber: TrueRubber, min_stretch_ratio: float, max_stretch_ratio: float
    ) -> None:
        cosines = np.cos(np.pi * (np.arange(STRETCH_NODES) + 0.5) / STRETCH_NODES)
        middle = 0.5 * (min_stretch_ratio + max_stretch_ratio)
        half = 0.5 * (max_stretch_ratio - min_stretch_ratio)
        self._stretches, self._range = middle + half * cosines, (middle - half, middle + half)
        self._width_m = rubber.width_m
        self._fields = [
            [_solve_sag(rubber, stretch, lean) for lean in LEANS] for stretch in self._stretches
        ]

    def evaluate(
        self, distances_m: Floats, leans: Floats, x_m: Floats, y_m: Floats
    ) -> tuple[Floats, Floats, Floats]:
        """Return the sag (n,), m, along the normal, and its slopes (n,) along x and along y.

        distances_m: distances (n,) between the edges.
        leans: vertical components (n,) of the sheet normals.
        x_m, y_m: positions (n,) relative to the sheet's centre.
        """
        stretches = np.clip(distances_m / self._width_m, *self._range)
        by_stretch = lagrange(self._stretches, stretches) / _compute_tension(stretches)
        by_lean = leans * lagrange(LEANS**2, leans**2) / LEANS[:, None]
        across = np.clip(x_m / distances_m + 0.5, 0.0, 1.0)
        result = np.zeros((3, len(x_m)))
        for fields, tension, weights in zip(
            self._fields, _compute_tension(self._stretches), by_stretch, strict=True
        ):
            for field, lean_weights in zip(fields, by_lean, strict=True):
                values = [field.ev(across, y_m, dx, dy) for dx, dy in ((0, 0), (1, 0), (0, 1))]
                result += tension * weights * lean_weights * np.array(values)
        return result[0], result[1] / distances_m, result[2]


def _compute_tension(stretch: Floats) -> Floats:
    """Return the normalized tension (n,) of a uniaxially stretched neo-Hookean sheet.

    stretch: stretch ratios (n,).

    The sag is almost inversely proportional to this tension. Therefore the product of both is
    interpolated between stretch ratios.
    """
    return stretch - stretch**-2


def lagrange(nodes: Floats, at: Floats | float) -> Floats:
    """Return the values (n, ...) of the Lagrange polynomials with `nodes` (n,) at points `at`."""
    factors = [
        np.prod([(at - other) / (node - other) for other in nodes if other != node], axis=0)
        for node in nodes
    ]
    return np.array(factors)


def _solve_sag(
    rubber: TrueRubber, stretch: float, lean: float
) -> scipy.interpolate.RectBivariateSpline:
    """Compute the sag (m) of a tilted sheet as a function of x and y.

    x is the position between the edges from 0 to 1, and y is the position along the edges in m.
    lean: vertical component of the sheet's unit normal.
    """
    cosine = np.sqrt(1.0 - lean**2)
    rotation = np.array([[1.0, 0.0, 0.0], [0.0, cosine, lean], [0.0, -lean, cosine]])
    half_m = 0.5 * stretch * rubber.width_m
    edges = [transform(rotation, [side * half_m, 0.0, 0.0]) for side in (-1.0, 1.0)]
    local = solve(rubber, *edges, cells=CELLS).positions @ rotation
    middle = local[:, local.shape[1] // 2]
    across = np.linspace(0.0, 1.0, local.shape[1])
    return scipy.interpolate.RectBivariateSpline(across, middle[:, 1], local[..., 2].T)


@lru_cache(maxsize=64)
def _cached_table(rubber: TrueRubber, low: float, high: float) -> SagTable:
    return SagTable(rubber, low, high)


@dataclass(frozen=True, slots=True)
class SheetSurface:
    """The surface of a scene's unloaded sheet.

    table: sag of the sheet; None if the sheet has no weight.
    """

    table: SagTable | None

    @classmethod
    def of(cls, scene: Scene, apparatus: Apparatus | None = None) -> Self:
        rubber = true_rubber(apply_apparatus(scene, apparatus).sheet, apparatus)
        if rubber.density_kg_per_m3 == 0.0:
            return cls(None)
        low, high = scene.sheet.min_stretch_ratio, scene.sheet.max_stretch_ratio
        return cls(_cached_table(rubber, max(low - STRETCH_MARGIN, 1.01), high + STRETCH_MARGIN))

    def find_tangent_planes(self, planes: SheetPlanes, points: Floats, up: Floats) -> SheetPlanes:
        """Return the tangent planes of the sheet at n points.

        points (n, 3): points that are projected onto the sheet.
        planes: planes through the edges.
        up (3,): unit vector against gravity, in the frame of the planes.
        """
        if self.table is None:
            return planes
        x, z = planes.x_axes, planes.normals
        y = np.cross(z, x)
        offsets = points - planes.points
        x_m, y_m = (np.einsum("ni,ni->n", offsets, axes) for axes in (x, y))
        sag_m, slope_x, slope_y = self.table.evaluate(planes.distances_m, z @ up, x_m, y_m)
        normals = z - slope_x[:, None] * x - slope_y[:, None] * y
        return replace(
            planes,
            points=planes.points + x_m[:, None] * x + y_m[:, None] * y + sag_m[:, None] * z,
            normals=normals / np.linalg.norm(normals, axis=1, keepdims=True),
        )
