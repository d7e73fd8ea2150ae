"""Solve the contact of a spherical fingertip with a linear soft body.

The skin (the surface of the body) is sampled at fixed contact points, which are closer together
than the nodes of the mesh. At each point, a penalty pressure is proportional to the penetration
that remains after the skin has moved. The nodal forces f minimise the strictly convex energy

    1/2 f.C f + 1/2 sum_q d_q max(0, t_q - (W C f)_q)^2

C is the nodal compliance, and W contains the shape functions at the contact points. t_q is the
penetration of the rigid finger at point q before the skin moves. d_q is the penalty stiffness times
the area of the point. The solution is unique, does not depend on the finger's path, and is
Lipschitz continuous in the finger's position. A semismooth Newton iteration (Qi & Sun 1993)
computes it by solving a few small dense systems.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from flexsheet.nodes.arrays import Floats, Ints, Singles
from flexsheet.nodes.fem_solver.closest_contact import ContactQuery
from flexsheet.nodes.fem_solver.mesh.solid import triangle_shape_functions
from flexsheet.nodes.models.shapes import Shape

PENALTY_RATIO = 40.0
"""The penalty stiffness (Pa/m) of the contact, divided by Young's modulus per finger radius."""
POINT_SPACING_RATIO = 0.4
"""The maximum spacing of the contact points, in finger radii."""
FLANK_RATIO = 0.9
"""The distance from the push axis, in finger radii, beyond which the spherical fingertip is
approximated by a tangent cone."""
FACING = (0.2, 0.6)
"""The range in which the weight of the penetration rises from 0 to 1. The two limits are cosines of
the angle between skin normal and contact normal."""
PAD_RATIO = 1.1
"""The half width of the contact patch at the end of the linear range, in finger radii."""
FULL_STEPS = 8
MAX_ITERATIONS = 40
CURVE_FRACTIONS = (0.05, 0.12, 0.22, 0.35, 0.5, 0.7, 1.0)
"""The depths of the force curve within the linear range, as fractions of that range."""


@dataclass(frozen=True, slots=True)
class SkinResponse:
    """The response of a linear body to unit normal forces on its skin.

    Young's modulus is 1 Pa. rest (s, 3): undeformed positions of the s skin nodes, m, mesh frame.
    contact_nodes (m,): indices into `rest` of the m nodes that the finger can touch. normals (m,
    3): outward normals at these nodes. faces (f, 6): six-node triangles, as indices into
    `contact_nodes`. compliance (m, m): inward displacement of node i (m) per inward force on node j
    (N). The matrix is symmetric. influence (m, 3s), float32: displacement (m) of all skin nodes per
    inward force (N) on each contact node.
    """

    rest: Floats
    contact_nodes: Ints
    normals: Floats
    faces: Ints
    compliance: Floats
    influence: Singles


@dataclass(frozen=True, slots=True)
class Response:
    """The response of a soft body to one finger position, in the mesh frame.

    displacement (s, 3): displacement of the s skin nodes, m. force_n (3,): force on the finger.
    stiffness_n_per_m: force divided by depth at the end of the linear range. force_curve (n, 2):
    depth (m) and force (N) of n points. push_depth_m: depth of the push. in_range: whether the
    method is valid for the push.
    """

    displacement: Singles
    force_n: Floats
    stiffness_n_per_m: float
    force_curve: Floats
    push_depth_m: float
    in_range: bool


class SoftBodyMethod(Protocol):
    """The interface of the methods that compute the response of a soft body to the finger.

    name: name of the method in messages.
    at_rest (s, 3): zero displacement of the s skin nodes, for a finger that does not touch the
        skin.
    """

    @property
    def name(self) -> str: ...

    @property
    def at_rest(self) -> Singles: ...

    def stiffness_n_per_m(self, surface: Floats) -> float:
        """Return the stiffness (N/m) of the touchable skin near a surface point (3,).

        The stiffness is the force divided by the depth at the end of the linear range.
        """
        ...

    def force_curve(self, surface: Floats) -> Floats:
        """Return the force-depth curve (n, 2) of the touchable skin near a surface point (3,).

        The columns are depth (m) and force (N). Both start at 0 and never decrease.
        """
        ...

    def respond(self, query: ContactQuery) -> Response:
        """Compute the displacement of the skin and the force on the finger for a contact."""
        ...


@dataclass(frozen=True, slots=True)
class NormalContact:
    """The solution of a frictionless contact between skin and finger.

    nodes (k,): indices of the k loaded contact nodes. forces (k,): inward forces on these nodes, N.
    force_n (3,): total force on the finger.
    """

    nodes: Ints
    forces: Floats
    force_n: Floats


