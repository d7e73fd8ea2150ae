"""Define fuzzing targets for `benchmarks.fuzz`: the parsers of external data.

A target accepts any bytes: it decodes them, or raises the declared error. Anything else is a
finding: another exception, memory beyond the bound, or the execution of a program or code
(`ExecutionMonitor`). Each target has valid examples as seeds, and a mutator that preserves part of
the structure, so that inputs pass the first checks. `tests/test_fuzz_*.py` run the same targets
with hypothesis.
"""

from __future__ import annotations

import asyncio
import io
import json
import logging
import os
import random
import resource
import shutil
import struct
import sys
import tempfile
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import msgpack
import numpy as np
import zstandard
from pydantic import BaseModel
from ruamel.yaml import YAML

import flexsheet.launch
from flexsheet.launch.objects.meshes import read_mesh
from flexsheet.launch.plans.documents import BadInputError
from flexsheet.launch.plans.plan import load_graph, load_scene
from flexsheet.messages.apparatus import nominal_apparatus
from flexsheet.messages.arrays import ArraySpec
from flexsheet.messages.bag import (
    BagError,
    BagReader,
    BagWriter,
    join_frames,
    recover,
    split_frames,
)
from flexsheet.messages.base import Header, Message
from flexsheet.messages.bus import Subscriber
from flexsheet.messages.scene import Scene
from flexsheet.messages.topics import TOPICS
from flexsheet.messages.wire import WireError, decode, encode
from flexsheet.nodes import NODES, node_class
from flexsheet.nodes.arm_bridge.link import ArmAnswerError, ArmLinkError, ArmRefusedError
from flexsheet.nodes.arm_bridge.modbus import STATUS_ADDRESS, ModbusLink, decode_status
from flexsheet.nodes.arm_bridge.mxt import PACKET_BYTES, decode_answer
from flexsheet.nodes.arm_bridge.mxt import encode as encode_mxt
from flexsheet.nodes.models.shapes import MeshError
from flexsheet.nodes.node import PortCounts
from flexsheet.nodes.twin.arms import RV_1A_MECHANICS, Controller
from flexsheet.nodes.twin.mxt_controller import FILTER_S, MxtController

LAUNCH = Path(flexsheet.launch.__file__).parent
AT_REST_RAD = np.radians([0.0, 25.0, 118.0, 0.0, -54.0, 0.0])
MEMORY_BYTES = 256 << 20
"""The maximum additional memory for one input, in bytes."""

FORBIDDEN = frozenset(
    {"os.system", "os.exec", "os.posix_spawn", "subprocess.Popen", "pickle.find_class", "os.fork"}
)
"""The audit events of Python that show the execution of a program or of code."""

Mutate = Callable[[bytes, random.Random], bytes]

_log = logging.getLogger("flexsheet.fuzz")


class Finding(AssertionError):
    """Raised if an input had a forbidden effect."""


class ExecutionMonitor:
    """A permanent monitor that raises Finding if a program or code is executed while it is on."""

    on = False
    _hooked = False

    @classmethod
    def _audit(cls, event: str, arguments: tuple[Any, ...]) -> None:
        if cls.on and event in FORBIDDEN:
            raise Finding(f"{event} {arguments!r:.200}")

    @classmethod
    @contextmanager
    def looks(cls) -> Iterator[None]:
        if not cls._hooked:
            sys.addaudithook(cls._audit)
            cls._hooked = True
        cls.on = True
        try:
            yield
        finally:
            cls.on = False


@contextmanager
def bounded_memory(max_bytes: int = MEMORY_BYTES) -> Iterator[None]:
    """Raise Finding if the process's peak memory grows by more than `max_bytes`."""
    before = _peak_bytes()
    yield
    taken = _peak_bytes() - before
    if taken > max_bytes:
        raise Finding(f"{taken >> 20} MiB were allocated")


def _peak_bytes() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss << 10


@dataclass(frozen=True)
class Target:
    """A target of fuzzing.

    run: function that decodes bytes, and returns False if the declared error was raised.
    """

    name: str
    about: str
    seeds: Callable[[], list[bytes]]
    run: Callable[[bytes], bool]
    mutate: Mutate

    def check(self, data: bytes) -> bool:
        """Run the target on bytes.

        Raises Finding for a forbidden effect, and any undeclared exception of the target.
        """
        with ExecutionMonitor.looks(), bounded_memory():
            return self.run(data)


