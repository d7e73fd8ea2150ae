"""Compute the simulated sheet: a finite-element membrane that two clamps hold and a finger pushes.

The material is incompressible neo-Hookean rubber in plane stress. Its energy per volume is W = mu/2
(I1 - 3), where I1 is the first strain invariant and mu = E/3 is the shear modulus. A membrane has
no bending stiffness. Under compression, it would buckle into infinitely fine wrinkles. In wrinkled
regions, the energy of a tension field replaces W (Pipkin, IMA J. Appl. Math. 36, 1986). The stress
is uniaxial along the wrinkles, zero across them, and zero where the sheet is slack. This energy
is convex in the strain, so Newton's method with a line search finds its minimum.

The elements are biquadratic quadrilaterals (nine nodes, 3x3 Gauss points). The renderer uses other
elements, because this module is used to test the renderer. The mesh is finer around the finger.
Gravity acts on the sheet. The fingertip is a rigid sphere that is moved into the sheet along the
sheet's normal, in steps. A stiff penalty force keeps the sheet outside the sphere. Touched nodes
stick to the sphere unless the limit of Coulomb friction is exceeded.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from flexsheet.messages.errors import FlexsheetError
from flexsheet.nodes.arrays import Bools, Floats
from flexsheet.nodes.models.rigid import transform

Indices = NDArray[np.intp]

CELLS = 32
"""The number of intervals between nodes along each side of the sheet. An element spans two
intervals."""
MIN_CELL_FRACTION = 0.008
"""The distance between nodes under the finger, divided by the length of the sheet's side. If the
side is 240 mm long, the distance is 1.9 mm."""

SLACK_TENSION = 2e-4
"""The isotropic tension that is added everywhere, in units of the shear modulus. Without this
tension, the equilibrium of slack and wrinkled regions would not be unique."""

CONTACT_PA_PER_M = 1e10
"""The contact pressure per penetration depth, Pa/m. At this value, a force of 10 N on 1 cm2
penetrates by 0.01 mm."""

MAX_STEP_RADII = 0.7
"""The maximum advance of the finger per step, in finger radii. A longer step could cross the
sheet."""

MAX_ITERATIONS = 80

UNDAMPED_ROUNDS = 6
"""The interval, in equilibria of one finger step, at which the factor on the friction forces'
changes is halved. Without this damping, the changes could alternate."""

MAX_FRICTION_ROUNDS = 30
"""The maximum number of equilibria that are solved per finger step while nodes slip."""

FRICTION_TOLERANCE = 0.01
"""The maximum relative change of the friction forces between two accepted equilibria."""
GRAVITY_M_PER_S2 = np.array([0.0, -9.81, 0.0])
"""The gravitational acceleration in the world frame, whose y axis points up."""


class NotConvergedError(FlexsheetError, RuntimeError):
    """Raised if the iteration for the membrane's equilibrium does not converge."""

    remedy = "Reduce the depth of the push: the simulated membrane has no solution for it."


