"""Track the contact between the finger and the virtual object, and compute the sheet's pose.

During the approach, the sheet is in the tangent plane at the surface point nearest to the finger
(Furukawa et al. 2007, Fig. 7a). During contact, the sheet rolls on the object without slip (Fig.
7b).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import hypot

import numpy as np

from flexsheet.messages.errors import FlexsheetError
from flexsheet.messages.types import Phase, SheetReason
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.models.rigid import inverse
from flexsheet.nodes.models.shapes import Nearest, Shape, projection_jacobian, tightest_curvature
from flexsheet.nodes.planner.rolling import (
    SheetContact,
    compute_rolling_twist,
    compute_tangent_twist,
    limit_tilt,
    make_tangent_contact,
    measure_spin_rad,
    roll_contact,
    transport_axes,
)

SHALLOW_RATIO, DEEP_RATIO = 0.15, 0.5
"""Two ratios of the finger's depth to the object's radius of curvature. Below the first ratio, the
contact is the surface point nearest to the finger. Above the second ratio, the contact moves as far
as the finger moves along the sheet."""

MIN_RADIUS_FRACTION = 0.15
"""The minimum distance of a finger from a centre of curvature, as a fraction of the radius of
curvature. Nearer to the centre, the side of the object that the finger touches is ambiguous."""

MIN_CURVATURE_PER_M = 1e-3
MAX_DISTANCE_M, MAX_FINGER_SPEED_M_PER_S = 10.0, 10.0
"""The maximum plausible distance of a finger from the object's origin, and its maximum plausible
speed."""

MAX_TILT_RAD = 1.4
"""The maximum angle (rad) between the sheet's normal and the direction to the user in any scene. It
is less than pi / 2, so two permitted normals are never opposite."""

RIM_RADIUS_M = 0.03
"""The radius around the contact in which a finger deforms the sheet."""

MIN_LIFT_M = 2e-4
"""The height (m) above the contact's tangent plane beyond which the surface around a contact is
reported as concave."""


@dataclass(frozen=True, slots=True)
class ContactLimits:
    """The limits of the sheet's motion and the thresholds of contact.

    front: unit vector (3,) from the object towards the user.
    max_tilt_rad: maximum angle between `front` and the surface normal at a contact.
    max_spin_rad: maximum rotation of the sheet about its normal by rolling.
    half_width_m, half_height_m: maximum |x| and |y| of a contact on the sheet.
    contact_on_m, contact_off_m: distances from the sheet at which contact begins and ends.
    max_depth_m: depth beyond which a finger has passed through the object.
    """

    front: Floats
    max_tilt_rad: float
    max_spin_rad: float
    half_width_m: float
    half_height_m: float
    contact_on_m: float
    contact_off_m: float
    max_depth_m: float


@dataclass(frozen=True, slots=True)
class ContactCommand:
    """The commanded contact of the sheet with the object, and the motion of the sheet.

    twist: velocity (6,) of the sheet's centre in the object's frame, m/s and rad/s.
    """

    phase: Phase
    reason: SheetReason
    contact: SheetContact
    twist: Floats
    push_depth_m: float


class UnpresentableError(FlexsheetError, ValueError):
    """The error raised if the sheet cannot render an object."""

    remedy = "Make the object larger or smoother, or the sheet wider."


class ContactStateMachine:
    """A state machine of the finger's contact with the object.

    home: axes (3, 3) of the sheet before the first contact; the third axis is the sheet's normal.

    Raises UnpresentableError if the tilt of the object's front exceeds the maximum.
    """

    def __init__(self, shape: Shape, home: Floats, limits: ContactLimits) -> None:
        max_tilt_rad = min(limits.max_tilt_rad, MAX_TILT_RAD)
        self._shape, self._home = shape, home
        self._limits = replace(limits, max_tilt_rad=max_tilt_rad)
        first = shape.closest(10.0 * limits.front)
        if first.normal @ limits.front < np.cos(max_tilt_rad):
            lean_deg = np.degrees(np.arccos(first.normal @ limits.front))
            raise UnpresentableError(
                f"the object's front faces {lean_deg:.0f} degrees away from the user, but the "
                f"sheet can tilt by at most {np.degrees(max_tilt_rad):.0f} degrees; rotate the "
                "object: change object.world_from_object in the scene"
            )
        self.contact = make_tangent_contact(home, first, limits.half_width_m)
        self._in_contact = False
        self._finger = np.zeros(3)
        self._nearest_point = first.point

    def step(self, finger: Floats, velocity: Floats, object_from_sheet: Floats) -> ContactCommand:
        """Return the contact command for a finger position (3,), m, and velocity (3,), m/s.

        object_from_sheet: the sheet's present pose (4, 4), from which a new contact starts.
        """
        limits = self._limits
        if not (_norm(finger) <= MAX_DISTANCE_M and _norm(velocity) <= MAX_FINGER_SPEED_M_PER_S):
            return self._hold("implausible_input", 0.0)
        if self._in_contact and self.contact.height_m(finger) > limits.contact_off_m:
            self._in_contact = False
        if self._in_contact:
            return self._roll(finger, velocity)
        found = self._shape.closest(finger, previous=self._nearest_point)
        self._nearest_point = found.point
        if found.height_m < 0.0 and (found.undecided or _is_too_deep(found)):
            return self._hold("ambiguous_side", float(-found.height_m))
        rate = _nearest_point_rate(found, velocity)
        allowed, limited = limit_tilt(
            self._shape, self.contact.nearest, found, limits.front, limits.max_tilt_rad
        )
        self.contact = self._lift(make_tangent_contact(self._home, allowed, limits.half_width_m))
        near = self.contact.height_m(finger) <= limits.contact_on_m
        if near and not limited and not found.on_edge:
            self.contact = self._begin_contact(self.contact, object_from_sheet)
            self._in_contact, self._finger = True, finger
            return self._roll(finger, velocity)
        twist = (
            np.zeros(6)
            if limited
            else compute_tangent_twist(self.contact, rate, self._home, limits.half_width_m)
        )
        reason: SheetReason = (
            "beyond_tilt"
            if limited
            else "past_object_edge"
            if found.on_edge
            else self._concavity_reason()
        )
        return ContactCommand("approach", reason, self.contact, twist, 0.0)

    def _begin_contact(self, contact: SheetContact, object_from_sheet: Floats) -> SheetContact:
        """Return the contact that begins when the finger touches the sheet.

        object_from_sheet: the sheet's present pose (4, 4).
        """
        limit = np.array([self._limits.half_width_m, self._limits.half_height_m])
        point_sheet = inverse(object_from_sheet) @ np.append(contact.point, 1.0)
        axes = transport_axes(object_from_sheet[:3, :3], contact.normal)
        return replace(contact, axes=axes, position_sheet_m=np.clip(point_sheet[:2], -limit, limit))

    def _roll(self, finger: Floats, velocity: Floats) -> ContactCommand:
        contact, limits = self.contact, self._limits
        depth = max(0.0, -contact.height_m(finger))
        moved, self._finger = finger - self._finger, finger
        if depth > limits.max_depth_m:
            return self._hold("through_object", depth)
        found = self._shape.closest(finger, previous=self._nearest_point)
        self._nearest_point = found.point
        if found.on_edge:
            return self._hold("past_object_edge", depth)
        found, rate = self._blend_contact(found, moved, velocity, depth)
        allowed, limited = limit_tilt(
            self._shape, contact.nearest, found, limits.front, limits.max_tilt_rad
        )
        rolled, past = self._roll_within_sheet(contact, allowed)
        if abs(measure_spin_rad(rolled.axes, self._home)) > limits.max_spin_rad:
            return self._hold("beyond_spin", depth)
        self.contact = self._lift(rolled)
        if past is not None or limited:
            return self._hold(past or "beyond_tilt", depth)
        # Deep inside the object the nearest point is arbitrary; start the next search here.
        self._nearest_point = self.contact.point
        twist = compute_rolling_twist(self.contact, rate)
        return ContactCommand("contact", self._concavity_reason(), self.contact, twist, depth)

    def _blend_contact(
        self, found: Nearest, moved: Floats, velocity: Floats, depth: float
    ) -> tuple[Nearest, Floats]:
        """Return the surface point to which the contact moves, and its velocity (3,) m/s.

        found: surface point nearest to the finger.
        moved: displacement (3,) m of the finger since the last step.
        velocity, depth: velocity (3,) m/s and depth (m) of the finger.

        At small depths, the contact is the surface point nearest to the finger. Deep inside the
        object, the contact moves as far as the finger moves along the sheet. Both motions are
        blended in between.
        """
        normal = self.contact.normal
        tangential = np.eye(3) - np.outer(normal, normal)
        curvature = max(float(tightest_curvature(self.contact.shape_operator)), MIN_CURVATURE_PER_M)
        weight = (DEEP_RATIO - depth * curvature) / (DEEP_RATIO - SHALLOW_RATIO)
        weight = min(max(weight, 0.0), 1.0)
        rate = (1.0 - weight) * (tangential @ velocity)
        if weight > 0.0:
            rate = rate + weight * _nearest_point_rate(found, velocity)
        if weight == 1.0:
            return found, rate
        dragged = self.contact.point + tangential @ moved
        target = weight * found.point + (1.0 - weight) * dragged
        return self._shape.closest(target, previous=self.contact.point), rate

    def _roll_within_sheet(
        self, contact: SheetContact, found: Nearest
    ) -> tuple[SheetContact, SheetReason | None]:
        """Roll the sheet on the object until the contact is at the surface point `found`.

        The contact must stay within the usable area of the sheet. Returns the new contact, and the
        limit at which the rolling stopped, or None if `found` was reached.
        """
        rolled = roll_contact(contact, found)
        limit = np.array([self._limits.half_width_m, self._limits.half_height_m])
        excess = np.abs(rolled.position_sheet_m) - limit
        if (excess <= 0.0).all():
            return rolled, None
        axis = int(np.argmax(excess))
        before, after = contact.position_sheet_m[axis], rolled.position_sheet_m[axis]
        fraction = (np.copysign(limit[axis], after) - before) / (after - before)
        target = contact.point + fraction * (found.point - contact.point)
        rolled = roll_contact(contact, self._shape.closest(target, previous=contact.point))
        rolled = replace(rolled, position_sheet_m=np.clip(rolled.position_sheet_m, -limit, limit))
        return rolled, "past_sheet_width" if axis == 0 else "past_sheet_height"

    def _lift(self, contact: SheetContact) -> SheetContact:
        """Return a copy of a contact in which the sheet does not cut into a concave surface.

        At a concave point, the surrounding surface rises above the tangent plane. The sheet is
        lifted from this plane by the height of the surrounding surface.
        """
        lift_m = self._shape.rise_m(contact.point, contact.normal, RIM_RADIUS_M)
        return replace(contact, lift_m=lift_m)

    def _concavity_reason(self) -> SheetReason:
        return "concave_contact" if self.contact.lift_m > MIN_LIFT_M else "ok"

    def _hold(self, reason: SheetReason, depth: float) -> ContactCommand:
        return ContactCommand("hold", reason, self.contact, np.zeros(6), max(0.0, depth))


def _is_too_deep(found: Nearest) -> bool:
    curvature = tightest_curvature(found.shape_operator)
    return bool(1.0 + found.height_m * curvature < MIN_RADIUS_FRACTION)


def _nearest_point_rate(found: Nearest, velocity: Floats) -> Floats:
    """Return the velocity (3,) m/s of the surface point that is nearest to a moving finger.

    The velocity would be infinite at a centre of curvature, and is therefore limited.
    """
    try:
        rate = projection_jacobian(found) @ velocity
    except np.linalg.LinAlgError:
        return np.zeros(3)
    limit, speed = _norm(velocity) / MIN_RADIUS_FRACTION, _norm(rate)
    return np.asarray(rate if speed <= limit else rate * (limit / speed))


def _norm(vector: Floats) -> float:
    """Return the length of a vector (3,); it is not finite if an element is not finite."""
    return hypot(*vector.tolist())
