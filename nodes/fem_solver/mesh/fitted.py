"""Mesh the solid inside any smooth closed surface by fitting tetrahedra of a lattice to it.

The method follows Molino, Bridson, Teran, Fedkiw ("A crystalline, red green strategy for meshing
highly deformable objects with tetrahedra", 2003), on a bisected lattice:

1. Lattice tetrahedra are bisected to the required sizes, and to smaller sizes where the surface is
    sharply curved.
2. Lattice vertices that are deep enough inside the surface form the core. All tetrahedra with a
    core vertex are used. Therefore every tetrahedron has a corner inside and at most one boundary
    face. If the boundary touches itself in an edge or a vertex (a pinch), vertices are removed from
    the core.
3. The boundary is moved to the surface while the element shapes are optimized (`smoothing`).

The method is deterministic. Parts thinner than the smallest elements are omitted.
"""

from __future__ import annotations

import numpy as np

from flexsheet.nodes.arrays import Bools, Floats, Ints
from flexsheet.nodes.fem_solver.mesh.bisection import CELL, bisect, make_lattice
from flexsheet.nodes.fem_solver.mesh.curving import curve_edges
from flexsheet.nodes.fem_solver.mesh.grading import EDGE_SIZE_RATIO, Grading, longest_edges
from flexsheet.nodes.fem_solver.mesh.quality import MIN_RADIUS_RATIO, radius_ratios
from flexsheet.nodes.fem_solver.mesh.smoothing import (
    SPRINGS_OFF_SURFACE,
    smooth_mesh,
)
from flexsheet.nodes.fem_solver.mesh.solid import (
    EDGES,
    UnfitMeshError,
    add_midside_nodes,
    orient_tetrahedra,
)
from flexsheet.nodes.models.shapes import Shape

INITIAL_CELL_RATIO = 2
"""The width of the lattice cells before they are bisected, divided by the minimum element size."""
MIN_SIZE_RATIO = 0.5
"""The minimum element size where the surface is sharply curved, relative to that elsewhere."""
CURVATURE_SIZE_RATIO = 0.8
"""The maximum element size, divided by the radius of curvature of the surface."""
SURFACE_DISTANCE_RATIO = 0.5
"""The maximum distance between the surface and the nearest corner of a surface element, divided by
the longest edge of the element."""
CORE_DEPTH_RATIO = 0.4
"""The minimum depth of a core (interior) vertex below the surface, divided by the length of the
shortest edge at this vertex."""
MAX_THINNED_FRACTION = 0.05
"""The maximum fraction of core (interior) vertices that are removed. If more must be removed, the
object is too thin."""
GOOD_RATIO = 0.2
ATTEMPTS = 5
"""The maximum number of attempts to fit a mesh. If the radius ratio of an element is below
`GOOD_RATIO`, its interior vertex nearest to the surface is removed, and the fit is repeated. The
best fit is used."""


class _SurfaceCache:
    """A cache of distance, normal and curvature of the surface for each lattice vertex."""

    def __init__(self, shape: Shape, origin: Floats, cell_m: float) -> None:
        self.shape, self.origin, self.cell_m = shape, origin, cell_m
        self._row_numbers: dict[bytes, int] = {}
        self._rows = np.empty((0, 5))

    def positions(self, vertices: Ints) -> Floats:
        return self.origin + vertices * (self.cell_m / CELL)

    def at(self, vertices: Ints) -> tuple[Floats, Floats, Floats]:
        """Return the signed distances of lattice vertices (n, 3) from the surface.

        Returns three arrays: signed distances (n,), m, surface normals (n, 3) and surface
        curvatures (n,), 1/m. The normals and curvatures are those of the nearest surface points.
        """
        keys = [vertex.tobytes() for vertex in vertices]
        new = [i for i, key in enumerate(keys) if key not in self._row_numbers]
        if new:
            found = self.shape.closest(self.positions(vertices[new]))
            bend = np.sqrt(np.square(found.shape_operator).sum(axis=(1, 2)))
            rows = np.column_stack([found.height_m, found.normal, bend])
            for number, i in enumerate(new, len(self._rows)):
                self._row_numbers[keys[i]] = number
            self._rows = np.concatenate([self._rows, rows])
        rows = self._rows[[self._row_numbers[key] for key in keys]]
        return rows[:, 0], rows[:, 1:4], rows[:, 4]


