"""Compute the boxes that represent the arm links on the console page, and the poses of the links.

The lengths of the boxes come from the model of the arm in the scene. Their thicknesses are
approximate. A box is fixed in the frame of its link, whose origin is on the axis of the joint that
moves the link. The frame of the last link is the flange frame.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flexsheet.messages.scene import RV_1A, ClosedFormArm, JointChain
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.models.rigid import pose_matrix, rotation_from_vector, transform


@dataclass(frozen=True, slots=True)
class Piece:
    """A box that represents a part of a link, with size and centre (m) in the link's frame.

    link: index of the link, where 0 is the base.
    dark: whether the box has the darker colour.
    """

    link: int
    size_m: tuple[float, float, float]
    centre_m: tuple[float, float, float]
    dark: bool = False


PIECES = (
    Piece(0, (0.19, 0.19, 0.13), (-0.01, 0.0, 0.065), dark=True),
    Piece(1, (0.13, 0.13, 0.13), (0.0, 0.0, 0.195)),
    Piece(1, (0.105, 0.15, 0.105), (0.0, 0.0, 0.3)),
    Piece(2, (0.085, 0.085, 0.2), (0.0, 0.0, 0.13)),
    Piece(2, (0.1, 0.12, 0.09), (0.0, 0.0, 0.25), dark=True),
    Piece(3, (0.12, 0.08, 0.08), (-0.05, 0.0, 0.0)),
    Piece(3, (0.07, 0.07, 0.13), (-0.09, 0.0, 0.085)),
    Piece(4, (0.06, 0.075, 0.06), (0.0, 0.0, 0.0), dark=True),
    Piece(5, (0.05, 0.05, 0.062), (0.0, 0.0, 0.035)),
    Piece(6, (0.044, 0.044, 0.012), (0.0, 0.0, -0.006), dark=True),
)
"""The boxes that represent the links of a Mitsubishi RV-1A."""

LINK_WIDTH_M = 0.07
"""The width of the boxes that represent the links of all other arm models."""

BRACKET_WIDTH_M = 0.012
"""The width of the drawn bar between a flange and its clamp."""

CLAMP_SIZE_M = (0.012, 1.04, 0.012)
"""The size of the drawn clamp: width (m), ratio of the clamp's length to the edge length, and
thickness (m)."""


def compute_link_poses(
    world_from_base: Floats, joints_rad: Floats, model: ClosedFormArm | JointChain
) -> Floats:
    """Compute the world poses (7, 4, 4) of the base and the six links of an arm.

    world_from_base: pose (4, 4) of the base.
    joints_rad: joint angles (6,).

    The last pose is the pose of the flange.
    """
    chain = model.chain() if isinstance(model, ClosedFormArm) else model
    poses = [world_from_base]
    for origin, axis, angle_rad in zip(chain.origins, chain.axes, joints_rad.tolist(), strict=True):
        turn = transform(rotation_from_vector(angle_rad * np.asarray(axis)), (0.0, 0.0, 0.0))
        poses.append(poses[-1] @ pose_matrix(origin) @ turn)
    poses[-1] = poses[-1] @ pose_matrix(chain.flange)
    return np.stack(poses)


def make_pieces(model: ClosedFormArm | JointChain) -> tuple[Piece, ...]:
    """Return the pieces (boxes) that represent an arm.

    If `PIECES` does not describe the arm, each box connects two successive joints.
    """
    if model == RV_1A:
        return PIECES
    chain = model.chain() if isinstance(model, ClosedFormArm) else model
    pieces = []
    for link, origin in enumerate(chain.origins):
        x, y, z = (float(one) for one in origin.position_m)
        size_m = (abs(x) + LINK_WIDTH_M, abs(y) + LINK_WIDTH_M, abs(z) + LINK_WIDTH_M)
        pieces.append(Piece(link, size_m, (0.5 * x, 0.5 * y, 0.5 * z), dark=link % 2 == 0))
    return (*pieces, Piece(6, (0.05, 0.05, 0.02), (0.0, 0.0, -0.01), dark=True))
