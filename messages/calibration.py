"""Define the calibration file of the stereo camera (`flexsheet calibrate stereo`)."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flexsheet.messages.arrays import ArraySpec, Transform
from flexsheet.messages.calibration_file import (
    CalibrationFile,
    CalibrationMismatchError,
)
from flexsheet.messages.scene import Lens, NonNegative, Part, Positive, StereoCamera

Covariance = Annotated[NDArray[np.float64], ArraySpec("<f8", ("numbers", "numbers"))]


class Board(Part):
    """A calibration board: a chessboard, or a ChArUco board with markers in its white squares.

    columns, rows: numbers of inner corners along both sides of the board.
    """

    kind: Literal["chessboard", "charuco"] = "chessboard"
    columns: Annotated[int, Field(ge=3)]
    rows: Annotated[int, Field(ge=3)]
    square_m: Positive
    marker_m: Positive | None = Field(
        default=None,
        description="side length of a marker on a ChArUco board; null: the board is a chessboard",
    )
    dictionary: str | None = Field(
        default=None,
        description="OpenCV's name of the marker dictionary of a ChArUco board, such as "
        "DICT_4X4_50",
    )


class PairResidual(Part):
    """The rms reprojection error (px) of the board's corners in each image of a stereo pair."""

    left: str
    right: str
    used: bool
    reason: str = Field(description="reason why the pair was left out; empty if it was used")
    left_rms_px: NonNegative | None
    right_rms_px: NonNegative | None
    stray_corners: int = Field(
        default=0, description="number of outlier corners of both views in a used pair"
    )
    digest: str = Field(
        default="", description="first 16 hexadecimal digits of the SHA-256 of both files' bytes"
    )


class Uncertainty(Part):
    """The uncertainty of a stereo calibration, given as standard deviations.

    The uncertainty is an error that all measured fingertip positions have in common. The scatter of
    single measurements is not included.
    """

    corner_sigma_px: NonNegative = Field(
        description="standard deviation of one coordinate of a corner"
    )
    jackknife_ratio: NonNegative = Field(
        description="scatter of fits that leave out some pairs, divided by the scatter that the "
        "covariance predicts; if above 1, the covariance was multiplied by the square of this ratio"
    )
    working_distance_m: Positive = Field(
        description="depth for which `depth_std_m` and `lateral_std_m` are computed"
    )
    depth_std_m: NonNegative = Field(
        description="standard deviation of a fingertip's position along the left camera's "
        "optical axis"
    )
    lateral_std_m: NonNegative = Field(
        description="standard deviation of a fingertip's position perpendicular to this axis, x "
        "and y together"
    )
    parameters: tuple[str, ...] = Field(description="names of the covariance's rows and columns")
    covariance: Covariance


class StereoCalibration(CalibrationFile):
    """The calibration of a stereo camera: both lenses and the transform between them."""

    command: ClassVar[str] = "flexsheet calibrate stereo"
    version: Literal[2] = 2
    device: str
    date: str = Field(description="time of the calibration, ISO 8601, UTC")
    code_version: str
    opencv_version: str | None = Field(
        default=None,
        description="version of OpenCV; null: the calibration was computed without OpenCV",
    )
    width_px: Annotated[int, Field(gt=0)]
    height_px: Annotated[int, Field(gt=0)]
    left: Lens
    right: Lens
    right_from_left: Transform
    board: Board
    reprojection_rms_px: NonNegative
    uncertainty: Uncertainty | None = Field(
        default=None, description="uncertainty of the calibration; null: unknown"
    )
    pairs: tuple[PairResidual, ...]


def refuse_other_camera(calibration: StereoCalibration, camera: StereoCamera) -> None:
    """Raise CalibrationMismatchError if a stereo calibration does not belong to the scene's camera.

    The device and the image size are compared.
    """
    if calibration.device != camera.device:
        raise CalibrationMismatchError(
            f'the calibration is of the camera "{calibration.device}", but the scene\'s camera is '
            f'"{camera.device}": set the parameter "calibration" to the file of this camera, or '
            "calibrate this camera"
        )
    measured = (calibration.width_px, calibration.height_px)
    expected = (camera.width_px, camera.height_px)
    if measured != expected:
        raise CalibrationMismatchError(
            f"the calibration of {calibration.device} is for {measured[0]}x{measured[1]} px, but "
            f"the scene's camera delivers {expected[0]}x{expected[1]} px: calibrate at "
            "this image size"
        )
