"""Test the true sheet against published FE results, theory, equilibrium and hard cases."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flexsheet.nodes.models.rigid import apply, rotation_from_vector, transform
from flexsheet.nodes.twin import membrane
from flexsheet.nodes.twin.membrane import Rubber, graded_axis, relaxed_energy, relaxed_stress, solve

RUBBER = Rubber(width_m=0.24, height_m=0.24, thickness_m=0.001, young_modulus_pa=1e6)


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
    """Rigid disc of 10 mm radius that is bonded to its nodes: the load of the FE table."""

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
    axis = graded_axis(0.24, 24, 0.12)
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


@pytest.mark.parametrize("stretch", [1.0, 1.02, 1.05, 1.08])
def test_deep_push_converges(stretch: float) -> None:
    sheet = solve(RUBBER, *edges(stretch), finger_tip=np.array([0.0, 0.0, -0.05]), cells=24)
    assert np.isfinite(sheet.positions).all()
    assert 4.0 < sheet.finger_force_n[2] < 12.0


@settings(max_examples=4, deadline=None)
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
