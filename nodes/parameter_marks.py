"""Define annotated types of node parameters, which tell the launcher how a value is used."""

from __future__ import annotations

from collections.abc import Iterator
from enum import StrEnum
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Union, get_args, get_origin

from pydantic import BaseModel, Field


class ParameterMark(StrEnum):
    """A mark that tells the launcher how a node parameter is used."""

    LISTEN_PORT = "listen_port"
    DEVICE_HOST = "device_host"
    DEVICE_PORT = "device_port"
    DEVICE_FILE = "device_file"
    CAMERA_CALIBRATION = "camera_calibration"
    SHEET_CALIBRATION = "sheet_calibration"
    MARKER_CALIBRATION = "marker_calibration"


ListenPort = Annotated[int, Field(ge=0, le=65535), ParameterMark.LISTEN_PORT]
"""The TCP port on which the node listens; 0 for any free port."""

DeviceHost = Annotated[str, ParameterMark.DEVICE_HOST]
"""The IP address of the device that the node controls."""

DevicePort = Annotated[int, Field(ge=1, le=65535), ParameterMark.DEVICE_PORT]
"""The TCP port of the device that the node controls."""

DeviceFile = Annotated[str, ParameterMark.DEVICE_FILE]
"""The path of a device file, or the URL of a stream. The command `flexsheet doctor` checks that the
path exists."""

CameraCalibrationFile = Annotated[Path, ParameterMark.CAMERA_CALIBRATION]
"""The path of a stereo calibration. The launcher checks whether it agrees with the scene."""

SheetCalibrationFile = Annotated[Path, ParameterMark.SHEET_CALIBRATION]
"""The path of a sheet calibration. The launcher checks whether it agrees with the scene."""

MarkerCalibrationFile = Annotated[Path, ParameterMark.MARKER_CALIBRATION]
"""The path of a marker calibration. The launcher checks whether it agrees with the scene."""

ParameterKey = tuple[str | int, ...]
"""The path of a value in nested parameters, for instance ("source", "left")."""


def find_marked(parameters: BaseModel, mark: ParameterMark) -> dict[ParameterKey, Any]:
    """Return the values of all node parameters that are annotated with a `ParameterMark`.

    The keys are the paths of the parameters. Parameters in nested models, unions and sequences are
    included. Values that are None are omitted.
    """
    return {key: value for key, value in _search_fields(parameters, (), mark) if value is not None}


def _search_fields(
    model: BaseModel, key: ParameterKey, mark: ParameterMark
) -> Iterator[tuple[ParameterKey, Any]]:
    for name, field in type(model).model_fields.items():
        inner = (*key, name)
        if mark in field.metadata:
            yield inner, getattr(model, name)
        else:
            yield from _search(field.annotation, getattr(model, name), inner, mark)


def _search(
    annotation: Any, value: Any, key: ParameterKey, mark: ParameterMark
) -> Iterator[tuple[ParameterKey, Any]]:
    if isinstance(value, BaseModel):
        yield from _search_fields(value, key, mark)
    elif get_origin(annotation) is Annotated:
        inner, *marks = get_args(annotation)
        if mark in marks:
            yield key, value
        else:
            yield from _search(inner, value, key, mark)
    elif get_origin(annotation) in (Union, UnionType):
        for option in get_args(annotation):
            if _accepts(option, value):
                yield from _search(option, value, key, mark)
    elif isinstance(value, tuple | list):
        for index, item in enumerate(value):
            yield from _search(get_args(annotation)[0], item, (*key, index), mark)


def _accepts(annotation: Any, value: Any) -> bool:
    if get_origin(annotation) is Annotated:
        return _accepts(get_args(annotation)[0], value)
    kind = get_origin(annotation) or annotation
    return isinstance(kind, type) and isinstance(value, kind)
