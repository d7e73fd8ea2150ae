"""Which measured points enter the track: the gate, late ones, loss and how a track begins.

What a track makes of its points is the filter's (`nodes.triangulator.filters`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from messages.types import FingertipState
from nodes.triangulator.filters import Estimate, Filter

Floats = NDArray[np.float64]
Verdict = Literal["ok", "too_fast", "unconfirmed"]
"""On a measured point: it is of the track; no finger moves so fast; it might begin a track, or came
after a later one and mends what there is."""

GATE_SIGMAS = 5.0
"""Errors of measurement and prediction that the gate forgives on top of a finger's motion."""


@dataclass(frozen=True, slots=True)
class TrackingSettings:
    """How a finger moves, and when a track begins and ends.

    max_speed_m_per_s, max_acceleration_m_per_s2: faster or sharper is no finger.
    forget_after_s: without a point for so long the track is lost.
    confirm_frames: points in a row that must agree with one another before they begin a track, or
        take the place of one that they do not agree with.
    remember_s: how far back a point that comes late can still be put in its place.
    """

    max_speed_m_per_s: float
    max_acceleration_m_per_s2: float = 60.0
    forget_after_s: float = 0.1
    confirm_frames: int = 3
    remember_s: float = 0.25


@dataclass(frozen=True, slots=True)
class Fix:
    """A measured point (3,) with its covariance (3, 3)."""

    at_ns: int
    measured: Floats
    covariance: Floats

    def reaches(self, later: Fix, max_speed: float) -> bool:
        """Whether a finger can get from this point to a later one, but for their noise."""
        way = float(np.linalg.norm(later.measured - self.measured))
        noise = float(np.sqrt(np.trace(self.covariance) + np.trace(later.covariance)))
        return way <= max_speed * (later.at_ns - self.at_ns) * 1e-9 + GATE_SIGMAS * noise


@dataclass(frozen=True, slots=True)
class Expected:
    """Where the finger should be: a point (3,) m, and how far from it a finger can be."""

    point: Floats
    reach_m: float

    def holds(self, fix: Fix) -> bool:
        """Whether a measured point can be the finger's, but for its noise."""
        noise_m = GATE_SIGMAS * float(np.sqrt(np.trace(fix.covariance)))
        return float(np.linalg.norm(fix.measured - self.point)) <= self.reach_m + noise_m


@dataclass(frozen=True, slots=True)
class Track:
    """What is known of the finger at one time, and the path (n, 3) predicted from then on.

    covariance: (6, 6) of position (3,) m and velocity (3,) m/s.
    """

    position: Floats
    velocity: Floats
    covariance: Floats
    ahead: Floats


UNKNOWN = np.diag([1.0] * 3 + [10.0] * 3)
"""Covariance (m, m/s) before the finger was ever seen."""


