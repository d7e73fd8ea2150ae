"""Test the live view with a plain WebSocket client."""

from __future__ import annotations

import asyncio
import json
import re
import signal
import socket
import struct
import sys
from collections import Counter
from collections.abc import AsyncIterator, Mapping
from contextlib import AsyncExitStack, asynccontextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import websockets

pytest.importorskip("foxglove", reason="pip install 'flexsheet[view]'")

from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass
from typer.testing import CliRunner, Result

from flexsheet.launch.cli import app
from flexsheet.launch.commands.view import LAYOUT
from flexsheet.launch.plans.plan import load_graph
from flexsheet.launch.plans.plan_model import ResolvedGraph
from flexsheet.launch.running.runs import Run, local_endpoints
from flexsheet.launch.viewing.channels import list_channels
from flexsheet.launch.viewing.json_channel import MAX_ARRAY, make_schema, to_json
from flexsheet.launch.viewing.live_server import ALWAYS_READ, LiveServer
from flexsheet.messages.base import Header, Message
from flexsheet.messages.bus import Publisher
from flexsheet.messages.clock import SystemClock
from flexsheet.messages.topics import TOPICS, find_topic
from flexsheet.messages.types import Skin, SoftBody, Status, StereoPair
from flexsheet.nodes.arm_bridge.geometry import ArmGeometry
from tests.arm_states import arm_state
from tests.examples import long_except
from tests.fingertips import fingertip
from tests.scenes import CYLINDER_FILE, load_cylinder
from tests.waiting import DEADLINE_S, until

SCENE = load_cylinder()
SUBPROTOCOL = "foxglove.sdk.v1"
TIP_M = np.array([0.01, 0.02, 0.003])
JOINTS_RAD = np.array([0.3, 0.2, 1.6, 0.1, 0.4, -0.2])
EXTERNAL = ("fingertip", "arm_left", "arm_right", "stereo", "skin", "soft_body")
VERTICES = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)
GRAY = np.tile(np.arange(0, 256, 4, dtype=np.uint8), (48, 1))


def arm(side: str) -> Message:
    geometry = ArmGeometry(SCENE, "left" if side == "left" else "right")
    return arm_state(
        side, joints_rad=JOINTS_RAD, world_from_flange=geometry.world_from_flange(JOINTS_RAD)
    )


MESSAGES: Mapping[str, Message] = {
    "scene": SCENE,
    "fingertip": fingertip(TIP_M, np.array([0.1, 0.0, 0.0])),
    "arm_left": arm("left"),
    "arm_right": arm("right"),
    "stereo": StereoPair(device="t", exposure_s=0.001, dropped_frames=0, left=GRAY,
                         right=GRAY[:, ::-1].copy()),
    "skin": Skin(mesh_id="a", vertices_world_m=VERTICES, triangles=np.array([[0, 1, 2]], "i4")),
    "soft_body": SoftBody(mesh_id="a", method="linear", in_range=True, push_depth_m=0.001,
                          force_world_n=np.zeros(3), stiffness_n_per_m=50.0,
                          displacement_world_m=np.full((3, 3), 0.25, np.float32)),
}  # fmt: skip


class FakeGraph:
    """Publisher of all topics of a graph, in place of its nodes."""

    def __init__(self, plan: ResolvedGraph, run: Run) -> None:
        self.plan, self.clock = plan, SystemClock()
        self._sequences: Counter[str] = Counter()
        self._publishers = {
            topic: Publisher(
                find_topic(topic), local_endpoints(run, plan.writers[topic][0].endpoints)
            )
            for topic in (*EXTERNAL, "scene", "status")
        }

    def publish(self, topic: str, message: Message | None = None) -> None:
        self._sequences[topic] += 1
        now_ns, writer = self.clock.now_ns(), self.plan.writers[topic][0].name
        header = Header(
            self._sequences[topic], now_ns, now_ns, self.clock.id, writer, 1, self.plan.hash
        )
        self._publishers[topic].send(message or MESSAGES[topic], header)

    async def publish_until(self, condition: Any, *topics: str) -> None:
        """Publish repeatedly until the condition holds, as nodes do."""

        def done() -> bool:
            for topic in topics:
                self.publish(topic)
            return bool(condition())

        await until(done, f"condition after {topics}", period_s=0.02)

    def close(self) -> None:
        for publisher in self._publishers.values():
            publisher.close()


