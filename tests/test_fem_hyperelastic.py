"""Test the neo-Hookean solid and its direct solver against theory and scikit-fem."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from flexsheet.nodes.fem_solver.elasticity import (
    SolidMeshError,
    element_stiffness,
)
from flexsheet.nodes.fem_solver.hyperelastic import InvertedElementError, NeoHookeanSolid
from flexsheet.nodes.fem_solver.multifrontal import IndefiniteError, NestedDissection
from tests.linear_elasticity import scikit_basis
from tests.solids import box, distorted

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

MODULUS, NU = 4000.0, 0.45
LAME, MU = MODULUS * NU / (1 + NU) / (1 - 2 * NU), MODULUS / 2 / (1 + NU)


def block(divisions: tuple[int, int, int] = (2, 2, 2), nu: float = NU) -> NeoHookeanSolid:
    nodes, elements = distorted(*box(divisions, (1.0, 1.0, 1.0)))
    return NeoHookeanSolid(nodes, elements, young_modulus_pa=MODULUS, poisson_ratio=nu)


def bent(solid: NeoHookeanSolid, size: float) -> Floats:
    """Return a displacement that bends, twists and stretches."""
    x, y, z = solid.nodes.T
    return size * np.column_stack([x * y + 0.3 * z, y * z - 0.5 * x * x, np.sin(2 * x) * z])


@given(seed=st.integers(0, 2**32 - 1), size=st.floats(0.0, 0.25))
@settings(max_examples=12, deadline=None)
def test_forces_and_tangent_are_the_energys_derivatives(seed: int, size: float) -> None:
    solid = block((1, 1, 1))
    there, way = bent(solid, size), np.random.default_rng(seed).normal(size=solid.nodes.shape)
    step = 1e-6
    ahead, behind = there + step * way, there - step * way
    slope = (solid.energy(ahead) - solid.energy(behind)) / (2 * step)
    assert float((solid.forces(there) * way).sum()) == pytest.approx(slope, rel=1e-6, abs=1e-5)
    dofs = (3 * solid.elements[:, :, None] + np.arange(3)).reshape(-1, 30)
    product = np.zeros(way.size)
    np.add.at(product, dofs, np.einsum("eij,ej->ei", solid.tangents(there), way.ravel()[dofs]))
    change = (solid.forces(ahead) - solid.forces(behind)).ravel() / (2 * step)
    assert np.abs(product - change).max() < 1e-6 * np.abs(change).max()


def test_small_strains_are_hookes_law() -> None:
    solid = block()
    hooke = element_stiffness(
        solid.nodes, solid.elements, young_modulus_pa=MODULUS, poisson_ratio=NU
    )
    assert np.abs(solid.tangents(np.zeros_like(solid.nodes)) - hooke).max() < 1e-10 * hooke.max()


def test_turning_the_body_costs_nothing() -> None:
    solid = block()
    angle = 2.0
    turn = np.array(
        [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1.0]]
    )
    moved = solid.nodes @ turn.T + 3.0 - solid.nodes
    assert solid.energy(moved) == pytest.approx(0.0, abs=1e-10)
    assert np.abs(solid.forces(moved)).max() < 1e-10


def test_an_element_turned_inside_out_has_no_energy_and_no_forces() -> None:
    solid = block((1, 1, 1))
    flipped = solid.nodes * [0.0, 0.0, -1.5]
    assert solid.energy(flipped) == float("inf")
    with pytest.raises(InvertedElementError, match="are inverted"):
        solid.forces(flipped)
    with pytest.raises(InvertedElementError, match="are inverted"):
        solid.tangents(flipped)
    with pytest.raises(SolidMeshError, match="inverted or flat"):
        NeoHookeanSolid(
            solid.nodes * [1, 1, -1], solid.elements, young_modulus_pa=1.0, poisson_ratio=0.3
        )


@pytest.mark.parametrize("nu", [0.3, 0.499])
def test_a_squeezed_volume_costs_ever_more(nu: float) -> None:
    solid = block((1, 1, 1), nu)
    energies = [solid.energy(solid.nodes * (side - 1.0)) for side in (0.9, 0.5, 0.1, 0.01, 1e-4)]
    assert (np.diff(energies) > 0).all()


def test_a_stiffness_that_does_not_resist_is_an_error() -> None:
    solid = block((3, 2, 2))
    order = NestedDissection(solid.nodes, solid.elements, solid.nodes[:, 2] == 0.0)
    with pytest.raises(IndefiniteError, match="pivot"):
        order.factor(-solid.tangents(np.zeros_like(solid.nodes)))


def test_nonlinear_forces_tangent_and_solution_equal_those_of_scikit_fem() -> None:
    """Deform a block, fixed at its bottom, sideways by body forces at large strains."""
    import skfem
    from scipy.sparse import coo_matrix
    from scipy.sparse.linalg import spsolve
    from skfem.helpers import ddot, det, grad, identity, inv, transpose

    nodes, elements = box((1, 2, 2), (1.0, 1.0, 2.0))
    solid = NeoHookeanSolid(nodes, elements, young_modulus_pa=MODULUS, poisson_ratio=NU)
    basis, order = scikit_basis(nodes, elements)

    def stress(state: Any) -> Any:
        gradient = grad(state) + identity(grad(state))
        inverse = transpose(inv(gradient))
        return MU * (gradient - inverse) + LAME * np.log(det(gradient)) * inverse

    @skfem.LinearForm
    def internal(v: Any, w: Any) -> Any:
        return ddot(stress(w["state"]), grad(v))

    @skfem.BilinearForm
    def tangent(u: Any, v: Any, w: Any) -> Any:
        gradient = grad(w["state"]) + identity(grad(w["state"]))
        inverse, log = inv(gradient), np.log(det(gradient))
        product = np.einsum("ij...,jk...->ik...", inverse, grad(u))
        product = np.einsum("ij...,jk...->ik...", product, inverse)
        change = MU * grad(u) + (MU - LAME * log) * transpose(product)
        change = change + LAME * ddot(transpose(inverse), grad(u)) * transpose(inverse)
        return ddot(change, grad(v))

    @skfem.LinearForm
    def weight(v: Any, w: Any) -> Any:
        return 90.0 * v[0] - 60.0 * v[2]

    fixed = nodes[:, 2] == 0.0
    held = np.isin(order // 3, np.flatnonzero(fixed))
    load = weight.assemble(basis)
    theirs = np.zeros(basis.N)
    for load in np.linspace(0.5, 1.0, 2).repeat(7)[:, None] * weight.assemble(basis):
        state = {"state": basis.interpolate(theirs)}
        matrix = tangent.assemble(basis, **state).tocsr()
        residual = internal.assemble(basis, **state) - load
        step = spsolve(matrix[~held][:, ~held].tocsc(), -residual[~held])
        theirs[~held] += step
    assert np.abs(step).max() < 1e-12
    assert np.abs(theirs).max() > 0.1

    back = np.empty(len(order), dtype=np.int64)
    back[order] = np.arange(len(order))
    there = theirs[back].reshape(-1, 3)
    mine = internal.assemble(basis, **state)[back]
    assert np.abs(solid.forces(there).ravel() - mine).max() < 1e-9 * np.abs(mine).max()
    dofs = (3 * elements[:, :, None] + np.arange(3)).reshape(-1, 30)
    rows, columns = np.repeat(dofs, 30, axis=1).ravel(), np.tile(dofs, (1, 30)).ravel()
    ours = coo_matrix((solid.tangents(there).ravel(), (rows, columns))).tocsr()
    assert abs(ours[order][:, order] - matrix).max() < 1e-10 * abs(matrix).max()

    loads = load[back].reshape(-1, 3)
    dissection = NestedDissection(nodes, elements, fixed)
    moved = np.zeros_like(nodes)
    for share in np.linspace(0.5, 1.0, 2).repeat(7):
        residual = solid.forces(moved) - share * loads
        moved = moved - dissection.factor(solid.tangents(moved)).solve(residual.ravel()).reshape(
            -1, 3
        )
    assert np.abs(moved - there).max() < 1e-8 * np.abs(there).max()
