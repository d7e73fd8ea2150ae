"""Test malformed inputs that fuzzing of the decoders found."""

from __future__ import annotations

import struct
import tracemalloc
import zlib
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
import zstandard
from ruamel.yaml.error import YAMLError

from flexsheet.launch.objects.meshes import read_mesh
from flexsheet.launch.plans.documents import BadInputError, parse_value, read_document
from flexsheet.messages import wire
from flexsheet.messages.bag import BagError, BagReader, BagWriter
from flexsheet.messages.base import Header
from flexsheet.messages.bus import Subscriber
from flexsheet.messages.topics import TOPICS
from flexsheet.messages.types import EStop
from flexsheet.messages.wire import WireError, decode, encode
from flexsheet.nodes.models.shapes import MeshError
from flexsheet.nodes.node import PortCounts
from tests.fingertips import fingertip

Record = tuple[int, bytes]
MAGIC = b"\x89MCAP0\r\n"
HEADER = Header(1, 10, 20, "clock", "planner", 1, "plan")
FINGERTIP = TOPICS["fingertip"]


def header_frame(**changes: Any) -> list[Any]:
    """Return the header of a fingertip with some of its eleven elements replaced."""
    places = {"protocol": 0, "name": 1, "fingerprint": 2, "sequence": 3, "writer": 7, "fields": -1}
    elements = list(msgpack.unpackb(encode(fingertip(np.zeros(3)), HEADER)[0], use_list=False))
    for name, value in changes.items():
        elements[places[name]] = value
    return elements


ARRAY = msgpack.ExtType(1, struct.pack("<BBxxI", 9, 1, 2) + bytes(8))
"""Two float32 in the position of a name."""


@pytest.mark.parametrize("place", ["protocol", "name", "fingerprint", "sequence", "writer"])
def test_an_array_where_a_name_belongs_is_rejected_and_ends_no_reader(place: str) -> None:
    """The comparison of an array with a name raised ValueError."""
    problems: list[str] = []
    counts = PortCounts()
    subscriber = Subscriber(FINGERTIP, [], print, counts, on_problem=problems.append)
    frame = msgpack.packb(header_frame(**{place: ARRAY}))
    assert subscriber.accept([frame], None) is None
    assert counts.rejected == len(problems) == 1


@pytest.mark.parametrize("place", ["protocol", "name", "sequence", "writer", "fields"])
def test_lists_nested_to_the_parsers_limit_are_rejected_in_a_sentence(place: str) -> None:
    """Their text is not created: it would need more depth than Python has."""
    deep = b"\x91" * 1000 + b"\x90"
    mark = "here"
    packed = msgpack.packb(header_frame(**{place: mark})).replace(msgpack.packb(mark), deep)
    with pytest.raises(WireError) as refused:
        decode([packed], FINGERTIP)
    assert len(str(refused.value)) < 300


def test_lists_with_a_false_length_allocate_no_memory() -> None:
    """Each allocated memory before its elements arrived: 8 GB for a message of a megabyte."""
    claim = b"\xdd" + struct.pack(">I", 60_000)
    bomb = claim * 1000 + bytes(100_000)
    tracemalloc.start()
    try:
        with pytest.raises(WireError):
            decode([bomb], FINGERTIP)
        assert tracemalloc.get_traced_memory()[1] < 40 << 20
    finally:
        tracemalloc.stop()


def test_a_header_of_many_small_values_is_rejected_before_it_is_read() -> None:
    """A byte of the message can need 64 bytes of memory, and an image's topic allows 64 MiB."""
    large = bytes(wire.MAX_HEADER_BYTES + 1)
    with pytest.raises(WireError, match=r"the header has .* at most 1048576"):
        decode([large], TOPICS["frame"])
    with pytest.raises(WireError, match=r"the header has .* at most 1048576"):
        encode(EStop(engaged=True, reason="x" * wire.MAX_HEADER_BYTES), HEADER)


def read_records(data: bytes) -> list[Record]:
    """Return the records (opcode, body) up to the first damaged one."""
    found, offset = [], 0
    while offset + 9 <= len(data):
        opcode, length = struct.unpack_from("<BQ", data, offset)
        found.append((opcode, data[offset + 9 : offset + 9 + length]))
        offset += 9 + length
    return found


def join_records(records: list[Record]) -> bytes:
    return b"".join(struct.pack("<BQ", opcode, len(body)) + body for opcode, body in records)


def small_bag(path: Path, *, compress: bool = True) -> list[Record]:
    with BagWriter(path, compress=compress) as bag:
        bag.write(TOPICS["estop"], EStop(engaged=True, reason="x"), HEADER, 1)
    return read_records(path.read_bytes()[len(MAGIC) :])


def rewritten(path: Path, records: list[Record]) -> Path:
    path.write_bytes(MAGIC + join_records(records) + MAGIC)
    return path


