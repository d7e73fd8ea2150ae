"""Define the interface of shapes, which return nearest surface points with normals and curvatures.

Points are arrays (3,) or (n, 3), in m, in the frame of the object. Results have the same leading
shape. A query is a point for which the nearest surface point is searched. Normals point out of the
object. The shape operator W, a symmetric matrix (3, 3), describes the curvature. For a small
displacement dp along the surface, the unit normal n changes by dn = W dp. In addition, W n = 0. The
two other eigenvalues of W are the principal curvatures, positive where the object is convex (do
Carmo, Differential Geometry of Curves and Surfaces, ch. 3).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import atan2, cos, hypot, sin, sqrt
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from flexsheet.nodes.arrays import Bools, Floats

EQUAL_DISTANCE_M = 1e-6
"""The maximum difference between two distances that are considered equal."""

MAX_QUERY_M = 1e6
"""The maximum absolute coordinate of a query."""

FRONT = np.array([0.0, 0.0, 1.0])
"""The direction that selects the nearest point if several surface points are equally near.

This direction is used if there is no previous point. If the object is not rotated, the direction
points to the user.
"""


@dataclass(frozen=True, slots=True)
class Nearest:
    """The touchable surface points that are nearest to given points (queries).

    point (..., 3), normal (..., 3): nearest point, m, and unit normal at this point.
    height_m: height (...) of the query above the tangent plane at `point`, negative below this
        plane. It equals the signed distance, unless the query is beyond the edge of the touchable
        surface.
    shape_operator: shape operator (..., 3, 3) at `point`, 1/m.
    on_edge: whether `point` is on an edge of a mesh, or whether the query is beyond the edge of the
        touchable surface. A sheet can touch such a point but cannot roll over it.
    undecided: whether another surface point is equally near. In this case, the point nearer to the
        previous result is returned. Without a previous result, the constant direction `FRONT`
        decides.
    """

    point: Floats
    normal: Floats
    height_m: Floats
    shape_operator: Floats
    on_edge: Bools
    undecided: Bools

    def reshape(self, shape: tuple[int, ...]) -> Nearest:
        """Return a copy of the results whose arrays match queries of the shape (3,) or (n, 3)."""
        return Nearest(
            self.point.reshape(shape),
            self.normal.reshape(shape),
            self.height_m.reshape(shape[:-1]),
            self.shape_operator.reshape((*shape, 3)),
            self.on_edge.reshape(shape[:-1]),
            self.undecided.reshape(shape[:-1]),
        )


class Shape(Protocol):
    """The interface of a solid with a touchable surface."""

    def closest(self, points: ArrayLike, *, previous: ArrayLike | None = None) -> Nearest:
        """Find the touchable surface points that are nearest to `points`.

        previous: nearest points of the previous queries, with the shape of `points`; None if the
            contact is new. The search then follows each point continuously, even if another surface
            point is equally near. Inside the object, another point can even be nearer.

        Raises ValueError if a coordinate is not finite or exceeds `MAX_QUERY_M`, or if the shape of
        the array is neither (3,) nor (n, 3).
        """
        ...

    def signed_distance(self, points: ArrayLike) -> Floats:
        """Return the signed distances (m) from points to the solid, which are negative inside.

        Raises ValueError if a coordinate is not finite or exceeds `MAX_QUERY_M`, or if the shape of
        the array is neither (3,) nor (n, 3).
        """
        ...

    def rise_m(self, point: Floats, normal: Floats, radius_m: float) -> float:
        """Return the maximum height (m) of the object above its tangent plane at a surface point.

        point, normal (3,): surface point, m, and unit normal at this point.
        radius_m: maximum considered distance from the point, measured along the plane.

        The result is 0 if the object is not concave near the point. Heights near the limit of the
        radius are reduced, so that the result changes continuously with the point.
        """
        ...


class Convex:
    """The base class of convex solids, which never rise above their tangent planes."""

    __slots__ = ()

    def rise_m(self, point: Floats, normal: Floats, radius_m: float) -> float:
        """Return 0, because a convex solid is never above its tangent plane."""
        return 0.0


def principal_curvatures(shape_operator: Floats, normal: Floats) -> tuple[Floats, Floats]:
    """Return the principal curvatures (..., 2), ascending, 1/m, and their directions (..., 2, 3).

    normal (..., 3): unit normal. The directions are unit tangents. If both curvatures are equal,
        any two perpendicular directions are returned.
    """
    # The eigenvalue of the normal is zero; shift it above the principal curvatures.
    bound = 1.0 + np.linalg.norm(shape_operator, axis=(-2, -1))
    outer = normal[..., :, None] * normal[..., None, :]
    values, vectors = np.linalg.eigh(shape_operator + 2.0 * bound[..., None, None] * outer)
    return values[..., :2], np.swapaxes(vectors, -1, -2)[..., :2, :]


def tightest_curvature(shape_operator: Floats) -> float:
    """Return the larger principal curvature (1/m) of a shape operator (3, 3).

    The trace of the operator is the sum of both curvatures, and its squared Frobenius norm is the
    sum of their squares.
    """
    total = float(np.einsum("ii", shape_operator))
    squares = float(np.einsum("ij,ij", shape_operator, shape_operator))
    return 0.5 * (total + sqrt(max(2.0 * squares - total * total, 0.0)))


def projection_jacobian(found: Nearest) -> Floats:
    """Return the derivative (..., 3, 3) of the nearest point with respect to the query.

    The derivative is (I + h W)^-1 P with the height h of the query, the shape operator W and the
    projection P onto the tangent plane. Raises LinAlgError at a centre of curvature, where I + h W
    is singular.
    """
    normal, operator = found.normal, found.shape_operator
    tangent = np.eye(3) - normal[..., :, None] * normal[..., None, :]
    height = np.asarray(found.height_m)[..., None, None]
    return np.asarray(np.linalg.solve(np.eye(3) + height * operator, tangent))


def check_points(points: ArrayLike, name: str = "points") -> Floats:
    """Convert points to a float array (3,) or (n, 3). Raises ValueError if the points are invalid.

    name: name of the argument in error texts.
    """
    array = np.asarray(points, dtype=np.float64)
    if array.ndim not in (1, 2) or array.shape[-1] != 3:
        raise ValueError(f"{name}: the shape is {array.shape}, expected (3,) or (n, 3)")
    # A comparison with NaN is false, hence the double negation.
    if array.size and not (np.abs(array) <= MAX_QUERY_M).all():
        raise ValueError(
            f"{name}: the array contains NaN, infinity or coordinates beyond {MAX_QUERY_M:g} m; "
            "give finite coordinates in metres"
        )
    return array


def check_previous(previous: ArrayLike | None, points: Floats) -> Floats | None:
    """Convert the previous nearest points to a float array, or return None if there are none.

    Raises ValueError if the shape differs from the shape of `points`.
    """
    if previous is None:
        return None
    array = check_points(previous, "previous")
    if array.shape != points.shape:
        raise ValueError(f"previous: the shape is {array.shape}, expected {points.shape}")
    return array


def check_positive(**lengths_m: float) -> None:
    """Raise ValueError unless every length is a positive number."""
    for name, length in lengths_m.items():
        if not (np.isfinite(length) and length > 0.0):
            raise ValueError(f"{name}: {length} must be a positive length in metres")


LevelSet = Callable[[Floats], tuple[Floats, Floats, Floats, Floats]]
"""A function f of points (n, 3) that describes a surface by f = 0 and increases outwards.

