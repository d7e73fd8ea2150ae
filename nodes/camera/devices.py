"""Readers of stereo pictures: two cameras or one side-by-side, video files, image files.

A reader is opened, read from in a thread that may block, and closed.  All give grey pairs.  What
goes wrong with a device is a `DeviceError`, which may pass when it is tried again; pictures that
run out end with `None`.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from glob import glob
from pathlib import Path
from typing import Annotated, Any, Literal, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

from messages.scene import NonNegative, Positive, StereoCamera

Image = NDArray[np.uint8]
Now = Callable[[], int]


class DeviceError(RuntimeError):
    """A device or file that cannot be read; the message names it and what to do."""


@dataclass(frozen=True, slots=True)
class Pictures:
    """A pair and when it was taken: the middle of the exposure, if the device lets us know."""

    left: Image
    right: Image
    exposure_ns: int


class Source(BaseModel):
    """A kind of device, as the parameter `source` names it."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class TwinSource(Source):
    """The twin's pixels, from the topic twin/stereo."""

    kind: Literal["twin"] = "twin"


class OpenCvSource(Source):
    """Cameras that OpenCV opens (V4L/UVC): by number, by path, or by a stream's address.

    Two cameras without a common trigger see a moving finger at two times; the triangulator then
    finds it inconsistent.  One device that gives both views has no such trouble.
    """

    kind: Literal["opencv"]
    left: int | str = Field(description="the left camera, or the one that gives both side by side")
    right: int | str | None = Field(default=None, description="null: left gives both side by side")
    exposure_to_grab_s: NonNegative | None = Field(
        default=None,
        description="from mid-exposure to the picture's arrival; null: half the exposure",
    )


class VideoSource(Source):
    """One video file with both views side by side, or two."""

    kind: Literal["video"]
    left: Path
    right: Path | None = Field(default=None, description="null: left holds both side by side")
    rate_hz: Positive | None = Field(default=None, description="null: the file's own")
    loop: bool = False


class ImagesSource(Source):
    """Image files, in the order of their sorted names."""

    kind: Literal["images"]
    left: Path = Field(description="a pattern: pictures/left*.png")
    right: Path
    rate_hz: Positive | None = Field(default=None, description="null: the scene's camera rate")
    loop: bool = False


def _kind_alone(source: object) -> object:
    """Lets a launch file write `source: twin` for a source that needs nothing but its kind."""
    return {"kind": source} if isinstance(source, str) else source


AnySource = Annotated[
    TwinSource | OpenCvSource | VideoSource | ImagesSource,
    Field(discriminator="kind"),
    BeforeValidator(_kind_alone),
]


class Reader(Protocol):
    """rate_hz: pace at which files are to be read; None for devices, which set the pace."""

    rate_hz: float | None

    def read(self) -> Pictures | None:
        """The next pair, waiting for it; None when there are no more.  Raises DeviceError."""
        ...

    def close(self) -> None: ...


def open_reader(source: AnySource, camera: StereoCamera, now: Now) -> Reader:
    """Open what a source names, for a scene's camera; raises DeviceError."""
    if isinstance(source, OpenCvSource):
        return CameraReader(source, camera, now)
    if isinstance(source, VideoSource):
        return VideoReader(source, now)
    if isinstance(source, ImagesSource):
        return ImagesReader(source, camera.rate_hz, now)
    raise DeviceError(f'source "{source.kind}" is not read from a device')


def gray(image: NDArray[Any]) -> Image:
    """A decoded picture as grey (h, w): grey or luma first (h, w, 1 or 2), or blue-green-red."""
    if image.ndim == 3:
        image = image[:, :, 0] if image.shape[2] < 3 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    return np.ascontiguousarray(image, dtype=np.uint8)


def halves(image: Image, name: object) -> tuple[Image, Image]:
    """Both views of a side-by-side picture (h, 2w); raises DeviceError for an odd width."""
    if image.shape[1] % 2:
        raise DeviceError(
            f"{name}: side-by-side picture of odd width {image.shape[1]}; name the right device too"
        )
    middle = image.shape[1] // 2
    return np.ascontiguousarray(image[:, :middle]), np.ascontiguousarray(image[:, middle:])


