"""Sphere, ellipsoid, rounded box and slab, as images of a bisected lattice.

A cuboid of lattice cells is mapped so that its surface comes to lie on the solid's.  With
s = max |u_i| over the cuboid's coordinates u in -1..1, and w = u / s on its surface,

    x(u) = c u + s^2 (X(w) - c w)

where X maps the cuboid's surface to the solid's and c are the inner lattice's half extents: near
the middle the lattice stays as it is.  X is, for an ellipsoid, the smooth map of a cube's surface
to the sphere with nearly even areas,

    (w1 sqrt(1 - w2^2/2 - w3^2/2 + w2^2 w3^2/3), and in turn), times the semi-axes,

and for a rounded box the nearest point of its surface.  Symmetric solids get symmetric meshes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from messages.scene import Ellipsoid, Plane, RoundedBox, Sphere
from nodes.fem_solver.mesh.bisection import CELL, bisected, lattice
from nodes.fem_solver.mesh.curving import curved
from nodes.fem_solver.mesh.grading import LONGEST_EDGE, Grading, longest_edges
from nodes.fem_solver.mesh.quality import radius_ratios
from nodes.fem_solver.mesh.smoothing import ON_SURFACE, settled, surface_of
from nodes.fem_solver.mesh.solid import UnfitMeshError, oriented, with_middles
from nodes.models.shapes import Shape

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]

INNER = 0.8
"""Half extents of an ellipsoid's inner lattice over its semi-axes."""
COARSENINGS = (8.0, 4.0, 2.0, 1.0, 0.85, 0.7)
"""Cells before bisection are this many of the smallest elements wide, or a little less."""
ANCHORS = (30.0, 3.0, 0.3, 0.0)
"""How firmly corners are kept to the map's places, see `settled`: less so, until all elements are
better than `GOOD_RATIO`."""
GOOD_RATIO = 0.2
MOST_SURPLUS = 2.0
"""Lattices with more than this many times the fewest elements are not tried."""


@dataclass(frozen=True, slots=True)
class Blank:
    """A cuboid and its map: half extents (3,) of the solid, X(w) and c as in the module's text."""

    half_m: Floats
    inner_m: Floats
    surface: Callable[[Floats], Floats]

    def place(self, vertices: Ints, half_cells: Ints) -> tuple[Floats, Floats]:
        """Images (n, 3) of lattice vertices (n, 3), and the surface points (n, 3) outside them."""
        u = vertices / (CELL * half_cells)
        share = np.abs(u).max(axis=1, keepdims=True)
        # the middle has no direction: any will do, it lies as deep as can be
        w = np.where(share > 0.0, u / np.maximum(share, 1e-300), np.array([0.0, 0.0, 1.0]))
        outside = self.surface(w)
        return self.inner_m * u + share**2 * (outside - self.inner_m * w), outside


def blank_of(geometry: Sphere | Ellipsoid | RoundedBox, shape: Shape) -> Blank:
    """The blank of a geometry that has this shape."""
    if isinstance(geometry, RoundedBox):
        half = 0.5 * np.array(geometry.size_m)
        return Blank(half, half, lambda w: shape.closest(half * w).point)
    if isinstance(geometry, Sphere):
        half = np.full(3, geometry.radius_m)
    else:
        half = np.array(geometry.semi_axes_m)
    return Blank(half, INNER * half, lambda w: half * _cube_to_sphere(w))


