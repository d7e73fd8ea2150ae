"""The sheet's calibration file: what `flexsheet calibrate sheet` writes and the planner reads."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, ValidationError
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from messages.arrays import ArraySpec
from messages.scene import NonNegative, Part, Positive, SheetSpec

SHEET_CALIBRATION_VERSION = 1

Axis = Annotated[NDArray[np.float64], ArraySpec("<f8", ("entries",))]
Entries = Annotated[NDArray[np.float64], ArraySpec("<f8", ("stretches", "depths", "xs", "ys"))]

NOMINAL_RATIO = 0.02
"""Nominal sizes of calibration and scene may differ by this much."""


class SheetCalibrationError(ValueError):
    """A sheet's calibration file that cannot be used; names file, key and remedy."""


class Fitted(Part):
    """A fitted number and its standard deviation (normal errors)."""

    value: NonNegative
    standard_deviation: NonNegative


class LeftOutRow(Part):
    """A row that contradicted the others, by its line in the file (from 1)."""

    line: Annotated[int, Field(ge=1)]
    residual_ratio: float = Field(description="measured force over the fitted law's, less one")


class SheetTable(Part):
    """Measured over fitted force; linear between stretches and places, cubic between depths."""

    stretch_ratios: Axis = Field(description="edge distance over the nominal width")
    depths_m: Axis
    xs_m: Axis
    ys_m: Axis
    ratios: Entries


class SheetCalibration(Part):
    """A measured sheet."""

    version: Literal[1] = 1
    date: str = Field(description="ISO 8601, UTC")
    code_version: str
    source: str = Field(description="the rows' file, or the twin's scene")
    nominal_width_m: Positive = Field(description="the scene's slack width; stretch is over this")
    height_m: Positive
    thickness_m: Positive
    finger_radius_m: Positive
    modulus_thickness_n_per_m: Fitted
    slack_width_m: Fitted
    cubic_ratio: Fitted = Field(description="of the slack sheet's cubic term, over ideal rubber's")
    mooney_share: Fitted | None = Field(default=None, description="C2/(C1+C2); null: not fitted")
    rows: Annotated[int, Field(ge=1)]
    left_out: tuple[LeftOutRow, ...]
    residual_rms_ratio: NonNegative
    residual_worst_ratio: NonNegative
    least_stretch_ratio: Positive
    largest_stretch_ratio: Positive
    deepest_m: Positive
    table: SheetTable | None = None


def refuse_other_sheet(calibration: SheetCalibration, sheet: SheetSpec) -> None:
    """Raises SheetCalibrationError unless the calibration is of a sheet of the scene's sizes."""
    sizes = (
        ("width_m", calibration.nominal_width_m, sheet.width_m),
        ("height_m", calibration.height_m, sheet.height_m),
    )
    for key, measured, wanted in sizes:
        if abs(measured - wanted) > NOMINAL_RATIO * wanted:
            raise SheetCalibrationError(
                f"calibration is of a sheet with {key} {measured:g}, the scene's sheet.{key} is "
                f"{wanted:g}: name the right file, or calibrate this sheet"
            )


def save_sheet_calibration(calibration: SheetCalibration, path: Path, *, comment: str = "") -> None:
    """Write the file, replacing an older one only when the new one is complete.

    comment: a line more for its head, as the command that made it.
    """
    yaml = YAML()
    yaml.default_flow_style = None
    yaml.width = 4096
    text = io.StringIO()
    text.write(f"# Calibration of a sheet, {calibration.date}.\n")
    if comment:
        text.write(f"# {comment}\n")
    yaml.dump(calibration.model_dump(mode="json"), text)
    partial = path.with_name(path.name + ".partial")
    partial.write_text(text.getvalue())
    partial.replace(path)


def load_sheet_calibration(path: Path) -> SheetCalibration:
    """Read the file; SheetCalibrationError for one that is absent, foreign or incomplete."""
    try:
        content: Any = YAML(typ="safe").load(path.read_text())
    except OSError as error:
        raise SheetCalibrationError(
            f"{path}: cannot be read: {error.strerror}; name a file that "
            "`flexsheet calibrate sheet` wrote"
        ) from error
    except (YAMLError, UnicodeDecodeError) as error:
        raise SheetCalibrationError(f"{path}: not YAML: {error}") from error
    if not isinstance(content, dict) or "modulus_thickness_n_per_m" not in content:
        raise SheetCalibrationError(
            f'{path}: no key "modulus_thickness_n_per_m": not a sheet\'s calibration; '
            "`flexsheet calibrate sheet` writes one"
        )
    if content.get("version") != SHEET_CALIBRATION_VERSION:
        raise SheetCalibrationError(
            f"{path}: version: {content.get('version')!r}, this program reads "
            f"{SHEET_CALIBRATION_VERSION}; calibrate anew with `flexsheet calibrate sheet`"
        )
    try:
        return SheetCalibration.model_validate(content)
    except ValidationError as error:
        problems = "; ".join(
            f"{'.'.join(str(part) for part in problem['loc'])}: {problem['msg']}"
            for problem in error.errors()
        )
        raise SheetCalibrationError(f"{path}: {problems}") from error