@pytest.mark.parametrize("claimed", [1 << 40, 1 << 20, 10])
def test_a_chunk_is_unpacked_no_further_than_it_claims(tmp_path: Path, claimed: int) -> None:
    """A file of 2 MB could allocate all memory."""
    records = small_bag(tmp_path / "a.mcap")
    packer = zstandard.ZstdCompressor().compressobj()
    packed = b"".join(packer.compress(bytes(1 << 20)) for _ in range(300)) + packer.flush()
    head = struct.pack("<QQQI", 1, 1, claimed, 0) + struct.pack("<I", 4) + b"zstd"
    chunk = head + struct.pack("<Q", len(packed)) + packed
    bag = rewritten(tmp_path / "b.mcap", [(op, chunk if op == 6 else body) for op, body in records])
    tracemalloc.start()
    try:
        with pytest.raises(BagError, match="decompress"):
            list(BagReader(bag))
        assert tracemalloc.get_traced_memory()[1] < 8 << 20
    finally:
        tracemalloc.stop()


def test_a_chunk_packed_otherwise_is_reported(tmp_path: Path) -> None:
    records = small_bag(tmp_path / "a.mcap", compress=False)
    changed = [
        (op, body[:28] + struct.pack("<I", 3) + b"lz4" + body[32:] if op == 6 else body)
        for op, body in records
    ]
    with pytest.raises(BagError, match="damaged chunk"):
        list(BagReader(rewritten(tmp_path / "b.mcap", changed)))


ODD_YAML = {
    "a day that is none": "a: 2026-13-45",
    "a time that is none": "a: 2026-02-30T25:61:61Z",
    "a number too long": "a: " + "9" * 5000,
    "no number": "a: !!int x",
    "no truth": "a: !!bool x",
    "a version of the future": "a: 1\n%YAML 9.9\n\nb: 2",
    "a map as a key": "? {a: b}\n: c",
    "a list as a key": "? [a]\n: c",
    "brackets": "a: " + "[" * 3000,
    "braces": "{a: " * 3000,
    "dashes": "- " * 3000,
    "aliases of aliases": "\n".join(
        f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9) if n else 'x'}]" for n in range(14)
    ),
}


@pytest.mark.parametrize("text", ODD_YAML.values(), ids=ODD_YAML)
def test_odd_yaml_is_a_problem_with_its_file(tmp_path: Path, text: str) -> None:
    """Each case was an unhandled exception, an endless loop or exponential growth."""
    file = tmp_path / "a.yaml"
    file.write_text(text)
    with pytest.raises(BadInputError, match=r"a\.yaml"):
        read_document(file)
    with pytest.raises(YAMLError):
        parse_value(text)


@pytest.mark.parametrize(
    ("open_", "close"), [("#", ""), ('"', '"'), ("'", "'")], ids=["comment", "string", "word"]
)
def test_brackets_in_comments_and_strings_nest_nothing(open_: str, close: str) -> None:
    text = "[1,\n" + f"{open_}{'[' * 200}{close}\n" + "]\n"
    assert parse_value(text)[0] == 1
    with pytest.raises(YAMLError, match="lists or mappings are nested"):
        # Closing ones in strings close nothing, either.
        parse_value("""['x]', """ * 200)


def test_a_file_too_large_to_be_written_by_hand_is_rejected(tmp_path: Path) -> None:
    file = tmp_path / "a.yaml"
    file.write_text("a: 1\n" * 300_000)
    with pytest.raises(BadInputError, match="at most"):
        read_document(file)


@pytest.mark.parametrize(
    "tag", ["!!python/object/apply:os.system ['true']", "!!python/name:os.system"]
)
def test_tags_of_python_are_nothing_but_text(tmp_path: Path, tag: str) -> None:
    file = tmp_path / "a.yaml"
    file.write_text(f"a: {tag}")
    assert "system" not in str(type(read_document(file).values["a"]))


@pytest.mark.parametrize(
    ("text", "printed"),
    [
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1e300\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n", "exceeds"),
        (
            "v 0 0 0\nv 1 0 0\nv 0 nan 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n",
            "not finite",
        ),
    ],
)
def test_an_impossible_mesh_is_rejected_with_an_error_text(
    tmp_path: Path, text: str, printed: str
) -> None:
    """Numbers beyond the range of integers overflowed in the library."""
    file = tmp_path / "a.obj"
    file.write_text(text)
    with pytest.raises(MeshError, match=printed), np.errstate(all="ignore"):
        read_mesh(file, 0.1, None)


def test_check_sums_of_a_rewritten_bag_are_verified(tmp_path: Path) -> None:
    """The check sums of the rewritten bags of the tests above must be valid."""
    records = small_bag(tmp_path / "a.mcap", compress=False)
    assert len(list(BagReader(rewritten(tmp_path / "b.mcap", records)))) == 1
    changed = [(op, body[:-1] + b"\xff" if op == 6 else body) for op, body in records]
    with pytest.raises(BagError, match="crc"):
        list(BagReader(rewritten(tmp_path / "c.mcap", changed)))
    assert zlib.crc32(b"") == 0
