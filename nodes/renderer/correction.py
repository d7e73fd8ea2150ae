"""Correct the projected image for a moved or pushed sheet: equations (1)-(6) of the paper.

V is the eye, P the projector, A a point of the object. C is where the line V-A meets the actual
screen (the sheet). C' is where the line C-P meets the imaginary screen, and A' the point of the
line V-C' at A's depth. Drawn at A', the object is seen at A.

The actual screen is one plane, or the four triangles between the pushed point and the sheet's
corners. All points are in the world frame, metres. What cannot be corrected is masked (`valid`
false), never moved:

- a screen seen edge-on by the eye or the projector, within `GRAZING_SINE`, or from its other side;
- a point level with the eye or behind it, or one whose C is behind the eye or the projector.

A triangle without area takes the plane of the whole sheet, and so does a push below `MIN_PUSH_M`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flexsheet.nodes.models.camera import camera_matrix
from flexsheet.nodes.models.rigid import inverse

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

GRAZING_SINE = 0.05
"""Sine of the minimum angle (2.9 degrees) between a ray and the sheet. At that angle a pixel covers
twenty times its width."""

NEAR_M = 0.02
"""Object points closer to the eye's own depth than this are not drawn."""

MIN_PUSH_M = 1e-4
"""Below this depth the four triangles are the plane."""


@dataclass(frozen=True, slots=True)
class ScreenPlane:
    """A point of the plane (3,) and its unit normal (3,), which points to the user."""

    point: Floats
    normal: Floats


@dataclass(frozen=True, slots=True)
class ProjectionScreen:
    """The actual screen: four planes through one point, distinguished by the corners.

    point: r_s (3,), common to all four. normals: n_si (4, 3), towards the user. corners: (4, 3)
    counter-clockwise as the user sees them. Triangle i lies between corner i and the next. None
    when all four normals are one plane's.
    """

    point: Floats
    normals: Floats
    corners: Floats | None


@dataclass(frozen=True, slots=True)
class CorrectedPoints:
    """The corrected points A' (n, 3), their points C' on the screen (n, 3), and validity (n,).

    Points that are not valid hold A.
    """

    points: Floats
    on_screen: Floats
    valid: Bools


IMAGINARY_SCREEN = ScreenPlane(np.zeros(3), np.array([0.0, 0.0, 1.0]))
"""The world frame is the imaginary screen's: r_o, n_o."""


def make_flat_screen(plane: ScreenPlane) -> ProjectionScreen:
    """Return the screen that is one plane."""
    return ProjectionScreen(plane.point, np.tile(plane.normal, (4, 1)), None)


def make_pushed_screen(
    pushed_point: Floats, corners: Floats, plane: ScreenPlane
) -> ProjectionScreen:
    """Return the four triangles between the pushed point and the sheet's corners (section III-C 3).

    pushed_point: (3,). corners: (4, 3), left bottom, right bottom, right top, left top. plane: of
    the sheet at rest. It replaces triangles without area, and all four when the push is less than
    `MIN_PUSH_M`.
    """
    if abs((pushed_point - plane.point) @ plane.normal) < MIN_PUSH_M:
        return make_flat_screen(plane)
    spokes = corners - pushed_point
    normals = np.cross(spokes, np.roll(spokes, -1, axis=0))
    areas = np.linalg.norm(normals, axis=1, keepdims=True)
    smallest = 1e-6 * float(np.max(np.sum(spokes**2, axis=1)))
    normals = np.where(areas > smallest, normals / np.maximum(areas, smallest), plane.normal)
    return ProjectionScreen(pushed_point, normals, corners)


def sector_normals(screen: ProjectionScreen, eye: Floats) -> Floats:
    """Return (4, 3) unit normals of the planes through the eye, the pushed point and each corner.

    Seen from the eye the four spokes divide the image into sectors. A direction d lies in the
    sector after spoke i when d . normal_i >= 0 > d . normal_(i+1). Zeros for one plane, and for a
    spoke that the eye sees end-on.
    """
    if screen.corners is None:
        return np.zeros((4, 3))
    normals = np.cross(screen.corners - eye, screen.point - eye)
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.where(lengths > 1e-9, normals / np.maximum(lengths, 1e-9), 0.0)


