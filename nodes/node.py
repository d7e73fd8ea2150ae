"""The form of a node: ports declared as annotations, handlers found by name, all else injected.

    class Follower(Node):
        "Publishes where the sheet shall be, a hand's breadth above the finger."

        parameters: FollowerParameters
        fingertip: Input[Fingertip]
        sheet_target: Output[SheetTarget]

        def on_fingertip(self, fingertip: Fingertip, header: Header) -> None:
            self.sheet_target.publish(..., source_ns=header.source_ns)

A node knows no sockets: it is given parameters, a clock and a function that takes what it sends.
The same class therefore runs live (`nodes.runner`), in replay and in a unit test.  Handlers may be
plain functions or coroutines; a coroutine handler never runs twice at once, and on a `latest` topic
it skips what was superseded while it ran.
"""

from __future__ import annotations

import asyncio
import inspect
from collections import deque
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import (
    Any,
    ClassVar,
    Generic,
    TypeVar,
    get_args,
    get_origin,
    get_type_hints,
)

import numpy as np
import structlog
from numpy.typing import NDArray
from pydantic import ConfigDict

from flexsheet.messages.base import Header, Message
from flexsheet.messages.clock import Clock
from flexsheet.messages.clock_table import ClockTable
from flexsheet.messages.limits import LimitedModel
from flexsheet.messages.topics import Delivery, Topic, topic_named
from flexsheet.messages.types import ArmState, PortStatus, Status
from flexsheet.nodes import NodeRole

M = TypeVar("M", bound=Message)
Send = Callable[[Topic, Message, Header], None]
Handler = Callable[[Any, Header], Awaitable[None] | None]

RATE_WINDOW_NS = 1_000_000_000
EVERY_QUEUE_LENGTH = 1000
MAX_LOG_ROWS = 20_000
RESEND_NS = 5_000_000_000
"""For this long after the start each status repeats the whole log, for late recorders."""


class NodeParameters(LimitedModel):
    """A node's parameters; subclasses declare theirs with units in the names and sane defaults."""

    model_config = ConfigDict(extra="forbid", frozen=True)


@dataclass(slots=True)
class PortCounts:
    """What is counted per port, for the status message."""

    messages: int = 0
    dropped: int = 0
    gaps: int = 0
    rejected: int = 0
    arrivals_ns: deque[int] = field(default_factory=lambda: deque(maxlen=2048))
    newest_source_ns: int | None = None
    newest_clock_id: str = ""

    def count(self, header: Header, now_ns: int) -> None:
        self.messages += 1
        self.arrivals_ns.append(now_ns)
        self.newest_source_ns = header.source_ns
        self.newest_clock_id = header.clock_id

    def status(self, topic: Topic, clock: Clock) -> PortStatus:
        now_ns = clock.now_ns()
        while self.arrivals_ns and self.arrivals_ns[0] < now_ns - RATE_WINDOW_NS:
            self.arrivals_ns.popleft()
        age_s = None
        if self.newest_source_ns is not None and self.newest_clock_id == clock.id:
            age_s = max(0.0, (now_ns - self.newest_source_ns) * 1e-9)
        return PortStatus(
            topic=topic.name,
            rate_hz=len(self.arrivals_ns) / (RATE_WINDOW_NS * 1e-9),
            age_s=age_s,
            messages=self.messages,
            dropped=self.dropped,
            gaps=self.gaps,
            rejected=self.rejected,
        )


class ExecutionLog:
    """Log the handler calls of a node, in order, for a replay.

    Rows are those of `flexsheet.messages.types.Status.execution_log`.
    """

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._started_ns = clock.now_ns()
        self._rows: deque[tuple[int, int, int, int]] = deque(maxlen=MAX_LOG_ROWS)

    def add_message(self, port: int, header: Header, at_ns: int) -> None:
        self._rows.append((port, header.sequence, header.epoch, at_ns))

    def add_timer(self, number: int) -> None:
        self._rows.append((-1 - number, 0, 0, self._clock.now_ns()))

    def drain(self) -> NDArray[np.int64]:
        """Return the rows (n, 4), and delete them once RESEND_NS have passed since the start."""
        rows = np.array(self._rows, dtype=np.int64).reshape(-1, 4)
        if self._clock.now_ns() > self._started_ns + RESEND_NS:
            self._rows.clear()
        return rows


