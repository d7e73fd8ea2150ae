"""What is drawn for one scene: the object, the projector, and the sheet as it is believed to be."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product

import moderngl
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from messages.methods import SheetShapeMethod
from messages.scene import Mesh, Pose, Scene
from messages.types import Display, SheetTarget, Skin, SoftBody
from nodes.models.rigid import apply, inverse, transform, transform_from_rpy
from nodes.models.shapes import make_shape
from nodes.models.sheet import corners
from nodes.models.sheet.indentation import IndentationBasis
from nodes.renderer.correction import (
    NEAR_M,
    Screen,
    clip_from_screen,
    on_imaginary_screen,
    pixel_from_screen,
    plane_is_usable,
)
from nodes.renderer.gl import SAMPLES, SCREEN_PATTERNS, Canvas, Look, Paint, View
from nodes.renderer.lens import clip_lens
from nodes.renderer.output import Image, both_eyes, pack
from nodes.renderer.projection import Projection, Window
from nodes.renderer.sheet import Sheet, screen_for
from nodes.renderer.sheet_mesh import (
    FLAT_TO_M,
    TRIANGLES_TO_M,
    SheetMesh,
    dented_mesh,
    finer,
    flat_mesh,
    lost_share,
    pyramid_mesh,
)
from nodes.renderer.surface import Follower, surface_of

Floats = NDArray[np.float64]

OVERSAMPLING = 1.5
"""Pixels of the eye's picture to one of the projector's."""

WINDOW_MARGIN_M, WINDOW_STEP_M = 0.001, 0.004
"""The window goes by steps, lest an outline's pixels swim as the object moves."""
WIDEST_M = 0.3
"""The window's reach from the screen's middle: farther out no sheet is."""
LEAST_LOST = 0.005
"""A smaller share that folds take is not told."""
NO_DENTS = "no dent shapes at hand: a pushed sheet is taken for four triangles (flexsheet prepare)"

GRID_WINDOW = Window(-0.151, -0.151, 0.302, 0.302)


def transform_of(pose: Pose) -> Floats:
    return transform_from_rpy(pose.position_m, pose.rpy_rad)


