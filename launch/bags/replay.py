"""Replay one node with its recorded inputs on a virtual clock, and check its outputs.

The node is built from the resolved launch file in the bag. Its status messages contain the order
and time of the messages that it handled (`messages.types.Status.execution_log`). The replay follows
this log, so it skips the same messages as the live node. If a bag contains no log, the replay
passes all recorded inputs to the node in the order of recording, and calls timers when they are
due.

The replay runs twice, and both runs must give the same bytes. The fields of the outputs are
compared with the recorded fields, with a tolerance.
"""

from __future__ import annotations

import asyncio
import hashlib
from collections import deque
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, ValidationError

from flexsheet.launch.plans.documents import BadInputError, did_you_mean
from flexsheet.launch.plans.plan_model import ResolvedGraph, ResolvedNode
from flexsheet.messages.bag import BagError, BagReader
from flexsheet.messages.base import Header, Message
from flexsheet.messages.clock import VirtualClock
from flexsheet.messages.topics import TOPICS, Delivery, Topic
from flexsheet.messages.types import Clocks, Status
from flexsheet.messages.wire import decode, encode
from flexsheet.nodes import NodeRole, UnknownNodeError, node_class
from flexsheet.nodes.arrays import Floats, Ints
from flexsheet.nodes.node import Node, find_parameters_type, find_timers

CLOCKS = "clocks"
EPOCH = 0
"""The start time (epoch) in the headers of replayed messages. A live node uses its start time."""

PROGRESS_STEPS = 100
"""The number of replayed messages between two calls of the progress function."""

Progress = Callable[[float, float], None]


@dataclass(frozen=True, slots=True)
class SentMessage:
    """An encoded message that a replayed node published."""

    topic: str
    data: tuple[bytes, ...]


@dataclass(slots=True)
class ReplayResult:
    """The result of one replay of a node.

    messages_in: number of input messages.
    missing: number of messages in the execution log that the bag does not contain.
    by_execution_log: whether the replay followed the node's execution log. If not, it followed the
        order in which the messages were recorded.
    logged_until_ns: end of the execution log, ns, on the clock of the node's host.
    """

    messages_in: int = 0
    missing: int = 0
    by_execution_log: bool = False
    logged_until_ns: int | None = None
    sent: list[SentMessage] = field(default_factory=list)
    errors: int = 0
    last_error: str = ""

    def digest(self) -> str:
        """Return the SHA-256 hash of all messages that the node published, as hexadecimal text."""
        digest = hashlib.sha256()
        for one in self.sent:
            digest.update(one.topic.encode())
            for part in one.data:
                digest.update(len(part).to_bytes(8, "little"))
                digest.update(part)
        return digest.hexdigest()


@dataclass(slots=True)
class Comparison:
    """A comparison of the replayed with the recorded messages of one topic.

    Messages with the same source timestamp are compared.

    recorded, replayed, compared: numbers of messages.
    beyond_tolerance: number of messages that differ by more than the tolerance.
    worst: maximum difference of each field that differs; 1 for values that are not numbers.
    """

    recorded: int = 0
    replayed: int = 0
    compared: int = 0
    beyond_tolerance: int = 0
    worst: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Verification:
    """The result of `flexsheet bag verify`: a replayed node compared with its recording.

    by_execution_log: whether the replay followed the node's execution log.
    missing: number of messages in the execution log that the bag does not contain.
    same_bytes: whether two replays gave the same bytes.
    digest: SHA-256 of the replayed messages, in hexadecimal digits.
    bag_problem: reason why the bag is incomplete, so that only a part was compared; "" if complete.
    """

    node: str
    bag: str
    by_execution_log: bool
    messages_in: int
    missing: int
    messages_out: int
    same_bytes: bool
    digest: str
    errors: int
    last_error: str
    topics: dict[str, Comparison]
    tolerance: float
    bag_problem: str = ""

    @property
    def repeatable(self) -> bool:
        """Return whether the node published identical bytes in both replays, without errors."""
        return self.same_bytes and self.errors == 0

    @property
    def as_live(self) -> bool:
        """Return whether the replayed outputs equal the recorded outputs within the tolerance."""
        return all(
            one.beyond_tolerance == 0 and (one.compared > 0 or one.recorded == 0)
            for one in self.topics.values()
        )

    @property
    def ok(self) -> bool:
        return self.repeatable and self.as_live


