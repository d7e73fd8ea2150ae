"""Records topics to a bag: the wire's bytes as they are, and what is needed to understand them."""

from __future__ import annotations

import mimetypes
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, ClassVar

from pydantic import Field

from messages.bag import BagError, BagWriter
from messages.base import Header
from messages.topics import Delivery, Topic, topic_named
from messages.types import Recording
from messages.wire import decode
from nodes.node import Input, Node, NodeParameters
from nodes.recorder.files import free_path

RUN_FILES = tuple(
    Path("@run") / name for name in ("launch.yaml", "scene.yaml", "plan.json", "git.json")
)


class RecorderParameters(NodeParameters):
    """Which topics go to which bag."""

    bag: Path = Field(description="file to write; %Y%m%d-%H%M%S and the like become its start")
    topics: tuple[str, ...] = Field(
        default=(), description="empty: all that the table of topics says are logged"
    )
    also: tuple[str, ...] = Field(default=(), description="topics beside those, as stereo")
    compress: bool | None = Field(
        default=None,
        description="null: unless pictures come, which take longer to compress than to write",
    )
    waits: bool = Field(
        default=False,
        description="record only while a `recording` message says so, to a bag for each time",
    )
    attach: tuple[Path, ...] = Field(
        default=RUN_FILES, description="files that go into the bag; @run is the run's directory"
    )


class Recorder(Node):
    """Writes every message that arrives; an existing bag is never overwritten.

    When the disk refuses, the graph goes on without a recording: what is not written is counted as
    dropped, and the status says why.
    """

    parameters: RecorderParameters
    takes_frames: ClassVar[bool] = True
    opens_devices: ClassVar[bool] = True

    @classmethod
    def further_inputs(
        cls, parameters: RecorderParameters, written: Sequence[Topic]
    ) -> Sequence[str]:
        wanted = parameters.topics or [topic.name for topic in written if topic.logged]
        told = ("recording",) if parameters.waits else ()
        return list(dict.fromkeys((*wanted, *parameters.also, *told)))

    def __init__(
        self, parameters: RecorderParameters, *, topics: dict[str, str] | None = None, **rest: Any
    ) -> None:
        super().__init__(parameters, **rest)
        for port, topic in (topics or {}).items():
            if port.startswith("in/"):
                self.inputs[port] = Input(topic_named(topic), self.clock)
        self._bag: BagWriter | None = None
        self._failed = False
        self._latched: dict[tuple[str, str], tuple[Any, Header]] = {}

    async def setup(self) -> None:
        if self.parameters.waits:
            self.note = "waits to be told to record"
        else:
            self._open()

    def _open(self) -> None:
        # The one use of the time of day: it names the bag, and tells people when it was.
        now = datetime.now(UTC)
        path = Path(now.astimezone().strftime(str(self.parameters.bag)))
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise BagError(f"{path.parent}: cannot be made: {error.strerror}") from error
        recording = {
            "clock_id": self.clock.id,
            "started_ns": str(self.clock.now_ns()),
            "started": now.isoformat(),
            "plan_hash": self.plan_hash,
        }
        compress = self.parameters.compress
        if compress is None:
            # The camera's pixels are what the table does not log by itself.
            compress = all(source.topic.logged for source in self.inputs.values())
        self._bag = bag = BagWriter(free_path(path), {"recording": recording}, compress=compress)
        self._failed = False
        for file in self.parameters.attach:
            media_type = mimetypes.guess_type(file.name)[0] or "application/octet-stream"
            bag.add_attachment(file.name, file.read_bytes(), media_type)
        for (port, _), (message, header) in self._latched.items():
            bag.write_frames(self.inputs[port].topic, message, header, self.clock.now_ns())
        bag.flush()
        self.note = f"records to {bag.path}"
        self.log.info("recording", bag=str(bag.path), topics=self._topics())

    def _topics(self) -> list[str]:
        return [source.topic.name for source in self.inputs.values()]

    def deliver(self, port: str, message: Any, header: Header) -> None:
        """Write a message's frames; called instead of handlers, since frames are taken unopened."""
        source = self.inputs[port]
        now_ns = self.clock.now_ns()
        source.counts.count(header, now_ns)
        if self.parameters.waits:
            if source.topic.name == "recording":
                self._heed(decode(message, Recording)[0])
            elif source.topic.delivery is Delivery.LATCHED:
                self._latched[port, header.writer] = (message, header)
        if self._bag is None and self.parameters.waits:
            return
        if self._bag is None or self._failed:
            source.counts.dropped += 1
            return
        try:
            self._bag.write_frames(source.topic, message, header, now_ns)
        except (BagError, OSError) as error:
            self._failed = True
            source.counts.dropped += 1
            self.note = f"NOT RECORDING: {error}"
            self.report_error("recording", error)
        else:
            self.note = f"{self._bag.messages} messages in {self._bag.path}"

    def _heed(self, told: Recording) -> None:
        """Begin a bag, or end the one that is being written; what cannot be is reported."""
        try:
            if told.running and self._bag is None:
                self._open()
            elif not told.running and self._bag is not None:
                bag, self._bag = self._bag, None
                bag.close()
                self.note = f"recorded {bag.messages} messages in {bag.path}"
        except (BagError, OSError) as error:
            self.note = f"NOT RECORDING: {error}"
            self.report_error("recording", error)

    async def close(self) -> None:
        if self._bag is not None:
            self._bag.close()
