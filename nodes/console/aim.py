"""From the mouse to the finger: which point of the object it means, and how to get there."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from flexsheet.messages.scene import Scene
from flexsheet.nodes.models.rigid import apply, inverse, transform_from_rpy
from flexsheet.nodes.models.shapes import Shape, make_shape

Floats = NDArray[np.float64]

FARTHEST_M = 3.0
CLOSE_M = 1e-4
STEPS = 64
MIN_STEP_RATIO = 0.01
"""Of the full step; one that is shorter leads around an object from its very middle: nowhere."""

HOVER_M = 0.03
"""Above the object: where a lifted finger waits."""


class Aim:
    """A scene's object as something to point at.  Building one for a mesh takes a second."""

    def __init__(self, scene: Scene) -> None:
        pose = scene.object.world_from_object
        self._world_from_object = transform_from_rpy(pose.position_m, pose.rpy_rad)
        self._object_from_world = inverse(self._world_from_object)
        self._shape: Shape = make_shape(dict(scene.object.geometry))
        self._low, self._high = scene.finger.volume_min_m, scene.finger.volume_max_m

    def under_ray(self, origin: Floats, direction: Floats, depth_m: float) -> Floats:
        """The fingertip (3,) that a ray from the viewer's eye means.

        Where the ray meets the object: that far below its surface, along the normal; below 0:
        above.  Where it passes the object: the point of the ray that is nearest to it, and not
        nearer than asked for.  direction (3,) is not zero.
        """
        direction = direction / np.linalg.norm(direction)
        travelled, nearest_m, nearest = 0.0, np.inf, origin
        for _ in range(STEPS):
            point = origin + travelled * direction
            away_m = float(self._shape.signed_distance(apply(self._object_from_world, point)))
            if away_m < nearest_m:
                nearest_m, nearest = away_m, point
            if away_m < CLOSE_M:
                return self.pressed(point, depth_m)
            travelled += away_m
            if travelled > FARTHEST_M:
                break
        return self.pressed(nearest, depth_m) if nearest_m < -depth_m else self._within(nearest)

    def pressed(self, near: Floats, depth_m: float) -> Floats:
        """The fingertip `depth_m` below the surface point nearest to a place; below 0: above."""
        found = self._shape.closest(apply(self._object_from_world, near))
        inside = found.point - depth_m * found.normal
        return self._within(apply(self._world_from_object, inside))

    def step(self, finger: Floats, target: Floats, *, depth_m: float, way_m: float) -> Floats:
        """The next point (3,) from the finger towards the target, `way_m` on at most.

        On the way it goes no deeper into the object than `depth_m`, or than it is, unless the way
        around leads nowhere.
        """
        across = target - finger
        distance = float(np.linalg.norm(across))
        if distance <= way_m:
            return target
        straight = finger + across * (way_m / distance)
        deepest_m = max(depth_m, self._depth_m(finger))
        if self._depth_m(straight) <= deepest_m + CLOSE_M:
            return straight
        across = self.pressed(straight, deepest_m) - finger
        around_m = float(np.linalg.norm(across))
        if around_m < MIN_STEP_RATIO * way_m:
            return straight
        return finger + across * min(1.0, way_m / around_m)

    def _depth_m(self, point: Floats) -> float:
        return -float(self._shape.signed_distance(apply(self._object_from_world, point)))

    def _within(self, point: Floats) -> Floats:
        return np.clip(point, self._low, self._high)
