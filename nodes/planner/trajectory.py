"""Plan the motion of the sheet after each fingertip measurement."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from flexsheet.messages.scene import Scene
from flexsheet.messages.types import Phase, SheetReason, SheetTrajectory
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.models.motion import EdgeBound, SheetBounds, SheetMotion, measure_length
from flexsheet.nodes.models.rigid import apply, inverse, pose_matrix
from flexsheet.nodes.models.shapes import make_shape
from flexsheet.nodes.models.sheet.tension import compute_sag_m
from flexsheet.nodes.planner.compliance_controller import ComplianceController
from flexsheet.nodes.planner.contact_state import (
    ContactCommand,
    ContactLimits,
    ContactStateMachine,
)
from flexsheet.nodes.planner.jerk_limiter import JerkLimitedState, step_sheet
from flexsheet.nodes.planner.parameters import PlannerParameters
from flexsheet.nodes.planner.rolling import cross
from flexsheet.nodes.planner.sheet_force import make_rubber
from flexsheet.nodes.planner.stabilized_offset import StabilizedOffset

EDGE_SPEED_FRACTION = 0.7
"""The fraction of the maximum tool speed that the planner uses. The remaining speed is reserved for
an arm that is late and must catch up."""

EDGE_MARGIN_M = 0.03
"""The minimum distance of a contact from a clamp, so the finger cannot touch the clamp."""

MAX_DEPTH_FRACTION = 1.4
"""The ratio of the finger's depth to the scene's push depth above which the finger has passed
through the object."""

MAX_STEP_S = 0.1
"""The time since the last fingertip message after which the sheet restarts from rest, because the
arms have stopped."""

KEEP_S = 0.15
"""The time (s) for which a trajectory continues with constant velocity. If a packet is lost, it is
repeated within 0.1 to 0.15 s."""

MIN_BRAKE_S, MAX_BRAKE_S = 0.1, 0.2
"""The minimum and maximum duration of the deceleration at the end of a trajectory."""


@dataclass(frozen=True, slots=True)
class PlannedStep:
    """The result of one planning step, in the world frame.

    trajectory: motion after the step if no newer target arrives.
    contact_sheet_m: (x, y) of the contact on the sheet.
    normal_offset_m: distance of the sheet behind the object's tangent plane.
    """

    motion: SheetMotion
    trajectory: SheetTrajectory | None
    command: ContactCommand
    contact_world_m: Floats
    normal_world: Floats
    contact_sheet_m: Floats
    normal_offset_m: float


class SheetTrajectoryPlanner:
    """A planner of the sheet's motion on one virtual object.

    Raises UnpresentableError if the tilt of the object's front exceeds the maximum.
    """

    def __init__(self, scene: Scene, settings: PlannerParameters) -> None:
        pose, sheet = scene.object.world_from_object, scene.sheet
        self._world_from_object = pose_matrix(pose)
        self._object_from_world = inverse(self._world_from_object)
        self._rotate_twist = np.kron(np.eye(2), self._world_from_object[:3, :3])
        self._bounds, self._jerks = settings.bounds, settings.jerks
        self._rubber, self._density_kg_per_m3 = make_rubber(sheet), sheet.density_kg_per_m3
        self._edges = EdgeBound(
            EDGE_SPEED_FRACTION * scene.arms.max_tool_speed_m_per_s, 0.5 * sheet.height_m
        )
        self._contact_state = ContactStateMachine(
            make_shape(dict(scene.object.geometry)),
            self._object_from_world[:3, :3],
            ContactLimits(
                front=self._object_from_world[:3, 2],
                max_tilt_rad=scene.working_range.tilt_rad + settings.tilt_margin_rad,
                max_spin_rad=settings.max_spin_rad,
                half_width_m=0.5 * sheet.width_m - EDGE_MARGIN_M,
                half_height_m=sheet.usable_half_height_m,
                contact_on_m=settings.contact_on_m,
                contact_off_m=settings.contact_off_m,
                max_depth_m=MAX_DEPTH_FRACTION * scene.working_range.push_depth_m,
            ),
        )
        contact = self._contact_state.contact
        self._command = ContactCommand("wait", "ok", contact, np.zeros(6), 0.0)
        self._normal_offset_m = 0.0
        self._offset = StabilizedOffset()
        home = self._world_from_object @ contact.object_from_sheet
        self._state = JerkLimitedState.at_rest(
            SheetMotion(home, np.zeros(6), sheet.min_stretch_ratio, 0.0)
        )

    def follow_finger(
        self,
        position_world: Floats,
        velocity_world: Floats,
        compliance: ComplianceController,
        step_s: float,
        measured_world: Floats | None = None,
    ) -> PlannedStep:
        """Move the sheet for `step_s` towards the contact with a finger.

        position_world, velocity_world: predicted position (m) and velocity (m/s) of the finger,
            each (3,).
        measured_world: measured position (3,) of the finger, m; None if it equals `position_world`.
        """
        finger = apply(self._object_from_world, position_world)
        velocity = self._object_from_world[:3, :3] @ velocity_world
        object_from_sheet = self._object_from_world @ self.motion.world_from_sheet
        command = self._contact_state.step(finger, velocity, object_from_sheet)
        self._command = command
        measured = finger
        if measured_world is not None:
            measured = apply(self._object_from_world, measured_world)
        moved_m = float((finger - measured) @ command.contact.normal)
        speed_m_per_s = float(velocity @ command.contact.normal)
        offset_rate_m_per_s = self._update_offset(
            compliance, step_s, moved_m=moved_m, speed_m_per_s=speed_m_per_s
        )
        target = SheetMotion(
            self._world_from_object @ command.contact.object_from_sheet,
            self._rotate_twist @ command.twist,
            compliance.stretch_ratio,
            0.0,
        )
        x, y = command.contact.position_sheet_m
        behind_m = self._normal_offset_m + self._sag_m(target, float(x), float(y))
        self._advance(offset_along_normal(target, behind_m, offset_rate_m_per_s), step_s)
        return self._make_step(command)

    def _update_offset(
        self,
        compliance: ComplianceController,
        step_s: float,
        *,
        moved_m: float,
        speed_m_per_s: float,
    ) -> float:
        """Update the sheet's offset behind the tangent plane, and return its rate (m/s).

        moved_m, speed_m_per_s: predicted displacement and speed of the finger along the normal.
        """
        x, y = self._command.contact.position_sheet_m
        at = (float(x), float(y))
        depth_m = self._command.push_depth_m
        if compliance.bandwidth_rad_per_s is None:
            self._normal_offset_m, per_depth = compliance.normal_offset(depth_m, at)
            return -per_depth * speed_m_per_s
        self._normal_offset_m, rate = self._offset.update(
            depth_m + moved_m if depth_m > 0.0 else 0.0,
            lambda filtered_m: compliance.normal_offset(filtered_m, at)[0],
            step_s=step_s,
            bandwidth_rad_per_s=compliance.bandwidth_rad_per_s,
            delay_s=compliance.delay_s,
        )
        return rate

    @property
    def watchdog_triggers(self) -> int:
        """Return the number of oscillations of the sheet that the oscillation watchdog stopped."""
        return self._offset.watchdog.triggers

    def _sag_m(self, sheet: SheetMotion, x_m: float, y_m: float) -> float:
        """Return the sag (m) of the sheet under its own weight, along the sheet's normal.

        x_m, y_m: position on the sheet.
        """
        distance_m = self._rubber.width_m * sheet.stretch_ratio
        return float(
            compute_sag_m(
                self._rubber,
                sheet.world_from_sheet[:3, 2],
                density_kg_per_m3=self._density_kg_per_m3,
                edge_distance_m=distance_m,
                across=min(max(x_m / distance_m + 0.5, 0.0), 1.0),
                along=y_m / self._rubber.height_m,
            )
        )

    @property
    def in_contact(self) -> bool:
        """Return whether the finger touched the sheet at the last valid finger position."""
        return self._command.phase in ("contact", "hold")

    def hold(self, reason: SheetReason, step_s: float) -> PlannedStep:
        """Decelerate the sheet for `step_s` because the finger's position is unknown.

        reason: reason that is published in the target.
        """
        self._advance(None, step_s)
        phase: Phase = "wait" if self._command.phase == "wait" else "hold"
        return self._make_step(
            replace(self._command, phase=phase, reason=reason, twist=np.zeros(6))
        )

    def _advance(self, target: SheetMotion | None, step_s: float) -> None:
        if step_s > MAX_STEP_S:
            self._state = JerkLimitedState.at_rest(self.motion)
        self._state = step_sheet(
            self._state,
            target,
            bounds=self._bounds,
            jerks=self._jerks,
            edges=self._edges,
            step_s=min(step_s, MAX_STEP_S),
        )

    @property
    def motion(self) -> SheetMotion:
        """Return the sheet's planned pose and velocity."""
        return self._state.sheet

    def _make_step(self, command: ContactCommand) -> PlannedStep:
        contact_world = apply(self._world_from_object, command.contact.point)
        contact_sheet = apply(inverse(self.motion.world_from_sheet), contact_world)[:2]
        return PlannedStep(
            self.motion,
            plan_continuation(self.motion, self._bounds),
            command,
            contact_world,
            self._world_from_object[:3, :3] @ command.contact.normal,
            np.ascontiguousarray(contact_sheet),
            self._normal_offset_m,
        )


