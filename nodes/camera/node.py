"""The camera: pictures of the finger, from the twin, from devices or from files."""

from __future__ import annotations

import asyncio
from typing import ClassVar

from messages.base import Header
from messages.scene import Positive, Scene, StereoCamera
from messages.types import StereoPair
from nodes.camera.devices import (
    AnySource,
    DeviceError,
    Pictures,
    ReaderThread,
    TwinSource,
    check_size,
    open_reader,
)
from nodes.node import Input, Node, NodeParameters, Output

JOIN_S = 3.0


class CameraParameters(NodeParameters):
    """source: where pictures come from.  retry_s: first pause after a device failed."""

    source: AnySource = TwinSource()
    retry_s: Positive = 1.0


class Camera(Node):
    """Publishes stereo pairs with the time of their exposure."""

    opens_devices: ClassVar[bool] = True

    parameters: CameraParameters
    scene: Input[Scene]
    twin__stereo: Input[StereoPair]
    stereo: Output[StereoPair]

    reader: ReaderThread | None = None
    waiting: tuple[Pictures, int] | None = None
    dropped = 0

    async def close(self) -> None:
        await self._stop_reading()

    async def on_scene(self, scene: Scene, header: Header) -> None:
        if self.parameters.source.kind == "twin":
            return
        await self._stop_reading()
        loop, camera = asyncio.get_running_loop(), scene.camera

        def deliver(pictures: Pictures, lost: int) -> None:
            if self.waiting is not None:
                self.dropped += 1
            self.waiting = (pictures, lost)
            loop.call_soon_threadsafe(self._publish_newest, camera)

        self.reader = ReaderThread(
            lambda: open_reader(self.parameters.source, camera, self.clock.now_ns),
            camera=camera,
            name=f"{self.name} {self.parameters.source.kind}",
            now=self.clock.now_ns,
            retry_s=self.parameters.retry_s,
            deliver=deliver,
            fail=lambda error: self._tell(loop, error),
            finish=lambda pairs: self._tell(loop, pairs),
        )
        self.reader.start()

    def _tell(self, loop: asyncio.AbstractEventLoop, news: DeviceError | int) -> None:
        """From the reading thread: a failure, or the number of pairs after which they ended."""
        if isinstance(news, DeviceError):
            loop.call_soon_threadsafe(self.report_error, "source", news)
            loop.call_soon_threadsafe(setattr, self, "note", f"no pictures: {news}")
        else:
            loop.call_soon_threadsafe(setattr, self, "note", f"ended after {news} pairs")

    def _publish_newest(self, camera: StereoCamera) -> None:
        waiting, self.waiting = self.waiting, None
        if waiting is None:
            return
        pictures, lost = waiting
        pair = StereoPair(
            device=camera.device,
            exposure_s=camera.exposure_s,
            dropped_frames=self.dropped + lost,
            left=pictures.left,
            right=pictures.right,
        )
        self.stereo.publish(pair, source_ns=pictures.exposure_ns)
        self.note = f"{camera.device}, {pair.dropped_frames} frames lost"

    def on_twin__stereo(self, pair: StereoPair, header: Header) -> None:
        if self.parameters.source.kind != "twin" or self.scene.message is None:
            return
        pictures = Pictures(pair.left, pair.right, header.source_ns)
        check_size(pictures, self.scene.message.camera, "twin/stereo")
        self.stereo.publish(pair, source_ns=header.source_ns)
        self.note = f"{pair.device}, {pair.dropped_frames} frames lost"

    async def _stop_reading(self) -> None:
        reader, self.reader = self.reader, None
        if reader is None:
            return
        reader.stop()
        await asyncio.to_thread(reader.join, JOIN_S)
        if reader.is_alive():
            self.log.error("a device does not answer; its thread stays", reader=reader.name)
        self.waiting = None
