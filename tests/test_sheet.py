"""Test the edge force and the geometry of the sheet."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flexsheet.nodes.arm_bridge.limiter import SheetLimits
from flexsheet.nodes.models.rigid import is_rigid, rotation_from_rpy, transform, transform_from_rpy
from flexsheet.nodes.models.sheet import corners, edge_poses, flange_pose, sheet_from_edges
from flexsheet.nodes.models.sheet.force_models import ScaledSheetModel, SheetPush
from flexsheet.nodes.models.sheet.rubber import Rubber
from flexsheet.nodes.models.sheet.tension import (
    edge_force_for_stiffness,
    edge_force_n,
    push_stiffness_n_per_m,
    stretch_for_edge_force,
)

PAPER = Rubber(0.24, 0.24, 0.001, 1e6)

angles = st.tuples(st.floats(-0.6, 0.6), st.floats(-0.6, 0.6), st.floats(-0.6, 0.6))
places = st.tuples(st.floats(-0.2, 0.2), st.floats(-0.2, 0.2), st.floats(-0.2, 0.2))


@pytest.mark.parametrize(
    ("stretch", "force"), [(1.02, 5.1), (1.05, 12.3), (1.10, 23.4), (1.20, 43.0)]
)
def test_edge_force_agrees_with_membrane_elements(stretch: float, force: float) -> None:
    assert edge_force_n(stretch, PAPER) == pytest.approx(force, rel=0.02)


@pytest.mark.parametrize("height_m", [0.15, 0.24, 0.33])
def test_the_arms_limit_and_the_planners_model_give_the_same_edge_force(height_m: float) -> None:
    limits = SheetLimits(
        width_m=0.24,
        height_m=height_m,
        thickness_m=0.001,
        young_modulus_pa=1e6,
        max_length_m=0.3,
        max_edge_force_n=20.0,
        max_twist_rad=0.1,
        min_flange_distance_m=0.1,
        workspace_min_m=np.full(3, -1.0),
        workspace_max_m=np.ones(3),
    )
    model = ScaledSheetModel(Rubber(0.24, height_m, 0.001, 1e6))
    flat = model.evaluate(SheetPush(1.05, 0.007), np.zeros(1))
    assert limits.force_n(1.05 * 0.24) == pytest.approx(float(flat.edge_force_n[0]), rel=1e-12)


def test_a_slack_sheet_pulls_at_nothing() -> None:
    assert edge_force_n(1.0, PAPER) == 0.0
    assert edge_force_n(0.9, PAPER) == 0.0
    assert stretch_for_edge_force(-3.0, PAPER) == 1.0


@given(st.floats(0.0, 500.0))
def test_stretch_and_force_are_inverse(force: float) -> None:
    stretch = stretch_for_edge_force(force, PAPER)
    assert edge_force_n(stretch, PAPER) == pytest.approx(force, rel=1e-9, abs=1e-9)


@given(st.floats(0.0, 1e4))
def test_stiffness_and_force_are_inverse(stiffness: float) -> None:
    force = edge_force_for_stiffness(stiffness, width_m=0.24)
    assert push_stiffness_n_per_m(force, width_m=0.24) == pytest.approx(stiffness)


@given(angles, places, st.floats(0.2, 0.3))
def test_a_flat_sheet_is_found_again_between_its_edges(
    rpy: tuple[float, float, float], place: tuple[float, float, float], distance: float
) -> None:
    pose = transform_from_rpy(place, rpy)
    left, right = edge_poses(pose, distance)
    assert np.linalg.norm(right[:3, 3] - left[:3, 3]) == pytest.approx(distance)
    assert sheet_from_edges(left, right) == pytest.approx(pose, abs=1e-12)


def test_a_twisted_sheet_lies_in_the_mean_of_its_edges() -> None:
    left = transform(rotation_from_rpy([0.1, 0.0, 0.0]), [-0.12, 0.0, 0.0])
    right = transform(rotation_from_rpy([-0.1, 0.0, 0.0]), [0.12, 0.0, 0.0])
    pose = sheet_from_edges(left, right)
    assert is_rigid(pose)
    assert pose == pytest.approx(np.eye(4), abs=1e-12)


def test_corners_go_round_from_the_left_bottom() -> None:
    left, right = edge_poses(np.eye(4), 0.25)
    expected = [[-0.125, -0.12, 0], [0.125, -0.12, 0], [0.125, 0.12, 0], [-0.125, 0.12, 0]]
    assert corners(left, right, 0.24) == pytest.approx(np.array(expected))


@given(angles, places)
def test_the_flange_holds_the_edge(
    rpy: tuple[float, float, float], place: tuple[float, float, float]
) -> None:
    clamp = transform_from_rpy([0.0, 0.0, 0.03], [np.pi / 2, -np.pi / 2, 0.0])
    edge = transform_from_rpy(place, rpy)
    assert flange_pose(edge, clamp) @ clamp == pytest.approx(edge, abs=1e-12)
