"""Define the base class of messages, and their header."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from functools import cache
from typing import Annotated

from pydantic import BaseModel, ConfigDict


@dataclass(frozen=True, slots=True)
class StampMark:
    """Annotation of a field that is a time on the clock of the header's stamps."""


Stamp = Annotated[int, StampMark()]
"""Time in ns on the clock of the header; 0: none.

A subscriber with another clock receives these fields converted to its own.  A duration is an `int`.
"""


class Message(BaseModel):
    """Base class of typed, immutable messages.

    Subclasses declare fields; `flexsheet.messages.arrays` defines array types.  Numbers are in SI
    units and radians.  Units and frames are in the names (`age_s`, `world_from_sheet`).
    """

    model_config = ConfigDict(extra="forbid", frozen=True, arbitrary_types_allowed=True)


class MessagePart(BaseModel):
    """Base class of the named groups of fields in a message."""

    model_config = ConfigDict(extra="forbid", frozen=True, arbitrary_types_allowed=True)


@dataclass(frozen=True, slots=True)
class Header:
    """Header of one message.

    sequence: number of the message from its writer, from 1; a gap is a loss.
    source_ns: time of the measurement on the clock `clock_id`; the middle of the exposure for
        everything that derives from an image.
    publish_ns: time when the message was passed to the socket, same clock.
    clock_id: clock of both stamps; stamps of different clocks must not be subtracted.
    writer: name of the node that published.
    epoch: time when the writer started, ns on the same clock.  It distinguishes a restart from a
        loss, and rejects older messages.
    plan: hash of the writer's plan; empty in bags of the first wire protocol.
    """

    sequence: int
    source_ns: int
    publish_ns: int
    clock_id: str
    writer: str
    epoch: int
    plan: str = ""


@cache
def find_stamp_fields(message_type: type[Message]) -> tuple[str, ...]:
    """Return the names of the message's fields of type `Stamp`."""
    return tuple(
        name
        for name, field in message_type.model_fields.items()
        if any(isinstance(mark, StampMark) for mark in field.metadata)
    )


@cache
def compute_fingerprint(message_type: type[Message]) -> bytes:
    """Return the first 8 bytes of the SHA-256 of the type's JSON Schema without descriptions.

    It changes with the names, types, ranges, dtypes and shapes of the fields.
    """
    schema = json.dumps(_remove_descriptions(message_type.model_json_schema()), sort_keys=True)
    return hashlib.sha256(schema.encode()).digest()[:8]


def _remove_descriptions(schema: object) -> object:
    """Return a JSON Schema without titles and descriptions; fields of these names remain."""
    if isinstance(schema, dict):
        return {
            key: _remove_descriptions(value)
            for key, value in schema.items()
            if not (key in ("title", "description") and isinstance(value, str))
        }
    if isinstance(schema, list):
        return [_remove_descriptions(value) for value in schema]
    return schema
