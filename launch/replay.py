"""Steps one node through its recorded inputs with a virtual clock, twice, and compares.

The node is built from the plan in the bag.  Each recorded input is handed to it in the order in
which the recorder got it, the clock standing at that moment; timers that came due are called
before.  The same bag must give the same bytes each time.  Against what the node published live,
fields are compared with a tolerance: live, messages reach a node and the recorder in slightly
different order and time.
"""

from __future__ import annotations

import asyncio
import hashlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel

from launch.documents import did_you_mean
from launch.planned import Plan, PlannedNode
from messages.bag import BagError, BagReader
from messages.base import Header, Message
from messages.clock import VirtualClock
from messages.topics import TOPICS, Topic
from messages.types import Clocks
from messages.wire import decode, encode
from nodes import node_class
from nodes.node import Node, parameters_of, timers_of

CLOCKS = "clocks"
EPOCH = 0
"""Of the replayed writers; a live one is random, a replay must not be."""


@dataclass(frozen=True, slots=True)
class Sent:
    """What a replayed node published, as bytes."""

    topic: str
    data: tuple[bytes, ...]


@dataclass(slots=True)
class Pass:
    """One run through the bag."""

    messages_in: int = 0
    sent: list[Sent] = field(default_factory=list)
    errors: int = 0
    last_error: str = ""

    def digest(self) -> str:
        """Of all bytes that the node published, in order."""
        digest = hashlib.sha256()
        for one in self.sent:
            digest.update(one.topic.encode())
            for part in one.data:
                digest.update(len(part).to_bytes(8, "little"))
                digest.update(part)
        return digest.hexdigest()


@dataclass(slots=True)
class Comparison:
    """Replayed against recorded messages of one topic, paired by their source stamps.

    worst: largest difference per field that differs at all; anything but numbers counts 1.
    """

    recorded: int = 0
    replayed: int = 0
    compared: int = 0
    beyond_tolerance: int = 0
    worst: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Verification:
    """What `bag verify` found."""

    node: str
    bag: str
    messages_in: int
    messages_out: int
    same_bytes: bool
    digest: str
    errors: int
    last_error: str
    topics: dict[str, Comparison]
    tolerance: float

    @property
    def repeatable(self) -> bool:
        """Whether both passes gave the same bytes, without an error."""
        return self.same_bytes and self.errors == 0

    @property
    def as_live(self) -> bool:
        """Whether the outputs are those that the node published live, within the tolerance."""
        return all(
            one.beyond_tolerance == 0 and (one.compared > 0 or one.recorded == 0)
            for one in self.topics.values()
        )

    @property
    def ok(self) -> bool:
        return self.repeatable and self.as_live


def verify(bag: Path, name: str, *, tolerance: float = 1e-6) -> Verification:
    """Replay node `name` of the bag's plan twice; BagError for a bag that does not allow it."""
    reader = BagReader(bag)
    plan = Plan.model_validate_json(reader.attachment("plan.json"))
    if name not in plan.nodes:
        raise BagError(
            f'{bag}: no node "{name}" in its plan; {did_you_mean(name, list(plan.nodes))}'
        )
    node = plan.nodes[name]
    if node_class(node.type).opens_devices:
        raise BagError(f"{name} reaches for devices of its own (an arm would move): not replayed")
    _check_inputs(bag, reader, plan, node)
    first, second = (asyncio.run(replay(bag, node)) for _ in range(2))
    return Verification(
        node=name,
        bag=str(bag),
        messages_in=first.messages_in,
        messages_out=len(first.sent),
        same_bytes=first.sent == second.sent,
        digest=first.digest(),
        errors=first.errors,
        last_error=first.last_error,
        topics=compare(bag, node, first, tolerance),
        tolerance=tolerance,
    )


