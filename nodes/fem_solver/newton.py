"""Solve the contact of a finger with a neo-Hookean body by Newton's method.

This method is the reference for the errors of the faster methods. The finger is a rigid sphere, or
a rigid capsule (a sphere with a straight shaft). In deep pushes, the skin closes over the sphere
and touches the shaft. A penalty pressure acts on contact points of the skin (the surface of the
body). For small penetrations, the pressure increases with the square of the penetration, so that
forces have a continuous slope. For larger penetrations, it increases linearly. At a pressure equal
to Young's modulus, the penetration is about a hundredth of the radius. Newton's method with a line
search minimises the sum of elastic and contact energy. An inverted element has infinite energy, so
it is never accepted. Because the contact has no friction, the solution depends only on the position
of the finger.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from flexsheet.messages.errors import FlexsheetError
from flexsheet.nodes.arrays import Bools, Floats, Ints
from flexsheet.nodes.fem_solver.contact import POINT_SPACING_RATIO, sample_triangle
from flexsheet.nodes.fem_solver.elasticity import degrees_of_freedom, scatter_add
from flexsheet.nodes.fem_solver.hyperelastic import NeoHookeanSolid
from flexsheet.nodes.fem_solver.mesh.solid import FACES, SUBTRIANGLES, nodes_in_planes, skin_faces
from flexsheet.nodes.fem_solver.multifrontal import Factors, IndefiniteError, NestedDissection

PENALTY_RATIO = 200.0
"""The penalty stiffness (Pa/m) of the contact, divided by Young's modulus per finger radius."""
ROUNDING_RATIO = 0.005
"""The penetration, in finger radii, up to which the penalty pressure rises quadratically."""
POINTS_PER_EDGE = 4
MAX_STEP_RATIO = 0.35
"""The maximum displacement of the finger per load step, in finger radii."""
MIN_STEP_FRACTION = 1.0 / 16.0
"""The minimum size of a load step as a fraction of the full step. Steps that do not converge are
halved down to this size."""
MAX_ITERATIONS = 25
REGULARIZATIONS = ((1.0, 0.0), (0.0, 0.0), (0.0, 0.3), (0.0, 2.0), (0.0, 15.0))
"""The settings of the successive attempts to make the tangent stiffness positive definite. Each
pair contains the weight of the contact's geometric stiffness, and the added stiffness in units of
the shear modulus.
"""
TOLERANCE = 1e-8
"""The maximum residual force at convergence, as a fraction of the largest nodal force."""


class NewtonNotConvergedError(FlexsheetError, ArithmeticError):
    """Raised if a load step of Newton's method does not converge."""

    remedy = "Reduce the push, refine the mesh, or choose the linear method."


@dataclass(frozen=True, slots=True)
class EquilibriumState:
    """An equilibrium of the body in contact with the finger.

    displacement (n, 3): displacement of the nodes, m. force_n (3,): force of the body on the
    finger. centre (3,): centre of the sphere that models the fingertip, m. min_volume_ratio:
    minimum ratio of deformed to undeformed volume. reached: whether the solution for the target
    position converged. If false, `centre` is the last position for which the solution converged.
    """

    displacement: Floats
    force_n: Floats
    centre: Floats
    min_volume_ratio: float
    reached: bool


