"""Test the 3D view of the console: arms, sheet, rays, and object."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from flexsheet.messages.scene import RV_1A, RV_2FR, ClosedFormArm, JointChain, Scene
from flexsheet.messages.types import Skin
from flexsheet.nodes.arm_bridge.geometry import make_kinematics
from flexsheet.nodes.console.access_control import start_server
from flexsheet.nodes.console.arms import compute_link_poses
from flexsheet.nodes.console.scene_view import (
    FINGER,
    FINGER_LOST,
    LINES_LIFT_M,
    SHEET_LIFT_M,
    SceneView,
    lift_sheet,
    make_line_segments,
)
from flexsheet.nodes.console.sheet import (
    ROWS,
    compute_sheet_points,
    film,
)
from flexsheet.nodes.models.rigid import rotation_from_vector, transform
from tests.arm_states import arm_state
from tests.console_parts import latest_messages
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


def test_the_drawing_shows_the_received_messages(scene: Scene) -> None:
    server = start_server(0, "test")
    view = SceneView(server, lambda *_: None)
    view.set_scene(scene)
    flat_m = view._sheet.vertices.copy()
    view.draw(scene, latest_messages())
    assert not any(frame.visible for frames in view._links.values() for frame in frames)
    left, right = edges()
    at_m = np.array([0.0, 0.0, -0.05])
    corners_m = np.eye(3, dtype=np.float32)
    skin = Skin(mesh_id="m", vertices_world_m=corners_m, triangles=np.array([[0, 1, 2]], np.int32))
    view.set_skin(skin)
    received = {
        "arm_left": arm_state("left", world_from_flange=left),
        "arm_right": arm_state("right", world_from_flange=right),
        "skin": skin,
    }
    view.draw(scene, latest_messages(**received, fingertip=fingertip(at_m)))
    assert all(frame.visible for frames in view._links.values() for frame in frames)
    np.testing.assert_allclose(view._finger.position, at_m)
    assert tuple(view._finger.color) == FINGER
    assert view._sheet.vertices[:, 2].min() < flat_m[:, 2].min() - 0.01, "the finger deflects it"
    lost = fingertip(at_m).model_copy(update={"valid": False, "reason": "no_marker"})
    view.draw(scene, latest_messages(**received, fingertip=lost))
    assert tuple(view._finger.color) == FINGER_LOST
    server.stop()
