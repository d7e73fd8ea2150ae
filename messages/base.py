"""What every message is, and the header that travels with it."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from functools import cache
from typing import Annotated

from pydantic import BaseModel, ConfigDict


@dataclass(frozen=True, slots=True)
class StampMark:
    """Marks a field as an instant on the clock of the header's stamps."""


Stamp = Annotated[int, StampMark()]
"""An instant in ns on the clock that the header names; 0: none.

A reader whose clock differs gets such fields moved onto its own; a duration is a plain `int`.
"""


class Message(BaseModel):
    """A typed, immutable message.

    Subclasses declare fields; `flexsheet.messages.arrays` has the array types.

    Numbers are SI and radians; a field whose unit or frame a reader could doubt carries it in its
    name (`age_s`, `world_from_sheet`).
    """

    model_config = ConfigDict(extra="forbid", frozen=True, arbitrary_types_allowed=True)


class MessagePart(BaseModel):
    """A named group of a message's fields."""

    model_config = ConfigDict(extra="forbid", frozen=True, arbitrary_types_allowed=True)


@dataclass(frozen=True, slots=True)
class Header:
    """The envelope of one message.

    sequence: counts up by one per message of one writer, from 1; gaps are losses.
    source_ns: when the thing that the message speaks of happened (for all that derives from a
        picture: the middle of its exposure), on the clock `clock_id`.
    publish_ns: when the message was handed to the socket, same clock.
    clock_id: names the clock of the two stamps; stamps of different clocks must not be subtracted.
    writer: the node that published.
    epoch: when the writer was started, ns on the same clock: a restart is no loss, and what was
        said before it is not taken again.
    plan: hash of the writer's plan; empty in bags from before there was one in the header.
    """

    sequence: int
    source_ns: int
    publish_ns: int
    clock_id: str
    writer: str
    epoch: int
    plan: str = ""


@cache
def stamp_fields(message_type: type[Message]) -> tuple[str, ...]:
    """Names of the message's fields that are instants: those of type `Stamp`."""
    return tuple(
        name
        for name, field in message_type.model_fields.items()
        if any(isinstance(mark, StampMark) for mark in field.metadata)
    )


@cache
def schema_fingerprint(message_type: type[Message]) -> bytes:
    """First 8 bytes of the SHA-256 of the type's JSON Schema, its prose left out.

    Equal if and only if names, types, ranges, dtypes and shapes of the fields are.
    """
    schema = json.dumps(_without_prose(message_type.model_json_schema()), sort_keys=True)
    return hashlib.sha256(schema.encode()).digest()[:8]


def _without_prose(schema: object) -> object:
    """A JSON Schema without titles and descriptions; a field that is named so stays."""
    if isinstance(schema, dict):
        return {
            key: _without_prose(value)
            for key, value in schema.items()
            if not (key in ("title", "description") and isinstance(value, str))
        }
    if isinstance(schema, list):
        return [_without_prose(value) for value in schema]
    return schema
