"""Array fields whose element type and shape are part of the message's type.

A field is declared as ``Annotated[NDArray[np.float64], ArraySpec("<f8", (3,))]``; the usual ones
have names here (``Vector3``, ``Transform``, ...).  Validation never copies an array that already
fits: what a subscriber sees is the memory that came from the socket.
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
"""A fixed length, or the name of a free one; equal names within one array must be equal lengths."""


@dataclass(frozen=True, slots=True)
class ArraySpec:
    """What an array field accepts.

    dtype: numpy type string with byte order, little-endian ("<f8", "|u1").
    shape: a length per axis; a name stands for any length.
    finite: refuse NaN and infinity (floating types only).
    """

    dtype: str
    shape: tuple[Dimension, ...]
    finite: bool = True

    def validate(self, value: object) -> NDArray[Any]:
        """Return `value` as an array of this type; ValueError says what does not fit.

        Arrays must have the exact dtype (a silent float64 -> float32 would lose digits); nested
        lists, as they come from a scene file, are converted.
        """
        wanted = _dtype(self.dtype)
        if isinstance(value, np.ndarray):
            array = value
            if array.dtype is not wanted and array.dtype != wanted:
                raise ValueError(f"array of {array.dtype}, wanted {wanted}")
        elif isinstance(value, (list, tuple)):
            array = _from_lists(value, wanted)
        else:
            raise ValueError(f"{type(value).__name__} is not an array of {wanted}")
        if not _fits(array.shape, self.shape):
            raise ValueError(f"array of shape {array.shape}, wanted {self.describe_shape()}")
        if not array.flags.c_contiguous:
            array = np.ascontiguousarray(array)
        if self.finite and wanted.kind == "f" and not _all_finite(array):
            raise ValueError("array has NaN or infinite elements")
        return array

    def describe_shape(self) -> str:
        """The shape as a reader would write it: "(3,)", "(height, width)"."""
        inner = ", ".join(str(length) for length in self.shape)
        return f"({inner},)" if len(self.shape) == 1 else f"({inner})"

    def __get_pydantic_core_schema__(
        self, source: object, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        wanted, shape, unlike = np.dtype(self.dtype), self.shape, self.validate
        check_finite = self.finite and wanted.kind == "f"
        array_type, fits, all_finite = np.ndarray, _fits, _all_finite

        def validate(value: object) -> NDArray[Any]:
            """The common case without detours: an array that fits."""
            if (
                type(value) is array_type
                and value.dtype is wanted
                and fits(value.shape, shape)
                and value.flags.c_contiguous
                and (not check_finite or all_finite(value))
            ):
                return value
            return unlike(value)

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
def _fits(shape: tuple[int, ...], wanted: tuple[Dimension, ...]) -> bool:
    """Return whether an array's shape is one of those that are wanted."""
    if len(shape) != len(wanted):
        return False
    lengths: dict[str, int] = {}
    return all(
        length == (lengths.setdefault(one, length) if isinstance(one, str) else one)
        for length, one in zip(shape, wanted, strict=True)
    )


def _from_lists(value: list[Any] | tuple[Any, ...], wanted: np.dtype[Any]) -> NDArray[Any]:
    try:
        array = np.asarray(value, dtype=wanted)
        if wanted.kind in "iu" and not np.array_equal(np.asarray(value), array):
            raise ValueError("an element is not a whole number")
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"not an array of {wanted}: {error}") from error
    return array


def _all_finite(array: NDArray[Any], few: int = 64, isfinite: Any = math.isfinite) -> bool:
    """Return whether no element is NaN or infinite.

    A sum is NaN or infinite if an element is; of a few elements it is sooner had than numpy's
    answer, above all by a process that has slept.  It may overflow for finite ones, hence the
    second look.
    """
    if array.size <= few and isfinite(sum(array.ravel().tolist())):
        return True
    return bool(np.isfinite(array).all())


Vector2 = Annotated[NDArray[np.float64], ArraySpec("<f8", (2,))]
Vector3 = Annotated[NDArray[np.float64], ArraySpec("<f8", (3,))]
Vector6 = Annotated[NDArray[np.float64], ArraySpec("<f8", (6,))]
Matrix3 = Annotated[NDArray[np.float64], ArraySpec("<f8", (3, 3))]
Matrix6 = Annotated[NDArray[np.float64], ArraySpec("<f8", (6, 6))]
Transform = Annotated[NDArray[np.float64], ArraySpec("<f8", (4, 4))]
"""Homogeneous rigid transform ``a_from_b``: metres, row-major."""
Points3 = Annotated[NDArray[np.float32], ArraySpec("<f4", ("points", 3))]
Vertices = Annotated[NDArray[np.float64], ArraySpec("<f8", ("vertices", 3))]
Triangles = Annotated[NDArray[np.int32], ArraySpec("<i4", ("triangles", 3))]
GrayImage = Annotated[NDArray[np.uint8], ArraySpec("|u1", ("height", "width"))]
ColorImage = Annotated[NDArray[np.uint8], ArraySpec("|u1", ("height", "width", 3))]
EyePair = Annotated[NDArray[np.float64], ArraySpec("<f8", (2, 3))]
