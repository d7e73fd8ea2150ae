"""Read the newest message of each topic up to a selected time in a bag, for the page."""

from __future__ import annotations

from bisect import bisect_right
from collections import OrderedDict
from pathlib import Path
from typing import TypeVar

from mcap.records import Message as Record

from flexsheet.messages.bag import BagError, BagReader, Chunk
from flexsheet.messages.base import Header, Message
from flexsheet.messages.types import Bookmark
from flexsheet.nodes.console.latest_messages import check_type

M = TypeVar("M", bound=Message)

MAX_CHUNKS = 6


class Timeline:
    """A reader of the last message of each topic up to a selected time in a bag.

    seconds: selected time since the start of the bag.

    Raises BagError if the file is not a bag, or contains no topic that the page shows.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._reader = BagReader(path)
        summary = self._reader.info()
        self.duration_s, self._start_ns = summary.duration_s, summary.start_ns
        self._readable = {one.name for one in summary.topics if one.readable and one.count}
        if not self._readable & {"arm_left", "arm_right", "fingertip", "soft_body"}:
            raise BagError(
                f"{path}: the bag contains no topic that the page shows, such as arm_left; choose "
                "another bag"
            )
        self._channels = {one.topic: one.id for one in self._reader.channels.values()}
        self._positions = {name: self._times(name) for name in self._readable}
        self._chunks: OrderedDict[int, dict[tuple[int, int], Record]] = OrderedDict()
        self._opened: dict[str, tuple[int, tuple[Message, Header]]] = {}
        self.bookmarks = self._find_bookmarks()
        self.seconds = 0.0

    def latest(self, name: str, kind: type[M]) -> tuple[M, Header] | None:
        """Return the last message of a topic up to the selected time, or None if there is none."""
        times, _ = self._positions.get(name, ([], []))
        i = bisect_right(times, self._start_ns + round(self.seconds * 1e9)) - 1
        if i < 0:
            return None
        cached = self._opened.get(name)
        if cached is None or cached[0] != i:
            cached = (i, self._open(name, i))
            self._opened[name] = cached
        return check_type(cached[1], kind)

    def _times(self, name: str) -> tuple[list[int], list[Chunk]]:
        entries = [
            (time_ns, chunk.offset, chunk)
            for chunk in self._reader.chunks
            for time_ns in chunk.times_ns.get(self._channels[name], [])
        ]
        entries.sort(key=lambda entry: entry[:2])
        return [entry[0] for entry in entries], [entry[2] for entry in entries]

    def _open(self, name: str, i: int) -> tuple[Message, Header]:
        times, chunks = self._positions[name]
        record = self._records(chunks[i]).get((self._channels[name], times[i]))
        if record is None:
            raise BagError(
                f'{self.path}: topic "{name}": the index of the bag refers to a missing message, '
                "so the file is damaged; choose another bag"
            )
        return self._reader.open_record(self._reader.channels[self._channels[name]], record)

    def _records(self, chunk: Chunk) -> dict[tuple[int, int], Record]:
        """Return the messages of a chunk of the bag by channel and log time (ns).

        Chunks that were read recently are cached.
        """
        cached = self._chunks.get(chunk.offset)
        if cached is None:
            with self.path.open("rb") as file:
                records = self._reader.read_chunk(file, chunk)
            cached = {
                (record.channel_id, record.log_time): record
                for record in records
                if isinstance(record, Record)
            }
            self._chunks[chunk.offset] = cached
            if len(self._chunks) > MAX_CHUNKS:
                self._chunks.popitem(last=False)
        self._chunks.move_to_end(chunk.offset)
        return cached

    def _find_bookmarks(self) -> list[tuple[float, str]]:
        found = []
        for i, time_ns in enumerate(self._positions.get("bookmark", ([], []))[0]):
            message, _ = self._open("bookmark", i)
            if isinstance(message, Bookmark):
                found.append(((time_ns - self._start_ns) * 1e-9, message.label))
        return found


def list_bags(folder: Path) -> list[str]:
    """List the bags in a folder and its subfolders, starting with the newest bag."""
    found = [path for path in folder.glob("**/*.mcap") if path.is_file()]
    found.sort(key=lambda path: path.stat().st_mtime, reverse=True)
    return [str(path.relative_to(folder)) for path in found]
