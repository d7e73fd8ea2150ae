"""Export bags as MCAP files with standard schemas, which Foxglove and rerun can open.

Each topic becomes a JSON channel of the same name. It contains the fields of the topic, except for
arrays of more than `json_channel.MAX_ARRAY` values. Images and 3D data become separate channels:

    stereo/left, stereo/right, frame/image, twin/eye/seen, twin/eye/expected     foxglove.RawImage
    tf          poses of the sheet and of both flanges                    foxglove.FrameTransforms
    finger      the fingertip with its predicted path                     foxglove.SceneUpdate
    sheet       the sheet between the flanges                             foxglove.SceneUpdate
    object      the deformed surface of the soft body                     foxglove.SceneUpdate

The axes of the world frame are x to the right, y up, and z towards the user. The timestamps in the
exported file are the times of recording. They count from 1970 if the bag contains the wall-clock
time of its start. Otherwise, they count from the time when the recording computer was started.
"""

from __future__ import annotations

import errno
import json
import os
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flexsheet.launch.ros2.mapping import CONTEXT_TOPICS, SHEET_COLOUR, find_sheet_corners
from flexsheet.launch.viewing.json_channel import make_schema
from flexsheet.launch.viewing.json_channel import to_json as _plain
from flexsheet.messages.bag import BagReader
from flexsheet.messages.base import Message
from flexsheet.messages.errors import FlexsheetError
from flexsheet.messages.files import free_bytes, make_write_error
from flexsheet.messages.scene import Scene
from flexsheet.messages.topics import TOPICS
from flexsheet.messages.types import (
    ArmState,
    EStop,
    Fingertip,
    Frame,
    SheetTarget,
    Side,
    Skin,
    SoftBody,
    StereoPair,
    TwinEye,
)
from flexsheet.nodes.arrays import Floats, Image

try:
    import foxglove
    from foxglove import messages as fg

    from flexsheet.launch.viewing.foxglove_drawing import (
        SKIN_COLOUR,
        draw_finger,
        draw_mesh,
        make_estop_log,
        make_frame,
        make_stamp,
    )
except ImportError:
    HAS_FOXGLOVE = False
else:
    HAS_FOXGLOVE = True

FINGER_RADIUS_M = 0.007

NamedImage = tuple[str, Image]
Output = tuple[str, Any]


MIN_FREE_BYTES = 4 << 20
"""The minimum free disk space (bytes) during an export.

It exceeds the size of the write buffer of the Foxglove library.
"""


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
    messages: dict[str, int] = field(default_factory=dict)
    unreadable: tuple[str, ...] = ()


def export(
    bag: Path,
    output: Path,
    *,
    topics: Iterable[str] | None = None,
    progress: Callable[[float, float], None] = lambda done_s, whole_s: None,
) -> ExportResult:
    """Export a bag as an MCAP file with the schemas of Foxglove.

    Topics whose message type cannot be converted to the current version are omitted. The result
    contains their names.

    topics: names of the topics to export, or None for all topics.
    progress: function that is called with the duration exported so far and the total duration (s).

    Raises ExportError if the export fails, and BagError if the bag cannot be read.
    """
    if not HAS_FOXGLOVE:
        raise ExportError(
            "`bag export` needs the package foxglove-sdk; run: pip install 'flexsheet[export]'"
        )
    selection = select_topics(bag, output, topics)
    offset_ns = wall_clock_offset_ns(selection.reader)
    result = ExportResult(output, unreadable=selection.unreadable)
    context = foxglove.Context()
    channels: dict[str, Any] = {}
    draft = output.with_name(f"{output.name}.part")
    state = ViewState()
    try:
        check_free_space(output)
        with foxglove.open_mcap(draft, context=context, allow_overwrite=True) as writer:
            for number, (topic, message, _, log_time_ns) in enumerate(
                BagReader(bag, selection.readable)
            ):
                # On a full disk, the library would print a line for each message.
                check_free_space(output)
                at_ns = log_time_ns + (offset_ns or 0)
                views = state.views(topic, message, at_ns)
                for name, value in ((topic, _plain(message)), *views):
                    channel = channels.get(name) or _channel(name, value, context)
                    channels[name] = channel
                    channel.log(value, log_time=at_ns)
                    result.messages[name] = result.messages.get(name, 0) + 1
                if number % 200 == 0:
                    progress((log_time_ns - selection.start_ns) * 1e-9, selection.duration_s)
            complete = str(selection.reader.complete)
            writer.write_metadata("flexsheet", {"bag": bag.name, "complete": complete})
        draft.replace(output)
    except OSError as error:
        raise ExportError(str(make_write_error(output, error))) from error
    except RuntimeError as error:
        raise ExportError(f"{output}: cannot be written: {error}") from error
    finally:
        draft.unlink(missing_ok=True)
    return result


@dataclass(frozen=True, slots=True)
class TopicsToExport:
    """The bag to export, its start time and duration, and the names of the topics to export.

    readable: names of the topics to export.
    context: names of further topics whose messages are needed to draw the exported topics.
    unreadable: names of the requested topics whose messages cannot be decoded.
    clock_id: clock of the recorder; None if it is unknown.
    """

    reader: BagReader
    start_ns: int
    duration_s: float
    readable: tuple[str, ...]
    context: tuple[str, ...]
    unreadable: tuple[str, ...]
    clock_id: str | None


