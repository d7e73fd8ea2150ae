"""Describe the types of message fields and parameters for documentation and commands."""

from __future__ import annotations

import re
from collections.abc import Iterator
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import numpy as np
from annotated_types import Ge, Gt, Le, Lt
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from flexsheet.messages.arrays import ArraySpec


def describe_field_type(field: FieldInfo) -> str:
    """Return the type of a field as Markdown, with a link for each nested model."""
    return _type(get_annotation(field))


def describe_field(field: FieldInfo) -> dict[str, str]:
    """Return the type (as plain text), the default value and the description of a field."""
    default = "empty" if field.default_factory is not None else str(field.default)
    return {
        "type": strip_markdown(describe_field_type(field)),
        "default": "required" if field.is_required() else default,
        "description": field.description or "",
    }


def strip_markdown(text: str) -> str:
    """Remove the code marks (backticks) from a Markdown text, and replace each link by its text."""
    return re.sub(r"[`\\]", "", re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", text))


def describe_bounds(field: FieldInfo) -> list[str]:
    """Return the bounds of a field's values as text, for example `> 0`."""
    return [note for extra in _constraints(field) if (note := _constraint(extra))]


def _constraints(field: FieldInfo) -> Iterator[Any]:
    yield from field.metadata
    for argument in get_args(field.annotation):
        if get_origin(argument) is Annotated:
            for extra in get_args(argument)[1:]:
                yield from getattr(extra, "metadata", ())


def _constraint(extra: Any) -> str:
    match extra:
        case Gt(gt=bound):
            return f"> {bound}"
        case Ge(ge=bound):
            return f"≥ {bound}"
        case Lt(lt=bound):
            return f"< {bound}"
        case Le(le=bound):
            return f"≤ {bound}"
        case _:
            return ""


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
