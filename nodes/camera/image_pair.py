"""Define what every reader of stereo images returns: grey pairs with their time, and the errors.

A reader is opened, read from in a thread that may block, and closed.  A `DeviceError` is a failure
that may disappear at the next attempt; the end of the images is `None`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Annotated, Any, NamedTuple, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flexsheet.messages.errors import FlexsheetError
from flexsheet.messages.scene import StereoCamera
from flexsheet.messages.types import StereoPair

Image = NDArray[np.uint8]
Now = Callable[[], int]


class DeviceError(FlexsheetError, RuntimeError):
    """Raised for a device or file that cannot be read; the message names it and what to do."""

    code = "device"
    remedy = (
        "Check the plug, the device's name and the calibration file. Another program may use the "
        "camera."
    )


class Region(NamedTuple):
    """Hold a part of the sensor, in pixels; column and row of its first pixel count from zero."""

    column: Annotated[int, Field(ge=0)]
    row: Annotated[int, Field(ge=0)]
    width: Annotated[int, Field(gt=0)]
    height: Annotated[int, Field(gt=0)]

    def holds(self, other: Region) -> bool:
        return (
            self.column <= other.column
            and self.row <= other.row
            and self.column + self.width >= other.column + other.width
            and self.row + self.height >= other.row + other.height
        )

    def __str__(self) -> str:
        return f"{self.width}x{self.height} px at ({self.column}, {self.row})"


Regions = tuple[Region, Region]
"""Regions of the left view and of the right."""


@dataclass(frozen=True, slots=True)
class ImagePair:
    """Hold a pair and its time: the mean of the middles of both exposures.

    exposure_ns: on the clock that the reader was given; of a paced reader (files), the file's own
        time from its beginning.
    exposure_s: as reported by the device; None: not known.
    skew_s: exposure of the right image minus that of the left.
    regions: parts of the sensors that the images show; None: all.
    notes: how they were taken, for display.
    """

    left: Image
    right: Image
    exposure_ns: int
    exposure_s: float | None = None
    skew_s: float = 0.0
    regions: Regions | None = None
    notes: tuple[str, ...] = ()


class Reader(Protocol):
    """Define what a reader of image pairs offers.

    paced: images come as fast as they are read, and are to be shown by their own time.
    rate_hz: of a device, for counting lost frames; files have none.
    warnings: settings that the device does not accept; known once it is open.
    """

    paced: bool
    rate_hz: float | None
    warnings: tuple[str, ...]

    def read(self) -> ImagePair | None:
        """Wait for the next pair and return it; None at the end.  Raises DeviceError."""
        ...

    def interrupt(self) -> None:
        """Make a waiting `read`, and each that follows, return None soon; callable from any
        thread."""
        ...

    def close(self) -> None: ...


def make_stereo_message(
    pictures: ImagePair, device: str, exposure_s: float, dropped_frames: int
) -> StereoPair:
    """Make the message of an image pair; exposure_s: used where the device does not report it."""
    origins = [(region.column, region.row) for region in pictures.regions or ()] or [(0, 0)] * 2
    return StereoPair(
        device=device,
        exposure_s=exposure_s if pictures.exposure_s is None else pictures.exposure_s,
        skew_s=pictures.skew_s,
        dropped_frames=dropped_frames,
        left_origin_px=origins[0],
        right_origin_px=origins[1],
        left=pictures.left,
        right=pictures.right,
    )


def make_image_pair(pair: StereoPair, exposure_ns: int) -> ImagePair:
    """Make the image pair of a published message."""
    origins = (pair.left_origin_px, pair.right_origin_px)
    left, right = (
        Region(*origin, image.shape[1], image.shape[0])
        for origin, image in zip(origins, (pair.left, pair.right), strict=True)
    )
    return ImagePair(
        pair.left,
        pair.right,
        exposure_ns,
        exposure_s=pair.exposure_s,
        skew_s=pair.skew_s,
        regions=(left, right) if any(origin != (0, 0) for origin in origins) else None,
    )


def skew_reason(skew_s: float, limit_s: float) -> str:
    """Describe why a pair was rejected for its skew."""
    return (
        f"skew {1e3 * skew_s:.1f} ms, at most {1e3 * limit_s:g} ms wanted; cameras that run freely "
        "keep their skew until they are restarted, a common trigger has none"
    )


def gray(image: NDArray[Any]) -> Image:
    """Convert a decoded image to grey (h, w): grey or luma first (h, w, 1 or 2), or
    blue-green-red."""
    if image.ndim == 3:
        image = image[:, :, 0] if image.shape[2] < 3 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    return np.ascontiguousarray(image, dtype=np.uint8)


def halves(image: Image, name: object) -> tuple[Image, Image]:
    """Split a side-by-side image (h, 2w) into both views; raises DeviceError for an odd width."""
    if image.shape[1] % 2:
        raise DeviceError(
            f"{name}: side-by-side picture of odd width {image.shape[1]}; name the right device too"
        )
    middle = image.shape[1] // 2
    return np.ascontiguousarray(image[:, :middle]), np.ascontiguousarray(image[:, middle:])


def check_size(pictures: ImagePair, camera: StereoCamera, name: object) -> None:
    """Raise DeviceError unless each view has the size of its region, or of the scene's camera."""
    whole = Region(0, 0, camera.width_px, camera.height_px)
    regions = pictures.regions or (whole, whole)
    views = (("left", pictures.left, regions[0]), ("right", pictures.right, regions[1]))
    for side, image, region in views:
        if image.shape != (region.height, region.width):
            wanted = (
                f"the scene's camera {camera.device} has {region.width}x{region.height} px"
                if pictures.regions is None
                else f"its region is {region}"
            )
            raise DeviceError(
                f"{name}: {side} view of {image.shape[1]}x{image.shape[0]} px, {wanted}: correct "
                "the scene or the source"
            )


def cut(pictures: ImagePair, wanted: Regions) -> ImagePair:
    """Cut the wanted regions out of images that `check_size` has passed.

    Raises DeviceError where the images do not show all of them.
    """
    if pictures.regions == wanted:
        return pictures
    images = []
    shown = pictures.regions
    for index, (image, region) in enumerate(
        zip((pictures.left, pictures.right), wanted, strict=True)
    ):
        has = Region(0, 0, image.shape[1], image.shape[0]) if shown is None else shown[index]
        if not has.holds(region):
            side = ("left", "right")[index]
            raise DeviceError(f"the {side} region is {region}, the picture only {has}: correct it")
        row, column = region.row - has.row, region.column - has.column
        part = image[row : row + region.height, column : column + region.width]
        images.append(np.ascontiguousarray(part))
    note = "regions cut from " + ("whole pictures" if shown is None else "what the device reads")
    return replace(
        pictures, left=images[0], right=images[1], regions=wanted, notes=(*pictures.notes, note)
    )


def encode_png(picture: Image) -> bytes:
    """Return an image as the bytes of a PNG file."""
    return bytes(cv2.imencode(".png", picture)[1])
