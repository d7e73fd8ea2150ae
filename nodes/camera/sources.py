"""Define the camera node's parameter `source`, which selects the device or the files to read."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import BeforeValidator, ConfigDict, Field

from flexsheet.messages.limits import LimitedModel
from flexsheet.messages.scene import Finite, NonNegative, Positive
from flexsheet.nodes.parameter_marks import DeviceFile


class CameraSource(LimitedModel):
    """The base class for values of the camera node's parameter `source`."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class TwinSource(CameraSource):
    """A source of simulated images from the topic twin/stereo."""

    kind: Literal["twin"] = "twin"


class OpenCvSource(CameraSource):
    """A source of live images: one camera with both views, or two cameras.

    Two cameras without a common trigger expose at different times (`docs/camera.md`).
    """

    kind: Literal["live"] = Field(description="images of real cameras")
    left: int | DeviceFile = Field(
        description="left camera, or camera with both views side by side: number, path or address; "
        "aravis: name of the camera; realsense: serial number, or empty; gstreamer: pipeline"
    )
    right: int | DeviceFile | None = Field(
        default=None, description="right camera; null: `left` has both views side by side"
    )
    api: Literal["v4l2", "ximea", "aravis", "realsense", "gstreamer", "any"] | None = Field(
        default=None,
        description="library that opens the camera; null: v4l2 for numbers and for paths under "
        "/dev, otherwise any",
    )
    pixel_format: Annotated[str, Field(min_length=4, max_length=4)] | None = Field(
        default=None,
        description="pixel format, four characters, such as MJPG; null: OpenCV's default format "
        "is used",
    )
    exposure_to_stamp_s: Finite | None = Field(
        default=None,
        description="time from mid-exposure to the driver's timestamp, s; negative if the "
        "timestamp is the start of the exposure; null: half the exposure time is used",
    )
    exposure_to_grab_s: NonNegative | None = Field(
        default=None,
        description="time from mid-exposure to the image's arrival, s, for drivers without "
        "usable timestamps; null: half the exposure time is used",
    )
    silence_s: Positive = Field(
        default=1.0,
        description="time without an image pair after which the cameras are opened again, s",
    )


class VideoSource(CameraSource):
    """A source of recorded images: one video file with both views side by side, or two files."""

    kind: Literal["video"]
    left: Path
    right: Path | None = Field(
        default=None, description="right video file; null: `left` has both views side by side"
    )
    rate_hz: Positive | None = Field(
        default=None, description="frame rate, Hz; null: the frame times in the files are used"
    )
    loop: bool = Field(default=False, description="whether to start again at the end")


class ImagesSource(CameraSource):
    """A source of image files, which are read in the order of their names."""

    kind: Literal["images"]
    left: Path = Field(description="glob pattern of the left images, such as images/left*.png")
    right: Path = Field(description="glob pattern of the right images")
    times: Path | None = Field(
        default=None,
        description="CSV file with a column t_s (time, s), one row per pair; null: the images "
        "have a constant rate",
    )
    rate_hz: Positive | None = Field(
        default=None,
        description="image rate, Hz, if `times` is not given; null: the camera's rate in the "
        "scene is used",
    )
    loop: bool = Field(default=False, description="whether to start again at the end")


def _expand_kind(source: object) -> object:
    """Expand the short form `source: twin` of a launch file to a mapping."""
    return {"kind": source} if isinstance(source, str) else source


AnySource = Annotated[
    TwinSource | OpenCvSource | VideoSource | ImagesSource,
    Field(discriminator="kind"),
    BeforeValidator(_expand_kind),
]
