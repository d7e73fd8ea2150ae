"""Represent a closed triangle mesh as a smooth implicit surface.

A sheet that follows the flat facets of a mesh would change its orientation abruptly. Therefore the
surface is smoothed over the smoothing length `rho` (m), in two steps:

1. Local quadratic fits, called jets (Cazals and Pouget, Estimating Differential Quantities Using
    Polynomial Fitting of Osculating Jets, 2005): a quadratic is fitted by least squares around
    selected vertices. Jet i has a centre p_i, a unit normal n_i and a shape operator A_i (the
    derivative of the normal along the surface). With d = x - p_i, the signed distance of a point x
    to second order is s_i(x) = n_i d + d A_i d / 2.
2. Blending (partition of unity; Ohtake et al., Multi-level Partition of Unity Implicits, 2003):
    f(x) = sum w_i s_i / sum w_i. The weights are w_i = (1 - t_i)^4 with t_i = (d d + 3 (n_i d)^2) /
    rho^2, and w_i = 0 for t_i > 1. The surface is f = 0. The support of a jet is the region t_i <
    1, in which its weight is not zero.

f is three times continuously differentiable, so the normal has a continuous second derivative along
a path. The supports are flat: half as thick along the normal as wide across it. Therefore the two
sides of a thin part do not affect each other. Edges sharper than `rho` are rounded over about that
length. `deviation_m` is the resulting maximum distance between surface and mesh.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from flexsheet.nodes.arrays import Bools, Floats
from flexsheet.nodes.models.shapes.surface import (
    EQUAL_DISTANCE_M,
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
"""The flatness of the support (region of influence) of a jet, which is a local quadratic fit.

The thickness of the support along the jet's normal, divided by its width across the normal, is 1 /
sqrt(1 + FLATNESS).
"""
FIT_RATIO = 1.25
"""The radius of the neighbourhood in which vertices are used for a local quadratic fit, divided by
the smoothing length `rho`."""
SPACING_RATIO = 1.0 / 3.0
"""The minimum distance between jets (local quadratic fits) on the same side of the surface, divided
by the smoothing length `rho`."""
MIN_NORMAL_COSINE = 0.2
"""The minimum cosine of the angle between two normals. One is the normal of a local quadratic fit
(jet), and the other is the normal of a vertex in the fit."""
MAX_CURVATURE_RATIO = 2.0
"""The maximum product of the curvature (1/m) of a local quadratic fit (jet) and the smoothing
length `rho` (m)."""
EDGE = 1.5
"""The curvature above which a surface point counts as an edge, divided by the maximum curvature of
a local quadratic fit (jet)."""
OFF_ONE, FAR_OFF_ONE = 0.35, 0.6
"""Two limits of | |grad f| - 1 |, where f is the level set. This deviation is 0 where adjacent
local quadratic fits (jets) agree.

If the deviation exceeds the first limit, a surface point counts as an edge, where jets with
different normals meet. If it exceeds the second limit, a point with f = 0 does not represent the
mesh. Such points occur beyond the rim of a thin part.
"""
MIN_SUPPORT = 0.1
"""The minimum sum of the weights of local quadratic fits (jets) at a surface point. The sum is
smaller only beyond the rim of a thin part."""
MEMBERS_KNOWN = 0.1
"""The distance by which a point moves before its list of nearby local quadratic fits (jets) is
updated, divided by the smoothing length `rho`."""
STRIDE_RATIO = 0.4
"""The maximum step of the projection onto the surface, divided by the smoothing length `rho`.

Longer steps could leave the region in which the surface is defined.
"""
REST_RATIO = 1e-3
"""The step below which the projection onto the surface has converged, divided by the smoothing
length `rho`.

The remaining error is a few nanometres in the position and about 1e-5 rad in the normal.
"""
APART_RATIO = 0.4
"""The distance above which two surface points count as distinct, divided by the smoothing length
`rho`."""
MAX_DEVIATION_RATIO = 0.22
"""The maximum permitted distance between the smooth surface and the mesh, divided by the smoothing
length `rho`."""
MAX_EXTENT_FRACTION = 1.0 / 3.0
MAX_STARTS = 6
"""The maximum number of additional starting points in the search for the global nearest point."""
MIN_CURVATURE_FACTOR = 0.1
"""The lower bound on the eigenvalues of I + h A. h is the height above a surface point, and A is
the shape operator.

