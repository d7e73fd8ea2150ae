"""Define limits for numbers in scenes, launch files, parameters and calibrations.

The limit of a number depends on the unit at the end of its field's name, such as `_m`. A few field
names have their own limits. The limits are wide. They only exclude unrealistic numbers that could
cause numerical errors in the nodes, such as overflow.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import cache
from typing import Annotated, Any, get_args, get_origin

import numpy as np
from annotated_types import Gt
from pydantic import BaseModel, ValidationInfo, field_validator
from pydantic.fields import FieldInfo

from flexsheet.messages.units import find_unit

MAX_LENGTH_M = 10.0
"""The maximum length or coordinate (m), which is about the size of a room."""

MAX_SIZE_M = 2.0
"""The maximum size (m) of the virtual object or of a device. A larger size is often meant in mm."""

MAX_ANGLE_RAD = 7.0
"""The maximum angle (rad): a full rotation plus a margin for rounding."""

MAX_ANGLE_DEG = 360.0
"""The maximum number that is understood as an angle in degrees by mistake."""

MAX_DURATION_S = 86_400.0
MAX_RATE_HZ = 10_000.0
MAX_IMAGE_PX = 16_384.0
"""The maximum width or height of an image (px): the largest OpenGL texture on common devices."""

MAX_STRESS_PA = 1.2e12
"""The maximum stress or elastic modulus (Pa): Young's modulus of diamond, the stiffest material."""

MAX_FORCE_N = 10_000.0
MAX_SPEED_M_PER_S = 10.0
"""The maximum speed (m/s): the speed of the fastest movements of a hand."""

MAX_TOOL_SPEED_M_PER_S = 2.2
"""The maximum speed (m/s) of the tool of an arm.

The value is from the specification of the RV-1A, for motion of all joints together.
"""

MAX_STRETCH_RATIO = 3.0
"""The maximum stretch ratio of a sheet. Scenes use ratios below 1.2."""

MAX_NUMBER = 1e9
"""The maximum magnitude of a number that has no unit."""

MAX_SEED = 2.0**63
MAX_BYTES = 2.0**50

MAX_BY_NAME = {
    "radius_m": MAX_SIZE_M,
    "length_m": MAX_SIZE_M,
    "width_m": MAX_SIZE_M,
    "height_m": MAX_SIZE_M,
    "size_m": MAX_SIZE_M,
    "semi_axes_m": MAX_SIZE_M,
    "max_tool_speed_m_per_s": MAX_TOOL_SPEED_M_PER_S,
    "max_stretch_ratio": MAX_STRETCH_RATIO,
    "min_stretch_ratio": MAX_STRETCH_RATIO,
    "exposure_s": 1.0,
    "latency_s": 10.0,
    "max_age_s": 10.0,
    "distortion": 1000.0,
    "gain": 1e6,
    "seed": MAX_SEED,
    "workers": 1024.0,
    "confirm_frames": 1000.0,
    "window_half_px": 256.0,
    "max_queue": 10_000.0,
}

MAX_BY_UNIT = {
    "_area_px": MAX_IMAGE_PX**2,
    "metres_per_px": 0.1,
    "_m_per_s3": 1e6,
    "_m_per_s2": 1e4,
    "_m_per_s": MAX_SPEED_M_PER_S,
    "_rad_per_s3": 1e6,
    "_rad_per_s2": 1e4,
    "_rad_per_s": 100.0,
    "_per_s3": 1e6,
    "_per_s2": 1e4,
    "_per_s": 1e3,
    "_ns_per_m": 1e6,
    "_n_per_m": 1e9,
    "_m": MAX_LENGTH_M,
    "_rad": MAX_ANGLE_RAD,
    "_s": MAX_DURATION_S,
    "_hz": MAX_RATE_HZ,
    "_px": MAX_IMAGE_PX,
    "_pa": MAX_STRESS_PA,
    "_n": MAX_FORCE_N,
    "_ratio": 1e6,
    "_bytes": MAX_BYTES,
}
"""The maximum magnitude of a number for each unit suffix of a field's name.

If one suffix ends with another suffix, the longer suffix is listed first.
"""

MIN_STRESS_PA = 100.0
"""The minimum elastic modulus (Pa). The softest tissues have a few hundred pascal, so a smaller
number is probably in kPa or MPa."""

MIN_BY_UNIT = {
    "metres_per_px": 1e-6,
    "_m": 1e-6,
    "_s": 1e-9,
    "_hz": 1e-3,
    "_px": 1e-3,
    "_pa": MIN_STRESS_PA,
}
"""The minimum value of a positive number for each unit suffix of a field's name.

The values are below the resolution of any device.
"""

