"""Convert messages to JSON that viewers can list and plot.

Foxglove and Lichtblick reject nested arrays and fields that have no type. An array therefore
becomes one list, row by row. A field is omitted if its value is None.
"""

from __future__ import annotations

import types
from enum import Enum
from functools import cache
from typing import Any, Literal, Union, get_args, get_origin

import numpy as np
from pydantic import BaseModel

from flexsheet.messages.field_types import get_annotation, split_annotation

MAX_ARRAY = 64
"""The maximum number of elements of an array in a JSON message. Larger arrays are omitted."""

JsonSchema = dict[str, Any]
_NUMBER: JsonSchema = {"type": "number"}
_TEXT: JsonSchema = {"type": "string"}
_OMITTED = object()


@cache
def make_schema(kind: type[BaseModel]) -> JsonSchema:
    """Return the JSON Schema that describes the result of `to_json` for a message type."""
    fields = {name: _describe(get_annotation(info)) for name, info in kind.model_fields.items()}
    return {"type": "object", "title": kind.__name__, "properties": fields}


def to_json(value: Any) -> Any:
    """Convert a message to JSON types, and omit arrays with more than `MAX_ARRAY` elements."""
    found = _convert(value)
    return None if found is _OMITTED else found


def _convert(value: Any) -> Any:
    if isinstance(value, BaseModel):
        named = ((name, _convert(getattr(value, name))) for name in type(value).model_fields)
        return {name: item for name, item in named if item is not _OMITTED}
    if value is None:
        return _OMITTED
    if isinstance(value, np.ndarray):
        return value.ravel().tolist() if value.size <= MAX_ARRAY else _OMITTED
    if isinstance(value, tuple | list):
        found: list[Any] = []
        for item in map(_convert, value):
            if isinstance(item, list):
                found += item
            elif item is not _OMITTED:
                found.append(item)
        return found
    if isinstance(value, dict):
        pairs = ((str(key), _convert(item)) for key, item in value.items())
        return {key: item for key, item in pairs if item is not _OMITTED}
    return value.value if isinstance(value, Enum) else value


def _describe(annotation: Any) -> JsonSchema:
    annotation, spec = split_annotation(annotation)
    if spec is not None:
        return {"type": "array", "items": _NUMBER}
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin in (Union, types.UnionType):
        return _merge([_describe(one) for one in arguments if one is not type(None)])
    if origin is Literal:
        return _describe(type(arguments[0]))
    if origin in (tuple, list):
        item = _merge([_describe(one) for one in arguments if one is not Ellipsis])
        return item if item["type"] == "array" else {"type": "array", "items": item}
    if origin is dict:
        return {"type": "object", "properties": {}}
    return _describe_type(annotation) if isinstance(annotation, type) else _TEXT


def _describe_type(kind: type) -> JsonSchema:
    if issubclass(kind, BaseModel):
        return make_schema(kind)
    if issubclass(kind, bool):
        return {"type": "boolean"}
    return _NUMBER if issubclass(kind, int | float) else _TEXT


def _merge(schemas: list[JsonSchema]) -> JsonSchema:
    """Return one JSON Schema for values of several types.

    If all types have the same schema, this schema is returned. If all types are objects, the result
    has the fields of all objects. Otherwise, the result is the schema of an array if one of the
    types is an array, and the schema of a text if no type is an array.
    """
    if not schemas:
        return _TEXT
    if all(one == schemas[0] for one in schemas):
        return schemas[0]
    if all(one["type"] == "object" for one in schemas):
        fields: JsonSchema = {}
        for one in schemas:
            fields |= one["properties"]
        return {"type": "object", "properties": fields}
    kinds = {one["type"] for one in schemas}
    return next(one for one in schemas if one["type"] == "array") if "array" in kinds else _TEXT
