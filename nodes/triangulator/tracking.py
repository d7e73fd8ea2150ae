"""Track the finger: accept or reject measured points, and predict the motion.

A track is the sequence of accepted points. A filter (module `adaptive`) estimates the
motion. The gate is the region in which the next point is expected.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from flexsheet.messages.types import Fingertip, FingertipReason, FingertipState
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.triangulator.adaptive import AdaptiveBank, BankEstimate

GateResult = Literal["ok", "too_fast", "unconfirmed"]
"""The possible results of adding a measured point to a tracker.

ok: the point was added to the track.
too_fast: the point is farther away than a finger can move.
unconfirmed: the point can start a new track if later points confirm it, or it arrived late."""

PREDICTION_STEP_S = 0.01
"""The time between two points of the predicted path: a tenth of the period of a 10 Hz tremor."""

HISTORY_NS = 250_000_000
"""The maximum age of a late point that can be inserted into the track."""

GATE_SIGMAS = 5.0
"""The margin of the gate for measurement and prediction errors, in standard deviations."""


def make_horizons_s(longest_s: float) -> Floats:
    """Return the horizons (n,), s, of a predicted path that lasts at least `longest_s`."""
    return np.arange(0.0, longest_s + 1.5 * PREDICTION_STEP_S, PREDICTION_STEP_S)


@dataclass(frozen=True, slots=True)
class TrackingSettings:
    """The settings of a tracker.

    max_speed_m_per_s, max_acceleration_m_per_s2: limits of a finger's motion. Points outside these
        limits are rejected.
    track_timeout_s: maximum time since the last point before the track is lost.
    confirm_frames: number of consecutive consistent points that start or replace a track.
    """

    max_speed_m_per_s: float
    max_acceleration_m_per_s2: float = 60.0
    track_timeout_s: float = 0.1
    confirm_frames: int = 3


@dataclass(frozen=True, slots=True)
class PositionMeasurement:
    """A measured marker position (3,), m, at the time `at_ns`, with its covariance (3, 3), m^2."""

    at_ns: int
    measured: Floats
    covariance: Floats

    def can_reach(self, later: PositionMeasurement, max_speed: float) -> bool:
        """Return whether a finger can move from this measured point to a later measured point.

        max_speed: maximum speed of the finger, m/s.

        The distance may exceed the distance at maximum speed by GATE_SIGMAS standard deviations of
        the measurement noise.
        """
        distance = float(np.linalg.norm(later.measured - self.measured))
        noise = float(np.sqrt(np.trace(self.covariance) + np.trace(later.covariance)))
        return distance <= max_speed * (later.at_ns - self.at_ns) * 1e-9 + GATE_SIGMAS * noise


@dataclass(frozen=True, slots=True)
class Gate:
    """A ball around the predicted point (3,), m, in which the finger's marker is expected."""

    point: Floats
    radius_m: float

    def contains(self, measurement: PositionMeasurement) -> bool:
        """Return whether a measured point can be in the gate, given its uncertainty.

        The distance from the centre may exceed the radius by GATE_SIGMAS standard deviations of the
        noise.
        """
        noise_m = GATE_SIGMAS * float(np.sqrt(np.trace(measurement.covariance)))
        return float(np.linalg.norm(measurement.measured - self.point)) <= self.radius_m + noise_m


@dataclass(frozen=True, slots=True)
class TrackPrediction:
    """The predicted state of the tracked point at one time, and n points (n, 3), m, of its path.

    covariance: joint covariance (6, 6) of position (3,), m, and velocity (3,), m/s.
    """

    position: Floats
    velocity: Floats
    covariance: Floats
    path: Floats


INITIAL_COVARIANCE = np.diag([1.0] * 3 + [10.0] * 3)
"""The covariance of position (m) and velocity (m/s) that is reported before the first detection."""


