"""Shapes: nearest points, and what is undefined is decided."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nodes.models.shapes import CylinderShape

SHAPE = CylinderShape(0.035, 0.12)
UP = np.array([0.0, 0.0, 1.0])
anywhere = st.tuples(st.floats(-0.1, 0.1), st.floats(-0.1, 0.1), st.floats(-0.1, 0.1))


@given(anywhere)
def test_the_nearest_point_is_on_the_side_and_no_other_is_nearer(
    point: tuple[float, float, float],
) -> None:
    query = np.array(point)
    found = SHAPE.closest(query, fallback_normal=UP)
    assert np.hypot(found.point[1], found.point[2]) == pytest.approx(SHAPE.radius_m)
    assert abs(found.point[0]) <= 0.06 + 1e-12
    assert np.linalg.norm(found.normal) == pytest.approx(1.0)
    distance = np.linalg.norm(query - found.point)
    for angle in np.linspace(0.0, 2 * np.pi, 24):
        rim = np.array([found.point[0], 0.035 * np.sin(angle), 0.035 * np.cos(angle)])
        # Within a micrometre of the axis all are taken as equally near.
        assert np.linalg.norm(query - rim) >= distance - 2e-6


@pytest.mark.parametrize(
    ("point", "distance", "on_edge"),
    [
        ((0.0, 0.0, 0.045), 0.01, False),
        ((0.0, 0.030, 0.0), -0.005, False),
        ((0.06, 0.0, 0.035), 0.0, False),
        ((0.063, 0.0, 0.039), 0.005, True),
        ((-0.07, 0.0, 0.02), 0.01, True),
        ((0.01, 0.0, 0.0), -0.035, True),
    ],
)
def test_signed_distance_and_edges(
    point: tuple[float, float, float], distance: float, on_edge: bool
) -> None:
    found = SHAPE.closest(np.array(point), fallback_normal=UP)
    assert found.distance_m == pytest.approx(distance, abs=1e-12)
    assert found.on_edge is on_edge


def test_on_the_axis_the_fallback_decides() -> None:
    found = SHAPE.closest(np.array([0.01, 0.0, 0.0]), fallback_normal=np.array([0.5, 3.0, 4.0]))
    assert found.normal == pytest.approx([0.0, 0.6, 0.8])
    assert found.point == pytest.approx([0.01, 0.021, 0.028])


@given(st.floats(-3.0, 3.0))
def test_the_angle_grows_from_z_towards_y(angle: float) -> None:
    point = np.array([0.02, np.sin(angle), np.cos(angle)])
    assert SHAPE.angle_rad(point) == pytest.approx(angle)


def test_curvature_is_that_of_a_cylinder() -> None:
    assert SHAPE.normal_curvatures() == pytest.approx((0.0, 1.0 / 0.035))
