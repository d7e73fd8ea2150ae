"""Bags from before a message changed, read by the code of today.

Every bag holds the JSON Schema of its messages.  Where a type has since only gained (fields with
defaults, further values of a literal, further members of a union), the recorded fields are valid
as they are, and `fits` finds that out by comparing the two schemas.  Any other change needs a line
in `MIGRATIONS`: the type, the fingerprint it had (`flexsheet bag info --json` names it), and a
function from the recorded fields to those of the type that came after.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from messages.base import Message, schema_fingerprint

Fields = dict[str, Any]
Migration = Callable[[Fields], Fields]
Schema = Mapping[str, Any]

MIGRATIONS: dict[tuple[str, str], Migration] = {}

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
    if (message_type.__name__, fingerprint) in MIGRATIONS:
        return MIGRATIONS[message_type.__name__, fingerprint]
    return _as_it_is if fits(recorded_schema, message_type.model_json_schema()) else None


def fits(recorded: Schema, today: Schema) -> bool:
    """Whether everything that the recorded schema allows is valid by today's."""
    try:
        return _fits(recorded, today, recorded.get("$defs", {}), today.get("$defs", {}))
    except (KeyError, TypeError, AttributeError):
        return False  # damaged: no JSON Schema at all


def _as_it_is(fields: Fields) -> Fields:
    return fields


def _fits(old: Any, new: Any, old_parts: Schema, new_parts: Schema) -> bool:
    old, new = _resolved(old, old_parts), _resolved(new, new_parts)
    if not (isinstance(old, Mapping) and isinstance(new, Mapping)):
        return bool(old == new)

    def within(one: Any, other: Any) -> bool:
        return _fits(one, other, old_parts, new_parts)

    was, now = _options(old), _options(new)
    if was or now:
        return all(any(within(one, other) for other in now or [new]) for one in was or [old])
    old_fields, new_fields = old.get("properties", {}), new.get("properties", {})
    old_items, new_items = old.get("prefixItems", []), new.get("prefixItems", [])
    return (
        _rest(old) == _rest(new)
        and _values(old) <= _values(new)
        and set(new.get("required", ())) <= old_fields.keys()
        and old_fields.keys() <= new_fields.keys()
        and all(within(field, new_fields[name]) for name, field in old_fields.items())
        and within(old.get("items"), new.get("items"))
        and len(old_items) == len(new_items)
        and all(map(within, old_items, new_items))
    )


def _resolved(schema: Any, parts: Schema) -> Any:
    while isinstance(schema, Mapping) and "$ref" in schema:
        schema = parts[str(schema["$ref"]).rpartition("/")[2]]
    return schema


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
