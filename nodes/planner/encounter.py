"""The finger's dealings with the object: away (the paper's Fig. 7a), in touch (7b), and back."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import hypot

import numpy as np
from numpy.typing import NDArray

from flexsheet.messages.errors import FlexsheetError
from flexsheet.messages.types import Phase
from flexsheet.nodes.models.rigid import inverse
from flexsheet.nodes.models.shapes import Nearest, Shape, projection_jacobian, tightest_curvature
from flexsheet.nodes.planner.rolling import (
    Contact,
    rim_lift_m,
    rolled,
    rolling_twist,
    spin_rad,
    tangent,
    tangent_twist,
    turned,
    within_tilt,
)

Floats = NDArray[np.float64]

NO_SIDE = "finger inside the object, on no side of it"
THROUGH = "finger through the object"
PAST_EDGE = "finger past the object's edge"
NOWHERE = "finger's place or velocity is no hand's"
BEYOND_TILT = "finger beyond the tilt that the arms present"
BEYOND_SPIN = "sheet turned too far about its normal; lift the finger"
HOLLOW = "hollow place: the flat sheet rests on its rim"

SHALLOW, DEEP = 0.15, 0.5
"""Depths over the radius of curvature: up to the first the surface point nearest to the finger
counts, from the second on how far the finger moves along the sheet."""

INNERMOST = 0.15
"""A finger nearer to a centre of curvature than this share of the radius is on no side of it."""

FLATTEST_PER_M = 1e-3
FARTHEST_M, FASTEST_M_PER_S = 10.0, 10.0
"""A finger farther from the object or faster than that is a mistake."""

STEEPEST_RAD = 1.4
"""No sheet is turned further from the front, whatever the scene: two normals both within it are
never opposite, and from one to the other there is one shortest way."""

HOLLOW_M = 2e-4
"""Rims lower than this are left to the sheet's own give."""


@dataclass(frozen=True, slots=True)
class Reach:
    """How far the sheet can go, and when the finger counts as touching.

    front: unit normal (3,) of the side that is presented; tilt_rad: most that a normal leans off.
    spin_rad: most that the sheet may be turned about its normal by rolling.
    half_width_m, half_height_m: largest |x| and |y| at which the sheet can be touched.
    touch_m, release_m: distances from the sheet (m) at which contact begins and ends.
    deepest_m: a finger deeper than this has gone through the object.
    """

    front: Floats
    tilt_rad: float
    spin_rad: float
    half_width_m: float
    half_height_m: float
    touch_m: float
    release_m: float
    deepest_m: float


@dataclass(frozen=True, slots=True)
class Presentation:
    """What to present: the sheet at a contact, and how it moves there.

    twist: (6,) of the sheet's middle in the object's frame.
    """

    phase: Phase
    reason: str
    contact: Contact
    twist: Floats
    push_depth_m: float


class UnpresentableError(FlexsheetError, ValueError):
    """An object that no sheet can be presented to; the message says why and what to change."""

    code = "unpresentable"
    remedy = "Make the object larger or smoother, or the sheet wider."