def refuse_long(error: Exception, most: int) -> None:
    """Raise Finding unless the error text has a reasonable length."""
    if not 0 < len(str(error)) <= most:
        raise Finding(f"error text of {len(str(error))} characters")


# Mutations of bytes and trees.

ODD_INTEGERS = (0, 1, 2, 0x7F, 0x80, 0xFF, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF)
ODD_LONGS = (0, 1 << 31, (1 << 32) - 1, 1 << 40, (1 << 63) - 1, 1 << 63, (1 << 64) - 1)


def mutate_bytes(data: bytes, chance: random.Random) -> bytes:
    """Apply one random mutation: flip, set, cut, insert, repeat or move bytes."""
    place = chance.randrange(len(data) + 1)
    end = min(len(data), place + 1 + int(chance.expovariate(1 / 8)))
    before, piece, after = data[:place], data[place:end], data[end:]
    match chance.randrange(8):
        case 0 if piece:
            flipped = bytes([piece[0] ^ 1 << chance.randrange(8)])
            return before + flipped + data[place + 1 :]
        case 1:
            return before + after
        case 2:
            return before + chance.randbytes(1 + int(chance.expovariate(1 / 8))) + piece + after
        case 3:
            return before + piece * chance.choice((2, 3, 50)) + after
        case 4:
            return data[:place]
        case 5:
            kind = chance.choice(("<I", ">I", "<H", ">H", "B"))
            most = 256 ** struct.calcsize(kind) - 1
            number = struct.pack(kind, chance.choice(ODD_INTEGERS) & most)
            return before + number + data[place + len(number) :]
        case 6:
            number = struct.pack(chance.choice("<>") + "Q", chance.choice(ODD_LONGS))
            return before + number + data[place + len(number) :]
        case _:
            other = chance.randrange(len(data) + 1)
            rest = before + after
            return rest[:other] + piece + rest[other:]


def nested(depth: int) -> Any:
    """Return nested lists."""
    value: Any = []
    for _ in range(depth):
        value = [value]
    return value


def make_odd_value(chance: random.Random) -> Any:
    """Return a random value of an unusual type or size."""
    values: tuple[Any, ...] = (
        None, True, 0, -1, 1 << 63, -(1 << 63), (1 << 64) - 1, 0.0, -0.0, 1e308, 5e-324, "", "x",
        float("nan"), float("inf"), "\0", "é" * 300, "../../etc/passwd", [], {}, [[]], {"": None},
        nested(40), ["x"] * 3000, {str(number): number for number in range(300)}, 0.5, "null",
    )  # fmt: skip
    return chance.choice(values)


def mutate_tree(tree: Any, chance: random.Random, odd: Callable[[random.Random], Any]) -> Any:
    """Return a tree of dicts and lists with one value changed, deleted, duplicated or moved."""
    if isinstance(tree, dict) and tree and chance.random() < 0.9:
        return _mutate_dict(tree, chance, odd)
    if isinstance(tree, list | tuple) and tree and chance.random() < 0.9:
        place = chance.randrange(len(tree))
        match chance.randrange(8):
            case 0:
                changed = []
            case 1:
                changed = [tree[place], tree[place]]
            case _:
                changed = [mutate_tree(tree[place], chance, odd)]
        return [*tree[:place], *changed, *tree[place + 1 :]]
    if isinstance(tree, bytes) and chance.random() < 0.7:
        return mutate_bytes(tree, chance)
    if isinstance(tree, str) and tree and chance.random() < 0.3:
        return mutate_bytes(tree.encode(), chance).decode(errors="replace")
    if isinstance(tree, int | float) and not isinstance(tree, bool) and chance.random() < 0.3:
        return -tree if chance.random() < 0.5 else tree * 1000
    return odd(chance)


def _mutate_dict(
    tree: dict[Any, Any], chance: random.Random, odd: Callable[[random.Random], Any]
) -> dict[Any, Any]:
    key = chance.choice(list(tree))
    match chance.randrange(12):
        case 0:
            return {name: value for name, value in tree.items() if name != key}
        case 1:
            return {**tree, chance.choice((f"{key}x", "", "type", "shape", "-")): tree[key]}
        case 2:
            return {**tree, key: tree[chance.choice(list(tree))]}
        case _:
            return {**tree, key: mutate_tree(tree[key], chance, odd)}


