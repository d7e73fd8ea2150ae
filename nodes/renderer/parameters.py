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
    idle_rate_hz: Positive = Field(
        default=1.0, description="Frame rate, Hz, while nothing moves and no finger is tracked."
    )
    output: Literal["headless", "window"] = Field(
        default="headless",
        description="headless: draw without a window. window: show frames on the projector's "
        "monitor.",
    )
    monitor: str | int | None = Field(
        default=None,
        description="Monitor of the projector, by name or number. null: an ordinary window.",
    )
    swap_interval: int = Field(
        default=1,
        ge=0,
        le=4,
        description="Monitor refreshes per shown frame. 0: do not wait for the refresh.",
    )
    prediction_horizon_s: NonNegative = Field(
        default=0.016,
        description="Assumed time, s, from the start of drawing to the middle of the frame's "
        "display, used until it is measured.",
    )
    display_latency_s: NonNegative = Field(
        default=0.008,
        description="Time, s, from the swap (without a window: the end of drawing) to the middle "
        "of the frame's display: half a refresh period plus the projector's delay.",
    )
    max_age_s: Positive | None = Field(
        default=None,
        description="Maximum age, s, of poses, fingertips, eyes and soft bodies that are used. "
        "null: four measured camera periods, at least 0.1 s and at most 0.5 s.",
    )
    spacing_m: Positive = Field(
        default=0.004,
        description="Distance, m, between vertices of the drawn object; it need not be smaller "
        "than that of the soft body's skin.",
    )
    samples: int | None = Field(
        default=None,
        ge=0,
        le=16,
        description="Samples per pixel (antialiasing); fewer are faster without a GPU. null: 4; "
        "two_pass without a GPU: none, at a higher resolution.",
    )
    correction: Correction | Literal["auto"] = Field(
        default="auto",
        description="Correction method until a display message sets it. auto: the scene's method, "
        "else two_pass.",
    )
    sheet_shape: SheetShapeMethod | Literal["auto"] = Field(
        default="auto",
        description="Method that computes the sheet's shape for two_pass. auto: the scene's "
        "method, else reduced_order.",
    )
    cache_dir: Path | None = Field(
        default=None, description="Folder of the sheet's deflection shapes. null: the user's cache."
    )
    stereo: StereoMode | Literal["auto"] = Field(
        default="auto",
        description="Stereo mode until a display message sets it. auto: mono if both eyes of the "
        "scene have the same position, else side_by_side.",
    )
