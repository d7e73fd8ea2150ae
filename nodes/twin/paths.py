"""Map finger paths onto the scene's object, within the range of the arms, and read recorded paths.

A surface position is (along, arc, height) in metres. The position (0, 0, 0) is the front of the
object, which is the point that faces the user. From there, `along` is the distance on the surface
in the direction of the object's x axis. Then `arc` is the distance at right angles to this
direction. `height` is the distance from the surface, negative inside the object. Motions that are
defined in surface positions apply to the object of any scene.
"""

from __future__ import annotations

import pickle

import numpy as np
import scipy

from flexsheet.messages.scene import Scene
from flexsheet.messages.types import FingerPath
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.models.rigid import apply, pose_matrix
from flexsheet.nodes.models.shapes import Nearest, Shape, make_shape
from flexsheet.nodes.twin.finger import FingerPathError, SmoothPath

FAR_M = 2.0  # distance of an imaginary viewer
MAX_DISTANCE_M = 0.5  # maximum length of geodesics, the straightest lines on the surface
STRIDE_M = 0.001  # step along a geodesic
GRID_M = 0.003  # spacing of the interpolation grid

# Fractions that a finger can stroke.
WITHIN_ENDS = 0.8  # of the length of an object with ends
OF_WIDTH = 0.7  # of the width of the sheet
OF_HEIGHT = 0.9  # of the usable half-height of the sheet

MAX_CACHED_SURFACE_MAPS = 4
_SURFACE_MAPS: dict[bytes, SurfaceMap] = {}

SPEED_FRACTION = 0.8
"""The maximum speed of a path, as a fraction of the scene's maximum finger speed. The difference is
a reserve for wander and tremor, which are added to the path."""

PRESS_FRACTION = 1.0 / 6.0
"""The maximum depth to which a recorded path pushes, as a fraction of the scene's push depth."""


def map_to_surface(scene: Scene, places: Floats) -> Floats:
    """Convert surface positions (n, 3) on the scene's object to world points (n, 3)."""
    return _surface_map_of(scene).points(places)


def touchable(scene: Scene) -> tuple[float, float]:
    """Return the lengths (m) of the touchable surface along the object and around the object.

    The touchable surface is centred on the front of the object, the point that faces the user. Its
    lengths are limited by the maximum tilt of the working range and by the usable part of the
    sheet. If the object has ends, only 0.8 of its length is used.
    """
    return _surface_map_of(scene).touchable_m


class SurfaceMap:
    """A map from surface positions on a scene's object to world points.

    A surface position is (along, arc, height). From the front of the object, `along` is the
    distance in the direction of its x axis. `arc` is the distance at right angles to this
    direction. Both are measured on geodesics.

    The map is a precomputed grid of points, interpolated by bicubic splines and projected onto the
    surface. Therefore a mapped path is as smooth as the surface.
    """

    def __init__(self, scene: Scene) -> None:
        """Compute the grid of surface points.

        Raises FingerPathError if no side of the object faces the user.
        """
        self._world_from_object = pose_matrix(scene.object.world_from_object)
        self._shape = make_shape(dict(scene.object.geometry))
        towards_user = self._world_from_object[:3, :3].T[:, 2]
        front = _front(self._shape, towards_user)
        most = np.cos(min(scene.working_range.tilt_rad, 0.5 * np.pi))
        if front.normal @ towards_user < most:
            raise FingerPathError(
                f'scene "{scene.name}": no side of the object faces the user within '
                "working_range.tilt_rad; rotate the object: change object.world_from_object"
            )
        along = np.array([1.0, 0.0, 0.0])
        across = np.cross(front.normal, along)
        if np.linalg.norm(across) < 0.1:  # the object's x axis points to the user
            across = np.array([0.0, 1.0, 0.0])
        ways = []
        for heading in (np.cross(across, front.normal), across):
            sides = [self._reach_m(front, sign * heading, towards_user, most) for sign in (1, -1)]
            ways.append((2.0 * min(end for end, _ in sides), any(edge for _, edge in sides)))
        (length_m, ends), (around_m, ends_around) = ways
        self.touchable_m = (
            min((WITHIN_ENDS if ends else 1.0) * length_m, OF_WIDTH * scene.sheet.width_m),
            min(
                (WITHIN_ENDS if ends_around else 1.0) * around_m,
                OF_HEIGHT * scene.sheet.usable_half_height_m,
            ),
        )
        self._fit_splines(front, np.cross(across, front.normal))

    def points(self, places: Floats) -> Floats:
        """Convert surface positions (n, 3) to world points (n, 3).

        `along` and `arc` are limited to the range of the grid.
        """
        along, arc = places[:, 0], places[:, 1]
        rough = np.column_stack([spline(along, arc, grid=False) for spline in self._splines])
        found = self._shape.closest(rough)
        return apply(self._world_from_object, found.point + places[:, 2:] * found.normal)

    def _reach_m(
        self, front: Nearest, heading: Floats, towards_user: Floats, most: float
    ) -> tuple[float, bool]:
        """Return the maximum length (m) of a stroke of the finger in one direction.

        The stroke starts at the front of the object and follows the geodesic in the direction
        `heading` (3,). It ends at an edge of the object, or at the maximum angle between the
        surface normal and the direction to the user. The second result is whether the stroke
        reaches an edge.

        most: cosine of the maximum angle.
        """
        here, way_m = front, 0.0
        while way_m < MAX_DISTANCE_M:
            heading = heading - here.normal * (heading @ here.normal)
            heading = heading / np.linalg.norm(heading)
            there = self._shape.closest(here.point + STRIDE_M * heading, previous=here.point)
            if there.on_edge or there.normal @ towards_user < most:
                gone = float(np.linalg.norm(there.point - here.point))
                if there.on_edge:
                    return way_m + gone, True
                lean, leant = (_lean_rad(one, towards_user) for one in (there, here))
                return way_m + gone * (float(np.arccos(most)) - leant) / (lean - leant), False
            way_m += STRIDE_M
            here = there
        return way_m, False

    def _fit_splines(self, front: Nearest, heading: Floats) -> None:
        """Fit splines that map two coordinates on the object's surface to surface points.

        The coordinates are the distances `along` and `arc`, m, from the point `front` in
        perpendicular directions. In each direction, the splines cover 1.25 times the length that
        the finger can touch.

        heading (3,): direction of the coordinate `along` at `front`.
        """
        ticks = [
            np.linspace(-half, half, max(9, 2 * int(np.ceil(half / GRID_M)) + 1))
            for half in (0.625 * size for size in self.touchable_m)
        ]
        line = _walk(self._shape, front.point[None], heading[None], ticks[0])
        points, normals = line[0][:, 0], line[1][:, 0]
        headings = np.gradient(points, axis=0)
        grid, _ = _walk(self._shape, points, np.cross(normals, headings), ticks[1])
        self._splines = [
            scipy.interpolate.RectBivariateSpline(*ticks, grid[:, :, axis].T, s=0.0)
            for axis in range(3)
        ]


