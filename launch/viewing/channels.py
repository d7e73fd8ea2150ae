"""Define the channels of Foxglove for topics, and make their messages, live and in exported bags.

A topic becomes a JSON channel of the same name. The other channels are:

    tf, tf_static                        poses of links, sheet target and fingertip
    sheet, object, finger                the 3D scene
    TOPIC/left, TOPIC/right, ...         images as JPEG
    log                                  e-stops and notes of the nodes

In the frame `viewer`, z points up, as viewers expect. In the frame `world`, y points up.

The package foxglove-sdk is required.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from enum import Enum
from typing import Any, get_args

import cv2
import foxglove
import numpy as np
from foxglove import messages as fg
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from flexsheet.launch.ros2.mapping import list_joints
from flexsheet.launch.viewing.apparatus_model import WORLD, Colour, Joint, make_model
from flexsheet.launch.viewing.json_channel import make_schema, to_json
from flexsheet.messages.base import Message
from flexsheet.messages.scene import Scene
from flexsheet.messages.topics import Topic
from flexsheet.messages.types import (
    ArmState,
    EStop,
    Fingertip,
    Frame,
    SheetTarget,
    Side,
    Skin,
    SoftBody,
    Status,
    StereoPair,
    TwinEye,
)
from flexsheet.nodes.arrays import Floats, Image
from flexsheet.nodes.console.sheet import COLUMNS, ROWS, compute_sheet_points
from flexsheet.nodes.models.rigid import pose_matrix, rotation_from_vector, transform
from flexsheet.nodes.models.shapes.triangles import triangulate_grid

VIEWER = "viewer"
VIEWER_FROM_WORLD = transform(rotation_from_vector((0.5 * np.pi, 0.0, 0.0)), np.zeros(3))
SKIN_COLOUR: Colour = (0.84, 0.38, 0.33, 1.0)
SHEET_COLOUR: Colour = (0.93, 0.93, 0.90, 0.6)
FINGER_COLOUR: Colour = (0.30, 0.65, 0.45, 1.0)
LOST_COLOUR: Colour = (0.60, 0.60, 0.60, 0.5)
PATH_WIDTH_M = 0.001
SHEET_STEP = 2
"""The step with which rows and columns of the sheet's mesh are selected for viewers."""
JPEG_QUALITY = 80


class Pace(Enum):
    """The maximum rate of a channel.

    NUMBERS, IMAGES: the configured maximum rate of numbers or of images.
    EACH: the rate is not limited; each message is sent.
    STATIC: a message is sent when the scene changes, and once per second for viewers that connect
        later.
    """

    NUMBERS = "numbers"
    IMAGES = "images"
    EACH = "each"
    STATIC = "static"


@dataclass(slots=True)
class ViewState:
    """The latest message of each topic, and the joints of the arms in the latest scene."""

    latest: dict[str, Message] = field(default_factory=dict)
    joints: dict[str, Joint] = field(default_factory=dict)

    def update(self, topic: str, message: Message) -> None:
        self.latest[topic] = message
        if isinstance(message, Scene):
            self.joints = {joint.name: joint for joint in make_model(message).joints}

    @property
    def scene(self) -> Scene | None:
        found = self.latest.get("scene")
        return found if isinstance(found, Scene) else None

    @property
    def fingertip(self) -> Fingertip | None:
        found = self.latest.get("fingertip")
        return found if isinstance(found, Fingertip) else None

    def edges(self) -> tuple[Floats, Floats] | None:
        """Return the world poses (4, 4) of the sheet's left and right edge.

        Returns None if a pose is unknown.
        """
        scene, found = self.scene, []
        for side in get_args(Side):
            state = self.latest.get(f"arm_{side}")
            if scene is None or not isinstance(state, ArmState):
                return None
            arm = scene.arms.left if side == "left" else scene.arms.right
            found.append(state.world_from_flange @ pose_matrix(arm.flange_from_edge))
        return found[0], found[1]


@dataclass(frozen=True, slots=True)
class Channel:
    """A channel that viewers can display.

    topics: topics that the channel needs in addition to the scene.
    triggers: topics that cause the channel to send a message.
    make: function (state, received message, timestamp) that returns a message of the channel. It
        returns None if there is nothing to send.
    kind: Foxglove type of the messages. It is empty if the messages are JSON.
    schema: JSON Schema of JSON messages.
    """

    name: str
    topics: tuple[str, ...]
    triggers: tuple[str, ...]
    pace: Pace
    make: Callable[[ViewState, Message | None, Any], Any]
    kind: str = ""
    schema: dict[str, Any] | None = None


