"""Run nodes live: connect their ports, run their timers and publish their status.

The launcher writes a `ProcessConfig` to a file, and starts a process that reads the file. The
process runs one or several nodes in one event loop. The nodes of a process exchange messages
without serialization. If a node fails, its process ends. A test can call `run_node` in its own
event loop.
"""

from __future__ import annotations

import asyncio
import gc
import json
import os
import signal
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import psutil
import structlog
import uvloop
from pydantic import BaseModel, ConfigDict

from flexsheet.messages.base import Header, Message
from flexsheet.messages.bus import BusError, MessageFilter, Publisher, Source, Subscriber
from flexsheet.messages.clock import SystemClock
from flexsheet.messages.errors import describe_error
from flexsheet.messages.local_bus import LocalBus
from flexsheet.messages.security import KeyRing
from flexsheet.messages.topics import Delivery, Topic, find_topic
from flexsheet.messages.types import Arming, EStop, HostStatus, Status
from flexsheet.nodes import node_class
from flexsheet.nodes.background import enter_real_time, leave_real_time
from flexsheet.nodes.node import Node, PortCounts, Timer, find_parameters_type, find_timers
from flexsheet.nodes.signals import handle_signals
from flexsheet.nodes.stop_socket import StopSocket

STATUS_PERIOD_S = 1.0
CANCEL_AGAIN_S = 0.2


class PortConfig(BaseModel):
    """The connection of a node's port to a topic.

    endpoints: ZeroMQ endpoints. The endpoints of an input can name the expected writer.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    port: str
    topic: str
    endpoints: tuple[str | Source, ...]


class NodeConfig(BaseModel):
    """The configuration of one node.

    keys_file: file with the encryption keys (a `KeyRing`); None if there is no encryption.
    estop_resetters: writers that may reset an e-stop or enable the arms; None if all writers may.
    clocks: connection to the topic with the clock offsets of other hosts; None if there is only one
        host.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    name: str
    type: str
    parameters: dict[str, Any]
    inputs: tuple[PortConfig, ...]
    outputs: tuple[PortConfig, ...]
    plan_hash: str
    run_dir: str
    keys_file: Path | None = None
    estop_resetters: tuple[str, ...] | None = None
    clocks: PortConfig | None = None


