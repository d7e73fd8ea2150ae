"""Contact of a fingertip sphere with a linear soft body: smooth, and the same from every history.

The finger pushes without friction.  The skin is sampled at fixed contact points, finer than the
mesh; where a point would lie inside the finger by more than it has yielded, a pressure acts that
grows with what is left (penetration times a stiff bed).  The nodal forces f then minimise the
strictly convex energy

    1/2 f.C f + 1/2 sum_q d_q max(0, t_q - (W C f)_q)^2

with C the compliance of the nodes, W the shape functions at the points, t_q how far the rigid
finger reaches below the skin there, and d_q = bed stiffness times area.  So the answer is unique
(no path dependence), and Lipschitz continuous in the finger's position (no popping).  A semismooth
Newton iteration (Qi & Sun 1993) finds it in a few small dense solves.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from nodes.fem_solver.place import Push
from nodes.models.shapes import Shape

Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]
Ints = NDArray[np.int64]

BED_RATIO = 40.0
"""Stiffness of the contact bed (Pa/m) in units of E / finger radius."""
POINT_SPACING_RATIO = 0.4
"""Largest spacing of the contact points, in finger radii."""
FLANK_RATIO = 0.9
"""Beyond this part of the radius the fingertip goes on as a cone, tangent to the sphere."""
FACING = (0.2, 0.6)
"""Cosines between the skin's normal and the push at which none, and all of its reach counts."""
PAD_RATIO = 1.1
"""Half width of the contact patch at the end of the linear range, in finger radii."""
TIE_GIVE_RATIO = 0.004
"""A tie gives by this share of the finger's radius under what presses its point."""
FULL_STEPS = 8
MAX_ITERATIONS = 40
CURVE_SHARES = (0.05, 0.12, 0.22, 0.35, 0.5, 0.7, 1.0)
"""Depths at which the force curve is sampled within the linear range, as shares of it."""


@dataclass(frozen=True, slots=True)
class SkinResponse:
    """What a linear body answers to unit forces on its skin, for a Young's modulus of 1 Pa.

    rest (s, 3): skin nodes, metres, mesh frame.  touch (m,): indices into the skin of the nodes
    that can be loaded.  normals (m, 3): outward.  faces (f, 6): six-node triangles, indices into
    `touch`.
    compliance (m, m): inward displacement of node i under 1 N inward on node j; symmetric.
    table (m, 3 s) float32: displacement of the whole skin under 1 N inward on node j.
    """

    rest: Floats
    touch: Ints
    normals: Floats
    faces: Ints
    compliance: Floats
    table: Floats32


@dataclass(frozen=True, slots=True)
class DragResponse:
    """What the same body answers to unit forces along its skin, for 1 Pa.

    tangents (m, 2, 3): two directions along the skin at each touch node.  compliance (2m, 2m):
    displacement along direction i under 1 N along direction j.  table (2m, 3 s) float32: of the
    whole skin.
    """

    tangents: Floats
    compliance: Floats
    table: Floats32


@dataclass(frozen=True, slots=True)
class Response:
    """A soft body's answer to one finger position, in the mesh frame; see `messages.SoftBody`."""

    displacement: Floats32
    force_n: Floats
    stiffness_n_per_m: float
    force_curve: Floats
    push_depth_m: float
    in_range: bool


class SoftBodyMethod(Protocol):
    """What every method of the family offers, whatever is precomputed behind it.

    name: as the message says it.  at_rest: displacement (n, 3) of the untouched skin.
    """

    @property
    def name(self) -> str: ...

    @property
    def at_rest(self) -> Floats32: ...

    def stiffness_n_per_m(self, surface: Floats) -> float:
        """Stiffness (N/m) at the touchable place nearest to a surface point (3,), m."""
        ...

    def force_curve(self, surface: Floats) -> Floats:
        """Force over depth at the touchable place nearest to a surface point (3,), m.

        (n, 2): depth (m) and force (N), both from 0 and never falling.
        """
        ...

    def respond(self, push: Push) -> Response:
        """The skin's answer to a push."""
        ...