class Tracker:
    """A track, and the rule by which measured points enter it."""

    def __init__(self, filter_: Filter, settings: TrackingSettings) -> None:
        self.filter, self.settings = filter_, settings
        self._history: list[tuple[Fix, Estimate]] = []
        self._challengers: list[Fix] = []
        self._late: list[Fix] = []

    @property
    def estimate(self) -> Estimate | None:
        """The newest; it stays when the track is lost."""
        return self._history[-1][1] if self._history else None

    def is_late(self, at_ns: int) -> bool:
        """Whether a point of that time would come after a later one."""
        return self.estimate is not None and at_ns <= self.estimate.at_ns

    def state(self, at_ns: int) -> FingertipState:
        """Of the track at a time not before its newest point."""
        if not self._alive(at_ns):
            return "acquiring" if self._challengers else "lost"
        assert self.estimate is not None
        return "tracking" if at_ns == self.estimate.at_ns else "coasting"

    def expected(self, at_ns: int) -> Expected | None:
        """Where the finger can be at a time after the newest point; None without a track.

        Of the time before its newest point a track says nothing.
        """
        if not self._alive(at_ns) or self.is_late(at_ns):
            return None
        return self._expected_after(*self._history[-1], at_ns)

    def _expected_after(self, fix: Fix, estimate: Estimate, at_ns: int) -> Expected:
        """Where the finger can be at a time after one of the track's points."""
        dt = (at_ns - estimate.at_ns) * 1e-9
        point = self.filter.ahead(estimate, np.array([dt]))[0]
        spread = self.filter.moments(estimate)[2]
        sigma = np.sqrt(np.trace(spread[:3, :3]) + dt * dt * np.trace(spread[3:, 3:]))
        turn_m = 0.5 * self.settings.max_acceleration_m_per_s2 * dt * dt
        way_m = self.settings.max_speed_m_per_s * dt
        away_m = float(np.linalg.norm(point - fix.measured))
        # A finger is where its acceleration leads, and where its speed does: the smaller counts.
        reach_m = min(turn_m + GATE_SIGMAS * float(sigma), way_m + away_m)
        return Expected(point, reach_m + GATE_SIGMAS * float(np.sqrt(np.trace(fix.covariance))))

    def track_at(self, at_ns: int, leads_s: Floats) -> Track:
        """The track at a time not before its newest point; a lost one stays where it was lost."""
        estimate = self.estimate
        if estimate is None:
            return Track(np.zeros(3), np.zeros(3), UNKNOWN, np.zeros((len(leads_s), 3)))
        position, velocity, covariance = self.filter.moments(estimate)
        if not self._alive(at_ns):
            return Track(position, np.zeros(3), covariance, np.tile(position, (len(leads_s), 1)))
        since_s = (at_ns - estimate.at_ns) * 1e-9
        ahead = self.filter.ahead(estimate, since_s + leads_s)
        return Track(ahead[0], velocity, covariance, ahead)

    def velocity_at(self, at_ns: int) -> tuple[Floats, Floats]:
        """The finger's velocity (3,) m/s and its covariance (3, 3), as far as they are known."""
        if self.estimate is None or not self._alive(at_ns):
            return np.zeros(3), np.eye(3) * (self.settings.max_speed_m_per_s / 3.0) ** 2
        _, velocity, covariance = self.filter.moments(self.estimate)
        return velocity, covariance[3:, 3:]

    def take(self, at_ns: int, measured: Floats, covariance: Floats) -> Verdict:
        """Judge a measured point (3,) with its covariance (3, 3), and let it in if it may."""
        fix = Fix(at_ns, measured, covariance)
        if self.is_late(at_ns):
            return self._take_late(fix)
        self._late = []
        expected = self.expected(at_ns)
        if expected is None:
            return self._challenge(fix, "unconfirmed")
        if not expected.holds(fix):
            return self._challenge(fix, "too_fast")
        self._challengers = []
        self._append(fix)
        return "ok"

    def _alive(self, at_ns: int) -> bool:
        newest = self.estimate
        return newest is not None and (
            (at_ns - newest.at_ns) * 1e-9 <= self.settings.forget_after_s
        )

    def _append(self, fix: Fix) -> None:
        newest = self.estimate
        estimate = (
            self.filter.started(fix.at_ns, fix.measured, fix.covariance)
            if newest is None
            else self.filter.updated(newest, fix.at_ns, fix.measured, fix.covariance)
        )
        oldest_ns = fix.at_ns - round(self.settings.remember_s * 1e9)
        self._history = [entry for entry in self._history if entry[0].at_ns >= oldest_ns]
        self._history.append((fix, estimate))

    def _challenge(self, fix: Fix, refusal: Verdict) -> Verdict:
        """Count a point that is not of the track; with enough that agree a new one begins."""
        self._challengers = self._agreeing(self._challengers, fix)
        if len(self._challengers) < self.settings.confirm_frames:
            return refusal
        return self._begin(self._challengers)

    def _agreeing(self, before: list[Fix], fix: Fix) -> list[Fix]:
        """The points in a row that a finger can have been at, up to this one."""
        last = before[-1] if before else None
        if last is None or (fix.at_ns - last.at_ns) * 1e-9 > self.settings.forget_after_s:
            return [fix]
        follows = fix.at_ns > last.at_ns and last.reaches(fix, self.settings.max_speed_m_per_s)
        return [*before, fix] if follows else [fix]

    def _begin(self, fixes: list[Fix]) -> Verdict:
        self._history, self._challengers, self._late = [], [], []
        for fix in fixes:
            self._append(fix)
        return "ok"

    def _take_late(self, fix: Fix) -> Verdict:
        """Put a point in its place in time, and let the filter go over the later ones again.

        Late points in a row, with none in between that is not, mean that the clock has stepped
        back: the track begins anew with them.  What is older than all that is remembered, was known
        already, comes where none is missing, or lies where no finger could have been is left out.
        """
        self._late = self._agreeing(self._late, fix)
        if len(self._late) >= self.settings.confirm_frames:
            return self._begin(self._late)
        place = sum(entry[0].at_ns < fix.at_ns for entry in self._history)
        again = [entry[0] for entry in self._history[place:]]
        fits = (
            place > 0
            and again[0].at_ns != fix.at_ns
            and self._is_missing_between(place - 1, place)
            and self._expected_after(*self._history[place - 1], fix.at_ns).holds(fix)
            and fix.reaches(again[0], self.settings.max_speed_m_per_s)
        )
        if fits:
            self._history = self._history[:place]
            for entry in (fix, *again):
                self._append(entry)
        return "unconfirmed"

    def _is_missing_between(self, before: int, after: int) -> bool:
        """Whether so much time lies between two points of the track that one should be there."""
        times_ns = np.array([entry[0].at_ns for entry in self._history])
        usual_ns = float(np.median(np.diff(times_ns)))
        return float(times_ns[after] - times_ns[before]) > 1.5 * usual_ns
