"""Correct the projected image for a moved or pushed sheet (Furukawa et al. 2007, eq. (1)-(6)).

The image is drawn for the imaginary screen, which is the fixed plane z = 0. It is projected onto
the actual screen, which is the sheet. V is the eye, P the projector and A a point of the object. C
is the intersection of the line V-A with the actual screen. C' is the intersection of the line C-P
with the imaginary screen. A' is the point of the line V-C' that has the same depth as A. If the
point is drawn at A', the eye sees it at A.

The actual screen is either one plane, or four triangles between the pushed point and the sheet's
corners. All points are in the world frame, in m. A point A is invalid and is not moved in two
cases:

- The eye or the projector sees the screen from the other side, or at an angle whose sine is below
    `GRAZING_SINE`.
- The point is not in front of the eye, or its point C is behind the eye or the projector.

If the area of a triangle is zero, the plane of the sheet replaces this triangle. If the push is too
shallow, the plane replaces all four triangles.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flexsheet.messages.scene import Lens
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.models.camera import camera_matrix
from flexsheet.nodes.models.rigid import inverse

GRAZING_SINE = 0.05
"""The sine of the minimum angle (2.9 degrees) between a ray and the sheet. At this angle, a pixel
on the sheet is stretched by a factor of 20."""

NEAR_M = 0.02
"""The minimum distance (m) from the eye, along the z axis, at which points are drawn."""

MIN_PUSH_M = 1e-4
"""The minimum push depth (m) at which the screen is four triangles instead of a plane."""


@dataclass(frozen=True, slots=True)
class ScreenPlane:
    """A plane through a point (3,), m, with a unit normal (3,) that points towards the user."""

    point: Floats
    normal: Floats


@dataclass(frozen=True, slots=True)
class ProjectionScreen:
    """The actual screen: four triangles with a common vertex, or one plane.

    point (3,): common vertex, m (r_s in Furukawa et al. 2007). normals (4, 3): unit normals towards
    the user (n_si in the paper). For a plane, the normals are equal. corners (4, 3): corners, m,
    counter-clockwise as seen by the user; None if the screen is one plane. Triangle i is between
    corner i and the next corner.
    """

    point: Floats
    normals: Floats
    corners: Floats | None


def make_flat_screen(plane: ScreenPlane) -> ProjectionScreen:
    """Return a screen that consists of one plane."""
    return ProjectionScreen(plane.point, np.tile(plane.normal, (4, 1)), None)


def make_pushed_screen(
    pushed_point: Floats, corners: Floats, plane: ScreenPlane
) -> ProjectionScreen:
    """Return the screen of four triangles between the pushed point and the sheet's corners.

    pushed_point (3,), m. corners (4, 3): left bottom, right bottom, right top, left top, m. plane:
    plane of the sheet as if it were not pushed. It replaces each triangle whose area is zero. It
    replaces all triangles if the push depth is below `MIN_PUSH_M`. Source: section III-C 3 of
    Furukawa et al. 2007.
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
    """Return unit normals (4, 3) of the planes through the eye, the pushed point and each corner.

    A pushed sheet is represented by four triangles between the pushed point and the sheet's
    corners. From the eye, each triangle covers one sector around the pushed point. A direction d is
    in sector i if d . normal_i >= 0 > d . normal_(i+1).

    eye (3,): position of the eye, m.

    All normals are zero if the screen is one plane. The normal of a corner is zero if the eye is on
    the line through the pushed point and this corner.
    """
    if screen.corners is None:
        return np.zeros((4, 3))
    normals = np.cross(screen.corners - eye, screen.point - eye)
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.where(lengths > 1e-9, normals / np.maximum(lengths, 1e-9), 0.0)


def is_plane_usable(plane: ScreenPlane, eye: Floats, projector: Floats) -> bool:
    """Return whether the eye sees the front of a plane and the projector illuminates its back.

    eye, projector (3,): positions, m.
    """
    to_eye, light = eye - plane.point, plane.point - projector
    return bool(
        to_eye @ plane.normal > GRAZING_SINE * np.linalg.norm(to_eye)
        and light @ plane.normal > GRAZING_SINE * np.linalg.norm(light)
    )


def on_imaginary_screen(points: Floats, eye: Floats) -> Floats:
    """Return the points (n, 2) where lines from the eye to points (n, 3) meet the plane z = 0."""
    fraction = eye[2] / (eye[2] - points[:, 2])
    crossings: Floats = eye[:2] + (points[:, :2] - eye[:2]) * fraction[:, None]
    return crossings


def pixel_from_screen(lens: Lens, world_from_projector: Floats) -> Floats:
    """Return the homography (3, 3) from (x, y, 1), in m, on the plane z = 0 to projector pixels.

    The projector is modelled as a pinhole that has no lens distortion. world_from_projector (4, 4):
    pose of the projector.
    """
    projector_from_world = inverse(world_from_projector)
    columns = projector_from_world[:3, [0, 1, 3]]
    matrix = camera_matrix(lens.fx_px, lens.fy_px, lens.cx_px, lens.cy_px)
    homography: Floats = matrix @ columns
    homography /= homography[2, 2]
    return homography


def clip_from_screen(pixel_from_screen: Floats, width_px: int, height_px: int) -> Floats:
    """Return the matrix (3, 3) from (x, y, 1) on the plane z = 0 to OpenGL clip coordinates.

    pixel_from_screen (3, 3): homography to pixels, whose origin is the centre of the top left
    pixel. The clip coordinates are (x, y, w).
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
