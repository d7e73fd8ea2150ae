"""Simulate a person's fingertip as a pure function of time.

One path message and one seed determine a motion.  It can be computed again from both at any time,
so that the truth behind an image is exact.  Positions are in the world frame, m; times are in
seconds since the path was given.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from flexsheet.messages.errors import FlexsheetError
from flexsheet.messages.types import PathJoin

Floats = NDArray[np.float64]
Real = TypeVar("Real", float, Floats)

ROUNDING_S = 0.04
"""Half the time over which corners of lines are rounded, since a hand does not jerk."""

EASE_SPEED_M_PER_S = 0.4
"""Peak speed of the reach from the present position to a path's first point."""

MIN_EASE_S = 0.3
WANDER_BAND_HZ = (0.15, 1.2)
TREMOR_BAND_HZ = (8.0, 12.0)


class FingerPathError(FlexsheetError, ValueError):
    """Raised for a path that the finger cannot follow; the message contains the remedy."""

    code = "finger-path"
    remedy = "Slow the path down, or correct the row that the text names."


@dataclass(frozen=True, slots=True)
class SineSum:
    """Band-limited noise: a sum of sines per axis with standard deviation 1, for all times."""

    frequencies_hz: Floats
    phases_rad: Floats

    @staticmethod
    def drawn(band_hz: tuple[float, float], generator: np.random.Generator) -> SineSum:
        """Draw seven sines per axis, one in each seventh of the band, at random within it."""
        edges = np.linspace(*band_hz, 8)
        return SineSum(
            frequencies_hz=generator.uniform(edges[:-1], edges[1:], (3, 7)),
            phases_rad=generator.uniform(0.0, 2.0 * np.pi, (3, 7)),
        )

    def at(self, time_s: float) -> tuple[Floats, Floats]:
        """Return value and rate of change (1/s), each (3,)."""
        pace = 2.0 * np.pi * self.frequencies_hz
        angle = pace * time_s + self.phases_rad
        scale = np.sqrt(2.0 / self.frequencies_hz.shape[1])
        return scale * np.sin(angle).sum(axis=1), scale * (pace * np.cos(angle)).sum(axis=1)


class Path(Protocol):
    """Interface of the steady part of a finger's motion, at rest before and after the path."""

    @property
    def points(self) -> Floats: ...

    @property
    def duration_s(self) -> float: ...

    @property
    def begins_s(self) -> float:
        """Time, zero or less, when the finger leaves the first point; before, it must have come to
        rest."""
        ...

    def speeds(self) -> Floats:
        """Return a bound on the speed (n-1,) m/s between each point and the next."""
        ...

    def at(self, time_s: float) -> tuple[Floats, Floats]:
        """Return position (m) and velocity (m/s), each (3,)."""
        ...


@dataclass(frozen=True, slots=True)
class RoundedLines:
    """Polyline in time, its corners rounded by a moving mean of +-ROUNDING_S.

    The mean of a polyline is exact through its integral.  It never leaves the polyline's hull,
    never exceeds its speed, and has a continuous velocity.  It is meant for paths of a few points:
    the mean removes ROUNDING_S^2 / 6 times the acceleration from a motion that bends between them.
    """

    times_s: Floats
    points: Floats
    integral: Floats

    @staticmethod
    def through(times_s: Floats, points: Floats) -> RoundedLines:
        """Make the path through points (n, 3) at increasing times (n,) from time 0."""
        times = times_s - times_s[0]
        areas = 0.5 * (points[1:] + points[:-1]) * np.diff(times)[:, None]
        integral = np.concatenate([np.zeros((1, 3)), np.cumsum(areas, axis=0)])
        return RoundedLines(times, points, integral)

    @property
    def duration_s(self) -> float:
        return float(self.times_s[-1])

    @property
    def begins_s(self) -> float:
        return -ROUNDING_S

    def speeds(self) -> Floats:
        """See `Path`; these are the lines' own."""
        ways = np.linalg.norm(np.diff(self.points, axis=0), axis=1)
        return np.asarray(ways / np.diff(self.times_s))

    def _corner(self, time_s: float) -> tuple[Floats, Floats]:
        """Return the polyline's position, and its integral since time 0."""
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
        """See `Path`."""
        before, area_before = self._corner(time_s - ROUNDING_S)
        after, area_after = self._corner(time_s + ROUNDING_S)
        span = 2.0 * ROUNDING_S
        return (area_after - area_before) / span, (after - before) / span


