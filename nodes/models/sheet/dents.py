"""The dented sheet's shape from a few numbers: a basis from the membrane's finite elements.

The elements are solved beforehand over stretch, place and depth of the push; what is left of all
those shapes after a proper orthogonal decomposition is a dozen modes, whose coefficients are
interpolated by polynomials through Chebyshev's points.  A shape then costs some 0.1 ms.

The grid on which shapes are told goes with the finger: it is finest where the finger is, so that
the dent's tip is always at the same nodes.  Only a quarter of the places is solved; the others are
its mirror images.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from nodes.models.sheet.membrane import push_path
from nodes.models.sheet.rubber import Rubber

Floats = NDArray[np.float64]

HALF_CELLS = 14
"""Cells of the grid from the finger to each side of the sheet."""

GRADING = 3.2
"""Cells grow from the finger outwards as sinh(GRADING a), a from 0 to 1: first 2 mm of 120."""

KEPT_M = 2e-5
"""Root of the mean square of what the modes leave of the solved shapes."""

FARTHEST_X, FARTHEST_Y = 0.36, 0.40
"""Places are solved up to this share of width and height from the middle."""


@dataclass(frozen=True, slots=True)
class DentRange:
    """For which pushes shapes are worked out: stretch ratios, and depths up to the deepest (m).

    ..._nodes: how many of each are solved; places along either axis.  element_cells: of the finite
    elements, along either side of the sheet.
    """

    least_stretch: float
    largest_stretch: float
    deepest_m: float
    stretch_nodes: int = 3
    place_nodes: int = 4
    depth_nodes: int = 8
    element_cells: int = 26


@dataclass(frozen=True, slots=True)
class DentShapes:
    """The basis and its coefficients.

    stretches, xs_m, ys_m, roots: the nodes of interpolation; roots are of depth over the deepest.
    modes: (modes, rows, columns, 3), m.  coefficients: (stretches, xs, ys, roots, modes).
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

    def offsets(self, stretch_ratio: float, place_m: tuple[float, float], depth_m: float) -> Floats:
        """How far the sheet's points are from where they are in a flat, evenly stretched sheet.

        (rows, columns, 3) m in the sheet's frame; rows along y, columns along x.

        place_m: (x, y) of the fingertip over the sheet.  What is outside of what was solved is
        taken at the border (see `outside`).
        """
        mirrored = (place_m[0] < 0.0, place_m[1] < 0.0)
        weights = (
            _weights(self.stretches, stretch_ratio),
            _weights(self.xs_m, abs(place_m[0])),
            _weights(self.ys_m, abs(place_m[1])),
            _weights(self.roots, np.sqrt(max(depth_m, 0.0) / self.deepest_m)),
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

    def grid(self, stretch_ratio: float, place_m: tuple[float, float]) -> Floats:
        """Where the same points (rows, columns, 2) are in the flat, evenly stretched sheet."""
        sheet, most_x, most_y = self.rubber, self.xs_m[-1], self.ys_m[-1]
        focus_x = float(np.clip(place_m[0], -most_x, most_x)) / stretch_ratio
        x = _graded(focus_x, 0.5 * sheet.width_m)
        y = _graded(float(np.clip(place_m[1], -most_y, most_y)), 0.5 * sheet.height_m)
        return np.stack(np.meshgrid(stretch_ratio * x, y), axis=-1)

    def outside(self, stretch_ratio: float, place_m: tuple[float, float], depth_m: float) -> str:
        """Why a shape is that of the nearest push that was solved; empty where it is its own."""
        if not self.stretches[0] <= stretch_ratio <= self.stretches[-1]:
            return (
                f"stretch {stretch_ratio:.3f} is not from {self.stretches[0]:.3f} to "
                f"{self.stretches[-1]:.3f}"
            )
        if depth_m > self.deepest_m:
            return f"push of {1e3 * depth_m:.0f} mm is deeper than {1e3 * self.deepest_m:.0f} mm"
        if abs(place_m[0]) > self.xs_m[-1] or abs(place_m[1]) > self.ys_m[-1]:
            x, y = 1e3 * place_m[0], 1e3 * place_m[1]
            return f"push at ({x:.0f}, {y:.0f}) mm is too near to the sheet's edge"
        return ""


def triangles_of(rows: int, columns: int) -> NDArray[np.int32]:
    """Triangles (n, 3) of a grid's points, counter-clockwise for the user."""
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    right, above = corner + 1, corner + columns
    both = [np.stack([corner, right, above + 1], 1), np.stack([corner, above + 1, above], 1)]
    return np.concatenate(both).astype(np.int32)


@dataclass(frozen=True, slots=True)
class Push:
    """One run of the elements: a stretch, a place, ascending depths (n,), cells along a side."""

    rubber: Rubber
    stretch_ratio: float
    place_m: tuple[float, float]
    depths_m: Floats
    finger_radius_m: float
    element_cells: int


Solved = Iterable[Floats]
"""Of each push its offsets (depths, rows, columns, 3), in the order of the pushes."""


def solve_dents(
    rubber: Rubber,
    *,
    within: DentRange,
    finger_radius_m: float,
    solve_all: Callable[[Sequence[Push]], Solved] = lambda pushes: map(solve_push, pushes),
) -> DentShapes:
    """Solves the elements at every node and keeps what matters; three quarters of a minute of a
    core.

    solve_all: does it, here or in other processes.  NoEquilibriumError where there is none.
    """
    stretches = _chebyshev(within.least_stretch, within.largest_stretch, within.stretch_nodes)
    xs = _chebyshev(0.0, FARTHEST_X * rubber.width_m, within.place_nodes)
    ys = _chebyshev(0.0, FARTHEST_Y * rubber.height_m, within.place_nodes)
    roots = _chebyshev(0.0, 1.0, within.depth_nodes)
    depths = within.deepest_m * roots**2
    pushes = [
        Push(
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
    modes, coefficients = _reduced(samples)
    side = 2 * HALF_CELLS + 1
    return DentShapes(
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


def solve_push(push: Push) -> Floats:
    """Offsets (depths, rows, columns, 3) on the grid of its place, from the elements."""
    rubber, stretch = push.rubber, push.stretch_ratio
    pushed = push_path(
        rubber,
        stretch_ratio=stretch,
        depths_m=push.depths_m,
        place_m=push.place_m,
        finger_radius_m=push.finger_radius_m,
        cells=push.element_cells,
    )
    rest = pushed.rest_m
    flat = np.stack([stretch * rest[..., 0], rest[..., 1], np.zeros(rest.shape[:2])], axis=-1)
    x = _graded(push.place_m[0] / stretch, 0.5 * rubber.width_m)
    y = _graded(push.place_m[1], 0.5 * rubber.height_m)
    along_x, along_y = _linear(rest[0, :, 0], x), _linear(rest[:, 0, 1], y)
    offsets = pushed.positions - flat
    return np.asarray(np.einsum("Rr,Cc,drck->dRCk", along_y, along_x, offsets, optimize=True))


def _reduced(samples: Floats) -> tuple[Floats, Floats]:
    """Modes (m, size) and coefficients (n, m) of samples (n, size): the fewest that keep them."""
    left, values, modes = np.linalg.svd(samples, full_matrices=False)
    lost = np.sqrt(np.cumsum(values[::-1] ** 2)[::-1] / samples.size)
    kept = max(1, int(np.argmax(lost < KEPT_M))) if (lost < KEPT_M).any() else len(values)
    return modes[:kept], left[:, :kept] * values[:kept]


def _graded(focus_m: float, half_m: float) -> Floats:
    """(2 HALF_CELLS + 1,) coordinates from -half_m to half_m, finest about the focus."""
    shares = np.sinh(GRADING * np.linspace(0.0, 1.0, HALF_CELLS + 1)) / np.sinh(GRADING)
    before = focus_m - (half_m + focus_m) * shares[::-1]
    after = focus_m + (half_m - focus_m) * shares
    return np.concatenate([before[:-1], after])


def _linear(nodes: Floats, at: Floats) -> Floats:
    """(at, nodes): linear interpolation."""
    upper = np.clip(np.searchsorted(nodes, at), 1, len(nodes) - 1)
    share = np.clip((at - nodes[upper - 1]) / (nodes[upper] - nodes[upper - 1]), 0.0, 1.0)
    result = np.zeros((len(at), len(nodes)))
    rows = np.arange(len(at))
    result[rows, upper - 1], result[rows, upper] = 1.0 - share, share
    return result


def _chebyshev(low: float, high: float, count: int) -> Floats:
    """Chebyshev's extreme points (count,), ends included, ascending."""
    shares = 0.5 * (1.0 - np.cos(np.pi * np.arange(count) / (count - 1)))
    return np.asarray(low + (high - low) * shares)


def _weights(nodes: Floats, at: float) -> Floats:
    """(n,) weights of the polynomial through the nodes, at a place kept within them.

    Barycentric, Berrut and Trefethen, SIAM Review 46, 2004, equation (5.4).
    """
    place = float(np.clip(at, *_within(nodes)))
    away = place - nodes
    at_node = np.flatnonzero(np.abs(away) < 1e-14 * max(float(np.ptp(nodes)), 1e-300))
    if len(at_node):
        return np.asarray(np.eye(len(nodes))[at_node[0]])
    signs = (-1.0) ** np.arange(len(nodes))
    signs[[0, -1]] *= 0.5
    shares = signs / away
    return np.asarray(shares / shares.sum())


def _within(nodes: Floats) -> tuple[float, float]:
    return float(nodes[0]), float(nodes[-1])