class Viewer:
    """Plain client of the protocol; `received`: decoded messages by channel."""

    def __init__(self, socket: websockets.ClientConnection) -> None:
        self.socket = socket
        self.texts: list[dict[str, Any]] = []
        self.channels: dict[str, dict[str, Any]] = {}
        self.received: dict[str, list[tuple[int, Any]]] = {}
        self._names: dict[int, str] = {}
        self.times: list[int] = []

    async def listen(self) -> None:
        async for data in self.socket:
            if isinstance(data, str):
                text = json.loads(data)
                self.texts.append(text)
                for channel in text.get("channels", []):
                    self.channels[channel["topic"]] = channel
            elif data[0] == 1:
                number, at_ns = struct.unpack_from("<IQ", data, 1)
                name = self._names[number]
                value = decode(self.channels[name], data[13:])
                self.received.setdefault(name, []).append((at_ns, value))
            elif data[0] == 2:
                self.times.append(struct.unpack_from("<Q", data, 1)[0])

    async def subscribe(self, *names: str) -> None:
        pairs = []
        for name in names:
            number = len(self._names) + 1
            self._names[number] = name
            pairs.append({"id": number, "channelId": self.channels[name]["id"]})
        await self.send("subscribe", subscriptions=pairs)

    async def unsubscribe(self) -> None:
        await self.send("unsubscribe", subscriptionIds=list(self._names))

    async def send(self, op: str, **fields: Any) -> None:
        await self.socket.send(json.dumps({"op": op, **fields}))

    def last(self, op: str) -> dict[str, Any] | None:
        return next((text for text in reversed(self.texts) if text["op"] == op), None)


def decode(channel: dict[str, Any], data: bytes) -> Any:
    """Decode JSON, or protobuf by the schema that the server has sent."""
    if channel["encoding"] == "json":
        return json.loads(data)
    import base64

    files = FileDescriptorSet.FromString(base64.b64decode(channel["schema"]))
    pool = DescriptorPool()
    for file in files.file:
        pool.Add(file)  # type: ignore[no-untyped-call]
    kind = GetMessageClass(pool.FindMessageTypeByName(channel["schemaName"]))  # type: ignore[no-untyped-call]
    return kind.FromString(data)


def load_plan(folder: Path) -> ResolvedGraph:
    file = folder / "graph.yaml"
    values = {
        "scene": str(CYLINDER_FILE),
        "hosts": {"main": {"address": "127.0.0.1"}},
        "external_topics": EXTERNAL,
        "nodes": {"planner": {"type": "planner"}},
    }
    file.write_text(json.dumps(values))
    return load_graph(file)


@asynccontextmanager
async def connect_to(server: LiveServer) -> AsyncIterator[Viewer]:
    async with connect(f"ws://127.0.0.1:{server.port}") as viewer:
        await until(lambda: len(viewer.channels) == len(server.channels), "the channels")
        yield viewer
        assert viewer.socket.close_code is None


@asynccontextmanager
async def connect(address: str) -> AsyncIterator[Viewer]:
    async with websockets.connect(
        address,
        subprotocols=[SUBPROTOCOL],  # type: ignore[list-item]
        max_size=None,
        close_timeout=0.1,  # the server of the SDK answers no close
    ) as socket:
        viewer = Viewer(socket)
        listening = asyncio.create_task(viewer.listen())
        try:
            yield viewer
        finally:
            listening.cancel()
            await asyncio.gather(listening, return_exceptions=True)