async def replay(bag: Path, planned: PlannedNode) -> Pass:
    """Step a node through its inputs in the bag."""
    ports: dict[str, list[str]] = {}
    for port in planned.inputs:
        ports.setdefault(port.topic, []).append(port.port)
    reader = BagReader(bag, {*ports, CLOCKS} & set(BagReader(bag).topics))
    start_ns = reader.info().start_ns
    clock_id = reader.metadata.get("recording", {}).get("clock_id", "recorded")
    clock = VirtualClock(start_ns, clock_id=clock_id)
    result = Pass()

    def keep(topic: Topic, message: Message, header: Header) -> None:
        result.sent.append(Sent(topic.name, tuple(bytes(one) for one in encode(message, header))))

    class_ = node_class(planned.type)
    node = class_(
        parameters_of(class_).model_validate(planned.parameters),
        name=planned.name,
        clock=clock,
        send=keep,
        topics={port.port: port.topic for port in (*planned.inputs, *planned.outputs)},
        epoch=EPOCH,
    )
    try:
        await node.setup()
        timers = Timers(node, start_ns)
        for topic, message, header, log_ns in reader:
            await timers.call_until(log_ns, clock)
            clock.move_to(log_ns)
            if isinstance(message, Clocks) and header.clock_id == clock.id:
                node.clock_table.update(message)
            result.messages_in += topic in ports
            for port_name in ports.get(topic, ()):
                await node.step(port_name, message, header)
    finally:
        node.stop_mailboxes()
        await node.close()
    result.errors, result.last_error = node.errors, node.last_error
    return result


class Timers:
    """A node's periodic methods on a virtual clock."""

    def __init__(self, node: Node, start_ns: int) -> None:
        self._node = node
        self._periods_ns = {
            timer.method: round(1e9 / float(getattr(node.parameters, timer.rate_parameter)))
            for timer in timers_of(type(node))
        }
        self._due_ns = dict.fromkeys(self._periods_ns, start_ns)

    async def call_until(self, now_ns: int, clock: VirtualClock) -> None:
        """Call all that comes due up to `now_ns`, in the order of time."""
        while self._due_ns:
            method = min(self._due_ns, key=lambda name: (self._due_ns[name], name))
            due_ns = self._due_ns[method]
            if due_ns > now_ns:
                return
            clock.move_to(due_ns)
            await self._node.call(method, getattr(self._node, method))
            self._due_ns[method] = due_ns + self._periods_ns[method]


def compare(
    bag: Path, node: PlannedNode, replayed: Pass, tolerance: float
) -> dict[str, Comparison]:
    """What the node published live against what it publishes now, for all its recorded outputs."""
    outputs = {port.topic for port in node.outputs} - {"status"}
    recorded: dict[str, dict[int, Message]] = {topic: {} for topic in outputs}
    comparisons = {topic: Comparison() for topic in sorted(outputs)}
    for topic, message, header, _ in BagReader(bag, outputs & set(BagReader(bag).topics)):
        if header.writer == node.name:
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
        differences = field_differences(live, message)
        comparison.beyond_tolerance += any(size > tolerance for size in differences.values())
        for name, size in differences.items():
            comparison.worst[name] = max(size, comparison.worst.get(name, 0.0))
    return comparisons


def field_differences(one: BaseModel, other: BaseModel, prefix: str = "") -> dict[str, float]:
    """Fields that differ, and by how much; see `Comparison.worst`."""
    found: dict[str, float] = {}
    for name in type(one).model_fields:
        a, b = getattr(one, name), getattr(other, name)
        if isinstance(a, BaseModel) and isinstance(b, BaseModel):
            found |= field_differences(a, b, f"{prefix}{name}.")
            continue
        size = _difference(a, b)
        if size > 0:
            found[f"{prefix}{name}"] = size
    return found


def _difference(a: Any, b: Any) -> float:
    if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
        if a.shape != b.shape:
            return float("inf")
        return float(np.abs(a.astype(float) - b.astype(float)).max(initial=0.0))
    if isinstance(a, float | int) and isinstance(b, float | int):
        return float(abs(a - b))
    return 0.0 if a == b else 1.0


def _check_inputs(bag: Path, reader: BagReader, plan: Plan, node: PlannedNode) -> None:
    """Every input must have been recorded (an input on which nothing came is no lack)."""
    recorded = set(reader.topics)
    for other in plan.nodes.values():
        if other.type == "recorder":
            recorded |= {port.topic for port in other.inputs}
    lacking = [port.topic for port in node.inputs if port.topic not in recorded]
    if lacking:
        raise BagError(
            f"{bag}: {node.name} reads {', '.join(lacking)}, which was not recorded; "
            f"record anew with: --set recorder.also='[{', '.join(lacking)}]'"
        )
    if not {port.topic for port in node.inputs} & set(reader.topics):
        raise BagError(f"{bag}: holds no input of {node.name}: nothing to replay")
