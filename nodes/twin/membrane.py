"""Solve the true sheet: a finite-element membrane, clamped at two edges and pushed by a finger.

The material is incompressible neo-Hookean rubber in plane stress, W = mu/2 (I1 - 3) with mu = E/3.
A membrane has no bending stiffness and would buckle into ever finer wrinkles. Where the taut law
would give compression, the energy is therefore that of a tension field (Pipkin, IMA J. Appl. Math.
36, 1986): uniaxial along the wrinkles, free across them, and zero where the sheet is slack. The
relaxed energy is convex in the strain, so that Newton's method with a line search finds its
minimum.

The elements are biquadratic quadrilaterals (nine nodes, 3x3 Gauss points), another kind than the
renderer's; the mesh is finer around the finger. The sheet has a weight. The fingertip is a rigid
sphere that is pushed in along the sheet's normal, in steps. Stiff penalties keep the sheet out of
it. Nodes that it has touched stick to it, unless Coulomb's limit of friction is exceeded.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array
from scipy.sparse.linalg import splu

from flexsheet.messages.errors import FlexsheetError

Floats = NDArray[np.float64]
Indices = NDArray[np.intp]
Bools = NDArray[np.bool_]

CELLS = 32
"""Intervals between nodes along either side; an element spans two of them."""
MIN_CELL_FRACTION = 0.008
"""Distance of nodes under the finger over the sheet's side: 1.9 mm of 240."""

SLACK_TENSION = 2e-4
"""Isotropic tension, in shear moduli, that makes slack and wrinkled regions determinate."""

CONTACT_PA_PER_M = 1e10
"""Pressure of the finger per depth of penetration: 0.01 mm under 10 N on 1 cm2."""

MAX_STEP_RADII = 0.7
"""Maximum advance of the finger per step, in its radii; a longer one could pass the sheet."""

MAX_ITERATIONS = 80
MAX_FRICTION_ROUNDS = 12
"""Maximum number of equilibria per step of the finger while nodes begin to slip."""
FRICTION_TOLERANCE = 0.01
"""Accepted change of the friction of slipping nodes between two equilibria, as a fraction."""
GRAVITY_M_PER_S2 = np.array([0.0, -9.81, 0.0])
"""Acceleration in the world frame, whose y axis points up."""


class NotConvergedError(FlexsheetError, RuntimeError):
    """Raised when the membrane's equilibrium is not found; the message gives the residual."""

    code = "membrane"
    remedy = "Reduce the push: it is beyond the simulated membrane's range."


@dataclass(frozen=True, slots=True)
class TrueRubber:
    """Dimensions and material of the true sheet at rest.

    width_m: between the clamps when slack; height_m: along them.
    density_kg_per_m3: 0 for a sheet without weight.
    thickness_gradient: relative change of the thickness from the left to the right clamp, and from
        the lower to the upper end of the clamps.
    """

    width_m: float
    height_m: float
    thickness_m: float
    young_modulus_pa: float
    density_kg_per_m3: float = 0.0
    thickness_gradient: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True, slots=True)
class DeformedSheet:
    """Equilibrium of the sheet.

    rest_m: (rows, columns, 2) from the left bottom corner.
    positions: (rows, columns, 3) world.
    finger_force_n: (3,) of the sheet on the finger.
    left_force_n, right_force_n: (3,) of the sheet on the clamps.
    iterations: total number of Newton steps.
    """

    rest_m: Floats
    positions: Floats
    finger_force_n: Floats
    left_force_n: Floats
    right_force_n: Floats
    iterations: int

    def triangles(self) -> Indices:
        """Return (triangles, 3) indices of the flattened positions, facing the user."""
        rows, columns = self.positions.shape[:2]
        corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
        right, above = corner + 1, corner + columns
        return np.concatenate(
            [
                np.column_stack([corner, right, above + 1]),
                np.column_stack([corner, above + 1, above]),
            ]
        )


def graded_axis(length_m: float, cells: int, focus_m: float | None) -> Floats:
    """Return (cells + 1,) coordinates up to `length_m`, finest at `focus_m`; None: uniform."""
    if focus_m is None:
        return np.linspace(0.0, length_m, cells + 1)
    samples = np.linspace(0.0, length_m, 4001)
    away = np.abs(samples - np.clip(focus_m, 0.0, length_m)) / length_m

    def counted(growth: float) -> Floats:
        density = 1.0 / (length_m * (2.0 * MIN_CELL_FRACTION + growth * away))
        steps = 0.5 * (density[1:] + density[:-1]) * np.diff(samples)
        return np.concatenate([[0.0], np.cumsum(steps)])

    low, high = 0.0, 2.0
    for _ in range(50):
        growth = 0.5 * (low + high)
        low, high = (growth, high) if counted(growth)[-1] > cells else (low, growth)
    count = counted(high)
    return np.interp(np.linspace(0.0, count[-1], cells + 1), count, samples)


