"""Correct the image in two passes (projective texture mapping).

The first pass draws the object as the eye should see it, through a rectangle on the imaginary
screen. The second pass draws the sheet's mesh as the projector sees it, textured with the first
image. The method supports any sheet shape and exact depth, and has no seams between triangles.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import moderngl
import numpy as np
from numpy.typing import NDArray

from flexsheet.nodes.renderer.gl import (
    SAMPLES,
    Canvas,
    DrawStyle,
    EyeView,
    Uniforms,
    set_view,
    shader_text,
)
from flexsheet.nodes.renderer.sheet_mesh import SheetMesh

Floats = NDArray[np.float64]

CLIP_DISTANCE_0, CLIP_PLANES = 0x3000, 5
"""OpenGL constant of the first clip plane, and number of clip planes in `sheet.vert.glsl`."""


@dataclass(frozen=True, slots=True)
class ScreenRectangle:
    """Rectangle on the imaginary screen, m."""

    left: float
    bottom: float
    width: float
    height: float

    @property
    def clip_from_screen(self) -> Floats:
        """Return the map (3, 3) from (x, y, 1) on the screen to OpenGL clip coordinates.

        The rectangle fills the clip space.
        """
        return np.array(
            [
                [2.0 / self.width, 0.0, -2.0 * self.left / self.width - 1.0],
                [0.0, 2.0 / self.height, -2.0 * self.bottom / self.height - 1.0],
                [0.0, 0.0, 1.0],
            ]
        )


class TwoPassProjector:
    """Two-pass renderer with the frame of the first pass and the sheet's buffers."""

    def __init__(
        self, context: moderngl.Context, width_px: int, height_px: int, *, samples: int = SAMPLES
    ) -> None:
        """Allocate the frame of the eye's image; samples: as in `Canvas`."""
        self._context = context
        samples = min(samples, context.max_samples)
        size = (width_px, height_px)
        self._frame = context.framebuffer(
            context.renderbuffer(size, 4, samples=samples),
            context.depth_renderbuffer(size, samples=samples),
        )
        self._image = context.texture(size, 4)
        self._image.repeat_x = self._image.repeat_y = False
        self._resolved = context.framebuffer([self._image])
        self._program = context.program(
            vertex_shader=shader_text("sheet.vert.glsl"),
            fragment_shader=shader_text("sheet.frag.glsl"),
        )
        self._uniforms = Uniforms(self._program)
        self._drawn: SheetMesh | None = None
        self._vertices: moderngl.Buffer | None = None
        self._array: moderngl.VertexArray | None = None
        self._triangles: NDArray[np.int32] | None = None

    def draw(
        self,
        canvas: Canvas,
        sheet: SheetMesh,
        view: EyeView,
        look: DrawStyle,
        window: ScreenRectangle,
    ) -> None:
        """Draw one eye's image onto the sheet, into the canvas's frame, and wait for completion."""
        seen = replace(view, screen=None, clip_from_screen=window.clip_from_screen, lens=None)
        canvas.draw_into(self._frame, seen, look)
        self._context.copy_framebuffer(self._resolved, self._frame)
        array = self._sheet_array(sheet)
        set_view(self._uniforms, view)
        self._uniforms.set(window=(window.left, window.bottom, window.width, window.height))
        self._image.use()
        canvas.begin()
        # The projector is behind the sheet, so back faces must be drawn.
        self._context.disable(moderngl.CULL_FACE)
        for plane in range(CLIP_PLANES):
            self._context.enable_direct(CLIP_DISTANCE_0 + plane)
        array.render(moderngl.TRIANGLES)
        for plane in range(CLIP_PLANES):
            self._context.disable_direct(CLIP_DISTANCE_0 + plane)
        self._context.enable(moderngl.CULL_FACE)
        self._context.finish()

    def _sheet_array(self, sheet: SheetMesh) -> moderngl.VertexArray:
        """Return the sheet's vertex array; its buffers are reused for the same triangles."""
        if self._array is not None and sheet is self._drawn:
            return self._array
        vertices, previous = np.ascontiguousarray(sheet.vertices, np.float32), self._triangles
        same = previous is sheet.triangles or (
            previous is not None and np.array_equal(previous, sheet.triangles)
        )
        if self._array is None or self._vertices is None or not same:
            self._release_sheet()
            self._vertices = self._context.buffer(vertices, dynamic=True)
            triangles = self._context.buffer(np.ascontiguousarray(sheet.triangles, np.int32))
            content = [(self._vertices, "3f", "position")]
            self._array = self._context.vertex_array(self._program, content, triangles)
            self._triangles = sheet.triangles
        else:
            self._vertices.orphan()
            self._vertices.write(vertices)
        self._drawn = sheet
        return self._array

    def _release_sheet(self) -> None:
        if self._array is not None:
            if self._array.index_buffer is not None:
                self._array.index_buffer.release()
            self._array.release()
        if self._vertices is not None:
            self._vertices.release()

    def release(self) -> None:
        """Release all buffers, but not the context."""
        self._release_sheet()
        for frame in (self._frame, self._resolved):
            for attachment in (*frame.color_attachments, frame.depth_attachment):
                if attachment is not None:
                    attachment.release()
            frame.release()
        self._program.release()
