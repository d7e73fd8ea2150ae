"""Associate the markers of each image pair with the finger and with clutter.

Clutter is every marker-like spot that is not the finger's marker. A marker outside the finger's
gate (the region in which the finger is expected) counts as clutter. Clutter is tracked too, so that
it is not confused with a finger that was hidden or merged with clutter. Markers are assigned
to tracks by position and brightness with the global nearest neighbour method (Bar-Shalom, Li,
Kirubarajan, Estimation with Applications to Tracking and Navigation). If another assignment is
about as likely, no fingertip is reported.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from flexsheet.messages.types import FingertipReason
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.triangulator.fingertip import Candidate, StereoDetection
from flexsheet.nodes.triangulator.tracking import Tracker
from flexsheet.nodes.triangulator.triangulation import TriangulatedPoint

TrackStatus = Literal["tentative", "ambiguous", "clutter"]
"""The status of a track that is not the finger's track.

tentative: the marker is possibly the finger's marker, and can start the finger's track.
ambiguous: it is uncertain whether the marker is the finger's marker, so it cannot start the
    finger's track yet.
clutter: the marker is not the finger's marker."""

POSITION_SIGMA_M = 0.0005
"""The scale (per axis) of a marker's deviation from motion at constant velocity, immediately after
a detection. The scale increases with time."""

ACCELERATION_SIGMA_M_PER_S2 = 1.0
"""The acceleration by which a marker is assumed to deviate from motion at constant velocity."""

STUDENT_T_DOF = 2.0
"""The degrees of freedom of Student's t distribution for a marker's deviation from motion at
constant velocity."""

MERGE_DISTANCE_M = 0.002
"""The distance below which two detected markers are treated as the same marker."""

MAX_POSITION_SIGMA_M = 0.1
"""The upper bound of the predicted position error of a track."""

MIN_APPEARANCE_SIGMA = np.array([0.01, 0.02])
"""The minimum relative standard deviations with which the grey levels of a marker and of its
surroundings vary from image to image."""

INITIAL_APPEARANCE_SIGMA = np.array([0.04, 0.08])
"""The initial relative standard deviations of the grey levels of a new track's marker and of its
surroundings."""

POPULATION_APPEARANCE_SIGMA = np.array([0.2, 0.4])
"""The relative standard deviations with which the grey levels vary between different markers, and
between their surroundings."""

APPEARANCE_TIME_CONSTANT_S = 0.2
"""The time constant for averaging the appearance (grey levels) of a marker."""

APPEARANCE_VARIANCE_TIME_CONSTANT_S = 3.0
"""The time constant for averaging the squared deviations of a marker's appearance from its mean."""

NEW_TRACK_COST = 6.0 * math.log(MAX_POSITION_SIGMA_M) + 2.0 * float(
    np.log(POPULATION_APPEARANCE_SIGMA).sum()
)
"""The cost of assigning a marker to a new track (see `_association_cost`)."""

INFEASIBLE_COST = 1e9
"""The cost of assigning a marker to a track to which the marker cannot belong."""

AMBIGUITY_MARGIN = 9.0
"""The cost difference below which two assignments are ambiguous. It is the square of three standard
deviations."""

MAX_APPEARANCE_DIST_SQ = 16.0
"""The maximum squared appearance distance at which two detections can show the same marker, in
squared standard deviations."""

VELOCITY_TIME_CONSTANT_S = 0.05
"""The time constant of the low-pass filter for a clutter track's velocity."""

CLUTTER_SEARCH_PERIOD_S = 0.1
"""The period at which the full images are searched for clutter while the finger is tracked."""

LATE_GATE_M = 0.03
"""The maximum distance from the newest position of the finger at which its marker is accepted in an
image pair that arrives late."""

STATIONARY_RADIUS_M = 3e-4
"""The radius within which a stationary marker stays. A finger always moves more."""

STATIONARY_TIME_S = 1.5
"""The time after which a marker that stays within STATIONARY_RADIUS_M is stationary."""

TRACK_TIMEOUT_S = 1.0
"""The time since the last detection after which the track of a moving marker is deleted."""

STATIONARY_TRACK_TIMEOUT_S = 10.0
"""The time since the last detection after which the track of a stationary marker is deleted."""

