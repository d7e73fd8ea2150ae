"""Compute the shape and forces of the pushed sheet by finite elements of a membrane.

The finite elements are bilinear cells with four integration points. The material is incompressible
Mooney-Rivlin rubber in plane stress. The energy W per volume has the constants C1 and C2. E is
Young's modulus, and C2 = 0 is a neo-Hookean material:

    W = C1 (I1 - 3) + C2 (I2 - 3),    E = 6 (C1 + C2)

I1 and I2 are the invariants of the Cauchy-Green tensor C = F'F, where F is the deformation
gradient. A membrane wrinkles under compression (tension field theory: Pipkin, IMA J. Appl. Math.
36, 1986). Let l1 be the larger and l2 the smaller principal stretch. In uniaxial tension, l2 is
l1^-1/2. If l2 is below l1^-1/2, the energy of uniaxial tension is used. If l1 is also below 1, the
energy is zero. The stress, and the tangent (the derivative of the stress with respect to the
strain), are computed in the principal frame of C.

The fingertip is a rigid sphere that is pushed along the flat sheet's normal. Touched nodes stick to
the sphere. Newton's method computes each equilibrium, starting from the previous equilibrium.
Levenberg-Marquardt damping is used if parts of the sheet are slack and have no stiffness.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from flexsheet.messages.errors import FlexsheetError
from flexsheet.nodes.arrays import Bools, Floats
from flexsheet.nodes.models.sheet.rubber import Rubber

Indices = NDArray[np.intp]

CELLS = 32
MIN_CELL_RADII = 0.3
"""The cell size under the finger, as a multiple of the finger's radius."""
STEP_RADII = 0.4
"""The maximum step of the finger's depth, as a multiple of the finger's radius."""
PENALTY_PER_MODULUS = 2e5
"""The stiffness of the contact penalty in units of E t / width^2. The stiffness is the pressure
divided by the penetration.

E is Young's modulus. t and width are the thickness and the width of the sheet.
"""
MAX_ITERATIONS = 120
GAUSS = 0.5 / np.sqrt(3.0)
"""The distance of the integration points from a cell's centre along each axis, divided by the
cell's side."""
TOLERANCE = 1e-7
"""The maximum residual force of a solution, in units of E t width. E is Young's modulus. t and
width are the thickness and the width of the sheet."""


class NoEquilibriumError(FlexsheetError, ArithmeticError):
    """Raised if the iteration for the membrane's equilibrium does not converge."""

    remedy = "Reduce the push or the tilt: it is beyond the sheet's range."


@dataclass(frozen=True, slots=True)
class PushPath:
    """The equilibria of the sheet at n depths of one push.

    forces_n (n,): normal force of the sheet on the finger.
    edge_forces_n (n,): mean force on the clamps along the line between them.
    positions (n, rows, columns, 3): positions (m) of the mesh nodes in the sheet's frame.
    rest_m (rows, columns, 2): positions (m) of these nodes in the slack sheet, relative to the
        sheet's centre.
    """

    depths_m: Floats
    forces_n: Floats
    edge_forces_n: Floats
    positions: Floats
    rest_m: Floats


