"""Show the newest image in a window from a separate thread.

A buffer swap that waits for the projector's refresh blocks only this thread. The event loop draws
the next image in the meantime. Both threads have their own OpenGL context, but share textures.
There are three pairs of textures (triple buffering): a shown pair, a completely drawn pair, and a
pair for the next image.
"""

from __future__ import annotations

import ctypes
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import glfw
import moderngl
import numpy as np

from flexsheet.messages.types import StereoMode
from flexsheet.nodes.renderer.gl import shader_text
from flexsheet.nodes.renderer.monitors import WindowError, glfw_errors

SLOTS = 3
IDLE_S = 0.1
REDRAW_COUNT = 4
"""The number of times that the image is shown again after the window was resized. The repetition is
necessary because some drivers resize their buffers only after two more buffer swaps."""

_NO_WINDOW: Any = None
GL_BACK_LEFT, GL_BACK_RIGHT = 0x0402, 0x0403

Shown = Callable[[Any, int], None]
"""A function that the presenter's thread calls with the tag and the swap time (ns) of each image.
The time is 0 for an image that a newer image replaced before it was shown."""


@dataclass(slots=True)
class Slot:
    """The textures of one frame, and the stereo mode of the frame.

    In the mode frame_sequential, the textures contain the images for the left and the right eye.
    Other modes use only the first texture. tag: object with which the caller identifies the frame.
    swap_eyes: whether to exchange the images of the two eyes.
    """

    textures: tuple[moderngl.Texture, moderngl.Texture]
    frames: tuple[moderngl.Framebuffer, moderngl.Framebuffer]
    tag: Any = None
    mode: StereoMode = "mono"
    swap_eyes: bool = False


def make_slot(context: moderngl.Context, size: tuple[int, int]) -> Slot:
    textures = context.texture(size, 4), context.texture(size, 4)
    left, right = textures
    return Slot(textures, (context.framebuffer([left]), context.framebuffer([right])))


