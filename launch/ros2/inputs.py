"""Check messages of external ROS nodes, and convert them to messages of flexsheet.

The messages are not trusted: one is rejected unless its frame, numbers and timestamp are plausible.
External fingertips are filtered by the same tracker as those from the camera. No external message
commands the arms directly.
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
from flexsheet.messages.types import Eye, Fingertip, FingertipReason
from flexsheet.nodes.triangulator.adaptive import TRACKING_METHODS
from flexsheet.nodes.triangulator.node import PREDICTION_STEP_S
from flexsheet.nodes.triangulator.parameters import TriangulatorParameters
from flexsheet.nodes.triangulator.tracking import Tracker, TrackingSettings

MAX_AGE_S = 0.5
MAX_FUTURE_S = 0.005
MIN_PERIOD_S = 0.001
MAX_EYE_OFFSET_M = 1.0
"""Maximum distance of an external eye position from that in the scene."""

QUATERNION_TOLERANCE = 1e-3


class Rejection(StrEnum):
    """Reason for rejecting an external message."""

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
    """Raised for an external message that must not enter the graph."""

    def __init__(self, reason: Rejection) -> None:
        super().__init__(reason.value)
        self.reason = reason


@dataclass(frozen=True, slots=True)
class RosInput:
    """ROS topic whose messages may be converted and published on a topic of flexsheet."""

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
"""Possible external inputs, by the flexsheet topic on which they are published."""


@dataclass(slots=True)
class ExternalInputs:
    """Checker and converter of external messages.

    noise_m: standard deviation of external fingertip positions. rejected: numbers of rejected
    messages by reason.
    """

    noise_m: float
    scene: Scene | None = None
    rejected: Counter[Rejection] = field(default_factory=Counter)
    _newest_ns: dict[str, int] = field(default_factory=dict)
    _tracker: Tracker | None = None

    def set_scene(self, scene: Scene) -> None:
        self.scene = scene
        limits = TriangulatorParameters()
        settings = TrackingSettings(
            max_speed_m_per_s=scene.finger.max_speed_m_per_s,
            max_acceleration_m_per_s2=limits.max_acceleration_m_per_s2,
            track_timeout_s=limits.track_timeout_s,
            confirm_frames=limits.confirm_frames,
        )
        method = TRACKING_METHODS[scene.methods.tracking or "adaptive"]
        self._tracker = Tracker(method(scene.finger.max_speed_m_per_s), settings)

    def convert(
        self, topic: str, decode: Callable[[], Any], now_ns: int, unix_ns: int
    ) -> tuple[Message, int] | None:
        """Convert a ROS message; return it with its source timestamp on the local clock, ns.

        Returns None if the message is rejected. decode: function that returns the ROS message, or
        raises an exception for malformed bytes. now_ns: present time of the local clock. unix_ns:
        present time since 1970.
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
                made: Message = self._make_eye(message.pose, self.scene)
            else:
                made = self._make_fingertip(message.point, at_ns, self.scene)
        except RejectedError as error:
            self.rejected[error.reason] += 1
            return None
        self._newest_ns[topic] = at_ns
        return made, at_ns

    def _check_header(self, topic: str, header: Any, now_ns: int, unix_ns: int) -> int:
        """Check frame and timestamp of a header; return the timestamp on the local clock, ns."""
        if header.frame_id != WORLD:
            raise RejectedError(Rejection.WRONG_FRAME)
        stamp_ns = int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)
        age_ns = unix_ns - stamp_ns
        if age_ns > MAX_AGE_S * 1e9:
            raise RejectedError(Rejection.TOO_OLD)
        if age_ns < -MAX_FUTURE_S * 1e9:
            raise RejectedError(Rejection.IN_FUTURE)
        at_ns = min(now_ns, now_ns - age_ns)
        if at_ns < self._newest_ns.get(topic, -(1 << 62)) + MIN_PERIOD_S * 1e9:
            raise RejectedError(Rejection.NOT_NEWER)
        return at_ns

    @staticmethod
    def _make_eye(pose: Any, scene: Scene) -> Eye:
        centre = _read_xyz(pose.position)
        q = pose.orientation
        quaternion = np.array([q.x, q.y, q.z, q.w], dtype=np.float64)
        length = float(np.linalg.norm(quaternion))
        if not np.isfinite(quaternion).all():
            raise RejectedError(Rejection.NOT_FINITE)
        if abs(length - 1.0) > QUATERNION_TOLERANCE:
            raise RejectedError(Rejection.NOT_A_ROTATION)
        if np.linalg.norm(centre - scene.eyes.centre_world_m) > MAX_EYE_OFFSET_M:
            raise RejectedError(Rejection.OUTSIDE_RANGE)
        x, y, z, w = quaternion / length
        right = np.array([1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w)])
        return Eye(valid=True, centre_world_m=centre, right_world=right)

    def _make_fingertip(self, point: Any, at_ns: int, scene: Scene) -> Fingertip:
        measured = _read_xyz(point)
        tracker = self._tracker
        assert tracker is not None
        low, high = scene.finger.volume_min_m, scene.finger.volume_max_m
        reason: FingertipReason = "outside_volume"
        if ((measured >= low) & (measured <= high)).all():
            reason = tracker.update(at_ns, measured, np.eye(3) * self.noise_m**2)
        horizon_s = TriangulatorParameters().prediction_horizon_s
        horizons_s = np.arange(0.0, horizon_s + 1.5 * PREDICTION_STEP_S, PREDICTION_STEP_S)
        track = tracker.predict_at(at_ns, horizons_s)
        return Fingertip(
            valid=reason == "ok",
            state=tracker.state(at_ns),
            reason=reason,
            position_world_m=track.position,
            velocity_world_m_per_s=track.velocity,
            covariance=track.covariance,
            predicted_path_world_m=track.path,
            prediction_step_s=PREDICTION_STEP_S,
            measured_world_m=measured,
            reprojection_px=0.0,
        )


def _read_xyz(vector: Any) -> np.ndarray:
    values = np.array([vector.x, vector.y, vector.z], dtype=np.float64)
    if not np.isfinite(values).all():
        raise RejectedError(Rejection.NOT_FINITE)
    return values
