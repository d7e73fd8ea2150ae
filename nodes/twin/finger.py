"""The twin's finger: where a person's fingertip is at any time, as a pure function.

A motion is what one path message and one seed determine.  Everything about it can be computed again
from those two, for any time, so the truth behind a picture is exact.  Positions are in the world
frame, metres; times are seconds since the path was given.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from messages.scene import Scene
from messages.types import FingerPath
from nodes.models.rigid import inverse, transform_from_rpy

Floats = NDArray[np.float64]

ROUNDING_S = 0.04
"""Half the time over which corners of a path are rounded off: a hand does not jerk."""

EASE_SPEED_M_PER_S = 0.4
"""Peak speed of the reach from where the finger is to a path's first point."""

MIN_EASE_S = 0.3
WANDER_BAND_HZ = (0.15, 1.2)
TREMOR_BAND_HZ = (8.0, 12.0)


class FingerPathError(ValueError):
    """A path that the finger cannot follow; the message says why and what to change."""


@dataclass(frozen=True, slots=True)
class Sines:
    """Band-limited noise: per axis a sum of sines; standard deviation 1, continuous for ever."""

    frequencies_hz: Floats
    phases_rad: Floats

    @staticmethod
    def drawn(band_hz: tuple[float, float], generator: np.random.Generator) -> Sines:
        """Seven sines per axis, one in each seventh of the band, at random within it."""
        edges = np.linspace(*band_hz, 8)
        return Sines(
            frequencies_hz=generator.uniform(edges[:-1], edges[1:], (3, 7)),
            phases_rad=generator.uniform(0.0, 2.0 * np.pi, (3, 7)),
        )

    def at(self, time_s: float) -> tuple[Floats, Floats]:
        """Value and rate of change (1/s), each (3,)."""
        pace = 2.0 * np.pi * self.frequencies_hz
        angle = pace * time_s + self.phases_rad
        scale = np.sqrt(2.0 / self.frequencies_hz.shape[1])
        return scale * np.sin(angle).sum(axis=1), scale * (pace * np.cos(angle)).sum(axis=1)


@dataclass(frozen=True, slots=True)
class Path3:
    """A polyline in time, its corners rounded by a moving mean of +-ROUNDING_S.

    The mean of a polyline is exact through its integral; it never leaves the polyline's hull and
    never exceeds its speed, and its velocity is continuous.  Before the first and after the last
    point the finger rests there.
    """

    times_s: Floats
    points: Floats
    integral: Floats

    @staticmethod
    def through(times_s: Floats, points: Floats) -> Path3:
        """The path through points (n, 3) at increasing times (n,), the first taken as time 0."""
        times = times_s - times_s[0]
        areas = 0.5 * (points[1:] + points[:-1]) * np.diff(times)[:, None]
        return Path3(times, points, np.concatenate([np.zeros((1, 3)), np.cumsum(areas, axis=0)]))

    @property
    def duration_s(self) -> float:
        return float(self.times_s[-1])

    def _corner(self, time_s: float) -> tuple[Floats, Floats]:
        """The polyline's position and its integral since time 0 at one time."""
        if time_s <= 0.0:
            return self.points[0], self.points[0] * time_s
        if time_s >= self.times_s[-1]:
            return self.points[-1], self.integral[-1] + self.points[-1] * (
                time_s - self.times_s[-1]
            )
        i = int(np.searchsorted(self.times_s, time_s, side="right")) - 1
        since = time_s - self.times_s[i]
        rate = (self.points[i + 1] - self.points[i]) / (self.times_s[i + 1] - self.times_s[i])
        return self.points[i] + rate * since, self.integral[i] + since * (
            self.points[i] + 0.5 * rate * since
        )

    def at(self, time_s: float) -> tuple[Floats, Floats]:
        """Position (m) and velocity (m/s), each (3,)."""
        before, area_before = self._corner(time_s - ROUNDING_S)
        after, area_after = self._corner(time_s + ROUNDING_S)
        span = 2.0 * ROUNDING_S
        return (area_after - area_before) / span, (after - before) / span


@dataclass(frozen=True, slots=True)
class FingerState:
    """The fingertip at one instant; `path_time_s` is negative while it eases to the path."""

    position: Floats
    velocity: Floats
    path_time_s: float
    path_done: bool


