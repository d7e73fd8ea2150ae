"""Define the renderer's parameters, as a launch file gives them."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field

from flexsheet.messages.methods import Correction, SheetShapeMethod
from flexsheet.messages.scene import NonNegative, Positive
from flexsheet.messages.types import StereoMode
from flexsheet.nodes.node import NodeParameters
from flexsheet.nodes.renderer.gl import SAMPLES


class RendererParameters(NodeParameters):
    rate_hz: Positive = Field(default=30.0, description="Maximum frame rate.")
    idle_rate_hz: Positive = Field(
        default=1.0, description="Frame rate while nothing moves and no finger is tracked."
    )
    output: Literal["headless", "window"] = Field(
        default="headless",
        description="headless: no window. window: a window on the projector's monitor.",
    )
    monitor: str | int | None = Field(
        default=None,
        description="Monitor of the projector, by name or number. null: an ordinary window.",
    )
    swap_interval: int = Field(
        default=1, ge=0, le=4, description="Refreshes per swap. 0: no wait, with tearing."
    )
    prediction_horizon_s: NonNegative = Field(
        default=0.016,
        description="Time from the start of drawing to the middle of the frame's display, before "
        "the first measurement.",
    )
    display_latency_s: NonNegative = Field(
        default=0.008,
        description="Time from the swap (without a window: the end of drawing) to the middle of "
        "the frame's display: half a frame plus the projector's delay.",
    )
    max_age_s: Positive | None = Field(
        default=None,
        description="Maximum age of poses, fingertips, eyes and soft bodies. null: four measured "
        "periods of the camera, from 0.1 to 0.5 s.",
    )
    spacing_m: Positive = Field(
        default=0.004,
        description="Distance between vertices of the drawn surface; no finer than the soft body's "
        "skin is needed.",
    )
    samples: int = Field(
        default=SAMPLES,
        ge=0,
        le=16,
        description="Samples per pixel; fewer are faster without a GPU.",
    )
    correction: Correction | Literal["auto"] = Field(
        default="auto",
        description="Correction before a display message. auto: the scene's, else two_pass.",
    )
    sheet_shape: SheetShapeMethod | Literal["auto"] = Field(
        default="auto",
        description="Sheet shape for two_pass. auto: the scene's, else reduced_order.",
    )
    cache_dir: Path | None = Field(
        default=None, description="Folder of the sheet's deflection shapes. null: the user's cache."
    )
    stereo: StereoMode | Literal["auto"] = Field(
        default="auto",
        description="Stereo mode before a display message. auto: mono if the scene's eyes have the "
        "same position, else side_by_side.",
    )