def mapped_solid(
    geometry: Sphere | Ellipsoid | RoundedBox, shape: Shape, grading: Grading
) -> tuple[Floats, Ints]:
    """Nodes (n, 3) in the object's frame and elements (e, 10) of a geometry that has this shape."""
    blank = blank_of(geometry, shape)

    def place(vertices: Ints, half_cells: Ints) -> tuple[Floats, Floats]:
        points, outside = blank.place(vertices, half_cells)
        depth = np.linalg.norm(outside - points, axis=1)
        return points, grading.sizes(shape.closest(outside).normal, depth)

    # a lattice's outermost cells are squeezed where its corners become round
    squeezed = 1.0 if isinstance(geometry, RoundedBox) else np.pi / 4
    for corners, tetrahedra, on_hull in _images(squeezed * blank.half_m, grading.element_m, place):
        for anchor in ANCHORS:
            moved = settled(
                corners,
                tetrahedra,
                np.flatnonzero(on_hull),
                surface_of(shape),
                springs=ON_SURFACE,
                anchor=anchor,
            )
            if radius_ratios(moved, tetrahedra).min() > GOOD_RATIO:
                nodes, elements = with_middles(moved, tetrahedra)
                nodes = curved(nodes, elements, lambda points: shape.closest(points).point)
                return nodes, elements
    raise UnfitMeshError(
        f"skin_spacing_m: no well shaped elements of {grading.element_m:.3g} m fill the object; "
        "take another spacing, or a less elongated object"
    )


def slab_solid(plane: Plane, margin_m: float, grading: Grading) -> tuple[Floats, Ints]:
    """Nodes (n, 3) and elements (e, 10) of a slab for a half-space: `margin_m` deep, and wider than
    the touchable rectangle by as much on each side."""
    rectangle = 0.5 * np.array([plane.width_m, plane.height_m])
    half = np.array([*(rectangle + margin_m), 0.5 * margin_m])

    def place(vertices: Ints, half_cells: Ints) -> tuple[Floats, Floats]:
        points = vertices / (CELL * half_cells) * half - np.array([0.0, 0.0, half[2]])
        facing = np.broadcast_to(np.array(grading.towards_user), points.shape)
        return points, grading.sizes(facing, below_rectangle(points, plane))

    corners, tetrahedra, _ = _images(half, grading.element_m, place)[0]
    return with_middles(corners, tetrahedra)


def below_rectangle(points: Floats, plane: Plane) -> Floats:
    """Distance (n,) of points (n, 3) from the touchable rectangle."""
    half = 0.5 * np.array([plane.width_m, plane.height_m])
    beside = np.maximum(np.abs(points[:, :2]) - half, 0.0)
    return np.asarray(np.linalg.norm(np.column_stack([beside, points[:, 2]]), axis=1))


Place = Callable[[Ints, Ints], tuple[Floats, Floats]]
"""Lattice vertices (n, 3) and half the cells of each side (3,) to the vertices' images (n, 3) and
the sizes of elements that are wanted there (n,), m."""


def _images(half_m: Floats, element_m: float, place: Place) -> list[tuple[Floats, Ints, Bools]]:
    """Corners (n, 3), tetrahedra (e, 4) and which corners are on the hull (n,): of lattices that
    begin with cells of several sizes, and are bisected where wanted, those with fewest elements
    first."""
    found: list[tuple[Floats, Ints, Bools]] = []
    for cells in COARSENINGS:
        half_cells = np.maximum(1, np.ceil(half_m / (cells * element_m) - 1e-9)).astype(np.int64)
        if found and 48 * half_cells.prod() > MOST_SURPLUS * min(len(e) for _, e, _ in found):
            break

        def too_large(vertices: Ints, tetrahedra: Ints, half_cells: Ints = half_cells) -> Bools:
            points, sizes = place(vertices, half_cells)
            wanted = LONGEST_EDGE * sizes[tetrahedra].min(axis=1)
            return np.asarray(longest_edges(points, tetrahedra) > wanted)

        x, y, z = (int(count) for count in half_cells)
        vertices, tetrahedra = bisected(*lattice((x, y, z)), too_large)
        corners, _ = place(vertices, half_cells)
        on_hull = (np.abs(vertices) == CELL * half_cells).any(axis=1)
        found.append((corners, oriented(corners, tetrahedra), on_hull))
    return sorted(found, key=lambda image: len(image[1]))


def _cube_to_sphere(w: Floats) -> Floats:
    """Points (n, 3) of the surface of the cube -1..1 to the unit sphere."""
    square = np.square(w)
    second, third = np.roll(square, -1, axis=1), np.roll(square, -2, axis=1)
    result: Floats = w * np.sqrt(1.0 - 0.5 * (second + third) + second * third / 3.0)
    return np.asarray(result / np.linalg.norm(result, axis=1, keepdims=True))
