"""Define the base class of nodes.

In a subclass, annotations declare the ports, and methods that are named after ports are handlers:

    class Follower(Node):
        "Publish a sheet target 10 cm above the finger."

        parameters: FollowerParameters
        fingertip: Input[Fingertip]
        sheet_target: Output[SheetTarget]

        def on_fingertip(self, fingertip: Fingertip, header: Header) -> None:
            self.sheet_target.publish(..., source_ns=header.source_ns)

A node does not use sockets. The arguments of a node are parameters, a clock and a function that
sends messages. Therefore the same class runs live (`nodes.runner`), in a replay and in a unit test.
Handlers are functions or coroutines. Only one call of a coroutine handler runs at a time. On a
topic with the delivery `latest`, the handler does not receive messages that were superseded during
its last call.
"""

from __future__ import annotations

import asyncio
import inspect
import json
from collections import deque
from collections.abc import Awaitable, Callable, Mapping, Sequence
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
from flexsheet.messages.errors import FlexsheetError, describe_error, find_missing_extra
from flexsheet.messages.limits import LimitedModel
from flexsheet.messages.notes import Note, NoteCode
from flexsheet.messages.scene import Scene
from flexsheet.messages.topics import Delivery, Topic, find_topic
from flexsheet.messages.types import ArmState, ParameterChange, PortStatus, SelfCheck, Status
from flexsheet.nodes import NodeRole, OmissionReason

M = TypeVar("M", bound=Message)
Send = Callable[[Topic, Message, Header], None]
Handler = Callable[[Any, Header], Awaitable[None] | None]

RATE_WINDOW_NS = 1_000_000_000
EVERY_QUEUE_LENGTH = 1000
MAX_LOG_ROWS = 20_000
RESEND_NS = 5_000_000_000
"""The time (ns) after the start in which each status contains the full execution log. Therefore
recorders that start late receive the full log, too."""


class NodeParameters(LimitedModel):
    """The base class for a node's parameters, which subclasses declare as fields."""

    model_config = ConfigDict(extra="forbid", frozen=True)


@dataclass(slots=True)
class PortCounts:
    """The counters of one input or output, which the status message reports."""

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
    """A log of a node's handler calls. A replay repeats the calls in the same order.

    `flexsheet.messages.types.Status.execution_log` describes the rows.
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
        """Return the logged handler calls as an array (n, 4), and delete them from the log.

        In the first RESEND_NS nanoseconds after the node's start, the log is not deleted. Therefore
        recorders that start late also receive the first calls.
        """
        rows = np.array(self._rows, dtype=np.int64).reshape(-1, 4)
        if self._clock.now_ns() > self._started_ns + RESEND_NS:
            self._rows.clear()
        return rows


class Input(Generic[M]):
    """A subscribed topic with its latest message, header and counters.

    clock_problem: reason why the conversion of timestamps is not reliable, or "" if it is.
    has_ended: whether the connection to the writer has ended since the last message; updated only
        for the `watched_inputs` of a node.

    All timestamps are converted to this host's clock.
    """

    def __init__(self, topic: Topic, clock: Clock) -> None:
        self.topic = topic
        self.message: M | None = None
        self.header: Header | None = None
        self.received_ns: int = 0
        self.clock_problem, self.has_ended = "", False
        self.counts = PortCounts()
        self.on_accept: Callable[[Header, int], None] | None = None
        self._clock = clock

    def age_s(self) -> float:
        """Return the time (s) since the source timestamp of the latest message.

        The time is infinite before the first message. If the offset of the sender's clock is
        unknown, the result is the time since the message was received.
        """
        if self.header is None:
            return float("inf")
        return (self._clock.now_ns() - self.header.source_ns) * 1e-9

    def accept(self, message: M, header: Header, clock_problem: str = "") -> None:
        self.message, self.header, self.clock_problem = message, header, clock_problem
        self.received_ns = self._clock.now_ns()
        self.counts.count(header, self.received_ns)
        if self.on_accept is not None:
            self.on_accept(header, self.received_ns)


class Output(Generic[M]):
    """A publisher of a topic, which adds sequence numbers and timestamps to the messages."""

    def __init__(
        self, topic: Topic, clock: Clock, send: Send, *, writer: str, epoch: int, plan: str
    ) -> None:
        self.topic = topic
        self.counts = PortCounts()
        self._clock, self._send = clock, send
        self._writer, self._epoch, self._plan = writer, epoch, plan

    def publish(self, message: M, *, source_ns: int | None = None) -> Header:
        """Publish a message, and return its header.

        source_ns: time of the measurement from which the message was computed; None means the
            current time.
        """
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
    """An input or output that a node class declares.

    direction: "input" or "output".
    """

    name: str
    direction: str
    message: type[Message]


@dataclass(frozen=True, slots=True)
class Timer:
    """A periodic method of a node class.

    rate_parameter: name of the node parameter that contains the rate (Hz).
    """

    method: str
    rate_parameter: str


def periodic(rate_parameter: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Return a decorator that marks a node's method as periodic.

    rate_parameter: name of the node parameter that contains the rate (Hz).
    """

    def mark(method: Callable[..., Any]) -> Callable[..., Any]:
        method.__periodic__ = rate_parameter  # type: ignore[attr-defined]  # a function attribute
        return method

    return mark


