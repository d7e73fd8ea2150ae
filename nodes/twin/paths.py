"""Map finger paths onto the scene's object, within the range of the arms; read recorded paths.

A surface position is (along, arc, height) in metres: along the object's x axis over its surface,
around it from there, and along the normal. (0, 0, 0) is the object's front, which faces the user.
Motions are defined in surface positions, so that they apply to the object of any scene.
"""

from __future__ import annotations

import pickle
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RectBivariateSpline

from flexsheet.messages.scene import Scene
from flexsheet.messages.types import FingerPath
from flexsheet.nodes.models.rigid import apply, transform_from_rpy
from flexsheet.nodes.models.shapes import Nearest, Shape, make_shape
from flexsheet.nodes.twin.finger import FingerPathError, SmoothPath

Floats = NDArray[np.float64]
FAR_M = 2.0
MAX_DISTANCE_M = 0.5
STRIDE_M = 0.001
GRID_M = 0.003
"""Maximum length of geodesics, their step, and the spacing of the grid."""

WITHIN_ENDS = 0.8
OF_WIDTH = 0.7
OF_HEIGHT = 0.9
"""Fractions that are stroked: of an object that ends, of the sheet's width and of its usable
half-height."""

MAX_CACHED_GROUNDS = 4
_GROUNDS: dict[bytes, Ground] = {}

SPEED_FRACTION = 0.8
"""Maximum speed of a path over the finger's; wander and tremor are added to it."""

PRESS_FRACTION = 1.0 / 6.0
"""Maximum depth of a recorded hand, over the scene's push depth."""


def map_to_surface(scene: Scene, places: Floats) -> Floats:
    """Return world points (n, 3) of surface positions (n, 3) on the scene's object."""
    return _ground_of(scene).points(places)


def touchable(scene: Scene) -> tuple[float, float]:
    """Return the lengths (m), along and around the surface, that a finger can stroke.

    They are limited by the object (0.8 of its length), by the working range's tilt, and by the
    usable sheet, to the same distance on both sides of the front. Around the object the sheet is
    met at its centre line.
    """
    return _ground_of(scene).touchable_m


class Ground:
    """Map from surface positions of a scene's object to points, from its front.

    Positions are measured along geodesics: first along the object's x axis, then at right angles to
    that. They are computed on a grid, interpolated by bicubic splines and projected onto the
    surface. A path over them is therefore as smooth as the surface.
    """

    def __init__(self, scene: Scene) -> None:
        """Raise FingerPathError for an object that turns no side to the user."""
        pose = scene.object.world_from_object
        self._world_from_object = transform_from_rpy(pose.position_m, pose.rpy_rad)
        self._shape = make_shape(dict(scene.object.geometry))
        towards_user = self._world_from_object[:3, :3].T[:, 2]
        front = _front(self._shape, towards_user)
        most = np.cos(min(scene.working_range.tilt_rad, 0.5 * np.pi))
        if front.normal @ towards_user < most:
            raise FingerPathError(
                f'scene "{scene.name}": the object turns no side to the user that may be touched; '
                "turn it by object.world_from_object"
            )
        along = np.array([1.0, 0.0, 0.0])
        across = np.cross(front.normal, along)
        if np.linalg.norm(across) < 0.1:  # its x axis points to the user
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
        self._lay_out(front, np.cross(across, front.normal))

    def points(self, places: Floats) -> Floats:
        """Return world points (n, 3) of positions (n, 3), limited to the touchable range."""
        along, arc = places[:, 0], places[:, 1]
        rough = np.column_stack([spline(along, arc, grid=False) for spline in self._splines])
        found = self._shape.closest(rough)
        return apply(self._world_from_object, found.point + places[:, 2:] * found.normal)

    def _reach_m(
        self, front: Nearest, heading: Floats, towards_user: Floats, most: float
    ) -> tuple[float, bool]:
        """Return the distance to the limit of tilt or to the end; True: to the end."""
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

    def _lay_out(self, front: Nearest, heading: Floats) -> None:
        """Fit splines of the surface over (along, arc), to a quarter beyond the touchable range."""
        ticks = [
            np.linspace(-half, half, max(9, 2 * int(np.ceil(half / GRID_M)) + 1))
            for half in (0.625 * size for size in self.touchable_m)
        ]
        line = _walk(self._shape, front.point[None], heading[None], ticks[0])
        points, normals = line[0][:, 0], line[1][:, 0]
        headings = np.gradient(points, axis=0)
        grid, _ = _walk(self._shape, points, np.cross(normals, headings), ticks[1])
        self._splines = [
            RectBivariateSpline(*ticks, grid[:, :, axis].T, s=0.0) for axis in range(3)
        ]


