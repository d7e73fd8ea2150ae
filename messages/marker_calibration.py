"""Define the file with the marker's position on the finger (`flexsheet calibrate marker`)."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from pydantic import Field

from flexsheet.messages.calibration_file import (
    CalibrationFile,
    CalibrationMismatchError,
)
from flexsheet.messages.scene import FingerLengths, NonNegative, Scene

Triple = tuple[float, float, float]


class MarkerCalibration(CalibrationFile):
    """The calibrated position of the marker on a finger, with its uncertainty."""

    command: ClassVar[str] = "flexsheet calibrate marker"
    version: Literal[1] = 1
    date: str = Field(description="time of the calibration, ISO 8601, UTC")
    code_version: str
    source: str = Field(
        description="file with the recorded touches, or name of the scene for simulated touches"
    )
    scene: str = Field(description="name of the scene in which the finger was calibrated")
    marker_from_pad_m: FingerLengths = Field(
        description="marker's centre relative to the pad's contact point, in the finger's frame"
    )
    standard_deviations_m: tuple[NonNegative, NonNegative, NonNegative]
    covariance_m2: tuple[Triple, ...] | None = Field(
        default=None,
        min_length=3,
        max_length=3,
        description="covariance of the position; null: the errors of the components are "
        "uncorrelated",
    )
    point_offset_m: FingerLengths = Field(
        description="mean estimated error of the touched points, world frame"
    )
    residual_rms_m: NonNegative
    max_residual_m: NonNegative
    touches: Annotated[int, Field(ge=1)]
    points: Annotated[int, Field(ge=1)] = 1
    orientations: Annotated[int, Field(ge=1)]


def refuse_other_marker(calibration: MarkerCalibration, scene: Scene) -> None:
    """Raise CalibrationMismatchError if the marker was calibrated in another scene."""
    if calibration.scene != scene.name:
        raise CalibrationMismatchError(
            f'scene: the marker was calibrated in the scene "{calibration.scene}", not in '
            f'"{scene.name}": use the file of this scene, or run `flexsheet calibrate marker`'
        )
