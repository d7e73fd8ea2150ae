"""Test equations (1)-(6) of the paper on planes and on the pushed sheet, and their limits."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flexsheet.messages.scene import Lens
from flexsheet.nodes.models.rigid import rotation_from_vector
from flexsheet.nodes.renderer.correction import (
    GRAZING_SINE,
    MIN_PUSH_M,
    ScreenPlane,
    is_plane_usable,
    make_flat_screen,
    make_pushed_screen,
    on_imaginary_screen,
    pixel_from_screen,
    sector_normals,
)
from tests.correction_reference import correct, select_triangles

EYE = np.array([0.0, 0.0, 0.4])
PROJECTOR = np.array([0.0, -0.25, -1.0])
CORNERS = np.array([[-0.12, -0.12, 0], [0.12, -0.12, 0], [0.12, 0.12, 0], [-0.12, 0.12, 0]])
FLAT = ScreenPlane(np.zeros(3), np.array([0.0, 0.0, 1.0]))

coordinate = st.floats(-0.1, 0.1)
points = st.tuples(coordinate, coordinate, st.floats(-0.1, 0.05)).map(np.array)


def tilted(tilt_x: float, tilt_y: float, centre: np.ndarray) -> ScreenPlane:
    return ScreenPlane(centre, rotation_from_vector([tilt_x, tilt_y, 0.0])[:, 2])


def seen_at(on_screen: np.ndarray, screen_point: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Return the point on z = 0 at which the eye sees light that a plane reflects."""
    ray = on_screen - PROJECTOR
    share = ((screen_point - PROJECTOR) @ normal) / (ray @ normal)
    return on_imaginary_screen(PROJECTOR + share[:, None] * ray, EYE)


@given(points, st.floats(-0.9, 0.9), st.floats(-0.9, 0.9), points)
def test_corrected_light_is_seen_where_the_point_is(
    point: np.ndarray, tilt_x: float, tilt_y: float, centre: np.ndarray
) -> None:
    plane = tilted(tilt_x, tilt_y, centre)
    result = correct(point[None], eye=EYE, projector=PROJECTOR, screen=make_flat_screen(plane))
    assert np.isfinite(result.points).all()
    if result.valid[0]:
        assert np.allclose(result.points[0, 2], point[2], atol=1e-12)
        seen = seen_at(result.on_screen, plane.point, plane.normal)
        assert np.allclose(seen, on_imaginary_screen(point[None], EYE), atol=1e-9)
        # A' is on the line V-C', so that drawing it draws C'.
        drawn = on_imaginary_screen(result.points, EYE)
        assert np.allclose(drawn, result.on_screen[:, :2], atol=1e-9)


def test_no_correction_is_needed_on_the_imaginary_screen() -> None:
    object_points = np.random.default_rng(1).uniform(-0.06, 0.0, (50, 3))
    result = correct(object_points, eye=EYE, projector=PROJECTOR, screen=make_flat_screen(FLAT))
    assert result.valid.all()
    assert np.allclose(result.points, object_points, atol=1e-12)


@given(points, st.floats(-0.05, 0.05), st.floats(-0.05, 0.05), st.floats(0.002, 0.05))
def test_the_chosen_triangle_is_the_one_that_is_hit(
    point: np.ndarray, x: float, y: float, depth: float
) -> None:
    apex = np.array([x, y, -depth])
    screen = make_pushed_screen(apex, CORNERS, FLAT)
    chosen = int(select_triangles(point[None], screen, EYE)[0])
    hits = []
    for i in range(4):
        edges = np.column_stack([apex - EYE, CORNERS[i] - EYE, CORNERS[(i + 1) % 4] - EYE])
        weights = np.linalg.solve(edges, point - EYE)
        if (weights >= 1e-9).all():
            hits.append(i)
    if hits:  # the line V-A may pass beside the sheet
        assert chosen in hits


@given(points, st.floats(-0.05, 0.05), st.floats(-0.05, 0.05), st.floats(0.002, 0.05))
def test_light_for_four_triangles_is_seen_where_the_point_is(
    point: np.ndarray, x: float, y: float, depth: float
) -> None:
    screen = make_pushed_screen(np.array([x, y, -depth]), CORNERS, FLAT)
    result = correct(point[None], eye=EYE, projector=PROJECTOR, screen=screen)
    if result.valid[0]:
        normal = screen.normals[select_triangles(point[None], screen, EYE)[0]]
        seen = seen_at(result.on_screen, screen.point, normal)
        assert np.allclose(seen, on_imaginary_screen(point[None], EYE), atol=1e-9)


