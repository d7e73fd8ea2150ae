"""Mesh the virtual object of a scene. The class `solid.SolidMesh` describes the result.

spec = mesh_spec(scene, skin_spacing_m)     # `spec.key()` identifies the mesh
mesh_budget(spec)                           # nodes and memory, before any work
mesh = build_mesh(spec)                     # in the frame of `world_from_mesh(scene)`
"""

from __future__ import annotations

from flexsheet.nodes.fem_solver.mesh.cylinder import Focus, cylinder_mesh
from flexsheet.nodes.fem_solver.mesh.from_scene import (
    MeshBudget,
    MeshSpec,
    build_mesh,
    mesh_budget,
    mesh_scene,
    mesh_spec,
    world_from_mesh,
)
from flexsheet.nodes.fem_solver.mesh.solid import (
    EDGES,
    FACES,
    SAME_M,
    SUBTRIANGLES,
    SolidMesh,
    UnfitMeshError,
    boundary_faces,
    nodes_in_planes,
    skin_faces,
)

__all__ = [
    "EDGES",
    "FACES",
    "SAME_M",
    "SUBTRIANGLES",
    "Focus",
    "MeshBudget",
    "MeshSpec",
    "SolidMesh",
    "UnfitMeshError",
    "boundary_faces",
    "build_mesh",
    "cylinder_mesh",
    "mesh_budget",
    "mesh_scene",
    "mesh_spec",
    "nodes_in_planes",
    "skin_faces",
    "world_from_mesh",
]
