"""Compute the corrected points of the paper's equations (1)-(6), as a reference for the shader.

C, C', A and A' are defined in `flexsheet.nodes.renderer.correction`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flexsheet.nodes.renderer.correction import (
    GRAZING_SINE,
    NEAR_M,
    ProjectionScreen,
    ScreenPlane,
    sector_normals,
)

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

IMAGINARY_SCREEN = ScreenPlane(np.zeros(3), np.array([0.0, 0.0, 1.0]))
"""Imaginary screen: the plane z = 0 of the world (point r_o and normal n_o in the equations)."""


@dataclass(frozen=True, slots=True)
class CorrectedPoints:
    """Corrected points A' (n, 3), points C' on the imaginary screen (n, 3), and validity (n,).

    Where a point is invalid, both are equal to the point A of the object.
    """

    points: Floats
    on_screen: Floats
    valid: Bools


def select_triangles(points: Floats, screen: ProjectionScreen, eye: Floats) -> NDArray[np.intp]:
    """Return the index (n,) of the triangle that the line V-A intersects, for each point A.

    The line is in the sector whose boundaries are farthest from it. Sectors extend beyond the
    sheet's outline, so each point is in exactly one. If triangles overlap as seen from the eye,
    their order in depth is ignored.
    """
    sides = (points - eye) @ sector_normals(screen, eye).T
    depths = np.minimum(sides, -np.roll(sides, -1, axis=1))
    triangles: NDArray[np.intp] = np.argmax(depths, axis=1)
    return triangles


def actual_point(points: Floats, eye: Floats, r_s: Floats, n_s: Floats) -> tuple[Floats, Bools]:
    """Return the points C (n, 3) on the actual screen by equations (1) and (2), and validity (n,).

    r_s: (3,), point of the screen. n_s: (n, 3), normal of the screen for each point. C is invalid
    behind the eye, and if the eye sees the screen at less than the minimum angle.
    """
    denominator = np.sum((eye - points) * n_s, axis=1)
    length = np.linalg.norm(eye - points, axis=1)
    valid = denominator > GRAZING_SINE * length
    s1 = np.sum((r_s - points) * n_s, axis=1) / np.where(valid, denominator, 1.0)
    valid &= s1 < 1.0
    return s1[:, None] * eye + (1.0 - s1)[:, None] * points, valid


def imaginary_point(
    on_actual: Floats, projector: Floats, n_s: Floats, imaginary: ScreenPlane
) -> tuple[Floats, Bools]:
    """Return the points C' (n, 3) on the imaginary screen by equations (3) and (4).

    The second result is whether the projector illuminates the sheet there from behind, (n,).
    """
    light = on_actual - projector
    denominator = light @ imaginary.normal
    length = np.linalg.norm(light, axis=1)
    valid = (denominator > GRAZING_SINE * length) & (
        np.sum(light * n_s, axis=1) > GRAZING_SINE * length
    )
    s2 = ((imaginary.point - projector) @ imaginary.normal) / np.where(valid, denominator, 1.0)
    return s2[:, None] * on_actual + (1.0 - s2)[:, None] * projector, valid


def shifted_point(
    points: Floats, on_imaginary: Floats, eye: Floats, imaginary: ScreenPlane
) -> tuple[Floats, Bools]:
    """Return the corrected points A' (n, 3) by equations (5) and (6).

    The second result is whether A is in front of the eye, (n,).
    """
    normal = imaginary.normal
    valid = (eye - points) @ normal > NEAR_M
    denominator = (eye - on_imaginary) @ normal
    s3 = np.sum((points - on_imaginary) * normal, axis=1) / denominator
    return s3[:, None] * eye + (1.0 - s3)[:, None] * on_imaginary, valid


def correct(
    points: Floats,
    *,
    eye: Floats,
    projector: Floats,
    screen: ProjectionScreen,
    imaginary: ScreenPlane = IMAGINARY_SCREEN,
) -> CorrectedPoints:
    """Compute the corrected points A' of points A (n, 3) by equations (1)-(6).

    It is the reference for the shader `object.vert.glsl`. Raises ValueError unless the eye is in
    front of the imaginary screen and the projector behind it.
    """
    if (eye - imaginary.point) @ imaginary.normal <= NEAR_M:
        raise ValueError(f"eye position {eye} m is not in front of the imaginary screen")
    if (projector - imaginary.point) @ imaginary.normal >= 0.0:
        raise ValueError(f"projector position {projector} m is not behind the imaginary screen")
    n_s = screen.normals[select_triangles(points, screen, eye)]
    on_actual, seen = actual_point(points, eye, screen.point, n_s)
    on_imaginary, lit = imaginary_point(on_actual, projector, n_s, imaginary)
    shifted, in_front = shifted_point(points, on_imaginary, eye, imaginary)
    valid = seen & lit & in_front
    keep = valid[:, None]
    return CorrectedPoints(
        np.where(keep, shifted, points), np.where(keep, on_imaginary, points), valid
    )
