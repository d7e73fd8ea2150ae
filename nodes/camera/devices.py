"""Open a source and read it in a thread of its own, to its end or in a loop."""

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
    cut,
)
from flexsheet.nodes.camera.live import CameraReader
from flexsheet.nodes.camera.sources import AnySource, ImagesSource, OpenCvSource, VideoSource

MAX_RETRY_S = 30.0


def open_reader(
    source: AnySource, camera: StereoCamera, now: Now, wanted: Regions | None = None
) -> Reader:
    """Open a source for a scene's camera; raises DeviceError.

    wanted: the sensor regions that a device is asked to read; `image_pair.cut` does the rest.
    """
    if isinstance(source, OpenCvSource):
        return CameraReader(source, camera, now, wanted)
    if isinstance(source, VideoSource):
        return VideoReader(source, camera.rate_hz)
    if isinstance(source, ImagesSource):
        return ImagesReader(source, camera)
    raise DeviceError(f'source "{source.kind}" is not read from a device')


class ReaderThread(threading.Thread):
    """Open a source and read it to its end; report failures, and try again after a while.

    deliver(pictures, lost): called for each pair, with the number of frames lost so far.
    fail(error): called for each DeviceError; waiting times double from `retry_s` to MAX_RETRY_S,
    and start over once images arrive again.
    warn(text): called at each opening for settings that the device does not accept.
    finish(pairs): called when the images end.
    regions: the parts of the images to deliver; None: all.

    All functions are called in this thread.
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
        deliver: Callable[[ImagePair, int], None],
        fail: Callable[[DeviceError], None],
        warn: Callable[[str], None],
        finish: Callable[[int], None],
    ) -> None:
        super().__init__(name=name, daemon=True)
        self._open, self._camera, self._regions = open_source, camera, regions
        self._now, self._retry_s = now, retry_s
        self._deliver, self._fail, self._warn, self._finish = deliver, fail, warn, finish
        self._stopping = threading.Event()
        self._reader: Reader | None = None
        self._pairs = self._lost = 0
        self._wait_s = retry_s

    def stop(self) -> None:
        """Ask the thread to end after the image that it waits for."""
        self._stopping.set()
        reader = self._reader
        if reader is not None:
            reader.interrupt()

    def run(self) -> None:
        while not self._stopping.is_set():
            try:
                reader = self._reader = self._open()
                try:
                    for text in reader.warnings:
                        self._warn(text)
                    self._read(reader)
                finally:
                    self._reader = None
                    reader.close()
            except Exception as error:  # drivers raise anything; report it and try again
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
        """Deliver until the images end or the thread is to stop."""
        start_ns: int | None = None
        newest_ns: int | None = None
        while not self._stopping.is_set():
            pictures = reader.read()
            if self._stopping.is_set():
                return
            if pictures is None:
                self._finish(self._pairs)
                return
            check_size(pictures, self._camera, self.name)
            if self._regions is not None:
                pictures = cut(pictures, self._regions)
            if reader.paced:
                if start_ns is None:
                    start_ns = self._now() - pictures.exposure_ns
                pictures = replace(pictures, exposure_ns=start_ns + pictures.exposure_ns)
                self._stopping.wait(max(0.0, (pictures.exposure_ns - self._now()) * 1e-9))
            elif reader.rate_hz is not None and newest_ns is not None:
                between_s = (pictures.exposure_ns - newest_ns) * 1e-9
                self._lost += max(0, round(between_s * reader.rate_hz) - 1)
            newest_ns = pictures.exposure_ns
            self._pairs, self._wait_s = self._pairs + 1, self._retry_s
            self._deliver(pictures, self._lost)
