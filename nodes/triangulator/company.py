"""Which of the marks in sight is the finger's: the others are remembered as bystanders.

A mark that is seen while the finger is followed, and is not where the finger can be, is none of the
finger's.  It is followed on its own, so that it is not taken for the finger when that is hidden, or
when both come apart after they were one in the pictures.  Who is who in a new picture is the most
likely assignment of its marks to those of before, by place and by brightness (global nearest
neighbour: Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking and Navigation);
where another assignment is about as likely a mark is doubtful, and no finger is said to be there.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from messages.types import FingertipReason
from nodes.triangulator.fingertip import Candidate, Sighting
from nodes.triangulator.tracking import Tracker
from nodes.triangulator.triangulation import Measured

Floats = NDArray[np.float64]
Standing = Literal["fresh", "doubtful", "bystander"]
"""Of a mark that is not followed as the finger's: it may be; it may be, or one that is not; it is
not."""

PLACE_SIGMA_M = 0.0005
TURN_SIGMA_M_PER_S2 = 1.0
FREEDOM = 2.0
"""What a mark deviates from its even motion, per axis: of its place, and of its acceleration.  Most
do little and some do much, as Student's distribution of so many degrees of freedom has it."""

SAME_M = 0.002
"""Marks so near to one another are one, seen twice."""

LOST_SIGMA_M = 0.1
"""A moving mark that was not seen for long is anywhere in the finger's volume."""

LEAST_LOOKS_SIGMA = np.array([0.01, 0.02])
FIRST_LOOKS_SIGMA = np.array([0.04, 0.08])
ANY_LOOKS_SIGMA = np.array([0.2, 0.4])
"""Standard deviations of looks, as shares of the level of a mark and of its surroundings: skin is
around the finger's always, and around another now this, now that.  From picture to picture at
least, and before it is known; between one mark and another."""

LOOKS_S = 0.2
LOOKS_SPREAD_S = 3.0
"""Times over which a mark's looks are averaged, and the squares of what the finger's are off."""

FRESH_COST = 6.0 * math.log(LOST_SIGMA_M) + 2.0 * float(np.log(ANY_LOOKS_SIGMA).sum())
NEVER = 1e9
"""Of a mark that was not there before, see `_cost`; of what cannot be."""

MARGIN = 9.0
"""By which one assignment must be more likely than another, on the same scale: 3 sigma."""

UNLIKE = 16.0
"""Sum of squared deviations at which a mark does not look like another, and no more is told by it:
4 sigma."""

SMOOTHING_S = 0.05
"""Time over which the velocity of a bystander is averaged."""

SURVEY_S = 0.1
"""So often the whole pictures are searched while the finger is followed."""

LATE_M = 0.03
"""A mark in a picture that comes late is the finger's when it alone is so near to where that is."""

STILL_M = 3e-4
STILL_S = 1.5
"""No hand keeps a finger within that distance for so long."""

REMEMBER_S = 1.0
REMEMBER_STILL_S = 10.0
"""A mark out of sight is remembered for so long, if it moved, and if it was still."""

GLIMPSES = 3
GLIMPSED_S = 0.1
"""What may be the finger's and was seen in fewer pictures is remembered for less."""

ALONE_S = 1.0
"""A doubtful mark that is the only one in sight for so long is the finger's after all."""

FORGIVEN_S = 5.0
"""When the finger was not seen for so long, a bystander that moves is doubtful."""