# Messages on the wire.


def example(kind: Any) -> Any:
    """Return a valid example of a message type, or of the type of a message field."""
    if isinstance(kind, type) and issubclass(kind, BaseModel):
        fields = kind.model_fields.items()
        # The annotations of the class contain the constraints, which pydantic stores separately.
        return kind.model_validate({name: _example_of(one) for name, one in fields})
    origin, arguments = get_origin(kind), get_args(kind)
    if origin is Annotated:
        specs = [one for one in arguments[1:] if isinstance(one, ArraySpec)]
        return _array(specs[0]) if specs else example(arguments[0])
    if origin is Literal:
        return arguments[0]
    if origin in (Union, UnionType):
        return example(arguments[0])
    if origin is tuple:
        many = len(arguments) == 2 and arguments[1] is ...
        return tuple(example(one) for one in (arguments[:1] if many else arguments))
    return {str: "x", int: 1, float: 0.15, bool: True}[kind]


def _example_of(info: Any) -> Any:
    specs = [one for one in info.metadata if isinstance(one, ArraySpec)]
    return _array(specs[0]) if specs else example(info.annotation)


def _array(spec: ArraySpec) -> np.ndarray[Any, Any]:
    shape = tuple(one if isinstance(one, int) else 2 for one in spec.shape)
    return np.ones(shape, np.dtype(spec.dtype))


HEADER = Header(7, 1000, 2000, "clock", "planner", 1, "plan")
NAMES = tuple(TOPICS)


@cache
def scene() -> Scene:
    return load_scene(LAUNCH / "scenes" / "cylinder.yaml")


@cache
def messages_of_scene() -> dict[str, Message]:
    """Return valid messages of the topics whose values must be consistent with a scene."""
    return {"scene": scene(), "twin/apparatus": nominal_apparatus(scene())}


def wire_seeds() -> list[bytes]:
    """Return a message of each topic, as the number of the topic and the frames of the message."""
    found = []
    for number, topic in enumerate(TOPICS.values()):
        message = messages_of_scene().get(topic.name) or example(topic.message)
        for inline_bytes in (0, 1024):
            frames = encode(message, HEADER, inline_bytes=inline_bytes)
            found.append(bytes([number]) + join_frames(frames))
    return found


@cache
def listener(name: str) -> Subscriber:
    """Return a subscriber without a connection."""

    def inbox(message: Message, header: Header) -> None:
        """Do nothing with a message."""

    return Subscriber(TOPICS[name], [], inbox, PortCounts(), on_problem=_log.debug, plan="plan")


def wire_frames(data: bytes) -> tuple[str, list[Any]]:
    """Decode bytes to a topic and frames."""
    name = NAMES[data[0] % len(NAMES)] if data else NAMES[0]
    try:
        return name, split_frames(data[1:])
    except WireError:
        return name, [data[1:]]


def run_wire(data: bytes) -> bool:
    """Decode a message, and check that it can be encoded again without a change."""
    name, frames = wire_frames(data)
    topic = TOPICS[name]
    subscriber = listener(name)
    envelope = subscriber.accept(frames, frozenset({"planner"}))
    if envelope is not None:
        subscriber.deliver(envelope)
    try:
        message, header = decode(frames, topic)
    except WireError as error:
        refuse_long(error, 2000)
        return False
    again = encode(message, header)
    assert [bytes(one) for one in encode(*decode(again, topic))] == [bytes(one) for one in again]
    return True


def mutate_wire(data: bytes, chance: random.Random) -> bytes:
    """Mutate the header's values, its bytes, or the frames."""
    frames = [bytes(one) for one in wire_frames(data)[1]]
    kind = chance.randrange(10)
    if kind < 6:
        with suppress(Exception):  # data that is not valid msgpack is mutated as bytes, below
            tree = msgpack.unpackb(frames[0], use_list=False, strict_map_key=False)
            changed = mutate_tree(tree, chance, odd_on_the_wire)
            frames[0] = msgpack.packb(changed)
            return data[:1] + join_frames(frames)
    if kind < 8:
        place = chance.randrange(len(frames))
        frames[place] = mutate_bytes(frames[place], chance)
        return data[:1] + join_frames(frames)
    if kind == 8:
        place = chance.randrange(len(frames))
        frames[place : place + 1] = chance.choice(([], [frames[place]] * 2, [b""]))
        return data[:1] + join_frames(frames)
    return (
        bytes([chance.randrange(len(NAMES))]) + data[1:]
        if chance.random() < 0.5
        else (mutate_bytes(data, chance))
    )


