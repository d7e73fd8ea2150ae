"""Compute the contents of the 3D view at one time, as arrays in the world frame.

The "skin" is the surface mesh of the soft object.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flexsheet.messages.scene import Scene
from flexsheet.messages.types import ArmState, Fingertip, Skin, SoftBody
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.console.arms import compute_link_poses
from flexsheet.nodes.console.latest_messages import MessageSource
from flexsheet.nodes.console.sheet import COLUMNS, ROWS, compute_sheet_points
from flexsheet.nodes.models.rigid import pose_matrix
from flexsheet.nodes.models.shapes.triangles import intersect_rays, triangulate_grid

RAY_POSITIONS = (-0.55, 0.0, 0.55)
"""The positions at which light rays are drawn, as fractions of half the object's width and height.
"""
RAY_TRIANGLES = triangulate_grid(ROWS // 2 + 1, COLUMNS // 2 + 1)
"""The t triangles (t, 3) between every second row and column of the drawn sheet."""


@dataclass(frozen=True, slots=True)
class SceneSnapshot:
    """The contents of the 3D view at one time, in the world frame.

    links: poses (7, 4, 4) of each arm's links, by side.
    edges: pose (4, 4) of each clamped edge, by side.
    sheet: n points (n, 3) of the sheet.
    skin: s deformed vertices (s, 3) of the object's surface mesh.
    finger: position (3,) of the fingertip.
    finger_valid: whether the fingertip is tracked.

    Lengths are in m. A value is None if it is unknown.
    """

    links: dict[str, Floats]
    edges: dict[str, Floats]
    sheet: Floats | None
    skin: Floats | None
    finger: Floats | None
    finger_valid: bool


def compute_snapshot(scene: Scene, source: MessageSource) -> SceneSnapshot:
    """Compute the contents of the 3D view from the latest messages."""
    links, edges = {}, {}
    for side, arm in (("left", scene.arms.left), ("right", scene.arms.right)):
        state = source.latest(f"arm_{side}", ArmState)
        if state is not None:
            links[side] = compute_link_poses(
                pose_matrix(arm.world_from_base), state[0].joints_rad, arm.model
            )
            edges[side] = state[0].world_from_flange @ pose_matrix(arm.flange_from_edge)
    entry = source.latest("fingertip", Fingertip)
    tip, valid = (None, False) if entry is None else (entry[0].position_world_m, entry[0].valid)
    sheet = None
    if len(edges) == 2:
        sheet = compute_sheet_points(
            edges["left"],
            edges["right"],
            height_m=scene.sheet.height_m,
            fingertip=tip if valid else None,
            finger_radius_m=scene.finger.radius_m,
        )
    return SceneSnapshot(
        links=links,
        edges=edges,
        sheet=sheet,
        skin=_skin(source),
        finger=tip,
        finger_valid=valid,
    )


def _skin(source: MessageSource) -> Floats | None:
    """Return the n vertices (n, 3), m, of the object's surface mesh, or None if there is no mesh.

    Before the first result of the solver, the vertices of the undeformed object are returned.
    """
    skin, body = source.latest("skin", Skin), source.latest("soft_body", SoftBody)
    if skin is None:
        return None
    rest = skin[0].vertices_world_m
    if body is None or body[0].mesh_id != skin[0].mesh_id:
        return np.asarray(rest, dtype=np.float64)
    return np.asarray(rest + body[0].displacement_world_m, dtype=np.float64)


def select_ray_vertices(rest: Floats) -> NDArray[np.int64]:
    """Select nine vertices in a grid on the user's side, at which light rays are drawn.

    rest: n vertices (n, 3) of the undeformed object, m.

    Returns the indices (9,) of the vertices.
    """
    low, high = rest.min(axis=0), rest.max(axis=0)
    centre, half = 0.5 * (low + high), 0.5 * (high - low)
    chosen = []
    for up in RAY_POSITIONS:
        for across in RAY_POSITIONS:
            position = centre[:2] + half[:2] * np.array([0.7 * across, up])
            off = np.linalg.norm(rest[:, :2] - position, axis=1)
            chosen.append(int(np.argmin(off - 0.3 * (rest[:, 2] - centre[2]))))
    return np.array(chosen)


def rays(scene: Scene, sheet: Floats, points: Floats) -> tuple[Floats, Floats]:
    """Compute the light rays by which the eye sees n points (n, 3), in m, of the deformed surface.

    sheet: points of the drawn sheet.

    Returns k segments (k, 2, 3) from the eye to the sheet, and k segments (k, 2, 3) from the sheet
    to the projector. If a ray misses the sheet, its point has no segments. The result is empty if
    the scene has no projector.
    """
    if scene.projector is None:
        return np.empty((0, 2, 3)), np.empty((0, 2, 3))
    eye = scene.eyes.centre_world_m
    projector = pose_matrix(scene.projector.world_from_projector)[:3, 3]
    # Every second row and column is sufficient for a drawing, and four times as fast.
    corners = sheet.reshape(ROWS, COLUMNS, 3)[::2, ::2].reshape(-1, 3)[RAY_TRIANGLES]
    triangles, weights = intersect_rays(eye, points - eye, corners)
    hits = np.einsum("nk,nki->ni", weights, corners[triangles])
    # Remove misses, which are NaN, and intersections behind the eye.
    hits = hits[((hits - eye) * (points - eye)).sum(axis=1) > 0.0]
    to_eye = np.stack([np.broadcast_to(eye, hits.shape), hits], axis=1)
    from_projector = np.stack([hits, np.broadcast_to(projector, hits.shape)], axis=1)
    return to_eye, from_projector
