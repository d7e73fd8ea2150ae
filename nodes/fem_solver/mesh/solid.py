"""What a mesh holds: 10-node tetrahedra, their hull, and the parts of it that matter.

Corners come first in an element, then the middles of its edges (VTK's order).  Edges on a curved
hull are curved: their middle nodes lie on the true surface; all other edges are straight.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

EDGES = np.array([[0, 1], [1, 2], [0, 2], [0, 3], [1, 3], [2, 3]])
"""Corners of the edges whose middles are nodes 4..9 of a tetrahedron (VTK's order)."""
FACES = np.array([[0, 2, 1, 6, 5, 4], [0, 1, 3, 4, 8, 7], [1, 2, 3, 5, 9, 8], [0, 3, 2, 7, 9, 6]])
"""Nodes of the faces: three corners, counter-clockwise seen from outside, then their middles."""
SUBTRIANGLES = np.array([[0, 3, 5], [3, 1, 4], [5, 4, 2], [3, 4, 5]])
"""A six-node triangle as four linear ones over the same nodes."""


class UnfitMeshError(ValueError):
    """An object that no sound mesh can be made of as asked; the text says why, and what helps."""


@dataclass(frozen=True, slots=True)
class SolidMesh:
    """A solid of 10-node tetrahedra with the parts of its surface that matter.

    nodes (n, 3) metres, mesh frame.  elements (e, 10).  slab (n,): number of the slice along x that
    a node belongs to; the nodes of one element lie in at most two successive slabs, and nodes are
    sorted by slab.  fixed (n,) bool.  skin (s,): nodes on the surface.  skin_triangles (t, 3):
    indices into `skin`, outward.  touch (m,): nodes that a finger can load, all in `skin`, sorted.
    touch_normals (m, 3).  touch_faces (f, 6): indices into `touch` of the six-node triangles
    between them, outward.
    """

    nodes: Floats
    elements: Ints
    slab: Ints
    fixed: NDArray[np.bool_]
    skin: Ints
    skin_triangles: NDArray[np.int32]
    touch: Ints
    touch_normals: Floats
    touch_faces: Ints


def boundary_faces(elements: Ints) -> Ints:
    """The six-node faces (f, 6) that belong to one element only, outward."""
    faces = elements[:, FACES].reshape(-1, 6)
    _, first, counts = np.unique(
        np.sort(faces[:, :3], axis=1), axis=0, return_index=True, return_counts=True
    )
    outer: Ints = faces[np.sort(first[counts == 1])]
    return outer


def with_middles(corners: Floats, tetrahedra: Ints) -> tuple[Floats, Ints]:
    """Nodes (n, 3), the corners first, and elements (e, 10) with straight edges."""
    pairs = np.sort(tetrahedra[:, EDGES], axis=2).reshape(-1, 2)
    unique, inverse = np.unique(pairs, axis=0, return_inverse=True)
    elements = np.concatenate([tetrahedra, inverse.reshape(-1, 6) + len(corners)], axis=1)
    return np.concatenate([corners, 0.5 * corners[unique].sum(axis=1)]), elements


def oriented(corners: Floats, tetrahedra: Ints) -> Ints:
    """The tetrahedra (e, 4) with those turned over whose volume was negative."""
    sides = corners[tetrahedra[:, 1:]] - corners[tetrahedra[:, :1]]
    turned = tetrahedra.copy()
    turned[:, 1:3] = np.where(
        (np.linalg.det(sides) < 0.0)[:, None], tetrahedra[:, [2, 1]], tetrahedra[:, [1, 2]]
    )
    return turned


def slabs(nodes: Floats, elements: Ints) -> Ints:
    """Slab (n,) of each node, counted from the low end of the longest side: elements reach from one
    slab into the next at most."""
    axis = int(np.ptp(nodes, axis=0).argmax())
    level = np.full(len(nodes), -1)
    first = nodes[:, axis] <= nodes[:, axis].min() + 1e-9 * np.ptp(nodes[:, axis])
    level[first] = 0
    number, waiting = 0, elements
    while len(waiting):
        reached = (level[waiting] >= 0).any(axis=1)
        if not reached.any():
            raise UnfitMeshError("the mesh falls into several pieces")
        number += 1
        fresh = np.unique(waiting[reached])
        level[fresh[level[fresh] < 0]] = number
        waiting = waiting[~reached]
    return level


def solid_mesh(
    nodes: Floats, elements: Ints, *, touchable: Bools, fixed: Bools, normals: Floats
) -> SolidMesh:
    """The mesh with its nodes sorted by slab, and its hull's parts.

    touchable, fixed (n,): of nodes on the hull; normals (n, 3), outward, where they are touchable.
    Faces are touchable where all their nodes are, and none is fixed.
    """
    level = slabs(nodes, elements)
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
        touch=skin,
        touch_normals=normals[order][skin],
        touch_faces=np.searchsorted(skin, faces),
    )
    return touched_where(whole, touchable[order])


def touched_where(mesh: SolidMesh, touchable: Bools) -> SolidMesh:
    """The mesh with its touchable part cut down to where `touchable` (n,) holds and nothing is
    fixed; UnfitMeshError where no face is left."""
    good = (touchable & ~mesh.fixed)[mesh.touch]
    faces = mesh.touch_faces[good[mesh.touch_faces].all(axis=1)]
    if not len(faces):
        raise UnfitMeshError(
            "no part of the skin can be touched: it is held by object.support, or faces away from "
            "the user by more than working_range.tilt_rad; hold less of it, or turn the object"
        )
    kept = np.unique(faces)
    return replace(
        mesh,
        touch=mesh.touch[kept],
        touch_normals=mesh.touch_normals[kept],
        touch_faces=np.searchsorted(kept, faces),
    )