def fit_mesh(shape: Shape, low_m: Floats, high_m: Floats, grading: Grading) -> tuple[Floats, Ints]:
    """Return nodes (n, 3), m, and elements (e, 10) of a mesh of the solid inside a shape.

    low_m, high_m (3,): corners of the bounding box of the shape. grading: required element sizes.
    Raises UnfitMeshError if the shape is too thin for elements of these sizes.
    """
    cell = INITIAL_CELL_RATIO * grading.element_m
    field = _SurfaceCache(shape, 0.5 * (low_m + high_m), cell)
    vertices, tetrahedra = _cover_with_lattice(field, 0.5 * (high_m - low_m), grading)
    distance, _, _ = field.at(vertices)
    points = field.positions(vertices)
    core = distance < -CORE_DEPTH_RATIO * _shortest_edges(points, tetrahedra)

    best, best_ratio = None, MIN_RADIUS_RATIO
    for _ in range(ATTEMPTS):
        chosen = _remove_pinches(tetrahedra, core, distance)
        used, index = np.unique(chosen, return_inverse=True)
        start_points = points[used]
        cells = orient_tetrahedra(start_points, index.reshape(-1, 4))
        hull = np.unique(hull_faces(cells))
        corners = smooth_mesh(
            start_points,
            cells,
            hull,
            shape,
            springs=SPRINGS_OFF_SURFACE,
            anchor=0.0,
        )
        ratios = radius_ratios(corners, cells)
        if ratios.min() > best_ratio:
            best, best_ratio = (corners, cells), float(ratios.min())
        bad = ratios < GOOD_RATIO
        if not bad.any():
            break
        # Remove the core vertex nearest to the surface from each bad element.
        ends = used[cells[bad]]
        height = np.where(core[ends], distance[ends], -np.inf)
        core[ends[np.arange(len(ends)), height.argmax(axis=1)]] = False
    if best is None:
        raise UnfitMeshError(
            f"skin_spacing_m: elements of {grading.element_m:.3g} m that fill the object are too "
            "distorted; reduce skin_spacing_m, or increase object.geometry.smoothing_m"
        )
    nodes, elements = add_midside_nodes(*best)
    return curve_edges(nodes, elements, lambda points: shape.closest(points).point), elements


def limit_sizes_by_curvature(sizes: Floats, bend: Floats, grading: Grading) -> Floats:
    """Limit element sizes (n,), m, to `CURVATURE_SIZE_RATIO` times the radius of curvature.

    bend (n,): surface curvature at each element, 1/m.
    grading: element sizes of the mesh. The limit is at least `MIN_SIZE_RATIO` times the minimum
        size in `grading`.
    """
    finest = np.maximum(
        CURVATURE_SIZE_RATIO / np.maximum(bend, 1e-9), MIN_SIZE_RATIO * grading.element_m
    )
    return np.asarray(np.minimum(sizes, finest))


def hull_faces(tetrahedra: Ints) -> Ints:
    """Return the faces (f, 3) that belong to only one of the tetrahedra (e, 4).

    The corner indices of each face are sorted.
    """
    faces = np.sort(
        tetrahedra[:, [[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]]].reshape(-1, 3), axis=1
    )
    unique, counts = np.unique(faces, axis=0, return_counts=True)
    return np.asarray(unique[counts == 1])


def _cover_with_lattice(
    field: _SurfaceCache, half_m: Floats, grading: Grading
) -> tuple[Ints, Ints]:
    """Return a lattice of tetrahedra that covers the solid, refined to the required element sizes.

    Returns vertices (n, 3), in integer coordinates, and tetrahedra (e, 4). Tetrahedra that are too
    large are bisected.
    """

    def too_large(vertices: Ints, tetrahedra: Ints) -> Bools:
        distance, normals, bend = field.at(vertices)
        points = field.positions(vertices)
        length = longest_edges(points, tetrahedra)
        sizes = grading.sizes(points, normals, -distance)[tetrahedra].min(axis=1)
        corners = distance[tetrahedra]
        at_surface = np.abs(corners).min(axis=1) < SURFACE_DISTANCE_RATIO * length
        bent = limit_sizes_by_curvature(sizes, bend[tetrahedra].max(axis=1), grading)
        sizes = np.where(at_surface, bent, sizes)
        matters = at_surface | (corners.min(axis=1) < 0.0)
        return np.asarray(matters & (length > EDGE_SIZE_RATIO * sizes))

    # Add one layer of cells, because no core vertex may be on the boundary of the lattice.
    counts = np.ceil(half_m / field.cell_m).astype(np.int64) + 1
    return bisect(*make_lattice((int(counts[0]), int(counts[1]), int(counts[2]))), too_large)