def _front(shape: Shape, towards_user: Floats) -> Nearest:
    """Return the surface point nearest to a distant user.

    This point can be on an end of the object. The result is then the point that the user sees in
    the direction of the object's origin.
    """
    far = shape.closest(FAR_M * towards_user)
    if not far.on_edge:
        return far
    place = FAR_M * towards_user
    for _ in range(200):
        distance_m = float(shape.signed_distance(place))
        if distance_m < 1e-9:
            break
        place = place - distance_m * towards_user
    return shape.closest(place)


def _lean_rad(found: Nearest, towards_user: Floats) -> float:
    return float(np.arccos(np.clip(found.normal @ towards_user, -1.0, 1.0)))


def _walk(shape: Shape, starts: Floats, headings: Floats, ticks: Floats) -> tuple[Floats, Floats]:
    """Return points and normals (k, n, 3) on the geodesics through points (n, 3).

    starts, headings (n, 3): points and directions of the geodesics at these points.
    ticks (k,): ascending distances (m) at which points are computed. The middle element is 0.
    """
    centre = len(ticks) // 2
    begun = shape.closest(starts)
    points, normals = (np.empty((len(ticks), *starts.shape)) for _ in range(2))
    points[centre], normals[centre] = begun.point, begun.normal
    for sign in (1, -1):
        found, heading = begun, sign * headings
        here, normal = found.point, found.normal
        for step in range(1, centre + 1):
            to = centre + sign * step
            way_m = abs(ticks[to] - ticks[to - sign])
            parts = max(1, int(np.ceil(way_m / STRIDE_M)))
            for _ in range(parts):
                heading = heading - normal * (heading * normal).sum(1, keepdims=True)
                heading = heading / np.maximum(np.linalg.norm(heading, axis=1), 1e-12)[:, None]
                # An arc of length s and curvature k has the length tan(k s) / k when projected
                # from its centre of curvature onto the tangent (here to third order).
                bend = np.einsum("ni,nij,nj->n", heading, found.shape_operator, heading)
                length = way_m / parts * (1.0 + (bend * way_m / parts) ** 2 / 3.0)
                found = shape.closest(here + length[:, None] * heading, previous=here)
                here, normal = found.point, found.normal
            points[to], normals[to] = here, normal
    return points, normals


def _surface_map_of(scene: Scene) -> SurfaceMap:
    """Return the map from surface coordinates to world points for a scene's object.

    The maps of the latest scenes are cached.
    """
    key = pickle.dumps((scene.object, scene.working_range, scene.sheet, scene.name))
    if key not in _SURFACE_MAPS:
        while len(_SURFACE_MAPS) >= MAX_CACHED_SURFACE_MAPS:
            _SURFACE_MAPS.pop(next(iter(_SURFACE_MAPS)))
        _SURFACE_MAPS[key] = SurfaceMap(scene)
    return _SURFACE_MAPS[key]


