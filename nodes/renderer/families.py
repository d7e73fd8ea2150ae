"""The image correction's method family: how long a picture's vertices take, how far off they land.

What is timed is the numpy form of the vertex shader's work, `correction.correct`, on every vertex
of the drawn surface.  What is judged is where the eye sees the light of each vertex on the true
sheet; that answer comes from a judge which shares no code with the renderer, and which whoever
asks for the family brings along.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray

from messages.scene import Scene, cylinder_of
from messages.types import Correction
from nodes.methods import Case, Family, Trial
from nodes.models.rigid import rotation_from_vector, transform
from nodes.models.sheet import edge_poses
from nodes.renderer.correction import correct, on_imaginary_screen
from nodes.renderer.sheet import Sheet, screen_for, sheet_between
from nodes.renderer.stage import projector_homography, transform_of
from nodes.renderer.surface import cylinder_surface, normals_of

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

SeenAt = Callable[[Floats], tuple[Floats, Bools]]
"""Projector pixels (n, 2) to where the eye sees their light, (n, 2) metres on the imaginary screen,
and whether it does."""

Judge = Callable[[Scene, Floats, Floats, Floats | None], SeenAt]
"""Makes a `SeenAt` for a scene whose sheet has its left and right edge at two poses (4, 4) and is
pushed by a fingertip (3,), or by none."""

METHODS: tuple[Correction, ...] = ("none", "one_plane", "four_triangles")
"""Those that move vertices; two passes move none."""
TILTS_DEG = (-50, -40, -30, -20, -10, 10, 20, 30, 40, 50)
PUSHES_MM = (0, 10, 20, 30, 40, 50)
STRETCH = 1.05
SPACING_M = 0.0025


def correction_family(judge: Judge) -> Family:
    """Every correction over the tilts and pushes of the paper's figures 11 and 13."""

    def trials(scene: Scene) -> Iterator[Trial]:
        for degrees in TILTS_DEG:
            yield from _case(scene, judge, tilt_deg=degrees, push_mm=0)
        for depth_mm in PUSHES_MM:
            if depth_mm <= 1e3 * scene.working_range.push_depth_m + 1e-9:
                yield from _case(scene, judge, tilt_deg=0, push_mm=depth_mm)

    return Family(
        name="correction",
        unit="mm",
        reference="rms displacement at the eye on the twin's sheet",
        methods=METHODS,
        trials=trials,
        tolerance=lambda scene: 1e3 * scene.tolerances.image_m,
    )


TRIANGLES_TO_MM = 3.5
"""To this push a pyramid leaves half a millimetre (rms) of a true dent; see the chart."""


def covers(method: Correction, *, tilt_deg: float, push_mm: float) -> bool:
    """A method's stated range: `none` is for the sheet on the imaginary screen, `one_plane` for a
    flat one, `four_triangles` for one that is pushed no deeper than `TRIANGLES_TO_MM`."""
    if method == "none":
        return tilt_deg == 0 and push_mm == 0
    return push_mm <= (TRIANGLES_TO_MM if method == "four_triangles" else 0.0)


def rolled_on(scene: Scene, tilt_rad: float) -> Floats:
    """world_from_sheet tangent to the cylinder, rolled there without slip from the upright pose."""
    radius = cylinder_of(scene).radius_m
    axis = transform_of(scene.object.world_from_object)[:3, 3]
    rotation = rotation_from_vector([tilt_rad, 0.0, 0.0])
    return transform(rotation, axis + radius * (rotation[:, 2] + tilt_rad * rotation[:, 1]))


def _case(scene: Scene, judge: Judge, *, tilt_deg: float, push_mm: float) -> Iterator[Trial]:
    pose = rolled_on(scene, np.radians(tilt_deg))
    edges = edge_poses(pose, scene.sheet.width_m * STRETCH)
    tip = pose[:3, 3] - 1e-3 * push_mm * pose[:3, 2] if push_mm else None
    believed = sheet_between(
        *edges,
        height_m=scene.sheet.height_m,
        twist_world=np.zeros(6),
        ahead_s=0.0,
        finger_tip=tip,
    )
    assert believed is not None
    seen_at = judge(scene, *edges, tip)
    case: Case = {"tilt_deg": tilt_deg, "push_mm": push_mm}
    for method in METHODS:
        in_range = covers(method, tilt_deg=tilt_deg, push_mm=push_mm)
        yield _trial(scene, method, believed, seen_at, case=case, in_range=in_range)


def _trial(
    scene: Scene,
    method: Correction,
    sheet: Sheet,
    seen_at: SeenAt,
    *,
    case: Case,
    in_range: bool,
) -> Trial:
    cylinder = cylinder_of(scene)
    surface = cylinder_surface(
        radius_m=cylinder.radius_m,
        length_m=cylinder.length_m,
        world_from_object=transform_of(scene.object.world_from_object),
        spacing_m=SPACING_M,
    )
    points, eye = surface.rest_world_m, scene.eyes.centre_world_m
    visible = np.einsum("ij,ij->i", normals_of(surface, points), eye - points) > 0.0
    screen, projector = screen_for(method, sheet), scene.projector.world_from_projector.position_m
    homography = projector_homography(scene)
    wanted = on_imaginary_screen(points[visible], eye)

    def run() -> tuple[Floats, Bools]:
        """Where on the imaginary screen (n, 2) the light of each vertex is sent, and whether."""
        if screen is None:
            return on_imaginary_screen(points, eye), np.ones(len(points), bool)
        corrected = correct(points, eye=eye, projector=projector, screen=screen)
        return corrected.on_screen[:, :2], corrected.valid

    def error_mm(result: tuple[Floats, Bools]) -> float:
        sent, valid = result[0][visible], result[1][visible]
        homogeneous = np.column_stack([sent, np.ones(len(sent))]) @ homography.T
        seen, lit = seen_at(homogeneous[:, :2] / homogeneous[:, 2:])
        counted = valid & lit
        if not counted.any():
            return float("inf")
        off = np.sum((seen[counted] - wanted[counted]) ** 2, axis=1)
        return 1e3 * float(np.sqrt(off.mean()))

    return Trial(method=method, case=case, run=run, error=error_mm, in_range=in_range)
