"""Simulate pushes of a finger into the sheet with the simulator's membrane model.

Calibrations and reference computations use the results.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from flexsheet.launch.experiments.true_geometry import ArmPair, place_edges
from flexsheet.messages.apparatus import Apparatus
from flexsheet.messages.scene import Scene, SheetSpec
from flexsheet.nodes.arrays import Floats, Image
from flexsheet.nodes.models.rigid import transform
from flexsheet.nodes.twin.error_map import error_map
from flexsheet.nodes.twin.eye import METRES_PER_PX, seen
from flexsheet.nodes.twin.force_history import compute_history_ratios
from flexsheet.nodes.twin.membrane import (
    CELLS,
    SLACK_TENSION,
    DeformedSheet,
    TrueRubber,
    solve,
    solve_path,
)
from flexsheet.nodes.twin.sheet_pull import true_rubber
from flexsheet.nodes.twin.truth import apply_apparatus

JUST_TAUT_TENSION = 2e-6
"""The small tension of slack rubber in the model, divided by the shear modulus.

This value is used if the edges are far enough apart to make the sheet taut. The simulator in a
running graph uses a value that is a hundred times as large, because its sheet can hang slack. The
larger value would triple the force of a small push into a sheet that is just taut.
"""

PUSHED_CELLS, UNTOUCHED_CELLS = 24, 16
"""The numbers of mesh intervals along each side of a pushed sheet and of an untouched sheet.

Forces that are computed with 24 and with 32 intervals differ by 0.5 %. At a depth of 2 mm, they
differ by 1 %.
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
    """Simulate a push, and return the normal force (N) and the mean force (N) on a clamped edge.

    point_m: pushed point (x, y) on the sheet, relative to its centre.
    cells: number of mesh intervals along each side of the sheet.
    """
    edges = place_edges(np.eye(4), sheet.width_m * stretch_ratio)
    rubber = true_rubber(sheet, None)
    return _push(rubber, edges, (depth_m,), point_m, finger_radius_m, cells=cells)[0]


def _push(
    rubber: TrueRubber,
    edges: tuple[Floats, Floats],
    depths_m: Sequence[float],
    point_m: tuple[float, float],
    finger_radius_m: float,
    *,
    cells: int = CELLS,
) -> list[tuple[float, float]]:
    """Simulate a push, and return (normal force, force on a clamped edge), in N, at each depth.

    edges: poses (4, 4) of the left and the right clamped edge.
    depths_m: ascending depths of the finger behind the plane of the flat sheet.
    point_m: pushed point (x, y), relative to the centre of the flat sheet.
    cells: number of mesh intervals along each side of the sheet.
    """
    x, y, normal, middle = flat_axes(*edges)
    distance_m = float((edges[1][:3, 3] - edges[0][:3, 3]) @ x)
    place = middle + point_m[0] * x + point_m[1] * y
    path = solve_path(
        rubber,
        *edges,
        finger_tips=[place - depth_m * normal for depth_m in depths_m],
        finger_radius_m=finger_radius_m,
        cells=cells,
        slack_tension=JUST_TAUT_TENSION if distance_m >= rubber.width_m else SLACK_TENSION,
    )
    return [
        (
            float(pushed.finger_force_n @ normal),
            0.5 * float((pushed.left_force_n - pushed.right_force_n) @ x),
        )
        for pushed in path
    ]


