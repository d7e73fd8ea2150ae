"""The precomputed nonlinear method: neo-Hookean pushes, tabulated over places and depths.

A table holds, for a push at every node of the touchable skin, how all the skin moves and what force
answers, at some depths.  Over depth it is reduced to a few modes (proper orthogonal decomposition),
between nodes it is interpolated by the mesh's own shape functions, between depths by splines.  So
the answer is continuous in the finger's place, and follows from that alone.

What fills it: full Newton solutions at some tens of sites, carried to the nodes between them
(`carried`); for the smallest depths, where these have nothing to add, the linear method's contact.
"""

from __future__ import annotations

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

LINEAR_DEPTHS_M = (0.0004, 0.0008)
"""Depths that are tabulated beside those that were solved."""
BLEND_M = (0.0008, 0.0015)
"""Up to the first depth the linear method's answer counts, from the second on the solutions'."""
MODE_ERROR_M = 1e-5
"""What the modes leave out at any place and depth that they are chosen from."""
BASIS_SHARE = 24
"""Modes are chosen from every so manieth place."""
DEPTH_STEP_M = 2e-5
"""Splines over depth are evaluated beforehand, at such steps."""
END_SPAN_M = 0.0025
"""The range ends this far before what was solved; deeper pushes approach that."""
FADE_RATIO = 2.0
"""Past the end of the touchable skin the dent fades over so many finger radii."""
FACES_TRIED = 4
Told = Callable[[int, int], None]


@dataclass(frozen=True, slots=True)
class Table:
    """For pushes at the m touchable nodes, at L depths, 1 Pa:

    depths_m (L,), from 0.  modes (L, k).  fields (m, k, 3 s) float32: skin displacement is modes
    times fields.  force_n (m, L, 3).  reach_m (m,): the depth to which solutions were found there.
    """

    depths_m: Floats
    modes: Floats
    fields: Floats32
    force_n: Floats
    reach_m: Floats


def table_bytes(loads: int, skin_nodes: int) -> int:
    """About what a table takes, with as many modes as usual."""
    return loads * skin_nodes * 3 * 4 * 7


def fill(response: SkinResponse, linear: LinearSoftBody, carrier: Carrier, told: Told) -> Table:
    """The table of a body; linear: of the same response, 1 Pa, and linear at any depth.

    told: called with (done, total) places; may raise to stop.
    """
    depths = np.array([0.0, *LINEAR_DEPTHS_M, *carrier.depths_m])
    places, normals = response.rest[response.touch], response.normals
    count = len(places)

    def at(number: int) -> tuple[Floats32, Floats, float]:
        site = Site(places[number], normals[number])
        return _levels(site, response, linear, carrier, depths)

    some = [at(number)[0] for number in range(0, count, BASIS_SHARE)]
    modes = depth_modes(np.stack(some), MODE_ERROR_M)
    del some
    project = np.linalg.pinv(modes).astype(np.float32)
    fields = np.empty((count, modes.shape[1], response.rest.size), dtype=np.float32)
    force, reach = np.empty((count, len(depths), 3)), np.empty(count)
    for number in range(count):
        moved, force[number], reach[number] = at(number)
        fields[number] = project @ moved
        told(number + 1, count)
    return Table(depths, modes, fields, force, reach)


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