def push_path(
    rubber: Rubber,
    *,
    stretch_ratio: float,
    depths_m: Sequence[float] | Floats,
    position_m: tuple[float, float] = (0.0, 0.0),
    finger_radius_m: float,
    cells: int = CELLS,
) -> PushPath:
    """Compute the equilibria of a push at ascending depths (n,), m.

    stretch_ratio: ratio of the edges' distance to the slack width.
    position_m: (x, y) of the push on the stretched sheet, from its centre.
    cells: number of elements along each side of the sheet.

    Raises NoEquilibriumError if the iteration does not converge. Raises ValueError if the position
    is outside the sheet, or if the depths are negative or not ascending.
    """
    depths = np.asarray(depths_m, dtype=np.float64)
    if (
        depths.ndim != 1
        or not np.isfinite(depths).all()
        or (np.diff(depths, prepend=0.0) < 0).any()
    ):
        raise ValueError(f"the depths {depths} m must be at least 0 and ascending")
    if not stretch_ratio > 0.0 or not finger_radius_m > 0.0:
        raise ValueError(
            f"the stretch ratio {stretch_ratio} and the finger radius {finger_radius_m} m must be "
            "above 0"
        )
    focus = np.array(
        [
            position_m[0] / stretch_ratio + 0.5 * rubber.width_m,
            position_m[1] + 0.5 * rubber.height_m,
        ]
    )
    if not (0.0 < focus[0] < rubber.width_m and 0.0 < focus[1] < rubber.height_m):
        raise ValueError(
            f"the position {position_m} m is not on the sheet; give a position between the edges"
        )
    grid = _Grid(rubber, focus, MIN_CELL_RADII * finger_radius_m, cells)
    flat = (grid.rest - grid.centre) * [stretch_ratio, 1.0]
    state = _solve_equilibrium(grid, np.pad(flat, ((0, 0), (0, 1))), None)
    foot: Floats = np.array([*position_m, 0.0], dtype=np.float64)
    sticking = np.zeros(len(state), dtype=bool)
    depth = 0.0
    rows: list[tuple[float, float, Floats]] = []
    for target in depths:
        steps = max(1, int(np.ceil((target - depth) / (STEP_RADII * finger_radius_m))))
        advance = float(target - depth) / steps
        for _ in range(steps if target > depth else 0):
            state = _predict_state(grid, state, foot, sticking, (depth, advance))
            depth += advance
            centre = foot.copy()
            centre[2] = finger_radius_m - depth
            finger = _FingerContact(centre, finger_radius_m, grid.penalty, sticking)
            state = _solve_equilibrium(grid, state, finger)
            sticking = sticking | finger.touched(state)
        inner = grid.gradient(state).reshape(-1, 3)
        force = -inner[sticking, 2].sum()
        left, right = inner[grid.left, 0].sum(), inner[grid.right, 0].sum()
        rows.append((float(force), float(0.5 * (right - left)), state))
    return PushPath(
        depths_m=depths,
        forces_n=np.array([row[0] for row in rows]),
        edge_forces_n=np.array([row[1] for row in rows]),
        positions=np.array([row[2] for row in rows]).reshape(len(rows), *grid.shape, 3),
        rest_m=(grid.rest - grid.centre).reshape(*grid.shape, 2),
    )


