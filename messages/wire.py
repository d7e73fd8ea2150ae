"""Encode and decode messages as a header frame, followed by large arrays as separate frames.

The header frame is one msgpack array of eleven elements:

  protocol     "flexsheet/2"
  type         name of the message's class
  fingerprint  8 bytes of the hash of its JSON Schema, see `messages.base.compute_fingerprint`
  sequence, source_ns, publish_ns, clock_id, writer, epoch, plan      see `messages.base.Header`
  fields       a map of the message's fields. A nested model is a map, and a tuple is an array.
               A numpy array is one of two extension types:
  type 1       dtype and shape, then the elements (for an array of at most 1 KiB)
  type 2       dtype and shape only; the elements are in the next frame

The encoding of dtype and shape is one byte with the index in `DTYPES`, one byte with the number of
axes, and two zero bytes. Then a little-endian uint32 follows for each axis. Zeros up to a multiple
of eight bytes align the elements. Elements are little-endian and in C order.

`encode` and `decode` do not copy large arrays. A sender must not change an array that is in a
message, and a receiver gets read-only views of the memory from the socket. Small arrays are copied,
because this is faster than sending them separately (`benchmarks/messaging.py`). Equal messages with
equal headers have equal bytes.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from functools import cache, lru_cache
from math import prod
from typing import Any, TypeAlias, TypeVar, overload

import numpy as np
from msgpack import ExtType, Packer, unpackb
from numpy import ndarray
from numpy.typing import NDArray
from pydantic import BaseModel, ValidationError

from flexsheet.messages.base import Header, Message, compute_fingerprint
from flexsheet.messages.errors import FlexsheetError
from flexsheet.messages.topics import Topic

Buffer: TypeAlias = bytes | memoryview
M = TypeVar("M", bound=Message)

PROTOCOL = "flexsheet/2"
HEADER_ELEMENTS = 11
DTYPES = tuple(
    np.dtype(name)
    for name in ("|b1", "|u1", "|i1", "<u2", "<i2", "<u4", "<i4", "<u8", "<i8", "<f4", "<f8")
)
INLINE_BYTES = 1024
NAME_LENGTH = 200
MAX_HEADER_BYTES = 1 << 20
"""The maximum size (bytes) of the header frame.

The decoded values need up to 64 times as much memory.
"""

MAX_ELEMENTS = 4096
"""The maximum number of elements of an array or a map in the header frame.

