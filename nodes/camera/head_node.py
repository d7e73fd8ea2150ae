"""Measure the positions of the user's eyes with a camera in front of the user, and publish them."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable
from typing import Annotated, ClassVar

import cv2
import numpy as np
from pydantic import Field

from flexsheet.messages.base import Header
from flexsheet.messages.scene import Lens, NonNegative, Pose, Positive, Scene
from flexsheet.messages.types import Eye
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.camera.head_eyes import (
    Detector,
    EyeFilter,
    load_detector,
    locate_eyes,
)
from flexsheet.nodes.camera.image_pair import DeviceError, Now, convert_to_gray
from flexsheet.nodes.camera.live import open_capture
from flexsheet.nodes.external_input import RejectedError, Rejection, make_eye
from flexsheet.nodes.models.rigid import pose_matrix
from flexsheet.nodes.node import Input, Node, NodeParameters, Output, periodic

JOIN_S = 1.0
DRAIN_NS = 10_000_000
"""The time (ns) after a face search in which arriving images are discarded. These images have
waited in the driver's queue and are outdated."""
PixelCount = Annotated[int, Field(gt=0)]


class HeadCameraParameters(NodeParameters):
    """The parameters of the head camera."""

    device: int | str = Field(
        default=0, description="number or path of the camera, or a stream that OpenCV opens"
    )
    width_px: PixelCount = Field(default=640, description="width of the images, px")
    height_px: PixelCount = Field(default=480, description="height of the images, px")
    lens: Lens = Field(
        default=Lens(fx_px=600.0, fy_px=600.0, cx_px=319.5, cy_px=239.5),
        description="lens of the camera for this image size; default: a typical webcam. An error "
        "of 1 % in the focal length causes an error of 1 % in the distance of the eyes",
    )
    world_from_camera: Pose = Field(
        default=Pose(position_m=np.array([0.0, 0.25, 0.0]), rpy_rad=np.array([0.0, 0.0, np.pi])),
        description="pose of the camera in the world; its axes are x right, y down and z along the "
        "optical axis",
    )
    max_rate_hz: Positive = Field(
        default=15.0, description="maximum rate at which images are searched for a face, Hz"
    )
    search_width_px: PixelCount = Field(
        default=480,
        description="width to which larger images are reduced for the face search, px. A face must "
        "be at least 80 px wide in the reduced image",
    )
    delay_s: NonNegative = Field(
        default=0.03, description="time from the exposure to the arrival of an image, s"
    )
    min_cutoff_hz: Positive = Field(
        default=1.0, description="cutoff frequency of the filter for a head at rest, Hz"
    )
    cutoff_per_speed_hz: NonNegative = Field(
        default=20.0,
        description="increase of the cutoff frequency with the speed of the head, Hz per m/s",
    )
    silence_s: Positive = Field(
        default=0.3,
        description="time without detected eyes after which the filter is reset, and time without "
        "an image after which the eyes are published as invalid, s",
    )
    retry_s: Positive = Field(
        default=2.0, description="time after a failure until the camera is opened again, s"
    )
    watch_hz: Positive = Field(
        default=5.0, description="rate at which the node checks for missing images, Hz"
    )


