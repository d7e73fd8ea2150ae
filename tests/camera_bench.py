"""Provide a running camera node, small numbered images, and fake cameras for tests."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from flexsheet.messages.base import Header
from flexsheet.messages.clock import Clock, SystemClock
from flexsheet.messages.scene import Lens, Scene
from flexsheet.messages.types import StereoPair
from flexsheet.nodes.camera.node import Camera, CameraParameters
from tests.node_harness import NodeHarness
from tests.scenes import load_cylinder
from tests.waiting import until

WIDTH, HEIGHT, FRAMES = 160, 120, 6
Image = NDArray[np.uint8]


def load_scene(width_px: int = WIDTH, height_px: int = HEIGHT) -> Scene:
    """Load the scene of the paper with a small camera image."""
    scene = load_cylinder()
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
    """Make a uniform image whose grey level encodes its number and side."""
    return np.full((HEIGHT, width), 20 + 20 * number + 100 * side, np.uint8)


def read_number(image: Image) -> int:
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


class CameraHarness(NodeHarness[Camera, Clock]):
    """A running camera node and its messages."""

    until = staticmethod(until)

    def __init__(self, clock: Clock | None = None, **parameters: Any) -> None:
        super().__init__(
            Camera,
            CameraParameters.model_validate(parameters),
            clock or SystemClock(),
            name="camera",
        )

    @property
    def sent(self) -> list[tuple[StereoPair, Header]]:
        return self.messages(StereoPair)

    def numbers(self) -> list[tuple[int, int]]:
        return [(read_number(pair.left), read_number(pair.right) - 5) for pair, _ in self.sent]


@asynccontextmanager
async def running(
    scene: Scene, *, clock: Clock | None = None, **parameters: Any
) -> AsyncIterator[CameraHarness]:
    bench = CameraHarness(clock, **parameters)
    await bench.node.setup()
    await bench.node.step("scene", scene, Header(1, 0, 0, "virtual", "test", 1))
    try:
        yield bench
    finally:
        await bench.node.close()


@dataclass
class Shot:
    """A frame of a fake camera: image, arrival time (ns) and driver's timestamp (ns)."""

    image: Image
    arrival_ns: int
    stamp_ns: int


class FakeCamera:
    """A fake camera that can be unplugged, and that can reject or limit settings."""

    def __init__(self, bag: CameraBag) -> None:
        self.bag = bag
        self.plugged = True
        self.shots: queue.Queue[Shot | None] = queue.Queue()
        self.properties: dict[int, float] = {}
        self.fixed: set[int] = set()
        self.bounds: dict[int, tuple[float, float]] = {}
        self.calls: list[tuple[int, float]] = []
        self.captures: list[FakeCapture] = []

    def shoot(
        self,
        at_ns: int,
        *,
        number: int = 0,
        side: int = 0,
        stamp_ns: int | None = None,
        image: Image | None = None,
    ) -> None:
        """Deliver a frame with the driver's timestamp `at_ns` (or `stamp_ns`), which arrives 8 ms
        later.
        """
        pixels = picture(number, side) if image is None else image
        stamp = self.bag.base_ns + at_ns if stamp_ns is None else stamp_ns
        self.shots.put(Shot(pixels, self.bag.base_ns + at_ns + 8_000_000, stamp))

    def unplug(self) -> None:
        self.plugged = False
        self.shots.put(None)


class FakeCapture:
    """A replacement of cv2.VideoCapture."""

    def __init__(self, camera: FakeCamera | None) -> None:
        self.camera = camera
        self.grabbing = False
        self.released = threading.Event()
        self.shot: Shot | None = None

    def isOpened(self) -> bool:
        return self.camera is not None

    def set(self, property_id: int, value: float) -> bool:
        camera = self.camera
        assert camera is not None
        camera.calls.append((property_id, value))
        if property_id in camera.fixed or property_id not in camera.properties:
            return False
        low, high = camera.bounds.get(property_id, (-np.inf, np.inf))
        camera.properties[property_id] = float(np.clip(value, low, high))
        return True

    def get(self, property_id: int) -> float:
        assert self.camera is not None
        if property_id == cv2.CAP_PROP_POS_MSEC:
            return self.shot.stamp_ns * 1e-6 if self.shot else 0.0
        return self.camera.properties.get(property_id, -1.0)

    def grab(self) -> bool:
        assert self.camera is not None
        self.grabbing = True
        self.shot = self.camera.shots.get()
        self.grabbing = False
        if self.shot is None:
            return False
        self.camera.bag.arrived.ns = self.shot.arrival_ns
        return True

    def retrieve(self) -> tuple[bool, Image | None]:
        return self.shot is not None, self.shot and self.shot.image

    def release(self) -> None:
        assert not self.grabbing, "released during a grab"
        self.released.set()


class CameraBag:
    """All fake cameras of a test. For each reader thread, the clock shows the arrival time of the
    newest frame.
    """

    def __init__(self) -> None:
        self.base_ns = time.monotonic_ns()
        self.arrived = threading.local()
        self.cameras: dict[int | str, FakeCamera] = {}
        self.id = "bag"

    def now_ns(self) -> int:
        return getattr(self.arrived, "ns", time.monotonic_ns())

    def plug(self, device: int | str, **properties: float) -> FakeCamera:
        """Add a UVC camera with the properties of V4L2.

        properties: names in OpenCV without CAP_PROP_.
        """
        camera = self.cameras[device] = FakeCamera(self)
        usual = {
            "BUFFERSIZE": 4,
            "FOURCC": 0,
            "FRAME_WIDTH": 640,
            "FRAME_HEIGHT": 480,
            "FPS": 30,
            "MODE": 0,
            "AUTO_EXPOSURE": 3,
            "EXPOSURE": 157,
            "GAIN": 64,
            "AUTO_WB": 1,
        }
        for name, value in {**usual, **properties}.items():
            camera.properties[getattr(cv2, f"CAP_PROP_{name}")] = float(value)
        return camera

    def open(self, device: int | str, api: int = cv2.CAP_ANY) -> FakeCapture:
        camera = self.cameras.get(device)
        if camera is None or not camera.plugged:
            return FakeCapture(None)
        capture = FakeCapture(camera)
        camera.captures.append(capture)
        return capture

    def empty(self) -> None:
        """Wake all threads that wait for a frame."""
        for camera in self.cameras.values():
            for _ in camera.captures:
                camera.shots.put(None)
