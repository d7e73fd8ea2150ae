"""Test the permissions of each host, as set in the launch file and enforced by the nodes."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager
from pathlib import Path
from typing import Any

import pytest
import structlog
from ruamel.yaml import YAML

from flexsheet.launch.plans.plan import load_graph
from flexsheet.launch.plans.plan_model import ResolvedGraph
from flexsheet.launch.running import runs
from flexsheet.launch.running.keys import KEYS_VARIABLE, make_rings
from flexsheet.launch.running.node_config import node_config
from flexsheet.messages import bus
from flexsheet.messages.base import Header, Message
from flexsheet.messages.bus import Publisher, Source
from flexsheet.messages.clock import SystemClock
from flexsheet.messages.security import make_key_pair, write_secret
from flexsheet.messages.topics import TOPICS
from flexsheet.messages.types import Arming, EStop
from flexsheet.nodes import node_class
from flexsheet.nodes.console.controller import ConsoleController, ReleaseError
from flexsheet.nodes.console.finger import FingerController
from flexsheet.nodes.console.graph_facts import GraphFacts
from flexsheet.nodes.node import Node, NodeParameters, Output, find_parameters_type
from flexsheet.nodes.runner import NodeTransport
from tests.arm_states import arm_state
from tests.test_security import target
from tests.waiting import until

LAUNCH = Path(__file__).resolve().parent.parent / "launch"
# Of this process's own: ports follow from names, and tests may run beside each other.
NET = f"127.{1 + os.getpid() % 250}.{os.getpid() // 250 % 250}"
BRIDGE = "arm_right_bridge"


class Hand(Node):
    """A console of another class, on the computer of an arm."""

    parameters: NodeParameters
    estop: Output[EStop]
    arming: Output[Arming]


@pytest.fixture(autouse=True)
def folder(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Make a folder for runs and keys, with a short path."""
    with tempfile.TemporaryDirectory(prefix="fs-", dir="/tmp") as name:
        monkeypatch.setenv(runs.ROOT_VARIABLE, f"{name}/runs")
        monkeypatch.setenv(KEYS_VARIABLE, f"{name}/keys")
        yield Path(name)


@pytest.mark.parametrize("name", ["three.yaml", "lab.yaml"])
def test_the_plans_that_come_with_it_believe_each_host_its_own_writers_only(name: str) -> None:
    plan = load_graph(LAUNCH / name)
    hosts_of = {topic: {one.host for one in writers} for topic, writers in plan.writers.items()}
    allowed = ("sheet_target", "arm_left", "arm_right", "stereo", "fingertip")
    assert [hosts_of[topic] for topic in allowed] == [
        {"main"}, {"left"}, {"right"}, {"main"}, {"main"},
    ]  # fmt: skip
    run = runs.create_run()
    for node in plan.nodes.values():
        for port in node_config(plan, node, run).inputs:
            sources = [one for one in port.endpoints if isinstance(one, Source)]
            assert len(sources) == len(port.endpoints)
            believed = {(one.writer, one.host or node.host) for one in sources}
            # Fewer where a recorder leaves a topic out.
            assert believed <= {(one.name, one.host) for one in plan.writers.get(port.topic, ())}
            for one in sources:
                assert one.host is not None or one.endpoint.startswith("ipc:"), "no key is asked"


def lab(folder: Path, **left: Any) -> ResolvedGraph:
    """Load launch/three.yaml with keys and loopback addresses, and a console on the left arm's
    computer.
    """
    spec = YAML(typ="safe").load(LAUNCH / "three.yaml")
    spec["scene"] = str(LAUNCH / spec["scene"])
    calibration = LAUNCH / "calibrations" / "twin-bumblebee.yaml"
    spec["nodes"]["triangulator"]["parameters"]["calibration"] = str(calibration)
    spec["nodes"]["console"] = {"type": "console", "host": "left"}
    spec["nodes"]["hand"] = {"type": f"{__name__}:Hand", "host": "left"}
    for number, (name, host) in enumerate(spec["hosts"].items(), start=1):
        public, secret = make_key_pair()
        write_secret(folder / "keys" / f"{name}.secret", secret, replace=True)
        host |= {"address": f"{NET}.{number}", "key": public}
    spec["hosts"]["left"] |= left
    path = folder / "three.yaml"
    path.write_text(json.dumps(spec))  # JSON is YAML
    return load_graph(path)


