"""Place the projected marks that the stereo camera uses to check the calibrations.

A mark is a square of projector pixels with a known ray. If the poses of projector and camera in the
scene are correct, the camera must see the mark on this ray. If the poses of the arms are correct,
the mark must be on the sheet. If a finger pushes the sheet, the displacement of the sheet near the
finger is a known fraction of the finger's displacement. Therefore the marks show the true depth of
the finger.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flexsheet.messages.scene import Projector
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.models import camera
from flexsheet.nodes.models.rigid import apply, inverse, pose_matrix
from flexsheet.nodes.models.shapes.triangles import intersect_rays
from flexsheet.nodes.renderer.sheet_mesh import SheetMesh

SIDE_M = 0.0053
"""The side length of a projected mark, which has the area of a round marker of 3 mm radius."""

FINGER_STEP_M = 0.001
"""The displacement of the fingertip for which the displacements of the marks are computed."""


@dataclass(frozen=True, slots=True)
class CheckMarks:
    """The projected marks of one frame.

    side_px: side of the squares. corners_px (n, 2): pixel coordinates (left column, top row) of
    each of the n marks. world_m (n, 3): centres of the marks on the sheet; NaN if a mark misses the
    sheet. finger_ratio (n,): displacement of the sheet along its normal at each mark, divided by
    the displacement of the fingertip.
    """

    side_px: int
    corners_px: NDArray[np.int64]
    world_m: Floats
    finger_ratio: Floats

    @property
    def centres_px(self) -> Floats:
        return np.asarray(self.corners_px + 0.5 * (self.side_px - 1), dtype=np.float64)


NO_MARKS = CheckMarks(0, np.zeros((0, 2), np.int64), np.zeros((0, 3)), np.zeros(0))


def place_marks(
    projector: Projector, world_from_sheet: Floats, mesh: SheetMesh, deeper: SheetMesh | None
) -> CheckMarks:
    """Place the marks that the projector draws on the sheet to check the calibrations.

    world_from_sheet (4, 4): pose of the sheet. mesh: current mesh of the sheet. deeper: mesh of the
    sheet if the fingertip were `FINGER_STEP_M` deeper; None if there is no contact.
    """
    pose, lens = projector.world_from_projector, projector.lens
    world_from_projector = pose_matrix(pose)
    matrix = camera.camera_matrix(lens.fx_px, lens.fy_px, lens.cx_px, lens.cy_px)
    distortion = np.array(lens.distortion)
    points = np.array([(x, y, 0.0) for x, y in projector.check_marks_sheet_m])
    local = apply(inverse(world_from_projector) @ world_from_sheet, points)
    # Side and corners are even, because a mark may be drawn at half the resolution.
    side_px = 2 * round(0.5 * SIDE_M * lens.fx_px / float(local[:, 2].mean()))
    half = 0.5 * (side_px - 1)
    pixels = camera.project(local, matrix, distortion)
    corners = 2 * np.rint(0.5 * (pixels - half)).astype(np.int64)
    centres = np.asarray(corners + half, dtype=np.float64)
    slopes = camera.normalize(centres, matrix, distortion)
    rays = np.column_stack([slopes, np.ones(len(slopes))]) @ world_from_projector[:3, :3].T
    surface = mesh.vertices[mesh.triangles]
    triangles, weights = intersect_rays(world_from_projector[:3, 3], rays, surface)
    surface = surface[triangles]
    world = np.einsum("nk,nki->ni", weights, surface)
    ratio = np.zeros(len(points))
    if deeper is not None:
        moved = deeper.vertices[mesh.triangles[triangles]] - surface
        ratio = np.einsum("nk,nki,i->n", weights, moved, -world_from_sheet[:3, 2]) / FINGER_STEP_M
    return CheckMarks(side_px, corners, world, np.nan_to_num(ratio))
