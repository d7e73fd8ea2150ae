"""Ways to a mesh's normal as a method family: how long a query takes, how far off the normal is.

Judged on an ellipsoid of a liver's size whose normals are known, meshed at several densities.  The
tolerance is the tilt that moves the end of the sheet's usable height by the scene's tolerance of
the sheet's position.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray

from messages.scene import Scene
from nodes.methods import Case, Family, Trial
from nodes.models.shapes import EllipsoidShape, SmoothMeshShape
from nodes.models.shapes.smooth_mesh import usual_smoothing_m
from nodes.models.shapes.triangles import Facets, half_edges, triangle_normals, vertex_normals

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]
NormalAt = Callable[[Floats], Floats]
"""Points (n, 3) to the unit normals (n, 3) of the surface points nearest to them."""

SEMI_AXES_M = (0.05, 0.03, 0.02)
SUBDIVISIONS = (2, 3, 4)
QUERIES, HEIGHT_RATIO = 400, 1.05
FINE_ENOUGH = 0.35
"""Jets are for meshes whose usual edge is under this share of the tightest radius of curvature."""


def ellipsoid_mesh(subdivisions: int) -> tuple[Floats, Indices]:
    """Vertices (v, 3) on the ellipsoid, and triangles (t, 3): a stretched icosahedron's."""
    # Late: only charts need it.
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=subdivisions, radius=1.0)
    return np.asarray(ball.vertices) * SEMI_AXES_M, np.asarray(ball.faces, dtype=np.int64)


def facet_normals(vertices: Floats, triangles: Indices) -> NormalAt:
    """The normal of the nearest triangle."""
    facets, normals = Facets(vertices, triangles), triangle_normals(vertices, triangles)
    return lambda points: np.asarray(normals[facets.nearest(points)[0]])


def blended_normals(vertices: Floats, triangles: Indices) -> NormalAt:
    """The vertices' normals, interpolated at the nearest point of the facets (Phong 1975)."""
    facets, normals = Facets(vertices, triangles), vertex_normals(vertices, triangles)

    def normal_at(points: Floats) -> Floats:
        triangle, weights = facets.nearest(points)
        blend = (weights[:, None] @ normals[triangles[triangle]])[:, 0]
        return np.asarray(blend / np.linalg.norm(blend, axis=1, keepdims=True))

    return normal_at


def jet_normals(vertices: Floats, triangles: Indices) -> NormalAt:
    """Those of `SmoothMeshShape`, each query by itself."""
    shape = SmoothMeshShape(vertices, triangles, usual_smoothing_m(vertices, triangles))
    return lambda points: shape.closest(points).normal


def followed_jet_normals(vertices: Floats, triangles: Indices) -> NormalAt:
    """Those of `SmoothMeshShape`, on from where it was a third of a millimetre ago."""
    shape = SmoothMeshShape(vertices, triangles, usual_smoothing_m(vertices, triangles))
    earlier: dict[bytes, Floats] = {}

    def normal_at(points: Floats) -> Floats:
        key = points.tobytes()
        if key not in earlier:
            earlier[key] = shape.closest(points + 2e-4).point
        return shape.closest(points, previous=earlier[key]).normal

    return normal_at


METHODS: dict[str, Callable[[Floats, Indices], NormalAt]] = {
    "facets": facet_normals,
    "blended": blended_normals,
    "jets": jet_normals,
    "jets_followed": followed_jet_normals,
}


def mesh_normal_trials(scene: Scene) -> Iterator[Trial]:
    """Every method at every density."""
    known = EllipsoidShape(SEMI_AXES_M)
    directions = np.random.default_rng(0).normal(size=(QUERIES, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    queries = HEIGHT_RATIO * directions * SEMI_AXES_M
    wanted = known.closest(queries).normal
    tightest_m = min(SEMI_AXES_M) ** 2 / max(SEMI_AXES_M)
    for subdivisions in SUBDIVISIONS:
        vertices, triangles = ellipsoid_mesh(subdivisions)
        run = half_edges(triangles)
        edge_m = np.median(np.linalg.norm(vertices[run[:, 0]] - vertices[run[:, 1]], axis=1))
        fine = bool(edge_m < FINE_ENOUGH * tightest_m)
        case: Case = {"triangles": len(triangles)}
        for name, method in METHODS.items():
            # Only jets give a normal whose rate does not jump, whatever its error.
            in_range = fine and name.startswith("jets")
            yield _trial(
                name, method(vertices, triangles), queries, wanted, case=case, in_range=in_range
            )


def _trial(
    name: str,
    normal_at: NormalAt,
    queries: Floats,
    wanted: Floats,
    *,
    case: Case,
    in_range: bool,
) -> Trial:
    """Timed is one query, judged are all."""

    def error_deg(_: Floats) -> float:
        apart = np.linalg.norm(normal_at(queries) - wanted, axis=1)
        return float(np.degrees(2.0 * np.arcsin(0.5 * apart.max())))

    return Trial(name, case, lambda: normal_at(queries[:1]), error_deg, in_range)


MESH_NORMAL = Family(
    name="mesh-normal",
    unit="deg",
    reference="an ellipsoid's known normals, the worst of 400",
    methods=tuple(METHODS),
    trials=mesh_normal_trials,
    tolerance=lambda scene: float(
        np.degrees(scene.tolerances.sheet_position_m / scene.sheet.usable_half_height_m)
    ),
)