def odd_on_the_wire(chance: random.Random) -> Any:
    """Return a random value, also an array with an invalid shape, or bytes."""
    axes = chance.randrange(4)
    shape = [chance.choice((0, 1, 2, 3, 4, 6, 0xFFFF, 0xFFFFFFFF)) for _ in range(axes)]
    head = struct.pack(f"<BBxx{axes}I", chance.randrange(13), axes, *shape)
    head += bytes(-len(head) % 8)
    body = chance.randbytes(chance.choice((0, 8, 24, 128)))
    array = msgpack.ExtType(chance.choice((1, 1, 2, 3)), head + body)
    return chance.choice(
        (make_odd_value(chance), array, array, b"", chance.randbytes(9), {b"k": 1})
    )


# Bags.

MAGIC = b"\x89MCAP0\r\n"
CHUNK, ATTACHMENT = 6, 9
Record = tuple[int, bytes]


@cache
def bag_seeds() -> list[bytes]:
    """Return small bags with attachment and metadata: compressed, uncompressed and truncated."""
    found = []
    with tempfile.TemporaryDirectory() as folder:
        for compress in (True, False):
            path = Path(folder) / f"{compress}.mcap"
            with BagWriter(path, {"recording": {"clock_id": "x"}}, compress=compress) as bag:
                bag.add_attachment("launch.yaml", b"nodes: {}\n", "text/yaml")
                for sequence in range(1, 4):
                    for name in ("fingertip", "estop", "bookmark"):
                        header = Header(sequence, 10, 20, "clock", "planner", 1, "plan")
                        bag.write(TOPICS[name], example(TOPICS[name].message), header, sequence)
            found.append(path.read_bytes())
    return [*found, found[0][: len(found[0]) // 2]]


def run_bag(data: bytes) -> bool:
    """Read the summary and all messages of a bag, and recover it."""
    with tempfile.TemporaryDirectory(dir=_scratch()) as folder:
        path, saved = Path(folder) / "a.mcap", Path(folder) / "b.mcap"
        path.write_bytes(data)
        try:
            reader = BagReader(path)
        except BagError:
            return False
        reader.info()
        for reading in (reader, reader.frames()):
            with suppress(BagError):
                for _ in reading:
                    pass
        for held in reader.attachments:
            with suppress(BagError):
                reader.attachment(held.name)
        with suppress(BagError):
            recover(path, saved)
    return True


@cache
def _scratch() -> str | None:
    """Return a folder in memory if available, else on disk."""
    return "/dev/shm" if os.access("/dev/shm", os.W_OK) else None


def read_records(data: bytes) -> list[Record]:
    """Return the records (opcode, body) up to the first damaged one."""
    found, offset = [], 0
    while offset + 9 <= len(data):
        opcode, length = struct.unpack_from("<BQ", data, offset)
        found.append((opcode, data[offset + 9 : offset + 9 + length]))
        offset += 9 + length
    return found


def join_records(records: Sequence[Record]) -> bytes:
    return b"".join(struct.pack("<BQ", opcode, len(body)) + body for opcode, body in records)


def mutate_bag(data: bytes, chance: random.Random) -> bytes:
    """Mutate the records of a bag, the records within a chunk, or the bytes of the bag."""
    if chance.random() < 0.2 or not data.startswith(MAGIC):
        return mutate_bytes(data, chance)
    records = read_records(data[len(MAGIC) :])
    if not records:
        return mutate_bytes(data, chance)
    changed = mutate_records(records, chance)
    return MAGIC + join_records(changed) + MAGIC


def mutate_records(records: Sequence[Record], chance: random.Random) -> list[Record]:
    place = chance.randrange(len(records))
    opcode, body = records[place]
    match chance.randrange(8):
        case 0:
            return [*records[:place], *records[place + 1 :]]
        case 1:
            return [*records[: place + 1], *records[place:]]
        case 2:
            return [*records[:place], (chance.randrange(16), body), *records[place + 1 :]]
        case 3:
            other = chance.randrange(len(records))
            rest = [*records[:place], *records[place + 1 :]]
            return [*rest[:other], (opcode, body), *rest[other:]]
        case _:
            if opcode == CHUNK:
                with suppress(Exception):  # a damaged one is mutated as bytes
                    return [*records[:place], (opcode, _mutate_chunk(body, chance)),
                            *records[place + 1 :]]  # fmt: skip
            changed = _mutate_text_or_bytes(body, chance)
            if opcode == ATTACHMENT and len(changed) >= 4:
                changed = changed[:-4] + struct.pack("<I", zlib.crc32(changed[:-4]))
            return [*records[:place], (opcode, changed), *records[place + 1 :]]


def _mutate_text_or_bytes(body: bytes, chance: random.Random) -> bytes:
    """Mutate the JSON Schema within a record, which is preceded by its length, or the bytes."""
    start = body.find(b"{")
    if start < 4 or chance.random() < 0.5:
        return mutate_bytes(body, chance)
    length = int.from_bytes(body[start - 4 : start], "little")
    try:
        tree = json.loads(body[start : start + length])
    except ValueError:
        return mutate_bytes(body, chance)
    text = json.dumps(mutate_tree(tree, chance, odd_in_a_schema)).encode()
    if chance.random() < 0.1:
        text = b"[" * chance.choice((10, 2000, 200_000))
    return body[: start - 4] + struct.pack("<I", len(text)) + text + body[start + length :]


def odd_in_a_schema(chance: random.Random) -> Any:
    ways = ("#/$defs/A", "#", "#/$defs/B", "")
    reference = {"$ref": chance.choice(ways)}
    definitions = {"A": {"$ref": "#/$defs/B"}, "B": {"$ref": "#/$defs/A"}}
    loop = {"$defs": definitions, "properties": {"a": reference}, "anyOf": [reference, reference]}
    return chance.choice((make_odd_value(chance), reference, {"anyOf": [reference] * 3}, loop))


def _mutate_chunk(body: bytes, chance: random.Random) -> bytes:
    """Mutate one record of a chunk. The size of the chunk is sometimes left wrong."""
    start, end, size, _ = struct.unpack_from("<QQQI", body)
    name_length = struct.unpack_from("<I", body, 28)[0]
    name = body[32 : 32 + name_length]
    packed = body[40 + name_length :]
    plain = zstandard.decompress(packed, 1 << 24) if name == b"zstd" else packed
    plain = join_records(mutate_records(read_records(plain), chance))
    if chance.random() < 0.05:
        plain = bytes(1 << 20)
    size = chance.choice(ODD_LONGS) if chance.random() < 0.1 else len(plain)
    packed = zstandard.compress(plain) if name == b"zstd" else plain
    head = struct.pack("<QQQI", start, end, size, zlib.crc32(plain))
    return head + struct.pack("<I", len(name)) + name + struct.pack("<Q", len(packed)) + packed


# Launch files and scenes.


def import_nodes() -> None:
    """Import all nodes. Some libraries start processes during their import."""
    for name in NODES:
        node_class(name)


YAML_TOKENS = (
    "&a ", "*a", "[*a, *a]", "<<: *a\n", "!!python/object/apply:os.system ['true']", "!!binary x",
    "!!python/name:os.system", "!!set {a}", "!!omap [a: 1]", "!!timestamp 2026-13-45", "2026-13-45",
    "2026-02-30T25:61:61Z", "? ", "=",
    "? {a: b}\n: c\n", "? [a]\n: c\n", "---\n", "...\n", "%YAML 9.9\n",
    "%TAG ! x\n", "<<", "{",
    "[", "}", "]", "|\n", ">\n", "'", '"', "\\", "#", "\t", "\0", "\x85", "￾", "🙂",
    "0x", "0o9", "0b2", "1_0", ".nan", ".inf", "-.inf", "1e999", "9" * 5000, "-", "- ", ": ", "~",
    "[" * 3000, "{a: " * 3000, "- " * 3000, "!!int x", "!!float x", "!!bool x", "!!null x", "!<x>",
    "!!int 1.5", "true", "@x", "`x", "%x", "\r", "\u2028",
)  # fmt: skip

BOMB = "".join(f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9) if n else 'x'}]\n" for n in range(12))
"""A YAML document whose nested aliases expand to a huge list."""


