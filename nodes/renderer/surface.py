"""The drawn surface: a fine mesh of the scene's cylinder that follows the solver's skin.

The correction is exact at vertices only, and the silhouette is as round as its facets, so the
drawn mesh is finer than the solver's and lies on the true shape; between the skin's vertices the
displacement is interpolated.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from nodes.models.rigid import apply

Floats = NDArray[np.float64]
Indices = NDArray[np.int32]


@dataclass(frozen=True, slots=True)
class Surface:
    """Vertices at rest: `rings` x `around` on the side, then the two caps (ring and centre each).

    rest_world_m: (vertices, 3).  triangles: (triangles, 3), outward.
    """

    rest_world_m: Floats
    triangles: Indices
    rings: int
    around: int


def cylinder_surface(
    *, radius_m: float, length_m: float, world_from_object: Floats, spacing_m: float
) -> Surface:
    """A closed cylinder about the object's x axis with vertices at most `spacing_m` apart."""
    rings = int(np.ceil(length_m / spacing_m)) + 1
    around = max(int(np.ceil(2.0 * np.pi * radius_m / spacing_m)), 128)
    x = np.linspace(-0.5 * length_m, 0.5 * length_m, rings)
    angle = 2.0 * np.pi * np.arange(around) / around
    circle = radius_m * np.column_stack([np.sin(angle), np.cos(angle)])
    side = np.empty((rings, around, 3))
    side[..., 0] = x[:, None]
    side[..., 1:] = circle
    centres = np.array([[x[0], 0.0, 0.0], [x[-1], 0.0, 0.0]])
    vertices = np.concatenate(
        [side.reshape(-1, 3), side[0], centres[:1], side[-1], centres[1:]], axis=0
    )

    j = np.arange(around)
    after = (j + 1) % around
    corner = (np.arange(rings - 1)[:, None] * around + j).ravel()
    beside = (np.arange(rings - 1)[:, None] * around + after).ravel()
    side_triangles = np.concatenate(
        [
            np.column_stack([corner, corner + around, beside + around]),
            np.column_stack([corner, beside + around, beside]),
        ]
    )
    first = rings * around
    last = first + around + 1
    caps = np.concatenate(
        [
            np.column_stack([np.full(around, first + around), first + j, first + after]),
            np.column_stack([np.full(around, last + around), last + after, last + j]),
        ]
    )
    triangles = np.concatenate([side_triangles, caps]).astype(np.int32)
    return Surface(apply(world_from_object, vertices), triangles, rings, around)


def normals_of(surface: Surface, positions: Floats) -> Floats:
    """Smooth unit normals (vertices, 3) of the deformed surface (vertices, 3)."""
    rings, around = surface.rings, surface.around
    side = positions[: rings * around].reshape(rings, around, 3)
    along = np.empty_like(side)
    along[1:-1] = side[2:] - side[:-2]
    along[0], along[-1] = side[1] - side[0], side[-1] - side[-2]
    about = np.roll(side, -1, axis=1) - np.roll(side, 1, axis=1)
    # np.cross is several times slower than its own six products.
    normals = np.empty_like(positions)
    flat = normals[: rings * around].reshape(rings, around, 3)
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        flat[..., i] = along[..., j] * about[..., k] - along[..., k] * about[..., j]
    axis = side.mean(axis=1)
    normals[rings * around : rings * around + around + 1] = axis[0] - axis[1]
    normals[rings * around + around + 1 :] = axis[-1] - axis[-2]
    lengths = np.sqrt(np.einsum("ij,ij->i", normals, normals))
    normals /= np.maximum(lengths, 1e-12)[:, None]
    return normals


def follow_matrix(points: Floats, skin_vertices: Floats, skin_triangles: Indices) -> csr_array:
    """(points, skin vertices): interpolates what the skin's vertices carry at the points.

    Each point takes the barycentric weights of the nearest point of the nearest skin triangles.
    ValueError for a skin without triangles.
    """
    if len(skin_triangles) == 0:
        raise ValueError("the skin has no triangles")
    corners = skin_vertices[skin_triangles]
    candidates = min(12, len(skin_triangles))
    _, near = cKDTree(corners.mean(axis=1)).query(points, k=candidates)
    near = near.reshape(len(points), candidates)
    weights = _barycentric(points[:, None, :], corners[near])
    foot = np.einsum("pck,pckx->pcx", weights, corners[near])
    best = np.argmin(np.linalg.norm(foot - points[:, None, :], axis=2), axis=1)
    rows = np.arange(len(points))
    columns = skin_triangles[near[rows, best]]
    return csr_array(
        (weights[rows, best].ravel(), (np.repeat(rows, 3), columns.ravel())),
        shape=(len(points), len(skin_vertices)),
    )


def _barycentric(points: Floats, corners: Floats) -> Floats:
    """Weights (..., 3), clamped to the triangle `corners` (..., 3, 3), of the foot of `points`."""
    a, b, c = corners[..., 0, :], corners[..., 1, :], corners[..., 2, :]
    u, v, p = b - a, c - a, points - a
    uu, uv, vv = (np.sum(s * t, axis=-1) for s, t in ((u, u), (u, v), (v, v)))
    pu, pv = np.sum(p * u, axis=-1), np.sum(p * v, axis=-1)
    determinant = np.maximum(uu * vv - uv * uv, 1e-30)
    weight_b = (vv * pu - uv * pv) / determinant
    weight_c = (uu * pv - uv * pu) / determinant
    weights: Floats = np.clip(
        np.stack([1.0 - weight_b - weight_c, weight_b, weight_c], axis=-1), 0.0, 1.0
    )
    weights /= weights.sum(axis=-1, keepdims=True)
    return weights
