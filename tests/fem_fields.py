"""Provide loads, norms and equilibrium on meshes of 10-node tetrahedra, for tests.

Shape functions and quadrature are independent of the solver's own, so that the solver is not
compared with itself.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import splu
from scipy.special import roots_jacobi

from flexsheet.nodes.fem_solver.hyperelastic import NeoHookeanSolid
from flexsheet.nodes.fem_solver.mesh.solid import EDGES

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Field = Callable[[Floats], Floats]
"""Function from points (k, 3) to vectors (k, 3), or to gradients (k, 3, 3) with the derivative
last."""

MAX_ITERATIONS = 40
SYMMETRIC = {"SymmetricMode": True}
SETTLED = 1e-9
"""Maximum ratio of Newton's last step to the displacement."""


def lame(young_modulus_pa: float, poisson_ratio: float) -> tuple[float, float]:
    """Return Lame's constants (lambda, mu)."""
    e, nu = young_modulus_pa, poisson_ratio
    return e * nu / ((1 + nu) * (1 - 2 * nu)), e / (2 * (1 + nu))


def dofs_of(nodes: Ints) -> Ints:
    """Return the degrees of freedom (3k,) of nodes (k,)."""
    return (3 * np.asarray(nodes)[:, None] + np.arange(3)).ravel()


def tetrahedron_rule(order: int) -> tuple[Floats, Floats]:
    """Return points (q, 3) and weights (q,) on the unit tetrahedron, exact to degree 2 order -
    1."""
    (a, wa), (b, wb), (c, wc) = (_rule(order, power) for power in (2, 1, 0))
    u, v, w = (g.ravel() for g in np.meshgrid(a, b, c, indexing="ij"))
    points = np.column_stack([u, v * (1 - u), w * (1 - u) * (1 - v)])
    return points, np.einsum("i,j,k->ijk", wa, wb, wc).ravel()


def triangle_rule(order: int) -> tuple[Floats, Floats]:
    """Return points (q, 2) and weights (q,) on the unit triangle, exact to degree 2 order - 1."""
    (a, wa), (b, wb) = (_rule(order, power) for power in (1, 0))
    u, v = (g.ravel() for g in np.meshgrid(a, b, indexing="ij"))
    return np.column_stack([u, v * (1 - u)]), np.outer(wa, wb).ravel()


def _rule(order: int, power: int) -> tuple[Floats, Floats]:
    x, w = roots_jacobi(order, power, 0.0)
    return 0.5 * (1 + x), w / 2.0 ** (power + 1)


def solid_shapes(points: Floats) -> tuple[Floats, Floats]:
    """Return values (q, 10) and gradients (q, 10, 3) of the shape functions at points (q, 3)."""
    return _quadratic(points, EDGES)


def face_shapes(points: Floats) -> tuple[Floats, Floats]:
    """Return values (q, 6) and gradients (q, 6, 2) on a six-node triangle at points (q, 2)."""
    return _quadratic(points, np.array([[0, 1], [1, 2], [2, 0]]))


def _quadratic(points: Floats, edges: Ints) -> tuple[Floats, Floats]:
    share = np.column_stack([1 - points.sum(axis=1), points])
    slope = np.vstack([-np.ones(points.shape[1]), np.eye(points.shape[1])])
    i, j = edges.T
    values = np.column_stack([share * (2 * share - 1), 4 * share[:, i] * share[:, j]])
    at_corners = (4 * share - 1)[:, :, None] * slope
    at_middles = 4 * (share[:, i, None] * slope[j] + share[:, j, None] * slope[i])
    return values, np.concatenate([at_corners, at_middles], axis=1)


def body_loads(nodes: Floats, elements: Ints, force: Field, order: int = 4) -> Floats:
    """Integrate the nodal loads (3n,) of a force per volume."""
    points, weights = tetrahedron_rule(order)
    values, slopes = solid_shapes(points)
    places = np.einsum("qa,eai->eqi", values, nodes[elements])
    volume = np.linalg.det(np.einsum("qak,eai->eqik", slopes, nodes[elements])) * weights
    density = force(places.reshape(-1, 3)).reshape(places.shape)
    loads = np.zeros_like(nodes)
    np.add.at(loads, elements, np.einsum("eq,qa,eqi->eai", volume, values, density))
    return loads.ravel()


def stress_loads(nodes: Floats, elements: Ints, stress: Field, order: int = 4) -> Floats:
    """Integrate the nodal loads (3n,) in equilibrium with a stress field."""
    points, weights = tetrahedron_rule(order)
    values, slopes = solid_shapes(points)
    jacobian = np.einsum("qak,eai->eqik", slopes, nodes[elements])
    volume = np.linalg.det(jacobian) * weights
    gradient = np.einsum("qak,eqki->eqai", slopes, np.linalg.inv(jacobian))
    places = np.einsum("qa,eai->eqi", values, nodes[elements])
    density = stress(places.reshape(-1, 3)).reshape(*places.shape, 3)
    loads = np.zeros_like(nodes)
    np.add.at(loads, elements, np.einsum("eq,eqij,eqaj->eai", volume, density, gradient))
    return loads.ravel()


