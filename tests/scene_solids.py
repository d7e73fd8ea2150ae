"""Mesh every shape of a scene coarsely, for tests."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import trimesh

from flexsheet.messages.scene import Scene
from flexsheet.nodes.fem_solver.mesh.from_scene import build_mesh, mesh_spec
from flexsheet.nodes.fem_solver.mesh.solid import SolidMesh
from tests.scenes import load_values

SPACINGS_M = {"plane": 0.0075}
"""Spacing of skin nodes; 0.006 for other shapes."""
SHAPES = ("cylinder", "sphere", "ellipsoid", "rounded_box", "plane", "mesh")


def geometry(shape: str) -> dict[str, Any]:
    """Return the geometry of an object with the size of a hand or smaller."""
    match shape:
        case "cylinder":
            return {"shape": shape, "radius_m": 0.0353553, "length_m": 0.06}
        case "sphere":
            return {"shape": shape, "radius_m": 0.03}
        case "ellipsoid":
            return {"shape": shape, "semi_axes_m": [0.045, 0.03, 0.02]}
        case "rounded_box":
            return {"shape": shape, "size_m": [0.08, 0.06, 0.04], "edge_radius_m": 0.008}
        case "plane":
            return {"shape": shape, "width_m": 0.04, "height_m": 0.03}
    ball = trimesh.creation.icosphere(subdivisions=3)
    return {
        "shape": "mesh",
        "vertices_m": np.ascontiguousarray(ball.vertices * [0.035, 0.03, 0.025]),
        "triangles": np.ascontiguousarray(ball.faces, dtype=np.int32),
        "smoothing_m": 0.006,
        "origin": "made",
    }


@cache
def scene_solid(shape: str) -> SolidMesh:
    """Return the mesh of a scene's object, as the solver makes it."""
    content = load_values()
    body = content["object"]
    body["geometry"] = geometry(shape)
    body["support"] = {"kind": "strip", "angle_rad": 1.5}
    return build_mesh(mesh_spec(Scene.model_validate(content), SPACINGS_M.get(shape, 0.006)))
