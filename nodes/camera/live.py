"""Read live cameras with one thread per camera, which records the arrival time of the frames."""

from __future__ import annotations

import threading
from collections import deque
from dataclasses import dataclass
from typing import Any

import cv2

from flexsheet.messages.scene import StereoCamera
from flexsheet.nodes.camera.captures import CAPTURES
from flexsheet.nodes.camera.image_pair import (
    DeviceError,
    Image,
    ImagePair,
    Now,
    Region,
    Regions,
    convert_to_gray,
    split_side_by_side,
)
from flexsheet.nodes.camera.settings import (
    Backend,
    choose_backend,
    fix_settings,
    set_format,
    set_region,
)
from flexsheet.nodes.camera.sources import OpenCvSource
from flexsheet.nodes.camera.stamps import Pairing, StampCheck

MAX_WAITING_FRAMES = 4
"""The maximum number of frames in the queue for pairing. If the queue is full, a new frame replaces
the oldest frame."""
FIRST_FRAME_S = 5.0
"""The minimum timeout (s) for the first frame. Sensors need time to start."""
RELEASE_S = 0.5

RATE_FRAMES = 61
"""The number of image pairs over which the actual frame rate is measured."""


@dataclass(frozen=True, slots=True)
class CapturedFrame:
    """An image of one camera with two estimates of the mid-exposure time.

    by_arrival_ns: estimate that is based on the time of arrival.
    by_stamp_ns: estimate that is based on the driver's timestamp; None if there is no timestamp.
    """

    image: Image
    by_arrival_ns: int
    by_stamp_ns: int | None


def open_capture(device: int | str, api: int = cv2.CAP_ANY) -> cv2.VideoCapture:
    """Open a device, file or stream with OpenCV. Raises DeviceError if this fails."""
    capture = cv2.VideoCapture(device, api)
    if not capture.isOpened():
        capture.release()
        raise DeviceError(
            f"{device!r} cannot be opened: it does not exist, is in use, or is no camera or video; "
            "correct the device or close the other program"
        )
    return capture


def open_device(device: int | str, api: str | None, backend: Backend | None) -> Any:
    """Open a camera with a backend. Raises DeviceError if this fails.

    The result has the interface of cv2.VideoCapture.
    """
    if api in CAPTURES:
        return CAPTURES[api](str(device))
    return open_capture(device, backend.api if backend else cv2.CAP_ANY)


