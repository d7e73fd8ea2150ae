"""Reads bags that were written before a message changed.

Every bag holds the JSON Schema of its messages.  Where a type has since only gained (fields with
defaults, further values of a literal, further members of a union), the recorded fields are valid
as they are, and `fits` finds that out by comparing the two schemas.

A renamed field or literal value needs a line in `RENAMED_FIELDS` or `RENAMED_VALUES`, a removed
field one in `REMOVED_FIELDS`.  These hold for every recorded version of the type.  Any other change
needs a line in `MIGRATIONS`: the type, the fingerprint it had (`flexsheet bag info --json` names
it), and a function from the recorded fields to those of the type that came after.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from typing import Any, get_args

from pydantic import BaseModel

from flexsheet.messages.base import Message, schema_fingerprint

Fields = dict[str, Any]
Migration = Callable[[Fields], Fields]
Schema = Mapping[str, Any]


RENAMED_TOPICS: dict[str, str] = {"moment": "bookmark"}
"""Recorded topic names and those of today."""

RENAMED_TYPES: dict[str, str] = {"Moment": "Bookmark"}
"""Recorded names of message types and those of today."""

RENAMED_FIELDS: dict[str, dict[str, str]] = {
    "Fingertip": {
        "ahead_world_m": "predicted_path_world_m",
        "ahead_step_s": "prediction_step_s",
    },
    "Frame": {"lost_share": "occluded_fraction"},
    "Methods": {"mark": "marker"},
    "SheetTarget": {"retreat_m": "normal_offset_m"},
    "Status": {"taken": "execution_log"},
    "SoftBody": {"lead_s": "prediction_horizon_s"},
    "TwinEye": {"proper": "expected"},
}
"""By model, messages and their parts alike: recorded field names and those of today."""

RENAMED_VALUES: dict[tuple[str, str], dict[str, str]] = {
    ("Fingertip", "reason"): {
        "no_mark": "no_marker",
        "mark_in_one_view": "marker_in_one_view",
        "two_marks": "two_markers",
    },
    ("Display", "pattern"): {"places_x": "coordinate_ramp_x", "places_y": "coordinate_ramp_y"},
    ("NodeProcess", "state"): {"away": "exited"},
    ("Methods", "sheet_shape"): {"dents": "reduced_order", "flat": "four_triangles"},
    ("Methods", "triangulation"): {"midpoint": "dlt", "optimal": "dlt"},
    ("Methods", "tracking"): {
        "hand": "adaptive",
        "singer_tremor": "adaptive",
        "constant_velocity": "adaptive",
        "constant_acceleration": "adaptive",
        "exponential": "one_euro",
    },
    ("Methods", "sheet_force"): {"cubic": "scaled"},
}
"""By model and today's field name: recorded literal values and those of today."""

SHEET_REASONS = {
    "": "ok",
    "fingertip: numbers that are not finite": "fingertip_not_finite",
    "finger inside the object, on no side of it": "ambiguous_side",
    "finger through the object": "through_object",
    "finger past the object's edge": "past_object_edge",
    "finger past the sheet's usable width": "past_sheet_width",
    "finger past the sheet's usable height": "past_sheet_height",
    "finger's place or velocity is no hand's": "implausible_input",
    "finger beyond the tilt that the arms present": "beyond_tilt",
    "sheet turned too far about its normal; lift the finger": "beyond_spin",
    "hollow place: the flat sheet rests on its rim": "concave_contact",
}
"""Recorded texts of `SheetTarget.reason` and today's literals."""


def _sheet_reason(recorded: str) -> str:
    if recorded in SHEET_REASONS:
        return SHEET_REASONS[recorded]
    if recorded.startswith("fingertip: "):
        return "fingertip_invalid"
    if recorded.startswith("fingertip is -"):
        return "fingertip_in_future"
    return "fingertip_too_old"


TEXTS_TO_LITERALS: dict[tuple[str, str], Callable[[str], str]] = {
    ("SheetTarget", "reason"): _sheet_reason,
}
"""By model and today's field name: makes the literal of a field that was recorded as text."""

REMOVED_FIELDS: dict[str, frozenset[str]] = {"Methods": frozenset({"kinematics"})}
"""By model: recorded fields that are dropped, since nothing reads them any more."""

_STROKE_LABEL = re.compile(r"stroke (\d+(?:\.\d+)?) s")


def _add_stroke_duration(fields: Fields) -> Fields:
    """Add a stroke's moving time, which recorded messages hold in the path's label only."""
    found = _STROKE_LABEL.fullmatch(fields["path_label"])
    return {**fields, "path_stroke_s": None if found is None else float(found[1])}


MIGRATIONS: dict[tuple[str, str], Migration] = {
    ("TwinFinger", "c1881b3029f02367"): _add_stroke_duration,
}

_IGNORED = frozenset({"title", "description", "default", "discriminator", "$defs"})
_COMPARED = frozenset({"$ref", "properties", "required", "enum", "const", "anyOf", "oneOf",
                       "items", "prefixItems"})  # fmt: skip


