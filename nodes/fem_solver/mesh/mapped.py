"""Mesh sphere, ellipsoid, rounded box and slab by mapping a bisected lattice to them.

With the cuboid's coordinates u in -1..1, s = max |u_i|, and w = u / s on the cuboid's surface, the
map is

    x(u) = c u + s^2 (X(w) - c w)

X maps the cuboid's surface to the solid's (`CuboidMap.surface`). c are the half extents of the
inner lattice, which is undistorted near the centre. Symmetric solids get symmetric meshes.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from flexsheet.messages.scene import Plane
from flexsheet.nodes.fem_solver.mesh.bisection import CELL, bisect, make_lattice
from flexsheet.nodes.fem_solver.mesh.curving import curve_edges
from flexsheet.nodes.fem_solver.mesh.grading import EDGE_SIZE_RATIO, Grading, longest_edges
from flexsheet.nodes.fem_solver.mesh.quality import radius_ratios
from flexsheet.nodes.fem_solver.mesh.smoothing import (
    SPRINGS_ON_SURFACE,
    make_surface_query,
    smooth_mesh,
)
from flexsheet.nodes.fem_solver.mesh.solid import (
    UnfitMeshError,
    add_midside_nodes,
    orient_tetrahedra,
)
from flexsheet.nodes.models.shapes import CuboidMap, Shape

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]

COARSENINGS = (8.0, 4.0, 2.0, 1.0, 0.85, 0.7)
"""Widths of the cells before bisection over the minimum element size."""
ANCHORS = (30.0, 3.0, 0.3, 0.0)
"""Stiffness of springs to the map's positions, see `smooth_mesh`. The first value is used with
which all elements are better than `GOOD_RATIO`."""
GOOD_RATIO = 0.2
MAX_SURPLUS_RATIO = 2.0
"""Maximum number of elements of a lattice, over that of the lattice with the fewest."""


def map_lattice(template: CuboidMap, vertices: Ints, half_cells: Ints) -> tuple[Floats, Floats]:
    """Return images (n, 3) of lattice vertices (n, 3), and the surface points they project to."""
    u = vertices / (CELL * half_cells)
    weight = np.abs(u).max(axis=1, keepdims=True)
    # The centre has no direction; any direction is valid there.
    w = np.where(weight > 0.0, u / np.maximum(weight, 1e-300), np.array([0.0, 0.0, 1.0]))
    outside = template.surface(w)
    return template.inner_m * u + weight**2 * (outside - template.inner_m * w), outside


def mesh_by_map(template: CuboidMap, shape: Shape, grading: Grading) -> tuple[Floats, Ints]:
    """Return nodes (n, 3), object frame, and elements (e, 10) of a shape with this map."""

    def positions(vertices: Ints, half_cells: Ints) -> tuple[Floats, Floats]:
        points, outside = map_lattice(template, vertices, half_cells)
        depth = np.linalg.norm(outside - points, axis=1)
        return points, grading.sizes(shape.closest(outside).normal, depth)

    # The outermost cells are compressed where a corner of the lattice is mapped to a round surface.
    squeezed = np.pi / 4 if template.is_round else 1.0
    for corners, tetrahedra, on_hull in _map_lattices(
        squeezed * template.half_m, grading.element_m, positions
    ):
        for anchor in ANCHORS:
            moved = smooth_mesh(
                corners,
                tetrahedra,
                np.flatnonzero(on_hull),
                make_surface_query(shape),
                springs=SPRINGS_ON_SURFACE,
                anchor=anchor,
            )
            if radius_ratios(moved, tetrahedra).min() > GOOD_RATIO:
                nodes, elements = add_midside_nodes(moved, tetrahedra)
                nodes = curve_edges(nodes, elements, lambda points: shape.closest(points).point)
                return nodes, elements
    raise UnfitMeshError(
        f"skin_spacing_m: elements of {grading.element_m:.3g} m that fill the object are too "
        "distorted; change it, or choose a less elongated object"
    )


def mesh_slab(plane: Plane, margin_m: float, grading: Grading) -> tuple[Floats, Ints]:
    """Return nodes (n, 3) and elements (e, 10) of a slab that represents a half-space.

    The slab is `margin_m` deep and extends `margin_m` beyond each side of the touchable rectangle.
    """
    rectangle = 0.5 * np.array([plane.width_m, plane.height_m])
    half = np.array([*(rectangle + margin_m), 0.5 * margin_m])

    def positions(vertices: Ints, half_cells: Ints) -> tuple[Floats, Floats]:
        points = vertices / (CELL * half_cells) * half - np.array([0.0, 0.0, half[2]])
        facing = np.broadcast_to(np.array(grading.towards_user), points.shape)
        return points, grading.sizes(facing, distance_to_rectangle(points, plane))

    corners, tetrahedra, _ = _map_lattices(half, grading.element_m, positions)[0]
    return add_midside_nodes(corners, tetrahedra)


def distance_to_rectangle(points: Floats, plane: Plane) -> Floats:
    """Return the distance (n,) of points (n, 3) from the touchable rectangle."""
    half = 0.5 * np.array([plane.width_m, plane.height_m])
    beside = np.maximum(np.abs(points[:, :2]) - half, 0.0)
    return np.asarray(np.linalg.norm(np.column_stack([beside, points[:, 2]]), axis=1))


MapFunction = Callable[[Ints, Ints], tuple[Floats, Floats]]
"""Function from lattice vertices (n, 3) and half the numbers of cells (3,) to the vertices' images
(n, 3) and the required element sizes there (n,), m."""


def _map_lattices(
    half_m: Floats, element_m: float, positions: MapFunction
) -> list[tuple[Floats, Ints, Bools]]:
    """Return corners (n, 3), tetrahedra (e, 4) and boundary flags (n,) of several lattices.

    They start with cells of different sizes and are bisected where required. They are sorted by
    their number of elements.
    """
    found: list[tuple[Floats, Ints, Bools]] = []
    for cells in COARSENINGS:
        half_cells = np.maximum(1, np.ceil(half_m / (cells * element_m) - 1e-9)).astype(np.int64)
        if found and 48 * half_cells.prod() > MAX_SURPLUS_RATIO * min(len(e) for _, e, _ in found):
            break

        def too_large(vertices: Ints, tetrahedra: Ints, half_cells: Ints = half_cells) -> Bools:
            points, sizes = positions(vertices, half_cells)
            wanted = EDGE_SIZE_RATIO * sizes[tetrahedra].min(axis=1)
            return np.asarray(longest_edges(points, tetrahedra) > wanted)

        x, y, z = (int(count) for count in half_cells)
        vertices, tetrahedra = bisect(*make_lattice((x, y, z)), too_large)
        corners, _ = positions(vertices, half_cells)
        on_hull = (np.abs(vertices) == CELL * half_cells).any(axis=1)
        found.append((corners, orient_tetrahedra(corners, tetrahedra), on_hull))
    return sorted(found, key=lambda image: len(image[1]))
