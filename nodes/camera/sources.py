"""Define the parameter `source` of a camera node: the device or files to read."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import BeforeValidator, ConfigDict, Field

from flexsheet.messages.limits import LimitedModel
from flexsheet.messages.scene import Finite, NonNegative, Positive
from flexsheet.nodes.parameter_marks import DeviceFile


class CameraSource(LimitedModel):
    """Base class of the values of the parameter `source`."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class TwinSource(CameraSource):
    """Images of the simulator, from the topic twin/stereo."""

    kind: Literal["twin"] = "twin"


class OpenCvSource(CameraSource):
    """Cameras that OpenCV opens by number, by path, or by a stream's address.

    Two cameras without a common trigger expose at different times (`docs/camera.md`).
    """

    kind: Literal["opencv"]
    left: int | DeviceFile = Field(
        description="left camera, or the one with both views side by side"
    )
    right: int | DeviceFile | None = Field(
        default=None, description="right camera; null: left has both views side by side"
    )
    api: Literal["v4l2", "ximea", "aravis", "any"] | None = Field(
        default=None,
        description="backend of OpenCV; null: v4l2 for numbers and paths under /dev, else any",
    )
    pixel_format: Annotated[str, Field(min_length=4, max_length=4)] | None = Field(
        default=None,
        description="pixel format, four characters, such as MJPG; null: OpenCV's default",
    )
    exposure_to_stamp_s: Finite | None = Field(
        default=None,
        description="time from mid-exposure to the driver's stamp, negative if the driver stamps "
        "the start of the exposure; null: half the exposure",
    )
    exposure_to_grab_s: NonNegative | None = Field(
        default=None,
        description="time from mid-exposure to the image's arrival, for drivers without usable "
        "stamps; null: half the exposure",
    )
    silence_s: Positive = Field(
        default=1.0, description="maximum time without a pair before the device is reopened"
    )


class VideoSource(CameraSource):
    """One video file with both views side by side, or two files."""

    kind: Literal["video"]
    left: Path
    right: Path | None = Field(
        default=None, description="right video; null: left has both views side by side"
    )
    rate_hz: Positive | None = Field(
        default=None, description="frame rate; null: the frame times of the files"
    )
    loop: bool = Field(default=False, description="restart at the end")


class ImagesSource(CameraSource):
    """Image files, in the order of their sorted names."""

    kind: Literal["images"]
    left: Path = Field(description="pattern of the left images: images/left*.png")
    right: Path = Field(description="pattern of the right images")
    times: Path | None = Field(
        default=None,
        description="CSV file with a column t_s, one row per pair; null: constant rate",
    )
    rate_hz: Positive | None = Field(
        default=None, description="rate without a file of times; null: the scene's camera rate"
    )
    loop: bool = Field(default=False, description="restart at the end")


def _expand_kind(source: object) -> object:
    """Expand the short form `source: twin` of a launch file to a mapping."""
    return {"kind": source} if isinstance(source, str) else source


AnySource = Annotated[
    TwinSource | OpenCvSource | VideoSource | ImagesSource,
    Field(discriminator="kind"),
    BeforeValidator(_expand_kind),
]
