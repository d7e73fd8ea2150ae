"""Serve a web page that shows and controls the running graph and its devices."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar

from pydantic import Field

from flexsheet.messages.base import Header, Message
from flexsheet.messages.notes import NoteCode
from flexsheet.messages.scene import Positive, Scene
from flexsheet.messages.topics import Delivery, Topic
from flexsheet.messages.types import Bookmark, Display, EStop, FingerPath, Recording, Skin
from flexsheet.messages.wire import WireError
from flexsheet.nodes import NodeRole
from flexsheet.nodes.console.controller import ConsoleController
from flexsheet.nodes.console.finger import FingerController
from flexsheet.nodes.console.graph_facts import GraphFacts
from flexsheet.nodes.console.latest_messages import LatestMessages
from flexsheet.nodes.node import Node, NodeParameters, Output, further_port, periodic
from flexsheet.nodes.parameter_marks import ListenPort

TOPICS_READ = {
    *("fingertip", "sheet_target", "arm_left", "arm_right", "skin", "soft_body"),
    *("frame", "twin/eye", "status", "host", "estop", "display"),
}
"""The topics that the console reads if a node of the graph writes them."""


class ConsoleParameters(NodeParameters):
    page_port: ListenPort = Field(
        default=8080, description="TCP port of the page. 0: any free port."
    )
    rate_hz: Positive = Field(default=25.0, description="Update rate of the 3D view, Hz.")
    plan: Path = Field(
        default=Path("@run/plan.json"),
        description="Plan file in the directory of the run, with the first scene and all others.",
    )


class Console(Node):
    """A node that serves the console page.

    While the page is open in a browser, the node updates the 3D view and the texts.
    """

    takes_frames: ClassVar[bool] = True
    opens_devices: ClassVar[bool] = True
    role: ClassVar[NodeRole | None] = NodeRole.CONSOLE
    parameters: ConsoleParameters
    scene: Output[Scene]
    display: Output[Display]
    estop: Output[EStop]
    recording: Output[Recording]
    bookmark: Output[Bookmark]
    twin__finger_path: Output[FingerPath]

    @classmethod
    def replay_refusal(cls, parameters: Any) -> str:
        return "it serves a page, and the bag does not contain its viewers' requests"

    @classmethod
    def further_inputs(
        cls, parameters: ConsoleParameters, written: Sequence[Topic]
    ) -> Sequence[str]:
        return [topic.name for topic in written if topic.name in TOPICS_READ]

    async def setup(self) -> None:
        # Imported here, because importing the libraries takes a second and the launcher needs none.
        from flexsheet.nodes.console.access_control import ADDRESS, start_server
        from flexsheet.nodes.console.operator import Operator

        settings = self.parameters
        self._loop = asyncio.get_running_loop()
        self._latest = LatestMessages(self._refused)
        self._server = start_server(settings.page_port, "flexsheet")
        self.url = f"http://{ADDRESS}:{self._server.get_port()}/"
        finger = FingerController(self._publish)
        facts = GraphFacts.from_plan(settings.plan, self.name)
        controller = ConsoleController(self._publish, settings.plan, finger, facts)
        self.operator = Operator(
            self._server,
            self._latest,
            controller,
            self._request,
            name=self.name,
            with_eye=further_port("twin/eye") in self.inputs,
        )
        controller.begin()
        self.set_note(NoteCode.INFO, f"{self.url}, viewers: 0")

    async def close(self) -> None:
        await self.operator.controller.scenes.close()
        await asyncio.to_thread(self._server.stop)

    def deliver(self, port: str, message: Any, header: Header) -> None:
        """Store a message until the next update of the page.

        If every message of the topic is needed, process the message immediately.
        """
        source = self.inputs[port]
        source.counts.count(header, self.clock.now_ns())
        superseded = self._latest.put(source.topic.name, message)
        if source.topic.delivery is Delivery.LATEST:
            source.counts.dropped += superseded
        elif source.topic.message is not Skin and (
            opened := self._latest.latest(source.topic.name, source.topic.message)
        ):
            self._call(self.operator.on_message, opened[0], header, self.clock.now_ns() * 1e-9)

    @periodic("rate_hz")
    def draw(self) -> None:
        """Move the finger, and update the page."""
        now_s = self.clock.now_ns() * 1e-9
        viewers = len(self._server.get_clients())
        self.set_note(NoteCode.INFO, f"{self.url}, viewers: {viewers}")
        self._call(self.operator.advance, now_s, viewers > 0)

    def _publish(self, message: Message) -> None:
        kind = type(message)
        next(out for out in self.outputs.values() if out.topic.message is kind).publish(message)

    def _request(self, name: str, *values: Any) -> None:
        """Pass a viewer's request to the node's event loop; any thread may call this method."""
        self._loop.call_soon_threadsafe(self._call, self.operator.handle_request, name, *values)

    def _call(self, function: Any, *values: Any) -> None:
        try:
            function(*values)
        except Exception as error:
            self.report_error(function.__name__, error)
            self.operator.fail(error)

    def _refused(self, topic: Topic, error: WireError) -> None:
        self.inputs[further_port(topic.name)].counts.rejected += 1
        self.log.warning("input", problem=str(error))
