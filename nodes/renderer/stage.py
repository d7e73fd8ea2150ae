"""What is drawn for one scene: the object, the projector, and the sheet as it is believed to be."""

from __future__ import annotations

from dataclasses import dataclass

import moderngl
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from messages.scene import Pose, Scene, cylinder_of
from messages.types import Correction, Display, Fingertip, SheetTarget, Skin, SoftBody
from nodes.models.rigid import apply, inverse, moved, transform, transform_from_rpy
from nodes.models.shapes import CylinderShape
from nodes.models.sheet import corners, sheet_from_edges
from nodes.renderer.correction import (
    Plane,
    Screen,
    clip_from_screen,
    flat_screen,
    pixel_from_screen,
    plane_is_usable,
    pushed_screen,
)
from nodes.renderer.gl import SAMPLES, Canvas, Look, View
from nodes.renderer.output import Image, pack
from nodes.renderer.surface import cylinder_surface, follow_matrix, normals_of

Floats = NDArray[np.float64]

LEAST_EDGE_DISTANCE_M = 0.05
"""Flanges nearer to one another than this hold no sheet: the poses are not believed."""


@dataclass(frozen=True, slots=True)
class Sheet:
    """The sheet as it is believed to be when the light leaves.

    world_from_sheet: (4, 4).  corners: (4, 3).  pushed_point: (3,) in the world, or None.
    """

    world_from_sheet: Floats
    corners: Floats
    pushed_point: Floats | None

    @property
    def plane(self) -> Plane:
        return Plane(self.world_from_sheet[:3, 3], self.world_from_sheet[:3, 2])

    @property
    def foremost_point(self) -> Floats:
        """The pushed point, or the sheet's centre when nothing pushes it."""
        return self.plane.point if self.pushed_point is None else self.pushed_point


def transform_of(pose: Pose) -> Floats:
    return transform_from_rpy(pose.position_m, pose.rpy_rad)


def sheet_between(
    world_from_left_edge: Floats,
    world_from_right_edge: Floats,
    *,
    height_m: float,
    twist_world: Floats,
    ahead_s: float,
    finger_tip: Floats | None,
) -> Sheet | None:
    """The sheet between two edges, moved on by `twist_world` (6,) for `ahead_s`.

    finger_tip: (3,) at that instant, or None.  It pushes the sheet when it is below the plane and
    over the sheet.  None when the edges are too near to one another to hold a sheet.
    """
    left, right = world_from_left_edge, world_from_right_edge
    distance = float(np.linalg.norm(right[:3, 3] - left[:3, 3]))
    if distance < LEAST_EDGE_DISTANCE_M:
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
    return Sheet(later, corner_points, pushed_point)


def screen_for(method: Correction, sheet: Sheet) -> Screen | None:
    """The screen that a correction method assumes; None for no correction."""
    if method == "none":
        return None
    if method == "four_triangles" and sheet.pushed_point is not None:
        return pushed_screen(sheet.pushed_point, sheet.corners, sheet.plane)
    return flat_screen(sheet.plane)


def projector_homography(scene: Scene) -> Floats:
    """(3, 3): the imaginary screen, metres, to projector pixels; ValueError if there is none."""
    lens = scene.projector.lens
    return pixel_from_screen(
        fx_px=lens.fx_px,
        fy_px=lens.fy_px,
        cx_px=lens.cx_px,
        cy_px=lens.cy_px,
        distortion=lens.distortion,
        world_from_projector=transform_of(scene.projector.world_from_projector),
    )


