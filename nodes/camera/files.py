"""Read video and image files as sources, with the files' own times."""

from __future__ import annotations

import csv
import math
from collections import deque
from dataclasses import dataclass
from glob import glob
from pathlib import Path

import cv2

from flexsheet.messages.scene import StereoCamera
from flexsheet.nodes.camera.image_pair import DeviceError, Image, ImagePair, gray, halves
from flexsheet.nodes.camera.live import open_capture
from flexsheet.nodes.camera.sources import ImagesSource, VideoSource
from flexsheet.nodes.camera.stamps import Pairing


@dataclass(frozen=True, slots=True)
class FileFrame:
    """Hold a decoded frame and its time from the file's first frame."""

    image: Image
    time_ns: int


class VideoFile:
    """Read one video file frame by frame."""

    def __init__(self, path: Path, rate_hz: float | None) -> None:
        """rate_hz: None for the file's own frame times.  Raises DeviceError."""
        if not path.is_file():
            raise DeviceError(f"{path}: no such file")
        self.path, self._rate_hz = path, rate_hz
        self._capture = open_capture(str(path))
        self.stated_hz = self._capture.get(cv2.CAP_PROP_FPS)
        self.waiting: deque[FileFrame] = deque()
        self._number = 0
        self._newest_ns = -1

    def advance(self) -> bool:
        """Read the next frame into `waiting`; False at the end.  Raises DeviceError."""
        image = self._capture.read()[1]
        if image is None:
            return False
        if self._rate_hz is not None:
            time_ns = round(1e9 * self._number / self._rate_hz)
        else:
            time_ms = self._capture.get(cv2.CAP_PROP_POS_MSEC)
            time_ns = round(1e6 * time_ms) if math.isfinite(time_ms) else self._newest_ns
            if time_ns <= self._newest_ns:
                raise DeviceError(
                    f"{self.path}: frame {self._number} at {time_ms:g} ms is not after the one "
                    "before it: the file holds no frame times; give rate_hz"
                )
        self._number += 1
        self._newest_ns = time_ns
        self.waiting.append(FileFrame(gray(image), time_ns))
        return True

    def close(self) -> None:
        self._capture.release()


