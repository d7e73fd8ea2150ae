"""Verify the neo-Hookean body at large stretch against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import brentq

from flexsheet.nodes.fem_solver.hyperelastic import NeoHookeanSolid
from flexsheet.nodes.fem_solver.mesh.solid import boundary_faces
from tests.fem_fields import dofs_of, equilibrium, lame
from tests.fem_verification import Record, at_most, near
from tests.solids import box, distorted

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

MODULUS = 4000.0


def cube(nu: float) -> NeoHookeanSolid:
    nodes, elements = distorted(*box((2, 2, 2), (1.0, 1.0, 1.0)))
    return NeoHookeanSolid(nodes, elements, young_modulus_pa=MODULUS, poisson_ratio=nu)


def stretched(solid: NeoHookeanSolid, stretches: dict[int, float]) -> tuple[Floats, Floats]:
    """Return displacement and forces (n, 3) of the cube with sliding supports on its three lower
    faces and prescribed upper faces."""
    nodes = solid.nodes
    values = {3 * int(n) + a: 0.0 for a in range(3) for n in np.flatnonzero(nodes[:, a] == 0.0)}
    for axis, stretch in stretches.items():
        for node in np.flatnonzero(np.isclose(nodes[:, axis], 1.0)):
            values[3 * int(node) + axis] = stretch - 1.0
    held = np.array(sorted(values))
    moved = np.array([values[dof] for dof in held.tolist()])
    got = equilibrium(solid, held, moved, np.zeros(nodes.size), steps=8)
    return got, solid.forces(got)


def traction(nu: float, mine: float, volume_ratio: float) -> float:
    """Return the force per undeformed area along an axis stretched by `mine`."""
    lam, mu = lame(MODULUS, nu)
    return mu * (mine - 1 / mine) + lam * np.log(volume_ratio) / mine


def pulled(solid: NeoHookeanSolid, forces: Floats, axis: int) -> float:
    """Return the force on the upper face of an axis."""
    return float(forces[np.isclose(solid.nodes[:, axis], 1.0), axis].sum())


@pytest.mark.parametrize("nu", [0.3, 0.499])
@pytest.mark.parametrize("stretch", [0.4, 3.0])
def test_uniaxial(record_property: Record, stretch: float, nu: float) -> None:
    """The cube is stretched along one axis with free sides; contraction and force are compared.

    Source: Bonet & Wood, Nonlinear Continuum Mechanics, 2nd ed., sec. 6.4.3 and exercise 6.2
    """
    thin = brentq(lambda t: traction(nu, t, stretch * t * t), 0.05, 5.0, xtol=1e-15)
    solid = cube(nu)
    got, forces = stretched(solid, {2: stretch})
    place = solid.nodes * [thin, thin, stretch] - solid.nodes
    what = f"uniaxial stretch {stretch:g}, ν = {nu:g}"
    at_most(record_property, f"{what}, displacement", float(np.abs(got - place).max()), 1e-8)
    wanted = traction(nu, stretch, stretch * thin * thin)
    near(record_property, f"{what}, force", pulled(solid, forces, 2), wanted, 1e-8)


@pytest.mark.parametrize("stretch", [0.6, 2.0])
def test_equibiaxial(record_property: Record, stretch: float) -> None:
    """The cube is stretched equally along two axes.

    Source: Bonet & Wood, Nonlinear Continuum Mechanics, 2nd ed., sec. 6.4.3
    """
    nu = 0.45
    thin = brentq(lambda t: traction(nu, t, stretch**2 * t), 0.02, 20.0, xtol=1e-15)
    solid = cube(nu)
    got, forces = stretched(solid, {0: stretch, 1: stretch})
    place = solid.nodes * [stretch, stretch, thin] - solid.nodes
    what = f"equibiaxial stretch {stretch:g}"
    at_most(record_property, f"{what}, displacement", float(np.abs(got - place).max()), 1e-8)
    wanted = traction(nu, stretch, stretch**2 * thin)
    near(record_property, f"{what}, force", pulled(solid, forces, 1), wanted, 1e-8)


@pytest.mark.parametrize("stretch", [0.5, 2.0])
def test_uniaxial_of_rubber(record_property: Record, stretch: float) -> None:
    """At nu = 0.4999 the result approaches the incompressible law.

    Source: P = mu (l - 1 / l^2), Treloar, The Physics of Rubber Elasticity, 3rd ed., 1975, sec. 4.3
    """
    solid = cube(0.4999)
    _, forces = stretched(solid, {2: stretch})
    wanted = lame(MODULUS, 0.4999)[1] * (stretch - stretch**-2)
    what = f"uniaxial stretch {stretch:g}, ν = 0.4999, force over the incompressible"
    near(record_property, what, pulled(solid, forces, 2), wanted, 1e-3)


def test_simple_shear(record_property: Record) -> None:
    """The cube is sheared by twice its height. The shear stress is proportional, with a normal
    stress difference that linear elasticity does not have.

    Source: s12 = mu g and Rivlin's universal relation s11 - s22 = g s12, Phil. Trans. R. Soc. A
    241, 1948 (the volume does not change, so that compressibility does not matter)
    """
    solid, shear = cube(0.45), 2.0
    deformation = np.eye(3)
    deformation[0, 1] = shear
    exact = (solid.nodes @ (deformation - np.eye(3)).T).ravel()
    held = dofs_of(np.unique(boundary_faces(solid.elements)))
    got = equilibrium(solid, held, exact[held], np.zeros(len(exact)), steps=4)
    piola = np.einsum("ni,nj->ij", solid.forces(got), solid.nodes)
    cauchy = piola @ deformation.T
    mu = lame(MODULUS, 0.45)[1]
    near(record_property, "simple shear 2, shear stress", cauchy[0, 1], mu * shear, 1e-9)
    difference = (cauchy[0, 0] - cauchy[1, 1]) / (shear * cauchy[0, 1])
    near(record_property, "simple shear 2, normal stress difference", difference, 1.0, 1e-9)
