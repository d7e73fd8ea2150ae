"""Compute the surface of the virtual object, at rest or deformed, to verify the displayed images.

The skin is the surface mesh of the soft-body solver. This module uses a separate, finer mesh that
follows the displacement of the skin.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from flexsheet.messages.scene import Cylinder, Ellipsoid, Geometry, Mesh, Plane, Scene, Sphere
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.models.rigid import apply, pose_matrix
from flexsheet.nodes.models.shapes import GEOMETRIES, Shape, make_shape
from flexsheet.nodes.models.shapes.triangles import find_degenerate, nearest_in_triangles

Indices = NDArray[np.intp]

AROUND, ALONG = 160, 40
"""The number of vertices around the x axis, and the number of vertex rows along the x axis. Round
shapes have twice as many rows."""
PLANE_CELLS = 64
MAX_EDGE_M = 0.004
"""The maximum edge length of the triangles of a mesh object after subdivision."""
NEAREST_VERTICES = 3
"""The number of skin vertices near a point. Their triangles are searched for the nearest point."""


@dataclass(frozen=True, slots=True)
class TrueObject:
    """A mesh of the virtual object's surface at one time.

    vertices (v, 3): positions in the world frame, m. They are duplicated along sharp edges.
    triangles (t, 3): indices of vertices, counter-clockwise as seen from outside.
    normals (v, 3): unit normals.
    sunk_m (v,): depths to which the vertices are pushed in.
    colour (3,): red, green and blue in full light, from 0 to 1.
    """

    vertices: Floats
    triangles: Indices
    normals: Floats
    sunk_m: Floats
    colour: Floats


class TrueBody:
    """The surface mesh of a scene's virtual object. A plane is represented by a rectangle."""

    def __init__(self, scene: Scene) -> None:
        geometry, pose = scene.object.geometry, scene.object.world_from_object
        world_from_object = pose_matrix(pose)
        shape = make_shape(dict(geometry))
        match geometry:
            case Cylinder(radius_m=radius, length_m=length):
                rest, triangles = _tube(radius, length)
            case Plane(width_m=width, height_m=height):
                rest, triangles = _rectangle(width, height)
            case Mesh(vertices_m=vertices, triangles=coarse):
                rest, triangles = _cut_up(vertices, coarse.astype(np.intp))
                rest = shape.closest(rest).point
            case _:
                rest, triangles = _star(_cast_rays(geometry, shape))
        self._rest, self._triangles = apply(world_from_object, rest), triangles
        owners = np.repeat(np.arange(len(triangles)), 3)
        self._of_vertices = scipy.sparse.csr_array(
            (np.ones(len(owners)), (triangles.ravel(), owners)), shape=(len(rest), len(triangles))
        )
        self._rest_normals = self._normals(self._rest)
        self._colour = np.array(scene.object.appearance.colour)
        self._skin: tuple[bytes, Indices, Floats] | None = None

    def at_rest(self) -> TrueObject:
        return self._object(self._rest)

    def displaced(
        self, skin_vertices: Floats, skin_triangles: NDArray[np.integer], displacement: Floats
    ) -> TrueObject:
        """Return the deformed object; each point moves with the nearest point of the skin at rest.

        skin_vertices (s, 3): vertices of the skin (solver's surface mesh) at rest, m.
        skin_triangles (t, 3): triangles in which the displacement is interpolated linearly.
        displacement (s, 3): displacement of the vertices, m.

        Raises ValueError if displacement and skin have different shapes, or if all triangles of the
        skin have zero area.
        """
        if displacement.shape != skin_vertices.shape:
            raise ValueError(
                f"the displacement has {len(displacement)} vertices, but the skin has "
                f"{len(skin_vertices)}; use the displacement and the skin of one mesh"
            )
        corners, weights = self._on_skin(skin_vertices, skin_triangles)
        return self._object(self._rest + np.einsum("vc,vcx->vx", weights, displacement[corners]))

    def _on_skin(
        self, skin_vertices: Floats, skin_triangles: NDArray[np.integer]
    ) -> tuple[Indices, Floats]:
        """Return the skin triangle that moves each vertex of the displayed object.

        The skin is the surface mesh of the soft-body solver. For each of v object vertices, the
        result contains the indices of the three corners (v, 3) and their interpolation weights (v,
        3). It is cached until the skin changes.
        """
        key = skin_vertices.tobytes() + skin_triangles.tobytes()
        if self._skin is None or self._skin[0] != key:
            self._skin = key, *_feet(self._rest, skin_vertices, skin_triangles.astype(np.intp))
        return self._skin[1], self._skin[2]

    def _object(self, vertices: Floats) -> TrueObject:
        sunk_m = np.einsum("vx,vx->v", self._rest - vertices, self._rest_normals)
        normals = self._normals(vertices)
        return TrueObject(vertices, self._triangles, normals, sunk_m, self._colour)

    def _normals(self, vertices: Floats) -> Floats:
        corners = vertices[self._triangles]
        area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals: Floats = self._of_vertices @ area
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
        return normals


