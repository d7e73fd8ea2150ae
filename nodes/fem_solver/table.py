"""Compute the response to pushes from a precomputed nonlinear table.

The table contains the force and the displacement of the skin (the surface of the body) for pushes
at every touchable node to several depths. Shape functions of the mesh interpolate between nodes.
Cubic polynomials with a continuous slope interpolate between depths. Therefore the response is a
continuous function of the finger's position. One response reads 24 rows of the table, for six nodes
at four depths.

The table is filled with solutions of Newton's method, called snapshots, at several tens of sample
points. The module `snapshot_interpolator` interpolates them to the other nodes. At small depths,
the table contains the response of the linear method.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flexsheet.nodes.arrays import Floats, Ints, Singles
from flexsheet.nodes.fem_solver.closest_contact import ContactQuery
from flexsheet.nodes.fem_solver.contact import (
    CURVE_FRACTIONS,
    LinearSoftBody,
    Response,
    SkinResponse,
    curve_depths,
    saturate_depth,
)
from flexsheet.nodes.fem_solver.mesh.solid import (
    triangle_shape_functions,
    triangle_shape_functions_at,
)
from flexsheet.nodes.fem_solver.snapshot_interpolator import SnapshotInterpolator, SnapshotSet
from flexsheet.nodes.fem_solver.snapshots import FINE_RATIO, SAME_RATIO, SamplePoint, Snapshot
from flexsheet.nodes.models.interpolation import smoothstep

LINEAR_DEPTHS_M = (0.0007,)
"""The depths (m) that the table has in addition to the depths of the snapshots."""
BLEND_M = (0.0007, 0.0015)
"""The range of depths (m) in which the table gradually changes from the linear response to the
snapshots."""
MIN_COSINE = -0.25
"""The minimum cosine of the angle between the deformed and the undeformed normal of a triangle."""
END_SPAN_M = 0.00125
"""The difference (m) between the greatest solved depth and the greatest valid depth. The responses
to pushes beyond the valid depth approach the response at the greatest solved depth."""
FADE_RATIO = 2.0
"""The distance beyond the edge of the touchable skin, in finger radii, over which the displacement
decreases to zero."""
CANDIDATE_FACES = 4
MESH_ORDER = 2.0
"""The assumed order of convergence of the force with the element size."""
FILLED_NODES = 48
"""The maximum number of contact nodes in one job that computes a part of a table."""


@dataclass(frozen=True, slots=True)
class Table:
    """The responses to pushes at m contact nodes to L depths, for a Young's modulus of 1 Pa.

    depths_m (L,): push depths, of which the first is 0. fields (m, L - 1, 3s), float32:
    displacement (m) of the s skin nodes at all depths except 0. force_n (m, L, 3): force on the
    finger. reach_m (m,): maximum depth with a valid solution at each contact node.
    """

    depths_m: Floats
    fields: Singles
    force_n: Floats
    reach_m: Floats


def table_bytes(loads: int, skin_nodes: int, depths: int) -> int:
    """Return the memory, in bytes, that a nonlinear table needs.

    loads: number of contact nodes. skin_nodes: number of skin nodes. depths: number of depths of a
    snapshot.
    """
    return loads * skin_nodes * 3 * 4 * (depths + len(LINEAR_DEPTHS_M))


@dataclass(frozen=True, slots=True, eq=False)
class FillJob:
    """The inputs of a worker process that interpolates push solutions at some contact nodes.

    samples: contact nodes.
    rest (s, 3): undeformed positions of the s skin nodes, m.
    triangles (t, 3): skin triangles.
    source: push solutions (snapshots) at other surface points.
    """

    samples: Sequence[SamplePoint]
    rest: Floats
    triangles: NDArray[np.int32]
    source: SnapshotSet


@dataclass(frozen=True, slots=True, eq=False)
class FilledNodes:
    """The interpolated push solutions at n contact nodes and k depths.

    moved (n, k, 3s): displacements of s skin nodes, m.
    force_n (n, k, 3): forces, N.
    reached (n,): number of depths at which Newton's method converged, as a weighted mean over the
        interpolated solutions.
    valid (n,): number of depths at which the displacement is valid.
    """

    moved: Singles
    force_n: Floats
    reached: Floats
    valid: Ints


def interpolate_nodes(job: FillJob) -> FilledNodes:
    """Interpolate push solutions (snapshots) at the contact nodes of one job."""
    interpolator = job.source.make_interpolator()
    moved, force, reached = zip(
        *(interpolator.interpolate(sample, job.rest) for sample in job.samples), strict=True
    )
    valid = [count_valid_levels(job.rest, one, job.triangles) for one in moved]
    count = len(job.samples)
    return FilledNodes(
        np.stack(moved).reshape(count, len(force[0]), -1),
        np.stack(force),
        np.array(reached),
        np.array(valid),
    )


def fill_table(
    response: SkinResponse,
    triangles: NDArray[np.int32],
    linear: LinearSoftBody,
    source: SnapshotSet,
    *,
    fine: tuple[SamplePoint, Snapshot] | None = None,
    interpolate: Callable[[Sequence[FillJob]], Iterable[FilledNodes]] = lambda jobs: map(
        interpolate_nodes, jobs
    ),
) -> Table:
    """Compute a soft body's nonlinear table of push responses from push solutions (snapshots).

    triangles (t, 3): triangles of the skin.
    linear: linear soft body with the same response and a modulus of 1 Pa. Its linear range must
        include the depths `BLEND_M`, between which the table changes to the snapshots.
    source: snapshots at several surface points.
    fine: surface point and solution of a push on a finer mesh, from which force corrections are
        computed; None for no corrections.
    interpolate: function that executes the interpolation jobs, and returns their results in the
        same order.
    """
    interpolator = source.make_interpolator()
    depths = np.array([0.0, *LINEAR_DEPTHS_M, *interpolator.depths_m])
    first = len(depths) - len(interpolator.depths_m)
    points, normals = response.rest[response.contact_nodes], response.normals
    count = len(points)
    factors = np.ones(len(depths))
    if fine is not None:
        factors = compute_force_factors(fine, response, linear, interpolator, depths)
    fields = np.empty((count, len(depths) - 1, response.rest.size), dtype=np.float32)
    force, reach = np.empty((count, len(depths), 3)), np.empty(count)
    samples = [SamplePoint(*one) for one in zip(points, normals, strict=True)]
    images = find_mirror_images(points, response.rest, source.mirrors)
    own = [number for number in range(count) if number not in images]
    jobs = [
        FillJob(
            [samples[number] for number in own[start : start + FILLED_NODES]],
            response.rest,
            triangles,
            source,
        )
        for start in range(0, len(own), FILLED_NODES)
    ]
    parts = list(interpolate(jobs))
    place = {number: divmod(at, FILLED_NODES) for at, number in enumerate(own)}
    for number, sample in enumerate(samples):
        partner, signs, permutation = images.get(number, (number, np.ones(3), None))
        part, at = place[partner]
        filled = parts[part]
        solved = filled.moved[at]
        if permutation is not None:
            shape = (len(solved), len(permutation), 3)
            solved = solved.reshape(shape)[:, permutation] * signs.astype(np.float32)
            solved = solved.reshape(len(solved), -1)
        moved, force[number] = _blend_levels(
            sample, linear, depths, solved, filled.force_n[at] * signs
        )
        fields[number] = moved[1:]
        sound_m = depths[first + filled.valid[at] - 1]
        # The number of converged depths may be fractional.
        levels = np.arange(1, len(depths) - first + 1)
        reach[number] = min(float(np.interp(filled.reached[at], levels, depths[first:])), sound_m)
    return Table(depths, fields, force * factors[:, None], reach)


def find_mirror_images(
    points: Floats, rest: Floats, mirrors: Sequence[Floats]
) -> dict[int, tuple[int, Floats, Ints]]:
    """Find the contact nodes whose pushes are mirror images of pushes at earlier contact nodes.

    points (n, 3): positions of the contact nodes, m. rest (s, 3): undeformed positions of the skin
    nodes, m. mirrors: vectors (3,) of signs, one for each mirror symmetry of the body. A symmetry
    is ignored if it maps a skin node to a point that is not a skin node. The keys of the result are
    contact nodes. The values are the earlier node, the signs, and the indices (s,) of the mirror
    images of the skin nodes.
    """
    from scipy.spatial import cKDTree

    same_m = SAME_RATIO * float(np.ptp(rest, axis=0).max())
    nodes, skin = cKDTree(points), cKDTree(rest)
    found: dict[int, tuple[int, Floats, Ints]] = {}
    usable = []
    for signs in mirrors:
        away, permutation = skin.query(rest * signs)
        if away.max() < same_m:
            usable.append((signs, permutation, *nodes.query(points * signs)))
    for number in range(len(points)):
        for signs, permutation, away, partners in usable:
            partner = int(partners[number])
            if away[number] < same_m and partner < number and partner not in found:
                found[number] = partner, signs, permutation
                break
    return found


def compute_force_factors(
    fine: tuple[SamplePoint, Snapshot],
    response: SkinResponse,
    linear: LinearSoftBody,
    interpolator: SnapshotInterpolator,
    depths: Floats,
) -> Floats:
    """Return the factors (L,) that correct the forces of a table at the L depths (L,), m.

    fine: surface point and solution of a push on a fine mesh.
    response, linear: response of the skin, and linear model of the soft body.
    interpolator: interpolator of the push solutions from which the table is computed.

    The meshes of the table are too coarse for small contacts, so the forces in the table are too
    large. Each factor is an estimate of the true force divided by the force in the table at the
    same point. At depths of at least `BLEND_M[1]`, the estimate is a Richardson extrapolation of
    order 2 from the table's mesh and the fine mesh. At smaller depths, the estimate is the force on
    the fine mesh. Beyond the maximum depth that was solved on the fine mesh, the factor is
    constant.
    """
    sample, push = fine
    solved_m = push.depths_m[: push.reached]
    factors = np.ones(len(depths))
    if not len(solved_m):
        return factors
    moved, pushed, _ = interpolator.interpolate(sample, response.rest)
    _, force = _blend_levels(sample, linear, depths, moved.reshape(len(pushed), -1), pushed)
    coarse_n, fine_n = force @ sample.normal, push.force_n[: push.reached] @ sample.normal
    within = (depths > 0.0) & (depths <= solved_m[-1] * (1.0 + 1e-9))
    # As in Hertz' theory, force / depth^1.5 hardly changes, so its interpolation is precise.
    hertz = np.interp(depths[within], solved_m, fine_n / solved_m**1.5)
    true_n = hertz * depths[within] ** 1.5
    excess_n = np.where(depths[within] >= BLEND_M[1], coarse_n[within] - true_n, 0.0)
    true_n -= excess_n / (FINE_RATIO**-MESH_ORDER - 1.0)
    factors[within] = true_n / coarse_n[within]
    factors[depths > solved_m[-1] * (1.0 + 1e-9)] = factors[within][-1] if within.any() else 1.0
    return factors


def _blend_levels(
    sample: SamplePoint, linear: LinearSoftBody, depths: Floats, solved: Singles, pushed: Floats
) -> tuple[Singles, Floats]:
    """Blend interpolated push solutions with the linear response at small depths.

    depths (L,): all depths of the table, m. The push solutions contain only the last k of them.
    solved (k, 3s), pushed (k, 3): displacement (m) of the s skin nodes, and force (N), from the
        push solutions.

    Returns the displacement (L, 3s) and the force (L, 3) at all depths. The weight of the push
    solutions increases from 0 to 1 between the two depths `BLEND_M`.
    """
    moved = np.zeros((len(depths), solved.shape[1]), dtype=np.float32)
    force = np.zeros((len(depths), 3))
    first = len(depths) - len(solved)
    fractions = np.clip((depths - BLEND_M[0]) / (BLEND_M[1] - BLEND_M[0]), 0.0, 1.0)
    for level, (depth, weight) in enumerate(zip(depths, fractions, strict=True)):
        if weight > 0.0:
            moved[level] = np.float32(weight) * solved[level - first]
            force[level] = weight * pushed[level - first]
        if depth > 0.0 and weight < 1.0:
            response = linear.respond(ContactQuery(sample.point, sample.normal, float(depth)))
            moved[level] += np.float32(1.0 - weight) * response.displacement.ravel()
            force[level] += (1.0 - weight) * response.force_n
    return moved, force


class CubicInterpolator:
    """An interpolator over increasing depths by cubic polynomials with a continuous slope.

    At each depth of the table, the slope equals the slope of the parabola through the values at
    this depth and the two adjacent depths.
    """

    def __init__(self, depths_m: Floats) -> None:
        """Compute the cubic polynomials between L >= 4 increasing depths (L,), m."""
        count = len(depths_m)
        self._depths = depths_m.tolist()
        values = np.eye(count)
        slopes = np.gradient(values, depths_m, axis=0, edge_order=2)
        self._first = [min(max(level - 1, 0), count - 4) for level in range(count - 1)]
        self._powers = []
        for level, first in enumerate(self._first):
            span = depths_m[level + 1] - depths_m[level]
            start, end = values[level], values[level + 1]
            leaving, coming = span * slopes[level], span * slopes[level + 1]
            rise = end - start
            rows = [start, leaving, 3 * rise - 2 * leaving - coming, leaving + coming - 2 * rise]
            self._powers.append(np.array(rows)[:, first : first + 4])

    def weights_at(self, depth_m: float) -> tuple[int, Floats]:
        """Return an index i and four weights (4,) for the interpolation at a depth (m).

        The weights apply to the depths i to i + 3 of the table.
        """
        level = min(max(bisect_right(self._depths, depth_m) - 1, 0), len(self._depths) - 2)
        t = (depth_m - self._depths[level]) / (self._depths[level + 1] - self._depths[level])
        return self._first[level], np.array([1.0, t, t * t, t * t * t]) @ self._powers[level]


def count_valid_levels(rest: Floats, moved: Singles, triangles: NDArray[np.int32]) -> int:
    """Count the successive depths at which the interpolated displacement is valid.

    rest (s, 3): undeformed positions of the s skin nodes, m. moved (L, s, 3): displacement at each
    of the L depths, m. triangles (t, 3): skin triangles. A displacement is invalid if a triangle is
    rotated by more than the angle whose cosine is `MIN_COSINE`. This can happen at an edge of the
    skin.
    """

    def normals(points: Floats) -> Floats:
        a, b, c = points[triangles].transpose(1, 0, 2)
        return np.cross(b - a, c - a)

    before = normals(rest)
    before /= np.linalg.norm(before, axis=1, keepdims=True)
    for level, displacement in enumerate(moved):
        after = normals(rest + displacement)
        cosines = (before * after).sum(axis=1) / np.linalg.norm(after, axis=1)
        if not cosines.min() > MIN_COSINE:
            return level
    return len(moved)


def project_to_edges(point: Floats, corners: Floats) -> tuple[float, Floats]:
    """Return the distance (m) of a point (3,) from a triangle's edges, and the nearest edge point.

    corners (3, 3): corners of the triangle. The edge point is in the triangle's local coordinates
    (2,).
    """
    starts, edge_vectors = corners, np.roll(corners, -1, axis=0) - corners
    along = np.clip(
        ((point - starts) * edge_vectors).sum(axis=1) / np.square(edge_vectors).sum(axis=1),
        0.0,
        1.0,
    )
    distances = np.linalg.norm(point - starts - along[:, None] * edge_vectors, axis=1)
    edge = int(distances.argmin())
    ends = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [0.0, 0.0]])
    return float(distances[edge]), ends[edge] + along[edge] * (ends[edge + 1] - ends[edge])


class TableSoftBody:
    """A soft-body method that interpolates responses in a nonlinear table."""

    def __init__(
        self,
        response: SkinResponse,
        bounds: Floats,
        table: Table,
        *,
        name: str = "nonlinear_table",
        young_modulus_pa: float,
        finger_radius_m: float,
        push_depth_m: float,
        linear_depth_m: float,
    ) -> None:
        """Precompute the force curves of all contact nodes.

        bounds (b, 3): positions (m) of the b skin nodes that the finger cannot touch.
        name: name of the method in messages.
        push_depth_m: depth at which the force curve ends.
        linear_depth_m: depth at which the stiffness is evaluated.
        """
        self.name = name
        from scipy.linalg.blas import sgemv
        from scipy.spatial import cKDTree

        self._add = sgemv
        self.at_rest: Singles = np.zeros(response.rest.shape, dtype=np.float32)
        self._radius = finger_radius_m
        self._fields = table.fields
        max_depth_m = float(table.depths_m[-1])
        self._cubics = CubicInterpolator(table.depths_m)
        self._force = young_modulus_pa * table.force_n
        self.reach_m = np.maximum(table.reach_m, 2.0 * END_SPAN_M)
        self._faces = response.faces
        self._corners = response.rest[response.contact_nodes][response.faces]
        self._centres = self._corners.mean(axis=1)
        self._centre_squares = np.square(self._centres).sum(axis=1)
        middles = 0.5 * (self._corners[:, :3] + self._corners[:, [1, 2, 0]])
        self._sag = float(np.linalg.norm(self._corners[:, 3:] - middles, axis=2).max())
        sides = self._corners[:, 1:3] - self._corners[:, :1]
        self._inverse = np.linalg.inv(sides @ sides.transpose(0, 2, 1)) @ sides
        # One matrix product gives the local coordinates of a point on all flat faces.
        self._across = self._inverse.reshape(-1, 3)
        self._offset = (self._inverse @ self._corners[:, 0, :, None]).reshape(-1, 2)
        self._depths = curve_depths(linear_depth_m, max_depth_m - END_SPAN_M, push_depth_m)
        self._linear = linear_depth_m
        self._curves = np.array(
            [self._curve(number, normal) for number, normal in enumerate(response.normals)]
        )
        bound_distance = np.full(len(response.contact_nodes), np.inf)
        if len(bounds):
            bound_distance, _ = cKDTree(bounds).query(response.rest[response.contact_nodes])
        self._reach_and_bound = np.column_stack([self.reach_m, np.minimum(bound_distance, 1.0)])

    def respond(self, query: ContactQuery) -> Response:
        nodes, weights, off = self.project_to_surface(query.surface)
        curve = self._curve_at(nodes, weights)
        stiffness = float(curve[len(CURVE_FRACTIONS), 1]) / self._linear
        if query.depth_m <= 0.0:
            return Response(self.at_rest, np.zeros(3), stiffness, curve, 0.0, True)
        reach, bound_distance = (weights @ self._reach_and_bound[nodes]).tolist()
        depth = saturate_depth(query.depth_m, reach - END_SPAN_M, reach)
        past = min(max(off, query.beyond_m) / (FADE_RATIO * self._radius), 1.0)
        fade = 1.0 - smoothstep(past)
        first, over = self._cubics.weights_at(depth)
        # Depth 0 has no row, because its displacement is zero.
        skipped = 1 if first == 0 else 0
        rows, fractions = slice(first + skipped - 1, first + 3), over[skipped:].astype(np.float32)
        total = np.zeros(self._fields.shape[2], dtype=np.float32)
        add, fields = self._add, self._fields
        for node, weight in zip(nodes.tolist(), (fade * weights).tolist(), strict=True):
            # BLAS adds in place, without temporary arrays.
            add(weight, fields[node, rows].T, fractions, 1.0, total, 0, 1, 0, 1, 0, 1)
        return Response(
            displacement=total.reshape(-1, 3),
            force_n=weights
            @ (over @ self._force[nodes, first : first + 4])
            * (fade * query.depth_m / depth),
            stiffness_n_per_m=stiffness,
            force_curve=curve,
            push_depth_m=max(0.0, query.depth_m - query.beyond_m),
            in_range=query.depth_m <= reach - END_SPAN_M
            and past == 0.0
            and bound_distance >= self._radius,
        )

    def project_to_surface(self, surface: Floats) -> tuple[Ints, Floats, float]:
        """Find the point of the touchable skin that is nearest to a surface point (3,).

        Return the indices (6,) of the nodes of the nearest face, and their shape functions (6,) at
        the found point. The third result is the distance (m) of the surface point from the
        touchable skin.
        """
        # The squared distances omit the square of `surface`, which is the same for all faces.
        squared = self._centre_squares - self._centres @ (2.0 * surface)
        tried = squared.argpartition(CANDIDATE_FACES)[:CANDIDATE_FACES].tolist()
        every = (self._across @ surface).reshape(-1, 2) - self._offset
        local = [(face, *every[face].tolist()) for face in tried]
        best, a, b = max(local, key=lambda one: min(one[1], one[2], 1.0 - one[1] - one[2]))
        if min(a, b, 1.0 - a - b) < 0.0:
            # The point is off the skin, or in a gap between the projections of two flat faces.
            nearest = [project_to_edges(surface, self._corners[face, :3]) for face in tried]
            number = int(np.argmin([distances for distances, _ in nearest]))
            off, inner = nearest[number]
            return (
                self._faces[tried[number]],
                triangle_shape_functions(inner),
                max(0.0, off - self._sag),
            )
        # Correct the coordinates on the flat face to those on the curved face by one Newton step.
        left = surface - np.array(triangle_shape_functions_at(a, b)) @ self._corners[best]
        a_left, b_left = (self._inverse[best] @ left).tolist()
        weights = np.array(triangle_shape_functions_at(a + a_left, b + b_left))
        return self._faces[best], weights, 0.0

    def stiffness_n_per_m(self, surface: Floats) -> float:
        return float(self.force_curve(surface)[len(CURVE_FRACTIONS), 1]) / self._linear

    def force_curve(self, surface: Floats) -> Floats:
        nodes, weights, _ = self.project_to_surface(surface)
        return self._curve_at(nodes, weights)

    def _curve_at(self, nodes: Ints, weights: Floats) -> Floats:
        """Return the force-depth curve (n, 2), m and N, of a skin point.

        The curve is interpolated between the mesh nodes. Interpolation weights can be negative, so
        the interpolated force could decrease with depth. The curve is therefore replaced by its
        running maximum.
        """
        result = np.empty((len(self._depths), 2))
        result[:, 0] = self._depths
        result[:, 1] = np.maximum.accumulate(np.maximum(weights @ self._curves[nodes], 0.0))
        return result

    def _curve(self, number: int, normal: Floats) -> Floats:
        """Return the normal force (n,), N, at a contact node for the depths of the force curve.

        The force never decreases with depth. number: index of the contact node. normal (3,): normal
        of the skin at this node.
        """
        reach = float(self.reach_m[number])
        bent = np.array([saturate_depth(float(d), reach - END_SPAN_M, reach) for d in self._depths])
        along = self._force[number] @ normal
        forces = np.array(
            [over @ along[first : first + 4] for first, over in map(self._cubics.weights_at, bent)]
        )
        grown = np.divide(self._depths, bent, out=np.ones_like(bent), where=bent > 0.0)
        result: Floats = np.maximum.accumulate(np.maximum(forces * grown, 0.0))
        return result