def test_light_push_is_one_plane_and_the_change_is_continuous() -> None:
    object_points = np.random.default_rng(2).uniform(-0.06, 0.0, (200, 3))

    def drawn(depth: float) -> np.ndarray:
        screen = make_pushed_screen(np.array([0.01, 0.02, -depth]), CORNERS, FLAT)
        return correct(object_points, eye=EYE, projector=PROJECTOR, screen=screen).points

    assert make_pushed_screen(np.zeros(3), CORNERS, FLAT).corners is None
    step = np.abs(drawn(0.99 * MIN_PUSH_M) - drawn(1.01 * MIN_PUSH_M)).max()
    assert step < 2 * MIN_PUSH_M


def test_triangle_without_area_takes_the_sheets_plane() -> None:
    corners = CORNERS.copy()
    corners[1] = corners[0]
    screen = make_pushed_screen(np.array([0.0, 0.0, -0.02]), corners, FLAT)
    assert np.allclose(screen.normals[0], FLAT.normal)
    assert np.allclose(np.linalg.norm(screen.normals, axis=1), 1.0)


def test_spoke_seen_end_on_leaves_every_point_a_triangle() -> None:
    apex = EYE + 1.2 * (CORNERS[0] - EYE)  # behind corner 0 as the eye sees it
    screen = make_pushed_screen(apex, CORNERS, FLAT)
    assert np.isfinite(sector_normals(screen, EYE)).all()
    object_points = np.random.default_rng(3).uniform(-0.1, 0.1, (500, 3))
    result = correct(object_points, eye=EYE, projector=PROJECTOR, screen=screen)
    assert np.isfinite(result.points).all()


@pytest.mark.parametrize("tilt_deg", [85.0, 89.9, 90.0, 90.1, 120.0, 180.0])
def test_plane_edge_on_or_turned_away_is_masked(tilt_deg: float) -> None:
    # Turned about x until the projector, 14 degrees below, sees the sheet edge-on: at 76 degrees.
    plane = tilted(np.radians(tilt_deg), 0.0, np.zeros(3))
    result = correct(
        np.array([[0.0, 0.0, -0.03]]), eye=EYE, projector=PROJECTOR, screen=make_flat_screen(plane)
    )
    assert not result.valid.any()
    assert np.isfinite(result.points).all()
    assert not is_plane_usable(plane, EYE, PROJECTOR)


def test_projector_edge_on_limit_agrees_with_the_geometry() -> None:
    sine_of_light = PROJECTOR / np.linalg.norm(PROJECTOR)
    limit = np.pi / 2 - np.arcsin(-sine_of_light[1]) - np.arcsin(GRAZING_SINE)
    assert is_plane_usable(tilted(limit - 1e-6, 0.0, np.zeros(3)), EYE, PROJECTOR)
    assert not is_plane_usable(tilted(limit + 1e-6, 0.0, np.zeros(3)), EYE, PROJECTOR)


@pytest.mark.parametrize("z", [0.39, 0.4, 0.5, 100.0])
def test_point_beside_or_behind_the_eye_is_masked(z: float) -> None:
    result = correct(
        np.array([[0.01, 0.0, z]]), eye=EYE, projector=PROJECTOR, screen=make_flat_screen(FLAT)
    )
    assert not result.valid.any()
    assert np.isfinite(result.points).all()


def test_sheet_behind_the_eye_is_masked() -> None:
    behind = ScreenPlane(np.array([0.0, 0.0, 0.5]), np.array([0.0, 0.0, 1.0]))
    result = correct(
        np.array([[0.0, 0.0, -0.03]]), eye=EYE, projector=PROJECTOR, screen=make_flat_screen(behind)
    )
    assert not result.valid.any()


def test_eye_behind_the_screen_is_rejected() -> None:
    with pytest.raises(ValueError, match="not in front of the imaginary screen"):
        correct(np.zeros((1, 3)), eye=-EYE, projector=PROJECTOR, screen=make_flat_screen(FLAT))
    with pytest.raises(ValueError, match="not behind the imaginary screen"):
        correct(np.zeros((1, 3)), eye=EYE, projector=-PROJECTOR, screen=make_flat_screen(FLAT))


def test_no_points_give_no_points() -> None:
    result = correct(np.empty((0, 3)), eye=EYE, projector=PROJECTOR, screen=make_flat_screen(FLAT))
    assert result.points.shape == (0, 3)
    assert result.valid.shape == (0,)


def test_homography_agrees_with_the_pinhole() -> None:
    world_from_projector = np.diag([-1.0, -1.0, 1.0, 1.0])
    world_from_projector[:3, 3] = PROJECTOR
    lens = Lens(fx_px=2000.0, fy_px=1900.0, cx_px=399.5, cy_px=799.5)
    homography = pixel_from_screen(lens, world_from_projector)
    x, y, w = homography @ [0.03, -0.02, 1.0]
    assert np.isclose(x / w, 399.5 - 2000.0 * 0.03)
    assert np.isclose(y / w, 799.5 + 1900.0 * (-0.25 + 0.02))