@dataclass(frozen=True, slots=True)
class FingerMotion:
    """A path, the reach to its start, and a person's unsteadiness.

    start, start_velocity: the steady part (without wander and tremor) when the path was given.
    amplitudes: (wander, tremor) at the start and on the path; they fade over during the reach.
    age_s: unsteadiness goes on from motion to motion; this is its time when the path was given.
    """

    path: Path3
    start: Floats
    start_velocity: Floats
    ease_s: float
    amplitudes_before_m: tuple[float, float]
    amplitudes_m: tuple[float, float]
    age_s: float
    wander: Sines = field(repr=False)
    tremor: Sines = field(repr=False)

    @staticmethod
    def resting(position: Floats, *, seed: int) -> FingerMotion:
        """A finger held still at `position`."""
        generator = np.random.default_rng(seed)
        return FingerMotion(
            path=Path3.through(np.zeros(1), position[None]),
            start=position,
            start_velocity=np.zeros(3),
            ease_s=MIN_EASE_S,
            amplitudes_before_m=(0.0, 0.0),
            amplitudes_m=(0.0, 0.0),
            age_s=0.0,
            wander=Sines.drawn(WANDER_BAND_HZ, generator),
            tremor=Sines.drawn(TREMOR_BAND_HZ, generator),
        )

    def followed_by(
        self,
        at_s: float,
        *,
        times_s: Floats,
        points: Floats,
        wander_m: float,
        tremor_m: float,
        max_speed_m_per_s: float,
    ) -> FingerMotion:
        """The motion when a path is given `at_s` into this one.

        wander_m: standard deviation per axis.  tremor_m: amplitude, so its standard deviation is
        tremor_m / sqrt(2).  Raises FingerPathError for a path without points, with times that do
        not increase, or faster than a finger.
        """
        if len(times_s) != len(points) or len(times_s) == 0:
            raise FingerPathError(
                f"path of {len(times_s)} times and {len(points)} points: one time per point, and "
                "at least one"
            )
        steps_s = np.diff(times_s)
        if (steps_s <= 0).any():
            at = int(np.argmax(steps_s <= 0))
            raise FingerPathError(
                f"times_s[{at + 1}] = {times_s[at + 1]:.6g} does not come after times_s[{at}] = "
                f"{times_s[at]:.6g}"
            )
        speeds = np.linalg.norm(np.diff(points, axis=0), axis=1) / steps_s
        if (speeds > max_speed_m_per_s).any():
            at = int(np.argmax(speeds))
            raise FingerPathError(
                f"speed {speeds[at]:.3g} m/s after times_s[{at}] = {times_s[at]:.6g}: a finger "
                f"does {max_speed_m_per_s:.3g} m/s (finger.max_speed_m_per_s), give it more time"
            )
        start, start_velocity, amplitudes = self._steady(at_s)
        distance_m = float(np.linalg.norm(points[0] - start))
        return FingerMotion(
            path=Path3.through(times_s, points),
            start=start,
            start_velocity=start_velocity,
            ease_s=max(MIN_EASE_S, 1.875 * distance_m / EASE_SPEED_M_PER_S),
            amplitudes_before_m=amplitudes,
            amplitudes_m=(wander_m, tremor_m),
            age_s=self.age_s + at_s,
            wander=self.wander,
            tremor=self.tremor,
        )

    def _steady(self, time_s: float) -> tuple[Floats, Floats, tuple[float, float]]:
        """Position and velocity without unsteadiness, and the (wander, tremor) amplitudes."""
        if time_s >= self.ease_s:
            position, velocity = self.path.at(time_s - self.ease_s - ROUNDING_S)
            return position, velocity, self.amplitudes_m
        s = max(time_s, 0.0) / self.ease_s
        share, _ = _smoothstep(s)
        before, after = self.amplitudes_before_m, self.amplitudes_m
        amplitudes = (
            before[0] + share * (after[0] - before[0]),
            before[1] + share * (after[1] - before[1]),
        )
        position, velocity = _reach(s, self.ease_s, self.start, self.start_velocity, self.path)
        return position, velocity, amplitudes

    def at(self, time_s: float) -> FingerState:
        """The true fingertip `time_s` after the path was given."""
        position, velocity, amplitudes = self._steady(time_s)
        _, share_rate = _smoothstep(np.clip(time_s / self.ease_s, 0.0, 1.0))
        noises = ((self.wander, 1.0), (self.tremor, np.sqrt(0.5)))
        for (noise, deviation), amplitude, before, after in zip(
            noises, amplitudes, self.amplitudes_before_m, self.amplitudes_m, strict=True
        ):
            value, rate = noise.at(self.age_s + time_s)
            fade_rate = share_rate / self.ease_s * (after - before)
            position = position + deviation * amplitude * value
            velocity = velocity + deviation * (amplitude * rate + fade_rate * value)
        path_time_s = time_s - self.ease_s - ROUNDING_S
        return FingerState(
            position=position,
            velocity=velocity,
            path_time_s=path_time_s,
            path_done=path_time_s >= self.path.duration_s,
        )


def _smoothstep(s: float) -> tuple[float, float]:
    """Minimum-jerk rise from 0 to 1 over s = 0..1 and its slope (Flash and Hogan 1985)."""
    return s**3 * (10.0 - 15.0 * s + 6.0 * s * s), 30.0 * s * s * (1.0 - s) ** 2


