"""Compute the indented sheet's shape by a reduced-order model of the membrane's finite elements.

The elements are solved in advance over stretch, position and depth of the push.  A proper
orthogonal decomposition reduces the shapes to a dozen modes.  Polynomials through Chebyshev points
interpolate their coefficients.  A shape then takes some 0.1 ms.

The grid of the shapes moves with the finger and is finest there, so that the tip of the indentation
is always at the same nodes.  Only a quarter of the positions is solved; the others follow by mirror
symmetry.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from flexsheet.nodes.models.sheet.membrane import push_path
from flexsheet.nodes.models.sheet.rubber import Rubber

Floats = NDArray[np.float64]

HALF_CELLS = 14
"""Cells of the grid from the finger to each side of the sheet."""

GRADING = 3.2
"""Cells grow away from the finger as sinh(GRADING a), a from 0 to 1: the first has 2 mm of 120."""

MAX_TRUNCATION_RMS_M = 2e-5
"""Maximum root mean square of the shapes that the modes leave out."""

MAX_FRACTION_X, MAX_FRACTION_Y = 0.36, 0.40
"""Largest solved positions, as fractions of width and height from the centre."""


@dataclass(frozen=True, slots=True)
class IndentationRange:
    """Hold the range of pushes that are solved: stretch ratios, and depths up to the maximum (m).

    stretch_nodes, place_nodes, depth_nodes: number of solved values, positions along either axis.
    element_cells: number of finite elements along either side of the sheet.
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
    """Hold the modes of the indented sheet and their coefficients.

    stretches, xs_m, ys_m, roots: interpolation nodes; roots are of depth over maximum depth.
    modes: (modes, rows, columns, 3), m.
    coefficients: (stretches, xs, ys, roots, modes).
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
        """Return the displacement (rows, columns, 3), m, from the flat, uniformly stretched sheet.

        position_m: (x, y) of the fingertip over the sheet.

        Rows run along y and columns along x of the sheet's frame.  Outside the solved range, the
        nearest border of the range is taken (see `invalid_reason`).
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
        """Return the same points (rows, columns, 2) in the flat, uniformly stretched sheet."""
        sheet, most_x, most_y = self.rubber, self.xs_m[-1], self.ys_m[-1]
        focus_x = float(np.clip(position_m[0], -most_x, most_x)) / stretch_ratio
        x = _grade_coordinates(focus_x, 0.5 * sheet.width_m)
        y = _grade_coordinates(float(np.clip(position_m[1], -most_y, most_y)), 0.5 * sheet.height_m)
        return np.stack(np.meshgrid(stretch_ratio * x, y), axis=-1)

    def invalid_reason(
        self, stretch_ratio: float, position_m: tuple[float, float], depth_m: float
    ) -> str:
        """Return why a push is outside the solved range; empty where it is inside."""
        if not self.stretches[0] <= stretch_ratio <= self.stretches[-1]:
            return (
                f"stretch {stretch_ratio:.3f} is not from {self.stretches[0]:.3f} to "
                f"{self.stretches[-1]:.3f}"
            )
        if depth_m > self.deepest_m:
            return f"push of {1e3 * depth_m:.0f} mm is deeper than {1e3 * self.deepest_m:.0f} mm"
        if abs(position_m[0]) > self.xs_m[-1] or abs(position_m[1]) > self.ys_m[-1]:
            x, y = 1e3 * position_m[0], 1e3 * position_m[1]
            return f"push at ({x:.0f}, {y:.0f}) mm is too near to the sheet's edge"
        return ""


def triangulate_grid(rows: int, columns: int) -> NDArray[np.int32]:
    """Return triangles (n, 3) of a grid's points, counter-clockwise for the user."""
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    right, above = corner + 1, corner + columns
    both = [np.stack([corner, right, above + 1], 1), np.stack([corner, above + 1, above], 1)]
    return np.concatenate(both).astype(np.int32)


@dataclass(frozen=True, slots=True)
class IndentationCase:
    """Hold one run of the elements: stretch, position, ascending depths (n,), cells along a
    side."""

    rubber: Rubber
    stretch_ratio: float
    position_m: tuple[float, float]
    depths_m: Floats
    finger_radius_m: float
    element_cells: int


IndentationOffsets = Iterable[Floats]
"""Displacements (depths, rows, columns, 3) of each case, in the order of the cases."""


def solve_indentation_basis(
    rubber: Rubber,
    *,
    within: IndentationRange,
    finger_radius_m: float,
    solve_all: Callable[[Sequence[IndentationCase]], IndentationOffsets] = lambda pushes: map(
        solve_indentation, pushes
    ),
) -> IndentationBasis:
    """Solve the elements at every node and reduce the shapes; takes 45 s of one core.

    solve_all: solves the cases, in this or in other processes.

    Raises NoEquilibriumError.
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
    """Return displacements (depths, rows, columns, 3) of the elements on the grid of the push."""
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
    """Return the fewest modes (m, size) that keep the samples (n, size), and coefficients (n,
    m)."""
    left, values, modes = np.linalg.svd(samples, full_matrices=False)
    lost = np.sqrt(np.cumsum(values[::-1] ** 2)[::-1] / samples.size)
    count = (
        max(1, int(np.argmax(lost < MAX_TRUNCATION_RMS_M)))
        if (lost < MAX_TRUNCATION_RMS_M).any()
        else len(values)
    )
    return modes[:count], left[:, :count] * values[:count]


def _grade_coordinates(focus_m: float, half_m: float) -> Floats:
    """Return (2 HALF_CELLS + 1,) coordinates from -half_m to half_m, finest about the focus."""
    fractions = np.sinh(GRADING * np.linspace(0.0, 1.0, HALF_CELLS + 1)) / np.sinh(GRADING)
    before = focus_m - (half_m + focus_m) * fractions[::-1]
    after = focus_m + (half_m - focus_m) * fractions
    return np.concatenate([before[:-1], after])


def _linear_weights(nodes: Floats, at: Floats) -> Floats:
    """Return the weights (at, nodes) of linear interpolation."""
    upper = np.clip(np.searchsorted(nodes, at), 1, len(nodes) - 1)
    fraction = np.clip((at - nodes[upper - 1]) / (nodes[upper] - nodes[upper - 1]), 0.0, 1.0)
    result = np.zeros((len(at), len(nodes)))
    rows = np.arange(len(at))
    result[rows, upper - 1], result[rows, upper] = 1.0 - fraction, fraction
    return result


def _chebyshev_points(low: float, high: float, count: int) -> Floats:
    """Return Chebyshev's extreme points (count,), ends included, ascending."""
    fractions = 0.5 * (1.0 - np.cos(np.pi * np.arange(count) / (count - 1)))
    return np.asarray(low + (high - low) * fractions)


def _barycentric_weights(nodes: Floats, at: float) -> Floats:
    """Return the weights (n,) of the interpolating polynomial at a point clamped to the nodes'
    range.

    Barycentric form: Berrut and Trefethen, SIAM Review 46, 2004, equation (5.4).
    """
    clamped = float(np.clip(at, *_bounds(nodes)))
    away = clamped - nodes
    at_node = np.flatnonzero(np.abs(away) < 1e-14 * max(float(np.ptp(nodes)), 1e-300))
    if len(at_node):
        return np.asarray(np.eye(len(nodes))[at_node[0]])
    signs = (-1.0) ** np.arange(len(nodes))
    signs[[0, -1]] *= 0.5
    fractions = signs / away
    return np.asarray(fractions / fractions.sum())


def _bounds(nodes: Floats) -> tuple[float, float]:
    return float(nodes[0]), float(nodes[-1])
