"""Quadratic tetrahedra of a solid cylinder, graded towards the side that fingers touch.

The mesh frame has the cylinder's axis along x, its middle in the origin, and z away from the
support.  A cross-section is triangulated once (rings of points, Delaunay), extruded along x to
prisms, and each prism split into three tetrahedra by the order of its vertices' numbers, so that
neighbours agree on the diagonal (Dompierre et al., "How to subdivide pyramids, prisms and hexahedra
into tetrahedra", 1999).  Elements have 10 nodes; the edges on the curved side are curved: their
middle nodes lie on the true cylinder (isoparametric), all other edges are straight.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nodes.fem_solver.mesh.solid import EDGES, SUBTRIANGLES, SolidMesh, boundary_faces

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

BACK_COARSENING = 2.0
DEPTH_GROWTH = 0.35
"""Elements grow by this much per length of depth below the side."""
RAMP_RAD = 0.6


def cylinder_mesh(
    *,
    radius_m: float,
    length_m: float,
    support_angle_rad: float,
    touch_angle_rad: float,
    skin_spacing_m: float,
) -> SolidMesh:
    """The solid cylinder, its skin nodes `skin_spacing_m` apart within `touch_angle_rad` of +z.

    support_angle_rad: full angle of the fixed strip about -z; touch_angle_rad: half angle about +z
    that fingers can load.  Farther back, elements grow to twice the size; inwards, likewise.
    Raises ValueError where no sound mesh results: spacing too coarse for the radius, support all
    around, touchable part reaching into the support.
    """
    half_support = 0.5 * support_angle_rad
    if not 0.0 < half_support < np.pi:
        raise ValueError(
            f"object.support_angle_rad: {support_angle_rad:g} must lie between 0 and 2 pi"
        )
    if touch_angle_rad <= 0.0 or touch_angle_rad > np.pi - half_support + 1e-9:
        raise ValueError(
            f"touchable half angle {touch_angle_rad:g} rad must be positive and stay clear of the "
            f"support, which begins at {np.pi - half_support:g} rad"
        )
    if not 0.0 < skin_spacing_m <= 0.25 * min(radius_m, length_m):
        raise ValueError(
            f"skin_spacing_m: {skin_spacing_m:g} must be positive and at most a quarter of radius "
            f"({radius_m:g} m) and length ({length_m:g} m)"
        )
    element_m = 2.0 * skin_spacing_m
    points, triangles = _disc(radius_m, half_support, touch_angle_rad, element_m)
    slices = max(2, round(length_m / element_m))
    corners, tetrahedra = _extrude(points, triangles, length_m, slices)
    layer = np.repeat(np.arange(slices + 1), len(points))
    return _with_midnodes(
        corners,
        tetrahedra,
        layer,
        radius_m=radius_m,
        length_m=length_m,
        half_support=half_support,
        touch_angle=touch_angle_rad,
    )


def _size(angle: Floats, touch_angle: float, element_m: float) -> Floats:
    """Wanted edge length at an angle from +z (rad, either sign)."""
    behind = np.clip((np.abs(angle) - touch_angle) / RAMP_RAD, 0.0, 1.0)
    return element_m * (1.0 + (BACK_COARSENING - 1.0) * behind)


def _arc(start: float, stop: float, radius: float, size: tuple[float, float, float]) -> Floats:
    """Angles from `start` (included) to `stop` (not), spaced as `size` asks.

    size: touchable half angle, element length on the side, depth of this ring below it.
    """
    touch_angle, element_m, depth = size
    fine = np.linspace(start, stop, 2001)
    wrapped = (fine + np.pi) % (2 * np.pi) - np.pi
    density = radius / (_size(wrapped, touch_angle, element_m) + DEPTH_GROWTH * depth)
    total = np.concatenate([[0.0], np.cumsum(0.5 * (density[1:] + density[:-1]) * np.diff(fine))])
    pieces = max(2, round(float(total[-1])))
    angles: Floats = np.interp(np.arange(pieces) * total[-1] / pieces, total, fine)
    return angles


def _disc(
    radius_m: float, half_support: float, touch_angle: float, element_m: float
) -> tuple[Floats, Ints]:
    """Points (y, z) of the cross-section and its triangles, counter-clockwise seen from +x.

    Points on the rim come first, with one on each end of the support.
    """
    from scipy.spatial import Delaunay  # late, as all of scipy: the process must start quickly

    free = np.pi - half_support
    size = (touch_angle, element_m, 0.0)
    rim = np.concatenate(
        [
            _arc(-free, free, radius_m, size),
            _arc(free, 2 * np.pi - free, radius_m, size),
        ]
    )
    rings = [radius_m * np.column_stack([np.sin(rim), np.cos(rim)])]
    depth, step = 0.0, element_m
    while True:
        depth += 0.85 * step
        step = element_m + DEPTH_GROWTH * depth
        inner = radius_m - depth
        if inner < 0.6 * step:
            break
        offset = 0.5 * step / inner if len(rings) % 2 else 0.0
        angles = _arc(-np.pi + offset, np.pi + offset, inner, (touch_angle, element_m, depth))
        if len(angles) < 4:
            break
        rings.append(inner * np.column_stack([np.sin(angles), np.cos(angles)]))
    rings.append(np.zeros((1, 2)))
    points = np.concatenate(rings)
    triangles = Delaunay(points).simplices.astype(np.int64)
    edges = points[triangles[:, 1:]] - points[triangles[:, :1]]
    area = edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0]
    triangles[area < 0] = triangles[area < 0][:, [0, 2, 1]]
    return points, triangles


def _extrude(points: Floats, triangles: Ints, length_m: float, slices: int) -> tuple[Floats, Ints]:
    """Corner nodes (k, 3) and tetrahedra (e, 4) of the extruded cross-section, slice by slice.

    The diagonals lean to the other side in every second slice, lest the whole solid lean.
    """
    count = len(points)
    x = np.linspace(-0.5 * length_m, 0.5 * length_m, slices + 1)
    corners = np.column_stack([np.repeat(x, count), np.tile(points, (slices + 1, 1))])
    low, middle, high = np.sort(triangles, axis=1).T
    tetrahedra = []
    for number in range(slices):
        near, far = number * count, (number + 1) * count
        if number % 2:
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
    elements = np.concatenate(tetrahedra)
    sides = corners[elements[:, 1:]] - corners[elements[:, :1]]
    negative = np.linalg.det(sides) < 0
    elements[negative] = elements[negative][:, [0, 2, 1, 3]]
    return corners, elements


def _with_midnodes(
    corners: Floats,
    tetrahedra: Ints,
    layer: Ints,
    *,
    radius_m: float,
    length_m: float,
    half_support: float,
    touch_angle: float,
) -> SolidMesh:
    """Add the edge middles, bend the side's edges onto the cylinder, name the parts of the skin."""
    pairs = np.sort(tetrahedra[:, EDGES], axis=2).reshape(-1, 2)
    unique, inverse = np.unique(pairs, axis=0, return_inverse=True)
    middles = inverse.reshape(-1, 6) + len(corners)
    elements = np.concatenate([tetrahedra, middles], axis=1)
    nodes = np.concatenate([corners, 0.5 * (corners[unique[:, 0]] + corners[unique[:, 1]])])
    level = np.concatenate([2 * layer, layer[unique[:, 0]] + layer[unique[:, 1]]])

    faces = boundary_faces(elements)
    on_cap = np.abs(np.abs(nodes[:, 0]) - 0.5 * length_m) < 1e-9 * length_m
    side = faces[~on_cap[faces[:, :3]].all(axis=1)]
    rim = np.unique(side)
    nodes[rim, 1:] *= (radius_m / np.hypot(nodes[rim, 1], nodes[rim, 2]))[:, None]

    angle = np.arctan2(nodes[:, 1], nodes[:, 2])
    order = np.lexsort((angle, nodes[:, 0], level))
    new = np.empty(len(nodes), dtype=np.int64)
    new[order] = np.arange(len(nodes))
    nodes, angle, level = nodes[order], angle[order], level[order]
    elements, faces, side, rim = new[elements], new[faces], new[side], np.sort(new[rim])

    fixed = np.zeros(len(nodes), dtype=bool)
    fixed[rim] = np.abs(angle[rim]) >= np.pi - half_support - 1e-9
    skin = np.unique(faces)
    touchable = np.zeros(len(nodes), dtype=bool)
    touchable[rim] = np.abs(angle[rim]) <= touch_angle + 1e-9
    touchable &= ~fixed
    touch_faces = side[touchable[side].all(axis=1)]
    touch = np.unique(touch_faces)
    normals = nodes[touch] / radius_m
    normals[:, 0] = 0.0
    return SolidMesh(
        nodes=nodes,
        elements=elements,
        slab=level // 2,
        fixed=fixed,
        skin=skin,
        skin_triangles=np.searchsorted(skin, faces[:, SUBTRIANGLES].reshape(-1, 3)).astype(
            np.int32
        ),
        touch=touch,
        touch_normals=normals,
        touch_faces=np.searchsorted(touch, touch_faces),
    )
