"""Define the channels that live viewers can display, and make their messages from the graph.

A topic of the graph becomes a JSON channel of the same name. The other channels are:

    tf                                   poses of links, sheet target and fingertip
    apparatus, sheet, object, finger     the 3D scene
    joint_states                         joint angles, named as in the URDF model
    TOPIC/left, TOPIC/right, ...         images as JPEG
    TOPIC/left/calibration, ...          calibration of the stereo camera
    log                                  e-stops and notes of the nodes

In the frame `viewer`, z points up, as viewers expect. In the frame `world`, y points up.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from enum import Enum
from typing import Any, get_args

import cv2
import numpy as np
from foxglove import messages as fg

from flexsheet.launch.bags.export import list_images
from flexsheet.launch.ros2.mapping import SHEET_COLOUR, list_joints
from flexsheet.launch.viewing.apparatus_model import (
    WORLD,
    ApparatusModel,
    Colour,
    Joint,
    make_model,
)
from flexsheet.launch.viewing.foxglove_drawing import (
    SKIN_COLOUR,
    draw_ball,
    draw_finger,
    draw_mesh,
    make_colour,
    make_entity,
    make_estop_log,
    make_frame,
    make_pose,
    make_vector,
)
from flexsheet.launch.viewing.json_channel import make_schema, to_json
from flexsheet.messages.base import Message
from flexsheet.messages.scene import Lens, Scene
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
from flexsheet.nodes.models.camera import camera_matrix
from flexsheet.nodes.models.rigid import pose_matrix, rotation_from_vector, transform
from flexsheet.nodes.models.shapes.triangles import triangulate_grid

VIEWER = "viewer"
VIEWER_FROM_WORLD = transform(rotation_from_vector((0.5 * np.pi, 0.0, 0.0)), np.zeros(3))
EYE_COLOUR: Colour = (0.98, 0.98, 0.98, 1.0)
EYE_RADIUS_M = 0.011
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
class LiveState:
    """The latest message of each topic, and the model of the haptic display in the latest scene."""

    latest: dict[str, Message] = field(default_factory=dict)
    model: ApparatusModel | None = None
    joints: dict[str, Joint] = field(default_factory=dict)

    def update(self, topic: str, message: Message) -> None:
        self.latest[topic] = message
        if isinstance(message, Scene):
            self.model = make_model(message)
            self.joints = {joint.name: joint for joint in self.model.joints}

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
class LiveChannel:
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
    make: Callable[[LiveState, Message | None, Any], Any]
    kind: str = ""
    schema: dict[str, Any] | None = None


def list_channels(topics: list[Topic]) -> Iterator[LiveChannel]:
    """Yield the channels that can be made from the given topics of a graph."""
    written = {topic.name for topic in topics}
    arms = tuple(name for name in ("arm_left", "arm_right") if name in written)
    for topic in topics:
        yield LiveChannel(
            topic.name, (topic.name,), (topic.name,),
            Pace.NUMBERS if topic.rate_hz else Pace.EACH,
            lambda _, message, __: to_json(message),
            schema=make_schema(topic.message),
        )  # fmt: skip
        for suffix in _list_image_names(topic):
            yield LiveChannel(
                f"{topic.name}/{suffix}", (topic.name,), (topic.name,), Pace.IMAGES,
                _make_image_maker(topic.name, suffix), "CompressedImage",
            )  # fmt: skip
        if topic.message is StereoPair:
            for side in get_args(Side):
                yield LiveChannel(
                    f"{topic.name}/{side}/calibration", (), (), Pace.STATIC,
                    _make_calibration_maker(side), "CameraCalibration",
                )  # fmt: skip
    moving = (*arms, *(name for name in ("sheet_target", "fingertip") if name in written))
    yield LiveChannel("tf", moving, moving, Pace.EACH, _make_frames, "FrameTransforms")
    yield LiveChannel("tf_static", (), (), Pace.STATIC, _make_static_frames, "FrameTransforms")
    yield LiveChannel("apparatus", (), (), Pace.STATIC, _draw_apparatus, "SceneUpdate")
    yield LiveChannel("joint_states", arms, arms, Pace.EACH, _make_joint_states, "JointStates")
    if len(arms) == 2:
        needed = (*arms, *({"fingertip"} & written))
        yield LiveChannel("sheet", needed, arms[:1], Pace.IMAGES, _draw_sheet, "SceneUpdate")
    if "fingertip" in written:
        tip = ("fingertip",)
        yield LiveChannel("finger", tip, tip, Pace.NUMBERS, _draw_finger, "SceneUpdate")
    if "skin" in written:
        body = tuple(name for name in ("skin", "soft_body") if name in written)
        yield LiveChannel("object", body, body, Pace.IMAGES, _draw_object, "SceneUpdate")
    notes = tuple(name for name in ("estop", "status") if name in written)
    yield LiveChannel("log", notes, notes, Pace.EACH, _make_log, "Log")


def _list_image_names(topic: Topic) -> tuple[str, ...]:
    names: dict[type[Message], tuple[str, ...]] = {
        StereoPair: ("left", "right"),
        Frame: ("image",),
        TwinEye: ("seen", "expected"),
    }
    return names.get(topic.message, ())


def _make_image_maker(topic: str, suffix: str) -> Callable[..., Any]:
    frame = f"camera_{suffix}" if suffix in get_args(Side) else suffix

    def make(_: LiveState, message: Message | None, stamp: Any) -> Any:
        images = dict(list_images(topic, message)) if message is not None else {}
        image = images.get(f"{topic}/{suffix}")
        return None if image is None or not image.size else _compress(image, frame, stamp)

    return make


def _compress(image: Image, frame: str, stamp: Any) -> Any:
    stored = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    done, data = cv2.imencode(".jpg", stored, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    if not done:
        return None
    return fg.CompressedImage(
        timestamp=stamp, frame_id=frame, format="jpeg", data=np.asarray(data).tobytes()
    )


def _make_calibration_maker(side: Side) -> Callable[..., Any]:
    def make(state: LiveState, _: Message | None, stamp: Any) -> Any:
        if state.scene is None:
            return None
        camera = state.scene.camera
        lens: Lens = camera.left if side == "left" else camera.right
        matrix = camera_matrix(lens.fx_px, lens.fy_px, lens.cx_px, lens.cy_px)
        return fg.CameraCalibration(
            timestamp=stamp,
            frame_id=f"camera_{side}",
            width=camera.width_px,
            height=camera.height_px,
            distortion_model="plumb_bob",
            D=list(lens.distortion),
            K=matrix.ravel().tolist(),
            R=np.eye(3).ravel().tolist(),
            P=np.column_stack([matrix, np.zeros(3)]).ravel().tolist(),
        )

    return make


def _make_frames(state: LiveState, message: Message | None, stamp: Any) -> Any:
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


def _make_static_frames(state: LiveState, _: Message | None, stamp: Any) -> Any:
    frames = [make_frame(VIEWER, WORLD, VIEWER_FROM_WORLD, stamp)]
    for joint in state.model.joints if state.model else ():
        if joint.limit is None:
            frames.append(make_frame(joint.parent, joint.child, joint.parent_from_child, stamp))
    return fg.FrameTransforms(transforms=frames)


def _make_joint_states(_: LiveState, message: Message | None, stamp: Any) -> Any:
    if not isinstance(message, ArmState):
        return None
    named = zip(list_joints(message.side), message.joints_rad.tolist(), strict=True)
    joints = [fg.JointState(name=name, position=angle) for name, angle in named]
    return fg.JointStates(timestamp=stamp, joints=joints)


def _draw_apparatus(state: LiveState, _: Message | None, stamp: Any) -> Any:
    if state.model is None or state.scene is None:
        return None
    entities = []
    for link in state.model.links:
        if link.name == "screen" or not link.boxes:
            continue  # the sheet is drawn where it is
        cubes = [
            fg.CubePrimitive(
                pose=make_pose(transform(np.eye(3), box.centre_m)),
                size=make_vector(box.size_m),
                color=make_colour(box.colour),
            )
            for box in link.boxes
        ]
        entities.append(make_entity(link.name, stamp, link.name, frame_locked=True, cubes=cubes))
    eyes, half = state.scene.eyes, 0.5 * state.scene.eyes.interocular_m
    balls = [
        draw_ball(eyes.centre_world_m + np.array([x, 0.0, 0.0]), EYE_RADIUS_M, EYE_COLOUR)
        for x in (-half, half)
    ]
    entities.append(make_entity("eyes", stamp, spheres=balls))
    return fg.SceneUpdate(entities=entities)


def _draw_sheet(state: LiveState, _: Message | None, stamp: Any) -> Any:
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


def _draw_object(state: LiveState, _: Message | None, stamp: Any) -> Any:
    skin, body = state.latest.get("skin"), state.latest.get("soft_body")
    if not isinstance(skin, Skin):
        return None
    vertices = skin.vertices_world_m
    if isinstance(body, SoftBody) and body.mesh_id == skin.mesh_id:
        vertices = vertices + body.displacement_world_m
    return draw_mesh("object", vertices, skin.triangles, stamp, SKIN_COLOUR)


def _draw_finger(state: LiveState, message: Message | None, stamp: Any) -> Any:
    if not isinstance(message, Fingertip) or state.scene is None:
        return None
    return draw_finger(message, state.scene.finger.radius_m, stamp)


def _make_log(_: LiveState, message: Message | None, stamp: Any) -> Any:
    match message:
        case EStop():
            return make_estop_log(message, stamp, "estop")
        case Status() if message.state == "degraded" or message.notes:
            text = message.note_text or message.last_error or message.state
            level = fg.LogLevel.Warning
            return fg.Log(timestamp=stamp, level=level, message=text, name=message.node)
    return None