class ProcessConfig(BaseModel):
    """The configuration of a process and its nodes.

    ready_fd: file descriptor of a pipe to the launcher; None if there is no launcher.
    realtime_priority: real-time priority after all nodes are ready; None for normal priority.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    name: str
    nodes: tuple[NodeConfig, ...]
    ready_fd: int | None = None
    realtime_priority: int | None = None


class NodeTransport:
    """The sockets of the inputs and outputs of one node.

    local: bus between the nodes of one process; None if the process has only one node.
    """

    def __init__(self, config: NodeConfig, log: Any, local: LocalBus | None = None) -> None:
        self._config, self._log, self._local = config, log, local
        self._keys = None if config.keys_file is None else KeyRing.load(config.keys_file)
        self._publishers: dict[str, Publisher] = {}
        self._subscribers: list[Subscriber] = []
        self._stop_socket: StopSocket | None = None
        self._failure: BusError | None = None
        self._has_failed = asyncio.Event()

    def open_outputs(self, node: Node) -> None:
        for output in self._config.outputs:
            if output.endpoints:
                topic = find_topic(output.topic)
                endpoints = [str(one) for one in output.endpoints]
                self._publishers[topic.name] = Publisher(
                    topic,
                    endpoints,
                    keys=self._keys,
                    on_refused=self._make_refusal_handler(node.outputs[output.port].counts, topic),
                    local=self._local,
                )

    def _make_refusal_handler(self, counts: PortCounts, topic: Topic) -> Callable[[str], None]:
        def on_refused(text: str) -> None:
            counts.rejected += 1
            self._log.warning("output", topic=topic.name, problem=text)

        return on_refused

    async def open_inputs(self, node: Node) -> None:
        if self._config.clocks is not None:
            subscriber = Subscriber(
                find_topic(self._config.clocks.topic),
                self._config.clocks.endpoints,
                lambda clocks, _: node.clock_table.update(clocks),
                PortCounts(),
                on_problem=partial(self._report_problem, node),
                plan=self._config.plan_hash,
                local=self._local,
            )
            subscriber.start()
            self._subscribers.append(subscriber)

        for config in self._config.inputs:
            node_input = node.inputs[config.port]
            subscriber = Subscriber(
                node_input.topic,
                config.endpoints,
                partial(node.deliver, config.port),
                node_input.counts,
                on_problem=partial(self._report_problem, node),
                raw=node.takes_frames,
                keys=self._keys,
                # The status of nodes with another plan must be accepted.
                plan=None
                if node_input.topic.message in (Status, HostStatus)
                else self._config.plan_hash,
                message_filter=self._message_filter(node_input.topic),
                on_disconnected=partial(self._end_input, node, config.port)
                if config.port in node.watched_inputs
                else None,
                local=self._local,
            )
            subscriber.start()
            self._subscribers.append(subscriber)
            if node.opens_devices and not node.takes_frames and node_input.topic.message is EStop:
                await self._open_stop_socket(node, config.port)

    async def _open_stop_socket(self, node: Node, port: str) -> None:
        """Open a socket for e-stops from tools. It works even if the launcher does not respond."""

        def stop(reason: str) -> None:
            now_ns = node.clock.now_ns()
            header = Header(1, now_ns, now_ns, node.clock.id, node.name, now_ns, node.plan_hash)
            node.deliver(port, EStop(engaged=True, reason=reason), header)

        self._stop_socket = StopSocket(Path(self._config.run_dir), "node", node.name, stop)
        await self._stop_socket.open()

    def _end_input(self, node: Node, port: str) -> None:
        """Record that the writer of an input port has ended.

        If the attribute `ends_with_inputs` of the node is true, disconnect the readers of its
        outputs. The readers then detect that the data have stopped.
        """
        node.inputs[port].has_ended = True
        if not node.ends_with_inputs or self._has_failed.is_set():
            return
        try:
            for topic, publisher in self._publishers.items():
                if topic != node.status.topic.name:
                    publisher.interrupt()
        except BusError as error:
            self._failure = error
            self._has_failed.set()

    async def watch_failure(self) -> None:
        """Wait until a socket of the node fails permanently, and raise BusError."""
        await self._has_failed.wait()
        if self._failure is not None:
            raise self._failure

    def _report_problem(self, node: Node, text: str) -> None:
        node.last_error = text
        self._log.warning("input", problem=text)

    def _message_filter(self, topic: Topic) -> MessageFilter | None:
        allowed = self._config.estop_resetters
        if topic.message not in (EStop, Arming) or allowed is None:
            return None

        def rejection_reason(message: EStop | Arming, header: Header) -> str | None:
            permits = not message.engaged if isinstance(message, EStop) else message.ready
            if not permits or header.writer in allowed:
                return None
            return (
                f"{header.writer} may not reset an e-stop or enable the arms; set "
                "hosts.NAME.may_reset_estop of its host in the launch file"
            )

        return rejection_reason

    def send(self, topic: Topic, message: Message, header: Header) -> None:
        publisher = self._publishers.get(topic.name)
        if publisher is not None:
            publisher.send(message, header)

    def close(self) -> None:
        if self._stop_socket is not None:
            self._stop_socket.close()
        for subscriber in self._subscribers:
            subscriber.close()
        for publisher in self._publishers.values():
            publisher.close()


async def run_timer(node: Node, number: int, timer: Timer) -> None:
    """Call a node's periodic method at multiples of its period, and skip overdue calls."""
    period_s = 1.0 / float(getattr(node.parameters, timer.rate_parameter))
    loop = asyncio.get_running_loop()
    due_s = loop.time()
    while True:
        await node.call_timer(number, timer)
        due_s += period_s
        now_s = loop.time()
        if due_s <= now_s:
            due_s += period_s * int((now_s - due_s) / period_s + 1)
        await asyncio.sleep(due_s - now_s)