def _front(shape: Shape, towards_user: Floats) -> Nearest:
    """Return the surface point that faces the user.

    That is the point nearest to a distant user. If it is an end of the object, it is the point that
    the user sees through the origin.
    """
    far = shape.closest(FAR_M * towards_user)
    if not far.on_edge:
        return far
    place = FAR_M * towards_user
    for _ in range(200):
        way = float(shape.signed_distance(place))
        if way < 1e-9:
            break
        place = place - way * towards_user
    return shape.closest(place)


def _lean_rad(found: Nearest, towards_user: Floats) -> float:
    return float(np.arccos(np.clip(found.normal @ towards_user, -1.0, 1.0)))


def _walk(shape: Shape, starts: Floats, headings: Floats, ticks: Floats) -> tuple[Floats, Floats]:
    """Return points and normals (k, n, 3) on geodesics from points (n, 3), at distances (k,) m.

    ticks: ascending, as many before 0 as after it; 0 is in the middle.
    """
    middle = len(ticks) // 2
    begun = shape.closest(starts)
    points, normals = (np.empty((len(ticks), *starts.shape)) for _ in range(2))
    points[middle], normals[middle] = begun.point, begun.normal
    for sign in (1, -1):
        found, heading = begun, sign * headings
        here, normal = found.point, found.normal
        for step in range(1, middle + 1):
            to = middle + sign * step
            way_m = abs(ticks[to] - ticks[to - sign])
            parts = max(1, int(np.ceil(way_m / STRIDE_M)))
            for _ in range(parts):
                heading = heading - normal * (heading * normal).sum(1, keepdims=True)
                heading = heading / np.maximum(np.linalg.norm(heading, axis=1), 1e-12)[:, None]
                # Seen from the tangent plane a way s on a bend k is tan(k s) / k long.
                bend = np.einsum("ni,nij,nj->n", heading, found.shape_operator, heading)
                length = way_m / parts * (1.0 + (bend * way_m / parts) ** 2 / 3.0)
                found = shape.closest(here + length[:, None] * heading, previous=here)
                here, normal = found.point, found.normal
            points[to], normals[to] = here, normal
    return points, normals


def _ground_of(scene: Scene) -> Ground:
    """Return the scene's ground; the latest few are cached, since a path needs it many times."""
    key = pickle.dumps((scene.object, scene.working_range, scene.sheet, scene.name))
    if key not in _GROUNDS:
        while len(_GROUNDS) >= MAX_CACHED_GROUNDS:
            _GROUNDS.pop(next(iter(_GROUNDS)))
        _GROUNDS[key] = Ground(scene)
    return _GROUNDS[key]


def inside(scene: Scene, points: Floats, margin_m: float) -> bool:
    """Return whether world points (n, 3) keep that far inside the scene's finger volume."""
    low = scene.finger.volume_min_m + margin_m
    high = scene.finger.volume_max_m - margin_m
    return bool((points >= low).all() and (points <= high).all())