def flat_axes(left: Floats, right: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """Return the x axis, y axis, normal and centre, each (3,), of the flat sheet between two edges.

    left, right: poses (4, 4) of the clamped edges.
    """
    x = right[:3, 3] - left[:3, 3]
    x = x / np.linalg.norm(x)
    normal = np.cross(x, left[:3, 1] + right[:3, 1])
    normal /= np.linalg.norm(normal)
    return x, np.cross(normal, x), normal, 0.5 * (left[:3, 3] + right[:3, 3])


class SimulatedSheet:
    """A simulated sheet between two simulated arms, with parameters that differ from the scene.

    The commanded poses of the edges are computed with the arm parameters of the scene. The true
    poses deviate from the commanded poses because of errors of the bases, joint angles and clamps,
    and because the arms are compliant.

    apparatus: true parameters of the hardware.
    """

    def __init__(self, scene: Scene, apparatus: Apparatus) -> None:
        true_scene = apply_apparatus(scene, apparatus)
        self._arms = ArmPair(scene, apparatus)
        self._rubber = true_rubber(true_scene.sheet, apparatus)
        self._history_ratios = compute_history_ratios(apparatus)

    def push(
        self,
        distance_m: float,
        depths_m: Sequence[float],
        point_m: tuple[float, float],
        radius_m: float,
    ) -> list[tuple[tuple[float, float], float]]:
        """Simulate a push, and return the forces (N) at each depth.

        Each entry of the result has the form ((normal force during loading, normal force during
        unloading), force on a clamped edge).

        distance_m: commanded distance between the edges.
        depths_m: ascending depths of the ball behind the flat sheet.
        point_m: pushed point (x, y), relative to the sheet's centre.
        radius_m: radius of the pushing ball. Touched rubber sticks to the ball.
        """
        edges = self._arms.hold(place_edges(np.eye(4), distance_m))
        moving_in, moving_out = (float(ratio) for ratio in self._history_ratios)
        return [
            ((moving_in * force_n, moving_out * force_n), clamp_n)
            for force_n, clamp_n in _push(
                self._rubber, edges, depths_m, point_m, radius_m, cells=PUSHED_CELLS
            )
        ]

    def hold(self, world_from_sheet: Floats, distance_m: float) -> tuple[Floats, Floats]:
        """Simulate the sheet at a commanded pose (4, 4) while nothing touches it.

        Return the true pose (4, 4) of the flat sheet between the edges. Also return points (n, 3),
        in m, of the true sheet, which sags under its weight.
        """
        left, right = self._arms.hold(place_edges(world_from_sheet, distance_m))
        x, y, normal, middle = flat_axes(left, right)
        flat = transform(np.column_stack([x, y, normal]), middle)
        sheet = solve(self._rubber, left, right, cells=UNTOUCHED_CELLS)
        return flat, sheet.positions.reshape(-1, 3)


def simulate_force(
    sheet: SheetSpec,
    stretch_ratio: float,
    depth_m: float,
    point_m: tuple[float, float],
    finger_radius_m: float,
) -> float:
    """Simulate a push, and return the normal force (N).

    point_m: pushed point (x, y) on the sheet, relative to its centre.
    """
    return simulate_push(sheet, stretch_ratio, depth_m, point_m, finger_radius_m)[0]


def simulate_points(
    scene: Scene, world_from_left_edge: Floats, world_from_right_edge: Floats, finger_tip: Floats
) -> Floats:
    """Return points (n, 3), in m, of the simulated sheet between two edges under a fingertip.

    world_from_left_edge, world_from_right_edge: poses (4, 4) of the clamped edges.
    finger_tip: position (3,) of the fingertip.
    """
    pushed = solve_sheet(scene, world_from_left_edge, world_from_right_edge, finger_tip)
    return pushed.positions.reshape(-1, 3)


def solve_sheet(
    scene: Scene,
    world_from_left_edge: Floats,
    world_from_right_edge: Floats,
    finger_tip: Floats | None,
) -> DeformedSheet:
    """Compute the shape of the simulated sheet between two edges, with or without a fingertip.

    world_from_left_edge, world_from_right_edge: poses (4, 4) of the clamped edges.
    finger_tip: position (3,) of the fingertip. If None, nothing touches the sheet.
    """
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
    """Return a function that computes the position errors of the image on a simulated sheet.

    The returned function has two arguments. They are projector images in which the brightness
    encodes the x and the y coordinate (coordinate ramps). The function returns the error (n,), in
    m, at each of n points that the user's eye can see.
    """
    sheet = solve_sheet(scene, world_from_left_edge, world_from_right_edge, finger_tip)
    eye = scene.eyes.centre_world_m

    def errors(coordinate_ramp_x: Image, coordinate_ramp_y: Image) -> Floats:
        x, y = (
            seen(image, sheet, scene, eye=eye) for image in (coordinate_ramp_x, coordinate_ramp_y)
        )
        return error_map(x, y, METRES_PER_PX).sizes_m

    return errors