@dataclass(frozen=True, slots=True)
class SmoothPath:
    """Cubic spline through samples of a motion, at rest at both ends.

    Between samples `h` apart its error is some h^4 / 100 times the motion's fourth derivative.
    This is below a micrometre for a reach of 10 mm in 50 ms that is sampled every 4 ms.
    """

    times_s: Floats
    points: Floats
    spline: CubicSpline = field(repr=False)
    rate: CubicSpline = field(repr=False)

    @staticmethod
    def through(times_s: Floats, points: Floats) -> SmoothPath:
        """Make the path through points (n >= 2, 3) at increasing times (n,) from time 0."""
        times = times_s - times_s[0]
        spline = CubicSpline(times, points, bc_type="clamped")
        return SmoothPath(times, points, spline, spline.derivative())

    @property
    def duration_s(self) -> float:
        return float(self.times_s[-1])

    @property
    def begins_s(self) -> float:
        return 0.0

    def speeds(self) -> Floats:
        """See `Path`.

        Velocity is quadratic between samples, so that it stays within the triangle of its three
        Bezier points: both ends' velocities, and three times the mean velocity less both.
        """
        ends = self.rate(self.times_s)
        mean = np.diff(self.points, axis=0) / np.diff(self.times_s)[:, None]
        middle = 3.0 * mean - ends[1:] - ends[:-1]
        corners = np.linalg.norm(np.stack([ends[1:], ends[:-1], middle]), axis=2)
        return np.asarray(corners.max(axis=0))

    def at(self, time_s: float) -> tuple[Floats, Floats]:
        """See `Path`."""
        if time_s <= 0.0:
            return self.points[0], np.zeros(3)
        if time_s >= self.times_s[-1]:
            return self.points[-1], np.zeros(3)
        # For one time, the library's evaluation takes six times as long.
        i = int(np.searchsorted(self.times_s, time_s, side="right")) - 1
        since = time_s - self.times_s[i]
        cubic, square, linear, constant = self.spline.c[:, i]
        return (
            ((cubic * since + square) * since + linear) * since + constant,
            (3.0 * cubic * since + 2.0 * square) * since + linear,
        )


def validate_path(times_s: Floats, points: Floats, joined_by: PathJoin) -> Path:
    """Make the path through points (n, 3) at times (n,).

    Raises FingerPathError for a path without points or with times that do not increase.
    """
    if len(times_s) != len(points) or len(times_s) == 0:
        raise FingerPathError(
            f"path of {len(times_s)} times and {len(points)} points: one time per point, and at "
            "least one"
        )
    steps_s = np.diff(times_s)
    if (steps_s <= 0).any():
        at = int(np.argmax(steps_s <= 0))
        raise FingerPathError(
            f"times_s[{at + 1}] = {times_s[at + 1]:.6g} does not come after times_s[{at}] = "
            f"{times_s[at]:.6g}"
        )
    # A single point is a point of rest, which needs no curve.
    if joined_by == "spline" and len(points) > 1:
        return SmoothPath.through(times_s, points)
    return RoundedLines.through(times_s, points)


@dataclass(frozen=True, slots=True)
class FingerState:
    """Fingertip at one time; `path_time_s` is negative during the reach to the path."""

    position: Floats
    velocity: Floats
    path_time_s: float
    path_done: bool


