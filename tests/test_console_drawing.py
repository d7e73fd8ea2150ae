"""Test the 3D view of the console: arms, sheet, rays, and object."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from flexsheet.messages.scene import RV_1A, RV_2FR, ClosedFormArm, JointChain, Scene
from flexsheet.nodes.arm_bridge.geometry import make_kinematics
from flexsheet.nodes.console.arms import PIECES, compute_link_poses, make_pieces, rounded_box
from flexsheet.nodes.console.creases import split_creases
from flexsheet.nodes.console.scene_view import (
    LINES_LIFT_M,
    SHEET_LIFT_M,
    lift_sheet,
    make_finger_mesh,
    make_line_segments,
)
from flexsheet.nodes.console.sheet import (
    COLUMNS,
    ROWS,
    TRIANGLES,
    compute_sheet_points,
    film,
)
from flexsheet.nodes.console.snapshot import compute_snapshot, rays, select_ray_vertices
from flexsheet.nodes.models.rigid import rotation_from_vector, transform
from tests.arm_states import arm_state
from tests.console_parts import FixedMessages
from tests.fingertips import fingertip
from tests.scenes import load_cylinder

Floats = NDArray[np.float64]
WIDTH_M = HEIGHT_M = 0.24


@pytest.fixture(scope="module")
def scene() -> Scene:
    return load_cylinder()


def edges(width_m: float = WIDTH_M) -> tuple[Floats, Floats]:
    half = 0.5 * width_m
    return transform(np.eye(3), (-half, 0, 0)), transform(np.eye(3), (half, 0, 0))


def sheet(fingertip: Floats | None = None) -> Floats:
    points = compute_sheet_points(
        *edges(), height_m=HEIGHT_M, fingertip=fingertip, finger_radius_m=0.007
    )
    assert points is not None
    return points


@pytest.mark.parametrize("model", [RV_1A, RV_2FR, RV_2FR.chain()])
@given(joints=st.lists(st.floats(-2.0, 2.0), min_size=6, max_size=6))
def test_the_drawn_flange_is_where_the_kinematics_have_it(
    model: ClosedFormArm | JointChain, joints: list[float]
) -> None:
    base = transform(rotation_from_vector(np.array([0.3, -0.2, 0.5])), (0.1, -0.4, 0.2))
    poses = compute_link_poses(base, np.array(joints), model)
    assert poses.shape == (7, 4, 4)
    np.testing.assert_allclose(
        poses[-1], base @ make_kinematics(model).forward(np.array(joints)), atol=1e-12
    )


@pytest.mark.parametrize("piece", [*PIECES, *make_pieces(RV_2FR)])
def test_boxes_are_closed_and_wound_outwards(piece: Any) -> None:
    vertices, triangles = rounded_box(piece.size_m, (0.0, 0.0, 0.0))
    a, b, c = (vertices[triangles[:, i]] for i in range(3))
    volume = float(np.einsum("ij,ij->", a, np.cross(b, c))) / 6.0
    assert 0.8 * np.prod(piece.size_m) < volume < np.prod(piece.size_m)
    tip, faces = make_finger_mesh(0.007)
    a, b, c = (tip[faces[:, i]] for i in range(3))
    assert float(np.einsum("ij,ij->", a, np.cross(b, c))) > 0.0


@given(st.floats(-0.115, 0.115), st.floats(-0.12, 0.12))
def test_the_film_is_held_at_its_edges_and_as_deep_as_the_finger(x: float, y: float) -> None:
    ends, up = np.array([-0.12, 0.12]), np.linspace(-0.12, 0.12, 9)
    places = [film(np.full(9, end), up, (x, y), (WIDTH_M, HEIGHT_M), 0.007) for end in ends]
    np.testing.assert_allclose(places, 0.0, atol=1e-9)
    at_finger = film(np.array([x]), np.array([y]), (x, y), (WIDTH_M, HEIGHT_M), 0.007)
    assert at_finger[0] == 1.0
    anywhere = film(np.linspace(-0.12, 0.12, 9), up, (x, y), (WIDTH_M, HEIGHT_M), 0.007)
    assert ((anywhere >= -1e-12) & (anywhere <= 1.0)).all()


def test_the_film_is_free_at_top_and_bottom() -> None:
    near = np.array([0.12 - 1e-5, 0.12])
    one, other = film(np.full(2, 0.02), near, (0.0, 0.08), (WIDTH_M, HEIGHT_M), 0.007)
    assert abs(one - other) < 1e-7


def test_a_sheet_that_is_not_there_or_not_pushed() -> None:
    assert (
        compute_sheet_points(*edges(0.01), height_m=1.0, fingertip=None, finger_radius_m=1.0)
        is None
    )
    nan = np.full((4, 4), np.nan)
    assert compute_sheet_points(nan, nan, height_m=1.0, fingertip=None, finger_radius_m=1.0) is None
    assert np.ptp(sheet()[:, 2]) == 0.0
    assert np.ptp(sheet(np.array([0.0, 0.0, 0.01]))[:, 2]) == 0.0, "a finger before the sheet"
    dented = sheet(np.array([0.02, 0.01, -0.03]))
    assert dented[:, 2].min() == pytest.approx(-0.03, abs=1e-3)
    assert make_line_segments(dented).shape == (2 * 9 * (ROWS - 1), 2, 3)


@given(x=st.floats(-0.11, 0.11), y=st.floats(-0.11, 0.11))
def test_rays_meet_the_flat_sheet_where_the_plane_is(scene: Scene, x: float, y: float) -> None:
    towards = np.array([[x, y, 0.0]]) + 0.3 * (np.array([[x, y, 0.0]]) - scene.eyes.centre_world_m)
    to_eye, _ = rays(scene, sheet(), towards)
    np.testing.assert_allclose(to_eye[:, 1], [[x, y, 0.0]], atol=1e-9)


@pytest.mark.parametrize("tilt_rad", [-1.0, 0.0, 1.0])
def test_the_sheet_is_drawn_before_the_object_that_it_touches(tilt_rad: float) -> None:
    """A flat object in the plane of the sheet would flicker."""
    turned = transform(rotation_from_vector(np.array([tilt_rad, 0.0, 0.0])), (0.0, 0.0, 0.0))
    points = compute_sheet_points(
        *(turned @ edge for edge in edges()),
        height_m=HEIGHT_M,
        fingertip=None,
        finger_radius_m=0.007,
    )
    assert points is not None
    lifted = (lift_sheet(points, SHEET_LIFT_M) - points) @ turned[:3, :3]
    np.testing.assert_allclose(
        lifted, np.tile([0.0, 0.0, SHEET_LIFT_M], (len(points), 1)), atol=1e-12
    )
    assert LINES_LIFT_M > SHEET_LIFT_M > 0.0


def test_sharp_edges_are_split_and_smooth_ones_are_not() -> None:
    """A single normal at a sharp edge would cause wrong shading."""
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=float)
    box = np.array(
        [
            *([0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]),
            *([2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]),
        ],
        dtype=np.int32,
    )
    source, triangles = split_creases(corners, box)
    assert np.bincount(source).tolist() == [3] * 8, "a vertex for each of the three faces"
    np.testing.assert_array_equal(source[triangles], box)
    points = sheet(np.array([0.02, 0.01, -0.01]))
    source, triangles = split_creases(points, TRIANGLES)
    assert sorted(source.tolist()) == list(range(len(points)))
    np.testing.assert_array_equal(source[triangles], TRIANGLES)


def test_rays_that_miss_have_no_segments(scene: Scene) -> None:
    points = np.array([[0.0, 0.0, -0.1], [5.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    to_eye, from_projector = rays(scene, sheet(), points)
    assert to_eye.shape == from_projector.shape == (1, 2, 3)
    np.testing.assert_allclose(to_eye[0, 1], from_projector[0, 0])


def test_the_drawing_shows_the_received_messages(scene: Scene) -> None:
    nothing = compute_snapshot(scene, FixedMessages())
    assert (nothing.links, nothing.sheet, nothing.finger) == ({}, None, None)
    left, right = edges()
    both = compute_snapshot(
        scene,
        FixedMessages(
            arm_left=arm_state("left", world_from_flange=left),
            arm_right=arm_state("right", world_from_flange=right),
            fingertip=fingertip(np.array([0.0, 0.0, -0.01])),
        ),
    )
    assert both.links["left"].shape == (7, 4, 4)
    assert both.sheet is not None
    assert both.sheet.shape == (ROWS * COLUMNS, 3)
    assert both.finger_valid
    grid = np.stack(np.meshgrid(*[np.linspace(-1, 1, 5)] * 3), axis=-1).reshape(-1, 3)
    assert len(set(select_ray_vertices(grid).tolist())) == 9