MIN_HITS = 3
TENTATIVE_TRACK_TIMEOUT_S = 0.1
"""The time since the last detection after which a tentative track is deleted if it has fewer than
MIN_HITS detections."""

SOLE_CANDIDATE_TIME_S = 1.0
"""The time after which the only visible marker is assigned to the finger, even if the status of its
track is `ambiguous`."""

CLUTTER_RELEASE_TIME_S = 5.0
"""The time since the finger's loss after which moving clutter can be selected as the finger."""


@dataclass(slots=True)
class Track:
    """The position (3,) m, velocity (3,) m/s and appearance (2,) of a tracked marker.

    The appearance contains the logarithms of the grey levels of the marker and of its surroundings.
    Its variance is estimated too.
    """

    point: Floats
    velocity: Floats
    appearance: Floats
    appearance_variance: Floats
    at_ns: int

    def predict(self, at_ns: int) -> tuple[Floats, float]:
        """Predict the marker's position (3,), m, at the time `at_ns`.

        The second result is the scale (m) of the prediction error per axis.
        """
        since_s = (at_ns - self.at_ns) * 1e-9
        sigma_m = POSITION_SIGMA_M + 0.5 * ACCELERATION_SIGMA_M_PER_S2 * since_s**2
        return self.point + since_s * self.velocity, min(sigma_m, MAX_POSITION_SIGMA_M)

    def appearance_distance_sq(self, appearance: Floats) -> float:
        """Return the squared Mahalanobis distance of an appearance (2,) from the track's mean."""
        return float((np.square(appearance - self.appearance) / self.appearance_variance).sum())

    def update_appearance(self, appearance: Floats, at_ns: int) -> None:
        """Update the mean and the variance of the track's appearance with a new detection.

        appearance (2,): logarithms of the grey levels of the marker and of its surroundings.
        at_ns: time of the detection.
        """
        since_s, residual = (at_ns - self.at_ns) * 1e-9, appearance - self.appearance
        self.appearance = (
            self.appearance - math.expm1(-since_s / APPEARANCE_TIME_CONSTANT_S) * residual
        )
        spread = np.maximum(residual**2, MIN_APPEARANCE_SIGMA**2) - self.appearance_variance
        self.appearance_variance = (
            self.appearance_variance
            - math.expm1(-since_s / APPEARANCE_VARIANCE_TIME_CONSTANT_S) * spread
        )


@dataclass(slots=True)
class ClutterTrack(Track):
    """A track of a marker that is not known to be the finger's marker.

    stationary_point, stationary_since_ns: centre (3,) m of a ball with radius STATIONARY_RADIUS_M,
        and the time since which the marker has been in this ball.
    sole_since_ns: time since which no other marker has been visible.
    hits: number of detections.
    """

    stationary_point: Floats
    stationary_since_ns: int
    sole_since_ns: int
    status: TrackStatus = "tentative"
    hits: int = 1

    @staticmethod
    def of(marker: Candidate, at_ns: int) -> ClutterTrack:
        variance = INITIAL_APPEARANCE_SIGMA**2
        return ClutterTrack(
            marker.point,
            np.zeros(3),
            marker.appearance,
            variance,
            at_ns,
            marker.point,
            at_ns,
            at_ns,
        )

    @property
    def is_stationary(self) -> bool:
        """Return whether the marker was stationary at its last detection."""
        return (self.at_ns - self.stationary_since_ns) * 1e-9 >= STATIONARY_TIME_S

    def predict(self, at_ns: int) -> tuple[Floats, float]:
        if self.is_stationary:
            return self.point, POSITION_SIGMA_M
        return Track.predict(self, at_ns)

    def update(self, marker: Candidate, at_ns: int, *, is_sole: bool) -> None:
        """Update the track with a detected marker.

        is_sole: whether the image pair contains no other marker.
        """
        since_s = (at_ns - self.at_ns) * 1e-9
        weight = 1.0 if self.hits == 1 else -math.expm1(-since_s / VELOCITY_TIME_CONSTANT_S)
        velocity = (marker.point - self.point) / since_s
        self.velocity = self.velocity + weight * (velocity - self.velocity)
        self.update_appearance(marker.appearance, at_ns)
        self.point, self.at_ns, self.hits = marker.point, at_ns, self.hits + 1
        if math.dist(marker.point, self.stationary_point) > STATIONARY_RADIUS_M:
            self.stationary_point, self.stationary_since_ns = marker.point, at_ns
        if not is_sole:
            self.sole_since_ns = at_ns

    def is_alive(self, at_ns: int) -> bool:
        """Return whether the track still exists at the time `at_ns`.

        A track ends if its last detection is too old. It also ends if its last detection is in the
        future because the clock was set back.
        """
        timeout_s = TRACK_TIMEOUT_S
        if self.is_stationary and self.status == "clutter":
            timeout_s = STATIONARY_TRACK_TIMEOUT_S
        if self.hits < MIN_HITS and self.status == "tentative":
            timeout_s = TENTATIVE_TRACK_TIMEOUT_S
        return 0 <= at_ns - self.at_ns <= 1e9 * timeout_s