def verify(
    bag: Path,
    name: str,
    *,
    tolerance: float = 1e-6,
    progress: Progress = lambda done, total: None,
) -> Verification:
    """Replay a node twice with its recorded inputs, and compare the outputs with the recording.

    name: name of the node.
    tolerance: maximum difference of a field that counts as equal.
    progress: function that is called with the number of replayed messages and the total number of
        messages.

    Raises BagError if the node cannot be replayed, or if the bag does not contain its inputs or a
    valid launch file. Raises BadInputError if the bag does not contain the node.
    """
    reader = BagReader(bag)
    plan = _read_plan(reader)
    if name not in plan.nodes:
        what = f'its plan contains no node "{name}"'
        raise BadInputError.single(str(bag), (), what, did_you_mean(name, list(plan.nodes)))
    node = plan.nodes[name]
    try:
        why = refusal(node)
    except (ValidationError, UnknownNodeError) as error:
        raise BagError(
            f"{bag}: this version of flexsheet has no node type {node.type}; verify {name} with "
            "the version that recorded the bag"
        ) from error
    if why:
        raise BagError(f"the node {name} cannot be replayed: {why}; verify another node")
    _check_inputs(bag, reader, plan, node)
    first = asyncio.run(replay(bag, node, lambda done, total: progress(done, 2 * total)))
    second = asyncio.run(replay(bag, node, lambda done, total: progress(total + done, 2 * total)))
    return Verification(
        node=name,
        bag=str(bag),
        by_execution_log=first.by_execution_log,
        messages_in=first.messages_in,
        missing=first.missing,
        messages_out=len(first.sent),
        same_bytes=first.sent == second.sent,
        digest=first.digest(),
        errors=first.errors,
        last_error=first.last_error,
        topics=compare(bag, node, first, tolerance),
        tolerance=tolerance,
        bag_problem=reader.problem,
    )


def _read_plan(reader: BagReader) -> ResolvedGraph:
    try:
        return ResolvedGraph.model_validate_json(reader.attachment("plan.json"))
    except ValidationError as error:
        raise BagError(
            f"{reader.path}: its plan.json is not valid in this version of flexsheet; verify the "
            "bag with the version that recorded it"
        ) from error


def refusal(node: ResolvedNode) -> str:
    """Return the reason why a node cannot be replayed, or "" if it can be replayed."""
    class_ = node_class(node.type)
    return class_.replay_refusal(find_parameters_type(class_).model_validate(node.parameters))


async def replay(
    bag: Path, planned: ResolvedNode, progress: Progress = lambda done, total: None
) -> ReplayResult:
    """Build a node, replay it once with its recorded inputs, and return its outputs."""
    result = ReplayResult()
    runs = read_runs(bag, planned.name)
    before, total = 0, sum(len(run.steps) for run in runs)
    for run in runs:
        result.by_execution_log, result.logged_until_ns = True, int(run.steps[-1, 3])
        report = partial(_report_progress, progress, before, total)
        await _replay_run(bag, planned, run, result, report)
        before += len(run.steps)
    if not runs:
        await _replay_in_order(bag, planned, result, progress)
    return result


def _report_progress(progress: Progress, before: int, total: int, step: int) -> None:
    if step % PROGRESS_STEPS == 0:
        progress(before + step, total)


def _build_node(planned: ResolvedNode, clock: VirtualClock, result: ReplayResult) -> Node:
    """Build the node as a launcher does, but store its published messages in `result`."""

    def store(topic: Topic, message: Message, header: Header) -> None:
        result.sent.append(
            SentMessage(topic.name, tuple(bytes(one) for one in encode(message, header)))
        )

    class_ = node_class(planned.type)
    return class_(
        find_parameters_type(class_).model_validate(planned.parameters),
        name=planned.name,
        clock=clock,
        send=store,
        topics={port.port: port.topic for port in (*planned.inputs, *planned.outputs)},
        epoch=EPOCH,
    )