def list_channels(topics: list[Topic]) -> Iterator[Channel]:
    """Yield the channels that can be made from the given topics of a graph."""
    written = {topic.name for topic in topics}
    arms = tuple(name for name in ("arm_left", "arm_right") if name in written)
    for topic in topics:
        yield Channel(
            topic.name, (topic.name,), (topic.name,),
            Pace.NUMBERS if topic.rate_hz else Pace.EACH,
            lambda _, message, __: to_json(message),
            schema=make_schema(topic.message),
        )  # fmt: skip
        for suffix in IMAGES.get(topic.message, ()):
            yield Channel(
                f"{topic.name}/{suffix}", (topic.name,), (topic.name,), Pace.IMAGES,
                _make_image_maker(suffix), "CompressedImage",
            )  # fmt: skip
    moving = (*arms, *(name for name in ("sheet_target", "fingertip") if name in written))
    yield Channel("tf", moving, moving, Pace.EACH, _make_frames, "FrameTransforms")
    scene = ("scene",)
    yield Channel("tf_static", (), scene, Pace.STATIC, _make_static_frames, "FrameTransforms")
    if len(arms) == 2:
        needed = (*arms, *({"fingertip"} & written))
        yield Channel("sheet", needed, arms[1:], Pace.IMAGES, _draw_sheet, "SceneUpdate")
    if "fingertip" in written:
        tip = ("fingertip",)
        yield Channel("finger", tip, tip, Pace.NUMBERS, _draw_finger, "SceneUpdate")
    if "skin" in written:
        body = tuple(name for name in ("skin", "soft_body") if name in written)
        yield Channel("object", body, body, Pace.IMAGES, _draw_object, "SceneUpdate")
    notes = tuple(name for name in ("estop", "status") if name in written)
    yield Channel("log", notes, notes, Pace.EACH, _make_log, "Log")


IMAGES: dict[type[Message], tuple[str, ...]] = {
    StereoPair: ("left", "right"),
    Frame: ("image",),
    TwinEye: ("seen", "expected"),
}
"""The images in a message, by the suffix of the channel."""


def _make_image_maker(suffix: str) -> Callable[..., Any]:
    frame = f"camera_{suffix}" if suffix in get_args(Side) else suffix

    def make(_: ViewState, message: Any, stamp: Any) -> Any:
        if isinstance(message, Frame):
            return _compress(message.pixels[0], frame, stamp) if message.pixels else None
        image: Image = getattr(message, suffix)
        return _compress(image, frame, stamp) if image.size else None

    return make