class Stage:
    """A scene ready to be drawn."""

    def __init__(
        self,
        scene: Scene,
        context: moderngl.Context,
        *,
        spacing_m: float,
        samples: int = SAMPLES,
    ) -> None:
        """ValueError for a projector that no homography describes."""
        projector, cylinder = scene.projector, cylinder_of(scene)
        self.scene = scene
        self._world_from_projector = transform_of(projector.world_from_projector)
        self._world_from_object = transform_of(scene.object.world_from_object)
        self._clip_from_screen = clip_from_screen(
            projector_homography(scene), projector.width_px, projector.height_px
        )
        self._shape = CylinderShape(cylinder.radius_m, cylinder.length_m)
        self._surface = cylinder_surface(
            radius_m=cylinder.radius_m,
            length_m=cylinder.length_m,
            world_from_object=self._world_from_object,
            spacing_m=spacing_m,
        )
        self.canvas = Canvas(context, projector.width_px, projector.height_px, samples=samples)
        self.canvas.set_mesh(self._surface.rest_world_m, self._surface.triangles)
        self._follow: csr_array | None = None
        self._shaped_by: SoftBody | None = None
        self._is_shaped = False
        self.shape(None)
        self.mesh_id: str | None = None

    def follow(self, skin: Skin) -> None:
        """From now on the drawn surface follows displacements of this skin."""
        self._follow = follow_matrix(
            self._surface.rest_world_m, skin.vertices_world_m.astype(np.float64), skin.triangles
        )
        self.mesh_id = skin.mesh_id

    def shape(self, body: SoftBody | None) -> None:
        """Deform the surface as a soft body of the followed skin says; None puts it to rest.

        ValueError when the displacement is not of that skin.
        """
        if body is self._shaped_by and self._is_shaped:
            return
        positions = self._surface.rest_world_m
        if body is not None:
            displacement = body.displacement_world_m
            if self._follow is None or self._follow.shape[1] != len(displacement):
                raise ValueError(f"displacement of {len(displacement)} vertices fits no skin")
            positions = positions + self._follow @ displacement
        self.canvas.set_shape(positions, normals_of(self._surface, positions))
        self._shaped_by, self._is_shaped = body, True

    def look(self, shown: Display, finger: Fingertip | None, target: SheetTarget | None) -> Look:
        """How to paint what is shown: marks where the finger is and where the sheet is tangent."""
        marks = shown.marks and shown.pattern == "object" and shown.shading == "soft"
        return Look(
            flat=shown.shading == "flat",
            pattern=shown.pattern,
            fingertip_mark=self.surface_point(finger.position_world_m)
            if marks and finger is not None and finger.valid
            else None,
            target_mark=target.contact_world_m if marks and target is not None else None,
        )

    def surface_point(self, world_point: Floats) -> Floats:
        """The point (3,) of the undeformed object nearest to a world point, for the marks."""
        point = apply(inverse(self._world_from_object), world_point)
        nearest = self._shape.closest(point)
        return apply(self._world_from_object, nearest.point)

    def sheet_at_rest(self) -> Sheet:
        """The slack sheet on the imaginary screen: assumed while no arm has said otherwise."""
        half = 0.5 * self.scene.sheet.width_m * np.array([1.0, 0.0, 0.0])
        left, right = transform(np.eye(3), -half), transform(np.eye(3), half)
        return Sheet(np.eye(4), corners(left, right, self.scene.sheet.height_m), None)

    def usable(self, sheet: Sheet) -> bool:
        """Whether the eyes see the sheet's front and the projector lights its back."""
        centre = self.scene.eyes.centre_world_m
        return plane_is_usable(sheet.plane, centre, self._world_from_projector[:3, 3])

    def eyes(self, display: Display) -> Floats:
        """(2, 3): left and right eye in the world; twice the point of view when mono."""
        half = 0.0 if display.stereo == "mono" else 0.5 * self.scene.eyes.interocular_m
        offset = np.array([half, 0.0, 0.0])
        centre = self.scene.eyes.centre_world_m
        return np.stack([centre - offset, centre + offset])

    def draw(self, display: Display, sheet: Sheet, look: Look, *, read: bool) -> Image | None:
        """Draw what the projector shall show; the picture (height, width, 3) if `read`.

        The second eye needs the frame of the first to be read or shown before, so in stereo each
        is read when pixels are wanted.
        """
        screen = screen_for(display.correction, sheet)
        eyes = self.eyes(display)
        pictures = []
        for eye in eyes[:1] if display.stereo == "mono" else eyes:
            projector = self._world_from_projector[:3, 3]
            self.canvas.draw(View(eye, projector, screen, self._clip_from_screen), look)
            if read:
                pictures.append(self.canvas.read())
        if not read:
            return None
        return pack(pictures[0], pictures[-1], display.stereo, swap_eyes=display.swap_eyes)
