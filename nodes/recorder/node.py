"""Records topics to a bag: the wire's bytes as they are, and what is needed to understand them."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, ClassVar

from flexsheet.messages.bag import BagError, BagWriter
from flexsheet.messages.base import Header
from flexsheet.messages.topics import Delivery, Topic
from flexsheet.messages.types import Recording
from flexsheet.messages.wire import decode
from flexsheet.nodes import NodeRole
from flexsheet.nodes.node import Node, periodic
from flexsheet.nodes.recorder.files import free_bytes, open_bag
from flexsheet.nodes.recorder.parameters import RecorderParameters

TRY_AGAIN_NS = 5_000_000_000
"""After a disk has refused, it is not asked again for so long."""


class Recorder(Node):
    """Writes every message that arrives; an existing bag is never overwritten.

    When the disk is full or refuses, the graph goes on without a recording: the bag is ended, what
    is not written is counted as dropped, the status says so; and when there is room again, another
    bag goes on, with the last messages of all latched topics first.
    """

    role: ClassVar[NodeRole | None] = NodeRole.RECORDER
    parameters: RecorderParameters
    takes_frames: ClassVar[bool] = True
    opens_devices: ClassVar[bool] = True

    @classmethod
    def replay_refusal(cls, parameters: Any) -> str:
        return "it wrote this bag"

    @classmethod
    def further_inputs(
        cls, parameters: RecorderParameters, written: Sequence[Topic]
    ) -> Sequence[str]:
        wanted = parameters.topics or [topic.name for topic in written if topic.logged]
        told = ("recording",) if parameters.start_paused else ()
        return list(dict.fromkeys((*wanted, *parameters.include, *told)))

    def __init__(self, parameters: RecorderParameters, **rest: Any) -> None:
        super().__init__(parameters, **rest)
        self._bag: BagWriter | None = None
        self._path, self._wanted = Path(), False
        self._latched: dict[tuple[str, str], tuple[Any, Header]] = {}
        self._lost, self._try_again_ns = 0, 0

    async def setup(self) -> None:
        if self.parameters.start_paused:
            self.note = "waits to be told to record"
        else:
            self._open()

    def _open(self) -> None:
        self._wanted, self._lost = True, 0
        # The one use of the time of day: it names the bag, and tells people when it was.
        now = datetime.now(UTC)
        self._path = Path(now.astimezone().strftime(str(self.parameters.bag)))
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise BagError(f"{self._path.parent}: cannot be made: {error.strerror}") from error
        self._begin_bag()
        self.watch_disk()

    def _begin_bag(self, **more: str) -> None:
        recording = {
            "clock_id": self.clock.id,
            "started_ns": str(self.clock.now_ns()),
            "started": datetime.now(UTC).isoformat(),
            "plan_hash": self.plan_hash,
            **more,
        }
        compress = self.parameters.compress
        if compress is None:
            # The camera's pixels are what the table does not log by itself.
            compress = all(source.topic.logged for source in self.inputs.values())
        files = self.parameters.attach
        self._bag = bag = open_bag(self._path, recording, compress=compress, attach=files)
        for (port, _), (message, header) in self._latched.items():
            bag.write_frames(self.inputs[port].topic, message, header, self.clock.now_ns())
        bag.flush()
        self.note = f"records to {bag.path}"
        self.log.info("recording", bag=str(bag.path), inputs=len(self.inputs))

    @periodic("watch_hz")
    def watch_disk(self) -> None:
        """End the bag while there is room for its index; begin another when there is room again."""
        if not self._wanted:
            return
        free, keep = free_bytes(self._path.parent), self.parameters.keep_free_bytes
        if self._bag is not None and free < keep:
            self._end_bag(OSError(f"{free >> 20} MiB are free at {self._path.parent}"))
        elif self._bag is None and free >= 2 * keep and self.clock.now_ns() >= self._try_again_ns:
            lost, self._lost = self._lost, 0
            try:
                self._begin_bag(lost_messages=str(lost))
            except (BagError, OSError) as error:
                self._lost += lost
                self._end_bag(error)

    def _end_bag(self, why: Exception) -> None:
        """Keep what is written; say why there is no more."""
        bag, self._bag = self._bag, None
        self._try_again_ns = self.clock.now_ns() + TRY_AGAIN_NS
        self.note = f"NOT RECORDING: {why}"
        self.report_error("recording", why)
        if bag is not None:
            # What it says of a disk that refuses is known already; a cut bag can be read.
            with suppress(BagError):
                bag.close()
            if bag.messages == 0:
                bag.path.unlink(missing_ok=True)

    def deliver(self, port: str, message: Any, header: Header) -> None:
        """Write a message's frames; called instead of handlers, since frames are taken unopened."""
        source = self.inputs[port]
        now_ns = self.clock.now_ns()
        source.counts.count(header, now_ns)
        if self.parameters.start_paused and source.topic.name == "recording":
            self._heed(decode(message, Recording)[0])
        elif source.topic.delivery is Delivery.LATCHED:
            self._latched[port, header.writer] = (message, header)
        if self._bag is not None:
            try:
                self._bag.write_frames(source.topic, message, header, now_ns)
            except (BagError, OSError) as error:
                self._end_bag(error)
            else:
                self.note = f"{self._bag.messages} messages in {self._bag.path}"
                return
        if self._wanted:
            source.counts.dropped += 1
            self._lost += 1

    def _heed(self, told: Recording) -> None:
        """Begin a bag, or end the one that is being written; what cannot be is reported."""
        try:
            if told.running and not self._wanted:
                self._open()
            elif not told.running:
                self._wanted, bag, self._bag = False, self._bag, None
                if bag is None:
                    return
                bag.close()
                self.note = f"recorded {bag.messages} messages in {bag.path}"
        except (BagError, OSError) as error:
            self._end_bag(error)

    async def close(self) -> None:
        if self._bag is not None:
            self._bag.close()
