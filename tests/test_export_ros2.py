"""Test bags that were exported for ROS 2 with readers that are independent of the writer."""

from __future__ import annotations

import json
import re
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from ruamel.yaml import YAML

from flexsheet.launch.bags.export import ExportError, export
from flexsheet.launch.ros2.mapping import Ros2Error, list_ros_topics
from flexsheet.messages.bag import BagWriter
from flexsheet.messages.base import Header, Message
from flexsheet.messages.topics import TOPICS
from flexsheet.messages.types import Eye, Force, TwinEye, TwinFinger
from flexsheet.nodes.models.rigid import rotation_from_rpy
from tests.commands import Command
from tests.example_bag import (
    DENT,
    LEFT,
    RECORDED,
    SCENE,
    STARTED_NS,
    STEP_NS,
    TIP,
    VERTICES,
    arm,
    write_example,
)

pytest.importorskip("rosbags")
ros2_decoder = pytest.importorskip("mcap_ros2.decoder")

export_ros2 = partial(export, form="ros2")
STARTED_UNIX_NS = 1795341600 * 10**9
COLOUR = np.arange(24, dtype=np.uint8).reshape(2, 4, 3)
FURTHER: tuple[tuple[str, Message], ...] = (
    ("eye", Eye(valid=True, centre_world_m=np.array([0.1, 0.2, 0.9]),
                right_world=np.array([0.0, 2.0, 0.0]))),
    ("force", Force(valid=True, force_n=3.0, standard_deviation_n=0.1)),
    ("twin/finger", TwinFinger(path_label="a", path_done=False, path_time_s=1.0,
                               position_world_m=TIP, velocity_world_m_per_s=2 * TIP,
                               force_world_n=3 * TIP)),
    ("twin/eye", TwinEye(label="b", correction="none", metres_per_px=0.001, seen=COLOUR,
                         expected=COLOUR + 1)),
    ("arm_left", arm("left", -0.15).model_copy(
        update={"command_sent_ns": STARTED_NS, "joints_commanded_rad": np.arange(6.0)})),
)  # fmt: skip


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    return write_example(tmp_path / "bag.mcap", RECORDED + FURTHER)


def opened(path: Path) -> dict[str, list[tuple[int, Any]]]:
    """Return (time, message) per topic, decoded with the definitions in the file."""
    found: dict[str, list[tuple[int, Any]]] = {}
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[ros2_decoder.DecoderFactory()])
        for schema, channel, message, decoded in reader.iter_decoded_messages():
            assert schema is not None
            assert (schema.encoding, channel.message_encoding) == ("ros2msg", "cdr")
            found.setdefault(channel.topic, []).append((message.log_time, decoded))
    return found


def at_ns(header: Any) -> int:
    return int(header.stamp.sec * 10**9 + header.stamp.nanosec)


def test_an_independent_reader_finds_all_values(bag: Path, tmp_path: Path) -> None:
    result = export_ros2(bag, tmp_path / "out.mcap")
    found = opened(result.output)
    assert result.messages == {name: len(values) for name, values in found.items()}

    log_ns, point = found["/fingertip/point"][0]
    tip_ns = STARTED_UNIX_NS + 2 * STEP_NS
    assert (log_ns, at_ns(point.header), point.header.frame_id) == (tip_ns, tip_ns, "world")
    assert (point.point.x, point.point.y, point.point.z) == tuple(TIP)
    joints = [state for _, state in found["/joint_states"]]
    assert joints[0].name == [f"left_joint_{number}" for number in range(1, 7)]
    assert joints[1].name[0] == "right_joint_1"
    frames = {one.child_frame_id: one for _, tf in found["/tf"] for one in tf.transforms}
    assert frames.keys() == {"fingertip", "left_flange_measured", "right_flange_measured"}
    assert frames["left_flange_measured"].transform.translation.x == -0.15

    image = found["/stereo/left/image_raw"][0][1]
    assert (image.width, image.height, image.step, image.encoding) == (4, 3, 4, "mono8")
    assert bytes(image.data) == LEFT.tobytes()
    info = found["/stereo/right/camera_info"][0][1]
    assert (info.k[0], info.p[2]) == (SCENE.camera.right.fx_px, SCENE.camera.right.cx_px)
    assert (info.roi.width, info.roi.height) == (4, 3)
    assert bytes(found["/twin/eye/expected"][0][1].data) == (COLOUR + 1).tobytes()

    cloud = found["/soft_body/points"][0][1]
    points = np.frombuffer(bytes(cloud.data), np.float32).reshape(-1, 3)
    assert points.tolist() == (VERTICES + DENT).tolist()
    assert found["/soft_body/force"][0][1].wrench.force.z == 0.0
    point = found["/twin/finger/point"][0][1].point
    assert (point.x, point.y, point.z) == tuple(TIP)
    assert found["/estop/engaged"][0][1].data is True


