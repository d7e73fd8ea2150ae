"""Build a flat, deflected or four-triangle mesh of the sheet for the two-pass correction."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, partial

import numpy as np
from numpy.typing import NDArray

from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.models.rigid import apply, inverse
from flexsheet.nodes.models.shapes.triangles import triangulate_grid
from flexsheet.nodes.models.sheet.indentation import IndentationBasis
from flexsheet.nodes.models.sheet.tension import compute_sag_m
from flexsheet.nodes.renderer.correction import GRAZING_SINE, MIN_PUSH_M
from flexsheet.nodes.renderer.sheet import SheetPose

Indices = NDArray[np.int32]

MAX_TRIANGLES_DEPTH_M = 0.0035
"""The maximum push depth (m) for a sheet mesh of four triangles. At this depth, the rms error of
the image is half a millimetre."""

HALVINGS = 5
PYRAMID = np.array([[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]], dtype=np.int32)
"""The vertex indices of the triangles between two corners (0 to 3) and the pushed point (4)."""


@dataclass(frozen=True, slots=True)
class SheetMesh:
    """A mesh of the sheet.

    vertices (n, 3): positions in the world frame, m. triangles (t, 3): vertex indices,
    counter-clockwise as seen by the user. note: reason why the shape is inaccurate; empty if the
    shape is accurate.
    """

    vertices: Floats
    triangles: Indices
    note: str = ""


def flat_mesh(sheet: SheetPose) -> SheetMesh:
    """Return the mesh of an undeflected sheet: four triangles between its corners and centre."""
    vertices = np.vstack([sheet.corners, sheet.corners.mean(axis=0)])
    return SheetMesh(vertices, PYRAMID)


def pyramid_mesh(sheet: SheetPose) -> SheetMesh:
    """Return the mesh of four triangles between the corners of the sheet and the pushed point.

    Source: Furukawa et al. 2007.
    """
    if sheet.pushed_point is None:
        return flat_mesh(sheet)
    return SheetMesh(np.vstack([sheet.corners, sheet.pushed_point]), PYRAMID)


def refine_mesh(mesh: SheetMesh) -> SheetMesh:
    """Halve the edges of a mesh `HALVINGS` times. The surface of the mesh does not change.

    The lens distortion is applied only at vertices, so a finer mesh is more accurate.
    """
    vertices, triangles = mesh.vertices, mesh.triangles
    for _ in range(HALVINGS):
        edges = np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
        unique, of_edge = np.unique(edges, axis=0, return_inverse=True)
        a, b, c = triangles.T
        ab, bc, ca = (of_edge.reshape(-1, 3) + len(vertices)).T
        vertices = np.vstack([vertices, vertices[unique].mean(axis=1)])
        triangles = np.vstack(
            [np.column_stack(corner) for corner in ((a, ab, ca), (b, bc, ab), (c, ca, bc))]
            + [np.column_stack([ab, bc, ca])]
        )
    return SheetMesh(vertices, triangles.astype(np.int32), mesh.note)


_grid_triangles = cache(triangulate_grid)
"""A variant of `triangulate_grid` that caches its results."""


def deflected_mesh(
    sheet: SheetPose, basis: IndentationBasis, *, density_kg_per_m3: float = 0.0
) -> SheetMesh:
    """Return the mesh of a sheet that is stretched, sags by its weight and is pushed by a finger.

    The deflection is the sum of the sag and the indentation of a flat sheet. It is added to the
    ruled surface between the edges. The depth of the indentation is the depth of the finger below
    the sagging sheet.
    """
    rubber = basis.rubber
    stretch = sheet.edge_distance_m / rubber.width_m
    x, y, depth_m = 0.0, 0.0, 0.0
    if sheet.pushed_point is not None:
        x, y, z = apply(inverse(sheet.world_from_sheet), sheet.pushed_point).tolist()
        depth_m = max(0.0, -z)
    position = (x, y)
    flat = basis.grid(stretch, position)
    sag_m = partial(
        compute_sag_m,
        rubber,
        sheet.world_from_sheet[:3, 2],
        density_kg_per_m3=density_kg_per_m3,
        edge_distance_m=sheet.edge_distance_m,
    )
    finger_across = float(np.clip(x / sheet.edge_distance_m + 0.5, 0.0, 1.0))
    indentation_m = depth_m + float(sag_m(across=finger_across, along=y / rubber.height_m))
    if sheet.pushed_point is None or indentation_m < MIN_PUSH_M:
        indentation_m = 0.0
    offsets = basis.offsets(stretch, position, indentation_m)
    rows, columns = flat.shape[:2]
    across = (flat[..., 0] / sheet.edge_distance_m + 0.5).ravel()
    up = (flat[..., 1] / rubber.height_m + 0.5).ravel()
    left_bottom, right_bottom, right_top, left_top = sheet.corners
    # The ruled surface between the edges is bilinear in `across` and `up`.
    edge_vectors = np.stack([right_bottom - left_bottom, left_top - left_bottom])
    twist = right_top - right_bottom - left_top + left_bottom
    offsets = offsets.reshape(-1, 3)
    offsets[:, 2] += sag_m(across=across, along=up - 0.5)
    vertices = offsets @ sheet.world_from_sheet[:3, :3].T
    vertices += np.stack([across, up, across * up], axis=1) @ np.vstack([edge_vectors, twist])
    vertices += left_bottom
    return SheetMesh(
        vertices,
        _grid_triangles(rows, columns),
        basis.invalid_reason(stretch, position, indentation_m),
    )


def occluded_fraction(mesh: SheetMesh, eye: Floats, projector: Floats) -> float:
    """Estimate the fraction (0 to 1) of the visible sheet that gets no light because of folds.

    A triangle gets no light if it faces away from the projector, or if the projector sees it
    edge-on. The area of an unlit triangle counts twice, because it casts a shadow of about the same
    area on the sheet.

    eye, projector (3,): positions, world frame, m.
    """
    # One array for each coordinate is several times faster than an array of points.
    coordinates = np.ascontiguousarray(mesh.vertices.T)
    a, b, c = (coordinates.take(mesh.triangles[:, i], axis=1) for i in range(3))
    b -= a
    c -= a
    x = b[1] * c[2] - b[2] * c[1]
    y = b[2] * c[0] - b[0] * c[2]
    z = b[0] * c[1] - b[1] * c[0]
    light = (a[0] - projector[0]) * x + (a[1] - projector[1]) * y + (a[2] - projector[2]) * z
    rays = a - projector[:, None]
    lengths = np.sqrt((x * x + y * y + z * z) * (rays * rays).sum(axis=0))
    unlit = light <= GRAZING_SINE * lengths
    if not unlit.any():
        return 0.0
    to_eye = eye[:, None] - a
    seen = np.abs(to_eye[0] * x + to_eye[1] * y + to_eye[2] * z) / (to_eye**2).sum(axis=0) ** 1.5
    shadow = 2.0 * float(seen[unlit].sum())
    return min(1.0, shadow / max(float(seen.sum()), 1e-12))