@asynccontextmanager
async def _set_up(node: Node, result: ReplayResult) -> AsyncIterator[None]:
    try:
        await node.setup()
        yield
        await node.settle()
    finally:
        for task in node.mailbox_tasks():
            task.cancel()
        await node.close()
        result.errors += node.errors
        result.last_error = node.last_error or result.last_error


async def _replay_in_order(
    bag: Path, planned: ResolvedNode, result: ReplayResult, progress: Progress
) -> None:
    """Pass all recorded inputs to the node, in the order in which they were recorded."""
    ports: dict[str, list[str]] = {}
    for port in planned.inputs:
        ports.setdefault(port.topic, []).append(port.port)
    reader = BagReader(bag, {*ports, CLOCKS} & set(BagReader(bag).topics))
    info = reader.info()
    start_ns = info.start_ns
    clock_id = reader.metadata.get("recording", {}).get("clock_id", "recorded")
    clock = VirtualClock(start_ns, clock_id=clock_id)
    node = _build_node(planned, clock, result)
    async with _set_up(node, result):
        timers = Timers(node, start_ns)
        for number, (topic, message, header, log_ns) in enumerate(reader):
            if number % PROGRESS_STEPS == 0:
                progress(number, info.count)
            await timers.call_until(log_ns, clock)
            clock.move_to(log_ns)
            if isinstance(message, Clocks) and header.clock_id == clock.id:
                node.clock_table.update(message)
            result.messages_in += topic in ports
            for port_name in ports.get(topic, ()):
                await node.step(port_name, message, header)
                await node.settle()


async def _replay_run(
    bag: Path,
    planned: ResolvedNode,
    run: NodeRun,
    result: ReplayResult,
    report: Callable[[int], None],
) -> None:
    """Pass recorded inputs to the node, in the order of the node's execution log.

    run: execution log of the node from one start to the next.
    report: function that is called with the number of each step.
    """
    clock = VirtualClock(int(run.steps[0, 3]), clock_id=run.clock_id)
    node = _build_node(planned, clock, result)
    names, timers = list(node.inputs), find_timers(type(node))
    async with _set_up(node, result):
        messages = RecordedInputs(bag, node)
        # The recorded log lacks messages that the node handled before the recording began.
        for port, message, header in messages.latched_before(run):
            result.messages_in += 1
            await node.step(port, message, header)
        for step, (number, sequence, epoch, at_ns) in enumerate(run.steps.tolist()):
            report(step)
            if number < 0:
                clock.move_to(at_ns)
                await node.call_timer(-1 - number, timers[-1 - number])
            else:
                taken = messages.find(names[number], sequence, epoch)
                if taken is None:
                    result.missing += 1
                    continue
                clock.move_to(at_ns)
                result.messages_in += 1
                await node.step(names[number], *taken)
            await node.settle()


@dataclass(frozen=True, slots=True)
class NodeRun:
    """The execution log of a node, from one start of the node to the next start.

    steps: integers (n, 4), one row for each call of a message handler or timer. For a message, the
        columns are input index, sequence number, epoch (start time) of the writer, and call time
        (ns). For a timer, the first column contains -1 minus the index of the timer.
    """

    clock_id: str
    steps: Ints


def read_runs(bag: Path, name: str) -> list[NodeRun]:
    """Read the execution logs of a node from a bag, with one log for each start of the node.

    Return an empty list if the bag contains no log.
    """
    logs: dict[int, list[Ints]] = {}
    clock_ids: dict[int, str] = {}
    if "status" not in BagReader(bag).topics:
        return []
    for _, message, header, _ in BagReader(bag, ["status"]):
        if isinstance(message, Status) and message.node == name and len(message.execution_log):
            before = logs.setdefault(header.epoch, [])
            # For a few seconds after its start, a node publishes its whole log again each time.
            if before and (before[0][0] == message.execution_log[0]).all():
                before.clear()
            before.append(message.execution_log)
            clock_ids[header.epoch] = header.clock_id
    return [NodeRun(clock_ids[epoch], np.concatenate(parts)) for epoch, parts in logs.items()]


