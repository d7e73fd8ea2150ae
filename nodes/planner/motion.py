"""From a finger to the sheet's next motion: what is presented, reached within bounds.

`Plan` is deterministic: it knows stamps and measurements only, no clock.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from flexsheet.messages.scene import Scene
from flexsheet.messages.types import Phase
from flexsheet.nodes.models.motion import EdgeBound, SheetBounds, SheetMotion
from flexsheet.nodes.models.rigid import apply, inverse, transform_from_rpy
from flexsheet.nodes.models.shapes import make_shape
from flexsheet.nodes.planner.easing import EasedMotion, JerkBounds, ease_sheet
from flexsheet.nodes.planner.encounter import Encounter, Presentation, Reach
from flexsheet.nodes.planner.yielding import Yielding

Floats = NDArray[np.float64]

PLANNED_EDGE_SPEED = 0.7
"""Share of the tool speed that is planned with; the rest lets an arm that was late catch up."""

EDGE_MARGIN_M = 0.03
"""A finger nearer to a clamped edge than this would push on the clamp."""

DEEPEST_SHARE = 1.4
"""A finger deeper than this share of the scene's push depth has gone through the object."""

LONGEST_STEP_S = 0.1
"""After a longer gap the sheet is taken to stand still where it was: the arms have stopped."""


@dataclass(frozen=True, slots=True)
class Planned:
    """One step's outcome, in the world frame; `contact_sheet_m` is (x, y) on the sheet.

    retreat_m: how far behind the object's tangent plane the sheet is to be.
    """

    motion: SheetMotion
    presentation: Presentation
    contact_world_m: Floats
    normal_world: Floats
    contact_sheet_m: Floats
    retreat_m: float


@dataclass(frozen=True, slots=True)
class PlanSettings:
    """touch_m, release_m: distances from the sheet at which contact begins and ends.
    tilt_margin_rad: how far past the scene's tilt the sheet still follows.
    spin_rad: most that the sheet may be turned about its normal by rolling."""

    bounds: SheetBounds
    jerks: JerkBounds
    touch_m: float
    release_m: float
    tilt_margin_rad: float
    spin_rad: float


class Plan:
    """The sheet's motion about one object, from finger to finger."""

    def __init__(self, scene: Scene, settings: PlanSettings) -> None:
        place, sheet = scene.object.world_from_object, scene.sheet
        self._world_from_object = transform_from_rpy(place.position_m, place.rpy_rad)
        self._object_from_world = inverse(self._world_from_object)
        self._turn = np.kron(np.eye(2), self._world_from_object[:3, :3])
        self._settings = settings
        self._edges = EdgeBound(
            PLANNED_EDGE_SPEED * scene.arms.max_tool_speed_m_per_s, 0.5 * sheet.height_m
        )
        self._encounter = Encounter(
            make_shape(dict(scene.object.geometry)),
            self._object_from_world[:3, :3],
            Reach(
                front=self._object_from_world[:3, 2],
                tilt_rad=scene.working_range.tilt_rad + settings.tilt_margin_rad,
                spin_rad=settings.spin_rad,
                half_width_m=0.5 * sheet.width_m - EDGE_MARGIN_M,
                half_height_m=sheet.usable_half_height_m,
                touch_m=settings.touch_m,
                release_m=settings.release_m,
                deepest_m=DEEPEST_SHARE * scene.working_range.push_depth_m,
            ),
        )
        contact = self._encounter.contact
        self._presented = Presentation("wait", "", contact, np.zeros(6), 0.0)
        self._retreat_m = 0.0
        home = self._world_from_object @ contact.object_from_sheet
        self._eased = EasedMotion.at_rest(
            SheetMotion(home, np.zeros(6), sheet.min_stretch_ratio, 0.0)
        )

    def follow_finger(
        self, position_world: Floats, velocity_world: Floats, yielding: Yielding, step_s: float
    ) -> Planned:
        """The sheet `step_s` later, on its way to what a finger there (m, m/s) shall touch."""
        finger = apply(self._object_from_world, position_world)
        velocity = self._object_from_world[:3, :3] @ velocity_world
        object_from_sheet = self._object_from_world @ self.motion.world_from_sheet
        shown = self._encounter.step(finger, velocity, object_from_sheet)
        self._presented = shown
        x, y = shown.contact.on_sheet
        self._retreat_m, per_depth = yielding.retreat(shown.push_depth_m, (float(x), float(y)))
        target = SheetMotion(
            self._world_from_object @ shown.contact.object_from_sheet,
            self._turn @ shown.twist,
            yielding.stretch_ratio,
            0.0,
        )
        deeper_m_per_s = -float(velocity @ shown.contact.normal)
        self._go_on(withdrawn(target, self._retreat_m, per_depth * deeper_m_per_s), step_s)
        return self._planned(shown)

    @property
    def touching(self) -> bool:
        """Whether the finger was last seen in touch with what is presented."""
        return self._presented.phase in ("contact", "hold")

    def hold(self, reason: str, step_s: float) -> Planned:
        """The sheet `step_s` later when nothing is known of the finger: it comes to rest."""
        self._go_on(None, step_s)
        phase: Phase = "wait" if self._presented.phase == "wait" else "hold"
        return self._planned(
            replace(self._presented, phase=phase, reason=reason, twist=np.zeros(6))
        )

    def _go_on(self, target: SheetMotion | None, step_s: float) -> None:
        """Let the sheet go on for a step; after a long gap it begins anew from where it was."""
        if step_s > LONGEST_STEP_S:
            self._eased = EasedMotion.at_rest(self.motion)
        self._eased = ease_sheet(
            self._eased,
            target,
            bounds=self._settings.bounds,
            jerks=self._settings.jerks,
            edges=self._edges,
            step_s=min(step_s, LONGEST_STEP_S),
        )

    @property
    def motion(self) -> SheetMotion:
        """Where the sheet is planned to be, and how it moves there."""
        return self._eased.sheet

    def _planned(self, shown: Presentation) -> Planned:
        contact_world = apply(self._world_from_object, shown.contact.point)
        on_sheet = apply(inverse(self.motion.world_from_sheet), contact_world)[:2]
        return Planned(
            self.motion,
            shown,
            contact_world,
            self._world_from_object[:3, :3] @ shown.contact.normal,
            np.ascontiguousarray(on_sheet),
            self._retreat_m,
        )


def withdrawn(sheet: SheetMotion, retreat_m: float, rate_m_per_s: float) -> SheetMotion:
    """The sheet's motion with the sheet further back along its normal, by so much and growing."""
    normal = sheet.world_from_sheet[:3, 2]
    pose, twist = sheet.world_from_sheet.copy(), sheet.twist_world.copy()
    pose[:3, 3] -= retreat_m * normal
    twist[:3] -= rate_m_per_s * normal + retreat_m * np.cross(twist[3:], normal)
    return replace(sheet, world_from_sheet=pose, twist_world=twist)