def depth_modes(samples: Floats32, error_m: float) -> Floats:
    """Modes over depth (L, k), as few as leave no more than `error_m` of samples (p, L, n)."""
    gram = np.einsum("pan,pbn->ab", samples, samples, optimize=True).astype(np.float64)
    values, vectors = np.linalg.eigh(gram)
    vectors = vectors[:, np.argsort(values)[::-1]]
    for count in range(1, len(vectors) + 1):
        modes = vectors[:, :count]
        left = (np.eye(len(vectors)) - modes @ modes.T).astype(np.float32)
        if max(float(np.abs(left @ one).max()) for one in samples) <= error_m:
            break
    return np.asarray(modes)


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
        from scipy.interpolate import CubicSpline
        from scipy.linalg.blas import sgemv
        from scipy.spatial import cKDTree

        self._add = sgemv
        self.at_rest: Floats32 = np.zeros(response.rest.shape, dtype=np.float32)
        self._radius = finger_radius_m
        self._fields = table.fields
        deepest = float(table.depths_m[-1])
        fine = np.linspace(0.0, deepest, int(np.ceil(deepest / DEPTH_STEP_M)) + 1)
        self._step = fine[1]
        self._modes = CubicSpline(table.depths_m, table.modes)(fine).astype(np.float32)
        self._splines = CubicSpline(table.depths_m, np.eye(len(table.depths_m)))(fine)
        self._force = young_modulus_pa * table.force_n
        self._reach = np.maximum(table.reach_m, 2.0 * END_SPAN_M)
        self._faces = response.faces
        self._corners = response.rest[response.touch][response.faces]
        self._centres = self._corners.mean(axis=1)
        middles = 0.5 * (self._corners[:, :3] + self._corners[:, [1, 2, 0]])
        self._sag = float(np.linalg.norm(self._corners[:, 3:] - middles, axis=2).max())
        sides = self._corners[:, 1:3] - self._corners[:, :1]
        self._inverse = np.linalg.inv(sides @ sides.transpose(0, 2, 1)) @ sides
        self._depths = curve_depths(linear_depth_m, deepest - END_SPAN_M, push_depth_m)
        self._linear = linear_depth_m
        self._curves = np.array(
            [self._curve(number, normal) for number, normal in enumerate(response.normals)]
        )
        room = np.full(len(response.touch), np.inf)
        if len(bounds):
            room, _ = cKDTree(bounds).query(response.rest[response.touch])
        self._reach_and_room = np.column_stack([self._reach, np.minimum(room, 1.0)])

    def respond(self, push: Push) -> Response:
        """The body's answer; any finite push has one."""
        nodes, weights, off = self.foot(push.surface)
        curve = np.column_stack([self._depths, weights @ self._curves[nodes]])
        stiffness = float(curve[len(CURVE_SHARES), 1]) / self._linear
        if push.depth_m <= 0.0:
            return Response(self.at_rest, np.zeros(3), stiffness, curve, 0.0, True)
        reach, room = (weights @ self._reach_and_room[nodes]).tolist()
        depth = saturated(push.depth_m, reach - END_SPAN_M, reach)
        past = min(max(off, push.beyond_m) / (FADE_RATIO * self._radius), 1.0)
        fade = 1.0 - past * past * (3.0 - 2.0 * past)
        level = min(int(depth / self._step), len(self._modes) - 2)
        share = depth / self._step - level
        over = (1.0 - share) * self._splines[level] + share * self._splines[level + 1]
        modes = (1.0 - share) * self._modes[level] + share * self._modes[level + 1]
        total = np.zeros(self._fields.shape[2], dtype=np.float32)
        for node, weight in zip(nodes.tolist(), (fade * weights).tolist(), strict=True):
            # adds up in place: what it takes is reading the table
            self._add(weight, self._fields[node].T, modes, 1.0, total, overwrite_y=1)
        return Response(
            displacement=total.reshape(-1, 3),
            force_n=weights @ (over @ self._force[nodes]) * (fade * push.depth_m / depth),
            stiffness_n_per_m=stiffness,
            force_curve=curve,
            push_depth_m=max(0.0, push.depth_m - push.beyond_m),
            in_range=push.depth_m <= reach - END_SPAN_M and past == 0.0 and room >= self._radius,
        )

    def foot(self, surface: Floats) -> tuple[Ints, Floats, float]:
        """Touchable nodes (6,) around a surface point (3,) with their shape functions there, and
        how far (m) the point is off the touchable skin."""
        squared = ((self._centres - surface) ** 2).sum(axis=1)
        tried = squared.argpartition(FACES_TRIED)[:FACES_TRIED]
        corners, inverse = self._corners[tried], self._inverse[tried]
        local = (inverse @ (surface - corners[:, 0])[:, :, None])[:, :, 0]
        least = np.minimum(local.min(axis=1), 1.0 - local.sum(axis=1))
        best = int(least.argmax())
        if least[best] < 0.0:
            # off the skin, or over an edge that two flat faces leave between them
            nearest = [nearest_on_edges(surface, face[:3]) for face in corners]
            face = int(np.argmin([away for away, _ in nearest]))
            off, inner = nearest[face]
            return self._faces[tried[face]], shape_functions(inner), max(0.0, off - self._sag)
        # faces are curved: from the flat one's coordinates one step leads to theirs
        there = shape_functions(local[best]) @ corners[best]
        inner = local[best] + inverse[best] @ (surface - there)
        return self._faces[tried[best]], shape_functions(inner), 0.0

    def stiffness_n_per_m(self, surface: Floats) -> float:
        """Force over depth at `linear_depth_m`, at the touchable place nearest to `surface`."""
        return float(self.force_curve(surface)[len(CURVE_SHARES), 1]) / self._linear

    def force_curve(self, surface: Floats) -> Floats:
        """Force over depth near `surface`, as `SoftBodyMethod`; past the range as `respond`."""
        nodes, weights, _ = self.foot(surface)
        return np.column_stack([self._depths, weights @ self._curves[nodes]])

    def _curve(self, number: int, normal: Floats) -> Floats:
        """Force along the normal at the depths of the curve, never falling."""
        reach = float(self._reach[number])
        bent = np.array([saturated(float(d), reach - END_SPAN_M, reach) for d in self._depths])
        along = self._splines @ (self._force[number] @ normal)
        forces = np.interp(bent, self._step * np.arange(len(along)), along)
        grown = np.divide(self._depths, bent, out=np.ones_like(bent), where=bent > 0.0)
        result: Floats = np.maximum.accumulate(np.maximum(forces * grown, 0.0))
        return result