@asynccontextmanager
async def live(folder: Path) -> AsyncIterator[tuple[LiveServer, FakeGraph]]:
    (folder / "run").mkdir()
    plan, run = load_plan(folder), Run("test", folder / "run")
    graph = FakeGraph(plan, run)
    problems: list[str] = []
    server = LiveServer(
        plan, run, port=0, rate_hz=100.0, image_rate_hz=100.0, on_problem=problems.append
    )
    try:
        yield server, graph
        assert not problems
    finally:
        server.close()
        graph.close()


@pytest.fixture
def short_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("v")


async def test_a_viewer_gets_numbers_poses_images_and_the_scene(short_folder: Path) -> None:
    names = ("fingertip", "tf", "tf_static", "sheet", "object", "finger", "stereo/left")
    async with live(short_folder) as (server, graph), connect_to(server) as viewer:
        await viewer.subscribe(*names)
        await graph.publish_until(lambda: set(names) <= viewer.received.keys(), "scene", *EXTERNAL)

        at_ns, number = viewer.received["fingertip"][-1]
        assert number["position_world_m"] == TIP_M.tolist()
        assert len(number["covariance"]) == 36, "arrays are lists that one index selects from"
        assert at_ns > 1_700_000_000 * 10**9, "times count from 1970"

        await graph.publish_until(
            lambda: {"left_flange", "right_flange", "fingertip"} <= frames(viewer).keys(), *EXTERNAL
        )
        poses = world_poses(frames(viewer))
        expected = ArmGeometry(SCENE, "left").world_from_edge(JOINTS_RAD)[:3, 3]
        np.testing.assert_allclose(poses["left_clamp"], expected, atol=1e-9)
        np.testing.assert_allclose(poses["fingertip"], TIP_M, atol=1e-12)

        sheet = viewer.received["sheet"][-1][1].entities[0].triangles[0]
        assert max(sheet.indices) == len(sheet.points) - 1
        skin = viewer.received["object"][-1][1].entities[0].triangles[0]
        assert [point.x for point in skin.points][:1] in ([0.0], [0.25])
        ball = viewer.received["finger"][-1][1].entities[0].spheres[0]
        assert ball.size.x == 2 * SCENE.finger.radius_m

        image = viewer.received["stereo/left"][-1][1]
        assert image.format == "jpeg"
        shown = cv2.imdecode(np.frombuffer(image.data, np.uint8), cv2.IMREAD_GRAYSCALE)
        assert shown is not None
        assert np.abs(shown.astype(int) - GRAY).max() < 12
        assert viewer.times


def frames(viewer: Viewer) -> dict[str, Any]:
    both = [*viewer.received.get("tf_static", []), *viewer.received.get("tf", [])]
    return {one.child_frame_id: one for _, message in both for one in message.transforms}


def world_poses(found: dict[str, Any]) -> dict[str, Any]:
    """Return the positions of frames in the world, computed with quaternions by this test."""

    def rotate(q: Any, v: Any) -> Any:
        axis = np.array([q.x, q.y, q.z])
        return v + 2.0 * np.cross(axis, np.cross(axis, v) + q.w * v)

    def to_world(name: str, point: Any) -> Any:
        while name != "world":
            one = found[name]
            t = one.translation
            point = rotate(one.rotation, point) + np.array([t.x, t.y, t.z])
            name = one.parent_frame_id
        return point

    return {name: to_world(name, np.zeros(3)) for name in found if name != "world"}


async def test_topics_are_read_only_for_subscribers(short_folder: Path) -> None:
    async with live(short_folder) as (server, graph), connect_to(server) as viewer:
        await until(lambda: server.topics_read == ALWAYS_READ, "only small topics")
        await viewer.subscribe("stereo/right")
        await until(lambda: server.topics_read == {*ALWAYS_READ, "stereo"}, "the images")
        await graph.publish_until(lambda: "stereo/right" in viewer.received, "stereo")
        await viewer.unsubscribe()
        await until(lambda: server.topics_read == ALWAYS_READ, "no images")