def surface_loads(
    nodes: Floats, faces: Ints, traction: Callable[[Floats, Floats], Floats], order: int = 4
) -> Floats:
    """Integrate the nodal loads (3n,) of tractions (k, 3), Pa, at points (k, 3) with normals (k,
    3)."""
    points, weights = triangle_rule(order)
    values, slopes = face_shapes(points)
    places = np.einsum("qa,fai->fqi", values, nodes[faces])
    along = np.einsum("qak,fai->fqki", slopes, nodes[faces])
    area = np.cross(along[:, :, 0], along[:, :, 1])
    size = np.linalg.norm(area, axis=2)
    pull = traction(places.reshape(-1, 3), (area / size[..., None]).reshape(-1, 3))
    loads = np.zeros_like(nodes)
    weighted = size * weights
    np.add.at(
        loads, faces, np.einsum("fq,qa,fqi->fai", weighted, values, pull.reshape(places.shape))
    )
    return loads.ravel()


def pressure_loads(nodes: Floats, faces: Ints, pressure: float) -> Floats:
    """Integrate the nodal loads (3n,) of a pressure on outward faces."""
    return surface_loads(nodes, faces, lambda _, normals: -pressure * normals)


def relative_errors(
    solid: tuple[Floats, Ints],
    displacement: Floats,
    exact: Field,
    exact_gradient: Field,
    material: tuple[float, float],
) -> tuple[float, float]:
    """Return the relative errors in the L2 norm and in that of the (linear elastic) energy.

    solid: nodes (n, 3), elements (e, 10). displacement (n, 3). material: Lame's constants.
    """
    nodes, elements = solid
    points, weights = tetrahedron_rule(5)
    values, slopes = solid_shapes(points)
    places = np.einsum("qa,eai->eqi", values, nodes[elements])
    jacobian = np.einsum("qak,eai->eqik", slopes, nodes[elements])
    volume = np.linalg.det(jacobian) * weights
    gradient = np.einsum("qak,eqki->eqai", slopes, np.linalg.inv(jacobian))
    field = np.einsum("qa,eai->eqi", values, displacement[elements])
    slope = np.einsum("eqaj,eai->eqij", gradient, displacement[elements])
    wanted = exact(places.reshape(-1, 3)).reshape(places.shape)
    wanted_slope = exact_gradient(places.reshape(-1, 3)).reshape(*places.shape, 3)

    def energy(slope: Floats) -> float:
        strain = 0.5 * (slope + np.swapaxes(slope, -1, -2))
        trace = np.trace(strain, axis1=-2, axis2=-1)
        density = 0.5 * material[0] * trace**2 + material[1] * np.square(strain).sum((-1, -2))
        return float((volume * density).sum())

    def square(field: Floats) -> float:
        return float((volume * np.square(field).sum(axis=-1)).sum())

    return (
        float(np.sqrt(square(field - wanted) / square(wanted))),
        float(np.sqrt(energy(slope - wanted_slope) / energy(wanted_slope))),
    )


def rate(sizes: list[float], errors: list[float]) -> float:
    """Return the convergence rate: the slope of a line through all points, in logarithms."""
    return float(np.polyfit(np.log(sizes), np.log(errors), 1)[0])


def tangent_matrix(solid: NeoHookeanSolid, displacement: Floats) -> csc_matrix:
    """Return the assembled tangent stiffness (3n, 3n)."""
    dofs = (3 * solid.elements[:, :, None] + np.arange(3)).reshape(-1, 30)
    rows, columns = np.repeat(dofs, 30, axis=1).ravel(), np.tile(dofs, (1, 30)).ravel()
    size = 3 * len(solid.nodes)
    entries = solid.tangents(displacement).ravel()
    return csc_matrix((entries, (rows, columns)), shape=(size, size))


def equilibrium(
    solid: NeoHookeanSolid, held: Ints, values: Floats, loads: Floats, *, steps: int
) -> Floats:
    """Return displacements (n, 3) under dead loads (3n,), with the degrees of freedom `held` at
    `values`.

    Newton's method in equal steps of both, with shorter steps where elements invert. Raises
    ArithmeticError if it does not converge.
    """
    free = np.setdiff1d(np.arange(3 * len(solid.nodes)), held)
    moved = np.zeros(3 * len(solid.nodes))
    for share in np.arange(1, steps + 1) / steps:
        step = np.zeros_like(moved)
        for _ in range(MAX_ITERATIONS):
            matrix = tangent_matrix(solid, moved.reshape(-1, 3))
            residual = solid.forces(moved.reshape(-1, 3)).ravel() - share * loads
            step[held] = share * values - moved[held]
            right = residual[free] + matrix[free][:, held] @ step[held]
            inner = matrix[free][:, free].tocsc()
            step[free] = -splu(inner, permc_spec="MMD_AT_PLUS_A", options=SYMMETRIC).solve(right)
            way = 1.0
            while not np.isfinite(solid.energy((moved + way * step).reshape(-1, 3))):
                way *= 0.5
            moved = moved + way * step
            if np.abs(step).max() < SETTLED * np.abs(moved).max():
                break
        else:
            raise ArithmeticError(f"not settled at {share:.2f} of the load")
    return moved.reshape(-1, 3)
