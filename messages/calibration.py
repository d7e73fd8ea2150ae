"""The stereo calibration: what `flexsheet calibrate stereo` writes and the triangulator reads."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flexsheet.messages.arrays import ArraySpec, Transform
from flexsheet.messages.calibration_file import (
    CalibrationMismatchError,
    read_calibration,
    write_calibration,
)
from flexsheet.messages.scene import Lens, NonNegative, Part, Positive, StereoCamera

CALIBRATION_VERSION = 2

Covariance = Annotated[NDArray[np.float64], ArraySpec("<f8", ("numbers", "numbers"))]


class Board(Part):
    """A chessboard, or a ChArUco board whose white squares carry markers.

    columns, rows: inner corners along its two directions, for both kinds.
    """

    kind: Literal["chessboard", "charuco"] = "chessboard"
    columns: Annotated[int, Field(ge=3)]
    rows: Annotated[int, Field(ge=3)]
    square_m: Positive
    marker_m: Positive | None = Field(default=None, description="side of a marker; ChArUco only")
    dictionary: str | None = Field(
        default=None, description="of the markers, as OpenCV names it: DICT_4X4_50; ChArUco only"
    )


class PairResidual(Part):
    """How one pair of pictures fits: root mean square over the corners of each view."""

    left: str
    right: str
    used: bool
    reason: str = Field(description="why the pair was left out; empty when used")
    left_rms_px: NonNegative | None
    right_rms_px: NonNegative | None
    stray_corners: int = Field(
        default=0, description="corners of both views that were left out of a used pair"
    )
    digest: str = Field(
        default="", description="of both files' bytes: SHA-256, its first 16 hexadecimal digits"
    )


class Uncertainty(Part):
    """How well the rig is known, as standard deviations of a normal error.

    It says by how much all fingertips are off together, not how much single ones scatter.
    """

    corner_sigma_px: NonNegative = Field(description="of one coordinate of a corner")
    jackknife_ratio: NonNegative = Field(
        description="what refits without some of the pairs scatter, over what the fit states; "
        "above 1 the covariance was raised by its square"
    )
    working_distance_m: Positive = Field(description="depth at which the next two hold")
    depth_std_m: NonNegative = Field(description="of a fingertip along the left camera's view")
    lateral_std_m: NonNegative = Field(description="of a fingertip across it, x and y together")
    parameters: tuple[str, ...] = Field(description="the covariance's rows and columns")
    covariance: Covariance


class StereoCalibration(Part):
    """A measured rig: both lenses and how they stand to each other."""

    version: Literal[2] = 2
    device: str
    date: str = Field(description="ISO 8601, UTC")
    code_version: str
    opencv_version: str | None = Field(default=None, description="null: not made with OpenCV")
    width_px: Annotated[int, Field(gt=0)]
    height_px: Annotated[int, Field(gt=0)]
    left: Lens
    right: Lens
    right_from_left: Transform
    board: Board
    reprojection_rms_px: NonNegative
    uncertainty: Uncertainty | None = Field(default=None, description="null: not known")
    pairs: tuple[PairResidual, ...]


def refuse_other_camera(calibration: StereoCalibration, camera: StereoCamera) -> None:
    """Raises CalibrationMismatchError unless the calibration is of this camera at this size."""
    if calibration.device != camera.device:
        raise CalibrationMismatchError(
            f'calibration is of device "{calibration.device}", the scene\'s camera is '
            f'"{camera.device}": name the right file in the parameter "calibration", or '
            "calibrate this camera"
        )
    measured = (calibration.width_px, calibration.height_px)
    wanted = (camera.width_px, camera.height_px)
    if measured != wanted:
        raise CalibrationMismatchError(
            f"calibration of {calibration.device} is for {measured[0]}x{measured[1]} px, the "
            f"scene's camera gives {wanted[0]}x{wanted[1]} px: calibrate at this size"
        )


def save_calibration(calibration: StereoCalibration, path: Path, *, comment: str = "") -> None:
    title = f"Stereo calibration of {calibration.device}, {calibration.date}."
    write_calibration(calibration, path, title=title, comment=comment)


def load_calibration(path: Path) -> StereoCalibration:
    command = "flexsheet calibrate stereo"
    return read_calibration(StereoCalibration, path, version=CALIBRATION_VERSION, command=command)
