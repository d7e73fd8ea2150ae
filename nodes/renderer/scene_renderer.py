"""Draw the images of one scene for the projector."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product

import moderngl
import numpy as np
import scipy
from numpy.typing import NDArray

from flexsheet.messages.methods import SheetShapeMethod
from flexsheet.messages.scene import Mesh, Scene, require_projector
from flexsheet.messages.types import Display, SheetTarget, Skin, SoftBody
from flexsheet.nodes.arrays import Floats, Image
from flexsheet.nodes.cache import advise_precompute
from flexsheet.nodes.models.rigid import apply, inverse, pose_matrix, transform
from flexsheet.nodes.models.shapes import make_shape
from flexsheet.nodes.models.sheet import corners
from flexsheet.nodes.models.sheet.indentation import IndentationBasis
from flexsheet.nodes.renderer.correction import (
    NEAR_M,
    ProjectionScreen,
    clip_from_screen,
    is_plane_usable,
    on_imaginary_screen,
    pixel_from_screen,
)
from flexsheet.nodes.renderer.gl import (
    SAMPLES,
    SCREEN_PATTERNS,
    Canvas,
    DrawStyle,
    EyeView,
    ImagePart,
    SurfaceMaterial,
    is_software,
)
from flexsheet.nodes.renderer.lens import clip_lens
from flexsheet.nodes.renderer.object_surface import DeformationTransfer, make_surface
from flexsheet.nodes.renderer.output import both_eyes, image_parts
from flexsheet.nodes.renderer.projection import ScreenRectangle, TwoPassProjector
from flexsheet.nodes.renderer.sheet import SheetPose, screen_for
from flexsheet.nodes.renderer.sheet_mesh import (
    MAX_TRIANGLES_DEPTH_M,
    SheetMesh,
    deflected_mesh,
    occluded_fraction,
    pyramid_mesh,
    refine_mesh,
)

OVERSAMPLING, UNSAMPLED_OVERSAMPLING = 1.5, 2.5
"""The resolution of the eye's image (first pass of two_pass), divided by the resolution of the
projector. The first value is used with multisampling, and the second value without it. On a
software driver, the second value needs a quarter less time, and edges are equally smooth."""

WINDOW_MARGIN_M, WINDOW_STEP_M = 0.001, 0.004
"""The margin (m) around the object in the eye's image, and a step (m). The edges of the image are
rounded to multiples of this step. This prevents flicker of the outline when the object moves."""
MAX_WINDOW_M = 0.3
"""The maximum distance (m) of the edges of the drawn rectangle from the centre of the imaginary
screen."""
MIN_REPORTED_FRACTION = 0.005
"""The unlit fraction of a folded sheet above which the attribute `note` reports the folds."""
NO_SHAPES_NOTE = (
    "the cache contains no deflection shapes, so a pushed sheet is drawn as four triangles"
)

GRID_WINDOW = ScreenRectangle(-0.151, -0.151, 0.302, 0.302)


def projector_homography(scene: Scene) -> Floats:
    """Return the homography (3, 3) from the plane z = 0 of the world frame to projector pixels.

    The plane is the imaginary screen of Furukawa et al. 2007. Its points are (x, y) in m. The
    pixels are those of a projector whose lens has no distortion.
    """
    projector = require_projector(scene)
    return pixel_from_screen(projector.lens, pose_matrix(projector.world_from_projector))


class SceneRenderer:
    """A renderer of the projector's images for one scene."""

    def __init__(
        self,
        scene: Scene,
        context: moderngl.Context,
        *,
        spacing_m: float,
        samples: int | None = None,
        basis: IndentationBasis | None = None,
        sheet_shape: SheetShapeMethod = "reduced_order",
    ) -> None:
        """Create the graphics objects of the scene.

        spacing_m: distance between the vertices of the object.
        samples: samples per pixel. If it is None, `SAMPLES` is used. With a software OpenGL driver,
            the first pass of the correction method two_pass then has only one sample per pixel.
        basis: precomputed deflection shapes of the sheet; if it is None, a pushed sheet is drawn as
            four triangles.
        sheet_shape: method that computes the shape of the sheet.

        Raises ValueError if the projector's lens maps several rays to one pixel.
        """
        projector, geometry = require_projector(scene), scene.object.geometry
        self.scene = scene
        self._world_from_projector = pose_matrix(projector.world_from_projector)
        self._world_from_object = pose_matrix(scene.object.world_from_object)
        size = projector.width_px, projector.height_px
        self._clip_from_screen = clip_from_screen(projector_homography(scene), *size)
        self._lens = clip_lens(projector.lens, *size)
        self._shape = make_shape(dict(geometry))
        self._surface = make_surface(
            geometry,
            self._shape,
            world_from_object=self._world_from_object,
            spacing_m=spacing_m,
        )
        self._object_from_world = inverse(self._world_from_object)
        # Nearest-point queries of a mesh are ten times as fast if they start at the nearest vertex.
        meshed = isinstance(geometry, Mesh)
        self._near = scipy.spatial.cKDTree(self._surface.rest_world_m) if meshed else None
        first_pass = samples
        if first_pass is None:
            first_pass = 0 if is_software(context) else SAMPLES
        samples = SAMPLES if samples is None else samples
        # Release the graphics objects of earlier scene renderers that no longer exist.
        context.gc_mode = "context_gc"
        context.gc()
        self.canvas = Canvas(context, size, self._surface, self._material(), samples=samples)
        self.basis, self.sheet_shape, self.note = basis, sheet_shape, ""
        self.occluded_fraction = 0.0
        self._box_world = _box_around(self._surface.rest_world_m)
        window = self._window(scene.eyes.centre_world_m)
        oversampling = OVERSAMPLING if first_pass else UNSAMPLED_OVERSAMPLING
        px_per_m = oversampling * abs(float(projector_homography(scene)[0, 0]))
        self._eye_size_px = px_per_m * window.width, px_per_m * window.height
        self._projection = TwoPassProjector(context, samples=first_pass)
        self._deformation: DeformationTransfer | None = None
        self._drawn_body: SoftBody | None = None
        self.mesh_id: str | None = None

    def _material(self) -> SurfaceMaterial:
        appearance, object_from_world = self.scene.object.appearance, self._object_from_world
        front = apply(object_from_world, self._surface.rest_world_m)[:, :2]
        low, extent = front.min(axis=0), np.ptp(front, axis=0)
        image_from_object = np.diag([*(1.0 / extent), 1.0, 1.0])
        image_from_object[:2, 3] = -low / extent
        return SurfaceMaterial(
            colour=appearance.colour,
            texture=appearance.texture,
            pitch_m=appearance.texture_pitch_m,
            image=appearance.image,
            image_from_world=image_from_object @ object_from_world,
            object_from_world=object_from_world,
        )

    def set_skin(self, skin: Skin) -> None:
        """Set the solver's skin mesh, whose displacement deforms the drawn object."""
        vertices = skin.vertices_world_m.astype(np.float64)
        self._deformation = DeformationTransfer(self._surface, vertices, skin.triangles)
        self.mesh_id = skin.mesh_id

    def deform(self, body: SoftBody | None) -> None:
        """Deform the drawn surface by the displacements from the soft-body solver.

        body: message of the solver; if it is None, the undeformed surface is drawn. Raises
        ValueError if the displacement does not fit the current skin or is not finite. The surface
        is then unchanged.
        """
        if body is self._drawn_body:
            return
        if body is None:
            self.canvas.set_shape(self._surface.interleaved)
            self._box_world = _box_around(self._surface.rest_world_m)
        elif self._deformation is None:
            raise ValueError(
                "topic soft_body: a message was received before the skin to which it refers; "
                "publish the skin first"
            )
        else:
            moved = self._deformation.apply(body.displacement_world_m)
            self.canvas.set_shape(moved)
            self._box_world = _box_around(moved[:, :3])
        self._drawn_body = body

    def draw_style(
        self, shown: Display, finger_tip: Floats | None, target: SheetTarget | None
    ) -> DrawStyle:
        """Return the drawing style for a display message.

        If the message requests marks, the style contains marks at the finger and at the target's
        contact point. finger_tip (3,): world position (m) at the display time; None if it is
        unknown.
        """
        marks = shown.marks and shown.pattern == "object" and shown.shading == "soft"
        return DrawStyle(
            flat=shown.shading == "flat",
            pattern=shown.pattern,
            fingertip_mark=self.surface_point(finger_tip)
            if marks and finger_tip is not None
            else None,
            target_mark=target.contact_world_m if marks and target is not None else None,
        )

    def surface_point(self, world_point: Floats) -> Floats:
        """Return the point (3,), m, of the undeformed surface nearest to a world point (3,), m."""
        start = None
        if self._near is not None:
            _, vertex = self._near.query(world_point)
            start = apply(self._object_from_world, self._surface.rest_world_m[vertex])
        nearest = self._shape.closest(apply(self._object_from_world, world_point), previous=start)
        return apply(self._world_from_object, nearest.point)

    def sheet_at_rest(self) -> SheetPose:
        """Return the pose of an unstretched sheet on the plane z = 0.

        This pose is used until the poses of the arms are known.
        """
        half = 0.5 * self.scene.sheet.width_m * np.array([1.0, 0.0, 0.0])
        left, right = transform(np.eye(3), -half), transform(np.eye(3), half)
        return SheetPose(np.eye(4), corners(left, right, self.scene.sheet.height_m), None)

    def usable(self, sheet: SheetPose, centre: Floats | None = None) -> bool:
        """Return whether the eyes see the front of a sheet and the projector illuminates its back.

        centre (3,): world position (m) of the midpoint of the eyes. If it is None, the eyes of the
        scene are used.
        """
        eye = self.scene.eyes.centre_world_m if centre is None else centre
        return is_plane_usable(sheet.plane, eye, self._world_from_projector[:3, 3])

    def eyes(self, display: Display) -> Floats:
        """Return the world positions (2, 3), in m, of the scene's eyes.

        The positions are equal in mono mode.
        """
        return both_eyes(self.scene.eyes, display.stereo)

    def draw(
        self,
        display: Display,
        sheet: SheetPose,
        look: DrawStyle,
        *,
        read: bool,
        eyes: Floats | None = None,
        drawn: Callable[[int], None] = lambda number: None,
    ) -> Image | None:
        """Draw the projector's image. If `read` is true, return an array (height, width, 3).

        eyes (1 or 2, 3): positions of the eyes, world frame, m; None means the eyes in the scene.
        drawn: function that is called when an image is finished in the buffer `canvas.resolved`.
            Its argument is the index of the image.

        Two eyes share one image, except in the mode frame_sequential. In this mode, each eye has an
        image, and the image of the left eye is returned.

        Raises ValueError if the sheet's pose is not finite.
        """
        if not np.isfinite(sheet.world_from_sheet.sum() + sheet.corners.sum()):
            raise ValueError("the sheet's pose is not finite; check the poses of the arms")
        if display.correction == "two_pass":
            mesh = self.sheet_mesh(sheet)
            self._report_folds(mesh, self.eyes(display)[0] if eyes is None else eyes[0])
            return self.draw_onto(display, mesh, look, read=read, eyes=eyes, drawn=drawn)
        screen = screen_for(display.correction, sheet)

        def draw_eye(eye: Floats, part: ImagePart) -> None:
            with part.of(self.canvas.target):
                view = self.view(eye, screen, grey=part.is_grey)
                self.canvas.draw_into(self.canvas.target, view, look)

        return self._draw_eyes(
            display, draw_eye, multisampled=True, read=read, eyes=eyes, drawn=drawn
        )

    def draw_onto(
        self,
        display: Display,
        mesh: SheetMesh,
        look: DrawStyle,
        *,
        read: bool,
        eyes: Floats | None = None,
        drawn: Callable[[int], None] = lambda number: None,
    ) -> Image | None:
        """Draw the projector's image by the correction method two_pass on a mesh of the sheet.

        read: whether to return the image as an array (height, width, 3). If it is false, None is
            returned.
        eyes (1 or 2, 3): positions of the eyes, world frame, m. If it is None, the scene's eyes are
            used.
        drawn: function that is called after each image is finished, with the index of the image.
        """
        whole = self.canvas.width_px, self.canvas.height_px

        def draw_eye(eye: Floats, part: ImagePart) -> None:
            window = GRID_WINDOW if look.pattern in SCREEN_PATTERNS else self._window(eye)
            # If an eye has only half of the projector's pixels, half the resolution is enough.
            size = (
                round(self._eye_size_px[0] * part.viewport[2] / whole[0]),
                round(self._eye_size_px[1] * part.viewport[3] / whole[1]),
            )
            view = self.view(eye, grey=part.is_grey)
            self._projection.draw(self.canvas, mesh, view, look, window, part=part, size=size)

        return self._draw_eyes(
            display, draw_eye, multisampled=False, read=read, eyes=eyes, drawn=drawn
        )

    def view(
        self, eye: Floats, screen: ProjectionScreen | None = None, *, grey: bool = False
    ) -> EyeView:
        """Return the geometry of one eye's image.

        eye (3,): position, world frame, m. screen: shape of the sheet for which the image is
        corrected. If it is None, the image is not corrected.
        """
        projector = self._world_from_projector[:3, 3]
        return EyeView(eye, projector, screen, self._clip_from_screen, self._lens, grey)

    def _draw_eyes(
        self,
        display: Display,
        draw_eye: Callable[[Floats, ImagePart], None],
        *,
        multisampled: bool,
        read: bool,
        eyes: Floats | None,
        drawn: Callable[[int], None],
    ) -> Image | None:
        canvas = self.canvas
        if eyes is None:
            eyes = self.eyes(display)[: 1 if display.stereo == "mono" else 2]
        size = canvas.width_px, canvas.height_px
        mode = display.stereo if len(eyes) > 1 else "mono"
        parts = image_parts(mode, size, swap_eyes=display.swap_eyes)
        shown, image = int(len(eyes) > len(parts) and display.swap_eyes), None
        for number, first in enumerate(range(0, len(eyes), len(parts))):
            canvas.begin(multisampled=multisampled)
            # Do not wait between the eyes: a software driver then works on both at the same time.
            for eye, part in zip(eyes[first:], parts, strict=False):
                draw_eye(eye, part)
            canvas.resolve()
            drawn(number)
            if read and number == shown:
                image = canvas.read()
        canvas.context.finish()
        return image

    def sheet_mesh(self, sheet: SheetPose) -> SheetMesh:
        """Compute the mesh of the sheet by the method that the attribute `sheet_shape` selects.

        If the deflection shapes for the method reduced_order are not precomputed, the mesh is a
        pyramid of four triangles. The attribute `note` states why the mesh is inaccurate, or is
        empty.
        """
        if self.sheet_shape != "reduced_order" or self.basis is None:
            if self.sheet_shape == "reduced_order":
                self.note = f"{NO_SHAPES_NOTE}; {advise_precompute(self.scene)}"
            else:
                self.note = self._range_note(sheet)
            mesh = pyramid_mesh(sheet)
            return mesh if self._lens is None else refine_mesh(mesh)
        mesh = deflected_mesh(
            sheet, self.basis, density_kg_per_m3=self.scene.sheet.density_kg_per_m3
        )
        self.note = mesh.note
        return mesh

    def _range_note(self, sheet: SheetPose) -> str:
        """Return a warning if the push is too deep to represent the sheet by four triangles.

        Otherwise, return an empty text.
        """
        if sheet.pushed_point is None:
            return ""
        depth_m = -float(apply(inverse(sheet.world_from_sheet), sheet.pushed_point)[2])
        if depth_m <= MAX_TRIANGLES_DEPTH_M:
            return ""
        return (
            f"the push depth of {1e3 * depth_m:.0f} mm exceeds the maximum for four triangles, "
            f"{1e3 * MAX_TRIANGLES_DEPTH_M:g} mm; set sheet_shape to reduced_order"
        )

    def _report_folds(self, mesh: SheetMesh, eye: Floats) -> None:
        """Compute the unlit fraction of a folded sheet, and report it in the attribute `note`."""
        self.occluded_fraction = occluded_fraction(mesh, eye, self._world_from_projector[:3, 3])
        if self.occluded_fraction > MIN_REPORTED_FRACTION:
            folds = (
                f"{100.0 * self.occluded_fraction:.0f} % of the sheet is folded and gets no light"
            )
            self.note = "; ".join(filter(None, (self.note, folds)))

    def _window(self, eye: Floats) -> ScreenRectangle:
        """Return the rectangle on the plane z = 0 that the object covers as seen from an eye (3,).

        Points that are not in front of the eye are excluded. `MAX_WINDOW_M` limits the rectangle.
        """
        box = np.minimum(self._box_world, [np.inf, np.inf, eye[2] - NEAR_M])
        crossings = on_imaginary_screen(box, eye)
        low = np.clip(
            crossings.min(axis=0) - WINDOW_MARGIN_M, -MAX_WINDOW_M, MAX_WINDOW_M - WINDOW_STEP_M
        )
        high = np.clip(crossings.max(axis=0) + WINDOW_MARGIN_M, low + WINDOW_MARGIN_M, MAX_WINDOW_M)
        low = np.floor(low / WINDOW_STEP_M) * WINDOW_STEP_M
        high = np.ceil(high / WINDOW_STEP_M) * WINDOW_STEP_M
        return ScreenRectangle(float(low[0]), float(low[1]), *(float(side) for side in high - low))


def _box_around(points: NDArray[np.floating]) -> Floats:
    """Return the corners (8, 3) of the bounding box of points (n, 3)."""
    low, high = points.min(axis=0).astype(np.float64), points.max(axis=0).astype(np.float64)
    return np.array(list(product(*zip(low, high, strict=True))))