class Stream(threading.Thread):
    """A thread that reads the frames of one camera.

    views: 2 if each image contains both views side by side, otherwise 1.
    requested: region of the sensor to read; None means the full sensor.
    changed: condition that is notified after each frame and after a failure.

    The thread also releases the device, because OpenCV crashes if another thread releases the
    device while a frame is grabbed. Raises DeviceError if the device cannot be opened or
    configured.
    """

    def __init__(
        self,
        device: int | str,
        source: OpenCvSource,
        camera: StereoCamera,
        *,
        views: int,
        requested: Region | None,
        now: Now,
        changed: threading.Condition,
    ) -> None:

        super().__init__(name=f"camera {device}", daemon=True)
        self.device = device
        self.frames: deque[CapturedFrame] = deque(maxlen=MAX_WAITING_FRAMES)
        self.count = 0
        self.failure: Exception | None = None
        self._now, self._changed = now, changed
        self._stopping = threading.Event()
        backend = choose_backend(device, source.api)
        self._capture = open_device(device, source.api, backend)
        try:
            set_format(self._capture, backend, camera, views, source.pixel_format or "")
            self.region = requested and set_region(self._capture, backend, requested, camera)
            self.settings = fix_settings(self._capture, backend, camera, device)
        except (DeviceError, cv2.error):
            self._capture.release()
            raise
        self.exposure_s = self.settings.exposure_s or camera.exposure_s
        self._stamp_check = StampCheck() if backend is not None and backend.clock else None
        to_stamp_s, to_grab_s = source.exposure_to_stamp_s, source.exposure_to_grab_s
        if to_stamp_s is None:
            to_stamp_s = (backend.stamp_fraction if backend else 0.5) * self.exposure_s
        if to_grab_s is None:
            to_grab_s = 0.5 * self.exposure_s
        self._to_stamp_ns, self._to_grab_ns = round(1e9 * to_stamp_s), round(1e9 * to_grab_s)

    @property
    def trusts_stamps(self) -> bool:
        """Return whether the driver's timestamps are plausible."""
        return self._stamp_check is not None and self._stamp_check.trusted

    def stop(self) -> None:
        """Stop the thread after the current frame."""
        self._stopping.set()
        if self.ident is None:
            self._capture.release()

    def run(self) -> None:
        try:
            while not self._stopping.is_set():
                frame = self._next()
                if frame is not None:
                    with self._changed:
                        self.frames.append(frame)
                        self.count += 1
                        self._changed.notify_all()
        except (DeviceError, cv2.error) as error:
            with self._changed:
                self.failure = error
                self._changed.notify_all()
        finally:
            self._capture.release()

    def _next(self) -> CapturedFrame | None:
        """Read the next frame; return None if the frame has an implausible timestamp.

        Raises DeviceError if the camera delivers no image.
        """
        grabbed = self._capture.grab()
        arrival_ns = self._now()
        stamp_ns = None
        if grabbed and self._stamp_check is not None and self._stamp_check.trusted:
            stamp_ns = round(1e6 * self._capture.get(cv2.CAP_PROP_POS_MSEC))
            if not self._stamp_check.is_plausible(stamp_ns, arrival_ns):
                if self._stamp_check.trusted:
                    return None
                stamp_ns = None
        image = self._capture.retrieve()[1] if grabbed else None
        if image is None:
            raise DeviceError(
                f"camera {self.device!r} does not deliver images any more: it was unplugged, or "
                "the stream ended; check its cable"
            )
        by_stamp_ns = None if stamp_ns is None else stamp_ns - self._to_stamp_ns
        return CapturedFrame(convert_to_gray(image), arrival_ns - self._to_grab_ns, by_stamp_ns)