class VideoReader:
    """Read one file with both views, or two whose frames are paired by their times."""

    paced = True
    rate_hz: float | None = None
    warnings: tuple[str, ...] = ()

    def __init__(self, source: VideoSource, camera_rate_hz: float) -> None:
        self._source, self._camera_rate_hz = source, camera_rate_hz
        self._unpaired = 0
        self._times = _Times(camera_rate_hz)
        self._open()

    def _open(self) -> None:
        paths = [path for path in (self._source.left, self._source.right) if path is not None]
        self._files: list[VideoFile] = []
        try:
            for path in paths:
                self._files.append(VideoFile(path, self._source.rate_hz))
        except DeviceError:
            self.close()
            raise
        # Files of variable rate state their time base (1000 Hz) as their rate.
        rates = [file.stated_hz for file in self._files if file.stated_hz > 0.0]
        rate_hz = self._source.rate_hz or min([*rates, self._camera_rate_hz])
        self._pairing = Pairing(1.0 / rate_hz)

    def read(self) -> ImagePair | None:
        """See `Reader`."""
        frames = self._next()
        if frames is None and self._source.loop:
            self.close()
            self._unpaired += self._pairing.unpaired
            self._open()
            self._times.begin_again()
            frames = self._next()
            if frames is None:
                raise DeviceError(f"{self._source.left}: holds no picture")
        if frames is None:
            return None
        notes = ["times of the file" if self._source.rate_hz is None else "at the given rate"]
        if len(frames) == 1:
            left, right = halves(frames[0].image, self._source.left)
        else:
            left, right = frames[0].image, frames[1].image
            unpaired = self._unpaired + self._pairing.unpaired
            notes.append(f"{unpaired} frames without a partner")
        times_ns = [frame.time_ns for frame in frames]
        return ImagePair(
            left,
            right,
            self._times.running_ns(sum(times_ns) // len(times_ns)),
            skew_s=(times_ns[-1] - times_ns[0]) * 1e-9,
            notes=tuple(notes),
        )

    def _next(self) -> tuple[FileFrame, ...] | None:
        """Return the next pair, or image with both views; None at the end of the shorter file."""
        if len(self._files) == 1:
            (file,) = self._files
            return (file.waiting.popleft(),) if file.advance() else None
        left, right = self._files
        while True:
            pair = self._pairing.take(left.waiting, right.waiting, lambda frame: frame.time_ns)
            if pair is not None:
                return pair
            for file in self._files:
                if not file.waiting and not file.advance():
                    return None

    def interrupt(self) -> None:
        """Do nothing: a file does not wait."""

    def close(self) -> None:
        for file in self._files:
            file.close()
        self._files = []


class _Times:
    """Continue the time when a file is repeated, by the spacing of its last two images."""

    def __init__(self, rate_hz: float) -> None:
        """rate_hz: for a file of one image only."""
        self._spacing_ns = round(1e9 / rate_hz)
        self._begin_ns = 0
        self._newest_ns: int | None = None

    def running_ns(self, time_ns: int) -> int:
        """Return an image's time from the beginning of the first pass."""
        running_ns = self._begin_ns + time_ns
        if self._newest_ns is not None:
            self._spacing_ns = running_ns - self._newest_ns
        self._newest_ns = running_ns
        return running_ns

    def begin_again(self) -> None:
        if self._newest_ns is not None:
            self._begin_ns = self._newest_ns + self._spacing_ns
            self._newest_ns = None


def read_times(path: Path, pairs: int) -> list[int]:
    """Read the times, ns, of the first `pairs` pairs from a CSV file's column `t_s`.

    Raises DeviceError, with file and line, unless they are ascending numbers.
    """
    if not path.is_file():
        raise DeviceError(f"{path}: no such file")
    try:
        with path.open(newline="", encoding="utf-8") as file:
            rows = csv.DictReader(file, skipinitialspace=True)
            columns = rows.fieldnames or ()
            texts = [(rows.line_num, row.get("t_s")) for row in rows]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise DeviceError(f"{path}: cannot be read as UTF-8 CSV: {error}") from error
    if "t_s" not in columns:
        raise DeviceError(f"{path}: has no column t_s; its first line must name the columns")
    if len(texts) != pairs:
        raise DeviceError(f"{path}: {len(texts)} times for {pairs} pairs; one row a pair is needed")
    times_s: list[float] = []
    for line, text in texts:
        try:
            time_s = math.nan if text is None else float(text)
        except ValueError:
            time_s = math.nan
        if not math.isfinite(time_s):
            raise DeviceError(f"{path}, line {line}: t_s is {text!r}, not a number of seconds")
        if times_s and time_s <= times_s[-1]:
            raise DeviceError(f"{path}, line {line}: t_s {text} is not after the one before it")
        times_s.append(time_s)
    return [round(1e9 * (time_s - times_s[0])) for time_s in times_s]


class ImagesReader:
    """Read image files by two patterns."""

    paced = True
    rate_hz: float | None = None
    warnings: tuple[str, ...] = ()

    def __init__(self, source: ImagesSource, camera: StereoCamera) -> None:
        left, right = sorted(glob(str(source.left))), sorted(glob(str(source.right)))
        for pattern, paths in ((source.left, left), (source.right, right)):
            if not paths:
                raise DeviceError(f"{pattern}: matches no file")
        if len(left) != len(right):
            raise DeviceError(
                f"{source.left} matches {len(left)} files, {source.right} {len(right)}: one right "
                "picture per left one is needed"
            )
        rate_hz = source.rate_hz or camera.rate_hz
        if source.times is None:
            times_ns = [round(1e9 * number / rate_hz) for number in range(len(left))]
        elif source.rate_hz is None:
            times_ns = read_times(source.times, len(left))
        else:
            raise DeviceError(f"{source.times}: times and rate_hz are both given; leave one out")
        self._note = f"at {rate_hz:g} Hz" if source.times is None else "times of the file"
        self._pairs = list(zip(left, right, times_ns, strict=True))
        self._loop, self._next = source.loop, 0
        self._times = _Times(rate_hz)

    def read(self) -> ImagePair | None:
        """See `Reader`."""
        if self._next == len(self._pairs):
            if not self._loop:
                return None
            self._next = 0
            self._times.begin_again()
        *paths, time_ns = self._pairs[self._next]
        images = []
        for path in paths:
            image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
            if image is None:
                raise DeviceError(f"{path}: not a picture that can be read")
            images.append(gray(image))
        self._next += 1
        left, right = images
        return ImagePair(left, right, self._times.running_ns(time_ns), notes=(self._note,))

    def interrupt(self) -> None:
        """Do nothing: a file does not wait."""

    def close(self) -> None:
        """Do nothing: no file stays open."""