class HeadCamera(Node):
    """A node that publishes the positions of the user's eyes from the images of a UVC camera.

    The distance of the eyes is computed from the interocular distance in the scene and from the
    focal length. If the camera, its packages or a face are missing, the published message is marked
    as invalid. The renderer then uses the eye positions in the scene.
    """

    opens_devices: ClassVar[bool] = True
    parameters: HeadCameraParameters
    scene: Input[Scene]
    eye: Output[Eye]

    current_scene: Scene | None = None
    reader: FaceReader | None = None

    async def setup(self) -> None:
        p = self.parameters
        self._filter = EyeFilter(p.min_cutoff_hz, p.cutoff_per_speed_hz)
        self._last_eye: Eye | None = None
        self._valid_ns: int | None = None
        self._published_ns: int | None = None
        self._problem = ""
        later = asyncio.get_running_loop().call_soon_threadsafe
        self.reader = FaceReader(
            p,
            self.clock.now_ns,
            deliver=lambda at_ns, pixels: later(self._receive, at_ns, pixels),
            fail=lambda error: later(self._report, error),
        )
        self.reader.start()

    async def close(self) -> None:
        reader, self.reader = self.reader, None
        if reader is not None:
            reader.stopping.set()
            await asyncio.to_thread(reader.join, JOIN_S)

    def on_scene(self, scene: Scene, header: Header) -> None:
        self.current_scene = scene
        self._filter.reset()
        self._valid_ns = None
        self._last_eye = Eye(valid=False, centre_world_m=scene.eyes.centre_world_m)

    def _report(self, error: DeviceError) -> None:
        self.note = f"the eyes are not tracked: {error}"
        if str(error) != self._problem:
            self._problem = str(error)
            self.report_error("source", error)

    def _receive(self, at_ns: int, pixels: Floats | None) -> None:
        """Publish the eye positions that were found in one image.

        at_ns: time of the exposure.
        pixels: positions (2, 2) of both eyes, px; None if the image shows no face.
        """
        scene, last_ns = self.current_scene, self._published_ns
        if scene is None or (last_ns is not None and at_ns <= last_ns):
            return
        self._problem = ""
        if pixels is None:
            self._publish_invalid(at_ns, "the image contains no face")
        elif scene.eyes.interocular_m == 0.0:
            self._publish_invalid(at_ns, "the scene's eyes.interocular_m is 0")
        else:
            self._publish_eyes(at_ns, pixels, scene)

    def _publish_eyes(self, at_ns: int, pixels: Floats, scene: Scene) -> None:
        p = self.parameters
        pose = p.world_from_camera
        centre, right = locate_eyes(pixels, p.lens, scene.eyes.interocular_m, pose_matrix(pose))
        if self._valid_ns is None or at_ns - self._valid_ns > 1e9 * p.silence_s:
            self._filter.reset()
        try:
            make_eye(centre, right, scene)  # An implausible position must not enter the filter.
        except RejectedError as error:
            x, y, z = centre
            far = error.reason is Rejection.OUTSIDE_RANGE
            why = "more than 1 m from the scene's eyes" if far else "not finite"
            where = f"the eyes are at ({x:.2f}, {y:.2f}, {z:.2f}) m, {why}"
            self._publish_invalid(at_ns, f"{where}; check lens and world_from_camera")
            return
        filtered = self._filter.update(1e-9 * at_ns, np.concatenate([centre, right]))
        self._last_eye = make_eye(filtered[:3], filtered[3:], scene)
        self._valid_ns = self._published_ns = at_ns
        self.eye.publish(self._last_eye, source_ns=at_ns)
        self.note = "the eyes are tracked"

    def _publish_invalid(self, at_ns: int, note: str = "") -> None:
        if self._last_eye is None:
            return
        self._published_ns = at_ns
        self.eye.publish(self._last_eye.model_copy(update={"valid": False}), source_ns=at_ns)
        self.note = note or self.note

    @periodic("watch_hz")
    async def watch(self) -> None:
        """Publish that the eye position is invalid if no images arrive.

        The message has a timestamp in the past, by the parameter `silence_s` plus the camera's
        delay. Therefore it is older than the result of an image that is still being processed.
        """
        p = self.parameters
        at_ns = self.clock.now_ns() - round(1e9 * (p.delay_s + p.silence_s))
        if self._published_ns is None or at_ns > self._published_ns:
            self._publish_invalid(at_ns)


class FaceReader(threading.Thread):
    """A thread that searches the newest image of a camera for eyes.

    deliver(at_ns, pixels): function that receives the exposure time of each searched image, and the
        pixel positions (2, 2) of the eyes. The positions are None if the image shows no face.
    fail(error): function that receives each DeviceError. The camera is then opened again after a
        delay.

    Both functions are called in the thread itself.
    """

    def __init__(
        self,
        parameters: HeadCameraParameters,
        now: Now,
        deliver: Callable[[int, Floats | None], object],
        fail: Callable[[DeviceError], object],
    ) -> None:
        super().__init__(name=f"head camera {parameters.device}", daemon=True)
        self._parameters, self._now = parameters, now
        self._deliver, self._fail = deliver, fail
        self.stopping = threading.Event()

    def run(self) -> None:
        detector: Detector | None = None
        while not self.stopping.is_set():
            try:
                detector = detector or load_detector(self._parameters.search_width_px)
                self._read(detector)
            except Exception as error:  # Drivers raise errors of many types.
                if self.stopping.is_set():
                    return
                if not isinstance(error, DeviceError):
                    error = DeviceError(f"{self.name}: {type(error).__name__}: {error}")
                self._fail(error)
                self.stopping.wait(self._parameters.retry_s)

    def _read(self, detect: Detector) -> None:
        """Search images for eyes until the thread stops. Raises DeviceError if the camera fails."""
        p = self._parameters
        capture = open_capture(p.device)
        try:
            capture.set(cv2.CAP_PROP_FRAME_WIDTH, p.width_px)
            capture.set(cv2.CAP_PROP_FRAME_HEIGHT, p.height_px)
            due_ns = 0
            while not self.stopping.is_set():
                # Each image is read, so that the next one is not an old one of the driver's queue.
                grabbed = capture.grab()
                now_ns = self._now()
                if grabbed and now_ns < due_ns:
                    continue
                image = capture.retrieve()[1] if grabbed else None
                if image is None:
                    raise DeviceError(
                        f"camera {p.device!r} does not deliver images any more; check its cable"
                    )
                height, width = image.shape[:2]
                if (width, height) != (p.width_px, p.height_px):
                    raise DeviceError(
                        f"camera {p.device!r} delivers images of {width}x{height} px instead of "
                        f"{p.width_px}x{p.height_px} px; set width_px, height_px and the lens"
                    )
                pixels = detect(convert_to_gray(image))
                due_ns = max(now_ns + round(1e9 / p.max_rate_hz), self._now() + DRAIN_NS)
                if not self.stopping.is_set():
                    self._deliver(now_ns - round(1e9 * p.delay_s), pixels)
        finally:
            capture.release()
