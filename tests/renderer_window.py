"""Test the window on the projector's monitor, under a virtual display whose pixels are read
back."""

from __future__ import annotations

import os
import shutil
import subprocess
import threading
from collections.abc import AsyncIterator, Iterator
from pathlib import Path

import glfw
import numpy as np
import pytest
from numpy.typing import NDArray

from flexsheet.messages.base import Header
from flexsheet.messages.types import Display, Frame, StereoMode
from flexsheet.nodes.renderer.monitors import WindowError, find_monitor, start_glfw
from flexsheet.nodes.renderer.output_window import CLOSED, ProjectorWindow
from tests.note_text import note_text
from tests.test_renderer import Bench
from tests.waiting import DEADLINE_S, until

pytestmark = pytest.mark.skipif(
    shutil.which("Xvfb") is None, reason="no Xvfb: apt-get install xvfb libgl1 libglx-mesa0"
)

SIZE = (800, 600)


class VirtualDisplay:
    """A virtual X display of 800 x 600 pixels, whose frame buffer is a file."""

    def __init__(self, folder: Path) -> None:
        reader, writer = os.pipe()
        self.process = subprocess.Popen(
            ["Xvfb", "-displayfd", str(writer), "-screen", "0", "800x600x24", "-nolisten", "tcp",
             "-fbdir", str(folder)],
            pass_fds=[writer], stderr=subprocess.DEVNULL,
        )  # fmt: skip
        os.close(writer)
        with os.fdopen(reader) as pipe:
            number = pipe.readline().strip()
        if not number:
            pytest.skip("Xvfb does not start")
        self.name = f":{number}"
        self._file = folder / "Xvfb_screen0"

    def pixels(self) -> NDArray[np.uint8]:
        """Return what the monitor shows, (600, 800, 3), from the XWD file."""
        data = self._file.read_bytes()
        header = np.frombuffer(data, ">u4", 25)
        width, height, line, colours = header[4], header[5], header[12], header[19]
        begin = int(header[0] + 12 * colours)
        rows = np.frombuffer(data, np.uint8, int(line * height), begin).reshape(height, line)
        return np.ascontiguousarray(rows.reshape(height, -1, 4)[:, :width, 2::-1])

    def close(self) -> None:
        self.process.terminate()
        self.process.wait()