class DataAssociation:
    """A selector of the finger's marker among the markers of each image pair."""

    def __init__(self) -> None:
        self.clutter_tracks: list[ClutterTrack] = []
        self._finger: Track | None = None
        self._successor: ClutterTrack | None = None
        self._clutter_searched_ns = 0

    def select_finger(
        self, at_ns: int, detection: StereoDetection, tracker: Tracker
    ) -> tuple[FingertipReason, TriangulatedPoint | None]:
        """Select the finger's marker among the detections of an image pair, and update the tracker.

        The first result is "ok", or the reason why no finger was found. The second result is the
        triangulated marker, or None if nothing was triangulated.
        """
        if tracker.is_late(at_ns):
            return self._associate_late(at_ns, detection, tracker)
        if tracker.gate(at_ns) is not None:
            chosen = self._continue_track(at_ns, detection)
        else:
            chosen = self._initiate_track(at_ns, detection)
        if not isinstance(chosen, Candidate):
            return chosen, detection.measured
        result = tracker.update(at_ns, chosen.point, chosen.measured.covariance)
        if result == "ok":
            self._update_finger(at_ns, chosen, tracker)
        return result, chosen.measured

    def _associate_late(
        self, at_ns: int, detection: StereoDetection, tracker: Tracker
    ) -> tuple[FingertipReason, TriangulatedPoint | None]:
        """Select the finger in an image pair that is older than the newest image pair.

        Markers are selected only by their distance from the finger, because past clutter is not
        stored.
        """
        markers = detection.markers
        if len(markers) > 1 and self._finger is not None:
            centre = self._finger.point
            markers = tuple(
                marker for marker in markers if math.dist(marker.point, centre) < LATE_GATE_M
            )
        if detection.reason not in ("ok", "two_markers") or len(markers) != 1:
            return detection.reason, detection.measured
        marker = markers[0]
        result = tracker.update(at_ns, marker.point, marker.measured.covariance)
        if result == "ok":
            self.clutter_tracks, self._finger = [], None
            self._update_finger(at_ns, marker, tracker)
        return result, marker.measured

    def is_clutter_search_due(self, at_ns: int) -> bool:
        """Return whether the full images must be searched for clutter at the time `at_ns`."""
        return not 0 <= at_ns - self._clutter_searched_ns < 1e9 * CLUTTER_SEARCH_PERIOD_S

    def track_clutter(self, at_ns: int, detection: StereoDetection) -> None:
        """Update the clutter tracks with the markers that were detected in full images."""
        self._clutter_searched_ns = at_ns
        seen = [one.point for one in self.clutter_tracks if one.at_ns == at_ns]
        if self._finger is not None:
            seen.append(self._finger.point)
        markers = [
            marker
            for marker in (*detection.markers, *detection.clutter)
            if all(math.dist(marker.point, point) > MERGE_DISTANCE_M for point in seen)
        ]
        for track in self._associate(at_ns, markers, None):
            if track is not None:
                track.status = "clutter"

    def _update_finger(self, at_ns: int, marker: Candidate, tracker: Tracker) -> None:
        assert tracker.estimate is not None
        if self._finger is None:
            self._finger = ClutterTrack.of(marker, at_ns)
        self._finger.update_appearance(marker.appearance, at_ns)
        self._finger.velocity = tracker.filter.moments(tracker.estimate)[1]
        self._finger.point, self._finger.at_ns = marker.point, at_ns
        self.clutter_tracks = [
            track for track in self.clutter_tracks if track.point is not marker.point
        ]

    def _continue_track(
        self, at_ns: int, detection: StereoDetection
    ) -> Candidate | FingertipReason:
        tracks = self._associate(at_ns, [*detection.markers, *detection.clutter], self._finger)
        near = tracks[: len(detection.markers)]
        finger_markers = [
            marker for marker, track in zip(detection.markers, near, strict=True) if track is None
        ]
        for track in tracks if finger_markers else tracks[len(near) :]:
            if track is not None and track.status == "tentative":
                # If the finger is not in view, this marker may be the finger, although it is
                # outside the gate.
                track.status = "clutter" if finger_markers else "ambiguous"
        if detection.reason not in ("ok", "two_markers"):
            return detection.reason
        if finger_markers:
            return finger_markers[0]
        is_all_clutter = all(track and track.status == "clutter" for track in near)
        return "no_marker" if is_all_clutter else "two_markers"

    def _initiate_track(
        self, at_ns: int, detection: StereoDetection
    ) -> Candidate | FingertipReason:
        markers = [*detection.markers, *detection.clutter]
        has_successor = any(track is self._successor for track in self.clutter_tracks)
        tracks = self._associate(at_ns, markers, None if has_successor else self._finger)
        for index, marker in enumerate(markers):
            if tracks[index] is None:  # the lost finger's marker becomes a separate track
                self._successor = tracks[index] = ClutterTrack.of(marker, at_ns)
                self.clutter_tracks.append(self._successor)
        best = self._select_candidate(at_ns)
        if detection.reason not in ("ok", "two_markers"):
            return detection.reason
        for marker, track in zip(detection.markers, tracks, strict=False):
            if track is best:
                return marker
        is_all_clutter = all(track and track.status == "clutter" for track in tracks)
        return "no_marker" if is_all_clutter else "two_markers"

    def _select_candidate(self, at_ns: int) -> ClutterTrack | None:
        """Return the track that is most likely the lost finger, or None if this is uncertain."""
        finger = self._finger
        absence_s = math.inf if finger is None else (at_ns - finger.at_ns) * 1e-9
        candidates: list[tuple[float, ClutterTrack]] = []
        for track in self.clutter_tracks:
            if (
                track.status == "clutter"
                and absence_s > CLUTTER_RELEASE_TIME_S
                and not track.is_stationary
            ):
                track.status = "ambiguous"
            distance_sq = 0.0 if finger is None else finger.appearance_distance_sq(track.appearance)
            if distance_sq > MAX_APPEARANCE_DIST_SQ and track.status == "tentative":
                track.status = "ambiguous"
            if track.status != "clutter" and distance_sq <= MAX_APPEARANCE_DIST_SQ:
                candidates.append((distance_sq, track))
        if any(not track.is_stationary for _, track in candidates):
            candidates = [candidate for candidate in candidates if not candidate[1].is_stationary]
        candidates.sort(key=lambda candidate: candidate[0])
        if len(candidates) > 1 and candidates[1][0] - candidates[0][0] > AMBIGUITY_MARGIN:
            return candidates[0][1] if candidates[0][1].hits > MIN_HITS else None
        if len(candidates) == 1 and candidates[0][1].status == "tentative":
            return candidates[0][1]
        sole = [
            track
            for track in self.clutter_tracks
            if track.status == "ambiguous"
            and track.at_ns == at_ns
            and (at_ns - track.sole_since_ns) * 1e-9 > SOLE_CANDIDATE_TIME_S
        ]
        return sole[0] if sole else None

    def _associate(
        self, at_ns: int, markers: Sequence[Candidate], finger: Track | None
    ) -> list[ClutterTrack | None]:
        """Assign the markers of an image pair to tracks, and update or create the clutter tracks.

        finger: track of the finger; None if the finger is not tracked.

        Returns the clutter track of each marker, or None for the finger's marker.
        """
        self.clutter_tracks = [track for track in self.clutter_tracks if track.is_alive(at_ns)]
        if not markers:
            return []
        all_tracks = [*self.clutter_tracks, *([] if finger is None else [finger])]
        costs = np.full((len(markers), len(all_tracks) + len(markers)), INFEASIBLE_COST)
        for row, marker in enumerate(markers):
            costs[row, : len(all_tracks)] = [
                _association_cost(one, at_ns, marker) for one in all_tracks
            ]
            costs[row, len(all_tracks) + row] = NEW_TRACK_COST
        columns = assign_columns(costs)
        ambiguous = (
            set[int]() if finger is None else _ambiguous_rows(costs, columns, len(all_tracks) - 1)
        )
        tracks: list[ClutterTrack | None] = []
        for row, (column, marker) in enumerate(zip(columns, markers, strict=True)):
            if column < len(self.clutter_tracks):
                track = self.clutter_tracks[column]
                track.update(marker, at_ns, is_sole=len(markers) == 1)
                if row in ambiguous and track.status == "clutter":
                    track.status = "ambiguous"
                tracks.append(track)
            elif column < len(all_tracks) and row not in ambiguous:
                tracks.append(None)
            else:
                track = ClutterTrack.of(marker, at_ns)
                if row in ambiguous:
                    track.status = "ambiguous"
                tracks.append(track)
        self.clutter_tracks += [
            one for one in tracks if one and all(one is not old for old in self.clutter_tracks)
        ]
        return tracks


