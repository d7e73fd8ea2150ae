"""Assemble and solve linear elasticity directly, as a reference for the project's solvers."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree

from flexsheet.nodes.fem_solver.elasticity import SolidMeshError, element_stiffness, quadrature
from flexsheet.nodes.fem_solver.mesh.solid import EDGES

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

CHUNK_ELEMENTS = 2048


def stiffness_matrix(
    nodes: Floats, elements: Ints, *, young_modulus_pa: float, poisson_ratio: float
) -> csc_matrix:
    """Return the assembled stiffness matrix (3n, 3n), N/m; errors as `element_stiffness`."""
    size = 3 * len(nodes)
    total = csc_matrix((size, size))
    for start in range(0, len(elements), CHUNK_ELEMENTS):
        part = elements[start : start + CHUNK_ELEMENTS]
        blocks = element_stiffness(
            nodes, part, young_modulus_pa=young_modulus_pa, poisson_ratio=poisson_ratio
        )
        dofs = (3 * part[:, :, None] + np.arange(3)).reshape(-1, 30)
        rows, columns = np.repeat(dofs, 30, axis=1).ravel(), np.tile(dofs, (1, 30)).ravel()
        total = total + csc_matrix((blocks.ravel(), (rows, columns)), shape=(size, size))
    return total


def solve(stiffness: csc_matrix, fixed_dofs: Ints, values: Floats, loads: Floats) -> Floats:
    """Solve for the displacements (3n,) by one sparse factorisation.

    fixed_dofs (k,), values (k,): prescribed degrees of freedom and their displacements. loads
    (3n,): nodal forces. Raises SolidMeshError if the body is free to move.
    """
    free = np.setdiff1d(np.arange(stiffness.shape[0]), fixed_dofs)
    result = np.zeros(stiffness.shape[0])
    result[fixed_dofs] = values
    inner = stiffness[free][:, free].tocsc()
    try:
        # The matrix is positive definite, so diagonal pivots suffice and keep the factor sparse.
        factor = splu(
            inner,
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        )
    except RuntimeError as error:
        raise SolidMeshError(f"the body is free to move: {error}") from error
    pivots = np.abs(factor.U.diagonal())
    if pivots.min() < 1e-12 * pivots.max():
        raise SolidMeshError("the body is free to move: the stiffness is singular to rounding")
    result[free] = factor.solve(loads[free] - stiffness[free][:, fixed_dofs] @ values)
    return result


def scikit_basis(nodes: Floats, elements: Ints) -> tuple[Any, Ints]:
    """Return scikit-fem's basis on a curved mesh, and the index of each degree of freedom here.

    The quadrature is that of the solver, so that only the assembly differs.
    """
    import skfem

    corners = np.unique(elements[:, :4])
    straight = nodes.copy()
    straight[elements[:, 4:]] = nodes[elements[:, EDGES]].mean(axis=2)
    tetrahedra = np.searchsorted(corners, elements[:, :4])
    external = skfem.MeshTet2.from_mesh(skfem.MeshTet(straight[corners].T, tetrahedra.T))
    distance, nearest = cKDTree(straight).query(external.doflocs.T)
    assert distance.max() < 1e-12
    external = skfem.MeshTet2(nodes[nearest].T, external.t)
    points, weights = quadrature()
    element = skfem.ElementVector(skfem.ElementTetP2())
    basis = skfem.Basis(external, element, quadrature=(points.T, weights))
    distance, node = cKDTree(nodes).query(basis.doflocs.T)
    assert distance.max() < 1e-9
    axis = np.empty(len(node), dtype=np.int64)
    for names in (basis.nodal_dofs, basis.edge_dofs):
        for number, dofs in enumerate(names):
            axis[dofs] = number
    return basis, 3 * node + axis
