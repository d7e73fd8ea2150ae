"""Serve a running graph to Foxglove and Lichtblick over their WebSocket protocol.

The server of the Foxglove SDK has no authentication and accepts requests from any web page.
Therefore the server listens on the loopback interface only. Viewers cannot publish, call services
or change parameters. A topic is read from the graph only while viewers subscribe to channels that
need the topic. Each viewer has a bounded queue, and a slow viewer loses the oldest messages.
"""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import foxglove
from foxglove.websocket import Capability, Parameter, ServerListener

from flexsheet.launch.plans.plan_model import ResolvedGraph
from flexsheet.launch.running.runs import Run
from flexsheet.launch.running.tools import make_subscriber
from flexsheet.launch.viewing.apparatus_model import make_model
from flexsheet.launch.viewing.channels import (
    Channel,
    Pace,
    ViewState,
    list_channels,
    make_stamp,
    open_channel,
)
from flexsheet.launch.viewing.urdf import make_urdf
from flexsheet.messages.base import Header, Message
from flexsheet.messages.bus import Subscriber
from flexsheet.messages.clock import SystemClock
from flexsheet.messages.scene import Scene
from flexsheet.messages.topics import find_topic
from flexsheet.messages.types import Status

ADDRESS = "127.0.0.1"
MAX_BACKLOG = 64
"""The maximum number of messages in the queue of one viewer."""
UPDATE_S = 0.1
"""The period, in seconds, with which the server checks which channels have viewers."""
STATIC_S = 1.0
TIME_S = 1.0 / 30.0
ALWAYS_READ = frozenset({"scene", "status"})
"""The topics that the server always reads, because they contain the scene and the parameters."""
URDF_PARAMETER = "/robot_description"


class ReadOnlyParameters(ServerListener):
    """A listener that returns parameters to viewers, and ignores changes of parameters."""

    def __init__(self) -> None:
        self.values: dict[str, Any] = {}

    def select(self, names: list[str]) -> list[Parameter]:
        """Return the named parameters, or all parameters if no names are given."""
        values = self.values
        return [Parameter(name, value=values[name]) for name in names or values if name in values]

    def on_get_parameters(
        self, client: Any, param_names: Any, request_id: str | None = None
    ) -> Any:
        return self.select(param_names)

    def on_set_parameters(self, client: Any, parameters: Any, request_id: str | None = None) -> Any:
        return self.select([one.name for one in parameters])


