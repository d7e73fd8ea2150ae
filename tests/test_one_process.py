"""Test that nodes publish the same bytes in one process as in several processes."""

from __future__ import annotations

import asyncio
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import structlog

from flexsheet.launch.plans.plan import load_scene
from flexsheet.messages.bag import BagReader, BagWriter
from flexsheet.messages.base import Header
from flexsheet.messages.bus import Publisher, Subscriber
from flexsheet.messages.clock import VirtualClock
from flexsheet.messages.local_bus import LocalBus
from flexsheet.messages.topics import TOPICS
from flexsheet.messages.types import EStop, SheetTarget
from flexsheet.nodes.node import Input, Node, NodeParameters, Output, PortCounts
from flexsheet.nodes.planner.node import Planner
from flexsheet.nodes.planner.parameters import PlannerParameters
from flexsheet.nodes.runner import (
    LoggedNodeError,
    NodeConfig,
    NodeTransport,
    PortConfig,
    ProcessConfig,
    run_nodes,
)
from tests.fingertips import fingertip
from tests.plans import ROOT
from tests.waiting import until

FIRST_SEQUENCE, STEP_NS, STEPS = 1000, 16_000_000, 30


class TargetReport(Node):
    """A node that publishes the centre and the source timestamp of each target."""

    parameters: NodeParameters
    sheet_target: Input[SheetTarget]
    estop: Output[EStop]

    def on_sheet_target(self, target: SheetTarget, header: Header) -> None:
        assert not target.world_from_sheet.flags.writeable
        centre = target.world_from_sheet[:3, 3].tolist()
        self.estop.publish(
            EStop(engaged=False, reason=f"{header.sequence} {centre}"), source_ns=header.source_ns
        )


def write_bag(path: Path) -> None:
    """Write the scene, and a finger that touches the object and moves up."""
    scene = load_scene(ROOT / "launch" / "scenes" / "rigid-plane.yaml")
    with BagWriter(path) as bag:
        for number in range(STEPS):
            at_ns = (number + 1) * STEP_NS
            head = Header(number + 1, at_ns, at_ns + 5_000_000, "virtual", "tools", 1)
            if number == 0:
                bag.write(TOPICS["scene"], scene, head, at_ns)
            point = np.array([0.0, 0.001 * number, -0.0005 * number])
            bag.write(TOPICS["fingertip"], fingertip(point), head, at_ns)


class Chain:
    """Planner and report with their connections, and a recorder in another process."""

    def __init__(self, folder: Path, *, in_one_process: bool) -> None:
        self._folder = folder
        folder.mkdir()
        configs = (
            self._configure("planner", (), "sheet_target"),
            self._configure("report", (self._port("sheet_target"),), "estop"),
        )
        local = None
        if in_one_process:
            local = LocalBus(str(one.outputs[0].endpoints[0]) for one in configs)
        self.clock = VirtualClock()
        self.transports = [NodeTransport(one, structlog.get_logger(), local) for one in configs]
        options: dict[str, Any] = {"clock": self.clock, "epoch": 1}
        # A measured horizon would depend on the number of messages before the bag.
        self.planner = Planner(
            PlannerParameters(prediction_horizon_s=0.05),
            name="planner",
            send=self.transports[0].send,
            **options,
        )
        self.report = TargetReport(
            NodeParameters(), name="report", send=self.transports[1].send, **options
        )
        self.nodes: tuple[Node, ...] = (self.planner, self.report)
        self.recorded: list[list[bytes]] = []
        self.newest: dict[str, int] = {}
        self.recorders = [
            Subscriber(
                TOPICS[topic], [f"ipc://{folder}/{topic}"], self._record, PortCounts(), raw=True
            )
            for topic in ("sheet_target", "estop")
        ]

    def _port(self, topic: str) -> PortConfig:
        return PortConfig(port=topic, topic=topic, endpoints=(f"ipc://{self._folder}/{topic}",))

    def _configure(self, name: str, inputs: tuple[PortConfig, ...], output: str) -> NodeConfig:
        return NodeConfig(
            name=name,
            type="",
            parameters={},
            inputs=inputs,
            outputs=(self._port(output),),
            plan_hash="",
            run_dir=str(self._folder),
        )

    def _record(self, frames: Any, header: Header) -> None:
        self.newest[header.writer] = header.sequence
        if header.sequence > FIRST_SEQUENCE:
            self.recorded.append([bytes(frame) for frame in frames])

    async def open(self) -> None:
        for node, transport in zip(self.nodes, self.transports, strict=True):
            transport.open_outputs(node)
            await node.setup()
            await transport.open_inputs(node)
        for recorder in self.recorders:
            recorder.start()

    def close(self) -> None:
        for connection in (*self.recorders, *self.transports):
            connection.close()

    def is_idle(self) -> bool:
        """Return whether all messages have reached the recorder."""
        return self.newest == {
            "planner": self.planner.sheet_target.counts.messages,
            "report": self.report.estop.counts.messages,
        }


