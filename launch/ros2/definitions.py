"""Generate the ROS 2 message types of the package `flexsheet_msgs` from flexsheet's message types.

A message type or a group of fields becomes a ROS type of the same name. Fields become:

    bool, int, float, text              bool, int64, float64, string
    timestamp                           builtin_interfaces/Time
    array                               flat sequence or array of its elements, row by row
    value that can be None              sequence with at most one element
    tuple of values of one type         sequence of the values
    anything else (such as a choice between several types)    string that contains JSON

Images are omitted, because `mapping.VIEWS` converts them to sensor_msgs/Image.
"""

from __future__ import annotations

import json
import types
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from enum import Enum
from functools import cache
from typing import Any, Literal, Union, get_args, get_origin

import numpy as np
from pydantic import BaseModel, TypeAdapter

from flexsheet.messages.arrays import ArraySpec
from flexsheet.messages.base import Message, find_stamp_fields
from flexsheet.messages.errors import FlexsheetError
from flexsheet.messages.field_types import get_annotation, is_image, split_annotation

PACKAGE = "flexsheet_msgs"
HEADER = "std_msgs/Header header\nstring writer\nuint64 sequence_number\n"
"""The first fields of all generated ROS message types.

The field `writer` contains the name of the node that published the message.
"""

ELEMENTS = {"<f8": "float64", "<f4": "float32", "<i4": "int32", "<i8": "int64", "|u1": "uint8"}
"""The ROS element types of array fields, by NumPy element type."""

Make = Callable[..., Any]
"""The type of a function that makes a ROS message from a type name and fields (keywords)."""


class Ros2Error(FlexsheetError, RuntimeError):
    """Raised if messages cannot be exchanged with ROS 2."""

    remedy = "Install the packages of the extra `flexsheet[ros2]`, or correct the named value."


@dataclass(frozen=True, slots=True)
class OwnField:
    """A field of a generated ROS type, and a function that converts the values of this field."""

    name: str
    ros_type: str
    convert: Callable[[Any, Make], Any]


def split_time(at_ns: int) -> dict[str, int]:
    """Split a time (ns since 1970) into the fields of a ROS time.

    Raises Ros2Error if the time is before 1970 or after 2038, because ROS 2 cannot represent it.
    """
    seconds, nanoseconds = divmod(at_ns, 1_000_000_000)
    if not 0 <= seconds < 1 << 31:
        raise Ros2Error(
            f"the timestamp {at_ns} ns is outside the range of ROS 2 (1970 to 2038); "
            "check the bag with `flexsheet bag info`"
        )
    return {"sec": seconds, "nanosec": nanoseconds}


def ros_name(kind: type[BaseModel]) -> str:
    """Return the name of the ROS type for a message type or a group of fields."""
    return f"{PACKAGE}/msg/{kind.__name__}"


@cache
def list_fields(kind: type[BaseModel]) -> tuple[OwnField, ...]:
    """Return the ROS fields of a message type or a group of fields, in the order of declaration.

    Images are omitted.
    """
    stamps = find_stamp_fields(kind) if issubclass(kind, Message) else ()
    fields = []
    for name, info in kind.model_fields.items():
        annotation = get_annotation(info)
        if name in stamps:
            fields.append(OwnField(name, "builtin_interfaces/Time", _convert_stamp))
        elif not _holds_images(annotation):
            fields.append(OwnField(name, *_describe(annotation)))
    return tuple(fields)


def make_definitions(kinds: Iterable[type[Message]]) -> dict[str, str]:
    """Return the .msg definitions of message types, by ROS type name.

    The result also contains the definitions of the groups of fields that the messages contain.
    """
    found: dict[str, str] = {}
    waiting: list[type[BaseModel]] = list(kinds)
    while waiting:
        kind = waiting.pop()
        if ros_name(kind) in found:
            continue
        lines = [f"{one.ros_type} {one.name}\n" for one in list_fields(kind)]
        head = HEADER if issubclass(kind, Message) else ""
        # A ROS type must have at least one field.
        found[ros_name(kind)] = head + "".join(lines) or "bool unused\n"
        waiting.extend(_list_groups(kind))
    return found


def convert_fields(value: BaseModel, make: Make) -> dict[str, Any]:
    """Convert the fields of a message or group to ROS values, by field name.

    make: function that makes a ROS message from a type name and fields.
    """
    return {
        one.name: one.convert(getattr(value, one.name), make) for one in list_fields(type(value))
    }