class RecordedInputs:
    """A reader that finds the recorded inputs of a node in the order of the execution log."""

    LOOK_AHEAD = 5000
    """The maximum number of further messages of the bag that are read to find one logged message.

    A logged message is one that the node's execution log contains.
    """

    def __init__(self, bag: Path, node: Node) -> None:
        self._bag, self._node = bag, node
        self._ports: dict[str, list[str]] = {}
        for port, source in node.inputs.items():
            self._ports.setdefault(source.topic.name, []).append(port)
        topics = {*self._ports, CLOCKS} & set(BagReader(bag).topics)
        self._messages = iter(BagReader(bag, topics))
        self._waiting: dict[str, deque[tuple[Message, Header]]] = {
            port: deque() for port in node.inputs
        }

    def latched_before(self, run: NodeRun) -> list[tuple[str, Message, Header]]:
        """Return the latched messages that the node had received before the run started.

        The result contains (port, message, header) for the last message of each port.
        """
        steps = {(names, *key) for names, *key in run.steps[:, :3].tolist()}
        latched = {
            source.topic.name
            for source in self._node.inputs.values()
            if source.topic.delivery is Delivery.LATCHED
        }
        recorded = BagReader(self._bag)
        found: dict[str, tuple[Message, Header]] = {}
        for topic, message, header, _ in BagReader(self._bag, latched & set(recorded.topics)):
            for number, port in enumerate(self._node.inputs):
                if port not in self._ports[topic]:
                    continue
                taken = (number, header.sequence, header.epoch) in steps
                if not taken and header.publish_ns <= run.steps[0, 3]:
                    found[port] = (message, header)
        return [(port, *entry) for port, entry in found.items()]

    def find(self, port: str, sequence: int, epoch: int) -> tuple[Message, Header] | None:
        """Return the message of an input port with the given sequence number.

        epoch: start time of the node that sent the message.

        Return None if the bag does not contain the message.
        """
        waiting = self._waiting[port]
        latest = self._node.inputs[port].topic.delivery is Delivery.LATEST
        read = seen = 0
        while True:
            for i in range(seen, len(waiting)):
                message, header = waiting[i]
                if header.epoch != epoch or header.sequence < sequence:
                    continue
                if header.sequence > sequence:
                    return None
                del waiting[i]
                # A node that reads only the latest message never handles a skipped one later.
                for _ in range(i if latest else 0):
                    waiting.popleft()
                return message, header
            seen = len(waiting)
            if read == self.LOOK_AHEAD or not self._read():
                return None
            read += 1

    def _read(self) -> bool:
        entry = next(self._messages, None)
        if entry is None:
            return False
        topic, message, header, _ = entry
        if isinstance(message, Clocks) and header.clock_id == self._node.clock.id:
            self._node.clock_table.update(message)
        for port in self._ports.get(topic, ()):
            self._waiting[port].append((message, header))
        return True


class Timers:
    """A scheduler that calls the periodic methods of a node at due times on a virtual clock."""

    def __init__(self, node: Node, start_ns: int) -> None:
        self._node = node
        self._periods_ns = {
            (number, timer): round(1e9 / float(getattr(node.parameters, timer.rate_parameter)))
            for number, timer in enumerate(find_timers(type(node)))
        }
        self._due_ns = dict.fromkeys(self._periods_ns, start_ns)

    async def call_until(self, now_ns: int, clock: VirtualClock) -> None:
        """Call the methods that are due up to `now_ns`, in the order of their due times."""
        while self._due_ns:
            next_one = min(self._due_ns, key=lambda one: (self._due_ns[one], one[1].method))
            due_ns = self._due_ns[next_one]
            if due_ns > now_ns:
                return
            clock.move_to(due_ns)
            await self._node.call_timer(*next_one)
            self._due_ns[next_one] = due_ns + self._periods_ns[next_one]


