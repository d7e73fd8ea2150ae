"""Compute the shape of the drawn sheet: a ruled surface that the finger deflects like a soap film.

This deflection is for display only. The module `flexsheet.nodes.models.sheet` contains the
mechanics of the sheet.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.models.rigid import apply, inverse
from flexsheet.nodes.models.shapes.triangles import triangulate_grid
from flexsheet.nodes.models.sheet import corners, sheet_from_edges

COLUMNS, ROWS = 41, 41
TRIANGLES = triangulate_grid(ROWS, COLUMNS)
"""The t triangles (t, 3) of the sheet's grid, which are counter-clockwise as seen by the user."""
MIN_EDGE_DISTANCE_M = 0.05
MIRRORED = 2
"""The number of mirror images of the finger beyond each free edge."""


def compute_sheet_points(
    world_from_left_edge: Floats,
    world_from_right_edge: Floats,
    *,
    height_m: float,
    fingertip: Floats | None,
    finger_radius_m: float,
) -> Floats | None:
    """Compute the world positions (ROWS * COLUMNS, 3), in m, of the drawn sheet's vertices.

    world_from_left_edge, world_from_right_edge: poses (4, 4) of the sheet's edges.
    fingertip: position (3,) in the world frame, m; None if it is unknown.

    Rows are ordered upwards, and columns to the right. Returns None if the distance between the
    edges is less than `MIN_EDGE_DISTANCE_M`.
    """
    left, right = world_from_left_edge, world_from_right_edge
    width_m = float(np.linalg.norm(right[:3, 3] - left[:3, 3]))
    if not width_m >= MIN_EDGE_DISTANCE_M:
        return None
    left_bottom, right_bottom, right_top, left_top = corners(left, right, height_m)
    across, up = _fractions()
    flat = (1.0 - across) * ((1.0 - up) * left_bottom + up * left_top) + across * (
        (1.0 - up) * right_bottom + up * right_top
    )
    if fingertip is not None:
        world_from_sheet = sheet_from_edges(left, right)
        x, y, z = apply(inverse(world_from_sheet), fingertip).tolist()
        if z < 0.0 and abs(x) < 0.49 * width_m and abs(y) < 0.5 * height_m:
            grid = (across[:, 0] - 0.5) * width_m, (up[:, 0] - 0.5) * height_m
            deflection = film(*grid, (x, y), (width_m, height_m), finger_radius_m)
            flat = flat + z * deflection[:, None] * world_from_sheet[:3, 2]
    return np.asarray(flat)


def film(
    x: Floats, y: Floats, finger: tuple[float, float], size_m: tuple[float, float], radius_m: float
) -> Floats:
    """Return the deflection of a film that a finger pushes, divided by the depth of the finger.

    x, y: coordinates (n,) of the points at which the deflection is computed, m.
    finger: position (x, y) of the finger, m.
    size_m: width and height of the film, which is clamped at x = +-width / 2.
    radius_m: radius of the finger. Within this distance of the finger, the result is 1.

    The result has the shape (n,). The deflection solves Laplace's equation for a point force in an
    infinite strip. The Green's function of this problem follows from a conformal map. The free
    edges at y = +-height / 2 are represented by mirror images of the finger.
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
    """Compute Green's function (n,) of Laplace's equation in the strip |x| < pi / 2.

    x, y: coordinates (n,) of n points.

    The source is at (source_x, 0). The function is 0 at both edges, and not normalized.
    """
    high = np.cosh(np.minimum(np.abs(y), 30.0))
    near = np.maximum(high - np.cos(x - source_x), 1e-12)
    return np.asarray(np.log(np.maximum(high + np.cos(x + source_x), near) / near))


@lru_cache(maxsize=1)
def _fractions() -> tuple[Floats, Floats]:
    """Return the n vertices' positions as fractions of width and height: two arrays (n, 1)."""
    up, across = np.meshgrid(np.linspace(0, 1, ROWS), np.linspace(0, 1, COLUMNS), indexing="ij")
    return across.reshape(-1, 1), up.reshape(-1, 1)
