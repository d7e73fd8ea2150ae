"""What can be set of the triangulator."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from messages.methods import MarkMethod, TrackingMethod, TriangulationMethod
from messages.scene import Positive
from nodes.node import NodeParameters


class TriangulatorParameters(NodeParameters):
    """How the mark is found, triangulated and tracked."""

    calibration: Path | None = Field(
        default=None, description="file of `flexsheet calibrate stereo`; null: the scene's optics"
    )
    mark: MarkMethod | Literal["auto"] = Field(
        default="auto", description="auto: as the scene's methods say, else subpixel_fit"
    )
    triangulation: TriangulationMethod | Literal["auto"] = Field(
        default="auto", description="auto: as the scene's methods say, else dlt"
    )
    mark_noise_px: Positive | None = Field(
        default=None, description="of a mark's centre; null: as the method states for each"
    )
    mark_radius_m: Positive = 0.003
    max_reprojection_px: Positive = 1.5
    mark_min_contrast: Positive = 60.0
    mark_min_area_px: Annotated[int, Field(ge=1)] = 4
    mark_max_area_px: Annotated[int, Field(ge=1)] = 1500
    window_half_px: Annotated[int, Field(ge=8)] = 16
    tracking: TrackingMethod | Literal["auto"] = Field(
        default="auto", description="auto: as the scene's methods say, else hand"
    )
    max_acceleration_m_per_s2: Positive = Field(
        default=60.0, description="of a finger; marks that go sharper are not followed"
    )
    forget_after_s: Positive = 0.1
    confirm_frames: Annotated[int, Field(ge=1)] = 3
    ahead_s: Positive = Field(default=0.12, description="how far ahead fingertips are predicted")