The limit prevents a short message from filling the memory. The decoder allocates the stated length
before it reads the elements, and arrays can be nested.
"""

_DTYPE_CODES = {dtype.str: code for code, dtype in enumerate(DTYPES)}
_INLINE, _FRAME = 1, 2
_BUFFERS = (bytes, memoryview)
_MAX_INTEGER = 2**63 - 1
# The constructor of ExtType spends half the time of `encode` on checks that always succeed here.
_extension = tuple.__new__


class WireError(FlexsheetError, ValueError):
    """Raised if a message is invalid or unexpected or cannot be encoded.

    cause: "malformed", "type", "fingerprint", "frames", "size" or "field". A subscriber also uses
        "writer", "plan", "replayed" and "forbidden".
    """

    remedy = "Run the same version of flexsheet on all hosts. The topic `status` has the count."

    def __init__(self, cause: str, text: str) -> None:
        super().__init__(text)
        self.cause = cause


class Codec:
    """The name, fingerprint and validator of one message type."""

    __slots__ = ("fingerprint", "name", "type", "validate")

    def __init__(self, message_type: type[Message]) -> None:
        self.type = message_type
        self.name = message_type.__name__
        self.fingerprint = compute_fingerprint(message_type)
        self.validate = message_type.__pydantic_validator__.validate_python


get_codec = cache(Codec)


def encode(
    message: Message,
    header: Header,
    *,
    max_bytes: int | None = None,
    inline_bytes: int = INLINE_BYTES,
) -> list[Buffer]:
    """Encode a message as frames (byte strings of a ZeroMQ multipart message).

    max_bytes: maximum size of the message; None means no limit.
    inline_bytes: maximum size of an array inside the header frame. Each larger array is a frame.

    Raises WireError if a field cannot be encoded, or if the message is too large.
    """
    frames: list[Buffer] = [b""]

    def pack(value: object) -> object:
        if isinstance(value, ndarray):
            what = _dtype_and_shape(value.dtype, value.shape)
            if value.nbytes <= inline_bytes or not value.nbytes:
                return _extension(ExtType, (_INLINE, what + value.tobytes()))
            array = value if value.flags.c_contiguous else np.ascontiguousarray(value)
            frames.append(array.data.cast("B"))
            return _extension(ExtType, (_FRAME, what))
        if isinstance(value, BaseModel):
            return value.__dict__
        raise TypeError(f"{type(value).__name__} cannot be encoded")

    codec = get_codec(type(message))
    try:
        frames[0] = Packer(default=pack).pack(
            (
                PROTOCOL,
                codec.name,
                codec.fingerprint,
                header.sequence,
                header.source_ns,
                header.publish_ns,
                header.clock_id,
                header.writer,
                header.epoch,
                header.plan,
                message.__dict__,
            )
        )
    except (TypeError, ValueError, OverflowError) as error:
        raise WireError("field", f"{type(message).__name__} cannot be encoded: {error}") from error
    if max_bytes is not None and count_bytes(frames) > max_bytes:
        raise _message_size_error(frames, max_bytes, codec.name)
    if len(frames[0]) > MAX_HEADER_BYTES:
        raise _header_size_error(frames)
    return frames


class Envelope:
    """A message whose header has been checked, but whose fields have not been validated."""

    __slots__ = ("codec", "fields", "header")

    def __init__(self, codec: Codec, header: Header, fields: dict[str, object]) -> None:
        self.codec, self.header, self.fields = codec, header, fields

    def open(self) -> Message:
        """Validate the fields, and return the message.

        Raises WireError if a field is invalid. The error text names the first invalid field.
        """
        try:
            return self.codec.validate(self.fields)  # type: ignore[no-any-return]  # pydantic's validator is untyped
        except ValidationError as error:
            raise WireError("field", _describe(error, self.codec.name)) from error


def read_envelope(frames: Sequence[Any], expected: Topic | type[Message]) -> Envelope:
    """Decode a message and check its header, without validating its fields.

    frames: buffers (bytes, memoryview or zmq.Frame). The first buffer is the header.
    expected: topic or message type. A topic also limits the size of the message.

    Raises WireError if the message is invalid or unexpected.
    """
    if isinstance(expected, Topic):
        codec = get_codec(expected.message)
        if sum(map(len, frames)) > expected.max_bytes:
            raise _message_size_error(frames, expected.max_bytes, f'topic "{expected.name}"')
    else:
        codec = get_codec(expected)
    unpacked = _unpack(frames)
    if type(unpacked) is not tuple or len(unpacked) != HEADER_ELEMENTS:
        raise WireError(
            "malformed",
            "this is not a flexsheet message: its header does not have eleven elements",
        )
    protocol, name, found, sequence, source, publish, clock_id, writer, epoch, plan, fields = (
        unpacked
    )
    if type(protocol) is not str or protocol != PROTOCOL:
        raise WireError(
            "malformed",
            f"the message has the protocol {_format_value(protocol)} instead of {PROTOCOL}",
        )
    # The name may be an array, and comparing an array does not give a bool.
    if type(name) is not str or name != codec.name:
        raise WireError(
            "type", f"the message has the type {_format_value(name)}, expected {codec.name}"
        )
    if type(found) is not bytes or found != codec.fingerprint:
        raise WireError(
            "fingerprint",
            f"{codec.name}: the message has the fingerprint {_format_value(found)}, expected "
            f"{codec.fingerprint.hex()}; run the same version of flexsheet on both hosts",
        )
    for number in (sequence, source, publish, epoch):
        if type(number) is not int or not 0 <= number <= _MAX_INTEGER:
            raise WireError(
                "malformed",
                f"the header has an invalid timestamp or sequence number: {_format_value(number)}",
            )
    for text in (clock_id, writer, plan):
        if type(text) is not str or len(text) > NAME_LENGTH:
            raise WireError("malformed", f"the header has an invalid text: {_format_value(text)}")
    if not (clock_id and writer):
        raise WireError("malformed", "the header does not name the clock or the writer")
    if type(fields) is not dict:
        raise WireError(
            "malformed", f"the fields of {codec.name} are not a map: {_format_value(fields)}"
        )
    header = Header(sequence, source, publish, clock_id, writer, epoch, plan)
    return Envelope(codec, header, fields)


@overload
def decode(frames: Sequence[Any], expected: type[M]) -> tuple[M, Header]: ...
@overload
def decode(frames: Sequence[Any], expected: Topic) -> tuple[Message, Header]: ...
def decode(frames: Sequence[Any], expected: Topic | type[Message]) -> tuple[Message, Header]:
    """Decode and validate a message, and return it with its header.

    Raises WireError if the message is invalid or unexpected.
    """
    envelope = read_envelope(frames, expected)
    return envelope.open(), envelope.header


def count_bytes(frames: Sequence[Any]) -> int:
    """Return the total size (bytes) of all frames."""
    return sum(map(len, frames))


def _unpack(frames: Sequence[Any]) -> Any:
    """Decode the header frame and the arrays in the further frames.

    Raises WireError unless each further frame belongs to exactly one array.
    """
    used = 0

    def unpack(code: int, data: bytes) -> NDArray[Any]:
        nonlocal used
        if code not in (_INLINE, _FRAME):
            raise WireError("malformed", f"the header has an unknown extension type {code}")
        if len(data) < 8:
            raise WireError("malformed", "an array in the header has no dtype and shape")
        dtype, shape, offset, size = _read_dtype_and_shape(data[: (4 * data[1] + 11) & ~7])
        if code == _INLINE:
            if len(data) - offset != size:
                raise _array_size_error(len(data) - offset, size, dtype, shape)
            return ndarray(shape, dtype, data, offset)
        used += 1
        if len(data) != offset or used >= len(frames):
            raise WireError(
                "frames",
                f"the header refers to an array in frame {used + 1}, which is missing or invalid; "
                f"the message has {len(frames)} frames",
            )
        view = _read_only(frames[used])
        if len(view) != size:
            raise _array_size_error(len(view), size, dtype, shape)
        # np.frombuffer keeps arrays read-only; an array from np.ndarray could be made writeable
        # again.
        return np.frombuffer(view, dtype).reshape(shape)

    if not frames:
        raise WireError("frames", "the message has no ZeroMQ frames")
    try:
        # msgpack reads the buffer of a zmq.Frame, but not the frame itself.
        first = frames[0] if isinstance(frames[0], _BUFFERS) else frames[0].buffer
        if len(first) > MAX_HEADER_BYTES:
            raise _header_size_error(frames)
        unpacked = unpackb(
            first,
            ext_hook=unpack,
            use_list=False,
            max_array_len=MAX_ELEMENTS,
            max_map_len=MAX_ELEMENTS,
        )
    except WireError:
        raise
    # msgpack raises various errors for invalid bytes: ValueError, TypeError, struct.error and
    # others.
    except Exception as error:
        reason = f"{type(error).__name__}: {error}"[:200]
        raise WireError("malformed", f"this is not a flexsheet message: {reason}") from error
    if used != len(frames) - 1:
        raise WireError(
            "frames",
            f"the message has {len(frames)} ZeroMQ frames, but its header describes {used + 1}",
        )
    return unpacked


def _header_size_error(frames: Sequence[Any]) -> WireError:
    return WireError(
        "size", f"the header has {len(frames[0])} bytes; at most {MAX_HEADER_BYTES} are allowed"
    )


def _array_size_error(
    found: int, expected: int, dtype: np.dtype[Any], shape: tuple[int, ...]
) -> WireError:
    return WireError(
        "frames", f"an array of {dtype} and shape {shape} has {found} bytes, expected {expected}"
    )


def _read_only(frame: Any) -> Buffer:
    buffer: Buffer = frame if isinstance(frame, _BUFFERS) else frame.buffer
    if isinstance(buffer, bytes) or buffer.readonly:
        return buffer
    return buffer.toreadonly()


@lru_cache(maxsize=1024)
def _dtype_and_shape(dtype: np.dtype[Any], shape: tuple[int, ...]) -> bytes:
    if dtype.str not in _DTYPE_CODES:
        raise TypeError(f"arrays of {dtype.str} cannot be encoded")
    head = struct.pack(f"<BBxx{len(shape)}I", _DTYPE_CODES[dtype.str], len(shape), *shape)
    return head + bytes(-len(head) % 8)


@lru_cache(maxsize=1024)
def _read_dtype_and_shape(head: bytes) -> tuple[np.dtype[Any], tuple[int, ...], int, int]:
    """Decode the dtype and shape of an array.

    Return dtype, shape, number of bytes that were read from `head`, and total size of the elements
    in bytes.
    """
    code, axes = head[0], head[1]
    if code >= len(DTYPES) or axes > 8 or len(head) != (4 * axes + 11) & ~7:
        raise WireError("malformed", f"an array has an invalid dtype or shape: {head[:16].hex()}")
    shape = struct.unpack_from(f"<{axes}I", head, 4)
    return DTYPES[code], shape, len(head), DTYPES[code].itemsize * prod(shape)


def _message_size_error(frames: Sequence[Any], max_bytes: int, what: str) -> WireError:
    return WireError(
        "size",
        f"{what}: the message has {count_bytes(frames)} bytes; at most {max_bytes} are allowed",
    )


def _describe(error: ValidationError, name: str) -> str:
    details = error.errors(include_url=False, include_input=False, include_context=False)
    where = ".".join(str(step) for step in details[0]["loc"]) or "message"
    more = f" (and {len(details) - 1} more)" if len(details) > 1 else ""
    return f"{name}.{where[:NAME_LENGTH]}: {details[0]['msg'][:NAME_LENGTH]}{more}"


def _format_value(value: object) -> str:
    """Format a received value for an error text.

    For a container, only the type is returned, because the `repr` of deeply nested values would
    fail.
    """
    if isinstance(value, bytes):
        return repr(value[:60].hex())[:60]
    if isinstance(value, str):
        return repr(value[:60])[:60]
    if value is None or isinstance(value, int | float):
        return repr(value)
    return f"a {type(value).__name__}"