def _feet(points: Floats, vertices: Floats, triangles: Indices) -> tuple[Indices, Floats]:
    """Find the points of a mesh that are nearest to `points` (n, 3).

    Each nearest point is given by the vertex indices of its triangle's corners (n, 3) and by
    barycentric weights (n, 3). Raises ValueError if all triangles have zero area.
    """
    triangles = triangles[~find_degenerate(vertices, triangles)]
    if not len(triangles):
        raise ValueError("all triangles of the skin have zero area; give the skin of a valid mesh")
    # Sort the triangles' corners by vertex, so that the triangles of one vertex are adjacent.
    order = np.argsort(triangles.ravel(), kind="stable")
    corner = triangles.ravel()[order]
    begin = np.searchsorted(corner, np.arange(len(vertices) + 1))
    used = np.unique(triangles)
    _, near = scipy.spatial.cKDTree(vertices[used]).query(
        points, k=min(NEAREST_VERTICES, len(used))
    )
    best = np.full(len(points), np.inf)
    chosen, weights = np.zeros(len(points), np.intp), np.zeros((len(points), 3))
    for vertex in used[near.reshape(len(points), -1)].T:
        degree = begin[vertex + 1] - begin[vertex]
        for slot in range(int(degree.max())):
            rows = np.nonzero(degree > slot)[0]
            triangle = order[begin[vertex[rows]] + slot] // 3
            corners = vertices[triangles[triangle]]
            here = nearest_in_triangles(points[rows], corners)
            away = np.linalg.norm(np.einsum("nc,ncx->nx", here, corners) - points[rows], axis=1)
            nearer = away < best[rows]
            rows = rows[nearer]
            best[rows], chosen[rows], weights[rows] = away[nearer], triangle[nearer], here[nearer]
    return triangles[chosen], weights


def _strip(rows: int, around: int) -> Indices:
    """Return the triangles (n, 3) between successive rings of `around` vertices each.

    The triangles face outward if the rings are ordered along +x and the vertices of a ring from +z
    towards +y.
    """
    i, j = (v.ravel() for v in np.meshgrid(np.arange(rows - 1), np.arange(around), indexing="ij"))
    here, beside = i * around + j, i * around + (j + 1) % around
    return np.concatenate(
        [
            np.column_stack([here, here + around, beside + around]),
            np.column_stack([here, beside + around, beside]),
        ]
    )


def _fan(rim: Indices, centre: int) -> Indices:
    return np.column_stack([np.full(len(rim), centre), rim, np.roll(rim, -1)])


def _turned() -> Floats:
    """Return AROUND unit vectors (AROUND, 3) at equal angles around the x axis.

    The first vector is +z. The angle increases towards +y.
    """
    angle = 2.0 * np.pi * np.arange(AROUND) / AROUND
    return np.column_stack([np.zeros(AROUND), np.sin(angle), np.cos(angle)])