def inside(scene: Scene, points: Floats, margin_m: float) -> bool:
    """Return whether all world points (n, 3) are at least `margin_m` inside the finger volume."""
    low = scene.finger.volume_min_m + margin_m
    high = scene.finger.volume_max_m - margin_m
    return bool((points >= low).all() and (points <= high).all())


def limit_path_speed(scene: Scene, times_s: Floats, points: Floats) -> Floats:
    """Return the times (n,), s, of a path that is slowed down to the finger's maximum speed.

    All times are multiplied by the same factor of at least 1.

    points (n, 3): positions, m.
    """
    fastest = float(SmoothPath.through(times_s, points).speeds().max())
    slower = max(1.0, fastest / (SPEED_FRACTION * scene.finger.max_speed_m_per_s))
    return np.asarray((times_s - times_s[0]) * slower)


def place_path(
    scene: Scene,
    label: str,
    times_s: Floats,
    places: Floats,
    *,
    wander_m: float,
    tremor_m: float,
) -> FingerPath:
    """Convert a motion in surface positions to a finger path in the scene.

    times_s, places: sample times (n,) and surface positions (n, 3), m.
    wander_m, tremor_m: amplitudes of slow noise and tremor, which are later added to the path.

    If the path including this noise would leave the scene's finger volume, it is scaled down. If it
    would exceed the scene's maximum finger speed, it is slowed down.

    Raises FingerPathError if the volume does not contain the front of the object.
    """
    margin_m = 4.0 * wander_m + 3.0 * tremor_m
    shrunk = next(
        (
            points
            for share in np.linspace(1.0, 0.0, 41)
            if inside(scene, points := map_to_surface(scene, share * places), margin_m)
        ),
        None,
    )
    if shrunk is None:
        front = map_to_surface(scene, np.zeros((1, 3)))[0]
        raise FingerPathError(
            f'path "{label}": the front of the object at {np.round(front, 4).tolist()} m must be '
            f"at least {margin_m:.2g} m inside the volume from finger.volume_min_m to "
            "finger.volume_max_m: widen the volume or move the object (object.world_from_object)"
        )
    return FingerPath(
        label=label,
        times_s=limit_path_speed(scene, times_s, shrunk),
        positions_world_m=shrunk,
        wander_m=wander_m,
        tremor_m=tremor_m,
        joined_by="spline",
    )


def place_recording(label: str, times_s: Floats, points: Floats, scene: Scene) -> FingerPath:
    """Map the recorded motion of a fingertip to the scene's object.

    times_s (n,): ascending times.
    points (n, 3): positions, m, with y upwards, as hand trackers write them.

    The mapping preserves the motion and changes its location:

    1. Rotate: the recorded x, y, z become the world's x, y, z (right, up, towards the user).
    2. Scale, if necessary, by one factor. Then the central 90 % of each coordinate fit the
        touchable range (`touchable`) and 50 mm of depth.
    3. Translate: the median x, y is placed in front of the centre of the object.
    4. Project: z becomes the height above the surface. The deepest 30 % of the samples push into
        the surface, limited smoothly to a sixth of `push_depth_m`. y becomes arc length on the
        surface, so a vertical motion of the finger strokes the surface.
    5. Slow down, if necessary, by one factor, to 0.8 of the scene's finger speed.

    The samples are limited to the scene's finger volume and joined by a spline, which preserves the
    recorded tremor.
    """
    points = points - np.median(points, axis=0)
    low, high = np.quantile(points, [0.05, 0.95], axis=0)
    extent = np.array([*touchable(scene), 0.05])
    points *= min(1.0, float((extent / np.maximum(high - low, 1e-9)).min()))

    half = 0.5 * extent
    press_m = scene.working_range.push_depth_m * PRESS_FRACTION
    touch = np.quantile(points[:, 2], 0.3)
    places = np.stack(
        [
            _soft_clip(points[:, 0], half[0]),
            _soft_clip(points[:, 1], half[1]),
            # The limit is gradual, because soft skin yields and does not stop the hand abruptly.
            _soft_max(points[:, 2] - touch, -press_m, 0.5 * press_m),
        ],
        axis=1,
    )
    within = np.clip(
        map_to_surface(scene, places), scene.finger.volume_min_m, scene.finger.volume_max_m
    )
    return FingerPath(
        label=label,
        times_s=limit_path_speed(scene, times_s, within),
        positions_world_m=within,
        wander_m=0.0,
        tremor_m=0.0,
        joined_by="spline",
    )


def _soft_max(values: Floats, floor: float, bend: float) -> Floats:
    """Limit values (n,) smoothly to at least `floor`. The transition has the width `bend`."""
    above = values - floor
    return np.asarray(floor + 0.5 * (above + np.hypot(above, bend)))


def _soft_clip(values: Floats, half: float) -> Floats:
    """Limit values (n,) smoothly to the range from -half to half.

    The width of the transition at each limit is 0.2 * half.
    """
    return -_soft_max(-_soft_max(values, -half, 0.2 * half), -half, 0.2 * half)