def plan_continuation(motion: SheetMotion, bounds: SheetBounds) -> SheetTrajectory | None:
    """Return the trajectory that the sheet follows if no newer target arrives.

    The sheet keeps its velocity for a short time and then brakes to rest. Returns None if braking
    would take longer than MAX_BRAKE_S.
    """
    brake_s = max(
        MIN_BRAKE_S,
        measure_length(motion.twist_world[:3]) / bounds.acceleration_m_per_s2,
        measure_length(motion.twist_world[3:]) / bounds.turn_acceleration_rad_per_s2,
    )
    return SheetTrajectory(keep_s=KEEP_S, brake_s=brake_s) if brake_s <= MAX_BRAKE_S else None


def offset_along_normal(sheet: SheetMotion, offset_m: float, rate_m_per_s: float) -> SheetMotion:
    """Move the sheet backwards along its normal by an offset, and change its velocity accordingly.

    rate_m_per_s: rate at which the offset changes.
    """
    normal = sheet.world_from_sheet[:3, 2]
    pose, twist = sheet.world_from_sheet.copy(), sheet.twist_world.copy()
    pose[:3, 3] -= offset_m * normal
    twist[:3] -= rate_m_per_s * normal + offset_m * cross(twist[3:], normal)
    return replace(sheet, world_from_sheet=pose, twist_world=twist)
