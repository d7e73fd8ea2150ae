"""Simulate the motion of a person's fingertip as a function of time.

A path message and a random seed determine the motion. The finger follows the path with two random
deviations: wander (slow) and tremor (fast). Because the position can be computed for any time, the
ground truth of each image is exact. Positions are in the world frame, in m. Times are in seconds
since the path message arrived, unless stated otherwise.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Protocol, TypeVar

import numpy as np

from flexsheet.messages.apparatus import FingerTruth
from flexsheet.messages.errors import FlexsheetError
from flexsheet.messages.types import PathJoin
from flexsheet.nodes.arrays import Floats

Real = TypeVar("Real", float, Floats)

ROUNDING_S = 0.04
"""Half of the time interval (s) of the moving average that rounds the corners of a polyline."""

EASE_SPEED_M_PER_S = 0.4
"""The peak speed of the finger's motion from its current position to the first point of a path."""

MIN_EASE_S = 0.3
WANDER_BAND_HZ = (0.15, 1.2)
TREMOR_BAND_HZ = (8.0, 12.0)


class FingerPathError(FlexsheetError, ValueError):
    """Raised if the simulated finger cannot follow a path."""

    exit_code = 2


@dataclass(frozen=True, slots=True)
class SineSum:
    """Band-limited noise with three components of standard deviation 1, each a sum of n sines.

    frequencies_hz, phases_rad (3, n): frequencies and phases of the sines.
    """

    frequencies_hz: Floats
    phases_rad: Floats

    @staticmethod
    def drawn(band_hz: tuple[float, float], generator: np.random.Generator) -> SineSum:
        """Choose seven random sines per component, one from each seventh of the frequency band."""
        edges = np.linspace(*band_hz, 8)
        return SineSum(
            frequencies_hz=generator.uniform(edges[:-1], edges[1:], (3, 7)),
            phases_rad=generator.uniform(0.0, 2.0 * np.pi, (3, 7)),
        )

    def at(self, time_s: float) -> tuple[Floats, Floats]:
        """Return the value (3,) and its rate of change (3,), 1/s, at a time."""
        pace = 2.0 * np.pi * self.frequencies_hz
        angle = pace * time_s + self.phases_rad
        scale = np.sqrt(2.0 / self.frequencies_hz.shape[1])
        return scale * np.sin(angle).sum(axis=1), scale * (pace * np.cos(angle)).sum(axis=1)


class Path(Protocol):
    """The interface of a fingertip's motion along a path, without its random deviations.

    Times are in seconds since the finger was at the first point. The finger rests before and after
    the path.
    """

    @property
    def points(self) -> Floats: ...

    @property
    def duration_s(self) -> float: ...

    @property
    def begins_s(self) -> float:
        """Return the time (s) at which the finger leaves the first point.

        The time is at most 0. It is negative if rounded corners make the motion start earlier.
        """
        ...

    def speeds(self) -> Floats:
        """Return upper bounds (n - 1,), in m/s, on the speed between n successive points."""
        ...

    def at(self, time_s: float) -> tuple[Floats, Floats]:
        """Return the position (3,), m, and the velocity (3,), m/s, at a time."""
        ...


