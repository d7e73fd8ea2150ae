"""Convert messages from bags that were recorded before a message type changed.

Every bag contains the JSON Schemas of its messages. Recorded fields remain valid if a type has only
gained fields with defaults, literal values, or members of a union. `is_compatible` checks this by
comparing the two schemas.

A renamed field needs a line in `RENAMED_FIELDS`. A renamed literal value needs a line in
`RENAMED_VALUES`, and a removed field needs a line in `REMOVED_FIELDS`. These lines apply to every
recorded version of the type. Any other change needs a line in `MIGRATIONS`. The line contains the
type, the former fingerprint (`flexsheet bag info --json`), and a function that converts the
recorded fields to the next version.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from typing import Any, get_args

from pydantic import BaseModel

from flexsheet.messages.base import Message, compute_fingerprint

Fields = dict[str, Any]
Migration = Callable[[Fields], Fields]
Schema = Mapping[str, Any]


RENAMED_TOPICS: dict[str, str] = {"moment": "bookmark"}
"""The topics that have been renamed: a mapping from former names to current names."""

RENAMED_TYPES: dict[str, str] = {"Moment": "Bookmark"}
"""The message types that have been renamed: a mapping from former names to current names."""

RENAMED_FIELDS: dict[str, dict[str, str]] = {
    "Fingertip": {
        "ahead_world_m": "predicted_path_world_m",
        "ahead_step_s": "prediction_step_s",
    },
    "ArmBase": {
        "largest_change_m": "max_change_m",
        "largest_change_rad": "max_change_rad",
        "places": "poses",
    },
    "ArmPoseFit": {"turn_rad": "rotation_rad"},
    "Frame": {"lost_share": "occluded_fraction"},
    "MarkerCalibration": {"residual_worst_m": "max_residual_m"},
    "Methods": {"mark": "marker"},
    "SheetCalibration": {
        "deepest_m": "max_depth_m",
        "largest_stretch_ratio": "max_stretch_ratio",
        "least_stretch_ratio": "min_stretch_ratio",
        "mooney_share": "mooney_ratio",
        "residual_worst_ratio": "max_residual_ratio",
    },
    "SheetTarget": {"retreat_m": "normal_offset_m"},
    "Status": {"taken": "execution_log"},
    "SoftBody": {"lead_s": "prediction_horizon_s"},
    "TwinEye": {"proper": "expected"},
}
"""The message fields that have been renamed.

For each message type, a table maps former names to current names.
"""

RENAMED_VALUES: dict[tuple[str, str], dict[str, str]] = {
    ("Fingertip", "reason"): {
        "no_mark": "no_marker",
        "mark_in_one_view": "marker_in_one_view",
        "two_marks": "two_markers",
    },
    ("Display", "pattern"): {"places_x": "coordinate_ramp_x", "places_y": "coordinate_ramp_y"},
    ("NodeProcess", "state"): {"away": "exited"},
    ("Methods", "sheet_shape"): {"dents": "reduced_order", "flat": "four_triangles"},
    ("Methods", "marker"): {"weighted_centroid": "subpixel_fit"},
    ("Methods", "tracking"): {
        "hand": "adaptive",
        "singer_tremor": "adaptive",
        "constant_velocity": "adaptive",
        "constant_acceleration": "adaptive",
        "exponential": "one_euro",
    },
    ("Methods", "sheet_force"): {"cubic": "scaled", "linear": "scaled"},
}
"""The literal values of message fields that have been renamed.

A key consists of the message type and the current name of the field. The table for this key maps
former values to current values.
"""

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
"""The current value of `SheetTarget.reason` for each text that old bags contain instead."""


def _convert_sheet_reason(recorded: str) -> str:
    if recorded in SHEET_REASONS:
        return SHEET_REASONS[recorded]
    if recorded.startswith("fingertip: "):
        return "fingertip_invalid"
    if recorded.startswith("fingertip is -"):
        return "fingertip_in_future"
    return "fingertip_too_old"


TEXTS_TO_LITERALS: dict[tuple[str, str], Callable[[str], str]] = {
    ("SheetTarget", "reason"): _convert_sheet_reason,
}
"""The functions that convert a text in an old bag to a current literal value.

