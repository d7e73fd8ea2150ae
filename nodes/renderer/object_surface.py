"""Build the drawn mesh of the scene's object, and deform it with the solver's skin.

The skin is the surface mesh of the soft-body solver. The drawn mesh is finer, and its vertices are
on the true shape. There are two reasons: the outline of a coarse mesh would be visibly angular, and
the image is corrected only at vertices (module `correction`). The displacement and the change of
the normals are interpolated between the vertices of the skin.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import scipy
from numpy.typing import NDArray

from flexsheet.messages.scene import Cylinder, Geometry, Mesh, Plane
from flexsheet.nodes.arrays import Floats, Singles
from flexsheet.nodes.models.rigid import apply
from flexsheet.nodes.models.shapes import GEOMETRIES, CuboidMap, MeshError, Shape
from flexsheet.nodes.models.shapes.triangles import (
    find_degenerate,
    nearest_in_triangles,
    refine_facets,
    triangulate_grid,
)

Indices = NDArray[np.int32]
Real = TypeVar("Real", np.float32, np.float64)

MIN_AROUND = 128
"""The minimum number of vertices around a cylinder, sphere or ellipsoid. It ensures a smooth
outline."""
CANDIDATES = 16
"""The number of nearby sample points on the skin whose triangles are searched for the nearest
point."""


@dataclass(frozen=True, slots=True)
class ObjectSurface:
    """The surface mesh of the object at rest.

    rest_world_m (n, 3): positions of the vertices. Vertices on sharp edges are duplicated.
    normals_world (n, 3): unit normals. triangles (t, 3): counter-clockwise as seen from outside.
    """

    rest_world_m: Floats
    normals_world: Floats
    triangles: Indices

    @property
    def interleaved(self) -> Singles:
        """Return the positions (m) and normals of the vertices as one array (n, 6)."""
        return np.concatenate([self.rest_world_m, self.normals_world], axis=1, dtype=np.float32)

    @staticmethod
    def placed(
        points: Floats, normals: Floats, triangles: NDArray[np.integer], world_from_object: Floats
    ) -> ObjectSurface:
        """Make a surface in the world frame from vertices in the object frame.

        points (n, 3): vertices, m. normals (n, 3): unit normals. triangles (t, 3): vertex indices.
        world_from_object (4, 4): pose of the object.
        """
        return ObjectSurface(
            apply(world_from_object, points),
            normals @ world_from_object[:3, :3].T,
            triangles.astype(np.int32),
        )


def make_surface(
    geometry: Geometry, shape: Shape, *, world_from_object: Floats, spacing_m: float
) -> ObjectSurface:
    """Return the surface mesh of a geometry with vertices about `spacing_m` apart.

    shape: shape of the geometry, which provides exact points and normals. world_from_object (4, 4):
    pose of the object. A plane is drawn as a rectangle, and a mesh as the smooth surface that its
    shape defines. Raises ValueError if the spacing requires too many triangles.
    """
    match geometry:
        case Cylinder(radius_m=radius, length_m=length):
            return cylinder_surface(
                radius_m=radius,
                length_m=length,
                world_from_object=world_from_object,
                spacing_m=spacing_m,
            )
        case Plane(width_m=width, height_m=height):
            points, triangles = _grid(_cells(width, spacing_m), _cells(height, spacing_m))
            points = np.column_stack([points * [width, height], np.zeros(len(points))])
            normals = np.tile([0.0, 0.0, 1.0], (len(points), 1))
        case Mesh(vertices_m=vertices, triangles=coarse):
            try:
                used, index = np.unique(coarse, return_inverse=True)
                points, triangles = refine_facets(vertices[used], index.reshape(-1, 3), spacing_m)
            except MeshError as error:
                raise ValueError(f"spacing_m: {spacing_m}: {error}") from None
            found = shape.closest(points)
            points, normals = found.point, found.normal
        case _:
            cuboid_map = GEOMETRIES[geometry.shape].cuboid_map
            if cuboid_map is None:
                raise ValueError(
                    f'geometry "{geometry.shape}" cannot be drawn: its entry in GEOMETRIES needs a '
                    "cuboid_map"
                )
            points, triangles = _inflate_cuboid(cuboid_map(geometry, shape), spacing_m)
            normals = shape.closest(points).normal
    return ObjectSurface.placed(points, normals, triangles, world_from_object)


def cylinder_surface(
    *, radius_m: float, length_m: float, world_from_object: Floats, spacing_m: float
) -> ObjectSurface:
    """Return a closed cylinder about the object's x axis with vertices at most `spacing_m` apart.

    The vertices of the rings on the curved side come first. The rim and the centre of each end
    follow. world_from_object (4, 4): pose of the object.
    """
    rings = int(np.ceil(length_m / spacing_m)) + 1
    around = max(int(np.ceil(2.0 * np.pi * radius_m / spacing_m)), MIN_AROUND)
    x = np.linspace(-0.5 * length_m, 0.5 * length_m, rings)
    angle = 2.0 * np.pi * np.arange(around) / around
    outward = np.column_stack([np.zeros(around), np.sin(angle), np.cos(angle)])
    side = radius_m * outward + x[:, None, None] * np.array([1.0, 0.0, 0.0])
    centres = np.array([[x[0], 0.0, 0.0], [x[-1], 0.0, 0.0]])
    points = np.concatenate([side.reshape(-1, 3), side[0], centres[:1], side[-1], centres[1:]])
    ends = np.repeat([[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]], around + 1, axis=0)
    normals = np.concatenate([np.tile(outward, (rings, 1)), ends])

    j = np.arange(around)
    after = (j + 1) % around
    corner = (np.arange(rings - 1)[:, None] * around + j).ravel()
    beside = (np.arange(rings - 1)[:, None] * around + after).ravel()
    first = rings * around
    last = first + around + 1
    triangles = np.concatenate(
        [
            np.column_stack([corner, corner + around, beside + around]),
            np.column_stack([corner, beside + around, beside]),
            np.column_stack([np.full(around, first + around), first + j, first + after]),
            np.column_stack([np.full(around, last + around), last + after, last + j]),
        ]
    )
    return ObjectSurface.placed(points, normals, triangles, world_from_object)


def _cells(length_m: float, spacing_m: float) -> int:
    return max(1, int(np.ceil(length_m / spacing_m)))


def _grid(columns: int, rows: int) -> tuple[Floats, NDArray[np.int64]]:
    """Return points (n, 2), from -0.5 to 0.5, and triangles (t, 3) of a grid on a square.

    columns, rows: number of cells. The triangles are counter-clockwise.
    """
    u, v = np.meshgrid(
        np.linspace(-0.5, 0.5, columns + 1), np.linspace(-0.5, 0.5, rows + 1), indexing="xy"
    )
    triangles = triangulate_grid(rows + 1, columns + 1).astype(np.int64)
    return np.column_stack([u.ravel(), v.ravel()]), triangles


def _inflate_cuboid(template: CuboidMap, spacing_m: float) -> tuple[Floats, NDArray[np.int64]]:
    """Map a grid on a cuboid to the surface mesh of a solid.

    template: map from the cuboid to the solid. Return points (n, 3), m, object frame, and triangles
    (t, 3).
    """
    if template.is_round:
        quarter_m = 0.5 * np.pi * float(template.half_m.max())
        cells = [max(_cells(quarter_m, spacing_m), MIN_AROUND // 4)] * 3
    else:
        cells = [_cells(2.0 * half, spacing_m) for half in template.half_m.tolist()]
    points, triangles, count = [], [], 0
    for axis in range(3):
        second, third = (axis + 1) % 3, (axis + 2) % 3
        flat, faces = _grid(cells[second], cells[third])
        for side in (1.0, -1.0):
            w = np.empty((len(flat), 3))
            w[:, axis], w[:, second], w[:, third] = side, 2.0 * flat[:, 0], 2.0 * flat[:, 1]
            points.append(w)
            triangles.append((faces if side > 0 else faces[:, ::-1]) + count)
            count += len(w)
    w, joined = np.unique(np.concatenate(points).round(12), axis=0, return_inverse=True)
    return template.surface(w), joined.ravel()[np.concatenate(triangles)]


class VertexNormals:
    """A function object that computes area-weighted unit normals at the vertices of a mesh."""

    def __init__(self, triangles: NDArray[np.integer], vertices: int) -> None:
        columns = np.repeat(np.arange(len(triangles)), 3)
        ones = np.ones(3 * len(triangles), np.float32)
        self._of_vertices = scipy.sparse.csr_array(
            (ones, (triangles.ravel(), columns)), shape=(vertices, len(triangles))
        )
        self._corners = [np.ascontiguousarray(triangles[:, i]) for i in range(3)]

    def __call__(self, positions: NDArray[Real]) -> NDArray[Real]:
        """Return the unit normals (n, 3) for vertex positions (n, 3)."""
        # One contiguous array for each coordinate is several times faster than np.cross.
        coordinates = np.ascontiguousarray(positions.T)
        a, b, c = (coordinates.take(corner, axis=1) for corner in self._corners)
        b -= a
        c -= a
        area = np.empty((len(self._corners[0]), 3), positions.dtype)
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            np.subtract(b[j] * c[k], b[k] * c[j], out=area[:, i])
        total: NDArray[Real] = self._of_vertices @ area
        total /= np.maximum(np.sqrt(np.einsum("ij,ij->i", total, total)), 1e-20)[:, None]
        return total


class DeformationTransfer:
    """An operator that transfers the displacement of the solver's skin to a drawn surface.

    A drawn vertex moves with the nearest point of the skin. The normal of the vertex changes as
    much as the normal of the skin at this point. Values on the skin are interpolated between the
    vertices of the skin.
    """

    def __init__(
        self, surface: ObjectSurface, skin_vertices: Floats, skin_triangles: Indices
    ) -> None:
        """Compute the interpolation weights between a drawn surface and the skin.

        skin_vertices (s, 3): undeformed vertices of the skin, world frame, m. skin_triangles (t,
        3): counter-clockwise as seen from outside. Raises ValueError if all triangles have zero
        area, or if a coordinate is not finite.
        """
        self.vertices = len(skin_vertices)
        self._weights = transfer_matrix(surface.rest_world_m, skin_vertices, skin_triangles)
        self._skin = skin_vertices.astype(np.float32)
        self._normals = VertexNormals(skin_triangles, len(skin_vertices))
        self._rest_normals = self._normals(self._skin)
        self._rest = surface.interleaved
        self._moves = np.empty((self.vertices, 6), np.float32)

    def apply(self, displacement: Singles) -> Singles:
        """Return positions (m) and normals, (n, 6), of the deformed drawn surface.

        displacement (s, 3): displacement of the skin's vertices, m. The normals need not have unit
        length. Raises ValueError if the array has the wrong shape, or if a value is not finite.
        """
        if displacement.shape != self._skin.shape:
            raise ValueError(
                f"soft_body.displacement_world_m: expected {len(self._skin)} vertices as in the "
                f"skin, found {len(displacement)}; run renderer and solver with the same scene"
            )
        moves = self._moves
        moves[:, :3] = displacement
        # The sum is not finite if one of its terms is not.
        if not np.isfinite(moves[:, :3].sum()):
            raise ValueError(
                "soft_body.displacement_world_m is not finite; check the soft-body solver"
            )
        np.subtract(self._normals(self._skin + displacement), self._rest_normals, out=moves[:, 3:])
        result: Singles = self._weights @ moves
        result += self._rest
        return result


def transfer_matrix(
    points: Floats, skin_vertices: Floats, skin_triangles: Indices
) -> scipy.sparse.csr_array:
    """Return the matrix (n, s), float32, that interpolates values of s skin vertices at n points.

    Each row contains the barycentric weights of the nearest point of the skin. points (n, 3), m.
    skin_vertices (s, 3): vertices of the skin, m. skin_triangles (t, 3): vertex indices. A triangle
    is ignored if its area is zero. Raises ValueError if all triangles have zero area, or if a
    vertex is not finite.
    """
    if not np.isfinite(skin_vertices).all():
        raise ValueError("skin.vertices_world_m is not finite; check the soft-body solver")
    skin_triangles = skin_triangles[
        ~find_degenerate(skin_vertices, skin_triangles.astype(np.int64))
    ]
    if len(skin_triangles) == 0:
        raise ValueError("skin.triangles: all triangles have zero area; check the soft-body solver")
    corners = skin_vertices[skin_triangles]
    samples, owners = _samples(corners)
    candidates = min(CANDIDATES, len(samples))
    _, near = scipy.spatial.cKDTree(samples).query(points, k=candidates)
    near = owners[near.reshape(len(points), candidates)]
    weights = np.empty((len(points), candidates, 3))
    distances = np.empty((len(points), candidates))
    for i in range(candidates):
        weights[:, i] = nearest_in_triangles(points, corners[near[:, i]])
        foot = np.einsum("pc,pcx->px", weights[:, i], corners[near[:, i]])
        distances[:, i] = np.linalg.norm(foot - points, axis=1)
    rows, best = np.arange(len(points)), np.argmin(distances, axis=1)
    columns = skin_triangles[near[rows, best]]
    return scipy.sparse.csr_array(
        (
            weights[rows, best].ravel().astype(np.float32),
            columns.ravel().astype(np.int32),
            np.arange(0, 3 * len(points) + 1, 3, dtype=np.int32),
        ),
        shape=(len(points), len(skin_vertices)),
    )


def _samples(corners: Floats) -> tuple[Floats, NDArray[np.intp]]:
    """Return sample points (n, 3) on triangles (t, 3, 3), and their triangle indices (n,).

    The samples are used to find the triangles near a point. Larger triangles have more samples, so
    that they are found, too.
    """
    sides = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2).max(axis=1)
    parts = np.clip(np.ceil(sides / max(float(np.median(sides)), 1e-12)), 1, 12).astype(int)
    points, owners = [], []
    for count in np.unique(parts):
        i, j = (v.ravel() for v in np.meshgrid(*(np.arange(count),) * 2, indexing="ij"))
        i, j = i[i + j < count], j[i + j < count]
        at = np.column_stack([i, j, count - 1 - i - j]) + 1.0 / 3.0
        mine = np.nonzero(parts == count)[0]
        points.append(np.einsum("wc,tcx->twx", at / count, corners[mine]).reshape(-1, 3))
        owners.append(np.repeat(mine, len(at)))
    return np.concatenate(points), np.concatenate(owners)