def find_ports(node_class: type[Node]) -> dict[str, Port]:
    """Return the declared ports of a node class by name, in the order of declaration.

    A port has the name of its topic, with "__" instead of "/" ("twin__finger"). A launch file can
    connect the port to another topic of the same type.
    """
    ports = {}
    for name, annotation in get_type_hints(node_class).items():
        origin = get_origin(annotation)
        if origin in (Input, Output):
            direction = "input" if origin is Input else "output"
            ports[name] = Port(name, direction, get_args(annotation)[0])
    return ports


def find_unmatched_handlers(node_class: type[Node]) -> list[str]:
    """Return the message handlers of a node class, such as "on_fingertip", that have no input."""
    inputs = {port.name for port in find_ports(node_class).values() if port.direction == "input"}
    return [
        name
        for name, _ in inspect.getmembers(node_class, inspect.isfunction)
        if name.startswith("on_") and name[3:] not in inputs and not hasattr(Node, name)
    ]


def further_port(topic_name: str) -> str:
    """Return the name of the input port for a topic without a declared port.

    The method `Node.further_inputs` returns these topics.
    """
    return f"in/{topic_name}"


def find_parameters_type(node_class: type[Node]) -> type[NodeParameters]:
    """Return the parameter class of a node class, which is the declared type of `parameters`."""
    return get_type_hints(node_class)["parameters"]  # type: ignore[no-any-return]


def find_role(node_class: type[Node]) -> NodeRole | None:
    """Return the role of a node class, or None if it has no role.

    A class that declares no role but writes ArmState has the role ARM_BRIDGE.
    """
    publishes = {
        port.message for port in find_ports(node_class).values() if port.direction == "output"
    }
    if node_class.role is None and ArmState in publishes:
        return NodeRole.ARM_BRIDGE
    return node_class.role


def find_timers(node_class: type[Node]) -> list[Timer]:
    """Return the methods of a node class that have the decorator `@periodic`."""
    return [
        Timer(name, member.__periodic__)
        for name, member in inspect.getmembers(node_class, inspect.isfunction)
        if hasattr(member, "__periodic__")
    ]


