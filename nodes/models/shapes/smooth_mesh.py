"""Represent a closed triangle mesh as a smooth surface, so that the sheet does not rattle on
facets.

The surface is built in two steps, the first when the shape is made.  `rho` is the smoothing length.

1. Osculating jets (Cazals and Pouget, Estimating Differential Quantities Using Polynomial Fitting
of Osculating Jets, 2005): about selected vertices a quadratic is fitted to the vertices around by
least squares.  Position, normal and shape operator A of each give the signed distance to second
order: s_i(x) = n_i d + d A_i d / 2 with d = x - p_i.
2. Partition of unity (Ohtake et al., Multi-level Partition of Unity Implicits, 2003): f(x) = sum
w_i s_i / sum w_i with w_i = (1 - t_i)^4, t_i = (d d + 3 (n_i d)^2) / rho^2, and w_i = 0 beyond t_i
= 1.  The surface is f = 0.

The weights are three times continuously differentiable, and so is f.  Along a path the normal thus
has a continuous second derivative, unlike with facets, interpolated vertex normals, or patches
joined with a common tangent plane.  Supports are half as thick along the normal as across it, so
that the two sides of a thin part do not affect one another.

Edges sharper than `rho` are rounded over about that length; `deviation_m` measures the resulting
distance of the surface from the mesh.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from flexsheet.nodes.models.shapes.surface import (
    EQUAL_DISTANCE_M,
    Bools,
    Floats,
    Nearest,
    SurfaceProjections,
    Triple,
    check_points,
    check_positive,
    check_previous,
    descend,
    descend_one,
)
from flexsheet.nodes.models.shapes.triangles import (
    Indices,
    MeshError,
    check_mesh,
    half_edges,
    refine_facets,
    vertex_normals,
)

FLATNESS = 3.0
"""Supports are 1 / sqrt(1 + FLATNESS) as thick along the normal as across it."""
FIT_RATIO = 1.25
"""A jet is fitted to the vertices within this many `rho`."""
SPACING_RATIO = 1.0 / 3.0
"""Jets of one side of the surface lie at least this many `rho` apart."""
MIN_NORMAL_COSINE = 0.2
"""Minimum cosine between a jet's normal and that of a vertex in its fit."""
MAX_CURVATURE_RATIO = 2.0
"""Curvatures are bounded by this over `rho`; sharper ones are smoothed to it."""
EDGE = 1.5
"""A curvature this many times a jet's maximum comes from jets of different directions: an edge."""
OFF_ONE, FAR_OFF_ONE = 0.35, 0.6
"""f is nearly a distance, with a gradient of nearly unit length.  A deviation above the first bound
comes from jets of different directions: an edge.  Above the second, f = 0 beyond the rim of a thin
part, which is no surface."""
MIN_SUPPORT = 0.1
"""Minimum sum of the weights; on the mesh it is several times this, and less beyond a rim."""
MEMBERS_KNOWN = 0.1
"""Distance, in `rho`, over which a list of the supports around a point remains complete."""
STRIDE_RATIO = 0.4
"""Maximum step of a descent in `rho`, so that it never leaves the supports."""
REST_RATIO = 1e-3
"""A descent ends at a step below this many `rho`; it leaves nanometres, and some 1e-5 rad."""
APART_RATIO = 0.4
"""Nearest points farther apart than this, in `rho`, are distinct."""
MAX_DEVIATION_RATIO = 0.22
"""Maximum distance of the surface from the mesh in `rho`; otherwise `rho` is too long."""
MAX_EXTENT_FRACTION = 1.0 / 3.0
MAX_STARTS = 6
"""Number of further starts that are tried for the global nearest point."""
MIN_CURVATURE_FACTOR = 0.1
"""Near a centre of curvature, where I + h A is below this, a jet's nearest point is inaccurate."""
RIM_FRACTION = 0.8
"""From this fraction of a circle's radius on, the weight of what rises in it decreases."""
CHUNK = 2048

_IDENTITY = np.eye(3)
if TYPE_CHECKING:
    from scipy.spatial import cKDTree


