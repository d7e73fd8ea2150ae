"""Test the force models of the sheet against the simulator's membrane."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from flexsheet.launch.calibration.simulated_sheet import simulate_push
from flexsheet.messages.scene import SheetSpec
from flexsheet.nodes.models.sheet.force_models import (
    CENTRE,
    ScaledSheetModel,
    SheetForceModel,
    SheetPosition,
    SheetPush,
    depth_for_force,
    flat_edge_force_n,
    interpolate_inverse,
)
from flexsheet.nodes.models.sheet.rubber import Rubber
from flexsheet.nodes.models.sheet.tabulated import (
    MAX_CURVES,
    TabulatedSheetModel,
    make_tabulated_model,
)

Floats = NDArray[np.float64]

RUBBER = Rubber(0.24, 0.24, 0.001, 1e6)
SHEET = SheetSpec(
    width_m=0.24,
    height_m=0.24,
    thickness_m=0.001,
    young_modulus_pa=1e6,
    min_stretch_ratio=1.0,
    max_stretch_ratio=1.12,
    max_edge_force_n=40.0,
    usable_half_height_m=0.09,
)
RADIUS = 0.007
LAW = ScaledSheetModel(RUBBER)


def force(
    law: SheetForceModel,
    stretch: float,
    depth: float,
    place: SheetPosition = CENTRE,
    radius: float = RADIUS,
) -> float:
    pressed = law.evaluate(SheetPush(stretch, radius, place), np.array([depth]))
    return float(pressed.force_n[0])


def true_push(stretch: float, depth: float, place: SheetPosition = CENTRE) -> tuple[float, float]:
    """Return force and edge force in the simulator, with a discretization error of 1.5 %."""
    return simulate_push(SHEET, stretch, depth, place, RADIUS, cells=24)


CASES: tuple[tuple[float, float, SheetPosition], ...] = (
    (1.0, 0.020, CENTRE),
    (1.02, 0.006, CENTRE),
    (1.04, 0.010, CENTRE),
    (1.04, 0.040, CENTRE),
    (1.05, 0.012, (0.03, 0.02)),
    (1.06, 0.008, (0.05, 0.0)),
    (1.06, 0.015, (0.0, 0.07)),
    (1.12, 0.020, CENTRE),
)


@pytest.fixture(scope="module")
def true_forces() -> Floats:
    return np.array([true_push(*case)[0] for case in CASES])


def test_within_its_range_the_scaled_law_has_the_stated_accuracy(true_forces: Floats) -> None:
    checked = 0
    for (stretch, depth, place), true in zip(CASES, true_forces, strict=True):
        if LAW.invalid_reason(SheetPush(stretch, RADIUS, place), depth):
            continue
        checked += 1
        assert force(LAW, stretch, depth, place) == pytest.approx(float(true), rel=0.10)
    assert checked >= 2


@pytest.mark.parametrize(
    ("stretch", "depth", "place", "radius"),
    [
        (0.97, 0.01, CENTRE, RADIUS),
        (1.3, 0.01, CENTRE, RADIUS),
        (1.05, 0.001, CENTRE, RADIUS),
        (1.05, 0.08, CENTRE, RADIUS),
        (1.05, 0.01, (0.1, 0.0), RADIUS),
        (1.05, 0.01, (0.0, 0.11), RADIUS),
        (1.05, 0.01, CENTRE, 0.02),
    ],
)
def test_the_scaled_law_reports_its_range(
    stretch: float, depth: float, place: SheetPosition, radius: float
) -> None:
    law = ScaledSheetModel(RUBBER)
    assert law.invalid_reason(SheetPush(stretch, radius, place), depth)
    assert np.isfinite(force(law, stretch, depth, place, radius))


def test_a_sheet_of_another_form_is_outside() -> None:
    tall = Rubber(0.24, 0.36, 0.001, 1e6)
    assert "square" in ScaledSheetModel(tall).invalid_reason(SheetPush(1.05, RADIUS), 0.012)


@pytest.mark.long
def test_a_slack_sheet_answers_with_the_cube_of_the_depth() -> None:
    law = ScaledSheetModel(RUBBER)
    assert force(law, 1.0, 0.02) == pytest.approx(8.0 * force(law, 1.0, 0.01), rel=1e-9)
    true = [true_push(1.0, depth)[0] for depth in (0.01, 0.02)]
    assert true[1] / true[0] == pytest.approx(8.0, rel=0.06)


@pytest.mark.parametrize("stretch", [1.02, 1.08])
def test_the_pushed_sheet_pulls_harder_at_its_clamps(stretch: float) -> None:
    law = ScaledSheetModel(RUBBER)
    flat, pulled = (true_push(stretch, depth)[1] for depth in (1e-4, 0.04))
    pressed = law.evaluate(SheetPush(stretch, RADIUS), np.array([0.0, 0.04]))
    assert pressed.edge_force_n == pytest.approx([flat, pulled], rel=0.03)
    assert pulled > flat + 2.0


places = st.tuples(st.floats(-0.06, 0.06), st.floats(-0.09, 0.09))


@given(st.floats(1.0, 1.13), places, st.floats(0.005, 0.01))
def test_force_and_slope_rise_and_agree(
    stretch: float, place: SheetPosition, radius: float
) -> None:
    depths = np.linspace(0.002, 0.05, 200)
    pressed = LAW.evaluate(SheetPush(stretch, radius, place), depths)
    assert (np.diff(pressed.force_n) >= 0.0).all()
    assert (np.diff(pressed.edge_force_n) >= 0.0).all()
    middle = 0.5 * (pressed.stiffness_n_per_m[1:] + pressed.stiffness_n_per_m[:-1])
    assert np.diff(pressed.force_n) / np.diff(depths) == pytest.approx(middle, rel=5e-3, abs=1e-9)


@given(st.floats(0.1, 10.0), st.floats(0.5, 2.0), st.floats(1.0, 1.13))
def test_modulus_and_thickness_scale_the_force_and_the_size_scales_out(
    factor: float, size: float, stretch: float
) -> None:
    other = Rubber(0.24 * size, 0.24 * size, 0.001 * factor, 2e6)
    here = force(ScaledSheetModel(RUBBER), stretch, 0.01, (0.02, 0.03))
    place = (0.02 * size, 0.03 * size)
    there = force(ScaledSheetModel(other), stretch, 0.01 * size, place, RADIUS * size)
    assert there == pytest.approx(2.0 * factor * size * here, rel=1e-9)


@given(places, st.floats(1.0, 1.13))
def test_left_is_as_right_and_up_as_down(place: SheetPosition, stretch: float) -> None:
    there = force(LAW, stretch, 0.01, (-place[0], -place[1]))
    assert force(LAW, stretch, 0.01, place) == pytest.approx(there)


def test_no_depth_presses_nothing_and_what_is_not_finite_is_rejected() -> None:
    assert force(LAW, 1.05, 0.0) == 0.0
    assert force(LAW, 1.05, -0.01) == 0.0
    for stretch, depth, x in ((np.nan, 0.01, 0.0), (1.05, np.inf, 0.0), (1.05, 0.01, np.nan)):
        with pytest.raises(ValueError, match="finite"):
            force(LAW, stretch, depth, (x, 0.0))
    with pytest.raises(ValueError, match="above 0"):
        force(LAW, 0.0, 0.01)


@settings(max_examples=30)
@given(st.floats(1.0, 1.13), places)
def test_depth_for_force_is_the_inverse(stretch: float, place: SheetPosition) -> None:
    depths = np.array([0.0, 1e-4, 0.002, 0.011, 0.03, 0.049])
    asked = LAW.evaluate(SheetPush(stretch, RADIUS, place), depths).force_n
    found = depth_for_force(LAW, SheetPush(stretch, RADIUS, place), asked, max_depth_m=0.05)
    assert found == pytest.approx(depths, rel=2e-3)


def test_an_inverse_ends_where_its_grid_does() -> None:
    grid = np.array([0.1, 0.2, 0.4])
    inverse = interpolate_inverse(grid, grid**2, np.array([-1.0, 0.0, 1e-4, 0.04, 5.0]))
    assert inverse == pytest.approx([0.0, 0.0, 0.01, 0.2, 0.4])
    flat = interpolate_inverse(grid, np.zeros(3), np.array([0.0, 1.0]))
    assert flat == pytest.approx([0.0, 0.4])


def test_a_table_returns_its_entries_and_interpolates_by_the_law() -> None:
    base = ScaledSheetModel(RUBBER)

    def measured(stretch: float, depths: Floats, place: SheetPosition) -> Floats:
        pressed = base.evaluate(SheetPush(stretch, RADIUS, place), depths)
        wave = 1.0 + 0.1 * np.sin(100.0 * depths) + place[0] - 0.5 * place[1] + stretch - 1.0
        result: Floats = pressed.force_n * wave
        return result

    reported: list[tuple[int, int]] = []
    table = make_tabulated_model(
        base,
        measured,
        stretches=np.array([1.02, 1.05, 1.08]),
        depths_m=np.linspace(0.002, 0.05, 12),
        xs_m=np.array([0.0, 0.03, 0.06]),
        ys_m=np.array([0.0, 0.09]),
        finger_radius_m=RADIUS,
        progress=lambda done, total: reported.append((done, total)),
    )
    assert reported[-1] == (18, 18)
    for stretch, depth, place in ((1.05, 0.002, (0.03, 0.0)), (1.035, 0.017, (-0.04, 0.05))):
        true = measured(stretch, np.array([depth]), (abs(place[0]), abs(place[1])))[0]
        assert force(table, stretch, depth, place) == pytest.approx(true, rel=2e-3)
        assert not table.invalid_reason(SheetPush(stretch, RADIUS, place), depth)
    depths = np.linspace(0.001, 0.06, 400)
    pressed = table.evaluate(SheetPush(1.04, RADIUS, (0.01, 0.02)), depths)
    middle = 0.5 * (pressed.stiffness_n_per_m[1:] + pressed.stiffness_n_per_m[:-1])
    slope = np.diff(pressed.force_n) / np.diff(depths)
    assert np.abs(slope / middle - 1.0).max() < 0.05
    for stretch, depth, place in (
        (1.01, 0.01, CENTRE),
        (1.05, 0.06, CENTRE),
        (1.05, 0.01, (0.07, 0.0)),
        (1.05, 0.01, (0.0, 0.1)),
    ):
        assert table.invalid_reason(SheetPush(stretch, RADIUS, place), depth)
        assert np.isfinite(force(table, stretch, depth, place))


def test_stored_curves_do_not_change_the_force_and_are_limited() -> None:
    axis, ratios = np.array([1.02, 1.08]), np.array([[1.0, 1.2], [1.1, 1.4]])
    depths, one = np.array([0.002, 0.05]), np.array([0.0])

    def make() -> TabulatedSheetModel:
        return TabulatedSheetModel(
            ScaledSheetModel(RUBBER), axis, depths, one, one, ratios.reshape(2, 2, 1, 1)
        )

    table = make()
    for stretch in np.linspace(1.02, 1.08, MAX_CURVES + 10).tolist():
        for _ in range(2):
            assert force(table, stretch, 0.02) == force(make(), stretch, 0.02)
        assert len(table._curves) <= MAX_CURVES


def test_a_table_of_one_entry_is_a_factor() -> None:
    base, one = ScaledSheetModel(RUBBER), np.array([0.0])
    table = TabulatedSheetModel(
        base, np.array([1.05]), np.array([0.01]), one, one, np.full((1, 1, 1, 1), 1.2)
    )
    assert force(table, 1.02, 0.02) == pytest.approx(1.2 * force(base, 1.02, 0.02))


@pytest.mark.parametrize(
    ("stretches", "ratios", "words"),
    [
        ([1.05, 1.02], np.ones((2, 1, 1, 1)), "ascend"),
        ([1.02, 1.05], np.ones((3, 1, 1, 1)), "force table has ratios of shape"),
        ([1.02, 1.05], np.zeros((2, 1, 1, 1)), "above 0"),
        ([1.02, 1.05], np.full((2, 1, 1, 1), np.nan), "finite"),
    ],
)
def test_a_table_that_is_none_is_rejected(
    stretches: list[float], ratios: Floats, words: str
) -> None:
    one = np.array([0.01])
    with pytest.raises(ValueError, match=words):
        TabulatedSheetModel(ScaledSheetModel(RUBBER), np.array(stretches), one, one, one, ratios)


def test_edge_force_depends_on_the_sheets_form_and_mooneys_rubber() -> None:
    forces = [flat_edge_force_n(RUBBER, stretch) for stretch in (0.9, 1.0, 1.02, 1.05, 1.1)]
    assert forces[0] == forces[1] == 0.0
    assert forces[2:] == pytest.approx([5.07, 12.3, 23.4], rel=0.01)
    mooney = Rubber(0.24, 0.24, 0.001, 1e6, mooney_ratio=0.3)
    softening = flat_edge_force_n(mooney, 1.2) / flat_edge_force_n(RUBBER, 1.2)
    assert softening == pytest.approx(0.95, abs=0.01)


@pytest.mark.parametrize(
    "numbers", [(0.0, 0.24, 0.001, 1e6, 0.0), (0.24, 0.24, np.nan, 1e6, 0.0), (0.24,) * 4 + (1.0,)]
)
def test_rubber_that_is_none_is_rejected(numbers: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match=r"above 0|mooney_ratio"):
        Rubber(*numbers)


def test_the_curve_has_no_kink() -> None:
    depths = np.geomspace(0.001, 0.06, 2000)
    slopes = ScaledSheetModel(RUBBER).evaluate(SheetPush(1.05, RADIUS), depths).stiffness_n_per_m
    assert all(abs(after / before - 1.0) < 0.01 for before, after in pairwise(slopes))
