"""Test that the sheet complies like the object: position, smoothness and reports."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from flexsheet.launch.calibration.simulated_sheet import simulate_push
from flexsheet.messages.types import SheetTarget, SoftBody
from flexsheet.nodes.models.motion import SheetMotion
from flexsheet.nodes.models.rigid import moved
from flexsheet.nodes.models.sheet.force_models import (
    ScaledSheetModel,
    SheetPush,
    make_model,
)
from flexsheet.nodes.planner.compliance import TARGET_ERROR_RATIO, UnfitCurveError
from flexsheet.nodes.planner.compliance_controller import ComplianceController
from flexsheet.nodes.planner.sheet_force import make_force_model, make_rubber
from flexsheet.nodes.planner.trajectory import offset_along_normal
from tests.examples import long_except
from tests.note_text import note_text
from tests.test_planner import FRAME_NS, SCENE, Table, in_world, on_cylinder, table
from tests.twists import twist_between

Floats = NDArray[np.float64]
STEP_S = FRAME_NS * 1e-9
RADIUS = SCENE.finger.radius_m


def object_force_n(depths: Floats, scale: float = 1.0) -> Floats:
    """Return a force like the demo's soft cylinder's: soft at first, then some 58 N/m."""
    return np.asarray(scale * 58.0 * (depths + 0.002 * np.expm1(-depths / 0.002)))


def soft_body(scale: float = 1.0) -> SoftBody:
    depths = 0.05 * np.linspace(0.0, 1.0, 15) ** 1.5
    return SoftBody(
        mesh_id="m",
        method="test",
        in_range=True,
        push_depth_m=0.0,
        force_world_n=np.zeros(3),
        stiffness_n_per_m=58.0 * scale,
        force_curve=np.column_stack([depths, object_force_n(depths, scale)]),
        displacement_world_m=np.zeros((4, 3), dtype=np.float32),
    )


def stands_behind_m(target: SheetTarget) -> float:
    """Return the distance of the sheet's plane behind the object's tangent plane at the contact."""
    sheet = target.world_from_sheet
    return float((target.contact_world_m - sheet[:3, 3]) @ sheet[:3, 2])


async def pressed(desk: Table, angle_deg: float, depth_m: float, scale: float = 1.0) -> SheetTarget:
    """Let the finger approach, touch, and rest at a depth."""
    await desk.planner.step("soft_body", soft_body(scale), desk.header())
    for height in (0.03, 0.0, -0.5 * depth_m):
        await desk.rest_at(in_world(on_cylinder(angle_deg, height)), 90)
    return await desk.rest_at(in_world(on_cylinder(angle_deg, -depth_m)), 200)


@pytest.mark.parametrize("depth_m", [0.005, 0.02, 0.045])
@pytest.mark.parametrize("scale", long_except([0.4, 1.0], 1.0))
async def test_a_finger_meets_the_objects_force_by_the_twins_sheet(
    depth_m: float, scale: float
) -> None:
    desk = await table()
    target = await pressed(desk, 20.0, depth_m, scale)
    assert target.push_depth_m == pytest.approx(depth_m, abs=1e-9)
    indentation_m = depth_m - stands_behind_m(target)
    x, y = target.contact_sheet_m
    force_n, pull_n = simulate_push(
        SCENE.sheet, target.stretch_ratio, indentation_m, (float(x), float(y)), RADIUS, cells=24
    )
    assert force_n == pytest.approx(
        float(object_force_n(np.array(depth_m), scale)), rel=TARGET_ERROR_RATIO
    )
    assert pull_n < SCENE.sheet.max_edge_force_n
    assert note_text(desk.planner) == "sheet force model: table"


async def test_what_is_published_as_retreat_is_where_the_sheet_comes_to_rest() -> None:
    target = await pressed(await table(), -15.0, 0.03)
    assert target.normal_offset_m > 0.005
    assert stands_behind_m(target) == pytest.approx(target.normal_offset_m, abs=1e-6)


@pytest.mark.parametrize("depth_m", [0.0002, 0.0004])
async def test_the_sheet_does_not_move_towards_a_finger_on_a_stiff_object(
    depth_m: float,
) -> None:
    desk = await table()
    await desk.planner.step("soft_body", soft_body(4.0), desk.header())
    await desk.rest_at(in_world(on_cylinder(0.0, 0.0)), 90)
    target = await desk.rest_at(in_world(on_cylinder(0.0, -depth_m)), 200)
    assert target.phase == "contact"
    # Presenting it right would take an advance of half the depth.
    assert abs(stands_behind_m(target)) < 0.1 * depth_m


async def test_pushing_and_stroking_make_no_step_and_keep_the_bounds() -> None:
    """The finger goes deep while it strokes, lifts and returns: the paper's open problem."""
    desk = await table()
    await desk.planner.step("soft_body", soft_body(), desk.header())
    given = desk.planner.parameters
    targets = []
    for frame in range(600):
        time_s = frame * STEP_S
        angle = 30.0 * np.sin(0.6 * time_s)
        height = -0.03 * np.sin(1.1 * time_s) ** 3
        targets.append(await desk.see(in_world(on_cylinder(float(angle), float(height)))))
        softness = 1.0 - 0.2 * abs(np.sin(0.6 * time_s))
        await desk.planner.step("soft_body", soft_body(softness), desk.header())
    phases = [target.phase for target in targets]
    assert "contact" in phases
    assert "approach" in phases
    places = np.array([target.world_from_sheet[:3, 3] for target in targets])
    # The finger is predicted ahead by a lead that is found as it goes: the steps differ in length.
    times = np.array([target.valid_at_ns for target in targets]) * 1e-9
    speeds = np.linalg.norm(np.diff(places, axis=0), axis=1) / np.diff(times)
    assert speeds.max() <= given.speed_m_per_s * (1.0 + 1e-6)
    velocities = np.diff(places, axis=0) / np.diff(times)[:, None]
    changes = np.linalg.norm(np.diff(velocities, axis=0), axis=1) / np.diff(times)[1:]
    assert changes[5:].max() <= given.acceleration_m_per_s2 * (1.0 + 1e-3)
    retreats = np.array([target.normal_offset_m for target in targets])
    assert retreats.max() > 0.005


