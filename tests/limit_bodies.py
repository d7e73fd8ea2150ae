"""Small soft bodies with coarse meshes, for tests of the limits of the methods."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from flexsheet.messages.scene import Scene
from flexsheet.nodes.arrays import Floats, Singles
from flexsheet.nodes.fem_solver.body import SceneBody, build_scene_body, make_soft_body_spec
from flexsheet.nodes.fem_solver.mesh.from_scene import build_mesh
from flexsheet.nodes.fem_solver.mesh.solid import SolidMesh
from flexsheet.nodes.fem_solver.precompute import SoftBodyModel, compute
from flexsheet.nodes.fem_solver.snapshots import SamplePoint, SnapshotJob, solve_snapshot
from tests.scenes import load_cylinder

SPACING_M = 0.005
CYLINDER = {"shape": "cylinder", "radius_m": 0.02, "length_m": 0.05}
STRIP = {"kind": "strip", "angle_rad": 1.57}


@dataclass(frozen=True, slots=True)
class Body:
    """The soft body of a scene by the linear method, and its mesh."""

    scene: Scene
    soft: SceneBody
    model: SoftBodyModel
    mesh: SolidMesh


def make_scene(
    geometry: dict[str, Any],
    support: dict[str, Any],
    *,
    height_m: float,
    nu: float = 0.45,
    finger_m: float = 0.007,
) -> Scene:
    """Return the demo's scene with another object whose front is at the world's origin."""
    content = load_cylinder().model_dump()
    content["object"] = {
        "geometry": geometry,
        "support": support,
        "material": content["object"]["material"] | {"poisson_ratio": nu},
        "world_from_object": {"position_m": [0.0, 0.0, -height_m], "rpy_rad": [0.0, 0.0, 0.0]},
    }
    content["finger"]["radius_m"] = finger_m
    return Scene.model_validate(content)


def cylinder(**changes: float) -> Scene:
    return make_scene(CYLINDER, STRIP, height_m=0.02, **changes)


def make_body(scene: Scene, spacing_m: float = SPACING_M) -> Body:
    """Make the soft body of a scene."""
    spec = make_soft_body_spec(scene, spacing_m)
    model = compute(spec, lambda *_: None)
    soft = build_scene_body(scene, spec, model)
    return Body(scene, soft, model, build_mesh(spec.mesh))


def make_sample(body: Body) -> SamplePoint:
    """Return a point of the skin that is near the front."""
    found = body.soft.shape.closest(body.soft.front + np.array([0.002, 0.0015, 0.0]))
    return SamplePoint(found.point, found.normal)


def solve_deepest_mm(body: Body, sample: SamplePoint, depths_m: tuple[float, ...]) -> float:
    """Return the largest of the depths, in mm, at which Newton's method converges; 0 without."""
    job = SnapshotJob(
        nodes=body.mesh.nodes,
        elements=body.mesh.elements,
        fixed=body.mesh.fixed,
        faces=body.mesh.contact_nodes[body.mesh.contact_faces],
        sample=sample,
        poisson_ratio=body.soft.spec.poisson_ratio,
        finger_radius_m=body.scene.finger.radius_m,
        depths_m=depths_m,
    )
    reached = solve_snapshot(job).reached
    return 1e3 * depths_m[reached - 1] if reached else 0.0


def count_inverted(body: Body, moved: Floats | Singles) -> int:
    """Return the number of skin triangles whose normal is rotated by more than a right angle."""

    def normals(points: Floats) -> Floats:
        a, b, c = points[body.model.triangles].transpose(1, 0, 2)
        return np.cross(b - a, c - a)

    rest = body.soft.rest
    return int(((normals(rest) * normals(rest + moved)).sum(axis=1) <= 0.0).sum())