@pytest.fixture(scope="module")
def display(tmp_path_factory: pytest.TempPathFactory) -> Iterator[VirtualDisplay]:
    virtual = VirtualDisplay(tmp_path_factory.mktemp("xvfb"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("DISPLAY", virtual.name)
        patch.delenv("WAYLAND_DISPLAY", raising=False)
        glfw.terminate()
        yield virtual
        glfw.terminate()
    virtual.close()


class WindowBench(Bench):
    """A renderer with a window on the virtual display."""

    async def start(self) -> None:
        await self.node.setup()
        await self.step("scene", self.scene)

    async def draw(self, mode: StereoMode, *, swap_eyes: bool = False) -> Frame:
        """Draw a frame of the object, and return once the window has shown it."""
        await self.step(
            "display",
            Display(correction="two_pass", stereo=mode, swap_eyes=swap_eyes, pixels_every=1),
        )
        before = len(self.sent)
        self.forward(40)
        await self.finger(0.0, 0.0, 0.1)
        await until(lambda: len(self.sent) > before)
        return self.sent[-1][0]


@pytest.fixture
async def bench(display: VirtualDisplay) -> AsyncIterator[WindowBench]:
    bench = WindowBench(output="window", monitor=0)
    await bench.start()
    yield bench
    await bench.node.close()


async def test_the_monitor_shows_each_mode_as_it_is_packed(
    bench: WindowBench, display: VirtualDisplay
) -> None:
    frame = await bench.draw("mono")
    assert frame.pixels[0].any()
    assert np.array_equal(display.pixels(), frame.pixels[0])
    assert frame.swapped_ns > 0
    assert frame.light_ns == frame.swapped_ns + 8_000_000
    modes: tuple[StereoMode, ...] = ("side_by_side", "top_bottom", "anaglyph")
    for mode in modes:
        for swap_eyes in (False, True):
            frame = await bench.draw(mode, swap_eyes=swap_eyes)
            off = np.abs(display.pixels().astype(int) - frame.pixels[0])
            assert off.max() <= 1, (mode, swap_eyes)


async def test_without_a_buffer_for_each_eye_the_window_alternates(
    bench: WindowBench, display: VirtualDisplay
) -> None:
    right = (await bench.draw("frame_sequential", swap_eyes=True)).pixels[0]
    frame = await bench.draw("frame_sequential")
    left = frame.pixels[0]
    assert frame.eye == "both"
    assert (left != right).any()
    shown: list[NDArray[np.uint8]] = []

    def both_seen() -> bool:
        shown.append(display.pixels())
        return all(
            any(np.array_equal(picture, wanted) for picture in shown[-40:])
            for wanted in (left, right)
        )

    await until(both_seen)


async def test_a_swap_that_waits_holds_up_nothing_else(
    bench: WindowBench, monkeypatch: pytest.MonkeyPatch
) -> None:
    await bench.draw("mono")
    swaps, refresh = glfw.swap_buffers, threading.Event()

    def waiting(window: object) -> None:
        refresh.wait(DEADLINE_S)
        swaps(window)

    monkeypatch.setattr(glfw, "swap_buffers", waiting)
    before = len(bench.sent)
    for _ in range(5):
        bench.forward(40)
        await bench.finger(0.0, 0.0, 0.1)
    await until(lambda: len(bench.sent) >= before + 3)  # drawn, passed over for newer ones
    assert all(frame.swapped_ns == 0 for frame, _ in bench.sent[before:])
    refresh.set()
    await until(lambda: len(bench.sent) == before + 5)
    assert bench.sent[-1][0].swapped_ns > 0


async def test_a_closed_window_leaves_the_renderer_drawing_unseen(bench: WindowBench) -> None:
    await bench.draw("mono")
    screen = bench.node._output
    assert isinstance(screen, ProjectorWindow)
    glfw.set_window_should_close(screen._window, True)
    bench.node.refresh()
    frame = await bench.draw("mono")
    assert frame.swapped_ns == 0
    assert frame.light_ns == frame.drawn_ns + 8_000_000
    assert CLOSED in note_text(bench.node)


async def test_a_lost_context_is_created_again(bench: WindowBench, display: VirtualDisplay) -> None:
    await bench.draw("mono")
    screen = bench.node._output
    assert isinstance(screen, ProjectorWindow)
    assert screen._presenter is not None
    screen._presenter.problem = WindowError("the graphics card was reset")
    bench.node.refresh()
    assert bench.node._output is not screen
    frame = await bench.draw("mono")
    assert np.array_equal(display.pixels(), frame.pixels[0])


async def test_a_window_of_another_size_shows_the_middle_unscaled(
    display: VirtualDisplay,
) -> None:
    bench = WindowBench(output="window")
    await bench.start()
    try:
        screen = bench.node._output
        assert isinstance(screen, ProjectorWindow)
        glfw.set_window_size(screen._window, 300, 200)
        await until(lambda: screen.poll() and "300x200" in screen.note)
        wanted = (await bench.draw("mono")).pixels[0][200:400, 250:550]
        left, top = glfw.get_window_pos(screen._window)
        here = slice(top, top + 200), slice(left, left + 300)
        await until(lambda: screen.poll() and np.array_equal(display.pixels()[here], wanted))
        assert "unscaled" in note_text(bench.node)
    finally:
        await bench.node.close()


async def test_a_monitor_that_is_not_there_is_named_with_those_that_are(
    display: VirtualDisplay,
) -> None:
    start_glfw()
    expected = r"'beamer': there is no such monitor; .*connected monitors: 0: \"screen\" 800x"
    with pytest.raises(WindowError, match=expected):
        find_monitor("beamer")
    assert find_monitor("screen") is not None
    assert find_monitor("0") is not None
    bench = WindowBench(output="window", monitor=0)
    await bench.node.setup()
    small = bench.scene.projector.model_copy(update={"width_px": 801})
    header = Header(1, 0, 0, "virtual", "test", 1)
    with pytest.raises(
        WindowError, match=r"scene\.projector has 801x600 px.*supports only 800x600"
    ):
        bench.node.on_scene(bench.scene.model_copy(update={"projector": small}), header)
    await bench.node.close()


def test_without_a_display_the_error_has_a_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    glfw.terminate()
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(WindowError, match="or set output to headless"):
        start_glfw()