The function returns values (n,), gradients (n, 3), Hessians (n, 3, 3) and supports (n,). The
support is a measure of the validity of f at a point, and is 0 far away from the surface.
"""


@dataclass(frozen=True, slots=True)
class SurfaceProjections:
    """The results of the projection of n queries onto a surface that an implicit function defines.

    point, normal (n, 3): surface points, m, and unit normals.
    shape_operator (n, 3, 3): shape operators, 1/m.
    steepness (n,): length of the gradient of the implicit function.
    support (n,): measure of the validity of the implicit function at each point; 0 far away from
        the surface.
    is_nearest (n,): whether the projection converged to a local minimum of the distance.
    """

    point: Floats
    normal: Floats
    shape_operator: Floats
    steepness: Floats
    support: Floats
    is_nearest: Bools


MAX_STEPS = 25
MIN_EIGENVALUE = 0.02
"""The lower bound on the absolute eigenvalues of the reduced Hessian in the search for nearest
points.

The eigenvalues are 1 on a flat surface. Near a centre of curvature, they approach 0, and a Newton
step would be too long. Beyond this centre, they are negative.
"""


def descend(
    level: LevelSet, queries: Floats, starts: Floats, *, stride_m: float, rest_m: float
) -> SurfaceProjections:
    """Project `queries` (n, 3) to their nearest surface points, starting at `starts` (n, 3), m.

    stride_m: maximum step.
    rest_m: step below which the method has converged.

    Newton's method minimises |x - q|^2 for each query q on the surface f(x) = 0 (Nocedal and
    Wright, Numerical Optimization, ch. 18). A step has a part along the gradient, towards the
    surface, and a part along the surface. The second part solves the reduced system with the
    Hessian I + lambda H of the Lagrangian. H is the Hessian of f, and lambda is the multiplier. The
    eigenvalues of this Hessian are made positive, so that each step reduces the distance.
    """
    count = len(queries)
    point = np.array(starts, dtype=np.float64)
    normal, operator = np.empty((count, 3)), np.empty((count, 3, 3))
    steepness, support = np.empty(count), np.empty(count)
    is_nearest = np.zeros(count, dtype=bool)
    moving = np.arange(count)
    for _ in range(MAX_STEPS):
        x = point[moving]
        value, gradient, hessian, known = level(x)
        square = (gradient * gradient).sum(-1)
        length = np.sqrt(square)
        unit = gradient / length[:, None]
        outward = unit[:, :, None] * unit[:, None, :]
        tangent = _IDENTITY - outward
        offset = queries[moving] - x
        multiplier = (offset * gradient).sum(-1) / square
        bend = _IDENTITY + multiplier[:, None, None] * hessian
        fall = (-value / square)[:, None] * gradient
        slope = tangent @ (offset[:, :, None] - bend @ fall[:, :, None])
        values, vectors = np.linalg.eigh(tangent @ bend @ tangent + outward)
        bounded = np.maximum(np.abs(values), MIN_EIGENVALUE)
        along = np.swapaxes(vectors, 1, 2) @ slope / bounded[:, :, None]
        step = (vectors @ along)[:, :, 0] + fall
        size = np.sqrt((step * step).sum(-1))
        step *= np.minimum(1.0, stride_m / np.maximum(size, 1e-300))[:, None]
        weingarten = tangent @ hessian @ tangent / length[:, None, None]
        rotated = unit + (weingarten @ step[:, :, None])[:, :, 0]
        point[moving] = x + step
        normal[moving] = rotated / np.sqrt((rotated * rotated).sum(-1))[:, None]
        operator[moving] = weingarten
        # With bounded eigenvalues convergence is slow, so the last step must be much shorter.
        slow = values[:, 0] < MIN_EIGENVALUE
        resting = size <= np.where(slow, 1e-3 * rest_m, rest_m)
        steepness[moving], support[moving] = length, known
        is_nearest[moving] = resting & (values[:, 0] > 0.0)
        if resting.all():
            break
        moving = moving[~resting]
    return SurfaceProjections(point, normal, operator, steepness, support, is_nearest)


_IDENTITY = np.eye(3)

Triple = tuple[float, float, float]
LevelAt = Callable[[Triple], tuple[float, Sequence[float], Sequence[Sequence[float]], float]]
"""A function like `LevelSet` for a single point, with Python numbers for speed.