class Node:
    """The base class of all nodes. The docstring of the module contains an example."""

    parameters: NodeParameters
    status: Output[Status]

    takes_frames: ClassVar[bool] = False
    """Whether `deliver` receives each message as undecoded ZeroMQ frames (message parts)."""
    measures_clocks: ClassVar[bool] = False
    """Whether the node measures the clocks of other hosts, so that their timestamps are not
    converted."""
    role: ClassVar[NodeRole | None] = None
    optional_inputs: ClassVar[frozenset[str]] = frozenset()
    """The ports that may be unconnected if no node of the graph writes their topic."""
    live_parameters: ClassVar[frozenset[str]] = frozenset()
    """The parameters that may change while the node runs. The node must read them from `parameters`
    at each use, and must declare `parameter: Input[ParameterChange]`."""
    watched_inputs: ClassVar[frozenset[str]] = frozenset()
    """The input ports at which the node must detect immediately that the process of the writer has
    ended."""
    ends_with_inputs: ClassVar[bool] = False
    """Whether the node disconnects the readers of its outputs if the writer of a port in
    `watched_inputs` ends. The readers then also detect that the data have stopped."""
    on_demand: ClassVar[bool] = False
    """Whether a graph omits the node if no other node reads its topics."""
    opens_devices: ClassVar[bool] = False
    """Whether the node opens devices, ports or files. A replay does not start such a node."""

    async def settle(self) -> None:
        """Wait until the work that handlers have started is finished.

        A replay calls this method after each step.
        """

    @classmethod
    def replay_refusal(cls, parameters: Any) -> str:
        """Return the reason why `flexsheet bag verify` cannot replay the node, or "" if it can."""
        if cls.opens_devices:
            return "it reads devices, whose data are not in the bag"
        return ""

    @classmethod
    def omission_reason(cls, parameters: Any, scene: Scene) -> OmissionReason | None:
        """Return the reason to omit the node from a graph with this scene, or None."""
        return None

    @classmethod
    def unused_inputs(cls, parameters: Any, scene: Scene) -> frozenset[str]:
        """Return the input ports that the node does not use with this scene."""
        return frozenset()

    @classmethod
    def unused_outputs(cls, parameters: Any) -> frozenset[str]:
        """Return the outputs on which a node with these parameters publishes nothing."""
        return frozenset()

    @classmethod
    def further_inputs(cls, parameters: Any, written: Sequence[Topic]) -> Sequence[str]:
        """Return the names of the topics that the node reads in addition to its declared ports.

        written: topics that the nodes of the graph write, from which the node can choose.
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
        """Connect the ports to topics.

        send: function that sends messages.
        topics: topic names by port, for ports whose name differs from the topic's name, such as
            {"arm": "arm_left"}.
        epoch: number that identifies one start of the node; None means the time (ns) of the start.

        Raises TypeError if the message types of a port and of its topic differ.
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
        self.notes: tuple[Note, ...] = ()
        self.changed_parameters: dict[str, Any] = {}
        self.self_checks: tuple[SelfCheck, ...] = ()
        self.started_ns = clock.now_ns()
        self.execution_log = ExecutionLog(clock)
        if epoch is None:
            epoch = self.started_ns
        declared = find_ports(type(self))
        for port in declared.values():
            port.message.model_rebuild()  # Otherwise this would happen during the first message.
            topic = find_topic((topics or {}).get(port.name, port.name.replace("__", "/")))
            if topic.message is not port.message:
                raise TypeError(
                    f"{name}.{port.name}: expected a topic of {port.message.__name__}, "
                    f'found "{topic.name}" of {topic.message.__name__}'
                )
            if port.direction == "input":
                self.inputs[port.name] = Input(topic, clock)
                if not self.opens_devices:
                    self.inputs[port.name].on_accept = partial(
                        self.execution_log.add_message, len(self.inputs) - 1
                    )
                setattr(self, port.name, self.inputs[port.name])
            else:
                self.outputs[port.name] = Output(
                    topic, clock, send, writer=name, epoch=epoch, plan=plan_hash
                )
                setattr(self, port.name, self.outputs[port.name])
        for further, topic_name in (topics or {}).items():
            if further not in declared:
                self.inputs[further] = Input(find_topic(topic_name), clock)
        self._mailboxes = {
            port: Mailbox(self, port)
            for port in self.inputs
            if inspect.iscoroutinefunction(self._handler(port))
        }

    def on_parameter(self, change: ParameterChange, _: Header) -> None:
        """Change a parameter while the node runs.

        Raises ValueError if the parameter is not one of `live_parameters`.
        """
        if change.node != self.name:
            return
        if change.parameter not in self.live_parameters:
            raise ValueError(
                f'parameter "{change.parameter}" cannot change while the node runs; change it in '
                "the launch file and start the graph again"
            )
        value = json.loads(change.value)
        kind = type(self.parameters)
        self.parameters = kind.model_validate({**dict(self.parameters), change.parameter: value})
        self.changed_parameters[change.parameter] = value

    async def setup(self) -> None:
        """Open devices. The runner calls this method once before the first message."""

    async def close(self) -> None:
        """Release devices. The runner calls this method once at the end, also after an error."""

    def _handler(self, port: str) -> Handler | None:
        return getattr(self, f"on_{port}", None)

    def deliver(self, port: str, message: Message, header: Header) -> None:
        """Store a message in its input, and call its handler.

        A coroutine handler runs in a separate task.
        """
        message, header, clock_problem = self._localise(message, header)
        self.inputs[port].has_ended = False
        mailbox = self._mailboxes.get(port)
        if mailbox is not None:
            mailbox.put(message, header, clock_problem)
            return
        self.inputs[port].accept(message, header, clock_problem)
        handler = self._handler(port)
        if handler is not None:
            try:
                handler(message, header)
            except Exception as error:
                self.report_error(f"on_{port}", error)

    async def step(self, port: str, message: Message, header: Header) -> None:
        """Store a message in its input, call its handler, and wait until the handler has finished.

        Replays and tests use this method.
        """
        await self.handle(port, *self._localise(message, header))

    def _localise(self, message: Message, header: Header) -> tuple[Message, Header, str]:
        if self.measures_clocks:
            return message, header, ""
        return self.clock_table.localize(message, header, self.clock.now_ns())

    async def handle(self, port: str, message: Message, header: Header, clock_problem: str) -> None:
        """Store a message in its input, call its handler, and wait until the handler has finished.

        header: header with timestamps of this host's clock.
        clock_problem: reason why the timestamps are not reliable, or "" if they are.
        """
        self.inputs[port].accept(message, header, clock_problem)
        handler = self._handler(port)
        if handler is not None:
            await self.call(f"on_{port}", handler, message, header)

    async def call(self, what: str, function: Callable[..., Any], *arguments: Any) -> None:
        """Call a handler or a periodic method, and report an exception that it raises.

        what: name of the called method in the report.
        """
        try:
            result = function(*arguments)
            if inspect.isawaitable(result):
                await result
        except Exception as error:
            self.report_error(what, error)

    async def call_timer(self, number: int, timer: Timer) -> None:
        """Call a periodic method, and add the call to the execution log.

        number: index of the method in the list of timers.
        """
        if not self.opens_devices:
            self.execution_log.add_timer(number)
        await self.call(timer.method, getattr(self, timer.method))

    def set_note(self, code: NoteCode, detail: str = "") -> None:
        """Replace the notes in the node's status by one note."""
        self.notes = (Note(code=code, detail=detail),)

    def set_notes(self, details: Mapping[NoteCode, str]) -> None:
        """Replace the notes in the node's status by the notes whose detail is not empty."""
        self.notes = tuple(Note(code=code, detail=text) for code, text in details.items() if text)

    def report_error(self, what: str, error: Exception) -> None:
        """Count an error, report it in the status message, and log it.

        The log has no traceback of a FlexsheetError, whose text states a remedy.
        """
        self.errors += 1
        self.last_error = f"{what}: {type(error).__name__}: {describe_error(error)}"
        explained = isinstance(error, FlexsheetError) or find_missing_extra(error)
        self.log.error(
            "handler failed",
            what=what,
            error=describe_error(error),
            exc_info=None if explained else error,
        )

    def mailbox_tasks(self) -> list[asyncio.Task[None]]:
        """Return the tasks in which coroutine handlers run."""
        return [box.task for box in self._mailboxes.values() if box.task is not None]


class Mailbox:
    """A queue of messages for a coroutine handler. On a topic with the delivery `latest`, the queue
    stores only the newest message.
    """

    def __init__(self, node: Node, port: str) -> None:
        self._node, self._port = node, port
        self._input = node.inputs[port]
        latest = self._input.topic.delivery is Delivery.LATEST
        self._capacity = 1 if latest else EVERY_QUEUE_LENGTH
        self._overflow_is_error = not latest
        self.waiting: deque[tuple[Message, Header, str]] = deque()
        self.task: asyncio.Task[None] | None = None

    def put(self, message: Message, header: Header, clock_problem: str) -> None:
        if len(self.waiting) >= self._capacity:
            self.waiting.popleft()
            self._input.counts.dropped += 1
            if self._overflow_is_error:
                self._node.report_error(
                    f"on_{self._port}",
                    OverflowError(
                        f"the queue of {self._capacity} messages is full, so its oldest message is "
                        "lost; reduce the rate of the topic"
                    ),
                )
        self.waiting.append((message, header, clock_problem))
        if self.task is None or self.task.done():
            self.task = asyncio.get_running_loop().create_task(self._drain())

    async def _drain(self) -> None:
        while self.waiting:
            await self._node.handle(self._port, *self.waiting.popleft())
