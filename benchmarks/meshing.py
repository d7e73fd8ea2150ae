"""Measure the cost and quality of meshing: every shape at several spacings.

    OPENBLAS_NUM_THREADS=1 python -m benchmarks.meshing [FILE METRES_PER_UNIT]

Prints a table row for each: nodes beside the estimate, tetrahedra, skin and touchable nodes, the
skin's mean spacing where fingers touch, seconds, the worst radius ratio, dihedral angle and
Jacobian, and the error of the volume. FILE: an STL or OBJ to mesh as well. Takes some minutes and 2
GiB.
"""

from __future__ import annotations

import itertools
import resource
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flexsheet.launch.objects.meshes import read_mesh
from flexsheet.launch.plans.plan import load_scene
from flexsheet.messages.scene import (
    Cylinder,
    Ellipsoid,
    Geometry,
    Mesh,
    Plane,
    RoundedBox,
    Scene,
    Sphere,
)
from flexsheet.nodes.fem_solver.elasticity import quadrature, shape_gradients
from flexsheet.nodes.fem_solver.mesh.from_scene import build_mesh, estimate_node_count, mesh_spec
from flexsheet.nodes.fem_solver.mesh.quality import min_jacobian_ratios, radius_ratios
from flexsheet.nodes.fem_solver.mesh.solid import SolidMesh
from flexsheet.nodes.models.shapes import make_shape
from flexsheet.nodes.models.shapes.triangles import volume_m3

SCENE_FILE = Path(__file__).resolve().parent.parent / "launch" / "scenes" / "cylinder.yaml"
SPACINGS_M = (0.004, 0.0028, 0.002)
GEOMETRIES: dict[str, Geometry] = {
    "cylinder, 71 × 120 mm": Cylinder(radius_m=0.0353553, length_m=0.12),
    "sphere, 70 mm": Sphere(radius_m=0.035),
    "ellipsoid, 100 × 60 × 40 mm": Ellipsoid(semi_axes_m=(0.05, 0.03, 0.02)),
    "rounded box, 80 × 60 × 40 mm, 10 mm": RoundedBox(
        size_m=(0.08, 0.06, 0.04), edge_radius_m=0.01
    ),
    "plane, 100 × 80 mm": Plane(width_m=0.1, height_m=0.08),
}

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


def min_dihedral_rad(points: Floats, tetrahedra: Ints) -> Floats:
    """Return the smallest angle between two faces of each straight tetrahedron (e,)."""
    corners = points[tetrahedra[:, :4]]
    normals = []
    for i in range(4):
        a, b, c = (corners[:, j] for j in range(4) if j != i)
        normal = np.cross(b - a, c - a)
        inwards = ((corners[:, i] - a) * normal).sum(axis=1, keepdims=True) > 0.0
        normal = np.where(inwards, -normal, normal)
        normals.append(normal / np.linalg.norm(normal, axis=1, keepdims=True))
    cosines = [-(a * b).sum(axis=1) for a, b in itertools.combinations(normals, 2)]
    smallest: Floats = np.arccos(np.clip(np.max(cosines, axis=0), -1.0, 1.0))
    return smallest


def with_geometry(scene: Scene, geometry: Geometry) -> Scene:
    body: Any = scene.object.model_copy(update={"geometry": geometry})
    return scene.model_copy(update={"object": body})


def volume_of(geometry: Geometry, slab_depth_m: float) -> float:
    """Return the volume of the solid, m^3; of a slab for a plane, of the facets for a mesh."""
    match geometry:
        case Cylinder(radius_m=r, length_m=length):
            return np.pi * r**2 * length
        case Sphere(radius_m=r):
            return 4.0 / 3.0 * np.pi * r**3
        case Ellipsoid(semi_axes_m=axes):
            return 4.0 / 3.0 * np.pi * float(np.prod(axes))
        case RoundedBox(size_m=size, edge_radius_m=r):
            a, b, c = (side - 2.0 * r for side in size)
            faces, edges = 2.0 * r * (a * b + b * c + c * a), np.pi * r**2 * (a + b + c)
            return a * b * c + faces + edges + 4.0 / 3.0 * np.pi * r**3
        case Plane(width_m=width, height_m=height):
            margin = 2.0 * slab_depth_m
            return (width + margin) * (height + margin) * slab_depth_m
        case Mesh(vertices_m=vertices, triangles=triangles):
            return volume_m3(vertices, triangles.astype(np.int64))


