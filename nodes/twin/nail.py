"""Compute the position of a marker on the nail of a tilted or straight finger."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Self

import numpy as np

from flexsheet.messages.apparatus import FingerTruth
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.models.rigid import rotation_from_vector
from flexsheet.nodes.twin.clutter import FINGER_DIRECTION, FINGER_LENGTH_M

THICKNESS_RATIO = 0.6
"""The ratio of a finger's thickness from pad to nail (10 mm under pressure) to its breadth (16 to
18 mm). The module `tolerance_table` names the sources."""


@dataclass(frozen=True, slots=True)
class Nail:
    """The placement of the marker and the direction of the finger, as vectors in the world frame.

    A finger with a flat marker on its nail has an elliptic cross-section, and the marker is on the
    flat side. A finger with a ball, or with a marker at the pad, is round. The axis of a round
    finger begins at the fingertip.

    marker_offset_m (3,): vector from the fingertip (contact point of the finger pad) to the centre
        of the marker.
    marker_normal (3,): normal of a flat marker; None if the marker is a ball.
    direction (3,): direction from the fingertip to the knuckle.
    """

    marker_offset_m: Floats = field(default_factory=lambda: np.zeros(3))
    marker_normal: Floats | None = None
    direction: Floats = field(default_factory=lambda: np.array(FINGER_DIRECTION))

    @classmethod
    def of(cls, finger: FingerTruth) -> Self:
        """Compute the placement from the true finger parameters.

        In the finger's frame, x points from the tip to the knuckle, and z points out of the nail.
        If the finger is not tilted, y points to the right.
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

    def find_normal(self, radius_m: float) -> Floats | None:
        """Return the direction (3,) from the finger's axis to the nail.

        Returns None if the finger is round.

        radius_m: half of the finger's breadth.
        """
        height_m = float(np.linalg.norm(_reject(self.marker_offset_m, self.direction)))
        if self.marker_normal is None or height_m < THICKNESS_RATIO * radius_m:
            return None
        across = _reject(self.marker_normal, self.direction)
        length = float(np.linalg.norm(across))
        return None if length < 1e-6 else across / length

    def find_axis_shift_m(self, radius_m: float) -> Floats:
        """Return the vector (3,), m, from the fingertip to the end of the finger's centre line.

        The centre line is below the nail by a multiple THICKNESS_RATIO of the radius. The vector is
        zero if the finger is round.

        radius_m: half of the finger's breadth.
        """
        normal = self.find_normal(radius_m)
        if normal is None:
            return np.zeros(3)
        on_nail = _reject(self.marker_offset_m, self.direction)
        return np.asarray(on_nail - THICKNESS_RATIO * radius_m * normal)

    def find_half_width_m(self, view: Floats, radius_m: float) -> float:
        """Return half the width (m) of the finger's outline as seen along the vector `view` (3,).

        radius_m: half of the finger's breadth.
        """
        normal, aside = self.find_normal(radius_m), np.cross(self.direction, view)
        length = float(np.linalg.norm(aside))
        if normal is None or length < 1e-9:
            return radius_m
        cosine = float(normal @ aside) / length
        return radius_m * math.sqrt(1.0 - (1.0 - THICKNESS_RATIO**2) * cosine**2)

    @property
    def knuckle_shift_m(self) -> Floats:
        """Return the displacement (3,), m, of knuckle and hand that the finger's tilt causes."""
        return np.asarray(FINGER_LENGTH_M * (self.direction - np.array(FINGER_DIRECTION)))


def _reject(vector: Floats, direction: Floats) -> Floats:
    """Return the component (3,) of a vector that is perpendicular to a direction (3,)."""
    along = direction / np.linalg.norm(direction)
    return np.asarray(vector - (vector @ along) * along)