class Tracker:
    """A tracker that filters the measured positions of one marker and predicts its path."""

    def __init__(self, settings: TrackingSettings) -> None:
        self.filter, self.settings = AdaptiveBank(settings.max_speed_m_per_s), settings
        self._history: list[tuple[PositionMeasurement, BankEstimate]] = []
        self._tentative_track: list[PositionMeasurement] = []
        self._late: list[PositionMeasurement] = []
        self._gate: tuple[tuple[PositionMeasurement, BankEstimate], int, Gate] | None = None

    @property
    def estimate(self) -> BankEstimate | None:
        """Return the newest estimate, even if the track is lost, or None before the first point."""
        return self._history[-1][1] if self._history else None

    def is_late(self, at_ns: int) -> bool:
        """Return whether a point at the time `at_ns` is not newer than the estimate."""
        return self.estimate is not None and at_ns <= self.estimate.at_ns

    def state(self, at_ns: int) -> FingertipState:
        """Return the state of the track at a time.

        at_ns: time that is not before the newest point of the track.
        """
        if not self._is_alive(at_ns):
            return "acquiring" if self._tentative_track else "lost"
        assert self.estimate is not None
        return "tracking" if at_ns == self.estimate.at_ns else "coasting"

    def gate(self, at_ns: int) -> Gate | None:
        """Return the gate, the ball in which the marker is expected, at a time.

        Returns None if the finger is not tracked, or if `at_ns` is not after the newest point.
        """
        if not self._is_alive(at_ns) or self.is_late(at_ns):
            return None
        newest = self._history[-1]
        # The detector, the data association and the update use the same gate.
        if self._gate is None or self._gate[0] is not newest or self._gate[1] != at_ns:
            self._gate = newest, at_ns, self._gate_after(*newest, at_ns)
        return self._gate[2]

    def _gate_after(
        self, measurement: PositionMeasurement, estimate: BankEstimate, at_ns: int
    ) -> Gate:
        dt = (at_ns - estimate.at_ns) * 1e-9
        point = self.filter.predict(estimate, np.array([dt]))[0]
        spread = self.filter.moments(estimate)[2]
        sigma = np.sqrt(np.trace(spread[:3, :3]) + dt * dt * np.trace(spread[3:, 3:]))
        acceleration_m = 0.5 * self.settings.max_acceleration_m_per_s2 * dt * dt
        travel_m = self.settings.max_speed_m_per_s * dt
        offset_m = float(np.linalg.norm(point - measurement.measured))
        # Acceleration limit and speed limit both bound the motion, so use the smaller distance.
        radius_m = min(acceleration_m + GATE_SIGMAS * float(sigma), travel_m + offset_m)
        return Gate(
            point, radius_m + GATE_SIGMAS * float(np.sqrt(np.trace(measurement.covariance)))
        )

    def predict_at(self, at_ns: int, horizons_s: Floats) -> TrackPrediction:
        """Predict position, velocity and path at the time `at_ns`.

        at_ns: time that is not before the newest point of the track.
        horizons_s: times (n,) of the path's points after `at_ns`; the first time must be 0.

        If the track is lost, the predicted path stays at the last position.
        """
        estimate = self.estimate
        if estimate is None:
            return TrackPrediction(
                np.zeros(3), np.zeros(3), INITIAL_COVARIANCE, np.zeros((len(horizons_s), 3))
            )
        position, velocity, covariance = self.filter.moments(estimate)
        if not self._is_alive(at_ns):
            return TrackPrediction(
                position, np.zeros(3), covariance, np.tile(position, (len(horizons_s), 1))
            )
        since_s = (at_ns - estimate.at_ns) * 1e-9
        ahead = self.filter.predict(estimate, since_s + horizons_s)
        return TrackPrediction(ahead[0], velocity, covariance, ahead)

    def make_fingertip(
        self,
        at_ns: int,
        reason: FingertipReason,
        measured: Floats | None,
        *,
        horizons_s: Floats,
        reprojection_px: float = 0.0,
        offset_m: Floats | float = 0.0,
    ) -> Fingertip:
        """Make the message about the fingertip at the time `at_ns`.

        measured: measured position (3,), m, of the tracked point; None if nothing was measured.
        horizons_s: horizons (n,) of the predicted path.
        offset_m: offset (3,) from the fingertip to the tracked point.
        """
        track = self.predict_at(at_ns, horizons_s)
        return Fingertip(
            valid=reason == "ok",
            state=self.state(at_ns),
            reason=reason,
            position_world_m=track.position - offset_m,
            velocity_world_m_per_s=track.velocity,
            covariance=track.covariance,
            predicted_path_world_m=track.path - offset_m,
            prediction_step_s=PREDICTION_STEP_S,
            measured_world_m=(track.position if measured is None else measured) - offset_m,
            reprojection_px=reprojection_px,
        )

    def velocity_at(self, at_ns: int) -> tuple[Floats, Floats]:
        """Return the velocity (3,), m/s, and its covariance (3, 3), m^2/s^2, at the time `at_ns`.

        If the finger is not tracked, the velocity is zero.
        """
        if self.estimate is None or not self._is_alive(at_ns):
            return np.zeros(3), np.eye(3) * (self.settings.max_speed_m_per_s / 3.0) ** 2
        _, velocity, covariance = self.filter.moments(self.estimate)
        return velocity, covariance[3:, 3:]

    def update(self, at_ns: int, measured: Floats, covariance: Floats) -> GateResult:
        """Add a measured point (3,), m, to the track if the point is inside the gate.

        covariance: noise covariance (3, 3), m^2, of the point.
        """
        measurement = PositionMeasurement(at_ns, measured, covariance)
        if self.is_late(at_ns):
            return self._insert_late(measurement)
        self._late = []
        gate = self.gate(at_ns)
        if gate is None:
            return self._extend_tentative_track(measurement, "unconfirmed")
        if not gate.contains(measurement):
            return self._extend_tentative_track(measurement, "too_fast")
        self._tentative_track = []
        self._append(measurement)
        return "ok"

    def _is_alive(self, at_ns: int) -> bool:
        newest = self.estimate
        return newest is not None and (
            (at_ns - newest.at_ns) * 1e-9 <= self.settings.track_timeout_s
        )

    def _append(self, measurement: PositionMeasurement) -> None:
        newest = self.estimate
        estimate = (
            self.filter.initialize(measurement.at_ns, measurement.measured, measurement.covariance)
            if newest is None
            else self.filter.update(
                newest, measurement.at_ns, measurement.measured, measurement.covariance
            )
        )
        oldest_ns = measurement.at_ns - HISTORY_NS
        self._history = [entry for entry in self._history if entry[0].at_ns >= oldest_ns]
        self._history.append((measurement, estimate))

    def _extend_tentative_track(
        self, measurement: PositionMeasurement, unconfirmed_result: GateResult
    ) -> GateResult:
        """Add a point to the tentative track, which replaces the track when it is long enough.

        unconfirmed_result: result while the tentative track is too short.
        """
        self._tentative_track = self._consistent_run(self._tentative_track, measurement)
        if len(self._tentative_track) < self.settings.confirm_frames:
            return unconfirmed_result
        return self._restart_with(self._tentative_track)

    def _consistent_run(
        self, previous: list[PositionMeasurement], measurement: PositionMeasurement
    ) -> list[PositionMeasurement]:
        """Append a point to a run of successive points, or begin a new run with this point.

        A new run begins if the finger cannot move from the last point to the new point. It also
        begins if the new point is not later, or is later by more than the time-out of a track.
        """
        last = previous[-1] if previous else None
        if last is None or (measurement.at_ns - last.at_ns) * 1e-9 > self.settings.track_timeout_s:
            return [measurement]
        follows = measurement.at_ns > last.at_ns and last.can_reach(
            measurement, self.settings.max_speed_m_per_s
        )
        return [*previous, measurement] if follows else [measurement]

    def _restart_with(self, measurements: list[PositionMeasurement]) -> GateResult:
        self._history, self._tentative_track, self._late = [], [], []
        for measurement in measurements:
            self._append(measurement)
        return "ok"

    def _insert_late(self, measurement: PositionMeasurement) -> GateResult:
        """Insert a late point into the history, and filter all later points again.

        A late point is older than the newest point of the track. It is inserted only if the history
        has a gap at its time, and if a finger can move through this point. Otherwise, it is
        dropped. If several consecutive points are late, the clock was probably set back, and the
        track restarts with these points.
        """
        self._late = self._consistent_run(self._late, measurement)
        if len(self._late) >= self.settings.confirm_frames:
            return self._restart_with(self._late)
        index = sum(entry[0].at_ns < measurement.at_ns for entry in self._history)
        later = [entry[0] for entry in self._history[index:]]
        times_ns = np.array([entry[0].at_ns for entry in self._history])
        fits = (
            index > 0
            and later[0].at_ns != measurement.at_ns
            # A point is missing between the two points of the history.
            and times_ns[index] - times_ns[index - 1] > 1.5 * np.median(np.diff(times_ns))
            and self._gate_after(*self._history[index - 1], measurement.at_ns).contains(measurement)
            and measurement.can_reach(later[0], self.settings.max_speed_m_per_s)
        )
        if fits:
            self._history = self._history[:index]
            for entry in (measurement, *later):
                self._append(entry)
        return "unconfirmed"
