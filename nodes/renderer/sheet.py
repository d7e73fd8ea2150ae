"""Estimate the sheet's pose and shape, for which the renderer corrects the projected image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flexsheet.messages.types import Correction
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.models.rigid import apply, inverse, moved
from flexsheet.nodes.models.sheet import corners, sheet_from_edges
from flexsheet.nodes.renderer.correction import (
    ProjectionScreen,
    ScreenPlane,
    make_flat_screen,
    make_pushed_screen,
)

MIN_EDGE_DISTANCE_M = 0.05
"""The minimum plausible distance (m) between the sheet's edges."""


@dataclass(frozen=True, slots=True)
class SheetPose:
    """The sheet as predicted for the display time of a frame, in the world frame.

    world_from_sheet (4, 4): pose of the sheet. corners (4, 3): left bottom, right bottom, right
    top, left top, m. pushed_point (3,): position of the fingertip that pushes the sheet, m; None if
    no finger pushes the sheet.
    """

    world_from_sheet: Floats
    corners: Floats
    pushed_point: Floats | None

    @property
    def plane(self) -> ScreenPlane:
        return ScreenPlane(self.world_from_sheet[:3, 3], self.world_from_sheet[:3, 2])

    @property
    def edge_distance_m(self) -> float:
        """Return the distance (m) between the centres of the clamped edges."""
        left_bottom, right_bottom, right_top, left_top = self.corners
        return float(np.linalg.norm(right_bottom + right_top - left_bottom - left_top)) / 2.0

    @property
    def contact_point(self) -> Floats:
        """Return the pushed point (3,), m, or the sheet's centre if no finger pushes the sheet."""
        return self.plane.point if self.pushed_point is None else self.pushed_point


def estimate_sheet(
    world_from_left_edge: Floats,
    world_from_right_edge: Floats,
    *,
    height_m: float,
    finger_tip: Floats | None,
    twist_world: Floats | None = None,
    ahead_s: float = 0.0,
) -> SheetPose | None:
    """Estimate the sheet's pose and pushed point from the measured poses (4, 4) of its edges.

    finger_tip (3,): predicted position of the fingertip, world frame, m; None if it is unknown. The
    fingertip pushes the sheet if it is below the plane and within the outline of the sheet.
    twist_world (6,): linear (m/s) and angular (rad/s) velocity of the sheet; None if the sheet is
    at rest. ahead_s: time from the measurement to the prediction. Return None if the edges are
    closer than `MIN_EDGE_DISTANCE_M`, or if a value is not finite.
    """
    twist_world = np.zeros(6) if twist_world is None else twist_world
    left, right = world_from_left_edge, world_from_right_edge
    if not all(np.isfinite(each).all() for each in (left, right, twist_world)):
        return None
    distance = float(np.linalg.norm(right[:3, 3] - left[:3, 3]))
    if distance < MIN_EDGE_DISTANCE_M:
        return None
    measured = sheet_from_edges(left, right)
    later = moved(measured, twist_world, ahead_s)
    later_from_measured = later @ inverse(measured)
    pushed_point = None
    if finger_tip is not None:
        x, y, z = apply(inverse(later), finger_tip)
        if z < 0.0 and abs(x) < 0.5 * distance and abs(y) < 0.5 * height_m:
            pushed_point = finger_tip
    corner_points = corners(later_from_measured @ left, later_from_measured @ right, height_m)
    return SheetPose(later, corner_points, pushed_point)


def screen_for(method: Correction, sheet: SheetPose) -> ProjectionScreen | None:
    """Return the shape of the sheet that a correction method assumes.

    Returns None for the methods none and two_pass, because they assume no shape.
    """
    if method in ("none", "two_pass"):
        return None
    if method == "four_triangles" and sheet.pushed_point is not None:
        return make_pushed_screen(sheet.pushed_point, sheet.corners, sheet.plane)
    return make_flat_screen(sheet.plane)
