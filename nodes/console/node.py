"""A page in the browser: the whole apparatus in 3D, how the graph is, and a hand on it."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from ipaddress import ip_address
from pathlib import Path
from typing import Any, ClassVar, Self

from pydantic import Field, field_validator, model_validator

from flexsheet.messages.base import Header, Message
from flexsheet.messages.scene import Positive, Scene
from flexsheet.messages.topics import Delivery, Topic
from flexsheet.messages.types import Bookmark, Display, EStop, FingerPath, Recording, Skin
from flexsheet.messages.wire import WireError
from flexsheet.nodes import NodeRole
from flexsheet.nodes.console.desk import Desk, Files
from flexsheet.nodes.console.finger import Finger
from flexsheet.nodes.console.graph_facts import GraphFacts
from flexsheet.nodes.console.guard import Guard, read_token, start_server
from flexsheet.nodes.console.newest import Newest
from flexsheet.nodes.console.operator import Operator
from flexsheet.nodes.node import Node, NodeParameters, Output, further_port, periodic
from flexsheet.nodes.parameter_marks import ListenPort

SHOWN = {
    *("fingertip", "sheet_target", "arm_left", "arm_right", "skin", "soft_body"),
    *("frame", "twin/eye", "status", "host", "estop", "display"),
}
"""Topics that it reads, as far as the graph has them."""


class ConsoleParameters(NodeParameters):
    """Where the page is, and how often it changes while somebody looks."""

    address: str = Field(default="127.0.0.1", description="IP address that the page is served at")
    page_port: ListenPort = Field(default=8080, description="0: any that is free")
    token_file: Path | None = Field(
        default=None, description="who looks must know what is in it; needed beyond loopback"
    )
    rate_hz: Positive = Field(default=25.0, description="of the 3D view")
    tables_hz: Positive = Field(default=2.0, description="of tables and charts")
    control_finger: bool = Field(default=True, description="the mouse moves the twin's finger")
    finger_speed_m_per_s: Positive = 0.15
    bags: Path = Field(default=Path("runs"), description="folder whose bags can be replayed")
    plan: Path = Field(default=Path("@run/plan.json"), description="holds the first scene")
    scenes: Path = Field(default=Path("@run/scenes"), description="scenes to choose from")
    state_file: Path = Field(
        default=Path("@run/console-kept.json"),
        description="state that a restarted console continues with",
    )

    @field_validator("address")
    @classmethod
    def _is_an_address(cls, address: str) -> str:
        try:
            return str(ip_address(address))
        except ValueError:
            raise ValueError(f'"{address}" is no IP address; as in 127.0.0.1') from None

    @model_validator(mode="after")
    def _is_guarded(self) -> Self:
        if self.token_file is None and not ip_address(self.address).is_loopback:
            raise ValueError(
                f"address {self.address} is beyond loopback: name a token_file, "
                "or take 127.0.0.1 and come through ssh -L"
            )
        return self


class Console(Node):
    """Serves the page.  It takes what it draws at its own rate, and works only while one looks."""

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
        return "it serves a page; only its outputs are in the bag, not what people did there"

    @classmethod
    def further_inputs(
        cls, parameters: ConsoleParameters, written: Sequence[Topic]
    ) -> Sequence[str]:
        return [topic.name for topic in written if topic.name in SHOWN]

    async def setup(self) -> None:
        given = self.parameters
        token = None if given.token_file is None else read_token(given.token_file)
        guard = Guard(given.address, token)
        self._loop = asyncio.get_running_loop()
        self._newest = Newest(self._refused)
        self._server = start_server(given.address, given.page_port, guard, "flexsheet")
        self.url = f"http://{given.address}:{self._server.get_port()}/"
        finger = Finger(self._publish, speed_m_per_s=given.finger_speed_m_per_s)
        files = Files(given.plan, given.scenes, given.bags, given.state_file)
        facts = GraphFacts.from_plan(given.plan, self.name)
        desk = Desk(self._publish, files, finger, self.log.warning, facts)
        self.operator = Operator(
            self._server,
            self._newest,
            desk,
            self._ask,
            name=self.name,
            with_finger=given.control_finger,
            with_eye=further_port("twin/eye") in self.inputs,
        )
        desk.begin()
        self.note = f"{self.url}, nobody looks"

    async def close(self) -> None:
        await self.operator.desk.scenes.close()
        await asyncio.to_thread(self._server.stop)

    def deliver(self, port: str, message: Any, header: Header) -> None:
        """Keep frames of what is drawn until they are drawn; what must all be read is read now."""
        source = self.inputs[port]
        source.counts.count(header, self.clock.now_ns())
        superseded = self._newest.put(source.topic.name, message)
        if source.topic.delivery is Delivery.LATEST:
            source.counts.dropped += superseded
        elif source.topic.message is not Skin and (
            opened := self._newest.newest(source.topic.name, source.topic.message)
        ):
            self._guarded(self.operator.hear, opened[0], header, self.clock.now_ns() * 1e-9)

    @periodic("rate_hz")
    def draw(self) -> None:
        """The 3D view, and what moves by itself."""
        now_s = self.clock.now_ns() * 1e-9
        looking = len(self._server.get_clients())
        self.note = f"{self.url}, {looking or 'nobody'} look{'' if looking > 1 else 's'}"
        self._guarded(self.operator.advance, now_s, looking > 0)

    @periodic("tables_hz")
    def tell(self) -> None:
        """Tables and charts."""
        if self._server.get_clients():
            self._guarded(self.operator.tell, self.clock.now_ns() * 1e-9)

    def _publish(self, message: Message) -> None:
        kind = type(message)
        next(out for out in self.outputs.values() if out.topic.message is kind).publish(message)

    def _ask(self, what: str, *values: Any) -> None:
        """Hand on what a viewer wants, from any thread."""
        self._loop.call_soon_threadsafe(self._guarded, self.operator.heed, what, *values)

    def _guarded(self, function: Any, *values: Any) -> None:
        try:
            function(*values)
        except Exception as error:
            self.report_error(function.__name__, error)
            self.operator.fail(error)

    def _refused(self, topic: Topic, error: WireError) -> None:
        self.inputs[further_port(topic.name)].counts.rejected += 1
        self.log.warning("input", problem=str(error))
