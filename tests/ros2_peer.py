"""Independent DDS participant of ROS 2, for tests; it shares no code with the bridge.

python ros2_peer.py DOMAIN

Its types are written by hand from the public message definitions. It prints each received message
as a line of JSON.
"""

# No postponed annotations: IdlStruct reads the types of the fields.
import json
import sys
from dataclasses import dataclass
from typing import Any

from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication
from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import float64, int32, sequence, uint8, uint32
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration


@dataclass
class Time(IdlStruct, typename="builtin_interfaces::msg::dds_::Time_"):
    sec: int32
    nanosec: uint32


@dataclass
class Header(IdlStruct, typename="std_msgs::msg::dds_::Header_"):
    stamp: Time
    frame_id: str


@dataclass
class Point(IdlStruct, typename="geometry_msgs::msg::dds_::Point_"):
    x: float64
    y: float64
    z: float64


@dataclass
class Vector3(IdlStruct, typename="geometry_msgs::msg::dds_::Vector3_"):
    x: float64
    y: float64
    z: float64


@dataclass
class Quaternion(IdlStruct, typename="geometry_msgs::msg::dds_::Quaternion_"):
    x: float64
    y: float64
    z: float64
    w: float64


@dataclass
class PointStamped(IdlStruct, typename="geometry_msgs::msg::dds_::PointStamped_"):
    header: Header
    point: Point


@dataclass
class JointState(IdlStruct, typename="sensor_msgs::msg::dds_::JointState_"):
    header: Header
    name: sequence[str]
    position: sequence[float64]
    velocity: sequence[float64]
    effort: sequence[float64]


@dataclass
class Transform(IdlStruct, typename="geometry_msgs::msg::dds_::Transform_"):
    translation: Vector3
    rotation: Quaternion


@dataclass
class TransformStamped(IdlStruct, typename="geometry_msgs::msg::dds_::TransformStamped_"):
    header: Header
    child_frame_id: str
    transform: Transform


@dataclass
class TFMessage(IdlStruct, typename="tf2_msgs::msg::dds_::TFMessage_"):
    transforms: sequence[TransformStamped]


@dataclass
class Image(IdlStruct, typename="sensor_msgs::msg::dds_::Image_"):
    header: Header
    height: uint32
    width: uint32
    encoding: str
    is_bigendian: uint8
    step: uint32
    data: sequence[uint8]


@dataclass
class String(IdlStruct, typename="std_msgs::msg::dds_::String_"):
    data: str


def find_stamp(value: Any) -> int:
    return int(value.stamp.sec) * 10**9 + value.stamp.nanosec


def describe(name: str, message: Any) -> dict[str, Any]:
    match message:
        case PointStamped():
            point = message.point
            return {"at_ns": find_stamp(message.header), "frame": message.header.frame_id,
                    "xyz": [point.x, point.y, point.z]}  # fmt: skip
        case JointState():
            return {"names": list(message.name), "position": list(message.position)}
        case TFMessage():
            return {"frames": [one.child_frame_id for one in message.transforms]}
        case Image():
            return {"size": [message.width, message.height], "data": list(message.data)}
        case String():
            return {"data": message.data}
    raise AssertionError(name)


RELIABLE = Qos(
    Policy.Reliability.Reliable(duration(seconds=1)),
    Policy.History.KeepLast(10),
    Policy.DataRepresentation(use_cdrv0_representation=True),
)
LATCHED = Qos(Policy.Durability.TransientLocal, base=RELIABLE)
READ = {
    "rt/fingertip/point": (PointStamped, RELIABLE),
    "rt/joint_states": (JointState, RELIABLE),
    "rt/tf": (TFMessage, RELIABLE),
    "rt/tf_static": (TFMessage, LATCHED),
    "rt/stereo/left/image_raw": (Image, RELIABLE),
    "rt/flexsheet/fingertip": (String, RELIABLE),
}


def main() -> None:
    participant = DomainParticipant(int(sys.argv[1]))
    readers = {
        name: DataReader(participant, Topic(participant, name, kind), qos)
        for name, (kind, qos) in READ.items()
    }
    endpoints = BuiltinDataReader(participant, BuiltinTopicDcpsPublication)
    print(json.dumps({"topic": "ready"}), flush=True)
    while True:
        for one in endpoints.take(N=100):
            if hasattr(one, "topic_name") and one.topic_name.startswith("rt/"):
                user_data = one.qos[Policy.Userdata]
                found = {"name": one.topic_name, "type": one.type_name,
                         "hash": user_data.data.decode() if user_data else ""}  # fmt: skip
                print(json.dumps({"topic": "endpoint", **found}), flush=True)
        for name, reader in readers.items():
            for message in reader.take_iter(timeout=duration(milliseconds=2)):
                print(json.dumps({"topic": name, **describe(name, message)}), flush=True)


if __name__ == "__main__":
    main()
