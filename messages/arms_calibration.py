"""The arms' calibration file: what `flexsheet calibrate arms` writes; where the bases stand."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field

from flexsheet.messages.calibration import Board, Covariance
from flexsheet.messages.calibration_file import read_calibration, write_calibration
from flexsheet.messages.scene import NonNegative, Part, Pose

ARMS_CALIBRATION_VERSION = 1


class ArmPoseFit(Part):
    """How one place of the arm fits."""

    name: str
    used: bool
    reason: str = Field(description="why it was left out; empty when used")
    shift_m: NonNegative = Field(description="from where the joints say to where it was seen")
    turn_rad: NonNegative
    rms_px: NonNegative = Field(description="of the corners, drawn where the joints say")


class ArmBase(Part):
    """Where one arm's base stands, and how well that is known; deviations are standard ones."""

    world_from_base: Pose
    flange_from_board: Pose
    position_std_m: NonNegative = Field(
        description="of where this arm is sent to at the world's origin, all three axes together"
    )
    rotation_std_rad: NonNegative = Field(description="of the base, all three axes together")
    covariance: Covariance = Field(
        description="(6, 6) of the base's error: a turn about its origin, in the world's axes "
        "(rad), then a shift (m)"
    )
    jackknife_ratio: NonNegative = Field(
        description="what refits without one place scatter, over what the fit states; above 1 the "
        "covariance was raised by its square"
    )
    largest_change_m: NonNegative = Field(
        description="of the base's position, when any one place is left out"
    )
    largest_change_rad: NonNegative
    corner_sigma_px: NonNegative = Field(description="of one coordinate of a corner")
    arm_sigma_m: NonNegative = Field(description="of one component of the flange's own error")
    arm_sigma_rad: NonNegative
    places: tuple[ArmPoseFit, ...]


class ArmsCalibration(Part):
    """The measured bases; an arm that was not measured is null."""

    version: Literal[1] = 1
    date: str = Field(description="ISO 8601, UTC")
    code_version: str
    scene: str = Field(description="whose camera's place in the world was taken as given")
    device: str = Field(description="the stereo camera")
    board: Board
    left: ArmBase | None = None
    right: ArmBase | None = None


def save_arms_calibration(calibration: ArmsCalibration, path: Path, *, comment: str = "") -> None:
    title = f"Where the arms of scene {calibration.scene} stand, {calibration.date}."
    write_calibration(calibration, path, title=title, comment=comment)


def load_arms_calibration(path: Path) -> ArmsCalibration:
    command = "flexsheet calibrate arms"
    return read_calibration(
        ArmsCalibration, path, version=ARMS_CALIBRATION_VERSION, command=command
    )