An eigenvalue is 0 at a centre of curvature.
"""
RIM_FRACTION = 0.8
"""The distance beyond which `rise_m` reduces the weight of heights, as a fraction of the maximum
distance `radius_m`."""
CHUNK = 2048

_IDENTITY = np.eye(3)
if TYPE_CHECKING:
    from scipy.spatial import cKDTree


def default_smoothing_m(vertices: Floats, triangles: Indices) -> float:
    """Return the default smoothing length (m) of a mesh: 1.75 times its median edge length.

    vertices (v, 3): positions, m.
    triangles (t, 3): indices of vertices.

    If the smoothing length were shorter, users would feel the facets. If it were longer, curved
    parts would be flattened.
    """
    run = half_edges(triangles)
    length = np.linalg.norm(vertices[run[:, 0]] - vertices[run[:, 1]], axis=1)
    return 1.75 * float(np.median(length))


class SmoothMeshShape:
    """A closed mesh with edges that are rounded over the length `smoothing_m`."""

    def __init__(self, vertices_m: Floats, triangles: NDArray[np.integer], smoothing_m: float):
        """Fit the local quadratics (jets) that define the smooth surface of a closed mesh.

        vertices_m (v, 3), triangles (t, 3): vertices of the mesh, and vertex indices.
        smoothing_m: smoothing length.

        Raises MeshError if the mesh does not bound a solid, or is too small for the smoothing
        length. Raises ValueError if the smoothing length is not positive.
        """
        check_positive(smoothing_m=smoothing_m)
        vertices = np.asarray(vertices_m, dtype=np.float64)
        faces = np.asarray(triangles, dtype=np.int64)
        check_mesh(vertices, faces)
        extent = float(np.ptp(vertices[faces], axis=(0, 1)).max())
        if smoothing_m > MAX_EXTENT_FRACTION * extent:
            raise MeshError(
                f"smoothing_m: {smoothing_m * 1e3:.3g} mm is more than a third of the object's "
                f"largest extent, {extent * 1e3:.3g} mm; reduce smoothing_m"
            )
        self.smoothing_m = smoothing_m
        used = np.unique(faces)
        fine_vertices, fine = refine_facets(
            vertices[used], np.searchsorted(used, faces), smoothing_m
        )
        self._centre, self._normal, self._operator = _jets(fine_vertices, fine, smoothing_m)
        from scipy.spatial import cKDTree  # imported late: scipy is slow to import

        self._tree = cKDTree(self._centre)
        corners = fine_vertices[fine]
        middles = 0.5 * (corners + np.roll(corners, 1, axis=1))
        self._samples = np.concatenate(
            [fine_vertices, middles.reshape(-1, 3), corners.mean(axis=1)]
        )
        # Maximum distance between each jet and the sample points whose nearest jet it is.
        away, nearest = self._tree.query(self._samples)
        cover = np.zeros(len(self._centre))
        np.maximum.at(cover, nearest, away)
        self._cover = 1.1 * float(cover.max())
        self._table, self._counts = self._support_table(1.1 * cover)

    def deviation_m(self) -> float:
        """Return the maximum distance (m) between the mesh and the smooth surface.

        The distance is evaluated at vertices, edge midpoints and triangle centres. Raises MeshError
        if the maximum exceeds `MAX_DEVIATION_RATIO` times `smoothing_m`.
        """
        deviation = float(np.abs(self.closest(self._samples).height_m).max())
        if deviation > MAX_DEVIATION_RATIO * self.smoothing_m:
            raise MeshError(
                f"smoothing_m: with {self.smoothing_m * 1e3:.3g} mm the surface deviates from the "
                f"mesh by {deviation * 1e3:.3g} mm; reduce smoothing_m or refine the mesh"
            )
        return deviation

    def closest(self, points: ArrayLike, *, previous: ArrayLike | None = None) -> Nearest:
        """Find the surface points nearest to `points` (n, 3) or (3,), as `Shape.closest` specifies.

        `on_edge` is true where the curvature exceeds `EDGE * MAX_CURVATURE_RATIO / smoothing_m`.
        This happens at rims thinner than `smoothing_m` and at rounded edges. A sheet cannot roll
        over such edges. `undecided` is true where two distinct surface points are equally near.
        """
        queries = check_points(points)
        before = check_previous(previous, queries)
        if queries.ndim == 1 and before is not None:
            continued = self._continue_from(queries, before)
            if continued is not None:
                return continued
        flat = queries.reshape(-1, 3)
        earlier = None if before is None else before.reshape(-1, 3)
        point, normal, operator = (np.empty((len(flat), *end)) for end in ((3,), (3,), (3, 3)))
        steepness, support = np.empty(len(flat)), np.empty(len(flat))
        undecided = np.zeros(len(flat), dtype=bool)
        for start in range(0, len(flat), CHUNK):
            part = slice(start, start + CHUNK)
            starts = None if earlier is None else earlier[part]
            feet, undecided[part] = self._project(flat[part], starts)
            point[part], normal[part] = feet.point, feet.normal
            operator[part], steepness[part] = feet.shape_operator, feet.steepness
            support[part] = feet.support
        height = ((flat - point) * normal).sum(-1)
        # The Frobenius norm is 1 to sqrt(2) times the larger curvature and needs no eigenvalues.
        sharpness = np.sqrt(np.square(operator).sum((1, 2)))
        on_edge = sharpness > EDGE * MAX_CURVATURE_RATIO / self.smoothing_m
        on_edge |= (np.abs(steepness - 1.0) > OFF_ONE) | (support < MIN_SUPPORT)
        found = Nearest(point, normal, height, operator, on_edge, undecided)
        return found.reshape(queries.shape)

    def signed_distance(self, points: ArrayLike) -> Floats:
        """Return the signed distances (m) of points to the solid, which are negative inside."""
        return self.closest(points).height_m

    def _continue_from(self, query: Floats, before: Floats) -> Nearest | None:
        """Find the surface point nearest to a query (3,), starting at the previous nearest point.

        Return None if the projection does not converge.
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
        """Return the surface points nearest to queries (n, 3), and whether each is ambiguous (n,).

        before: nearest points (n, 3) of the previous queries, or None if there are none.
        """
        if before is None:
            return self._find_global_nearest(queries)
        feet = self._descend(queries, before)
        undecided = np.zeros(len(queries), dtype=bool)
        lost = np.flatnonzero(~feet.is_nearest)
        if len(lost):
            replacement, undecided[lost] = self._find_global_nearest(queries[lost])
            _put(feet, lost, replacement)
        return feet, undecided

    def _find_global_nearest(self, queries: Floats) -> tuple[SurfaceProjections, Bools]:
        """Return the surface points nearest to queries (n, 3), and whether each is ambiguous.

        The surface is represented by local quadratic fits, called jets. Newton's method first
        projects each query to the surface from the nearest jet. The found point has the distance D
        from the query. A jet near a closer surface point is at most sqrt(D^2 + c^2 (1 + 4 D / rho))
        from the query. Here c is the maximum distance of a surface point from the nearest jet. The
        smoothing length rho limits the curvature. Newton's method is repeated from selected jets
        within this distance.
        """
        nearest, rho = self._tree.query(queries)[1], self.smoothing_m
        start = self._centre[nearest]
        feet = self._descend(queries, self._on_jet(queries, nearest))
        distance = np.linalg.norm(queries - feet.point, axis=1)
        # A projection that ended farther from the query than its start diverged.
        start_distance = np.linalg.norm(queries - start, axis=1)
        feet.is_nearest[distance > start_distance + self._cover] = False
        distance = np.where(feet.is_nearest, distance, start_distance)
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
            # At a rim that no jet covers, use the centre of the nearest jet as the nearest point.
            feet.point[lost], feet.normal[lost] = start[lost], self._normal[nearest[lost]]
            feet.shape_operator[lost] = self._operator[nearest[lost]]
            feet.support[lost], undecided[lost] = 0.0, True
        return feet, undecided

    def _select_starts(
        self, queries: Floats, lists: list[list[int]], feet: Floats, distance: Floats
    ) -> tuple[Indices, Indices]:
        """Choose further starting points for the search for a nearer surface point.

        lists: for each query, indices of the candidate jets (local quadratic fits of the surface).
        feet (n, 3), distance (n,): surface points found before, and their distances from the
            queries, m.

        Returns k pairs of a query and a jet, as query indices (k,) and jet indices (k,). A jet is
        chosen only if its quadratic can contain a point nearer to the query than `distance`. A jet
        is omitted if the surface point found before, or a chosen jet, is within the smoothing
        length.
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
        # The factor 1.5 allows for the error of the nearest point on a quadratic.
        reach = 1.5 * self._cover * np.maximum(values, MIN_CURVATURE_FACTOR)
        promising = (values[:, 0] > 0.0) & (np.abs(along) <= reach).all(axis=1)
        rough_distance = np.linalg.norm(queries[rows] - self._on_jet(queries[rows], jets), axis=1)
        promising &= rough_distance < distance[rows] + self._cover
        rows, jets, offset = rows[promising], jets[promising], offset[promising]
        selected: dict[int, list[int]] = {}
        for i in np.argsort(np.square(offset).sum(1)):
            starts = selected.setdefault(int(rows[i]), [])
            apart = np.square(self._centre[jets[starts]] - self._centre[jets[i]]).sum(1) > square
            if len(starts) < MAX_STARTS and apart.all():
                starts.append(int(i))
        chosen = np.array(sorted(i for some in selected.values() for i in some), dtype=np.int64)
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
        """Return the maximum height (m) of the object above its tangent plane at a surface point.

        The height is evaluated only at the centres of the local quadratic fits of the surface.
        """
        offset = self._centre[:-1] - point
        height = offset @ normal
        across = np.einsum("ji,ji->j", offset, offset) - height * height
        within = np.flatnonzero((height > 0.0) & (across < radius_m * radius_m))
        if not len(within):
            return 0.0
        weight = (1.0 - np.sqrt(np.maximum(across[within], 0.0)) / radius_m) / (1.0 - RIM_FRACTION)
        return float((height[within] * np.minimum(weight, 1.0)).max())

    def _on_jet(self, queries: Floats, jet: Indices) -> Floats:
        """Return points (n, 3) on local quadratic fits, approximately nearest to queries (n, 3).

        jet (n,): index of the quadratic fit for each query.
        """
        normal, operator = self._normal[jet], self._operator[jet]
        offset = queries - self._centre[jet]
        height = (offset * normal).sum(1)[:, None]
        across = offset - height * normal
        # Use the first two terms of the series of (I + h A)^-1, which is valid for small h only.
        near = np.clip(height, -0.25 * self.smoothing_m, 0.25 * self.smoothing_m)
        along = across - near * (operator @ across[:, :, None])[:, :, 0]
        length = np.linalg.norm(along, axis=1, keepdims=True)
        along *= np.minimum(1.0, STRIDE_RATIO * self.smoothing_m / np.maximum(length, 1e-300))
        sag = 0.5 * np.einsum("ni,nij,nj->n", along, operator, along)
        return np.asarray(self._centre[jet] + along - sag[:, None] * normal)

    def _support_table(self, cover: Floats) -> tuple[Indices, Indices]:
        """List the local quadratic fits (jets) that influence the surface near each jet.

        cover (j,): radius (m) of the considered neighbourhood of each jet.

        Returns a table (j, k) of jet indices, and the number (j,) of valid entries in each row.
        Rows are padded with the index of an additional jet that has no influence. This method
        appends that jet.
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
        """Evaluate the implicit function whose zero level set is the surface, at points (n, 3).

        Returns the values (n,), gradients (n, 3) and Hessians (n, 3, 3) of the function. A fourth
        result is the sum (n,) of the weights of the local quadratic fits at each point.
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
        # A starting point far from the surface may be outside all supports: use the nearest jet.
        alone = total < 1e-12
        if alone.any():
            weight[alone] = members[alone] == nearest[alone, None]
            total[alone] = 1.0
        bent = (operator @ offset[..., None])[..., 0]
        distance = height + 0.5 * np.einsum("nki,nki->nk", offset, bent)
        slope = normal + bent
        # With u = 1 - t, the weight u^4 has the derivatives -4 u^3 and 12 u^2 with respect to t.
        # The gradient of t is (2 / rho^2) lean.
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
        """Return the local quadratic fits (jets) of the surface around a point (3,).

        The first result is the index of the nearest jet. The other results describe the k jets that
        may have a weight above zero near the point: indices (k,), centres (k, 3), normals (k, 3)
        and shape operators (k, 3, 3).
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
    """The implicit function of a smoothed mesh, for the projection of one query to the surface.

    The function is a weighted mean of local quadratic fits, and is zero on the surface. To save
    time, the list of nearby fits is updated only after a motion of `MEMBERS_KNOWN` times the
    smoothing length.
    """

    __slots__ = ("_jets", "_jets_point", "_shape")

    def __init__(self, shape: SmoothMeshShape, start: Floats) -> None:
        self._shape, self._jets_point = shape, start
        self._jets = shape.surroundings(start)

    def __call__(self, point: Triple) -> tuple[float, list[float], list[list[float]], float]:
        here, rho = np.array(point), self._shape.smoothing_m
        square, moved = rho**2, here - self._jets_point
        if moved @ moved > MEMBERS_KNOWN**2 * square:
            self._jets_point, self._jets = here, self._shape.surroundings(here)
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
    """Mark projections as invalid if they ended beyond the rim of a thin part of the mesh.

    The attribute `is_nearest` is set to false. Beyond the rim, the implicit function can be zero at
    points that are not on the mesh.
    """
    beyond_rim = np.abs(feet.steepness - 1.0) > FAR_OFF_ONE
    feet.is_nearest[beyond_rim | (feet.support < MIN_SUPPORT)] = False
    return feet