MIN_POSITIVE = 1e-9
"""The minimum value of a positive number whose unit is not in `MIN_BY_UNIT`."""

MAX_ROTATION_ERROR = 1e-4
"""The maximum deviation of an element of R R^T from the identity, for a rotation matrix R.

The resulting position error at a distance of half a metre is 0.05 mm.
"""


class LimitedModel(BaseModel):
    """The base class of models in which each number has a limit that depends on its unit.

    Matrices of shape (4, 4) must be rigid transforms.
    """

    @field_validator("*", mode="after")
    @classmethod
    def _check_limits(cls, value: Any, info: ValidationInfo) -> Any:
        if value is None or isinstance(value, str | bool | BaseModel):
            return value
        name = info.field_name or ""
        if isinstance(value, np.ndarray):
            if value.dtype.kind == "f" and value.size:
                _check_number(float(np.abs(value).max()), name)
                if value.shape == (4, 4):
                    check_rigid(value)
        elif isinstance(value, tuple | list):
            for one in value:
                if isinstance(one, int | float):
                    _check_number(one, name)
        elif isinstance(value, int | float):
            _check_number(value, name)
            if 0.0 < value < find_min_positive(name) and _refuses_zero(cls, name):
                unit = _unit_text(name)
                hint = f"; {value:g} kPa are {1e3 * value:g} Pa" if unit == " Pa" else ""
                raise ValueError(
                    f"give at least {find_min_positive(name):g}{unit}, not {value:g}{hint}"
                )
        return value


def _check_number(value: float, name: str) -> None:
    if not abs(value) <= find_max_magnitude(name):
        unit = _unit_text(name)
        hint = ""
        if name.endswith("_rad") and abs(value) <= MAX_ANGLE_DEG:
            hint = f"; {value:g}° are {math.radians(value):.4g} rad"
        elif unit == " s" and abs(value) <= 1e3 * find_max_magnitude(name):
            hint = f"; {value:g} ms are {1e-3 * value:g} s"
        elif unit == " m" and abs(value) <= 1e3 * find_max_magnitude(name):
            hint = f"; {value:g} mm are {1e-3 * value:g} m"
        finite = "" if math.isfinite(value) else ", and a finite number"
        raise ValueError(f"give at most {find_max_magnitude(name):g}{unit}{finite}{hint}")


def check_rigid(matrix: np.ndarray[Any, Any]) -> None:
    """Raise ValueError if a matrix (4, 4) is not a rigid transform."""
    if not np.array_equal(matrix[3], (0.0, 0.0, 0.0, 1.0)):
        raise ValueError("the last row of a rigid transform must be [0, 0, 0, 1]")
    rotation = matrix[:3, :3]
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > MAX_ROTATION_ERROR:
        raise ValueError(
            "the upper left 3x3 block must be a rotation matrix (perpendicular rows of length 1, "
            "determinant +1)"
        )
    if np.linalg.det(rotation) < 0.0:
        raise ValueError(
            "the upper left 3x3 block is a reflection, not a rotation; negate one of its columns"
        )


@cache
def find_max_magnitude(name: str) -> float:
    """Return the largest magnitude that a number in a field of this name may have."""
    if name in MAX_BY_NAME:
        return MAX_BY_NAME[name]
    return next((MAX_BY_UNIT[unit] for unit in MAX_BY_UNIT if name.endswith(unit)), MAX_NUMBER)


@cache
def find_min_positive(name: str) -> float:
    """Return the smallest positive number that a field of this name may contain."""
    unit = next((unit for unit in MAX_BY_UNIT if name.endswith(unit)), "")
    return MIN_BY_UNIT.get(unit, MIN_POSITIVE)


def _unit_text(name: str) -> str:
    unit = find_unit(name)
    return "" if unit in ("", "1") else f" {unit}"


@cache
def _refuses_zero(model: type[BaseModel], name: str) -> bool:
    field = model.model_fields[name]
    return any(isinstance(one, Gt) for one in _constraints(field, field.annotation))


def _constraints(field: FieldInfo, annotation: Any) -> Iterator[Any]:
    """Yield the constraints of a field, including those inside an optional type."""
    yield from field.metadata
    for member in get_args(annotation):
        if get_origin(member) is Annotated:
            for one in get_args(member)[1:]:
                yield from one.metadata if isinstance(one, FieldInfo) else (one,)