class SecuredBridge:
    """The bridge of the right arm with its connections, and publishers of other hosts."""

    def __init__(self, plan: ResolvedGraph) -> None:
        self.plan, run = plan, runs.create_run()
        self.rings = make_rings(plan, run, None)
        config = node_config(plan, plan.nodes[BRIDGE], run)
        class_ = node_class(config.type)
        self.links = NodeTransport(config, structlog.get_logger())
        self.bridge = class_(
            find_parameters_type(class_).model_validate(config.parameters),
            name=config.name,
            clock=SystemClock(),
            send=self.links.send,
            topics={port.port: port.topic for port in (*config.inputs, *config.outputs)},
            plan_hash=config.plan_hash,
        )
        self.inbox: list[tuple[str, str]] = []
        self.sequence = 0

    def record(self, port: str, message: Message, header: Header) -> None:
        self.inbox.append((header.writer, repr(message)))

    def rejected(self, port: str) -> int:
        return self.bridge.inputs[port].counts.rejected

    @contextmanager
    def sender(self, topic: str, *, at: tuple[str, str], key: str) -> Iterator[Publisher]:
        """Open a publisher at the endpoint of a node and topic, with the key of a host."""
        writer = self.plan.writer(*at)
        assert writer is not None
        assert writer.tcp is not None
        publisher = Publisher(TOPICS[topic], [writer.tcp], keys=self.rings[key])
        try:
            yield publisher
        finally:
            publisher.close()

    async def say(
        self, sender: Publisher, writer: str, message: Message, enough: Callable[[], object]
    ) -> None:
        """Publish a message repeatedly until a condition is true."""

        def printed() -> bool:
            self.sequence += 1
            now_ns = self.bridge.clock.now_ns()
            clock_id, plan = f"{writer}-1", self.plan.hash
            sender.send(message, Header(self.sequence, now_ns, now_ns, clock_id, writer, 1, plan))
            return bool(enough())

        await until(printed)

    async def is_taken(self, sender: Publisher, writer: str, message: Message) -> None:
        self.inbox.clear()
        await self.say(sender, writer, message, lambda: (writer, repr(message)) in self.inbox)

    async def is_refused(self, sender: Publisher, writer: str, message: Message, port: str) -> None:
        """Assert that a message is rejected and counted."""
        first = self.rejected(port)
        self.inbox.clear()
        await self.say(sender, writer, message, lambda: self.rejected(port) >= first + 10)
        assert (writer, repr(message)) not in self.inbox


@asynccontextmanager
async def make_secured(
    plan: ResolvedGraph, monkeypatch: pytest.MonkeyPatch
) -> AsyncIterator[SecuredBridge]:
    monkeypatch.setattr(bus, "REOPEN_DELAY_S", 0.02)
    secured = SecuredBridge(plan)
    monkeypatch.setattr(secured.bridge, "deliver", secured.record)
    await secured.links.open_inputs(secured.bridge)
    try:
        yield secured
    finally:
        secured.links.close()


async def test_an_arm_s_computer_cannot_command_the_other_arm(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The attacker has the key and the address of the host `left`, and any free address."""
    mine, main_s = ("arm_left", "arm_left_bridge"), ("sheet_target", "planner")
    left, forged = arm_state("left"), target()
    async with make_secured(lab(folder), monkeypatch) as secured:
        with secured.sender("arm_left", at=mine, key="left") as sender:
            await secured.is_taken(sender, "arm_left_bridge", left)
            for other in ("planner", BRIDGE, "tools"):
                await secured.is_refused(sender, other, left, "other_arm")
        with secured.sender("sheet_target", at=mine, key="left") as sender:
            await secured.is_refused(sender, "planner", forged, "other_arm")
        with secured.sender("sheet_target", at=main_s, key="left") as sender:
            secured.bridge.last_error = ""
            await secured.say(sender, "planner", forged, lambda: secured.bridge.last_error)
            assert 'topic "sheet_target": host main did not prove' in secured.bridge.last_error
            assert {writer for writer, _ in secured.inbox} <= {"arm_left_bridge"}
        with secured.sender("sheet_target", at=main_s, key="main") as sender:
            await secured.is_taken(sender, "planner", forged)


@pytest.mark.parametrize("may", [None, False, True], ids=["as it comes", "may not", "may"])
async def test_who_may_reset_a_stop_and_let_the_arms_move(
    folder: Path, monkeypatch: pytest.MonkeyPatch, may: bool | None
) -> None:
    """A console on the host `left` can always stop the arms. The launch file defines all other
    permissions.
    """
    async with make_secured(lab(folder, may_reset_estop=may), monkeypatch) as secured:
        words: tuple[tuple[str, Message, Message], ...] = (
            ("estop", EStop(engaged=True, reason="a hand"), EStop(engaged=False, reason="gone")),
            ("arming", Arming(ready=False), Arming(ready=True)),
        )
        for topic, stops, lets in words:
            with secured.sender(topic, at=(topic, "hand"), key="left") as sender:
                await secured.is_taken(sender, "hand", stops)
                if may:
                    await secured.is_taken(sender, "hand", lets)
                else:
                    await secured.is_refused(sender, "hand", lets, topic)
                    assert "hand may not reset an e-stop" in secured.bridge.last_error
                await secured.is_taken(sender, "hand", stops)
            with secured.sender(topic, at=(topic, "tools"), key="main") as sender:
                await secured.is_taken(sender, "tools", lets)
            assert (secured.rejected(topic) == 0) == bool(may)


@pytest.mark.parametrize("may", [None, True], ids=["as it comes", "may"])
def test_a_console_that_may_not_reset_names_hosts_that_may(folder: Path, may: bool | None) -> None:
    plan = lab(folder, may_reset_estop=may)
    (folder / "plan.json").write_text(plan.model_dump_json())
    sent: list[Message] = []
    facts = GraphFacts.from_plan(folder / "plan.json", "console")
    finger = FingerController(sent.append)
    console = ConsoleController(sent.append, folder / "plan.json", finger, facts)
    console.stop("pressed at the console")
    if may:
        console.release()
        assert sent[-1] == EStop(engaged=False, reason="reset at the console")
    else:
        with pytest.raises(ReleaseError, match="use main, or set may_reset_estop"):
            console.release()
        assert sent == [EStop(engaged=True, reason="pressed at the console")]
        assert console.stopped == "pressed at the console"