def _put(
    feet: SurfaceProjections,
    rows: Indices,
    other: SurfaceProjections,
    chosen: Bools | slice = slice(None),
) -> None:
    """Replace rows of the arrays in `feet` (surface projections) by rows of `other`, in place.

    rows: indices of the replaced rows.
    chosen: mask or slice that selects the rows of `other`.
    """
    feet.point[rows], feet.normal[rows] = other.point[chosen], other.normal[chosen]
    feet.shape_operator[rows] = other.shape_operator[chosen]
    feet.steepness[rows], feet.support[rows] = other.steepness[chosen], other.support[chosen]
    feet.is_nearest[rows] = other.is_nearest[chosen]


def _jets(vertices: Floats, triangles: Indices, rho: float) -> tuple[Floats, Floats, Floats]:
    """Fit the jets (local quadratics) of a mesh with the smoothing length `rho` (m).

    Return centres (j, 3), normals (j, 3) and shape operators (j, 3, 3).
    """
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
    """Select vertices at least `spacing` (m) apart on each side of thin parts; return indices.

    Every vertex that is not selected has a selected vertex within `spacing` on the same side.
    """
    selected, covered = [], np.zeros(len(vertices), dtype=bool)
    for vertex in range(len(vertices)):
        if covered[vertex]:
            continue
        selected.append(vertex)
        near = np.array(tree.query_ball_point(vertices[vertex], spacing))
        covered[near[normals[near] @ normals[vertex] > 0.5]] = True
    return selected


def _connected(start: int, allowed: set[int], ring: list[Indices]) -> list[int]:
    """Return the allowed vertices that are connected to `start` through allowed vertices.

    ring: indices of the neighbours of each vertex.
    """
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
    """Fit a quadratic z(x, y) to m points `around` (m, 3) by weighted least squares.

    origin, rough (3,): vertex, and approximate normal at this vertex, which defines the z axis.

    Lengths are scaled by the radius of the fit. If there are too few points, the solution of
    minimum norm is used. Return the centre (3,), the normal (3,) and the shape operator (3, 3).
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
    rotated = frame @ vectors
    operator = rotated @ np.diag(bounded) @ rotated.T
    normal = frame @ normal
    point = origin + shift * reach * rough
    if (bounded != values).any():
        # Bounding the curvature moves the quadratic outside a sharp edge; shift it back inwards.
        offset = around - point
        distance = offset @ normal + 0.5 * np.einsum("mi,ij,mj->m", offset, operator, offset)
        point = point + (distance @ weight / weight.sum()) * normal
    return point, normal, operator
