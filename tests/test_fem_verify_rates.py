"""Verify the convergence rates with manufactured solutions."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from flexsheet.nodes.fem_solver.elasticity import element_stiffness
from flexsheet.nodes.fem_solver.hyperelastic import NeoHookeanSolid
from flexsheet.nodes.fem_solver.mesh.solid import boundary_faces
from flexsheet.nodes.fem_solver.multifrontal import NestedDissection
from tests.fem_fields import body_loads, lame, rate, relative_errors
from tests.fem_verification import Record, at_most, between
from tests.solids import box, distorted

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Complexes = NDArray[np.complex128]

E, NU = 1000.0, 0.3
DIVISIONS = (2, 4, 6, 8)
WAYS = np.array([[2.0, 1.0, -1.0], [-1.0, 2.0, 1.5], [1.0, -1.5, 2.0]])
PHASES = np.array([0.3, 0.7, 0.1])


def field(size: float, points: Floats) -> Floats:
    """Return three plane waves, one for each component."""
    return size * np.sin(points @ WAYS.T + PHASES)


def slope(size: float, points: Floats | Complexes) -> Complexes:
    """Return the gradient of `field`, also for complex points."""
    waves = np.cos(points @ WAYS.T + PHASES)
    return np.asarray(size * waves[:, :, None] * WAYS, dtype=np.complex128)


def hooke(gradient: Complexes) -> Complexes:
    lam, mu = lame(E, NU)
    trace = np.trace(gradient, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    return np.asarray(lam * trace + mu * (gradient + gradient.transpose(0, 2, 1)))


def neo_hooke(gradient: Complexes) -> Complexes:
    lam, mu = lame(E, NU)
    deformation = gradient + np.eye(3)
    log = np.log(np.linalg.det(deformation))[:, None, None]
    product = np.linalg.inv(deformation).transpose(0, 2, 1)
    return np.asarray(mu * deformation + (lam * log - mu) * product)


def body_force(size: float, law: object, points: Floats) -> Floats:
    """Return the force in equilibrium with the field: minus the divergence of its stress, by
    complex-step derivatives (Squire & Trapp, SIAM Review 40, 1998)."""
    assert callable(law)
    tiny = 1e-30
    force = np.zeros_like(points)
    for axis in range(3):
        beside = points.astype(np.complex128)
        beside[:, axis] += 1j * tiny
        force -= law(slope(size, beside))[:, :, axis].imag / tiny
    return force


@pytest.mark.long
def test_linear_rates(record_property: Record) -> None:
    """Plane waves are prescribed on the hull of a box of distorted elements, with a body force.

    Source: manufactured solution, Roache, J. Fluids Eng. 124, 2002; rates 3 and 2 of quadratic
    elements: Strang & Fix, An Analysis of the Finite Element Method, 1973, ch. 3
    """
    sizes, errors = [], []
    for divisions in DIVISIONS:
        nodes, elements = distorted(*box((divisions,) * 3, (1.0, 1.0, 1.0)))
        fixed = np.zeros(len(nodes), dtype=bool)
        fixed[np.unique(boundary_faces(elements))] = True
        matrices = element_stiffness(nodes, elements, young_modulus_pa=E, poisson_ratio=NU)
        held = np.where(fixed[:, None], field(1.0, nodes), 0.0)
        loads = body_loads(nodes, elements, lambda p: body_force(1.0, hooke, p))
        np.subtract.at(
            loads.reshape(-1, 3),
            elements,
            (matrices @ held[elements].reshape(-1, 30, 1)).reshape(-1, 10, 3),
        )
        got = held + NestedDissection(nodes, elements, fixed).factor(matrices).solve(loads).reshape(
            -1, 3
        )
        sizes.append(1.0 / divisions)
        errors.append(
            relative_errors(
                (nodes, elements),
                got,
                lambda p: field(1.0, p),
                lambda p: slope(1.0, p).real,
                lame(E, NU),
            )
        )
    l2, energy = (rate(sizes, [pair[i] for pair in errors]) for i in (0, 1))
    between(record_property, "linear, rate in L2, four meshes", l2, 2.8, 3.3)
    between(record_property, "linear, rate in energy norm, four meshes", energy, 1.85, 2.2)
    at_most(record_property, "linear, L2 error of the finest mesh", errors[-1][0], 1e-3)


@pytest.mark.long
def test_neo_hookean_rates(record_property: Record) -> None:
    """The same waves are used with strains up to a third in the neo-Hookean body.

    Source: manufactured solution, Roache, J. Fluids Eng. 124, 2002
    """
    size = 0.1
    sizes, errors = [], []
    for divisions in DIVISIONS[:-1]:
        nodes, elements = distorted(*box((divisions,) * 3, (1.0, 1.0, 1.0)))
        solid = NeoHookeanSolid(nodes, elements, young_modulus_pa=E, poisson_ratio=NU)
        fixed = np.zeros(len(nodes), dtype=bool)
        fixed[np.unique(boundary_faces(elements))] = True
        order = NestedDissection(nodes, elements, fixed)
        loads = body_loads(nodes, elements, lambda p: body_force(size, neo_hooke, p))
        got = field(size, nodes)
        got[~fixed] += 0.001 * np.sin(50.0 * nodes[~fixed])
        for _ in range(8):
            residual = solid.forces(got).ravel() - loads
            step = order.factor(solid.tangents(got)).solve(residual).reshape(-1, 3)
            got = got - step
        assert np.abs(step).max() < 1e-12
        sizes.append(1.0 / divisions)
        errors.append(
            relative_errors(
                (nodes, elements),
                got,
                lambda p: field(size, p),
                lambda p: slope(size, p).real,
                lame(E, NU),
            )
        )
    l2, energy = (rate(sizes, [pair[i] for pair in errors]) for i in (0, 1))
    between(record_property, "neo-Hookean, rate in L2, three meshes", l2, 2.8, 3.3)
    between(record_property, "neo-Hookean, rate in energy norm, three meshes", energy, 1.85, 2.2)
