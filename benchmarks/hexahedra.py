"""Mesh a half, quarter or whole cylinder with 27-node hexahedra that are fine near one push.

The independent force reference uses the meshes; they share no code with the package's own meshes.
The frame has x along the axis and z away from the support.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

TOP_RAD = 1.7
"""Half the angle of the arc, centred on +z, that is one of four sides of a meshed cross-section."""
SIZE, NEAR = 0.17, 0.36
"""The element size near the push, and the radius of the region with elements of this size.

Lengths are in finger radii at a scale of 1.
"""
GROWTH, MAX_SIZE_RATIO = 0.35, 0.3
"""The increase of the element size per distance from the push, and the maximum element size.

The maximum element size is a fraction of the radius of the cylinder, at a scale of 1.
"""
DEPTH_RATIO = 1.3
"""The ratio of the element size along the depth to that along the skin."""
OFFSETS = np.array(
    [(x, y, z) for z in (-1, 1) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    + [(x, y, z) for z in (-1, 1) for x, y in ((0, -1), (1, 0), (0, 1), (-1, 0))]
    + [(x, y, 0) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1), (-1, 0), (1, 0), (0, -1), (0, 1))]
    + [(0, 0, -1), (0, 0, 1), (0, 0, 0)]
)
"""The local coordinates (27, 3) of the nodes of a hexahedron, in the order of VTK."""


@dataclass(frozen=True, slots=True)
class HexMesh:
    """A mesh of a cylinder, reduced by its planes of symmetry.

    points (n, 3): nodes. cells (e, 27): hexahedra. held (n, 3): degrees of freedom that the support
    or a plane of symmetry holds. faces (f, 3, 3): nine-node faces of the touchable side. copies:
    number of mirror images that make up the whole cylinder.
    """

    points: Floats
    cells: Ints
    held: NDArray[np.bool_]
    faces: Ints
    copies: int


def grade(ends: tuple[float, float], focus: float, size: float, scale: float, cap: float) -> Floats:
    """Return coordinates between two ends whose spacing grows with the distance from `focus`.

    size: spacing near the focus. cap: maximum spacing. One coordinate is the focus if it is
    not near an end.
    """
    inner = [focus] if ends[0] + 0.5 * size < focus < ends[1] - 0.5 * size else []
    stations = [np.array([ends[0]])]
    for low, high in itertools.pairwise([ends[0], *inner, ends[1]]):
        fine = np.linspace(low, high, 4001)
        away = np.maximum(np.abs(fine - focus) - NEAR, 0.0)
        density = 1.0 / np.minimum(size + scale * GROWTH * away, max(cap, size))
        steps = 0.5 * (density[1:] + density[:-1]) * np.diff(fine)
        total = np.append(0.0, np.cumsum(steps))
        count = int(np.ceil(total[-1]))
        stations.append(np.interp(np.arange(1, count + 1) * total[-1] / count, total, fine))
    return np.concatenate(stations)


def map_section(radius: float, half_support_rad: float, across: Floats, up: Floats) -> Floats:
    """Return points (..., 2), as (y, z), of the cross-section for coordinates of a square.

    across: -1 to 1 from left to right. up: 0 at the support to 1 at the top. The map blends the
    four arcs that bound the section (transfinite interpolation, Gordon & Hall 1973).
    """

    def arc(angle: Floats) -> Floats:
        return radius * np.stack([np.sin(angle), np.cos(angle)], axis=-1)

    bottom, top = np.pi - half_support_rad, TOP_RAD
    right = (0.5 * (across + 1.0))[..., None]
    high = up[..., None]
    side = bottom + up * (top - bottom)
    corners = [arc(np.full_like(up, angle)) for angle in (-bottom, bottom, -top, top)]
    return np.asarray(
        (1 - high) * arc(np.pi - half_support_rad * across)
        + high * arc(top * across)
        + (1 - right) * arc(-side)
        + right * arc(side)
        - (1 - high) * ((1 - right) * corners[0] + right * corners[1])
        - high * ((1 - right) * corners[2] + right * corners[3])
    )


def cylinder_hexahedra(
    *,
    radius: float,
    length: float,
    support_angle_rad: float,
    along: float,
    angle_rad: float,
    scale: float,
) -> HexMesh:
    """Return the mesh for a push at `along` on the axis and `angle_rad` from the top.

    Lengths are in finger radii. scale: factor of all element sizes.
    """
    size, cap = scale * SIZE, scale * MAX_SIZE_RATIO * radius
    mirrored_x, mirrored_y = along == 0.0, angle_rad == 0.0
    x = grade((0.0 if mirrored_x else -0.5 * length, 0.5 * length), along, size, scale, cap)
    arc = radius * TOP_RAD
    a = grade((0.0 if mirrored_y else -arc, arc), radius * angle_rad, size, scale, cap)
    column = np.linspace(1.0, 0.0, 2001)
    drawn = map_section(radius, 0.5 * support_angle_rad, np.full(2001, angle_rad / TOP_RAD), column)
    depth = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(drawn, axis=0), axis=1)))
    down = grade((0.0, depth[-1]), 0.0, DEPTH_RATIO * size, scale, cap)
    up = np.interp(down, depth, column)[::-1]
    grids = [_with_middles(one) for one in (x, a / arc, up)]
    counts = [len(one) for one in grids]
    across, height = np.meshgrid(grids[1], grids[2], indexing="ij")
    section = map_section(radius, 0.5 * support_angle_rad, across, height)
    points = np.empty((*counts, 3))
    points[..., 0] = grids[0][:, None, None]
    points[..., 1:] = section
    numbers = np.arange(np.prod(counts)).reshape(counts)
    middles = np.stack(
        np.meshgrid(*(np.arange(1, count, 2) for count in counts), indexing="ij"), axis=-1
    ).reshape(-1, 1, 3)
    picked = np.moveaxis(middles + OFFSETS, -1, 0)
    held = np.zeros((*counts, 3), dtype=bool)
    held[:, :, 0] = True
    if mirrored_x:
        held[0, :, :, 0] = True
    if mirrored_y:
        held[:, 0, :, 1] = True
    top = numbers[:, :, -1]
    faces = np.array(
        [
            top[i : i + 3, j : j + 3]
            for i in range(0, counts[0] - 2, 2)
            for j in range(0, counts[1] - 2, 2)
        ]
    )
    return HexMesh(
        points=points.reshape(-1, 3),
        cells=numbers[tuple(picked)],
        held=held.reshape(-1, 3),
        faces=faces,
        copies=(2 if mirrored_x else 1) * (2 if mirrored_y else 1),
    )


def _with_middles(stations: Floats) -> Floats:
    result = np.empty(2 * len(stations) - 1)
    result[::2], result[1::2] = stations, 0.5 * (stations[1:] + stations[:-1])
    return result
