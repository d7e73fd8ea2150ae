"""Read and write bags: MCAP files that contain encoded messages, their schemas and their times.

The MCAP format leaves these details to the application:

- The profile is "flexsheet". Each message type has a schema (JSON Schema). Each topic has a channel
  with the encoding "flexsheet/2". The channel's metadata contain the fingerprint of the type.
- `log_time` is when the recorder received the message, and `publish_time` is the source timestamp
  in the message's header. Both are times of a monotonic clock, in ns, and do not count from 1970.
- The data of a message are its frames (byte strings of a ZeroMQ multipart message). The data begin
  with the number of frames (uint32), four zero bytes, and the length of each frame (uint64). Then
  the frames follow. Each frame is padded with zeros to a multiple of eight bytes, so that arrays
  are aligned and can be read without a copy. All numbers are little-endian.

A writer flushes its data to the disk every second. A reader scans the records from the start and
does not need the index at the end. If a crash has truncated a file, a reader can read the file up
to the truncation. The attribute `BagReader.complete` is then false.
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

from mcap import records as mcap_records
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.stream_reader import breakup_chunk
from mcap.writer import MCAP0_MAGIC, CompressionType, Writer

from flexsheet.messages.base import Header, Message, compute_fingerprint
from flexsheet.messages.errors import FlexsheetError
from flexsheet.messages.files import make_write_error
from flexsheet.messages.topics import TOPICS, Topic, UnknownTopicError, find_topic
from flexsheet.messages.wire import PROTOCOL, WireError, decode, encode

PROFILE = "flexsheet"
CHUNK_BYTES = 1 << 20
FLUSH_PERIOD_S = 1.0
MAX_CHUNK_BYTES = 256 << 20
"""The maximum uncompressed size of a chunk, in bytes, that a reader accepts.

