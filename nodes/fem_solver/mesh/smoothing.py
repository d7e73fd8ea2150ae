"""Optimize the shape of tetrahedra while their boundary is moved to a surface.

The objective is the sum of w^2 over all tetrahedra. w = (|A|^2 / 3)^(3/2) / det A is the inverse
mean ratio, a measure of distortion. The matrix A maps a regular tetrahedron to the actual one. w is
1 for a regular tetrahedron of any size and infinite for a flat one, so elements never become
inverted (Knupp, "Algebraic mesh quality metrics", 2001; Freitag and Knupp, "Tetrahedral mesh
improvement via optimization of the element condition number", 2002). Springs along the surface
normals pull the boundary corners to the surface, and the corners can slide along it. The stiffness
of the springs increases in several rounds.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from flexsheet.nodes.arrays import Floats, Ints
from flexsheet.nodes.fem_solver.mesh.quality import radius_ratios
from flexsheet.nodes.models.shapes import Shape

Surface = Callable[[Floats], tuple[Floats, Floats]]
"""Function that maps points (n, 3) to the nearest surface points and outward normals there."""

SPRINGS_OFF_SURFACE = (0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 300.0, 1000.0, 3000.0)
"""Spring stiffness in each round, if the boundary is at first up to one element off the surface.
Lengths are measured in median edge lengths."""
SPRINGS_ON_SURFACE = (300.0, 1000.0, 3000.0)
"""Spring stiffness in each round, if the boundary is on the surface from the start."""
MIN_FINAL_RADIUS_RATIO = 0.15
"""Minimum radius ratio (`quality.radius_ratios`) of an element after its corners are moved onto the
surface."""
ROUND_STEPS = 20
MEMORY = 8
"""Number of previous steps and gradient changes that the L-BFGS method uses."""

_REGULAR = np.array(
    [[1.0, 0.5, 0.5], [0.0, np.sqrt(0.75), np.sqrt(1.0 / 12.0)], [0.0, 0.0, np.sqrt(2.0 / 3.0)]]
)
_FROM_REGULAR = np.linalg.inv(_REGULAR)


def make_surface_query(shape: Shape) -> Surface:
    """Return the function of type `Surface` for a shape, an argument of `smooth_mesh`."""

    def nearest(points: Floats) -> tuple[Floats, Floats]:
        found = shape.closest(points)
        return found.point, found.normal

    return nearest


def smooth_mesh(
    corners: Floats,
    tetrahedra: Ints,
    hull: Ints,
    surface: Surface,
    *,
    springs: tuple[float, ...],
    anchor: float,
) -> Floats:
    """Return improved positions (n, 3) of the corners of tetrahedra with positive volume.

    hull: indices of the corners that move to the surface. springs: spring stiffness in each round.
    anchor: stiffness of springs from each corner to its start position, which preserve the
    variation of element sizes. If an element would have a radius ratio below
    `MIN_FINAL_RADIUS_RATIO`, its corners are not moved fully onto the surface.
    """
    sides = corners[tetrahedra[:, 1]] - corners[tetrahedra[:, 0]]
    unit = float(np.median(np.linalg.norm(sides, axis=1)))
    start_points = corners / unit
    points = start_points
    for spring in springs:
        feet, normals = surface(points[hull] * unit)
        feet = feet / unit

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
    targets[hull] = surface(points[hull])[0]
    while True:
        flat = radius_ratios(targets, tetrahedra) < MIN_FINAL_RADIUS_RATIO
        moved = np.unique(tetrahedra[flat])
        moved = moved[(targets[moved] != points[moved]).any(axis=1)]
        if not len(moved):
            return targets
        targets[moved] = points[moved]


def _distortion(points: Floats, tetrahedra: Ints) -> tuple[float, Floats]:
    """Return the sum of w^2 (see the module docstring) and its gradient (n, 3).

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

    points (n, 3): start. energy: function that returns value and gradient. Source: Nocedal and
    Wright, Numerical Optimization, alg. 7.5. The optimizer of scipy is not used, because its line
    search does not accept infinite values.
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
    """Multiply a gradient by the approximate inverse Hessian (two-loop recursion of L-BFGS)."""
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
