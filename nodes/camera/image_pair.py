"""Define the interface of readers of stereo images from cameras or files."""

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
    """Raised if a device or file cannot be read, or delivers images of a wrong size."""

    remedy = (
        "Check the cable, the device's name and the files in the launch file. Check that no other "
        "program uses the camera."
    )


class Region(NamedTuple):
    """A rectangle of sensor pixels: column and row of the first pixel, width and height (px).

    Columns and rows are counted from zero.
    """

    column: Annotated[int, Field(ge=0)]
    row: Annotated[int, Field(ge=0)]
    width: Annotated[int, Field(gt=0)]
    height: Annotated[int, Field(gt=0)]

    def contains(self, other: Region) -> bool:
        return (
            self.column <= other.column
            and self.row <= other.row
            and self.column + self.width >= other.column + other.width
            and self.row + self.height >= other.row + other.height
        )

    def __str__(self) -> str:
        return f"{self.width}x{self.height} px at ({self.column}, {self.row})"


Regions = tuple[Region, Region]
"""The sensor regions of the left and the right camera."""


@dataclass(frozen=True, slots=True)
class ImagePair:
    """A left and a right grey image (height, width) with nearly equal exposure times.

    exposure_ns: mean of both mid-exposure times on the reader's clock. If the source is a file,
        this clock starts at the start of the file.
    exposure_s: duration of the exposure that the device reports; None if it is unknown.
    skew_s: mid-exposure time of the right image minus mid-exposure time of the left image.
    regions: sensor regions of the images; None means the full sensors.
    notes: remarks for the operator.
    """

    left: Image
    right: Image
    exposure_ns: int
    exposure_s: float | None = None
    skew_s: float = 0.0
    regions: Regions | None = None
    notes: tuple[str, ...] = ()


class Reader(Protocol):
    """The interface of readers of image pairs.

    paced: whether `read` returns immediately because the images come from files. In that case, the
        caller must wait until each image pair is due.
    rate_hz: frame rate of a device, which is necessary to count lost frames; None if the source is
        a file.
    warnings: texts about settings that the device did not accept.
    opened: texts about the actual format and settings of each device; empty if the source is a
        file.
    """

    paced: bool
    rate_hz: float | None
    warnings: tuple[str, ...]
    opened: tuple[str, ...]

    def read(self) -> ImagePair | None:
        """Wait for the next image pair; return None after the last pair.

        Raises DeviceError if the source fails.
        """
        ...

    def interrupt(self) -> None:
        """Make the current `read` call and all later calls return None.

        Any thread may call this method.
        """
        ...

    def close(self) -> None: ...


def make_stereo_message(
    images: ImagePair, device: str, exposure_s: float, dropped_frames: int
) -> StereoPair:
    """Make the message for an image pair.

    device: name of the camera.
    exposure_s: exposure time that is used if the device reports no exposure time.
    """
    origins = [(region.column, region.row) for region in images.regions or ()] or [(0, 0)] * 2
    return StereoPair(
        device=device,
        exposure_s=exposure_s if images.exposure_s is None else images.exposure_s,
        skew_s=images.skew_s,
        dropped_frames=dropped_frames,
        left_origin_px=origins[0],
        right_origin_px=origins[1],
        left=images.left,
        right=images.right,
    )


def make_image_pair(pair: StereoPair, exposure_ns: int) -> ImagePair:
    """Convert a message to an image pair.

    exposure_ns: mean of both mid-exposure times.
    """
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


def describe_skew(skew_s: float, limit_s: float) -> str:
    """Return the error text for an image pair that is rejected because of its skew.

    skew_s: time between the left and the right exposure.
    limit_s: maximum permitted time.
    """
    return (
        f"{1e3 * skew_s:.1f} ms between left and right exposure, maximum {1e3 * limit_s:g} ms; "
        "restart the cameras, or connect a common trigger"
    )


def convert_to_gray(image: NDArray[Any]) -> Image:
    """Convert an image of height h and width w to a grey image (h, w).

    image: grey (h, w) or (h, w, 1), BGR (h, w, 3), or brightness and a second channel (h, w, 2).
    """
    if image.ndim == 3:
        image = image[:, :, 0] if image.shape[2] < 3 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    return np.ascontiguousarray(image, dtype=np.uint8)


def split_side_by_side(image: Image, name: object) -> tuple[Image, Image]:
    """Split an image with both views side by side into the left and the right view.

    image: image (h, 2w) of two views (h, w) with the height h and the width w.
    name: name of the source in the error text.

    Raises DeviceError if the width of the image is odd.
    """
    if image.shape[1] % 2:
        raise DeviceError(
            f"{name}: an image with the odd width of {image.shape[1]} px cannot contain both views "
            "side by side; set `right` if the views are separate"
        )
    middle = image.shape[1] // 2
    return np.ascontiguousarray(image[:, :middle]), np.ascontiguousarray(image[:, middle:])


def check_size(images: ImagePair, camera: StereoCamera, name: object) -> None:
    """Raise DeviceError if the image size differs from the region or from the scene.

    name: name of the source in the error text.
    """
    whole = Region(0, 0, camera.width_px, camera.height_px)
    regions = images.regions or (whole, whole)
    views = (("left", images.left, regions[0]), ("right", images.right, regions[1]))
    for side, image, region in views:
        if image.shape != (region.height, region.width):
            expected = (
                f"the scene's camera {camera.device} has {region.width}x{region.height} px"
                if images.regions is None
                else f"its region is {region}"
            )
            raise DeviceError(
                f"{name}: the {side} view has {image.shape[1]}x{image.shape[0]} px, but "
                f"{expected}; correct the scene's camera or the camera node's source"
            )


def crop(images: ImagePair, regions: Regions) -> ImagePair:
    """Crop images to sensor regions.

    Raises DeviceError if an image does not contain its whole region.
    """
    if images.regions == regions:
        return images
    parts = []
    shown = images.regions
    for index, (image, region) in enumerate(zip((images.left, images.right), regions, strict=True)):
        available = Region(0, 0, image.shape[1], image.shape[0]) if shown is None else shown[index]
        if not available.contains(region):
            side = ("left", "right")[index]
            raise DeviceError(
                f"region.{side}: {region} is outside the image of {available}; correct the camera "
                "node's parameter region"
            )
        row, column = region.row - available.row, region.column - available.column
        part = image[row : row + region.height, column : column + region.width]
        parts.append(np.ascontiguousarray(part))
    note = "regions cropped from " + ("full images" if shown is None else "the device's region")
    return replace(
        images, left=parts[0], right=parts[1], regions=regions, notes=(*images.notes, note)
    )


def encode_png(image: Image) -> bytes:
    """Encode an image as the bytes of a PNG file."""
    return bytes(cv2.imencode(".png", image)[1])
