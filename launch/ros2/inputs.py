"""Check messages of external ROS nodes, and convert them to messages of flexsheet.

A message is rejected if its frame, numbers or timestamp are not plausible. External fingertip
positions are filtered by the same tracker as positions from the camera. External messages cannot
command the arms.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from flexsheet.launch.ros2.mapping import WORLD, RosTopic
from flexsheet.messages.base import Message
from flexsheet.messages.scene import Scene
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.external_input import (
    RejectedError,
    Rejection,
    check_finite,
    check_period,
    make_eye,
    rotate_x_axis,
)
from flexsheet.nodes.triangulator.external_fingertip import ExternalFingertip

MAX_AGE_S = 0.5
MAX_FUTURE_S = 0.005


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
                right = rotate_x_axis(np.array([q.x, q.y, q.z, q.w], dtype=np.float64))
                made: Message = make_eye(_read_xyz(message.pose.position), right, self.scene)
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
        check_period(at_ns, self._newest_ns.get(topic))
        return at_ns


def _read_xyz(vector: Any) -> Floats:
    return check_finite(np.array([vector.x, vector.y, vector.z], dtype=np.float64))
