"""Test the tracking filters and the gating of measured points."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from flexsheet.nodes.models.interpolation import interpolate_path
from flexsheet.nodes.triangulator.adaptive import AdaptiveBank, BankEstimate
from flexsheet.nodes.triangulator.tracking import Tracker, TrackingSettings

Floats = NDArray[np.float64]
Path = Callable[[float], Floats]

FRAME_NS = 16_666_667
NOISE = np.diag([1e-5, 2e-5, 8e-5]) ** 2
SETTINGS = TrackingSettings(max_speed_m_per_s=1.5)


BANK = AdaptiveBank(SETTINGS.max_speed_m_per_s)


def new_tracker() -> Tracker:
    return Tracker(SETTINGS)


def followed(path: Path, frames: int, *, seed: int = 0) -> list[BankEstimate]:
    """Return the estimates after each of the frames of a noisily measured path."""
    generator = np.random.default_rng(seed)
    estimates: list[BankEstimate] = []
    for frame in range(frames):
        at_ns = frame * FRAME_NS
        seen = path(at_ns * 1e-9) + np.sqrt(np.diag(NOISE)) * generator.standard_normal(3)
        estimates.append(
            BANK.update(estimates[-1], at_ns, seen, NOISE)
            if estimates
            else BANK.initialize(at_ns, seen, NOISE)
        )
    return estimates


def feed(tracker: Tracker, path: Path, frames: range, *, seed: int = 0) -> list[str]:
    generator = np.random.default_rng(seed)
    verdicts: list[str] = []
    for frame in frames:
        at_ns = frame * FRAME_NS
        seen = path(at_ns * 1e-9) + np.sqrt(np.diag(NOISE)) * generator.standard_normal(3)
        verdicts.append(tracker.update(at_ns, seen, NOISE))
    return verdicts


def still(_: float) -> Floats:
    return np.array([0.01, 0.02, 0.03])


def steady(time_s: float) -> Floats:
    return np.array([0.1, -0.05, 0.02]) * time_s


# The filters


@given(
    steps_ns=st.lists(st.integers(1_000, 90_000_000), min_size=1, max_size=20),
    way_m=st.floats(-0.05, 0.05),
)
@settings(max_examples=25, deadline=None)
def test_every_estimate_is_finite_and_its_covariance_is_one(
    steps_ns: list[int], way_m: float
) -> None:
    estimate = BANK.initialize(0, np.zeros(3), NOISE)
    for step_ns in steps_ns:
        estimate = BANK.update(estimate, estimate.at_ns + step_ns, np.full(3, way_m), NOISE)
        position, velocity, covariance = BANK.moments(estimate)
        assert np.isfinite(position).all()
        assert np.isfinite(velocity).all()
        assert np.allclose(covariance, covariance.T)
        assert np.linalg.eigvalsh(covariance).min() > 0
        assert np.isfinite(BANK.predict(estimate, np.array([0.0, 0.1]))).all()


def test_the_path_ahead_begins_where_the_finger_is() -> None:
    last = followed(steady, 50)[-1]
    position, velocity, _ = BANK.moments(last)
    ahead = BANK.predict(last, np.array([0.0, 1e-4]))
    assert ahead[0] == pytest.approx(position, abs=1e-15)
    assert (ahead[1] - ahead[0]) / 1e-4 == pytest.approx(velocity, abs=1e-2)


def lag_s(lead_s: float) -> float:
    """Return the mean lag of the prediction behind a uniform finger."""
    errors = [
        BANK.predict(estimate, np.array([lead_s]))[0] - steady(estimate.at_ns * 1e-9 + lead_s)
        for estimate in followed(steady, 600)[100:]
    ]
    velocity = steady(1.0)
    return float(-np.mean(errors @ velocity) / (velocity @ velocity))


def test_a_steady_finger_is_predicted_without_lag() -> None:
    assert abs(lag_s(0.05)) < 1e-3


def test_a_resting_finger_is_known_better_than_it_is_measured() -> None:
    errors = [BANK.moments(estimate)[0] - still(0.0) for estimate in followed(still, 600)[60:]]
    assert np.sqrt(np.mean(np.square(errors))) < 0.95 * np.sqrt(np.trace(NOISE) / 3)


def test_tremor_is_predicted() -> None:
    def trembling(time_s: float) -> Floats:
        return np.array([5e-5 * np.sin(2 * np.pi * 9.3 * time_s), 0.0, 0.0])

    errors = [
        BANK.predict(one, np.array([0.02]))[0, 0] - trembling(one.at_ns * 1e-9 + 0.02)[0]
        for one in followed(trembling, 900)[200:]
    ]
    left_out_m = 5e-5 / np.sqrt(2)
    assert np.sqrt(np.mean(np.square(errors))) < 0.75 * left_out_m


def test_a_start_and_a_stop_are_followed_within_a_few_frames() -> None:
    def stop_and_go(time_s: float) -> Floats:
        return np.array([0.2 * min(max(time_s - 1.0, 0.0), 0.5), 0.0, 0.0])

    estimates = followed(stop_and_go, 180)
    off = [
        np.linalg.norm(BANK.moments(one)[0] - stop_and_go(one.at_ns * 1e-9))
        for one in estimates[30:]
    ]
    assert max(off) < 2e-3
    assert np.linalg.norm(BANK.moments(estimates[-1])[1]) < 5e-3


# The path ahead


@given(
    lead_s=st.floats(-0.05, 0.3),
    velocity=st.floats(-1.5, 1.5),
)
def test_an_even_path_is_met_everywhere(lead_s: float, velocity: float) -> None:
    path = np.array([0.1, 0.0, 0.0]) + velocity * 0.01 * np.arange(13)[:, None]
    position, speed = interpolate_path(path, 0.01, lead_s)
    assert position == pytest.approx(np.array([0.1, 0.0, 0.0]) + velocity * lead_s, abs=1e-12)
    assert speed == pytest.approx(np.full(3, velocity), abs=1e-9)


def test_a_swing_is_met_between_the_points() -> None:
    times = 0.01 * np.arange(13)
    path = np.column_stack([np.sin(2 * np.pi * 10 * times)] * 3)
    for lead_s in np.linspace(0.0, 0.12, 100):
        assert interpolate_path(path, 0.01, lead_s)[0][0] == pytest.approx(
            np.sin(2 * np.pi * 10 * lead_s), abs=0.02
        )


def test_a_path_of_one_point_is_rejected() -> None:
    with pytest.raises(ValueError, match="at least two are required"):
        interpolate_path(np.zeros((1, 3)), 0.01, 0.0)


# The gate


def test_a_track_begins_with_points_that_agree() -> None:
    tracker = new_tracker()
    assert tracker.state(0) == "lost"
    assert feed(tracker, steady, range(3)) == ["unconfirmed", "unconfirmed", "ok"]
    assert tracker.state(2 * FRAME_NS) == "tracking"
    assert tracker.state(4 * FRAME_NS) == "coasting"
    assert tracker.state(60 * FRAME_NS) == "lost"
    # The points that confirmed it are in it: its velocity is known from the start.
    velocity = tracker.predict_at(2 * FRAME_NS, np.zeros(1)).velocity
    assert velocity == pytest.approx([0.1, -0.05, 0.02], abs=0.02)


def test_points_that_do_not_agree_begin_no_track() -> None:
    tracker = new_tracker()
    generator = np.random.default_rng(1)
    for frame in range(100):
        result = tracker.update(frame * FRAME_NS, generator.uniform(-0.15, 0.15, 3), NOISE)
        assert result in ("unconfirmed", "ok")
        if result == "ok":
            pytest.fail("three random points in a row look like a finger")


def test_a_jump_is_rejected_and_forgotten() -> None:
    tracker = new_tracker()
    feed(tracker, steady, range(60))
    assert (
        tracker.update(60 * FRAME_NS, steady(1.0) + np.array([0.05, 0.0, 0.0]), NOISE) == "too_fast"
    )
    assert tracker.state(60 * FRAME_NS) == "coasting"
    assert feed(tracker, steady, range(61, 64)) == ["ok"] * 3
    track = tracker.predict_at(63 * FRAME_NS, np.zeros(1))
    assert track.position == pytest.approx(steady(63 * FRAME_NS * 1e-9), abs=3e-4)


def test_a_jump_that_stays_becomes_the_track() -> None:
    tracker = new_tracker()
    feed(tracker, still, range(60))

    def elsewhere(_: float) -> Floats:
        return still(0.0) + np.array([0.0, 0.1, 0.0])

    assert feed(tracker, elsewhere, range(60, 64)) == ["too_fast", "too_fast", "ok", "ok"]


def test_a_track_is_carried_over_a_gap_and_then_lost() -> None:
    tracker = new_tracker()
    feed(tracker, steady, range(60))
    short, long = 64 * FRAME_NS, 90 * FRAME_NS
    expected = tracker.gate(short)
    assert expected is not None
    assert expected.point == pytest.approx(steady(short * 1e-9), abs=2e-3)
    assert tracker.gate(long) is None
    lost = tracker.predict_at(long, np.array([0.0, 0.05]))
    assert (lost.velocity == 0).all()
    assert (lost.path == lost.position).all()
    assert feed(tracker, steady, range(90, 93)) == ["unconfirmed", "unconfirmed", "ok"]


@given(
    speed=st.floats(0.0, 1.4),
    direction=st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda d: np.linalg.norm(d) > 0.1),
    frames_lost=st.integers(0, 4),
)
@settings(max_examples=30, deadline=None)
def test_no_even_finger_is_ever_too_fast(
    speed: float, direction: tuple[float, float, float], frames_lost: int
) -> None:
    velocity = speed * np.array(direction) / np.linalg.norm(direction)
    tracker = new_tracker()
    feed(tracker, lambda time_s: velocity * time_s, range(20))
    again = range(20 + frames_lost, 30)
    assert set(feed(tracker, lambda time_s: velocity * time_s, again)) == {"ok"}


@given(way_m=st.floats(0.03, 10.0))
@settings(max_examples=30, deadline=None)
def test_nothing_beyond_a_fingers_reach_enters(way_m: float) -> None:
    tracker = new_tracker()
    feed(tracker, still, range(30))
    before = tracker.estimate
    assert (
        tracker.update(30 * FRAME_NS, still(0.0) + np.array([way_m, 0.0, 0.0]), NOISE) == "too_fast"
    )
    assert tracker.estimate is before


# Late and missing points


def test_a_late_point_corrects_the_track() -> None:
    """Points out of order give the same track as points in order."""
    generator = np.random.default_rng(2)
    points = [
        steady(frame * FRAME_NS * 1e-9) + 1e-5 * generator.standard_normal(3) for frame in range(40)
    ]
    order = [*range(30), 31, 32, 30, 34, 33, 35, 36, 37, 38, 39]
    in_order, shuffled = new_tracker(), new_tracker()
    for frame in range(40):
        in_order.update(frame * FRAME_NS, points[frame], NOISE)
    late = 0
    for frame in order:
        late += shuffled.is_late(frame * FRAME_NS)
        shuffled.update(frame * FRAME_NS, points[frame], NOISE)
    assert late == 2
    horizons_s = np.array([0.0, 0.05])
    assert shuffled.predict_at(39 * FRAME_NS, horizons_s).path == pytest.approx(
        in_order.predict_at(39 * FRAME_NS, horizons_s).path, abs=1e-12
    )


def test_a_late_jump_a_doubled_point_and_an_ancient_one_change_nothing() -> None:
    tracker = new_tracker()
    feed(tracker, steady, range(60))
    before = tracker.estimate
    doubled, deviation = steady(58 * FRAME_NS * 1e-9), steady(1.0) + np.array([0.2, 0.0, 0.0])
    assert tracker.update(58 * FRAME_NS, doubled, NOISE) == "unconfirmed"
    assert tracker.update(57 * FRAME_NS + 5, deviation, NOISE) == "unconfirmed"
    assert tracker.update(10, steady(0.0), NOISE) == "unconfirmed"
    assert tracker.estimate is before


@pytest.mark.parametrize("off_m", [0.003, 0.01, 0.02])
def test_a_late_point_is_gated_like_one_in_time(off_m: float) -> None:
    """A point that is too fast in order is also rejected when it is late."""
    tracker = new_tracker()
    feed(tracker, still, range(58))
    for frame in (59, 60):
        tracker.update(frame * FRAME_NS, still(0.0), NOISE)
    before = tracker.estimate
    deviation = still(0.0) + np.array([off_m, 0.0, 0.0])
    in_time = new_tracker()
    feed(in_time, still, range(58))
    if in_time.update(58 * FRAME_NS, deviation, NOISE) == "too_fast":
        tracker.update(58 * FRAME_NS, deviation, NOISE)
        assert tracker.estimate is before
    else:
        assert off_m < 0.01


def test_a_late_point_where_none_is_missing_is_left_out() -> None:
    """A clock that steps back by about a frame would otherwise compress the finger's path."""
    tracker = new_tracker()
    feed(tracker, steady, range(60))
    before = tracker.estimate
    assert tracker.update(59 * FRAME_NS - 3_000_000, steady(1.0), NOISE) == "unconfirmed"
    assert tracker.estimate is before