The keys are the message type and the name of the field.
"""

REMOVED_FIELDS: dict[str, frozenset[str]] = {
    "FingerTruth": frozenset({"hand_damping_ns_per_m"}),
    "Methods": frozenset({"kinematics", "triangulation"}),
}
"""For each message type, the names of the fields that have been removed."""

_STROKE_LABEL = re.compile(r"stroke (\d+(?:\.\d+)?) s")


def _add_stroke_duration(fields: Fields) -> Fields:
    """Add the field `path_stroke_s`, which old messages contain only as text in `path_label`."""
    found = _STROKE_LABEL.fullmatch(fields["path_label"])
    return {**fields, "path_stroke_s": None if found is None else float(found[1])}


MIGRATIONS: dict[tuple[str, str], Migration] = {
    ("TwinFinger", "c1881b3029f02367"): _add_stroke_duration,
}

_IGNORED = frozenset({"title", "description", "default", "discriminator", "$defs"})
_COMPARED = frozenset({"$ref", "properties", "required", "enum", "const", "anyOf", "oneOf",
                       "items", "prefixItems"})  # fmt: skip


def find_migration(
    message_type: type[Message], fingerprint: str, recorded_schema: Schema
) -> Migration | None:
    """Return a function that converts recorded fields to the current message type.

    Return None if the recorded fields cannot be converted.

    fingerprint: hexadecimal fingerprint of the recorded type.
    recorded_schema: JSON Schema of the recorded type.
    """
    if fingerprint == compute_fingerprint(message_type).hex():
        return _unchanged
    if (message_type.__name__, fingerprint) in MIGRATIONS:
        return MIGRATIONS[message_type.__name__, fingerprint]
    current = message_type.model_json_schema()
    renamed_schema = _rename_in_schema(message_type, recorded_schema)
    if not is_compatible(_literal_schema(message_type.__name__, renamed_schema, current), current):
        return None
    return lambda fields: rename_fields(message_type, fields)


def _rename_in_schema(message_type: type[Message], recorded: Schema) -> Schema:
    """Return a recorded JSON Schema with former names replaced by current names."""
    parts = recorded.get("$defs", {})
    if not isinstance(parts, Mapping):
        return recorded
    renamed = {name: _rename_part(name, part) for name, part in parts.items()}
    return {**_rename_part(message_type.__name__, recorded), "$defs": renamed}


def _literal_schema(model: str, recorded: Schema, current: Schema) -> Schema:
    """Return a recorded JSON Schema in which some fields have their current literal type.

    These are the fields in TEXTS_TO_LITERALS, which contained text when old bags were recorded.
    """
    properties = recorded.get("properties")
    if not isinstance(properties, Mapping):
        return recorded
    literals = {
        name: current["properties"][name]
        for owner, name in TEXTS_TO_LITERALS
        if owner == model and _is_text(properties.get(name))
    }
    return {**recorded, "properties": {**properties, **literals}}


def _is_text(schema: Any) -> bool:
    return isinstance(schema, Mapping) and schema.get("type") == "string" and "enum" not in schema


def _rename_part(model: str, schema: Any) -> Any:
    """Return the schema of one model with current field names and literal values."""
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
    """Replace former names of allowed values in the JSON schema of a field.

    The values are in the keys `const` and `enum`. The options of a union (`anyOf`) are also
    searched.

    values: new names, by former name.
    """
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


def rename_fields(model: type[BaseModel], fields: Fields) -> Fields:
    """Rename the recorded fields of a model and of its nested models to their current names.

    The function also converts calibration files, because they contain the fields of a model.
    """
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
    if model is not None and isinstance(value, dict):
        return rename_fields(model, value)
    if model is not None and isinstance(value, list):
        return [_rename_in_parts(model, part) for part in value]
    return value


def _model_in(annotation: Any) -> type[BaseModel] | None:
    """Return the pydantic model class that a type annotation contains.

    Return None if the annotation contains no model class, or more than one.
    """
    options = [annotation, *get_args(annotation)]
    models = [one for one in options if isinstance(one, type) and issubclass(one, BaseModel)]
    return models[0] if len(models) == 1 else None


def is_compatible(recorded: Schema, current: Schema) -> bool:
    """Return whether all values that a recorded schema allows are valid in the current schema."""
    try:
        return _Comparison(recorded.get("$defs", {}), current.get("$defs", {})).is_compatible(
            recorded, current
        )
    except (KeyError, TypeError, AttributeError, RecursionError):
        return False  # The schema is not a valid JSON Schema, or contains itself.


def _unchanged(fields: Fields) -> Fields:
    return fields


class _Comparison:
    def __init__(self, old_parts: Schema, new_parts: Schema) -> None:
        self._old_parts, self._new_parts = old_parts, new_parts
        self._known: dict[tuple[int, int], bool] = {}

    def is_compatible(self, old: Any, new: Any) -> bool:
        old, new = _resolve(old, self._old_parts), _resolve(new, self._new_parts)
        if not (isinstance(old, Mapping) and isinstance(new, Mapping)):
            return bool(old == new)
        pair = id(old), id(new)
        if pair not in self._known:
            # A schema that contains itself never ends, and no message has such a schema.
            self._known[pair] = False
            self._known[pair] = self._fit(old, new)
        return self._known[pair]

    def _fit(self, old: Schema, new: Schema) -> bool:
        was, now = _options(old), _options(new)
        if was or now:
            return all(
                any(self.is_compatible(one, other) for other in now or [new])
                for one in was or [old]
            )
        old_fields, new_fields = old.get("properties", {}), new.get("properties", {})
        old_items, new_items = old.get("prefixItems", []), new.get("prefixItems", [])
        return (
            _other_keywords(old) == _other_keywords(new)
            and _allowed_values(old) <= _allowed_values(new)
            and set(new.get("required", ())) <= old_fields.keys()
            and old_fields.keys() <= new_fields.keys()
            and all(
                self.is_compatible(field, new_fields[name]) for name, field in old_fields.items()
            )
            and self.is_compatible(old.get("items"), new.get("items"))
            and len(old_items) == len(new_items)
            and all(map(self.is_compatible, old_items, new_items))
        )


def _resolve(schema: Any, parts: Schema) -> Any:
    """Replace a reference in a JSON Schema by the schema that it names.

    Raises TypeError for a cycle of references.
    """
    for _ in range(len(parts) + 1):
        if not (isinstance(schema, Mapping) and "$ref" in schema):
            return schema
        schema = parts[str(schema["$ref"]).rpartition("/")[2]]
    raise TypeError("the JSON Schema contains a cycle of references")


def _options(schema: Schema) -> list[Any]:
    return [*schema.get("anyOf", ()), *schema.get("oneOf", ())]


def _allowed_values(schema: Schema) -> set[Any]:
    """Return the literal values that a schema allows, or {None} if it does not restrict them."""
    if "const" in schema:
        return {schema["const"]}
    return set(schema["enum"]) if "enum" in schema else {None}


def _other_keywords(schema: Schema) -> dict[str, Any]:
    return {
        key: value for key, value in schema.items() if key not in _IGNORED and key not in _COMPARED
    }
