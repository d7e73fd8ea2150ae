"""Test that all commands that read a bag reject damaged and hostile bags with an error text."""

from __future__ import annotations

import resource
import struct
from collections.abc import Callable
from pathlib import Path
from random import Random

import pytest
import zstandard
from mcap.writer import CompressionType, Writer

from flexsheet.messages.bag import PROFILE, BagReader
from flexsheet.messages.base import compute_fingerprint
from flexsheet.messages.types import EStop
from flexsheet.messages.wire import PROTOCOL
from tests.sessions import write_session
from tests.test_cli import Command

COMMANDS = ("info {bag}", "verify {bag} planner", "report {bag} -o {out}.html",
            "export {bag} -o {out}.mcap", "export {bag} -o {out} --format ros2",
            "export {bag} -o {out}-2.mcap --format bag",
            "play {bag} --launch {graph}")  # fmt: skip
GRAPH = "external_topics: [estop]\nnodes: {}\n"
MAX_GROWTH_KB = 400_000


@pytest.fixture
def command(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Command:
    return Command(capsys, monkeypatch)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    return write_session(tmp_path_factory.mktemp("bags") / "a.mcap").read_bytes()


def cut(data: bytes) -> bytes:
    return data[: len(data) // 2]


def flipped(seed: int) -> Callable[[bytes], bytes]:
    def flip(data: bytes) -> bytes:
        random, changed = Random(seed), bytearray(data)
        for _ in range(20):
            changed[random.randrange(len(changed))] ^= 1 << random.randrange(8)
        return bytes(changed)

    return flip


def records(data: bytes, opcode: int) -> list[int]:
    """Return the byte positions of the length fields of all records of one kind."""
    found, offset = [], 8
    while offset + 9 < len(data):
        kind, length = struct.unpack_from("<BQ", data, offset)
        if kind == opcode:
            found.append(offset + 1)
        offset += 9 + length
    return found


def longer(opcode: int, length: int) -> Callable[[bytes], bytes]:
    def lengthen(data: bytes) -> bytes:
        changed = bytearray(data)
        for offset in records(data, opcode)[:1]:
            struct.pack_into("<Q", changed, offset, length)
        return bytes(changed)

    return lengthen


def bomb(data: bytes) -> bytes:
    """Insert a chunk of 0.5 GB of zeros, compressed to about 10 KB, after the first header."""
    packer = zstandard.ZstdCompressor(level=1).compressobj()
    packed = b"".join(packer.compress(bytes(1 << 20)) for _ in range(512)) + packer.flush()
    body = struct.pack("<QQQI", 0, 1, 512 << 20, 0) + struct.pack("<I", 4) + b"zstd"
    body += struct.pack("<Q", len(packed)) + packed
    return _behind_header(data, struct.pack("<BQ", 0x06, len(body)) + body)


def lying_bomb(data: bytes) -> bytes:
    """Insert a chunk of 0.5 GB of zeros with a small stated size."""
    packer = zstandard.ZstdCompressor(level=1).compressobj()
    packed = b"".join(packer.compress(bytes(1 << 20)) for _ in range(512)) + packer.flush()
    body = struct.pack("<QQQI", 0, 1, 1000, 0) + struct.pack("<I", 4) + b"zstd"
    body += struct.pack("<Q", len(packed)) + packed
    return _behind_header(data, struct.pack("<BQ", 0x06, len(body)) + body)


def _behind_header(data: bytes, record: bytes) -> bytes:
    (length,) = struct.unpack_from("<Q", data, 9)
    return data[: 17 + length] + record + data[17 + length :]


def made(write: Callable[[Writer], None]) -> Callable[[bytes], bytes]:
    """Write a valid bag."""

    def make(_: bytes) -> bytes:
        from io import BytesIO

        out = BytesIO()
        writer = Writer(out, compression=CompressionType.ZSTD)
        writer.start(profile=PROFILE, library="flexsheet")
        write(writer)
        writer.finish()
        return out.getvalue()

    return make


def channel(writer: Writer, number: int = 0, schema: bytes = b"{}", topic: str = "estop") -> int:
    kind = writer.register_schema("EStop", "jsonschema", schema)
    fingerprint = compute_fingerprint(EStop).hex()
    known = {"type": "EStop", "fingerprint": fingerprint, "n": str(number)}
    return writer.register_channel(topic, PROTOCOL, kind, known)


def absurd_stamps(writer: Writer) -> None:
    one = channel(writer)
    for stamp in (0, 1, 2**63, 2**64 - 1):
        writer.add_message(one, log_time=stamp, publish_time=stamp, data=bytes(24), sequence=1)


def many_channels(writer: Writer) -> None:
    for number in range(2000):
        one = channel(writer, number, topic=f"topic-{number}")
        writer.add_message(one, log_time=number, publish_time=number, data=b"", sequence=1)


def deep_schema(writer: Writer) -> None:
    schema = b'{"a":' * 20_000 + b"1" + b"}" * 20_000
    writer.add_message(channel(writer, 0, schema), 5, b"\x01" * 50, 5, 1)


def wrong_plan(writer: Writer) -> None:
    writer.add_attachment(0, 0, "plan.json", "application/json", b'{"nodes": {"planner": 3}}')
    writer.add_attachment(0, 0, "launch.yaml", "text/yaml", b"[" * 100_000)
    absurd_stamps(writer)


HOSTILE: dict[str, Callable[[bytes], bytes]] = {
    "empty": lambda _: b"",
    "not a bag": lambda _: b"hello" * 100,
    "cut": cut,
    "magic alone": lambda data: data[:8],
    **{f"bits flipped {seed}": flipped(seed) for seed in range(4)},
    "chunk of 2^62": longer(0x06, 2**62),
    "schema of 2^40": longer(0x03, 2**40),
    "channel of 2^33": longer(0x04, 2**33),
    "attachment of 2^63": longer(0x09, 2**63),
    "bomb": bomb,
    "bomb that lies": lying_bomb,
    "absurd stamps": made(absurd_stamps),
    "thousands of channels": made(many_channels),
    "a deep schema": made(deep_schema),
    "a wrong plan": made(wrong_plan),
    "no messages": made(lambda writer: None),
}
MORE_OF_THE_SAME = (
    "bits flipped 2", "bits flipped 3", "schema of 2^40", "channel of 2^33", "attachment of 2^63",
)  # fmt: skip


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.long if name in MORE_OF_THE_SAME else ())
        for name in HOSTILE
    ],
)
def test_a_hostile_bag_is_rejected_or_read_in_part(
    whole: bytes, command: Command, tmp_path: Path, name: str
) -> None:
    bag, graph = tmp_path / "hostile.mcap", tmp_path / "graph.yaml"
    bag.write_bytes(HOSTILE[name](whole))
    graph.write_text(GRAPH)
    before_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for number, line in enumerate(COMMANDS):
        text = line.format(bag=bag, out=tmp_path / f"out{number}", graph=graph)
        result = command("bag", *text.split())
        assert "Traceback" not in result.err, (line, result.err[-2000:])
        if result.code:
            assert result.err.startswith("flexsheet: "), (line, result.err)
            assert len(result.err) < 4000, line
        assert len(result.err.splitlines()) < 60, (line, result.err)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before_kb < MAX_GROWTH_KB


def test_the_whole_bag_is_read(whole: bytes, tmp_path: Path) -> None:
    """Without damage, the bag of the other tests is valid."""
    (tmp_path / "a.mcap").write_bytes(whole)
    assert BagReader(tmp_path / "a.mcap").complete