def migration_for(
    message_type: type[Message], fingerprint: str, recorded_schema: Schema
) -> Migration | None:
    """Return the function from recorded fields to those of today's type; None without one.

    fingerprint: hexadecimal, of the type as it was recorded.
    recorded_schema: the bag's own.
    """
    if fingerprint == schema_fingerprint(message_type).hex():
        return _unchanged
    if (message_type.__name__, fingerprint) in MIGRATIONS:
        return MIGRATIONS[message_type.__name__, fingerprint]
    today = message_type.model_json_schema()
    renamed_schema = _rename_in_schema(message_type, recorded_schema)
    if not fits(_literal_schema(message_type.__name__, renamed_schema, today), today):
        return None
    return lambda fields: _rename_in_fields(message_type, fields)


def _rename_in_schema(message_type: type[Message], recorded: Schema) -> Schema:
    """Return the recorded schema with the names of today."""
    parts = recorded.get("$defs", {})
    if not isinstance(parts, Mapping):
        return recorded
    renamed = {name: _rename_part(name, part) for name, part in parts.items()}
    return {**_rename_part(message_type.__name__, recorded), "$defs": renamed}


def _literal_schema(model: str, recorded: Schema, today: Schema) -> Schema:
    """Return a recorded schema whose text fields are the literals that they are read as."""
    properties = recorded.get("properties")
    if not isinstance(properties, Mapping):
        return recorded
    literals = {
        name: today["properties"][name]
        for owner, name in TEXTS_TO_LITERALS
        if owner == model and _is_text(properties.get(name))
    }
    return {**recorded, "properties": {**properties, **literals}}


def _is_text(schema: Any) -> bool:
    return isinstance(schema, Mapping) and schema.get("type") == "string" and "enum" not in schema


def _rename_part(model: str, schema: Any) -> Any:
    """Return one model's schema with its renamed properties and literal values."""
    if not isinstance(schema, Mapping) or not isinstance(schema.get("properties"), Mapping):
        return schema
    names, removed = RENAMED_FIELDS.get(model, {}), REMOVED_FIELDS.get(model, frozenset())
    properties = {
        names.get(name, name): _rename_values(
            field, RENAMED_VALUES.get((model, names.get(name, name)), {})
        )
        for name, field in schema["properties"].items()
        if name not in removed
    }
    required = [names.get(name, name) for name in schema.get("required", ()) if name not in removed]
    return {**schema, "properties": properties, "required": required}


def _rename_values(schema: Any, values: Mapping[str, str]) -> Any:
    """Return a field's schema with the literal values of today, in it and in its options."""
    if not values or not isinstance(schema, Mapping):
        return schema
    renamed = dict(schema)
    if "const" in schema:
        renamed["const"] = values.get(schema["const"], schema["const"])
    if "enum" in schema:
        renamed["enum"] = [values.get(value, value) for value in schema["enum"]]
    if "anyOf" in schema:
        renamed["anyOf"] = [_rename_values(option, values) for option in schema["anyOf"]]
    return renamed


def _rename_in_fields(model: type[BaseModel], fields: Fields) -> Fields:
    """Return the recorded fields of a model, and of the models within it, with today's names."""
    names = RENAMED_FIELDS.get(model.__name__, {})
    renamed: Fields = {}
    for name, value in fields.items():
        if name in REMOVED_FIELDS.get(model.__name__, frozenset()):
            continue
        key = names.get(name, name)
        values = RENAMED_VALUES.get((model.__name__, key), {})
        if isinstance(value, str):
            as_literal = TEXTS_TO_LITERALS.get((model.__name__, key))
            known = get_args(model.model_fields[key].annotation) if as_literal else ()
            renamed[key] = (
                as_literal(value) if as_literal and value not in known else values.get(value, value)
            )
        elif isinstance(value, dict | list) and key in model.model_fields:
            renamed[key] = _rename_in_parts(_model_in(model.model_fields[key].annotation), value)
        else:
            renamed[key] = value
    return renamed


def _rename_in_parts(model: type[BaseModel] | None, value: Any) -> Any:
    """Return the recorded fields of a part, or of each part of a list, with today's names."""
    if model is not None and isinstance(value, dict):
        return _rename_in_fields(model, value)
    if model is not None and isinstance(value, list):
        return [_rename_in_parts(model, part) for part in value]
    return value


def _model_in(annotation: Any) -> type[BaseModel] | None:
    """Return the one model that an annotation allows; None for none or several."""
    options = [annotation, *get_args(annotation)]
    models = [one for one in options if isinstance(one, type) and issubclass(one, BaseModel)]
    return models[0] if len(models) == 1 else None


def fits(recorded: Schema, today: Schema) -> bool:
    """Return whether everything that the recorded schema allows is valid by today's."""
    try:
        return _Comparison(recorded.get("$defs", {}), today.get("$defs", {})).fits(recorded, today)
    except (KeyError, TypeError, AttributeError, RecursionError):
        return False  # damaged: no JSON Schema at all, or one without an end


def _unchanged(fields: Fields) -> Fields:
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