The function returns the value, the gradient (3,), the Hessian (3, 3) and the support.
"""


def descend_one(
    level: LevelAt, query: Floats, start: Floats, *, stride_m: float, rest_m: float
) -> SurfaceProjections:
    """Project one query (3,) by the method of `descend`. The result arrays have the length one.

    The computation with Python numbers is faster than operations on small arrays.
    """
    qx, qy, qz = query.tolist()
    x, y, z = start.tolist()
    is_nearest = False
    for _ in range(MAX_STEPS):
        value, (gx, gy, gz), hessian, support = level((x, y, z))
        square = max(gx * gx + gy * gy + gz * gz, 1e-300)
        length = sqrt(square)
        ux, uy, uz = gx / length, gy / length, gz / length
        e, f = _tangents(ux, uy, uz)
        he, hf = _times(hessian, e), _times(hessian, f)
        ox, oy, oz = qx - x, qy - y, qz - z
        multiplier = (ox * gx + oy * gy + oz * gz) / square
        fall = -value / length
        # Components of the Hessian in the tangent plane, then those between tangents and normal.
        h11, h12, h22 = _dot(e, he), _dot(f, he), _dot(f, hf)
        h1n, h2n = _dot((ux, uy, uz), he), _dot((ux, uy, uz), hf)
        slope = (
            _dot(e, (ox, oy, oz)) - multiplier * fall * h1n,
            _dot(f, (ox, oy, oz)) - multiplier * fall * h2n,
        )
        t1, t2, low = _downhill(
            1.0 + multiplier * h11, multiplier * h12, 1.0 + multiplier * h22, slope
        )
        size = sqrt(t1 * t1 + t2 * t2 + fall * fall)
        fraction = min(1.0, stride_m / max(size, 1e-300))
        t1, t2, fall = fraction * t1, fraction * t2, fraction * fall
        x += t1 * e[0] + t2 * f[0] + fall * ux
        y += t1 * e[1] + t2 * f[1] + fall * uy
        z += t1 * e[2] + t2 * f[2] + fall * uz
        if size <= (rest_m if low >= MIN_EIGENVALUE else 1e-3 * rest_m):
            is_nearest = low > 0.0
            break
    basis = np.array([e, f])
    inner = np.array([[h11, h12], [h12, h22]]) / length
    # Rotate the normal according to the tangential part of the last step.
    rotated = np.array([ux, uy, uz]) + np.array([t1, t2]) @ inner @ basis
    return SurfaceProjections(
        np.array([[x, y, z]]),
        (rotated / sqrt(rotated @ rotated))[None],
        (basis.T @ inner @ basis)[None],
        np.array([length]),
        np.array([support]),
        np.array([is_nearest]),
    )


def _tangents(x: float, y: float, z: float) -> tuple[Triple, Triple]:
    """Return two unit vectors that form an orthonormal basis with the unit vector (x, y, z).

    Source: Duff et al., Building an Orthonormal Basis, Revisited, 2017.
    """
    side = 1.0 if z >= 0.0 else -1.0
    a = -1.0 / (side + z)
    b = x * y * a
    return (1.0 + side * x * x * a, side * b, -side * x), (b, side + y * y * a, -y)


def _downhill(
    b11: float, b12: float, b22: float, slope: tuple[float, float]
) -> tuple[float, float, float]:
    """Solve the symmetric 2x2 system of a Newton step, after its eigenvalues are made positive.

    b11, b12, b22: entries of the matrix.
    slope: right-hand side.

    Return the two components of the step and the smaller eigenvalue of the original matrix.
    """
    middle, spread = 0.5 * (b11 + b22), hypot(0.5 * (b11 - b22), b12)
    angle = 0.5 * atan2(2.0 * b12, b11 - b22)
    c, s = cos(angle), sin(angle)
    along_high = (c * slope[0] + s * slope[1]) / max(abs(middle + spread), MIN_EIGENVALUE)
    along_low = (c * slope[1] - s * slope[0]) / max(abs(middle - spread), MIN_EIGENVALUE)
    return c * along_high - s * along_low, s * along_high + c * along_low, middle - spread


def _dot(a: Triple, b: Triple) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _times(matrix: Sequence[Sequence[float]], vector: Triple) -> Triple:
    x, y, z = vector
    (a, b, c), (d, e, f), (g, h, i) = matrix
    return a * x + b * y + c * z, d * x + e * y + f * z, g * x + h * y + i * z
