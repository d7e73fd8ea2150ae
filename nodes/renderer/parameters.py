"""Define the parameters of the renderer that a launch file can set."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field

from flexsheet.messages.methods import Correction, SheetShapeMethod
from flexsheet.messages.scene import NonNegative, Positive
from flexsheet.messages.types import StereoMode
from flexsheet.nodes.node import NodeParameters


class RendererParameters(NodeParameters):
    rate_hz: Positive = Field(default=30.0, description="Maximum frame rate, Hz.")
    output: Literal["headless", "window"] = Field(
        default="headless",
        description="Output of the frames. headless: draw without a window. window: show frames "
        "on the projector's monitor.",
    )
    monitor: str | int | None = Field(
        default=None,
        description="Monitor of the projector, by name or number. null: an ordinary window is "
        "used.",
    )
    swap_interval: int = Field(
        default=1,
        ge=0,
        le=4,
        description="Number of monitor refreshes per shown frame. 0: do not wait for the refresh, "
        "so images may tear.",
    )
    prediction_horizon_s: NonNegative = Field(
        default=0.016,
        description="Assumed time, s, from the start of drawing to the middle of the frame's "
        "display. It is used until the latency of the first frame has been "
        "measured.",
    )
    display_latency_s: NonNegative = Field(
        default=0.008,
        description="Time, s, from the buffer swap to the middle of the frame's display. This is "
        "half of the time for which a frame is shown, plus the projector's delay. Without a "
        "window, the time starts at the end of drawing.",
    )
    max_age_s: Positive | None = Field(
        default=None,
        description="Maximum age, s, of messages about poses, fingertips, eyes and soft bodies "
        "that are used. null: four times the measured camera period is used, limited to the range "
        "0.1 s to 0.5 s.",
    )
    spacing_m: Positive = Field(
        default=0.004,
        description="Distance, m, between vertices of the drawn object. It need not be smaller "
        "than skin_spacing_m of the soft-body solver.",
    )
    samples: int | None = Field(
        default=None,
        ge=0,
        le=16,
        description="Number of samples per pixel (antialiasing). Fewer samples are faster without "
        "a GPU. null: 4 samples are used. For two_pass without a GPU, null means a higher "
        "resolution without multisampling.",
    )
    correction: Correction | None = Field(
        default=None,
        description="Correction method until a display message sets it. null: the method of the "
        "scene.",
    )
    sheet_shape: SheetShapeMethod | None = Field(
        default=None,
        description="Method that computes the sheet's shape for the correction method two_pass. "
        "null: the method of the scene.",
    )
    cache_dir: Path | None = Field(
        default=None,
        description="Folder of the sheet's deflection shapes. null: the user's cache folder is "
        "used.",
    )
    stereo: StereoMode | Literal["auto"] = Field(
        default="auto",
        description="Stereo mode until a display message sets it. auto: mono if both eyes of the "
        "scene have the same position, otherwise side_by_side.",
    )
