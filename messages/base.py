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
    """A marker for message fields that contain a timestamp on the clock of the message's header."""


Stamp = Annotated[int, StampMark()]
"""A timestamp, in ns, on the clock of the message's header. The value 0 means no timestamp.

When a message arrives from another host, its timestamps are converted to the clock of the receiving
host. A field that contains a duration has the type `int` instead.
"""


class Message(BaseModel):
    """The base class of messages, which are typed and immutable.

    Numbers are in SI units and radians. Field names contain units and frames, such as `age_s` and
    `world_from_sheet`. `flexsheet.messages.arrays` defines array types. The validator of a type is
    built on its first use, because a node uses only a few types.
    """

    model_config = ConfigDict(
        extra="forbid", frozen=True, arbitrary_types_allowed=True, defer_build=True
    )

    def find_problem(self) -> str:
        """Return why no node can use the message, or "" if there is no such reason.

        A message with a problem can be decoded, so that a bag that contains it stays readable.
        `flexsheet topic pub` does not send it.
        """
        return ""


class MessagePart(BaseModel):
    """The base class of named groups of fields in a message."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, arbitrary_types_allowed=True, defer_build=True
    )


@dataclass(frozen=True, slots=True)
class Header:
    """The header of one message.

    sequence: number of the message among the messages of its writer, starting at 1. A gap in the
        numbers means that messages were lost.
    source_ns: time of the measurement on the clock `clock_id`. For values that are derived from an
        image, the time is the midpoint of the exposure.
    publish_ns: time when the message was passed to the socket, on the same clock.
    clock_id: clock of both timestamps. Timestamps of different clocks must not be subtracted.
    writer: name of the node that published the message.
    epoch: time when the writer started, in ns, on the same clock. A receiver uses the epoch to
        distinguish a restart from a loss of messages, and to reject messages from before a restart.
    plan: hash of the resolved launch file of the writer; empty in bags of the first wire protocol.
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
    """Return the names of a message type's fields that have the type `Stamp` (timestamp)."""
    return tuple(
        name
        for name, field in message_type.model_fields.items()
        if any(isinstance(mark, StampMark) for mark in field.metadata)
    )


@cache
def compute_fingerprint(message_type: type[Message]) -> bytes:
    """Return a hash of a message type: the first 8 bytes of the SHA-256 of its JSON Schema.

    The hash depends on the names, types, ranges, dtypes and shapes of the fields, but not on their
    descriptions.
    """
    schema = json.dumps(_remove_descriptions(message_type.model_json_schema()), sort_keys=True)
    return hashlib.sha256(schema.encode()).digest()[:8]


def _remove_descriptions(schema: object) -> object:
    """Return a copy of a JSON Schema without titles and descriptions.

    Message fields that are named "title" or "description" remain.
    """
    if isinstance(schema, dict):
        return {
            key: _remove_descriptions(value)
            for key, value in schema.items()
            if not (key in ("title", "description") and isinstance(value, str))
        }
    if isinstance(schema, list):
        return [_remove_descriptions(value) for value in schema]
    return schema