def meshed_volume(mesh: SolidMesh) -> float:
    """Return the volume of the curved elements, m^3."""
    points, weights = quadrature()
    jacobian = np.einsum("qak,eai->eqik", shape_gradients(points), mesh.nodes[mesh.elements])
    return float((np.linalg.det(jacobian) * weights).sum())


def spacing_mm(mesh: SolidMesh) -> float:
    """Return the mean spacing of touchable nodes, mm: the root of the skin's area per node."""
    corners = mesh.nodes[mesh.contact_nodes][mesh.contact_faces]
    area = 0.0
    for i, j, k in ((0, 3, 5), (3, 1, 4), (5, 4, 2), (3, 4, 5)):
        cross = np.cross(corners[:, j] - corners[:, i], corners[:, k] - corners[:, i])
        area += 0.5 * float(np.linalg.norm(cross, axis=1).sum())
    return 1e3 * float(np.sqrt(area / len(mesh.contact_nodes)))


def measure(name: str, scene: Scene, spacing_m: float) -> None:
    spec = mesh_spec(scene, spacing_m)
    estimated = estimate_node_count(spec, make_shape(dict(spec.geometry)))
    start = time.perf_counter()
    mesh = build_mesh(spec)
    took_s = time.perf_counter() - start
    wanted = volume_of(spec.geometry, spec.slab_depth_m)
    dihedral = np.degrees(min_dihedral_rad(mesh.nodes, mesh.elements).min())
    print(
        f"| {name} | {1e3 * spacing_m:g} mm | {len(mesh.nodes)} ({estimated})"
        f" | {len(mesh.elements)} | {len(mesh.skin)}, {len(mesh.contact_nodes)}"
        f" | {spacing_mm(mesh):.2f} mm | {took_s:.1f} s"
        f" | {radius_ratios(mesh.nodes, mesh.elements).min():.2f}"
        f" | {dihedral:.0f}° | {min_jacobian_ratios(mesh.nodes, mesh.elements).min():.2f}"
        f" | {100 * (meshed_volume(mesh) / wanted - 1):+.2f} % |",
        flush=True,
    )
    if isinstance(spec.geometry, Mesh):
        skin = make_shape(dict(spec.geometry)).closest(mesh.nodes[mesh.skin])
        off_mm = 1e3 * np.abs(skin.height_m)
        print(
            f"skin nodes off the smooth surface: 95 % within {np.quantile(off_mm, 0.95):.3f} mm,"
            f" {np.count_nonzero(off_mm > 0.01)} more than 0.01 mm, at most {off_mm.max():.1f} mm"
        )


def main() -> None:
    scene = load_scene(SCENE_FILE)
    geometries = dict(GEOMETRIES)
    if len(sys.argv) == 3:
        path = Path(sys.argv[1])
        geometries[path.stem] = read_mesh(path, float(sys.argv[2]), None)
    print(
        "| shape | asked spacing | nodes (foreseen) | tetrahedra | skin, touchable nodes | spacing"
        " | time | worst radius ratio | worst dihedral | worst Jacobian | volume |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|---|")
    for name, geometry in geometries.items():
        for spacing_m in SPACINGS_M:
            measure(name, with_geometry(scene, geometry), spacing_m)
    peak_mib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10
    print(f"\npeak {peak_mib:.0f} MiB")


if __name__ == "__main__":
    main()
