"""Bags: MCAP files that hold the wire's bytes as they are, with their schemas and their time.

What MCAP leaves to the application is decided here:

- Profile "flexsheet"; one schema per message type (JSON Schema); one channel per topic, encoding
  "flexsheet/2", with the type's fingerprint in the channel's metadata.
- `log_time` is when the recorder received the message, `publish_time` is the header's source
  stamp; both in ns of a monotonic clock, not since 1970.
- A message's data are its frames: uint32 number of frames, four zero bytes, a uint64 length per
  frame, then the frames, each padded with zeros to a multiple of eight, so that arrays are aligned
  when they are read in place.  All little-endian.

A writer hands its data to the disk each second by itself.  A reader walks over the records and
never needs the index at the end, so a file cut by a crash is no special case: it just ends earlier,
and `BagReader.complete` is false.
"""

from __future__ import annotations

import json
import os
import struct
import threading
import zlib
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from heapq import heappop, heappush
from io import BytesIO
from pathlib import Path
from types import TracebackType
from typing import IO, Any

import zstandard
from mcap import records as mcap_records
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.stream_reader import breakup_chunk
from mcap.writer import MCAP0_MAGIC, CompressionType, Writer

from flexsheet.messages.base import Header, Message, schema_fingerprint
from flexsheet.messages.errors import FlexsheetError
from flexsheet.messages.files import write_error
from flexsheet.messages.migrations import RENAMED_TOPICS, RENAMED_TYPES, Migration, find_migration
from flexsheet.messages.topics import TOPICS, Topic, UnknownTopicError, find_topic
from flexsheet.messages.wire import PROTOCOL, WireError, encode, read_envelope

PROFILE = "flexsheet"
CHUNK_BYTES = 1 << 20
FLUSH_PERIOD_S = 1.0
MAX_SUMMARY_RECORD_BYTES = 64 << 20
MAX_CHUNK_BYTES = 256 << 20
"""Largest uncompressed chunk; a writer closes a chunk with the message that exceeds 1 MiB."""

_RECORD_HEAD = struct.Struct("<BQ")
_CHUNK_HEAD = struct.Struct("<QQQ")


class BagError(FlexsheetError):
    """A bag that cannot be written or read; the sentence names the file and says what is wrong."""

    code = "bag"
    remedy = (
        "`flexsheet bag info BAG` reports how much can be read. `flexsheet bag recover` makes a "
        "whole bag of it."
    )


def join_frames(frames: Sequence[Any]) -> bytes:
    """The data of one recorded message; the layout is in the module's text."""
    lengths = [len(frame) for frame in frames]
    parts: list[Any] = [struct.pack(f"<II{len(lengths)}Q", len(lengths), 0, *lengths)]
    for frame, length in zip(frames, lengths, strict=True):
        parts += (frame, bytes(-length % 8))
    return b"".join(parts)


def split_frames(data: bytes) -> list[memoryview]:
    """The frames of `join_frames`, as views; raises WireError where `data` is something else."""
    view = memoryview(data)
    count = struct.unpack_from("<I", view)[0] if len(view) >= 8 else 0
    offset = 8 + 8 * count
    if not count or offset > len(view):
        raise WireError("malformed", "recorded data are not frames")
    frames = []
    for length in struct.unpack_from(f"<{count}Q", view, 8):
        frames.append(view[offset : offset + length])
        offset += length + -length % 8
    if offset != len(view):
        raise WireError("malformed", f"recorded frames need {offset} bytes, there are {len(view)}")
    return frames


