"""Compute element matrices of linear isotropic elasticity on 10-node tetrahedra.

Small strain, Hooke's law with Lame's constants (Zienkiewicz & Taylor, "The Finite Element Method",
vol. 1, ch. 4-6). Degrees of freedom are numbered 3 * node + axis.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from flexsheet.messages.errors import FlexsheetError
from flexsheet.nodes.fem_solver.mesh import EDGES

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

MAX_POISSON_RATIO = 0.4999
"""Closer to 0.5 a displacement formulation loses all digits to the bulk modulus."""
MIN_VOLUME_RATIO = 1e-6
"""Minimum Jacobian of an element over its side's cube: flatter elements lose the solution to
rounding."""


class SolidMeshError(FlexsheetError, ValueError):
    """Raised for a mesh with inverted elements or a body without sufficient support."""

    code = "solid-mesh"
    remedy = "Increase skin_spacing_m, or fix more of the object; see docs/soft-body-reference.md."


def lame_constants(young_modulus_pa: float, poisson_ratio: float) -> tuple[float, float]:
    """Return Lame's constants (lambda, mu), Pa.

    Raises ValueError outside E > 0, -1 < nu <= 0.4999.
    """
    if not (np.isfinite(young_modulus_pa) and young_modulus_pa > 0.0):
        raise ValueError(f"young_modulus_pa: {young_modulus_pa!r} must be a positive number")
    if not -1.0 < poisson_ratio <= MAX_POISSON_RATIO:
        raise ValueError(
            f"poisson_ratio: {poisson_ratio!r} must be above -1 and at most "
            f"{MAX_POISSON_RATIO}; use 0.499 for a nearly incompressible body"
        )
    mu = 0.5 * young_modulus_pa / (1.0 + poisson_ratio)
    return 2.0 * mu * poisson_ratio / (1.0 - 2.0 * poisson_ratio), mu


def quadrature() -> tuple[Floats, Floats]:
    """Return quadrature points (8, 3) and positive weights (8,) on the unit tetrahedron.

    The rule is exact to degree 3, as the patch test on curved elements requires. It is a conical
    product of Gauss-Jacobi rules (Stroud, "Approximate Calculation of Multiple Integrals").
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
    """Return the shape functions' gradients (q, 10, 3) at points (q, 3) of the unit tetrahedron."""
    barycentric = np.column_stack([1.0 - points.sum(axis=1), points])
    slopes = np.vstack([-np.ones(3), np.eye(3)])
    corner = (4.0 * barycentric - 1.0)[:, :, None] * slopes
    first, second = EDGES.T
    edge = 4.0 * (
        barycentric[:, first, None] * slopes[second] + barycentric[:, second, None] * slopes[first]
    )
    return np.concatenate([corner, edge], axis=1)


def jacobians(nodes: Floats, elements: Ints, local: Floats) -> tuple[Floats, Floats]:
    """Return Jacobians (e, q, 3, 3) with respect to the unit tetrahedron, and determinants (e, q).

    local (q, 10, 3): gradients of the shape functions. Raises SolidMeshError where an element is
    inverted or flat, or a node's coordinates are not finite.
    """
    corners = nodes[elements]
    invalid = ~np.isfinite(corners).all(axis=(1, 2))
    if invalid.any():
        raise SolidMeshError(
            f"{int(invalid.sum())} of {len(elements)} elements have nodes that are not finite; the "
            f"first is element number {int(np.argmax(invalid))}"
        )
    jacobian: Floats = corners.transpose(0, 2, 1)[:, None] @ local
    determinant: Floats = np.linalg.det(jacobian)
    size = np.ptp(corners[:, :4], axis=1).max(axis=1)
    bad = determinant.min(axis=1) <= MIN_VOLUME_RATIO * size**3
    if bad.any():
        raise SolidMeshError(
            f"{int(bad.sum())} of {len(elements)} elements are inverted or flat; the first is "
            f"element number {int(np.argmax(bad))} (minimum Jacobian {determinant.min():.3g} m^3)"
        )
    return jacobian, determinant


def element_stiffness(
    nodes: Floats, elements: Ints, *, young_modulus_pa: float, poisson_ratio: float
) -> Floats:
    """Return the element stiffness matrices (e, 30, 30), N/m.

    Raises SolidMeshError as `jacobians`, ValueError as `lame_constants`.
    """
    lame, mu = lame_constants(young_modulus_pa, poisson_ratio)
    points, weights = quadrature()
    local = shape_gradients(points)
    jacobian, determinant = jacobians(nodes, elements, local)
    # Gradients in space: J^-T applied to the local ones, one row per (node, axis).
    gradient = np.einsum("qak,eqki->eqai", local, np.linalg.inv(jacobian))
    flat = gradient.reshape(len(elements), len(points), 30)
    weighted = flat * (determinant * weights)[:, :, None]
    outer = (weighted.transpose(0, 2, 1) @ flat).reshape(-1, 10, 3, 10, 3)
    stiffness: Floats = lame * outer + mu * outer.transpose(0, 1, 4, 3, 2)
    trace = mu * np.einsum("eakbk->eab", outer)
    for axis in range(3):
        stiffness[:, :, axis, :, axis] += trace
    return stiffness.reshape(-1, 30, 30)


def require_support(nodes: Floats, fixed: NDArray[np.bool_]) -> None:
    """Raise SolidMeshError if all fixed nodes are collinear, so that the body can move.

    nodes (n, 3). fixed (n,): flags of the fixed nodes.
    """
    fixed_nodes = nodes[fixed]
    extent = np.ptp(nodes, axis=0).max()
    if (
        len(fixed_nodes) < 3
        or np.linalg.matrix_rank(
            fixed_nodes - fixed_nodes.mean(axis=0), tol=1e-6 * extent * len(fixed_nodes) ** 0.5
        )
        < 2
    ):
        raise SolidMeshError(
            f"the body is free to move: it has {len(fixed_nodes)} fixed nodes, and at least three "
            "that are not collinear are required; enlarge object.support or reduce skin_spacing_m"
        )


def degrees_of_freedom(nodes: NDArray[np.integer] | Ints) -> Ints:
    """Return the numbers (3k,) of the nodes' degrees of freedom."""
    return (3 * np.asarray(nodes, dtype=np.int64)[:, None] + np.arange(3)).ravel()


def scatter_add(indices: Ints, values: Floats, size: int) -> Floats:
    """Return an array (size,) with values (k,) added at their indices (k,)."""
    result: Floats = np.bincount(indices, values, size).astype(np.float64, copy=False)
    return result