A writer starts a new chunk after 1 MiB.
"""

_RECORD_HEAD = struct.Struct("<BQ")
_CHUNK_HEAD = struct.Struct("<QQQ")


class BagError(FlexsheetError):
    """Raised if a bag cannot be written or read. The text names the file and the cause."""

    remedy = (
        "`flexsheet bag info BAG` reports how much is readable. `flexsheet bag export BAG -o NEW "
        "--format bag` writes the readable part to a complete bag."
    )


class NoBagError(BagError):
    """Raised if a bag does not exist."""

    remedy = ""
    exit_code = 2


def join_frames(frames: Sequence[Any]) -> bytes:
    """Encode the ZeroMQ frames (parts) of a message as the data of one MCAP record.

    The docstring of the module specifies the layout.
    """
    lengths = [len(frame) for frame in frames]
    parts: list[Any] = [struct.pack(f"<II{len(lengths)}Q", len(lengths), 0, *lengths)]
    for frame, length in zip(frames, lengths, strict=True):
        parts += (frame, bytes(-length % 8))
    return b"".join(parts)


def split_frames(data: bytes) -> list[memoryview]:
    """Return views of the ZeroMQ frames (parts) of a message from the data of an MCAP record.

    Raises WireError if the data are invalid.
    """
    view = memoryview(data)
    count = struct.unpack_from("<I", view)[0] if len(view) >= 8 else 0
    offset = 8 + 8 * count
    if not count or offset > len(view):
        raise WireError(
            "malformed",
            "the recorded message does not begin with the lengths of its ZeroMQ frames; the bag is "
            "damaged or was written by another program",
        )
    frames = []
    for length in struct.unpack_from(f"<{count}Q", view, 8):
        frames.append(view[offset : offset + length])
        offset += length + -length % 8
    if offset != len(view):
        raise WireError(
            "malformed",
            f"the recorded message has {len(view)} bytes, but the lengths of its ZeroMQ frames "
            f"require {offset} bytes; the bag is damaged",
        )
    return frames


class BagWriter:
    """A writer of one bag file, which can be used as a context manager.

    All methods must be called from one thread. A separate thread flushes the file to the disk every
    second (fsync). If the process is killed, at most the last second of messages is lost. After a
    power failure, slightly more can be lost.

    metadata: named tables of text that identify the recording (clock, hosts, git state).
    compress: whether to compress chunks of about 1 MiB with zstd. If chunks are not compressed,
        images are written faster but need more disk space.

    Raises BagError if the file exists or cannot be created.
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
            raise BagError(
                f"{self.path}: the file exists already; a bag cannot be overwritten, so choose "
                "another file name"
            ) from None
        except OSError as error:
            raise BagError(str(make_write_error(self.path, error))) from error
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
            # The buffered data cannot be written either; the raised error gives the cause.
            with suppress(OSError):
                self._file.close()
            self.path.unlink(missing_ok=True)
            raise
        for name, values in (metadata or {}).items():
            self.add_metadata(name, values)
        self._flusher = threading.Thread(target=self._flush_regularly, name="bag", daemon=True)
        self._flusher.start()

    def write(self, topic: Topic, message: Message, header: Header, log_time_ns: int) -> None:
        """Encode a message and write it to the bag.

        log_time_ns: time when the message was received, ns of the recorder's clock.
        """
        self.write_frames(topic, encode(message, header), header, log_time_ns)

    def write_frames(
        self, topic: Topic, frames: Sequence[Any], header: Header, log_time_ns: int
    ) -> None:
        """Write a message that is already encoded as ZeroMQ frames (message parts).

        log_time_ns: time when the message was received, ns of the recorder's clock.
        """
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
        """Add the content of a file to the bag, such as the launch file or the scene.

        media_type: MIME type of the file.
        """
        with self._writing():
            self._writer.add_attachment(0, 0, name, media_type, data)

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Add a named table of strings that describe the recording to the bag."""
        with self._writing():
            self._writer.add_metadata(name, dict(values))

    def flush(self) -> None:
        """Write all buffered data to the disk, and wait until the disk has stored it."""
        with self._writing():
            self._writer.flush()
        # Flush outside the lock, so that a slow disk does not delay the next message.
        try:
            os.fsync(self._file.fileno())
        except OSError as error:
            self._failure = error
            raise BagError(str(make_write_error(self.path, error))) from error

    def close(self) -> None:
        """Write the index and close the file.

        Raises BagError if any data could not be written.
        """
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
            raise BagError(str(make_write_error(self.path, self._failure))) from self._failure

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
                return  # The error is stored in _failure; the next call raises it again.

    @contextmanager
    def _writing(self) -> Iterator[None]:
        """Lock the file while the context is active, and convert disk errors to BagError.

        Raises BagError if the file is closed.
        """
        with self._lock:
            if self._file.closed:
                raise BagError(f"{self.path}: cannot write, because the bag is closed")
            try:
                if self._failure is not None:
                    raise self._failure
                yield
            except OSError as error:
                self._failure = error
                raise BagError(str(make_write_error(self.path, error))) from error

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
                "fingerprint": compute_fingerprint(kind).hex(),
                "delivery": topic.delivery.value,
            },
        )
        return self._channels[topic.name]


@dataclass(slots=True)
class Chunk:
    """The position of a chunk in the bag file, and the times of its messages.

    offset, length: position and size of the chunk, in bytes.
    times_ns: times when the messages were recorded, as a list for each channel number.
    """

    offset: int
    length: int
    start_ns: int
    end_ns: int
    times_ns: dict[int, list[int]] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class TopicInfo:
    """A summary of the messages of one topic in a bag.

    readable: whether this version of flexsheet can decode the messages.
    """

    name: str
    type: str
    count: int
    rate_hz: float
    readable: bool


@dataclass(frozen=True, slots=True)
class AttachmentInfo:
    """The name, type and position of a file that is attached to a bag.

    offset, length: position and size (bytes) of the attachment's record in the bag.
    """

    name: str
    media_type: str
    size_bytes: int
    offset: int
    length: int


@dataclass(frozen=True, slots=True)
class BagInfo:
    """A summary of a bag. All times are on the recorder's clock.

    problem: reason why the bag is incomplete; empty if the bag is complete.
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
    """A reader of a complete or truncated bag.

    Iteration yields (topic name, message, header, log time in ns), in the order of log time. The
    log time is the time when the recorder received the message.

    topics: names of the topics to read; None means all topics.
    start_ns, end_ns: range of log time to read. A message at `end_ns` is not included.

    Raises BagError if the file cannot be read or is not a bag, or if a topic name is unknown.
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
        self._topics = None if topics is None else frozenset(topics)
        self._start_ns, self._end_ns = start_ns, end_ns
        self.channels: dict[int, mcap_records.Channel] = {}
        self.schemas: dict[int, mcap_records.Schema] = {}
        self.chunks: list[Chunk] = []
        self.attachments: list[AttachmentInfo] = []
        try:
            with self.path.open("rb") as file:
                self._scan(file)
                self._index_remaining_chunks(file)
        except FileNotFoundError as error:
            raise NoBagError(f"{self.path}: the file does not exist; check the path") from error
        except OSError as error:
            raise BagError(
                f"{self.path}: cannot be read: {error.strerror or error}; check the path"
            ) from error
        self._check_topics()

    def __iter__(self) -> Iterator[tuple[str, Message, Header, int]]:
        """Yield decoded messages in the order of recording.

        Raises BagError for an invalid message, and for a recorded type that differs from the
        current type of the topic.
        """
        for channel in self._selected().values():
            self._check_readable(channel)
        for channel, record in self.records():
            yield channel.topic, *self.open_record(channel, record), record.log_time

    def open_record(
        self, channel: mcap_records.Channel, record: mcap_records.Message
    ) -> tuple[Message, Header]:
        """Decode a record that `records` or `read_chunk` returned.

        Raises BagError if the record is invalid.
        """
        self._check_readable(channel)
        try:
            return decode(split_frames(record.data), TOPICS[channel.topic])
        except WireError as error:
            raise BagError(
                f'{self.path}: topic "{channel.topic}" at {record.log_time} ns: {error}'
            ) from error

    def frames(self) -> Iterator[tuple[str, list[memoryview], int]]:
        """Yield (topic name, ZeroMQ frames, log time in ns) of each message, without decoding."""
        for channel, record in self.records():
            try:
                frames = split_frames(record.data)
            except WireError as error:
                raise BagError(f'{self.path}: topic "{channel.topic}": {error}') from error
            yield channel.topic, frames, record.log_time

    def records(self) -> Iterator[tuple[mcap_records.Channel, mcap_records.Message]]:
        """Yield the MCAP channel and the MCAP message of each record, in the order of log time."""
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
        """Return a mapping from the name of each recorded topic to the name of its message type."""
        return {one.topic: one.metadata.get("type", "") for one in self.channels.values()}

    def attachment(self, name: str) -> bytes:
        """Return the content of the attachment with the given name.

        If several attachments have this name, the newest one is returned. Raises BagError if no
        attachment has this name.
        """
        for one in reversed(self.attachments):
            if one.name == name:
                with self.path.open("rb") as file:
                    body = _read_at(file, one.offset, one.length)
                return _parse_attachment(body).data
        names = ", ".join(one.name for one in self.attachments) or "none"
        raise BagError(
            f'{self.path}: does not contain the attachment "{name}"; attachments: {names}'
        )

    def info(self) -> BagInfo:
        """Return a summary of the whole bag, including messages that this reader skips."""
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
                    type=channel.metadata.get("type", ""),
                    count=len(stamps),
                    rate_hz=(len(stamps) - 1) / span_s if span_s > 0.0 else 0.0,
                    readable=_is_readable(channel),
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

    def _scan(self, file: IO[bytes]) -> None:
        """Index the records of the file. Skip damaged records, and stop at a truncated record."""
        size = os.fstat(file.fileno()).st_size
        magic = file.read(len(MCAP0_MAGIC))
        if magic != MCAP0_MAGIC:
            what = "the file is empty" if not magic else "this is not an MCAP file"
            raise BagError(f"{self.path}: {what}; use a bag that `flexsheet bag record` wrote")
        offset = len(MCAP0_MAGIC)
        first = True
        while True:
            head = _read_at(file, offset, _RECORD_HEAD.size)
            opcode, length = _RECORD_HEAD.unpack(head.ljust(_RECORD_HEAD.size, b"\0"))
            if offset + _RECORD_HEAD.size + length > size or opcode == 0:
                self.problem = f"truncated after {offset} of {size} bytes: it was not closed"
                break
            offset += _RECORD_HEAD.size
            if first and opcode != Opcode.HEADER:
                raise BagError(
                    f"{self.path}: its first record is not an MCAP header; "
                    "use a bag that `flexsheet bag record` wrote"
                )
            try:
                self._index_record(file, opcode, offset, length)
            except BagError:
                raise
            # The parsers raise unspecified errors on invalid bytes: struct.error, ValueError, ...
            except Exception as error:
                if first:
                    raise BagError(f"{self.path}: the MCAP header is damaged: {error}") from error
                self.problem = f"damaged record at byte {offset}: {type(error).__name__}: {error}"
            first = False
            offset += length
            if opcode == Opcode.FOOTER:
                if _read_at(file, offset, len(MCAP0_MAGIC)) != MCAP0_MAGIC:
                    self.problem = f"truncated in its last bytes, after {offset} of {size}"
                self.complete = not self.problem
                break
        if first:
            raise BagError(f"{self.path}: {self.problem}; the bag contains no readable record")

    def _index_record(self, file: IO[bytes], opcode: int, offset: int, length: int) -> None:
        if opcode == Opcode.CHUNK:
            head = _CHUNK_HEAD.unpack(_read_at(file, offset, _CHUNK_HEAD.size))
            self.chunks.append(Chunk(offset, length, head[0], head[1]))
            return
        if opcode == Opcode.ATTACHMENT:
            found = _parse_attachment(_read_at(file, offset, length))
            self.attachments.append(
                AttachmentInfo(found.name, found.media_type, len(found.data), offset, length)
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
        stream = ReadDataStream(BytesIO(_read_at(file, offset, length)))
        if opcode == Opcode.HEADER:
            profile = mcap_records.Header.read(stream).profile
            if profile != PROFILE:
                raise BagError(
                    f'{self.path}: the MCAP file has the profile "{profile[:40]}", expected '
                    '"flexsheet"; use a bag that `flexsheet bag record` wrote'
                )
        elif opcode == Opcode.CHANNEL:
            channel = mcap_records.Channel.read(stream)
            self.channels[channel.id] = channel
        elif opcode == Opcode.SCHEMA:
            schema = mcap_records.Schema.read(stream)
            self.schemas[schema.id] = schema
        elif opcode == Opcode.METADATA:
            metadata = mcap_records.Metadata.read(stream)
            self.metadata[metadata.name] = metadata.metadata
        elif self.chunks:
            index = mcap_records.MessageIndex.read(stream)
            self.chunks[-1].times_ns[index.channel_id] = [time for time, _ in index.records]

    def _index_remaining_chunks(self, file: IO[bytes]) -> None:
        """Index the chunks that the index in a truncated bag does not cover.

        The last chunk is always indexed, because the index record after it can be truncated. A
        damaged chunk is reported in `problem`. Reading its messages raises an error.
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
                    self.channels[record.id] = record
                elif isinstance(record, mcap_records.Schema):
                    self.schemas[record.id] = record
                elif isinstance(record, mcap_records.Message):
                    times.setdefault(record.channel_id, []).append(record.log_time)
            chunk.times_ns = times

    def read_chunk(self, file: IO[bytes], chunk: Chunk) -> list[mcap_records.McapRecord]:
        """Return the MCAP records of a chunk. Raises BagError if the chunk is damaged."""
        body = _read_at(file, chunk.offset, chunk.length)
        try:
            packed = mcap_records.Chunk.read(ReadDataStream(BytesIO(body)))
            if packed.uncompressed_size > MAX_CHUNK_BYTES:
                raise ValueError(f"it decompresses to {packed.uncompressed_size} bytes")
            return breakup_chunk(packed, validate_crc=True)
        # Decompression and parsing raise unspecified errors on damaged bytes.
        except Exception as error:
            raise BagError(
                f"{self.path}: damaged chunk at byte {chunk.offset}: "
                f"{str(error) or type(error).__name__}; `flexsheet bag export --format bag` "
                "saves the other chunks"
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

    def _check_readable(self, channel: mcap_records.Channel) -> None:
        """Raise BagError if this version of flexsheet cannot decode the messages of a channel."""
        if channel.topic not in TOPICS:
            raise BagError(
                f'{self.path}: this version of flexsheet has no topic "{channel.topic}"; '
                "`BagReader.frames` returns its messages without decoding"
            )
        if not _is_readable(channel):
            raise BagError(
                f'{self.path}: topic "{channel.topic}": the recorded message type '
                f"{channel.metadata.get('type', '')} differs from the current one; read the bag "
                "with the version of flexsheet that recorded it, or leave out the topic "
                "(`BagReader.frames` returns its messages as bytes)"
            )


def _is_readable(channel: mcap_records.Channel) -> bool:
    """Return whether the messages of a channel have the current type of its topic."""
    topic = TOPICS.get(channel.topic)
    if topic is None:
        return False
    return channel.metadata.get("fingerprint") == compute_fingerprint(topic.message).hex()


def info(path: Path | str) -> BagInfo:
    """Return a summary of a bag. Raises BagError if the bag cannot be read."""
    return BagReader(path).info()


@dataclass(frozen=True, slots=True)
class RecoverReport:
    """The result of the recovery of a bag.

    messages, attachments: numbers of recovered messages and attachments.
    was_complete: whether the original bag was complete.
    problem: reason why the original bag was incomplete; empty if it was complete.
    orphan_messages: number of messages that were not recovered because the bag does not describe
        their channel.
    """

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
    """Write the readable part of a truncated or damaged bag to a new bag.

    progress: function that is called with the number of processed chunks and the total number of
        chunks.

    Raises BagError if nothing is readable, or if the new file exists or cannot be written.
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
            for attached in reader.attachments:
                whole = _parse_attachment(_read_at(file, attached.offset, attached.length))
                writer.add_attachment(
                    whole.create_time, whole.log_time, whole.name, whole.media_type, whole.data
                )
            schemas = {
                one.id: writer.register_schema(one.name, one.encoding, one.data)
                for one in reader.schemas.values()
            }
            channels = {
                one.id: writer.register_channel(
                    one.topic, one.message_encoding, schemas[one.schema_id], one.metadata
                )
                for one in reader.channels.values()
                if one.schema_id in schemas
            }
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
                    if record.channel_id not in channels:
                        orphans += 1
                        continue
                    writer.add_message(
                        channels[record.channel_id],
                        log_time=record.log_time,
                        data=record.data,
                        publish_time=record.publish_time,
                        sequence=record.sequence,
                    )
                    messages += 1
            writer.finish()
    except FileExistsError:
        raise BagError(
            f"{path_out}: the file exists already; a bag cannot be overwritten, so choose "
            "another file name"
        ) from None
    except OSError as error:
        with suppress(OSError):
            path_out.unlink(missing_ok=True)
        raise BagError(str(make_write_error(path_out, error))) from error
    if not BagReader(path_out).complete:
        raise BagError(
            f"{path_out}: the recovered bag cannot be read again; check the disk and repeat"
        )
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


def _parse_attachment(body: bytes) -> mcap_records.Attachment:
    """Decode an attachment. Raises ValueError if its checksum is wrong."""
    if zlib.crc32(memoryview(body)[:-4]) != int.from_bytes(body[-4:], "little"):
        raise ValueError("an attachment is damaged: its checksum is wrong")
    attachment: mcap_records.Attachment = mcap_records.Attachment.read(
        ReadDataStream(BytesIO(body))
    )
    return attachment
