"""Test the simulated sheet against published FE results, theory, equilibrium and difficult
cases.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flexsheet.nodes.models.rigid import apply, rotation_from_vector, transform
from flexsheet.nodes.models.sheet.membrane import push_path
from flexsheet.nodes.models.sheet.rubber import Rubber as ModelRubber
from flexsheet.nodes.models.sheet.tension import compute_sag_m
from flexsheet.nodes.twin import membrane
from flexsheet.nodes.twin.membrane import (
    TrueRubber,
    graded_axis,
    relaxed_energy,
    relaxed_stress,
    solve,
    solve_path,
)
from tests.examples import examples, long_except

RUBBER = TrueRubber(width_m=0.24, height_m=0.24, thickness_m=0.001, young_modulus_pa=1e6)


def edges(stretch: float, pose: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    pose = np.eye(4) if pose is None else pose
    half = 0.12 * stretch
    return (
        pose @ transform(np.eye(3), [-half, 0.0, 0.0]),
        pose @ transform(np.eye(3), [half, 0.0, 0.0]),
    )


@pytest.mark.parametrize(
    ("stretch", "force_n"), [(1.02, 5.1), (1.05, 12.3), (1.10, 23.4), (1.20, 43.0)]
)
def test_edge_force_of_the_flat_sheet(stretch: float, force_n: float) -> None:
    sheet = solve(RUBBER, *edges(stretch))
    assert np.allclose(sheet.left_force_n, [force_n, 0, 0], atol=0.01 * force_n)
    assert np.allclose(sheet.left_force_n + sheet.right_force_n, 0.0, atol=1e-4)
    assert np.allclose(sheet.positions[..., 2], 0.0, atol=1e-9)


class Patch:
    """A rigid disc with a radius of 10 mm that is bonded to the sheet, as in the published FE
    results.
    """

    def __init__(self, rest: np.ndarray, start: np.ndarray, depth_m: float) -> None:
        self.on = np.hypot(*(rest.reshape(-1, 2) - 0.12).T) < 0.010
        self.target = start - [0.0, 0.0, depth_m]

    def _away(self, positions: np.ndarray) -> np.ndarray:
        return np.where(self.on[:, None], positions - self.target, 0.0)

    def energy(self, positions: np.ndarray) -> float:
        return float(0.5 * 1e5 * np.sum(self._away(positions) ** 2))

    def forces(self, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        stiffness = np.where(self.on[:, None, None], 1e5 * np.eye(3), 0.0)
        return 1e5 * self._away(positions), stiffness


@pytest.mark.parametrize(
    ("stretch", "forces_n"),
    [(1.02, (0.35, 1.2, 4.9)), (1.05, (0.68, 1.9, 6.5)), (1.10, (1.1, 2.9, 8.7))],
)
def test_push_force_of_a_disc(stretch: float, forces_n: tuple[float, float, float]) -> None:
    axis = membrane._insert_midpoints(graded_axis(0.24, 12, 0.12))
    mesh = membrane._Mesh(RUBBER, axis, axis, membrane.SLACK_TENSION)
    flat = np.zeros((axis.size**2, 3))
    flat[:, :2] = (mesh.rest.reshape(-1, 2) - 0.12) * [stretch, 1.0]
    flat, _ = membrane._relax(mesh, flat, None)
    positions = flat
    for depth_m, wanted_n in zip((0.01, 0.02, 0.04), forces_n, strict=True):
        patch = Patch(mesh.rest, flat, depth_m)
        positions, _ = membrane._relax(mesh, positions, patch)  # type: ignore[arg-type]  # a stand-in
        force_n = patch.forces(positions)[0][:, 2].sum()
        # 5 %: the table is of a uniform mesh with another count of nodes under the disc.
        assert abs(abs(force_n) - wanted_n) < 0.05 * wanted_n


def test_finger_pushes_less_than_a_disc_and_leaves_its_tip_where_it_is() -> None:
    sheet = solve(RUBBER, *edges(1.05), finger_tip=np.array([0.0, 0.0, -0.02]))
    assert np.isclose(sheet.positions[..., 2].min(), -0.02, atol=5e-5)
    assert 1.0 < sheet.finger_force_n[2] < 1.9
    assert np.allclose(sheet.finger_force_n[:2], 0.0, atol=0.01)


@pytest.mark.parametrize("stretch", long_except([1.0, 1.02, 1.05, 1.08], 1.0, 1.08))
def test_deep_push_converges(stretch: float) -> None:
    sheet = solve(RUBBER, *edges(stretch), finger_tip=np.array([0.0, 0.0, -0.05]), cells=24)
    assert np.isfinite(sheet.positions).all()
    assert 4.0 < sheet.finger_force_n[2] < 12.0


@examples(2)
@given(
    st.tuples(*[st.floats(-0.8, 0.8)] * 3),
    st.tuples(st.floats(-0.07, 0.07), st.floats(-0.08, 0.08), st.floats(-0.05, -0.001)),
    st.tuples(*[st.floats(-0.05, 0.05)] * 3),
    st.floats(1.0, 1.08),
)
def test_tilted_twisted_off_centre_push_is_in_balance(
    turn: tuple[float, float, float],
    tip: tuple[float, float, float],
    twist: tuple[float, float, float],
    stretch: float,
) -> None:
    pose = transform(rotation_from_vector(turn), [0.01, -0.02, 0.03])
    left, right = edges(stretch, pose)
    right = right @ transform(rotation_from_vector(twist), np.zeros(3))
    finger_tip = apply(pose, np.array(tip))
    sheet = solve(RUBBER, left, right, finger_tip=finger_tip, cells=24)
    total = sheet.finger_force_n + sheet.left_force_n + sheet.right_force_n
    assert np.allclose(total, 0.0, atol=1e-3)
    from_tip = np.linalg.norm(sheet.positions - finger_tip, axis=-1).min()
    assert from_tip < 0.004 or tip[2] > -0.003


def test_a_push_through_several_depths_finds_the_sheet_of_each() -> None:
    depths = (0.004, 0.012, 0.02)
    tips = [np.array([0.0, 0.0, -depth]) for depth in depths]
    path = solve_path(RUBBER, *edges(1.04), finger_tips=tips, cells=16)
    assert len(path) == len(depths)
    for tip, pushed in zip(tips, path, strict=True):
        alone = solve(RUBBER, *edges(1.04), finger_tip=tip, cells=16)
        # Touched nodes stick, so that the positions of earlier contacts have a small effect.
        assert pushed.finger_force_n[2] == pytest.approx(alone.finger_force_n[2], rel=0.02)
        assert pushed.positions == pytest.approx(alone.positions, abs=1e-4)
    (untouched,) = solve_path(RUBBER, *edges(1.04), finger_tips=(), cells=16)
    assert not untouched.finger_force_n.any()


def test_pose_carries_the_solution_along() -> None:
    pose = transform(rotation_from_vector([0.6, -0.2, 0.1]), [0.02, 0.03, -0.04])
    tip = np.array([0.01, 0.02, -0.015])
    here = solve(RUBBER, *edges(1.04), finger_tip=tip)
    there = solve(RUBBER, *edges(1.04, pose), finger_tip=apply(pose, tip))
    assert np.allclose(there.positions, apply(pose, here.positions), atol=1e-6)


@pytest.mark.parametrize("tip", [(0.0, 0.0, 0.005), (0.2, 0.0, -0.3), (0.0, -0.13, -0.01)])
def test_finger_before_or_beside_the_sheet_pushes_nothing(
    tip: tuple[float, float, float],
) -> None:
    sheet = solve(RUBBER, *edges(1.04), finger_tip=np.array(tip), cells=16)
    assert not sheet.finger_force_n.any()


def test_slack_sheet_is_found_and_pulls_nothing() -> None:
    sheet = solve(RUBBER, *edges(0.97), cells=16)
    assert np.isfinite(sheet.positions).all()
    assert np.linalg.norm(sheet.left_force_n) < 0.1


def test_edges_that_coincide_are_rejected() -> None:
    with pytest.raises(ValueError, match="apart"):
        solve(RUBBER, np.eye(4), np.eye(4))


strains = st.tuples(st.floats(0.5, 1.8), st.floats(0.5, 1.8), st.floats(-0.3, 0.3))


@given(strains)
def test_stress_and_tangent_are_derivatives_of_the_energy(
    strain: tuple[float, float, float],
) -> None:
    c = np.array([strain])
    large, small, _ = membrane._eigen(c)
    switches = [large[0] - 1.0, small[0] - np.maximum(large[0], 1.0) ** -0.5, large[0] - small[0]]
    if small[0] < 0.05 or min(abs(value) for value in switches) < 1e-3:
        return  # on a switch of the law the second derivative jumps
    stress, tangent = relaxed_stress(c, 1.0)
    step = 1e-6
    for i, factor in enumerate((2.0, 2.0, 1.0)):  # dE11 = dC11 / 2, d(2 E12) = dC12
        shift = np.zeros(3)
        shift[i] = step
        slope = (relaxed_energy(c + shift, 1.0) - relaxed_energy(c - shift, 1.0)) / (2 * step)
        assert np.isclose(slope[0] * factor, stress[0, i], atol=1e-5)
        turn = relaxed_stress(c + shift, 1.0)[0] - relaxed_stress(c - shift, 1.0)[0]
        assert np.allclose(turn[0] / (2 * step) * factor, tangent[0, :, i], atol=1e-3, rtol=1e-3)


def test_law_never_presses_but_by_the_slack_tension() -> None:
    rng = np.random.default_rng(0)
    c = np.column_stack([rng.uniform(0.5, 1.5, (500, 2)), rng.uniform(-0.2, 0.2, 500)])
    stress, _ = relaxed_stress(c, 1.0)
    _, smaller, _ = membrane._eigen(stress)
    assert smaller.min() > -1e-9


def test_graded_axis_is_finest_at_the_finger_and_ends_at_the_clamps() -> None:
    for focus in (0.0, 0.03, 0.12, 0.24, 0.3):
        axis = graded_axis(0.24, 32, focus)
        assert len(axis) == 33
        assert axis[0] == 0.0
        assert np.isclose(axis[-1], 0.24)
        cells = np.diff(axis)
        assert cells.min() > 0.0
        assert abs(axis[np.argmin(cells)] - min(focus, 0.24)) < 0.012
    assert np.allclose(np.diff(graded_axis(0.24, 8, None)), 0.03)


HEAVY = replace(RUBBER, density_kg_per_m3=1200.0)


@pytest.mark.parametrize(
    ("stretch", "tilt_deg", "tolerance"), [(1.05, 50, 0.08), (1.05, -50, 0.08), (1.02, 10, 0.08)]
)
def test_a_tilted_sheet_sags_as_the_parabola_of_its_tension(
    stretch: float, tilt_deg: float, tolerance: float
) -> None:
    pose = transform(rotation_from_vector([np.radians(tilt_deg), 0.0, 0.0]), [0.0, 0.0, 0.0])
    sheet = solve(HEAVY, *edges(stretch, pose), cells=16)
    local = sheet.positions @ pose[:3, :3]
    across = local[..., 0] / (0.24 * stretch) + 0.5
    parabola = compute_sag_m(
        ModelRubber(0.24, 0.24, 0.001, 1e6),
        pose[:3, 2],
        density_kg_per_m3=1200.0,
        edge_distance_m=0.24 * stretch,
        across=across,
        along=local[..., 1] / 0.24,
    )
    rms_sag, rms_error = (
        float(np.sqrt(np.mean(value**2))) for value in (local[..., 2], local[..., 2] - parabola)
    )
    assert rms_error < tolerance * rms_sag
    assert np.sign(local[8, 8, 2]) == np.sign(tilt_deg)


def test_the_clamps_carry_the_weight_of_the_sheet() -> None:
    sheet = solve(HEAVY, *edges(1.03), cells=16)
    weight_n = 1200.0 * 0.24 * 0.24 * 0.001 * 9.81
    assert np.allclose(sheet.left_force_n + sheet.right_force_n, [0.0, -weight_n, 0.0], atol=1e-4)


def test_a_thicker_sheet_at_one_clamp_carries_the_mean_thickness() -> None:
    uneven = solve(replace(RUBBER, thickness_gradient=(0.0, 0.2)), *edges(1.05), cells=16)
    even = solve(RUBBER, *edges(1.05), cells=16)
    assert np.isclose(uneven.left_force_n[0], even.left_force_n[0], rtol=0.01)
    # The thicker half carries more: the tension acts above the middle of the edge.
    pulled = solve(
        replace(RUBBER, thickness_gradient=(0.0, 0.2)),
        *edges(1.05),
        finger_tip=np.array([0.0, 0.06, -0.01]),
        cells=16,
    )
    below = solve(
        replace(RUBBER, thickness_gradient=(0.0, 0.2)),
        *edges(1.05),
        finger_tip=np.array([0.0, -0.06, -0.01]),
        cells=16,
    )
    assert pulled.finger_force_n[2] > 1.02 * below.finger_force_n[2]


@pytest.mark.parametrize("coefficient", long_except([0.0, 0.3], 0.3))
def test_friction_stays_within_coulombs_limit(coefficient: float) -> None:
    tip = np.array([0.05, 0.03, -0.02])
    slipping = solve(
        RUBBER, *edges(1.05), finger_tip=tip, friction_coefficient=coefficient, cells=24
    )
    sticking = solve(RUBBER, *edges(1.05), finger_tip=tip, cells=24)
    assert slipping.finger_force_n[2] < sticking.finger_force_n[2]
    total = slipping.finger_force_n + slipping.left_force_n + slipping.right_force_n
    assert np.allclose(total, 0.0, atol=1e-3)


def test_alternating_friction_forces_converge() -> None:
    """If changes are halved only once, nodes at the friction limit alternate between stick and
    slip.
    """
    tip = np.array([-0.0023, 0.0701, -0.033])
    pushed = solve(RUBBER, *edges(1.05), finger_tip=tip, friction_coefficient=0.85, cells=16)
    total = pushed.finger_force_n + pushed.left_force_n + pushed.right_force_n
    assert np.linalg.norm(total) < 0.01 * np.linalg.norm(pushed.finger_force_n)


def test_a_coefficient_that_is_never_reached_changes_nothing() -> None:
    tip = np.array([0.02, 0.0, -0.01])
    rough = solve(RUBBER, *edges(1.05), finger_tip=tip, friction_coefficient=1e6, cells=16)
    sticking = solve(RUBBER, *edges(1.05), finger_tip=tip, cells=16)
    assert np.allclose(rough.finger_force_n, sticking.finger_force_n, atol=0.01)


def test_the_elements_agree_with_those_of_the_renderer() -> None:
    path = push_path(
        ModelRubber(0.24, 0.24, 0.001, 1e6),
        stretch_ratio=1.05,
        depths_m=[0.01, 0.03],
        finger_radius_m=0.007,
    )
    for depth_m, force_n in zip(path.depths_m, path.forces_n, strict=True):
        sheet = solve(RUBBER, *edges(1.05), finger_tip=np.array([0.0, 0.0, -depth_m]))
        assert np.isclose(sheet.finger_force_n[2], force_n, rtol=0.02)
