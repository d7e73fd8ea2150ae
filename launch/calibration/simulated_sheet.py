"""The twin's sheet on the bench: what it answers to a push, for calibration and judgement."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from flexsheet.messages.scene import Scene, SheetSpec
from flexsheet.nodes.models.rigid import transform
from flexsheet.nodes.twin.error_map import error_map
from flexsheet.nodes.twin.eye import METRES_PER_PX, seen
from flexsheet.nodes.twin.membrane import CELLS, SLACK_TENSION, DeformedSheet, Rubber, solve

Floats = NDArray[np.float64]
Image = NDArray[np.uint8]

JUST_TAUT_TENSION = 2e-6
"""What the twin's rubber keeps of tension where it is slack, in shear moduli.  A hundredth of what
it keeps in the graph, where the sheet may hang: with that a small push into a sheet that is just
not taut would meet three times its force."""


def twin_push(
    sheet: SheetSpec,
    stretch_ratio: float,
    depth_m: float,
    place_m: tuple[float, float],
    finger_radius_m: float,
    *,
    cells: int = CELLS,
) -> tuple[float, float]:
    """Force along the sheet's normal and mean force on a clamp, N, of the scene's sheet pushed in
    at a place (x, y from its centre)."""
    half = 0.5 * sheet.width_m * stretch_ratio
    pushed = solve(
        Rubber(sheet.width_m, sheet.height_m, sheet.thickness_m, sheet.young_modulus_pa),
        transform(np.eye(3), [-half, 0.0, 0.0]),
        transform(np.eye(3), [half, 0.0, 0.0]),
        finger_tip=np.array([*place_m, -depth_m]),
        finger_radius_m=finger_radius_m,
        cells=cells,
        slack_tension=JUST_TAUT_TENSION if stretch_ratio >= 1.0 else SLACK_TENSION,
    )
    pull = 0.5 * (pushed.left_force_n[0] - pushed.right_force_n[0])
    return float(pushed.finger_force_n[2]), float(pull)


def twin_force(
    sheet: SheetSpec,
    stretch_ratio: float,
    depth_m: float,
    place_m: tuple[float, float],
    finger_radius_m: float,
) -> float:
    """The first of `twin_push`."""
    return twin_push(sheet, stretch_ratio, depth_m, place_m, finger_radius_m)[0]


def twin_points(
    scene: Scene, world_from_left_edge: Floats, world_from_right_edge: Floats, finger_tip: Floats
) -> Floats:
    """Points (n, 3) of the twin's sheet in the world, between two edges and under a fingertip."""
    pushed = true_sheet(scene, world_from_left_edge, world_from_right_edge, finger_tip)
    return pushed.positions.reshape(-1, 3)


def true_sheet(
    scene: Scene,
    world_from_left_edge: Floats,
    world_from_right_edge: Floats,
    finger_tip: Floats | None,
) -> DeformedSheet:
    """The twin's sheet between two edges (4, 4), under a fingertip (3,) or none."""
    sheet = scene.sheet
    return solve(
        Rubber(sheet.width_m, sheet.height_m, sheet.thickness_m, sheet.young_modulus_pa),
        world_from_left_edge,
        world_from_right_edge,
        finger_tip=finger_tip,
        finger_radius_m=scene.finger.radius_m,
    )


def twin_errors(
    scene: Scene,
    world_from_left_edge: Floats,
    world_from_right_edge: Floats,
    finger_tip: Floats | None,
) -> Callable[[Image, Image], Floats]:
    """Judges the projector's pictures of both patterns of places on the twin's sheet.

    Returns a function to the errors (n,), m, at all points that the scene's eye sees.
    """
    sheet = true_sheet(scene, world_from_left_edge, world_from_right_edge, finger_tip)
    eye = scene.eyes.centre_world_m

    def errors(coordinate_ramp_x: Image, coordinate_ramp_y: Image) -> Floats:
        x, y = (
            seen(picture, sheet, scene, eye=eye)
            for picture in (coordinate_ramp_x, coordinate_ramp_y)
        )
        return error_map(x, y, METRES_PER_PX).sizes_m

    return errors
