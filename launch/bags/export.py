"""Export bags for other tools: MCAP files for Foxglove and Rerun, or bags of ROS 2.

`flexsheet.launch.viewing.channels` defines the channels for Foxglove, and
`flexsheet.launch.ros2.mapping` the topics and types of ROS 2. The timestamps in the exported file
are the times of recording. They count from 1970 if the bag contains the wall-clock time of its
start. Otherwise, they count from the time when the recording computer was started.
"""

from __future__ import annotations

import errno
import os
import shutil
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, Literal

from flexsheet.launch.ros2.mapping import (
    CONTEXT_TOPICS,
    Converter,
    RosTopic,
    load_ros_types,
    split_time,
)
from flexsheet.messages.bag import BagReader
from flexsheet.messages.base import Header, Message
from flexsheet.messages.errors import FlexsheetError
from flexsheet.messages.files import free_bytes, make_write_error
from flexsheet.messages.topics import TOPICS

MIN_FREE_BYTES = 4 << 20
"""The minimum free disk space (bytes) during an export.

It exceeds the size of the write buffer of the Foxglove library.
"""

MESH_PERIOD_NS = 100_000_000
"""The minimum time (ns) between two exported meshes of a channel, which limits the file size."""

METADATA_VERSION = 8
"""The format version of metadata.yaml, which ROS 2 Humble and later releases can read."""


class ExportError(FlexsheetError, RuntimeError):
    """Raised if a bag cannot be exported. The text gives the reason and the remedy."""

    remedy = "Install the package that the text names, or choose another output file."


@dataclass(slots=True)
class ExportResult:
    """The result of an export.

    messages: number of exported messages of each channel.
    unreadable: names of the topics that could not be read.
    """

    output: Path
    messages: dict[str, int]
    unreadable: tuple[str, ...]


def export(
    bag: Path,
    output: Path,
    form: Literal["foxglove", "ros2"] = "foxglove",
    *,
    topics: Iterable[str] | None = None,
    progress: Callable[[float, float], None] = lambda done_s, whole_s: None,
) -> ExportResult:
    """Export a bag. Topics whose message type has changed since the recording are omitted.

    output: MCAP file to write, or for ROS 2 the folder of a bag. If the name of the folder ends
        with .mcap, only the MCAP file is written.
    topics: names of the topics to export, or None for all topics.
    progress: function that is called with the duration exported so far and the total duration (s).

    Raises ExportError or Ros2Error if the export fails, and BagError if the bag cannot be read.
    """
    if output.exists():
        raise ExportError(f"{output}: the file exists already; give the name of a new file")
    reader = BagReader(bag)
    summary = reader.info()
    wanted = set(reader.topics if topics is None else topics)
    if absent := sorted(wanted - reader.topics.keys()):
        names = ", ".join(sorted(reader.topics)) or "no topic"
        raise ExportError(
            f"{bag}: the bag does not contain the topics {', '.join(absent)}; it contains {names}"
        )
    readable = {one.name for one in summary.topics if one.readable}
    selected = readable & wanted
    draft = output.with_name(f"{output.name}.part")
    counts: Counter[str] = Counter()
    try:
        shutil.rmtree(draft, ignore_errors=True)
        _check_free_space(output)
        target = _FoxgloveFile(draft, reader) if form == "foxglove" else _Ros2Bag(draft, reader)
        try:
            for number, (topic, message, header, log_ns) in enumerate(
                BagReader(bag, selected | (CONTEXT_TOPICS & readable))
            ):
                # On a full disk, the Foxglove library would print a line for each message.
                _check_free_space(output)
                counts.update(target.write(topic, message, header, log_ns, topic in selected))
                if number % 200 == 0:
                    progress((log_ns - summary.start_ns) * 1e-9, summary.duration_s)
        finally:
            made = target.close()
        (made / f"{made.name}.mcap" if made.is_dir() and output.suffix == ".mcap" else made).rename(
            output
        )
    except FlexsheetError:
        raise
    except OSError as error:
        raise ExportError(str(make_write_error(output, error))) from error
    except RuntimeError as error:
        raise ExportError(f"{output}: cannot be written: {error}") from error
    finally:
        shutil.rmtree(draft, ignore_errors=True)
        draft.unlink(missing_ok=True)
    return ExportResult(output, dict(counts), tuple(sorted(wanted - readable)))


