"""Convert poses, surfaces and the finger to 3D messages of Foxglove, in the world frame.

The package foxglove-sdk is required.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from foxglove import messages as fg
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from flexsheet.launch.viewing.apparatus_model import WORLD, Colour
from flexsheet.messages.types import EStop, Fingertip
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.models.rigid import transform

SKIN_COLOUR: Colour = (0.84, 0.38, 0.33, 1.0)
FINGER_COLOUR: Colour = (0.30, 0.65, 0.45, 1.0)
LOST_COLOUR: Colour = (0.60, 0.60, 0.60, 0.5)
PATH_WIDTH_M = 0.001


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
    return fg.SceneUpdate(entities=[make_entity(name, stamp, triangles=[surface])])


def draw_finger(message: Fingertip, radius_m: float, stamp: Any) -> Any:
    """Make a Foxglove scene update that draws the fingertip and its predicted path.

    The fingertip is drawn as a sphere.
    """
    colour = FINGER_COLOUR if message.valid else LOST_COLOUR
    path = fg.LinePrimitive(
        type=fg.LinePrimitiveLineType.LineStrip,
        thickness=PATH_WIDTH_M,
        points=_make_points(message.predicted_path_world_m),
        color=make_colour(colour),
    )
    ball = draw_ball(message.position_world_m, radius_m, colour)
    return fg.SceneUpdate(entities=[make_entity("finger", stamp, spheres=[ball], lines=[path])])


def draw_ball(centre_m: Floats, radius_m: float, rgba: Colour) -> Any:
    pose = make_pose(transform(np.eye(3), centre_m))
    size = make_vector((2 * radius_m,) * 3)
    return fg.SpherePrimitive(pose=pose, size=size, color=make_colour(rgba))


def make_entity(name: str, stamp: Any, frame: str = WORLD, **shapes: Any) -> Any:
    return fg.SceneEntity(timestamp=stamp, frame_id=frame, id=name, **shapes)


def make_estop_log(message: EStop, stamp: Any, topic: str) -> Any:
    """Make a Foxglove log entry about an e-stop or its reset."""
    level = fg.LogLevel.Fatal if message.engaged else fg.LogLevel.Info
    text = f"e-stop {'engaged' if message.engaged else 'reset'}: {message.reason}"
    return fg.Log(timestamp=stamp, level=level, message=text, name=topic)


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