def check_size(pictures: Pictures, camera: StereoCamera, name: object) -> None:
    """Raises DeviceError unless both views have the size that the scene's camera has."""
    wanted = (camera.height_px, camera.width_px)
    for side, image in (("left", pictures.left), ("right", pictures.right)):
        if image.shape != wanted:
            raise DeviceError(
                f"{name}: {side} view of {image.shape[1]}x{image.shape[0]} px, the scene's camera "
                f"{camera.device} has {wanted[1]}x{wanted[0]} px: correct the scene or the source"
            )


def _capture(device: int | str) -> cv2.VideoCapture:
    capture = cv2.VideoCapture(device)
    if not capture.isOpened():
        capture.release()
        raise DeviceError(
            f"{device!r}: cannot be opened: not there, in use, or not a camera or video"
        )
    return capture


class CameraReader:
    """Live cameras: both are triggered to grab at once, then decoded."""

    rate_hz: float | None = None

    def __init__(self, source: OpenCvSource, camera: StereoCamera, now: Now) -> None:
        self._source, self._now = source, now
        delay_s = source.exposure_to_grab_s
        self._delay_ns = round(1e9 * (0.5 * camera.exposure_s if delay_s is None else delay_s))
        self._captures: list[cv2.VideoCapture] = []
        views = 2 if source.right is None else 1
        try:
            for device in (source.left, source.right):
                if device is not None:
                    self._captures.append(self._opened(device, camera, views))
        except DeviceError:
            self.close()
            raise

    @staticmethod
    def _opened(device: int | str, camera: StereoCamera, views: int) -> cv2.VideoCapture:
        """Ask for the scene's size and rate; what the device then gives is checked by its pictures.

        One buffered frame at most, where the driver allows it: an old picture is a wrong picture.
        """
        capture = _capture(device)
        capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
        capture.set(cv2.CAP_PROP_FRAME_WIDTH, views * camera.width_px)
        capture.set(cv2.CAP_PROP_FRAME_HEIGHT, camera.height_px)
        capture.set(cv2.CAP_PROP_FPS, camera.rate_hz)
        return capture

    def read(self) -> Pictures | None:
        """See `Reader`.  The stamp is the middle of the grabs, less the known delay."""
        grabbed, stamps_ns = [], []
        for capture in self._captures:
            grabbed.append(capture.grab())
            stamps_ns.append(self._now())
        stamp_ns = (stamps_ns[0] + stamps_ns[-1]) // 2
        images = []
        names = (self._source.left, self._source.right)
        for capture, name, taken in zip(self._captures, names, grabbed, strict=False):
            image = capture.retrieve()[1] if taken else None
            if image is None:
                raise DeviceError(f"{name!r}: gives no more pictures: unplugged, or at its end")
            images.append(gray(image))
        left, right = images if len(images) == 2 else halves(images[0], self._source.left)
        return Pictures(left, right, stamp_ns - self._delay_ns)

    def close(self) -> None:
        for capture in self._captures:
            capture.release()
        self._captures.clear()


class VideoReader:
    """Video files, decoded frame by frame; both files end with the shorter one."""

    def __init__(self, source: VideoSource, now: Now) -> None:
        self._source, self._now = source, now
        self._captures = self._open()
        stated_hz = self._captures[0].get(cv2.CAP_PROP_FPS)
        if source.rate_hz is None and not stated_hz > 0:
            self.close()
            raise DeviceError(f"{source.left}: states no frame rate; give rate_hz")
        self.rate_hz: float | None = source.rate_hz or stated_hz

    def _open(self) -> list[cv2.VideoCapture]:
        paths = [path for path in (self._source.left, self._source.right) if path is not None]
        captures: list[cv2.VideoCapture] = []
        try:
            for path in paths:
                if not path.is_file():
                    raise DeviceError(f"{path}: no such file")
                captures.append(_capture(str(path)))
        except DeviceError:
            for capture in captures:
                capture.release()
            raise
        return captures

    def read(self) -> Pictures | None:
        """See `Reader`.  A picture is taken to be exposed when it is read."""
        images = self._next()
        if images is None and self._source.loop:
            self.close()
            self._captures = self._open()
            images = self._next()
            if images is None:
                raise DeviceError(f"{self._source.left}: holds no picture")
        if images is None:
            return None
        left, right = images if len(images) == 2 else halves(images[0], self._source.left)
        return Pictures(left, right, self._now())

    def _next(self) -> list[Image] | None:
        images = []
        for capture in self._captures:
            image = capture.read()[1]
            if image is None:
                return None
            images.append(gray(image))
        return images

    def close(self) -> None:
        for capture in self._captures:
            capture.release()
        self._captures = []