class BagWriter:
    """Writes one bag; a context manager.  Methods may be called from one thread.

    metadata: named records of text, for what identifies the recording (clock, hosts, git state).
    compress: zstd per chunk of about 1 MiB; without, pictures cost less time and more disk.

    Each second a thread of its own hands what was written to the disk (fsync), so that a killed
    process loses at most the last second, and a power cut little more.
    """

    def __init__(
        self,
        path: Path | str,
        metadata: Mapping[str, Mapping[str, str]] | None = None,
        *,
        compress: bool = True,
    ) -> None:
        self.path = Path(path)
        self.messages = 0
        self._schemas: dict[type[Message], int] = {}
        self._channels: dict[str, int] = {}
        self._failure: OSError | None = None
        try:
            self._file: IO[bytes] = self.path.open("xb")
        except FileExistsError:
            raise BagError(f"{self.path}: exists already; a bag is never written over") from None
        except OSError as error:
            raise BagError(str(write_error(self.path, error))) from error
        self._writer: Any = Writer(  # mcap's types are incomplete
            self._file,
            chunk_size=CHUNK_BYTES,
            compression=CompressionType.ZSTD if compress else CompressionType.NONE,
        )
        self._lock = threading.Lock()
        self._closing = threading.Event()
        try:
            with self._writing():
                self._writer.start(profile=PROFILE, library="flexsheet")
                self._file.flush()
        except BagError:
            # What is buffered cannot be written either; the error that is raised says why.
            with suppress(OSError):
                self._file.close()
            self.path.unlink(missing_ok=True)
            raise
        for name, values in (metadata or {}).items():
            self.add_metadata(name, values)
        self._flusher = threading.Thread(target=self._flush_regularly, name="bag", daemon=True)
        self._flusher.start()

    def write(self, topic: Topic, message: Message, header: Header, log_time_ns: int) -> None:
        """Record a message with the bytes that it has on the wire."""
        self.write_frames(topic, encode(message, header), header, log_time_ns)

    def write_frames(
        self, topic: Topic, frames: Sequence[Any], header: Header, log_time_ns: int
    ) -> None:
        """Record a message whose frames are at hand."""
        data = join_frames(frames)
        with self._writing():
            self._writer.add_message(
                self._channels.get(topic.name) or self._register(topic),
                log_time=log_time_ns,
                data=data,
                publish_time=header.source_ns,
                sequence=header.sequence & 0xFFFFFFFF,
            )
            self.messages += 1

    def add_attachment(self, name: str, data: bytes, media_type: str) -> None:
        """Put a whole file into the bag: launch file, scene, calibration, git state."""
        with self._writing():
            self._writer.add_attachment(0, 0, name, media_type, data)

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Put a named table of text into the bag."""
        with self._writing():
            self._writer.add_metadata(name, dict(values))

    def flush(self) -> None:
        """Hand all that was written to the disk, and wait for it."""
        with self._writing():
            self._writer.flush()
        # Outside the lock: a slow disk must not keep the next message waiting.
        try:
            os.fsync(self._file.fileno())
        except OSError as error:
            self._failure = error
            raise BagError(str(write_error(self.path, error))) from error

    def close(self) -> None:
        """Write the index and close; raises BagError if the disk did not take everything."""
        if self._file.closed:
            return
        self._closing.set()
        self._flusher.join()
        try:
            with self._lock:
                self._writer.finish()
                self._file.flush()
            os.fsync(self._file.fileno())
            self._file.close()
        except OSError as error:
            self._failure = self._failure or error
            with suppress(OSError):
                self._file.close()
        if self._failure is not None:
            raise BagError(str(write_error(self.path, self._failure))) from self._failure

    def __enter__(self) -> BagWriter:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def _flush_regularly(self) -> None:
        while not self._closing.wait(FLUSH_PERIOD_S):
            try:
                self.flush()
            except BagError:
                return  # kept in _failure: the next call says it again

    @contextmanager
    def _writing(self) -> Iterator[None]:
        """The lock held, the file open; what the disk refuses becomes a BagError."""
        with self._lock:
            if self._file.closed:
                raise BagError(f"{self.path}: the bag is closed")
            try:
                if self._failure is not None:
                    raise self._failure
                yield
            except OSError as error:
                self._failure = error
                raise BagError(str(write_error(self.path, error))) from error

    def _register(self, topic: Topic) -> int:
        kind = topic.message
        if kind not in self._schemas:
            schema = json.dumps(kind.model_json_schema()).encode()
            self._schemas[kind] = self._writer.register_schema(kind.__name__, "jsonschema", schema)
        self._channels[topic.name] = self._writer.register_channel(
            topic.name,
            PROTOCOL,
            self._schemas[kind],
            {
                "type": kind.__name__,
                "fingerprint": schema_fingerprint(kind).hex(),
                "delivery": topic.delivery.value,
            },
        )
        return self._channels[topic.name]


@dataclass(slots=True)
class Chunk:
    """A chunk's place, its span of log time, and the log times of its messages per channel."""

    offset: int
    length: int
    start_ns: int
    end_ns: int
    times_ns: dict[int, list[int]] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Reading:
    """How the messages of one channel are read: the type as recorded, and how to migrate it."""

    topic: Topic
    recorded_type: str
    fingerprint: bytes
    migrate: Migration


