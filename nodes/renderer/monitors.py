"""Find the projector's monitor and open a window on it, through GLFW, on the main thread."""

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
    """The requested window cannot be opened; the message gives the remedy."""

    code = "window"
    remedy = "Set the monitor to one that the text lists, or run headless."


@contextmanager
def glfw_errors() -> Iterator[None]:
    """Convert GLFW's errors to WindowError; GLFW raises them only after `start_glfw`."""
    try:
        yield
    except glfw.GLFWError as error:
        raise WindowError(f"the window system reports: {error}") from error


def start_glfw() -> None:
    """Connect to the display. Raises WindowError when there is none."""
    glfw.ERROR_REPORTING = "raise"
    try:
        with glfw_errors():
            connected = glfw.init()
    except WindowError as error:
        raise _no_display(str(error)) from error
    if not connected:
        raise _no_display("GLFW does not start")


def _no_display(why: str) -> WindowError:
    return WindowError(
        f"parameter output: window: no display ({why}); set DISPLAY to the screen of the "
        "projector (such as DISPLAY=:0), or draw without a window: output: headless"
    )


def monitor_names() -> list[str]:
    """Return the names of the monitors, the primary one first; an index into this list selects
    one."""
    return [_text(glfw.get_monitor_name(monitor)) for monitor in glfw.get_monitors()]


def find_monitor(monitor: str | int) -> Any:
    """Return GLFW's monitor of that number or name. Raises WindowError, which lists all
    monitors."""
    monitors, names = glfw.get_monitors(), monitor_names()
    wanted = monitor
    if isinstance(monitor, str) and monitor not in names and monitor.isdigit():
        wanted = int(monitor)
    if isinstance(wanted, int) and 0 <= wanted < len(monitors):
        return monitors[wanted]
    same = [index for index, name in enumerate(names) if name == wanted]
    if len(same) == 1:
        return monitors[same[0]]
    have = "; ".join(
        f'{index}: "{name}" {_mode(monitors[index])}' for index, name in enumerate(names)
    )
    why = f"{len(same)} monitors have that name, give the number" if same else "there is none"
    raise WindowError(f"parameter monitor: {monitor!r}: {why}; monitors: {have or 'none'}")


def _mode(monitor: Any) -> str:
    mode = glfw.get_video_mode(monitor)
    return f"{mode.size.width}x{mode.size.height} at {mode.refresh_rate} Hz"


def _text(name: bytes | str) -> str:
    return name.decode(errors="replace") if isinstance(name, bytes) else name


def refresh_period_s(monitor: Any) -> float:
    """Return the refresh period of a monitor as it runs now; 0 when it is not known."""
    rate_hz = glfw.get_video_mode(monitor).refresh_rate
    return 1.0 / rate_hz if rate_hz > 0 else 0.0


def hidden_window() -> Any:
    """Return an invisible window: its context is the one to draw in."""
    return _create((1, 1), {glfw.VISIBLE: False})


def open_window(
    size: tuple[int, int], monitor: Any | None, share: Any, *, stereo: bool
) -> tuple[Any, bool]:
    """Return a window whose context shares objects with `share`, and whether it has a buffer per
    eye.

    monitor: full-screen there; None: an ordinary window. stereo: a buffer per eye if the driver has
    that. Raises WindowError for a monitor without a mode of that size.
    """
    width, height = size
    if monitor is not None:
        modes = {(mode.size.width, mode.size.height) for mode in glfw.get_video_modes(monitor)}
        if size not in modes:
            have = ", ".join(f"{w}x{h}" for w, h in sorted(modes))
            raise WindowError(
                f"scene.projector is {width}x{height}; the monitor "
                f'"{_text(glfw.get_monitor_name(monitor))}" supports {have}; '
                "set one of these in the scene and calibrate again"
            )
    hints = {**ON_A_PROJECTOR, glfw.VISIBLE: True}
    if stereo:
        try:
            window = _create(size, {**hints, glfw.STEREO: True}, monitor, share)
        except WindowError:
            pass  # no such buffers: the eyes alternate instead
        else:
            return window, True
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
        raise WindowError(f"no window of {size[0]}x{size[1]} with OpenGL 3.3 could be opened")
    if glfw.get_window_attrib(window, glfw.VISIBLE):
        glfw.set_input_mode(window, glfw.CURSOR, glfw.CURSOR_HIDDEN)
    return window