class Input(Generic[M]):
    """A subscribed topic: the newest message with its header, and what was counted.

    All stamps are of our own clock; clock_trouble says why they cannot be trusted, empty: they can.
    """

    def __init__(self, topic: Topic, clock: Clock) -> None:
        self.topic = topic
        self.message: M | None = None
        self.header: Header | None = None
        self.received_ns: int = 0
        self.clock_trouble = ""
        self.counts = PortCounts()
        self.on_accept: Callable[[Header, int], None] | None = None
        self._clock = clock

    def age_s(self) -> float:
        """Seconds since the newest message's source stamp; infinite before the first.

        Of another host's clock that is not measured, the time since it was received counts.
        """
        if self.header is None:
            return float("inf")
        return (self._clock.now_ns() - self.header.source_ns) * 1e-9

    def accept(self, message: M, header: Header, clock_trouble: str = "") -> None:
        self.message, self.header, self.clock_trouble = message, header, clock_trouble
        self.received_ns = self._clock.now_ns()
        self.counts.count(header, self.received_ns)
        if self.on_accept is not None:
            self.on_accept(header, self.received_ns)


class Output(Generic[M]):
    """A published topic: numbers and stamps each message."""

    def __init__(
        self, topic: Topic, clock: Clock, send: Send, *, writer: str, epoch: int, plan: str
    ) -> None:
        self.topic = topic
        self.counts = PortCounts()
        self._clock, self._send = clock, send
        self._writer, self._epoch, self._plan = writer, epoch, plan

    def publish(self, message: M, *, source_ns: int | None = None) -> Header:
        """Send `message`; `source_ns` is the stamp of what it derives from (default: now)."""
        now_ns = self._clock.now_ns()
        header = Header(
            sequence=self.counts.messages + 1,
            source_ns=now_ns if source_ns is None else source_ns,
            publish_ns=now_ns,
            clock_id=self._clock.id,
            writer=self._writer,
            epoch=self._epoch,
            plan=self._plan,
        )
        self.counts.count(header, now_ns)
        self._send(self.topic, message, header)
        return header


@dataclass(frozen=True, slots=True)
class Port:
    """A declared input or output, before any node is built."""

    name: str
    direction: str
    message: type[Message]


@dataclass(frozen=True, slots=True)
class Timer:
    """A method to be called periodically; `rate_parameter` names the parameter with its Hz."""

    method: str
    rate_parameter: str