def _reach(
    s: float, duration_s: float, start: Floats, start_velocity: Floats, path: Path3
) -> tuple[Floats, Floats]:
    """Minimum-jerk reach at share `s` of its time, from `start` to rest at the path's first point.

    Gives position (m) and velocity (m/s).  The start's velocity dies out by the quintic Hermite
    function s (1-s)^3 (1+3s), so that both are continuous.
    """
    share, slope = _smoothstep(s)
    carried = s * (1.0 - s) ** 3 * (1.0 + 3.0 * s)
    carried_slope = (1.0 - s) ** 2 * (1.0 + 2.0 * s - 15.0 * s * s)
    way = path.points[0] - start
    position = start + share * way + duration_s * carried * start_velocity
    velocity = slope / duration_s * way + carried_slope * start_velocity
    return position, velocity


def recorded_path(csv_path: Path, scene: Scene) -> FingerPath:
    """A recorded fingertip's path brought into the scene, ready to be sent; named as its file.

    The file has columns t_s, x_mm, y_mm, z_mm with y upwards, as hand trackers give them.  The
    mapping keeps what a hand does and changes where it does it:

    1. Turned: the recording's x, y, z become the world's x, y, z (right, up, towards the user).
    2. Scaled, if it must be, by one factor, such that its middle 90 % fits 0.8 of the object's
       length, the arc that the working range's tilt and the sheet's usable height allow, and 50 mm
       of depth.
    3. Moved: its median x, y is put before the object's middle.
    4. Laid on: the depth becomes the distance to the object's surface; the deepest 30 % press into
       it by up to a sixth of `push_depth_m`, the rest hovers or reaches.  Height y becomes arc
       length over the surface, so that moving up and down strokes it.
    5. Slowed, if it must be, by one factor, to 0.8 of the scene's finger speed.

    Points are kept inside the scene's finger volume.  Raises FingerPathError for another file.
    """
    recorded = _read_recording(csv_path)
    times_s, points = recorded[:, 0] - recorded[0, 0], recorded[:, 1:] * 1e-3
    points = points - np.median(points, axis=0)
    low, high = np.quantile(points, [0.05, 0.95], axis=0)
    cylinder = scene.object.geometry
    arc_m = min(
        2.0 * scene.sheet.usable_half_height_m,
        2.0 * cylinder.radius_m * min(scene.working_range.tilt_rad, 0.5 * np.pi),
    )
    room = np.array([0.8 * cylinder.length_m, arc_m, 0.05])
    points *= min(1.0, float((room / np.maximum(high - low, 1e-9)).min()))

    half = 0.5 * room
    along = np.clip(points[:, 0], -half[0], half[0])
    arc = np.clip(points[:, 1], -half[1], half[1])
    press_m = scene.working_range.push_depth_m / 6.0
    touch = np.quantile(points[:, 2], 0.3)
    distance = np.maximum(points[:, 2] - touch, -press_m)
    angle = arc / cylinder.radius_m
    radius = cylinder.radius_m + distance
    in_object = np.stack([along, radius * np.sin(angle), radius * np.cos(angle)], axis=1)

    pose = scene.object.world_from_object
    world_from_object = transform_from_rpy(pose.position_m, pose.rpy_rad)
    camera_side = inverse(world_from_object)[:3, :3] @ np.array([0.0, 0.0, 1.0])
    turn = float(np.arctan2(camera_side[1], camera_side[2]))
    cosine, sine = np.cos(turn), np.sin(turn)
    towards_user = np.array([[1.0, 0.0, 0.0], [0.0, cosine, sine], [0.0, -sine, cosine]])
    world = in_object @ (world_from_object[:3, :3] @ towards_user).T + world_from_object[:3, 3]
    inside = np.clip(world, scene.finger.volume_min_m, scene.finger.volume_max_m)
    speed = np.linalg.norm(np.diff(inside, axis=0), axis=1) / np.diff(times_s)
    slower = max(1.0, float(speed.max()) / (0.8 * scene.finger.max_speed_m_per_s))
    return FingerPath(
        label=csv_path.stem,
        times_s=times_s * slower,
        positions_world_m=inside,
        wander_m=0.0,
        tremor_m=0.0,
    )


def _read_recording(csv_path: Path) -> Floats:
    """The columns t_s, x_mm, y_mm, z_mm (n, 4); raises FingerPathError naming line and remedy."""
    wanted = ["t_s", "x_mm", "y_mm", "z_mm"]
    try:
        lines: Sequence[str] = csv_path.read_text().splitlines()
    except OSError as error:
        raise FingerPathError(f"{csv_path}: cannot be read: {error.strerror}") from error
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
