"""Define the interface of shapes: nearest surface points with normals and curvature.

Points are (3,) or (n, 3) arrays in the object's frame, m; results have the same leading shape.
Normals point out of the object. Curvature is given as the shape operator W, a symmetric 3x3 matrix
with W n = 0. Along the surface the normal changes by dn = W dp. The two other eigenvalues are the
principal curvatures, positive where the object is convex (do Carmo, Differential Geometry of Curves
and Surfaces, ch. 3).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import atan2, cos, hypot, sin, sqrt
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

EQUAL_DISTANCE_M = 1e-6
"""Maximum difference of distances that are considered equal."""

MAX_QUERY_M = 1e6
"""Maximum distance of a query from the origin."""

FRONT = np.array([0.0, 0.0, 1.0])
"""Direction that is chosen if all surface points are equally near and there is no previous point.
It faces the user if the object is not rotated."""


@dataclass(frozen=True, slots=True)
class Nearest:
    """Touchable surface points nearest to queries, with the queries' leading shape.

    height_m: height of the query above the tangent plane at `point`, negative below it. It is the
        signed distance, except past an end of the surface.
    shape_operator: (..., 3, 3) at `point`, 1/m.
    on_edge: whether `point` is on the rim of the touchable surface with the query past its end, or
        on an edge of a mesh. A sheet can be tangent there but cannot roll over it.
    undecided: whether another point is equally near; `previous` or `FRONT` selected this one.
    """

    point: Floats
    normal: Floats
    height_m: Floats
    shape_operator: Floats
    on_edge: Bools
    undecided: Bools


class Shape(Protocol):
    """Interface of a solid with a touchable surface."""

    def closest(self, points: ArrayLike, *, previous: ArrayLike | None = None) -> Nearest:
        """Return the nearest touchable points.

        previous: surface points of the previous queries, shaped as `points`; None for a new
            contact. The local nearest point that continues them is returned as long as it exists,
            even if another point is equally near, or, inside the object, nearer.

        Raises ValueError for points that are not finite, not of shape (3,) or (n, 3), or beyond
        `MAX_QUERY_M`.
        """
        ...

    def signed_distance(self, points: ArrayLike) -> Floats:
        """Return the signed distance (m) to the solid, negative inside; errors as `closest`."""
        ...

    def rise_m(self, point: Floats, normal: Floats, radius_m: float) -> float:
        """Return the maximum height of the object above its tangent plane at a point (3,), m.

        Only the surface within `radius_m` of the point along that plane is considered; 0 where it
        is not concave. Heights near the rim of that circle have a smaller weight, so that the
        result is continuous.
        """
        ...


class Convex:
    """Base class of convex solids."""

    __slots__ = ()

    def rise_m(self, point: Floats, normal: Floats, radius_m: float) -> float:
        """Return 0: a convex solid is below its tangent planes."""
        return 0.0


def principal_curvatures(shape_operator: Floats, normal: Floats) -> tuple[Floats, Floats]:
    """Return the principal curvatures (..., 2), ascending, 1/m, and their directions (..., 2, 3).

    The directions are unit tangents; at an umbilic point they are any perpendicular pair.
    """
    # Shift the normal's eigenvalue, which is zero, away from the principal curvatures.
    bound = 1.0 + np.linalg.norm(shape_operator, axis=(-2, -1))
    outer = normal[..., :, None] * normal[..., None, :]
    values, vectors = np.linalg.eigh(shape_operator + 2.0 * bound[..., None, None] * outer)
    return values[..., :2], np.swapaxes(vectors, -1, -2)[..., :2, :]


def tightest_curvature(shape_operator: Floats) -> float:
    """Return the larger principal curvature (1/m) of a shape operator (3, 3).

    It is computed from k1 + k2 (trace) and k1^2 + k2^2 (squared Frobenius norm).
    """
    total = float(np.einsum("ii", shape_operator))
    squares = float(np.einsum("ij,ij", shape_operator, shape_operator))
    return 0.5 * (total + sqrt(max(2.0 * squares - total * total, 0.0)))


def projection_jacobian(found: Nearest) -> Floats:
    """Return the derivative (..., 3, 3) of the nearest point by the query: (I + h W)^-1 P.

    h is the height of the query and P projects onto the tangent plane. Raises LinAlgError at a
    centre of curvature, where I + h W is singular.
    """
    normal, operator = found.normal, found.shape_operator
    tangent = np.eye(3) - normal[..., :, None] * normal[..., None, :]
    height = np.asarray(found.height_m)[..., None, None]
    return np.asarray(np.linalg.solve(np.eye(3) + height * operator, tangent))


def check_points(points: ArrayLike, name: str = "points") -> Floats:
    """Return points as floats (3,) or (n, 3); raise ValueError for invalid ones."""
    array = np.asarray(points, dtype=np.float64)
    if array.ndim not in (1, 2) or array.shape[-1] != 3:
        raise ValueError(f"{name}: expected shape (3,) or (n, 3), found {array.shape}")
    # A comparison with NaN is false, hence the double negation.
    if array.size and not (np.abs(array) <= MAX_QUERY_M).all():
        raise ValueError(f"{name}: contains NaN, infinity or positions beyond {MAX_QUERY_M:g} m")
    return array


def check_previous(previous: ArrayLike | None, points: Floats) -> Floats | None:
    """Return previous points as floats; raise ValueError if their shape is not that of `points`."""
    if previous is None:
        return None
    array = check_points(previous, "previous")
    if array.shape != points.shape:
        raise ValueError(f"previous: expected shape {points.shape}, found {array.shape}")
    return array


def check_positive(**lengths_m: float) -> None:
    """Raise ValueError unless every length is a positive number."""
    for name, length in lengths_m.items():
        if not (np.isfinite(length) and length > 0.0):
            raise ValueError(f"{name}: {length} must be a positive length in metres")


LevelSet = Callable[[Floats], tuple[Floats, Floats, Floats, Floats]]
"""Function of points (n, 3) that returns values (n,), gradients (n, 3), Hessians (n, 3, 3) and
support (n,). It is zero on the surface and increases outwards."""


@dataclass(frozen=True, slots=True)
class SurfaceProjections:
    """Results of projections to the surface: points, normals (n, 3) and shape operators (n, 3, 3).

    steepness, support (n,): length of the level set's gradient, and its support. is_nearest (n,):
    whether the projection converged to a local minimum of the distance.
    """

    point: Floats
    normal: Floats
    shape_operator: Floats
    steepness: Floats
    support: Floats
    is_nearest: Bools


MAX_STEPS = 25
MIN_EIGENVALUE = 0.02
"""Lower bound on the absolute eigenvalues of the reduced Hessian, which are 1 on a flat surface.
Near a centre of curvature the full Newton step would be too long; beyond it, the sign changes."""


def descend(
    level: LevelSet, queries: Floats, starts: Floats, *, stride_m: float, rest_m: float
) -> SurfaceProjections:
    """Project `queries` (n, 3) to their nearest surface points, starting at `starts` (n, 3).

    Newton's method for min |x - q|^2 on f(x) = 0 (Nocedal and Wright, Numerical Optimization, ch.
    18). Each step moves to the surface along the gradient, and along the surface by the reduced
    system with the Lagrangian's Hessian I + lambda H. Its eigenvalues are made positive, so that
    each step is a descent. stride_m: maximum step. rest_m: step below which it has converged.
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
        # Bounded eigenvalues converge slowly, so the last step must be much shorter.
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
"""`LevelSet` for a single point, with Python numbers."""


def descend_one(
    level: LevelAt, query: Floats, start: Floats, *, stride_m: float, rest_m: float
) -> SurfaceProjections:
    """Project one query (3,) as `descend`, faster; the results have length one.

    The method is written out in the two tangent directions with Python numbers, because operations
    on small arrays are slow.
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
        # The Hessian's components in the tangent plane, and those between tangents and normal.
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
    # The normal is rotated by the tangential part of the last step.
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
    """Return two unit vectors that complete a unit vector to an orthonormal basis.

    Source: Duff et al., Building an Orthonormal Basis, Revisited, 2017.
    """
    side = 1.0 if z >= 0.0 else -1.0
    a = -1.0 / (side + z)
    b = x * y * a
    return (1.0 + side * x * x * a, side * b, -side * x), (b, side + y * y * a, -y)


def _downhill(
    b11: float, b12: float, b22: float, slope: tuple[float, float]
) -> tuple[float, float, float]:
    """Solve a symmetric 2x2 system with bounded eigenvalues.

    Returns the Newton step and the smaller eigenvalue.
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