@dataclass(slots=True)
class Known:
    """A mark when it was last seen: place (3,), velocity (3,), looks (2,) and their variance."""

    point: Floats
    velocity: Floats
    looks: Floats
    looks_variance: Floats
    at_ns: int

    def whereabouts(self, at_ns: int) -> tuple[Floats, float]:
        """Where it should be (3,), and the scale of what it is off per axis, m."""
        since_s = (at_ns - self.at_ns) * 1e-9
        sigma_m = PLACE_SIGMA_M + 0.5 * TURN_SIGMA_M_PER_S2 * since_s**2
        return self.point + since_s * self.velocity, min(sigma_m, LOST_SIGMA_M)

    def unlikeness(self, looks: Floats) -> float:
        """Sum of the squared deviations of other looks from its own, in standard deviations."""
        return float((np.square(looks - self.looks) / self.looks_variance).sum())

    def looked(self, looks: Floats, at_ns: int) -> None:
        """Take new looks in."""
        since_s, off = (at_ns - self.at_ns) * 1e-9, looks - self.looks
        self.looks = self.looks - math.expm1(-since_s / LOOKS_S) * off
        spread = np.maximum(off * off, LEAST_LOOKS_SIGMA**2) - self.looks_variance
        self.looks_variance = self.looks_variance - math.expm1(-since_s / LOOKS_SPREAD_S) * spread


@dataclass(slots=True)
class Other(Known):
    """A mark that is not followed as the finger's.

    still_at, still_since_ns: the place (3,) that it has not left since, but for STILL_M.
    alone_since_ns: since when it is the only one in sight.
    """

    still_at: Floats
    still_since_ns: int
    alone_since_ns: int
    standing: Standing = "fresh"
    pictures: int = 1

    @staticmethod
    def of(mark: Candidate, at_ns: int) -> Other:
        variance = FIRST_LOOKS_SIGMA**2
        return Other(mark.point, np.zeros(3), mark.looks, variance, at_ns, mark.point, at_ns, at_ns)

    @property
    def is_still(self) -> bool:
        """Whether it was, when last seen."""
        return (self.at_ns - self.still_since_ns) * 1e-9 >= STILL_S

    def whereabouts(self, at_ns: int) -> tuple[Floats, float]:
        if self.is_still:
            return self.point, PLACE_SIGMA_M
        return Known.whereabouts(self, at_ns)

    def seen(self, mark: Candidate, at_ns: int, *, alone: bool) -> None:
        since_s = (at_ns - self.at_ns) * 1e-9
        share = 1.0 if self.pictures == 1 else -math.expm1(-since_s / SMOOTHING_S)
        velocity = (mark.point - self.point) / since_s
        self.velocity = self.velocity + share * (velocity - self.velocity)
        self.looked(mark.looks, at_ns)
        self.point, self.at_ns, self.pictures = mark.point, at_ns, self.pictures + 1
        if math.dist(mark.point, self.still_at) > STILL_M:
            self.still_at, self.still_since_ns = mark.point, at_ns
        if not alone:
            self.alone_since_ns = at_ns

    def is_remembered(self, at_ns: int) -> bool:
        """For some time out of sight; and not when the clock has stepped back."""
        remember_s = REMEMBER_S
        if self.is_still and self.standing == "bystander":
            remember_s = REMEMBER_STILL_S
        if self.pictures < GLIMPSES and self.standing == "fresh":
            remember_s = GLIMPSED_S
        return 0 <= at_ns - self.at_ns <= 1e9 * remember_s