def _list_groups(kind: type[BaseModel]) -> list[type[BaseModel]]:
    """Return the groups of fields that the ROS type of a message or group contains."""
    named = {one.ros_type.partition("[")[0] for one in list_fields(kind)}
    groups: list[type[BaseModel]] = []

    def search(annotation: Any) -> None:
        if isinstance(annotation, type) and issubclass(annotation, BaseModel):
            if f"{PACKAGE}/{annotation.__name__}" in named:
                groups.append(annotation)
            return
        for argument in get_args(annotation):
            search(argument)

    for info in kind.model_fields.values():
        search(info.annotation)
    return groups


def _describe(annotation: Any) -> tuple[str, Callable[[Any, Make], Any]]:
    """Return the ROS type for a Python annotation, and a function that converts values to it."""
    annotation, spec = split_annotation(annotation)
    if spec is not None:
        return _describe_array(spec)
    scalar = _find_scalar(annotation)
    if scalar is not None:
        return scalar, _plain
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return f"{PACKAGE}/{annotation.__name__}", _convert_group
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin in (Union, types.UnionType):
        rest = [argument for argument in arguments if argument is not type(None)]
        if len(rest) == 1 and len(rest) < len(arguments):
            return _describe_sequence(rest[0], "[<=1]", lambda value: (value,))
    if origin is tuple and arguments and arguments[-1] is Ellipsis:
        return _describe_sequence(arguments[0], "[]", tuple)
    if origin is tuple and arguments and all(one == arguments[0] for one in arguments):
        return _describe_sequence(arguments[0], f"[{len(arguments)}]", tuple)
    adapter = TypeAdapter(annotation)
    return "string", lambda value, _: json.dumps(adapter.dump_python(value, mode="json"))


def _describe_sequence(
    item: Any, suffix: str, split: Callable[[Any], tuple[Any, ...]]
) -> tuple[str, Callable[[Any, Make], Any]]:
    """Return the ROS type of a sequence, and a function that converts values to this type.

    item: annotation of an element.
    suffix: array part of the ROS type, such as "[]".
    split: function that returns the elements of a value. The value None is converted to an empty
        sequence.
    """
    item_type, convert = _describe(item)
    if "[" in item_type:  # ROS does not support sequences of sequences.
        adapter = TypeAdapter(item)
        return f"string{suffix}", lambda value, _: [
            json.dumps(adapter.dump_python(one, mode="json"))
            for one in (() if value is None else split(value))
        ]
    dtype = item_type if item_type in ("float64", "int64") else None

    def convert_all(value: Any, make: Make) -> Any:
        values = [convert(one, make) for one in (() if value is None else split(value))]
        if item_type == "bool":
            return np.array(values, dtype=np.bool_)
        return values if dtype is None else np.array(values, dtype=dtype)

    return f"{item_type}{suffix}", convert_all


def _describe_array(spec: ArraySpec) -> tuple[str, Callable[[Any, Make], Any]]:
    lengths = [length for length in spec.shape if isinstance(length, int)]
    fixed = len(lengths) == len(spec.shape)
    suffix = f"[{int(np.prod(lengths))}]" if fixed else "[]"
    return ELEMENTS[spec.dtype] + suffix, lambda value, _: np.ravel(value)


def _find_scalar(annotation: Any) -> str | None:
    if get_origin(annotation) is Literal and all(
        isinstance(one, str) for one in get_args(annotation)
    ):
        return "string"
    if isinstance(annotation, type) and issubclass(annotation, str):
        return "string"
    return {bool: "bool", int: "int64", float: "float64"}.get(annotation)


def _holds_images(annotation: Any) -> bool:
    """Return whether an annotation describes an image, a tuple of images or an optional image."""
    inner, spec = split_annotation(annotation)
    if spec is not None:
        return is_image(spec)
    if get_origin(inner) in (tuple, Union, types.UnionType):
        return any(_holds_images(one) for one in get_args(inner) if one is not Ellipsis)
    return False


def _plain(value: Any, _: Make) -> Any:
    return value.value if isinstance(value, Enum) else value


def _convert_group(value: BaseModel, make: Make) -> Any:
    return make(ros_name(type(value)), **convert_fields(value, make))


def _convert_stamp(value: int, make: Make) -> Any:
    return make("builtin_interfaces/msg/Time", **split_time(value))
