"""Test the reduced-order model of the pushed sheet: accuracy, interpolation and range."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from flexsheet.nodes.models.shapes.triangles import triangulate_grid
from flexsheet.nodes.models.sheet import indentation
from flexsheet.nodes.models.sheet.indentation import (
    IndentationBasis,
    IndentationCase,
    solve_indentation,
)
from tests.indentation_bases import (
    DEEPEST_M,
    ELEMENT_CELLS,
    MAX_STRETCH_RATIO,
    MIN_STRETCH,
    RADIUS_M,
    RUBBER,
    few_dents,
)

Floats = NDArray[np.float64]
TIP = indentation.HALF_CELLS


def solved(stretch: float, place: tuple[float, float], depth: float) -> Floats:
    return solve_indentation(
        IndentationCase(RUBBER, stretch, place, np.array([depth]), RADIUS_M, ELEMENT_CELLS)
    )[0]


@pytest.fixture(scope="module")
def shapes() -> IndentationBasis:
    return few_dents()


def test_what_was_solved_comes_out_again(shapes: IndentationBasis) -> None:
    for stretch in shapes.stretches:
        depth = shapes.deepest_m * float(shapes.roots[3]) ** 2
        place = (float(shapes.xs_m[1]), float(shapes.ys_m[0]))
        wanted = solved(float(stretch), place, depth)
        assert shapes.offsets(float(stretch), place, depth) == pytest.approx(wanted, abs=1.5e-4)


def test_between_depths_it_is_near_the_elements(shapes: IndentationBasis) -> None:
    for depth in (0.004, 0.011, 0.026):
        wanted = solved(1.04, (0.0, 0.0), depth)
        got = shapes.offsets(1.04, (0.0, 0.0), depth)
        assert np.abs(got - wanted)[..., 2].max() < 2e-4
        assert got[TIP, TIP, 2] == pytest.approx(-depth, abs=1e-4)


@settings(max_examples=60, deadline=None)
@given(
    st.floats(1.0, 1.2),
    st.tuples(st.floats(-0.2, 0.2), st.floats(-0.2, 0.2)),
    st.floats(-0.01, 0.2),
)
def test_any_push_has_a_finite_shape_of_bounded_depth(
    shapes: IndentationBasis, stretch: float, place: tuple[float, float], depth: float
) -> None:
    offsets, flat = shapes.offsets(stretch, place, depth), shapes.grid(stretch, place)
    assert offsets.shape == (*flat.shape[:2], 3)
    assert np.isfinite(offsets).all()
    assert offsets[..., 2].min() >= -1.05 * shapes.deepest_m
    # The grid never folds, and its clamped ends stay where they are.
    assert (np.diff(flat[0, :, 0]) > 0).all()
    assert (np.diff(flat[:, 0, 1]) > 0).all()
    assert np.abs(offsets[:, [0, -1]]).max() < 1e-4
    fits = not shapes.invalid_reason(stretch, place, depth)
    inside = (
        MIN_STRETCH <= stretch <= MAX_STRETCH_RATIO
        and depth <= DEEPEST_M
        and abs(place[0]) <= shapes.xs_m[-1]
        and abs(place[1]) <= shapes.ys_m[-1]
    )
    assert fits == inside


@pytest.mark.parametrize(("x", "y"), [(-1, 1), (1, -1), (-1, -1)])
def test_mirrored_points_have_mirrored_shapes(shapes: IndentationBasis, x: int, y: int) -> None:
    place = (0.03, 0.05)
    shape, other = (shapes.grid(1.05, at) for at in (place, (x * place[0], y * place[1])))
    assert other == pytest.approx(shape[::y, ::x] * [x, y])
    dent = shapes.offsets(1.05, place, 0.02)
    mirrored = shapes.offsets(1.05, (x * place[0], y * place[1]), 0.02)
    assert mirrored == pytest.approx(dent[::y, ::x] * [x, y, 1.0])


def test_a_stretched_sheet_narrows_between_its_clamps(shapes: IndentationBasis) -> None:
    offsets = shapes.offsets(MAX_STRETCH_RATIO, (0.0, 0.0), 0.0)
    assert np.abs(offsets[..., 2]).max() < 1e-4
    top = offsets[-1, :, 1]
    assert top.min() < -0.0015
    assert offsets[0, :, 1] == pytest.approx(-top, abs=1e-4)


def test_triangles_face_the_user(shapes: IndentationBasis) -> None:
    flat = shapes.grid(1.05, (0.02, 0.01)).reshape(-1, 2)
    corners = flat[triangulate_grid(2 * TIP + 1, 2 * TIP + 1)]
    one, other = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    areas = 0.5 * (one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0])
    assert areas.min() > 0
    assert areas.sum() == pytest.approx(1.05 * 0.24 * 0.24)


def test_what_is_out_of_range_is_named(shapes: IndentationBasis) -> None:
    assert shapes.invalid_reason(1.05, (0.0, 0.0), 0.02) == ""
    assert "the stretch ratio 1.100" in shapes.invalid_reason(1.1, (0.0, 0.0), 0.02)
    assert "deeper than 30 mm" in shapes.invalid_reason(1.05, (0.0, 0.0), 0.04)
    assert "too close to the sheet's edge" in shapes.invalid_reason(1.05, (0.11, 0.0), 0.02)


def test_a_sheet_of_another_modulus_has_the_same_shape() -> None:
    stiff = replace(RUBBER, young_modulus_pa=3e6, thickness_m=0.002)
    soft, hard = (
        solve_indentation(
            IndentationCase(rubber, 1.05, (0.0, 0.0), np.array([0.015]), RADIUS_M, ELEMENT_CELLS)
        )
        for rubber in (RUBBER, stiff)
    )
    assert hard == pytest.approx(soft, abs=2e-5)
