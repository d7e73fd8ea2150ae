"""Parameters of the triangulator node."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from flexsheet.messages.methods import MarkerMethod, TrackingMethod, TriangulationMethod
from flexsheet.messages.scene import Finite, Positive
from flexsheet.nodes.node import NodeParameters
from flexsheet.nodes.parameter_marks import CameraCalibrationFile, MarkerCalibrationFile


class TriangulatorParameters(NodeParameters):
    """Parameters of the detection, triangulation and tracking of the marker."""

    calibration: CameraCalibrationFile | None = Field(
        default=None,
        description="file of `flexsheet calibrate stereo`; null takes the scene's optics",
    )
    marker_calibration: MarkerCalibrationFile | None = Field(
        default=None,
        description="file of `flexsheet calibrate marker`; null takes the scene's "
        "finger.marker_from_pad_m",
    )
    marker: MarkerMethod | Literal["auto"] = Field(
        default="auto",
        description="refinement of the marker's centre; auto takes the scene's method, else "
        "subpixel_fit",
    )
    triangulation: TriangulationMethod | Literal["auto"] = Field(
        default="auto", description="triangulation method; auto takes the scene's method, else dlt"
    )
    marker_noise_px: Positive | None = Field(
        default=None,
        description="standard deviation of a marker's centre; null takes the method's estimate",
    )
    marker_radius_m: Positive = Field(
        default=0.003, description="true radius of the marker, a ball or a flat disc"
    )
    max_reprojection_px: Positive = Field(
        default=1.5, description="maximum reprojection error of a marker pair"
    )
    marker_min_contrast: Positive = Field(
        default=60.0, description="minimum height of a marker above its surroundings, levels of 255"
    )
    marker_min_area_px: Annotated[int, Field(ge=1)] = Field(
        default=4, description="minimum number of pixels of a marker"
    )
    marker_max_area_px: Annotated[int, Field(ge=1)] = Field(
        default=1500, description="maximum number of pixels of a marker"
    )
    window_half_px: Annotated[int, Field(ge=8)] = Field(
        default=16, description="half the side of the smallest search window"
    )
    tracking: TrackingMethod | Literal["auto"] = Field(
        default="auto",
        description="filter of the fingertip; auto takes the scene's method, else adaptive",
    )
    max_acceleration_m_per_s2: Positive = Field(
        default=60.0, description="maximum acceleration of a finger; faster points are rejected"
    )
    track_timeout_s: Positive = Field(
        default=0.1,
        description="maximum time without a point before the track is lost; at least 2.5 frames",
    )
    confirm_frames: Annotated[int, Field(ge=1)] = Field(
        default=3, description="number of consecutive consistent points that start a track"
    )
    prediction_horizon_s: Positive = Field(default=0.12, description="length of the predicted path")
    reference_marks_world_m: tuple[tuple[Finite, Finite, Finite], ...] = Field(
        default=(),
        description="positions of fixed marks that look like the finger's marker, for the "
        "self-check of the camera's pose",
    )
    touch_point_world_m: tuple[Finite, Finite, Finite] | None = Field(
        default=None,
        description="position of the fingertip when it rests at a known point, for the self-check "
        "of the marker's offset",
    )
