"""Move the simulated finger step by step to the position that a viewer requests."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from flexsheet.messages.types import FingerPath
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.console.picking import HOVER_M, SurfacePicker

LABEL = "console"
SPEED_M_PER_S = 0.15
FRONT_M = 1.5
"""The z coordinate (m, world frame) of the origins of rays from the front."""


@dataclass(frozen=True, slots=True)
class Ray:
    """A ray in the world frame that selects its first intersection with the object.

    direction: vector of any length except 0.

    Raises ValueError if a value is not finite, or if the length of the direction is 0.
    """

    origin_m: tuple[float, float, float]
    direction: tuple[float, float, float]

    def __post_init__(self) -> None:
        length = float(np.linalg.norm(self.direction))
        if not (np.isfinite(self.origin_m).all() and np.isfinite(length) and length > 0.0):
            raise ValueError(
                f"ray from {self.origin_m}: the direction {self.direction} must be finite and must "
                "not be zero; drag on the sheet again"
            )

    @property
    def is_from_front(self) -> bool:
        """Return whether the ray points in the negative z direction, away from the user."""
        return self.direction[:2] == (0.0, 0.0) and self.direction[2] < 0.0

    @classmethod
    def from_front(cls, x_m: float, y_m: float) -> Ray:
        """Return the ray in the negative z direction through the point (x, y)."""
        return cls((x_m, y_m, FRONT_M), (0.0, 0.0, -1.0))


@dataclass(frozen=True, slots=True)
class FingerIntent:
    """A finger position that a viewer of the console page requests.

    position: ray in the world frame; the finger is placed where the ray meets the object.
    depth_m: depth of the finger below the surface if the finger is not lifted.
    lifted: whether the finger hovers above the surface instead.

    Raises ValueError if the depth is negative or not finite.
    """

    position: Ray = field(default_factory=lambda: Ray.from_front(0.0, 0.0))
    depth_m: float = 0.004
    lifted: bool = True

    def __post_init__(self) -> None:
        if not (np.isfinite(self.depth_m) and self.depth_m >= 0.0):
            raise ValueError(
                f"depth_m: {self.depth_m} must be a finite number of at least 0; move the slider "
                "Push again"
            )

    def target_m(self, picker: SurfacePicker) -> Floats:
        """Return the requested position (3,), in m, of the fingertip in the world frame.

        picker: object that selects points on the virtual object.

        The position is limited to the touchable surface and the working range of the scene.
        """
        origin, direction = np.array(self.position.origin_m), np.array(self.position.direction)
        return picker.pick(origin, direction, -HOVER_M if self.lifted else self.depth_m)


class FingerController:
    """A controller that moves the simulated finger to the requested position at a limited speed.

    position_m: requested position (x, y) as seen from the front.

    Each step is published as a path of one point. Before the first command of a viewer, nothing is
    published, and other programs can control the finger.
    """

    def __init__(self, publish: Callable[[FingerPath], None]) -> None:
        self._publish = publish
        self._picker: SurfacePicker | None = None
        self._target: Floats | None = None
        self._arrived = False
        self._last_point = np.array([0.0, 0.0, 0.08])
        self.position_m = (0.0, 0.0)
        self._commanded = False
        self.intent = FingerIntent()

    def use(self, picker: SurfacePicker | None) -> None:
        """Replace the picker after a change of the virtual object.

        picker: object that selects points on the virtual object; None if the shape is unknown.
        """
        self._picker = picker
        self._update_target()

    def touch(self, origin: Floats, direction: Floats) -> None:
        """Request a push at the point where a ray from the viewer's eye meets the object.

        origin, direction: origin (3,), m, and direction (3,) of the ray in the world frame.
        """
        position = Ray(tuple(map(float, origin)), tuple(map(float, direction)))  # type: ignore[arg-type]  # three each
        self._request(position=position, lifted=False)

    def move_to(self, x_m: float, y_m: float) -> None:
        """Request a finger position (x, y) as seen from the front. The depth does not change."""
        self._request(position=Ray.from_front(x_m, y_m))

    def push(self, depth_m: float) -> None:
        """Request a push of the finger to a depth below the surface at the requested position.

        Raises ValueError if the depth exceeds the scene's working range.
        """
        if self._picker is not None and self._picker.max_depth_m < depth_m < np.inf:
            raise ValueError(
                f"Push: {1e3 * depth_m:g} mm is deeper than the working range of the scene, "
                f"{1e3 * self._picker.max_depth_m:g} mm; choose a smaller depth, or increase "
                "`working_range.push_depth_m` of the scene"
            )
        self._request(depth_m=depth_m, lifted=False)

    def lift_or_lower(self) -> None:
        """Request that the finger is lifted above the requested position, or lowered again."""
        self._request(lifted=not self.intent.lifted)

    def _request(self, **changes: object) -> None:
        self.intent = replace(self.intent, **changes)  # type: ignore[arg-type]  # fields of it
        self._commanded = True
        self._update_target()

    def _update_target(self) -> None:
        self._target, self._arrived = None, False
        position = self.intent.position
        if position.is_from_front:
            self.position_m = position.origin_m[:2]
        if self._picker is not None and self._commanded:
            self._target = target = self.intent.target_m(self._picker)
            if not position.is_from_front:
                self.position_m = float(target[0]), float(target[1])

    def advance(self, duration_s: float, measured: Floats | None) -> None:
        """Publish the next step towards the target.

        duration_s: duration of the step.
        measured: measured position (3,) of the finger, m; None if the position is unknown.
        """
        if self._target is None or self._picker is None or self._arrived:
            if measured is not None:
                self._last_point = measured
            return
        max_step_m = SPEED_M_PER_S * duration_s
        depth_m = 0.0 if self.intent.lifted else self.intent.depth_m
        self._last_point = self._picker.step(
            self._last_point, self._target, depth_m=depth_m, max_step_m=max_step_m
        )
        self._arrived = self._last_point is self._target
        self._publish(
            FingerPath(
                label=LABEL,
                times_s=np.zeros(1),
                positions_world_m=self._last_point[None],
                wander_m=0.0,
                tremor_m=0.0,
            )
        )
