"""Measure the query time of shapes, and the smoothness of a mesh for rolling.

OPENBLAS_NUM_THREADS=1 python -m benchmarks.shapes [MESH METRES_PER_UNIT]

Prints the time of a query for every shape, without and with the previous point. For a mesh
(default: an ellipsoid's) with several smoothing lengths, it prints the distance to the mesh, the
fraction of the area that is an edge, and the maximum second derivative of the normal along
geodesics. The latter is compared with facets and with interpolated vertex normals. Takes under two
minutes.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.planner_methods import ellipsoid_mesh
from flexsheet.launch.objects.meshes import read_mesh
from flexsheet.nodes.models.shapes import Shape, SmoothMeshShape, make_shape
from flexsheet.nodes.models.shapes.smooth_mesh import default_smoothing_m
from flexsheet.nodes.models.shapes.triangles import triangle_normals, vertex_normals
from tests.facets import Facets

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]
Bools = NDArray[np.bool_]

SOLIDS = (
    {"shape": "cylinder", "radius_m": 0.035, "length_m": 0.12},
    {"shape": "sphere", "radius_m": 0.03},
    {"shape": "plane", "width_m": 0.2, "height_m": 0.2},
    {"shape": "ellipsoid", "semi_axes_m": (0.05, 0.03, 0.02)},
    {"shape": "rounded_box", "size_m": (0.1, 0.06, 0.04), "edge_radius_m": 0.005},
)
QUERIES, REPEATS = 200, 5
MOVED_M = 3e-4
"""The motion of a finger at 20 mm/s between two images at 60 Hz."""
EDGES = (1.25, 1.75, 2.5, 3.5)
STEPS_M = (4e-4, 1e-4)
WAYS, WAY_M = 8, 0.06


def microseconds(ask: Callable[[int], object]) -> str:
    """Return the median and 99th percentile of query times (minimum of repeats) as text, us."""
    best = np.empty(QUERIES)
    for i in range(QUERIES):
        took = []
        for _ in range(REPEATS):
            start = time.perf_counter()
            ask(i)
            took.append(time.perf_counter() - start)
        best[i] = min(took)
    return f"{1e6 * np.median(best):4.0f} / {1e6 * np.quantile(best, 0.99):4.0f} µs"


def time_queries(name: str, shape: Shape) -> None:
    """Time queries within 10 mm of the surface, on both sides."""
    rng = np.random.default_rng(0)
    base = shape.closest(rng.uniform(-0.05, 0.05, (QUERIES, 3)))
    near = base.point + rng.uniform(-0.01, 0.01, (QUERIES, 1)) * base.normal
    before = shape.closest(near + MOVED_M / np.sqrt(3.0)).point
    first = microseconds(lambda i: shape.closest(near[i]))
    following = microseconds(lambda i: shape.closest(near[i], previous=before[i]))
    print(f"{name:12}  first {first}   next {following}", flush=True)


def walk(shape: SmoothMeshShape, start: Floats, step_m: float) -> tuple[Floats, Floats, Bools]:
    """Return points, normals and edge flags along a geodesic."""
    here = shape.closest(start)
    point, normal = here.point, here.normal
    heading = np.cross(normal, [0.36, 0.48, 0.8])
    way = []
    for _ in range(int(WAY_M / step_m)):
        heading = heading - normal * (normal @ heading)
        heading /= np.linalg.norm(heading)
        found = shape.closest(point + step_m * heading, previous=point)
        point, normal = found.point, found.normal
        way.append((point, normal, found.on_edge))
    points, normals, edges = (np.array(part) for part in zip(*way, strict=True))
    return points, normals, edges


def second_derivative(normals: Floats, edges: Bools, step_m: float) -> float:
    off = ~(edges[2:] | edges[1:-1] | edges[:-2])
    return float((np.linalg.norm(np.diff(normals, 2, axis=0), axis=1) / step_m**2)[off].max())


def evaluate_mesh(vertices: Floats, triangles: Indices) -> None:
    edge_m = default_smoothing_m(vertices, triangles) / 1.75
    facets = Facets(vertices, triangles)
    flat, rough = triangle_normals(vertices, triangles), vertex_normals(vertices, triangles)
    corners = vertices[triangles]
    area = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    print(f"mesh of {len(triangles)} triangles, usual edge {1e3 * edge_m:.2f} mm")
    for ratio in EDGES:
        started = time.perf_counter()
        shape = SmoothMeshShape(vertices, triangles, ratio * edge_m)
        built_s = time.perf_counter() - started
        found = shape.closest(corners.mean(axis=1))
        off = np.abs(found.height_m)
        share = float((area * found.on_edge).sum() / area.sum())
        print(
            f"smoothed over {1e3 * shape.smoothing_m:.2f} mm ({ratio:g} edges): built in "
            f"{built_s:.2f} s; off the triangles' centres median {1e3 * np.median(off):.3f}, "
            f"99 % {1e3 * np.quantile(off, 0.99):.3f}, most {1e3 * off.max():.3f} mm; "
            f"edge {100 * share:.1f} % of the area"
        )
        time_queries("  queries", shape)
        for step_m in STEPS_M:
            worst = np.zeros(3)
            for start in vertices[:: len(vertices) // WAYS][:WAYS]:
                points, normals, edges = walk(shape, start, step_m)
                triangle, weights = facets.nearest(points)
                blend = (weights[:, None] @ rough[triangles[triangle]])[:, 0]
                blend /= np.linalg.norm(blend, axis=1, keepdims=True)
                here = [
                    second_derivative(one, edges, step_m)
                    for one in (normals, blend, flat[triangle])
                ]
                worst = np.maximum(worst, here)
            print(
                f"    normal's second derivative at steps of {1e3 * step_m:g} mm, 1/mm²: "
                f"jets {1e-6 * worst[0]:.2f}, blended {1e-6 * worst[1]:.1f}, "
                f"facets {1e-6 * worst[2]:.1f}",
                flush=True,
            )


def main() -> None:
    for measures in SOLIDS:
        time_queries(str(measures["shape"]), make_shape(measures))
    if len(sys.argv) == 3:
        mesh = read_mesh(Path(sys.argv[1]), float(sys.argv[2]), None)
        print(mesh.origin)
        evaluate_mesh(mesh.vertices_m, mesh.triangles.astype(np.int64))
    else:
        evaluate_mesh(*ellipsoid_mesh(4))


if __name__ == "__main__":
    main()
