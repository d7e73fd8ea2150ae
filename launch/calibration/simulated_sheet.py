"""Simulate pushes of the sheet by the simulator's membrane, for calibration and reference."""

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
"""Residual tension of slack rubber, in shear moduli: a hundredth of that in the graph, where the
sheet may hang.  With the larger one, a small push into a sheet that is just not taut would have
three times its force."""


def twin_push(
    sheet: SheetSpec,
    stretch_ratio: float,
    depth_m: float,
    place_m: tuple[float, float],
    finger_radius_m: float,
    *,
    cells: int = CELLS,
) -> tuple[float, float]:
    """Return the force along the sheet's normal and the mean force on a clamp, N.

    place_m: pushed position on the sheet (x, y from its centre).
    """
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
    """Return the normal force of `twin_push`, N."""
    return twin_push(sheet, stretch_ratio, depth_m, place_m, finger_radius_m)[0]


def twin_points(
    scene: Scene, world_from_left_edge: Floats, world_from_right_edge: Floats, finger_tip: Floats
) -> Floats:
    """Return points (n, 3) m of the simulated sheet, clamped at two edges under a fingertip."""
    pushed = true_sheet(scene, world_from_left_edge, world_from_right_edge, finger_tip)
    return pushed.positions.reshape(-1, 3)


def true_sheet(
    scene: Scene,
    world_from_left_edge: Floats,
    world_from_right_edge: Floats,
    finger_tip: Floats | None,
) -> DeformedSheet:
    """Solve the simulated sheet between two edges (4, 4), under a fingertip (3,) or none."""
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
    """Return a function that evaluates projector images of both coordinate ramps.

    It returns the errors (n,), m, at all points of the simulated sheet that the scene's eye sees.
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