@pytest.mark.parametrize("step_s", [0.1, 5.0])
def test_a_clock_that_steps_back_costs_a_few_frames(step_s: float) -> None:
    tracker = new_tracker()
    feed(tracker, steady, range(120))
    back_ns = round(step_s * 1e9)
    verdicts = [
        tracker.update(frame * FRAME_NS - back_ns, steady(frame * FRAME_NS * 1e-9), NOISE)
        for frame in range(120, 130)
    ]
    assert verdicts == ["unconfirmed"] * 2 + ["ok"] * 8


@pytest.mark.parametrize("step_s", [0.03, 0.08, 5.0])
def test_a_clock_that_steps_ahead_costs_a_few_frames_and_no_jump(step_s: float) -> None:
    tracker = new_tracker()
    feed(tracker, still, range(120))
    ahead_ns = round(step_s * 1e9)
    places = []
    for frame in range(120, 140):
        at_ns = frame * FRAME_NS + ahead_ns
        if tracker.update(at_ns, still(0.0), NOISE) == "ok":
            places.append(tracker.predict_at(at_ns, np.zeros(1)).position)
    assert len(places) >= 18
    assert np.abs(np.array(places) - still(0.0)).max() < 1e-4


def test_half_the_frames_are_enough() -> None:
    def rms_m(step: int) -> float:
        tracker = new_tracker()
        errors = []
        for frame in range(0, 600, step):
            feed(tracker, steady, range(frame, frame + 1), seed=frame)
            at_ns = frame * FRAME_NS
            if frame > 100:
                errors.append(
                    tracker.predict_at(at_ns, np.zeros(1)).position - steady(at_ns * 1e-9)
                )
        return float(np.sqrt(np.mean(np.square(errors))))

    assert rms_m(2) < 2.0 * rms_m(1)
