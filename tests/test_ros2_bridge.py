"""Test the bridge to ROS 2 with a DDS participant that shares no code with it."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import threading
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from flexsheet.launch.plans.plan import load_graph
from flexsheet.launch.ros2.inputs import INPUTS, ExternalInputs, Rejection
from flexsheet.launch.running.supervisor import RunningGraph
from flexsheet.launch.running.tools import GraphWriter
from flexsheet.messages.types import Eye, Fingertip
from tests.example_bag import LEFT, RECORDED, SCENE, TIP, arm
from tests.fingertips import fingertip
from tests.waiting import until

pytest.importorskip("rosbags")
pytest.importorskip("cyclonedds")

from flexsheet.launch.ros2 import dds  # needs cyclonedds
from flexsheet.launch.ros2.bridge import Ros2Bridge
from flexsheet.launch.ros2.mapping import Ros2Error, load_ros_types

ROOT = Path(__file__).resolve().parent.parent
DOMAIN = 20 + os.getpid() % 80
PEER_CONFIGURATION = (
    "<CycloneDDS><Domain><General><AllowMulticast>false</AllowMulticast><Interfaces>"
    '<NetworkInterface name="lo" multicast="false"/></Interfaces></General><Discovery>'
    "<ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>120"
    '</MaxAutoParticipantIndex><Peers><Peer Address="127.0.0.1"/></Peers></Discovery>'
    "</Domain></CycloneDDS>"
)
JOINT_STATE_HASH = "RIHS01_a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e"
"""Hash of sensor_msgs/msg/JointState that `ros2 topic info --verbose` prints."""

EYE = np.array([0.05, 0.1, 0.0])


class Peer:
    """Process of the independent participant, and what it has received by topic."""

    def __init__(self) -> None:
        self.found: dict[str, list[dict[str, Any]]] = {}
        environment = {**os.environ, "CYCLONEDDS_URI": PEER_CONFIGURATION}
        self._process = subprocess.Popen(
            [sys.executable, ROOT / "tests" / "ros2_peer.py", str(DOMAIN)],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment,
        )  # fmt: skip
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            received = json.loads(line)
            self.found.setdefault(received.pop("topic"), []).append(received)

    def has(self, *topics: str) -> bool:
        """Return whether all topics have been received; fail if the process has ended."""
        assert self._process.poll() is None, "the peer has ended"
        return self.found.keys() >= {*topics}

    def send(self, **fields: Any) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps(fields) + "\n")
        self._process.stdin.flush()

    def close(self) -> None:
        self._process.kill()
        self._process.wait()
        self._thread.join()
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.close()
        self._process.stdout.close()


@asynccontextmanager
async def bridged(
    folder: Path, topics: list[str], *, accept: tuple[str, ...] = ()
) -> AsyncIterator[tuple[Peer, Ros2Bridge, Callable[..., None]]]:
    """Run a graph, the bridge and the peer; yield the function that publishes in the graph."""
    external = [name for name in (*topics, *accept) if name != "eye"]
    launch_file = folder / "graph.yaml"
    launch_file.write_text(
        f"scene: {ROOT}/launch/scenes/cylinder.yaml\n"
        "nodes: {beacon: {type: 'tests.launch_nodes:Beacon'}}\n"
        f"external_topics: [{', '.join(dict.fromkeys(external))}]\n"
    )
    peer = Peer()
    try:
        async with RunningGraph(load_graph(launch_file)) as graph:
            participant = dds.RosParticipant(DOMAIN)
            bridge = Ros2Bridge(
                graph.plan, graph.run, participant,
                topics=["scene", *topics, *accept], accept=accept, noise_m=0.001,
                on_problem=pytest.fail,
            )  # fmt: skip
            writer = GraphWriter(graph.plan, graph.run, [one for one in topics if one != "eye"])
            try:
                bridge.start()
                await until(lambda: peer.has("ready"), "the peer")
                await until(lambda: peer.has("rt/tf_static"), "the latched scene")
                yield peer, bridge, writer.publish
            finally:
                writer.close()
                bridge.close()
    finally:
        peer.close()


async def test_ros_sees_arms_fingertip_and_images(tmp_path: Path) -> None:
    stereo = next(message for topic, message in RECORDED if topic == "stereo")
    joints = np.arange(6.0)
    state = arm("right", 0.1).model_copy(update={"joints_rad": joints})
    async with bridged(tmp_path, ["fingertip", "arm_right", "stereo"]) as (peer, _, publish):
        found = peer.found

        def all_arrived() -> bool:
            publish("fingertip", fingertip(TIP))
            publish("arm_right", state)
            publish("stereo", stereo)
            names = ("rt/fingertip/point", "rt/joint_states", "rt/stereo/left/image_raw")
            frames = {frame for one in found.get("rt/tf", []) for frame in one["frames"]}
            return peer.has(*names) and {"fingertip", "right_flange_measured"} <= frames

        await until(all_arrived, found, period_s=0.05)
    point = found["rt/fingertip/point"][0]
    assert (point["xyz"], point["frame"]) == (TIP.tolist(), "world")
    assert abs(time.time_ns() - point["at_ns"]) < 60 * 10**9, "stamps count from 1970"
    assert found["rt/joint_states"][0]["position"] == joints.tolist()
    assert found["rt/joint_states"][0]["names"][5] == "right_joint_6"
    image = found["rt/stereo/left/image_raw"][0]
    assert (image["size"], image["data"]) == ([4, 3], LEFT.ravel().tolist())
    assert "camera_left" in found["rt/tf_static"][0]["frames"]
    endpoints = {one["name"]: one for one in found["endpoint"]}
    assert endpoints["rt/joint_states"]["type"] == "sensor_msgs::msg::dds_::JointState_"
    assert endpoints["rt/tf"]["type"] == "tf2_msgs::msg::dds_::TFMessage_"
    assert endpoints["rt/joint_states"]["hash"] == f"typehash={JOINT_STATE_HASH};"


async def test_ros_gives_eye_and_fingertip_as_untrusted_inputs(tmp_path: Path) -> None:
    accept = ("eye", "fingertip")
    async with bridged(tmp_path, [], accept=accept) as (peer, bridge, _):
        found, eye = peer.found, (SCENE.eyes.centre_world_m + EYE).tolist()

        def all_arrived() -> bool:
            now_ns = time.time_ns()
            half = math.sqrt(0.5)
            peer.send(kind="eye", frame="world", at_ns=now_ns, xyz=eye, xyzw=[0, 0, half, half])
            peer.send(kind="eye", frame="map", at_ns=now_ns, xyz=eye, xyzw=[0, 0, 0, 1])
            peer.send(kind="fingertip", frame="world", at_ns=now_ns, xyz=[0.0, 0.01, 0.1])
            return peer.has("rt/flexsheet/eye", "rt/fingertip/point")

        await until(all_arrived, found, period_s=0.03)
    received = found["rt/flexsheet/eye"][0]
    assert received["writer"] == "tools", "the writer's name marks the source as external"
    assert received["centre"] == pytest.approx(eye)
    assert received["right"] == pytest.approx([0.0, 1.0, 0.0])
    assert found["rt/fingertip/point"][0]["xyz"] == pytest.approx([0.0, 0.01, 0.1])
    assert bridge.inputs.rejected[Rejection.WRONG_FRAME] >= 1
    assert bridge.accepted.keys() == {"eye", "fingertip"}


def test_only_eye_and_fingertip_are_accepted() -> None:
    assert {one.topic for one in INPUTS.values()} == {"eye", "fingertip"}


def test_other_interfaces_are_used_only_by_name() -> None:
    configuration = dds.make_configuration("lo")
    assert 'name="lo" multicast="false"' in configuration
    assert "<AllowMulticast>false" in configuration
    with pytest.raises(Ros2Error, match="no such network interface"):
        dds.make_configuration("nothing0")


def test_cyclone_describes_types_with_the_same_bytes_as_the_codec() -> None:
    """The independent types of the peer serialize to the bytes that the bridge sends."""
    from tests import ros2_peer as peer

    ros = load_ros_types()
    header = ros.header(1_500_000_000, "world")
    ours = ros.make(
        "sensor_msgs/msg/JointState", header=header, name=["a", "bc"],
        position=np.array([1.0, 2.0]), velocity=np.zeros(0), effort=np.zeros(0),
    )  # fmt: skip
    theirs = peer.JointState(
        peer.Header(peer.Time(1, 500_000_000), "world"), ["a", "bc"], [1.0, 2.0], [], []
    )
    assert ros.encode("sensor_msgs/msg/JointState", ours) == theirs.serialize(use_version_2=False)


NOW_NS, UNIX_NS = 5_000_000_000, 1_700_000_000_000_000_000


def message(kind: str, *, age_s: float = 0.0, frame: str = "world", **changes: Any) -> Any:
    stamp_ns = UNIX_NS - round(age_s * 1e9)
    stamp = SimpleNamespace(sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    header = SimpleNamespace(stamp=stamp, frame_id=frame)
    x, y, z = changes.get("xyz", SCENE.eyes.centre_world_m if kind == "eye" else (0.0, 0.01, 0.1))
    point = SimpleNamespace(x=x, y=y, z=z)
    if kind == "fingertip":
        return SimpleNamespace(header=header, point=point)
    qx, qy, qz, qw = changes.get("xyzw", (0.0, 0.0, 0.0, 1.0))
    orientation = SimpleNamespace(x=qx, y=qy, z=qz, w=qw)
    return SimpleNamespace(
        header=header, pose=SimpleNamespace(position=point, orientation=orientation)
    )


def make_inputs() -> ExternalInputs:
    inputs = ExternalInputs(noise_m=0.001)
    inputs.set_scene(SCENE)
    return inputs


@pytest.mark.parametrize(
    ("kind", "changes", "reason"),
    [
        ("eye", {"frame": "map"}, Rejection.WRONG_FRAME),
        ("eye", {"age_s": 1.0}, Rejection.TOO_OLD),
        ("eye", {"age_s": -0.1}, Rejection.IN_FUTURE),
        ("eye", {"xyz": (math.nan, 0.0, 0.5)}, Rejection.NOT_FINITE),
        ("eye", {"xyz": (0.0, 0.0, 9.0)}, Rejection.OUTSIDE_RANGE),
        ("eye", {"xyzw": (0.0, 0.0, 0.0, 0.0)}, Rejection.NOT_A_ROTATION),
        ("eye", {"xyzw": (0.0, math.inf, 0.0, 0.0)}, Rejection.NOT_FINITE),
        ("fingertip", {"frame": ""}, Rejection.WRONG_FRAME),
        ("fingertip", {"xyz": (0.0, math.inf, 0.0)}, Rejection.NOT_FINITE),
    ],
)
def test_implausible_inputs_are_rejected(
    kind: str, changes: dict[str, Any], reason: Rejection
) -> None:
    inputs = make_inputs()
    given = message(kind, **changes)
    assert inputs.convert(kind, lambda: given, NOW_NS, UNIX_NS) is None
    assert inputs.rejected == {reason: 1}


def test_malformed_bytes_repeated_stamps_and_a_missing_scene_are_rejected() -> None:
    inputs = make_inputs()
    ros = load_ros_types()
    decode = lambda: ros.decode("geometry_msgs/msg/PoseStamped", b"\0\1\0\0abc")  # noqa: E731
    assert inputs.convert("eye", decode, NOW_NS, UNIX_NS) is None
    assert inputs.convert("eye", lambda: message("eye"), NOW_NS, UNIX_NS) is not None
    assert inputs.convert("eye", lambda: message("eye"), NOW_NS, UNIX_NS) is None
    assert inputs.rejected == {Rejection.MALFORMED: 1, Rejection.NOT_NEWER: 1}
    without = ExternalInputs(noise_m=0.001)
    assert without.convert("eye", lambda: message("eye"), NOW_NS, UNIX_NS) is None
    assert without.rejected == {Rejection.NO_SCENE: 1}


def feed(inputs: ExternalInputs, positions: list[tuple[float, float, float]]) -> list[Fingertip]:
    """Give one fingertip every 10 ms; return the messages."""
    found = []
    for number, xyz in enumerate(positions):
        later_ns = number * 10_000_000
        given = message("fingertip", age_s=-later_ns * 1e-9, xyz=xyz)
        converted = inputs.convert(
            "fingertip", lambda given=given: given, NOW_NS + later_ns, UNIX_NS + later_ns
        )
        assert converted is not None
        made, at_ns = converted
        assert at_ns == NOW_NS + later_ns
        assert isinstance(made, Fingertip)
        found.append(made)
    return found


def test_a_fingertip_is_tracked_and_its_path_predicted() -> None:
    tips = feed(make_inputs(), [(0.0, 0.001 * number, 0.1) for number in range(40)])
    assert [one.reason for one in tips[:3]] == ["unconfirmed", "unconfirmed", "ok"]
    last = tips[-1]
    assert last.valid
    assert last.velocity_world_m_per_s == pytest.approx([0.0, 0.1, 0.0], abs=0.02)
    assert last.predicted_path_world_m[5] == pytest.approx([0.0, 0.044, 0.1], abs=0.003)


def test_a_jump_and_a_position_outside_the_volume_are_not_valid() -> None:
    still = [(0.0, 0.0, 0.1)] * 5
    jump = feed(make_inputs(), [*still, (0.1, 0.1, 0.1)])[-1]
    assert (jump.valid, jump.reason) == (False, "too_fast")
    outside = feed(make_inputs(), [*still, (0.0, 0.0, 5.0)])[-1]
    assert (outside.valid, outside.reason, outside.state) == (False, "outside_volume", "coasting")
    assert outside.position_world_m == pytest.approx([0.0, 0.0, 0.1], abs=1e-3)


def test_an_eye_keeps_position_and_direction() -> None:
    made = make_inputs().convert("eye", lambda: message("eye", age_s=0.02), NOW_NS, UNIX_NS)
    assert made is not None
    eye, at_ns = made
    assert isinstance(eye, Eye)
    assert at_ns == NOW_NS - 20_000_000
    assert eye.centre_world_m == pytest.approx(SCENE.eyes.centre_world_m)
    assert eye.right_world == pytest.approx([1.0, 0.0, 0.0])