@dataclass(frozen=True, slots=True)
class TopicInfo:
    """What a bag holds of one topic.

    readable: the type's fields are what they are in this code, or can be made so (`migrations`).
    """

    name: str
    type: str
    count: int
    rate_hz: float
    readable: bool


@dataclass(frozen=True, slots=True)
class AttachmentInfo:
    """A file that was put into the bag, and where in the bag it is."""

    name: str
    media_type: str
    size_bytes: int
    offset: int
    length: int


@dataclass(frozen=True, slots=True)
class BagInfo:
    """The summary of a bag; times are on the recorder's clock.

    problem: why the bag is not complete, in a sentence.
    """

    path: Path
    size_bytes: int
    complete: bool
    problem: str
    start_ns: int
    duration_s: float
    count: int
    topics: tuple[TopicInfo, ...]
    attachments: tuple[AttachmentInfo, ...]
    metadata: dict[str, dict[str, str]]


class BagReader:
    """Reads a bag, whole or cut; iterating gives (topic name, message, header, log_time_ns).

    topics: names; default all.  start_ns, end_ns: of log time, the end excluded.
    Messages come in the order of log time.
    """

    def __init__(
        self,
        path: Path | str,
        topics: Collection[str] | None = None,
        *,
        start_ns: int | None = None,
        end_ns: int | None = None,
    ) -> None:
        self.path = Path(path)
        self.complete = False
        self.problem = ""
        self.metadata: dict[str, dict[str, str]] = {}
        self._topics = (
            None if topics is None else frozenset(RENAMED_TOPICS.get(name, name) for name in topics)
        )
        self._start_ns, self._end_ns = start_ns, end_ns
        self.channels: dict[int, mcap_records.Channel] = {}
        self.schemas: dict[int, mcap_records.Schema] = {}
        self.chunks: list[Chunk] = []
        self.attachments: list[AttachmentInfo] = []
        try:
            with self.path.open("rb") as file:
                self._walk(file)
                self._fill_in_what_the_index_lacks(file)
        except OSError as error:
            raise BagError(f"{self.path}: cannot be read: {error.strerror or error}") from error
        self._check_topics()

    def __iter__(self) -> Iterator[tuple[str, Message, Header, int]]:
        """Decoded messages, as of today: see `messages.migrations` for types that have changed.

        Raises BagError for a topic whose type has changed in a way that nobody knows how to follow.
        """
        readable = {
            channel.topic: self._reading_of(channel) for channel in self._selected().values()
        }
        for number, (name, frames, log_time_ns) in enumerate(self.frames()):
            reading = readable[name]
            try:
                message, header = _open(frames, reading)
            except WireError as error:
                raise BagError(
                    f'{self.path}: topic "{name}", message {number} at {log_time_ns} ns: {error}'
                ) from error
            yield name, message, header, log_time_ns

    def open_record(
        self, channel: mcap_records.Channel, record: mcap_records.Message
    ) -> tuple[Message, Header]:
        """Decode one record of `records` or `read_chunk`, as iterating does; BagError."""
        try:
            return _open(split_frames(record.data), self._reading_of(channel))
        except WireError as error:
            raise BagError(
                f'{self.path}: topic "{channel.topic}" at {record.log_time} ns: {error}'
            ) from error

    def frames(self) -> Iterator[tuple[str, list[memoryview], int]]:
        """(topic name, frames, log_time_ns), as recorded, whatever the types are today."""
        for channel, record in self.records():
            try:
                frames = split_frames(record.data)
            except WireError as error:
                raise BagError(f'{self.path}: topic "{channel.topic}": {error}') from error
            yield channel.topic, frames, record.log_time

    def records(self) -> Iterator[tuple[mcap_records.Channel, mcap_records.Message]]:
        """MCAP's own records, in the order of log time."""
        selected = self._selected()
        start = self._start_ns if self._start_ns is not None else -1
        end = self._end_ns if self._end_ns is not None else 1 << 64
        waiting: list[tuple[int, int, mcap_records.Message]] = []
        order = 0
        with self.path.open("rb") as file:
            for chunk in sorted(self.chunks, key=lambda chunk: chunk.start_ns):
                if chunk.end_ns < start or chunk.start_ns >= end:
                    continue
                if chunk.times_ns.keys().isdisjoint(selected):
                    continue
                while waiting and waiting[0][0] < chunk.start_ns:
                    message = heappop(waiting)[2]
                    yield selected[message.channel_id], message
                for record in self.read_chunk(file, chunk):
                    if (
                        isinstance(record, mcap_records.Message)
                        and record.channel_id in selected
                        and start <= record.log_time < end
                    ):
                        order += 1
                        heappush(waiting, (record.log_time, order, record))
        while waiting:
            message = heappop(waiting)[2]
            yield selected[message.channel_id], message

    @property
    def topics(self) -> dict[str, str]:
        """The recorded topics and their types' names."""
        return {channel.topic: _type_of(channel) for channel in self.channels.values()}

    def attachment(self, name: str) -> bytes:
        """The newest attachment of that name; raises BagError if there is none."""
        for held in reversed(self.attachments):
            if held.name == name:
                with self.path.open("rb") as file:
                    body = _read_at(file, held.offset, held.length)
                return _parse_attachment(body).data
        names = ", ".join(held.name for held in self.attachments) or "none"
        raise BagError(f'{self.path}: no attachment "{name}"; there are: {names}')

    def info(self) -> BagInfo:
        """The summary of the whole bag, whatever this reader selects."""
        times: dict[int, list[int]] = {}
        for chunk in self.chunks:
            for channel_id, stamps in chunk.times_ns.items():
                times.setdefault(channel_id, []).extend(stamps)
        topics = []
        for channel_id, channel in self.channels.items():
            stamps = times.get(channel_id, [])
            span_s = (max(stamps) - min(stamps)) * 1e-9 if stamps else 0.0
            topics.append(
                TopicInfo(
                    name=channel.topic,
                    type=_type_of(channel),
                    count=len(stamps),
                    rate_hz=(len(stamps) - 1) / span_s if span_s > 0.0 else 0.0,
                    readable=self._migration_of(channel) is not None,
                )
            )
        stamps = [stamp for channel_stamps in times.values() for stamp in channel_stamps]
        start_ns = min(stamps, default=0)
        return BagInfo(
            path=self.path,
            size_bytes=self.path.stat().st_size,
            complete=self.complete,
            problem=self.problem,
            start_ns=start_ns,
            duration_s=(max(stamps, default=0) - start_ns) * 1e-9,
            count=len(stamps),
            topics=tuple(sorted(topics, key=lambda topic: topic.name)),
            attachments=tuple(self.attachments),
            metadata=self.metadata,
        )

    def _walk(self, file: IO[bytes]) -> None:
        """Find every whole record; where one is cut or makes no sense, the bag ends."""
        size = os.fstat(file.fileno()).st_size
        magic = file.read(len(MCAP0_MAGIC))
        if magic != MCAP0_MAGIC:
            what = "is empty" if not magic else "is no MCAP file"
            raise BagError(f"{self.path}: {what}; bags are written by `flexsheet bag record`")
        offset = len(MCAP0_MAGIC)
        first = True
        while True:
            head = _read_at(file, offset, _RECORD_HEAD.size)
            if len(head) < _RECORD_HEAD.size:
                self.problem = f"cut after {offset} of {size} bytes; it was not closed"
                break
            opcode, length = _RECORD_HEAD.unpack(head)
            offset += _RECORD_HEAD.size
            if offset + length > size or opcode == 0:
                self.problem = (
                    f"cut after {offset - _RECORD_HEAD.size} of {size} bytes; it was not closed"
                )
                break
            if first and opcode != Opcode.HEADER:
                raise BagError(f"{self.path}: its first record is no header; not a bag")
            try:
                self._note_record(file, opcode, offset, length)
            except BagError:
                raise
            # What the parsers raise on foreign bytes is not specified: struct.error, ValueError...
            except Exception as error:
                if first:
                    raise BagError(f"{self.path}: its header is damaged: {error}") from error
                self.problem = f"damaged record at byte {offset}: {type(error).__name__}: {error}"
            first = False
            offset += length
            if opcode == Opcode.FOOTER:
                if _read_at(file, offset, len(MCAP0_MAGIC)) != MCAP0_MAGIC:
                    self.problem = f"cut in its last bytes, at {offset} of {size}"
                self.complete = not self.problem
                break
        if first:
            raise BagError(f"{self.path}: {self.problem}; it holds nothing")

    def _note_record(self, file: IO[bytes], opcode: int, offset: int, length: int) -> None:
        if opcode == Opcode.CHUNK:
            head = _CHUNK_HEAD.unpack(_read_at(file, offset, _CHUNK_HEAD.size))
            self.chunks.append(Chunk(offset, length, head[0], head[1]))
            return
        if opcode == Opcode.ATTACHMENT:
            held = _parse_attachment(_read_at(file, offset, length))
            self.attachments.append(
                AttachmentInfo(held.name, held.media_type, len(held.data), offset, length)
            )
            return
        if opcode not in (
            Opcode.HEADER,
            Opcode.CHANNEL,
            Opcode.SCHEMA,
            Opcode.METADATA,
            Opcode.MESSAGE_INDEX,
        ):
            return
        if length > MAX_SUMMARY_RECORD_BYTES:
            raise ValueError(f"a record of {length} bytes")
        stream = ReadDataStream(BytesIO(_read_at(file, offset, length)))
        if opcode == Opcode.HEADER:
            profile = mcap_records.Header.read(stream).profile
            if profile != PROFILE:
                raise BagError(
                    f'{self.path}: an MCAP file of profile "{profile[:40]}", not of flexsheet'
                )
        elif opcode == Opcode.CHANNEL:
            self._add_channel(mcap_records.Channel.read(stream))
        elif opcode == Opcode.SCHEMA:
            schema = mcap_records.Schema.read(stream)
            self.schemas[schema.id] = schema
        elif opcode == Opcode.METADATA:
            metadata = mcap_records.Metadata.read(stream)
            self.metadata[metadata.name] = metadata.metadata
        elif self.chunks:
            index = mcap_records.MessageIndex.read(stream)
            self.chunks[-1].times_ns[index.channel_id] = [time for time, _ in index.records]

    def _add_channel(self, channel: mcap_records.Channel) -> None:
        """Store a channel under the name that its topic has today."""
        channel.topic = RENAMED_TOPICS.get(channel.topic, channel.topic)
        self.channels[channel.id] = channel

    def _fill_in_what_the_index_lacks(self, file: IO[bytes]) -> None:
        """Read the chunks of a cut bag whose channels or message times are known no other way.

        The message indexes behind the last chunk may be cut off in part.  A chunk that is damaged
        is left for whoever wants its messages to stumble over.
        """
        for chunk in self.chunks:
            last = chunk is self.chunks[-1]
            if self.complete or (chunk.times_ns.keys() <= self.channels.keys() and not last):
                continue
            try:
                records = self.read_chunk(file, chunk)
            except BagError as error:
                self.problem = f"{self.problem}; {error}"
                continue
            times: dict[int, list[int]] = {}
            for record in records:
                if isinstance(record, mcap_records.Channel):
                    self._add_channel(record)
                elif isinstance(record, mcap_records.Schema):
                    self.schemas[record.id] = record
                elif isinstance(record, mcap_records.Message):
                    times.setdefault(record.channel_id, []).append(record.log_time)
            chunk.times_ns = times

    def read_chunk(self, file: IO[bytes], chunk: Chunk) -> list[mcap_records.McapRecord]:
        """The chunk's records; raises BagError if its bytes are not what was written."""
        body = _read_at(file, chunk.offset, chunk.length)
        try:
            parsed = mcap_records.Chunk.read(ReadDataStream(BytesIO(body)))
            parsed.data, parsed.compression = _unpacked(parsed), ""
            return breakup_chunk(parsed, validate_crc=True)
        # Decompression and parsing of damaged bytes raise what they like.
        except Exception as error:
            raise BagError(
                f"{self.path}: damaged chunk at byte {chunk.offset}: {type(error).__name__}: "
                f"{error}; `flexsheet bag recover` saves the others"
            ) from error

    def _check_topics(self) -> None:
        recorded = {channel.topic for channel in self.channels.values()}
        for name in (self._topics or frozenset()) - recorded:
            try:
                find_topic(name)
            except UnknownTopicError as error:
                raise BagError(f"{self.path}: {error}") from None

    def _selected(self) -> dict[int, mcap_records.Channel]:
        return {
            channel_id: channel
            for channel_id, channel in self.channels.items()
            if self._topics is None or channel.topic in self._topics
        }

    def _migration_of(self, channel: mcap_records.Channel) -> Migration | None:
        topic, schema = TOPICS.get(channel.topic), self.schemas.get(channel.schema_id)
        if topic is None or schema is None:
            return None
        try:
            recorded, fingerprint = json.loads(schema.data), channel.metadata["fingerprint"]
            bytes.fromhex(fingerprint)
        except (ValueError, KeyError, RecursionError):
            return None  # damaged
        return find_migration(topic.message, fingerprint, recorded)

    def _reading_of(self, channel: mcap_records.Channel) -> Reading:
        """Return how a channel's messages are read; BagError where no migration is known."""
        if channel.topic not in TOPICS:
            raise BagError(
                f'{self.path}: topic "{channel.topic}" does not exist any more; '
                "`BagReader.frames` still gives its bytes"
            )
        migration = self._migration_of(channel)
        if migration is None:
            raise BagError(
                f'{self.path}: topic "{channel.topic}" was recorded when '
                f"{channel.metadata.get('type', 'its type')} had other fields, and nothing in "
                "messages/migrations.py says how to follow; read it with the code of that time, or "
                "leave the topic out (`BagReader.frames` gives its bytes)"
            )
        return Reading(
            TOPICS[channel.topic],
            channel.metadata.get("type", TOPICS[channel.topic].message.__name__),
            bytes.fromhex(channel.metadata["fingerprint"]),
            migration,
        )