def _tube(radius_m: float, length_m: float) -> tuple[Floats, Indices]:
    """Return vertices and triangles of a closed cylinder along x with duplicated rim vertices."""
    side = np.repeat(radius_m * _turned()[None], ALONG + 1, axis=0)
    side[..., 0] = length_m * np.linspace(-0.5, 0.5, ALONG + 1)[:, None]
    count = AROUND * (ALONG + 1)
    first, last = count + np.arange(AROUND), count + AROUND + np.arange(AROUND)
    centres = np.array([[-0.5, 0.0, 0.0], [0.5, 0.0, 0.0]]) * length_m
    vertices = np.concatenate([side.reshape(-1, 3), side[0], side[-1], centres])
    caps = [_fan(first, len(vertices) - 2), _fan(last[::-1], len(vertices) - 1)]
    return vertices, np.concatenate([_strip(ALONG + 1, AROUND), *caps])


def _rectangle(width_m: float, height_m: float) -> tuple[Floats, Indices]:
    x = np.linspace(-0.5, 0.5, PLANE_CELLS + 1)
    y, x = (v.ravel() for v in np.meshgrid(height_m * x, width_m * x, indexing="ij"))
    cell = np.arange(PLANE_CELLS)
    here = (cell[:, None] * (PLANE_CELLS + 1) + cell).ravel()
    above = here + PLANE_CELLS + 1
    triangles = [[here, here + 1, above], [here + 1, above + 1, above]]
    return (
        np.column_stack([x, y, np.zeros_like(x)]),
        np.concatenate([np.column_stack(each) for each in triangles]),
    )


def _directions() -> Floats:
    """Return unit vectors (n, 3) that cover the sphere.

    The vectors are in rows around the x axis, from -x to +x. The last two vectors are -x and +x.
    """
    polar = np.pi * np.arange(1, 2 * ALONG) / (2 * ALONG)
    rows = np.sin(polar)[:, None, None] * _turned()
    rows[..., 0] = -np.cos(polar)[:, None]
    return np.concatenate([rows.reshape(-1, 3), [[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]]])


def _star(vertices: Floats) -> tuple[Floats, Indices]:
    """Return the vertices and the triangles of a closed surface around a centre.

    vertices (n, 3): one vertex in each direction that `_directions` returns, in the same order.
    """
    rows, count = 2 * ALONG - 1, len(vertices)
    first, last = np.arange(AROUND), (rows - 1) * AROUND + np.arange(AROUND)
    caps = [_fan(first, count - 2), _fan(last[::-1], count - 1)]
    return vertices, np.concatenate([_strip(rows, AROUND), *caps])


def _cast_rays(geometry: Geometry, shape: Shape) -> Floats:
    """Return the points (n, 3), m, at which rays from the centre leave a solid.

    The solid must be star-shaped: all its points are visible from the centre.
    """
    away = _directions()
    match geometry:
        case Sphere(radius_m=radius):
            return radius * away
        case Ellipsoid(semi_axes_m=axes):
            return np.asarray(away / np.linalg.norm(away / np.array(axes), axis=1)[:, None])
    # Sphere tracing from outside: a step by the distance to the surface never crosses it.
    low, high = GEOMETRIES[geometry.shape].bounds_m(geometry)
    reach = np.full(len(away), float(np.linalg.norm(np.maximum(-low, high))))
    for _ in range(100):
        step = shape.signed_distance(reach[:, None] * away)
        reach -= step
        if step.max() < 1e-9:
            break
    return reach[:, None] * away


def _cut_up(vertices: Floats, triangles: Indices) -> tuple[Floats, Indices]:
    """Divide each triangle into four repeatedly until no edge is longer than `MAX_EDGE_M`."""
    while True:
        corners = vertices[triangles]
        longest = float(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max())
        if longest <= MAX_EDGE_M:
            return vertices, triangles
        ends = np.concatenate([triangles[:, [i, (i + 1) % 3]] for i in range(3)])
        edges, which = np.unique(np.sort(ends, axis=1), axis=0, return_inverse=True)
        ab, bc, ca = which.ravel().reshape(3, -1) + len(vertices)
        vertices = np.concatenate([vertices, vertices[edges].mean(axis=1)])
        a, b, c = triangles.T
        parts = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
        triangles = np.concatenate([np.column_stack(part) for part in parts])
