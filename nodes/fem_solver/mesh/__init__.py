"""Meshes of the scene's object, see `solid.SolidMesh` for what they hold."""

from __future__ import annotations

from nodes.fem_solver.mesh.cylinder import (
    EDGES,
    FACES,
    SUBTRIANGLES,
    SolidMesh,
    boundary_faces,
    cylinder_mesh,
)

__all__ = ["EDGES", "FACES", "SUBTRIANGLES", "SolidMesh", "boundary_faces", "cylinder_mesh"]
