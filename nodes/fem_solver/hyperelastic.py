"""Compute the energy, forces and tangent stiffness of a compressible neo-Hookean solid of 10-node
tetrahedra.

The energy per undeformed volume (Bonet & Wood, "Nonlinear Continuum Mechanics for Finite Element
Analysis", 2nd ed., sec. 6.4.3) is

    psi = mu/2 (tr F^T F - 3) - mu ln J + lambda/2 (ln J)^2

lambda and mu are Lame's constants, F is the deformation gradient, and J its determinant. The first
Piola-Kirchhoff stress is P = mu F + (lambda ln J - mu) F^-T. For small strains, it reduces to
Hooke's law. The energy becomes infinite as J approaches 0, so no element is inverted if the energy
is finite.
"""

from __future__ import annotations

import numpy as np

from flexsheet.messages.errors import FlexsheetError
from flexsheet.nodes.arrays import Floats, Ints
from flexsheet.nodes.fem_solver.elasticity import (
    jacobians,
    lame_constants,
    quadrature,
    scatter_add,
    shape_gradients,
)
from flexsheet.nodes.fem_solver.mesh.solid import EDGES

CORNERS = np.vstack([np.zeros(3), np.eye(3)])
NODE_COORDINATES: Floats = np.vstack([CORNERS, CORNERS[EDGES].mean(axis=1)])
"""The coordinates (10, 3) of the nodes of an element on the unit tetrahedron."""


class InvertedElementError(FlexsheetError, ArithmeticError):
    """Raised if a displacement inverts an element of the mesh."""

    remedy = "Use smaller load steps. Deep pushes may have no solution."


