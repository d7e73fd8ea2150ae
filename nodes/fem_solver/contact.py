"""Solve the contact of a fingertip sphere with a linear soft body, without friction.

The skin is sampled at fixed contact points, finer than the mesh. At each point a penalty pressure
is proportional to the remaining penetration. The nodal forces f minimise the strictly convex energy

    1/2 f.C f + 1/2 sum_q d_q max(0, t_q - (W C f)_q)^2

C is the nodal compliance and W contains the shape functions at the contact points. t_q is the
penetration of the rigid finger at point q; d_q is the penalty stiffness times the area. The
solution is unique, independent of the path and Lipschitz continuous in the finger's position. A
semismooth Newton iteration (Qi & Sun 1993) finds it in a few small dense solves.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from flexsheet.nodes.fem_solver.closest_contact import ContactQuery
from flexsheet.nodes.fem_solver.mesh.solid import triangle_shape_functions
from flexsheet.nodes.models.shapes import Shape

Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]
Ints = NDArray[np.int64]

PENALTY_RATIO = 40.0
"""Penalty stiffness of the contact (Pa/m) in units of E / finger radius."""
POINT_SPACING_RATIO = 0.4
"""Maximum spacing of the contact points, in finger radii."""
FLANK_RATIO = 0.9
"""Beyond this fraction of its radius the sphere is extended by its tangent cone."""
FACING = (0.2, 0.6)
"""Cosines between skin normal and push direction between which the penetration's weight rises from
0 to 1."""
PAD_RATIO = 1.1
"""Half width of the contact patch at the end of the linear range, in finger radii."""
TANGENTIAL_COMPLIANCE_RATIO = 0.004
"""Tangential displacement of a sticking point under its own normal force, in finger radii."""
FULL_STEPS = 8
MAX_ITERATIONS = 40
CURVE_FRACTIONS = (0.05, 0.12, 0.22, 0.35, 0.5, 0.7, 1.0)
"""Depths of the force curve within the linear range, as fractions of that range."""


@dataclass(frozen=True, slots=True)
class SkinResponse:
    """Response of a linear body to unit forces on its skin, for a Young's modulus of 1 Pa.

    rest (s, 3): skin nodes, m, mesh frame. contact_nodes (m,): indices into the skin of the
    nodes that can be loaded. normals (m, 3): outward. faces (f, 6): six-node triangles, indices
    into `contact_nodes`. compliance (m, m): inward displacement of node i under 1 N inward on node
    j; symmetric. influence (m, 3 s) float32: displacement of the whole skin under 1 N inward on
    node j.
    """

    rest: Floats
    contact_nodes: Ints
    normals: Floats
    faces: Ints
    compliance: Floats
    influence: Floats32


@dataclass(frozen=True, slots=True)
class DragResponse:
    """Response of a linear body to unit tangential forces on its skin, for 1 Pa.

    tangents (m, 2, 3): two directions along the skin at each contact node. compliance (2m, 2m):
    displacement along direction i under 1 N along direction j. influence (2m, 3 s) float32:
    displacement of the whole skin.
    """

    tangents: Floats
    compliance: Floats
    influence: Floats32


@dataclass(frozen=True, slots=True)
class Response:
    """Response of a soft body to one finger position, mesh frame; see `messages.SoftBody`."""

    displacement: Floats32
    force_n: Floats
    stiffness_n_per_m: float
    force_curve: Floats
    push_depth_m: float
    in_range: bool


class SoftBodyMethod(Protocol):
    """Interface of every soft body method.

    name: as in the message. at_rest: displacement (n, 3) of the skin without contact, zero.
    """

    @property
    def name(self) -> str: ...

    @property
    def at_rest(self) -> Floats32: ...

    def stiffness_n_per_m(self, surface: Floats) -> float:
        """Return the stiffness (N/m) at the touchable skin nearest to a surface point (3,)."""
        ...

    def force_curve(self, surface: Floats) -> Floats:
        """Return the force curve at the touchable skin nearest to a surface point (3,).

        Rows (n, 2) are depth (m) and force (N). Both start at 0 and never decrease.
        """
        ...

    def respond(self, query: ContactQuery) -> Response:
        """Return the response of the skin to a contact."""
        ...


@dataclass(frozen=True, slots=True)
class NormalContact:
    """Solution of a frictionless contact.

    forces (k,): inward forces on the contact nodes `nodes` (k,), N. force_n (3,): total force on
    the finger. weights (q, k), normals (q, 3), pressed_n (q,): shape functions, normals and normal
    forces of the points in contact.
    """

    nodes: Ints
    forces: Floats
    force_n: Floats
    weights: Floats
    normals: Floats
    pressed_n: Floats


@dataclass(frozen=True, slots=True)
class Drag:
    """Tangential contact forces.

    forces (k, 2): along the tangents of the nodes `nodes` (k,), N. force_n (3,): total force on the
    finger.
    """

    nodes: Ints
    forces: Floats
    force_n: Floats


def saturate_depth(depth_m: float, linear_m: float, largest_m: float) -> float:
    """Return the depth limited smoothly (C1) to `largest_m`.

    Up to `linear_m` it equals `depth_m`; beyond, it approaches `largest_m` exponentially.
    """
    if depth_m <= linear_m:
        return depth_m
    span = largest_m - linear_m
    return linear_m + span * -float(np.expm1(-(depth_m - linear_m) / span))


def curve_depths(linear_m: float, largest_m: float, push_m: float | None) -> Floats:
    """Return the depths (m) of a force curve, dense up to `linear_m`, then geometric."""
    max_push_m = largest_m if push_m is None else max(push_m, largest_m)
    deeper = np.geomspace(
        linear_m, max_push_m, max(2, round(4 * np.log2(max_push_m / linear_m)) // 2 + 1)
    )
    return np.concatenate([[0.0], linear_m * np.array(CURVE_FRACTIONS), deeper[1:]])


def sample_triangle(divisions: int) -> tuple[Floats, Floats]:
    """Return shape functions (p, 6) and local coordinates (p, 2) of contact points in a triangle.

    The points are the centroids of divisions^2 equal parts of a six-node triangle.
    """
    upright = [(i + 1 / 3, j + 1 / 3) for i in range(divisions) for j in range(divisions - i)]
    inverted = [(i + 2 / 3, j + 2 / 3) for i in range(divisions) for j in range(divisions - i - 1)]
    local = np.array(upright + inverted) / divisions
    return triangle_shape_functions(local), local


class SphereContact:
    """Stateless solver of the contact between one body and one spherical fingertip."""

    def __init__(
        self,
        response: SkinResponse,
        shape: Shape,
        *,
        young_modulus_pa: float,
        finger_radius_m: float,
    ) -> None:
        """Sample the contact points of the skin.

        shape: the smooth surface that the response's triangles approximate, in the mesh frame.
        """
        self._response = response
        self._radius = finger_radius_m
        self._compliance = response.compliance / young_modulus_pa
        corners = response.rest[response.contact_nodes][response.faces]
        max_edge_m = float(np.linalg.norm(corners[:, 0] - corners[:, 1], axis=1).max())
        divisions = max(2, int(np.ceil(max_edge_m / (POINT_SPACING_RATIO * finger_radius_m))))
        self._shape, _ = sample_triangle(divisions)
        # Finger positions are relative to the smooth surface, so contact points are moved onto it.
        found = shape.closest((self._shape @ corners).reshape(-1, 3))
        self._points = found.point.reshape(len(corners), -1, 3)
        self._normals = found.normal.reshape(len(corners), -1, 3)
        sides = corners[:, 1:3] - corners[:, :1]
        areas = 0.5 * np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
        penalty = PENALTY_RATIO * young_modulus_pa / finger_radius_m
        self._penalty = penalty * areas / len(self._shape)
        self._centres = corners.mean(axis=1)
        self._size = np.linalg.norm(corners - self._centres[:, None], axis=2).max(axis=1)

    def penetration(
        self, points: Floats, normals: Floats, centre: Floats, direction: Floats
    ) -> Floats:
        """Return the penetration depth (q,), m, of points into the rigid finger.

        points, normals (q, 3): skin points and outward normals. centre (3,): of the sphere.
        direction (3,): outward surface normal at the contact; skin that faces another direction is
        excluded (`FACING`). Beyond `FLANK_RATIO` of the radius the tangent cone extends the sphere,
        so every point has a finite, C1 value. The value is negative outside the finger.
        """
        offset = centre - points
        along = np.einsum("qi,qi->q", offset, normals)
        across2 = np.einsum("qi,qi->q", offset, offset) - along * along
        across = np.sqrt(np.maximum(across2, 0.0))
        inner = np.minimum(across, FLANK_RATIO * self._radius)
        height = np.sqrt(self._radius**2 - inner * inner)
        facing = np.clip((normals @ direction - FACING[0]) / (FACING[1] - FACING[0]), 0.0, 1.0)
        depths = height - inner / height * (across - inner) - along
        result: Floats = depths * facing * facing * (3.0 - 2.0 * facing)
        return result

    def solve(self, query: ContactQuery, depth_m: float) -> NormalContact | None:
        """Return the contact at `depth_m` below `query.surface`; None without contact."""
        centre = query.surface + (self._radius - depth_m) * query.normal
        limit = FLANK_RATIO * self._radius
        widest = limit + max(depth_m, 0.0)
        squared = np.square(self._centres - query.surface).sum(axis=1)
        near = np.flatnonzero(squared < np.square(widest + self._size))
        if not len(near):
            return None
        count = len(self._shape)
        depths = self.penetration(
            self._points[near].reshape(-1, 3),
            self._normals[near].reshape(-1, 3),
            centre,
            query.normal,
        )
        reached = np.flatnonzero(depths > 0.0)
        if not len(reached):
            return None
        # Points outside the finger at rest are omitted: skin around a push moves inwards.
        face, point = near[reached // count], reached % count
        nodes, local = np.unique(self._response.faces[face], return_inverse=True)
        weights = np.zeros((len(reached), len(nodes)))
        weights[np.arange(len(reached))[:, None], local.reshape(-1, 6)] = self._shape[point]
        compliance, penalty = self._compliance[np.ix_(nodes, nodes)], self._penalty[face]
        forces = solve_penalty_contact(weights, compliance, penalty, depths[reached])
        remaining = depths[reached] - weights @ (compliance @ forces)
        pressed = remaining > 0.0
        return NormalContact(
            nodes=nodes,
            forces=forces,
            force_n=forces @ self._response.normals[nodes],
            weights=weights[pressed],
            normals=self._normals[face[pressed], point[pressed]],
            pressed_n=penalty[pressed] * remaining[pressed],
        )


class DragContact:
    """Tangential contact of a finger that sticks to the skin.

    Tangential springs connect the points in contact to the finger. Their stiffness is proportional
    to the normal force at the point, so that contact starts and ends continuously. Normal and
    tangential contact are not coupled.
    """

    def __init__(
        self, response: DragResponse, *, young_modulus_pa: float, finger_radius_m: float
    ) -> None:
        self._response = response
        self._compliance = response.compliance / young_modulus_pa
        self._full_load_slip_m = TANGENTIAL_COMPLIANCE_RATIO * finger_radius_m

    def solve(self, contact: NormalContact, drag: Floats) -> Drag:
        """Return the tangential forces after a displacement `drag` (3,), m, since sticking."""
        nodes, count = contact.nodes, len(contact.nodes)
        rows = (2 * nodes[:, None] + np.arange(2)).ravel()
        across = self._response.tangents[nodes]
        along = np.eye(3) - contact.normals[:, :, None] * contact.normals[:, None, :]
        # Tangential displacement at the points (3 q) due to the nodes' directions (2 k).
        moved = np.einsum("qk,kai,qij->qjka", contact.weights, across, along, optimize=True)
        moved = moved.reshape(-1, 2 * count)
        springs = np.repeat(contact.pressed_n / self._full_load_slip_m, 3)
        target_drag = (along @ drag).ravel()
        loads = moved.T * springs
        system = np.eye(2 * count) + loads @ moved @ self._compliance[np.ix_(rows, rows)]
        forces = np.linalg.solve(system, loads @ target_drag).reshape(-1, 2)
        return Drag(nodes, forces, -np.einsum("ka,kai->i", forces, across))


def solve_penalty_contact(
    weights: Floats, compliance: Floats, penalty: Floats, depths: Floats
) -> Floats:
    """Return the nodal forces (k,) that minimise the contact energy (see the module docstring).

    weights W (q, k), compliance C (k, k), penalty d (q,), depths t (q,). Newton's method starts
    from Hertz's estimate that half of the overlap is in contact. It usually converges in two to
    five full steps; after `FULL_STEPS` a line search damps it. Raises ArithmeticError without
    convergence.
    """
    compliance_at_points = weights @ compliance
    identity = np.eye(len(compliance))
    active = depths > 0.5 * depths.max()
    forces = np.zeros(len(compliance))
    for iteration in range(MAX_ITERATIONS):
        loaded = weights[active].T * penalty[active]
        target = np.linalg.solve(
            identity + loaded @ compliance_at_points[active], loaded @ depths[active]
        )
        fraction = 1.0
        if iteration >= FULL_STEPS:
            fraction = _search_step(
                forces, target, (compliance, compliance_at_points, penalty, depths)
            )
        forces = forces + fraction * (target - forces)
        now = depths > compliance_at_points @ forces
        if fraction == 1.0 and np.array_equal(now, active):
            return forces
        active = now
    raise ArithmeticError(f"the contact of {len(penalty)} points did not converge")


def _search_step(
    forces: Floats, target: Floats, problem: tuple[Floats, Floats, Floats, Floats]
) -> float:
    """Return the largest 2^-j of the step from `forces` to `target` that lowers the energy."""
    compliance, compliance_at_points, penalty, depths = problem

    def energy(trial: Floats) -> float:
        remaining = np.maximum(depths - compliance_at_points @ trial, 0.0)
        return 0.5 * float(trial @ compliance @ trial + penalty @ (remaining * remaining))

    start, fraction = energy(forces), 1.0
    while fraction > 1e-3 and energy(forces + fraction * (target - forces)) > start * (1.0 + 1e-12):
        fraction *= 0.5
    return fraction


class LinearSoftBody:
    """Precomputed linear method: one contact solve and one product with the influence matrix.

    The method is valid up to `linear_depth_m`. Deeper pushes are reported as out of range: the
    deflection is limited to `max_depth_m`, and the force grows in proportion to the depth.
    """

    name = "linear"

    def __init__(
        self,
        response: SkinResponse,
        shape: Shape,
        bounds: Floats,
        *,
        young_modulus_pa: float,
        finger_radius_m: float,
        linear_depth_m: float,
        max_depth_m: float,
        push_depth_m: float | None = None,
        drag: DragResponse | None = None,
    ) -> None:
        """Precompute the force curves of all touchable mesh corners.

        bounds (b, 3): skin nodes that cannot be touched; pushes next to them are out of range.
        push_depth_m: end of the force curve; None for `max_depth_m`. drag: tangential response for
        a sticking finger; None for no friction. Raises ValueError unless
        0 < linear_depth_m < max_depth_m.
        """
        if not 0.0 < linear_depth_m < max_depth_m:
            raise ValueError(
                f"linear_depth_m: {linear_depth_m:g} must be positive and less than "
                f"max_depth_m: {max_depth_m:g}"
            )
        self.contact = SphereContact(
            response, shape, young_modulus_pa=young_modulus_pa, finger_radius_m=finger_radius_m
        )
        self._drag = None if drag is None else drag.influence
        self._drag_contact = None
        if drag is not None:
            self._drag_contact = DragContact(
                drag, young_modulus_pa=young_modulus_pa, finger_radius_m=finger_radius_m
            )
        self._response = response
        self._modulus = young_modulus_pa
        self._linear, self._largest = linear_depth_m, max_depth_m
        self._bounds, self._pad2 = bounds, (PAD_RATIO * finger_radius_m) ** 2
        self.at_rest: Floats32 = np.zeros(response.rest.shape, dtype=np.float32)
        corners = np.unique(response.faces[:, :3])
        self._points = response.rest[response.contact_nodes[corners]]
        normals = response.normals[corners]
        self._depths = curve_depths(linear_depth_m, max_depth_m, push_depth_m)
        self._corner_forces = np.array(
            [
                self._forces(point, normal)
                for point, normal in zip(self._points, normals, strict=True)
            ]
        )
        sides = response.rest[response.contact_nodes[response.faces[:, :2]]]
        max_edge_m = np.linalg.norm(sides[:, 0] - sides[:, 1], axis=1).max()
        self._smoothing2 = max(float(max_edge_m), finger_radius_m) ** 2

    def respond(self, query: ContactQuery) -> Response:
        """Return the response to a contact."""
        depth = saturate_depth(query.depth_m, self._linear, self._largest)
        contact = self.contact.solve(query, depth)
        curve = self.force_curve(query.surface)
        stiffness = float(curve[len(CURVE_FRACTIONS), 1]) / self._linear
        if contact is None:
            clear = query.depth_m <= 0.0 or query.beyond_m > 0.0
            return Response(self.at_rest, np.zeros(3), stiffness, curve, 0.0, clear)
        total = self._sum(self._response.influence, contact.nodes, contact.forces)
        force = contact.force_n
        if self._drag_contact is not None and self._drag is not None and query.drag_m is not None:
            dragged = self._drag_contact.solve(contact, query.drag_m)
            rows = (2 * dragged.nodes[:, None] + np.arange(2)).ravel()
            total += self._sum(self._drag, rows, dragged.forces.ravel())
            force = force + dragged.force_n
        return Response(
            displacement=total.reshape(-1, 3),
            force_n=force * (query.depth_m / depth if query.depth_m > depth else 1.0),
            stiffness_n_per_m=stiffness,
            force_curve=curve,
            push_depth_m=max(0.0, query.depth_m - query.beyond_m),
            in_range=query.depth_m <= self._linear
            and query.beyond_m == 0.0
            and self._clears_bounds(query.surface),
        )

    def _clears_bounds(self, surface: Floats) -> bool:
        """Return whether the contact patch at a surface point contains touchable skin only."""
        if not len(self._bounds):
            return True
        return bool(np.square(self._bounds - surface).sum(axis=1).min() >= self._pad2)

    def stiffness_n_per_m(self, surface: Floats) -> float:
        """Return force over depth (N/m) at the end of the linear range, near `surface` (3,).

        The value does not depend on the current push, so it is available before contact.
        """
        forces = self._weights(surface) @ self._corner_forces
        return float(forces[len(CURVE_FRACTIONS)]) / self._linear

    def force_curve(self, surface: Floats) -> Floats:
        """Return the force curve near `surface` as a weighted mean of the nodes' curves."""
        return np.column_stack([self._depths, self._weights(surface) @ self._corner_forces])

    def _weights(self, surface: Floats) -> Floats:
        """Return Gaussian weights of the mesh corners around a point; their sum is 1."""
        squared = np.square(self._points - surface).sum(axis=1)
        weights = np.exp((squared.min() - squared) / (0.5 * self._smoothing2))
        result: Floats = weights / weights.sum()
        return result

    def _forces(self, point: Floats, normal: Floats) -> Floats:
        """Return the non-decreasing normal force (n,), N, at the depths of the curve."""
        shallow = self._depths[: len(CURVE_FRACTIONS) + 1]
        solved = np.append(shallow, [0.5 * (self._linear + self._largest), self._largest])
        forces = np.zeros(len(solved))
        for number, depth in enumerate(solved[1:], start=1):
            contact = self.contact.solve(ContactQuery(point, normal, float(depth)), float(depth))
            if contact is not None:
                forces[number] = float(contact.force_n @ normal)
        bent = np.array(
            [saturate_depth(float(d), self._linear, self._largest) for d in self._depths]
        )
        grown = np.divide(self._depths, bent, out=np.ones_like(bent), where=bent > 0.0)
        result: Floats = np.maximum.accumulate(np.interp(bent, solved, forces) * grown)
        return result

    def _sum(self, table: Floats32, rows: Ints, forces: Floats) -> Floats32:
        """Return the skin displacement (3 s,) under forces (k,), N, for k rows of a table."""
        scaled = (forces / self._modulus).astype(np.float32)
        total = np.zeros(table.shape[1], dtype=np.float32)
        # Slices of consecutive rows avoid the copy that fancy indexing would make.
        breaks = np.flatnonzero(np.diff(rows) != 1) + 1
        for start, stop in zip([0, *breaks], [*breaks, len(scaled)], strict=True):
            first = rows[start]
            total += scaled[start:stop] @ table[first : first + stop - start]
        return total


def unit_linear_body(
    response: SkinResponse, shape: Shape, bounds: Floats, finger_radius_m: float
) -> LinearSoftBody:
    """Return the linear method for 1 Pa, linear up to one finger radius; bounds (b, 3)."""
    return LinearSoftBody(
        response,
        shape,
        bounds,
        young_modulus_pa=1.0,
        finger_radius_m=finger_radius_m,
        linear_depth_m=finger_radius_m,
        max_depth_m=2.0 * finger_radius_m,
    )