def _association_cost(one: Track, at_ns: int, marker: Candidate) -> float:
    """Return the cost of assigning a marker to a track.

    The cost is twice the negative log likelihood of position and appearance, up to a constant.
    """
    if one.at_ns == at_ns:  # The track was already updated by this image pair.
        return INFEASIBLE_COST
    point, sigma_m = one.predict(at_ns)
    residual = math.dist(marker.point, point) / sigma_m
    position = (STUDENT_T_DOF + 3.0) * math.log1p(residual**2 / STUDENT_T_DOF) + 6.0 * math.log(
        sigma_m
    )
    appearance = min(one.appearance_distance_sq(marker.appearance), MAX_APPEARANCE_DIST_SQ)
    return position + appearance + float(np.log(one.appearance_variance).sum())


def assign_columns(costs: Floats) -> list[int]:
    """Assign a different column to each row so that the sum of the costs is minimal.

    costs: cost matrix (n, m) with n <= m.

    Returns the column of each row. The algorithm finds shortest augmenting paths (Jonker and
    Volgenant, 1987). Importing the equivalent function of SciPy would take a third of a second.
    """
    nearest: list[int] = costs.argmin(axis=1).tolist()
    if len(set(nearest)) == len(nearest):
        return nearest
    rows, columns = costs.shape
    row_prices, prices = np.zeros(rows), np.zeros(columns)
    row_of = [-1] * columns
    for first in range(rows):
        lengths, before = np.full(columns, np.inf), np.full(columns, -1)
        is_done = np.zeros(columns, dtype=bool)
        row, column, length = first, -1, 0.0
        visited = [(first, 0.0)]
        while row >= 0:
            reached = length + costs[row] - row_prices[row] - prices
            shorter = ~is_done & (reached < lengths)
            lengths[shorter], before[shorter] = reached[shorter], column
            column = int(np.where(is_done, np.inf, lengths).argmin())
            length, is_done[column], row = float(lengths[column]), True, row_of[column]
            if row >= 0:
                visited.append((row, length))
        for one, at in visited:
            row_prices[one] += length - at
        prices[is_done] += lengths[is_done] - length
        while column >= 0:
            previous = int(before[column])
            row_of[column] = first if previous < 0 else row_of[previous]
            column = previous
    return [row_of.index(row) for row in range(rows)]


def _ambiguous_rows(costs: Floats, columns: Sequence[int], finger: int) -> set[int]:
    """Return the rows of the markers that could be either the finger or clutter.

    costs: cost of assigning each marker (row) to each track (column).
    columns: column of the track that is assigned to each marker.
    finger: column of the finger's track.
    """
    finger_row = next((row for row, column in enumerate(columns) if column == finger), None)
    ambiguous = set[int]()
    for row, column in enumerate(columns):
        if column >= finger:
            continue
        cost, swapped = costs[row, column], costs[row, finger]
        if finger_row is not None:  # cost if the two markers swap their tracks
            cost, swapped = (
                cost + costs[finger_row, finger],
                swapped + costs[finger_row, column],
            )
        if swapped - cost < AMBIGUITY_MARGIN:
            ambiguous |= {row} if finger_row is None else {row, finger_row}
    return ambiguous