class ImagesReader:
    """Image files by two patterns."""

    def __init__(self, source: ImagesSource, camera_rate_hz: float, now: Now) -> None:
        self._now, self._loop, self._next = now, source.loop, 0
        self.rate_hz: float | None = source.rate_hz or camera_rate_hz
        left, right = sorted(glob(str(source.left))), sorted(glob(str(source.right)))
        for pattern, paths in ((source.left, left), (source.right, right)):
            if not paths:
                raise DeviceError(f"{pattern}: matches no file")
        if len(left) != len(right):
            raise DeviceError(
                f"{source.left} matches {len(left)} files, {source.right} {len(right)}: one right "
                "picture per left one is needed"
            )
        self._pairs = list(zip(left, right, strict=True))

    def read(self) -> Pictures | None:
        """See `Reader`.  A picture is taken to be exposed when it is read."""
        if self._next == len(self._pairs):
            if not self._loop:
                return None
            self._next = 0
        images = []
        for path in self._pairs[self._next]:
            image = cv2.imread(path, cv2.IMREAD_GRAYSCALE)
            if image is None:
                raise DeviceError(f"{path}: not a picture that can be read")
            images.append(gray(image))
        self._next += 1
        return Pictures(images[0], images[1], self._now())

    def close(self) -> None:
        """Nothing is held open."""


MAX_RETRY_S = 30.0


class ReaderThread(threading.Thread):
    """Opens a source and reads it to its end; what fails is told, and tried again after a while.

    deliver(pictures, lost): called for each pair, with the number of frames lost so far.
    fail(error): called for each DeviceError; waiting times double from `retry_s` to MAX_RETRY_S,
    and start over once pictures come again.
    finish(pairs): called when the pictures ran out.
    All are called in this thread.
    """

    def __init__(
        self,
        open_source: Callable[[], Reader],
        *,
        camera: StereoCamera,
        name: str,
        now: Now,
        retry_s: float,
        deliver: Callable[[Pictures, int], None],
        fail: Callable[[DeviceError], None],
        finish: Callable[[int], None],
    ) -> None:
        super().__init__(name=name, daemon=True)
        self._open, self._camera, self._now, self._retry_s = open_source, camera, now, retry_s
        self._deliver, self._fail, self._finish = deliver, fail, finish
        self._stopping = threading.Event()
        self._pairs = self._lost = 0
        self._wait_s = retry_s

    def stop(self) -> None:
        """Ask the thread to end after the picture that it waits for."""
        self._stopping.set()

    def run(self) -> None:
        while not self._stopping.is_set():
            try:
                reader = self._open()
                try:
                    self._read(reader)
                finally:
                    reader.close()
            except (DeviceError, cv2.error) as error:
                if self._stopping.is_set():
                    return
                if not isinstance(error, DeviceError):
                    error = DeviceError(f"{self.name}: OpenCV: {error}")
                self._fail(error)
                self._stopping.wait(self._wait_s)
                self._wait_s = min(2.0 * self._wait_s, MAX_RETRY_S)
            else:
                return

    def _read(self, reader: Reader) -> None:
        """Deliver until the pictures end or the thread is to stop."""
        start_ns, frame = self._now(), 0
        newest_ns: int | None = None
        while not self._stopping.is_set():
            if reader.rate_hz is not None:
                due_ns = start_ns + round(1e9 * frame / reader.rate_hz)
                self._stopping.wait(max(0.0, (due_ns - self._now()) * 1e-9))
            pictures = reader.read()
            if self._stopping.is_set():
                return
            if pictures is None:
                self._finish(self._pairs)
                return
            check_size(pictures, self._camera, self.name)
            if reader.rate_hz is None and newest_ns is not None:
                between_s = (pictures.exposure_ns - newest_ns) * 1e-9
                self._lost += max(0, round(between_s * self._camera.rate_hz) - 1)
            newest_ns = pictures.exposure_ns
            self._pairs, frame, self._wait_s = self._pairs + 1, frame + 1, self._retry_s
            self._deliver(pictures, self._lost)