class Company:
    """The finger's mark, and those in sight beside it."""

    def __init__(self) -> None:
        self.others: list[Other] = []
        self._finger: Known | None = None
        self._successor: Other | None = None
        self._surveyed_ns = 0

    def judge(
        self, at_ns: int, sighting: Sighting, tracker: Tracker
    ) -> tuple[FingertipReason, Measured | None]:
        """Which mark of a picture is the finger's, if one is, and what the tracker says to it."""
        if tracker.is_late(at_ns):
            return self._late(at_ns, sighting, tracker)
        if tracker.expected(at_ns) is not None:
            chosen = self._go_on(at_ns, sighting)
        else:
            chosen = self._begin(at_ns, sighting)
        if not isinstance(chosen, Candidate):
            return chosen, sighting.measured
        verdict = tracker.take(at_ns, chosen.point, chosen.measured.covariance)
        if verdict == "ok":
            self._follow(at_ns, chosen, tracker)
        return verdict, chosen.measured

    def _late(
        self, at_ns: int, sighting: Sighting, tracker: Tracker
    ) -> tuple[FingertipReason, Measured | None]:
        """As `judge` of an earlier picture: who was who then is not remembered, but the finger is.

        Several in a row begin a track anew, since the clock has stepped back.
        """
        marks = sighting.marks
        if len(marks) > 1 and self._finger is not None:
            here = self._finger.point
            marks = tuple(mark for mark in marks if math.dist(mark.point, here) < LATE_M)
        if sighting.reason not in ("ok", "two_marks") or len(marks) != 1:
            return sighting.reason, sighting.measured
        mark = marks[0]
        verdict = tracker.take(at_ns, mark.point, mark.measured.covariance)
        if verdict == "ok":
            self.others, self._finger = [], None
            self._follow(at_ns, mark, tracker)
        return verdict, mark.measured

    def is_survey_due(self, at_ns: int) -> bool:
        """Whether the last was so long ago, or in a time that the clock has stepped back from."""
        return not 0 <= at_ns - self._surveyed_ns < 1e9 * SURVEY_S

    def survey(self, at_ns: int, sighting: Sighting) -> None:
        """Follow on what is in the whole pictures in which the finger was just seen."""
        self._surveyed_ns = at_ns
        seen = [one.point for one in self.others if one.at_ns == at_ns]
        if self._finger is not None:
            seen.append(self._finger.point)
        marks = [
            mark
            for mark in (*sighting.marks, *sighting.others)
            if all(math.dist(mark.point, point) > SAME_M for point in seen)
        ]
        for other in self._met(at_ns, marks, None):
            if other is not None:
                other.standing = "bystander"

    def _follow(self, at_ns: int, mark: Candidate, tracker: Tracker) -> None:
        """The tracker has taken this mark for the finger's."""
        assert tracker.estimate is not None
        if self._finger is None:
            self._finger = Other.of(mark, at_ns)
        self._finger.looked(mark.looks, at_ns)
        self._finger.velocity = tracker.filter.moments(tracker.estimate)[1]
        self._finger.point, self._finger.at_ns = mark.point, at_ns
        self.others = [other for other in self.others if other.point is not mark.point]

    def _go_on(self, at_ns: int, sighting: Sighting) -> Candidate | FingertipReason:
        """The mark of a finger that is followed, or why it is not there."""
        met = self._met(at_ns, [*sighting.marks, *sighting.others], self._finger)
        near = met[: len(sighting.marks)]
        own = [mark for mark, other in zip(sighting.marks, near, strict=True) if other is None]
        for other in met if own else met[len(near) :]:
            if other is not None and other.standing == "fresh":
                # Without the finger in sight it is only known that it should not be there.
                other.standing = "bystander" if own else "doubtful"
        if sighting.reason not in ("ok", "two_marks"):
            return sighting.reason
        if own:
            return own[0]
        bystanders = all(other and other.standing == "bystander" for other in near)
        return "no_mark" if bystanders else "two_marks"

    def _begin(self, at_ns: int, sighting: Sighting) -> Candidate | FingertipReason:
        """The mark that a track may begin with, or why there is none."""
        marks = [*sighting.marks, *sighting.others]
        succeeded = any(other is self._successor for other in self.others)
        met = self._met(at_ns, marks, None if succeeded else self._finger)
        for place, mark in enumerate(marks):
            if met[place] is None:  # where the finger was lost; from now on it is one of them
                self._successor = met[place] = Other.of(mark, at_ns)
                self.others.append(self._successor)
        best = self._best(at_ns)
        if sighting.reason not in ("ok", "two_marks"):
            return sighting.reason
        for mark, other in zip(sighting.marks, met, strict=False):
            if other is best:
                return mark
        bystanders = all(other and other.standing == "bystander" for other in met)
        return "no_mark" if bystanders else "two_marks"

    def _best(self, at_ns: int) -> Other | None:
        """The mark that is taken for the lost finger's, if that can be told."""
        finger = self._finger
        away_s = math.inf if finger is None else (at_ns - finger.at_ns) * 1e-9
        claims: list[tuple[float, Other]] = []
        for other in self.others:
            if other.standing == "bystander" and away_s > FORGIVEN_S and not other.is_still:
                other.standing = "doubtful"
            unlike = 0.0 if finger is None else finger.unlikeness(other.looks)
            if unlike > UNLIKE and other.standing == "fresh":
                other.standing = "doubtful"
            if other.standing != "bystander" and unlike <= UNLIKE:
                claims.append((unlike, other))
        if any(not other.is_still for _, other in claims):
            claims = [claim for claim in claims if not claim[1].is_still]
        claims.sort(key=lambda claim: claim[0])
        if len(claims) > 1 and claims[1][0] - claims[0][0] > MARGIN:
            return claims[0][1] if claims[0][1].pictures > GLIMPSES else None
        if len(claims) == 1 and claims[0][1].standing == "fresh":
            return claims[0][1]
        lonely = [
            other
            for other in self.others
            if other.standing == "doubtful"
            and other.at_ns == at_ns
            and (at_ns - other.alone_since_ns) * 1e-9 > ALONE_S
        ]
        return lonely[0] if lonely else None

    def _met(
        self, at_ns: int, marks: Sequence[Candidate], finger: Known | None
    ) -> list[Other | None]:
        """Who the marks of a picture are; None: the finger's."""
        self.others = [other for other in self.others if other.is_remembered(at_ns)]
        if not marks:
            return []
        known = [*self.others, *([] if finger is None else [finger])]
        costs = np.full((len(marks), len(known) + len(marks)), NEVER)
        for row, mark in enumerate(marks):
            costs[row, : len(known)] = [_cost(one, at_ns, mark) for one in known]
            costs[row, len(known) + row] = FRESH_COST
        who = linear_sum_assignment(costs)[1].tolist()
        doubtful = set[int]() if finger is None else _doubtful(costs, who, len(known) - 1)
        met: list[Other | None] = []
        for row, (column, mark) in enumerate(zip(who, marks, strict=True)):
            if column < len(self.others):
                other = self.others[column]
                other.seen(mark, at_ns, alone=len(marks) == 1)
                if row in doubtful and other.standing == "bystander":
                    other.standing = "doubtful"
                met.append(other)
            elif column < len(known) and row not in doubtful:
                met.append(None)
            else:
                other = Other.of(mark, at_ns)
                if row in doubtful:
                    other.standing = "doubtful"
                met.append(other)
        self.others += [one for one in met if one and all(one is not old for old in self.others)]
        return met


def _cost(one: Known, at_ns: int, mark: Candidate) -> float:
    """Twice the negative log likelihood of a mark being that one, but for a constant."""
    if one.at_ns == at_ns:  # it was another mark of the same picture
        return NEVER
    place, sigma_m = one.whereabouts(at_ns)
    off = math.dist(mark.point, place) / sigma_m
    away = (FREEDOM + 3.0) * math.log1p(off * off / FREEDOM) + 6.0 * math.log(sigma_m)
    looks = min(one.unlikeness(mark.looks), UNLIKE)
    return away + looks + float(np.log(one.looks_variance).sum())


def _doubtful(costs: Floats, who: Sequence[int], finger: int) -> set[int]:
    """The marks (rows) that may as well be the finger's (its column) as another that is known."""
    own = next((row for row, column in enumerate(who) if column == finger), None)
    doubtful = set[int]()
    for row, column in enumerate(who):
        if column >= finger:
            continue
        price, instead = costs[row, column], costs[row, finger]
        if own is not None:  # the two would change places
            price, instead = price + costs[own, finger], instead + costs[own, column]
        if instead - price < MARGIN:
            doubtful |= {row} if own is None else {row, own}
    return doubtful
