"""Verify thick spheres under pressure: Lame's solution, and the inflation of a rubber sphere."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.sparse.linalg import splu

from flexsheet.nodes.fem_solver.hyperelastic import NeoHookeanSolid
from tests.examples import long_except
from tests.fem_fields import equilibrium, lame, pressure_loads, rate, relative_errors
from tests.fem_verification import Record, at_most, between, near
from tests.linear_elasticity import stiffness_matrix
from tests.thick_sphere import INNER, OUTER, eighth, faces_at, symmetry

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

E = 1000.0


class Lame:
    """The displacement of a thick sphere under an inner and an outer pressure."""

    def __init__(self, inside: float, outside: float, nu: float) -> None:
        a3, b3 = INNER**3, OUTER**3
        self.uniform = (inside * a3 - outside * b3) / (b3 - a3) * (1 - 2 * nu) / E
        self.shear = (inside - outside) * a3 * b3 / (b3 - a3) * (1 + nu) / (2 * E)

    def radial(self, radius: float) -> float:
        return self.uniform * radius + self.shear / radius**2

    def field(self, points: Floats) -> Floats:
        radius = np.linalg.norm(points, axis=1)[:, None]
        return points * (self.uniform + self.shear / radius**3)

    def slope(self, points: Floats) -> Floats:
        radius = np.linalg.norm(points, axis=1)[:, None, None]
        way = points / radius[:, 0]
        product = np.eye(3) - 3 * way[:, :, None] * way[:, None, :]
        return self.uniform * np.eye(3) + self.shear / radius**3 * product


@cache
def unit_answers(layers: int, nu: float) -> tuple[Floats, Ints, Floats, Floats]:
    """Return nodes, elements, and their displacements under a unit of inner and of outer
    pressure."""
    nodes, elements = eighth(layers)
    loads = [pressure_loads(nodes, faces_at(nodes, elements, at), 1.0) for at in (INNER, OUTER)]
    matrix = stiffness_matrix(nodes, elements, young_modulus_pa=E, poisson_ratio=nu)
    free = np.setdiff1d(np.arange(nodes.size), symmetry(nodes))
    # positive definite: no pivot needs looking for
    factor = splu(matrix[free][:, free].tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0)
    moved = np.zeros((nodes.size, 2))
    moved[free] = factor.solve(np.column_stack(loads)[free])
    inner, outer = moved.T
    return nodes, elements, inner.reshape(-1, 3), outer.reshape(-1, 3)


def solved(layers: int, exact: tuple[float, float], nu: float) -> tuple[Floats, Ints, Floats]:
    """Return nodes, elements and displacement under an inner and an outer pressure."""
    nodes, elements, inner, outer = unit_answers(layers, nu)
    return nodes, elements, exact[0] * inner + exact[1] * outer


@pytest.mark.long
@pytest.mark.parametrize(("inside", "outside"), [(1.0, 0.0), (0.0, 1.0)])
def test_thick_sphere_under_pressure(
    record_property: Record, inside: float, outside: float
) -> None:
    """The outer radius is twice the inner one, with four layers of cells; the displacements of both
    surfaces are compared.

    Source: Lame 1852; Timoshenko & Goodier, Theory of Elasticity, 3rd ed., art. 136
    """
    exact = Lame(inside, outside, 0.3)
    nodes, _, got = solved(4, (inside, outside), 0.3)
    radius = np.linalg.norm(nodes, axis=1)
    pushed = "inside" if inside else "outside"
    for name, at in (("inner", INNER), ("outer", OUTER)):
        there = np.isclose(radius, at)
        moved = (got[there] * nodes[there]).sum(axis=1) / at
        error = float(np.abs(moved / exact.radial(at) - 1).max())
        what = f"thick sphere pressed from {pushed}, worst node of the {name} skin, relative"
        at_most(record_property, what, error, 6e-3)


@pytest.mark.long
def test_thick_sphere_converges_as_it_should(record_property: Record) -> None:
    """Curved elements and pressure on curved faces have the rates of quadratic elements, 3 and 2.
    On such coarse meshes the rates approach them from below (from two to five layers 1.65, 1.75,
    1.81 in energy).

    Source: Lame 1852; rates by Ciarlet & Raviart, isoparametric elements, 1972
    """
    exact, sizes, errors = Lame(1.0, 0.3, 0.3), [], []
    for layers in (2, 3, 4):
        nodes, elements, got = solved(layers, (1.0, 0.3), 0.3)
        sizes.append(1.0 / layers)
        errors.append(
            relative_errors((nodes, elements), got, exact.field, exact.slope, lame(E, 0.3))
        )
    l2, energy = (rate(sizes, [pair[i] for pair in errors]) for i in (0, 1))
    between(record_property, "thick sphere, rate in L2, three meshes", l2, 2.7, 3.3)
    between(record_property, "thick sphere, rate in energy norm, three meshes", energy, 1.6, 2.2)


@pytest.mark.parametrize("nu", long_except([0.45, 0.499, 0.4999], 0.4999))
def test_thick_sphere_nearly_incompressible(record_property: Record, nu: float) -> None:
    """The displacements remain accurate as nu approaches 0.5, while the error in the energy norm,
    that of stresses, grows.

    Source: Lame 1852
    """
    exact = Lame(1.0, 0.0, nu)
    nodes, elements, got = solved(3, (1.0, 0.0), nu)
    l2, energy = relative_errors((nodes, elements), got, exact.field, exact.slope, lame(E, nu))
    at_most(record_property, f"thick sphere, ν = {nu:g}, displacement in L2", l2, 0.03)
    at_most(record_property, f"thick sphere, ν = {nu:g}, energy norm", energy, 0.2)


def test_inflated_rubber_sphere(record_property: Record) -> None:
    """The inner radius of a thick neo-Hookean sphere grows by half, with nu = 0.499 for 0.5; outer
    radius and pressure are compared.

    Source: p = mu/2 [(4 / l + 1 / l^4)]_outer - [...]_inner with l the hoop stretches, Ogden,
    Non-linear Elastic Deformations, 1984, sec. 5.3
    """
    nodes, elements = eighth(2)
    solid = NeoHookeanSolid(nodes, elements, young_modulus_pa=E, poisson_ratio=0.499)
    radius = np.linalg.norm(nodes, axis=1)
    inner = np.isclose(radius, INNER)
    held = np.union1d(symmetry(nodes), 3 * np.flatnonzero(inner)[:, None] + np.arange(3))
    wanted = np.where(inner[:, None], 0.5 * nodes, 0.0).ravel()
    got = equilibrium(solid, held, wanted[held], np.zeros(nodes.size), steps=3)
    outer = np.isclose(radius, OUTER)
    now = np.linalg.norm((nodes + got)[outer], axis=1)
    theory = (OUTER**3 + (1.5**3 - 1) * INNER**3) ** (1 / 3)
    near(record_property, "inflated rubber sphere, outer radius", float(now.mean()), theory, 0.003)
    forces = solid.forces(got)[inner]
    push = float((forces * nodes[inner]).sum()) / (0.5 * np.pi * (1.5 * INNER) ** 2)
    mu = lame(E, 0.499)[1]

    def term(stretch: float) -> float:
        return 4 / stretch + stretch**-4

    pressure = 0.5 * mu * (term(theory / OUTER) - term(1.5))
    near(record_property, "inflated rubber sphere, pressure", push, pressure, 0.03)