async def run_status(node: Node, process: psutil.Process, beat: Callable[[], None]) -> None:
    """Publish the node's status, and send a heartbeat to the launcher, once a second."""
    process.cpu_percent()
    while True:
        await asyncio.sleep(STATUS_PERIOD_S)
        node.status.publish(make_status(node, "running", process))
        beat()


def make_status(node: Node, state: Any, process: psutil.Process) -> Status:
    """Make the status message of a node.

    The state is "degraded" if an error, a rejected message or a gap in the sequence numbers has
    occurred since the last status. Gaps on topics with the delivery `latest` are normal and are
    ignored.
    """
    problems = node.errors + sum(
        port.counts.rejected + (0 if port.topic.delivery is Delivery.LATEST else port.counts.gaps)
        for port in node.inputs.values()
    )
    degraded = state == "running" and problems > node.reported_problems
    node.reported_problems = problems
    return Status(
        node=node.name,
        state="degraded" if degraded else state,
        pid=process.pid,
        uptime_s=(node.clock.now_ns() - node.started_ns) * 1e-9,
        cpu_ratio=process.cpu_percent() / 100.0,
        resident_bytes=process.memory_info().rss,
        inputs=tuple(port.counts.status(port.topic, node.clock) for port in node.inputs.values()),
        outputs=tuple(port.counts.status(port.topic, node.clock) for port in node.outputs.values()),
        errors=node.errors,
        last_error=node.last_error,
        notes=node.notes,
        plan_hash=node.plan_hash,
        clock_id=node.clock.id,
        clock_offsets=tuple(node.clock_table.offsets.values()),
        execution_log=node.execution_log.drain(),
        self_checks=node.self_checks,
        changed_parameters=json.dumps(node.changed_parameters),
    )


async def run_node(
    config: NodeConfig,
    stop: asyncio.Event,
    *,
    heartbeat: Heartbeat | None = None,
    local: LocalBus | None = None,
) -> None:
    """Create and connect a node, and run it until `stop` is set or one of its tasks fails.

    heartbeat: pipe to the launcher; None if there is no launcher.
    local: bus between the nodes of one process; None if the process has only one node.
    """
    heartbeat = heartbeat or Heartbeat(None)
    class_ = node_class(config.type)
    log = structlog.get_logger().bind(node=config.name)
    transport = NodeTransport(config, log, local)
    node = class_(
        find_parameters_type(class_).model_validate(config.parameters),
        name=config.name,
        clock=SystemClock(),
        send=transport.send,
        topics={port.port: port.topic for port in (*config.inputs, *config.outputs)},
        plan_hash=config.plan_hash,
    )
    process = psutil.Process()
    tasks: list[asyncio.Task[Any]] = []
    try:
        transport.open_outputs(node)
        await node.setup()
    except BaseException:
        transport.close()
        raise
    try:
        await transport.open_inputs(node)
        for number, timer in enumerate(find_timers(class_)):
            tasks.append(asyncio.create_task(run_timer(node, number, timer)))
        tasks.append(asyncio.create_task(run_status(node, process, heartbeat.beat)))
        tasks.append(asyncio.create_task(stop.wait()))
        tasks.append(asyncio.create_task(transport.watch_failure()))
        # Exclude the objects that `setup` has made from garbage collection while the node runs.
        gc.collect()
        gc.freeze()
        gc.enable()
        heartbeat.report_ready()
        done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        for task in done:
            task.result()
        node.status.publish(make_status(node, "stopping", process))
    finally:
        await end_tasks([*tasks, *node.mailbox_tasks()])
        try:
            await node.close()
        finally:
            transport.close()


