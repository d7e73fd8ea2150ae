"""Find the monitor that is the projector, and open a window on it with the library GLFW.

All functions must be called on the main thread.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import glfw

from flexsheet.messages.errors import FlexsheetError

PLAIN_CONTEXT = {
    glfw.CONTEXT_VERSION_MAJOR: 3,
    glfw.CONTEXT_VERSION_MINOR: 3,
    glfw.OPENGL_PROFILE: glfw.OPENGL_CORE_PROFILE,
    glfw.OPENGL_FORWARD_COMPAT: True,
}
ON_A_PROJECTOR = {
    glfw.AUTO_ICONIFY: False,
    glfw.FOCUS_ON_SHOW: False,
    glfw.DEPTH_BITS: 0,
    glfw.STENCIL_BITS: 0,
    glfw.SAMPLES: 0,
}


class WindowError(FlexsheetError, RuntimeError):
    """Raised if the requested window cannot be opened or was lost."""

    remedy = "Set `monitor` to a monitor that the error text lists, or set `output` to headless."


@contextmanager
def glfw_errors() -> Iterator[None]:
    """Convert errors of the window library GLFW to WindowError until the context exits.

    `start_glfw` must be called first.
    """
    try:
        yield
    except glfw.GLFWError as error:
        raise WindowError(
            f"the window system reports: {error}; check the display and its driver"
        ) from error


def start_glfw() -> None:
    """Initialize the window library GLFW. Raises WindowError if there is no display."""
    glfw.ERROR_REPORTING = "raise"
    try:
        with glfw_errors():
            connected = glfw.init()
    except WindowError as error:
        raise _no_display(str(error)) from error
    if not connected:
        raise _no_display("the window library GLFW does not start")


def _no_display(why: str) -> WindowError:
    return WindowError(
        f"parameter output: window needs a display, but there is none ({why}); set DISPLAY to the "
        "screen of the projector (such as DISPLAY=:0), or set output to headless"
    )


def find_monitor(monitor: str | int) -> Any:
    """Return the GLFW monitor with a number or name. Number 0 is the primary monitor.

    Raises WindowError if there is no such monitor, or if several monitors have this name.
    """
    monitors = glfw.get_monitors()
    names = [_text(glfw.get_monitor_name(one)) for one in monitors]
    key = monitor
    if isinstance(monitor, str) and monitor not in names and monitor.isdigit():
        key = int(monitor)
    if isinstance(key, int) and 0 <= key < len(monitors):
        return monitors[key]
    same = [index for index, name in enumerate(names) if name == key]
    if len(same) == 1:
        return monitors[same[0]]
    have = "; ".join(
        f'{index}: "{name}" {_mode(monitors[index])}' for index, name in enumerate(names)
    )
    why = (
        f"{len(same)} monitors have this name; set the number"
        if same
        else "there is no such monitor; set one that is connected"
    )
    raise WindowError(
        f"parameter monitor: {monitor!r}: {why}; connected monitors: {have or 'none'}"
    )


def _mode(monitor: Any) -> str:
    mode = glfw.get_video_mode(monitor)
    return f"{mode.size.width}x{mode.size.height} at {mode.refresh_rate} Hz"


def _text(name: bytes | str) -> str:
    return name.decode(errors="replace") if isinstance(name, bytes) else name


def refresh_period_s(monitor: Any) -> float:
    """Return the current refresh period of a monitor, in seconds, or 0 if the period is unknown."""
    rate_hz = glfw.get_video_mode(monitor).refresh_rate
    return 1.0 / rate_hz if rate_hz > 0 else 0.0


def hidden_window() -> Any:
    """Return an invisible window with an OpenGL context for drawing.

    Raises WindowError if the window cannot be opened.
    """
    return _create((1, 1), {glfw.VISIBLE: False})


def open_window(size: tuple[int, int], monitor: Any | None, share: Any) -> tuple[Any, bool]:
    """Open a window that shares graphics objects with the window `share`.

    size: width and height, px. monitor: monitor of a full-screen window; None for an ordinary
    window. Return the window, and whether it is quad-buffered (has separate buffers for each eye).
    Raises WindowError if the monitor has no mode of this size.
    """
    width, height = size
    if monitor is not None:
        modes = {(mode.size.width, mode.size.height) for mode in glfw.get_video_modes(monitor)}
        if size not in modes:
            have = ", ".join(f"{w}x{h}" for w, h in sorted(modes))
            raise WindowError(
                f"scene.projector has {width}x{height} px, but the monitor "
                f'"{_text(glfw.get_monitor_name(monitor))}" supports only {have}; '
                "set one of these sizes in the scene and calibrate the projector again"
            )
    hints = {**ON_A_PROJECTOR, glfw.VISIBLE: True}
    try:
        return _create(size, {**hints, glfw.STEREO: True}, monitor, share), True
    except WindowError:
        # Quad buffering is not supported, so the images of the eyes alternate.
        return _create(size, hints, monitor, share), False


def _create(
    size: tuple[int, int],
    hints: dict[int, int],
    monitor: Any | None = None,
    share: Any | None = None,
) -> Any:
    with glfw_errors():
        glfw.default_window_hints()
        for hint, value in {**PLAIN_CONTEXT, **hints}.items():
            glfw.window_hint(hint, value)
        window = glfw.create_window(*size, "flexsheet", monitor, share)
    if not window:
        raise WindowError(
            f"cannot open a window of {size[0]}x{size[1]} px with OpenGL 3.3; install a graphics "
            "driver with OpenGL 3.3, or set output to headless"
        )
    if glfw.get_window_attrib(window, glfw.VISIBLE):
        glfw.set_input_mode(window, glfw.CURSOR, glfw.CURSOR_HIDDEN)
    return window
