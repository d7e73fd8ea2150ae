"""Provide the renderer's outputs: offscreen, or in a window on the projector's monitor."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import glfw
import moderngl

from flexsheet.messages.types import Display
from flexsheet.nodes.renderer.gl import headless_context, limit_driver_threads
from flexsheet.nodes.renderer.monitors import (
    find_monitor,
    hidden_window,
    open_window,
    refresh_period_s,
    start_glfw,
)
from flexsheet.nodes.renderer.parameters import RendererParameters
from flexsheet.nodes.renderer.presenter import SLOTS, Presenter, Shown, Slot, make_slot

CLOSED = "the window was closed; restart the node to show frames again"


class OutputWindow(Protocol):
    """The interface of an output that shows the images for the eyes.

    context: OpenGL context for drawing, which is current in the thread that created the output.
    """

    context: moderngl.Context
    is_seen: bool
    """Whether images are shown and their swap times are reported."""
    shows_both: bool
    """Whether the output itself alternates between the eyes in the mode frame_sequential."""
    period_s: float
    """The monitor's refresh period, in seconds; 0 if buffer swaps do not wait for the refresh."""
    note: str

    def open(self, size: tuple[int, int]) -> None: ...
    def store(self, number: int, image: moderngl.Framebuffer) -> None: ...
    def show(self, tag: Any, display: Display) -> None: ...
    def poll(self) -> bool: ...
    def close(self) -> None: ...


class OffscreenOutput:
    """An output that has no window. Images are only drawn, and can be added to frame messages."""

    is_seen = shows_both = False
    period_s = 0.0
    note = ""

    def __init__(self) -> None:
        self.context = headless_context()

    def open(self, size: tuple[int, int]) -> None:
        """Do nothing, because there is no window."""

    def store(self, number: int, image: moderngl.Framebuffer) -> None:
        """Do nothing, because an offscreen output shows no images."""

    def show(self, tag: Any, display: Display) -> None:
        """Do nothing, because an offscreen output has no window."""

    def poll(self) -> bool:
        return True

    def close(self) -> None:
        self.context.release()


def open_output(
    parameters: RendererParameters, now_ns: Callable[[], int], shown: Shown
) -> OutputWindow:
    """Open the output that the parameters select, which is an offscreen output or a window.

    now_ns: function that returns the current time. shown: function that receives the tag and the
    swap time, ns, of each shown image. Raises WindowError if the window cannot be opened, and
    NoOpenGLError if OpenGL 3.3 is not available.
    """
    if parameters.output == "headless":
        return OffscreenOutput()
    return ProjectorWindow(
        monitor=parameters.monitor,
        swap_interval=parameters.swap_interval,
        now_ns=now_ns,
        shown=shown,
    )


