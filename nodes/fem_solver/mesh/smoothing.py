"""Optimize the shape of tetrahedra while their boundary is moved to a surface.

The objective is the sum of w^2 over all tetrahedra. w = (|A|^2 / 3)^(3/2) / det A is the inverse
mean ratio, a measure of distortion. The matrix A maps a regular tetrahedron to the actual
tetrahedron. w is 1 for a regular tetrahedron of any size, and infinite for a flat tetrahedron.
Therefore elements never become inverted (Knupp, "Algebraic mesh quality metrics", 2001; Freitag and
Knupp, "Tetrahedral mesh improvement via optimization of the element condition number", 2002).
Springs along the surface normals pull the boundary corners to the surface. The corners can slide
along the surface. The stiffness of the springs increases in several rounds.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from flexsheet.nodes.arrays import Floats, Ints
from flexsheet.nodes.fem_solver.mesh.quality import radius_ratios
from flexsheet.nodes.models.shapes import Shape

SPRINGS_OFF_SURFACE = (0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 300.0, 1000.0, 3000.0)
"""The stiffness, in each smoothing round, of the springs that pull the boundary to the surface.
The values apply if the boundary starts at most one element off the surface. The unit of length is
the median edge length."""
SPRINGS_ON_SURFACE = (300.0, 1000.0, 3000.0)
"""The stiffness of these springs in each round if the boundary starts on the surface."""
MIN_FINAL_RADIUS_RATIO = 0.15
"""The minimum radius ratio (a measure of quality) of an element after its corners are moved onto
the surface."""
ROUND_STEPS = 20
MEMORY = 8
"""The number of previous steps and gradient changes that the L-BFGS method uses."""

_REGULAR = np.array(
    [[1.0, 0.5, 0.5], [0.0, np.sqrt(0.75), np.sqrt(1.0 / 12.0)], [0.0, 0.0, np.sqrt(2.0 / 3.0)]]
)
_FROM_REGULAR = np.linalg.inv(_REGULAR)


def smooth_mesh(
    corners: Floats,
    tetrahedra: Ints,
    hull: Ints,
    shape: Shape,
    *,
    springs: tuple[float, ...],
    anchor: float,
) -> Floats:
    """Improve the shape of tetrahedra, and return the new positions (n, 3), m, of their corners.

    Each round minimizes a measure of distortion plus the energy of springs. Springs pull the
    boundary corners onto the surface, and pull all corners to their initial positions.

    corners (n, 3): corner positions, m.
    tetrahedra (e, 4): corner indices, ordered for positive volumes.
    hull: indices of the boundary corners, which move to the surface of `shape`.
    springs: stiffness of the springs to the surface, one value for each round.
    anchor: stiffness of the springs to the initial positions. They preserve the variation of
        element sizes.

    Finally, the boundary corners are moved exactly onto the surface. If this would give an element
    a radius ratio below `MIN_FINAL_RADIUS_RATIO`, its corners are not moved.
    """
    sides = corners[tetrahedra[:, 1]] - corners[tetrahedra[:, 0]]
    unit = float(np.median(np.linalg.norm(sides, axis=1)))
    start_points = corners / unit
    points = start_points
    for spring in springs:
        found = shape.closest(points[hull] * unit)
        feet, normals = found.point / unit, found.normal

        def energy(
            x: Floats, pull: tuple[Floats, Floats, float] = (feet, normals, spring)
        ) -> tuple[float, Floats]:
            value, gradient = _distortion(x, tetrahedra)
            feet, normals, spring = pull
            distance = ((x[hull] - feet) * normals).sum(axis=1)
            gradient[hull] += 2.0 * spring * distance[:, None] * normals
            gradient += 2.0 * anchor * (x - start_points)
            value += spring * float(np.square(distance).sum())
            return value + anchor * float(np.square(x - start_points).sum()), gradient

        points = _minimize(points, energy)
    points = points * unit
    targets = points.copy()
    targets[hull] = shape.closest(points[hull]).point
    while True:
        flat = radius_ratios(targets, tetrahedra) < MIN_FINAL_RADIUS_RATIO
        moved = np.unique(tetrahedra[flat])
        moved = moved[(targets[moved] != points[moved]).any(axis=1)]
        if not len(moved):
            return targets
        targets[moved] = points[moved]


def _distortion(points: Floats, tetrahedra: Ints) -> tuple[float, Floats]:
    """Return the sum of the squared inverse mean ratios of all tetrahedra, and its gradient (n, 3).

    The sum is infinite if a tetrahedron is inverted.
    """
    first = points[tetrahedra[:, 0]]
    edges = np.swapaxes(points[tetrahedra[:, 1:]] - first[:, None], 1, 2)
    shape = edges @ _FROM_REGULAR
    determinant = np.linalg.det(shape)
    if determinant.min() <= 0.0:
        return np.inf, np.zeros_like(points)
    square = (shape * shape).sum((1, 2))
    inverse_mean_ratio = (square / 3.0) ** 1.5 / determinant
    inverse = np.swapaxes(np.linalg.inv(shape), 1, 2)
    slope = 3.0 * shape / square[:, None, None] - inverse
    slope *= 2.0 * np.square(inverse_mean_ratio)[:, None, None]
    by_corner = np.swapaxes(slope @ _FROM_REGULAR.T, 1, 2)
    gradient = np.zeros_like(points)
    np.add.at(gradient, tetrahedra[:, 1:], by_corner)
    np.add.at(gradient, tetrahedra[:, 0], -by_corner.sum(axis=1))
    return float(np.square(inverse_mean_ratio).sum()), gradient


def _minimize(points: Floats, energy: Callable[[Floats], tuple[float, Floats]]) -> Floats:
    """Minimize an energy by `ROUND_STEPS` steps of L-BFGS with a backtracking line search.

    points (n, 3): initial positions. energy: function that returns the energy and its gradient (n,
    3). Unlike the line search of SciPy, this line search accepts infinite energies. Source: Nocedal
    and Wright, Numerical Optimization, alg. 7.5.
    """
    value, gradient = energy(points)
    steps: list[tuple[Floats, Floats, float]] = []
    for _ in range(ROUND_STEPS):
        direction = -_times_inverse_hessian(gradient, steps)
        slope = float((direction * gradient).sum())
        if slope >= 0.0:
            steps, direction = [], -gradient
            slope = -float(np.square(gradient).sum())
        # Limit the step of each point to a fifth of the median edge length.
        max_step = float(np.sqrt(np.square(direction).sum(axis=1).max()))
        step = min(1.0, 0.2 / max(max_step, 1e-300))
        while step > 1e-6:
            new_value, new_gradient = energy(points + step * direction)
            if new_value <= value + 1e-4 * step * slope:
                break
            step *= 0.5
        else:
            return points
        moved, gradient_change = step * direction, new_gradient - gradient
        curvature = float((moved * gradient_change).sum())
        if curvature > 0.0:
            steps = [*steps[1 - MEMORY :], (moved, gradient_change, 1.0 / curvature)]
        points, value, gradient = points + moved, new_value, new_gradient
    return points


def _times_inverse_hessian(gradient: Floats, steps: list[tuple[Floats, Floats, float]]) -> Floats:
    """Multiply a gradient (n, 3) by the approximate inverse Hessian of L-BFGS.

    steps: previous steps (n, 3), gradient changes (n, 3), and reciprocals of their scalar products.
    Source: two-loop recursion, Nocedal and Wright, alg. 7.4.
    """
    result = gradient.copy()
    weights = []
    for moved, gradient_change, inverse in reversed(steps):
        weight = inverse * float((moved * result).sum())
        weights.append(weight)
        result -= weight * gradient_change
    if steps:
        moved, gradient_change, inverse = steps[-1]
        result /= inverse * float((gradient_change * gradient_change).sum())
    for (moved, gradient_change, inverse), weight in zip(steps, reversed(weights), strict=True):
        result += (weight - inverse * float((gradient_change * result).sum())) * moved
    return result