@dataclass(frozen=True, slots=True)
class TrueRubber:
    """The dimensions and material of the simulated sheet at rest.

    width_m: free length of the unstretched sheet between the clamps.
    height_m: length along the clamps.
    density_kg_per_m3: density of the rubber; 0 if the weight is neglected.
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
    """The equilibrium of the sheet.

    rest_m (rows, columns, 2): node positions at rest, measured from the bottom left corner, m.
    positions (rows, columns, 3): node positions in the world frame, m.
    finger_force_n (3,): force that the sheet exerts on the finger.
    left_force_n, right_force_n (3,): forces that the sheet exerts on the clamps.
    iterations: total number of Newton steps.
    """

    rest_m: Floats
    positions: Floats
    finger_force_n: Floats
    left_force_n: Floats
    right_force_n: Floats
    iterations: int

    def triangles(self) -> Indices:
        """Return triangles (n, 3) that face the user, as indices into the flattened nodes."""
        rows, columns = self.positions.shape[:2]
        corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
        right, above = corner + 1, corner + columns
        return np.concatenate(
            [
                np.column_stack([corner, right, above + 1]),
                np.column_stack([corner, above + 1, above]),
            ]
        )


def make_edge_plane(left: Floats, right: Floats) -> Floats:
    """Return the pose (4, 4) of the plane through both clamped edges of the sheet.

    left, right: poses (4, 4) of the edges. The origin of the plane is midway between the edges. Its
    x axis points to the right edge, and its z axis points towards the user.
    """
    across = right[:3, 3] - left[:3, 3]
    across = across / np.linalg.norm(across)
    normal = np.cross(across, left[:3, 1] + right[:3, 1])
    normal /= np.linalg.norm(normal)
    rotation = np.column_stack([across, np.cross(normal, across), normal])
    return transform(rotation, 0.5 * (left[:3, 3] + right[:3, 3]))


def graded_axis(length_m: float, cells: int, focus_m: float | None) -> Floats:
    """Return coordinates (cells + 1,), in m, from 0 to `length_m`, densest at `focus_m`.

    The coordinates are uniform if the focus is None.
    """
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
    """Return the values and derivatives (points, 3) of the quadratic shape functions on [0, 1].

    The nodes of the shape functions are at 0, 1/2 and 1.
    """
    values = [(1 - t) * (1 - 2 * t), 4 * t * (1 - t), t * (2 * t - 1)]
    slopes = [4 * t - 3, 4 - 8 * t, 4 * t - 1]
    return np.stack(values, axis=-1), np.stack(slopes, axis=-1)


class _Mesh:
    """A rectangular finite-element mesh that assembles the elastic forces and stiffness.

    x, y: coordinates of the nodes. Element boundaries have even indices. Nodes with odd indices are
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
        # Gauss points and nodes are ordered by y, then x: (3 x 3 points, 3 x 3 nodes).
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
        # The sparsity pattern of the stiffness matrix is the same in all iterations, so it is
        # computed once. Element entries are summed into it.
        size = len(self.free)
        keys = column[self._is_free].astype(np.int64) * size + row[self._is_free]
        unique, self._slot = np.unique(keys, return_inverse=True)
        self._row_of = unique % size
        self._start_of = np.searchsorted(unique // size, np.arange(size + 1))
        self._indices = indices
        self._unique, self._size = unique, size

    def deformation(self, positions: Floats) -> tuple[Floats, Floats]:
        """Return the deformation gradient F and the right Cauchy-Green tensor C = F^T F.

        positions: node positions (nodes, 3). The results at the Gauss points are F (elements,
        points, 3, 2) and [C11, C22, C12] (elements, points, 3).
        """
        at_nodes = positions[self.elements].transpose(0, 2, 1)[:, None]
        f = at_nodes @ self.gradient
        a, b = f[..., 0], f[..., 1]
        c = np.stack([(a * a).sum(-1), (b * b).sum(-1), (a * b).sum(-1)], axis=-1)
        return f, c

    def energy(self, positions: Floats) -> float:
        """Return the elastic energy minus the work of gravity, J, for node positions (nodes, 3)."""
        _, c = self.deformation(positions)
        elastic = np.sum(self.weight * relaxed_energy(c, self.shear_modulus, self.slack_tension))
        return float(elastic - np.sum(self.load_n * positions))

    def forces(self, positions: Floats) -> tuple[Floats, Floats]:
        """Return the gradient (nodes * 3,), N, of `energy`, and the stiffness of each element.

        The stiffness has the shape (elements, 27, 27) and the unit N/m.
        """
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

    def matrix(self, stiffness: Floats, contact: Floats) -> scipy.sparse.csc_array:
        """Return the sparse stiffness matrix of the nodes that are not clamped.

        contact (nodes, 3, 3): contact stiffness, N/m, added to the diagonal blocks.
        """
        free = stiffness.ravel()[self._is_free]
        values = np.bincount(self._slot, free, minlength=len(self._unique))
        for node in np.nonzero(contact.any(axis=(1, 2)))[0]:
            dofs = self._indices[3 * node : 3 * node + 3]
            if dofs[0] >= 0:
                keys = dofs[None, :] * self._size + dofs[:, None]
                values[np.searchsorted(self._unique, keys)] += contact[node]
        return scipy.sparse.csc_array(
            (values, self._row_of, self._start_of), shape=(self._size, self._size)
        )


def _eigen(c: Floats) -> tuple[Floats, Floats, Floats]:
    """Return the larger and the smaller eigenvalue (...,) of C, and a unit eigenvector (..., 2).

    C is a symmetric 2x2 matrix. The eigenvector belongs to the larger eigenvalue.

    c: components [C11, C22, C12] (..., 3) of C.
    """
    mean, half = 0.5 * (c[..., 0] + c[..., 1]), 0.5 * (c[..., 0] - c[..., 1])
    radius = np.hypot(half, c[..., 2])
    angle = 0.5 * np.arctan2(c[..., 2], half)
    return mean + radius, mean - radius, np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def relaxed_energy(c: Floats, shear_modulus: float, slack_tension: float = SLACK_TENSION) -> Floats:
    """Return the elastic energy (...,) per volume at rest, J/m3, of a membrane that wrinkles.

    c: components [C11, C22, C12] (..., 3) of the right Cauchy-Green tensor.
    shear_modulus: shear modulus of the rubber, Pa.
    """
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
    """Return the second Piola-Kirchhoff stress (..., 3) = [S11, S22, S12], Pa, and its tangent.

    The stress is the derivative of `relaxed_energy` with respect to the Green strain [E11, E22, 2
    E12]. The tangent (..., 3, 3), Pa, is the derivative of the stress.
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
    """A model of the fingertip as a rigid sphere to which touched nodes stick.

    A penalty force acts on nodes inside the sphere.

    stuck (nodes,): whether each node sticks to the finger at its position in `anchor` (nodes, 3).
    friction_coefficient: Coulomb coefficient; None if touched nodes never slip.
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
        """Return whether each node sticks to the finger or penetrates it, as an array (nodes,)."""
        return self._stuck | (self._depth(positions)[0] > 0.0)

    def energy(self, positions: Floats) -> float:
        """Return the energy of the penalty forces minus the work of the friction forces, J."""
        depth, _ = self._depth(positions)
        away = np.sum((positions - self._anchor) ** 2, axis=1)
        penalty = 0.5 * np.sum(self._stiffness * np.where(self._stuck, away, depth**2))
        return float(penalty - np.sum(self._friction_n * (positions - self._anchor)))

    def forces(self, positions: Floats) -> tuple[Floats, Floats]:
        """Return the gradient (nodes, 3) of `energy`, N, and a stiffness (nodes, 3, 3), N/m.

        The effect of the sphere's curvature is omitted. Therefore the stiffness is never negative.
        """
        depth, outward = self._depth(positions)
        pressed = np.where(depth > 0.0, self._stiffness, 0.0)
        fixed = np.where(self._stuck, self._stiffness, 0.0)
        gradient = fixed[:, None] * (positions - self._anchor)
        gradient -= (pressed * depth)[:, None] * outward + self._friction_n
        derivative = pressed[:, None, None] * outward[:, :, None] * outward[:, None, :]
        return gradient, derivative + fixed[:, None, None] * np.eye(3)

    def release(self, positions: Floats, fraction: float) -> bool:
        """Let the nodes slip whose friction force exceeds the Coulomb limit.

        Returns whether forces changed. If so, a new equilibrium must be computed. The friction
        force of a slipping node becomes the friction coefficient times the normal force. The
        direction of the friction force does not change.

        fraction: applied fraction (0 to 1) of the change of the friction forces.
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
        wanted = np.where(moving[:, None], limit_n[:, None] * direction, 0.0)
        self._friction_n = before + fraction * (wanted - before)
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
) -> DeformedSheet:
    """Compute the equilibrium of the sheet between its edges, with or without a pushing fingertip.

    finger_tip: deepest point (3,), m, of the fingertip sphere. There is no contact if the point is
        None, in front of the sheet, or beside the sheet.

    The other arguments are the same as for `solve_path`. Raises NotConvergedError if the iteration
    does not converge, and ValueError if the edges coincide.
    """
    return solve_path(
        rubber,
        world_from_left_edge,
        world_from_right_edge,
        finger_tips=() if finger_tip is None else (finger_tip,),
        finger_radius_m=finger_radius_m,
        friction_coefficient=friction_coefficient,
        cells=cells,
    )[-1]


def solve_path(
    rubber: TrueRubber,
    world_from_left_edge: Floats,
    world_from_right_edge: Floats,
    *,
    finger_tips: Sequence[Floats],
    finger_radius_m: float = 0.007,
    friction_coefficient: float | None = None,
    cells: int = CELLS,
    slack_tension: float = SLACK_TENSION,
) -> list[DeformedSheet]:
    """Compute the equilibria of the sheet while a fingertip advances through the given positions.

    Returns the sheet at each position, or only the untouched sheet if there are no positions.

    world_from_left_edge, world_from_right_edge: poses (4, 4) of the clamped edges. The origin is
        the centre of the edge, and y points along the edge.
    finger_tips: positions (3,) on one normal of the sheet, sorted by depth.
    friction_coefficient: Coulomb coefficient between finger and sheet; None if touched nodes stick.
    cells: number of intervals between nodes along each side, an even number.
    slack_tension: tension that is added everywhere, in units of the shear modulus. A smaller value
        is more accurate for small pushes of a sheet with little tension, but the iteration for a
        slack sheet does not converge.

    Raises NotConvergedError if an iteration does not converge, and ValueError if the edges
    coincide.
    """
    left, right = world_from_left_edge, world_from_right_edge
    distance = float(np.linalg.norm(right[:3, 3] - left[:3, 3]))
    if distance < 1e-3:
        raise ValueError(
            f"the sheet's edges are {distance * 1e3:.2f} mm apart, but the simulated membrane "
            "needs at least 1 mm; move the arms apart"
        )
    x_axis, y_axis, normal, middle = make_edge_plane(left, right)[:3].T

    focus: tuple[float, float] | None = None
    tips = list(finger_tips)
    if tips:
        offset = tips[-1] - middle
        across, along_edge = float(offset @ x_axis / distance), float(offset @ y_axis)
        over = abs(across) < 0.5 and abs(along_edge) < 0.5 * rubber.height_m
        if over and offset @ normal < 0.0:
            focus = (across + 0.5) * rubber.width_m, along_edge + 0.5 * rubber.height_m
    focus_x_m, focus_y_m = focus or (None, None)
    mesh = _Mesh(
        rubber,
        _insert_midpoints(graded_axis(rubber.width_m, cells // 2, focus_x_m)),
        _insert_midpoints(graded_axis(rubber.height_m, cells // 2, focus_y_m)),
        slack_tension,
    )
    fraction = mesh.rest[..., 0, None] / rubber.width_m
    along = mesh.rest[..., 1, None] - 0.5 * rubber.height_m
    flat = (1 - fraction) * (left[:3, 3] + along * left[:3, 1]) + fraction * (
        right[:3, 3] + along * right[:3, 1]
    )
    positions, iterations = _relax(mesh, flat.reshape(-1, 3), None)

    if focus is None:
        return [_describe(mesh, positions, None, iterations)] * max(len(tips), 1)
    carried = _cone(mesh, focus, rubber)
    stuck = np.zeros(len(positions), bool)
    finger: _Finger | None = None
    solved = []
    before_m = 0.0
    for tip in tips:
        depth = float((middle - tip) @ normal)
        steps = int(np.ceil((depth - before_m) / (MAX_STEP_RADII * finger_radius_m)))
        advance = -((depth - before_m) / max(steps, 1)) * normal
        for step in range(1, steps + 1):
            centre = tip + finger_radius_m * normal - (steps - step) * advance
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
            while finger.release(positions, 0.5 ** (rounds // UNDAMPED_ROUNDS)):
                rounds += 1
                if rounds > MAX_FRICTION_ROUNDS:
                    raise NotConvergedError(
                        "the friction forces on the simulated membrane have not converged after "
                        f"{rounds} iterations (friction coefficient {friction_coefficient})"
                    )
                positions, count = _relax(mesh, positions, finger)
                iterations += count
            stuck = finger.touching(positions)
        before_m = max(depth, before_m)
        solved.append(_describe(mesh, positions, finger, iterations))
    return solved


def _describe(
    mesh: _Mesh, positions: Floats, finger: _Finger | None, iterations: int
) -> DeformedSheet:
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
    """Return boundaries (n,) and the midpoints between them in ascending order (2 n - 1,)."""
    nodes = np.empty(2 * len(boundaries) - 1)
    nodes[::2] = boundaries
    nodes[1::2] = 0.5 * (boundaries[1:] + boundaries[:-1])
    return nodes


def _cone(mesh: _Mesh, focus_m: tuple[float, float], rubber: TrueRubber) -> Floats:
    """Return the initial guess of the displacement when a finger pushes a sheet.

    The result (nodes,) is the displacement of each node as a fraction of the finger's displacement.
    It is 1 at the pushed point `focus_m` and decreases linearly to 0 near the clamps.
    """
    x, y = mesh.rest[..., 0].ravel(), mesh.rest[..., 1].ravel()
    focus_x, focus_y = focus_m
    reach = np.where(x < focus_x, focus_x, rubber.width_m - focus_x)
    radius = np.hypot((x - focus_x) / np.maximum(reach, 1e-6), (y - focus_y) / np.max(reach))
    cone: Floats = np.clip(1.0 - radius, 0.0, 1.0)
    return cone


def _relax(mesh: _Mesh, start: Floats, finger: _Finger | None) -> tuple[Floats, int]:
    """Minimise the energy of the sheet by Newton's method with a line search.

    Returns the node positions (nodes, 3), m, and the number of steps. Raises NotConvergedError if
    the residual force exceeds the tolerance.
    """
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
        factor = scipy.sparse.linalg.splu(
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
        f"the residual force {residual:.2e} N of the simulated membrane after {iteration} Newton "
        f"steps exceeds the tolerance {1e-7 * scale:.2e} N"
    )