class _FoxgloveFile:
    """An MCAP file with the channels of Foxglove."""

    def __init__(self, draft: Path, reader: BagReader) -> None:
        import foxglove

        from flexsheet.launch.viewing import channels

        self._library, self._draft = channels, draft
        self._state = channels.ViewState()
        self._context = foxglove.Context()
        self._writer = foxglove.open_mcap(draft, context=self._context, allow_overwrite=True)
        self._writer.write_metadata("flexsheet", {"bag": reader.path.name})
        self._offset_ns = wall_clock_offset_ns(reader) or 0
        self._opened: dict[str, Any] = {}
        self._due_ns: dict[tuple[str, str], int] = {}
        self._channels: dict[str, list[channels.Channel]] = {}
        for channel in channels.list_channels(
            [TOPICS[name] for name in reader.topics if name in TOPICS]
        ):
            for topic in channel.triggers:
                self._channels.setdefault(topic, []).append(channel)

    def write(
        self, topic: str, message: Message, _: Header, log_ns: int, wanted: bool
    ) -> Iterator[str]:
        """Write a message, and yield the names of the channels. Only store it if not wanted."""
        self._state.update(topic, message)
        at_ns = log_ns + self._offset_ns
        stamp = self._library.make_stamp(at_ns)
        for channel in self._channels[topic] if wanted else ():
            if at_ns < self._due_ns.get((channel.name, topic), 0):
                continue
            value = channel.make(self._state, message, stamp)
            if value is None:
                continue
            if channel.name not in self._opened:
                self._opened[channel.name] = self._library.open_channel(channel, self._context)
            self._opened[channel.name].log(value, log_time=at_ns)
            if channel.pace is self._library.Pace.IMAGES and channel.kind == "SceneUpdate":
                self._due_ns[channel.name, topic] = at_ns + MESH_PERIOD_NS
            yield channel.name

    def close(self) -> Path:
        self._writer.close()
        return self._draft


class _Ros2Bag:
    """A bag of ROS 2: a folder with metadata.yaml and an MCAP file with messages in CDR."""

    def __init__(self, draft: Path, reader: BagReader) -> None:
        self._ros = load_ros_types()
        from rosbags.rosbag2 import StoragePlugin, Writer

        draft.mkdir()
        self._folder = draft / draft.stem
        self._writer = Writer(
            self._folder, version=METADATA_VERSION, storage_plugin=StoragePlugin.MCAP
        )
        self._writer.open()
        self._converter = Converter(self._ros)
        self._connections: dict[str, Any] = {}
        self._clock_id = reader.metadata.get("recording", {}).get("clock_id")
        self._offset_ns = wall_clock_offset_ns(reader) or 0

    def write(
        self, topic: str, message: Message, header: Header, log_ns: int, wanted: bool
    ) -> Iterator[str]:
        """Write a message, and yield the names of the ROS topics. Only store it if not wanted."""
        at_ns = log_ns + self._offset_ns
        split_time(at_ns)
        # The delay between publication and recording is negligible.
        same_clock = header.clock_id == self._clock_id
        shift_ns = self._offset_ns if same_clock else at_ns - header.publish_ns
        for ros_topic, made in self._converter.convert(topic, message, header, shift_ns):
            if not wanted:
                continue
            if ros_topic.name not in self._connections:
                self._connections[ros_topic.name] = self._writer.add_connection(
                    ros_topic.name,
                    ros_topic.ros_type,
                    typestore=self._ros.store,
                    offered_qos_profiles=[make_qos(ros_topic)],
                )
            cdr = self._ros.encode(ros_topic.ros_type, made)
            self._writer.write(self._connections[ros_topic.name], at_ns, cdr)
            yield ros_topic.name

    def close(self) -> Path:
        self._writer.close()
        return self._folder


def _check_free_space(output: Path) -> None:
    """Raise OSError if the disk on which the output file will be written is nearly full."""
    if free_bytes(output.parent) < MIN_FREE_BYTES:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def wall_clock_offset_ns(reader: BagReader) -> int | None:
    """Return the offset (ns) to add to recorded times to obtain times since 1970.

    Return None if the bag does not contain the wall-clock time of its start.
    """
    recording = reader.metadata.get("recording", {})
    try:
        started = datetime.fromisoformat(recording["started"])
        return int(started.timestamp() * 1e9) - int(recording["started_ns"])
    except (KeyError, ValueError):
        return None


def make_qos(topic: RosTopic) -> Any:
    """Return the ROS 2 quality of service for a topic.

    All topics are reliable. A latched topic is also transient local, so that late subscribers
    receive its last message.
    """
    from rosbags.interfaces import (
        Qos,
        QosDurability,
        QosHistory,
        QosLiveliness,
        QosReliability,
        QosTime,
    )

    unlimited = QosTime(2147483647, 4294967295)
    return Qos(
        history=QosHistory.KEEP_LAST,
        depth=1 if topic.latched else 10,
        reliability=QosReliability.RELIABLE,
        durability=QosDurability.TRANSIENT_LOCAL if topic.latched else QosDurability.VOLATILE,
        deadline=unlimited,
        lifespan=unlimited,
        liveliness=QosLiveliness.AUTOMATIC,
        liveliness_lease_duration=unlimited,
        avoid_ros_namespace_conventions=False,
    )