def _shortest_edges(points: Floats, tetrahedra: Ints) -> Floats:
    """Return the length (n,), m, of the shortest edge at each of the n vertices."""
    ends = tetrahedra[:, EDGES].reshape(-1, 2)
    length = np.linalg.norm(points[ends[:, 0]] - points[ends[:, 1]], axis=1)
    shortest = np.full(len(points), np.inf)
    np.minimum.at(shortest, ends.ravel(), np.repeat(length, 2))
    return shortest


def _remove_pinches(tetrahedra: Ints, core: Bools, distance: Floats) -> Ints:
    """Remove pinches, and return the tetrahedra (k, 4) that have a core (interior) vertex.

    A pinch is a vertex at which the boundary touches itself. Core vertices near it are removed from
    `core` (n,), in place. distance (n,): signed distance (m) of the vertices from the surface.
    Raises UnfitMeshError if the object is too thin.
    """
    before = int(core.sum())
    while True:
        chosen = tetrahedra[core[tetrahedra].any(axis=1)]
        pinches = _find_pinches(hull_faces(chosen)) if len(chosen) else np.empty(0, dtype=np.int64)
        if not len(pinches) and len(chosen):
            return _largest_piece(chosen)
        about = np.unique(chosen[np.isin(chosen, pinches).any(axis=1)])
        about = about[core[about]]
        if not len(about) or core.sum() < (1.0 - MAX_THINNED_FRACTION) * before:
            raise UnfitMeshError(
                "skin_spacing_m: the object is too thin for elements of twice the skin spacing; "
                "reduce skin_spacing_m"
            )
        core[about[distance[about].argmax()]] = False


def _find_pinches(faces: Ints) -> Ints:
    """Return the pinches (k,): vertices at which a boundary of faces (f, 3) touches itself.

    At a pinch, an edge belongs to more than two faces, or the faces form more than one fan.
    """
    edges, uses = np.unique(
        np.sort(faces[:, [[0, 1], [1, 2], [0, 2]]].reshape(-1, 2), axis=1),
        axis=0,
        return_counts=True,
    )
    crowded = np.unique(edges[uses != 2])
    if len(crowded):
        return crowded
    # Every edge has two faces, so the faces around a vertex form closed fans. Connect the corners
    # of faces across edges to a graph: each fan is a component, and a vertex must have only one.
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    corner = np.arange(faces.size).reshape(faces.shape)
    ends, owners = [], []
    for i, j in ((0, 1), (1, 2), (0, 2)):
        for here, there in ((i, j), (j, i)):
            ends.append(np.column_stack([faces[:, here], faces[:, there]]))
            owners.append(corner[:, here])
    spoke, owner = np.concatenate(ends), np.concatenate(owners)
    order = np.lexsort((spoke[:, 1], spoke[:, 0]))
    pairs = owner[order].reshape(-1, 2)
    graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(faces.size,) * 2)
    _, fan = connected_components(graph, directed=False)
    fans = np.unique(np.column_stack([faces.ravel(), fan]), axis=0)[:, 0]
    vertices, counts = np.unique(fans, return_counts=True)
    return np.asarray(vertices[counts > 1])


def _largest_piece(tetrahedra: Ints) -> Ints:
    """Return the tetrahedra (k, 4) of the largest connected component."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    size = int(tetrahedra.max()) + 1
    first = np.repeat(tetrahedra[:, 0], 3)
    graph = coo_array((np.ones(len(first)), (first, tetrahedra[:, 1:].ravel())), shape=(size, size))
    _, piece = connected_components(graph, directed=False)
    labels = piece[tetrahedra[:, 0]]
    return np.asarray(tetrahedra[labels == np.bincount(labels).argmax()])
