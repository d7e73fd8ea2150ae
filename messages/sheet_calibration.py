"""Define the calibration file of the rubber sheet (`flexsheet calibrate sheet`)."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from pydantic import Field

from flexsheet.messages.calibration_file import (
    CalibrationFile,
    CalibrationMismatchError,
)
from flexsheet.messages.scene import NonNegative, Part, Positive, SheetSpec

NOMINAL_RATIO = 0.02
"""The maximum relative difference between the sheet sizes in a calibration and in the scene."""


class Fitted(Part):
    """A fitted value and its standard deviation."""

    value: NonNegative
    standard_deviation: NonNegative


class LeftOutRow(Part):
    """A measurement of the sheet's force that was excluded from the fit as an outlier.

    line: line of the measurement in the file of measurements, starting at 1.
    """

    line: Annotated[int, Field(ge=1)]
    residual_ratio: float = Field(description="measured force divided by fitted force, minus one")


class SheetCalibration(CalibrationFile):
    """The calibration of a rubber sheet.

    The calibration contains the fitted parameters of the force model, and the range of the
    measurements.
    """

    command: ClassVar[str] = "flexsheet calibrate sheet"
    version: Literal[1] = 1
    date: str = Field(description="time of the calibration, ISO 8601, UTC")
    code_version: str
    source: str = Field(description="file of the measurements, or scene of the simulator")
    nominal_width_m: Positive = Field(
        description="unstretched width of the scene's sheet, to which stretch ratios refer"
    )
    height_m: Positive
    thickness_m: Positive
    finger_radius_m: Positive
    modulus_thickness_n_per_m: Fitted
    slack_width_m: Fitted
    cubic_ratio: Fitted = Field(
        description="cubic term of the unstretched sheet's force, divided by the cubic term of "
        "ideal rubber"
    )
    hysteresis_ratio: Fitted | None = Field(
        default=None,
        description="fraction of the loading energy that is lost in a cycle; null: the fraction "
        "was not measured",
    )
    rows: Annotated[int, Field(ge=1)]
    left_out: tuple[LeftOutRow, ...]
    residual_rms_ratio: NonNegative
    max_residual_ratio: NonNegative
    residual_rms_sigmas: NonNegative | None = Field(
        default=None,
        description="rms of the residuals divided by their assumed standard deviations; null: "
        "not computed",
    )
    min_stretch_ratio: Positive
    max_stretch_ratio: Positive
    max_depth_m: Positive


def refuse_other_sheet(calibration: SheetCalibration, sheet: SheetSpec) -> None:
    """Raise CalibrationMismatchError if the calibrated sheet differs in size from the scene's."""
    sizes = (
        ("width_m", calibration.nominal_width_m, sheet.width_m),
        ("height_m", calibration.height_m, sheet.height_m),
    )
    for key, measured, expected in sizes:
        if abs(measured - expected) > NOMINAL_RATIO * expected:
            raise CalibrationMismatchError(
                f"the calibrated sheet has {key} {measured:g}, but the scene's sheet.{key} is "
                f"{expected:g}: use the file of this sheet, or calibrate this sheet"
            )
