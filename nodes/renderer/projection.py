"""Correct the image in two passes (projective texture mapping).

The first pass draws the object as the eye must see it through a rectangle on the imaginary screen
(the plane z = 0). The second pass draws the sheet's mesh as seen from the projector. The texture of
the mesh is the image of the first pass. The method is exact for any shape of the sheet and any
depth of the object. The image has no seams between triangles.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import moderngl
import numpy as np

from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.renderer.gl import (
    SAMPLES,
    Canvas,
    DrawStyle,
    EyeView,
    ImagePart,
    Programs,
    set_view,
)
from flexsheet.nodes.renderer.sheet_mesh import SheetMesh

CLIP_DISTANCE_0, CLIP_PLANES = 0x3000, 5
"""The OpenGL constant GL_CLIP_DISTANCE0, and the number of clip planes in `sheet.vert.glsl`."""


@dataclass(frozen=True, slots=True)
class ScreenRectangle:
    """A rectangle on the imaginary screen, the plane z = 0, in metres."""

    left: float
    bottom: float
    width: float
    height: float

    @property
    def clip_from_screen(self) -> Floats:
        """Return the matrix (3, 3) from screen coordinates (x, y, 1) to OpenGL clip coordinates.

        The matrix maps the rectangle to the whole image.
        """
        return np.array(
            [
                [2.0 / self.width, 0.0, -2.0 * self.left / self.width - 1.0],
                [0.0, 2.0 / self.height, -2.0 * self.bottom / self.height - 1.0],
                [0.0, 0.0, 1.0],
            ]
        )


@dataclass(frozen=True, slots=True)
class EyePicture:
    """The framebuffers for the image of an eye in the first pass.

    samples: framebuffer for drawing. resolved: framebuffer with the averaged image. If
    multisampling is off, both are the same framebuffer. image: texture of `resolved`.
    """

    samples: moderngl.Framebuffer
    resolved: moderngl.Framebuffer
    image: moderngl.Texture

    @staticmethod
    def make(context: moderngl.Context, size: tuple[int, int], samples: int) -> EyePicture:
        """Allocate the framebuffers for an eye's image of a given size (width, height), px."""
        image = context.texture(size, 4)
        image.repeat_x = image.repeat_y = False
        if not samples:
            single = context.framebuffer([image], context.depth_renderbuffer(size))
            return EyePicture(single, single, image)
        multisampled = context.framebuffer(
            context.renderbuffer(size, 4, samples=samples),
            context.depth_renderbuffer(size, samples=samples),
        )
        return EyePicture(multisampled, context.framebuffer([image]), image)


class TwoPassProjector:
    """A renderer that corrects the image in two passes."""

    def __init__(self, context: moderngl.Context, *, samples: int = SAMPLES) -> None:
        """Prepare the shaders.

        samples: samples per pixel of the first pass, limited to the maximum of the driver; 0
        switches multisampling off.
        """
        self._context, self._samples = context, min(samples, context.max_samples)
        self._pictures: dict[tuple[int, int], EyePicture] = {}
        self._programs = Programs(context, "sheet")
        self._drawn: SheetMesh | None = None
        self._buffers: tuple[moderngl.Buffer, moderngl.Buffer] | None = None
        self._arrays: dict[int, moderngl.VertexArray] = {}

    def draw(
        self,
        canvas: Canvas,
        sheet: SheetMesh,
        view: EyeView,
        look: DrawStyle,
        window: ScreenRectangle,
        *,
        part: ImagePart,
        size: tuple[int, int],
    ) -> None:
        """Draw the projector's image for one eye into a part of the framebuffer `canvas.target`.

        window: rectangle on the imaginary screen that the eye's image covers. size: width and
        height of the eye's image, px.
        """
        if size not in self._pictures:
            self._pictures[size] = EyePicture.make(self._context, size, self._samples)
        picture = self._pictures[size]
        seen = replace(
            view, screen=None, clip_from_screen=window.clip_from_screen, lens=None, grey=False
        )
        picture.samples.clear(0.0, 0.0, 0.0, 1.0)
        canvas.draw_into(picture.samples, seen, look)
        if picture.resolved is not picture.samples:
            self._context.copy_framebuffer(picture.resolved, picture.samples)
        program, uniforms = self._programs.get(LENS=view.lens is not None, GREY=view.grey)
        array = self._sheet_array(sheet, program)
        set_view(uniforms, view)
        uniforms.set(window=(window.left, window.bottom, window.width, window.height))
        picture.image.use()
        # The projector is behind the sheet, so back faces must be drawn.
        self._context.disable(moderngl.CULL_FACE)
        for plane in range(CLIP_PLANES):
            self._context.enable_direct(CLIP_DISTANCE_0 + plane)
        with part.of(canvas.target):
            canvas.target.use()
            array.render(moderngl.TRIANGLES)
        for plane in range(CLIP_PLANES):
            self._context.disable_direct(CLIP_DISTANCE_0 + plane)
        self._context.enable(moderngl.CULL_FACE)

    def _sheet_array(self, sheet: SheetMesh, program: moderngl.Program) -> moderngl.VertexArray:
        """Write the vertices of the sheet to its buffers, and return its OpenGL vertex array."""
        if self._buffers is None or sheet is not self._drawn:
            vertices = np.ascontiguousarray(sheet.vertices, np.float32)
            same = self._drawn is not None and np.array_equal(
                self._drawn.triangles, sheet.triangles
            )
            if self._buffers is None or not same:
                triangles = np.ascontiguousarray(sheet.triangles, np.int32)
                self._arrays = {}
                self._buffers = self._context.buffer(vertices), self._context.buffer(triangles)
                self._context.gc()  # Release the replaced buffers.
            else:
                self._buffers[0].orphan()
                self._buffers[0].write(vertices)
            self._drawn = sheet
        if program.glo not in self._arrays:
            content = [(self._buffers[0], "3f", "position")]
            self._arrays[program.glo] = self._context.vertex_array(
                program, content, self._buffers[1]
            )
        return self._arrays[program.glo]
