"""Define the file with the calibrated poses of the arm bases (`flexsheet calibrate arms`)."""

from __future__ import annotations

from typing import ClassVar, Literal

from pydantic import Field

from flexsheet.messages.calibration import Board, Covariance
from flexsheet.messages.calibration_file import CalibrationFile
from flexsheet.messages.scene import NonNegative, Part, Pose


class ArmPoseFit(Part):
    """The residuals of the calibration in one measured pose of an arm."""

    name: str
    used: bool
    reason: str = Field(description="reason why the pose was left out; empty if it was used")
    shift_m: NonNegative = Field(
        description="distance between the board pose from the camera and the board pose from the "
        "joint angles"
    )
    rotation_rad: NonNegative
    rms_px: NonNegative = Field(
        description="rms reprojection error of the corners, with the board pose computed from "
        "the joint angles"
    )


class ArmBase(Part):
    """The calibrated pose of the base of an arm, with standard deviations."""

    world_from_base: Pose
    flange_from_board: Pose
    position_std_m: NonNegative = Field(
        description="standard deviation of this arm's position at the world's origin, all three "
        "axes together"
    )
    rotation_std_rad: NonNegative = Field(
        description="standard deviation of the base's orientation, all three axes together"
    )
    covariance: Covariance = Field(
        description="covariance (6, 6) of the base's error: rotation about its origin, in the "
        "world's axes (rad), then translation (m)"
    )
    jackknife_ratio: NonNegative = Field(
        description="scatter of the fits that leave out one pose, divided by the scatter that the "
        "covariance predicts; if above 1, the covariance was multiplied by the square of this ratio"
    )
    max_change_m: NonNegative = Field(
        description="maximum change of the base's position when one pose is left out"
    )
    max_change_rad: NonNegative
    corner_sigma_px: NonNegative = Field(
        description="standard deviation of one coordinate of a corner"
    )
    arm_sigma_m: NonNegative = Field(
        description="standard deviation per axis of the flange position from the joint angles"
    )
    arm_sigma_rad: NonNegative
    poses: tuple[ArmPoseFit, ...]


class ArmsCalibration(CalibrationFile):
    """The calibrated poses of the bases of both arms.

    If an arm was not calibrated, its field is null.
    """

    command: ClassVar[str] = "flexsheet calibrate arms"
    version: Literal[1] = 1
    date: str = Field(description="time of the calibration, ISO 8601, UTC")
    code_version: str
    scene: str = Field(description="scene whose camera pose in the world is the reference")
    device: str = Field(description="device of the stereo camera")
    board: Board
    left: ArmBase | None = None
    right: ArmBase | None = None