@dataclass(frozen=True, slots=True)
class FingerMotion:
    """Combine a path, the reach to its start, and a person's unsteadiness.

    start, start_velocity: the steady part (without wander and tremor) when the path was given.
    amplitudes: (wander, tremor) at the start and on the path; they blend during the reach.
    age_s: time of the unsteadiness when the path was given; it continues from motion to motion.
    """

    path: Path
    start: Floats
    start_velocity: Floats
    ease_s: float
    amplitudes_before_m: tuple[float, float]
    amplitudes_m: tuple[float, float]
    age_s: float
    wander: SineSum = field(repr=False)
    tremor: SineSum = field(repr=False)

    @staticmethod
    def resting(
        position: Floats,
        *,
        seed: int,
        wander_band_hz: tuple[float, float] = WANDER_BAND_HZ,
        tremor_band_hz: tuple[float, float] = TREMOR_BAND_HZ,
    ) -> FingerMotion:
        """Make a finger that rests at `position`, with the bands of its unsteadiness."""
        generator = np.random.default_rng(seed)
        return FingerMotion(
            path=RoundedLines.through(np.zeros(1), position[None]),
            start=position,
            start_velocity=np.zeros(3),
            ease_s=MIN_EASE_S,
            amplitudes_before_m=(0.0, 0.0),
            amplitudes_m=(0.0, 0.0),
            age_s=0.0,
            wander=SineSum.drawn(wander_band_hz, generator),
            tremor=SineSum.drawn(tremor_band_hz, generator),
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
        joined_by: PathJoin = "rounded_lines",
    ) -> FingerMotion:
        """Return the motion after a path is given `at_s` into this one.

        wander_m: standard deviation per axis.
        tremor_m: amplitude, so that its standard deviation is tremor_m / sqrt(2).

        Raises FingerPathError for a path without points, with times that do not increase, or faster
        than a finger.
        """
        path = validate_path(times_s, points, joined_by)
        speeds = path.speeds()
        if (speeds > max_speed_m_per_s).any():
            at = int(np.argmax(speeds))
            raise FingerPathError(
                f"speed {speeds[at]:.3g} m/s after times_s[{at}] = {times_s[at]:.6g}: a finger "
                f"does {max_speed_m_per_s:.3g} m/s (finger.max_speed_m_per_s), give it more time"
            )
        start, start_velocity, amplitudes = self._steady(at_s)
        distance_m = float(np.linalg.norm(points[0] - start))
        return FingerMotion(
            path=path,
            start=start,
            start_velocity=start_velocity,
            ease_s=max(MIN_EASE_S, 1.875 * distance_m / EASE_SPEED_M_PER_S),
            amplitudes_before_m=amplitudes,
            amplitudes_m=(wander_m, tremor_m),
            age_s=self.age_s + at_s,
            wander=self.wander,
            tremor=self.tremor,
        )

    def _path_time_s(self, time_s: float) -> float:
        return time_s - self.ease_s + self.path.begins_s

    def _steady(self, time_s: float) -> tuple[Floats, Floats, tuple[float, float]]:
        """Return the steady position and velocity, and the wander and tremor amplitudes."""
        if time_s >= self.ease_s:
            position, velocity = self.path.at(self._path_time_s(time_s))
            return position, velocity, self.amplitudes_m
        s = max(time_s, 0.0) / self.ease_s
        share, _ = minimum_jerk_profile(s)
        before, after = self.amplitudes_before_m, self.amplitudes_m
        amplitudes = (
            before[0] + share * (after[0] - before[0]),
            before[1] + share * (after[1] - before[1]),
        )
        position, velocity = _reach(s, self.ease_s, self.start, self.start_velocity, self.path)
        return position, velocity, amplitudes

    def at(self, time_s: float) -> FingerState:
        """Return the true fingertip `time_s` after the path was given."""
        position, velocity, amplitudes = self._steady(time_s)
        _, share_rate = minimum_jerk_profile(min(max(time_s / self.ease_s, 0.0), 1.0))
        noises = ((self.wander, 1.0), (self.tremor, np.sqrt(0.5)))
        for (noise, deviation), amplitude, before, after in zip(
            noises, amplitudes, self.amplitudes_before_m, self.amplitudes_m, strict=True
        ):
            value, rate = noise.at(self.age_s + time_s)
            fade_rate = share_rate / self.ease_s * (after - before)
            position = position + deviation * amplitude * value
            velocity = velocity + deviation * (amplitude * rate + fade_rate * value)
        path_time_s = self._path_time_s(time_s)
        return FingerState(
            position=position,
            velocity=velocity,
            path_time_s=path_time_s,
            path_done=path_time_s >= self.path.duration_s,
        )


def minimum_jerk_profile(s: Real) -> tuple[Real, Real]:
    """Return the minimum-jerk rise from 0 to 1 and its slope (Flash and Hogan 1985)."""
    return s**3 * (10.0 - 15.0 * s + 6.0 * s * s), 30.0 * s * s * (1.0 - s) ** 2


def _reach(
    s: float, duration_s: float, start: Floats, start_velocity: Floats, path: Path
) -> tuple[Floats, Floats]:
    """Return a minimum-jerk reach at the fraction `s` of its time, from `start` to the path's first
    point.

    The result is position (m) and velocity (m/s).  The start's velocity decays by the quintic
    Hermite function s (1-s)^3 (1+3s), so that both are continuous.
    """
    share, slope = minimum_jerk_profile(s)
    carried = s * (1.0 - s) ** 3 * (1.0 + 3.0 * s)
    carried_slope = (1.0 - s) ** 2 * (1.0 + 2.0 * s - 15.0 * s * s)
    way = path.points[0] - start
    position = start + share * way + duration_s * carried * start_velocity
    velocity = slope / duration_s * way + carried_slope * start_velocity
    return position, velocity
