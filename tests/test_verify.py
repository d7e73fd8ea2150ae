"""Test `bag verify` of every node: replayed results equal live ones, or the reason why not."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import psutil
import pytest

from flexsheet.launch.bags.replay import Verification, refusal, verify
from flexsheet.launch.plans.plan import load_graph
from flexsheet.launch.plans.plan_model import ResolvedGraph
from flexsheet.messages.bag import BagError, BagReader, BagWriter
from flexsheet.messages.base import Header, Message
from flexsheet.messages.clock import VirtualClock
from flexsheet.messages.topics import TOPICS, Topic
from flexsheet.messages.types import ClockEcho, ClockPing, Status, StereoPair
from flexsheet.nodes import node_class
from flexsheet.nodes.node import Node, find_parameters_type, find_timers
from flexsheet.nodes.runner import make_status
from flexsheet.nodes.twin.pixels import TwinCamera
from flexsheet.nodes.twin.rig import make_true_camera

ROOT = Path(__file__).resolve().parent.parent
START_NS = 10**13
FRAME_NS = 16_666_667
FRAMES = 24
NODES = ("camera", "triangulator", "planner", "fem_solver")


def plan_of(folder: Path) -> ResolvedGraph:
    settings = [
        "fem_solver.skin_spacing_m=0.007",
        "fem_solver.method=linear",
        f"fem_solver.cache_dir={folder}/cache",
    ]
    return load_graph(ROOT / "launch" / "demo.yaml", settings=settings, record=folder / "x.mcap")


@dataclass
class SimulatedGraph:
    """Nodes of the demo on one clock, with random delays, and a recorder without."""

    plan: ResolvedGraph
    writer: BagWriter
    clock: VirtualClock = field(default_factory=lambda: VirtualClock(START_NS, clock_id="lab"))
    nodes: dict[str, Node] = field(default_factory=dict)
    newest: dict[str, tuple[Message, Header]] = field(default_factory=dict)
    handed: dict[tuple[str, str], object] = field(default_factory=dict)

    def build(self, name: str) -> Node:
        planned = self.plan.nodes[name]
        class_ = node_class(planned.type)
        node = class_(
            find_parameters_type(class_).model_validate(planned.parameters),
            name=name,
            clock=self.clock,
            send=self.send,
            topics={port.port: port.topic for port in (*planned.inputs, *planned.outputs)},
        )
        self.nodes[name] = node
        return node

    def send(self, topic: Topic, message: Message, header: Header) -> None:
        self.newest[topic.name] = (message, header)
        self.writer.write(topic, message, header, self.clock.now_ns() + 1000)

    def say(self, topic: str, message: Message, sequence: int, writer: str) -> None:
        """Publish a message of a node that does not run."""
        now_ns = self.clock.now_ns()
        header = Header(sequence, now_ns - 4_000_000, now_ns, "lab", writer, 5)
        self.send(TOPICS[topic], message, header)

    async def hand(self, topic: str, *names: str) -> None:
        """Pass the newest message of a topic to nodes, while time passes."""
        for name in names:
            entry = self.newest.get(topic)
            if entry is not None and self.handed.get((topic, name)) is not entry:
                self.handed[topic, name] = entry
                self.clock.move_to(self.clock.now_ns() + 300_000)
                await self.nodes[name].step(topic.replace("/", "__"), *entry)

    def publish_status(self) -> None:
        for node in self.nodes.values():
            node.status.publish(make_status(node, "running", psutil.Process()))


async def live(folder: Path) -> Path:
    """Record a finger that approaches and presses."""
    bag, plan = folder / "live.mcap", plan_of(folder)
    scene = plan.scene_message()
    assert scene is not None
    eyes = TwinCamera(make_true_camera(scene.camera), finger_radius_m=scene.finger.radius_m, seed=4)
    with BagWriter(bag, {"recording": {"clock_id": "lab"}}) as writer:
        writer.add_attachment("plan.json", plan.model_dump_json().encode(), "application/json")
        graph = SimulatedGraph(plan, writer)
        for name in NODES:
            await graph.build(name).setup()
        graph.say("scene", scene, 1, "launch")
        await graph.hand("scene", *NODES)
        for i in range(FRAMES):
            graph.clock.move_to(START_NS + 10**9 + i * FRAME_NS)
            tip = np.array([0.001 * i, 0.0, 0.01 - 6e-4 * i])
            left, right = eyes.picture(lambda _, tip=tip: tip, exposure_s=0.004, time_s=0.02 * i)
            pair = StereoPair(device=eyes.camera.device, exposure_s=0.004, dropped_frames=0,
                              left=left, right=right)  # fmt: skip
            graph.say("twin/stereo", pair, i + 1, "twin_finger")
            await graph.hand("twin/stereo", "camera")
            if i % 6 != 5:
                await graph.hand("stereo", "triangulator")
            # The planner hears of the body before or after the finger, or not at all.
            order = [
                ("fingertip", "planner"),
                ("soft_body", "planner"),
                ("fingertip", "fem_solver"),
            ]
            for topic, name in order if i % 2 else order[::-1]:
                if (i + len(topic)) % 5:
                    await graph.hand(topic, name)
        graph.publish_status()
        for node in graph.nodes.values():
            await node.close()
    return bag


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return asyncio.run(live(tmp_path_factory.mktemp("verify")))


def assert_as_live(result: Verification) -> None:
    assert result.same_bytes
    assert result.ok, result
    for comparison in result.topics.values():
        assert comparison.worst == {}
        assert comparison.compared == comparison.replayed


@pytest.mark.parametrize("name", NODES)
def test_what_a_node_did_live_it_does_again_to_the_last_bit(bag: Path, name: str) -> None:
    result = verify(bag, name)
    assert_as_live(result)
    # The camera, which could reach for devices, does not say what it took: it takes all.
    assert result.by_execution_log == (name != "camera")
    assert result.missing == 0
    output = {"camera": "stereo", "triangulator": "fingertip", "planner": "sheet_target",
              "fem_solver": "soft_body"}[name]  # fmt: skip
    assert result.topics[output].compared >= FRAMES // 2


def test_images_are_drawn_again_to_the_last_pixel(bag: Path) -> None:
    result = verify(bag, "renderer")
    assert result.repeatable, result
    assert result.topics["frame"].replayed > 3


def test_without_the_execution_log_the_recorders_order_differs(bag: Path, tmp_path: Path) -> None:
    old = rewritten(bag, tmp_path / "old.mcap", log=False)
    result = verify(old, "planner")
    assert result.same_bytes
    assert not result.by_execution_log
    assert not result.as_live


def test_inputs_that_the_recorder_lost_are_counted(bag: Path, tmp_path: Path) -> None:
    holed = rewritten(bag, tmp_path / "holed.mcap", without=("fingertip", 7))
    assert verify(holed, "planner").missing == 1


def rewritten(
    bag: Path, path: Path, *, log: bool = True, without: tuple[str, int] | None = None
) -> Path:
    reader = BagReader(bag)
    with BagWriter(path, reader.metadata) as writer:
        writer.add_attachment("plan.json", reader.attachment("plan.json"), "application/json")
        for topic, message, header, log_ns in reader:
            if isinstance(message, Status) and not log:
                message = message.model_copy(update={"execution_log": np.zeros((0, 4), np.int64)})  # noqa: PLW2901
            if (topic, header.sequence) != without:
                writer.write(TOPICS[topic], message, header, log_ns)
    return path


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("arm_left_bridge", "commands an arm"),
        ("twin_arms", "over the network"),
        ("twin_finger", "takes images by its own clock"),
        ("recorder", "recorded this bag"),
    ],
)
def test_nodes_that_cannot_be_replayed_give_a_reason(bag: Path, name: str, why: str) -> None:
    with pytest.raises(BagError, match=f"{name} cannot be replayed: .*{why}"):
        verify(bag, name)


def test_devices_windows_and_pages_are_not_replayed_either(tmp_path: Path) -> None:
    settings = ["camera.source={kind: live, left: /dev/video0}", "renderer.output=window"]
    plan = load_graph(ROOT / "launch" / "demo.yaml", settings=settings, console=True)
    assert "reads a device" in refusal(plan.nodes["camera"])
    assert "in a window" in refusal(plan.nodes["renderer"])
    assert "serves a page" in refusal(plan.nodes["console"])
    assert refusal(plan.nodes["twin_eye"]) == ""


async def test_a_clock_node_measures_the_same_again(tmp_path: Path) -> None:
    file = tmp_path / "two.yaml"
    file.write_text(
        "hosts: {main: {address: 127.0.0.1}}\n"
        "nodes:\n  clock: {type: clock, host: main, topics: {clock_ping_out: clock_ping}}\n"
    )
    plan = load_graph(file, settings=[], record=tmp_path / "x.mcap")
    name = next(name for name, node in plan.nodes.items() if node.host == "main")
    bag = tmp_path / "clocks.mcap"
    with BagWriter(bag, {"recording": {"clock_id": "lab"}}) as writer:
        writer.add_attachment("plan.json", plan.model_dump_json().encode(), "application/json")
        graph = SimulatedGraph(plan, writer)
        node = graph.build(name)
        await node.setup()
        for i in range(1, 9):
            graph.clock.move_to(START_NS + i * 10**8)
            now_ns = graph.clock.now_ns()
            echo = ClockEcho(
                clock_id="lab", sent_ns=now_ns - 400_000, received_ns=now_ns + 5 * 10**6
            )
            header = Header(i, now_ns + 5 * 10**6, now_ns + 5 * 10**6 + 100_000, "far", "far", 9)
            ping = ClockPing(echoes=(echo,))
            graph.send(TOPICS["clock_ping"], ping, header)
            await node.step("clock_ping", ping, header)
            await node.call_timer(0, find_timers(type(node))[0])
        graph.publish_status()
    result = await asyncio.to_thread(verify, bag, name)
    assert_as_live(result)
    assert result.topics["clocks"].compared == 8
