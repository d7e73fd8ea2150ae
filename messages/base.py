"""Define the base class of messages, and the header of each message."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from functools import cache
from typing import Annotated

from pydantic import BaseModel, ConfigDict


@dataclass(frozen=True, slots=True)
class StampMark:
    """The annotation of a field that is a time on the clock of the header's timestamps."""


Stamp = Annotated[int, StampMark()]
"""A timestamp in ns on the clock of the message's header; 0: none.

A subscriber on another host receives these fields converted to its own clock. A field that is a
duration has the type `int`.
"""


class Message(BaseModel):
    """The base class of messages. Messages are typed and immutable.

    Numbers are in SI units and radians. Names contain units and frames (`age_s`,
    `world_from_sheet`). `flexsheet.messages.arrays` defines array types. A type's validator is
    built on its first use, because a node uses only a few types.
    """

    model_config = ConfigDict(
        extra="forbid", frozen=True, arbitrary_types_allowed=True, defer_build=True
    )


class MessagePart(BaseModel):
    """The base class of named groups of fields in a message."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, arbitrary_types_allowed=True, defer_build=True
    )


@dataclass(frozen=True, slots=True)
class Header:
    """The header of one message.

    sequence: sequence number of the message among those of its writer, from 1. A gap means a loss.
    source_ns: time of the measurement on the clock `clock_id`. For all values that are derived from
        an image, it is the midpoint of the exposure.
    publish_ns: time when the message was passed to the socket, on the same clock.
    clock_id: clock of both timestamps. Timestamps of different clocks must not be subtracted.
    writer: name of the node that published the message.
    epoch: time when the writer started, ns on the same clock. It distinguishes a restart from a
        loss, and is used to reject older messages.
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
    """Return the names of a message type's fields that are timestamps (of the type `Stamp`)."""
    return tuple(
        name
        for name, field in message_type.model_fields.items()
        if any(isinstance(mark, StampMark) for mark in field.metadata)
    )


@cache
def compute_fingerprint(message_type: type[Message]) -> bytes:
    """Return the first 8 bytes of the SHA-256 of a type's JSON Schema without descriptions.

    The fingerprint depends on the names, types, ranges, dtypes and shapes of the fields.
    """
    schema = json.dumps(_remove_descriptions(message_type.model_json_schema()), sort_keys=True)
    return hashlib.sha256(schema.encode()).digest()[:8]


def _remove_descriptions(schema: object) -> object:
    """Return a JSON Schema without titles and descriptions. Fields with these names remain."""
    if isinstance(schema, dict):
        return {
            key: _remove_descriptions(value)
            for key, value in schema.items()
            if not (key in ("title", "description") and isinstance(value, str))
        }
    if isinstance(schema, list):
        return [_remove_descriptions(value) for value in schema]
    return schema
