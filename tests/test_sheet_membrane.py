"""Test the membrane elements against theory, the simulator's elements, and difficult cases."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from flexsheet.launch.calibration.simulated_sheet import simulate_push
from flexsheet.nodes.models.sheet import membrane
from flexsheet.nodes.models.sheet.membrane import (
    NoEquilibriumError,
    grade_coordinates,
    principal,
    push_path,
    relaxed_energy,
    stress_and_tangent,
)
from flexsheet.nodes.models.sheet.rubber import Rubber
from tests.examples import examples
from tests.test_sheet_force_models import RADIUS, RUBBER, SHEET

Floats = NDArray[np.float64]


@pytest.mark.long
@pytest.mark.parametrize(
    ("stretch", "place"),
    [
        pytest.param(1.04, (0.0, 0.0), marks=pytest.mark.long),
        (1.06, (0.05, -0.06)),
        pytest.param(1.08, (0.0, 0.08), marks=pytest.mark.long),
    ],
)
def test_it_agrees_with_the_twins_elements(stretch: float, place: tuple[float, float]) -> None:
    depths = np.array([0.005, 0.020])
    path = push_path(
        RUBBER, stretch_ratio=stretch, depths_m=depths, position_m=place, finger_radius_m=RADIUS
    )
    true = [
        simulate_push(SHEET, stretch, float(depth), place, RADIUS, cells=24) for depth in depths
    ]
    assert path.forces_n == pytest.approx([one[0] for one in true], rel=0.04)
    assert path.edge_forces_n == pytest.approx([one[1] for one in true], rel=0.02)


def test_a_push_leaves_the_finger_where_it_is_and_the_clamps_where_they_are() -> None:
    path = push_path(
        RUBBER, stretch_ratio=1.05, depths_m=[0.03], position_m=(0.02, 0.03), finger_radius_m=RADIUS
    )
    sheet = path.positions[0]
    assert sheet[..., 2].min() == pytest.approx(-0.03, abs=1e-4)
    assert (sheet[:, [0, -1], 2] == 0.0).all()
    assert sheet[:, 0, 0] == pytest.approx(-0.126)
    centre = np.array([0.02, 0.03, RADIUS - 0.03])
    assert np.linalg.norm(sheet - centre, axis=-1).min() > RADIUS - 2e-5


def test_wrinkles_carry_no_pressure() -> None:
    path = push_path(RUBBER, stretch_ratio=1.02, depths_m=[0.03], finger_radius_m=RADIUS)
    grid = membrane._Grid(RUBBER, np.array([0.12, 0.12]), 0.3 * RADIUS, membrane.CELLS)
    _, c = grid.strain(path.positions[0].reshape(-1, 3))
    large, small, _ = principal(c)
    loose = small < np.maximum(large, 1.0) ** -0.5
    assert loose.mean() > 0.02  # the free edges do wrinkle
    stress, _ = stress_and_tangent(c, grid.c1, grid.c2, tangent=False)
    assert np.linalg.eigvalsh(stress).min() > -1e-6 * RUBBER.young_modulus_pa


@pytest.mark.parametrize("stretch", [0.97, 1.0, 1.0005])
def test_a_slack_sheet_is_found(stretch: float) -> None:
    path = push_path(
        RUBBER, stretch_ratio=stretch, depths_m=[0.012, 0.03], finger_radius_m=RADIUS, cells=12
    )
    assert np.isfinite(path.positions).all()
    assert 0.0 <= path.forces_n[0] < 0.15
    assert path.forces_n[0] < path.forces_n[1] < 1.6
    if stretch < 1.0:
        assert path.forces_n[1] < 0.8  # the slack is taken up first


def test_pushing_deeper_in_more_steps_ends_alike() -> None:
    once = push_path(RUBBER, stretch_ratio=1.04, depths_m=[0.025], finger_radius_m=RADIUS, cells=20)
    often = push_path(
        RUBBER,
        stretch_ratio=1.04,
        depths_m=np.linspace(0.0, 0.025, 26),
        finger_radius_m=RADIUS,
        cells=20,
    )
    assert once.forces_n[0] == pytest.approx(often.forces_n[-1], rel=0.02)
    assert often.forces_n[0] == pytest.approx(0.0, abs=1e-6)
    assert (np.diff(often.forces_n) > 0.0).all()


def test_near_the_free_edge_and_the_clamp_there_is_an_answer() -> None:
    for place in ((0.0, 0.112), (0.105, 0.0), (-0.11, -0.1)):
        path = push_path(
            RUBBER,
            stretch_ratio=1.05,
            depths_m=[0.01, 0.03],
            position_m=place,
            finger_radius_m=RADIUS,
            cells=14,
        )
        assert 0.0 < path.forces_n[0] < path.forces_n[1]


def test_mooneys_rubber_softens_when_stretched() -> None:
    shares = [
        push_path(
            Rubber(0.24, 0.24, 0.001, 1e6, mooney_ratio=share),
            stretch_ratio=1.2,
            depths_m=[0.02],
            finger_radius_m=RADIUS,
            cells=20,
        )
        for share in (0.0, 0.3)
    ]
    assert shares[1].forces_n[0] / shares[0].forces_n[0] == pytest.approx(0.955, abs=0.02)
    assert shares[1].edge_forces_n[0] / shares[0].edge_forces_n[0] == pytest.approx(0.95, abs=0.01)


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"depths_m": [0.02, 0.01]}, "ascend"),
        ({"depths_m": [-0.01]}, "ascend"),
        ({"depths_m": [np.nan]}, "ascend"),
        ({"position_m": (0.13, 0.0)}, "not on the sheet"),
        ({"stretch_ratio": 0.0}, "above 0"),
        ({"stretch_ratio": np.nan}, "above 0"),
        ({"finger_radius_m": -1.0}, "above 0"),
    ],
)
def test_pushes_that_are_none_are_rejected(changed: dict[str, object], words: str) -> None:
    asked: dict[str, object] = {
        "stretch_ratio": 1.05,
        "depths_m": [0.01],
        "finger_radius_m": RADIUS,
        "cells": 8,
        **changed,
    }
    with pytest.raises(ValueError, match=words):
        push_path(RUBBER, **asked)  # type: ignore[arg-type]  # one of them is wrong on purpose


def test_a_missing_equilibrium_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(membrane, "MAX_ITERATIONS", 1)
    with pytest.raises(NoEquilibriumError, match="residual"):
        push_path(RUBBER, stretch_ratio=1.05, depths_m=[0.02], finger_radius_m=RADIUS, cells=12)


strains = st.tuples(st.floats(0.5, 1.9), st.floats(0.5, 1.9), st.floats(-0.3, 0.3))


@examples(100)
@given(strains, st.sampled_from([(1.0, 0.0), (0.7, 0.3)]))
def test_stress_and_tangent_are_derivatives_of_the_energy(
    strain: tuple[float, float, float], constants: tuple[float, float]
) -> None:
    def at(values: Floats) -> Floats:
        return np.array([[[values[0], values[2]], [values[2], values[1]]]])

    here = np.array(strain)
    large, small, _ = principal(at(here))
    switches = [large[0] - 1.0, small[0] - np.maximum(large[0], 1.0) ** -0.5, large[0] - small[0]]
    if small[0] < 0.1 or min(abs(value) for value in switches) < 1e-3:
        return  # on a switch of the law the second derivative jumps

    def energy(values: Floats) -> float:
        p, q, _ = principal(at(values))
        return float(relaxed_energy(p, q, *constants)[0][0])

    stress, tangent = stress_and_tangent(at(here), *constants, tangent=True)
    flat = np.array([stress[0, 0, 0], stress[0, 1, 1], stress[0, 0, 1]])
    step = 1e-6
    for i, factor in enumerate((2.0, 2.0, 1.0)):  # dE11 = dC11 / 2, d(2 E12) = dC12
        shift = np.zeros(3)
        shift[i] = step
        slope = factor * (energy(here + shift) - energy(here - shift)) / (2.0 * step)
        assert slope == pytest.approx(flat[i], abs=1e-5)
        after, _ = stress_and_tangent(at(here + shift), *constants, tangent=False)
        before, _ = stress_and_tangent(at(here - shift), *constants, tangent=False)
        turn = factor * (after - before)[0] / (2.0 * step)
        column = np.array([turn[0, 0], turn[1, 1], turn[0, 1]])
        assert column == pytest.approx(tangent[0, :, i], abs=2e-3, rel=2e-3)


def test_the_energy_has_no_step_where_it_begins_to_wrinkle_or_to_slacken() -> None:
    for p in (1.0, 1.2, 1.8):
        q = np.array([p**-0.5 - 1e-7, p**-0.5 + 1e-7])
        energy, first, _ = relaxed_energy(np.full(2, p), q, 0.8, 0.2)
        assert energy[0] == pytest.approx(energy[1], abs=1e-6)
        assert first[:, 0] == pytest.approx(first[:, 1], abs=1e-6)
    energy, first, second = relaxed_energy(np.array([0.9]), np.array([0.8]), 0.8, 0.2)
    assert energy[0] == pytest.approx(0.0, abs=1e-15)
    assert not first.any()
    assert not second.any()


@given(st.floats(0.001, 0.239), st.integers(8, 40))
def test_graded_axes_have_a_node_at_the_focus_and_grow_from_there(focus: float, cells: int) -> None:
    axis = grade_coordinates(0.24, focus, 0.002, cells)
    assert len(axis) == cells + 1
    assert axis[0] == pytest.approx(0.0, abs=1e-15)
    assert axis[-1] == pytest.approx(0.24)
    assert np.abs(axis - focus).min() < 1e-12
    assert (np.diff(axis) > 0.0).all()