async def test_the_same_curve_again_changes_nothing_and_another_does() -> None:
    compliance = ComplianceController(SCENE, make_force_model(SCENE.sheet), "force_curve")
    compliance.update(soft_body(), in_contact=False)
    first = compliance.normal_offset(0.03, (0.0, 0.0))
    compliance.update(soft_body(1.005), in_contact=False)
    assert compliance.normal_offset(0.03, (0.0, 0.0)) == first
    compliance.update(soft_body(0.7), in_contact=False)
    assert compliance.normal_offset(0.03, (0.0, 0.0))[0] > first[0]


def test_a_law_that_is_asked_beyond_its_range_is_named_with_the_reason() -> None:
    for depth_m in (0.002, 0.05):
        working_range = SCENE.working_range.model_copy(update={"push_depth_m": depth_m})
        scene = SCENE.model_copy(update={"working_range": working_range})
        asked = ScaledSheetModel(make_rubber(scene.sheet))
        compliance = ComplianceController(scene, asked, "force_curve")
        compliance.update(soft_body(), in_contact=False)
        indentation_m = depth_m - compliance.normal_offset(depth_m, (0.0, 0.0))[0]
        why = asked.invalid_reason(SheetPush(compliance.stretch_ratio, RADIUS), indentation_m)
        words = f"the sheet force model {asked.name} is not valid here: {why}"
        assert bool(why) == (words in compliance.note)
        assert compliance.note.endswith(why)
        assert bool(why) == (depth_m < 0.01)


