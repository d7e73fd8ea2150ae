"""Compute element matrices of linear isotropic elasticity on 10-node tetrahedra.

The strain is small, and the material follows Hooke's law with Lame's constants (Zienkiewicz &
Taylor, "The Finite Element Method", vol. 1, ch. 4-6). The index of a degree of freedom is 3 * node
+ axis.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from flexsheet.messages.errors import FlexsheetError
from flexsheet.nodes.arrays import Floats, Ints
from flexsheet.nodes.fem_solver.mesh.solid import EDGES

MAX_POISSON_RATIO = 0.4999
"""The maximum Poisson's ratio. For larger ratios, rounding errors make the solution useless."""
MIN_VOLUME_RATIO = 1e-6
"""The minimum ratio of an element's Jacobian determinant to the cube of its edge length. For
flatter elements, rounding errors make the solution useless."""


class SolidMeshError(FlexsheetError, ValueError):
    """Raised if a mesh contains inverted or flat elements."""

    remedy = "Increase skin_spacing_m; see docs/soft-body-reference.md."


def lame_constants(young_modulus_pa: float, poisson_ratio: float) -> tuple[float, float]:
    """Return Lame's constants lambda and mu, in Pa.

    Raises ValueError unless Young's modulus is positive and -1 < Poisson's ratio <= 0.4999.
    """
    if not (np.isfinite(young_modulus_pa) and young_modulus_pa > 0.0):
        raise ValueError(
            f"young_modulus_pa: {young_modulus_pa!r} must be a positive number of pascals"
        )
    if not -1.0 < poisson_ratio <= MAX_POISSON_RATIO:
        raise ValueError(
            f"poisson_ratio: {poisson_ratio!r} must be above -1 and at most "
            f"{MAX_POISSON_RATIO}; use 0.499 for a nearly incompressible body"
        )
    mu = 0.5 * young_modulus_pa / (1.0 + poisson_ratio)
    return 2.0 * mu * poisson_ratio / (1.0 - 2.0 * poisson_ratio), mu


def quadrature() -> tuple[Floats, Floats]:
    """Return quadrature points (8, 3) and their positive weights (8,) on the unit tetrahedron.

    The rule is exact for polynomials up to degree 3. Source: conical product of Gauss-Jacobi rules
    (Stroud, "Approximate Calculation of Multiple Integrals").
    """
    from scipy.special import roots_jacobi

    rules = [roots_jacobi(2, power, 0.0) for power in (2, 1, 0)]
    (a, wa), (b, wb), (c, wc) = [
        (0.5 * (1.0 + x), w / 2.0 ** (power + 1))
        for (x, w), power in zip(rules, (2, 1, 0), strict=True)
    ]
    u, v, w = (grid.ravel() for grid in np.meshgrid(a, b, c, indexing="ij"))
    points = np.column_stack([u, v * (1.0 - u), w * (1.0 - u) * (1.0 - v)])
    weights = np.einsum("i,j,k->ijk", wa, wb, wc).ravel()
    return points, weights


def shape_gradients(points: Floats) -> Floats:
    """Return the shape function gradients (q, 10, 3) at points (q, 3) of the unit tetrahedron."""
    barycentric = np.column_stack([1.0 - points.sum(axis=1), points])
    slopes = np.vstack([-np.ones(3), np.eye(3)])
    corner = (4.0 * barycentric - 1.0)[:, :, None] * slopes
    first, second = EDGES.T
    edge = 4.0 * (
        barycentric[:, first, None] * slopes[second] + barycentric[:, second, None] * slopes[first]
    )
    return np.concatenate([corner, edge], axis=1)


def jacobians(nodes: Floats, elements: Ints, local: Floats) -> tuple[Floats, Floats]:
    """Return Jacobian matrices (e, q, 3, 3) and determinants (e, q) of e elements at q points.

    The matrices belong to the map from the unit tetrahedron to each element. nodes (n, 3):
    positions of the n nodes, m. elements (e, 10): node indices. local (q, 10, 3): gradients of the
    shape functions at q points. Raises SolidMeshError if an element is inverted or flat, or if the
    coordinates of a node are not finite.
    """
    corners = nodes[elements]
    invalid = ~np.isfinite(corners).all(axis=(1, 2))
    if invalid.any():
        raise SolidMeshError(
            f"{int(invalid.sum())} of {len(elements)} elements have node positions that are not "
            f"finite; the first of these elements has the index {int(np.argmax(invalid))}; "
            "correct the node positions"
        )
    jacobian: Floats = corners.transpose(0, 2, 1)[:, None] @ local
    determinant: Floats = np.linalg.det(jacobian)
    size = np.ptp(corners[:, :4], axis=1).max(axis=1)
    bad = determinant.min(axis=1) <= MIN_VOLUME_RATIO * size**3
    if bad.any():
        raise SolidMeshError(
            f"{int(bad.sum())} of {len(elements)} elements are inverted or flat; the first of "
            f"these elements has the index {int(np.argmax(bad))} (minimum determinant "
            f"{determinant.min():.3g} m^3); repair the mesh"
        )
    return jacobian, determinant


def element_stiffness(
    nodes: Floats, elements: Ints, *, young_modulus_pa: float, poisson_ratio: float
) -> Floats:
    """Return the stiffness matrices (e, 30, 30), N/m, of e elements.

    nodes (n, 3): positions of the n nodes, m. elements (e, 10): node indices. Raises SolidMeshError
    if an element is inverted or flat, and ValueError if the material is invalid.
    """
    lame, mu = lame_constants(young_modulus_pa, poisson_ratio)
    points, weights = quadrature()
    local = shape_gradients(points)
    jacobian, determinant = jacobians(nodes, elements, local)
    # Spatial gradients: the inverse transposed Jacobian times the local gradients.
    gradient = np.einsum("qak,eqki->eqai", local, np.linalg.inv(jacobian))
    flat = gradient.reshape(len(elements), len(points), 30)
    weighted = flat * (determinant * weights)[:, :, None]
    outer = (weighted.transpose(0, 2, 1) @ flat).reshape(-1, 10, 3, 10, 3)
    stiffness: Floats = lame * outer + mu * outer.transpose(0, 1, 4, 3, 2)
    trace = mu * np.einsum("eakbk->eab", outer)
    for axis in range(3):
        stiffness[:, :, axis, :, axis] += trace
    return stiffness.reshape(-1, 30, 30)


def degrees_of_freedom(nodes: NDArray[np.integer] | Ints) -> Ints:
    """Return the indices (3k,) of the degrees of freedom of k nodes."""
    return (3 * np.asarray(nodes, dtype=np.int64)[:, None] + np.arange(3)).ravel()


def scatter_add(indices: Ints, values: Floats, size: int) -> Floats:
    """Add values (k,) at their indices (k,) to an array (size,) of zeros, and return the array."""
    result: Floats = np.bincount(indices, values, size).astype(np.float64, copy=False)
    return result
