"""From a finger to the sheet's next motion: what is presented, reached within bounds.

`Plan` is deterministic: it knows stamps and measurements only, no clock.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from messages.scene import Scene, cylinder_of
from messages.types import Phase
from nodes.models.motion import EdgeBound, SheetBounds, SheetMotion, coast_sheet, follow_sheet
from nodes.models.rigid import apply, inverse, transform_from_rpy
from nodes.models.shapes import CylinderShape
from nodes.planner.rolling import (
    Encounter,
    Presentation,
    Reach,
    normal_at,
    sheet_on_cylinder,
    sheet_twist,
)

Floats = NDArray[np.float64]

PLANNED_EDGE_SPEED = 0.7
"""Share of the tool speed that is planned with; the rest lets an arm that was late catch up."""

LONGEST_STEP_S = 0.1
"""After a longer gap the sheet is taken to stand still where it was: the arms have stopped."""


@dataclass(frozen=True, slots=True)
class Planned:
    """One step's outcome, in the world frame; `contact_sheet_m` is (x, y) on the sheet."""

    motion: SheetMotion
    presentation: Presentation
    contact_world_m: Floats
    normal_world: Floats
    contact_sheet_m: Floats


class Plan:
    """The sheet's motion about one object, from finger to finger."""

    def __init__(self, scene: Scene, *, bounds: SheetBounds, touch_m: float, release_m: float,
                 tilt_margin_rad: float) -> None:  # fmt: skip
        cylinder, place = cylinder_of(scene), scene.object.world_from_object
        self._shape = CylinderShape(cylinder.radius_m, cylinder.length_m)
        self._world_from_object = transform_from_rpy(place.position_m, place.rpy_rad)
        self._object_from_world = inverse(self._world_from_object)
        self._turn = np.kron(np.eye(2), self._world_from_object[:3, :3])
        self._bounds = bounds
        self._edges = EdgeBound(
            PLANNED_EDGE_SPEED * scene.arms.max_tool_speed_m_per_s, 0.5 * scene.sheet.height_m
        )
        user = self._object_from_world[:3, 2]
        front = float(np.arctan2(user[1], user[2]))
        self._encounter = Encounter(
            self._shape,
            Reach(
                front_rad=front,
                tilt_rad=scene.working_range.tilt_rad + tilt_margin_rad,
                half_height_m=scene.sheet.usable_half_height_m,
                touch_m=touch_m,
                release_m=release_m,
                axis_m=0.15 * cylinder.radius_m,
            ),
        )
        self._presented = Presentation("wait", "", front, 0.0, 0.0, False, 0.0)
        home = self._world_from_object @ sheet_on_cylinder(self._shape, front, 0.0)
        self.motion = SheetMotion(home, np.zeros(6), scene.sheet.min_stretch_ratio, 0.0)
        self._contact_x = 0.0

    def follow_finger(
        self, position_world: Floats, velocity_world: Floats, stretch_ratio: float, step_s: float
    ) -> Planned:
        """The sheet `step_s` later, on its way to what a finger there (m, m/s) shall touch."""
        finger = apply(self._object_from_world, position_world)
        velocity = self._object_from_world[:3, :3] @ velocity_world
        shown = self._encounter.step(finger, velocity, self._sheet_y_under(finger))
        self._presented = shown
        half = 0.5 * self._shape.length_m
        self._contact_x = float(np.clip(finger[0], -half, half))
        twist = sheet_twist(
            self._shape, shown.angle_rad, shown.y_m, shown.angle_rate, rolling=shown.rolling
        )
        target = SheetMotion(
            self._world_from_object @ sheet_on_cylinder(self._shape, shown.angle_rad, shown.y_m),
            self._turn @ twist,
            stretch_ratio,
            0.0,
        )
        self.motion = follow_sheet(
            self._before(step_s),
            target,
            bounds=self._bounds,
            edges=self._edges,
            step_s=min(step_s, LONGEST_STEP_S),
        )
        return self._planned(shown)

    def hold(self, reason: str, step_s: float) -> Planned:
        """The sheet `step_s` later when nothing is known of the finger: it comes to rest."""
        self.motion = coast_sheet(
            self._before(step_s), bounds=self._bounds, step_s=min(step_s, LONGEST_STEP_S)
        )
        phase: Phase = "wait" if self._presented.phase == "wait" else "hold"
        return self._planned(replace(self._presented, phase=phase, reason=reason, angle_rate=0.0))

    def _before(self, step_s: float) -> SheetMotion:
        if step_s <= LONGEST_STEP_S:
            return self.motion
        return replace(self.motion, twist_world=np.zeros(6), stretch_rate_per_s=0.0)

    def _sheet_y_under(self, finger: Floats) -> float:
        """y of the sheet's point nearest to the surface point under the finger, as the sheet is."""
        shown = self._shape.radius_m * normal_at(self._encounter.angle_rad)
        surface = self._shape.closest(finger, previous=shown)
        contact_world = apply(self._world_from_object, surface.point)
        return float(apply(inverse(self.motion.world_from_sheet), contact_world)[1])

    def _planned(self, shown: Presentation) -> Planned:
        normal = normal_at(shown.angle_rad)
        contact = self._shape.radius_m * normal + np.array([self._contact_x, 0.0, 0.0])
        contact_world = apply(self._world_from_object, contact)
        on_sheet = apply(inverse(self.motion.world_from_sheet), contact_world)[:2]
        return Planned(
            self.motion,
            shown,
            contact_world,
            self._world_from_object[:3, :3] @ normal,
            np.ascontiguousarray(on_sheet),
        )
