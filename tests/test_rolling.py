"""Test rolling without slip or spin on geometries with closed-form results."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from flexsheet.nodes.models.rigid import angle_between, moved
from flexsheet.nodes.models.shapes import (
    CylinderShape,
    EllipsoidShape,
    PlaneShape,
    RoundedBoxShape,
    Shape,
    SphereShape,
)
from flexsheet.nodes.planner.contact_state import (
    RIM_RADIUS_M,
    ContactLimits,
    ContactStateMachine,
)
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

Floats = NDArray[np.float64]
FRONT = np.array([0.0, 0.0, 1.0])
WIDE = 1.0
units = st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: np.linalg.norm(v) > 0.1)


def unit(vector: tuple[float, float, float] | Floats) -> Floats:
    return np.asarray(vector) / np.linalg.norm(vector)


def rolled_along(shape: Shape, start: Floats, points: Floats) -> SheetContact:
    contact = make_tangent_contact(np.eye(3), shape.closest(start), WIDE)
    for point in points:
        contact = roll_contact(contact, shape.closest(point, previous=contact.point))
    return contact


def great_circle(begin: Floats, end: Floats, count: int) -> Floats:
    angle = angle_between(begin, end)
    shares = np.linspace(0.0, 1.0, count)[1:, None]
    return np.asarray(
        (np.sin((1 - shares) * angle) * begin + np.sin(shares * angle) * end) / np.sin(angle)
    )


@given(before=units, after=units)
def test_axes_are_turned_by_the_least_rotation(
    before: tuple[float, float, float], after: tuple[float, float, float]
) -> None:
    axes = transport_axes(np.eye(3), unit(before)) if unit(before)[2] > -0.99 else np.eye(3)
    normal = unit(after)
    angle = angle_between(axes[:, 2], normal)
    if angle > math.pi - 0.05:
        return
    there = transport_axes(axes, normal)
    assert there.T @ there == pytest.approx(np.eye(3), abs=1e-9)
    assert np.linalg.det(there) == pytest.approx(1.0)
    assert there[:, 2] == pytest.approx(normal)
    # A rotation's angle from its trace; the least one that does it is the angle of the normals.
    cosine = 0.5 * (np.trace(there @ axes.T) - 1.0)
    assert math.acos(min(1.0, max(-1.0, cosine))) == pytest.approx(angle, abs=1e-6)


@pytest.mark.parametrize("steps", [12, 600])
def test_arc_and_path_on_the_sheet_are_equal_on_a_cylinder(steps: int) -> None:
    """The error is at most 0.01 mm after 60 degrees, with 600 samples or 12."""
    radius = 0.0353553
    shape = CylinderShape(radius, 0.12)
    angles = np.radians(60.0) * np.arange(1, steps + 1) / steps
    path = np.stack([0.0 * angles, np.sin(angles), np.cos(angles)], axis=1) * radius
    contact = rolled_along(shape, radius * FRONT, path)
    assert contact.position_sheet_m == pytest.approx([0.0, radius * np.radians(60.0)], abs=1e-5)
    back = contact
    for point in [*path[::-1][1:], radius * FRONT]:
        back = roll_contact(back, shape.closest(point))
    assert back.position_sheet_m == pytest.approx([0.0, 0.0], abs=1e-9)


def test_the_path_is_a_straight_line_on_the_unrolled_cylinder() -> None:
    """A helix is a straight line on the sheet: 30 mm along, 40 degrees around."""
    radius = 0.04
    shape = CylinderShape(radius, 0.2)
    share = np.linspace(0.0, 1.0, 400)[1:]
    angle = np.radians(40.0) * share
    path = np.stack([0.03 * share, radius * np.sin(angle), radius * np.cos(angle)], axis=1)
    contact = rolled_along(shape, radius * FRONT, path)
    assert contact.position_sheet_m == pytest.approx([0.03, radius * np.radians(40.0)], abs=1e-7)
    assert measure_spin_rad(contact.axes, np.eye(3)) == pytest.approx(0.0, abs=1e-9)


@given(
    corners=st.lists(st.tuples(st.floats(-0.6, 0.6), st.floats(-0.6, 0.6)), min_size=2, max_size=2),
    radius=st.floats(0.02, 0.2),
)
@settings(max_examples=25, deadline=None)
def test_on_a_sphere_a_closed_triangle_turns_the_sheet_by_its_solid_angle(
    corners: list[tuple[float, float]], radius: float
) -> None:
    """Gauss and Bonnet: to 0.01 degrees."""
    a, (b, c) = FRONT, [unit(np.array([x, y, 1.0])) for x, y in corners]
    if min(angle_between(a, b), angle_between(b, c), angle_between(c, a)) < 0.05:
        return
    # Van Oosterom and Strackee 1983; positive when a, b, c turn counter-clockwise from outside.
    solid_angle = 2.0 * math.atan2(float(np.cross(a, b) @ c), float(1.0 + a @ b + b @ c + c @ a))
    path = radius * np.concatenate([great_circle(*side, 60) for side in ((a, b), (b, c), (c, a))])
    contact = rolled_along(SphereShape(radius), radius * a, path)
    assert contact.point == pytest.approx(radius * a, abs=1e-12)
    turn = math.atan2(contact.axes[1, 0], contact.axes[0, 0])
    assert turn == pytest.approx(solid_angle, abs=math.radians(0.01))


def test_on_a_plane_the_sheet_rests_and_the_finger_goes_over_it() -> None:
    shape = PlaneShape(0.2, 0.2)
    contact = rolled_along(shape, np.zeros(3), np.array([[0.01, 0.0, 0.0], [0.01, 0.02, 0.0]]))
    assert contact.position_sheet_m == pytest.approx([0.01, 0.02])
    assert contact.object_from_sheet == pytest.approx(np.eye(4))
    assert compute_rolling_twist(contact, np.array([0.1, 0.05, 0.0])) == pytest.approx(np.zeros(6))


SHAPES: list[Shape] = [
    CylinderShape(0.035, 0.12),
    SphereShape(0.05),
    EllipsoidShape((0.06, 0.04, 0.05)),
    RoundedBoxShape((0.1, 0.08, 0.06), 0.02),
]


@pytest.mark.parametrize("shape", SHAPES, ids=lambda shape: type(shape).__name__)
def test_a_rolling_sheet_neither_slips_nor_spins(shape: Shape) -> None:
    """Its point that touches is at rest, and it does not turn about the normal there."""
    start = shape.closest(np.array([0.004, 0.01, 0.2]))
    contact = make_tangent_contact(np.eye(3), start, WIDE)
    rate = contact.axes[:, :2] @ np.array([0.03, 0.05])
    twist = compute_rolling_twist(contact, rate)
    middle = contact.object_from_sheet[:3, 3]
    at_touch = twist[:3] + np.cross(twist[3:], contact.point - middle)
    assert at_touch == pytest.approx(np.zeros(3), abs=2e-6)
    assert twist[3:] @ contact.normal == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("shape", SHAPES, ids=lambda shape: type(shape).__name__)
def test_twists_lead_along_the_poses(shape: Shape) -> None:
    start = shape.closest(np.array([0.004, 0.01, 0.2]))
    ready = make_tangent_contact(np.eye(3), start, WIDE)
    rate = ready.axes[:, :2] @ np.array([0.03, 0.05])
    step_s = 0.004
    later = shape.closest(start.point + step_s * rate, previous=start.point)
    for twist, there in (
        (
            compute_tangent_twist(ready, rate, np.eye(3), WIDE),
            make_tangent_contact(np.eye(3), later, WIDE),
        ),
        (compute_rolling_twist(ready, rate), roll_contact(ready, later)),
    ):
        ahead = moved(ready.object_from_sheet, twist, step_s)
        assert ahead == pytest.approx(there.object_from_sheet, abs=3e-5)


@given(place=units, tilt_deg=st.floats(5.0, 80.0))
@settings(max_examples=60, deadline=None)
def test_what_is_presented_is_within_the_tilt_and_as_far_as_it_goes(
    place: tuple[float, float, float], tilt_deg: float
) -> None:
    # Straight behind the object there is no way around it but through its middle.
    assume(math.hypot(*place[:2]) > 0.05)
    shape = EllipsoidShape((0.06, 0.04, 0.05))
    tilt = math.radians(tilt_deg)
    start = shape.closest(np.array([0.0, 0.0, 0.2]))
    found = shape.closest(0.2 * unit(place), previous=start.point)
    allowed, limited = limit_tilt(shape, start, found, FRONT, tilt)
    leaning = angle_between(allowed.normal, FRONT)
    assert leaning <= tilt + 1e-9
    assert limited == (angle_between(found.normal, FRONT) > tilt)
    if limited:
        assert leaning > tilt - math.radians(3.0)


def limits(**changes: float) -> ContactLimits:
    return ContactLimits(
        **{
            "front": FRONT, "max_tilt_rad": 1.2, "max_spin_rad": 0.3, "half_width_m": 0.09,
            "half_height_m": 0.09, "contact_on_m": 0.0005, "contact_off_m": 0.003,
            "max_depth_m": 0.07,
            **changes,
        }  # type: ignore[arg-type]  # one dictionary of both kinds of value
    )  # fmt: skip


def test_the_sheet_is_not_turned_too_far_and_is_free_again_after_a_lift() -> None:
    """Round and round on a sphere's cap rolling turns the sheet; arms cannot."""
    radius = 0.05
    encounter = ContactStateMachine(SphereShape(radius), np.eye(3), limits())
    reasons = set()
    for turn in np.linspace(0.0, 6.0 * np.pi, 700):
        lean = min(0.6, turn)
        place = np.array([np.sin(lean) * np.cos(turn), np.sin(lean) * np.sin(turn), np.cos(lean)])
        shown = encounter.step(
            (radius - 0.001) * place, np.zeros(3), encounter.contact.object_from_sheet
        )
        reasons.add(shown.reason)
        assert abs(measure_spin_rad(shown.contact.axes, np.eye(3))) <= 0.3 + 1e-9
    assert "beyond_spin" in reasons
    lifted = encounter.step(
        (radius + 0.02) * place, np.zeros(3), encounter.contact.object_from_sheet
    )
    assert lifted.phase == "approach"
    assert measure_spin_rad(lifted.contact.axes, np.eye(3)) == pytest.approx(0.0, abs=1e-9)


def test_a_convex_object_needs_no_lift() -> None:
    for shape in SHAPES:
        contact = make_tangent_contact(np.eye(3), shape.closest(np.array([0.0, 0.01, 0.2])), WIDE)
        assert shape.rise_m(contact.point, contact.normal, RIM_RADIUS_M) < 1e-9


def test_over_a_concavity_the_sheet_is_offset_by_the_rim() -> None:
    bottom = np.array([0.0, 0.0, -0.06])
    contact = SheetContact(bottom, FRONT, -np.diag([1.0, 1.0, 0.0]) / 0.06, np.eye(3), np.zeros(2))
    lifted = replace(contact, lift_m=0.002)
    assert lifted.object_from_sheet[:3, 3] == pytest.approx([0.0, 0.0, -0.058])
    assert lifted.height_m(bottom) == pytest.approx(-0.002)
