"""Record topics to a bag, with the schemas that are necessary to decode the messages."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, ClassVar

from flexsheet.messages.base import Header
from flexsheet.messages.topics import Topic
from flexsheet.messages.types import Recording
from flexsheet.messages.wire import decode
from flexsheet.nodes import NodeRole
from flexsheet.nodes.node import Node, periodic
from flexsheet.nodes.recorder.bag_recording import BagRecording
from flexsheet.nodes.recorder.parameters import RecorderParameters


class Recorder(Node):
    """A node that writes the messages that it receives to a bag.

    An existing bag is never overwritten. If the disk is full, the graph continues without a
    recording. Lost messages are counted as dropped, and the node's status note contains the reason.
    """

    role: ClassVar[NodeRole | None] = NodeRole.RECORDER
    parameters: RecorderParameters
    takes_frames: ClassVar[bool] = True
    opens_devices: ClassVar[bool] = True

    @classmethod
    def replay_refusal(cls, parameters: Any) -> str:
        return "it recorded this bag"

    @classmethod
    def further_inputs(
        cls, parameters: RecorderParameters, written: Sequence[Topic]
    ) -> Sequence[str]:
        topics = parameters.topics or [topic.name for topic in written if topic.logged]
        requests = ("recording",) if parameters.start_paused else ()
        return list(dict.fromkeys((*topics, *parameters.include, *requests)))

    async def setup(self) -> None:
        compress = self.parameters.compress
        if compress is None:
            # Topics that are not recorded by default contain images, which take long to compress.
            compress = all(source.topic.logged for source in self.inputs.values())
        self._recording = BagRecording(
            self.parameters,
            self.clock,
            plan_hash=self.plan_hash,
            compress=compress,
            on_error=partial(self.report_error, "recording"),
        )
        if not self.parameters.start_paused:
            self._recording.start()
            self.log.info("recording", bag=str(self._recording.path), inputs=len(self.inputs))
        self.set_note(*self._recording.note)

    @periodic("watch_hz")
    def watch_disk(self) -> None:
        """End the bag before the disk is full; start a new bag when enough space is free again."""
        self._recording.check_disk()
        self.set_note(*self._recording.note)

    def deliver(self, port: str, message: Any, header: Header) -> None:
        """Write the ZeroMQ frames of a message to the bag without decoding them."""
        source = self.inputs[port]
        source.counts.count(header, self.clock.now_ns())
        if self.parameters.start_paused and source.topic.message is Recording:
            self._recording.set_requested(decode(message, Recording)[0].running)
        source.counts.dropped += self._recording.write(source.topic, message, header)
        self.set_note(*self._recording.note)

    async def close(self) -> None:
        self._recording.close()