def select_triangles(points: Floats, screen: ProjectionScreen, eye: Floats) -> NDArray[np.intp]:
    """Return the triangle (n,) of each point: the one that the line V-A crosses.

    It is the sector in which the line lies deepest. Inside the sheet's outline that is the triangle
    which is hit. Outside, the sectors continue, so that every point has exactly one. Where the
    indentation folds over itself as seen from the eye, the choice is unique but ignores depth.
    """
    sides = (points - eye) @ sector_normals(screen, eye).T
    depths = np.minimum(sides, -np.roll(sides, -1, axis=1))
    triangles: NDArray[np.intp] = np.argmax(depths, axis=1)
    return triangles


def actual_point(points: Floats, eye: Floats, r_s: Floats, n_s: Floats) -> tuple[Floats, Bools]:
    """Return C (n, 3) by equations (1) and (2), and where it exists, before the eye and not
    grazing.

    r_s: (3,). n_s: (n, 3), a normal per point.
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
    """Return C' (n, 3) by equations (3) and (4), and where the projector lights the screen's
    back."""
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
    """Return A' (n, 3) by equations (5) and (6), and where A is in front of the eye."""
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
    """Return A' of every point A (n, 3) by equations (1)-(6); `object.vert.glsl` does the same.

    Raises ValueError unless the eye is in front of the imaginary screen and the projector behind
    it.
    """
    if (eye - imaginary.point) @ imaginary.normal <= NEAR_M:
        raise ValueError(f"the eye {eye} is not in front of the imaginary screen")
    if (projector - imaginary.point) @ imaginary.normal >= 0.0:
        raise ValueError(f"the projector {projector} is not behind the imaginary screen")
    n_s = screen.normals[select_triangles(points, screen, eye)]
    on_actual, seen = actual_point(points, eye, screen.point, n_s)
    on_imaginary, lit = imaginary_point(on_actual, projector, n_s, imaginary)
    shifted, in_front = shifted_point(points, on_imaginary, eye, imaginary)
    valid = seen & lit & in_front
    keep = valid[:, None]
    return CorrectedPoints(
        np.where(keep, shifted, points), np.where(keep, on_imaginary, points), valid
    )


def is_plane_usable(plane: ScreenPlane, eye: Floats, projector: Floats) -> bool:
    """Return whether the eye sees the front and the projector lights the back at the plane's
    point."""
    to_eye, light = eye - plane.point, plane.point - projector
    return bool(
        to_eye @ plane.normal > GRAZING_SINE * np.linalg.norm(to_eye)
        and light @ plane.normal > GRAZING_SINE * np.linalg.norm(light)
    )


def on_imaginary_screen(points: Floats, eye: Floats) -> Floats:
    """Return where (n, 2) lines from the eye to points (n, 3) cross z = 0, the imaginary screen."""
    fraction = eye[2] / (eye[2] - points[:, 2])
    crossings: Floats = eye[:2] + (points[:, :2] - eye[:2]) * fraction[:, None]
    return crossings


def pixel_from_screen(
    *,
    fx_px: float,
    fy_px: float,
    cx_px: float,
    cy_px: float,
    world_from_projector: Floats,
) -> Floats:
    """Return the homography (3, 3) from (x, y, 1) on the imaginary screen, metres, to projector
    pixels.

    It is that of a pinhole; a lens distorts the pixels afterwards (`lens.py`).
    """
    projector_from_world = inverse(world_from_projector)
    columns = projector_from_world[:3, [0, 1, 3]]
    homography: Floats = camera_matrix(fx_px, fy_px, cx_px, cy_px) @ columns
    homography /= homography[2, 2]
    return homography


def clip_from_screen(pixel_from_screen: Floats, width_px: int, height_px: int) -> Floats:
    """Return (3, 3): homogeneous (x, y, w) on the imaginary screen to OpenGL's clip (x, y, w).

    Pixel (0, 0) is the centre of the top left pixel.
    """
    clip_from_pixel = np.array(
        [
            [2.0 / width_px, 0.0, 1.0 / width_px - 1.0],
            [0.0, -2.0 / height_px, 1.0 - 1.0 / height_px],
            [0.0, 0.0, 1.0],
        ]
    )
    clip: Floats = clip_from_pixel @ pixel_from_screen
    return clip
