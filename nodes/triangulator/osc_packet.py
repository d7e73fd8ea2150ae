"""Read packets of OSC 1.0 (https://opensoundcontrol.stanford.edu/spec-1_0.html)."""

from __future__ import annotations

import struct
from collections.abc import Iterator

BUNDLE = b"#bundle\0"
HEADER_BYTES = 16
"""The size of the name and the time at the beginning of an OSC bundle."""

FORMATS = {"i": ">i", "f": ">f", "h": ">q", "d": ">d"}
WITHOUT_DATA = "TFNI"


def read_packet(data: bytes) -> Iterator[tuple[str, list[float]]]:
    """Yield the address and the numbers of each message in a packet. Skip string arguments.

    Raises ValueError or struct.error if the bytes are not an OSC packet.
    """
    if not data.startswith(BUNDLE):
        yield _read_message(data)
        return
    offset = HEADER_BYTES
    while offset < len(data):
        (size,) = struct.unpack_from(">i", data, offset)
        end = offset + 4 + size
        if size <= 0 or end > len(data):
            raise ValueError(f"OSC bundle of {len(data)} bytes: invalid element size {size}")
        yield from read_packet(data[offset + 4 : end])
        offset = end


def _read_message(data: bytes) -> tuple[str, list[float]]:
    address, offset = _read_text(data, 0)
    tags, offset = _read_text(data, offset)
    if not address.startswith("/") or not tags.startswith(","):
        raise ValueError("the OSC message does not begin with an address and a type tag string")
    numbers = []
    for tag in tags[1:]:
        if tag in FORMATS:
            (number,) = struct.unpack_from(FORMATS[tag], data, offset)
            numbers.append(float(number))
            offset += struct.calcsize(FORMATS[tag])
        elif tag == "s":
            _, offset = _read_text(data, offset)
        elif tag not in WITHOUT_DATA:
            raise ValueError(f'OSC message {address}: the type tag "{tag}" is unknown')
    return address, numbers


def _read_text(data: bytes, offset: int) -> tuple[str, int]:
    """Return the string that begins at `offset`, and the offset after its zero bytes."""
    end = data.index(b"\0", offset)
    return data[offset:end].decode("ascii"), end + 4 - (end - offset) % 4