@dataclass(frozen=True, slots=True)
class RoundedLines:
    """A motion along straight lines whose corners are rounded by an average over +-ROUNDING_S.

    The average is computed exactly from the integral of the position. The rounded motion never
    leaves the convex hull of the points, never exceeds the speed on the lines, and has a continuous
    velocity. Densely sampled smooth motions are unsuitable, because rounding would displace them by
    ROUNDING_S^2 / 6 times their acceleration.

    integral (n, 3): integral (m s) of the position from time 0 to each point.
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
        """Return the speeds (n - 1,), m/s, on the straight segments.

        They are upper bounds on the speed of the rounded motion.
        """
        ways = np.linalg.norm(np.diff(self.points, axis=0), axis=1)
        return np.asarray(ways / np.diff(self.times_s))

    def _corner(self, time_s: float) -> tuple[Floats, Floats]:
        """Return the position on the polyline without rounding, and its time integral from time 0.

        The position (3,) is in m, and the integral (3,) in m s. Differences of the integral give
        the moving average that rounds the corners.
        """
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
        """Return the position (3,), m, and velocity (3,), m/s, at a time after the first point."""
        before, area_before = self._corner(time_s - ROUNDING_S)
        after, area_after = self._corner(time_s + ROUNDING_S)
        span = 2.0 * ROUNDING_S
        return (area_after - area_before) / span, (after - before) / span


@dataclass(frozen=True, slots=True)
class SmoothPath:
    """A motion along a cubic spline through samples, at rest at both ends.

    For samples at intervals h, the error is about h^4 / 100 times the fourth derivative of the
    motion. The error of a motion of 10 mm in 50 ms with samples every 4 ms is below a micrometre.
    """

    times_s: Floats
    points: Floats
    cubics: Floats = field(repr=False)
    rates: Floats = field(repr=False)

    @staticmethod
    def through(times_s: Floats, points: Floats) -> SmoothPath:
        """Make the path through points (n >= 2, 3) at increasing times (n,) from time 0."""
        times = times_s - times_s[0]
        rates = find_clamped_rates(times, points)
        steps = np.diff(times)[:, None]
        mean = np.diff(points, axis=0) / steps
        excess = (rates[:-1] + rates[1:] - 2.0 * mean) / steps
        cubics = [excess / steps, (mean - rates[:-1]) / steps - excess, rates[:-1], points[:-1]]
        return SmoothPath(times, points, np.stack(cubics), rates)

    @property
    def duration_s(self) -> float:
        return float(self.times_s[-1])

    @property
    def begins_s(self) -> float:
        return 0.0

    def speeds(self) -> Floats:
        """Return upper bounds (n - 1,), in m/s, on the speed between n successive samples.

        Between two samples, the velocity is a quadratic Bezier curve. Its speed never exceeds the
        maximum magnitude of the three control points.
        """
        ends = self.rates
        mean = np.diff(self.points, axis=0) / np.diff(self.times_s)[:, None]
        middle = 3.0 * mean - ends[1:] - ends[:-1]
        corners = np.linalg.norm(np.stack([ends[1:], ends[:-1], middle]), axis=2)
        return np.asarray(corners.max(axis=0))

    def at(self, time_s: float) -> tuple[Floats, Floats]:
        """Return the position (3,), m, and velocity (3,), m/s, at a time after the first point."""
        if time_s <= 0.0:
            return self.points[0], np.zeros(3)
        if time_s >= self.times_s[-1]:
            return self.points[-1], np.zeros(3)
        # The library's function would take six times as long for a single time.
        i = int(np.searchsorted(self.times_s, time_s, side="right")) - 1
        since = time_s - self.times_s[i]
        cubic, square, linear, constant = self.cubics[:, i]
        return (
            ((cubic * since + square) * since + linear) * since + constant,
            (3.0 * cubic * since + 2.0 * square) * since + linear,
        )


def find_clamped_rates(times_s: Floats, points: Floats) -> Floats:
    """Return the velocities (n, 3) of a clamped cubic spline at its points (n, 3).

    The velocity is zero at both ends, and the second derivative is continuous. The tridiagonal
    equations are solved without SciPy, because its import would delay the start of the node.
    """
    steps = np.diff(times_s)
    mean = np.diff(points, axis=0) / steps[:, None]
    right = 3.0 * (steps[1:, None] * mean[:-1] + steps[:-1, None] * mean[1:])
    rates, ratios = np.zeros_like(points), [0.0]
    for i, (before, after) in enumerate(zip(steps[:-1].tolist(), steps[1:].tolist(), strict=True)):
        pivot = 2.0 * (before + after) - after * ratios[i]
        ratios.append(before / pivot)
        rates[i + 1] = (right[i] - after * rates[i]) / pivot
    for i in range(len(points) - 2, 0, -1):
        rates[i] -= ratios[i] * rates[i + 1]
    return rates


def join_points(times_s: Floats, points: Floats, joined_by: PathJoin) -> Path:
    """Return the motion through the points (n, 3) of a path at increasing times (n,)."""
    # At a single point the finger rests, which needs no spline.
    if joined_by == "spline" and len(points) > 1:
        return SmoothPath.through(times_s, points)
    return RoundedLines.through(times_s, points)


def check_speed(path: Path, times_s: Floats, max_speed_m_per_s: float) -> None:
    """Raise FingerPathError if a path is faster than `max_speed_m_per_s`.

    times_s: times of the points of the path.
    """
    speeds = path.speeds()
    if (speeds > max_speed_m_per_s).any():
        at = int(np.argmax(speeds))
        raise FingerPathError(
            f"path: the speed {speeds[at]:.3g} m/s after times_s[{at}] = {times_s[at]:.6g} "
            f"exceeds finger.max_speed_m_per_s = {max_speed_m_per_s:.3g} m/s; increase the times"
        )


@dataclass(frozen=True, slots=True)
class FingerState:
    """The true state of the fingertip at one time.

    position, velocity: position (3,), m, and velocity (3,), m/s.
    path_time_s: time since the first point of the path; negative before the finger reaches it.
    path_done: whether the finger has reached the end of the path.
    force: force (3,) of the sheet on the finger, N.
    """

    position: Floats
    velocity: Floats
    path_time_s: float
    path_done: bool
    force: Floats = field(default_factory=lambda: np.zeros(3))


@dataclass(frozen=True, slots=True)
class FingerMotion:
    """The motion of the fingertip along a path, with wander (slow noise) and tremor.

    The motion starts at the present position, and first moves to the first point of the path.

    start, start_velocity: position and velocity when the path message arrived, without wander and
        tremor.
    ease_s: duration of the motion to the first point.
    amplitudes_before_m, amplitudes_m: amplitudes of wander and tremor before the path message and
        on the path. During the motion to the first point, they are interpolated.
    age_s: total duration of the motions before this path. Wander and tremor are functions of the
        total time, so that they are continuous.
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
        """Make the motion of a finger that rests at `position` (3,), m.

        seed: seed of the random wander and tremor that are added when the finger follows later
            paths.
        """
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

    @staticmethod
    def of(finger: FingerTruth | None, position: Floats, *, seed: int) -> FingerMotion:
        """Make the motion of a finger that rests at `position` (3,), m.

        finger: true parameters of wander and tremor; None for default values.
        """
        if finger is None:
            return FingerMotion.resting(position, seed=seed)
        middle_hz, half_hz = finger.tremor_frequency_hz, 0.5 * finger.tremor_width_hz
        return FingerMotion.resting(
            position,
            seed=seed,
            wander_band_hz=(WANDER_BAND_HZ[0], finger.voluntary_bandwidth_hz),
            tremor_band_hz=(middle_hz - half_hz, middle_hz + half_hz),
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
        """Return the motion along a new path that starts at the time `at_s` of this motion.

        times_s, points: path of n times and points (n, 3), m.
        wander_m: standard deviation of the wander per axis.
        tremor_m: amplitude of the tremor: sqrt(2) times its standard deviation per axis.

        Raises FingerPathError if the path has a speed above `max_speed_m_per_s`.
        """
        path = join_points(times_s, points, joined_by)
        check_speed(path, times_s, max_speed_m_per_s)
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
        """Return position (m) and velocity (m/s) without wander and tremor.

        The third result contains the amplitudes (m) of wander and tremor.
        """
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
        """Return the true state of the fingertip at a time (s) after the path message arrived."""
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


def find_tremor_m(finger: FingerTruth | None, path_tremor_m: float) -> float:
    """Return the tremor amplitude (m) on a path.

    If the path has a tremor and the true parameters `finger` contain a tremor, the tremor in the
    true parameters is used.
    """
    if finger is None or finger.tremor_rms_m is None or not path_tremor_m:
        return path_tremor_m
    return math.sqrt(2.0) * finger.tremor_rms_m


def minimum_jerk_profile(s: Real) -> tuple[Real, Real]:
    """Return the minimum-jerk position profile and its derivative at s (Flash and Hogan 1985).

    s: fraction of the duration, from 0 to 1, as a number or an array. The profile rises from 0 to
        1.
    """
    return s**3 * (10.0 - 15.0 * s + 6.0 * s * s), 30.0 * s * s * (1.0 - s) ** 2


def _reach(
    s: float, duration_s: float, start: Floats, start_velocity: Floats, path: Path
) -> tuple[Floats, Floats]:
    """Return position (m) and velocity (m/s) during a motion to the first point of a path.

    s: fraction of the duration, 0 at `start` and 1 at the first point of the path.

    The motion is the minimum-jerk motion between both points plus a term for the initial velocity.
    This term is the quintic Hermite function s (1-s)^3 (1+3s) times velocity and duration.
    Therefore position and velocity are continuous.
    """
    share, slope = minimum_jerk_profile(s)
    carried = s * (1.0 - s) ** 3 * (1.0 + 3.0 * s)
    carried_slope = (1.0 - s) ** 2 * (1.0 + 2.0 * s - 15.0 * s * s)
    way = path.points[0] - start
    position = start + share * way + duration_s * carried * start_velocity
    velocity = slope / duration_s * way + carried_slope * start_velocity
    return position, velocity
