"""Define solid meshes of 10-node tetrahedra with their skin, fixed and touchable parts.

An element lists its corners, then the midpoints of its edges (VTK's order). Midpoints of edges on a
curved surface are on the true surface; all other edges are straight.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from flexsheet.messages.errors import FlexsheetError

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

EDGES = np.array([[0, 1], [1, 2], [0, 2], [0, 3], [1, 3], [2, 3]])
"""Corners of the edges whose midpoints are nodes 4..9 of a tetrahedron (VTK's order)."""
FACES = np.array([[0, 2, 1, 6, 5, 4], [0, 1, 3, 4, 8, 7], [1, 2, 3, 5, 9, 8], [0, 3, 2, 7, 9, 6]])
"""Nodes of the faces: three corners, counter-clockwise seen from outside, then their midpoints."""
SUBTRIANGLES = np.array([[0, 3, 5], [3, 1, 4], [5, 4, 2], [3, 4, 5]])
"""A six-node triangle as four linear ones over the same nodes."""


class UnfitMeshError(FlexsheetError, ValueError):
    """Raised for an object that cannot be meshed as specified."""

    code = "unfit-mesh"
    remedy = "Choose a coarser or finer spacing, or repair the surface."


@dataclass(frozen=True, slots=True)
class SolidMesh:
    """Solid mesh of 10-node tetrahedra.

    nodes (n, 3): m, mesh frame. elements (e, 10). slab (n,): number of a node's slice along one
    axis. The nodes of one element are in at most two successive slabs; nodes are sorted by
    slab. fixed (n,) bool. skin (s,): nodes on the surface. skin_triangles (t, 3): indices into
    `skin`, outward. contact_nodes (m,): touchable nodes, a sorted subset of `skin`. contact_normals
    (m, 3). contact_faces (f, 6): indices into `contact_nodes` of six-node triangles, outward.
    """

    nodes: Floats
    elements: Ints
    slab: Ints
    fixed: NDArray[np.bool_]
    skin: Ints
    skin_triangles: NDArray[np.int32]
    contact_nodes: Ints
    contact_normals: Floats
    contact_faces: Ints


def triangle_shape_functions(local: Floats) -> Floats:
    """Return a six-node triangle's shape functions (..., 6) at local coordinates (..., 2)."""
    a, b = local[..., 0], local[..., 1]
    c = 1.0 - a - b
    result = np.empty((*local.shape[:-1], 6))
    result[..., 0] = c * (2.0 * c - 1.0)
    result[..., 1] = a * (2.0 * a - 1.0)
    result[..., 2] = b * (2.0 * b - 1.0)
    result[..., 3] = 4.0 * c * a
    result[..., 4] = 4.0 * a * b
    result[..., 5] = 4.0 * b * c
    return result


def triangle_shape_functions_at(a: float, b: float) -> tuple[float, ...]:
    """Return `triangle_shape_functions` at one point, faster than with arrays."""
    c = 1.0 - a - b
    corners = (c * (2.0 * c - 1.0), a * (2.0 * a - 1.0), b * (2.0 * b - 1.0))
    return (*corners, 4.0 * c * a, 4.0 * a * b, 4.0 * b * c)


def boundary_faces(elements: Ints) -> Ints:
    """Return the outward six-node faces (f, 6) that belong to a single element."""
    faces = elements[:, FACES].reshape(-1, 6)
    _, first, counts = np.unique(
        np.sort(faces[:, :3], axis=1), axis=0, return_index=True, return_counts=True
    )
    outer: Ints = faces[np.sort(first[counts == 1])]
    return outer


def add_midside_nodes(corners: Floats, tetrahedra: Ints) -> tuple[Floats, Ints]:
    """Return nodes (n, 3), corners first, and elements (e, 10) with straight edges."""
    pairs = np.sort(tetrahedra[:, EDGES], axis=2).reshape(-1, 2)
    unique, inverse = np.unique(pairs, axis=0, return_inverse=True)
    elements = np.concatenate([tetrahedra, inverse.reshape(-1, 6) + len(corners)], axis=1)
    return np.concatenate([corners, 0.5 * corners[unique].sum(axis=1)]), elements


def orient_tetrahedra(corners: Floats, tetrahedra: Ints) -> Ints:
    """Return the tetrahedra (e, 4), reordered so that all volumes are positive."""
    sides = corners[tetrahedra[:, 1:]] - corners[tetrahedra[:, :1]]
    oriented = tetrahedra.copy()
    oriented[:, 1:3] = np.where(
        (np.linalg.det(sides) < 0.0)[:, None], tetrahedra[:, [2, 1]], tetrahedra[:, [1, 2]]
    )
    return oriented


def number_slabs(nodes: Floats, elements: Ints) -> Ints:
    """Return the slab (n,) of each node, counted along the longest axis.

    The nodes of an element are in at most two successive slabs. Raises UnfitMeshError for several
    components.
    """
    axis = int(np.ptp(nodes, axis=0).argmax())
    level = np.full(len(nodes), -1)
    first = nodes[:, axis] <= nodes[:, axis].min() + 1e-9 * np.ptp(nodes[:, axis])
    level[first] = 0
    number, waiting = 0, elements
    while len(waiting):
        reached = (level[waiting] >= 0).any(axis=1)
        if not reached.any():
            raise UnfitMeshError("the mesh has several components; reduce skin_spacing_m")
        number += 1
        new_nodes = np.unique(waiting[reached])
        level[new_nodes[level[new_nodes] < 0]] = number
        waiting = waiting[~reached]
    return level


def make_solid_mesh(
    nodes: Floats, elements: Ints, *, touchable: Bools, fixed: Bools, normals: Floats
) -> SolidMesh:
    """Return the mesh with nodes sorted by slab, and with its skin and touchable part.

    touchable, fixed (n,): flags of boundary nodes. normals (n, 3): outward at touchable nodes.
    Faces are touchable if all their nodes are touchable and none is fixed.
    """
    level = number_slabs(nodes, elements)
    order = np.lexsort((nodes[:, 2], nodes[:, 1], nodes[:, 0], level))
    new = np.empty(len(nodes), dtype=np.int64)
    new[order] = np.arange(len(nodes))
    nodes, level, elements = nodes[order], level[order], new[elements]
    faces = boundary_faces(elements)
    skin = np.unique(faces)
    on_hull = np.zeros(len(nodes), dtype=bool)
    on_hull[skin] = True
    triangles = np.searchsorted(skin, faces[:, SUBTRIANGLES].reshape(-1, 3))
    whole = SolidMesh(
        nodes=nodes,
        elements=elements,
        slab=level,
        fixed=fixed[order] & on_hull,
        skin=skin,
        skin_triangles=triangles.astype(np.int32),
        contact_nodes=skin,
        contact_normals=normals[order][skin],
        contact_faces=np.searchsorted(skin, faces),
    )
    return restrict_touchable(whole, touchable[order])


def restrict_touchable(mesh: SolidMesh, touchable: Bools) -> SolidMesh:
    """Restrict the touchable part to nodes that are `touchable` (n,) and not fixed.

    Raises UnfitMeshError if no face remains.
    """
    good = (touchable & ~mesh.fixed)[mesh.contact_nodes]
    faces = mesh.contact_faces[good[mesh.contact_faces].all(axis=1)]
    if not len(faces):
        raise UnfitMeshError(
            "no part of the skin is touchable: object.support fixes it, or it faces away from the "
            "user by more than working_range.tilt_rad; reduce the support or rotate the object"
        )
    used = np.unique(faces)
    return replace(
        mesh,
        contact_nodes=mesh.contact_nodes[used],
        contact_normals=mesh.contact_normals[used],
        contact_faces=np.searchsorted(used, faces),
    )