async def test_parameters_are_shown_and_cannot_be_changed(short_folder: Path) -> None:
    async with live(short_folder) as (server, graph), connect_to(server) as viewer:
        status = make_status()
        await viewer.send("subscribeParameterUpdates", parameterNames=["planner.max_spin_rad"])

        async def ask(**fields: Any) -> dict[str, Any]:
            viewer.texts.clear()
            await viewer.send(**fields)
            await until(lambda: viewer.last("parameterValues"), "parameters")
            answer = viewer.last("parameterValues")
            assert answer is not None
            return {one["name"]: one.get("value") for one in answer["parameters"]}

        before = await ask(op="getParameters", parameterNames=["planner.max_age_s"], id="1")
        assert before["planner.max_age_s"] == graph.plan.nodes["planner"].parameters["max_age_s"]
        changed = [{"name": "planner.max_age_s", "value": 9.0}]
        assert await ask(op="setParameters", parameters=changed, id="2") == before
        assert await ask(op="getParameters", parameterNames=["planner.max_age_s"], id="3") == before
        await graph.publish_until(lambda: URDF in server._parameters.values, "scene")
        shown = await ask(op="getParameters", parameterNames=[URDF], id="4")
        assert 'name="left_joint_1"' in shown[URDF]

        def is_updated() -> bool:
            graph.publish("status", status)
            return server._parameters.values.get("planner.max_spin_rad") == 0.5

        await until(is_updated, "the changed parameter", period_s=0.02)


URDF = "/robot_description"


def make_status() -> Status:
    return Status(
        node="planner", state="running", pid=1, uptime_s=1.0, cpu_ratio=0.0, resident_bytes=1,
        inputs=(), outputs=(), errors=0, last_error="", plan_hash="", clock_id="",
        clock_offsets=(), execution_log=np.zeros((0, 4), np.int64), self_checks=(),
        changed_parameters='{"max_spin_rad": 0.5}',
    )  # fmt: skip


async def test_viewers_can_neither_publish_nor_call(short_folder: Path) -> None:
    async with live(short_folder) as (server, graph), connect_to(server) as viewer:
        info = viewer.last("serverInfo")
        assert info is not None
        assert set(info["capabilities"]) == {"parameters", "parametersSubscribe", "time"}
        channel = {"id": 1, "topic": "estop", "encoding": "json", "schemaName": "EStop"}
        await viewer.send("advertise", channels=[channel])
        await viewer.socket.send(struct.pack("<BI", 1, 1) + b'{"engaged": false, "reason": ""}')
        await until(lambda: viewer.last("status"), "a refusal")
        refusal = viewer.last("status")
        assert refusal is not None
        assert refusal["level"] == 2, refusal
        assert server.channels
        assert graph.plan


async def test_a_client_of_the_former_protocol_is_refused(short_folder: Path) -> None:
    async with live(short_folder) as (server, _):
        with pytest.raises(websockets.exceptions.InvalidStatus):
            await websockets.connect(
                f"ws://127.0.0.1:{server.port}",
                subprotocols=["foxglove.websocket.v1"],  # type: ignore[list-item]
            )


