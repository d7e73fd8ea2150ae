"""Deform objects and sheets for image tests."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from flexsheet.messages.scene import Scene
from flexsheet.messages.types import Skin, SoftBody
from flexsheet.nodes.models.sheet import edge_poses
from flexsheet.nodes.renderer.scene_renderer import SceneRenderer
from flexsheet.nodes.renderer.sheet import SheetPose, estimate_sheet

Floats = NDArray[np.float64]


def sheet_at(scene: Scene, pose: Floats, tip: Floats | None = None) -> SheetPose:
    """Return the scene's sheet, slightly stretched, with its middle at a pose (4, 4)."""
    sheet = estimate_sheet(
        *edge_poses(pose, 1.05 * scene.sheet.width_m), height_m=scene.sheet.height_m, finger_tip=tip
    )
    assert sheet is not None
    return sheet


def follow(stage: SceneRenderer, displacement: Floats | None) -> None:
    """Deform the drawn object by a displacement (vertices, 3) of its surface, or reset it."""
    if displacement is None:
        stage.deform(None)
        return
    surface = stage._surface
    vertices = surface.rest_world_m.astype(np.float32)
    stage.set_skin(Skin(mesh_id="own", vertices_world_m=vertices, triangles=surface.triangles))
    stage.deform(body_of(displacement))


def body_of(displacement: Floats) -> SoftBody:
    return SoftBody(
        mesh_id="own",
        method="linear",
        in_range=True,
        push_depth_m=0.0,
        force_world_n=np.zeros(3),
        stiffness_n_per_m=0.0,
        displacement_world_m=displacement.astype(np.float32),
    )


def dent(stage: SceneRenderer, depth_m: float, place: tuple[float, float] = (0.0, 0.0)) -> Floats:
    """Return a displacement (vertices, 3) of the surface by a push from the front."""
    points = stage._surface.rest_world_m
    away = np.linalg.norm(points[:, :2] - np.array(place), axis=1)
    facing = np.clip(1.0 + points[:, 2] / 0.05, 0.0, 1.0)
    depth = depth_m * facing * np.exp(-((away / 0.018) ** 2))
    return depth[:, None] * np.array([0.0, 0.0, -1.0])
