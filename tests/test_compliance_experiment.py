"""Test the evaluation of the rendered force from a recording, with a known sheet."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from flexsheet.launch.calibration.simulated_sheet import simulate_force
from flexsheet.launch.experiments import ExperimentError
from flexsheet.launch.experiments.compliance import (
    DEPTHS_M,
    EVALUATED_S,
    HOLD_S,
    POSITIONS_M,
    ComplianceRecording,
    ForceReference,
    ForceSample,
    Press,
    make_presses,
    read_bag,
)
from flexsheet.launch.experiments.force_reference import ReferenceForce, find_reference_curve
from flexsheet.launch.experiments.stroke import SampledMotion
from flexsheet.launch.plans.plan import load_scene
from flexsheet.messages.bag import BagWriter
from flexsheet.nodes.models.rigid import inverse, transform, transform_from_rpy
from flexsheet.nodes.planner.compliance import FORCE_JND_FLOOR_N
from tests.scenes import make_weightless

Floats = NDArray[np.float64]
DEMO = Path(__file__).parent.parent / "launch" / "demo.yaml"
SCENE = make_weightless(load_scene(DEMO.parent / "scenes" / "cylinder.yaml"))
TIMES = np.array([0, 1_000_000_000], dtype=np.int64)
STRETCH = 1.06
CURVE = np.array([[0.0, 0.0], [0.02, 1.0], [0.05, 2.5]])


def held(press: Press, depth_m: float, normal_offset_m: float) -> ComplianceRecording:
    """Simulate a finger at rest at a depth, with the sheet at a distance behind the tangent
    plane."""
    tip = press.surface - depth_m * press.normal
    y_axis = np.cross(press.normal, [1.0, 0.0, 0.0])
    axes = np.column_stack([[1.0, 0.0, 0.0], y_axis, press.normal])
    middle = press.surface - normal_offset_m * press.normal
    half = 0.5 * STRETCH * SCENE.sheet.width_m * axes[:, 0]
    rows = []
    for side, arm in ((-1.0, SCENE.arms.left), (1.0, SCENE.arms.right)):
        pose = arm.flange_from_edge
        clamp = transform_from_rpy(pose.position_m, pose.rpy_rad)
        flange = transform(axes, middle + side * half) @ inverse(clamp)
        rows.append(SampledMotion(TIMES, np.tile(flange.ravel(), (2, 1))))
    return ComplianceRecording(
        scene=SCENE,
        finger=SampledMotion(TIMES, np.tile(tip, (2, 1))),
        windows_ns={},
        edges=(rows[0], rows[1]),
        curve_times_ns=[0],
        curves=[CURVE],
        methods=["linear"],
    )


@pytest.mark.parametrize(
    "press",
    [
        pytest.param(press, marks=pytest.mark.long if number else ())
        for number, press in enumerate(make_presses(SCENE)[::2])
    ],
    ids=lambda press: press.path.label,
)
@pytest.mark.parametrize(
    ("depth_m", "normal_offset_m"), [(0.02, 0.0), (0.045, 0.02), (0.005, -0.002)]
)
def test_the_simulated_sheet_gives_the_rendered_force(
    press: Press, depth_m: float, normal_offset_m: float
) -> None:
    felt = ForceReference(held(press, depth_m, normal_offset_m)).evaluate(500_000_000, press)
    assert felt.depth_m == pytest.approx(depth_m, abs=1e-9)
    assert felt.normal_offset_m == pytest.approx(normal_offset_m, abs=1e-9)
    assert felt.wanted_n == pytest.approx(50.0 * depth_m, rel=1e-6)
    alone = simulate_force(
        SCENE.sheet, STRETCH, depth_m - normal_offset_m, (float(press.surface[0]), 0.0), 0.007
    )
    assert felt.felt_n == pytest.approx(alone, rel=0.02)


def test_a_finger_past_the_middle_is_as_deep_as_it_was_pushed() -> None:
    press = make_presses(SCENE)[0]
    deep_m = 1.3 * SCENE.object.geometry.radius_m
    assert ForceReference(held(press, deep_m, 0.02)).evaluate(0, press).depth_m == pytest.approx(
        deep_m
    )


def test_errors_of_what_cannot_be_felt_count_as_of_the_least_felt() -> None:
    assert ForceSample(0.01, 2.0, 2.2, 0.0, "linear").error_ratio == pytest.approx(0.1)
    light = ForceSample(0.0001, 0.0, 0.5 * FORCE_JND_FLOOR_N, 0.0, "linear")
    assert light.error_ratio == pytest.approx(0.5)


def test_the_felt_force_is_compared_with_the_independent_reference() -> None:
    sample = ForceSample(0.01, 1.25, 1.1, 0.0, "linear", ReferenceForce(1.0, 0.01))
    assert sample.error_ratio == pytest.approx(0.1)
    assert sample.model_error_ratio == pytest.approx(0.25)


def test_the_reference_is_found_for_scaled_scenes_and_its_positions_only(tmp_path: Path) -> None:
    geometry, finger = SCENE.object.geometry, SCENE.finger.radius_m
    curve = {
        "radius": geometry.radius_m / finger,
        "length": geometry.length_m / finger,
        "support_angle_rad": SCENE.object.support.angle_rad,
        "poisson_ratio": SCENE.object.material.poisson_ratio,
        "along": 0.0,
        "angle_rad": 0.0,
        "depths": [0.1, 0.5, 1.0, 2.0],
        "forces": [0.1**1.5, 0.5**1.5, 1.0, 2.0**1.5],
        "uncertainty_ratio": [0.04, 0.02, 0.01, 0.01],
    }
    file = tmp_path / "reference.json"
    file.write_text(json.dumps({"curves": [curve]}))
    found = find_reference_curve(SCENE, 0.0, 0.0, file)
    assert found is not None
    force = found.force(0.75 * finger)
    assert force is not None
    assert force.force_n == pytest.approx(4000.0 * finger**2 * 0.75**1.5, rel=1e-6)
    assert force.uncertainty_ratio == pytest.approx(0.015)
    assert found.force(2.1 * finger) is None
    assert find_reference_curve(SCENE, 0.01, 0.0, file) is None


def test_the_stored_reference_covers_every_position_of_the_demo() -> None:
    for along_m, around_m in POSITIONS_M:
        curve = find_reference_curve(SCENE, along_m, around_m)
        assert curve is not None
        assert all(curve.force(depth) is not None for depth in DEPTHS_M)


def test_every_position_is_pressed_at_every_depth_and_evaluated_at_rest() -> None:
    *at_places, last = make_presses(SCENE)
    deepest_m = SCENE.working_range.push_depth_m
    for press in at_places:
        depths = [hold.depth_m for hold in press.holds]
        assert depths == pytest.approx([*DEPTHS_M, deepest_m])
        for hold in press.holds:
            assert hold.end_s - hold.begin_s == pytest.approx(EVALUATED_S)
            times = np.array([hold.end_s - HOLD_S, hold.begin_s, hold.end_s])
            along = [
                np.interp(times, press.path.times_s, press.path.positions_world_m[:, i])
                for i in range(3)
            ]
            heights = (np.column_stack(along) - press.surface) @ press.normal
            assert heights == pytest.approx(-hold.depth_m, abs=1e-9)
    assert last.holds == ()
    assert ((last.path.positions_world_m - last.surface) @ last.normal).min() == pytest.approx(
        -deepest_m
    )


def test_a_bag_without_a_soft_body_is_rejected(tmp_path: Path) -> None:
    bag = tmp_path / "bare.mcap"
    with BagWriter(bag):
        pass
    with pytest.raises(ExperimentError, match="the bag lacks a scene or a force curve"):
        read_bag(bag)