class NeoHookeanSolid:
    """A solid of neo-Hookean material, meshed with 10-node tetrahedra."""

    def __init__(
        self, nodes: Floats, elements: Ints, *, young_modulus_pa: float, poisson_ratio: float
    ) -> None:
        """Compute the shape function gradients and the volumes of the elements.

        nodes (n, 3): positions of the nodes, m. elements (e, 10): node indices. Raises
        SolidMeshError if an element is inverted, and ValueError if the material is invalid.
        """
        self.nodes, self.elements = nodes, elements
        self._lame, self._mu = lame_constants(young_modulus_pa, poisson_ratio)
        points, weights = quadrature()
        local = shape_gradients(points)
        jacobian, determinant = jacobians(nodes, elements, local)
        self._gradients: Floats = local @ np.linalg.inv(jacobian)
        self._volumes = determinant * weights
        flat = self._gradients.transpose(0, 2, 1, 3).reshape(len(elements), 10, -1)
        scaled = flat * np.repeat(self._volumes, 3, axis=1)[:, None]
        self._laplacian: Floats = self._mu * (scaled @ flat.transpose(0, 2, 1))
        self._rows = (3 * elements[:, :, None] + np.arange(3)).reshape(-1)

    @property
    def volume(self) -> float:
        """Return the volume of the undeformed solid, m^3."""
        return float(self._volumes.sum())

    def deformation(self, displacement: Floats) -> tuple[Floats, Floats]:
        """Return the deformation gradient F (e, 8, 3, 3) and its determinant J (e, 8).

        Both are evaluated at the 8 quadrature points of each of the e elements. displacement (n,
        3): displacement of the nodes, m.
        """
        moved = displacement[self.elements].transpose(0, 2, 1)
        gradient = moved[:, None] @ self._gradients
        gradient[..., 0, 0] += 1.0
        gradient[..., 1, 1] += 1.0
        gradient[..., 2, 2] += 1.0
        return gradient, determinants(gradient)

    def energy(self, displacement: Floats) -> float:
        """Return the elastic energy in joules, or infinity if an element is inverted.

        displacement (n, 3): displacement of the nodes, m.
        """
        gradient, volume_ratio = self.deformation(displacement)
        if volume_ratio.min() <= 0.0:
            return float("inf")
        log = np.log(volume_ratio)
        squared = np.einsum("eqij,eqij->eq", gradient, gradient)
        density = 0.5 * self._mu * (squared - 3.0) - self._mu * log + 0.5 * self._lame * log * log
        return float((self._volumes * density).sum())

    def forces(self, displacement: Floats) -> Floats:
        """Return the elastic nodal forces (n, 3), N: the gradient of the energy.

        displacement (n, 3): displacement of the nodes, m. Raises InvertedElementError if an element
        is inverted.
        """
        gradient, inverse, log = self._state(displacement)
        stress = (self._lame * log - self._mu)[..., None, None] * inverse.transpose(0, 1, 3, 2)
        stress += self._mu * gradient
        stress *= self._volumes[..., None, None]
        per_node = (self._gradients @ stress.transpose(0, 1, 3, 2)).sum(axis=1)
        return scatter_add(self._rows, per_node.ravel(), 3 * len(self.nodes)).reshape(-1, 3)

    def tangents(self, displacement: Floats) -> Floats:
        """Return the tangent stiffness of each element (e, 30, 30), N/m.

        The tangent stiffness is the second derivative of the energy. Let g_a and g_b be the
        gradients of the shape functions of two nodes a and b. Let h_a = F^-T g_a and h_b = F^-T
        g_b. The block of these nodes is the integral of mu (g_a . g_b) I + lambda h_a h_b^T + (mu -
        lambda ln J) h_b h_a^T. displacement (n, 3): displacement of the nodes, m. Raises
        InvertedElementError if an element is inverted.
        """
        _, inverse, log = self._state(displacement)
        count = len(self.elements)
        spatial_gradients = (self._gradients @ inverse).reshape(count, -1, 30)
        first: Floats = (spatial_gradients * (self._lame * self._volumes)[..., None]).transpose(
            0, 2, 1
        ) @ spatial_gradients
        scaled = spatial_gradients * ((self._mu - self._lame * log) * self._volumes)[..., None]
        second = scaled.transpose(0, 2, 1) @ spatial_gradients
        blocks = first.reshape(count, 10, 3, 10, 3)
        blocks += second.reshape(count, 10, 3, 10, 3).transpose(0, 1, 4, 3, 2)
        for axis in range(3):
            blocks[:, :, axis, :, axis] += self._laplacian
        return first

    def stiffen(self, matrices: Floats, weight: float) -> None:
        """Add a positive definite stiffness to element matrices (e, 30, 30), in place.

        The added stiffness is the stiffness matrix of the vector Laplacian, multiplied by `weight`
        and the shear modulus. It regularizes a tangent stiffness that is not positive definite.
        """
        blocks = matrices.reshape(-1, 10, 3, 10, 3)
        for axis in range(3):
            blocks[:, :, axis, :, axis] += weight * self._laplacian

    def min_volume_ratio(self, displacement: Floats) -> float:
        """Return the minimum volume ratio J over all quadrature points and nodes.

        The ratio is 1 if the solid is not deformed, and at most 0 if an element is inverted. A
        corner of a quadratic element can invert while J is positive at all quadrature points.
        displacement (n, 3): displacement of the nodes, m.
        """
        local = shape_gradients(NODE_COORDINATES)
        rest, moved = (
            np.linalg.det(coordinates[self.elements].transpose(0, 2, 1)[:, None] @ local)
            for coordinates in (self.nodes, self.nodes + displacement)
        )
        return float(min(self.deformation(displacement)[1].min(), (moved / rest).min()))

    def _state(self, displacement: Floats) -> tuple[Floats, Floats, Floats]:
        gradient, volume_ratio = self.deformation(displacement)
        if volume_ratio.min() <= 0.0:
            raise InvertedElementError(
                f"{int((volume_ratio.min(axis=1) <= 0).sum())} elements of the deformed mesh are "
                f"inverted (minimum volume ratio {volume_ratio.min():.3g})"
            )
        return gradient, inverses(gradient, volume_ratio), np.log(volume_ratio)


def determinants(matrices: Floats) -> Floats:
    """Return the determinants (...) of matrices (..., 3, 3), faster than `numpy.linalg.det`."""
    a, b, c = matrices[..., 0, :], matrices[..., 1, :], matrices[..., 2, :]
    result: Floats = (
        a[..., 0] * (b[..., 1] * c[..., 2] - b[..., 2] * c[..., 1])
        - a[..., 1] * (b[..., 0] * c[..., 2] - b[..., 2] * c[..., 0])
        + a[..., 2] * (b[..., 0] * c[..., 1] - b[..., 1] * c[..., 0])
    )
    return result


def inverses(matrices: Floats, determinant: Floats) -> Floats:
    """Return the inverses (..., 3, 3) of 3x3 matrices whose determinants (...) are known."""
    result = np.empty_like(matrices)
    for i in range(3):
        for j in range(3):
            p, q = (j + 1) % 3, (j + 2) % 3
            r, s = (i + 1) % 3, (i + 2) % 3
            result[..., i, j] = (
                matrices[..., p, r] * matrices[..., q, s]
                - matrices[..., p, s] * matrices[..., q, r]
            )
    result /= determinant[..., None, None]
    return result
