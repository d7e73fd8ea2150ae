"""Open a source of images, and read the images in a separate thread."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace

import cv2

from flexsheet.messages.scene import StereoCamera
from flexsheet.nodes.camera.files import ImagesReader, VideoReader
from flexsheet.nodes.camera.image_pair import (
    DeviceError,
    ImagePair,
    Now,
    Reader,
    Regions,
    check_size,
    crop,
)
from flexsheet.nodes.camera.live import CameraReader
from flexsheet.nodes.camera.sources import AnySource, ImagesSource, OpenCvSource, VideoSource

MAX_RETRY_S = 30.0


def open_reader(
    source: AnySource, camera: StereoCamera, now: Now, requested: Regions | None = None
) -> Reader:
    """Open a source of images, and return its reader.

    camera: camera of the scene.
    now: function that returns the current time (ns).
    requested: sensor regions that the camera must deliver; None means the full sensors.

    Raises DeviceError if the source cannot be opened.
    """
    if isinstance(source, OpenCvSource):
        return CameraReader(source, camera, now, requested)
    if isinstance(source, VideoSource):
        return VideoReader(source, camera.rate_hz)
    if isinstance(source, ImagesSource):
        return ImagesReader(source, camera)
    raise DeviceError(f'the source "{source.kind}" is not a device or a file that can be opened')


class ReaderThread(threading.Thread):
    """A thread that reads image pairs from a source, and reopens the source after a failure.

    deliver(images, lost): function that receives each image pair and the total number of lost
        frames.
    fail(error): function that receives each DeviceError. The source is then opened again after a
        delay, which doubles from `retry_s` to MAX_RETRY_S until images arrive.
    report(text): function that receives the format and the settings of each opened device.
    warn(text): function that receives a text about each setting that a device does not accept.
    finish(pairs): function that receives the number of image pairs at the end of the source.
    regions: sensor regions to deliver; None means the full images.

    All functions are called in the thread itself.
    """

    def __init__(
        self,
        open_source: Callable[[], Reader],
        *,
        camera: StereoCamera,
        regions: Regions | None = None,
        name: str,
        now: Now,
        retry_s: float,
        deliver: Callable[[ImagePair, int], object],
        fail: Callable[[DeviceError], object],
        report: Callable[[str], object],
        warn: Callable[[str], object],
        finish: Callable[[int], object],
    ) -> None:
        super().__init__(name=name, daemon=True)
        self._open, self._camera, self._regions = open_source, camera, regions
        self._now, self._retry_s = now, retry_s
        self._deliver, self._fail, self._warn, self._finish = deliver, fail, warn, finish
        self._report = report
        self._stopping = threading.Event()
        self._reader: Reader | None = None
        self._pairs = self._lost = 0
        self._wait_s = retry_s

    def stop(self) -> None:
        """Stop the thread after the current read operation."""
        self._stopping.set()
        reader = self._reader
        if reader is not None:
            reader.interrupt()

    def run(self) -> None:
        while not self._stopping.is_set():
            try:
                reader = self._reader = self._open()
                try:
                    for text in reader.opened:
                        self._report(text)
                    for text in reader.warnings:
                        self._warn(text)
                    self._read(reader)
                finally:
                    self._reader = None
                    reader.close()
            except Exception as error:  # Drivers raise errors of many types.
                if self._stopping.is_set():
                    return
                if not isinstance(error, DeviceError):
                    kind = "OpenCV" if isinstance(error, cv2.error) else type(error).__name__
                    error = DeviceError(f"{self.name}: {kind}: {error}")
                self._fail(error)
                self._stopping.wait(self._wait_s)
                self._wait_s = min(2.0 * self._wait_s, MAX_RETRY_S)
            else:
                return

    def _read(self, reader: Reader) -> None:
        start_ns: int | None = None
        newest_ns: int | None = None
        while not self._stopping.is_set():
            images = reader.read()
            if self._stopping.is_set():
                return
            if images is None:
                self._finish(self._pairs)
                return
            check_size(images, self._camera, self.name)
            if self._regions is not None:
                images = crop(images, self._regions)
            if reader.paced:
                if start_ns is None:
                    start_ns = self._now() - images.exposure_ns
                images = replace(images, exposure_ns=start_ns + images.exposure_ns)
                self._stopping.wait(max(0.0, (images.exposure_ns - self._now()) * 1e-9))
            elif reader.rate_hz is not None and newest_ns is not None:
                between_s = (images.exposure_ns - newest_ns) * 1e-9
                self._lost += max(0, round(between_s * reader.rate_hz) - 1)
            newest_ns = images.exposure_ns
            self._pairs, self._wait_s = self._pairs + 1, self._retry_s
            self._deliver(images, self._lost)