def mutate_yaml(data: bytes, chance: random.Random) -> bytes:
    """Mutate the values of a YAML document, or insert constructs that YAML parsers handle badly."""
    text = data.decode(errors="replace")
    kind = chance.randrange(10)
    if kind < 6:
        with suppress(Exception):  # data that is not valid YAML is mutated as text
            tree = YAML(typ="safe", pure=True).load(text)
            if isinstance(tree, dict):
                return to_yaml(mutate_tree(tree, chance, make_odd_value))
    place = chance.randrange(len(text) + 1)
    if kind < 8:
        return (text[:place] + chance.choice(YAML_TOKENS) + text[place:]).encode()
    if kind == 8 and chance.random() < 0.1:
        return BOMB.encode() + data
    return mutate_bytes(data, chance)


def to_yaml(tree: Any) -> bytes:
    written = io.BytesIO()
    YAML(typ="safe", pure=True).dump(tree, written)
    return written.getvalue()


SMALL_LAUNCH = """scene: scenes/cylinder.yaml
hosts: {main: {address: 127.0.0.1}, left: {address: 127.0.0.1}}
nodes:
  twin_finger: {type: twin_finger}
  camera: {type: camera, parameters: {source: {kind: twin}}}
  planner: {type: planner, topics: {fingertip: fingertip, soft_body: null}, host: main}
  triangulator: {type: triangulator}
  arm_left_bridge:
    type: arm_bridge
    host: left
    parameters: {side: left, host: 127.0.0.1, port: 5020, arming: auto}
    topics: {arm: arm_left, other_arm: null}
    restart: {policy: always, delay_s: 0.1}
record: {bag: x.mcap, topics: [fingertip]}
clocks: {max_offset_uncertainty_s: 0.01}
"""