@dataclass(frozen=True, slots=True)
class Contact:
    """Inward forces (k,) in N on the touch nodes `nodes` (k,); their sum (3,) on the finger.

    weights (q, k), normals (q, 3), pressed_n (q,): of the points in contact, their shape functions
    at the nodes, normals, and the forces that press them.
    """

    nodes: Ints
    forces: Floats
    force_n: Floats
    weights: Floats
    normals: Floats
    pressed_n: Floats


@dataclass(frozen=True, slots=True)
class Drag:
    """Forces (k, 2) in N along the tangents of the touch nodes `nodes` (k,); their sum (3,) on the
    finger."""

    nodes: Ints
    forces: Floats
    force_n: Floats


def saturated(depth_m: float, linear_m: float, largest_m: float) -> float:
    """A depth that follows `depth_m` to `linear_m` and then bends (C1) towards `largest_m`."""
    if depth_m <= linear_m:
        return depth_m
    span = largest_m - linear_m
    return linear_m + span * -float(np.expm1(-(depth_m - linear_m) / span))


def curve_depths(linear_m: float, largest_m: float, push_m: float | None) -> Floats:
    """Depths of a force curve: dense where the contact grows, then on to the deepest push."""
    deepest = largest_m if push_m is None else max(push_m, largest_m)
    deeper = np.geomspace(
        linear_m, deepest, max(2, round(4 * np.log2(deepest / linear_m)) // 2 + 1)
    )
    return np.concatenate([[0.0], linear_m * np.array(CURVE_SHARES), deeper[1:]])


def triangle_points(divisions: int) -> tuple[Floats, Floats]:
    """Shape functions (p, 6) and local coordinates (p, 2) at the centroids of a six-node triangle
    cut into divisions^2 equal parts."""
    upright = [(i + 1 / 3, j + 1 / 3) for i in range(divisions) for j in range(divisions - i)]
    inverted = [(i + 2 / 3, j + 2 / 3) for i in range(divisions) for j in range(divisions - i - 1)]
    local = np.array(upright + inverted) / divisions
    b = np.column_stack([1.0 - local.sum(axis=1), local])
    middle = 4.0 * np.column_stack([b[:, 0] * b[:, 1], b[:, 1] * b[:, 2], b[:, 2] * b[:, 0]])
    return np.column_stack([b * (2.0 * b - 1.0), middle]), local


class SphereContact:
    """The contact problem of one body and one fingertip; holds no state between solves."""

    def __init__(
        self,
        response: SkinResponse,
        shape: Shape,
        *,
        young_modulus_pa: float,
        finger_radius_m: float,
        bed_ratio: float = BED_RATIO,
    ) -> None:
        """shape: the smooth surface that the response's faces approximate, in its frame."""
        self._response = response
        self._radius = finger_radius_m
        self._compliance = response.compliance / young_modulus_pa
        corners = response.rest[response.touch][response.faces]
        longest = float(np.linalg.norm(corners[:, 0] - corners[:, 1], axis=1).max())
        divisions = max(2, int(np.ceil(longest / (POINT_SPACING_RATIO * finger_radius_m))))
        self._shape, _ = triangle_points(divisions)
        # the finger is tracked above the smooth surface: contact is with that, not with the faces
        found = shape.closest((self._shape @ corners).reshape(-1, 3))
        self._points = found.point.reshape(len(corners), -1, 3)
        self._normals = found.normal.reshape(len(corners), -1, 3)
        sides = corners[:, 1:3] - corners[:, :1]
        areas = 0.5 * np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
        bed = bed_ratio * young_modulus_pa / finger_radius_m
        self._bed = bed * areas / len(self._shape)
        self._centres = corners.mean(axis=1)
        self._size = np.linalg.norm(corners - self._centres[:, None], axis=2).max(axis=1)

    def reach(self, points: Floats, normals: Floats, centre: Floats, way: Floats) -> Floats:
        """How far the rigid finger with its sphere at `centre` reaches below each point, (q,) m.

        points, normals (q, 3); way (3,): outward normal that the finger came in against.  Skin that
        faces across that way, on another side of the body, is not reached.  Beyond `FLANK_RATIO` of
        the radius the sphere is continued by its tangent cone, so that every point has a finite, C1
        answer; it is negative where the finger is clear of the skin.
        """
        offset = centre - points
        along = np.einsum("qi,qi->q", offset, normals)
        across2 = np.einsum("qi,qi->q", offset, offset) - along * along
        across = np.sqrt(np.maximum(across2, 0.0))
        inner = np.minimum(across, FLANK_RATIO * self._radius)
        height = np.sqrt(self._radius**2 - inner * inner)
        facing = np.clip((normals @ way - FACING[0]) / (FACING[1] - FACING[0]), 0.0, 1.0)
        below = height - inner / height * (across - inner) - along
        result: Floats = below * facing * facing * (3.0 - 2.0 * facing)
        return result

    def solve(self, push: Push, depth_m: float) -> Contact | None:
        """The contact at `depth_m` below `push.surface`; None where the finger does not touch."""
        centre = push.surface + (self._radius - depth_m) * push.normal
        limit = FLANK_RATIO * self._radius
        widest = limit + max(depth_m, 0.0)
        squared = np.square(self._centres - push.surface).sum(axis=1)
        near = np.flatnonzero(squared < np.square(widest + self._size))
        if not len(near):
            return None
        count = len(self._shape)
        below = self.reach(
            self._points[near].reshape(-1, 3),
            self._normals[near].reshape(-1, 3),
            centre,
            push.normal,
        )
        reached = np.flatnonzero(below > 0.0)
        if not len(reached):
            return None
        # points that the finger does not reach at rest are left out: the skin sinks around a push
        face, point = near[reached // count], reached % count
        nodes, local = np.unique(self._response.faces[face], return_inverse=True)
        weights = np.zeros((len(reached), len(nodes)))
        weights[np.arange(len(reached))[:, None], local.reshape(-1, 6)] = self._shape[point]
        compliance, bed = self._compliance[np.ix_(nodes, nodes)], self._bed[face]
        forces = solve_bed(weights, compliance, bed, below[reached])
        left = below[reached] - weights @ (compliance @ forces)
        pressed = left > 0.0
        return Contact(
            nodes=nodes,
            forces=forces,
            force_n=forces @ self._response.normals[nodes],
            weights=weights[pressed],
            normals=self._normals[face[pressed], point[pressed]],
            pressed_n=bed[pressed] * left[pressed],
        )


class DragContact:
    """How a finger that sticks to the skin drags it along.

    Points in contact are tied to the finger, along the skin, by springs as strong as they are
    pressed: so a point that comes into contact, or leaves it, does so without a jump.  What the
    straight push moves along the skin is left free, and dragging does not change what presses.
    """

    def __init__(
        self, response: DragResponse, *, young_modulus_pa: float, finger_radius_m: float
    ) -> None:
        self._response = response
        self._compliance = response.compliance / young_modulus_pa
        self._give = TIE_GIVE_RATIO * finger_radius_m

    def solve(self, contact: Contact, drag: Floats) -> Drag:
        """The drag by a finger that has moved along the skin by `drag` (3,), m, since it stuck."""
        nodes, count = contact.nodes, len(contact.nodes)
        rows = (2 * nodes[:, None] + np.arange(2)).ravel()
        across = self._response.tangents[nodes]
        along = np.eye(3) - contact.normals[:, :, None] * contact.normals[:, None, :]
        # displacement along the skin at the points (3 q), by that of the nodes' directions (2 k)
        moved = np.einsum("qk,kai,qij->qjka", contact.weights, across, along, optimize=True)
        moved = moved.reshape(-1, 2 * count)
        ties = np.repeat(contact.pressed_n / self._give, 3)
        wanted = (along @ drag).ravel()
        pulled = moved.T * ties
        system = np.eye(2 * count) + pulled @ moved @ self._compliance[np.ix_(rows, rows)]
        forces = np.linalg.solve(system, pulled @ wanted).reshape(-1, 2)
        return Drag(nodes, forces, -np.einsum("ka,kai->i", forces, across))


def solve_bed(weights: Floats, compliance: Floats, bed: Floats, below: Floats) -> Floats:
    """Nodal forces (k,) at the minimum of the module's energy.

    weights W (q, k), compliance C (k, k), bed d (q,), below t (q,).  Newton from Hertz's guess that
    half of the overlap is contact; its full steps settle in two to five.  Should they not, further
    ones are halved until the energy falls.  ArithmeticError if even that does not settle.
    """
    yields = weights @ compliance
    identity = np.eye(len(compliance))
    active = below > 0.5 * below.max()
    forces = np.zeros(len(compliance))
    for iteration in range(MAX_ITERATIONS):
        loaded = weights[active].T * bed[active]
        target = np.linalg.solve(identity + loaded @ yields[active], loaded @ below[active])
        share = 1.0
        if iteration >= FULL_STEPS:
            share = _decreasing_share(forces, target, (compliance, yields, bed, below))
        forces = forces + share * (target - forces)
        now = below > yields @ forces
        if share == 1.0 and np.array_equal(now, active):
            return forces
        active = now
    raise ArithmeticError(f"contact of {len(bed)} points did not settle")


def _decreasing_share(
    forces: Floats, target: Floats, problem: tuple[Floats, Floats, Floats, Floats]
) -> float:
    """The largest 2^-j of the way from `forces` to `target` along which the energy falls."""
    compliance, yields, bed, below = problem

    def energy(trial: Floats) -> float:
        left = np.maximum(below - yields @ trial, 0.0)
        return 0.5 * float(trial @ compliance @ trial + bed @ (left * left))

    start, share = energy(forces), 1.0
    while share > 1e-3 and energy(forces + share * (target - forces)) > start * (1.0 + 1e-12):
        share *= 0.5
    return share


class LinearSoftBody:
    """The precomputed linear method: one contact solve, one product with the skin's table.

    Good to `linear_depth_m`.  Deeper pushes bend the skin no further than `largest_depth_m`, are
    flagged, and their force goes on growing in proportion to the depth.
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
        largest_depth_m: float,
        push_depth_m: float | None = None,
        drag: DragResponse | None = None,
    ) -> None:
        """bounds (b, 3): skin nodes that cannot be touched; pushes next to them are out of range.
        push_depth_m: how deep the force curve goes; None: to `largest_depth_m`.  drag: for a finger
        that sticks; None: pushes are answered as without friction.

        ValueError unless 0 < linear_depth_m < largest_depth_m.
        """
        if not 0.0 < linear_depth_m < largest_depth_m:
            raise ValueError(
                f"linear_depth_m: {linear_depth_m:g} must be positive and less than "
                f"largest_depth_m: {largest_depth_m:g}"
            )
        self.contact = SphereContact(
            response, shape, young_modulus_pa=young_modulus_pa, finger_radius_m=finger_radius_m
        )
        self._drag = None if drag is None else drag.table
        self._drag_contact = None
        if drag is not None:
            self._drag_contact = DragContact(
                drag, young_modulus_pa=young_modulus_pa, finger_radius_m=finger_radius_m
            )
        self._response = response
        self._modulus = young_modulus_pa
        self._linear, self._largest = linear_depth_m, largest_depth_m
        self._bounds, self._pad2 = bounds, (PAD_RATIO * finger_radius_m) ** 2
        self.at_rest: Floats32 = np.zeros(response.rest.shape, dtype=np.float32)
        corners = np.unique(response.faces[:, :3])
        self._places = response.rest[response.touch[corners]]
        normals = response.normals[corners]
        self._depths = curve_depths(linear_depth_m, largest_depth_m, push_depth_m)
        self._place_forces = np.array(
            [
                self._forces(place, normal)
                for place, normal in zip(self._places, normals, strict=True)
            ]
        )
        sides = response.rest[response.touch[response.faces[:, :2]]]
        longest = np.linalg.norm(sides[:, 0] - sides[:, 1], axis=1).max()
        self._smoothing2 = max(float(longest), finger_radius_m) ** 2

    def respond(self, push: Push) -> Response:
        """The body's answer; any finite push has one."""
        depth = saturated(push.depth_m, self._linear, self._largest)
        contact = self.contact.solve(push, depth)
        curve = self.force_curve(push.surface)
        stiffness = float(curve[len(CURVE_SHARES), 1]) / self._linear
        if contact is None:
            clear = push.depth_m <= 0.0 or push.beyond_m > 0.0
            return Response(self.at_rest, np.zeros(3), stiffness, curve, 0.0, clear)
        total = self._sum(self._response.table, contact.nodes, contact.forces)
        force = contact.force_n
        if self._drag_contact is not None and self._drag is not None and push.drag_m is not None:
            dragged = self._drag_contact.solve(contact, push.drag_m)
            rows = (2 * dragged.nodes[:, None] + np.arange(2)).ravel()
            total += self._sum(self._drag, rows, dragged.forces.ravel())
            force = force + dragged.force_n
        return Response(
            displacement=total.reshape(-1, 3),
            force_n=force * (push.depth_m / depth if push.depth_m > depth else 1.0),
            stiffness_n_per_m=stiffness,
            force_curve=curve,
            push_depth_m=max(0.0, push.depth_m - push.beyond_m),
            in_range=push.depth_m <= self._linear
            and push.beyond_m == 0.0
            and self._off_bounds(push.surface),
        )

    def _off_bounds(self, surface: Floats) -> bool:
        """Whether a contact patch there is all on skin that can be touched."""
        if not len(self._bounds):
            return True
        return bool(np.square(self._bounds - surface).sum(axis=1).min() >= self._pad2)

    def stiffness_n_per_m(self, surface: Floats) -> float:
        """Force over depth at the end of the linear range, at the touchable place near `surface`.

        It does not depend on the present push, so that it is there before the finger touches.
        """
        forces = self._weights(surface) @ self._place_forces
        return float(forces[len(CURVE_SHARES)]) / self._linear

    def force_curve(self, surface: Floats) -> Floats:
        """Force over depth near `surface`, as `SoftBodyMethod`; past the linear range as `respond`.

        A mean over the places around: costs a sum, not a contact solve.
        """
        return np.column_stack([self._depths, self._weights(surface) @ self._place_forces])

    def _weights(self, surface: Floats) -> Floats:
        """Gaussian weights of the mesh's corners around a point: the mean by them is smooth."""
        squared = np.square(self._places - surface).sum(axis=1)
        weights = np.exp((squared.min() - squared) / (0.5 * self._smoothing2))
        result: Floats = weights / weights.sum()
        return result

    def _forces(self, place: Floats, normal: Floats) -> Floats:
        """Force along the normal (n,) at the depths of the curve, never falling."""
        shallow = self._depths[: len(CURVE_SHARES) + 1]
        solved = np.append(shallow, [0.5 * (self._linear + self._largest), self._largest])
        forces = np.zeros(len(solved))
        for number, depth in enumerate(solved[1:], start=1):
            contact = self.contact.solve(Push(place, normal, float(depth)), float(depth))
            if contact is not None:
                forces[number] = float(contact.force_n @ normal)
        bent = np.array([saturated(float(d), self._linear, self._largest) for d in self._depths])
        grown = np.divide(self._depths, bent, out=np.ones_like(bent), where=bent > 0.0)
        result: Floats = np.maximum.accumulate(np.interp(bent, solved, forces) * grown)
        return result

    def _sum(self, table: Floats32, rows: Ints, forces: Floats) -> Floats32:
        """Displacement (3 s,) of the skin under forces (k,), N, of some rows (k,) of a table."""
        scaled = (forces / self._modulus).astype(np.float32)
        total = np.zeros(table.shape[1], dtype=np.float32)
        # nodes are numbered along the mesh: runs of neighbours are read in place, without a copy
        breaks = np.flatnonzero(np.diff(rows) != 1) + 1
        for start, stop in zip([0, *breaks], [*breaks, len(scaled)], strict=True):
            first = rows[start]
            total += scaled[start:stop] @ table[first : first + stop - start]
        return total