async def end_tasks(tasks: list[asyncio.Task[Any]]) -> None:
    """Cancel tasks repeatedly until they have ended.

    A single cancellation is not sufficient, because a handler can suppress it. The function
    `wait_for` of Python 3.11 suppresses a cancellation if its result arrives at the same moment.
    """
    pending = {task for task in tasks if not task.done()}
    while pending:
        for task in pending:
            task.cancel()
        _, pending = await asyncio.wait(pending, timeout=CANCEL_AGAIN_S)


class Heartbeat:
    """A pipe for heartbeats to the launcher. The first heartbeat reports that all nodes are ready.

    fd: write end of the pipe; None if there is no launcher. Writing never blocks.
    nodes: number of nodes in the process.
    on_ready: function that is called when all nodes are ready.
    """

    def __init__(
        self, fd: int | None, nodes: int = 1, on_ready: Callable[[], None] = lambda: None
    ) -> None:
        self._fd, self._starting, self._on_ready = fd, nodes, on_ready
        if fd is not None:
            os.set_blocking(fd, False)

    def report_ready(self) -> None:
        """Record that one node is ready. When all nodes are ready, send the first heartbeat."""
        self._starting -= 1
        if self._starting == 0:
            self._on_ready()
        self.beat()

    def beat(self) -> None:
        if self._fd is not None and self._starting <= 0:
            # A full pipe contains enough heartbeats. If the launcher has ended, so will this
            # process: its lifeline (a pipe to the launcher) is then closed.
            with suppress(BlockingIOError, BrokenPipeError):
                os.write(self._fd, b".")


class LoggedNodeError(Exception):
    """Raised after a node has failed and its failure has been logged with the node's name."""


async def run_nodes(config: ProcessConfig, stop: asyncio.Event) -> None:
    """Run all nodes of a process until `stop` is set. If a node fails, stop all nodes.

    Raises LoggedNodeError for the first node that failed, after its error was logged.
    """
    heartbeat = Heartbeat(config.ready_fd, len(config.nodes), partial(_prioritize, config))
    local = None
    if len(config.nodes) > 1:
        outputs = (output for node in config.nodes for output in node.outputs)
        local = LocalBus(str(one) for output in outputs for one in output.endpoints)

    async def run_one(node: NodeConfig) -> None:
        try:
            await run_node(node, stop, heartbeat=heartbeat, local=local)
        except Exception as error:
            # The launcher sees only the exit code, so the reason must be logged here.
            structlog.get_logger().error(
                "node failed", node=node.name, error=describe_error(error), exc_info=True
            )
            raise LoggedNodeError(node.name) from error
        finally:
            stop.set()

    results = await asyncio.gather(*map(run_one, config.nodes), return_exceptions=True)
    for result in results:
        if isinstance(result, BaseException):
            raise result


def _prioritize(config: ProcessConfig) -> None:
    """Give this process the configured real-time priority.

    The function is called when all nodes are ready. During the start, a real-time process would
    delay other programs.
    """
    if config.realtime_priority is not None:
        asyncio.get_running_loop().set_default_executor(
            ThreadPoolExecutor(thread_name_prefix="asyncio", initializer=leave_real_time)
        )
        enter_real_time(config.realtime_priority)


async def run_until_signal(config: ProcessConfig) -> None:
    """Run the nodes of a process until SIGINT or SIGTERM."""
    stop = asyncio.Event()
    # If the launcher ends, the lifeline's thread and the kernel each send a signal.
    with handle_signals(stop.set, signal.SIGINT, signal.SIGTERM, ignore_afterwards=True):
        await run_nodes(config, stop)


def main(config_path: str) -> int:
    """Run the nodes in a configuration file, and return the exit code of the process."""
    config = ProcessConfig.model_validate_json(Path(config_path).read_text())
    structlog.configure(
        processors=[
            structlog.processors.add_log_level,
            structlog.processors.TimeStamper(fmt="iso"),
            structlog.processors.format_exc_info,
            structlog.processors.JSONRenderer(),
        ],
        logger_factory=structlog.PrintLoggerFactory(sys.stderr),
    )
    try:
        uvloop.run(run_until_signal(config))
    except LoggedNodeError:
        return 1
    return 0
