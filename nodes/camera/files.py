"""Read stereo image pairs from video files or image files."""

from __future__ import annotations

import csv
import math
from collections import deque
from dataclasses import dataclass
from glob import glob
from pathlib import Path

import cv2

from flexsheet.messages.scene import StereoCamera
from flexsheet.nodes.camera.image_pair import (
    DeviceError,
    Image,
    ImagePair,
    convert_to_gray,
    split_side_by_side,
)
from flexsheet.nodes.camera.live import open_capture
from flexsheet.nodes.camera.sources import ImagesSource, VideoSource
from flexsheet.nodes.camera.stamps import Pairing


@dataclass(frozen=True, slots=True)
class FileFrame:
    """A decoded image of a file, and the time since the first image of the file."""

    image: Image
    time_ns: int


class VideoFile:
    """A video file that is read frame by frame.

    rate_hz: frame rate; None means that the frame times in the file are used.

    Raises DeviceError if the file cannot be opened.
    """

    def __init__(self, path: Path, rate_hz: float | None) -> None:
        if not path.is_file():
            raise DeviceError(f"{path}: file not found; correct the camera node's source")
        self.path, self._rate_hz = path, rate_hz
        self._capture = open_capture(str(path))
        self.stated_hz = self._capture.get(cv2.CAP_PROP_FPS)
        self.frames: deque[FileFrame] = deque()
        self._number = 0
        self._newest_ns = -1

    def advance(self) -> bool:
        """Append the next frame to `frames`; return False at the end of the file.

        Raises DeviceError if the frame times in the file do not increase.
        """
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
                    f"{self.path}: the time of frame {self._number}, {time_ms:g} ms, is not after "
                    "the time of the previous frame; set rate_hz of the camera node's source"
                )
        self._number += 1
        self._newest_ns = time_ns
        self.frames.append(FileFrame(convert_to_gray(image), time_ns))
        return True

    def close(self) -> None:
        self._capture.release()


class FileReader:
    """A base class for readers of image files. The method `read` never waits."""

    paced = True
    rate_hz: float | None = None
    warnings: tuple[str, ...] = ()
    opened: tuple[str, ...] = ()

    def interrupt(self) -> None:
        """Do nothing, because `read` does not wait."""

    def close(self) -> None:
        """Close all open files."""