def compare(
    bag: Path, node: ResolvedNode, replayed: ReplayResult, tolerance: float
) -> dict[str, Comparison]:
    """Compare the recorded outputs of a node with its replayed outputs, topic by topic.

    tolerance: maximum difference of a field that counts as equal.
    """
    outputs = {port.topic for port in node.outputs} - {"status"}
    recorded: dict[str, dict[int, Message]] = {topic: {} for topic in outputs}
    comparisons = {topic: Comparison() for topic in sorted(outputs)}
    for topic, message, header, _ in BagReader(bag, outputs & set(BagReader(bag).topics)):
        unlogged = (
            replayed.logged_until_ns is not None and header.source_ns > replayed.logged_until_ns
        )
        if header.writer == node.name and not unlogged:
            recorded[topic][header.source_ns] = message
            comparisons[topic].recorded += 1
    for one in replayed.sent:
        if one.topic not in comparisons:
            continue
        comparison = comparisons[one.topic]
        message, header = decode(one.data, TOPICS[one.topic])
        comparison.replayed += 1
        live = recorded[one.topic].get(header.source_ns)
        if live is None:
            continue
        comparison.compared += 1
        differences = compute_field_differences(live, message)
        comparison.beyond_tolerance += any(size > tolerance for size in differences.values())
        for name, size in differences.items():
            comparison.worst[name] = max(size, comparison.worst.get(name, 0.0))
    return comparisons


def compute_field_differences(
    one: BaseModel, other: BaseModel, prefix: str = ""
) -> dict[str, float]:
    """Return the differences between two messages as a mapping from field names to differences.

    Fields that are equal are omitted. If a field contains numbers, its difference is the maximum
    absolute difference. Otherwise, it is 1.
    """
    found: dict[str, float] = {}
    for name in type(one).model_fields:
        a, b = getattr(one, name), getattr(other, name)
        if isinstance(a, BaseModel) and isinstance(b, BaseModel):
            found |= compute_field_differences(a, b, f"{prefix}{name}.")
            continue
        size = _difference(a, b)
        if size > 0:
            found[f"{prefix}{name}"] = size
    return found


def _difference(a: Any, b: Any) -> float:
    if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
        if a.shape != b.shape:
            return float("inf")
        return _distance(a.astype(float), b.astype(float))
    if isinstance(a, float | int) and isinstance(b, float | int):
        return _distance(np.array(a, float), np.array(b, float))
    return 0.0 if a == b else 1.0


def _distance(a: Floats, b: Floats) -> float:
    """Return the maximum absolute difference between two arrays of the same shape.

    The result is infinite if an element is NaN in only one of the arrays.
    """
    same = (a == b) | (np.isnan(a) & np.isnan(b))
    with np.errstate(invalid="ignore"):
        apart = np.where(same, 0.0, np.abs(a - b))
    return float(np.where(np.isnan(apart), np.inf, apart).max(initial=0.0))


def _check_inputs(bag: Path, reader: BagReader, plan: ResolvedGraph, node: ResolvedNode) -> None:
    """Raise BagError if the inputs of the node were not recorded.

    An input counts as recorded if a recorder of the graph reads its topic, even if the bag contains
    no message of it. Inputs that no node of the graph publishes are not checked. BagError is also
    raised if the bag contains no message for any input.
    """
    recorded = set(reader.topics)
    for other in plan.nodes.values():
        if other.role is NodeRole.RECORDER:
            recorded |= {port.topic for port in other.inputs}
    missing = [
        port.topic
        for port in node.inputs
        if port.topic not in recorded and plan.writers.get(port.topic)
    ]
    if missing:
        options = " ".join(f"--include {topic}" for topic in missing)
        raise BagError(
            f"{bag}: the bag does not contain {', '.join(missing)}, which {node.name} reads; "
            f"record a new bag with: flexsheet bag record BAG {options}"
        )
    if not {port.topic for port in node.inputs} & set(reader.topics):
        raise BagError(
            f"{bag}: the bag contains no input messages of {node.name}; verify another node"
        )
