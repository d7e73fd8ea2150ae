"""Bags from before a message changed, read by the code of today.

Every bag holds the JSON Schema of its messages.  Where a type has since only gained (fields with
defaults, further values of a literal, further members of a union), the recorded fields are valid
as they are, and `fits` finds that out by comparing the two schemas.  Any other change needs a line
in `MIGRATIONS`: the type, the fingerprint it had (`flexsheet bag info --json` names it), and a
function from the recorded fields to those of the type that came after.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from functools import partial
from typing import Any

from messages.base import Message, schema_fingerprint

Fields = dict[str, Any]
Migration = Callable[[Fields], Fields]
Schema = Mapping[str, Any]


def _one_way_of_stepping(scene: Fields) -> Fields:
    """The arms' `closed_form` is no longer a choice."""
    methods = scene.get("methods", {})
    if methods.get("kinematics") != "closed_form":
        return scene
    return scene | {"methods": methods | {"kinematics": "closed_form_continuous"}}


MIGRATIONS: dict[tuple[str, str], Migration] = {
    ("Scene", "d7307561a5180666"): _one_way_of_stepping,
}

RENAMED_FIELDS: dict[str, Mapping[str, str]] = {
    "Frame": {"lost_share": "occluded_fraction"},
    "SoftBody": {"lead_s": "prediction_horizon_s"},
}
"""Old to new names of fields, by message type."""

RENAMED_VALUES: dict[tuple[str, ...], Mapping[str, str]] = {
    ("Display", "pattern"): {"places_x": "coordinate_ramp_x", "places_y": "coordinate_ramp_y"},
    ("Scene", "methods", "sheet_shape"): {"dents": "reduced_order", "flat": "four_triangles"},
}
"""Old to new values of a literal field, by message type and the path to the field."""

_IGNORED = frozenset({"title", "description", "default", "discriminator", "$defs"})
_COMPARED = frozenset({"$ref", "properties", "required", "enum", "const", "anyOf", "oneOf",
                       "items", "prefixItems"})  # fmt: skip


def migration_for(
    message_type: type[Message], fingerprint: str, recorded_schema: Schema
) -> Migration | None:
    """From recorded fields to those of today's type; None where nobody knows how.

    fingerprint: hexadecimal, of the type as it was recorded; recorded_schema: the bag's own.
    """
    if fingerprint == schema_fingerprint(message_type).hex():
        return _as_it_is
    name = message_type.__name__
    if (name, fingerprint) in MIGRATIONS:
        migration = MIGRATIONS[name, fingerprint]
        return lambda fields: rename(name, migration(fields))
    if fits(recorded_schema, message_type.model_json_schema()):
        return _as_it_is
    try:
        renamed_schema = _rename_in_schema(name, recorded_schema)
    except (KeyError, TypeError, AttributeError):
        return None
    return partial(rename, name) if fits(renamed_schema, message_type.model_json_schema()) else None


def rename(type_name: str, fields: Fields) -> Fields:
    """Return recorded fields with the names and values of today."""
    names = RENAMED_FIELDS.get(type_name, {})
    result = {names.get(name, name): value for name, value in fields.items()}
    for (holder, *path), values in RENAMED_VALUES.items():
        if holder == type_name:
            result = _rename_value(result, path, values)
    return result


def _rename_value(fields: Fields, path: Sequence[str], values: Mapping[str, str]) -> Fields:
    if not isinstance(fields, dict) or path[0] not in fields:
        return fields
    value: Any = fields[path[0]]
    if len(path) > 1:
        value = _rename_value(value, path[1:], values)
    elif isinstance(value, str):
        value = values.get(value, value)
    return fields | {path[0]: value}


def _rename_in_schema(type_name: str, schema: Schema) -> Schema:
    """Return a recorded schema with the names and values of today."""
    result = deepcopy(dict(schema))
    names = RENAMED_FIELDS.get(type_name, {})
    properties = result["properties"]
    result["properties"] = {names.get(name, name): one for name, one in properties.items()}
    result["required"] = [names.get(name, name) for name in result.get("required", [])]
    for (holder, *path), values in RENAMED_VALUES.items():
        if holder == type_name:
            part: Any = result
            for name in path:
                part = _resolved(part, result.get("$defs", {}))["properties"][name]
            for option in (part, *_options(part)):
                if "enum" in option:
                    option["enum"] = [values.get(one, one) for one in option["enum"]]
    return result


def fits(recorded: Schema, today: Schema) -> bool:
    """Whether everything that the recorded schema allows is valid by today's."""
    try:
        return _Comparison(recorded.get("$defs", {}), today.get("$defs", {})).fits(recorded, today)
    except (KeyError, TypeError, AttributeError, RecursionError):
        return False  # damaged: no JSON Schema at all, or one without an end


def _as_it_is(fields: Fields) -> Fields:
    return fields


class _Comparison:
    """Of two schemas with their parts; each pair is looked at once, however often it is named."""

    def __init__(self, old_parts: Schema, new_parts: Schema) -> None:
        self._old_parts, self._new_parts = old_parts, new_parts
        self._known: dict[tuple[int, int], bool] = {}

    def fits(self, old: Any, new: Any) -> bool:
        old, new = _resolved(old, self._old_parts), _resolved(new, self._new_parts)
        if not (isinstance(old, Mapping) and isinstance(new, Mapping)):
            return bool(old == new)
        pair = id(old), id(new)
        if pair not in self._known:
            # What is met again within itself has no end, and is no message's.
            self._known[pair] = False
            self._known[pair] = self._fit(old, new)
        return self._known[pair]

    def _fit(self, old: Schema, new: Schema) -> bool:
        was, now = _options(old), _options(new)
        if was or now:
            return all(any(self.fits(one, other) for other in now or [new]) for one in was or [old])
        old_fields, new_fields = old.get("properties", {}), new.get("properties", {})
        old_items, new_items = old.get("prefixItems", []), new.get("prefixItems", [])
        return (
            _rest(old) == _rest(new)
            and _values(old) <= _values(new)
            and set(new.get("required", ())) <= old_fields.keys()
            and old_fields.keys() <= new_fields.keys()
            and all(self.fits(field, new_fields[name]) for name, field in old_fields.items())
            and self.fits(old.get("items"), new.get("items"))
            and len(old_items) == len(new_items)
            and all(map(self.fits, old_items, new_items))
        )


def _resolved(schema: Any, parts: Schema) -> Any:
    """What a chain of references leads to; TypeError for one that leads to itself."""
    for _ in range(len(parts) + 1):
        if not (isinstance(schema, Mapping) and "$ref" in schema):
            return schema
        schema = parts[str(schema["$ref"]).rpartition("/")[2]]
    raise TypeError("a reference that leads to itself")


def _options(schema: Schema) -> list[Any]:
    return [*schema.get("anyOf", ()), *schema.get("oneOf", ())]


def _values(schema: Schema) -> set[Any]:
    """The literal values that are allowed; {None} where a schema restricts nothing."""
    if "const" in schema:
        return {schema["const"]}
    return set(schema["enum"]) if "enum" in schema else {None}


def _rest(schema: Schema) -> dict[str, Any]:
    return {
        key: value for key, value in schema.items() if key not in _IGNORED and key not in _COMPARED
    }