class VideoReader(FileReader):
    """A reader of one video file with both views, or of two video files whose frames are paired."""

    def __init__(self, source: VideoSource, camera_rate_hz: float) -> None:
        self._source, self._camera_rate_hz = source, camera_rate_hz
        self._unpaired = 0
        self._clock = _LoopClock(camera_rate_hz)
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
        # A file with variable rate states its time base, such as 1000 Hz, as rate.
        rates = [file.stated_hz for file in self._files if file.stated_hz > 0.0]
        rate_hz = self._source.rate_hz or min([*rates, self._camera_rate_hz])
        self._pairing = Pairing(1.0 / rate_hz)

    def read(self) -> ImagePair | None:
        """Return the next image pair, or None if the end of the video has been reached.

        Raises DeviceError if a file is faulty.
        """
        frames = self._next()
        if frames is None and self._source.loop:
            self.close()
            self._unpaired += self._pairing.unpaired
            self._open()
            self._clock.restart()
            frames = self._next()
            if frames is None:
                raise DeviceError(
                    f"{self._source.left}: the video contains no image pair; correct the camera "
                    "node's source"
                )
        if frames is None:
            return None
        notes = ["frame times of the file" if self._source.rate_hz is None else "at the set rate"]
        if len(frames) == 1:
            left, right = split_side_by_side(frames[0].image, self._source.left)
        else:
            left, right = frames[0].image, frames[1].image
            unpaired = self._unpaired + self._pairing.unpaired
            notes.append(f"{unpaired} frames without a partner")
        times_ns = [frame.time_ns for frame in frames]
        return ImagePair(
            left,
            right,
            self._clock.continuous_ns(sum(times_ns) // len(times_ns)),
            skew_s=(times_ns[-1] - times_ns[0]) * 1e-9,
            notes=tuple(notes),
        )

    def _next(self) -> tuple[FileFrame, ...] | None:
        """Return the two frames of the next image pair, or one frame that contains both views.

        Returns None if the end of a file has been reached.
        """
        if len(self._files) == 1:
            (file,) = self._files
            return (file.frames.popleft(),) if file.advance() else None
        left, right = self._files
        while True:
            pair = self._pairing.pop_pair(left.frames, right.frames, lambda frame: frame.time_ns)
            if pair is not None:
                return pair
            for file in self._files:
                if not file.frames and not file.advance():
                    return None

    def close(self) -> None:
        for file in self._files:
            file.close()
        self._files = []


class _LoopClock:
    """A clock whose time continues to increase when a file is read again from its start.

    Between the last image and the first image of the repetition, the time increases by the interval
    between the last two images. If the file has a single image, the time increases by 1 / rate_hz.
    """

    def __init__(self, rate_hz: float) -> None:
        self._interval_ns = round(1e9 / rate_hz)
        self._start_ns = 0
        self._newest_ns: int | None = None

    def continuous_ns(self, time_ns: int) -> int:
        """Convert the time (ns) of an image in the file to a continuously increasing time (ns).

        When the file is read again from its start, the returned time continues to increase.
        """
        continuous_ns = self._start_ns + time_ns
        if self._newest_ns is not None:
            self._interval_ns = continuous_ns - self._newest_ns
        self._newest_ns = continuous_ns
        return continuous_ns

    def restart(self) -> None:
        if self._newest_ns is not None:
            self._start_ns = self._newest_ns + self._interval_ns
            self._newest_ns = None


def read_times(path: Path, pairs: int) -> list[int]:
    """Read the times of image pairs from the column `t_s` (seconds) of a CSV file.

    pairs: required number of rows.

    Returns the times (ns) since the first image pair. Raises DeviceError if the file cannot be
    read, or if its times are not ascending numbers.
    """
    if not path.is_file():
        raise DeviceError(f"{path}: file not found; correct times of the camera node's source")
    try:
        with path.open(newline="", encoding="utf-8") as file:
            rows = csv.DictReader(file, skipinitialspace=True)
            columns = rows.fieldnames or ()
            texts = [(rows.line_num, row.get("t_s")) for row in rows]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise DeviceError(
            f"{path} is not a CSV file with UTF-8 text: {error}; replace the file"
        ) from error
    if "t_s" not in columns:
        raise DeviceError(f"{path}: the column t_s is missing; name it in the first line")
    if len(texts) != pairs:
        raise DeviceError(
            f"{path} has {len(texts)} rows for {pairs} image pairs; give one row for each pair"
        )
    times_s: list[float] = []
    for line, text in texts:
        try:
            time_s = math.nan if text is None else float(text)
        except ValueError:
            time_s = math.nan
        if not math.isfinite(time_s):
            raise DeviceError(
                f"{path}, line {line}: t_s is {text!r}; it must be a number of seconds"
            )
        if times_s and time_s <= times_s[-1]:
            raise DeviceError(
                f"{path}, line {line}: t_s is {text} s, which is not after the time in the "
                "previous row; sort the rows by time"
            )
        times_s.append(time_s)
    return [round(1e9 * (time_s - times_s[0])) for time_s in times_s]


class ImagesReader(FileReader):
    """A reader of left and right image files that match two glob patterns."""

    def __init__(self, source: ImagesSource, camera: StereoCamera) -> None:
        left, right = sorted(glob(str(source.left))), sorted(glob(str(source.right)))
        for pattern, paths in ((source.left, left), (source.right, right)):
            if not paths:
                raise DeviceError(
                    f"the pattern {pattern} matches no file; correct the camera node's source"
                )
        if len(left) != len(right):
            raise DeviceError(
                f"the pattern {source.left} matches {len(left)} files, but {source.right} matches "
                f"{len(right)} files; provide equal numbers of left and right images"
            )
        rate_hz = source.rate_hz or camera.rate_hz
        if source.times is None:
            times_ns = [round(1e9 * number / rate_hz) for number in range(len(left))]
        elif source.rate_hz is None:
            times_ns = read_times(source.times, len(left))
        else:
            raise DeviceError(
                f"the camera node's source has times ({source.times}) and rate_hz; remove one of "
                "them"
            )
        self._note = (
            f"at the set rate of {rate_hz:g} Hz"
            if source.times is None
            else "frame times of the CSV file"
        )
        self._pairs = list(zip(left, right, times_ns, strict=True))
        self._loop, self._next = source.loop, 0
        self._clock = _LoopClock(rate_hz)

    def read(self) -> ImagePair | None:
        """Return the next image pair, or None after the last pair.

        Raises DeviceError if a file is faulty.
        """
        if self._next == len(self._pairs):
            if not self._loop:
                return None
            self._next = 0
            self._clock.restart()
        *paths, time_ns = self._pairs[self._next]
        images = []
        for path in paths:
            image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
            if image is None:
                raise DeviceError(
                    f"{path} cannot be read as an image; replace the file, or change the pattern"
                )
            images.append(convert_to_gray(image))
        self._next += 1
        left, right = images
        return ImagePair(left, right, self._clock.continuous_ns(time_ns), notes=(self._note,))
