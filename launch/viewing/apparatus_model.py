"""Describe the arms, cameras, projector and sheet of a scene by links and joints, as in URDF.

Each arm has the links `SIDE_base`, `SIDE_link_1` to `SIDE_link_6`, `SIDE_flange` and `SIDE_clamp`,
where SIDE is `left` or `right`. The other links are `world`, `camera_left`, `camera_right`,
and `projector`. The movable joints are `SIDE_joint_1` to `SIDE_joint_6`. The model
contains only geometry, because masses and torques are unknown.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import get_args

import numpy as np

from flexsheet.launch.ros2.mapping import list_joints
from flexsheet.messages.scene import ClosedFormArm, Projector, Scene
from flexsheet.messages.types import Side
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.console.arms import BRACKET_WIDTH_M, CLAMP_SIZE_M, make_pieces
from flexsheet.nodes.models.rigid import inverse, pose_matrix, rotation_from_vector, transform

Vector = tuple[float, float, float]
Colour = tuple[float, float, float, float]

WORLD = "world"
LIGHT: Colour = (0.87, 0.89, 0.91, 1.0)
DARK: Colour = (0.29, 0.33, 0.41, 1.0)
LENS: Colour = (0.0, 0.42, 0.58, 1.0)

CAMERA_BODY_M: Vector = (0.05, 0.035, 0.045)
"""The size (x, y, z), in metres, of the drawn housing of a camera behind the lens."""
PROJECTOR_BODY_M: Vector = (0.16, 0.07, 0.12)
LENS_LENGTH_M = 0.01


@dataclass(frozen=True, slots=True)
class Box:
    """A box that represents a part of a link.

    The size and centre are in m in the link's frame; the colour is RGBA (0 to 1).
    """

    size_m: Vector
    centre_m: Vector
    colour: Colour


@dataclass(frozen=True, slots=True)
class Link:
    """A rigid part of the haptic display, represented by boxes."""

    name: str
    boxes: tuple[Box, ...] = ()


@dataclass(frozen=True, slots=True)
class JointLimit:
    """The axis (in the frame of the child link), range and maximum speed of a revolute joint."""

    axis: Vector
    min_rad: float
    max_rad: float
    max_speed_rad_per_s: float


@dataclass(frozen=True, slots=True)
class Joint:
    """A joint between two links.

    parent_from_child: pose (4, 4) of the child at joint angle zero.
    limit: axis and range of a revolute joint. It is None if the joint is fixed.
    """

    name: str
    parent: str
    child: str
    parent_from_child: Floats
    limit: JointLimit | None = None

    def pose(self, angle_rad: float) -> Floats:
        """Return the pose (4, 4) of the child link.

        If the joint is fixed, the angle has no effect.
        """
        if self.limit is None:
            return self.parent_from_child
        rotation = rotation_from_vector(angle_rad * np.array(self.limit.axis))
        return self.parent_from_child @ transform(rotation, np.zeros(3))


@dataclass(frozen=True, slots=True)
class ApparatusModel:
    """The links and joints of the haptic display. Parent links precede their child links."""

    name: str
    links: tuple[Link, ...]
    joints: tuple[Joint, ...]


def make_model(scene: Scene) -> ApparatusModel:
    """Return a model of both arms with clamps, the stereo camera and the projector.

    The joint angles of the model are equal to the readings of the joint encoders.
    """
    links, joints = [Link(WORLD)], []
    for side in get_args(Side):
        for joint, link in _make_arm(scene, side):
            joints.append(joint)
            links.append(link)
    for name, world_from_device, boxes in _list_devices(scene):
        joints.append(Joint(f"{name}_mount", WORLD, name, world_from_device))
        links.append(Link(name, boxes))
    return ApparatusModel(scene.name, tuple(links), tuple(joints))


def _make_arm(scene: Scene, side: Side) -> Iterator[tuple[Joint, Link]]:
    """Yield the links of an arm, from base to clamp, with the joints to their parents."""
    arm = scene.arms.left if side == "left" else scene.arms.right
    chain = arm.model.chain() if isinstance(arm.model, ClosedFormArm) else arm.model
    numbered = [f"{side}_link_{number}" for number in range(1, 7)]
    names = [f"{side}_base", *numbered, f"{side}_flange"]
    boxes: list[list[Box]] = [[] for _ in names]
    for piece in make_pieces(arm.model):
        # The pieces of the last link belong to the flange.
        link = piece.link if piece.link < len(numbered) else -1
        boxes[link].append(Box(piece.size_m, piece.centre_m, DARK if piece.dark else LIGHT))
    bracket = np.asarray(arm.flange_from_edge.position_m)
    bracket_size = (BRACKET_WIDTH_M + np.abs(bracket)).tolist()
    boxes[-1].append(Box(tuple(bracket_size), tuple((0.5 * bracket).tolist()), DARK))
    mount = Joint(f"{side}_mount", WORLD, names[0], pose_matrix(arm.world_from_base))
    yield mount, Link(names[0], tuple(boxes[0]))
    for i, name in enumerate(list_joints(side)):
        x, y, z = chain.axes[i].tolist()
        # The encoder reads zero when the joint angle equals its offset.
        offset = rotation_from_vector(arm.joint_offsets_rad[i] * chain.axes[i])
        limit = JointLimit((x, y, z), chain.min_rad[i], chain.max_rad[i], chain.speed_rad_per_s[i])
        pose = pose_matrix(chain.origins[i]) @ transform(offset, np.zeros(3))
        yield (
            Joint(name, names[i], names[i + 1], pose, limit),
            Link(names[i + 1], tuple(boxes[i + 1])),
        )
    yield (
        Joint(f"{side}_flange_mount", names[-2], names[-1], pose_matrix(chain.flange)),
        Link(names[-1], tuple(boxes[-1])),
    )
    across, along, through = CLAMP_SIZE_M
    clamp = Box((across, along * scene.sheet.height_m, through), (0.0, 0.0, 0.0), DARK)
    yield (
        Joint(f"{side}_clamp_mount", names[-1], f"{side}_clamp", pose_matrix(arm.flange_from_edge)),
        Link(f"{side}_clamp", (clamp,)),
    )


def _list_devices(scene: Scene) -> Iterator[tuple[str, Floats, tuple[Box, ...]]]:
    """Yield the name, world pose (4, 4) and boxes of each camera and the projector."""
    left = pose_matrix(scene.camera.world_from_left)
    yield "camera_left", left, _make_device(CAMERA_BODY_M, 0.02)
    right = left @ inverse(np.asarray(scene.camera.right_from_left))
    yield "camera_right", right, _make_device(CAMERA_BODY_M, 0.02)
    projector: Projector | None = scene.projector
    if projector is not None:
        pose = pose_matrix(projector.world_from_projector)
        yield "projector", pose, _make_device(PROJECTOR_BODY_M, 0.04)


def _make_device(body_m: Vector, lens_m: float) -> tuple[Box, ...]:
    """Return boxes for the housing and the lens of a device that faces +z.

    The centre of the lens is the origin.

    body_m: size of the housing.
    lens_m: width of the lens.
    """
    depth_m = body_m[2]
    return (
        Box(body_m, (0.0, 0.0, -0.5 * (depth_m + LENS_LENGTH_M)), DARK),
        Box((lens_m, lens_m, LENS_LENGTH_M), (0.0, 0.0, 0.0), LENS),
    )
