"""Map topics of flexsheet to topics of ROS 2, for exported bags and for the live bridge.

`VIEWS` lists the ROS topics with types for the usual tools. In addition, each topic is published as
`flexsheet/TOPIC`, a std_msgs/String with the fields as JSON, without arrays of over 64 values.

The frame `world` has the following child frames: `object`, `camera_left`, `camera_right`,
`projector`, `left_base`, `right_base`, `left_flange_measured`, `right_flange_measured`, `sheet`,
`fingertip`. The measured flanges have their own names, because a robot model in ROS computes
flanges from joint angles.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from flexsheet.launch.viewing.json_channel import to_json
from flexsheet.messages.base import Header, Message
from flexsheet.messages.clock_table import shift_stamps
from flexsheet.messages.errors import FlexsheetError
from flexsheet.messages.scene import Lens, Scene
from flexsheet.messages.topics import TOPICS, Delivery, Topic
from flexsheet.messages.types import (
    ArmState,
    EStop,
    Fingertip,
    Frame,
    SheetTarget,
    Side,
    Skin,
    SoftBody,
    StereoPair,
    TwinEye,
    TwinFinger,
)
from flexsheet.nodes.arrays import Floats, Image, Singles
from flexsheet.nodes.models.camera import camera_matrix
from flexsheet.nodes.models.rigid import (
    inverse,
    pose_matrix,
    quaternion_from_rotation,
    transform,
)

OWN_PREFIX = "/flexsheet/"
WORLD = "world"
JOINTS = 6
CONTEXT_TOPICS = frozenset({"scene", "skin"})
"""The topics whose latest messages are needed to convert messages of other topics."""

OWN_TYPE = "std_msgs/msg/String"
_FLOAT32 = 7


class Ros2Error(FlexsheetError, RuntimeError):
    """Raised if messages cannot be exchanged with ROS 2."""

    remedy = "Install the packages of the extra `flexsheet[ros2]`, or correct the named value."


def split_time(at_ns: int) -> dict[str, int]:
    """Split a time (ns since 1970) into the fields of a ROS time.

    Raises Ros2Error if the time is before 1970 or after 2038, because ROS 2 cannot represent it.
    """
    seconds, nanoseconds = divmod(at_ns, 1_000_000_000)
    if not 0 <= seconds < 1 << 31:
        raise Ros2Error(
            f"the timestamp {at_ns} ns is outside the range of ROS 2 (1970 to 2038); "
            "check the bag with `flexsheet bag info`"
        )
    return {"sec": seconds, "nanosec": nanoseconds}


class RosTypes:
    """A codec for ROS 2 messages in the CDR format."""

    def __init__(self) -> None:
        from rosbags.typesys import Stores, get_typestore

        # Humble and later releases have the same definitions of these types.
        self.store = get_typestore(Stores.ROS2_JAZZY)

    def make(self, kind: str, /, **fields: Any) -> Any:
        """Make a ROS message of the type `kind`, such as `std_msgs/msg/Bool`."""
        return self.store.types[kind](**fields)

    def encode(self, name: str, message: Any) -> bytes:
        """Serialize a message to CDR bytes, including the encapsulation header of four bytes."""
        return bytes(self.store.serialize_cdr(message, name))

    def stamp(self, at_ns: int) -> Any:
        return self.make("builtin_interfaces/msg/Time", **split_time(at_ns))

    def header(self, at_ns: int, frame: str = WORLD) -> Any:
        return self.make("std_msgs/msg/Header", stamp=self.stamp(at_ns), frame_id=frame)

    def xyz(self, values: Any, kind: str = "Vector3") -> Any:
        x, y, z = (float(value) for value in values)
        return self.make(f"geometry_msgs/msg/{kind}", x=x, y=y, z=z)

    def quaternion(self, rotation: Floats) -> Any:
        w, x, y, z = quaternion_from_rotation(rotation).tolist()
        return self.make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)

    def pose(self, matrix: Floats) -> Any:
        return self.make(
            "geometry_msgs/msg/Pose",
            position=self.xyz(matrix[:3, 3], "Point"),
            orientation=self.quaternion(matrix[:3, :3]),
        )


@cache
def load_ros_types() -> RosTypes:
    """Return the ROS types; the first call loads them, which takes about half a second."""
    return RosTypes()


@dataclass(slots=True)
class Source:
    """The data that the conversion of a message needs in addition to the message.

    topic: topic of the message.
    at_ns: source timestamp of the message, ns since 1970.
    scene, skin: latest messages with the scene and the surface of the soft body. They are None
        before the first message.
    """

    ros: RosTypes
    topic: str
    at_ns: int
    scene: Scene | None
    skin: Skin | None

    def stamped(self, kind: str, name: str, value: Any, frame: str = WORLD) -> Any:
        """Make a ROS message that consists of a header and one other field.

        The header contains the source timestamp of the flexsheet message.

        kind: ROS type of the message.
        name, value: name and value of the other field.
        """
        header = self.ros.header(self.at_ns, frame)
        return self.ros.make(kind, **{"header": header, name: value})


@dataclass(frozen=True, slots=True)
class View:
    """A ROS topic with a standard type that represents some fields of a message.

    message: type of the message.
    fields: names of the fields.
    name: name of the ROS topic, except for the first slash. In the name, {topic} represents the
        flexsheet topic.
    make: function that converts a message, or returns None if there is nothing to publish.
    """

    message: type[Message]
    fields: str
    name: str
    ros_type: str
    make: Callable[[Any, Source], Any | None]
    latched: bool = False


@dataclass(frozen=True, slots=True)
class RosTopic:
    """A ROS 2 topic.

    name: name of the topic, which begins with a slash.
    latched: whether readers that connect later receive the last message.
    """

    name: str
    ros_type: str
    latched: bool


def _image(select: Callable[[Any], tuple[Image, str] | None]) -> Any:
    def make(message: Any, source: Source) -> Any | None:
        found = select(message)
        if found is None:
            return None
        image, frame = found
        height, width = image.shape[:2]
        channels = 1 if image.ndim == 2 else image.shape[2]
        return source.ros.make(
            "sensor_msgs/msg/Image",
            header=source.ros.header(source.at_ns, frame),
            height=height,
            width=width,
            encoding="mono8" if channels == 1 else "rgb8",
            is_bigendian=0,
            step=width * channels,
            data=np.ravel(image),
        )

    return make


def _camera_info(side: Side) -> Callable[[StereoPair, Source], Any | None]:
    def make(pair: StereoPair, source: Source) -> Any | None:
        if source.scene is None:
            return None
        camera = source.scene.camera
        lens: Lens = getattr(camera, side)
        column, row = getattr(pair, f"{side}_origin_px")
        height, width = getattr(pair, side).shape
        matrix = camera_matrix(lens.fx_px, lens.fy_px, lens.cx_px, lens.cy_px)
        cropped = (height, width) != (camera.height_px, camera.width_px)
        roi = {"x_offset": column, "y_offset": row, "height": height, "width": width}
        if not cropped:  # In ROS, a region of interest of zeros means the whole image.
            roi = dict.fromkeys(roi, 0)
        return source.ros.make(
            "sensor_msgs/msg/CameraInfo",
            header=source.ros.header(source.at_ns, f"camera_{side}"),
            height=camera.height_px,
            width=camera.width_px,
            distortion_model="plumb_bob",
            d=np.array(lens.distortion),
            k=matrix.ravel(),
            r=np.eye(3).ravel(),
            p=np.column_stack([matrix, np.zeros(3)]).ravel(),
            binning_x=0,
            binning_y=0,
            roi=source.ros.make("sensor_msgs/msg/RegionOfInterest", **roi, do_rectify=False),
        )

    return make


def _frames(source: Source, world_from: dict[str, Floats]) -> Any:
    ros = source.ros
    transforms = [
        ros.make(
            "geometry_msgs/msg/TransformStamped",
            header=ros.header(source.at_ns),
            child_frame_id=name,
            transform=ros.make(
                "geometry_msgs/msg/Transform",
                translation=ros.xyz(matrix[:3, 3]),
                rotation=ros.quaternion(matrix[:3, :3]),
            ),
        )
        for name, matrix in world_from.items()
    ]
    return ros.make("tf2_msgs/msg/TFMessage", transforms=transforms)


def _static_frames(scene: Scene, source: Source) -> Any:
    world_from_left = pose_matrix(scene.camera.world_from_left)
    world_from = {
        "object": pose_matrix(scene.object.world_from_object),
        "left_base": pose_matrix(scene.arms.left.world_from_base),
        "right_base": pose_matrix(scene.arms.right.world_from_base),
        "camera_left": world_from_left,
        "camera_right": world_from_left @ inverse(scene.camera.right_from_left),
    }
    if scene.projector is not None:
        world_from["projector"] = pose_matrix(scene.projector.world_from_projector)
    return _frames(source, world_from)


def _point(source: Source, position: Floats) -> Any:
    return source.stamped(
        "geometry_msgs/msg/PointStamped", "point", source.ros.xyz(position, "Point")
    )


def _pose(source: Source, matrix: Floats) -> Any:
    return source.stamped("geometry_msgs/msg/PoseStamped", "pose", source.ros.pose(matrix))


def _force(body: SoftBody, source: Source) -> Any:
    ros = source.ros
    force = ros.xyz(body.force_world_n)
    wrench = ros.make("geometry_msgs/msg/Wrench", force=force, torque=ros.xyz(np.zeros(3)))
    return source.stamped("geometry_msgs/msg/WrenchStamped", "wrench", wrench)


def list_joints(side: str) -> list[str]:
    """Return the names of the joints of the left or right arm, from the base to the flange."""
    return [f"{side}_joint_{number}" for number in range(1, JOINTS + 1)]


def _joint_states(arm: ArmState, source: Source) -> Any:
    return source.ros.make(
        "sensor_msgs/msg/JointState",
        header=source.ros.header(source.at_ns, ""),
        name=list_joints(arm.side),
        position=arm.joints_rad,
        velocity=np.zeros(0),
        effort=np.zeros(0),
    )


def _fingertip_frame(fingertip: Fingertip, source: Source) -> Any | None:
    if not fingertip.valid:
        return None
    return _frames(source, {"fingertip": transform(np.eye(3), fingertip.position_world_m)})


def _points(source: Source, points: Singles) -> Any:
    kind = "sensor_msgs/msg/PointField"
    fields = [
        source.ros.make(kind, name=name, offset=4 * i, datatype=_FLOAT32, count=1)
        for i, name in enumerate("xyz")
    ]
    return source.ros.make(
        "sensor_msgs/msg/PointCloud2",
        header=source.ros.header(source.at_ns),
        height=1,
        width=len(points),
        fields=fields,
        is_bigendian=False,
        point_step=12,
        row_step=12 * len(points),
        data=np.ascontiguousarray(points, dtype="<f4").view(np.uint8).ravel(),
        is_dense=True,
    )


def _deformed_points(body: SoftBody, source: Source) -> Any | None:
    if source.skin is None or source.skin.mesh_id != body.mesh_id:
        return None
    return _points(source, source.skin.vertices_world_m + body.displacement_world_m)


_IMAGE, _TF = "sensor_msgs/msg/Image", "tf2_msgs/msg/TFMessage"
_POINT, _CLOUD = "geometry_msgs/msg/PointStamped", "sensor_msgs/msg/PointCloud2"

VIEWS = (
    View(Scene, "poses of camera, projector, arms, object", "tf_static", _TF, _static_frames,
         latched=True),
    View(StereoPair, "left", "{topic}/left/image_raw", _IMAGE,
         _image(lambda pair: (pair.left, "camera_left"))),
    View(StereoPair, "right", "{topic}/right/image_raw", _IMAGE,
         _image(lambda pair: (pair.right, "camera_right"))),
    View(StereoPair, "left_origin_px, scene.camera.left", "{topic}/left/camera_info",
         "sensor_msgs/msg/CameraInfo", _camera_info("left")),
    View(StereoPair, "right_origin_px, scene.camera.right", "{topic}/right/camera_info",
         "sensor_msgs/msg/CameraInfo", _camera_info("right")),
    View(Fingertip, "position_world_m", "{topic}/point", _POINT,
         lambda tip, source: _point(source, tip.position_world_m) if tip.valid else None),
    View(Fingertip, "position_world_m", "tf", _TF, _fingertip_frame),
    View(SheetTarget, "world_from_sheet", "{topic}/pose", "geometry_msgs/msg/PoseStamped",
         lambda target, source: _pose(source, target.world_from_sheet)),
    View(SheetTarget, "world_from_sheet", "tf", _TF,
         lambda target, source: _frames(source, {"sheet": target.world_from_sheet})),
    View(ArmState, "joints_rad", "joint_states", "sensor_msgs/msg/JointState", _joint_states),
    View(ArmState, "world_from_flange", "tf", _TF,
         lambda arm, source: _frames(
             source, {f"{arm.side}_flange_measured": arm.world_from_flange})),
    View(Skin, "vertices_world_m", "{topic}/points", _CLOUD,
         lambda skin, source: _points(source, skin.vertices_world_m), latched=True),
    View(SoftBody, "displacement_world_m", "{topic}/points", _CLOUD, _deformed_points),
    View(SoftBody, "force_world_n", "{topic}/force", "geometry_msgs/msg/WrenchStamped", _force),
    View(Frame, "pixels", "{topic}/image", _IMAGE,
         _image(lambda frame: (frame.pixels[0], "projector") if frame.pixels else None)),
    View(EStop, "engaged", "{topic}/engaged", "std_msgs/msg/Bool",
         lambda estop, source: source.ros.make("std_msgs/msg/Bool", data=estop.engaged),
         latched=True),
    View(TwinFinger, "position_world_m", "{topic}/point", _POINT,
         lambda finger, source: _point(source, finger.position_world_m)),
    View(TwinEye, "seen", "{topic}/seen", _IMAGE, _image(lambda eye: (eye.seen, "eye"))),
    View(TwinEye, "expected", "{topic}/expected", _IMAGE,
         _image(lambda eye: (eye.expected, "eye"))),
)  # fmt: skip


@cache
def list_ros_topics(topic: Topic) -> list[tuple[RosTopic, View | None]]:
    """Return the ROS topics to which the messages of a flexsheet topic are converted.

    The first topics have standard ROS types. Each is returned with the `View` that defines its
    conversion. The last topic contains the fields as JSON, and None instead of a view.
    """
    found: list[tuple[RosTopic, View | None]] = [
        (RosTopic("/" + view.name.format(topic=topic.name), view.ros_type, view.latched), view)
        for view in VIEWS
        if view.message is topic.message
    ]
    latched = topic.delivery is Delivery.LATCHED
    found.append((RosTopic(OWN_PREFIX + topic.name, OWN_TYPE, latched), None))
    return found


@dataclass(slots=True)
class Converter:
    """A converter of the messages of one graph to ROS 2.

    The latest scene and skin are stored, because later conversions need them.
    """

    ros: RosTypes
    scene: Scene | None = None
    skin: Skin | None = None

    def convert(
        self,
        topic: str,
        message: Message,
        header: Header,
        shift_ns: int,
        wanted: Callable[[RosTopic], bool] = lambda _: True,
    ) -> Iterator[tuple[RosTopic, Any]]:
        """Convert a message, and yield pairs of a ROS topic and a ROS message.

        shift_ns: offset that converts the header's timestamps to the time since 1970.
        wanted: function that returns whether messages of a ROS topic are needed.
        """
        match message:
            case Scene():
                self.scene = message
            case Skin():
                self.skin = message
        at_ns = max(0, header.source_ns + shift_ns)
        message = shift_stamps(message, shift_ns)
        source = Source(self.ros, topic, at_ns, self.scene, self.skin)
        for ros_topic, view in list_ros_topics(TOPICS[topic]):
            if not wanted(ros_topic):
                continue
            if view is not None:
                made = view.make(message, source)
            else:
                fields = to_json(message)
                head = {"source_ns": at_ns, "writer": header.writer, "sequence": header.sequence}
                made = self.ros.make(OWN_TYPE, data=json.dumps({"header": head, **fields}))
            if made is not None:
                yield ros_topic, made
