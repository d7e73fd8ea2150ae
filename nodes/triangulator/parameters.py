"""Define the parameters of the triangulator node."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from flexsheet.messages.scene import Finite, Positive
from flexsheet.nodes.node import NodeParameters
from flexsheet.nodes.parameter_marks import CameraCalibrationFile, MarkerCalibrationFile
from flexsheet.nodes.triangulator.tracking import TrackingSettings


class TriangulatorParameters(NodeParameters):
    """The parameters for the detection, triangulation and tracking of the marker."""

    calibration: CameraCalibrationFile | None = Field(
        default=None,
        description="calibration file from `flexsheet calibrate stereo`; null: the optics in the "
        "scene are used",
    )
    marker_calibration: MarkerCalibrationFile | None = Field(
        default=None,
        description="calibration file from `flexsheet calibrate marker`; null: "
        "finger.marker_from_pad_m of the scene is used",
    )
    marker_radius_m: Positive = Field(
        default=0.003, description="true radius of the marker (ball or flat disc), m"
    )
    max_reprojection_px: Positive = Field(
        default=1.5, description="maximum reprojection error of a triangulated marker, px"
    )
    marker_min_contrast: Positive = Field(
        default=60.0,
        description="minimum contrast of a marker: its grey level minus the grey level of its "
        "surroundings",
    )
    track_timeout_s: Positive = Field(
        default=0.1,
        description="time without a measured point after which the track is lost, s; at least 2.5 "
        "camera periods are used",
    )
    confirm_frames: Annotated[int, Field(ge=1)] = Field(
        default=3, description="number of consecutive points that are required to start a track"
    )
    prediction_horizon_s: Positive = Field(
        default=0.12, description="duration of the predicted path, s"
    )
    reference_marks_world_m: tuple[tuple[Finite, Finite, Finite], ...] = Field(
        default=(),
        description="world positions, m, of fixed marks that look like the finger's marker, to "
        "check the camera's pose",
    )
    touch_point_world_m: tuple[Finite, Finite, Finite] | None = Field(
        default=None,
        description="world position, m, of a known point at which the fingertip may rest, to check "
        "the marker's offset",
    )

    def tracking_settings(self, max_speed_m_per_s: float) -> TrackingSettings:
        """Return the settings of a tracker for a finger with the given maximum speed."""
        return TrackingSettings(
            max_speed_m_per_s=max_speed_m_per_s,
            track_timeout_s=self.track_timeout_s,
            confirm_frames=self.confirm_frames,
        )
