"""Test the bridge to ROS 2 with a DDS participant that shares no code with it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flexsheet.launch.plans.plan import load_graph
from flexsheet.launch.running.supervisor import RunningGraph
from flexsheet.launch.running.tools import GraphWriter
from tests.example_bag import LEFT, RECORDED, TIP, arm
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


class Peer:
    """Process of the independent participant, and what it has received by topic."""

    def __init__(self) -> None:
        self.found: dict[str, list[dict[str, Any]]] = {}
        environment = {**os.environ, "CYCLONEDDS_URI": PEER_CONFIGURATION}
        self._process = subprocess.Popen(
            [sys.executable, ROOT / "tests" / "ros2_peer.py", str(DOMAIN)],
            stdout=subprocess.PIPE, text=True, env=environment,
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

    def close(self) -> None:
        self._process.kill()
        self._process.wait()
        self._thread.join()
        assert self._process.stdout is not None
        self._process.stdout.close()


@asynccontextmanager
async def bridged(
    folder: Path, topics: list[str]
) -> AsyncIterator[tuple[Peer, Callable[..., None]]]:
    """Run a graph, the bridge and the peer; yield the function that publishes in the graph."""
    launch_file = folder / "graph.yaml"
    launch_file.write_text(
        f"scene: {ROOT}/launch/scenes/cylinder.yaml\n"
        "nodes: {beacon: {type: 'tests.launch_nodes:Beacon'}}\n"
        f"external_topics: [{', '.join(topics)}]\n"
    )
    peer = Peer()
    try:
        async with RunningGraph(load_graph(launch_file)) as graph:
            participant = dds.RosParticipant(DOMAIN)
            bridge = Ros2Bridge(
                graph.plan, graph.run, participant, topics=["scene", *topics],
                on_problem=pytest.fail,
            )  # fmt: skip
            writer = GraphWriter(graph.plan, graph.run, topics)
            try:
                bridge.start()
                await until(lambda: peer.has("ready"), "the peer")
                await until(lambda: peer.has("rt/tf_static"), "the latched scene")
                yield peer, writer.publish
            finally:
                writer.close()
                bridge.close()
    finally:
        peer.close()


async def test_ros_sees_arms_fingertip_and_images(tmp_path: Path) -> None:
    stereo = next(message for topic, message in RECORDED if topic == "stereo")
    joints = np.arange(6.0)
    state = arm("right", 0.1).model_copy(update={"joints_rad": joints})
    async with bridged(tmp_path, ["fingertip", "arm_right", "stereo"]) as (peer, publish):
        found = peer.found

        def all_arrived() -> bool:
            publish("fingertip", fingertip(TIP))
            publish("arm_right", state)
            publish("stereo", stereo)
            names = ("rt/fingertip/point", "rt/joint_states", "rt/stereo/left/image_raw",
                     "rt/flexsheet/fingertip")  # fmt: skip
            frames = {frame for one in found.get("rt/tf", []) for frame in one["frames"]}
            return peer.has(*names) and {"fingertip", "right_flange_measured"} <= frames

        await until(all_arrived, found, period_s=0.05)
    point = found["rt/fingertip/point"][0]
    assert (point["xyz"], point["frame"]) == (TIP.tolist(), "world")
    assert abs(time.time_ns() - point["at_ns"]) < 60 * 10**9, "stamps count from 1970"
    assert json.loads(found["rt/flexsheet/fingertip"][0]["data"])["state"] == "tracking"
    assert found["rt/joint_states"][0]["position"] == joints.tolist()
    assert found["rt/joint_states"][0]["names"][5] == "right_joint_6"
    image = found["rt/stereo/left/image_raw"][0]
    assert (image["size"], image["data"]) == ([4, 3], LEFT.ravel().tolist())
    assert "camera_left" in found["rt/tf_static"][0]["frames"]
    endpoints = {one["name"]: one for one in found["endpoint"]}
    assert endpoints["rt/joint_states"]["type"] == "sensor_msgs::msg::dds_::JointState_"
    assert endpoints["rt/tf"]["type"] == "tf2_msgs::msg::dds_::TFMessage_"
    assert endpoints["rt/joint_states"]["hash"] == f"typehash={JOINT_STATE_HASH};"


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