async def test_in_touch_the_stretch_stays_and_the_retreat_makes_up_for_it() -> None:
    law = make_force_model(SCENE.sheet)
    compliance = ComplianceController(SCENE, law, "force_curve")
    compliance.update(soft_body(), in_contact=False)
    before, back = compliance.stretch_ratio, compliance.normal_offset(0.03, (0.0, 0.0))[0]
    compliance.update(soft_body(0.3), in_contact=True)
    assert compliance.stretch_ratio == before
    assert compliance.normal_offset(0.03, (0.0, 0.0))[0] > back + 0.005
    compliance.update(soft_body(0.29), in_contact=False)
    assert compliance.stretch_ratio < before


async def test_a_soft_body_without_a_curve_changes_nothing() -> None:
    compliance = ComplianceController(SCENE, make_force_model(SCENE.sheet), "force_curve")
    untold = soft_body().model_copy(update={"force_curve": np.zeros((0, 2))})
    compliance.update(untold, in_contact=False)
    assert compliance.normal_offset(0.03, (0.0, 0.0)) == (0.0, 0.0)
    assert compliance.stretch_ratio == SCENE.sheet.min_stretch_ratio
    compliance.update(soft_body(), in_contact=False)
    kept = compliance.normal_offset(0.03, (0.0, 0.0))
    compliance.update(untold, in_contact=False)
    falling = soft_body().model_copy(
        update={"force_curve": np.array([[0.0, 0.0], [0.01, 2.0], [0.02, 1.0]])}
    )
    with pytest.raises(UnfitCurveError, match="forces must not fall"):
        compliance.update(falling, in_contact=False)
    assert compliance.normal_offset(0.03, (0.0, 0.0)) == kept


@pytest.mark.parametrize(("scale", "words"), [(0.0005, "too soft for"), (30.0, "stiffer than")])
async def test_what_the_sheet_cannot_render_is_reported(scale: float, words: str) -> None:
    desk = await table()
    await desk.planner.step("soft_body", soft_body(scale), desk.header())
    assert f"object is {words} the" in note_text(desk.planner)


async def test_a_calibrated_sheet_is_planned_with() -> None:
    thin = make_model(
        make_rubber(SCENE.sheet),
        modulus_thickness_n_per_m=700.0,
        slack_width_m=SCENE.sheet.width_m,
        cubic_ratio=1.0,
    )
    ideal, calibrated = (
        ComplianceController(SCENE, law, "force_curve")
        for law in (make_force_model(SCENE.sheet), thin)
    )
    for compliance in (ideal, calibrated):
        compliance.update(soft_body(0.5), in_contact=False)
    assert calibrated.stretch_ratio > ideal.stretch_ratio


@settings(max_examples=50, deadline=None)
@given(
    st.floats(-0.02, 0.05),
    st.floats(-0.2, 0.2),
    st.lists(st.floats(-0.3, 0.3), min_size=6, max_size=6),
)
def test_the_twist_of_a_withdrawn_sheet_is_how_it_moves(
    normal_offset_m: float, rate: float, twist: list[float]
) -> None:
    sheet = SheetMotion(np.eye(4), np.array(twist), 1.05, 0.0)
    step_s = 1e-4
    shown = offset_along_normal(sheet, normal_offset_m, rate)
    poses = []
    for time_s in (-step_s, step_s):
        pose = moved(sheet.world_from_sheet, sheet.twist_world, time_s)
        then = SheetMotion(pose, sheet.twist_world, 1.05, 0.0)
        poses.append(
            offset_along_normal(then, normal_offset_m + rate * time_s, rate).world_from_sheet
        )
    assert shown.twist_world == pytest.approx(
        twist_between(poses[0], poses[1], 2.0 * step_s), abs=1e-6
    )
    assert shown.world_from_sheet[:3, 2] == pytest.approx(sheet.world_from_sheet[:3, 2])
