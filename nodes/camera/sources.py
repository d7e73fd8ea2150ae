"""Define the parameter `source`: which device or files a camera node reads."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import BeforeValidator, ConfigDict, Field

from flexsheet.messages.limits import LimitedModel
from flexsheet.messages.scene import Finite, NonNegative, Positive
from flexsheet.nodes.parameter_marks import DeviceFile


class CameraSource(LimitedModel):
    """A kind of device, as the parameter `source` names it."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class TwinSource(CameraSource):
    """The simulator's pixels, from the topic twin/stereo."""

    kind: Literal["twin"] = "twin"


class OpenCvSource(CameraSource):
    """Cameras that OpenCV opens: by number, by path, or by a stream's address.

    Two cameras without a common trigger see a moving finger at two times (`docs/camera.md`); one
    device that gives both views does not.
    """

    kind: Literal["opencv"]
    left: int | DeviceFile = Field(
        description="the left camera, or the one that gives both side by side"
    )
    right: int | DeviceFile | None = Field(
        default=None, description="null: left gives both side by side"
    )
    api: Literal["v4l2", "ximea", "aravis", "any"] | None = Field(
        default=None,
        description="OpenCV's backend; null: v4l2 for numbers and paths under /dev, else any",
    )
    pixel_format: Annotated[str, Field(min_length=4, max_length=4)] | None = Field(
        default=None, description='four characters, such as "MJPG"; null: as OpenCV chooses'
    )
    exposure_to_stamp_s: Finite | None = Field(
        default=None,
        description="from mid-exposure to the driver's stamp, negative where the driver stamps the "
        "beginning of the exposure; null: half the exposure",
    )
    exposure_to_grab_s: NonNegative | None = Field(
        default=None,
        description="from mid-exposure to the picture's arrival, for devices whose driver gives no "
        "usable stamps; null: half the exposure",
    )
    silence_s: Positive = Field(
        default=1.0, description="without a pair for so long, the device is opened again"
    )


class VideoSource(CameraSource):
    """One video file with both views side by side, or two."""

    kind: Literal["video"]
    left: Path
    right: Path | None = Field(default=None, description="null: left holds both side by side")
    rate_hz: Positive | None = Field(default=None, description="null: the files' own frame times")
    loop: bool = False


class ImagesSource(CameraSource):
    """Image files, in the order of their sorted names."""

    kind: Literal["images"]
    left: Path = Field(description="a pattern: pictures/left*.png")
    right: Path
    times: Path | None = Field(
        default=None, description="CSV file with a column t_s, one row a pair; null: even times"
    )
    rate_hz: Positive | None = Field(
        default=None, description="where there are no times; null: the scene's camera rate"
    )
    loop: bool = False


def _kind_alone(source: object) -> object:
    """Accept `source: twin` in a launch file for a source that needs only its kind."""
    return {"kind": source} if isinstance(source, str) else source


AnySource = Annotated[
    TwinSource | OpenCvSource | VideoSource | ImagesSource,
    Field(discriminator="kind"),
    BeforeValidator(_kind_alone),
]