class Encounter:
    """What the sheet presents to one finger, step by step."""

    def __init__(self, shape: Shape, home: Floats, reach: Reach) -> None:
        """home: the sheet's axes (3, 3) when it waits, the third near `reach.front`.

        UnpresentableError for an object that turns no side to the front.
        """
        tilt_rad = min(reach.tilt_rad, STEEPEST_RAD)
        self._shape, self._home, self._reach = shape, home, replace(reach, tilt_rad=tilt_rad)
        first = shape.closest(10.0 * reach.front)
        if first.normal @ reach.front < np.cos(tilt_rad):
            lean_deg = np.degrees(np.arccos(first.normal @ reach.front))
            raise UnpresentableError(
                f"the object's front leans {lean_deg:.0f} degrees away from the user, the sheet at "
                f"most {np.degrees(tilt_rad):.0f}; turn it by object.world_from_object"
            )
        self.contact = tangent(home, first, reach.half_width_m)
        self._touching = False
        self._finger = np.zeros(3)
        self._foot = first.point

    def step(self, finger: Floats, velocity: Floats, object_from_sheet: Floats) -> Presentation:
        """What to present to a finger (3,) m that moves with `velocity` (3,) m/s.

        object_from_sheet: where the sheet is now; a contact that begins takes it as it is.
        """
        if not (_size(finger) <= FARTHEST_M and _size(velocity) <= FASTEST_M_PER_S):
            return self._hold(NOWHERE, 0.0)
        if self._touching and self.contact.height_m(finger) > self._reach.release_m:
            self._touching = False
        if self._touching:
            return self._roll(finger, velocity)
        found = self._shape.closest(finger, previous=self._foot)
        self._foot = found.point
        if found.height_m < 0.0 and (found.undecided or self._too_deep(found)):
            return self._hold(NO_SIDE, float(-found.height_m))
        rate = _foot_rate(found, velocity)
        allowed, limited = within_tilt(
            self._shape, self.contact.place, found, self._reach.front, self._reach.tilt_rad
        )
        self.contact = self._lifted(tangent(self._home, allowed, self._reach.half_width_m))
        near = self.contact.height_m(finger) <= self._reach.touch_m
        if near and not limited and not found.on_edge:
            self.contact = self._begun(self.contact, object_from_sheet)
            self._touching, self._finger = True, finger
            return self._roll(finger, velocity)
        twist = (
            np.zeros(6)
            if limited
            else tangent_twist(self.contact, rate, self._home, self._reach.half_width_m)
        )
        reason = BEYOND_TILT if limited else PAST_EDGE if found.on_edge else self._hollow()
        return Presentation("approach", reason, self.contact, twist, 0.0)

    def _begun(self, contact: Contact, object_from_sheet: Floats) -> Contact:
        """The contact with the sheet as it is now: which of its points is there, how it is turned.

        A sheet on its way to the finger is met where it is; it neither slips nor spins from then.
        """
        most = np.array([self._reach.half_width_m, self._reach.half_height_m])
        place = inverse(object_from_sheet) @ np.append(contact.point, 1.0)
        axes = turned(object_from_sheet[:3, :3], contact.normal)
        return replace(contact, axes=axes, on_sheet=np.clip(place[:2], -most, most))

    def _roll(self, finger: Floats, velocity: Floats) -> Presentation:
        """In touch: roll to the finger, or say what keeps the sheet from it."""
        contact = self.contact
        depth = max(0.0, -contact.height_m(finger))
        moved, self._finger = finger - self._finger, finger
        if depth > self._reach.deepest_m:
            return self._hold(THROUGH, depth)
        found = self._shape.closest(finger, previous=self._foot)
        self._foot = found.point
        if found.on_edge:
            return self._hold(PAST_EDGE, depth)
        found, rate = self._carried(found, moved, velocity, depth)
        allowed, limited = within_tilt(
            self._shape, contact.place, found, self._reach.front, self._reach.tilt_rad
        )
        there, past = self._on_sheet(contact, allowed)
        if abs(spin_rad(there.axes, self._home)) > self._reach.spin_rad:
            return self._hold(BEYOND_SPIN, depth)
        self.contact = self._lifted(there)
        if past or limited:
            return self._hold(past or BEYOND_TILT, depth)
        # Deep inside, where nearest means little, the side is kept that the sheet is on.
        self._foot = self.contact.point
        twist = rolling_twist(self.contact, rate)
        return Presentation("contact", self._hollow(), self.contact, twist, depth)

    def _carried(
        self, found: Nearest, moved: Floats, velocity: Floats, depth: float
    ) -> tuple[Nearest, Floats]:
        """Where a finger in touch carries the contact, and at what rate (3,) m/s.

        On the surface that is the nearest point.  Deep inside, which point is nearest means little
        (at the axis every side is as near), and what the finger feels is the dented sheet; there
        the sheet rolls by how far the finger moves along it.  In between the two are blended, so
        that stroking while pushing makes no step.
        """
        normal = self.contact.normal
        along = np.eye(3) - np.outer(normal, normal)
        bent = tightest_curvature(self.contact.shape_operator)
        share = (DEEP - depth * max(float(bent), FLATTEST_PER_M)) / (DEEP - SHALLOW)
        share = min(max(share, 0.0), 1.0)
        rate = (1.0 - share) * (along @ velocity)
        if share > 0.0:
            rate = rate + share * _foot_rate(found, velocity)
        if share == 1.0:
            return found, rate
        dragged = self.contact.point + along @ moved
        place = share * found.point + (1.0 - share) * dragged
        return self._shape.closest(place, previous=self.contact.point), rate

    def _on_sheet(self, contact: Contact, found: Nearest) -> tuple[Contact, str]:
        """The sheet rolled to a point, or as far as it reaches there and what ends it."""
        there = rolled(contact, found)
        most = np.array([self._reach.half_width_m, self._reach.half_height_m])
        over = np.abs(there.on_sheet) - most
        if (over <= 0.0).all():
            return there, ""
        axis = int(np.argmax(over))
        before, after = contact.on_sheet[axis], there.on_sheet[axis]
        share = (np.copysign(most[axis], after) - before) / (after - before)
        place = contact.point + share * (found.point - contact.point)
        there = rolled(contact, self._shape.closest(place, previous=contact.point))
        there = replace(there, on_sheet=np.clip(there.on_sheet, -most, most))
        return there, f"finger past the sheet's usable {('width', 'height')[axis]}"

    def _too_deep(self, found: Nearest) -> bool:
        """Whether a finger that comes anew is so far inside that it is on no side."""
        bent = tightest_curvature(found.shape_operator)
        return bool(1.0 + found.height_m * bent < INNERMOST)

    def _lifted(self, contact: Contact) -> Contact:
        """The contact standing off by as much as the object rises around it."""
        return replace(contact, lift_m=rim_lift_m(self._shape, contact))

    def _hollow(self) -> str:
        return HOLLOW if self.contact.lift_m > HOLLOW_M else ""

    def _hold(self, reason: str, depth: float) -> Presentation:
        return Presentation("hold", reason, self.contact, np.zeros(6), max(0.0, depth))


def _foot_rate(found: Nearest, velocity: Floats) -> Floats:
    """Rate (3,) m/s of the nearest point.

    Near a centre of curvature, where it would leap, it is bounded as by `INNERMOST`; there it is 0.
    """
    try:
        rate = projection_jacobian(found) @ velocity
    except np.linalg.LinAlgError:
        return np.zeros(3)
    most, size = _size(velocity) / INNERMOST, _size(rate)
    return np.asarray(rate if size <= most else rate * (most / size))


def _size(vector: Floats) -> float:
    """Length of a vector (3,); NaN and infinity stay what they are."""
    return hypot(*vector.tolist())