class LiveServer:
    """A server that sends the data of one running graph to viewers in a running event loop.

    rate_hz: maximum rate of a channel with numbers.
    image_rate_hz: maximum rate of a channel with images or meshes.
    port: TCP port. If it is 0, a free port is selected.
    on_problem: function that is called with the text of an error.
    """

    def __init__(
        self,
        plan: ResolvedGraph,
        run: Run,
        *,
        port: int,
        rate_hz: float,
        image_rate_hz: float,
        on_problem: Callable[[str], None],
    ) -> None:
        self._plan, self._run, self._on_problem = plan, run, on_problem
        self._periods_ns = {
            Pace.NUMBERS: int(1e9 / rate_hz),
            Pace.IMAGES: int(1e9 / image_rate_hz),
            Pace.EACH: 0,
            Pace.STATIC: 0,
        }
        self._state = ViewState()
        self._subscribers: dict[str, Subscriber] = {}
        self._clock = SystemClock()
        self._epoch_ns = time.time_ns() - self._clock.now_ns()
        self._context = foxglove.Context()
        topics = [find_topic(name) for name in plan.writers]
        self.channels = list(list_channels(topics))
        self._sinks = {one.name: open_channel(one, self._context) for one in self.channels}
        self._due_ns: dict[tuple[str, str], int] = {}
        self._parameters = ReadOnlyParameters()
        self._server = foxglove.start_server(
            name="flexsheet",
            host=ADDRESS,
            port=port,
            capabilities=[Capability.Parameters, Capability.Time],
            server_listener=self._parameters,
            context=self._context,
            message_backlog_size=MAX_BACKLOG,
        )
        self._set_parameters(
            {
                f"{node.name}.{name}": value
                for node in plan.nodes.values()
                for name, value in node.parameters.items()
            }
        )
        self._tasks = [
            asyncio.create_task(self._every(UPDATE_S, self._update_subscribers)),
            asyncio.create_task(self._every(STATIC_S, self._send_static)),
            asyncio.create_task(self._every(TIME_S, self._send_time)),
        ]

    @property
    def port(self) -> int:
        return int(self._server.port)

    @property
    def topics_read(self) -> set[str]:
        """Return the topics that the server currently reads from the graph."""
        return set(self._subscribers)

    async def serve(self) -> None:
        """Send data to viewers until the calling task is cancelled."""
        await asyncio.gather(*self._tasks)

    def close(self) -> None:
        for task in self._tasks:
            task.cancel()
        for subscriber in self._subscribers.values():
            subscriber.close()
        self._server.stop()

    async def _every(self, period_s: float, call: Callable[[], None]) -> None:
        while True:
            call()
            await asyncio.sleep(period_s)

    def _update_subscribers(self) -> None:
        """Subscribe only to the topics that channels with viewers need."""
        wanted = set(ALWAYS_READ & self._plan.writers.keys())
        for channel in self.channels:
            if self._sinks[channel.name].has_sinks():
                wanted.update(channel.topics)
        for topic in self._subscribers.keys() - wanted:
            self._subscribers.pop(topic).close()
            self._state.latest.pop(topic, None)
        for topic in wanted - self._subscribers.keys():
            self._subscribers[topic] = make_subscriber(
                topic,
                self._plan,
                self._run,
                partial(self._receive, topic),
                on_problem=self._on_problem,
            )
            self._subscribers[topic].start()

    def _receive(self, topic: str, message: Message, header: Header) -> None:
        self._state.update(topic, message)
        if isinstance(message, Scene):
            self._set_parameters({URDF_PARAMETER: make_urdf(make_model(message))})
        elif isinstance(message, Status):
            changed = json.loads(message.changed_parameters)
            self._set_parameters({f"{message.node}.{key}": one for key, one in changed.items()})
        now_ns = self._clock.now_ns()
        # A timestamp from the clock of another computer is replaced by the time of arrival.
        source_ns = header.source_ns if header.clock_id == self._clock.id else now_ns
        for channel in self.channels:
            if topic in channel.triggers:
                self._send(channel, topic, message, now_ns, source_ns)

    def _send(
        self, channel: Channel, topic: str, message: Message | None, now_ns: int, source_ns: int
    ) -> None:
        """Send a message on a channel if the channel has viewers and its period has elapsed.

        The period is the inverse of the channel's maximum rate.

        now_ns: present time.
        source_ns: timestamp of the message.
        """
        sink, key = self._sinks[channel.name], (channel.name, topic)
        if now_ns < self._due_ns.get(key, 0) or not sink.has_sinks():
            return
        self._due_ns[key] = now_ns + self._periods_ns[channel.pace]
        value = channel.make(self._state, message, make_stamp(source_ns + self._epoch_ns))
        if value is not None:
            sink.log(value, log_time=now_ns + self._epoch_ns)

    def _send_static(self) -> None:
        now_ns = self._clock.now_ns()
        for channel in self.channels:
            if channel.pace is Pace.STATIC:
                self._send(channel, "", None, now_ns, now_ns)

    def _send_time(self) -> None:
        self._server.broadcast_time(self._clock.now_ns() + self._epoch_ns)

    def _set_parameters(self, values: dict[str, Any]) -> None:
        """Store parameter values, and send the changed values to the subscribed viewers."""
        plain = {key: _make_plain(value) for key, value in values.items() if value is not None}
        old = self._parameters.values
        changed = {key: value for key, value in plain.items() if old.get(key) != value}
        # The dictionary is replaced and not modified, because another thread reads it.
        self._parameters.values = {**old, **changed}
        if changed:
            self._server.publish_parameter_values(self._parameters.select(list(changed)))


def _make_plain(value: Any) -> Any:
    """Convert a value to a parameter of Foxglove: a float, a bool or a text."""
    if isinstance(value, bool | str):
        return value
    if isinstance(value, int | float):
        return float(value)
    return json.dumps(value)
