"""Where a finger's path is laid: over the scene's object, within reach; and recorded paths.

A place is (along, arc, height), metres: along the object's axis, around its surface from where it
faces the user, and out of the surface.  Motions are thought out in places and laid on the object of
whatever scene there is.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from messages.scene import Scene, cylinder_of
from messages.types import FingerPath
from nodes.models.rigid import apply, inverse, transform_from_rpy
from nodes.twin.finger import FingerPathError, SmoothPath

Floats = NDArray[np.float64]

SPEED_SHARE = 0.8
"""Of a finger's largest speed, that a path may ask for: unsteadiness comes on top."""

PRESS_SHARE = 1.0 / 6.0
"""Of the scene's push depth, that a recorded hand presses at most."""


def over_surface(scene: Scene, places: Floats) -> Floats:
    """World points (n, 3) of places (n, 3) on the scene's object."""
    cylinder = cylinder_of(scene)
    angle = places[:, 1] / cylinder.radius_m
    radius = cylinder.radius_m + places[:, 2]
    in_object = np.stack([places[:, 0], radius * np.sin(angle), radius * np.cos(angle)], axis=1)
    pose = scene.object.world_from_object
    world_from_object = transform_from_rpy(pose.position_m, pose.rpy_rad)
    towards_user = inverse(world_from_object)[:3, :3] @ np.array([0.0, 0.0, 1.0])
    turn = np.arctan2(towards_user[1], towards_user[2])
    cosine, sine = np.cos(turn), np.sin(turn)
    object_from_facing = np.array([[1.0, 0.0, 0.0], [0.0, cosine, sine], [0.0, -sine, cosine]])
    return apply(world_from_object, in_object @ object_from_facing.T)


def touchable(scene: Scene) -> tuple[float, float]:
    """How far (m) along and around the surface a finger can stroke, from end to end.

    0.8 of the object's length; the arc that the working range's tilt and the sheet's usable height
    allow.
    """
    cylinder = cylinder_of(scene)
    arc_m = min(
        2.0 * scene.sheet.usable_half_height_m,
        2.0 * cylinder.radius_m * min(scene.working_range.tilt_rad, 0.5 * np.pi),
    )
    return 0.8 * cylinder.length_m, arc_m


def inside(scene: Scene, points: Floats, margin_m: float) -> bool:
    """Whether world points (n, 3) keep that far inside the scene's finger volume."""
    low = scene.finger.volume_min_m + margin_m
    high = scene.finger.volume_max_m - margin_m
    return bool((points >= low).all() and (points <= high).all())


def times_slowed(scene: Scene, times_s: Floats, points: Floats) -> Floats:
    """The times (n,), stretched by one factor if the path is too fast for the scene's finger."""
    fastest = float(SmoothPath.through(times_s, points).speeds().max())
    slower = max(1.0, fastest / (SPEED_SHARE * scene.finger.max_speed_m_per_s))
    return np.asarray((times_s - times_s[0]) * slower)


def placed_path(
    scene: Scene,
    label: str,
    times_s: Floats,
    places: Floats,
    *,
    wander_m: float,
    tremor_m: float,
) -> FingerPath:
    """The path of a motion through places (n, 3) at times (n,), samples of something smooth.

    It is made smaller by one factor if it must be to stay in the scene's finger volume, wander and
    all, and slowed by one if it must be for the finger's speed.  Raises FingerPathError where the
    volume does not hold the place that the motion shrinks to, the object's front.
    """
    margin_m = 4.0 * wander_m + 3.0 * tremor_m
    shrunk = next(
        (
            points
            for share in np.linspace(1.0, 0.0, 41)
            if inside(scene, points := over_surface(scene, share * places), margin_m)
        ),
        None,
    )
    if shrunk is None:
        front = over_surface(scene, np.zeros((1, 3)))[0]
        raise FingerPathError(
            f'path "{label}": the object\'s front at {np.round(front, 4).tolist()} m is not '
            f"{margin_m:.2g} m inside finger.volume_min_m..volume_max_m: widen the volume or move "
            "object.world_from_object"
        )
    return FingerPath(
        label=label,
        times_s=times_slowed(scene, times_s, shrunk),
        positions_world_m=shrunk,
        wander_m=wander_m,
        tremor_m=tremor_m,
        joined_by="spline",
    )


def recorded_path(csv_path: Path, scene: Scene) -> FingerPath:
    """A recorded fingertip's path brought into the scene, ready to be sent; named as its file.

    The file has columns t_s, x_mm, y_mm, z_mm with y upwards, as hand trackers give them.  The
    mapping keeps what a hand does and changes where it does it:

    1. Turned: the recording's x, y, z become the world's x, y, z (right, up, towards the user).
    2. Scaled, if it must be, by one factor, such that its middle 90 % fits what is touchable, and
       50 mm of depth.
    3. Moved: its median x, y is put before the object's middle.
    4. Laid on: the depth becomes the height over the object's surface; the deepest 30 % press into
       it, more and more reluctantly, to a sixth of `push_depth_m`, the rest hovers or reaches.
       Height y becomes arc length over the surface, so that moving up and down strokes it.
    5. Slowed, if it must be, by one factor, to 0.8 of the scene's finger speed.

    Its samples are kept inside the scene's finger volume, and joined smoothly: what the hand did
    between them, tremor and all, is kept.  Raises FingerPathError for another file.
    """
    recorded = _read_recording(csv_path)
    times_s, points = recorded[:, 0] - recorded[0, 0], recorded[:, 1:] * 1e-3
    points = points - np.median(points, axis=0)
    low, high = np.quantile(points, [0.05, 0.95], axis=0)
    room = np.array([*touchable(scene), 0.05])
    points *= min(1.0, float((room / np.maximum(high - low, 1e-9)).min()))

    half = 0.5 * room
    press_m = scene.working_range.push_depth_m * PRESS_SHARE
    touch = np.quantile(points[:, 2], 0.3)
    places = np.stack(
        [
            _within(points[:, 0], half[0]),
            _within(points[:, 1], half[1]),
            # A skin gives way, it does not stop a hand.
            _not_below(points[:, 2] - touch, -press_m, 0.5 * press_m),
        ],
        axis=1,
    )
    within = np.clip(
        over_surface(scene, places), scene.finger.volume_min_m, scene.finger.volume_max_m
    )
    return FingerPath(
        label=csv_path.stem,
        times_s=times_slowed(scene, times_s, within),
        positions_world_m=within,
        wander_m=0.0,
        tremor_m=0.0,
        joined_by="spline",
    )


def _not_below(values: Floats, floor: float, bend: float) -> Floats:
    """Values (n,) kept above a floor by a hyperbola, so that they turn there within some `bend`."""
    above = values - floor
    return np.asarray(floor + 0.5 * (above + np.hypot(above, bend)))


def _within(values: Floats, half: float) -> Floats:
    """Values (n,) kept within +-half, turning over a fifth of it."""
    return -_not_below(-_not_below(values, -half, 0.2 * half), -half, 0.2 * half)


def _read_recording(csv_path: Path) -> Floats:
    """The columns t_s, x_mm, y_mm, z_mm (n, 4); raises FingerPathError naming line and remedy."""
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