def projector_homography(scene: Scene) -> Floats:
    """(3, 3): the imaginary screen, metres, to projector pixels before the lens bends them."""
    lens = scene.projector.lens
    return pixel_from_screen(
        fx_px=lens.fx_px,
        fy_px=lens.fy_px,
        cx_px=lens.cx_px,
        cy_px=lens.cy_px,
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
        dents: IndentationBasis | None = None,
        sheet_shape: SheetShapeMethod = "dents",
    ) -> None:
        """dents: of the scene's sheet, for the two-pass projection; without them a pushed sheet is
        taken for four triangles.  ValueError for a lens that folds the projector's picture.
        """
        projector, geometry = scene.projector, scene.object.geometry
        self.scene = scene
        self._world_from_projector = transform_of(projector.world_from_projector)
        self._world_from_object = transform_of(scene.object.world_from_object)
        size = projector.width_px, projector.height_px
        self._clip_from_screen = clip_from_screen(projector_homography(scene), *size)
        self._lens = clip_lens(projector.lens, *size)
        self._shape = make_shape(dict(geometry))
        self._surface = surface_of(
            geometry,
            self._shape,
            world_from_object=self._world_from_object,
            spacing_m=spacing_m,
        )
        self._object_from_world = inverse(self._world_from_object)
        # From the nearest vertex on, the nearest point of a mesh is found ten times as fast.
        meshed = isinstance(geometry, Mesh)
        self._near = cKDTree(self._surface.rest_world_m) if meshed else None
        self.canvas = Canvas(context, projector.width_px, projector.height_px, samples=samples)
        self.canvas.set_mesh(
            self._surface.rest_world_m, self._surface.triangles, self._surface.normals_world
        )
        self.canvas.set_paint(self._paint())
        self.dents, self.sheet_shape, self.note = dents, sheet_shape, ""
        self.lost_share = 0.0
        self._box_world = _box_around(self._surface.rest_world_m)
        window = self._window(scene.eyes.centre_world_m)
        across_px = OVERSAMPLING * projector_homography(scene)[0, 0]
        self._projection = Projection(
            context,
            round(abs(across_px) * window.width),
            round(abs(across_px) * window.height),
            samples=samples,
        )
        self._follower: Follower | None = None
        self._shaped_by: SoftBody | None = None
        self.mesh_id: str | None = None

    def _paint(self) -> Paint:
        """The scene's appearance; an image is fitted to the object's front."""
        appearance, object_from_world = (
            self.scene.object.appearance,
            inverse(self._world_from_object),
        )
        front = apply(object_from_world, self._surface.rest_world_m)[:, :2]
        low, extent = front.min(axis=0), np.ptp(front, axis=0)
        image_from_object = np.diag([*(1.0 / extent), 1.0, 1.0])
        image_from_object[:2, 3] = -low / extent
        return Paint(
            colour=appearance.colour,
            texture=appearance.texture,
            pitch_m=appearance.texture_pitch_m,
            image=appearance.image,
            image_from_world=image_from_object @ object_from_world,
            object_from_world=object_from_world,
        )

    def follow(self, skin: Skin) -> None:
        """From now on the drawn surface follows displacements of this skin."""
        vertices = skin.vertices_world_m.astype(np.float64)
        self._follower = Follower(self._surface, vertices, skin.triangles)
        self.mesh_id = skin.mesh_id

    def shape(self, body: SoftBody | None) -> None:
        """Deform the surface as a soft body of the followed skin says; None puts it to rest.

        ValueError when the displacement is not of that skin, or not finite: the surface stays.
        """
        if body is self._shaped_by:
            return
        if body is None:
            self.canvas.set_shape(self._surface.rest_world_m, self._surface.normals_world)
            self._box_world = _box_around(self._surface.rest_world_m)
        elif self._follower is None:
            raise ValueError("a soft body came before its skin")
        else:
            moved = self._follower.moved(body.displacement_world_m)
            self.canvas.set_moved(moved)
            self._box_world = _box_around(moved[:, :3])
        self._shaped_by = body

    def look(self, shown: Display, finger_tip: Floats | None, target: SheetTarget | None) -> Look:
        """How to paint what is shown: marks where the finger is and where the sheet is tangent.

        finger_tip: (3,) when the light leaves, or None when it is not known.
        """
        marks = shown.marks and shown.pattern == "object" and shown.shading == "soft"
        return Look(
            flat=shown.shading == "flat",
            pattern=shown.pattern,
            fingertip_mark=self.surface_point(finger_tip)
            if marks and finger_tip is not None
            else None,
            target_mark=target.contact_world_m if marks and target is not None else None,
        )

    def surface_point(self, world_point: Floats) -> Floats:
        """The point (3,) of the undeformed object nearest to a world point, for the marks."""
        start = None
        if self._near is not None:
            _, vertex = self._near.query(world_point)
            start = apply(self._object_from_world, self._surface.rest_world_m[vertex])
        nearest = self._shape.closest(apply(self._object_from_world, world_point), previous=start)
        return apply(self._world_from_object, nearest.point)

    def sheet_at_rest(self) -> Sheet:
        """The slack sheet on the imaginary screen: assumed while no arm has said otherwise."""
        half = 0.5 * self.scene.sheet.width_m * np.array([1.0, 0.0, 0.0])
        left, right = transform(np.eye(3), -half), transform(np.eye(3), half)
        return Sheet(np.eye(4), corners(left, right, self.scene.sheet.height_m), None)

    def usable(self, sheet: Sheet, centre: Floats | None = None) -> bool:
        """Whether the eyes, about `centre` (3,) or the scene's, see the sheet's front and the
        projector lights its back."""
        eye = self.scene.eyes.centre_world_m if centre is None else centre
        return plane_is_usable(sheet.plane, eye, self._world_from_projector[:3, 3])

    def eyes(self, display: Display) -> Floats:
        """(2, 3): the scene's left and right eye; twice the point of view when mono."""
        return both_eyes(self.scene.eyes, display.stereo)

    def draw(
        self,
        display: Display,
        sheet: Sheet,
        look: Look,
        *,
        read: bool,
        eyes: Floats | None = None,
        drawn: Callable[[int], None] = lambda number: None,
    ) -> Image | None:
        """Draw what the projector shall show; the picture (height, width, 3) if `read`.

        eyes: (1 or 2, 3), one picture each; None: the scene's, one when mono.  `drawn(number)` is
        called when an eye's picture is in `canvas.resolved`, which the next one takes.
        ValueError for a sheet that is nowhere (NaN).
        """
        if not np.isfinite(sheet.world_from_sheet.sum() + sheet.corners.sum()):
            raise ValueError("the sheet's pose is not finite")
        if display.correction == "two_pass":
            mesh = self.sheet_mesh(sheet)
            self._tell_folds(mesh, self.eyes(display)[0] if eyes is None else eyes[0])
            return self.draw_onto(display, mesh, look, read=read, eyes=eyes, drawn=drawn)
        screen = screen_for(display.correction, sheet)

        def draw_eye(eye: Floats) -> None:
            self.canvas.draw(self.view(eye, screen), look)

        return self._draw_eyes(display, draw_eye, read=read, eyes=eyes, drawn=drawn)

    def draw_onto(
        self,
        display: Display,
        mesh: SheetMesh,
        look: Look,
        *,
        read: bool,
        eyes: Floats | None = None,
        drawn: Callable[[int], None] = lambda number: None,
    ) -> Image | None:
        """As `draw`, in two passes onto a sheet of that shape."""

        def draw_eye(eye: Floats) -> None:
            window = GRID_WINDOW if look.pattern in SCREEN_PATTERNS else self._window(eye)
            self._projection.draw(self.canvas, mesh, self.view(eye), look, window)

        return self._draw_eyes(display, draw_eye, read=read, eyes=eyes, drawn=drawn)

    def view(self, eye: Floats, screen: Screen | None = None) -> View:
        """What an eye's picture is drawn with; corrected for a screen, or not."""
        projector = self._world_from_projector[:3, 3]
        return View(eye, projector, screen, self._clip_from_screen, self._lens)

    def _draw_eyes(
        self,
        display: Display,
        draw_eye: Callable[[Floats], None],
        *,
        read: bool,
        eyes: Floats | None,
        drawn: Callable[[int], None],
    ) -> Image | None:
        if eyes is None:
            eyes = self.eyes(display)[: 1 if display.stereo == "mono" else 2]
        pictures = []
        for number, eye in enumerate(eyes):
            draw_eye(eye)
            drawn(number)
            if read:
                pictures.append(self.canvas.read())
        if not read:
            return None
        if len(pictures) == 1:
            return pictures[0]
        return pack(pictures[0], pictures[-1], display.stereo, swap_eyes=display.swap_eyes)

    def sheet_mesh(self, sheet: Sheet) -> SheetMesh:
        """The sheet as `sheet_shape` has it; of dents, four triangles as long as no dent shapes are
        at hand.

        `note` says where it is not quite so.
        """
        if self.sheet_shape != "dents" or self.dents is None:
            self.note = NO_DENTS if self.sheet_shape == "dents" else self._too_deep(sheet)
            mesh = flat_mesh(sheet) if self.sheet_shape == "flat" else pyramid_mesh(sheet)
            return mesh if self._lens is None else finer(mesh)
        mesh = dented_mesh(sheet, self.dents)
        self.note = mesh.note
        return mesh

    def _too_deep(self, sheet: Sheet) -> str:
        """Of a push past what the chosen shape stands for; empty within it."""
        if sheet.pushed_point is None:
            return ""
        depth_m = -float(apply(inverse(sheet.world_from_sheet), sheet.pushed_point)[2])
        to_m = FLAT_TO_M if self.sheet_shape == "flat" else TRIANGLES_TO_M
        if depth_m <= to_m:
            return ""
        told = "flat" if self.sheet_shape == "flat" else "four triangles"
        return (
            f"pushed {1e3 * depth_m:.0f} mm: taken for {told}, which holds to {1e3 * to_m:g} mm; "
            "sheet_shape: dents goes further"
        )

    def _tell_folds(self, mesh: SheetMesh, eye: Floats) -> None:
        """Measure and note what of the sheet gets no light because it is folded."""
        self.lost_share = lost_share(mesh, eye, self._world_from_projector[:3, 3])
        if self.lost_share > LEAST_LOST:
            told = f"{100.0 * self.lost_share:.0f} % of the sheet is folded and gets no light"
            self.note = "; ".join(filter(None, (self.note, told)))

    def _window(self, eye: Floats) -> Window:
        """What of the imaginary screen the object covers, as the eye sees it.

        What is level with the eye or behind it is not drawn; the window ends at `WIDEST_M`.
        """
        box = np.minimum(self._box_world, [np.inf, np.inf, eye[2] - NEAR_M])
        crossings = on_imaginary_screen(box, eye)
        low = np.clip(crossings.min(axis=0) - WINDOW_MARGIN_M, -WIDEST_M, WIDEST_M - WINDOW_STEP_M)
        high = np.clip(crossings.max(axis=0) + WINDOW_MARGIN_M, low + WINDOW_MARGIN_M, WIDEST_M)
        low = np.floor(low / WINDOW_STEP_M) * WINDOW_STEP_M
        high = np.ceil(high / WINDOW_STEP_M) * WINDOW_STEP_M
        return Window(float(low[0]), float(low[1]), *(float(side) for side in high - low))

    def release(self) -> None:
        """Free what is on the graphics card; the context stays."""
        self.canvas.release()
        self._projection.release()


def _box_around(points: NDArray[np.floating]) -> Floats:
    """Corners (8, 3) of the box around points."""
    low, high = points.min(axis=0).astype(np.float64), points.max(axis=0).astype(np.float64)
    return np.array(list(product(*zip(low, high, strict=True))))