def test_the_command_prints_address_and_layout(
    short_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("os.nice", lambda _: 0)
    (short_folder / "plan.json").write_text(load_plan(short_folder).model_dump_json())

    def run(port: int) -> Result:
        words = ["view", "--run", str(short_folder), "--port", str(port), "--duration", "0.1"]
        return CliRunner().invoke(app, [*words, "--json"])

    done = run(0)
    assert done.exit_code == 0, done.output
    printed = json.loads(done.stdout)
    assert re.fullmatch(r"ws://127\.0\.0\.1:\d+", printed["address"])
    assert Path(printed["layout"]).is_file()
    assert {"fingertip", "tf", "sheet"} <= set(printed["channels"])
    with socket.create_server(("127.0.0.1", 0)) as occupied:
        refused = run(occupied.getsockname()[1])
    assert refused.exit_code != 0
    assert "choose another port" in str(refused.exception)


@pytest.mark.parametrize("connected", long_except([False, True], True))
async def test_ctrl_c_ends_the_command_at_once(short_folder: Path, connected: bool) -> None:
    (short_folder / "plan.json").write_text(load_plan(short_folder).model_dump_json())
    process = await asyncio.create_subprocess_exec(
        sys.executable, "-m", "flexsheet", "view", "--run", short_folder, "--port", "0", "--json",
        stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.PIPE,
    )  # fmt: skip
    assert process.stdout is not None
    async with AsyncExitStack() as stack:
        stack.callback(lambda: process.returncode is None and process.kill())
        printed = json.loads(await process.stdout.readline())
        if connected:
            viewer = await stack.enter_async_context(connect(printed["address"]))
            await until(lambda: "tf_static" in viewer.channels, "the channels")
            await viewer.subscribe("tf_static")
            await until(lambda: "tf_static" in viewer.received, "a message")
        process.send_signal(signal.SIGINT)
        async with asyncio.timeout(DEADLINE_S):
            _, errors = await process.communicate()
    assert process.returncode == 0, errors.decode()
    assert "Traceback" not in errors.decode()


@pytest.mark.parametrize("topic", TOPICS)
def test_a_schema_has_only_what_viewers_accept(topic: str) -> None:
    """Lichtblick 1.28 refuses nested arrays, fields without a type, and other types."""

    def check(schema: dict[str, Any], path: str) -> None:
        assert schema["type"] in ("object", "array", "string", "boolean", "number"), path
        for name, inner in schema.get("properties", {}).items():
            check(inner, f"{path}.{name}")
        if schema["type"] == "array":
            assert schema["items"]["type"] != "array", path
            check(schema["items"], f"{path}[]")

    check(make_schema(TOPICS[topic].message), topic)


@pytest.mark.parametrize("message", MESSAGES.values(), ids=list(MESSAGES))
def test_json_agrees_with_its_schema(message: Message) -> None:
    kinds = {"object": dict, "array": list, "string": str, "boolean": bool, "number": (int, float)}

    def check(value: Any, schema: dict[str, Any]) -> None:
        assert isinstance(value, kinds[schema["type"]])  # type: ignore[arg-type]
        if isinstance(value, dict):
            for name, item in value.items():
                check(item, schema["properties"][name])
        elif isinstance(value, list):
            assert len(value) <= MAX_ARRAY
            for item in value:
                check(item, schema["items"])

    check(to_json(message), make_schema(type(message)))


def test_the_layout_shows_channels_and_fields_that_exist() -> None:
    """Each panel of the shipped layout is placed once, and each path exists in the demo."""
    layout = json.loads(LAYOUT.read_text())
    plan = load_graph(Path("launch/demo.yaml"))
    channels = {one.name: one for one in list_channels([TOPICS[name] for name in plan.writers])}
    text = LAYOUT.read_text()
    keys = "value|topicPath|imageTopic|calibrationTopic|topicToRender"
    paths = re.findall(rf'"(?:{keys})": "([^"]+)"', text)
    assert len(paths) > 20
    for path in paths:
        name, _, rest = path.partition(".")
        assert name in channels, path
        schema = channels[name].schema
        for step in filter(None, rest.split(".")):
            assert schema is not None
            schema = schema["properties"][step.partition("[")[0]]
            assert ("[" in step) == (schema["type"] == "array"), path
    for panel in layout["configById"].values():
        assert set(panel.get("topics", {})) <= set(channels)
    placed = re.findall(r'"(?:first|second|layout)": "([^"]+)"', text)
    assert sorted([*placed]) == sorted(layout["configById"])
