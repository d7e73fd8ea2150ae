"""Compute the shape of the pushed sheet by a reduced-order model of the membrane.

Finite-element solutions are precomputed for a grid of stretch ratios, push positions and push
depths. A proper orthogonal decomposition reduces the shapes to a dozen modes. Polynomials through
Chebyshev points interpolate the modes' coefficients. The computation of a shape then takes about
0.1 ms.

The grid on the sheet moves with the finger and is densest at the finger. Therefore the same grid
nodes are always at the deepest point of the sheet. Solutions are computed for positions in one
quadrant. Solutions for the other quadrants follow by symmetry.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.models.sheet.membrane import push_path
from flexsheet.nodes.models.sheet.rubber import Rubber

HALF_CELLS = 14
"""The number of grid cells from the finger to each side of the sheet."""

GRADING = 3.2
"""The grading of the grid. The distance of a grid line from the finger is proportional to
sinh(GRADING a). Here a is the index of the line, counted from the finger, divided by `HALF_CELLS`.
"""

MAX_TRUNCATION_RMS_M = 2e-5
"""The maximum error (m, root mean square) due to the truncation of the modes."""

MAX_FRACTION_X, MAX_FRACTION_Y = 0.36, 0.40
"""The maximum |x| and |y| of a precomputed push, as fractions of the sheet's width (x) and height
(y)."""


@dataclass(frozen=True, slots=True)
class IndentationRange:
    """The range of the precomputed pushes: stretch ratios and maximum depth (m).

    stretch_nodes, place_nodes, depth_nodes: numbers of interpolation nodes over stretch, over each
        coordinate of the position, and over depth.
    element_cells: number of finite elements along each side of the sheet.
    """

    min_stretch: float
    max_stretch: float
    deepest_m: float
    stretch_nodes: int = 3
    place_nodes: int = 4
    depth_nodes: int = 8
    element_cells: int = 26


@dataclass(frozen=True, slots=True)
class IndentationBasis:
    """A reduced-order model of the pushed sheet.

    stretches, xs_m, ys_m, roots: interpolation nodes over the stretch ratio, the two coordinates of
        the position, and the depth. `roots` contains values of sqrt(depth / maximum depth).
    modes: displacement modes (modes, rows, columns, 3), m.
    coefficients: coefficients (stretches, xs, ys, roots, modes) of the modes at the interpolation
        nodes.
    """

    rubber: Rubber
    finger_radius_m: float
    deepest_m: float
    stretches: Floats
    xs_m: Floats
    ys_m: Floats
    roots: Floats
    modes: Floats
    coefficients: Floats

    def offsets(
        self, stretch_ratio: float, position_m: tuple[float, float], depth_m: float
    ) -> Floats:
        """Return displacements (rows, columns, 3), m, of grid points from the flat stretched sheet.

        position_m: (x, y) of the fingertip in the sheet frame.

        Rows are along y, columns along x. Inputs are clamped to the precomputed range.
        """
        mirrored = (position_m[0] < 0.0, position_m[1] < 0.0)
        weights = (
            _barycentric_weights(self.stretches, stretch_ratio),
            _barycentric_weights(self.xs_m, abs(position_m[0])),
            _barycentric_weights(self.ys_m, abs(position_m[1])),
            _barycentric_weights(self.roots, np.sqrt(max(depth_m, 0.0) / self.deepest_m)),
        )
        table = self.coefficients
        for weight in weights:
            table = np.tensordot(weight, table, axes=1)
        shape = np.tensordot(table, self.modes, axes=1)
        if mirrored[0]:
            shape = shape[:, ::-1] * [-1.0, 1.0, 1.0]
        if mirrored[1]:
            shape = shape[::-1] * [1.0, -1.0, 1.0]
        return np.asarray(shape)

    def grid(self, stretch_ratio: float, position_m: tuple[float, float]) -> Floats:
        """Return the grid points (rows, columns, 2), m, of the flat sheet before it is pushed.

        position_m: (x, y) of the fingertip in the sheet frame. The grid is finer near this
            position.

        The method `offsets` returns the displacements of these points.
        """
        sheet, most_x, most_y = self.rubber, self.xs_m[-1], self.ys_m[-1]
        focus_x = float(np.clip(position_m[0], -most_x, most_x)) / stretch_ratio
        x = _grade_coordinates(focus_x, 0.5 * sheet.width_m)
        y = _grade_coordinates(float(np.clip(position_m[1], -most_y, most_y)), 0.5 * sheet.height_m)
        return np.stack(np.meshgrid(stretch_ratio * x, y), axis=-1)

    def invalid_reason(
        self, stretch_ratio: float, position_m: tuple[float, float], depth_m: float
    ) -> str:
        """Return why a push is outside the precomputed range, or "" if it is inside.

        position_m: (x, y) of the fingertip in the sheet frame.
        """
        if not self.stretches[0] <= stretch_ratio <= self.stretches[-1]:
            return (
                f"the stretch ratio {stretch_ratio:.3f} is not from {self.stretches[0]:.3f} to "
                f"{self.stretches[-1]:.3f}"
            )
        if depth_m > self.deepest_m:
            deepest_mm = 1e3 * self.deepest_m
            return f"the push of {1e3 * depth_m:.0f} mm is deeper than {deepest_mm:.0f} mm"
        if abs(position_m[0]) > self.xs_m[-1] or abs(position_m[1]) > self.ys_m[-1]:
            x, y = 1e3 * position_m[0], 1e3 * position_m[1]
            return f"the push at ({x:.0f}, {y:.0f}) mm is too close to the sheet's edge"
        return ""


@dataclass(frozen=True, slots=True)
class IndentationCase:
    """The inputs of one finite-element solution of a push.

    position_m: (x, y) of the fingertip in the sheet frame.
    depths_m: ascending depths (n,).
    """

    rubber: Rubber
    stretch_ratio: float
    position_m: tuple[float, float]
    depths_m: Floats
    finger_radius_m: float
    element_cells: int


IndentationOffsets = Iterable[Floats]
"""The displacements of each solved push (`IndentationCase`), in the order of the pushes.