def _type_of(channel: mcap_records.Channel) -> str:
    """Return the name that a channel's message type has today."""
    recorded = channel.metadata.get("type", "")
    return RENAMED_TYPES.get(recorded, recorded)


def _open(frames: list[memoryview], reading: Reading) -> tuple[Message, Header]:
    """Decode a message as of today; WireError."""
    envelope = read_envelope(
        frames, reading.topic, fingerprint=reading.fingerprint, type_name=reading.recorded_type
    )
    envelope.fields = reading.migrate(envelope.fields)
    return envelope.open(), envelope.header


def info(path: Path | str) -> BagInfo:
    """The summary of a bag."""
    return BagReader(path).info()


@dataclass(frozen=True, slots=True)
class RecoverReport:
    """What `recover` saved, and what it could not: chunks, and messages of channels unknown."""

    messages: int
    attachments: int
    was_complete: bool
    problem: str
    damaged_chunks: int
    orphan_messages: int


def recover(
    path_in: Path | str,
    path_out: Path | str,
    *,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> RecoverReport:
    """Write a whole bag from what can be read of a cut or damaged one; the original stays.

    `progress` is told how many chunks are done, and of how many.  Raises BagError where nothing can
    be read, or the new file cannot be written or exists.
    """
    reader = BagReader(path_in)
    path_out = Path(path_out)
    messages = damaged = orphans = 0
    try:
        with path_out.open("xb") as out, reader.path.open("rb") as file:
            writer: Any = Writer(out, chunk_size=CHUNK_BYTES)
            writer.start(profile=PROFILE, library="flexsheet")
            for name, values in reader.metadata.items():
                writer.add_metadata(name, values)
            for held in reader.attachments:
                whole = _parse_attachment(_read_at(file, held.offset, held.length))
                writer.add_attachment(
                    whole.create_time, whole.log_time, whole.name, whole.media_type, whole.data
                )
            schemas: dict[int, int] = {}
            channels: dict[int, int] = {}
            for number, chunk in enumerate(reader.chunks):
                progress(number, len(reader.chunks))
                try:
                    records = reader.read_chunk(file, chunk)
                except BagError:
                    damaged += 1
                    continue
                for record in records:
                    if not isinstance(record, mcap_records.Message):
                        continue
                    channel = reader.channels.get(record.channel_id)
                    schema = reader.schemas.get(channel.schema_id) if channel else None
                    if channel is None or schema is None:
                        orphans += 1
                        continue
                    if schema.id not in schemas:
                        schemas[schema.id] = writer.register_schema(
                            schema.name, schema.encoding, schema.data
                        )
                    if channel.id not in channels:
                        channels[channel.id] = writer.register_channel(
                            channel.topic,
                            channel.message_encoding,
                            schemas[schema.id],
                            channel.metadata,
                        )
                    writer.add_message(
                        channels[channel.id],
                        log_time=record.log_time,
                        data=record.data,
                        publish_time=record.publish_time,
                        sequence=record.sequence,
                    )
                    messages += 1
            writer.finish()
    except FileExistsError:
        raise BagError(f"{path_out}: exists already; a bag is never written over") from None
    except OSError as error:
        with suppress(OSError):
            path_out.unlink(missing_ok=True)
        raise BagError(str(write_error(path_out, error))) from error
    if not BagReader(path_out).complete:
        raise BagError(f"{path_out}: the recovered bag cannot be read back; is the disk full?")
    return RecoverReport(
        messages=messages,
        attachments=len(reader.attachments),
        was_complete=reader.complete,
        problem=reader.problem,
        damaged_chunks=damaged,
        orphan_messages=orphans,
    )


def _read_at(file: IO[bytes], offset: int, length: int) -> bytes:
    file.seek(offset)
    return file.read(length)


def _unpacked(chunk: mcap_records.Chunk) -> bytes:
    """A chunk's records; ValueError where they are more than the chunk claims, or than is allowed.

    A few bytes of a packed chunk can stand for any number: no more is unpacked than is claimed.
    """
    claimed = chunk.uncompressed_size
    if claimed > MAX_CHUNK_BYTES:
        raise ValueError(f"claims {claimed} bytes, at most {MAX_CHUNK_BYTES} are allowed")
    match chunk.compression:
        case "":
            data = chunk.data
        case "zstd":
            with zstandard.ZstdDecompressor().stream_reader(chunk.data) as packed:
                data = packed.read(claimed + 1)
        case other:
            raise ValueError(f"is packed by {other[:40]!r}; bags are by zstd, or not at all")
    if len(data) != claimed:
        raise ValueError(f"claims {claimed} bytes unpacked, which it is not")
    return data


def _parse_attachment(body: bytes) -> mcap_records.Attachment:
    """Raises ValueError where the bytes are not what was written."""
    if zlib.crc32(memoryview(body)[:-4]) != int.from_bytes(body[-4:], "little"):
        raise ValueError("an attachment whose check sum is wrong")
    attachment: mcap_records.Attachment = mcap_records.Attachment.read(
        ReadDataStream(BytesIO(body))
    )
    return attachment
