"""Compute where the marker is on the nail of a finger, which may be held at an angle."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Self

import numpy as np
from numpy.typing import NDArray

from flexsheet.messages.apparatus import FingerTruth
from flexsheet.nodes.models.rigid import rotation_from_vector
from flexsheet.nodes.twin.clutter import FINGER_DIRECTION, FINGER_LENGTH_M

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Nail:
    """Placement of the marker, and direction of the finger, as vectors in the world frame.

    marker_offset_m: (3,) from the fingertip (contact point of the finger pad) to the centre of the
        marker.
    marker_normal: (3,) normal of a flat marker; None if the marker is a ball.
    direction: (3,) from the fingertip to the knuckle.
    """

    marker_offset_m: Floats = field(default_factory=lambda: np.zeros(3))
    marker_normal: Floats | None = None
    direction: Floats = field(default_factory=lambda: np.array(FINGER_DIRECTION))

    @classmethod
    def of(cls, finger: FingerTruth) -> Self:
        """Compute the placement from the true finger parameters.

        In the finger's frame, x points from the tip to the knuckle and z out of the nail. For a
        finger that is not tilted, y points to the right.
        """
        tilt = rotation_from_vector((*finger.finger_tilt_rad, 0.0))
        x = tilt @ np.array(FINGER_DIRECTION)
        direction = x if any(finger.finger_tilt_rad) else np.array(FINGER_DIRECTION)
        x = x / np.linalg.norm(x)
        z = np.cross(x, tilt[:, 0])
        z /= np.linalg.norm(z)
        world_from_finger = np.column_stack([x, np.cross(z, x), z])
        on_nail = rotation_from_vector((*finger.marker_tilt_rad, 0.0))
        normal = world_from_finger @ on_nail[:, 2]
        return cls(
            marker_offset_m=world_from_finger @ np.array(finger.marker_from_pad_m),
            marker_normal=normal if finger.marker_shape == "disc" else None,
            direction=direction,
        )

    @property
    def knuckle_shift_m(self) -> Floats:
        """Return the vector (3,) by which the finger's tilt displaces the knuckle and the hand."""
        return np.asarray(FINGER_LENGTH_M * (self.direction - np.array(FINGER_DIRECTION)))