def default_smoothing_m(vertices: Floats, triangles: Indices) -> float:
    """Return a smoothing length that hides the facets and preserves the form: 1.75 typical edges.

    Shorter lengths show facets, longer ones flatten what is curved over a few edges; see
    docs/shapes.md for figures.
    """
    run = half_edges(triangles)
    length = np.linalg.norm(vertices[run[:, 0]] - vertices[run[:, 1]], axis=1)
    return 1.75 * float(np.median(length))


class SmoothMeshShape:
    """Smooth a closed mesh over `smoothing_m`; see the module's text."""

    def __init__(self, vertices_m: Floats, triangles: NDArray[np.integer], smoothing_m: float):
        """Build the smooth surface of a closed mesh.

        Raises MeshError for a mesh that bounds no solid or is too small for this smoothing, and
        ValueError for a length that is not positive.
        """
        check_positive(smoothing_m=smoothing_m)
        vertices = np.asarray(vertices_m, dtype=np.float64)
        faces = np.asarray(triangles, dtype=np.int64)
        check_mesh(vertices, faces)
        extent = float(np.ptp(vertices[faces], axis=(0, 1)).max())
        if smoothing_m > MAX_EXTENT_FRACTION * extent:
            raise MeshError(
                f"smoothed over {smoothing_m * 1e3:.3g} mm little would be left of an object of "
                f"{extent * 1e3:.3g} mm; smooth over a shorter length"
            )
        self.smoothing_m = smoothing_m
        used = np.unique(faces)
        fine_vertices, fine = refine_facets(
            vertices[used], np.searchsorted(used, faces), smoothing_m
        )
        self._centre, self._normal, self._operator = _jets(fine_vertices, fine, smoothing_m)
        from scipy.spatial import cKDTree  # late, as all of scipy: processes must start quickly

        self._tree = cKDTree(self._centre)
        corners = fine_vertices[fine]
        middles = 0.5 * (corners + np.roll(corners, 1, axis=1))
        self._samples = np.concatenate(
            [fine_vertices, middles.reshape(-1, 3), corners.mean(axis=1)]
        )
        # How far from a jet the points can be to which it is the nearest.
        away, nearest = self._tree.query(self._samples)
        cover = np.zeros(len(self._centre))
        np.maximum.at(cover, nearest, away)
        self._cover = 1.1 * float(cover.max())
        self._table, self._counts = self._support_table(1.1 * cover)

    def deviation_m(self) -> float:
        """Return the largest distance of the mesh from the smooth surface.

        Vertices, midpoints of edges and centres of triangles are checked, which takes as long as
        some thousand queries.

        Raises MeshError where it is more than `MAX_DEVIATION_RATIO` of `smoothing_m`.
        """
        deviation = float(np.abs(self.closest(self._samples).height_m).max())
        if deviation > MAX_DEVIATION_RATIO * self.smoothing_m:
            raise MeshError(
                f"smoothed over {self.smoothing_m * 1e3:.3g} mm the surface leaves the mesh by "
                f"{deviation * 1e3:.3g} mm; smooth over a shorter length or refine the mesh"
            )
        return deviation

    def closest(self, points: ArrayLike, *, previous: ArrayLike | None = None) -> Nearest:
        """See `Shape`; undecided where two separate places are as near.

        `on_edge` where the surface is more sharply curved than `EDGE * MAX_CURVATURE_RATIO /
        smoothing_m`: at rims thinner than `smoothing_m` and at rounded edges, which a sheet cannot
        roll over.
        """
        queries = check_points(points)
        before = check_previous(previous, queries)
        if queries.ndim == 1 and before is not None:
            going_on = self._continue_from(queries, before)
            if going_on is not None:
                return going_on
        flat = queries.reshape(-1, 3)
        earlier = None if before is None else before.reshape(-1, 3)
        point, normal, operator = (np.empty((len(flat), *end)) for end in ((3,), (3,), (3, 3)))
        steepness, support = np.empty(len(flat)), np.empty(len(flat))
        undecided = np.zeros(len(flat), dtype=bool)
        for start in range(0, len(flat), CHUNK):
            part = slice(start, start + CHUNK)
            begun = None if earlier is None else earlier[part]
            feet, undecided[part] = self._project(flat[part], begun)
            point[part], normal[part] = feet.point, feet.normal
            operator[part], steepness[part] = feet.shape_operator, feet.steepness
            support[part] = feet.support
        height = ((flat - point) * normal).sum(-1)
        # The Frobenius norm, one to root two times the larger curvature: no eigenvalues needed.
        sharpness = np.sqrt(np.square(operator).sum((1, 2)))
        on_edge = sharpness > EDGE * MAX_CURVATURE_RATIO / self.smoothing_m
        on_edge |= (np.abs(steepness - 1.0) > OFF_ONE) | (support < MIN_SUPPORT)
        shape = queries.shape
        return Nearest(
            point.reshape(shape),
            normal.reshape(shape),
            height.reshape(shape[:-1]),
            operator.reshape((*shape, 3)),
            on_edge.reshape(shape[:-1]),
            undecided.reshape(shape[:-1]),
        )

    def signed_distance(self, points: ArrayLike) -> Floats:
        """See `Shape`."""
        return self.closest(points).height_m

    def _continue_from(self, query: Floats, before: Floats) -> Nearest | None:
        """Return `closest` for one query (3,) by a descent from the previous point.

        Returns None if that descent does not converge, which is rare.
        """
        feet = self._descend_one(query, before)
        if not feet.is_nearest[0]:
            return None
        point, normal, operator = feet.point[0], feet.normal[0], feet.shape_operator[0]
        edge = EDGE * MAX_CURVATURE_RATIO / self.smoothing_m
        on_edge = bool(
            float(np.einsum("ij,ij", operator, operator)) > edge * edge
            or abs(feet.steepness[0] - 1.0) > OFF_ONE
        )
        height = (query - point) @ normal
        return Nearest(
            point, normal, height, operator, np.array(on_edge), np.zeros((), dtype=np.bool_)
        )

    def _project(self, queries: Floats, before: Floats | None) -> tuple[SurfaceProjections, Bools]:
        """Return the nearest points of queries (n, 3), from previous points, and which are
        undecided.
        """
        if before is None:
            return self._nearest_of_all(queries)
        feet = self._descend(queries, before)
        undecided = np.zeros(len(queries), dtype=bool)
        lost = np.flatnonzero(~feet.is_nearest)
        if len(lost):
            found_again, undecided[lost] = self._nearest_of_all(queries[lost])
            _put(feet, lost, found_again)
        return feet, undecided

    def _nearest_of_all(self, queries: Floats) -> tuple[SurfaceProjections, Bools]:
        """Return the nearest points, whatever was found before.

        A descent from the nearest jet ends at distance D. Any nearer point has a jet within the
        cover c of it. By the bound on curvature, that jet is at most sqrt(D^2 + c^2 (1 + 4 D /
        rho)) away. Further descents start from the jets that `_select_starts` leaves of them.
        """
        nearest, rho = self._tree.query(queries)[1], self.smoothing_m
        start = self._centre[nearest]
        feet = self._descend(queries, self._on_jet(queries, nearest))
        distance = np.linalg.norm(queries - feet.point, axis=1)
        # A descent that ended farther away than it began went astray.
        begun = np.linalg.norm(queries - start, axis=1)
        feet.is_nearest[distance > begun + self._cover] = False
        distance = np.where(feet.is_nearest, distance, begun)
        slack = self._cover**2 * (1.0 + 2.0 * MAX_CURVATURE_RATIO * distance / rho)
        lists = self._tree.query_ball_point(queries, np.sqrt(distance**2 + slack))
        undecided = np.zeros(len(queries), dtype=bool)
        rows, jets = self._select_starts(queries, lists, feet.point, distance)
        if len(rows):
            other = self._descend(queries[rows], self._centre[jets])
            other_distance = np.linalg.norm(queries[rows] - other.point, axis=1)
            for i in np.flatnonzero(other.is_nearest):
                row, shorter = rows[i], distance[rows[i]] - other_distance[i]
                apart = float(np.linalg.norm(other.point[i] - feet.point[row])) > APART_RATIO * rho
                if shorter > EQUAL_DISTANCE_M or not feet.is_nearest[row]:
                    _put(feet, rows[i : i + 1], other, np.array([i]))
                    distance[row], undecided[row] = other_distance[i], False
                elif apart and shorter > -EQUAL_DISTANCE_M:
                    undecided[row] = True
        lost = np.flatnonzero(~feet.is_nearest)
        if len(lost):
            # At a rim that the jets do not close: the nearest jet itself.
            feet.point[lost], feet.normal[lost] = start[lost], self._normal[nearest[lost]]
            feet.shape_operator[lost] = self._operator[nearest[lost]]
            feet.support[lost], undecided[lost] = 0.0, True
        return feet, undecided

    def _select_starts(
        self, queries: Floats, lists: list[list[int]], feet: Floats, distance: Floats
    ) -> tuple[Indices, Indices]:
        """Select the jets from which a nearer point may be found; return rows of queries, and jets.

        The quadratic of such a jet has a nearest point that is a minimum, not far from the jet, and
        not much farther than `distance` (n,). Of jets within `rho` of one another, one is taken.
        Jets near the points `feet` that are known already are left out.
        """
        rows = np.repeat(np.arange(len(lists)), [len(one) for one in lists])
        jets = np.fromiter((jet for one in lists for jet in one), np.int64, len(rows))
        square = self.smoothing_m**2
        away = np.square(self._centre[jets] - feet[rows]).sum(1) > square
        rows, jets = rows[away], jets[away]
        if not len(rows):
            return rows, jets
        normal = self._normal[jets]
        offset = queries[rows] - self._centre[jets]
        height = (offset * normal).sum(1)[:, None]
        across = offset - height * normal
        values, vectors = np.linalg.eigh(_IDENTITY + height[:, :, None] * self._operator[jets])
        along = (np.swapaxes(vectors, 1, 2) @ across[:, :, None])[:, :, 0]
        # Feet of quadratics are rough, hence the room that is given.
        reach = 1.5 * self._cover * np.maximum(values, MIN_CURVATURE_FACTOR)
        hopeful = (values[:, 0] > 0.0) & (np.abs(along) <= reach).all(axis=1)
        rough_distance = np.linalg.norm(queries[rows] - self._on_jet(queries[rows], jets), axis=1)
        hopeful &= rough_distance < distance[rows] + self._cover
        rows, jets, offset = rows[hopeful], jets[hopeful], offset[hopeful]
        taken: dict[int, list[int]] = {}
        for i in np.argsort(np.square(offset).sum(1)):
            kept = taken.setdefault(int(rows[i]), [])
            apart = np.square(self._centre[jets[kept]] - self._centre[jets[i]]).sum(1) > square
            if len(kept) < MAX_STARTS and apart.all():
                kept.append(int(i))
        chosen = np.array(sorted(i for kept in taken.values() for i in kept), dtype=np.int64)
        return rows[chosen], jets[chosen]

    def _descend(self, queries: Floats, starts: Floats) -> SurfaceProjections:
        rho = self.smoothing_m
        feet = descend(
            self._level, queries, starts, stride_m=STRIDE_RATIO * rho, rest_m=REST_RATIO * rho
        )
        return _on_surface_only(feet)

    def _descend_one(self, query: Floats, start: Floats) -> SurfaceProjections:
        rho = self.smoothing_m
        feet = descend_one(
            _LevelNear(self, start),
            query,
            start,
            stride_m=STRIDE_RATIO * rho,
            rest_m=REST_RATIO * rho,
        )
        return _on_surface_only(feet)

    def rise_m(self, point: Floats, normal: Floats, radius_m: float) -> float:
        """See `Shape`; evaluated at the jets, which are closer to each other than `smoothing_m`."""
        offset = self._centre[:-1] - point
        height = offset @ normal
        across = np.einsum("ji,ji->j", offset, offset) - height * height
        within = np.flatnonzero((height > 0.0) & (across < radius_m * radius_m))
        if not len(within):
            return 0.0
        weight = (1.0 - np.sqrt(np.maximum(across[within], 0.0)) / radius_m) / (1.0 - RIM_FRACTION)
        return float((height[within] * np.minimum(weight, 1.0)).max())

    def _on_jet(self, queries: Floats, jet: Indices) -> Floats:
        """Return rough nearest points (n, 3) of queries on the quadratics of single jets (n,)."""
        normal, operator = self._normal[jet], self._operator[jet]
        offset = queries - self._centre[jet]
        height = (offset * normal).sum(1)[:, None]
        across = offset - height * normal
        # The first two terms of (I + h A)^-1, as long as it is a small correction.
        near = np.clip(height, -0.25 * self.smoothing_m, 0.25 * self.smoothing_m)
        along = across - near * (operator @ across[:, :, None])[:, :, 0]
        length = np.linalg.norm(along, axis=1, keepdims=True)
        along *= np.minimum(1.0, STRIDE_RATIO * self.smoothing_m / np.maximum(length, 1e-300))
        sag = 0.5 * np.einsum("ni,nij,nj->n", along, operator, along)
        return np.asarray(self._centre[jet] + along - sag[:, None] * normal)

    def _support_table(self, cover: Floats) -> tuple[Indices, Indices]:
        """Return, for each jet, the jets whose supports reach its neighbourhood, and their number.

        cover: (j,) radius of that neighbourhood: the points to which the jet is the nearest. Rows
        are padded with a jet at infinity.
        """
        reach = self.smoothing_m + cover + MEMBERS_KNOWN * self.smoothing_m
        lists = self._tree.query_ball_point(self._centre, reach)
        counts = np.array([len(one) for one in lists])
        table = np.full((len(lists), int(counts.max())), len(lists))
        for row, members in zip(table, lists, strict=True):
            row[: len(members)] = members
        self._centre = np.concatenate([self._centre, np.full((1, 3), 1e9)])
        self._normal = np.concatenate([self._normal, [[0.0, 0.0, 1.0]]])
        self._operator = np.concatenate([self._operator, np.zeros((1, 3, 3))])
        return table, counts

    def _level(self, points: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        """Evaluate f with its derivatives at points (n, 3) near the surface, see `LevelSet`.

        The support is the sum of the weights.
        """
        nearest = self._tree.query(points)[1]
        members = self._table[nearest, : self._counts[nearest].max()]
        normal, operator = self._normal[members], self._operator[members]
        offset = points[:, None, :] - self._centre[members]
        square = self.smoothing_m**2
        height = np.einsum("nki,nki->nk", offset, normal)
        inside = 1.0 - (np.einsum("nki,nki->nk", offset, offset) + FLATNESS * height**2) / square
        inside = np.maximum(inside, 0.0)
        weight = inside**4
        total = weight.sum(1)
        # Never on the way, by the stride; a start far off takes the nearest jet's alone.
        alone = total < 1e-12
        if alone.any():
            weight[alone] = members[alone] == nearest[alone, None]
            total[alone] = 1.0
        bent = (operator @ offset[..., None])[..., 0]
        distance = height + 0.5 * np.einsum("nki,nki->nk", offset, bent)
        slope = normal + bent
        # Derivatives of the weights: w' = -4 u^3 and w'' = 12 u^2 by t; dt = (2 / rho^2) lean.
        lean = offset + FLATNESS * height[..., None] * normal
        fall = (-8.0 / square) * inside**3
        value = (weight * distance).sum(1) / total
        excess = distance - value[:, None]
        pull = fall * excess
        gradient = (pull[:, None] @ lean + weight[:, None] @ slope)[:, 0] / total[:, None]
        sweep = (fall[:, None] @ lean)[:, 0]
        curl = (48.0 / square**2) * inside**2 * excess
        lean_t, normal_t = np.swapaxes(lean, 1, 2), np.swapaxes(normal, 1, 2)
        mixed = (lean_t * fall[:, None]) @ slope - gradient[:, :, None] * sweep[:, None, :]
        hessian = (lean_t * curl[:, None]) @ lean + mixed + np.swapaxes(mixed, 1, 2)
        hessian += pull.sum(1)[:, None, None] * _IDENTITY
        hessian += FLATNESS * ((normal_t * pull[:, None]) @ normal)
        count = len(points)
        hessian += (weight[:, None] @ operator.reshape(count, -1, 9)).reshape(count, 3, 3)
        return value, gradient, hessian / total[:, None, None], np.where(alone, 0.0, total)

    def surroundings(self, point: Floats) -> tuple[int, Indices, Floats, Floats, Floats]:
        """Return the jet nearest to a point (3,), and the jets whose supports may reach near it.

        Their centres (k, 3), normals (k, 3) and shape operators (k, 3, 3) follow.
        """
        nearest = int(self._tree.query(point)[1])
        members = self._table[nearest, : self._counts[nearest]]
        return (
            nearest,
            members,
            self._centre[members],
            self._normal[members],
            self._operator[members],
        )


class _LevelNear:
    """Evaluate `SmoothMeshShape._level` at the single points of one descent, see `LevelAt`.

    The list of jets is renewed only after a longer distance.
    """

    __slots__ = ("_asked_at", "_jets", "_shape")

    def __init__(self, shape: SmoothMeshShape, start: Floats) -> None:
        self._shape, self._asked_at = shape, start
        self._jets = shape.surroundings(start)

    def __call__(self, point: Triple) -> tuple[float, list[float], list[list[float]], float]:
        here, rho = np.array(point), self._shape.smoothing_m
        square, gone = rho**2, here - self._asked_at
        if gone @ gone > MEMBERS_KNOWN**2 * square:
            self._asked_at, self._jets = here, self._shape.surroundings(here)
        nearest, members, centre, normal, operator = self._jets
        offset = here - centre
        height = np.einsum("ki,ki->k", offset, normal)
        away = np.einsum("ki,ki->k", offset, offset) + FLATNESS * height * height
        inside = np.maximum(1.0 - away / square, 0.0)
        inside_2 = inside * inside
        weight = inside_2 * inside_2
        support = total = float(weight.sum())
        if total < 1e-12:
            weight, total, support = (members == nearest).astype(np.float64), 1.0, 0.0
        bent = np.einsum("kij,kj->ki", operator, offset)
        distance = height + 0.5 * np.einsum("ki,ki->k", offset, bent)
        slope = normal + bent
        lean = offset + (FLATNESS * height)[:, None] * normal
        fall = (-8.0 / square) * inside_2 * inside
        value = float(weight @ distance) / total
        excess = distance - value
        pull = fall * excess
        gradient = (pull @ lean + weight @ slope) / total
        curl = (48.0 / square**2) * inside_2 * excess
        mixed = (lean * fall[:, None]).T @ slope - gradient[:, None] * (fall @ lean)
        hessian = (lean * curl[:, None]).T @ lean + mixed + mixed.T
        hessian += FLATNESS * ((normal * pull[:, None]).T @ normal)
        hessian += (weight @ operator.reshape(-1, 9)).reshape(3, 3)
        hessian += float(pull.sum()) * _IDENTITY
        return value, gradient.tolist(), (hessian / total).tolist(), support


def _on_surface_only(feet: SurfaceProjections) -> SurfaceProjections:
    """Mark points where f = 0 beyond the rim of a thin part as not nearest."""
    beyond_rim = np.abs(feet.steepness - 1.0) > FAR_OFF_ONE
    feet.is_nearest[beyond_rim | (feet.support < MIN_SUPPORT)] = False
    return feet


def _put(
    feet: SurfaceProjections,
    rows: Indices,
    other: SurfaceProjections,
    chosen: Bools | slice = slice(None),
) -> None:
    """Store the chosen rows of other projections."""
    feet.point[rows], feet.normal[rows] = other.point[chosen], other.normal[chosen]
    feet.shape_operator[rows] = other.shape_operator[chosen]
    feet.steepness[rows], feet.support[rows] = other.steepness[chosen], other.support[chosen]
    feet.is_nearest[rows] = other.is_nearest[chosen]


def _jets(vertices: Floats, triangles: Indices, rho: float) -> tuple[Floats, Floats, Floats]:
    """Fit points (j, 3), normals (j, 3) and shape operators (j, 3, 3) about selected vertices."""
    rough = vertex_normals(vertices, triangles)
    from scipy.spatial import cKDTree

    tree = cKDTree(vertices)
    run = half_edges(triangles)
    order = np.argsort(run[:, 0], kind="stable")
    ring = np.split(run[order, 1], np.cumsum(np.bincount(run[:, 0], minlength=len(vertices)))[:-1])
    chosen = _thin_out(vertices, rough, tree, SPACING_RATIO * rho)
    points, normals, operators = np.empty((len(chosen), 3)), [], []
    for row, vertex in enumerate(chosen):
        ball = tree.query_ball_point(vertices[vertex], FIT_RATIO * rho)
        level = [i for i in ball if rough[i] @ rough[vertex] > MIN_NORMAL_COSINE]
        patch = _connected(int(vertex), set(level), ring)
        points[row], normal, operator = _jet(vertices[vertex], rough[vertex], vertices[patch], rho)
        normals.append(normal)
        operators.append(operator)
    return points, np.array(normals), np.array(operators)


def _thin_out(vertices: Floats, normals: Floats, tree: cKDTree, spacing: float) -> list[int]:
    """Select vertices such that no two on the same side are closer than `spacing`.

    Every other vertex has a selected one within that distance.
    """
    taken, covered = [], np.zeros(len(vertices), dtype=bool)
    for vertex in range(len(vertices)):
        if covered[vertex]:
            continue
        taken.append(vertex)
        near = np.array(tree.query_ball_point(vertices[vertex], spacing))
        covered[near[normals[near] @ normals[vertex] > 0.5]] = True
    return taken


def _connected(start: int, allowed: set[int], ring: list[Indices]) -> list[int]:
    """Return the allowed vertices that are connected to `start` through allowed ones."""
    found, edge = [start], [start]
    left = allowed - {start}
    while edge:
        reached = left.intersection(*[{j for i in edge for j in ring[i].tolist()}])
        left -= reached
        edge = sorted(reached)
        found += edge
    return found


def _jet(
    origin: Floats, rough: Floats, around: Floats, rho: float
) -> tuple[Floats, Floats, Floats]:
    """Fit the quadratic z(x, y) to points (m, 3); return point, normal (3,), shape operator (3, 3).

    z is along the rough normal; lengths are scaled by the fit's radius. For too few points the
    solution of least norm is taken.
    """
    reach = FIT_RATIO * rho
    first = np.cross(rough, _IDENTITY[np.abs(rough).argmin()])
    first /= np.linalg.norm(first)
    frame = np.stack([first, np.cross(rough, first), rough], axis=1)
    x, y, z = ((around - origin) @ frame).T / reach
    weight = np.maximum(1.0 - (x * x + y * y + z * z), 0.0) + 0.03
    terms = np.stack([np.ones_like(x), x, y, 0.5 * x * x, x * y, 0.5 * y * y], axis=1)
    solution = np.linalg.lstsq(terms * weight[:, None], z * weight, rcond=1e-6)[0]
    shift, slope_x, slope_y, xx, xy, yy = solution
    gradient = np.array([-slope_x, -slope_y, 1.0])
    steepness = float(np.linalg.norm(gradient))
    normal = gradient / steepness
    tangent = _IDENTITY - np.outer(normal, normal)
    graph = np.zeros((3, 3))
    graph[:2, :2] = -np.array([[xx, xy], [xy, yy]]) / (steepness * reach)
    values, vectors = np.linalg.eigh(tangent @ graph @ tangent)
    bound = MAX_CURVATURE_RATIO / rho
    bounded = np.clip(values, -bound, bound)
    turned = frame @ vectors
    operator = turned @ np.diag(bounded) @ turned.T
    normal = frame @ normal
    point = origin + shift * reach * rough
    if (bounded != values).any():
        # A blunter quadratic through the same point would bulge out of the edge: move it back in.
        offset = around - point
        distance = offset @ normal + 0.5 * np.einsum("mi,ij,mj->m", offset, operator, offset)
        point = point + (distance @ weight / weight.sum()) * normal
    return point, normal, operator