def launch_seeds() -> list[bytes]:
    """Return a small launch file for two hosts, and the shipped ones."""
    names = ("demo.yaml", "three.yaml", "replay.yaml", "lab.yaml")
    return [SMALL_LAUNCH.encode(), *((LAUNCH / name).read_bytes() for name in names)]


@cache
def launch_folder() -> Path:
    """Create a folder with scenes and calibrations for launch files, until the process ends."""
    folder = Path(tempfile.mkdtemp(prefix="fuzz-", dir=_scratch()))
    for name in ("scenes", "calibrations"):
        shutil.copytree(LAUNCH / name, folder / name)
    return folder


def remove_launch_folder() -> None:
    """Delete the folder of launch files."""
    if launch_folder.cache_info().currsize:
        shutil.rmtree(launch_folder())
        launch_folder.cache_clear()


def run_launch(data: bytes) -> bool:
    """Load a launch file as a plan. The last line may be a setting for `--set`."""
    path = launch_folder() / "fuzz.yaml"
    text, mark, setting = data.partition(b"\n#--set ")
    path.write_bytes(text)
    settings = [setting.decode(errors="replace")] if mark else []
    try:
        plan = load_graph(path, settings=settings)
    except BadInputError as error:
        refuse_long(error, 100_000)
        return False
    plan.model_dump_json()
    return True


def mutate_launch(data: bytes, chance: random.Random) -> bytes:
    if chance.random() < 0.1:
        value = chance.choice((*YAML_TOKENS, "3", "[1, 2]", BOMB))
        name = chance.choice(("planner.rate_hz", "recorder.bag", "x", "planner.a.b.c", "planner."))
        return data.partition(b"\n#--set ")[0] + f"\n#--set {name}={value}".encode()
    return mutate_yaml(data, chance)


def scene_seeds() -> list[bytes]:
    # Scenes with meshes load too slowly; meshes have a separate target.
    files = sorted((LAUNCH / "scenes").glob("*.yaml"))
    texts = [file.read_bytes() for file in files]
    return [text for text in texts if b"mesh_file" not in text and b"texture" not in text]


def run_scene(data: bytes) -> bool:
    path = launch_folder() / "scenes" / "fuzz.yaml"
    path.write_bytes(data)
    try:
        found = load_scene(path)
    except BadInputError as error:
        refuse_long(error, 100_000)
        return False
    encode(found, HEADER)
    return True


def mesh_seeds() -> list[bytes]:
    """Return a tetrahedron, and a triangle in text and binary form."""
    return list(MESH_SEEDS)