def select_topics(bag: Path, output: Path | None, topics: Iterable[str] | None) -> TopicsToExport:
    """Select the topics of a bag that can be exported.

    output: file to write, which must not exist; None if no file is written.
    topics: names of the requested topics, or None for all topics of the bag.

    Raises ExportError if `output` exists or if the bag does not contain a requested topic. Raises
    BagError if the bag cannot be read.
    """
    if output is not None and output.exists():
        raise ExportError(f"{output}: the file exists already; give the name of a new file")
    reader = BagReader(bag)
    summary = reader.info()
    wanted = set(reader.topics if topics is None else topics)
    if absent := sorted(wanted - reader.topics.keys()):
        names = ", ".join(sorted(reader.topics)) or "no topic"
        raise ExportError(
            f"{bag}: the bag does not contain the topics {', '.join(absent)}; it contains {names}"
        )
    all_readable = {one.name for one in summary.topics if one.readable}
    readable = all_readable & wanted
    return TopicsToExport(
        reader,
        summary.start_ns,
        summary.duration_s,
        tuple(sorted(readable)),
        tuple(sorted(CONTEXT_TOPICS & all_readable - readable)),
        tuple(sorted(wanted - readable)),
        summary.metadata.get("recording", {}).get("clock_id"),
    )


def check_free_space(output: Path) -> None:
    """Raise OSError if the disk on which the output file will be written is nearly full."""
    if free_bytes(output.parent) < MIN_FREE_BYTES:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@dataclass(slots=True)
class ViewState:
    """The newest scene, soft-body surface and flange poses, needed to draw later messages."""

    scene: Scene | None = None
    skin: Skin | None = None
    flanges: dict[Side, Floats] = field(default_factory=dict)

    def views(self, topic: str, message: Message, at_ns: int) -> Iterator[Output]:
        """Yield the images and the 3D data in a message as (channel, Foxglove message).

        at_ns: timestamp of the Foxglove messages.
        """
        stamp = make_stamp(at_ns)
        match message:
            case Scene():
                self.scene = message
            case Skin():
                self.skin = message
                yield "object", self._object(message.vertices_world_m, stamp)
            case SoftBody() if self.skin is not None and self.skin.mesh_id == message.mesh_id:
                deformed = self.skin.vertices_world_m + message.displacement_world_m
                yield "object", self._object(deformed, stamp)
            case Fingertip():
                radius_m = self.scene.finger.radius_m if self.scene else FINGER_RADIUS_M
                yield "finger", draw_finger(message, radius_m, stamp)
            case SheetTarget():
                yield "tf", _frames("sheet_target", message.world_from_sheet, stamp)
            case ArmState():
                self.flanges[message.side] = message.world_from_flange
                yield "tf", _frames(f"flange_{message.side}", message.world_from_flange, stamp)
                sheet = self._sheet(stamp)
                if sheet is not None:
                    yield "sheet", sheet
            case EStop():
                yield "log", make_estop_log(message, stamp, topic)
        for name, image in list_images(topic, message):
            yield name, _raw_image(name, image, stamp)

    def _object(self, vertices: NDArray[Any], stamp: Any) -> Any:
        assert self.skin is not None
        return draw_mesh("object", vertices, self.skin.triangles, stamp, SKIN_COLOUR)

    def _sheet(self, stamp: Any) -> Any | None:
        """Draw the sheet as a flat surface; return None if the pose of an edge is unknown."""
        corners = find_sheet_corners(self.scene, self.flanges)
        if corners is None:
            return None
        triangles = np.array([[0, 2, 1], [1, 2, 3]])
        return draw_mesh("sheet", corners, triangles, stamp, SHEET_COLOUR)


def list_images(topic: str, message: Message) -> Iterator[NamedImage]:
    """Yield each image in a message, together with the name of the channel for the image."""
    match message:
        case StereoPair():
            yield f"{topic}/left", message.left
            yield f"{topic}/right", message.right
        case Frame():
            for image in message.pixels:
                yield f"{topic}/image", image
        case TwinEye():
            yield f"{topic}/seen", message.seen
            yield f"{topic}/expected", message.expected


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


def _channel(name: str, value: Any, context: Any) -> Any:
    if isinstance(value, dict):
        shape = json.dumps(make_schema(TOPICS[name].message)).encode()
        schema = foxglove.Schema(name=f"flexsheet.{name}", encoding="jsonschema", data=shape)
        return foxglove.Channel(name, schema=schema, message_encoding="json", context=context)
    channel_type = getattr(foxglove.channels, f"{type(value).__name__}Channel")
    return channel_type(name, context=context)


def _frames(child: str, world_from_child: Floats, stamp: Any) -> Any:
    frame = make_frame("world", child, world_from_child, stamp)
    return fg.FrameTransforms(transforms=[frame])


def _raw_image(name: str, image: Image, stamp: Any) -> Any:
    height, width = image.shape[:2]
    channels = 1 if image.ndim == 2 else image.shape[2]
    return fg.RawImage(
        timestamp=stamp,
        frame_id=name,
        width=width,
        height=height,
        encoding="mono8" if channels == 1 else "rgb8",
        step=width * channels,
        data=np.ascontiguousarray(image).tobytes(),
    )
