"""Compute the fingertip position that the mouse selects on the object, and a path to this point."""

from __future__ import annotations

import numpy as np

from flexsheet.messages.scene import Scene
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.models.rigid import apply, inverse, pose_matrix
from flexsheet.nodes.models.shapes import Shape, make_shape

MAX_RAY_M = 3.0
SURFACE_TOLERANCE_M = 1e-4
MAX_STEPS = 64
MIN_STEP_RATIO = 0.01
"""The minimum length of a step around an object, as a fraction of the maximum step length."""

HOVER_M = 0.03
"""The distance of a lifted finger from the object's surface, in metres."""


class SurfacePicker:
    """A selector of points on the object of a scene. If the object is a mesh, the constructor takes
    a second.
    """

    def __init__(self, scene: Scene) -> None:
        self._world_from_object = pose_matrix(scene.object.world_from_object)
        self._object_from_world = inverse(self._world_from_object)
        self._shape: Shape = make_shape(dict(scene.object.geometry))
        self._low, self._high = scene.finger.volume_min_m, scene.finger.volume_max_m

    def pick(self, origin: Floats, direction: Floats, depth_m: float) -> Floats:
        """Return the fingertip position (3,), in m, that a ray from the viewer's eye selects.

        origin, direction: origin (3,), m, and direction (3,) of the ray in the world frame; the
            direction is not zero.
        If the ray meets the object, the position is `depth_m` below the surface along the normal. A
        negative depth is above the surface. If the ray misses the object, the position is the point
        of the ray that is nearest to the object, but not deeper than `depth_m`.
        """
        direction = direction / np.linalg.norm(direction)
        travelled, nearest_m, nearest = 0.0, np.inf, origin
        for _ in range(MAX_STEPS):
            point = origin + travelled * direction
            away_m = float(self._shape.signed_distance(apply(self._object_from_world, point)))
            if away_m < nearest_m:
                nearest_m, nearest = away_m, point
            if away_m < SURFACE_TOLERANCE_M:
                return self.offset_point(point, depth_m)
            travelled += away_m
            if travelled > MAX_RAY_M:
                break
        return (
            self.offset_point(nearest, depth_m) if nearest_m < -depth_m else self._within(nearest)
        )

    def offset_point(self, near: Floats, depth_m: float) -> Floats:
        """Return the point (3,), in m, at a depth below the surface point nearest to `near`.

        near: point (3,), m.
        A negative depth results in a point above the surface.
        """
        found = self._shape.closest(apply(self._object_from_world, near))
        inside = found.point - depth_m * found.normal
        return self._within(apply(self._world_from_object, inside))

    def step(self, finger: Floats, target: Floats, *, depth_m: float, max_step_m: float) -> Floats:
        """Return the next point (3,), in m, on the path of the finger to the target.

        finger, target: present and requested position (3,), m. The step is at most `max_step_m`
        long. The step ends at most `depth_m` below the surface, or at the present depth if the
        present depth is larger. If a step around the object makes no progress, the step is
        straight.
        """
        across = target - finger
        distance = float(np.linalg.norm(across))
        if distance <= max_step_m:
            return target
        straight = finger + across * (max_step_m / distance)
        deepest_m = max(depth_m, self._depth_m(finger))
        if self._depth_m(straight) <= deepest_m + SURFACE_TOLERANCE_M:
            return straight
        across = self.offset_point(straight, deepest_m) - finger
        around_m = float(np.linalg.norm(across))
        if around_m < MIN_STEP_RATIO * max_step_m:
            return straight
        return finger + across * min(1.0, max_step_m / around_m)

    def _depth_m(self, point: Floats) -> float:
        return -float(self._shape.signed_distance(apply(self._object_from_world, point)))

    def _within(self, point: Floats) -> Floats:
        return np.clip(point, self._low, self._high)
