"""Verify stiffness and solution on the meshes of all shapes against scikit-fem."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest
import skfem
from numpy.typing import NDArray
from skfem.models.elasticity import lame_parameters, linear_elasticity

from flexsheet.nodes.fem_solver.elasticity import element_stiffness
from flexsheet.nodes.fem_solver.mesh.solid import boundary_faces
from flexsheet.nodes.fem_solver.multifrontal import NestedDissection
from tests.examples import long_except
from tests.fem_fields import dofs_of, pressure_loads
from tests.fem_verification import Record, at_most
from tests.linear_elasticity import scikit_basis, solve, stiffness_matrix
from tests.scene_solids import SHAPES, scene_solid

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

E, NU, PRESSURE = 4000.0, 0.45, 50.0


@cache
def their_basis(shape: str) -> tuple[Any, Ints]:
    mesh = scene_solid(shape)
    return scikit_basis(mesh.nodes, mesh.elements)


@cache
def their_matrix(shape: str) -> Any:
    basis, _ = their_basis(shape)
    return skfem.asm(linear_elasticity(*lame_parameters(E, NU)), basis)


@pytest.mark.parametrize("shape", long_except(SHAPES, "cylinder", "mesh"))
def test_stiffness_equals_that_of_scikit_fem(record_property: Record, shape: str) -> None:
    """The error is the largest difference of any entry over the largest entry.

    Source: scikit-fem (Gustafsson & McBain, J. Open Source Softw. 5, 2020), linear_elasticity on
    curved ElementTetP2
    """
    mesh = scene_solid(shape)
    _, order = their_basis(shape)
    theirs = their_matrix(shape)
    ours = stiffness_matrix(mesh.nodes, mesh.elements, young_modulus_pa=E, poisson_ratio=NU)
    error = float(abs(ours[order][:, order] - theirs).max() / abs(theirs).max())
    at_most(record_property, f"stiffness as scikit-fem's, mesh of the {shape}", error, 1e-10)


@pytest.mark.parametrize("shape", long_except(SHAPES, "cylinder", "mesh"))
def test_solution_equals_that_of_scikit_fem(record_property: Record, shape: str) -> None:
    """The body on its support has a pressure on the skin that fingers reach; both of the solver's
    factorizations are compared with scikit-fem's `solve`.

    Source: scikit-fem, `condense` and `solve`
    """
    mesh = scene_solid(shape)
    _, order = their_basis(shape)
    faces = boundary_faces(mesh.elements)
    pressed = faces[np.isin(faces, mesh.contact_nodes).all(axis=1)]
    loads = pressure_loads(mesh.nodes, pressed, PRESSURE)
    held = np.flatnonzero(np.isin(order, dofs_of(np.flatnonzero(mesh.fixed))))
    solver = skfem.solver_direct_scipy(permc_spec="MMD_AT_PLUS_A")
    problem = skfem.condense(their_matrix(shape), loads[order], D=held)
    theirs = skfem.solve(*problem, solver=solver)
    largest = np.abs(theirs).max()
    assert largest > 1e-5
    ours = stiffness_matrix(mesh.nodes, mesh.elements, young_modulus_pa=E, poisson_ratio=NU)
    fixed = dofs_of(np.flatnonzero(mesh.fixed))
    by_sparse = solve(ours, fixed, np.zeros(len(fixed)), loads)
    matrices = element_stiffness(mesh.nodes, mesh.elements, young_modulus_pa=E, poisson_ratio=NU)
    by_fronts = (
        NestedDissection(mesh.nodes, mesh.elements, mesh.fixed).factor(matrices).solve(loads)
    )
    for name, mine in (("sparse", by_sparse), ("multifrontal", by_fronts)):
        error = float(np.abs(mine[order] - theirs).max() / largest)
        what = f"solution by {name} factor as scikit-fem's, mesh of the {shape}"
        at_most(record_property, what, error, 1e-8)
