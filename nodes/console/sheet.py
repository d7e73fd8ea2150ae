"""The sheet as the page draws it: ruled between its edges, dented by the finger.

The dent is that of a soap film, good to look at; what the sheet truly does is the business of
`flexsheet.nodes.models.sheet`.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from flexsheet.nodes.models.rigid import apply, inverse
from flexsheet.nodes.models.sheet import corners, sheet_from_edges

Floats = NDArray[np.float64]
Indices = NDArray[np.int32]

COLUMNS, ROWS = 41, 41
LEAST_EDGE_DISTANCE_M = 0.05
NEAR = 6
"""Cells along each side around a vertex that are searched for where a ray goes through."""

MIRRORED = 2
"""Images of the finger in each free edge."""


def sheet_points(
    world_from_left_edge: Floats,
    world_from_right_edge: Floats,
    *,
    height_m: float,
    fingertip: Floats | None,
    finger_radius_m: float,
) -> Floats | None:
    """Vertices (ROWS * COLUMNS, 3) in the world, rows from bottom to top, columns left to right.

    fingertip: (3,), or None.  None where the edges are too near to one another to hold a sheet.
    """
    left, right = world_from_left_edge, world_from_right_edge
    width_m = float(np.linalg.norm(right[:3, 3] - left[:3, 3]))
    if not width_m >= LEAST_EDGE_DISTANCE_M:
        return None
    left_bottom, right_bottom, right_top, left_top = corners(left, right, height_m)
    across, up = _shares()
    flat = (1.0 - across) * ((1.0 - up) * left_bottom + up * left_top) + across * (
        (1.0 - up) * right_bottom + up * right_top
    )
    if fingertip is not None:
        world_from_sheet = sheet_from_edges(left, right)
        x, y, z = apply(inverse(world_from_sheet), fingertip).tolist()
        if z < 0.0 and abs(x) < 0.49 * width_m and abs(y) < 0.5 * height_m:
            grid = (across[:, 0] - 0.5) * width_m, (up[:, 0] - 0.5) * height_m
            dent = film(*grid, (x, y), (width_m, height_m), finger_radius_m)
            flat = flat + z * dent[:, None] * world_from_sheet[:3, 2]
    return np.asarray(flat)


def film(
    x: Floats, y: Floats, finger: tuple[float, float], size_m: tuple[float, float], radius_m: float
) -> Floats:
    """Share (n,) of the finger's depth at places x, y (n,) of a film held at x = +-width / 2.

    The film solves Laplace's equation with a point force in an infinite strip (the conformal map of
    the strip gives its Green's function in closed form); free edges at y = +-height / 2 are made by
    mirroring the finger in them.  Within `radius_m` of the finger it is as deep as the finger.
    """
    width_m, height_m = size_m
    finger_x, finger_y = finger
    rates = np.pi / width_m
    total, peak = np.zeros_like(x), 0.0
    for k in range(-MIRRORED, MIRRORED + 1):
        mirrored_y = k * height_m + (finger_y if k % 2 == 0 else -finger_y)
        total = total + _strip(rates * x, rates * (y - mirrored_y), rates * finger_x)
        at_rim = rates * (finger_y - mirrored_y)
        rim = np.hypot(at_rim, rates * radius_m)
        peak += float(_strip(np.array([rates * finger_x]), np.array([rim]), rates * finger_x)[0])
    return np.minimum(total / peak, 1.0)


def _strip(x: Floats, y: Floats, source_x: float) -> Floats:
    """Green's function of Laplace in |x| < pi / 2, source at (source_x, 0), but for a factor."""
    high = np.cosh(np.minimum(np.abs(y), 30.0))
    near = np.maximum(high - np.cos(x - source_x), 1e-12)
    return np.asarray(np.log(np.maximum(high + np.cos(x + source_x), near) / near))


@lru_cache(maxsize=1)
def _shares() -> tuple[Floats, Floats]:
    """How far along the width and the height (n, 1) each vertex is, 0 to 1."""
    up, across = np.meshgrid(np.linspace(0, 1, ROWS), np.linspace(0, 1, COLUMNS), indexing="ij")
    return across.reshape(-1, 1), up.reshape(-1, 1)


@lru_cache(maxsize=1)
def sheet_triangles() -> Indices:
    """(2 * (ROWS - 1) * (COLUMNS - 1), 3), counter-clockwise for the user."""
    index = np.arange(ROWS * COLUMNS, dtype=np.int32).reshape(ROWS, COLUMNS)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    lower, upper = np.stack([a, b, c], axis=-1), np.stack([a, c, d], axis=-1)
    return np.concatenate([lower.reshape(-1, 3), upper.reshape(-1, 3)])


def hit_by_ray(points: Floats, origin: Floats, towards: Floats) -> Floats:
    """Where rays from `origin` (3,) towards `towards` (n, 3) meet the sheet's mesh; NaN: nowhere.

    points: of `sheet_points`.  Moeller and Trumbore (1997) with the triangles around the vertex
    that is nearest to the ray as seen from its origin.
    """
    direction = towards - origin
    seen = points - origin
    seen = seen / np.maximum(np.linalg.norm(seen, axis=1, keepdims=True), 1e-12)
    nearest = np.argmax(direction @ seen.T, axis=1)
    triangles = sheet_triangles()[_around(nearest)]
    a, b, c = (points[triangles[..., i]] for i in range(3))
    first, second, along = b - a, c - a, direction[:, None, :]
    across, away = np.cross(along, second), np.cross(origin - a, first)
    determinant = (first * across).sum(axis=2)
    with np.errstate(divide="ignore", invalid="ignore"):
        u = ((origin - a) * across).sum(axis=2) / determinant
        v = (along * away).sum(axis=2) / determinant
        length = (second * away).sum(axis=2) / determinant
    inside = (u >= -1e-9) & (v >= -1e-9) & (u + v <= 1.0 + 1e-9) & (length > 0.0)
    length = np.where(inside, length, np.inf).min(axis=1)
    length[~np.isfinite(length)] = np.nan
    return np.asarray(origin + length[:, None] * direction)


def _around(vertices: NDArray[np.int64]) -> NDArray[np.int64]:
    """Indices (n, 2 * NEAR**2) of the triangles in the cells around vertices (n,)."""
    rows, columns = np.divmod(vertices, COLUMNS)
    cells = np.arange(-NEAR // 2, NEAR - NEAR // 2)
    row = np.clip(rows[:, None, None] + cells[None, :, None], 0, ROWS - 2)
    column = np.clip(columns[:, None, None] + cells[None, None, :], 0, COLUMNS - 2)
    cell = (row * (COLUMNS - 1) + column).reshape(len(vertices), -1)
    return np.concatenate([cell, cell + (ROWS - 1) * (COLUMNS - 1)], axis=1)