def grade_coordinates(length_m: float, focus_m: float, finest_m: float, cells: int) -> Floats:
    """Return node coordinates (cells + 1,) from 0 to length_m, which are densest at the focus.

    finest_m: size of the cells at the focus. On each side, distances from the focus are
        proportional to sinh(k u), with uniformly spaced values u from 0 to 1.
    """
    left_cells = int(np.clip(round(cells * focus_m / length_m), cells // 4, cells - cells // 4))

    def side(extent: float, count: int) -> Floats:
        even = np.linspace(0.0, 1.0, count + 1)
        if extent <= finest_m * count:
            return extent * even
        low, high = 1e-6, 30.0
        for _ in range(60):
            k = 0.5 * (low + high)
            first = extent * np.sinh(k / count) / np.sinh(k)
            low, high = (k, high) if first > finest_m else (low, k)
        result: Floats = extent * np.sinh(high * even) / np.sinh(high)
        return result

    left, right = side(focus_m, left_cells), side(length_m - focus_m, cells - left_cells)
    return np.concatenate([focus_m - left[::-1], focus_m + right[1:]])


class _Grid:
    """A finite-element mesh of the sheet, with the sparsity pattern of its stiffness matrix."""

    def __init__(self, rubber: Rubber, focus: Floats, finest_m: float, cells: int) -> None:
        x = grade_coordinates(rubber.width_m, float(focus[0]), finest_m, cells)
        y = grade_coordinates(rubber.height_m, float(focus[1]), finest_m, cells)
        rows, columns = len(y), len(x)
        self.shape = (rows, columns)
        self.rest = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        self.centre = 0.5 * np.array([rubber.width_m, rubber.height_m])
        self.c1 = rubber.young_modulus_pa / 6.0 * (1.0 - rubber.mooney_ratio)
        self.c2 = rubber.young_modulus_pa / 6.0 * rubber.mooney_ratio
        self.force_scale = rubber.young_modulus_pa * rubber.thickness_m * rubber.width_m

        number = np.arange(rows * columns).reshape(rows, columns)
        corners = [number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]]
        self.cells = np.stack([each.ravel() for each in corners], axis=1)
        width, height = (each.ravel() for each in np.meshgrid(np.diff(x), np.diff(y)))
        u, v = (each.ravel() for each in np.meshgrid(*[[0.5 - GAUSS, 0.5 + GAUSS]] * 2))
        by_u = np.stack([v - 1.0, 1.0 - v, v, -v], axis=1)
        by_v = np.stack([u - 1.0, -u, u, 1.0 - u], axis=1)
        # (4 cells, 4 nodes, 2) at four points per cell; F = sum over nodes of position x gradient.
        self.shape_gradients = np.stack(
            [by_u / width[:, None, None], by_v / height[:, None, None]], axis=-1
        ).reshape(-1, 4, 2)
        area = width * height
        self.volume = np.repeat(0.25 * area * rubber.thickness_m, 4)
        node_area = np.bincount(self.cells.ravel(), np.repeat(0.25 * area, 4), len(self.rest))
        pressure = rubber.young_modulus_pa * rubber.thickness_m / rubber.width_m**2
        self.penalty = np.asarray(PENALTY_PER_MODULUS * pressure * node_area, dtype=np.float64)
        self.left, self.right = number[:, 0], number[:, -1]
        clamped = np.zeros(len(self.rest), dtype=bool)
        clamped[self.left] = clamped[self.right] = True
        self.clamped = clamped
        coordinates = (3 * self.cells[:, :, None] + np.arange(3)).reshape(-1, 12)
        self._coordinates = coordinates
        size = 3 * len(self.rest)
        keys = np.repeat(coordinates, 12, axis=1) + size * np.tile(coordinates, (1, 12))
        self._keys, self._slots = np.unique(keys.ravel(), return_inverse=True)
        self._rows, self._columns = self._keys % size, self._keys // size
        self._size = size
        self._diagonal = np.searchsorted(self._keys, np.arange(size) * (size + 1))

    def strain(self, positions: Floats) -> tuple[Floats, Floats]:
        """Return the tensors F (points, 3, 2) and C (points, 2, 2) at four integration points per
        cell.

        F is the deformation gradient, and C = F'F is the Cauchy-Green tensor.
        """
        at_corners = np.repeat(positions[self.cells].transpose(0, 2, 1), 4, axis=0)
        deformed = at_corners @ self.shape_gradients
        return deformed, deformed.transpose(0, 2, 1) @ deformed

    def energy(self, positions: Floats) -> float:
        _, c = self.strain(positions)
        large, small, _ = principal(c)
        return float(self.volume @ relaxed_energy(large, small, self.c1, self.c2)[0])

    def gradient(self, positions: Floats) -> Floats:
        """Return the gradient (3 n,) of the elastic energy: internal forces, N, at n nodes."""
        deformed, c = self.strain(positions)
        stress, _ = stress_and_tangent(c, self.c1, self.c2, tangent=False)
        volume = self.volume[:, None, None]
        local = volume * self.shape_gradients @ stress @ deformed.transpose(0, 2, 1)
        return self._assemble(local)

    def _assemble(self, local: Floats) -> Floats:
        """Assemble the nodal forces (3 n,), N, from forces (points, 4, 3) of integration points."""
        by_cell = local.reshape(-1, 4, 12).sum(axis=1)
        sums = np.bincount(self._coordinates.ravel(), by_cell.ravel(), minlength=self._size)
        return np.asarray(sums, dtype=np.float64)

    def _scatter(self, blocks: Floats) -> Floats:
        """Assemble the stiffness matrix's entries from the stiffnesses of integration points."""
        by_cell = blocks.reshape(-1, 4, 144).sum(axis=1)
        sums = np.bincount(self._slots, by_cell.ravel(), minlength=len(self._keys))
        return np.asarray(sums, dtype=np.float64)

    def system(
        self, positions: Floats, added: Floats, free: Bools, damping: float
    ) -> tuple[Floats, scipy.sparse.csc_array]:
        """Return the energy gradient (3 n,), N, and the sparse stiffness matrix, N/m, of n nodes.

        added (n, 3, 3): stiffness of the contact, N/m.
        free (3 n,): whether each coordinate of the nodes is free to move. Only free coordinates are
            in the matrix.
        damping: value (N/m) that is added to the diagonal.
        """
        deformed, c = self.strain(positions)
        stress, tangent = stress_and_tangent(c, self.c1, self.c2, tangent=True)
        volume, hats = self.volume[:, None, None], self.shape_gradients
        local = volume * hats @ stress @ deformed.transpose(0, 2, 1)
        count = len(local)
        # Derivative of the strain E = (C - I)/2, as [E11, E22, 2 E12], by the nodes' coordinates.
        by_node = np.empty((count, 3, 4, 3))
        by_node[:, 0] = hats[:, :, :1] * deformed[:, None, :, 0]
        by_node[:, 1] = hats[:, :, 1:] * deformed[:, None, :, 1]
        by_node[:, 2] = (
            hats[:, :, 1:] * deformed[:, None, :, 0] + hats[:, :, :1] * deformed[:, None, :, 1]
        )
        b = by_node.reshape(count, 3, 12)
        blocks = (b.transpose(0, 2, 1) @ (volume * tangent @ b)).reshape(count, 4, 3, 4, 3)
        geometric = volume * hats @ stress @ hats.transpose(0, 2, 1)
        for axis in range(3):
            blocks[:, :, axis, :, axis] += geometric
        values = self._scatter(blocks)
        values[self._diagonal] += damping
        for node in np.flatnonzero(added.any(axis=(1, 2))):
            at = 3 * node + np.arange(3)
            values[np.searchsorted(self._keys, at[:, None] + self._size * at)] += added[node]
        keep = free[self._rows] & free[self._columns]
        number = np.cumsum(free) - 1
        matrix = scipy.sparse.csc_array(
            (values[keep], (number[self._rows[keep]], number[self._columns[keep]])),
            shape=(int(free.sum()),) * 2,
        )
        return self._assemble(local), matrix


def principal(c: Floats) -> tuple[Floats, Floats, Floats]:
    """Return the larger eigenvalues (n,), the smaller eigenvalues (n,) and directions (n, 2).

    c (n, 2, 2): symmetric tensors.

    The directions are the unit eigenvectors of the larger eigenvalues.
    """
    middle, half = 0.5 * (c[:, 0, 0] + c[:, 1, 1]), 0.5 * (c[:, 0, 0] - c[:, 1, 1])
    spread = np.hypot(half, c[:, 0, 1])
    angle = 0.5 * np.arctan2(c[:, 0, 1], half)
    return middle + spread, middle - spread, np.column_stack([np.cos(angle), np.sin(angle)])


def relaxed_energy(
    large: Floats, small: Floats, c1: float, c2: float
) -> tuple[Floats, Floats, Floats]:
    """Return the energy W per rest volume according to tension field theory, and its derivatives.

    large, small (n,): squared principal stretches p and q, with p >= q.
    c1, c2: material constants, Pa.

    The results are W (n,), its first derivatives [W_p, W_q] (2, n) and its second derivatives
    [W_pp, W_qq, W_pq] (3, n).
    """
    p = np.maximum(large, 1.0)
    taut = small > p**-0.5
    q = np.where(taut, small, p**-0.5)
    p_full = np.where(taut, large, p)
    pq = p_full * q
    energy = c1 * (p_full + q + 1.0 / pq - 3.0) + c2 * (1.0 / p_full + 1.0 / q + pq - 3.0)
    first = np.stack(
        [
            c1 * (1.0 - 1.0 / (p_full * pq)) + c2 * (q - p_full**-2),
            c1 * (1.0 - 1.0 / (q * pq)) + c2 * (p_full - q**-2),
        ]
    )
    second = np.stack(
        [
            2.0 * c1 / (p_full**2 * pq) + 2.0 * c2 * p_full**-3,
            2.0 * c1 / (q**2 * pq) + 2.0 * c2 * q**-3,
            c1 / pq**2 + c2,
        ]
    )
    # Under uniaxial tension only the stiffness along the tension remains.
    loose = ~taut
    first[1, loose] = 0.0
    along = second[0, loose] - second[2, loose] ** 2 / second[1, loose]
    second[0, loose] = np.where(large[loose] > 1.0, along, 0.0)
    second[1:, loose] = 0.0
    return energy, first, second


def stress_and_tangent(c: Floats, c1: float, c2: float, *, tangent: bool) -> tuple[Floats, Floats]:
    """Return the second Piola-Kirchhoff stress (n, 2, 2), Pa, and its tangent (n, 3, 3), Pa.

    c (n, 2, 2): Cauchy-Green tensors.
    c1, c2: material constants, Pa.
    tangent: whether the tangent is computed. If false, an empty array is returned instead.

    The rows and columns of the tangent belong to the strains [E11, E22, 2 E12].
    """
    large, small, direction = principal(c)
    _, first, second = relaxed_energy(large, small, c1, c2)
    cos, sin = direction.T
    along = np.stack([cos * cos, sin * sin, cos * sin])
    across = np.stack([sin * sin, cos * cos, -cos * sin])
    flat = 2.0 * (first[0] * along + first[1] * across)
    stress = np.stack([np.stack([flat[0], flat[2]], -1), np.stack([flat[2], flat[1]], -1)], -1)
    if not tangent:
        return stress, np.empty((0, 3, 3))
    gap = large - small
    apart = gap > 1e-9
    turning = np.where(
        apart, (first[0] - first[1]) / np.where(apart, gap, 1.0), second[0] - second[2]
    )
    shear = np.stack([-2.0 * cos * sin, 2.0 * cos * sin, cos * cos - sin * sin])
    result = 4.0 * (
        np.einsum("n,in,jn->nij", second[0], along, along)
        + np.einsum("n,in,jn->nij", second[1], across, across)
        + np.einsum("n,in,jn->nij", second[2], along, across)
        + np.einsum("n,in,jn->nij", second[2], across, along)
    ) + 2.0 * np.einsum("n,in,jn->nij", turning, shear, shear)
    return stress, result


class _FingerContact:
    """A penalty model of the contact between the fingertip and nodes that do not stick to it."""

    def __init__(self, centre: Floats, radius_m: float, penalty: Floats, sticking: Bools) -> None:
        self.centre, self.radius, self.sticking = centre, radius_m, sticking
        self._penalty = np.where(sticking, 0.0, penalty)

    def _penetration(self, positions: Floats) -> tuple[Floats, Floats]:
        offset = positions - self.centre
        distance = np.maximum(np.linalg.norm(offset, axis=1), 1e-12)
        return np.maximum(self.radius - distance, 0.0), offset / distance[:, None]

    def touched(self, positions: Floats) -> Bools:
        touched: Bools = self._penetration(positions)[0] > 0.0
        return touched

    def energy(self, positions: Floats) -> float:
        return 0.5 * float(self._penalty @ self._penetration(positions)[0] ** 2)

    def gradient(self, positions: Floats) -> tuple[Floats, Floats]:
        """Return the energy's gradient (n, 3), N, and a semidefinite Hessian (n, 3, 3), N/m."""
        inside, outward = self._penetration(positions)
        stiff = np.where(inside > 0.0, self._penalty, 0.0)
        return -(stiff * inside)[:, None] * outward, np.einsum(
            "n,ni,nj->nij", stiff, outward, outward
        )


def _predict_state(
    grid: _Grid, state: Floats, foot: Floats, sticking: Bools, push: tuple[float, float]
) -> Floats:
    """Predict the equilibrium at the next push depth, as the initial guess of the solver.

    The current deflection is scaled with the depth. If the depth is 0, the prediction is a cone.

    push: current depth and its increase in this step (m).
    """
    depth, advance = push
    grown = state.copy()
    if depth > 0.0:
        grown[:, 2] *= (depth + advance) / depth
    else:
        away = np.hypot(state[:, 0] - foot[0], state[:, 1] - foot[1])
        grown[:, 2] = -advance * np.maximum(1.0 - away / np.abs(grid.centre).max(), 0.0)
        grown[grid.clamped, 2] = 0.0
    grown[sticking] = state[sticking] - [0.0, 0.0, advance]
    return grown


def _solve_equilibrium(grid: _Grid, start: Floats, finger: _FingerContact | None) -> Floats:
    """Compute the equilibrium, starting at `start`, with clamped and sticking nodes fixed.

    Raises NoEquilibriumError if the iteration does not converge.
    """
    fixed = grid.clamped if finger is None else grid.clamped | finger.sticking
    free = np.repeat(~fixed, 3)
    positions, damping = start, 1e-7
    stiffness_scale = grid.force_scale / grid.centre[0]
    added = np.zeros((len(start), 3, 3))

    def energy(at: Floats) -> float:
        return grid.energy(at) + (0.0 if finger is None else finger.energy(at))

    current, residual = energy(positions), np.inf
    for _ in range(MAX_ITERATIONS):
        push = np.zeros_like(start)
        if finger is not None:
            push, added = finger.gradient(positions)
        gradient, matrix = grid.system(positions, added, free, damping * stiffness_scale)
        downhill = -(gradient + push.ravel())[free]
        residual = float(np.linalg.norm(downhill))
        if residual < TOLERANCE * grid.force_scale:
            return positions
        solved = scipy.sparse.linalg.splu(
            matrix,
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        ).solve(downhill)
        slope = float(solved @ downhill)
        step = np.zeros_like(start)
        step.reshape(-1)[free] = solved
        fraction = min(1.0, 0.1 * grid.centre[0] / max(float(np.abs(step).max()), 1e-12))
        moved = False
        for _ in range(20 if slope > 0.0 else 0):
            trial = positions + fraction * step
            value = energy(trial)
            if value <= current - 1e-4 * fraction * slope + 1e-15 * abs(current):
                positions, current, moved = trial, value, True
                break
            fraction *= 0.5
        if not moved and damping > 1e3:
            break
        damping = damping * 30.0 if not moved else max(damping / 10.0, 1e-9)
    if residual < 100.0 * TOLERANCE * grid.force_scale:
        return positions
    raise NoEquilibriumError(
        f"the membrane has no equilibrium: the residual is {residual:.2e} N, but the "
        f"tolerance is {TOLERANCE * grid.force_scale:.2e} N; reduce the push depth"
    )
