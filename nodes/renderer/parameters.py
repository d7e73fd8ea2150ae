"""What the renderer can be told in a launch file."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field

from messages.methods import Correction, SheetShapeMethod
from messages.scene import NonNegative, Positive
from messages.types import StereoMode
from nodes.node import NodeParameters
from nodes.renderer.gl import SAMPLES


class RendererParameters(NodeParameters):
    rate_hz: Positive = Field(default=30.0, description="most frames a second")
    idle_rate_hz: Positive = Field(
        default=1.0, description="of frames while nobody touches and nothing moves"
    )
    output: Literal["headless", "window"] = "headless"
    monitor: str | int | None = Field(
        default=None,
        description="the projector's, by name or number; null: an ordinary window",
    )
    swap_interval: int = Field(
        default=1, ge=0, le=4, description="the projector's refreshes to a swap; 0: none, tears"
    )
    prediction_horizon_s: NonNegative = Field(
        default=0.016,
        description="from the start of drawing to the middle of the light, until it is measured",
    )
    display_latency_s: NonNegative = Field(
        default=0.008,
        description="from the swap (without a window: the end of drawing) to the middle of the "
        "light: half a frame, and the projector's own delay",
    )
    max_age_s: Positive = Field(
        default=0.1, description="older poses, fingertips, eyes and soft bodies are not used"
    )
    spacing_m: Positive = Field(default=0.0025, description="between vertices of the drawn surface")
    samples: int = Field(
        default=SAMPLES, ge=0, le=16, description="of a pixel; fewer draw faster without a GPU"
    )
    correction: Correction | Literal["auto"] = Field(
        default="auto",
        description="until a display message; auto: as the scene's methods say, else two_pass",
    )
    sheet_shape: SheetShapeMethod | Literal["auto"] = Field(
        default="auto",
        description="what two_pass takes the sheet for; auto: as the scene's methods say, else "
        "dents",
    )
    cache_dir: Path | None = Field(
        default=None, description="of the sheet's dent shapes; null: the user's cache"
    )
    stereo: StereoMode = Field(default="side_by_side", description="until a display message")
