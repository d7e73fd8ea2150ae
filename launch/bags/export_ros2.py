"""Export bags as bags of ROS 2, which `ros2 bag play` and RViz can read.

A bag of ROS 2 is an MCAP file with messages in CDR encoding. `flexsheet.launch.ros2.mapping`
defines the topics and types. Timestamps count from 1970 if the bag contains the wall-clock time of
its start. Otherwise, they count from the time when the recording computer was started.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from flexsheet.launch.bags.export import (
    ExportError,
    ExportResult,
    check_free_space,
    select_topics,
    wall_clock_offset_ns,
)
from flexsheet.launch.ros2.definitions import split_time
from flexsheet.launch.ros2.mapping import Converter, RosTopic, load_ros_types
from flexsheet.messages.bag import BagReader
from flexsheet.messages.files import make_write_error

METADATA_VERSION = 8
"""The format version of metadata.yaml, which ROS 2 Humble and later releases can read."""

MCAP_SUFFIX = ".mcap"


def export_ros2(
    bag: Path,
    output: Path,
    *,
    topics: Iterable[str] | None = None,
    progress: Callable[[float, float], None] = lambda done_s, whole_s: None,
) -> ExportResult:
    """Convert a bag to a bag of ROS 2.

    output: folder to create, which will contain metadata.yaml and an MCAP file. If the name ends
        with .mcap, only the MCAP file is written, and it contains the same metadata.
    topics: names of the flexsheet topics to convert, or None for all topics.
    progress: function that is called with the duration converted so far and the total duration (s).

    Raises ExportError or Ros2Error if the export fails, and BagError if the bag cannot be read.
    """
    ros = load_ros_types()
    from rosbags.rosbag2 import StoragePlugin, Writer

    selection = select_topics(bag, output, topics)
    offset_ns = wall_clock_offset_ns(selection.reader) or 0
    result = ExportResult(output, unreadable=selection.unreadable)
    converter = Converter(ros)
    connections: dict[str, Any] = {}
    draft = output.with_name(f"{output.name}.part")
    folder = draft / output.stem
    try:
        shutil.rmtree(draft, ignore_errors=True)
        check_free_space(output)
        draft.mkdir()
        with Writer(folder, version=METADATA_VERSION, storage_plugin=StoragePlugin.MCAP) as writer:
            reader = BagReader(bag, {*selection.readable, *selection.context})
            for number, (topic, message, header, log_ns) in enumerate(reader):
                check_free_space(output)
                split_time(log_ns + offset_ns)
                # The delay between publication and recording is negligible.
                same_clock = header.clock_id == selection.clock_id
                shift_ns = offset_ns if same_clock else offset_ns + log_ns - header.publish_ns
                for ros_topic, made in converter.convert(topic, message, header, shift_ns):
                    if topic not in selection.readable:
                        continue  # read only to convert other topics
                    connection = connections.get(ros_topic.name)
                    if connection is None:
                        connection = connections[ros_topic.name] = writer.add_connection(
                            ros_topic.name,
                            ros_topic.ros_type,
                            typestore=ros.store,
                            offered_qos_profiles=[make_qos(ros_topic)],
                        )
                    writer.write(
                        connection, log_ns + offset_ns, ros.encode(ros_topic.ros_type, made)
                    )
                    result.messages[ros_topic.name] = result.messages.get(ros_topic.name, 0) + 1
                if number % 200 == 0:
                    progress((log_ns - selection.start_ns) * 1e-9, selection.duration_s)
        made_path = folder / f"{folder.name}.mcap" if output.suffix == MCAP_SUFFIX else folder
        made_path.rename(output)
    except OSError as error:
        raise ExportError(str(make_write_error(output, error))) from error
    finally:
        shutil.rmtree(draft, ignore_errors=True)
    return result


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