def test_static_frames_are_those_of_the_scene(bag: Path, tmp_path: Path) -> None:
    found = opened(export_ros2(bag, tmp_path / "out.mcap").output)
    frames = {one.child_frame_id: one.transform for one in found["/tf_static"][0][1].transforms}
    assert frames.keys() == {
        "object", "left_base", "right_base", "camera_left", "camera_right", "projector",
    }  # fmt: skip
    base = SCENE.arms.left.world_from_base
    translation = frames["left_base"].translation
    assert [translation.x, translation.y, translation.z] == base.position_m.tolist()
    q = frames["left_base"].rotation
    rotation = rotation_of(q)
    assert rotation == pytest.approx(rotation_from_rpy(base.rpy_rad))
    # A point at the right camera's centre has the coordinates of the stereo calibration's inverse.
    right, left = (frames[f"camera_{side}"].translation for side in ("right", "left"))
    between = np.linalg.norm([right.x - left.x, right.y - left.y, right.z - left.z])
    assert between == pytest.approx(np.linalg.norm(SCENE.camera.right_from_left[:3, 3]))


def rotation_of(q: Any) -> np.ndarray:
    """Return the matrix of a quaternion, by the formula of Hamilton's product."""
    x, y, z, w = q.x, q.y, q.z, q.w
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def test_all_fields_are_json(bag: Path, tmp_path: Path) -> None:
    found = opened(export_ros2(bag, tmp_path / "out.mcap").output)
    tip = json.loads(found["/flexsheet/fingertip"][0][1].data)
    assert tip["header"] == {
        "source_ns": STARTED_UNIX_NS + 2 * STEP_NS, "writer": "node", "sequence": 1
    }  # fmt: skip
    assert tip["state"] == "tracking"
    assert tip["covariance"] == pytest.approx(np.eye(6).ravel() * 1e-8)
    scene = json.loads(found["/flexsheet/scene"][0][1].data)
    assert scene["sheet"]["width_m"] == SCENE.sheet.width_m
    assert scene["object"]["geometry"]["shape"] == "cylinder"
    arm_state = json.loads(found["/flexsheet/arm_left"][1][1].data)
    assert arm_state["command_sent_ns"] == STARTED_UNIX_NS
    assert arm_state["edge_distance_m"] == 0.24
    assert "command_age_s" not in arm_state


def test_names_of_ros_topics_are_valid_and_have_one_type() -> None:
    types: dict[str, str] = {}
    for topic in TOPICS.values():
        for ros_topic, _ in list_ros_topics(topic):
            assert re.fullmatch(r"(/[a-z](_?[a-z0-9]+)*)+", ros_topic.name)
            assert types.setdefault(ros_topic.name, ros_topic.ros_type) == ros_topic.ros_type


def test_the_folder_is_a_bag_of_ros_2(bag: Path, tmp_path: Path) -> None:
    output = export_ros2(bag, tmp_path / "session").output
    metadata = YAML(typ="safe").load(output / "metadata.yaml")["rosbag2_bagfile_information"]
    assert (metadata["storage_identifier"], metadata["version"]) == ("mcap", 8)
    assert metadata["relative_file_paths"] == ["session.mcap"]
    assert metadata["starting_time"]["nanoseconds_since_epoch"] == STARTED_UNIX_NS
    topics = {
        one["topic_metadata"]["name"]: one["topic_metadata"]
        for one in metadata["topics_with_message_count"]
    }
    assert topics["/joint_states"]["type"] == "sensor_msgs/msg/JointState"
    assert {one["serialization_format"] for one in topics.values()} == {"cdr"}
    latched = YAML(typ="safe").load(topics["/tf_static"]["offered_qos_profiles"])[0]
    assert (latched["durability"], latched["reliability"]) == (1, 1)
    with (output / "session.mcap").open("rb") as file:
        reader = make_reader(file)
        assert reader.get_header().profile == "ros2"
        schemas = reader.get_summary().schemas.values()  # type: ignore[union-attr]
        assert {schema.encoding for schema in schemas} == {"ros2msg"}


def test_selected_topics_still_know_the_scene(bag: Path, tmp_path: Path) -> None:
    found = opened(export_ros2(bag, tmp_path / "out.mcap", topics=["stereo"]).output)
    assert "/stereo/left/camera_info" in found
    assert "/tf_static" not in found


def test_a_time_that_ros_cannot_represent_is_refused(tmp_path: Path) -> None:
    bag = tmp_path / "late.mcap"
    with BagWriter(bag, {"recording": {"clock_id": "c"}}) as writer:
        header = Header(1, 2**62, 2**62, "c", "node", 1)
        writer.write(TOPICS["eye"], FURTHER[0][1], header, 2**62)
    with pytest.raises(Ros2Error, match="1970 to 2038"):
        export_ros2(bag, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_an_existing_output_stays(bag: Path, tmp_path: Path) -> None:
    output = tmp_path / "out"
    output.mkdir()
    with pytest.raises(ExportError, match="exists already"):
        export_ros2(bag, output)
    assert list(output.iterdir()) == []


def test_the_command(bag: Path, tmp_path: Path, flexsheet: Command) -> None:
    output = tmp_path / "out"
    printed = flexsheet("bag", "export", bag, "--format", "ros2", "-o", output, "--json")
    assert printed.code == 0
    assert printed.json()["messages"]["/fingertip/point"] == 1
