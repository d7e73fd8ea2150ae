"""Check positions that programs outside the graph send, because such programs are not trusted."""

from __future__ import annotations

from enum import StrEnum

import numpy as np

from flexsheet.messages.scene import Scene
from flexsheet.messages.types import Eye
from flexsheet.nodes.arrays import Floats

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


def check_period(at_ns: int, newest_ns: int | None) -> None:
    """Raise RejectedError if a message is not at least MIN_PERIOD_S newer than the last message.

    at_ns, newest_ns: times of this message and the last message; None if there is no last message.
    """
    if newest_ns is not None and at_ns < newest_ns + MIN_PERIOD_S * 1e9:
        raise RejectedError(Rejection.NOT_NEWER)


def check_finite(values: Floats) -> Floats:
    """Raise RejectedError if a value is not finite; otherwise return the values."""
    if not np.isfinite(values).all():
        raise RejectedError(Rejection.NOT_FINITE)
    return values


def rotate_x_axis(quaternion: Floats) -> Floats:
    """Rotate the x axis by a quaternion (x, y, z, w), and return the rotated axis (3,).

    Raises RejectedError unless the length of the quaternion is 1 within QUATERNION_TOLERANCE.
    """
    length = float(np.linalg.norm(check_finite(quaternion)))
    if abs(length - 1.0) > QUATERNION_TOLERANCE:
        raise RejectedError(Rejection.NOT_A_ROTATION)
    x, y, z, w = quaternion / length
    return np.array([1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w)])


def make_eye(centre_world_m: Floats, right_world: Floats, scene: Scene) -> Eye:
    """Make a message with the position of the user's eyes.

    centre_world_m: midpoint (3,) of the eyes.
    right_world: direction (3,) from the left to the right eye, of any length except zero.

    Raises RejectedError if the position is not finite, or too far from the eye position in the
    scene.
    """
    check_finite(centre_world_m)
    if np.linalg.norm(centre_world_m - scene.eyes.centre_world_m) > MAX_EYE_OFFSET_M:
        raise RejectedError(Rejection.OUTSIDE_RANGE)
    return Eye(valid=True, centre_world_m=centre_world_m, right_world=right_world)