async def run_chain(folder: Path, bag: Path, *, in_one_process: bool) -> list[list[bytes]]:
    """Return the messages of planner and report that a recorder in another process receives, as
    bytes.
    """
    messages = list(BagReader(bag))
    [scene] = [(message, header) for topic, message, header, _ in messages if topic == "scene"]
    fingers = [(message, header) for topic, message, header, _ in messages if topic == "fingertip"]
    chain = Chain(folder, in_one_process=in_one_process)
    planner = chain.planner

    def connected() -> bool:
        planner.deliver("scene", *scene)
        planner.deliver("fingertip", *fingers[0])
        return chain.newest.keys() == {"planner", "report"}

    try:
        await chain.open()
        await until(connected, "the connections")
        await until(chain.is_idle, "the last report before the bag")
        for node in chain.nodes:
            for output in node.outputs.values():
                output.counts.messages = FIRST_SEQUENCE
        planner.deliver("scene", *scene)
        for number, finger in enumerate(fingers, start=FIRST_SEQUENCE + 1):
            chain.clock.move_to(finger[1].publish_ns)
            planner.deliver("fingertip", *finger)
            assert planner.sheet_target.counts.messages == number
            await until(
                lambda number=number: chain.newest == {"planner": number, "report": number},
                "target and report",
            )
        assert [node.errors for node in chain.nodes] == [0, 0]
    finally:
        chain.close()
    return chain.recorded


async def test_the_same_bag_gives_the_same_bytes_in_one_process_and_in_many(tmp_path: Path) -> None:
    bag = tmp_path / "finger.mcap"
    write_bag(bag)
    several = await run_chain(tmp_path / "several", bag, in_one_process=False)
    one = await run_chain(tmp_path / "one", bag, in_one_process=True)
    assert len(several) == 2 * STEPS
    assert sorted(one) == sorted(several)


async def test_the_end_of_the_images_is_passed_on_to_the_arms(tmp_path: Path) -> None:
    """The camera runs in one process, and triangulator and planner run in another."""
    topics = ("twin/stereo", "stereo", "fingertip", "sheet_target")
    ends = {one: f"ipc://{tmp_path}/{number}" for number, one in enumerate(topics)}

    def configure(kind: str, reads: str, writes: str, **parameters: Any) -> NodeConfig:
        def port(topic: str) -> PortConfig:
            return PortConfig(port=topic.replace("/", "__"), topic=topic, endpoints=(ends[topic],))

        return NodeConfig(
            name=kind, type=kind, parameters=parameters, inputs=(port(reads),),
            outputs=(port(writes),), plan_hash="", run_dir=str(tmp_path),
        )  # fmt: skip

    processes = [
        [configure("camera", "twin/stereo", "stereo")],
        [
            configure("triangulator", "stereo", "fingertip"),
            configure("planner", "fingertip", "sheet_target"),
        ],
    ]
    stop, ended = asyncio.Event(), asyncio.Event()
    images = Publisher(TOPICS["twin/stereo"], [ends["twin/stereo"]])
    bridge = Subscriber(
        TOPICS["sheet_target"],
        [ends["sheet_target"]],
        lambda *_: None,
        PortCounts(),
        on_disconnected=ended.set,
    )
    running = [
        asyncio.create_task(run_nodes(ProcessConfig(name=nodes[0].name, nodes=tuple(nodes)), stop))
        for nodes in processes
    ]
    try:
        bridge.start()

        def interrupt() -> bool:
            # Until all nodes have connected, an end reaches only some of them.
            images.interrupt()
            return ended.is_set()

        await until(interrupt, period_s=0.2)
    finally:
        stop.set()
        await asyncio.gather(*running)
        bridge.close()
        images.close()


async def test_a_node_fails_if_it_cannot_open_its_output_again(tmp_path: Path) -> None:
    folder = tmp_path / "out"
    folder.mkdir()
    ends = {"fingertip": f"ipc://{tmp_path}/in", "sheet_target": f"ipc://{folder}/a"}
    inputs, outputs = (
        (PortConfig(port=topic, topic=topic, endpoints=(end,)),) for topic, end in ends.items()
    )
    planner = NodeConfig(
        name="planner", type="planner", parameters={}, inputs=inputs, outputs=outputs,
        plan_hash="", run_dir=str(tmp_path),
    )  # fmt: skip
    fingers = Publisher(TOPICS["fingertip"], [ends["fingertip"]])
    config = ProcessConfig(name="planner", nodes=(planner,))
    running = asyncio.create_task(run_nodes(config, asyncio.Event()))
    try:
        await until((folder / "a").exists)
        shutil.rmtree(folder)

        def interrupt() -> bool:
            fingers.interrupt()
            return running.done()

        await until(interrupt, period_s=0.2)
    finally:
        fingers.close()
    with pytest.raises(LoggedNodeError):
        running.result()