The arrays have the shape (depths, rows, columns, 3) and the unit m. Rows and columns are those of
the grid on the sheet."""


def solve_indentation_basis(
    rubber: Rubber,
    *,
    within: IndentationRange,
    finger_radius_m: float,
    solve_all: Callable[[Sequence[IndentationCase]], IndentationOffsets] = lambda pushes: map(
        solve_indentation, pushes
    ),
) -> IndentationBasis:
    """Solve pushes at all interpolation nodes, and reduce the shapes of the membrane to modes.

    solve_all: function that solves the pushes in this process or in other processes. On one core,
        this takes 45 s.

    Raises NoEquilibriumError if a solution does not converge.
    """
    stretches = _chebyshev_points(within.min_stretch, within.max_stretch, within.stretch_nodes)
    xs = _chebyshev_points(0.0, MAX_FRACTION_X * rubber.width_m, within.place_nodes)
    ys = _chebyshev_points(0.0, MAX_FRACTION_Y * rubber.height_m, within.place_nodes)
    roots = _chebyshev_points(0.0, 1.0, within.depth_nodes)
    depths = within.deepest_m * roots**2
    pushes = [
        IndentationCase(
            rubber,
            float(stretch),
            (float(x), float(y)),
            depths,
            finger_radius_m,
            within.element_cells,
        )
        for stretch, x, y in product(stretches, xs, ys)
    ]
    samples = np.array(list(solve_all(pushes))).reshape(len(pushes) * len(roots), -1)
    modes, coefficients = _decompose(samples)
    side = 2 * HALF_CELLS + 1
    return IndentationBasis(
        rubber,
        finger_radius_m,
        within.deepest_m,
        stretches,
        xs,
        ys,
        roots,
        modes.reshape(-1, side, side, 3),
        coefficients.reshape(len(stretches), len(xs), len(ys), len(roots), -1),
    )


def solve_indentation(push: IndentationCase) -> Floats:
    """Return the finite-element displacements (depths, rows, columns, 3), m, of a push.

    Rows and columns are those of the grid of the reduced-order model.

    Raises NoEquilibriumError if a solution does not converge.
    """
    rubber, stretch = push.rubber, push.stretch_ratio
    pushed = push_path(
        rubber,
        stretch_ratio=stretch,
        depths_m=push.depths_m,
        position_m=push.position_m,
        finger_radius_m=push.finger_radius_m,
        cells=push.element_cells,
    )
    rest = pushed.rest_m
    flat = np.stack([stretch * rest[..., 0], rest[..., 1], np.zeros(rest.shape[:2])], axis=-1)
    x = _grade_coordinates(push.position_m[0] / stretch, 0.5 * rubber.width_m)
    y = _grade_coordinates(push.position_m[1], 0.5 * rubber.height_m)
    along_x, along_y = _linear_weights(rest[0, :, 0], x), _linear_weights(rest[:, 0, 1], y)
    offsets = pushed.positions - flat
    return np.asarray(np.einsum("Rr,Cc,drck->dRCk", along_y, along_x, offsets, optimize=True))


def _decompose(samples: Floats) -> tuple[Floats, Floats]:
    """Return m modes (m, size) of n samples (n, size), and their coefficients (n, m).

    m is the smallest number of modes for which the error is below `MAX_TRUNCATION_RMS_M`.
    """
    left, values, modes = np.linalg.svd(samples, full_matrices=False)
    lost = np.sqrt(np.cumsum(values[::-1] ** 2)[::-1] / samples.size)
    count = (
        max(1, int(np.argmax(lost < MAX_TRUNCATION_RMS_M)))
        if (lost < MAX_TRUNCATION_RMS_M).any()
        else len(values)
    )
    return modes[:count], left[:, :count] * values[:count]


def _grade_coordinates(focus_m: float, half_m: float) -> Floats:
    """Return coordinates (2 HALF_CELLS + 1,), m, from -half_m to half_m, densest at focus_m."""
    fractions = np.sinh(GRADING * np.linspace(0.0, 1.0, HALF_CELLS + 1)) / np.sinh(GRADING)
    before = focus_m - (half_m + focus_m) * fractions[::-1]
    after = focus_m + (half_m - focus_m) * fractions
    return np.concatenate([before[:-1], after])


def _linear_weights(nodes: Floats, at: Floats) -> Floats:
    """Return the weights (k, n) of n nodes (n,) in a linear interpolation at k points (k,)."""
    upper = np.clip(np.searchsorted(nodes, at), 1, len(nodes) - 1)
    fraction = np.clip((at - nodes[upper - 1]) / (nodes[upper] - nodes[upper - 1]), 0.0, 1.0)
    result = np.zeros((len(at), len(nodes)))
    rows = np.arange(len(at))
    result[rows, upper - 1], result[rows, upper] = 1.0 - fraction, fraction
    return result


def _chebyshev_points(low: float, high: float, count: int) -> Floats:
    """Return ascending Chebyshev points (count,) of the second kind, including both ends."""
    fractions = 0.5 * (1.0 - np.cos(np.pi * np.arange(count) / (count - 1)))
    return np.asarray(low + (high - low) * fractions)


def _barycentric_weights(nodes: Floats, at: float) -> Floats:
    """Return the weights (n,) of n nodes (n,) in a polynomial interpolation at the point `at`.

    The point `at` is limited to the range of the nodes.

    Source: the barycentric form of Berrut and Trefethen, SIAM Review 46, 2004, equation (5.4).
    """
    clamped = float(np.clip(at, nodes[0], nodes[-1]))
    away = clamped - nodes
    at_node = np.flatnonzero(np.abs(away) < 1e-14 * max(float(np.ptp(nodes)), 1e-300))
    if len(at_node):
        return np.asarray(np.eye(len(nodes))[at_node[0]])
    signs = (-1.0) ** np.arange(len(nodes))
    signs[[0, -1]] *= 0.5
    fractions = signs / away
    return np.asarray(fractions / fractions.sum())