class CameraReader:
    """A reader of two free-running cameras, or of one camera with both views side by side.

    If the timestamps of all drivers are plausible, the mid-exposure time of a frame is its
    timestamp minus `exposure_to_stamp_s`. Otherwise the mid-exposure time is the time of arrival
    minus `exposure_to_grab_s`.
    """

    paced = False

    def __init__(
        self, source: OpenCvSource, camera: StereoCamera, now: Now, requested: Regions | None = None
    ) -> None:
        self._source, self._now = source, now
        self._changed = threading.Condition()
        self._streams: list[Stream] = []
        self._interrupted = False
        devices = [device for device in (source.left, source.right) if device is not None]
        is_single = len(devices) == 1
        try:
            for index, device in enumerate(devices):
                stream = Stream(
                    device,
                    source,
                    camera,
                    views=2 if is_single else 1,
                    # If one image contains both views, it cannot have a region for each.
                    requested=None if requested is None or is_single else requested[index],
                    now=now,
                    changed=self._changed,
                )
                self._streams.append(stream)
        except (DeviceError, cv2.error):
            self.close()
            raise
        settings = [stream.settings for stream in self._streams]
        self.warnings: tuple[str, ...] = tuple(text for each in settings for text in each.warnings)
        self.opened: tuple[str, ...] = tuple(each.got for each in settings)
        self._exposures_ns: deque[int] = deque(maxlen=RATE_FRAMES)
        rate_hz = min(each.rate_hz for each in settings)
        self.rate_hz: float | None = rate_hz
        self._pairing = Pairing(1.0 / rate_hz)
        self._regions: Regions | None = None
        if any(stream.region is not None for stream in self._streams):
            whole = Region(0, 0, camera.width_px, camera.height_px)
            left, right = (stream.region or whole for stream in self._streams)
            self._regions = left, right
        self._wait_s = max(FIRST_FRAME_S, source.silence_s)
        for stream in self._streams:
            stream.start()

    def read(self) -> ImagePair | None:
        """Wait for the next image pair and return it. Raises DeviceError if no pair arrives."""
        with self._changed:
            counts = [stream.count for stream in self._streams]
            limit_ns = self._now() + round(1e9 * self._wait_s)
            while not self._interrupted:
                frames = self._pop_frames()
                if frames is not None:
                    break
                for stream in self._streams:
                    if stream.failure is not None:
                        raise stream.failure
                left_s = (limit_ns - self._now()) * 1e-9
                if left_s <= 0.0:
                    raise DeviceError(self._describe_silence(counts))
                self._changed.wait(left_s)
            else:
                return None
        self._wait_s = self._source.silence_s
        return self._make_pair(frames)

    def _by_stamp(self) -> bool:
        return all(stream.trusts_stamps for stream in self._streams)

    def _exposure_ns(self, frame: CapturedFrame) -> int:
        if frame.by_stamp_ns is not None and self._by_stamp():
            return frame.by_stamp_ns
        return frame.by_arrival_ns

    def _pop_frames(self) -> tuple[CapturedFrame, ...] | None:
        """Remove the next image pair from the queues, and return its one or two frames.

        The result has one frame if the frame contains both views. Returns None if no pair is
        complete.
        """
        if len(self._streams) == 1:
            frames = self._streams[0].frames
            return (frames.popleft(),) if frames else None
        left, right = self._streams
        return self._pairing.pop_pair(left.frames, right.frames, self._exposure_ns)

    def _make_pair(self, frames: tuple[CapturedFrame, ...]) -> ImagePair:
        exposures_ns = [self._exposure_ns(frame) for frame in frames]
        notes = ["stamped by the driver" if self._by_stamp() else "stamped on arrival"]
        self._exposures_ns.append(exposures_ns[0])
        if len(self._exposures_ns) == RATE_FRAMES:
            duration_ns = self._exposures_ns[-1] - self._exposures_ns[0]
            notes.append(f"{1e9 * (RATE_FRAMES - 1) / max(duration_ns, 1):.1f} Hz measured")
        if len(frames) == 1:
            left, right = split_side_by_side(frames[0].image, self._source.left)
        else:
            left, right = frames[0].image, frames[1].image
            notes.append(f"{self._pairing.unpaired} frames without a partner")
        return ImagePair(
            left,
            right,
            sum(exposures_ns) // len(exposures_ns),
            exposure_s=max(stream.exposure_s for stream in self._streams),
            skew_s=(exposures_ns[-1] - exposures_ns[0]) * 1e-9,
            regions=self._regions,
            notes=tuple(notes),
        )

    def _describe_silence(self, counts: list[int]) -> str:
        """Return an error text with the reason why no image pair arrived.

        counts: number of frames that each camera had delivered when the wait began.
        """
        silent = [
            repr(stream.device)
            for stream, count in zip(self._streams, counts, strict=True)
            if stream.count == count
        ]
        if silent:
            return (
                f"camera {' and '.join(silent)}: no image for {self._wait_s:g} s; check the "
                "device, its cable and its hub"
            )
        return (
            f"cameras {self._source.left!r} and {self._source.right!r}: no two images were taken "
            "within half a period; set both cameras to the same rate"
        )

    def interrupt(self) -> None:
        """Make the current `read` call and all later calls return None.

        Any thread may call this method.
        """
        with self._changed:
            self._interrupted = True
            self._changed.notify_all()

    def close(self) -> None:
        """Close the cameras.

        If a camera is waiting for a frame, the camera is released after this frame has arrived.
        """
        for stream in self._streams:
            stream.stop()
        for stream in self._streams:
            if stream.ident is not None:
                stream.join(RELEASE_S)
        self._streams = []
