"""The precomputed nonlinear method: neo-Hookean pushes, tabulated over places and depths.

A table holds, for a push at every node of the touchable skin, how all the skin moves and what
force answers, at some depths.  Between nodes it is interpolated by the mesh's own shape functions,
between depths by cubics with a continuous slope.  So the answer is continuous in the finger's
place, and follows from that alone; it costs the reading of 24 rows: six nodes, four depths.  (Modes
over depth, by proper orthogonal decomposition, were tried: as the contact spreads with depth, nine
of thirteen were needed to keep a tenth of a millimetre, which is more to read.)

What fills it: full Newton solutions at some tens of sites, carried to the nodes between them
(`carried`); for the smallest depths, where these have nothing to add, the linear method's contact.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nodes.fem_solver.carried import Carrier, shape_functions
from nodes.fem_solver.contact import (
    CURVE_SHARES,
    LinearSoftBody,
    Response,
    SkinResponse,
    curve_depths,
    saturated,
)
from nodes.fem_solver.place import Push
from nodes.fem_solver.pushes import Site

Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]
Ints = NDArray[np.int64]

LINEAR_DEPTHS_M = (0.0007,)
"""Depths that are tabulated beside those that were solved."""
BLEND_M = (0.0007, 0.0015)
"""Up to the first depth the linear method's answer counts, from the second on the solutions'."""
LEAST_COSINE = -0.25
"""No triangle of the skin is shown that is turned so that its normal falls below this."""
END_SPAN_M = 0.00125
"""The range ends this far before what was solved; deeper pushes approach that."""
FADE_RATIO = 2.0
"""Past the end of the touchable skin the dent fades over so many finger radii."""
FACES_TRIED = 4
Told = Callable[[int, int], None]


@dataclass(frozen=True, slots=True)
class Table:
    """For pushes at the m touchable nodes, at L depths, 1 Pa:

    depths_m (L,), from 0.  fields (m, L - 1, 3 s) float32: skin displacement at all depths but 0.
    force_n (m, L, 3).  reach_m (m,): the depth to which solutions were found there.
    """

    depths_m: Floats
    fields: Floats32
    force_n: Floats
    reach_m: Floats


def table_bytes(loads: int, skin_nodes: int, depths: int) -> int:
    """What a table takes whose pushes were solved at so many depths."""
    return loads * skin_nodes * 3 * 4 * (depths + len(LINEAR_DEPTHS_M))


def fill(
    response: SkinResponse,
    triangles: NDArray[np.int32],
    linear: LinearSoftBody,
    carrier: Carrier,
    told: Told,
) -> Table:
    """The table of a body; triangles (t, 3) of its skin; linear: of the same response, 1 Pa, and
    linear at any depth.

    told: called with (done, total) places; may raise to stop.
    """
    depths = np.array([0.0, *LINEAR_DEPTHS_M, *carrier.depths_m])
    places, normals = response.rest[response.touch], response.normals
    count = len(places)

    fields = np.empty((count, len(depths) - 1, response.rest.size), dtype=np.float32)
    force, reach = np.empty((count, len(depths), 3)), np.empty(count)
    for number in range(count):
        site = Site(places[number], normals[number])
        moved, force[number], reach[number] = _levels(site, response, linear, carrier, depths)
        fields[number] = moved[1:]
        sound = sound_levels(response.rest, moved.reshape(len(depths), -1, 3), triangles)
        reach[number] = min(reach[number], float(depths[sound - 1]))
        told(number + 1, count)
    return Table(depths, fields, force, reach)


def _levels(
    site: Site, response: SkinResponse, linear: LinearSoftBody, carrier: Carrier, depths: Floats
) -> tuple[Floats32, Floats, float]:
    """Skin displacement (L, 3 s) and force (L, 3) of a push at the depths, and the reach, m."""
    moved = np.zeros((len(depths), response.rest.size), dtype=np.float32)
    force = np.zeros((len(depths), 3))
    solved, pushed, reached = carrier.answer(site, response.rest)
    first = len(depths) - len(solved)
    shares = np.clip((depths - BLEND_M[0]) / (BLEND_M[1] - BLEND_M[0]), 0.0, 1.0)
    for level, (depth, share) in enumerate(zip(depths, shares, strict=True)):
        if share > 0.0:
            moved[level] = np.float32(share) * solved[level - first].ravel()
            force[level] = share * pushed[level - first]
        if depth > 0.0 and share < 1.0:
            answer = linear.respond(Push(site.place, site.normal, float(depth)))
            moved[level] += np.float32(1.0 - share) * answer.displacement.ravel()
            force[level] += (1.0 - share) * answer.force_n
    reach = float(np.interp(reached, np.arange(1, len(solved) + 1), depths[first:]))
    return moved, force, reach


class Cubics:
    """Interpolation over rising depths by cubics with a continuous slope, that of the parabola
    through a depth and its neighbours; each lies between two depths and knows one more beyond."""

    def __init__(self, depths_m: Floats) -> None:
        """depths_m (L,), four or more."""
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

    def at(self, depth_m: float) -> tuple[int, Floats]:
        """The first of the four depths that count at a depth within the range, their weights."""
        level = min(max(bisect_right(self._depths, depth_m) - 1, 0), len(self._depths) - 2)
        t = (depth_m - self._depths[level]) / (self._depths[level + 1] - self._depths[level])
        return self._first[level], np.array([1.0, t, t * t, t * t * t]) @ self._powers[level]


def sound_levels(rest: Floats, moved: Floats32, triangles: NDArray[np.int32]) -> int:
    """How many of the first levels of a skin that moves (L, s, 3) turn none of its triangles
    farther than `LEAST_COSINE` says; where a finger is carried past a rim, they may be."""

    def normals(points: Floats) -> Floats:
        a, b, c = points[triangles].transpose(1, 0, 2)
        return np.cross(b - a, c - a)

    before = normals(rest)
    before /= np.linalg.norm(before, axis=1, keepdims=True)
    for level, way in enumerate(moved):
        after = normals(rest + way)
        cosines = (before * after).sum(axis=1) / np.linalg.norm(after, axis=1)
        if not cosines.min() > LEAST_COSINE:
            return level
    return len(moved)


def six_shape_functions(a: float, b: float) -> tuple[float, ...]:
    """`shape_functions` at one place: on so few numbers arrays are slow."""
    c = 1.0 - a - b
    corners = (c * (2.0 * c - 1.0), a * (2.0 * a - 1.0), b * (2.0 * b - 1.0))
    return (*corners, 4.0 * c * a, 4.0 * a * b, 4.0 * b * c)


def nearest_on_edges(point: Floats, corners: Floats) -> tuple[float, Floats]:
    """Distance (m) of a point (3,) from the edges of a triangle (3, 3), and the local coordinates
    (2,) of the place that is nearest."""
    starts, ways = corners, np.roll(corners, -1, axis=0) - corners
    along = np.clip(((point - starts) * ways).sum(axis=1) / np.square(ways).sum(axis=1), 0.0, 1.0)
    away = np.linalg.norm(point - starts - along[:, None] * ways, axis=1)
    edge = int(away.argmin())
    ends = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [0.0, 0.0]])
    return float(away[edge]), ends[edge] + along[edge] * (ends[edge + 1] - ends[edge])


class TableSoftBody:
    """The table's answers; see `SoftBodyMethod`."""

    name = "nonlinear_table"

    def __init__(
        self,
        response: SkinResponse,
        bounds: Floats,
        table: Table,
        *,
        young_modulus_pa: float,
        finger_radius_m: float,
        push_depth_m: float,
        linear_depth_m: float,
    ) -> None:
        """bounds as `LinearSoftBody`; linear_depth_m: where the stiffness is told."""
        from scipy.linalg.blas import sgemv
        from scipy.spatial import cKDTree

        self._add = sgemv
        self.at_rest: Floats32 = np.zeros(response.rest.shape, dtype=np.float32)
        self._radius = finger_radius_m
        self._fields = table.fields
        deepest = float(table.depths_m[-1])
        self._cubics = Cubics(table.depths_m)
        self._force = young_modulus_pa * table.force_n
        self.reach_m = np.maximum(table.reach_m, 2.0 * END_SPAN_M)
        self._faces = response.faces
        self._corners = response.rest[response.touch][response.faces]
        self._centres = self._corners.mean(axis=1)
        self._centre_squares = np.square(self._centres).sum(axis=1)
        middles = 0.5 * (self._corners[:, :3] + self._corners[:, [1, 2, 0]])
        self._sag = float(np.linalg.norm(self._corners[:, 3:] - middles, axis=2).max())
        sides = self._corners[:, 1:3] - self._corners[:, :1]
        self._inverse = np.linalg.inv(sides @ sides.transpose(0, 2, 1)) @ sides
        # local coordinates of a point on each flat face: one product for all
        self._across = self._inverse.reshape(-1, 3)
        self._offset = (self._inverse @ self._corners[:, 0, :, None]).reshape(-1, 2)
        self._depths = curve_depths(linear_depth_m, deepest - END_SPAN_M, push_depth_m)
        self._linear = linear_depth_m
        self._curves = np.array(
            [self._curve(number, normal) for number, normal in enumerate(response.normals)]
        )
        room = np.full(len(response.touch), np.inf)
        if len(bounds):
            room, _ = cKDTree(bounds).query(response.rest[response.touch])
        self._reach_and_room = np.column_stack([self.reach_m, np.minimum(room, 1.0)])

    def respond(self, push: Push) -> Response:
        """The body's answer; any finite push has one."""
        nodes, weights, off = self.foot(push.surface)
        curve = self._curve_at(nodes, weights)
        stiffness = float(curve[len(CURVE_SHARES), 1]) / self._linear
        if push.depth_m <= 0.0:
            return Response(self.at_rest, np.zeros(3), stiffness, curve, 0.0, True)
        reach, room = (weights @ self._reach_and_room[nodes]).tolist()
        depth = saturated(push.depth_m, reach - END_SPAN_M, reach)
        past = min(max(off, push.beyond_m) / (FADE_RATIO * self._radius), 1.0)
        fade = 1.0 - past * past * (3.0 - 2.0 * past)
        first, over = self._cubics.at(depth)
        # at depth 0 nothing moves: it has no row
        skipped = 1 if first == 0 else 0
        rows, shares = slice(first + skipped - 1, first + 3), over[skipped:].astype(np.float32)
        total = np.zeros(self._fields.shape[2], dtype=np.float32)
        add, fields = self._add, self._fields
        for node, weight in zip(nodes.tolist(), (fade * weights).tolist(), strict=True):
            # adds up in place: what it takes is reading the table
            add(weight, fields[node, rows].T, shares, 1.0, total, 0, 1, 0, 1, 0, 1)
        return Response(
            displacement=total.reshape(-1, 3),
            force_n=weights
            @ (over @ self._force[nodes, first : first + 4])
            * (fade * push.depth_m / depth),
            stiffness_n_per_m=stiffness,
            force_curve=curve,
            push_depth_m=max(0.0, push.depth_m - push.beyond_m),
            in_range=push.depth_m <= reach - END_SPAN_M and past == 0.0 and room >= self._radius,
        )

    def foot(self, surface: Floats) -> tuple[Ints, Floats, float]:
        """Touchable nodes (6,) around a surface point (3,) with their shape functions there, and
        how far (m) the point is off the touchable skin."""
        # squared distances, but for what is the same for all
        squared = self._centre_squares - self._centres @ (2.0 * surface)
        tried = squared.argpartition(FACES_TRIED)[:FACES_TRIED].tolist()
        every = (self._across @ surface).reshape(-1, 2) - self._offset
        local = [(face, *every[face].tolist()) for face in tried]
        best, a, b = max(local, key=lambda one: min(one[1], one[2], 1.0 - one[1] - one[2]))
        if min(a, b, 1.0 - a - b) < 0.0:
            # off the skin, or over an edge that two flat faces leave between them
            nearest = [nearest_on_edges(surface, self._corners[face, :3]) for face in tried]
            number = int(np.argmin([away for away, _ in nearest]))
            off, inner = nearest[number]
            return self._faces[tried[number]], shape_functions(inner), max(0.0, off - self._sag)
        # faces are curved: from the flat one's coordinates one step leads to theirs
        left = surface - np.array(six_shape_functions(a, b)) @ self._corners[best]
        a_left, b_left = (self._inverse[best] @ left).tolist()
        weights = np.array(six_shape_functions(a + a_left, b + b_left))
        return self._faces[best], weights, 0.0

    def stiffness_n_per_m(self, surface: Floats) -> float:
        """Force over depth at `linear_depth_m`, at the touchable place nearest to `surface`."""
        return float(self.force_curve(surface)[len(CURVE_SHARES), 1]) / self._linear

    def force_curve(self, surface: Floats) -> Floats:
        """Force over depth near `surface`, as `SoftBodyMethod`; past the range as `respond`."""
        nodes, weights, _ = self.foot(surface)
        return self._curve_at(nodes, weights)

    def _curve_at(self, nodes: Ints, weights: Floats) -> Floats:
        result = np.empty((len(self._depths), 2))
        result[:, 0], result[:, 1] = self._depths, weights @ self._curves[nodes]
        return result

    def _curve(self, number: int, normal: Floats) -> Floats:
        """Force along the normal at the depths of the curve, never falling."""
        reach = float(self.reach_m[number])
        bent = np.array([saturated(float(d), reach - END_SPAN_M, reach) for d in self._depths])
        along = self._force[number] @ normal
        forces = np.array(
            [over @ along[first : first + 4] for first, over in map(self._cubics.at, bent)]
        )
        grown = np.divide(self._depths, bent, out=np.ones_like(bent), where=bent > 0.0)
        result: Floats = np.maximum.accumulate(np.maximum(forces * grown, 0.0))
        return result
