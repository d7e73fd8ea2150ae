"""Mesh a solid cylinder with quadratic tetrahedra, graded towards the side that fingers touch.

The mesh frame has its origin at the centre of the cylinder, x along the axis and z away from the
support. A cross-section consists of concentric rings of points. It is triangulated (Delaunay) and
extruded along x to prisms. Each prism is split into three tetrahedra according to the order of its
vertex indices, so that neighbours use the same diagonal (Dompierre et al., "How to subdivide
pyramids, prisms and hexahedra into tetrahedra", 1999). The midpoints of edges on the curved side
are on the true cylinder (isoparametric elements). All other edges are straight.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from flexsheet.nodes.arrays import Floats, Ints
from flexsheet.nodes.fem_solver.mesh.grading import BACK_COARSENING, DEPTH_GROWTH, RAMP_RAD
from flexsheet.nodes.fem_solver.mesh.solid import (
    EDGES,
    SAME_M,
    SUBTRIANGLES,
    SolidMesh,
    add_midside_nodes,
    orient_tetrahedra,
    skin_faces,
)

FOCUS_GROWTH = 0.35
"""The increase of the element size per distance (m/m) from the focus, which is the pushed point."""
MAX_SIZE_RATIO = 0.35
"""The maximum element size of a mesh that is fine only near a focus point, as a fraction of the
radius of the cylinder."""
SPIRAL, FLAT_RATIO = 1e-3, 1e-6


@dataclass(frozen=True, slots=True)
class Focus:
    """A point on the curved side of a cylinder around which the mesh is fine.

    x_m: position along the axis. angle_rad: angle from +z. near_m: distance within which elements
    have the requested size. growth: increase of the element size per distance beyond `near_m`
    (m/m). If it is None, `FOCUS_GROWTH` is used.
    """

    x_m: float
    angle_rad: float
    near_m: float
    growth: float | None = None


def cylinder_mesh(
    *,
    radius_m: float,
    length_m: float,
    support_angle_rad: float,
    touch_angle_rad: float,
    skin_spacing_m: float,
    focus: Focus | None = None,
    mirror_axes: tuple[int, ...] = (),
) -> SolidMesh:
    """Return the mesh of a solid cylinder.

    support_angle_rad: full angle of the fixed strip, which is centred on -z. touch_angle_rad: half
    angle of the touchable skin, which is centred on +z. skin_spacing_m: distance between touchable
    nodes. focus: point around which the mesh is fine; if it is None, the mesh is fine on all
    touchable skin. mirror_axes: axes of planes of symmetry through the focus, 0 for x = 0 and 1 for
    y = 0. For each axis, the mesh contains only the half with positive coordinates. Elements are
    larger inside and at the back of the cylinder. Raises ValueError if the spacing is too large for
    the cylinder, or if the angles are invalid.
    """
    half_support = 0.5 * support_angle_rad
    if not 0.0 < half_support < np.pi:
        raise ValueError(
            f"object.support.angle_rad: {support_angle_rad:g} must be between 0 and 2 pi; change "
            "this angle, or working_range.tilt_rad if the support is not a strip"
        )
    if touch_angle_rad <= 0.0 or touch_angle_rad > np.pi - half_support + 1e-9:
        raise ValueError(
            f"touch_angle_rad: {touch_angle_rad:g} must be positive and at most "
            f"{np.pi - half_support:g}, where the support begins; reduce working_range.tilt_rad, "
            "from which this angle results, or object.support.angle_rad"
        )
    if not 0.0 < skin_spacing_m <= 0.25 * min(radius_m, length_m):
        raise ValueError(
            f"skin_spacing_m: {skin_spacing_m:g} must be positive and at most a quarter of the "
            f"cylinder's radius ({radius_m:g} m) and length ({length_m:g} m); change skin_spacing_m"
        )
    element_m = 2.0 * skin_spacing_m
    sizes = _Sizes(element_m, touch_angle_rad, radius_m, focus)
    if focus is None:
        points, triangles = _disc(radius_m, half_support, sizes)
    else:
        points, triangles = _focused_disc(radius_m, half_support, sizes, focus, mirror_axes)
    stations = _stations(length_m, sizes, mirror_axes)
    # The slices at the focus are mirror images. With the other diagonals there, deep pushes invert
    # elements earlier.
    swapped = 1 if focus is None else int(np.abs(stations - focus.x_m).argmin())
    corners, tetrahedra = _extrude(points, triangles, stations, swapped)
    layer = np.repeat(np.arange(len(stations)), len(points))
    nodes, elements = add_midside_nodes(corners, tetrahedra)
    level = np.empty(len(nodes), dtype=np.int64)
    level[: len(corners)] = 2 * layer
    level[elements[:, 4:]] = layer[tetrahedra[:, EDGES]].sum(axis=2)

    # Move the nodes of the curved side onto the true cylinder.
    faces = skin_faces(nodes, elements, mirror_axes)
    on_cap = np.abs(np.abs(nodes[:, 0]) - 0.5 * length_m) < 1e-9 * length_m
    side = faces[~on_cap[faces[:, :3]].all(axis=1)]
    rim = np.unique(side)
    nodes[rim, 1:] *= (radius_m / np.hypot(nodes[rim, 1], nodes[rim, 2]))[:, None]

    # Sort the nodes by level, position along the axis, and angle.
    angle = np.arctan2(nodes[:, 1], nodes[:, 2])
    order = np.lexsort((angle, nodes[:, 0], level))
    new = np.empty(len(nodes), dtype=np.int64)
    new[order] = np.arange(len(nodes))
    nodes, angle = nodes[order], angle[order]
    elements, faces, side, rim = new[elements], new[faces], new[side], np.sort(new[rim])

    fixed = np.zeros(len(nodes), dtype=bool)
    fixed[rim] = np.abs(angle[rim]) >= np.pi - half_support - 1e-9
    skin = np.unique(faces)
    touchable = np.zeros(len(nodes), dtype=bool)
    touchable[rim] = np.abs(angle[rim]) <= touch_angle_rad + 1e-9
    touchable &= ~fixed
    contact_faces = side[touchable[side].all(axis=1)]
    contact_nodes = np.unique(contact_faces)
    normals = nodes[contact_nodes] / radius_m
    normals[:, 0] = 0.0
    return SolidMesh(
        nodes=nodes,
        elements=elements,
        fixed=fixed,
        skin=skin,
        skin_triangles=np.searchsorted(skin, faces[:, SUBTRIANGLES].reshape(-1, 3)).astype(
            np.int32
        ),
        contact_nodes=contact_nodes,
        contact_normals=normals,
        contact_faces=np.searchsorted(contact_nodes, contact_faces),
    )


@dataclass(frozen=True, slots=True)
class _Sizes:
    element_m: float
    touch_angle: float
    radius_m: float
    focus: Focus | None

    def around(self, angle: Floats) -> Floats:
        wrapped = (angle + np.pi) % (2 * np.pi) - np.pi
        if self.focus is None:
            behind = np.clip((np.abs(wrapped) - self.touch_angle) / RAMP_RAD, 0.0, 1.0)
            result: Floats = self.element_m * (1.0 + (BACK_COARSENING - 1.0) * behind)
            return result
        apart = (wrapped - self.focus.angle_rad + np.pi) % (2 * np.pi) - np.pi
        return self._sizes_at_distance(self.radius_m * np.abs(apart), self.focus)

    def along(self, x: Floats) -> Floats:
        if self.focus is None:
            return np.full(len(x), self.element_m)
        return self._sizes_at_distance(np.abs(x - self.focus.x_m), self.focus)

    def _sizes_at_distance(self, distance_m: Floats, focus: Focus) -> Floats:
        growth = FOCUS_GROWTH if focus.growth is None else focus.growth
        grown = self.element_m + growth * np.maximum(distance_m - focus.near_m, 0.0)
        result: Floats = np.minimum(grown, max(MAX_SIZE_RATIO * self.radius_m, self.element_m))
        return result


def _stations(length_m: float, sizes: _Sizes, mirror_axes: tuple[int, ...]) -> Floats:
    """Return the x coordinates (s,), m, of the cross-sections, including both ends of the cylinder.

    If the mesh is fine only near a focus (pushed point), one cross-section is at the focus. Within
    the distance `near_m` of the focus, the spacing is uniform. If x = 0 is a plane of symmetry,
    only values x >= 0 are returned.
    """
    half = 0.5 * length_m
    stops = [-half, half]
    if sizes.focus is not None:
        near, x = sizes.focus.near_m, sizes.focus.x_m
        inner = [x - near, x, x + near]
        stops[1:1] = [stop for stop in inner if abs(stop) < half - sizes.element_m]
    if 0 in mirror_axes:
        # The focus is in the plane only within rounding, and its coordinate may be negative.
        stops = [0.0, *(stop for stop in stops if stop > SAME_M)]
    stations = []
    for start, stop in itertools.pairwise(stops):
        fine = np.linspace(start, stop, 2001)
        stations.append(_sample_by_density(fine, 1.0 / sizes.along(fine), min_count=1))
    return np.concatenate([*stations, stops[-1:]])


def _sample_arc(start: float, stop: float, radius: float, depth: float, sizes: _Sizes) -> Floats:
    """Return the angles (n,), rad, of points on an arc from `start` to `stop` (excluded).

    The points are about one required element size apart. radius: radius of the arc, m. depth: depth
    (m) of the arc below the curved side of the cylinder.
    """
    fine = np.linspace(start, stop, 2001)
    return _sample_by_density(
        fine, radius / (sizes.around(fine) + DEPTH_GROWTH * depth), min_count=2
    )


def _sample_by_density(fine: Floats, density: Floats, *, min_count: int) -> Floats:
    """Return increasing samples of a coordinate with a given number of samples per unit.

    fine: increasing coordinates at which the density is given. The samples begin at the first
        coordinate and end before the last.
    density: number of samples per unit of the coordinate, at each value of `fine`.
    min_count: minimum number of samples.
    """
    total = np.concatenate([[0.0], np.cumsum(0.5 * (density[1:] + density[:-1]) * np.diff(fine))])
    pieces = max(min_count, round(float(total[-1])))
    result: Floats = np.interp(np.arange(pieces) * total[-1] / pieces, total, fine)
    return result


def _rings(radius_m: float, sizes: _Sizes) -> Iterator[tuple[float, float]]:
    """Yield the radius (m) and the depth (m) of each ring of points in a cross-section.

    The outermost ring comes first. The depth is the distance from the curved side.
    """
    depth, step = 0.0, sizes.element_m
    while True:
        depth += 0.85 * step
        step = sizes.element_m + DEPTH_GROWTH * depth
        inner = radius_m - depth
        if inner < 0.6 * step:
            return
        yield inner, depth


def _disc(radius_m: float, half_support: float, sizes: _Sizes) -> tuple[Floats, Ints]:
    """Return the points (n, 2), as (y, z), m, and the triangles (t, 3) of a cross-section.

    half_support: half the angle (rad) of the arc on which the cylinder is fixed. Two points are at
        the ends of this arc.

    The triangles are counter-clockwise as seen from +x.
    """
    free = np.pi - half_support
    ends = [-free, free, 2 * np.pi - free]
    rim = np.concatenate(
        [_sample_arc(start, stop, radius_m, 0.0, sizes) for start, stop in itertools.pairwise(ends)]
    )
    rings = [_circle(radius_m, rim)]
    for inner, depth in _rings(radius_m, sizes):
        step = sizes.element_m + DEPTH_GROWTH * depth
        offset = 0.5 * step / inner if len(rings) % 2 else 0.0
        angles = _sample_arc(-np.pi + offset, np.pi + offset, inner, depth, sizes)
        if len(angles) < 4:
            break
        rings.append(_circle(inner, angles))
    points = np.concatenate([*rings, np.zeros((1, 2))])
    return points, _triangles(points, points)


def _focused_disc(
    radius_m: float,
    half_support: float,
    sizes: _Sizes,
    focus: Focus,
    mirror_axes: tuple[int, ...],
) -> tuple[Floats, Ints]:
    """Return a mesh of the cross-section that is fine near the pushed point.

    half_support: half the angle (rad) of the arc on which the cylinder is fixed.
    focus: pushed point.
    mirror_axes: axes of the planes of symmetry. If 1 is among them, only the half with y >= 0 is
        returned.

    Returns the points (n, 2), m, and the triangles (t, 3). The mesh is symmetric about the diameter
    through the pushed point, except at the ends of the fixed arc. In an asymmetric mesh, the force
    on the finger would have a sideways component of a few percent.
    """
    near = focus.near_m / radius_m
    inner = [(r, _sample_arc(0.0, np.pi, r, depth, sizes)) for r, depth in _rings(radius_m, sizes)]
    radii = np.array([radius_m, *(r for r, _ in inner)])
    axis = np.concatenate([radii, -radii, [0.0]])
    points = [np.column_stack([0.0 * axis, axis])]
    triangles, count = [], len(axis)
    for side in (1.0,) if 1 in mirror_axes else (1.0, -1.0):
        ends = side * (np.pi + half_support * np.array([-1.0, 1.0]) - focus.angle_rad)
        ends = np.sort(ends % (2.0 * np.pi))
        stops = [0.0, near, *ends[(near < ends) & (ends < np.pi)], np.pi]
        rim = [_sample_arc(a, b, radius_m, 0.0, sizes) for a, b in itertools.pairwise(stops)]
        rings = [(radius_m, np.concatenate(rim)), *inner]
        off = np.concatenate([_circle(r * (1.0 + SPIRAL * p[1:]), p[1:]) for r, p in rings])
        # Triangulate points moved onto a spiral, where no four points are on a common circle. The
        # triangulation is then unique, and therefore the same in both halves.
        flat = np.column_stack([0.0 * axis, axis * np.where(axis < 0.0, 1.0 + SPIRAL * np.pi, 1.0)])
        number = np.append(np.arange(len(axis)), count + np.arange(len(off)))
        true = np.concatenate([_circle(np.full(len(p) - 1, r), p[1:]) for r, p in rings])
        found = number[_triangles(np.concatenate([points[0], true]), np.concatenate([flat, off]))]
        triangles.append(found if side > 0.0 else found[:, [0, 2, 1]])
        points.append(true * [side, 1.0])
        count += len(off)
    y, z = np.concatenate(points).T
    sine, cosine = np.sin(focus.angle_rad), np.cos(focus.angle_rad)
    return np.column_stack([y * cosine + z * sine, z * cosine - y * sine]), np.concatenate(
        triangles
    )


def _circle(radius: float | Floats, angles: Floats) -> Floats:
    """Return points (n, 2), as (y, z), on circles about the origin at angles (n,) from +z."""
    return np.column_stack([radius * np.sin(angles), radius * np.cos(angles)])


def _triangles(points: Floats, where: Floats) -> Ints:
    """Triangulate points, and return counter-clockwise triangles (t, 3) of point indices.

    points (n, 2): positions of the points, which determine the orientation and area of the
        triangles.
    where (n, 2): positions that are used for the Delaunay triangulation. They may differ slightly
        from `points`, so that the triangulation is unique.

    Triangles without area are omitted.
    """
    from scipy.spatial import Delaunay  # late: scipy is slow to import

    triangles = Delaunay(where).simplices.astype(np.int64)
    edges = points[triangles[:, 1:]] - points[triangles[:, :1]]
    area = edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0]
    triangles[area < 0] = triangles[area < 0][:, [0, 2, 1]]
    size = np.square(edges).sum(axis=(1, 2))
    sound: Ints = triangles[np.abs(area) > FLAT_RATIO * size]
    return sound


def _extrude(points: Floats, triangles: Ints, x: Floats, swapped: int) -> tuple[Floats, Ints]:
    """Extrude a cross-section, and return corner nodes (k, 3) and tetrahedra (e, 4).

    points (n, 2), triangles (t, 3): cross-section.
    x (s,): positions of the s cross-sections, m.
    swapped: index of a slice between two cross-sections.

    Each slice consists of prisms, which are divided into tetrahedra. In the slice `swapped` and in
    every second slice before and after it, the division is mirrored along x. Otherwise the mesh
    would be stiffer in some directions than in the mirrored directions.
    """
    count, slices = len(points), len(x) - 1
    corners = np.column_stack([np.repeat(x, count), np.tile(points, (len(x), 1))])
    low, middle, high = np.sort(triangles, axis=1).T
    tetrahedra = []
    for number in range(slices):
        near, far = number * count, (number + 1) * count
        if (number - swapped) % 2 == 0:
            near, far = far, near
        tetrahedra.append(
            np.concatenate(
                [
                    np.column_stack([low + near, middle + near, high + near, high + far]),
                    np.column_stack([low + near, middle + near, middle + far, high + far]),
                    np.column_stack([low + near, low + far, middle + far, high + far]),
                ]
            )
        )
    return corners, orient_tetrahedra(corners, np.concatenate(tetrahedra))