def periodic(rate_parameter: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Mark a method to be called at the rate (Hz) that the named parameter holds."""

    def mark(method: Callable[..., Any]) -> Callable[..., Any]:
        method.__periodic__ = rate_parameter  # type: ignore[attr-defined]  # a function attribute
        return method

    return mark


def ports_of(node_class: type[Node]) -> dict[str, Port]:
    """The declared ports of a node class, in the order of declaration.

    A port is named as its topic, with "/" written "__" ("twin__finger"); a launch file may connect
    it to another topic of the same type.
    """
    ports = {}
    for name, annotation in get_type_hints(node_class).items():
        origin = get_origin(annotation)
        if origin in (Input, Output):
            direction = "input" if origin is Input else "output"
            ports[name] = Port(name, direction, get_args(annotation)[0])
    return ports


def further_port(topic_name: str) -> str:
    """Name the port of a topic that `Node.further_inputs` returned."""
    return f"in/{topic_name}"


def parameters_of(node_class: type[Node]) -> type[NodeParameters]:
    """The declared type of a node class's `parameters`."""
    return get_type_hints(node_class)["parameters"]  # type: ignore[no-any-return]


def role_of(node_class: type[Node]) -> NodeRole | None:
    """The declared role of a node class; an arm bridge is known by what it publishes."""
    publishes = {
        port.message for port in ports_of(node_class).values() if port.direction == "output"
    }
    if node_class.role is None and ArmState in publishes:
        return NodeRole.ARM_BRIDGE
    return node_class.role


def timers_of(node_class: type[Node]) -> list[Timer]:
    """The methods of a node class that are marked `@periodic`."""
    return [
        Timer(name, member.__periodic__)
        for name, member in inspect.getmembers(node_class, inspect.isfunction)
        if hasattr(member, "__periodic__")
    ]


class Node:
    """Base of all nodes; see the module's text."""

    parameters: NodeParameters
    status: Output[Status]

    takes_frames: ClassVar[bool] = False
    """Whether `deliver` is given each message as the wire's frames, unopened."""
    measures_clocks: ClassVar[bool] = False
    """Whether it wants the stamps of other hosts as they are, of their clocks."""
    role: ClassVar[NodeRole | None] = None
    opens_devices: ClassVar[bool] = False
    """Whether it reaches for devices, ports or files of its own: a replay must not start it."""

    async def settle(self) -> None:
        """Wait for work that handlers have left to others; a replay stands still until then."""

    @classmethod
    def replay_refusal(cls, parameters: Any) -> str:
        """Say why `bag verify` must not step a node with these parameters; empty: it may."""
        if cls.opens_devices:
            return "it uses devices of its own, whose data are not in the bag"
        return ""

    @classmethod
    def further_inputs(cls, parameters: Any, written: Sequence[Topic]) -> Sequence[str]:
        """Name the topics to subscribe to beside the declared ports.

        For a node whose inputs depend on its parameters and on the topics that the graph writes.
        The ports of these topics are named by `further_port`.
        """
        return ()

    def __init__(
        self,
        parameters: NodeParameters,
        *,
        name: str,
        clock: Clock,
        send: Send,
        topics: dict[str, str] | None = None,
        plan_hash: str = "",
        epoch: int | None = None,
    ) -> None:
        """`topics` connects ports to topics of other names: {"arm": "arm_left"}.

        `epoch` tells one start of the node from another; when it starts, unless a replay gives it.
        """
        self.parameters = parameters
        self.name, self.clock, self.plan_hash = name, clock, plan_hash
        self.log = structlog.get_logger().bind(node=name)
        self.clock_table = ClockTable(clock.id)
        self.inputs: dict[str, Input[Any]] = {}
        self.outputs: dict[str, Output[Any]] = {}
        self.errors = 0
        self.last_error = ""
        self.reported_problems = 0
        self.note = ""
        self.started_ns = clock.now_ns()
        self._execution_log = ExecutionLog(clock)
        if epoch is None:
            epoch = self.started_ns
        declared = ports_of(type(self))
        for port in declared.values():
            topic = topic_named((topics or {}).get(port.name, port.name.replace("__", "/")))
            if topic.message is not port.message:
                raise TypeError(
                    f"{name}.{port.name} carries {port.message.__name__}, "
                    f'topic "{topic.name}" carries {topic.message.__name__}'
                )
            if port.direction == "input":
                self.inputs[port.name] = Input(topic, clock)
                if not self.opens_devices:
                    number = len(self.inputs) - 1
                    self.inputs[port.name].on_accept = partial(
                        self._execution_log.add_message, number
                    )
                setattr(self, port.name, self.inputs[port.name])
            else:
                self.outputs[port.name] = Output(
                    topic, clock, send, writer=name, epoch=epoch, plan=plan_hash
                )
                setattr(self, port.name, self.outputs[port.name])
        for further, topic_name in (topics or {}).items():
            if further not in declared:
                self.inputs[further] = Input(topic_named(topic_name), clock)
        self._mailboxes = {
            port: Mailbox(self, port)
            for port in self.inputs
            if inspect.iscoroutinefunction(self._handler(port))
        }

    async def setup(self) -> None:
        """Called once before the first message; open devices here."""

    async def close(self) -> None:
        """Called once at the end, whatever happened; release devices here."""

    def _handler(self, port: str) -> Handler | None:
        return getattr(self, f"on_{port}", None)

    def deliver(self, port: str, message: Message, header: Header) -> None:
        """Hand a message to the input; a plain handler runs now, a coroutine in its own task."""
        message, header, clock_trouble = self._localised(message, header)
        mailbox = self._mailboxes.get(port)
        if mailbox is not None:
            mailbox.put(message, header, clock_trouble)
            return
        self.inputs[port].accept(message, header, clock_trouble)
        handler = self._handler(port)
        if handler is not None:
            try:
                handler(message, header)
            except Exception as error:
                self.report_error(f"on_{port}", error)

    async def step(self, port: str, message: Message, header: Header) -> None:
        """Hand a message to the input and wait until its handler is through: replay, tests."""
        await self.take(port, *self._localised(message, header))

    def _localised(self, message: Message, header: Header) -> tuple[Message, Header, str]:
        if self.measures_clocks:
            return message, header, ""
        return self.clock_table.localised(message, header, self.clock.now_ns())

    async def take(self, port: str, message: Message, header: Header, clock_trouble: str) -> None:
        """`step` with a message whose stamps are of our own clock already."""
        self.inputs[port].accept(message, header, clock_trouble)
        handler = self._handler(port)
        if handler is not None:
            await self.call(f"on_{port}", handler, message, header)

    async def call(self, what: str, function: Callable[..., Any], *arguments: Any) -> None:
        """Call a handler or timer; an exception is counted, logged and shown in the status."""
        try:
            result = function(*arguments)
            if inspect.isawaitable(result):
                await result
        except Exception as error:
            self.report_error(what, error)

    def drain_execution_log(self) -> NDArray[np.int64]:
        """Return the handler calls since the last call; see `Status.execution_log`."""
        return self._execution_log.drain()

    async def call_timer(self, number: int, timer: Timer) -> None:
        """Call the method of one of `timers_of` the node."""
        if not self.opens_devices:
            self._execution_log.add_timer(number)
        await self.call(timer.method, getattr(self, timer.method))

    def report_error(self, what: str, error: Exception) -> None:
        """Count an error, keep it for the status, and log it with its trace."""
        self.errors += 1
        self.last_error = f"{what}: {type(error).__name__}: {error}"
        self.log.error("handler failed", what=what, error=str(error), exc_info=error)

    def is_superseded(self, port: str) -> bool:
        """Return whether a newer message waits for a port's coroutine handler; from any thread."""
        return self._mailboxes[port].has_waiting

    def mailbox_tasks(self) -> list[asyncio.Task[None]]:
        """Tasks in which coroutine handlers run now; for the runner to end."""
        return [box.task for box in self._mailboxes.values() if box.task is not None]

    def stop_mailboxes(self) -> None:
        for mailbox in self._mailboxes.values():
            mailbox.stop()


class Mailbox:
    """What waits for a coroutine handler: the newest message, or a bounded queue of every one."""

    def __init__(self, node: Node, port: str) -> None:
        self._node, self._port = node, port
        self._input = node.inputs[port]
        latest = self._input.topic.delivery is Delivery.LATEST
        self._capacity = 1 if latest else EVERY_QUEUE_LENGTH
        self._overflow_is_error = not latest
        self._waiting: deque[tuple[Message, Header, str]] = deque()
        self.task: asyncio.Task[None] | None = None

    def put(self, message: Message, header: Header, clock_trouble: str) -> None:
        if len(self._waiting) >= self._capacity:
            self._waiting.popleft()
            self._input.counts.dropped += 1
            if self._overflow_is_error:
                self._node.report_error(
                    f"on_{self._port}", OverflowError(f"queue of {self._capacity} overflowed")
                )
        self._waiting.append((message, header, clock_trouble))
        if self.task is None or self.task.done():
            self.task = asyncio.get_running_loop().create_task(self._drain())

    @property
    def has_waiting(self) -> bool:
        """Whether a message waits that no handler has begun with."""
        return bool(self._waiting)

    async def _drain(self) -> None:
        while self._waiting:
            await self._node.take(self._port, *self._waiting.popleft())

    def stop(self) -> None:
        if self.task is not None:
            self.task.cancel()