def saturate_depth(depth_m: float, linear_m: float, largest_m: float) -> float:
    """Limit a push depth smoothly (with continuous slope) to less than `largest_m`.

    Depths up to `linear_m` are returned unchanged. For larger depths, the result approaches
    `largest_m` exponentially.
    """
    if depth_m <= linear_m:
        return depth_m
    span = largest_m - linear_m
    return linear_m + span * -float(np.expm1(-(depth_m - linear_m) / span))


def curve_depths(linear_m: float, largest_m: float, push_m: float | None) -> Floats:
    """Return the depths (m) at which the force curve of a push is sampled.

    linear_m: end of the linear range, in which the depths are closely spaced.
    largest_m: minimum value of the greatest depth.
    push_m: required greatest depth; None if `largest_m` is sufficient.

    Beyond `linear_m`, the depths increase geometrically to the larger of `largest_m` and `push_m`.
    """
    max_push_m = largest_m if push_m is None else max(push_m, largest_m)
    deeper = np.geomspace(
        linear_m, max_push_m, max(2, round(4 * np.log2(max_push_m / linear_m)) // 2 + 1)
    )
    return np.concatenate([[0.0], linear_m * np.array(CURVE_FRACTIONS), deeper[1:]])


def sample_triangle(divisions: int) -> tuple[Floats, Floats]:
    """Return shape functions (p, 6) and local coordinates (p, 2) of p contact points in a triangle.

    The triangle has six nodes and is divided into `divisions` ** 2 equal parts. The p contact
    points are the centroids of these parts.
    """
    upright = [(i + 1 / 3, j + 1 / 3) for i in range(divisions) for j in range(divisions - i)]
    inverted = [(i + 2 / 3, j + 2 / 3) for i in range(divisions) for j in range(divisions - i - 1)]
    local = np.array(upright + inverted) / divisions
    return triangle_shape_functions(local), local


class SphereContact:
    """A solver of the frictionless contact between a linear body and a spherical fingertip."""

    def __init__(
        self,
        response: SkinResponse,
        shape: Shape,
        *,
        young_modulus_pa: float,
        finger_radius_m: float,
    ) -> None:
        """Distribute the contact points over the skin.

        shape: smooth surface, in the mesh frame, that the triangles in `response` approximate.
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
        """Return the penetration (q,), in m, of skin points into the rigid finger.

        The penetration is negative outside the finger. points, normals (q, 3): skin points and
        their outward normals. centre (3,): centre of the sphere that models the fingertip, m.
        direction (3,): outward surface normal at the contact. Skin that faces away from this
        direction has no penetration. At more than `FLANK_RATIO` radii from the push axis, the
        sphere is replaced by a tangent cone. Therefore each value is finite and has a continuous
        slope.
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
        """Solve the contact of a spherical finger at a depth (m) below a surface point.

        query: surface point and its normal. The depth in the query is ignored.

        Returns None if the finger does not touch the object.
        """
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
        # The skin around a push moves inwards, so points outside the finger at rest stay outside.
        face, point = near[reached // count], reached % count
        nodes, local = np.unique(self._response.faces[face], return_inverse=True)
        weights = np.zeros((len(reached), len(nodes)))
        weights[np.arange(len(reached))[:, None], local.reshape(-1, 6)] = self._shape[point]
        compliance, penalty = self._compliance[np.ix_(nodes, nodes)], self._penalty[face]
        forces = solve_penalty_contact(weights, compliance, penalty, depths[reached])
        return NormalContact(nodes, forces, forces @ self._response.normals[nodes])


def solve_penalty_contact(
    weights: Floats, compliance: Floats, penalty: Floats, depths: Floats
) -> Floats:
    """Return the forces (k,), N, on k nodes that minimise the contact energy.

    The energy of the forces f is 1/2 f.C f + 1/2 sum_q d_q max(0, t_q - (W C f)_q)^2. weights W (q,
    k): shape functions of the nodes at q contact points. compliance C (k, k): m/N. penalty d (q,):
    N/m. depths t (q,): m. Newton's method starts from Hertz's estimate that points deeper than half
    of the maximum depth are in contact. After `FULL_STEPS` steps, a line search damps the method.
    Raises ArithmeticError if the method does not converge.
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
    raise ArithmeticError(
        f"the contact forces at {len(penalty)} contact points did not converge; reduce the push "
        "depth or skin_spacing_m"
    )


def _search_step(
    forces: Floats, target: Floats, problem: tuple[Floats, Floats, Floats, Floats]
) -> float:
    """Return the largest step fraction (1, 1/2, 1/4 and so on) that decreases the contact energy.

    forces, target (k,): forces (N) on k nodes at the start and at the end of the full step.
    problem: four arrays that define the energy, as in `solve_penalty_contact`: node compliance,
        compliance at the contact points, penalty stiffness and depths.
    """
    compliance, compliance_at_points, penalty, depths = problem

    def energy(trial: Floats) -> float:
        remaining = np.maximum(depths - compliance_at_points @ trial, 0.0)
        return 0.5 * float(trial @ compliance @ trial + penalty @ (remaining * remaining))

    start, fraction = energy(forces), 1.0
    while fraction > 1e-3 and energy(forces + fraction * (target - forces)) > start * (1.0 + 1e-12):
        fraction *= 0.5
    return fraction


class LinearSoftBody:
    """The linear soft-body method: a superposition of precomputed responses to unit forces.

    Pushes deeper than `linear_depth_m` are reported as out of range. For these pushes, the force
    increases in proportion to the depth. The displacement stops growing at the depth `max_depth_m`.
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
    ) -> None:
        """Precompute the force curves of all touchable mesh corners.

        bounds (b, 3): positions of the skin nodes that the finger cannot touch. Pushes near these
            nodes are reported as out of range.
        linear_depth_m: depth above which pushes are reported as out of range.
        max_depth_m: depth above which the displacement does not increase.
        push_depth_m: depth at which the force curve ends; None means `max_depth_m`.

        Raises ValueError unless 0 < linear_depth_m < max_depth_m.
        """
        if not 0.0 < linear_depth_m < max_depth_m:
            raise ValueError(
                f"linear_depth_m: {linear_depth_m:g} must be positive and less than max_depth_m "
                f"({max_depth_m:g}); reduce linear_depth_m"
            )
        self.contact = SphereContact(
            response, shape, young_modulus_pa=young_modulus_pa, finger_radius_m=finger_radius_m
        )
        self._response = response
        self._modulus = young_modulus_pa
        self._linear, self._largest = linear_depth_m, max_depth_m
        self._bounds, self._pad2 = bounds, (PAD_RATIO * finger_radius_m) ** 2
        self.at_rest: Singles = np.zeros(response.rest.shape, dtype=np.float32)
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
        depth = saturate_depth(query.depth_m, self._linear, self._largest)
        contact = self.contact.solve(query, depth)
        curve = self.force_curve(query.surface)
        stiffness = float(curve[len(CURVE_FRACTIONS), 1]) / self._linear
        if contact is None:
            clear = query.depth_m <= 0.0 or query.beyond_m > 0.0
            return Response(self.at_rest, np.zeros(3), stiffness, curve, 0.0, clear)
        total = self._sum(contact)
        return Response(
            displacement=total.reshape(-1, 3),
            force_n=contact.force_n * (query.depth_m / depth if query.depth_m > depth else 1.0),
            stiffness_n_per_m=stiffness,
            force_curve=curve,
            push_depth_m=max(0.0, query.depth_m - query.beyond_m),
            in_range=query.depth_m <= self._linear
            and query.beyond_m == 0.0
            and bool((np.square(self._bounds - query.surface).sum(axis=1) >= self._pad2).all()),
        )

    def stiffness_n_per_m(self, surface: Floats) -> float:
        forces = self._weights(surface) @ self._corner_forces
        return float(forces[len(CURVE_FRACTIONS)]) / self._linear

    def force_curve(self, surface: Floats) -> Floats:
        return np.column_stack([self._depths, self._weights(surface) @ self._corner_forces])

    def _weights(self, surface: Floats) -> Floats:
        """Return Gaussian weights of the mesh corners, with sum 1, for a surface point (3,)."""
        squared = np.square(self._points - surface).sum(axis=1)
        weights = np.exp((squared.min() - squared) / (0.5 * self._smoothing2))
        result: Floats = weights / weights.sum()
        return result

    def _forces(self, point: Floats, normal: Floats) -> Floats:
        """Return the normal force (n,), N, at the n depths of the force curve.

        The force never decreases with depth. point, normal (3,): surface point (m) and its outward
        normal.
        """
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

    def _sum(self, contact: NormalContact) -> Singles:
        """Return the displacement (3s,), m, that the nodal forces cause at the s skin nodes."""
        table, rows = self._response.influence, contact.nodes
        scaled = (contact.forces / self._modulus).astype(np.float32)
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
    """Return a linear soft body with a Young's modulus of 1 Pa.

    Pushes deeper than one finger radius are out of the linear range.

    bounds (b, 3): positions of the skin nodes that the finger cannot touch.
    """
    return LinearSoftBody(
        response,
        shape,
        bounds,
        young_modulus_pa=1.0,
        finger_radius_m=finger_radius_m,
        linear_depth_m=finger_radius_m,
        max_depth_m=2.0 * finger_radius_m,
    )
