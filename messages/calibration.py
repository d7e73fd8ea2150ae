"""The stereo calibration file: what `flexsheet calibrate stereo` writes and the triangulator reads.

It is YAML, so that people can read it, with every number in full precision.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationError
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from messages.arrays import Transform
from messages.scene import Lens, NonNegative, Part, Positive

CALIBRATION_VERSION = 1


class CalibrationFileError(ValueError):
    """A calibration file that cannot be used; the message names file, key and remedy."""


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


class StereoCalibration(Part):
    """A measured rig: both lenses and how they stand to each other."""

    version: Literal[1] = 1
    device: str
    date: str = Field(description="ISO 8601, UTC")
    code_version: str
    width_px: Annotated[int, Field(gt=0)]
    height_px: Annotated[int, Field(gt=0)]
    left: Lens
    right: Lens
    right_from_left: Transform
    board: Board
    reprojection_rms_px: NonNegative
    pairs: tuple[PairResidual, ...]


def save_calibration(calibration: StereoCalibration, path: Path) -> None:
    """Write the file, replacing an older one only when the new one is complete."""
    yaml = YAML()
    yaml.default_flow_style = None
    yaml.width = 200
    text = io.StringIO()
    text.write(f"# Stereo calibration of {calibration.device}, {calibration.date}.\n")
    yaml.dump(calibration.model_dump(mode="json"), text)
    partial = path.with_name(path.name + ".partial")
    partial.write_text(text.getvalue())
    partial.replace(path)


def load_calibration(path: Path) -> StereoCalibration:
    """Read the file; raises CalibrationFileError for one that is absent, foreign or incomplete."""
    try:
        content: Any = YAML(typ="safe").load(path.read_text())
    except OSError as error:
        raise CalibrationFileError(f"{path}: cannot be read: {error.strerror}") from error
    except (YAMLError, UnicodeDecodeError) as error:
        raise CalibrationFileError(f"{path}: not YAML: {error}") from error
    if not isinstance(content, dict) or "version" not in content:
        raise CalibrationFileError(
            f'{path}: no key "version": not a calibration file; `flexsheet calibrate stereo` '
            "writes one"
        )
    if content["version"] != CALIBRATION_VERSION:
        raise CalibrationFileError(
            f"{path}: version: {content['version']!r}, this program reads {CALIBRATION_VERSION}; "
            "calibrate anew with `flexsheet calibrate stereo`"
        )
    try:
        return StereoCalibration.model_validate(content)
    except ValidationError as error:
        problems = "; ".join(
            f"{'.'.join(str(part) for part in problem['loc'])}: {problem['msg']}"
            for problem in error.errors()
        )
        raise CalibrationFileError(f"{path}: {problems}") from error