class Presenter:
    """A thread that owns a window's OpenGL context and shows the images that `put` receives."""

    def __init__(
        self,
        window: Any,
        slots: list[Slot],
        *,
        swap_interval: int,
        quad_buffered: bool,
        now_ns: Callable[[], int],
        shown: Shown,
    ) -> None:
        self._window, self._slots = window, slots
        self._swap_interval, self._quad_buffered = swap_interval, quad_buffered
        self._now_ns, self._shown = now_ns, shown
        self._changed = threading.Condition()
        self._ready: Slot | None = None
        self._shown_slot: Slot | None = None
        self._stop, self._again = False, 0
        self._right_is_next = False
        self.framebuffer_px = glfw.get_framebuffer_size(window)
        self.problem: Exception | None = None
        self._thread = threading.Thread(target=self._run, name="presenter", daemon=True)
        self._thread.start()

    def free_slot(self) -> Slot:
        """Return a slot (textures of one frame) into which the next frame can be drawn.

        The slot is neither shown nor waiting to be shown.
        """
        with self._changed:
            return next(
                slot
                for slot in self._slots
                if slot is not self._ready and slot is not self._shown_slot
            )

    def put(self, slot: Slot) -> None:
        """Pass a completely drawn frame to the display thread, and return immediately.

        The thread shows the frame at the next refresh, unless a newer frame replaces it.
        """
        with self._changed:
            superseded, self._ready = self._ready, slot
            self._changed.notify()
        if superseded is not None:
            self._shown(superseded.tag, 0)

    def redraw(self, framebuffer_px: tuple[int, int]) -> None:
        """Show the current image again after the window was resized or uncovered."""
        with self._changed:
            self.framebuffer_px, self._again = framebuffer_px, REDRAW_COUNT
            self._changed.notify()

    def stop(self) -> None:
        """Stop the thread and wait until it has released its context."""
        with self._changed:
            self._stop = True
            self._changed.notify()
        self._thread.join()

    def _run(self) -> None:
        try:
            with glfw_errors():
                glfw.make_context_current(self._window)
                glfw.swap_interval(self._swap_interval)
                quad = _WindowQuad(self._slots)
                while (slot := self._next()) is not None:
                    self._present(quad, *slot)
        except (WindowError, moderngl.Error) as error:
            self.problem = error
        finally:
            glfw.make_context_current(_NO_WINDOW)

    def _next(self) -> tuple[Slot, bool] | None:
        """Wait until a slot (textures of one frame) must be shown.

        Returns the slot, and whether the slot is new. Returns None if `stop` was called.
        """
        with self._changed:
            while not self._stop:
                if self._ready is not None:
                    self._shown_slot, self._ready = self._ready, None
                    return self._shown_slot, True
                if self._shown_slot is not None and (
                    self._again or self._alternates(self._shown_slot)
                ):
                    self._again = max(0, self._again - 1)
                    return self._shown_slot, False
                self._changed.wait(IDLE_S)
        return None

    def _alternates(self, slot: Slot) -> bool:
        return slot.mode == "frame_sequential" and not self._quad_buffered

    def _present(self, quad: _WindowQuad, slot: Slot, is_new: bool) -> None:
        left, right = slot.textures[:: -1 if slot.swap_eyes else 1]
        if slot.mode == "frame_sequential" and self._quad_buffered:
            for buffer, texture in ((GL_BACK_LEFT, left), (GL_BACK_RIGHT, right)):
                quad.choose_buffer(buffer)
                quad.draw(self.framebuffer_px, texture)
        else:
            if self._alternates(slot):
                left = right if self._right_is_next else left
                self._right_is_next = not self._right_is_next
            quad.draw(self.framebuffer_px, left)
        glfw.swap_buffers(self._window)
        quad.wait_until_done()
        swapped_ns = self._now_ns()
        if quad.is_lost():
            raise WindowError(
                "the graphics driver reports that the graphics card was reset; the window is "
                "opened again"
            )
        if is_new:
            self._shown(slot.tag, swapped_ns)


class _WindowQuad:
    """The shader program that draws a finished frame in the window.

    OpenGL functions that block are called through ctypes, so that other Python threads can run
    meanwhile.
    """

    def __init__(self, slots: list[Slot]) -> None:
        self._context = moderngl.create_context(require=330)
        self._program = self._context.program(
            vertex_shader=shader_text("window.vert.glsl"),
            fragment_shader=shader_text("window.frag.glsl"),
        )
        self._array = self._context.vertex_array(self._program, [])
        self._size = slots[0].textures[0].size
        self._textures = {
            texture.glo: self._context.external_texture(texture.glo, self._size, 4, 0, "f1")
            for slot in slots
            for texture in slot.textures
        }
        self.wait_until_done = _function("glFinish", None)
        self.choose_buffer = _function("glDrawBuffer", None, ctypes.c_uint)
        self._reset_status = _function("glGetGraphicsResetStatus", ctypes.c_uint)

    def draw(self, framebuffer_px: tuple[int, int], texture: moderngl.Texture) -> None:
        """Draw a texture unscaled in the centre of the window."""
        origin = (np.array(framebuffer_px) - self._size) // 2
        screen = self._context.screen
        screen.viewport = (0, 0, *framebuffer_px)
        screen.use()
        self._program["origin"] = tuple(int(value) for value in origin)
        self._textures[texture.glo].use()
        self._array.render(moderngl.TRIANGLES, vertices=3)

    def is_lost(self) -> bool:
        return self._reset_status is not None and self._reset_status() != 0


def _function(name: str, result: Any, *arguments: Any) -> Any:
    """Return a function of the OpenGL driver by name, or None if the driver does not provide it."""
    address = glfw.get_proc_address(name)
    if not address:
        return None
    return ctypes.cast(address, ctypes.CFUNCTYPE(result, *arguments))