def limit_path_speed(scene: Scene, times_s: Floats, points: Floats) -> Floats:
    """Return times (n,), scaled if the path is too fast for the scene's finger."""
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
    """Return the path of a motion through positions (n, 3) at times (n,), samples of a smooth
    motion.

    The motion is scaled down by one factor if it leaves the scene's finger volume, wander included,
    and slowed by one factor if it exceeds the finger's speed.

    Raises FingerPathError where the volume does not contain the object's front.
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
            f'path "{label}": the object\'s front at {np.round(front, 4).tolist()} m is not '
            f"{margin_m:.2g} m inside finger.volume_min_m..volume_max_m: widen the volume or move "
            "object.world_from_object"
        )
    return FingerPath(
        label=label,
        times_s=limit_path_speed(scene, times_s, shrunk),
        positions_world_m=shrunk,
        wander_m=wander_m,
        tremor_m=tremor_m,
        joined_by="spline",
    )


def recorded_path(csv_path: Path, scene: Scene) -> FingerPath:
    """Map a recorded fingertip's path into the scene; it has the name of its file.

    The file has columns t_s, x_mm, y_mm, z_mm with y upwards, as from hand trackers. The mapping
    preserves the motion and changes its location:

    1. Rotate: the recording's x, y, z become the world's x, y, z (right, up, towards the user).
    2. Scale, if necessary, by one factor, so that the middle 90 % fits the touchable range and 50
      mm of depth.
    3. Translate: the median x, y is put before the object's middle.
    4. Project: the depth becomes the height over the object's surface. The deepest 30 % press into
    it, limited smoothly to a sixth of `push_depth_m`; the rest hovers or reaches. Height y becomes
    arc length over the surface, so that moving up and down strokes it.
    5. Slow down, if necessary, by one factor, to 0.8 of the scene's finger speed.

    The samples are limited to the scene's finger volume and joined smoothly, so that the motion
    between them, tremor included, is preserved.

    Raises FingerPathError for an invalid file.
    """
    recorded = _read_recording(csv_path)
    times_s, points = recorded[:, 0] - recorded[0, 0], recorded[:, 1:] * 1e-3
    points = points - np.median(points, axis=0)
    low, high = np.quantile(points, [0.05, 0.95], axis=0)
    room = np.array([*touchable(scene), 0.05])
    points *= min(1.0, float((room / np.maximum(high - low, 1e-9)).min()))

    half = 0.5 * room
    press_m = scene.working_range.push_depth_m * PRESS_FRACTION
    touch = np.quantile(points[:, 2], 0.3)
    places = np.stack(
        [
            _soft_clip(points[:, 0], half[0]),
            _soft_clip(points[:, 1], half[1]),
            # A skin gives way, it does not stop a hand.
            _soft_max(points[:, 2] - touch, -press_m, 0.5 * press_m),
        ],
        axis=1,
    )
    within = np.clip(
        map_to_surface(scene, places), scene.finger.volume_min_m, scene.finger.volume_max_m
    )
    return FingerPath(
        label=csv_path.stem,
        times_s=limit_path_speed(scene, times_s, within),
        positions_world_m=within,
        wander_m=0.0,
        tremor_m=0.0,
        joined_by="spline",
    )


def _soft_max(values: Floats, floor: float, bend: float) -> Floats:
    """Limit values (n,) from below by a hyperbola, so that the transition has the width `bend`."""
    above = values - floor
    return np.asarray(floor + 0.5 * (above + np.hypot(above, bend)))


def _soft_clip(values: Floats, half: float) -> Floats:
    """Limit values (n,) to +-half, with a transition over a fifth of it."""
    return -_soft_max(-_soft_max(values, -half, 0.2 * half), -half, 0.2 * half)


def _read_recording(csv_path: Path) -> Floats:
    """Read columns t_s, x_mm, y_mm, z_mm (n, 4); raise FingerPathError with line and remedy."""
    wanted = ["t_s", "x_mm", "y_mm", "z_mm"]
    try:
        lines: Sequence[str] = csv_path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise FingerPathError(f"{csv_path}: cannot be read: {error}") from error
    columns = [name.strip() for name in lines[0].split(",")] if lines else []
    if missing := [name for name in wanted if name not in columns]:
        raise FingerPathError(f"{csv_path}: no column {missing[0]}; needed are {', '.join(wanted)}")
    rows: list[list[float]] = []
    for number, line in enumerate(lines[1:], start=2):
        cells = line.split(",")
        try:
            row = [float(cells[columns.index(name)]) for name in wanted]
        except (ValueError, IndexError) as error:
            raise FingerPathError(f"{csv_path}: line {number}: {error}") from error
        if not np.isfinite(row).all():
            raise FingerPathError(f"{csv_path}: line {number}: not a finite number")
        if rows and row[0] <= rows[-1][0]:
            raise FingerPathError(f"{csv_path}: line {number}: t_s does not increase")
        rows.append(row)
    if len(rows) < 2:
        raise FingerPathError(f"{csv_path}: {len(rows)} samples, a path needs two")
    return np.array(rows)
