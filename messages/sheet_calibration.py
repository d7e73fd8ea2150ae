"""Define the sheet's calibration file, which `flexsheet calibrate sheet` writes."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flexsheet.messages.arrays import ArraySpec
from flexsheet.messages.calibration_file import (
    CalibrationMismatchError,
    read_calibration,
    write_calibration,
)
from flexsheet.messages.scene import NonNegative, Part, Positive, SheetSpec

Axis = Annotated[NDArray[np.float64], ArraySpec("<f8", ("entries",))]
Entries = Annotated[NDArray[np.float64], ArraySpec("<f8", ("stretches", "depths", "xs", "ys"))]

NOMINAL_RATIO = 0.02
"""The maximum relative difference between the nominal sizes of a calibration and of the scene."""


class Fitted(Part):
    """A fitted value with the standard deviation of its normally distributed error."""

    value: NonNegative
    standard_deviation: NonNegative


class LeftOutRow(Part):
    """A measured push that was excluded as an outlier; `line` is its line in the file, from 1."""

    line: Annotated[int, Field(ge=1)]
    residual_ratio: float = Field(description="measured force divided by fitted force, minus one")


class SheetTable(Part):
    """A table of the ratio of measured to fitted force.

    It is interpolated linearly over stretch and position, and by cubics over depth.
    """

    stretch_ratios: Axis = Field(description="edge distance divided by the nominal width")
    depths_m: Axis
    xs_m: Axis
    ys_m: Axis
    ratios: Entries


class SheetCalibration(Part):
    """The calibration of a sheet: fitted parameters of the force model, and the measured range."""

    version: Literal[1] = 1
    date: str = Field(description="ISO 8601, UTC")
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
        description="cubic term of the unstretched sheet's force, divided by that of ideal rubber"
    )
    mooney_ratio: Fitted | None = Field(
        default=None, description="Mooney-Rivlin constants C2/(C1+C2); null: not fitted"
    )
    hysteresis_ratio: Fitted | None = Field(
        default=None,
        description="fraction of the loading energy that is lost in a cycle; null: not measured",
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
    table: SheetTable | None = None


def refuse_other_sheet(calibration: SheetCalibration, sheet: SheetSpec) -> None:
    """Raise CalibrationMismatchError if the calibrated sheet's size differs from the scene's."""
    sizes = (
        ("width_m", calibration.nominal_width_m, sheet.width_m),
        ("height_m", calibration.height_m, sheet.height_m),
    )
    for key, measured, expected in sizes:
        if abs(measured - expected) > NOMINAL_RATIO * expected:
            raise CalibrationMismatchError(
                f"the calibrated sheet has {key} {measured:g}, but the scene's sheet.{key} is "
                f"{expected:g}: give the file of this sheet, or calibrate this sheet"
            )


def save_sheet_calibration(calibration: SheetCalibration, path: Path, *, comment: str = "") -> None:
    """Write a sheet calibration to a file. Raises FileWriteError if it cannot be written."""
    title = f"Calibration of a sheet, {calibration.date}."
    write_calibration(calibration, path, title=title, comment=comment)


def load_sheet_calibration(path: Path) -> SheetCalibration:
    """Read a sheet calibration from a file. Raises CalibrationFileError if it is invalid."""
    return read_calibration(SheetCalibration, path, command="flexsheet calibrate sheet")
