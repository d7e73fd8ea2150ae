"""Publish images of the finger, from the simulator, from devices or from files."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any, ClassVar, Literal

from pydantic import Field

from flexsheet.messages.base import Header
from flexsheet.messages.scene import Positive, Scene, StereoCamera
from flexsheet.messages.types import StereoPair
from flexsheet.nodes import NodeRole
from flexsheet.nodes.camera.devices import ReaderThread, open_reader
from flexsheet.nodes.camera.image_pair import (
    DeviceError,
    ImagePair,
    Regions,
    check_size,
    cut,
    make_image_pair,
    make_stereo_message,
    skew_reason,
)
from flexsheet.nodes.camera.region import ExplicitRegions, resolve_regions
from flexsheet.nodes.camera.sources import AnySource, TwinSource
from flexsheet.nodes.node import Input, Node, NodeParameters, Output

JOIN_S = 3.0


class CameraParameters(NodeParameters):
    """Hold the source of the images, and which of them are published."""

    source: AnySource = TwinSource()
    retry_s: Positive = Field(default=1.0, description="first pause after a device failed")
    max_skew_s: Positive | None = Field(
        default=None, description="pairs further apart are refused; null: none"
    )
    region: Literal["full", "finger"] | ExplicitRegions = Field(
        default="full", description="part of each view to publish; finger: where one can be"
    )


class Camera(Node):
    """Publish stereo pairs with the time of their exposure."""

    role: ClassVar[NodeRole | None] = NodeRole.CAMERA
    opens_devices: ClassVar[bool] = True

    parameters: CameraParameters
    scene: Input[Scene]
    twin__stereo: Input[StereoPair]
    stereo: Output[StereoPair]

    camera: StereoCamera | None = None
    regions: Regions | None = None
    reader: ReaderThread | None = None
    waiting: tuple[ImagePair, int] | None = None
    warned: tuple[str, ...] = ()
    superseded = refused = 0

    @classmethod
    def replay_refusal(cls, parameters: Any) -> str:
        if parameters.source.kind == "twin":
            return ""  # It passes on twin/stereo and opens no device.
        return (
            "it reads a device, which is not in the bag; with stereo recorded, "
            "`bag verify triangulator` starts from what it read"
        )

    async def close(self) -> None:
        await self._stop_reading()

    async def on_scene(self, scene: Scene, header: Header) -> None:
        await self._stop_reading()
        self.camera, self.warned = None, ()
        regions = self.regions = resolve_regions(self.parameters.region, scene)
        camera = self.camera = scene.camera
        if self.parameters.source.kind == "twin":
            return
        loop = asyncio.get_running_loop()

        def later(call: Callable[..., None], *arguments: object) -> None:
            loop.call_soon_threadsafe(call, *arguments)

        def deliver(pictures: ImagePair, lost: int) -> None:
            if self.waiting is not None:
                self.superseded += 1
            self.waiting = (pictures, lost)
            later(self._publish_newest, camera)

        self.reader = ReaderThread(
            lambda: open_reader(self.parameters.source, camera, self.clock.now_ns, regions),
            camera=camera,
            regions=regions,
            name=f"{self.name} {self.parameters.source.kind}",
            now=self.clock.now_ns,
            retry_s=self.parameters.retry_s,
            deliver=deliver,
            fail=lambda error: later(self._tell_failure, error),
            warn=lambda text: later(self._tell_warning, text),
            finish=lambda pairs: later(setattr, self, "note", f"ended after {pairs} pairs"),
        )
        self.reader.start()

    def _tell_failure(self, error: DeviceError) -> None:
        self.report_error("source", error)
        self.note = f"no pictures: {error}"

    def _tell_warning(self, text: str) -> None:
        """Report a warning once per scene, however often the device is opened."""
        if text not in self.warned:
            self.warned = (*self.warned, text)
            self.report_error("source", DeviceError(text))

    def _publish_newest(self, camera: StereoCamera) -> None:
        waiting, self.waiting = self.waiting, None
        if waiting is not None:
            pictures, lost = waiting
            self._publish(pictures, camera.device, camera.exposure_s, self.superseded + lost)

    def on_twin__stereo(self, pair: StereoPair, header: Header) -> None:
        if self.parameters.source.kind != "twin" or self.camera is None:
            return
        pictures = make_image_pair(pair, header.source_ns)
        check_size(pictures, self.camera, "twin/stereo")
        if self.regions is not None:
            pictures = cut(pictures, self.regions)
        self._publish(pictures, pair.device, pair.exposure_s, pair.dropped_frames)

    def _publish(self, pictures: ImagePair, device: str, exposure_s: float, lost: int) -> None:
        """Publish a pair.

        exposure_s: used where the device does not report it.
        lost: number of lost frames, apart from rejected ones.
        """
        limit_s = self.parameters.max_skew_s
        if limit_s is not None and abs(pictures.skew_s) > limit_s:
            self.refused += 1
            self.note = f"{self.refused} pairs refused: {skew_reason(pictures.skew_s, limit_s)}"
            return
        pair = make_stereo_message(pictures, device, exposure_s, lost + self.refused)
        self.stereo.publish(pair, source_ns=pictures.exposure_ns)
        facts = (device, f"{pair.dropped_frames} frames lost", *pictures.notes, *self.warned)
        self.note = "; ".join(facts)

    async def _stop_reading(self) -> None:
        reader, self.reader = self.reader, None
        if reader is None:
            return
        reader.stop()
        await asyncio.to_thread(reader.join, JOIN_S)
        if reader.is_alive():
            self.log.error("a device does not answer; its thread stays", reader=reader.name)
        self.waiting = None
