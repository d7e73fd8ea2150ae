"""Compute the fingertip position that the mouse selects on the object, and a path to it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from flexsheet.messages.scene import Scene
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.models.rigid import apply, inverse, pose_matrix
from flexsheet.nodes.models.shapes import Nearest, Shape, make_shape

MAX_RAY_M = 3.0
SURFACE_TOLERANCE_M = 1e-4
MAX_STEPS = 64
MIN_STEP_RATIO = 0.01
"""The minimum length of a step around an object, as a fraction of the maximum step length."""

HOVER_M = 0.03
"""The distance of a lifted finger from the object's surface, in metres."""

RIM_MARGIN_M = 0.002
"""The minimum distance of a selected point from the rim of the touchable surface."""

SEARCH_POINTS, SEARCH_ROUNDS = 17, 2
"""The number of points on a line that are tested for the last touchable point, and the number of
rounds of this search. Each round tests the interval that the previous round found."""


class SurfacePicker:
    """A picker (selector) of points on the object of a scene.

    max_depth_m: maximum push depth of the working range.

    Position, tilt and depth are limited to the scene's working range. A point outside the touchable
    part of the surface is replaced by a touchable point slightly inside the edge of this part. If
    the object is a mesh, construction takes a second.
    """

    def __init__(self, scene: Scene) -> None:
        self._world_from_object = pose_matrix(scene.object.world_from_object)
        self._object_from_world = inverse(self._world_from_object)
        self._shape: Shape = make_shape(dict(scene.object.geometry))
        self._low, self._high = scene.finger.volume_min_m, scene.finger.volume_max_m
        self.max_depth_m = scene.working_range.push_depth_m
        self._min_cos_tilt = np.cos(scene.working_range.tilt_rad)
        self._towards_user = self._object_from_world[:3, 2]
        self._front_m = self._shape.closest(10.0 * self._towards_user).point

    def pick(self, origin: Floats, direction: Floats, depth_m: float) -> Floats:
        """Return the fingertip position (3,), in m, that a ray from the viewer's eye selects.

        origin: origin (3,), m, of the ray in the world frame.
        direction: direction (3,) of the ray in the world frame, which is not zero.

        The ray selects the surface point where it meets the object. If the ray misses the object,
        the surface point nearest to the ray is selected. The fingertip is `depth_m` below the
        selected point along the normal. If the depth is negative, the fingertip is above the
        surface. The point and the depth are limited to the working range.
        """
        direction = direction / np.linalg.norm(direction)
        travelled, nearest_m, nearest = 0.0, np.inf, origin
        for _ in range(MAX_STEPS):
            point = origin + travelled * direction
            away_m = float(self._shape.signed_distance(apply(self._object_from_world, point)))
            if away_m < nearest_m:
                nearest_m, nearest = away_m, point
            travelled += away_m
            if away_m < SURFACE_TOLERANCE_M or travelled > MAX_RAY_M:
                break
        return self.offset_point(nearest, depth_m)

    def offset_point(self, near: Floats, depth_m: float) -> Floats:
        """Return the point (3,), in m, at a depth below the touchable surface nearest to `near`.

        near: point (3,) in the world frame, m.

        If the depth is negative, the result is above the surface.
        """
        found = self._find_touchable(apply(self._object_from_world, near))
        inside = found.point - min(depth_m, self.max_depth_m) * found.normal
        return self._within(apply(self._world_from_object, inside))

    def _find_touchable(self, near: Floats) -> Nearest:
        """Return the touchable surface point nearest to `near`, or a touchable point close to it.

        near: point (3,) in the object's frame, m.

        If the nearest surface point is not touchable, the result moves from the object's front
        towards this point while it remains touchable. Then it moves along the world's x axis and y
        axis to reduce the remaining distance.
        """
        found = self._shape.closest(near)
        outwards = found.point - self._front_m
        length_m = max(float(np.linalg.norm(outwards)), RIM_MARGIN_M)
        beyond = self._shape.closest(found.point + RIM_MARGIN_M / length_m * outwards)
        if self._is_touchable(found) and not beyond.on_edge:
            return found
        best = self._advance(self._front_m, outwards)
        for axis in self._object_from_world[:3, :2].T:
            best = self._advance(best.point, ((found.point - best.point) @ axis) * axis)
        return best

    def _advance(self, start: Floats, displacement: Floats) -> Nearest:
        """Return the last touchable surface point on the path from `start` along `displacement`.

        start, displacement: touchable point (3,) and displacement (3,), m, in the object's frame.

        Points on the straight path are projected onto the surface.
        """
        margin = RIM_MARGIN_M / max(float(np.linalg.norm(displacement)), RIM_MARGIN_M)
        low, high = 0.0, 1.0 + margin
        for _ in range(SEARCH_ROUNDS):
            tried = np.linspace(low, high, SEARCH_POINTS)
            found = self._shape.closest(start + tried[:, None] * displacement)
            touchable = int(np.argmin(np.append(self._is_touchable(found), False)))
            low = float(tried[max(touchable - 1, 0)])
            high = float(tried[min(touchable, SEARCH_POINTS - 1)])
        return self._shape.closest(start + max(low - margin, 0.0) * displacement)

    def _is_touchable(self, found: Nearest) -> NDArray[np.bool_]:
        tilt_is_small = found.normal @ self._towards_user >= self._min_cos_tilt
        return np.asarray(~found.on_edge & tilt_is_small)

    def step(self, finger: Floats, target: Floats, *, depth_m: float, max_step_m: float) -> Floats:
        """Return the next point (3,), in m, on the path of the finger to the target.

        finger, target: present and requested position (3,), m.

        The step is at most `max_step_m` long. It ends at most `depth_m` below the surface, or at
        the depth of `finger` if that is deeper. The path goes around the object. If this makes no
        progress, the step goes straight towards the target.
        """
        across = target - finger
        distance = float(np.linalg.norm(across))
        if distance <= max_step_m:
            return target
        straight = finger + across * (max_step_m / distance)
        deepest_m = max(min(depth_m, self.max_depth_m), self._depth_m(finger))
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
