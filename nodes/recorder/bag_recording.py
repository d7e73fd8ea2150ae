"""Write messages to recordings (bags).

If the disk is full, the current bag is closed. A new bag is started when space is free again.
"""

from __future__ import annotations

import mimetypes
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from datetime import UTC, datetime
from itertools import count
from pathlib import Path
from typing import Any

from flexsheet.messages.bag import BagError, BagWriter
from flexsheet.messages.base import Header
from flexsheet.messages.clock import Clock
from flexsheet.messages.files import free_bytes
from flexsheet.messages.notes import NoteCode
from flexsheet.messages.topics import Delivery, Topic
from flexsheet.messages.types import Recording
from flexsheet.nodes.recorder.parameters import RecorderParameters

RETRY_NS = 5_000_000_000
"""The time (ns) from a disk error to the next attempt to start a bag."""


class BagRecording:
    """A recorder that writes messages to bags while recording is requested.

    note: code and detail of the note about the recording.
    lost: number of messages that were lost since the last bag ended.

    A bag is closed when the free disk space falls to `keep_free_bytes`. The remaining space is
    sufficient for the index of the bag. When twice as much space is free again, a new bag starts
    with the last messages of all latched topics. Disk errors during writing are passed to
    `on_error` and not raised.
    """

    def __init__(
        self,
        parameters: RecorderParameters,
        clock: Clock,
        *,
        plan_hash: str,
        compress: bool,
        on_error: Callable[[Exception], None],
    ) -> None:
        self._parameters, self._clock = parameters, clock
        self._plan_hash, self._compress, self._on_error = plan_hash, compress, on_error
        self._bag: BagWriter | None = None
        self._path = Path()
        self._latched: dict[tuple[str, str], tuple[Topic, Any, Header]] = {}
        self._retry_ns = self._bag_started_ns = 0
        self.requested = False
        self.lost = 0
        self.note = NoteCode.INFO, "waits for a request to record"

    @property
    def path(self) -> Path | None:
        """Return the path of the current bag, or None if no bag is open."""
        return None if self._bag is None else self._bag.path

    def start(self) -> None:
        """Start a bag named after the current time. Raises BagError or OSError if this fails."""
        self.requested, self.lost = True, 0
        # The time of day is only used to name the bag.
        now = datetime.now(UTC)
        self._path = Path(now.astimezone().strftime(str(self._parameters.bag)))
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise BagError(
                f"{self._path.parent}: the folder cannot be created: {error.strerror}; "
                "correct the path of the bag, or the permissions"
            ) from error
        self._start_bag()
        self.check_disk()

    def set_requested(self, requested: bool) -> None:
        """Start a bag if recording is requested; otherwise end the current bag.

        Disk errors are passed to `on_error`.
        """
        try:
            if requested and not self.requested:
                self.start()
            elif not requested:
                self.requested, bag, self._bag = False, self._bag, None
                if bag is not None:
                    bag.close()
                    self.note = NoteCode.INFO, f"recorded: {bag.messages} messages in {bag.path}"
        except (BagError, OSError) as error:
            self._end_bag(error)

    def check_disk(self) -> None:
        """End the bag if free disk space is low, and start a new bag if there is enough space.

        A new bag is also started when the current bag reaches the maximum size or duration.
        """
        if not self.requested:
            return
        free, minimum = free_bytes(self._path.parent), self._parameters.keep_free_bytes
        if self._bag is not None and free >= minimum and self._is_full(self._bag):
            self._split(self._bag)
        elif self._bag is not None and free < minimum:
            self._end_bag(OSError(f"only {free >> 20} MiB are free at {self._path.parent}"))
        elif self._bag is None and free >= 2 * minimum and self._clock.now_ns() >= self._retry_ns:
            lost, self.lost = self.lost, 0
            try:
                self._start_bag(lost_messages=str(lost))
            except (BagError, OSError) as error:
                self.lost += lost
                self._end_bag(error)

    def _is_full(self, bag: BagWriter) -> bool:
        limits, age_s = self._parameters, (self._clock.now_ns() - self._bag_started_ns) * 1e-9
        size_bytes = bag.path.stat().st_size
        if bag.messages == 0:
            return False
        return (limits.max_bag_bytes is not None and size_bytes >= limits.max_bag_bytes) or (
            limits.max_bag_duration_s is not None and age_s >= limits.max_bag_duration_s
        )

    def _split(self, bag: BagWriter) -> None:
        self._bag = None
        try:
            bag.close()
            self._start_bag()
        except (BagError, OSError) as error:
            self._end_bag(error)

    def write(self, topic: Topic, frames: Any, header: Header) -> bool:
        """Write a message's ZeroMQ frames; return True if they are lost because no bag is open.

        The last message of each writer of a latched topic is stored for the next bag. Recording
        commands are not stored.
        """
        is_request = self._parameters.start_paused and topic.message is Recording
        if topic.delivery is Delivery.LATCHED and not is_request:
            self._latched[topic.name, header.writer] = (topic, frames, header)
        if self._bag is not None:
            try:
                self._bag.write_frames(topic, frames, header, self._clock.now_ns())
            except (BagError, OSError) as error:
                self._end_bag(error)
            else:
                self._note_progress(self._bag)
                return False
        self.lost += self.requested
        return self.requested

    def close(self) -> None:
        """Close the bag. Raises BagError if the bag is incomplete."""
        if self._bag is not None:
            self._bag.close()

    def _start_bag(self, **more: str) -> None:
        self._bag_started_ns = self._clock.now_ns()
        recording = {
            "clock_id": self._clock.id,
            "started_ns": str(self._bag_started_ns),
            "started": datetime.now(UTC).isoformat(),
            "plan_hash": self._plan_hash,
            **more,
        }
        self._bag = bag = open_bag(
            self._path, recording, compress=self._compress, attach=self._parameters.attach
        )
        for topic, frames, header in self._latched.values():
            bag.write_frames(topic, frames, header, self._clock.now_ns())
        bag.flush()
        self._note_progress(bag)

    def _note_progress(self, bag: BagWriter) -> None:
        self.note = NoteCode.INFO, f"recording: {bag.messages} messages in {bag.path}"

    def _end_bag(self, error: Exception) -> None:
        bag, self._bag = self._bag, None
        self._retry_ns = self._clock.now_ns() + RETRY_NS
        self.note = NoteCode.NOT_RECORDING, str(error)
        self._on_error(error)
        if bag is not None:
            # The disk error is already reported, and a truncated bag can still be read.
            with suppress(BagError):
                bag.close()
            if bag.messages == 0:
                bag.path.unlink(missing_ok=True)


def free_path(path: Path) -> Path:
    """Return a path that does not exist: `path`, or `path` with a suffix -2, -3, and so on."""
    if not path.exists():
        return path
    for number in count(2):
        candidate = path.with_name(f"{path.stem}-{number}{path.suffix}")
        if not candidate.exists():
            return candidate
    raise AssertionError("count() does not end")


def open_bag(
    path: Path, recording: Mapping[str, str], *, compress: bool, attach: Iterable[Path]
) -> BagWriter:
    """Create a bag, and attach files. Raises BagError or OSError if this fails.

    path: path of the bag; a number is appended to its name if the path exists.
    recording: texts that identify the recording, by name.
    attach: files to store in the bag.
    """
    bag = BagWriter(free_path(path), {"recording": recording}, compress=compress)
    try:
        for file in attach:
            media_type = mimetypes.guess_type(file.name)[0] or "application/octet-stream"
            bag.add_attachment(file.name, file.read_bytes(), media_type)
    except BaseException:
        with suppress(BagError):
            bag.close()
        raise
    return bag