def _compress(image: Image, frame: str, stamp: Any) -> Any:
    stored = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    done, data = cv2.imencode(".jpg", stored, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    if not done:
        return None
    return fg.CompressedImage(
        timestamp=stamp, frame_id=frame, format="jpeg", data=np.asarray(data).tobytes()
    )


def _make_frames(state: ViewState, message: Message | None, stamp: Any) -> Any:
    match message:
        case ArmState() if state.joints:
            named = zip(list_joints(message.side), message.joints_rad.tolist(), strict=True)
            frames = []
            for joint, angle in ((state.joints[name], angle) for name, angle in named):
                frames.append(make_frame(joint.parent, joint.child, joint.pose(angle), stamp))
        case SheetTarget():
            frames = [make_frame(WORLD, "sheet", message.world_from_sheet, stamp)]
        case Fingertip() if message.valid:
            pose = transform(np.eye(3), message.position_world_m)
            frames = [make_frame(WORLD, "fingertip", pose, stamp)]
        case _:
            return None
    return fg.FrameTransforms(transforms=frames)


def _make_static_frames(state: ViewState, _: Message | None, stamp: Any) -> Any:
    frames = [make_frame(VIEWER, WORLD, VIEWER_FROM_WORLD, stamp)]
    for joint in state.joints.values():
        if joint.limit is None:
            frames.append(make_frame(joint.parent, joint.child, joint.parent_from_child, stamp))
    return fg.FrameTransforms(transforms=frames)


def _draw_sheet(state: ViewState, _: Message | None, stamp: Any) -> Any:
    scene, edges, tip = state.scene, state.edges(), state.fingertip
    if scene is None or edges is None:
        return None
    points = compute_sheet_points(
        *edges,
        height_m=scene.sheet.height_m,
        fingertip=tip.position_world_m if tip is not None and tip.valid else None,
        finger_radius_m=scene.finger.radius_m,
    )
    if points is None:
        return None
    grid = points.reshape(ROWS, COLUMNS, 3)[::SHEET_STEP, ::SHEET_STEP]
    triangles = triangulate_grid(*grid.shape[:2])
    return draw_mesh("sheet", grid.reshape(-1, 3), triangles, stamp, SHEET_COLOUR)


def _draw_object(state: ViewState, _: Message | None, stamp: Any) -> Any:
    skin, body = state.latest.get("skin"), state.latest.get("soft_body")
    if not isinstance(skin, Skin):
        return None
    vertices = skin.vertices_world_m
    if isinstance(body, SoftBody) and body.mesh_id == skin.mesh_id:
        vertices = vertices + body.displacement_world_m
    return draw_mesh("object", vertices, skin.triangles, stamp, SKIN_COLOUR)


def _draw_finger(state: ViewState, message: Message | None, stamp: Any) -> Any:
    if not isinstance(message, Fingertip) or state.scene is None:
        return None
    colour = make_colour(FINGER_COLOUR if message.valid else LOST_COLOUR)
    path = fg.LinePrimitive(
        type=fg.LinePrimitiveLineType.LineStrip,
        thickness=PATH_WIDTH_M,
        points=_make_points(message.predicted_path_world_m),
        color=colour,
    )
    pose = make_pose(transform(np.eye(3), message.position_world_m))
    size = make_vector((2 * state.scene.finger.radius_m,) * 3)
    ball = fg.SpherePrimitive(pose=pose, size=size, color=colour)
    return make_update("finger", stamp, spheres=[ball], lines=[path])


def _make_log(_: ViewState, message: Message | None, stamp: Any) -> Any:
    match message:
        case EStop():
            level = fg.LogLevel.Fatal if message.engaged else fg.LogLevel.Info
            text = f"e-stop {'engaged' if message.engaged else 'reset'}: {message.reason}"
            return fg.Log(timestamp=stamp, level=level, message=text, name="estop")
        case Status() if message.state == "degraded" or message.notes:
            text = message.note_text or message.last_error or message.state
            level = fg.LogLevel.Warning
            return fg.Log(timestamp=stamp, level=level, message=text, name=message.node)
    return None


def open_channel(channel: Channel, context: Any) -> Any:
    """Open a channel of the Foxglove library, to which messages are logged."""
    if channel.schema is None:
        kind = getattr(foxglove.channels, f"{channel.kind}Channel")
        return kind(channel.name, context=context)
    schema = foxglove.Schema(
        name=f"flexsheet.{channel.schema['title']}",
        encoding="jsonschema",
        data=json.dumps(channel.schema).encode(),
    )
    return foxglove.Channel(channel.name, schema=schema, message_encoding="json", context=context)


def make_stamp(at_ns: int) -> Any:
    """Convert a time (ns since 1970) to a Foxglove timestamp."""
    return fg.Timestamp(sec=at_ns // 1_000_000_000, nsec=at_ns % 1_000_000_000)


def make_frame(parent: str, child: str, parent_from_child: Floats, stamp: Any) -> Any:
    """Make the Foxglove transform between two frames.

    parent_from_child: pose (4, 4) of the child frame in the parent frame.
    """
    return fg.FrameTransform(
        timestamp=stamp,
        parent_frame_id=parent,
        child_frame_id=child,
        translation=make_vector(parent_from_child[:3, 3]),
        rotation=_make_rotation(parent_from_child),
    )


def draw_mesh(
    name: str, vertices: NDArray[Any], triangles: NDArray[Any], stamp: Any, rgba: Colour
) -> Any:
    """Make a Foxglove scene update that draws a triangle mesh.

    vertices: positions (n, 3) of n vertices, m.
    triangles: vertex indices (k, 3) of k triangles.
    """
    surface = fg.TriangleListPrimitive(
        pose=make_pose(np.eye(4)),
        points=_make_points(vertices),
        indices=triangles.ravel().tolist(),
        color=make_colour(rgba),
    )
    return make_update(name, stamp, triangles=[surface])


def make_update(name: str, stamp: Any, **shapes: Any) -> Any:
    """Make a Foxglove scene update with one entity in the world frame."""
    entity = fg.SceneEntity(timestamp=stamp, frame_id=WORLD, id=name, **shapes)
    return fg.SceneUpdate(entities=[entity])


def make_pose(matrix: Floats) -> Any:
    return fg.Pose(position=make_vector(matrix[:3, 3]), orientation=_make_rotation(matrix))


def make_vector(vector: Any) -> Any:
    x, y, z = map(float, vector)
    return fg.Vector3(x=x, y=y, z=z)


def make_colour(rgba: Colour) -> Any:
    red, green, blue, opacity = rgba
    return fg.Color(r=red, g=green, b=blue, a=opacity)


def _make_rotation(matrix: Floats) -> Any:
    x, y, z, w = Rotation.from_matrix(matrix[:3, :3]).as_quat().tolist()
    return fg.Quaternion(x=x, y=y, z=z, w=w)


def _make_points(points: NDArray[Any]) -> list[Any]:
    return [fg.Point3(x=x, y=y, z=z) for x, y, z in points.tolist()]
