"""Define solid meshes of 10-node tetrahedra and the roles of their surface nodes.

The nodes of an element are its four corners and then the midpoints of its six edges, in the order
that VTK uses. The midpoints of edges on a curved surface are on the true surface. All other edges
are straight.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from flexsheet.messages.errors import FlexsheetError
from flexsheet.nodes.arrays import Bools, Floats, Ints

EDGES = np.array([[0, 1], [1, 2], [0, 2], [0, 3], [1, 3], [2, 3]])
"""The corners of the edges whose midpoints are the nodes 4 to 9 of a tetrahedron."""
FACES = np.array([[0, 2, 1, 6, 5, 4], [0, 1, 3, 4, 8, 7], [1, 2, 3, 5, 9, 8], [0, 3, 2, 7, 9, 6]])
"""The nodes of the faces of a tetrahedron. Each row contains three corners, counter-clockwise as
seen from outside, and then the midpoints of the edges between these corners."""
SUBTRIANGLES = np.array([[0, 3, 5], [3, 1, 4], [5, 4, 2], [3, 4, 5]])
"""The division of a six-node triangle into four flat triangles over the same nodes."""
SAME_M = 1e-9
"""The maximum distance (m) from a plane at which a node counts as lying in the plane."""


class UnfitMeshError(FlexsheetError, ValueError):
    """Raised if an object cannot be meshed as specified."""

    remedy = "Choose a coarser or finer spacing, or repair the surface."


@dataclass(frozen=True, slots=True)
class SolidMesh:
    """A solid mesh of 10-node tetrahedra.

    nodes (n, 3): positions of the n nodes, m, mesh frame. elements (e, 10): node indices. fixed
    (n,): whether each node is fixed. skin (s,): indices of the nodes on the surface. skin_triangles
    (t, 3): indices into `skin`, ordered for outward normals. contact_nodes (m,): sorted indices of
    the skin nodes that the finger can touch. contact_normals (m, 3): outward normals at these
    nodes. contact_faces (f, 6): six-node triangles as indices into `contact_nodes`, ordered for
    outward normals.
    """

    nodes: Floats
    elements: Ints
    fixed: Bools
    skin: Ints
    skin_triangles: NDArray[np.int32]
    contact_nodes: Ints
    contact_normals: Floats
    contact_faces: Ints


def triangle_shape_functions(local: Floats) -> Floats:
    """Return the shape functions (..., 6) of a six-node triangle at local coordinates (..., 2)."""
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
    """Return the six shape functions of a six-node triangle at local coordinates (a, b).

    For one point, this function is faster than `triangle_shape_functions`.
    """
    c = 1.0 - a - b
    corners = (c * (2.0 * c - 1.0), a * (2.0 * a - 1.0), b * (2.0 * b - 1.0))
    return (*corners, 4.0 * c * a, 4.0 * a * b, 4.0 * b * c)


def boundary_faces(elements: Ints) -> Ints:
    """Return the six-node faces (f, 6) that belong to only one element, with outward normals."""
    faces = elements[:, FACES].reshape(-1, 6)
    _, first, counts = np.unique(
        np.sort(faces[:, :3], axis=1), axis=0, return_index=True, return_counts=True
    )
    outer: Ints = faces[np.sort(first[counts == 1])]
    return outer


def nodes_in_planes(nodes: Floats, mirror_axes: tuple[int, ...]) -> Bools:
    """Return flags (n, 3): whether each node is in the plane of symmetry normal to each axis.

    nodes (n, 3): positions, m. mirror_axes: axes with a plane of symmetry, 0 for x = 0 and 1 for
    y = 0. The columns of other axes are false.
    """
    inside: Bools = np.abs(nodes) < SAME_M
    inside[:, [axis for axis in range(3) if axis not in mirror_axes]] = False
    return inside


def skin_faces(nodes: Floats, elements: Ints, mirror_axes: tuple[int, ...]) -> Ints:
    """Return the boundary faces (f, 6) that are not in a plane of symmetry.

    mirror_axes: axes that are perpendicular to these planes, 0 for x = 0 and 1 for y = 0.
    """
    faces = boundary_faces(elements)
    in_planes = np.any(np.all(nodes_in_planes(nodes, mirror_axes)[faces], axis=1), axis=1)
    result: Ints = faces[~in_planes]
    return result


def add_midside_nodes(corners: Floats, tetrahedra: Ints) -> tuple[Floats, Ints]:
    """Add midside nodes to tetrahedra (e, 4), which become 10-node elements with straight edges.

    Return the nodes (n, 3), starting with the corners, and the elements (e, 10).
    """
    pairs = np.sort(tetrahedra[:, EDGES], axis=2).reshape(-1, 2)
    unique, inverse = np.unique(pairs, axis=0, return_inverse=True)
    elements = np.concatenate([tetrahedra, inverse.reshape(-1, 6) + len(corners)], axis=1)
    return np.concatenate([corners, 0.5 * corners[unique].sum(axis=1)]), elements


def orient_tetrahedra(corners: Floats, tetrahedra: Ints) -> Ints:
    """Return the tetrahedra (e, 4) with corners in an order that makes all volumes positive."""
    sides = corners[tetrahedra[:, 1:]] - corners[tetrahedra[:, :1]]
    oriented = tetrahedra.copy()
    oriented[:, 1:3] = np.where(
        (np.linalg.det(sides) < 0.0)[:, None], tetrahedra[:, [2, 1]], tetrahedra[:, [1, 2]]
    )
    return oriented


def number_slabs(nodes: Floats, elements: Ints) -> Ints:
    """Divide the mesh into slabs along its longest axis; return the slab index (n,) of each node.

    The nodes of one element are in at most two successive slabs. Raises UnfitMeshError if the mesh
    consists of several separate components.
    """
    axis = int(np.ptp(nodes, axis=0).argmax())
    level = np.full(len(nodes), -1)
    first = nodes[:, axis] <= nodes[:, axis].min() + 1e-9 * np.ptp(nodes[:, axis])
    level[first] = 0
    number, waiting = 0, elements
    while len(waiting):
        reached = (level[waiting] >= 0).any(axis=1)
        if not reached.any():
            raise UnfitMeshError(
                "the mesh of the object has several separate parts; reduce skin_spacing_m"
            )
        number += 1
        new_nodes = np.unique(waiting[reached])
        level[new_nodes[level[new_nodes] < 0]] = number
        waiting = waiting[~reached]
    return level


def make_solid_mesh(
    nodes: Floats, elements: Ints, *, touchable: Bools, fixed: Bools, normals: Floats
) -> SolidMesh:
    """Make a mesh with marked skin from nodes (n, 3), m, and elements (e, 10).

    touchable, fixed (n,): whether each node can be touched, and whether it is fixed.
    normals (n, 3): outward normals at touchable nodes.

    A face is touchable if all its nodes are touchable and none is fixed. The nodes are sorted along
    the longest axis of the mesh. Raises UnfitMeshError if no face is touchable, or if the mesh
    consists of several components.
    """
    level = number_slabs(nodes, elements)
    order = np.lexsort((nodes[:, 2], nodes[:, 1], nodes[:, 0], level))
    new = np.empty(len(nodes), dtype=np.int64)
    new[order] = np.arange(len(nodes))
    nodes, elements = nodes[order], new[elements]
    faces = boundary_faces(elements)
    skin = np.unique(faces)
    on_hull = np.zeros(len(nodes), dtype=bool)
    on_hull[skin] = True
    triangles = np.searchsorted(skin, faces[:, SUBTRIANGLES].reshape(-1, 3))
    whole = SolidMesh(
        nodes=nodes,
        elements=elements,
        fixed=fixed[order] & on_hull,
        skin=skin,
        skin_triangles=triangles.astype(np.int32),
        contact_nodes=skin,
        contact_normals=normals[order][skin],
        contact_faces=np.searchsorted(skin, faces),
    )
    return restrict_touchable(whole, touchable[order])


def restrict_touchable(mesh: SolidMesh, touchable: Bools) -> SolidMesh:
    """Return a copy of the mesh in which fewer nodes are touchable.

    touchable (n,): whether each node may remain touchable. Fixed nodes are always excluded. Raises
    UnfitMeshError if no touchable face remains.
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
