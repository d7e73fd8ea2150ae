"""Mesh a sphere, ellipsoid, rounded box or slab by mapping the vertices of a bisected lattice.

Let u be the coordinates of a lattice vertex, scaled so that the lattice is the cube [-1, 1]^3. With
s = max |u_i|, the point w = u / s is on the surface of the cube. The vertex is mapped to

    x(u) = c u + s^2 (X(w) - c w)

X maps the surface of the cube to the surface of the solid (`CuboidMap.surface`). c contains the
half extents of the undistorted inner lattice (`CuboidMap.inner_m`). Near the centre, the lattice is
only scaled by c. The meshes of symmetric solids are symmetric.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from flexsheet.messages.scene import Plane
from flexsheet.nodes.arrays import Bools, Floats, Ints
from flexsheet.nodes.fem_solver.mesh.bisection import CELL, Cells, bisect, make_lattice
from flexsheet.nodes.fem_solver.mesh.curving import curve_edges
from flexsheet.nodes.fem_solver.mesh.grading import EDGE_SIZE_RATIO, Grading, longest_edges
from flexsheet.nodes.fem_solver.mesh.quality import radius_ratios
from flexsheet.nodes.fem_solver.mesh.smoothing import (
    SPRINGS_ON_SURFACE,
    smooth_mesh,
)
from flexsheet.nodes.fem_solver.mesh.solid import (
    UnfitMeshError,
    add_midside_nodes,
    orient_tetrahedra,
)
from flexsheet.nodes.models.shapes import CuboidMap, Shape

COARSENINGS = (8.0, 4.0, 2.0, 1.0, 0.85, 0.7)
"""The cell widths that are tried for the lattice before it is bisected, divided by the minimum
element size."""
ANCHORS = (30.0, 3.0, 0.3, 0.0)
"""The stiffnesses that are tried for the springs between corners and their mapped positions. The
first value for which the radius ratios of all elements exceed `GOOD_RATIO` is used."""
GOOD_RATIO = 0.2
MAX_SURPLUS_RATIO = 2.0
"""The maximum number of elements of a lattice, divided by the minimum number over all lattices."""


def map_lattice(template: CuboidMap, u: Floats) -> tuple[Floats, Floats]:
    """Map lattice vertices with the scaled coordinates u (n, 3) to points (n, 3), m, in the solid.

    The second result contains the points (n, 3), m, at which rays from the centre through the
    vertices intersect the surface.
    """
    weight = np.abs(u).max(axis=1, keepdims=True)
    # At the centre w is undefined; any direction may be used.
    w = np.where(weight > 0.0, u / np.maximum(weight, 1e-300), np.array([0.0, 0.0, 1.0]))
    outside = template.surface(w)
    return template.inner_m * u + weight**2 * (outside - template.inner_m * w), outside


def mesh_by_map(template: CuboidMap, shape: Shape, grading: Grading) -> tuple[Floats, Ints]:
    """Return nodes (n, 3), m, object frame, and elements (e, 10) of the solid inside a shape.

    template: map from the cube to the shape. grading: required element sizes. Raises UnfitMeshError
    if the elements of all tried meshes are too distorted.
    """

    def positions(u: Floats) -> tuple[Floats, Floats]:
        points, outside = map_lattice(template, u)
        depth = np.linalg.norm(outside - points, axis=1)
        return points, grading.sizes(points, shape.closest(outside).normal, depth)

    # Where a lattice corner is mapped to a round surface, the outermost cells are compressed.
    squeezed = np.pi / 4 if template.is_round else 1.0
    half = squeezed * template.half_m
    for corners, tetrahedra, on_hull in _map_lattices(half, half, grading.element_m, positions):
        for anchor in ANCHORS:
            moved = smooth_mesh(
                corners,
                tetrahedra,
                np.flatnonzero(on_hull),
                shape,
                springs=SPRINGS_ON_SURFACE,
                anchor=anchor,
            )
            if radius_ratios(moved, tetrahedra).min() > GOOD_RATIO:
                nodes, elements = add_midside_nodes(moved, tetrahedra)
                nodes = curve_edges(nodes, elements, lambda points: shape.closest(points).point)
                return nodes, elements
    raise UnfitMeshError(
        f"skin_spacing_m: elements of {grading.element_m:.3g} m that fill the object are too "
        "distorted; change skin_spacing_m, or choose a less elongated object"
    )


def mesh_slab(plane: Plane, margin_m: float, grading: Grading) -> tuple[Floats, Ints]:
    """Return nodes (n, 3), m, and elements (e, 10) of a slab that represents a half-space.

    The slab is `margin_m` deep and extends `margin_m` beyond each side of the touchable rectangle.
    If the grading has a fine point, the lattice is symmetric about this point. In an asymmetric
    mesh, the force on a finger there would have a sideways component.
    """
    rectangle = 0.5 * np.array([plane.width_m, plane.height_m])
    half = np.array([*(rectangle + margin_m), 0.5 * margin_m])
    centre = np.zeros(3)
    if grading.fine_point is not None:
        centre[:2] = grading.fine_point.point_m[:2]
    below, above = half + centre, half - centre

    def positions(u: Floats) -> tuple[Floats, Floats]:
        points = centre + np.where(u < 0.0, below, above) * u - np.array([0.0, 0.0, half[2]])
        facing = np.broadcast_to(np.array(grading.towards_user), points.shape)
        return points, grading.sizes(points, facing, distance_to_rectangle(points, plane))

    corners, tetrahedra, _ = _map_lattices(below, above, grading.element_m, positions)[0]
    return add_midside_nodes(corners, tetrahedra)


def distance_to_rectangle(points: Floats, plane: Plane) -> Floats:
    """Return the distances (n,), m, of points (n, 3) from the touchable rectangle of a plane."""
    half = 0.5 * np.array([plane.width_m, plane.height_m])
    beside = np.maximum(np.abs(points[:, :2]) - half, 0.0)
    return np.asarray(np.linalg.norm(np.column_stack([beside, points[:, 2]]), axis=1))


MapFunction = Callable[[Floats], tuple[Floats, Floats]]
"""A function that maps lattice vertices with scaled coordinates (n, 3) between -1 and 1. It returns
the mapped points (n, 3), m, and the required element sizes (n,), m."""


def _map_lattices(
    below_m: Floats, above_m: Floats, element_m: float, positions: MapFunction
) -> list[tuple[Floats, Ints, Bools]]:
    """Return meshes of tetrahedra with different resolutions, sorted by their number of elements.

    A mesh is made from a cubic lattice. Its cells are bisected where smaller elements are required,
    and its vertices are mapped to the solid. A mesh consists of corners (n, 3), tetrahedra (e, 4),
    and flags (n,) for corners on the boundary.

    below_m, above_m (3,): extents of the lattice in the negative and positive directions of the
        axes.
    element_m: minimum element size.
    positions: function that maps vertices to the solid. It also returns the required element size
        at each mapped vertex.
    """
    found: list[tuple[Floats, Ints, Bools]] = []
    for cells in COARSENINGS:
        low, high = (
            np.maximum(1, np.ceil(extent / (cells * element_m) - 1e-9)).astype(np.int64)
            for extent in (below_m, above_m)
        )
        if found and 6 * (low + high).prod() > MAX_SURPLUS_RATIO * min(len(e) for _, e, _ in found):
            break

        def scale(vertices: Ints, low: Ints = low, high: Ints = high) -> Floats:
            return np.asarray(vertices / (CELL * np.where(vertices < 0, low, high)))

        def too_large(
            vertices: Ints, tetrahedra: Ints, scale: Callable[[Ints], Floats] = scale
        ) -> Bools:
            points, sizes = positions(scale(vertices))
            wanted = EDGE_SIZE_RATIO * sizes[tetrahedra].min(axis=1)
            return np.asarray(longest_edges(points, tetrahedra) > wanted)

        vertices, tetrahedra = bisect(*make_lattice(_cells(low), _cells(high)), too_large)
        corners, _ = positions(scale(vertices))
        on_hull = ((vertices == -CELL * low) | (vertices == CELL * high)).any(axis=1)
        found.append((corners, orient_tetrahedra(corners, tetrahedra), on_hull))
    return sorted(found, key=lambda image: len(image[1]))


def _cells(counts: Ints) -> Cells:
    x, y, z = (int(count) for count in counts)
    return x, y, z
