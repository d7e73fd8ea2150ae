"""Test the node base class: ports, parameters, handlers, mailboxes, errors and status."""

from __future__ import annotations

import asyncio

import numpy as np
import psutil
import pytest
from pydantic import ValidationError

from flexsheet.messages.base import Header, Message
from flexsheet.messages.clock import VirtualClock
from flexsheet.messages.notes import NoteCode
from flexsheet.messages.topics import Topic, UnknownTopicError
from flexsheet.messages.types import EStop, FingerPath, Fingertip, SheetTarget
from flexsheet.nodes import NODES, NodeImportError, UnknownNodeError, node_class
from flexsheet.nodes.node import (
    Input,
    Node,
    NodeParameters,
    Output,
    find_parameters_type,
    find_ports,
    find_timers,
    periodic,
)
from flexsheet.nodes.runner import end_tasks, make_status
from tests.fingertips import fingertip as even_fingertip
from tests.node_harness import NodeHarness
from tests.waiting import DEADLINE_S


class EchoParameters(NodeParameters):
    gain: float = 1.0
    rate_hz: float = 10.0


class Echo(Node):
    """A node that forwards e-stops, or fails on request."""

    parameters: EchoParameters
    estop: Input[EStop]
    fingertip: Input[Fingertip]
    sheet_target: Output[SheetTarget]
    twin__finger_path: Input[FingerPath]

    def __init__(self, *args: object, **kwargs: object) -> None:
        super().__init__(*args, **kwargs)  # type: ignore[arg-type]  # passed through unchanged
        self.seen: list[int] = []
        self.started = asyncio.Event()
        self.go_on = asyncio.Event()
        self.second = asyncio.Event()

    def on_estop(self, estop: EStop, header: Header) -> None:
        if estop.engaged:
            raise RuntimeError(estop.reason)
        self.seen.append(header.sequence)

    async def on_fingertip(self, fingertip: Fingertip, header: Header) -> None:
        self.started.set()
        await self.go_on.wait()
        self.seen.append(header.sequence)
        if len(self.seen) == 2:
            self.second.set()

    @periodic("rate_hz")
    def tick(self) -> None:
        self.set_note(NoteCode.INFO, "ticked")


def fingertip() -> Fingertip:
    return even_fingertip(np.zeros(3))


def header(sequence: int, clock_id: str = "virtual") -> Header:
    return Header(sequence, sequence, sequence, clock_id, "test", 1)


Sent = list[tuple[Topic, Message, Header]]


def build(topics: dict[str, str] | None = None) -> tuple[Echo, VirtualClock, Sent]:
    harness = NodeHarness(Echo, EchoParameters(), VirtualClock(1_000), name="echo", topics=topics)
    return harness.node, harness.clock, harness.published


def test_ports_parameters_and_timers_are_read_from_the_class() -> None:
    ports = find_ports(Echo)
    assert [(port.name, port.direction, port.message) for port in ports.values()] == [
        ("status", "output", ports["status"].message),
        ("estop", "input", EStop),
        ("fingertip", "input", Fingertip),
        ("sheet_target", "output", SheetTarget),
        ("twin__finger_path", "input", FingerPath),
    ]
    assert find_parameters_type(Echo) is EchoParameters
    assert [(timer.method, timer.rate_parameter) for timer in find_timers(Echo)] == [
        ("tick", "rate_hz")
    ]


def test_a_port_can_be_connected_to_another_topic_of_its_type_only() -> None:
    with pytest.raises(TypeError, match="expected a topic of Fingertip"):
        build(topics={"fingertip": "stereo"})
    with pytest.raises(UnknownTopicError, match='did you mean "fingertip"'):
        build(topics={"fingertip": "fingertips"})


def test_unknown_parameters_are_rejected() -> None:
    with pytest.raises(ValidationError, match="gian"):
        EchoParameters.model_validate({"gian": 2.0})


def test_every_node_of_the_table_imports_and_declares_its_ports() -> None:
    for name in NODES:
        class_ = node_class(name)
        assert issubclass(find_parameters_type(class_), NodeParameters)
        assert "status" in find_ports(class_)
        assert class_.__doc__
    with pytest.raises(UnknownNodeError, match='did you mean "planner"'):
        node_class("planer")


def test_a_class_that_cannot_be_imported_is_an_error_with_a_remedy() -> None:
    with pytest.raises(NodeImportError, match="PYTHONPATH=FOLDER before the command"):
        node_class("missing.module:Thing")
    with pytest.raises(NodeImportError, match="define the class Thing in tests"):
        node_class("tests.launch_nodes:Thing")


async def test_an_error_in_a_handler_is_counted_and_shown_and_the_node_continues() -> None:
    node, _, _ = build()
    node.deliver("estop", EStop(engaged=True, reason="hot"), header(1))
    node.deliver("estop", EStop(engaged=False, reason=""), header(2))
    assert node.seen == [2]
    assert node.errors == 1
    status = make_status(node, "running", psutil.Process())
    assert status.errors == 1
    assert "hot" in status.last_error


async def test_a_slow_handler_skips_what_was_superseded_and_counts_it() -> None:
    node, _, _ = build()
    node.deliver("fingertip", fingertip(), header(1))
    await node.started.wait()
    for sequence in (2, 3, 4):
        node.deliver("fingertip", fingertip(), header(sequence))
    node.go_on.set()
    async with asyncio.timeout(DEADLINE_S):
        await node.second.wait()
    assert node.seen == [1, 4]
    assert node.inputs["fingertip"].counts.dropped == 2


async def test_a_task_that_swallows_its_cancellation_is_ended_all_the_same() -> None:
    cancellations = 0

    async def stubborn() -> None:
        nonlocal cancellations
        while cancellations < 2:
            try:
                await asyncio.Event().wait()
            except asyncio.CancelledError:
                cancellations += 1
        await asyncio.Event().wait()

    task = asyncio.create_task(stubborn())
    await asyncio.sleep(0)
    async with asyncio.timeout(DEADLINE_S):
        await end_tasks([task])
    assert task.cancelled()
    assert cancellations == 2


async def test_outputs_number_and_stamp_what_they_send() -> None:
    node, clock, sent = build()
    clock.move_to(5_000)
    node.sheet_target.publish(
        SheetTarget(
            phase="wait",
            reason="ok",
            valid_at_ns=0,
            world_from_sheet=np.eye(4),
            twist_world=np.zeros(6),
            stretch_ratio=1.0,
            contact_world_m=np.zeros(3),
            normal_world=np.zeros(3),
            contact_sheet_m=np.zeros(2),
            push_depth_m=0.0,
        ),
        source_ns=4_000,
    )
    topic, _, head = sent[0]
    assert topic.name == "sheet_target"
    assert (head.sequence, head.source_ns, head.publish_ns) == (1, 4_000, 5_000)
    assert (head.writer, head.clock_id) == ("echo", "virtual")


async def test_age_counts_from_the_source_on_the_same_clock_else_from_receipt() -> None:
    node, clock, _ = build()
    assert node.fingertip.age_s() == float("inf")
    node.go_on.set()
    await node.step("fingertip", fingertip(), header(500))
    clock.move_to(1_000_000_500)
    assert node.fingertip.age_s() == pytest.approx(1.0)
    await node.step("fingertip", fingertip(), header(7, clock_id="another host"))
    clock.move_to(1_500_000_500)
    assert node.fingertip.age_s() == pytest.approx(0.5)