class FingerObstacle:
    """The penalty contact between the skin of a body and the finger."""

    def __init__(
        self,
        nodes: Floats,
        elements: Ints,
        faces: Ints,
        *,
        modulus_pa: float,
        radius_m: float,
        axis: Floats | None = None,
    ) -> None:
        """Distribute the contact points over the faces.

        faces (f, 6): six-node triangles that the finger can touch. modulus_pa: Young's modulus of
        the body. The contact stiffness is proportional to it. radius_m: radius of the finger. axis
        (3,): unit vector from the tip of the finger along its shaft, which is a cylinder of the
        same radius; None if the finger is a sphere.
        """
        self.radius_m, self._axis = radius_m, axis
        self._count, self._faces = len(nodes), faces
        corners = nodes[faces[:, :3]]
        # Place the points close enough together that the finger cannot pass between them.
        max_step_m = float(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max())
        divisions = int(np.ceil(max_step_m / (POINT_SPACING_RATIO * radius_m)))
        self._shape, _ = sample_triangle(max(POINTS_PER_EDGE, divisions))
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        areas = 0.5 * np.linalg.norm(normals, axis=1)
        points = len(self._shape)
        self._penalty = np.repeat(PENALTY_RATIO * modulus_pa / radius_m * areas / points, points)
        self._rounding = ROUNDING_RATIO * radius_m
        self.parents, self._local = _find_parents(elements, faces)

    def points(self, positions: Floats) -> Floats:
        """Return the positions (q, 3), m, of the q contact points on the body's surface.

        positions (n, 3): positions of the mesh nodes, m.
        """
        result: Floats = (self._shape @ positions[self._faces]).reshape(-1, 3)
        return result

    def inside(self, positions: Floats, centre: Floats) -> tuple[Ints, Floats, Floats, Floats]:
        """Find the contact points inside the finger.

        positions (n, 3): nodes, m. centre (3,): centre of the sphere that models the fingertip, m.
        Return four arrays for the k points inside: indices (k,), penetrations (k,), m, outward
        normals (k, 3) of the finger, and distances (k,), m, from the centre or from the axis of the
        shaft.
        """
        offset = self.points(positions) - centre
        if self._axis is not None:
            offset -= np.maximum(offset @ self._axis, 0.0)[:, None] * self._axis
        distance = np.linalg.norm(offset, axis=1)
        inner = np.flatnonzero(distance < self.radius_m)
        away = distance[inner]
        return inner, self.radius_m - away, offset[inner] / away[:, None], away

    def energy(self, positions: Floats, centre: Floats) -> float:
        """Return the energy (J) of the penalty pressure.

        positions (n, 3): nodes, m. centre (3,): centre of the sphere that models the fingertip, m.
        """
        inner, depth, _, _ = self.inside(positions, centre)
        d = self._rounding
        low = depth < d
        density = np.where(low, depth**3 / (6 * d), 0.5 * depth * (depth - d) + d * d / 6)
        return float(self._penalty[inner] @ density)

    def forces(self, positions: Floats, centre: Floats) -> Floats:
        """Return the force (n, 3), N, that each node exerts on the finger: the gradient of the
        energy.

        positions (n, 3): nodes, m. centre (3,): centre of the sphere that models the fingertip, m.
        """
        inner, depth, normals, _ = self.inside(positions, centre)
        per_point = np.zeros((len(self._penalty), 3))
        per_point[inner] = -(self._penalty[inner] * self._pressure(depth))[:, None] * normals
        contact_forces = np.flatnonzero(per_point.any(axis=1))
        faces = np.unique(contact_forces // len(self._shape))
        blocks = per_point.reshape(len(self._faces), -1, 3)[faces]
        per_node = self._shape.T @ blocks
        rows = degrees_of_freedom(self._faces[faces].ravel())
        return scatter_add(rows, per_node.ravel(), 3 * self._count).reshape(-1, 3)

    def add_tangents(
        self,
        matrices: Floats,
        positions: Floats,
        centre: Floats,
        *,
        geometric_stiffness_weight: float,
    ) -> None:
        """Add the contact stiffness to the element matrices (e, 30, 30), in place.

        The contact stiffness is the second derivative of the contact energy.
        geometric_stiffness_weight: weight of the part of the stiffness that results from the
        curvature of the finger. This part can make the stiffness indefinite. The derivative is
        exact if the weight is 1.
        """
        inner, depth, normals, away = self.inside(positions, centre)
        slope = np.where(depth < self._rounding, depth / self._rounding, 1.0)
        outer = normals[:, :, None] * normals[:, None, :]
        turning = (self._pressure(depth) / away)[:, None, None] * geometric_stiffness_weight
        curved = np.eye(3) - outer
        if self._axis is not None:
            on_shaft = np.abs(normals @ self._axis) < 1e-9
            curved[on_shaft] -= self._axis[:, None] * self._axis
        blocks = slope[:, None, None] * outer - turning * curved
        blocks *= self._penalty[inner][:, None, None]
        face, point = inner // len(self._shape), inner % len(self._shape)
        faces, where = np.unique(face, return_inverse=True)
        shape = self._shape[point]
        weights = shape[:, :, None] * shape[:, None, :]
        per_point = weights[:, :, None, :, None] * blocks[:, None, :, None, :]
        summed = np.zeros((len(faces), 18, 18))
        np.add.at(summed, where, per_point.reshape(-1, 18, 18))
        local = self._local[faces]
        rows = (3 * local[:, :, None] + np.arange(3)).reshape(-1, 18)
        target = self.parents[faces]
        np.add.at(matrices, (target[:, None, None], rows[:, :, None], rows[:, None, :]), summed)

    def _pressure(self, depth: Floats) -> Floats:
        d = self._rounding
        result: Floats = np.where(depth < d, depth * depth / (2 * d), depth - 0.5 * d)
        return result


class NeoHookeanBody:
    """A solver for a neo-Hookean (hyperelastic) body with fixed nodes and a pushing finger."""

    def __init__(
        self,
        nodes: Floats,
        elements: Ints,
        fixed: Bools,
        faces: Ints,
        *,
        young_modulus_pa: float,
        poisson_ratio: float,
        finger_radius_m: float,
        tolerance: float = TOLERANCE,
        min_step_fraction: float = MIN_STEP_FRACTION,
        max_step_ratio: float = MAX_STEP_RATIO,
        factor_dtype: type[np.floating[Any]] = np.float64,
        mirror_axes: tuple[int, ...] = (),
        finger_axis: Floats | None = None,
    ) -> None:
        """Prepare the solver for a mesh and a material.

        nodes (n, 3): positions of the n nodes, m. elements (e, 10): node indices. fixed (n,):
        whether each node is fixed. faces (f, 6): six-node triangles that the finger can touch, with
        outward normals. tolerance: maximum residual force, relative to the largest nodal force.
        min_step_fraction: minimum fraction of a load step. max_step_ratio: maximum load step, in
        finger radii. factor_dtype: precision of the factors of the tangent stiffness; it affects
        only the search direction. mirror_axes: axes of the planes of symmetry if the mesh contains
        only one side of them. In this case, the forces contain only the contribution of this side.
        finger_axis (3,): direction of the finger's shaft; None if the finger is a sphere. Raises
        SolidMeshError if an element is inverted, and ValueError if the material is invalid.
        """
        self.solid = NeoHookeanSolid(
            nodes, elements, young_modulus_pa=young_modulus_pa, poisson_ratio=poisson_ratio
        )
        self.obstacle = FingerObstacle(
            nodes,
            elements,
            faces,
            modulus_pa=young_modulus_pa,
            radius_m=finger_radius_m,
            axis=finger_axis,
        )
        self.fixed = fixed
        self.tolerance, self.min_step_fraction = tolerance, min_step_fraction
        self.max_step_ratio = max_step_ratio
        self.factor_dtype = factor_dtype
        self._order = NestedDissection(nodes, elements, fixed)
        self._hull = skin_faces(nodes, elements, mirror_axes)[:, SUBTRIANGLES].reshape(-1, 3)
        self._max_winding = 0.5 ** (1 + len(mirror_axes))
        in_planes = nodes_in_planes(nodes, mirror_axes)
        self._fixed_dofs = in_planes | fixed[:, None]
        at_planes = (in_planes & ~fixed[:, None])[elements].reshape(len(elements), -1)
        self._constrained = np.flatnonzero(at_planes.any(axis=1))
        free = ~at_planes[self._constrained]
        # Without its coupling, a constrained degree of freedom keeps its own positive stiffness.
        self._coupled = (free[:, :, None] & free[:, None, :]) | np.eye(30, dtype=bool)

    def solve_load_steps(
        self, centres: Iterable[Floats], *, start: tuple[Floats, Floats] | None = None
    ) -> Iterator[EquilibriumState]:
        """Move the finger in a straight line to each position, and yield the equilibrium there.

        centres: positions (3,), m, of the centre of the spherical fingertip.
        start: displacement (n, 3) of the nodes and centre (3,) of the fingertip in a known
            equilibrium, m. If `start` is None, the sphere at the first position must not touch the
            body.

        If a step does not converge, the last equilibrium is yielded with `reached` false for all
        remaining positions. A step with inverted elements or with the sphere inside the body has
        not converged. Raises ValueError if a coordinate of a position is not finite.
        """
        displacement, position = start or (np.zeros_like(self.solid.nodes), None)
        factors: Factors | None = None
        failed = False
        for centre in centres:
            if not np.isfinite(centre).all():
                raise ValueError(
                    f"the finger centre {centre} is not finite; check the push point and depth"
                )
            if position is None:
                position = centre
            done, fraction = 0.0, 1.0
            start_position, path = position, centre - position
            max_step_m = self.max_step_ratio * self.obstacle.radius_m
            step_count = max(1, int(np.ceil(np.linalg.norm(path) / max_step_m)))
            while done < 1.0 - 1e-12 and not failed:
                step = min(fraction / step_count, 1.0 - done)
                target = start_position + (done + step) * path
                try:
                    guess = self._predict(displacement, position, target, factors)
                    solution, factors = self.solve_equilibrium(displacement, target, guess=guess)
                    self._check_validity(solution, target)
                except NewtonNotConvergedError:
                    fraction *= 0.5
                    failed = fraction < self.min_step_fraction
                    continue
                displacement, position = solution, target
                done += step
                fraction = min(1.0, 2.0 * fraction)
            yield EquilibriumState(
                displacement=displacement,
                force_n=self.obstacle.forces(self.solid.nodes + displacement, position).sum(axis=0),
                centre=position,
                min_volume_ratio=self.solid.min_volume_ratio(displacement),
                reached=not failed,
            )

    def solve_equilibrium(
        self, displacement: Floats, centre: Floats, *, guess: Floats
    ) -> tuple[Floats, Factors | None]:
        """Find the equilibrium for a spherical fingertip at `centre` (3,) by Newton's method.

        The iteration starts at `displacement` or `guess` (n, 3), m, whichever has less energy.

        Returns the displacement (n, 3) at equilibrium, and the last factorization of the tangent
        stiffness matrix. Raises NewtonNotConvergedError if the iteration does not converge.
        """
        nodes = self.solid.nodes
        if self._energy(guess, centre) < self._energy(displacement, centre):
            displacement = guess
        energy = self._energy(displacement, centre)
        factors: Factors | None = None
        for iteration in range(MAX_ITERATIONS):
            inner = self.solid.forces(displacement)
            contact_forces = self.obstacle.forces(nodes + displacement, centre)
            residual = np.where(self._fixed_dofs, 0.0, inner + contact_forces)
            scale = max(np.abs(inner).max(), np.abs(contact_forces).max())
            if np.abs(residual).max() <= self.tolerance * scale:
                return displacement, factors
            factors = self._factorize(displacement, centre)
            step = -factors.solve(residual.ravel()).reshape(-1, 3)
            slope = float((residual * step).sum())
            fraction = 1.0
            while True:
                trial = displacement + fraction * step
                now = self._energy(trial, centre)
                if now <= energy + 1e-4 * fraction * slope + 1e-14 * abs(energy):
                    break
                fraction *= 0.5
                if fraction < 1e-4:
                    raise NewtonNotConvergedError(
                        f"the line search found no lower energy after {iteration} Newton iterations"
                    )
            displacement, energy = trial, now
        raise NewtonNotConvergedError(
            f"the equilibrium did not converge in {MAX_ITERATIONS} Newton iterations"
        )

    def _check_validity(self, displacement: Floats, centre: Floats) -> None:
        """Raise NewtonNotConvergedError if an element is inverted or the finger is in the body."""
        ratio = self.solid.min_volume_ratio(displacement)
        if ratio <= 0.0:
            raise NewtonNotConvergedError(
                f"an element of the mesh is inverted (minimum volume ratio {ratio:.3g})"
            )
        triangles = (self.solid.nodes + displacement)[self._hull] - centre
        if winding_number(triangles) > self._max_winding:
            raise NewtonNotConvergedError("the centre of the finger is inside the body")

    def _energy(self, displacement: Floats, centre: Floats) -> float:
        elastic = self.solid.energy(displacement)
        if not np.isfinite(elastic):
            return elastic
        return elastic + self.obstacle.energy(self.solid.nodes + displacement, centre)

    def _predict(
        self,
        displacement: Floats,
        position: Floats,
        target: Floats,
        factors: Factors | None,
    ) -> Floats:
        """Predict to first order the displacement (n, 3), m, after the finger moves to `target`."""
        if factors is None:
            return displacement
        positions, fraction = self.solid.nodes + displacement, 1e-3 * (target - position)
        change = self.obstacle.forces(positions, position + fraction)
        change -= self.obstacle.forces(positions, position - fraction)
        change[self._fixed_dofs] = 0.0
        return displacement - factors.solve(500.0 * change.ravel()).reshape(-1, 3)

    def _factorize(self, displacement: Floats, centre: Floats) -> Factors:
        """Factor the tangent stiffness. If it is not positive definite, regularize it first.

        Raises NewtonNotConvergedError if no regularization makes it positive definite.
        """
        positions = self.solid.nodes + displacement
        elastic = self.solid.tangents(displacement)
        for geometric_stiffness_weight, stiffening in REGULARIZATIONS:
            matrices = elastic.copy()
            self.obstacle.add_tangents(
                matrices,
                positions,
                centre,
                geometric_stiffness_weight=geometric_stiffness_weight,
            )
            self.solid.stiffen(matrices, stiffening)
            matrices[self._constrained] *= self._coupled
            try:
                return self._order.factor(matrices.astype(self.factor_dtype, copy=False))
            except IndefiniteError:
                continue
        raise NewtonNotConvergedError(
            "the tangent stiffness is not positive definite with any regularization"
        )


def winding_number(triangles: Floats) -> float:
    """Return the winding number of a closed surface about the origin.

    The number is 1 if the origin is inside the surface, and 0 if it is outside. triangles (t, 3,
    3): corners, counter-clockwise as seen from outside. Source: van Oosterom & Strackee, IEEE
    Trans. Biomed. Eng. 30, 1983.
    """
    a, b, c = triangles.transpose(1, 0, 2)
    x, y, z = np.linalg.norm(triangles, axis=2).T
    spanned = (a * np.cross(b, c)).sum(axis=1)
    total = x * y * z + (a * b).sum(1) * z + (b * c).sum(1) * x + (c * a).sum(1) * y
    return float(np.arctan2(spanned, total).sum() / (2.0 * np.pi))


def _find_parents(elements: Ints, faces: Ints) -> tuple[Ints, Ints]:
    """Find the element to which each of the f faces (f, 6) belongs.

    Return the indices (f,) of the elements, and the local indices (f, 6), from 0 to 9, of the face
    nodes in their element.
    """
    sides = elements[:, FACES]
    keys = np.sort(sides[..., :3], axis=2).reshape(-1, 3)
    base = int(elements.max()) + 1
    weights = np.array([base * base, base, 1])
    face_keys, wanted_keys = keys @ weights, np.sort(faces[:, :3], axis=1) @ weights
    order = np.argsort(face_keys)
    parents = order[np.searchsorted(face_keys, wanted_keys, sorter=order)] // len(FACES)
    return parents, (elements[parents][:, None, :] == faces[:, :, None]).argmax(axis=2)
