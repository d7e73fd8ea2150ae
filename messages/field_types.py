"""Describe the types of message fields and parameters for documentation and commands."""

from __future__ import annotations

import re
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import numpy as np
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from flexsheet.messages.arrays import ArraySpec


def describe_field_type(field: FieldInfo) -> str:
    """Return the type of a field as Markdown, with a link for each nested model."""
    return _type(get_annotation(field))


def describe_field(field: FieldInfo) -> dict[str, str]:
    """Return the type (as plain text), the default value and the description of a field."""
    default = "empty" if field.default_factory is not None else str(field.default)
    # Replace Markdown links by their text.
    kind = re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", describe_field_type(field))
    return {
        "type": re.sub(r"[`\\]", "", kind),
        "default": "required" if field.is_required() else default,
        "description": field.description or "",
    }


def get_annotation(field: FieldInfo) -> Any:
    """Return the type of a field, with its metadata, as a `typing.Annotated`."""
    annotation: Any = field.annotation
    for mark in field.metadata:
        annotation = Annotated[annotation, mark]
    return annotation


def split_annotation(annotation: Any) -> tuple[Any, ArraySpec | None]:
    """Split an annotation into the bare type and its array specification.

    The array specification is None if the annotation contains none.
    """
    spec = None
    while get_origin(annotation) is Annotated:
        annotation, *marks = get_args(annotation)
        spec = next((mark for mark in marks if isinstance(mark, ArraySpec)), spec)
    return annotation, spec


def is_image(spec: ArraySpec) -> bool:
    """Return whether an array specification describes an image.

    An image is an array in which more than one axis has a variable length.
    """
    return sum(isinstance(length, str) for length in spec.shape) > 1


def _type(annotation: Any) -> str:
    annotation, spec = split_annotation(annotation)
    if spec is not None:
        return f"{np.dtype(spec.dtype).name} {spec.describe_shape()}"
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin is Literal:
        return " \\| ".join(f"`{value}`" for value in arguments)
    if origin in (Union, UnionType):
        return " or ".join(_type(argument) for argument in arguments)
    if origin is tuple and arguments[-1] is Ellipsis:
        return f"any number of {_type(arguments[0])}"
    if origin is tuple:
        return f"{len(arguments)} of {_type(arguments[0])}"
    if annotation is NoneType:
        return "none"
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return f"[{annotation.__name__}](#{annotation.__name__.lower()})"
    return getattr(annotation, "__name__", str(annotation))