MESH_SEEDS = (
    b"v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n",
    b"solid x\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\n"
    b"endfacet\nendsolid x\n",
    bytes(80) + struct.pack("<I", 1) + struct.pack("<12fH", *range(12), 0),
)


def run_mesh(data: bytes) -> bool:
    """Load the same bytes as an STL and as an OBJ file."""
    logging.getLogger("trimesh").setLevel(logging.CRITICAL)
    taken = False
    for suffix in (".obj", ".stl"):
        path = launch_folder() / f"fuzz{suffix}"
        path.write_bytes(data)
        with suppress(MeshError), np.errstate(all="ignore"):
            read_mesh(path, 0.1, None)
            taken = True
    return taken


def mutate_mesh(data: bytes, chance: random.Random) -> bytes:
    words = data.split(b" ")
    if len(words) > 3 and chance.random() < 0.5:
        place = chance.randrange(len(words))
        odd = (b"nan", b"inf", b"-1", b"99999999999", b"1e400", b"1/2/3", b"f", b"\nv", b"usemtl x")
        return b" ".join([*words[:place], chance.choice(odd), *words[place + 1 :]])
    return mutate_bytes(data, chance)


# Modbus TCP.

TID, CRC_RIGHT, ACCEPTED_RIGHT, SPLIT, CLOSE = 1, 2, 4, 8, 16
"""The bits in the first byte of an answer, which change the answer.

In this order: use the transaction number of the request; correct the check sum of the status block;
correct its accepted number; split the answer; close the connection.
"""

_REGISTERS = 26


