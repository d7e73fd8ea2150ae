"""Define types of message fields that contain numpy arrays of a fixed element type and shape.

A field is declared as ``Annotated[NDArray[np.float64], ArraySpec("<f8", (3,))]``. The common types
have names, such as ``Vector3`` and ``Transform``. Validation does not copy a valid array, so a
subscriber can read the memory that was received from the socket.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import GetCoreSchemaHandler, GetJsonSchemaHandler
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema, core_schema

Dimension = int | str
"""The length of an array axis, or a name for a variable length.

Axes with the same name must have the same length.
"""


@dataclass(frozen=True, slots=True)
class ArraySpec:
    """The required element type and shape of an array field.

    dtype: numpy type string with little-endian byte order ("<f8", "|u1").
    shape: length of each axis. A name stands for any length.
    finite: whether NaN and infinity are rejected. This applies only to floating-point types.
    """

    dtype: str
    shape: tuple[Dimension, ...]
    finite: bool = True

    def validate(self, value: object) -> NDArray[Any]:
        """Convert `value` to an array, and check its element type, shape and elements.

        A numpy array must have the exact dtype, because a silent conversion from float64 to float32
        would lose digits. Nested lists, as in a scene file, are converted.

        Raises ValueError if a check fails.
        """
        expected = _dtype(self.dtype)
        if isinstance(value, np.ndarray):
            array = value
            if array.dtype is not expected and array.dtype != expected:
                raise ValueError(f"the array has the type {array.dtype}, expected {expected}")
        elif isinstance(value, (list, tuple)):
            array = _convert_lists(value, expected)
        else:
            raise ValueError(f"{type(value).__name__} cannot be used as an array of {expected}")
        if not _has_shape(array.shape, self.shape):
            raise ValueError(
                f"the array has the shape {array.shape}, expected {self.describe_shape()}"
            )
        if not array.flags.c_contiguous:
            array = np.ascontiguousarray(array)
        if self.finite and expected.kind == "f" and not _all_finite(array):
            raise ValueError("the array has NaN or infinite elements")
        return array

    def describe_shape(self) -> str:
        """Return the shape as text, such as "(3,)" or "(height, width)"."""
        inner = ", ".join(str(length) for length in self.shape)
        return f"({inner},)" if len(self.shape) == 1 else f"({inner})"

    def __get_pydantic_core_schema__(
        self, source: object, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        expected, shape, validate_fully = np.dtype(self.dtype), self.shape, self.validate
        check_finite = self.finite and expected.kind == "f"
        array_type, has_shape, all_finite = np.ndarray, _has_shape, _all_finite

        def validate(value: object) -> NDArray[Any]:
            if (
                type(value) is array_type
                and value.dtype is expected
                and (value.shape == shape or has_shape(value.shape, shape))
                and value.flags.c_contiguous
                and (not check_finite or all_finite(value))
            ):
                return value
            return validate_fully(value)

        return core_schema.no_info_plain_validator_function(
            validate,
            serialization=core_schema.plain_serializer_function_ser_schema(
                lambda array: array.tolist(), when_used="json"
            ),
        )

    def __get_pydantic_json_schema__(
        self, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> JsonSchemaValue:
        return {
            "type": "array",
            "description": f"{np.dtype(self.dtype).name}, shape {self.describe_shape()}",
            "dtype": self.dtype,
            "shape": list(self.shape),
        }


@cache
def _dtype(name: str) -> np.dtype[Any]:
    return np.dtype(name)


@lru_cache(maxsize=4096)
def _has_shape(shape: tuple[int, ...], expected: tuple[Dimension, ...]) -> bool:
    if len(shape) != len(expected):
        return False
    lengths: dict[str, int] = {}
    return all(
        length == (lengths.setdefault(one, length) if isinstance(one, str) else one)
        for length, one in zip(shape, expected, strict=True)
    )


def _convert_lists(value: list[Any] | tuple[Any, ...], expected: np.dtype[Any]) -> NDArray[Any]:
    try:
        array = np.asarray(value, dtype=expected)
        if expected.kind in "iu" and not np.array_equal(np.asarray(value), array):
            raise ValueError("an element is not a whole number")
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"the value is not an array of {expected}: {error}") from error
    return array


def _all_finite(array: NDArray[Any], few: int = 64, isfinite: Any = math.isfinite) -> bool:
    """Return whether all elements of an array are finite.

    The sum of at most `few` elements is tested first, because this is faster than numpy's test. A
    sum of finite elements can overflow. If the sum is not finite, numpy's test therefore follows.
    """
    if array.size <= few and isfinite(sum(array.ravel().tolist())):
        return True
    return bool(np.isfinite(array).all())


Vector2 = Annotated[NDArray[np.float64], ArraySpec("<f8", (2,))]
Vector3 = Annotated[NDArray[np.float64], ArraySpec("<f8", (3,))]
Vector6 = Annotated[NDArray[np.float64], ArraySpec("<f8", (6,))]
Matrix6 = Annotated[NDArray[np.float64], ArraySpec("<f8", (6, 6))]
Transform = Annotated[NDArray[np.float64], ArraySpec("<f8", (4, 4))]
"""A matrix (4, 4) of a rigid transform ``a_from_b`` in homogeneous coordinates, in metres."""
Points3 = Annotated[NDArray[np.float32], ArraySpec("<f4", ("points", 3))]
Vertices = Annotated[NDArray[np.float64], ArraySpec("<f8", ("vertices", 3))]
Triangles = Annotated[NDArray[np.int32], ArraySpec("<i4", ("triangles", 3))]
GrayImage = Annotated[NDArray[np.uint8], ArraySpec("|u1", ("height", "width"))]
ColorImage = Annotated[NDArray[np.uint8], ArraySpec("|u1", ("height", "width", 3))]
EyePair = Annotated[NDArray[np.float64], ArraySpec("<f8", (2, 3))]
