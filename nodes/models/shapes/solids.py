"""Define the virtual objects that simple formulas describe: cylinder, sphere, plane, ellipsoid and
box.

Each class implements the interface `Shape` of the module `surface`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from flexsheet.nodes.arrays import Bools, Floats
from flexsheet.nodes.models.shapes.surface import (
    EQUAL_DISTANCE_M,
    FRONT,
    Convex,
    Nearest,
    Triple,
    check_points,
    check_positive,
    check_previous,
    descend,
    descend_one,
)

_IDENTITY = np.eye(3)


@dataclass(frozen=True, slots=True)
class CylinderShape(Convex):
    """A circular cylinder about the x axis, centred on the origin.

    Only the lateral surface can be touched, because the sheet is stretched along x. For a finger
    beyond an end cap, the nearest point is on the rim of the lateral surface, and `on_edge` is
    true.
    """

    radius_m: float
    length_m: float

    def __post_init__(self) -> None:
        check_positive(radius_m=self.radius_m, length_m=self.length_m)

    def closest(self, points: ArrayLike, *, previous: ArrayLike | None = None) -> Nearest:
        """Find the points of the lateral surface nearest to `points`, as `Shape.closest` specifies.

        The nearest point is ambiguous for points on the axis.
        """
        queries = check_points(points)
        radial = queries * np.array([0.0, 1.0, 1.0])
        normal, radius, undecided = _directions(radial, previous, queries, across=(1, 2))
        half = 0.5 * self.length_m
        station = queries[..., 0]
        point = normal * self.radius_m
        point[..., 0] = np.clip(station, -half, half)
        axis = np.array([1.0, 0.0, 0.0])
        operator = (_IDENTITY - np.outer(axis, axis) - _outer(normal)) / self.radius_m
        beyond = np.asarray(np.abs(station) > half)
        return Nearest(point, normal, radius - self.radius_m, operator, beyond, undecided)

    def signed_distance(self, points: ArrayLike) -> Floats:
        """Return the signed distances (m) to the solid, including its end caps."""
        queries = check_points(points)
        aside = np.hypot(queries[..., 1], queries[..., 2]) - self.radius_m
        beyond = np.abs(queries[..., 0]) - 0.5 * self.length_m
        outside = np.hypot(np.maximum(aside, 0.0), np.maximum(beyond, 0.0))
        return np.asarray(outside + np.minimum(np.maximum(aside, beyond), 0.0))

    def angle_rad(self, point: Floats) -> float:
        """Return the angle (rad) of a point (3,) about the axis: 0 on +z, positive towards +y."""
        return float(np.arctan2(point[1], point[2]))


@dataclass(frozen=True, slots=True)
class SphereShape(Convex):
    """A sphere centred on the origin."""

    radius_m: float

    def __post_init__(self) -> None:
        check_positive(radius_m=self.radius_m)

    def closest(self, points: ArrayLike, *, previous: ArrayLike | None = None) -> Nearest:
        """Find the surface points nearest to `points` (n, 3) or (3,), as `Shape.closest` specifies.

        The nearest point is ambiguous for the centre.
        """
        queries = check_points(points)
        normal, radius, undecided = _directions(queries, previous, queries, across=(0, 1, 2))
        operator = (_IDENTITY - _outer(normal)) / self.radius_m
        nowhere = np.zeros(radius.shape, dtype=bool)
        point = normal * self.radius_m
        return Nearest(point, normal, radius - self.radius_m, operator, nowhere, undecided)

    def signed_distance(self, points: ArrayLike) -> Floats:
        return np.asarray(np.linalg.norm(check_points(points), axis=-1) - self.radius_m)


@dataclass(frozen=True, slots=True)
class PlaneShape(Convex):
    """The half-space z <= 0, which can be touched on a rectangle centred on the origin."""

    width_m: float
    height_m: float

    def __post_init__(self) -> None:
        check_positive(width_m=self.width_m, height_m=self.height_m)

    def closest(self, points: ArrayLike, *, previous: ArrayLike | None = None) -> Nearest:
        """Find the points of the rectangle nearest to `points`, as `Shape.closest` specifies.

        `on_edge` is true beyond the rectangle, whose width is along x and whose height is along y.
        """
        queries = check_points(points)
        check_previous(previous, queries)
        half = 0.5 * np.array([self.width_m, self.height_m, np.inf])
        point = np.clip(queries, -half, half)
        point[..., 2] = 0.0
        normal = np.broadcast_to(FRONT, queries.shape).copy()
        operator = np.zeros((*queries.shape, 3))
        beyond = np.asarray((np.abs(queries) > half).any(axis=-1))
        return Nearest(
            point, normal, queries[..., 2].copy(), operator, beyond, np.zeros_like(beyond)
        )

    def signed_distance(self, points: ArrayLike) -> Floats:
        """Return the signed distances (m) to the whole half-space, not only to the rectangle."""
        return check_points(points)[..., 2].copy()


@dataclass(frozen=True, slots=True)
class EllipsoidShape(Convex):
    """An ellipsoid centred on the origin, with semi-axes along x, y and z."""

    semi_axes_m: tuple[float, float, float]

    def __post_init__(self) -> None:
        for axis, length in zip("xyz", self.semi_axes_m, strict=True):
            check_positive(**{f"semi_axes_m ({axis})": length})

    def closest(self, points: ArrayLike, *, previous: ArrayLike | None = None) -> Nearest:
        """Find the surface points nearest to `points` (n, 3) or (3,), as `Shape.closest` specifies.

        The nearest point is ambiguous for some points in the central plane perpendicular to the
        shortest axis.
        """
        queries = check_points(points)
        before = check_previous(previous, queries)
        flat = queries.reshape(-1, 3)
        undecided = self._undecided(flat)
        if before is None:
            point = self._nearest(flat, np.broadcast_to(FRONT, flat.shape))
        else:
            starts = before.reshape(-1, 3)
            # The gradient vanishes at the centre, so the projection cannot start there.
            at_centre = np.linalg.norm(starts, axis=-1, keepdims=True) < EQUAL_DISTANCE_M
            starts = np.where(at_centre, FRONT * self.semi_axes_m, starts)
            min_axis_m = min(self.semi_axes_m)
            stride_m, rest_m = 0.5 * min_axis_m, 1e-7 * min_axis_m
            if len(flat) == 1:
                feet = descend_one(
                    self._level_at, flat[0], starts[0], stride_m=stride_m, rest_m=rest_m
                )
            else:
                feet = descend(self._level, flat, starts, stride_m=stride_m, rest_m=rest_m)
            point = feet.point
            lost = ~feet.is_nearest
            if lost.any():
                point[lost] = self._nearest(flat[lost], starts[lost])
        gradient = point / np.square(self.semi_axes_m)
        length = np.linalg.norm(gradient, axis=-1)
        normal = gradient / length[:, None]
        tangent = _IDENTITY - _outer(normal)
        hessian = np.diag(1.0 / np.square(self.semi_axes_m))
        operator = tangent @ hessian @ tangent / length[:, None, None]
        height = ((flat - point) * normal).sum(-1)
        on_edge = np.zeros(len(flat), dtype=bool)
        found = Nearest(point, normal, height, operator, on_edge, undecided)
        return found.reshape(queries.shape)

    def signed_distance(self, points: ArrayLike) -> Floats:
        return self.closest(points).height_m

    def _level(self, points: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        """Evaluate a quadratic function of points (n, 3) that is zero on the ellipsoid.

        Returns values (n,), gradients (n, 3), Hessians (n, 3, 3), and the number 1 for each point.
        The number means that the function is valid everywhere.
        """
        inverse = 1.0 / np.square(self.semi_axes_m)
        gradient = points * inverse
        value = 0.5 * ((points * gradient).sum(-1) - 1.0)
        hessian = np.broadcast_to(np.diag(inverse), (len(points), 3, 3))
        return value, gradient, hessian, np.ones(len(points))

    def _level_at(
        self, point: Triple
    ) -> tuple[float, Triple, tuple[Triple, Triple, Triple], float]:
        """Evaluate a quadratic function of one point (3,) that is zero on the ellipsoid.

        Returns the value, the gradient, the Hessian and the number 1, which means that the function
        is valid everywhere. Python numbers are used for speed. The method `_level` evaluates the
        same function for arrays of points.
        """
        (x, y, z), (a, b, c) = point, self.semi_axes_m
        p, q, r = 1.0 / (a * a), 1.0 / (b * b), 1.0 / (c * c)
        value = 0.5 * (x * x * p + y * y * q + z * z * r - 1.0)
        return value, (x * p, y * q, z * r), ((p, 0.0, 0.0), (0.0, q, 0.0), (0.0, 0.0, r)), 1.0

    def _undecided(self, queries: Floats) -> Bools:
        """Return whether each query (n, 3) has several equally near surface points.

        Such queries are in the plane through the centre, perpendicular to the shortest axis. In
        this plane, they are inside the ellipse whose vertices are the centres of curvature at the
        ends of the other axes.
        """
        axes = np.array(self.semi_axes_m)
        shortest = np.flatnonzero(axes <= axes.min() * (1.0 + 1e-9))
        others = np.setdiff1d(np.arange(3), shortest)
        focal = (axes[others] ** 2 - axes.min() ** 2) / axes[others]
        inside = (np.square(queries[:, others] / focal).sum(-1)) < 1.0
        on_plane = np.linalg.norm(queries[:, shortest], axis=-1) < EQUAL_DISTANCE_M
        return np.asarray(on_plane & inside)

    def _nearest(self, queries: Floats, sides: Floats) -> Floats:
        """Return the surface points (n, 3) that are globally nearest to queries (n, 3).

        Let e_i be the semi-axes. The point nearest to a query q is x_i = e_i^2 q_i / (t + e_i^2),
        where t is the largest root of sum (e_i q_i / (t + e_i^2))^2 = 1 (Eberly, Distance from a
        Point to an Ellipsoid, 2013). Newton's method is applied to the reciprocal of the square
        root of this sum. This function is concave in t, so the method converges monotonically
        (Conn, Gould, Toint, Trust-Region Methods, sec. 7.3). On a plane of symmetry, the terms have
        poles. Therefore queries on such a plane are moved by a billionth of the shortest axis in
        the directions `sides` (n, 3).
        """
        axes = np.array(self.semi_axes_m)
        nudge = 1e-9 * axes.min()
        towards = sides / np.maximum(np.linalg.norm(sides, axis=-1, keepdims=True), 1e-300)
        moved = np.where(np.abs(queries) < nudge, nudge * towards, queries)
        # If a component is still zero, choose the positive side.
        moved = np.where(np.abs(moved) < 1e-3 * nudge, 1e-3 * nudge, moved)
        size, squares = np.abs(moved) * axes, axes**2
        root = (size - squares).max(axis=-1)
        for _ in range(60):
            below = root[:, None] + squares
            squares_ratio = np.square(size / below)
            norm = np.sqrt(squares_ratio.sum(-1))
            step = (norm - 1.0) * norm**2 / (squares_ratio / below).sum(-1)
            root += step
            if not (np.abs(step) > 1e-15 * (np.abs(root) + squares.min())).any():
                break
        foot = squares * moved / (root[:, None] + squares)
        # Scale the points onto the surface, which removes the residual of the iteration.
        return np.asarray(foot / np.linalg.norm(foot / axes, axis=-1, keepdims=True))


@dataclass(frozen=True, slots=True)
class RoundedBoxShape(Convex):
    """A box centred on the origin, with rounded edges and corners.

    size_m: full extents along x, y and z, including the rounding.
    edge_radius_m: radius of edges and corners, at most half of the smallest extent.

    The shape contains all points within `edge_radius_m` of a smaller box, which is called the core.
    The normal is continuous along the surface, but the curvature is not.
    """

    size_m: tuple[float, float, float]
    edge_radius_m: float

    def __post_init__(self) -> None:
        for axis, length in zip("xyz", self.size_m, strict=True):
            check_positive(**{f"size_m ({axis})": length})
        check_positive(edge_radius_m=self.edge_radius_m)
        if 2.0 * self.edge_radius_m > min(self.size_m):
            raise ValueError(
                f"edge_radius_m: {self.edge_radius_m} is more than half the minimum extent in "
                f"size_m, {min(self.size_m)}; reduce edge_radius_m"
            )

    def closest(self, points: ArrayLike, *, previous: ArrayLike | None = None) -> Nearest:
        """Find the surface points nearest to `points` (n, 3) or (3,), as `Shape.closest` specifies.

        The nearest point is ambiguous for points inside the box that are equally near to two faces.
        """
        queries = check_points(points)
        before = check_previous(previous, queries)
        flat = queries.reshape(-1, 3)
        core = self._core()
        nearest_core = np.clip(flat, -core, core)
        normal = flat - nearest_core
        away = np.linalg.norm(normal, axis=-1)
        deep = away <= 1e-12
        normal[~deep] /= away[~deep, None]
        height = away - self.edge_radius_m
        undecided = np.zeros(len(flat), dtype=bool)
        if deep.any():
            earlier = None if before is None else before.reshape(-1, 3)[deep]
            axis, sign, margin, tied = self._nearest_face(flat[deep], earlier)
            rows = np.flatnonzero(deep)
            normal[rows] = 0.0
            normal[rows, axis] = sign
            nearest_core[rows, axis] = sign * core[axis]
            height[rows] = -margin - self.edge_radius_m
            undecided[rows] = tied
        rounded = (np.abs(normal) > 0.0)[:, :, None] * _IDENTITY
        flat_face = np.abs(normal).max(axis=-1) == 1.0
        operator = (rounded - _outer(normal)) / self.edge_radius_m
        operator[flat_face] = 0.0
        point = nearest_core + self.edge_radius_m * normal
        on_edge = np.zeros(len(flat), dtype=bool)
        found = Nearest(point, normal, height, operator, on_edge, undecided)
        return found.reshape(queries.shape)

    def signed_distance(self, points: ArrayLike) -> Floats:
        away = np.abs(check_points(points)) - self._core()
        outside = np.linalg.norm(np.maximum(away, 0.0), axis=-1)
        return np.asarray(outside + np.minimum(away.max(axis=-1), 0.0) - self.edge_radius_m)

    def _core(self) -> Floats:
        """Return the half extents (3,), m, of the core, the box that the rounding surrounds."""
        return 0.5 * np.array(self.size_m) - self.edge_radius_m

    def _nearest_face(
        self, queries: Floats, before: Floats | None
    ) -> tuple[np.ndarray[tuple[int], np.dtype[np.int64]], Floats, Floats, Bools]:
        """Return the nearest face of the core (inner box) for each query (n, 3) inside the core.

        before: previous nearest points (n, 3) on the rounded box; None if there are none. Only the
            faces next to a previous point are considered.

        If several faces are equally near, the first face in the order z, y, x, -z, -y, -x is
        chosen.

        Returns four arrays (n,): axis of the face's normal, sign of the normal, distance from the
        face (m), and whether several faces are equally near.
        """
        core = self._core()
        # Columns z, y, x, -z, -y, -x.
        margins = np.concatenate([core - queries, core + queries], axis=1)[:, [2, 1, 0, 5, 4, 3]]
        allowed = np.ones(margins.shape, dtype=bool)
        if before is not None:
            out = (before - np.clip(before, -core, core)) / self.edge_radius_m
            allowed = np.concatenate([out, -out], axis=1)[:, [2, 1, 0, 5, 4, 3]] > 0.5
            # Ignore a previous point that is not on the surface.
            allowed |= ~allowed.any(axis=1, keepdims=True)
        first = margins.min(axis=1)
        tied = (margins < first[:, None] + EQUAL_DISTANCE_M).sum(axis=1) > 1
        chosen = np.where(allowed, margins, np.inf)
        # The tolerance ensures that rounding errors do not decide between equally near faces.
        face = (chosen <= chosen.min(axis=1, keepdims=True) + 1e-12).argmax(axis=1)
        depth = margins[np.arange(len(face)), face]
        return 2 - face % 3, np.where(face < 3, 1.0, -1.0), depth, tied


def _outer(normal: Floats) -> Floats:
    return normal[..., :, None] * normal[..., None, :]


def _directions(
    offsets: Floats, previous: ArrayLike | None, queries: Floats, *, across: tuple[int, ...]
) -> tuple[Floats, Floats, Bools]:
    """Return unit directions and lengths of vectors (..., 3), and whether each vector is zero.

    offsets: vectors from an axis or centre of a solid to queries.
    previous: previous nearest points of the queries, or None.
    across: indices of the coordinates in which the vectors can differ from zero.

    A zero vector has no direction. Instead, the direction to the previous nearest point is
    returned, or `FRONT` if there is none.
    """
    before = check_previous(previous, queries)
    length = np.linalg.norm(offsets, axis=-1)
    undecided = length < EQUAL_DISTANCE_M
    direction = offsets
    if undecided.any():
        mask = np.zeros(3)
        mask[list(across)] = 1.0
        sides = np.broadcast_to(FRONT, offsets.shape) if before is None else before * mask
        is_zero = np.linalg.norm(sides, axis=-1) < EQUAL_DISTANCE_M
        sides = np.where(is_zero[..., None], FRONT, sides)
        direction = np.where(undecided[..., None], sides, offsets)
    unit = direction / np.linalg.norm(direction, axis=-1)[..., None]
    return unit, np.asarray(length), np.asarray(undecided)
