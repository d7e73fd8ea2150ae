"""Simulate pushes of a finger into the sheet with the simulator's membrane model.

Calibrations and reference computations use the results.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from flexsheet.messages.scene import Scene, SheetSpec
from flexsheet.nodes.models.rigid import transform
from flexsheet.nodes.twin.error_map import error_map
from flexsheet.nodes.twin.eye import METRES_PER_PX, seen
from flexsheet.nodes.twin.membrane import CELLS, SLACK_TENSION, DeformedSheet, solve
from flexsheet.nodes.twin.sheet_pull import true_rubber

Floats = NDArray[np.float64]
Image = NDArray[np.uint8]

JUST_TAUT_TENSION = 2e-6
"""Residual tension of slack rubber, in shear moduli, for a sheet that is almost taut.

The simulator of a running graph uses a hundred times as much, because its sheet may hang. In a
sheet that is barely slack, that tension would triple the force of a small push.
"""


def simulate_push(
    sheet: SheetSpec,
    stretch_ratio: float,
    depth_m: float,
    point_m: tuple[float, float],
    finger_radius_m: float,
    *,
    cells: int = CELLS,
) -> tuple[float, float]:
    """Return the normal force of a push and the mean force on a clamped edge, N.

    point_m: pushed point on the sheet (x, y from its centre).
    """
    half = 0.5 * sheet.width_m * stretch_ratio
    pushed = solve(
        true_rubber(sheet, None),
        transform(np.eye(3), [-half, 0.0, 0.0]),
        transform(np.eye(3), [half, 0.0, 0.0]),
        finger_tip=np.array([*point_m, -depth_m]),
        finger_radius_m=finger_radius_m,
        cells=cells,
        slack_tension=JUST_TAUT_TENSION if stretch_ratio >= 1.0 else SLACK_TENSION,
    )
    clamp_force_n = 0.5 * (pushed.left_force_n[0] - pushed.right_force_n[0])
    return float(pushed.finger_force_n[2]), float(clamp_force_n)


def simulate_force(
    sheet: SheetSpec,
    stretch_ratio: float,
    depth_m: float,
    point_m: tuple[float, float],
    finger_radius_m: float,
) -> float:
    """Return only the normal force of `simulate_push`, N."""
    return simulate_push(sheet, stretch_ratio, depth_m, point_m, finger_radius_m)[0]


def simulate_points(
    scene: Scene, world_from_left_edge: Floats, world_from_right_edge: Floats, finger_tip: Floats
) -> Floats:
    """Return points (n, 3) of the simulated sheet between two edges under a fingertip, m."""
    pushed = solve_sheet(scene, world_from_left_edge, world_from_right_edge, finger_tip)
    return pushed.positions.reshape(-1, 3)


def solve_sheet(
    scene: Scene,
    world_from_left_edge: Floats,
    world_from_right_edge: Floats,
    finger_tip: Floats | None,
) -> DeformedSheet:
    """Solve the simulated sheet between two edges (4, 4), under a fingertip (3,) or without one."""
    return solve(
        true_rubber(scene.sheet, None),
        world_from_left_edge,
        world_from_right_edge,
        finger_tip=finger_tip,
        finger_radius_m=scene.finger.radius_m,
    )


def make_error_function(
    scene: Scene,
    world_from_left_edge: Floats,
    world_from_right_edge: Floats,
    finger_tip: Floats | None,
) -> Callable[[Image, Image], Floats]:
    """Make a function that computes image errors from projector images of both coordinate ramps.

    It returns the errors (n,), m, at all points of the simulated sheet that the eye can see.
    """
    sheet = solve_sheet(scene, world_from_left_edge, world_from_right_edge, finger_tip)
    eye = scene.eyes.centre_world_m

    def errors(coordinate_ramp_x: Image, coordinate_ramp_y: Image) -> Floats:
        x, y = (
            seen(image, sheet, scene, eye=eye) for image in (coordinate_ramp_x, coordinate_ramp_y)
        )
        return error_map(x, y, METRES_PER_PX).sizes_m

    return errors