def _quadratic(t: Floats) -> tuple[Floats, Floats]:
    """Return the shape functions (points, 3) of nodes at 0, 1/2 and 1, and their derivatives."""
    values = [(1 - t) * (1 - 2 * t), 4 * t * (1 - t), t * (2 * t - 1)]
    slopes = [4 * t - 3, 4 - 8 * t, 4 * t - 1]
    return np.stack(values, axis=-1), np.stack(slopes, axis=-1)


class _Mesh:
    """Assemble forces and stiffness of a rectangular mesh.

    x, y: coordinates of the nodes; element boundaries are at the even ones, and the odd ones are
    midway between their neighbours.
    """

    def __init__(self, rubber: TrueRubber, x: Floats, y: Floats, slack_tension: float) -> None:
        self.slack_tension = slack_tension
        columns, rows = len(x), len(y)
        self.shape = (rows, columns)
        self.shear_modulus = rubber.young_modulus_pa / 3.0
        number = np.arange(rows * columns).reshape(rows, columns)
        windows = np.lib.stride_tricks.sliding_window_view(number, (3, 3))[::2, ::2]
        self.elements = windows.reshape(-1, 9)
        sides = np.meshgrid(np.diff(x[::2]), np.diff(y[::2]))
        width, height = (each.ravel() for each in sides)
        points = 0.5 + 0.5 * np.array([-1.0, 0.0, 1.0]) * np.sqrt(0.6)
        weights = np.array([5.0, 8.0, 5.0]) / 18.0
        value, slope = _quadratic(points)
        # Points and nodes are ordered along y first: (3 x 3 points, 3 x 3 nodes).
        shape_function = np.einsum("ab,cd->acbd", value, value).reshape(9, 9)
        along_x = np.einsum("ab,cd->acbd", value, slope).reshape(9, 9)
        along_y = np.einsum("ab,cd->acbd", slope, value).reshape(9, 9)
        # (elements, Gauss points, nodes, 2): gradient of each shape function in the rest plane.
        self.gradient = np.stack(
            [along_x / width[:, None, None], along_y / height[:, None, None]], axis=-1
        )
        x_grid, y_grid = np.meshgrid(x, y)
        self.rest = np.stack([x_grid, y_grid], axis=-1)
        at_points = shape_function @ self.rest.reshape(-1, 2)[self.elements]
        fraction = at_points / [rubber.width_m, rubber.height_m] - 0.5
        thickness = rubber.thickness_m * (1.0 + fraction @ np.array(rubber.thickness_gradient))
        area = (width * height)[:, None] * np.outer(weights, weights).ravel()
        self.weight = area * thickness
        mass = rubber.density_kg_per_m3 * (self.weight @ shape_function)
        self.load_n = np.zeros((rows * columns, 3))
        np.add.at(self.load_n, self.elements, mass[..., None] * GRAVITY_M_PER_S2)
        self.node_area = np.zeros(rows * columns)
        np.add.at(self.node_area, self.elements, area @ shape_function)
        clamped = np.zeros(self.shape, bool)
        clamped[:, [0, -1]] = True
        self.free = np.nonzero(np.repeat(~clamped.ravel(), 3))[0]
        indices = np.full(rows * columns * 3, -1)
        indices[self.free] = np.arange(len(self.free))
        self.dofs = (3 * self.elements[:, :, None] + np.arange(3)).reshape(-1, 27)
        row = indices[np.repeat(self.dofs, 27, axis=1)].ravel()
        column = indices[np.tile(self.dofs, (1, 27))].ravel()
        self._is_free = (row >= 0) & (column >= 0)
        # Entries are summed into a fixed sparsity pattern: found once, used in every iteration.
        size = len(self.free)
        keys = column[self._is_free].astype(np.int64) * size + row[self._is_free]
        unique, self._slot = np.unique(keys, return_inverse=True)
        self._row_of = unique % size
        self._start_of = np.searchsorted(unique // size, np.arange(size + 1))
        self._indices = indices
        self._unique, self._size = unique, size

    def deformation(self, positions: Floats) -> tuple[Floats, Floats]:
        """Return F (elements, points, 3, 2) and C (..., [C11, C22, C12]) at the Gauss points."""
        at_nodes = positions[self.elements].transpose(0, 2, 1)[:, None]
        f = at_nodes @ self.gradient
        a, b = f[..., 0], f[..., 1]
        c = np.stack([(a * a).sum(-1), (b * b).sum(-1), (a * b).sum(-1)], axis=-1)
        return f, c

    def energy(self, positions: Floats) -> float:
        """Return the elastic energy less the work of the weight, J."""
        _, c = self.deformation(positions)
        elastic = np.sum(self.weight * relaxed_energy(c, self.shear_modulus, self.slack_tension))
        return float(elastic - np.sum(self.load_n * positions))

    def forces(self, positions: Floats) -> tuple[Floats, Floats]:
        """Return the energy's gradient (nodes * 3,) and element stiffness (elements, 27, 27)."""
        f, c = self.deformation(positions)
        stress, tangent = relaxed_stress(c, self.shear_modulus, self.slack_tension)
        g, weight = self.gradient, self.weight
        b = np.empty((*f.shape[:2], 3, 9, 3))
        b[..., 0, :, :] = g[..., :, 0, None] * f[..., None, :, 0]
        b[..., 1, :, :] = g[..., :, 1, None] * f[..., None, :, 1]
        b[..., 2, :, :] = (
            g[..., :, 1, None] * f[..., None, :, 0] + g[..., :, 0, None] * f[..., None, :, 1]
        )
        elements, points = f.shape[:2]
        b = b.reshape(elements, points * 3, 27)
        weighted = (weight[..., None] * stress).reshape(elements, 1, points * 3)
        force = (weighted @ b)[:, 0]
        db = (weight[..., None, None] * tangent) @ b.reshape(elements, points, 3, 27)
        stiffness = b.transpose(0, 2, 1) @ db.reshape(elements, points * 3, 27)
        full = np.empty((elements, points, 2, 2))
        full[..., 0, 0], full[..., 1, 1] = stress[..., 0], stress[..., 1]
        full[..., 0, 1] = full[..., 1, 0] = stress[..., 2]
        geometric = np.sum(g @ (weight[..., None, None] * full) @ g.swapaxes(-1, -2), axis=1)
        blocks = stiffness.reshape(elements, 9, 3, 9, 3)
        for i in range(3):
            blocks[:, :, i, :, i] += geometric
        total = np.bincount(self.dofs.ravel(), force.ravel(), minlength=positions.size)
        return total - self.load_n.ravel(), blocks.reshape(elements, 27, 27)

    def matrix(self, stiffness: Floats, contact: Floats) -> csc_array:
        """Return the sparse free stiffness; contact: (nodes, 3, 3) diagonal blocks."""
        free = stiffness.ravel()[self._is_free]
        values = np.bincount(self._slot, free, minlength=len(self._unique))
        for node in np.nonzero(contact.any(axis=(1, 2)))[0]:
            dofs = self._indices[3 * node : 3 * node + 3]
            if dofs[0] >= 0:
                keys = dofs[None, :] * self._size + dofs[:, None]
                values[np.searchsorted(self._unique, keys)] += contact[node]
        return csc_array((values, self._row_of, self._start_of), shape=(self._size, self._size))


def _eigen(c: Floats) -> tuple[Floats, Floats, Floats]:
    """Return eigenvalues (...,) of C, larger first, and the first's unit vector (..., 2)."""
    mean, half = 0.5 * (c[..., 0] + c[..., 1]), 0.5 * (c[..., 0] - c[..., 1])
    radius = np.hypot(half, c[..., 2])
    angle = 0.5 * np.arctan2(c[..., 2], half)
    return mean + radius, mean - radius, np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def relaxed_energy(c: Floats, shear_modulus: float, slack_tension: float = SLACK_TENSION) -> Floats:
    """Return the energy per rest volume (...,) of C (..., 3) = [C11, C22, C12]."""
    large, small, _ = _eigen(c)
    stretched = np.maximum(large, 1.0)
    taut = small > stretched**-0.5
    determinant = np.where(taut, large * small, 1.0)
    full = large + small + 1.0 / determinant - 3.0
    uniaxial = stretched + 2.0 * stretched**-0.5 - 3.0
    slack = slack_tension * (c[..., 0] + c[..., 1])
    return 0.5 * shear_modulus * (np.where(taut, full, uniaxial) + slack)


def relaxed_stress(
    c: Floats, shear_modulus: float, slack_tension: float = SLACK_TENSION
) -> tuple[Floats, Floats]:
    """Return the second Piola-Kirchhoff stress (..., 3) = [S11, S22, S12] and its tangent (..., 3,
    3).

    Both are derivatives of `relaxed_energy`; the tangent is over the strain [E11, E22, 2 E12].
    """
    large, small, along = _eigen(c)
    taut = small > np.maximum(large, 1.0) ** -0.5
    stress, tangent = np.empty(c.shape), np.empty((*c.shape, 3))

    c11, c22, c12 = np.moveaxis(c[taut], -1, 0)
    determinant = c11 * c22 - c12 * c12
    inverse = np.stack([c22, c11, -c12], axis=-1) / determinant[:, None]
    i1, i2, i3 = np.moveaxis(inverse, -1, 0)
    stress[taut] = [1.0, 1.0, 0.0] - inverse / determinant[:, None]
    d = np.empty((len(i1), 3, 3))
    d[:, 0, 0], d[:, 1, 1] = 2.0 * i1 * i1, 2.0 * i2 * i2
    d[:, 0, 1] = d[:, 1, 0] = i3 * i3 + i1 * i2
    d[:, 0, 2] = d[:, 2, 0] = 2.0 * i1 * i3
    d[:, 1, 2] = d[:, 2, 1] = 2.0 * i2 * i3
    d[:, 2, 2] = 0.5 * (i1 * i2 + i3 * i3) + i3 * i3
    tangent[taut] = d * (2.0 / determinant)[:, None, None]

    loose = ~taut
    stretched, across = np.maximum(large[loose], 1.0), small[loose]
    n1, n2 = np.moveaxis(along[loose], -1, 0)
    parallel = np.stack([n1 * n1, n2 * n2, n1 * n2], axis=-1)
    turning = np.stack([-2.0 * n1 * n2, 2.0 * n1 * n2, n1 * n1 - n2 * n2], axis=-1)
    pull = 1.0 - stretched**-1.5
    pull_slope = np.where(large[loose] > 1.0, 1.5 * stretched**-2.5, 0.0)
    stress[loose] = pull[:, None] * parallel
    tangent[loose] = (2.0 * pull_slope)[:, None, None] * (
        parallel[:, :, None] * parallel[:, None, :]
    ) + (pull / np.maximum(stretched - across, 1e-9))[:, None, None] * (
        turning[:, :, None] * turning[:, None, :]
    )
    stress += [slack_tension, slack_tension, 0.0]
    return shear_modulus * stress, shear_modulus * tangent


class _Finger:
    """Rigid sphere that nodes cannot enter (penalty); touched nodes stick to it.

    stuck: (nodes,) nodes that stick, each at its position in `anchor` (nodes, 3).
    friction_coefficient: Coulomb's, or None for nodes that never slip.
    """

    def __init__(
        self,
        centre: Floats,
        radius_m: float,
        node_area: Floats,
        stuck: Bools,
        anchor: Floats,
        *,
        friction_coefficient: float | None,
    ) -> None:
        self._centre, self._radius = centre, radius_m
        self._stiffness = CONTACT_PA_PER_M * node_area
        self._stuck, self._anchor = stuck.copy(), anchor
        self._coefficient = friction_coefficient
        self._friction_n = np.zeros(anchor.shape)

    def _depth(self, positions: Floats) -> tuple[Floats, Floats]:
        offset = positions - self._centre
        distance = np.linalg.norm(offset, axis=1)
        outward = offset / np.maximum(distance, 1e-12)[:, None]
        return np.where(self._stuck, 0.0, np.maximum(self._radius - distance, 0.0)), outward

    def touching(self, positions: Floats) -> Bools:
        """Return which nodes (nodes,) stick or are pressed."""
        return self._stuck | (self._depth(positions)[0] > 0.0)

    def energy(self, positions: Floats) -> float:
        """Return the energy of the penalties less the work of the friction, J."""
        depth, _ = self._depth(positions)
        away = np.sum((positions - self._anchor) ** 2, axis=1)
        penalty = 0.5 * np.sum(self._stiffness * np.where(self._stuck, away, depth**2))
        return float(penalty - np.sum(self._friction_n * (positions - self._anchor)))

    def forces(self, positions: Floats) -> tuple[Floats, Floats]:
        """Return the gradient (nodes, 3), and the definite part of its derivative (nodes, 3, 3)."""
        depth, outward = self._depth(positions)
        pressed = np.where(depth > 0.0, self._stiffness, 0.0)
        fixed = np.where(self._stuck, self._stiffness, 0.0)
        gradient = fixed[:, None] * (positions - self._anchor)
        gradient -= (pressed * depth)[:, None] * outward + self._friction_n
        derivative = pressed[:, None, None] * outward[:, :, None] * outward[:, None, :]
        return gradient, derivative + fixed[:, None, None] * np.eye(3)

    def release(self, positions: Floats) -> bool:
        """Let nodes slip whose friction exceeds Coulomb's limit; return whether forces changed.

        A slipping node keeps the direction of its friction; the size follows its normal force.
        """
        if self._coefficient is None:
            return False
        before = self._friction_n.copy()
        depth, outward = self._depth(positions)
        on_node = -self.forces(positions)[0]
        normal_n = np.einsum("ni,ni->n", on_node, outward)
        tangential = on_node - normal_n[:, None] * outward
        size_n = np.linalg.norm(tangential, axis=1)
        limit_n = self._coefficient * np.maximum(normal_n, 0.0)
        slipping = self._friction_n.any(axis=1)
        begins = self._stuck & (size_n > limit_n)
        moving = (slipping & (depth > 0.0)) | begins
        direction = tangential / np.maximum(size_n, 1e-15)[:, None]
        self._friction_n = np.where(moving[:, None], limit_n[:, None] * direction, 0.0)
        self._stuck = self._stuck & ~begins
        change = np.linalg.norm(self._friction_n - before)
        return bool(begins.any() or change > FRICTION_TOLERANCE * np.linalg.norm(before))


def solve(
    rubber: TrueRubber,
    world_from_left_edge: Floats,
    world_from_right_edge: Floats,
    *,
    finger_tip: Floats | None = None,
    finger_radius_m: float = 0.007,
    friction_coefficient: float | None = None,
    cells: int = CELLS,
    slack_tension: float = SLACK_TENSION,
) -> DeformedSheet:
    """Solve the equilibrium of the sheet between its edges, pushed by a fingertip.

    world_from_..._edge: (4, 4), origin in the middle of the clamped edge, y along it.
    finger_tip: the point (3,) of the sphere that is farthest from the user; its centre is
    `finger_radius_m` towards the user. With None, or a tip before or beside the sheet, there is no
    contact.
    friction_coefficient: between finger and sheet; None if touched nodes stick whatever the force.
    cells: even number of intervals between nodes along either side.
    slack_tension: in shear moduli. A smaller one is more accurate for small pushes of a sheet that
    is barely taut, but the equilibrium of a slack sheet is then not found.

    Raises NotConvergedError if no equilibrium is found.
    """
    left, right = world_from_left_edge, world_from_right_edge
    x_axis = right[:3, 3] - left[:3, 3]
    distance = float(np.linalg.norm(x_axis))
    if distance < 1e-3:
        raise ValueError(f"the sheet's edges are {distance * 1e3:.2f} mm apart")
    x_axis = x_axis / distance
    normal = np.cross(x_axis, left[:3, 1] + right[:3, 1])
    normal /= np.linalg.norm(normal)
    y_axis = np.cross(normal, x_axis)
    middle = 0.5 * (left[:3, 3] + right[:3, 3])

    depth = 0.0
    focus: tuple[float | None, float | None] = (None, None)
    if finger_tip is not None:
        offset = finger_tip - middle
        across, along_edge = float(offset @ x_axis / distance), float(offset @ y_axis)
        over = abs(across) < 0.5 and abs(along_edge) < 0.5 * rubber.height_m
        depth = float(-offset @ normal) if over else 0.0
        if depth > 0.0:
            focus = (
                (across + 0.5) * rubber.width_m,
                along_edge + 0.5 * rubber.height_m,
            )
    mesh = _Mesh(
        rubber,
        _insert_midpoints(graded_axis(rubber.width_m, cells // 2, focus[0])),
        _insert_midpoints(graded_axis(rubber.height_m, cells // 2, focus[1])),
        slack_tension,
    )
    fraction = mesh.rest[..., 0, None] / rubber.width_m
    along = mesh.rest[..., 1, None] - 0.5 * rubber.height_m
    flat = (1 - fraction) * (left[:3, 3] + along * left[:3, 1]) + fraction * (
        right[:3, 3] + along * right[:3, 1]
    )
    positions, iterations = _relax(mesh, flat.reshape(-1, 3), None)

    finger = None
    if finger_tip is not None and depth > 0.0:
        steps = int(np.ceil(depth / (MAX_STEP_RADII * finger_radius_m)))
        advance = -(depth / steps) * normal
        carried = _cone(mesh, focus, rubber)
        stuck = np.zeros(len(positions), bool)
        for step in range(1, steps + 1):
            centre = finger_tip + finger_radius_m * normal - (steps - step) * advance
            positions = positions + np.where(stuck, 1.0, carried)[:, None] * advance
            finger = _Finger(
                centre,
                finger_radius_m,
                mesh.node_area,
                stuck,
                positions,
                friction_coefficient=friction_coefficient,
            )
            positions, count = _relax(mesh, positions, finger)
            iterations += count
            rounds = 0
            while finger.release(positions):
                rounds += 1
                if rounds > MAX_FRICTION_ROUNDS:
                    raise NotConvergedError(
                        f"membrane: the friction changes after {rounds} equilibria; "
                        f"friction coefficient {friction_coefficient}"
                    )
                positions, count = _relax(mesh, positions, finger)
                iterations += count
            stuck = finger.touching(positions)

    gradient, _ = mesh.forces(positions)
    at_nodes = gradient.reshape(*mesh.shape, 3)
    contact = np.zeros(3) if finger is None else -finger.forces(positions)[0].sum(axis=0)
    return DeformedSheet(
        rest_m=mesh.rest,
        positions=positions.reshape(*mesh.shape, 3),
        finger_force_n=-contact,
        left_force_n=-at_nodes[:, 0].sum(axis=0),
        right_force_n=-at_nodes[:, -1].sum(axis=0),
        iterations=iterations,
    )


def _insert_midpoints(boundaries: Floats) -> Floats:
    """Return node coordinates (2 n - 1,): element boundaries (n,) and the points midway."""
    nodes = np.empty(2 * len(boundaries) - 1)
    nodes[::2] = boundaries
    nodes[1::2] = 0.5 * (boundaries[1:] + boundaries[:-1])
    return nodes


def _cone(mesh: _Mesh, focus: tuple[float | None, float | None], rubber: TrueRubber) -> Floats:
    """Return (nodes,) 1 at the focus, decreasing to 0 at the distance of the clamps."""
    x, y = mesh.rest[..., 0].ravel(), mesh.rest[..., 1].ravel()
    focus_x, focus_y = focus
    assert focus_x is not None
    assert focus_y is not None
    reach = np.where(x < focus_x, focus_x, rubber.width_m - focus_x)
    radius = np.hypot((x - focus_x) / np.maximum(reach, 1e-6), (y - focus_y) / np.max(reach))
    cone: Floats = np.clip(1.0 - radius, 0.0, 1.0)
    return cone


def _relax(mesh: _Mesh, start: Floats, finger: _Finger | None) -> tuple[Floats, int]:
    """Solve by Newton's method with a line search on the energy; return positions and steps."""
    positions = start.copy()
    scale = mesh.shear_modulus * float(mesh.weight.sum()) / float(np.ptp(mesh.rest[..., 0]))

    def energy(at: Floats) -> float:
        return mesh.energy(at) + (0.0 if finger is None else finger.energy(at))

    current = energy(positions)
    residual = np.inf
    for iteration in range(1, MAX_ITERATIONS + 1):
        gradient, stiffness = mesh.forces(positions)
        contact = np.zeros((len(positions), 3, 3))
        if finger is not None:
            push, contact = finger.forces(positions)
            gradient = gradient + push.ravel()
        downhill = -gradient[mesh.free]
        residual = float(np.linalg.norm(downhill))
        if residual < 1e-7 * scale:
            return positions, iteration
        factor = splu(
            mesh.matrix(stiffness, contact),
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        )
        free_step = factor.solve(downhill)
        slope = float(free_step @ downhill)
        step = np.zeros(positions.shape)
        step.reshape(-1)[mesh.free] = free_step
        length = min(1.0, 0.02 / max(float(np.abs(step).max()), 1e-12))
        for _ in range(30):
            trial = positions + length * step
            value = energy(trial)
            if value <= current - 1e-4 * length * slope + 1e-14 * abs(current):
                break
            length *= 0.5
        else:
            break
        positions, current = trial, value
    if residual < 1e-5 * scale:
        return positions, iteration
    raise NotConvergedError(
        f"membrane: residual {residual:.2e} N after {iteration} steps, tolerance {1e-7 * scale:.2e}"
    )