class ProjectorWindow:
    """A full-screen window on the projector's monitor. A separate thread shows the images.

    All methods must be called on the main thread.
    """

    def __init__(
        self,
        *,
        monitor: str | int | None,
        swap_interval: int,
        now_ns: Callable[[], int],
        shown: Shown,
    ) -> None:
        """Create the drawing context.

        monitor: name or number of the monitor. If it is None, an ordinary window is opened, which
        is useful for tests. swap_interval: number of monitor refreshes per shown image. If it is 0,
        swaps do not wait for the refresh, and images can tear. now_ns: function that returns the
        current time. shown: function that receives the tag and the swap time, ns, of each shown
        image. Raises WindowError if there is no display or no such monitor.
        """
        limit_driver_threads()
        start_glfw()
        self._monitor = None if monitor is None else find_monitor(monitor)
        self._swap_interval, self._now_ns, self._shown = swap_interval, now_ns, shown
        self._hidden = hidden_window()
        glfw.make_context_current(self._hidden)
        self.context = moderngl.create_context(require=330)
        self.note = ""
        self.is_seen, self.shows_both, self.period_s = False, True, 0.0
        self.quad_buffered = False
        self._window: Any = None
        self._presenter: Presenter | None = None
        self._slots: list[Slot] = []
        self._filling: Slot | None = None

    def open(self, size: tuple[int, int]) -> None:
        """Open the window for images of a size (width, height), px, unless it is already open.

        Raises WindowError if the monitor has no mode of this size.
        """
        if self._presenter is not None and self._slots[0].textures[0].size == size:
            return
        self._shut()
        self._window, self.quad_buffered = open_window(size, self._monitor, self._hidden)
        at = self._monitor if self._monitor is not None else glfw.get_primary_monitor()
        self.period_s = self._swap_interval * refresh_period_s(at) if at else 0.0
        glfw.make_context_current(self._hidden)
        self._slots = [make_slot(self.context, size) for _ in range(SLOTS)]
        self.context.finish()
        self._presenter = Presenter(
            self._window,
            self._slots,
            swap_interval=self._swap_interval,
            quad_buffered=self.quad_buffered,
            now_ns=self._now_ns,
            shown=self._shown,
        )
        glfw.set_framebuffer_size_callback(self._window, self._resized)
        glfw.set_window_refresh_callback(self._window, self._uncovered)
        self.is_seen, self.note = True, ""
        self._note_size(size, self._presenter.framebuffer_px)

    def store(self, number: int, image: moderngl.Framebuffer) -> None:
        """Store an image for the next call of `show`.

        number: index of the image in the frame, 0 or 1.
        """
        if self._presenter is None:
            return
        if self._filling is None:
            self._filling = self._presenter.free_slot()
        self.context.copy_framebuffer(self._filling.frames[number], image)

    def show(self, tag: Any, display: Display) -> None:
        """Show the stored images at the next refresh.

        tag: object that the callback `shown` receives after the images were shown.
        """
        slot, self._filling = self._filling, None
        if self._presenter is None or slot is None:
            return
        slot.tag, slot.mode = tag, display.stereo
        slot.swap_eyes = display.swap_eyes and display.stereo == "frame_sequential"
        self.context.finish()
        self._presenter.put(slot)

    def poll(self) -> bool:
        """Handle the window's events, and return false if the graphics context was lost.

        After a loss, `note` contains the reason, and the caller must create the output again. If
        the user has closed the window, `note` reports this, and the window is not opened again.
        """
        glfw.poll_events()
        if self._presenter is not None and self._presenter.problem is not None:
            self.note = f"the window was lost ({self._presenter.problem}) and is opened again"
            return False
        if self._window is not None and glfw.window_should_close(self._window):
            self._shut()
            self.note = CLOSED
        return True

    def _resized(self, window: Any, width: int, height: int) -> None:
        if self._presenter is not None:
            self._note_size(self._slots[0].textures[0].size, (width, height))
            self._presenter.redraw((width, height))

    def _uncovered(self, window: Any) -> None:
        if self._presenter is not None:
            self._presenter.redraw(glfw.get_framebuffer_size(window))

    def _note_size(self, size: tuple[int, int], framebuffer_px: tuple[int, int]) -> None:
        fits = tuple(framebuffer_px) == tuple(size)
        width, height = framebuffer_px
        self.note = (
            ""
            if fits
            else f"the window has {width}x{height} px, but the images have {size[0]}x{size[1]} px; "
            "images are shown unscaled in the centre; set the same size on the monitor and in the "
            "scene"
        )

    def _shut(self) -> None:
        if self._presenter is not None:
            self._presenter.stop()
            self._presenter = None
        self._filling, self.is_seen = None, False
        glfw.make_context_current(self._hidden)
        for slot in self._slots:
            for part in (*slot.frames, *slot.textures):
                part.release()
        self._slots = []
        if self._window is not None:
            glfw.destroy_window(self._window)
            self._window = None

    def close(self) -> None:
        """Close the window and release all resources."""
        self._shut()
        self.context.release()
        glfw.destroy_window(self._hidden)
