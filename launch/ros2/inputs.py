"""Check messages of external ROS nodes, and convert them to messages of flexsheet.

A message is rejected if its frame, numbers or timestamp are not plausible. External fingertip
positions are filtered by the same tracker as positions from the camera. External messages cannot
command the arms.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

import numpy as np

from flexsheet.launch.ros2.mapping import WORLD, RosTopic
from flexsheet.messages.base import Message
from flexsheet.messages.scene import Scene
from flexsheet.messages.types import Eye
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.triangulator.external_fingertip import ExternalFingertip

MAX_AGE_S = 0.5
MAX_FUTURE_S = 0.005

MAX_EYE_OFFSET_M = 1.0
"""The maximum distance (m) of an external eye position from the eye position in the scene."""

MIN_PERIOD_S = 0.001
"""The minimum time (s) between two accepted messages of one input."""

QUATERNION_TOLERANCE = 1e-3


class Rejection(StrEnum):
    """The reason why an external message is rejected."""

    NO_SCENE = "no_scene"
    MALFORMED = "malformed"
    WRONG_FRAME = "wrong_frame"
    NOT_FINITE = "not_finite"
    NOT_A_ROTATION = "not_a_rotation"
    TOO_OLD = "too_old"
    IN_FUTURE = "in_future"
    NOT_NEWER = "not_newer"
    OUTSIDE_RANGE = "outside_range"


class RejectedError(ValueError):
    """Raised if an external message must not enter the graph."""

    def __init__(self, reason: Rejection) -> None:
        super().__init__(reason.value)
        self.reason = reason


@dataclass(frozen=True, slots=True)
class RosInput:
    """A ROS topic whose messages can be converted and published on a topic of flexsheet."""

    topic: str
    ros_topic: RosTopic
    about: str


INPUTS = {
    "eye": RosInput("eye", RosTopic("/external/eye", "geometry_msgs/msg/PoseStamped", False),
                    "midpoint between the eyes; x points from the left to the right eye"),
    "fingertip": RosInput("fingertip",
                          RosTopic("/external/fingertip", "geometry_msgs/msg/PointStamped", False),
                          "point of the finger's pad that touches the sheet"),
}  # fmt: skip
"""The supported ROS inputs. Each key is the flexsheet topic on which the input is published."""


@dataclass(slots=True)
class ExternalInputs:
    """A converter of external messages that rejects implausible messages.

    noise_m: standard deviation of external fingertip positions.
    rejected: numbers of rejected messages by reason.
    """

    noise_m: float
    scene: Scene | None = None
    rejected: Counter[Rejection] = field(default_factory=Counter)
    _newest_ns: dict[str, int] = field(default_factory=dict)
    _finger: ExternalFingertip | None = None

    def set_scene(self, scene: Scene) -> None:
        self.scene = scene
        self._finger = ExternalFingertip(scene, self.noise_m)

    def convert(
        self, topic: str, decode: Callable[[], Any], now_ns: int, unix_ns: int
    ) -> tuple[Message, int] | None:
        """Convert a ROS message to a flexsheet message, and return it with its source timestamp.

        The timestamp (ns) is on the local clock. If the message is rejected, for example because
        its bytes are malformed, the rejection is counted and None is returned.

        decode: function that returns the ROS message, or raises an exception if the bytes are
            malformed.
        now_ns: current time of the local clock.
        unix_ns: current time since 1970, ns.
        """
        try:
            if self.scene is None:
                raise RejectedError(Rejection.NO_SCENE)
            try:
                message = decode()
            except Exception as error:  # Untrusted bytes can cause any exception in the decoder.
                raise RejectedError(Rejection.MALFORMED) from error
            at_ns = self._check_header(topic, message.header, now_ns, unix_ns)
            if topic == "eye":
                q = message.pose.orientation
                right = _rotate_x_axis(np.array([q.x, q.y, q.z, q.w], dtype=np.float64))
                made: Message = _make_eye(_read_xyz(message.pose.position), right, self.scene)
            else:
                assert self._finger is not None
                made = self._finger.update(at_ns, _read_xyz(message.point))
        except RejectedError as error:
            self.rejected[error.reason] += 1
            return None
        self._newest_ns[topic] = at_ns
        return made, at_ns

    def _check_header(self, topic: str, header: Any, now_ns: int, unix_ns: int) -> int:
        """Return the timestamp (ns) of a header on the local clock.

        Raises RejectedError if the frame or the timestamp is invalid.
        """
        if header.frame_id != WORLD:
            raise RejectedError(Rejection.WRONG_FRAME)
        stamp_ns = int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)
        age_ns = unix_ns - stamp_ns
        if age_ns > MAX_AGE_S * 1e9:
            raise RejectedError(Rejection.TOO_OLD)
        if age_ns < -MAX_FUTURE_S * 1e9:
            raise RejectedError(Rejection.IN_FUTURE)
        at_ns = min(now_ns, now_ns - age_ns)
        newest_ns = self._newest_ns.get(topic)
        if newest_ns is not None and at_ns < newest_ns + MIN_PERIOD_S * 1e9:
            raise RejectedError(Rejection.NOT_NEWER)
        return at_ns


def _read_xyz(vector: Any) -> Floats:
    return _check_finite(np.array([vector.x, vector.y, vector.z], dtype=np.float64))


def _check_finite(values: Floats) -> Floats:
    """Raise RejectedError if a value is not finite; otherwise return the values."""
    if not np.isfinite(values).all():
        raise RejectedError(Rejection.NOT_FINITE)
    return values


def _rotate_x_axis(quaternion: Floats) -> Floats:
    """Rotate the x axis by a quaternion (x, y, z, w), and return the rotated axis (3,).

    Raises RejectedError unless the length of the quaternion is 1 within QUATERNION_TOLERANCE.
    """
    length = float(np.linalg.norm(_check_finite(quaternion)))
    if abs(length - 1.0) > QUATERNION_TOLERANCE:
        raise RejectedError(Rejection.NOT_A_ROTATION)
    x, y, z, w = quaternion / length
    return np.array([1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w)])


def _make_eye(centre_world_m: Floats, right_world: Floats, scene: Scene) -> Eye:
    """Make a message with the position of the user's eyes.

    centre_world_m: midpoint (3,) of the eyes.
    right_world: direction (3,) from the left to the right eye, of any length except zero.

    Raises RejectedError if the position is not finite, or too far from the eye position in the
    scene.
    """
    _check_finite(centre_world_m)
    if np.linalg.norm(centre_world_m - scene.eyes.centre_world_m) > MAX_EYE_OFFSET_M:
        raise RejectedError(Rejection.OUTSIDE_RANGE)
    return Eye(valid=True, centre_world_m=centre_world_m, right_world=right_world)
