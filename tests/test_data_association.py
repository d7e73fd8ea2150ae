"""Test data association: known clutter is not confused with the finger, which is found again."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from flexsheet.nodes.triangulator.data_association import (
    CLUTTER_RELEASE_TIME_S,
    SOLE_CANDIDATE_TIME_S,
    DataAssociation,
)
from flexsheet.nodes.triangulator.fingertip import Candidate, StereoDetection
from flexsheet.nodes.triangulator.tracking import Tracker, TrackingSettings
from flexsheet.nodes.triangulator.triangulation import TriangulatedPoint

Floats = NDArray[np.float64]
Place = Callable[[float], Floats]
FRAME_S = 1.0 / 60.0
NOISE = np.diag([2e-5, 3e-5, 6e-5]) ** 2
SKIN, CLOTH = np.log([215.0, 80.0]), np.log([150.0, 40.0])


class Bench:
    """A tracker and its company, shown marks frame by frame."""

    def __init__(self) -> None:
        settings = TrackingSettings(max_speed_m_per_s=1.5)
        self.tracker = Tracker(settings)
        self.association = DataAssociation()
        self.random = np.random.default_rng(1)
        self.time_s = 10.0

    def show(self, *markers: tuple[Place, Floats]) -> tuple[str, Floats | None]:
        """Process one image of markers with their appearances: return the reason and the selected
        point."""
        self.time_s += FRAME_S
        at_ns = round(1e9 * self.time_s)
        candidates = [
            Candidate(
                TriangulatedPoint(
                    place(self.time_s) + self.random.multivariate_normal(np.zeros(3), NOISE),
                    NOISE,
                    0.05,
                ),
                appearance + 0.005 * self.random.standard_normal(2),
            )
            for place, appearance in markers
        ]
        expected = self.tracker.gate(at_ns)
        near = [
            one
            for one in candidates
            if expected is None or np.linalg.norm(one.point - expected.point) <= expected.radius_m
        ]
        far = [one for one in candidates if all(one is not other for other in near)]
        reason = (
            "ok"
            if len(near) == 1
            else "two_markers"
            if near
            else "too_fast"
            if far
            else "no_marker"
        )
        first = (near or far or [None])[0]
        measured = None if first is None else first.measured
        detection = StereoDetection(reason, measured, tuple(near), tuple(far))
        result, chosen = self.association.select_finger(at_ns, detection, self.tracker)
        if result == "ok" and self.association.is_clutter_search_due(at_ns):
            self.association.track_clutter(at_ns, detection)
        return result, None if chosen is None else chosen.point_world

    def run(
        self, seconds: float, *markers: tuple[Place, Floats]
    ) -> list[tuple[str, Floats | None]]:
        return [self.show(*markers) for _ in range(round(seconds / FRAME_S))]


def finger(time_s: float) -> Floats:
    return np.array([0.01 * np.sin(2.0 * time_s), 0.008 * np.cos(1.7 * time_s), 0.0])


def bead(time_s: float) -> Floats:
    return np.array([0.05 + 0.02 * np.sin(3.0 * time_s), 0.01, 0.02 * np.cos(2.1 * time_s)])


def reasons(shown: Sequence[tuple[str, Floats | None]]) -> list[str]:
    return [reason for reason, _ in shown]


def all_at(shown: Sequence[tuple[str, Floats | None]], place: Place, bench: Bench) -> bool:
    """Return whether the last valid point is at the current position of that marker."""
    points = [point for reason, point in shown if reason == "ok" and point is not None]
    return bool(np.linalg.norm(points[-1] - place(bench.time_s)) < 1e-3)


def test_tracked_clutter_is_not_confused_with_a_hidden_finger() -> None:
    bench = Bench()
    bench.run(0.2, (finger, SKIN))
    assert set(reasons(bench.run(0.5, (finger, SKIN), (bead, SKIN)))) == {"ok"}
    assert "ok" not in reasons(bench.run(2.0, (bead, SKIN)))
    again = bench.run(0.2, (bead, SKIN), (finger, SKIN))
    assert reasons(again)[:3] == ["unconfirmed", "unconfirmed", "ok"]
    assert all_at(again, finger, bench)


def test_markers_that_cross_are_not_swapped() -> None:
    bench = Bench()

    def passing(time_s: float) -> Floats:
        return finger(time_s) + np.array([0.15 * (time_s - 11.0), 0.002, -0.004])

    bench.run(0.3, (finger, SKIN))
    bench.run(0.6, (finger, SKIN), (passing, SKIN))
    while abs(passing(bench.time_s)[0] - finger(bench.time_s)[0]) < 0.012:
        bench.time_s += FRAME_S  # they are one in the pictures, and no mark
    apart = bench.run(0.4, (passing, SKIN), (finger, SKIN))
    found = [point for reason, point in apart if reason == "ok" and point is not None]
    assert len(found) > 15
    assert all_at(apart, finger, bench)


def test_two_unknown_markers_are_ambiguous() -> None:
    bench = Bench()
    assert set(reasons(bench.run(2.0, (finger, SKIN), (bead, SKIN)))) == {"two_markers"}


def test_of_two_unknown_markers_the_moving_one_is_the_finger() -> None:
    bench = Bench()
    shown = bench.run(2.0, (finger, SKIN), (lambda _: np.array([0.06, 0.0, 0.0]), SKIN))
    assert shown[0][0] == "two_markers"
    assert shown[-1][0] == "ok"
    assert all_at(shown, finger, bench)


def test_a_lost_finger_is_recognised_by_its_appearance() -> None:
    bench = Bench()
    bench.run(1.0, (finger, SKIN))
    bench.time_s += 0.3
    shown = bench.run(0.4, (bead, CLOTH), (finger, SKIN))
    assert shown[-1][0] == "ok"
    assert all_at(shown, finger, bench)
    bench.time_s += 0.3
    assert "ok" not in reasons(bench.run(0.5, (bead, CLOTH)))


def test_a_sole_moving_marker_finally_becomes_the_finger() -> None:
    bench = Bench()
    bench.run(0.3, (finger, SKIN))
    bench.run(0.5, (finger, SKIN), (bead, SKIN))
    assert "ok" not in reasons(bench.run(0.9 * CLUTTER_RELEASE_TIME_S, (bead, SKIN)))
    shown = bench.run(0.1 * CLUTTER_RELEASE_TIME_S + 2.0 * SOLE_CANDIDATE_TIME_S, (bead, SKIN))
    assert shown[-1][0] == "ok"
    assert all_at(shown, bead, bench)


@pytest.mark.parametrize("step_s", [0.1, 5.0])
def test_a_clock_that_steps_back_costs_a_few_frames(step_s: float) -> None:
    bench = Bench()
    bench.run(0.3, (finger, SKIN))
    bench.run(0.5, (finger, SKIN), (bead, SKIN))
    bench.time_s -= step_s

    def shifted(place: Place) -> Place:
        return lambda time_s: place(time_s + step_s)

    shown = bench.run(0.3, (shifted(finger), SKIN), (shifted(bead), SKIN))
    assert reasons(shown)[:4] == ["unconfirmed", "unconfirmed", "ok", "ok"]
    assert all_at(shown, shifted(finger), bench)
