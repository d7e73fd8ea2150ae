"""A camera node that runs, small pictures that tell their number, and a box of fake cameras."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from ruamel.yaml import YAML

from messages.base import Header, Message
from messages.clock import SystemClock
from messages.scene import Lens, Scene
from messages.topics import Topic
from messages.types import StereoPair
from nodes.camera.node import Camera, CameraParameters

SCENE_FILE = Path(__file__).resolve().parent.parent / "launch" / "scenes" / "cylinder.yaml"
WIDTH, HEIGHT, FRAMES = 160, 120, 6
Image = NDArray[np.uint8]


def load_scene(width_px: int = WIDTH, height_px: int = HEIGHT) -> Scene:
    """The paper's scene with a small camera, its optics scaled with it."""
    scene = Scene.model_validate(YAML(typ="safe").load(SCENE_FILE.read_text()))
    size = {"width_px": width_px, "height_px": height_px}
    scale = width_px / scene.camera.width_px

    def scaled(lens: Lens) -> Lens:
        numbers = {
            "fx_px": lens.fx_px * scale,
            "fy_px": lens.fy_px * scale,
            "cx_px": (lens.cx_px + 0.5) * scale - 0.5,
            "cy_px": (lens.cy_px + 0.5) * scale - 0.5,
        }
        return lens.model_copy(update=numbers)

    lenses = {"left": scaled(scene.camera.left), "right": scaled(scene.camera.right)}
    return scene.model_copy(update={"camera": scene.camera.model_copy(update={**size, **lenses})})


def picture(number: int, side: int, width: int = WIDTH) -> Image:
    """An even picture whose level tells its number and side, as compression leaves it."""
    return np.full((HEIGHT, width), 20 + 20 * number + 100 * side, np.uint8)


def told(image: Image) -> int:
    return round((float(image.mean()) - 20) / 20)


def write_video(path: Path, frames: list[Image], rate_hz: float = 50.0) -> Path:
    height, width = frames[0].shape
    codec = cv2.VideoWriter.fourcc(*"MJPG")
    writer = cv2.VideoWriter(str(path), codec, rate_hz, (width, height), True)
    assert writer.isOpened()
    for frame in frames:
        writer.write(cv2.cvtColor(frame, cv2.COLOR_GRAY2BGR))
    writer.release()
    return path


class Bench:
    """A camera node that runs, and what it publishes."""

    def __init__(self, **parameters: Any) -> None:
        self.sent: list[tuple[StereoPair, Header]] = []
        self.changed = asyncio.Event()
        self.node = Camera(
            CameraParameters.model_validate(parameters),
            name="camera",
            clock=SystemClock(),
            send=self.keep,
        )

    def keep(self, topic: Topic, message: Message, header: Header) -> None:
        assert isinstance(message, StereoPair)
        self.sent.append((message, header))
        self.changed.set()

    async def until(self, true: Callable[[], bool]) -> None:
        async with asyncio.timeout(20):
            while not true():  # noqa: ASYNC110  # notes and errors come without an event
                await asyncio.sleep(0.005)

    def numbers(self) -> list[tuple[int, int]]:
        return [(told(pair.left), told(pair.right) - 5) for pair, _ in self.sent]


@asynccontextmanager
async def running(scene: Scene, **parameters: Any) -> AsyncIterator[Bench]:
    bench = Bench(**parameters)
    await bench.node.setup()
    await bench.node.step("scene", scene, Header(1, 0, 0, "virtual", "test", 1))
    try:
        yield bench
    finally:
        await bench.node.close()
