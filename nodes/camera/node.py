"""Publish stereo images of the finger from the simulator, from cameras or from files."""

from __future__ import annotations

import asyncio
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field

from flexsheet.messages.base import Header
from flexsheet.messages.notes import NoteCode
from flexsheet.messages.scene import Positive, Scene, StereoCamera
from flexsheet.messages.types import ParameterChange, StereoPair
from flexsheet.nodes import NodeRole
from flexsheet.nodes.camera.devices import ReaderThread, open_reader
from flexsheet.nodes.camera.image_pair import (
    DeviceError,
    ImagePair,
    Regions,
    check_size,
    crop,
    describe_skew,
    make_image_pair,
    make_stereo_message,
)
from flexsheet.nodes.camera.region import ExplicitRegions, resolve_regions
from flexsheet.nodes.camera.sources import AnySource, TwinSource
from flexsheet.nodes.node import Input, Node, NodeParameters, Output

JOIN_S = 3.0


class CameraParameters(NodeParameters):
    """The parameters of the camera node."""

    source: AnySource = TwinSource()
    retry_s: Positive = Field(
        default=1.0,
        description="time after a first failure until the source is opened again, s; the time "
        "doubles with each further failure",
    )
    max_skew_s: Positive | None = Field(
        default=None,
        description="maximum time between the left and right exposure of a published pair, s; "
        "null: no limit",
    )
    stamp_offset_s: Annotated[float, Field(ge=-0.1, le=0.1)] = Field(
        default=0.0,
        description="time by which exposures are later than their timestamps, s. It is added to "
        "all timestamps",
    )
    region: Literal["full", "finger"] | ExplicitRegions = Field(
        default="full",
        description="part of each view to publish: full, finger (the part in which the finger can "
        "appear), or explicit regions",
    )


class Camera(Node):
    """A node that publishes stereo image pairs with their exposure times."""

    role: ClassVar[NodeRole | None] = NodeRole.CAMERA
    opens_devices: ClassVar[bool] = True

    watched_inputs: ClassVar[frozenset[str]] = frozenset({"twin__stereo"})
    ends_with_inputs: ClassVar[bool] = True
    live_parameters: ClassVar[frozenset[str]] = frozenset({"max_skew_s"})
    parameters: CameraParameters
    scene: Input[Scene]
    twin__stereo: Input[StereoPair]
    parameter: Input[ParameterChange]
    stereo: Output[StereoPair]

    camera: StereoCamera | None = None
    regions: Regions | None = None
    reader: ReaderThread | None = None
    newest: tuple[ImagePair, int] | None = None
    opened: tuple[str, ...] = ()
    warned: tuple[str, ...] = ()
    superseded = rejected = 0

    @classmethod
    def replay_refusal(cls, parameters: Any) -> str:
        if parameters.source.kind == "twin":
            return ""  # It forwards the topic twin/stereo, so it opens no device.
        return (
            "it reads a device or files, which the bag does not contain; `bag verify triangulator` "
            "replays a recorded topic stereo"
        )

    async def close(self) -> None:
        await self._stop_reading()

    async def on_scene(self, scene: Scene, header: Header) -> None:
        await self._stop_reading()
        self.camera, self.opened, self.warned = None, (), ()
        regions = self.regions = resolve_regions(self.parameters.region, scene)
        camera = self.camera = scene.camera
        if self.parameters.source.kind == "twin":
            return
        later = asyncio.get_running_loop().call_soon_threadsafe

        def deliver(images: ImagePair, lost: int) -> None:
            if self.newest is not None:
                self.superseded += 1
            self.newest = (images, lost)
            later(self._publish_newest, camera)

        self.reader = ReaderThread(
            lambda: open_reader(self.parameters.source, camera, self.clock.now_ns, regions),
            camera=camera,
            regions=regions,
            name=f"{self.name} {self.parameters.source.kind}",
            now=self.clock.now_ns,
            retry_s=self.parameters.retry_s,
            deliver=deliver,
            fail=lambda error: later(self._report_failure, error),
            report=lambda text: later(self._report_opened, text),
            warn=lambda text: later(self._report_warning, text),
            finish=lambda pairs: later(self._report_end, pairs),
        )
        self.reader.start()

    def _report_end(self, pairs: int) -> None:
        self.set_note(NoteCode.SOURCE_ENDED, f"{pairs} pairs read")

    def _report_failure(self, error: DeviceError) -> None:
        self.report_error("source", error)
        self.set_note(NoteCode.NO_IMAGES, str(error))

    def _report_opened(self, text: str) -> None:
        if text not in self.opened:
            self.opened = (*self.opened, text)
            self.log.info("camera opened", device=text)

    def _report_warning(self, text: str) -> None:
        """Report a warning only once per scene, even if the device is opened several times."""
        if text not in self.warned:
            self.warned = (*self.warned, text)
            self.report_error("source", DeviceError(text))

    def _publish_newest(self, camera: StereoCamera) -> None:
        newest, self.newest = self.newest, None
        if newest is not None:
            images, lost = newest
            self._publish(images, camera.device, camera.exposure_s, self.superseded + lost)

    def on_twin__stereo(self, pair: StereoPair, header: Header) -> None:
        if self.parameters.source.kind != "twin" or self.camera is None:
            return
        images = make_image_pair(pair, header.source_ns)
        check_size(images, self.camera, "twin/stereo")
        if self.regions is not None:
            images = crop(images, self.regions)
        self._publish(images, pair.device, pair.exposure_s, pair.dropped_frames)

    def _publish(self, images: ImagePair, device: str, exposure_s: float, lost: int) -> None:
        """Publish an image pair, unless its two exposures are too far apart in time.

        exposure_s: exposure time that is used if the device reports no exposure time.
        lost: total number of lost frames, without the frames of rejected pairs.
        """
        limit_s = self.parameters.max_skew_s
        if limit_s is not None and abs(images.skew_s) > limit_s:
            self.rejected += 1
            skew = describe_skew(images.skew_s, limit_s)
            self.set_note(NoteCode.PAIRS_REJECTED, f"{self.rejected}, {skew}")
            return
        pair = make_stereo_message(images, device, exposure_s, lost + self.rejected)
        offset_ns = round(1e9 * self.parameters.stamp_offset_s)
        self.stereo.publish(pair, source_ns=images.exposure_ns + offset_ns)
        lost_text = f"{pair.dropped_frames} frames lost"
        self.set_notes(
            {
                NoteCode.INFO: "; ".join((device, lost_text, *images.notes, *self.opened)),
                NoteCode.CAMERA_SETTINGS: "; ".join(self.warned),
            }
        )

    async def _stop_reading(self) -> None:
        reader, self.reader = self.reader, None
        if reader is None:
            return
        reader.stop()
        await asyncio.to_thread(reader.join, JOIN_S)
        if reader.is_alive():
            self.log.error(
                "the camera does not respond, so its thread continues; restart the node",
                reader=reader.name,
            )
        self.newest = None