class FakeArm:
    """Modbus TCP server on loopback that answers every request with given bytes."""

    def __init__(self) -> None:
        self.loop = asyncio.new_event_loop()
        self.answer = b""
        self.failures: list[str] = []
        self.loop.set_exception_handler(self._note)
        self._server = self.loop.run_until_complete(
            asyncio.start_server(self._serve, "127.0.0.1", 0)
        )
        self.port = int(self._server.sockets[0].getsockname()[1])

    def _note(self, _: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        """Ignore exceptions in the event loop."""
        self.failures.append(f"{context}")

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with suppress(ConnectionError):
            while request := await reader.read(1024):
                flags, answer = self.answer[0] if self.answer else 0, self.answer[1:]
                answer = correct_answer(answer, flags, request)
                middle = len(answer) // 2 if flags & SPLIT else len(answer)
                for piece in (answer[:middle], answer[middle:]):
                    writer.write(piece)
                    await writer.drain()
                    await asyncio.sleep(0)
                if flags & CLOSE:
                    break
        writer.close()

    def ask(self, answer: bytes) -> bool:
        """Exchange one request with a new link."""
        return self.loop.run_until_complete(self._ask(answer))

    async def _ask(self, answer: bytes) -> bool:
        self.answer = answer
        self.failures.clear()
        link = ModbusLink("127.0.0.1", self.port, timeout_s=0.01)
        try:
            status = await link.exchange(mode="hold", joints_rad=AT_REST_RAD, now_ns=1)
        except ArmLinkError:
            return False
        finally:
            link.close()
            await asyncio.sleep(0)
            assert not self.failures, self.failures
        assert np.isfinite(status.joints_rad).all()
        return True

    def close(self) -> None:
        self._server.close()
        self.loop.run_until_complete(self._server.wait_closed())
        self.loop.close()


def correct_answer(answer: bytes, flags: int, request: bytes) -> bytes:
    """Correct the parts of an answer that `flags` selects, to match the request."""
    block = 9
    if flags & TID and len(answer) >= 2:
        answer = request[:2] + answer[2:]
    if len(answer) == block + 2 * _REGISTERS:
        if flags & ACCEPTED_RIGHT:
            # The command block follows the request's head of 17 bytes; its sequence is the third.
            answer = answer[: block + 4] + request[21:25] + answer[block + 8 :]
        if flags & CRC_RIGHT:
            answer = answer[:-4] + struct.pack(">I", zlib.crc32(answer[block:-4]))
    return answer


@cache
def fake_arm() -> FakeArm:
    return FakeArm()


def close_fake_arm() -> None:
    """Close the server of the Modbus target."""
    if fake_arm.cache_info().currsize:
        fake_arm().close()
        fake_arm.cache_clear()


def modbus_seeds() -> list[bytes]:
    """Return a valid answer, an exception, and requests to the simulated controller."""
    controller = Controller(AT_REST_RAD, servo_lag_s=0.02, noise_rad=0.0, watchdog_s=1.0)
    registers = controller.status_registers()
    body = struct.pack(f">{len(registers)}H", *registers)
    right = struct.pack(">HHHBBB", 1, 0, 3 + len(body), 1, 23, len(body)) + body
    exception = struct.pack(">HHHBBB", 1, 0, 3, 1, 0x97, 4)
    every = TID | CRC_RIGHT | ACCEPTED_RIGHT
    return [bytes([flags]) + one for one in (right, exception) for flags in (every, every | SPLIT)]


def run_modbus(data: bytes) -> bool:
    """Decode bytes as the answer of an arm, and the registers in them as status and command."""
    taken = fake_arm().ask(data)
    body = data[10 : 10 + 2 * _REGISTERS]
    registers = list(struct.unpack(f">{len(body) // 2}H", body[: len(body) // 2 * 2]))
    with suppress(ArmAnswerError):
        decode_status(registers)
    controller = Controller(AT_REST_RAD, servo_lag_s=0.02, noise_rad=0.0, watchdog_s=0.1)
    for block in (registers[:20], registers):
        controller.receive_command(block)
        controller.advance(0.01)
    assert in_range(controller.servo.joints_rad)
    assert len(controller.status_registers()) == _REGISTERS
    assert STATUS_ADDRESS == 100
    return taken


def in_range(joints_rad: np.ndarray[Any, Any]) -> bool:
    return RV_1A_MECHANICS.is_in_range(joints_rad)


# The manufacturer's real-time protocol.


def mxt_seeds() -> list[bytes]:
    controller = _mxt_controller()
    controller.receive_command(encode_mxt(0), ("a", 1))
    controller.advance(0.0075)
    answer = controller.answers[0][0]
    move = encode_mxt(1, send_type=2, data=AT_REST_RAD.tolist())
    return [answer, encode_mxt(0) + move + encode_mxt(255)]


def _mxt_controller() -> MxtController:
    return MxtController(
        AT_REST_RAD, servo_lag_s=0.02, filter_s=FILTER_S, noise_rad=0.0, timeout_s=0.1
    )


def run_mxt(data: bytes) -> bool:
    """Decode bytes as an answer of the controller, and each packet as a command."""
    taken = True
    try:
        status = decode_answer(data)
    except (ArmAnswerError, ArmRefusedError):
        taken = False
    else:
        assert np.isfinite(status.joints_rad).all()
    controller = _mxt_controller()
    for start in range(0, min(len(data), 40 * PACKET_BYTES), PACKET_BYTES):
        controller.receive_command(data[start : start + PACKET_BYTES], ("a", 1))
        controller.advance(0.0072)
        assert in_range(controller.servo.joints_rad)
    return taken


def mutate_mxt(data: bytes, chance: random.Random) -> bytes:
    """Mutate the numbers or bytes of a packet, or duplicate packets."""
    if len(data) >= PACKET_BYTES and chance.random() < 0.5:
        place = chance.randrange(len(data) // PACKET_BYTES) * PACKET_BYTES
        odd = chance.choice((float("nan"), float("inf"), -1e30, 0.0, 3.0, 1e-40))
        at = place + 8 + 4 * chance.randrange(8)
        if chance.random() < 0.3:
            return data + data[place : place + PACKET_BYTES] * chance.choice((1, 30))
        return data[:at] + struct.pack("<f", odd) + data[at + 4 :]
    return mutate_bytes(data, chance)


TARGETS = {
    one.name: one
    for one in (
        Target("wire", "messages: header, arrays, fields", wire_seeds, run_wire, mutate_wire),
        Target("bag", "bag files, cut and whole", bag_seeds, run_bag, mutate_bag),
        Target("launch", "launch files and settings", launch_seeds, run_launch, mutate_launch),
        Target("scene", "scene files", scene_seeds, run_scene, mutate_yaml),
        Target("mesh", "STL and OBJ files of a scene", mesh_seeds, run_mesh, mutate_mesh),
        Target("modbus", "answers and registers of an arm", modbus_seeds, run_modbus, mutate_bytes),
        Target("mxt", "packets of the manufacturer's controller", mxt_seeds, run_mxt, mutate_mxt),
    )
}
