"""Test the estimate of an arm's lag with simulated servos and invalid measurements."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from flexsheet.messages.base import Header
from flexsheet.messages.types import SheetTarget
from flexsheet.nodes.arm_bridge.goal import GoalTiming, make_goal
from flexsheet.nodes.arm_bridge.report import REPORTED_TARGETS, LastExchange, LatencyMean
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.models.servo_lag import (
    MAX_SLEW_S_PER_S,
    LagBounds,
    LagEstimate,
    ServoLagEstimator,
)
from flexsheet.nodes.planner.timing import ActuationDelayEstimator
from flexsheet.nodes.twin.arms import Servo

BOUNDS = LagBounds(0.005, 0.1)
PERIOD_S = 1.0 / 140.0
TEST_SEEDS = (100, 101)


def motion(seed: int) -> Callable[[float], Floats]:
    """Return joint angles over time: sums of sines of 0.2 to 1.5 Hz, as in a stroke."""
    random = np.random.default_rng((seed, 18))
    pace = 2.0 * np.pi * random.uniform(0.2, 1.5, (3, 6))
    phase, size = random.uniform(0.0, 2.0 * np.pi, (3, 6)), random.uniform(0.005, 0.03, (3, 6))
    return lambda time_s: np.asarray((size * np.sin(pace * time_s + phase)).sum(axis=0))


def play(
    estimator: ServoLagEstimator,
    seed: int,
    lag_s: float,
    seconds: float,
    *,
    start_s: float = 0.0,
    noise_rad: float = 5e-6,
    offset_rad: float = 0.0,
    late_s: float = 0.0,
    change: Callable[[Floats], Floats] = lambda joints: joints,
) -> None:
    """Add the commands and measurements of a servo with a lag and jitter to an estimator."""
    random, path = np.random.default_rng((seed, 19)), motion(seed)
    now_s = start_s
    servo = Servo(path(now_s).copy(), max(lag_s - late_s, 1e-3), 3e-5)
    waiting: list[tuple[float, Floats]] = []
    active = path(now_s)
    while now_s < start_s + seconds:
        commanded = path(now_s)
        estimator.on_command(now_s, commanded)
        waiting.append((now_s + late_s, commanded))
        step_s = PERIOD_S * random.uniform(0.8, 1.2)
        answer_s = now_s + 0.0008
        while waiting and waiting[0][0] <= now_s:
            active = waiting.pop(0)[1]
        estimator.on_measurement(
            answer_s,
            change(servo.joints_rad + offset_rad + noise_rad * random.standard_normal(6)),
        )
        servo.advance(active, step_s)
        now_s += step_s


@pytest.mark.parametrize("lag_s", [0.01, 0.03, 0.08])
@pytest.mark.parametrize("seed", TEST_SEEDS)
def test_a_lag_is_found_within_three_seconds_of_motion(lag_s: float, seed: int) -> None:
    estimator = ServoLagEstimator(0.03, BOUNDS)
    play(estimator, seed, lag_s, 3.0)
    estimate = estimator.estimate
    assert estimate is not None
    # A command is held for a cycle, which adds half a period; the answer is 0.8 ms later.
    assert estimate.lag_s == pytest.approx(lag_s + 0.5 * PERIOD_S, abs=0.003)
    assert estimate.uncertainty_s < 0.004


@pytest.mark.parametrize("offset_rad", [-0.005, 0.005])
def test_a_constant_offset_and_a_transport_delay_do_not_bias_the_lag(offset_rad: float) -> None:
    estimator = ServoLagEstimator(0.03, BOUNDS)
    play(estimator, 100, 0.05, 4.0, offset_rad=offset_rad, noise_rad=1e-4, late_s=0.02)
    assert estimator.estimate is not None
    # The delayed command waits for the next cycle of the simulation: half a period more.
    assert estimator.estimate.lag_s == pytest.approx(0.05 + PERIOD_S, abs=0.003)


def test_a_changed_lag_is_found_within_ten_seconds_and_used_slowly() -> None:
    estimator = ServoLagEstimator(0.03, BOUNDS)
    play(estimator, 101, 0.025, 4.0)
    before_s = estimator.lag_s
    play(estimator, 102, 0.045, 8.0, start_s=100.0)
    assert estimator.lag_s - before_s == pytest.approx(0.02, abs=0.003)
    assert estimator.lag_s - before_s < 8.0 * MAX_SLEW_S_PER_S


@pytest.mark.parametrize(
    "change",
    [
        lambda joints: -joints,
        lambda joints: np.full(6, np.nan),
        lambda joints: np.full(6, np.inf),
        lambda joints: np.zeros(6),
        lambda joints: np.clip(joints, -1e-3, 1e-3),
        lambda joints: 1e300 * np.ones(6),
    ],
    ids=["wrong sign", "NaN", "infinite", "frozen", "saturated", "huge"],
)
def test_bad_measurements_keep_the_lag(change: Callable[[Floats], Floats]) -> None:
    estimator = ServoLagEstimator(0.03, BOUNDS)
    with np.errstate(over="ignore", invalid="ignore"):
        play(estimator, 103, 0.05, 4.0, change=change)
    assert estimator.estimate is None
    assert estimator.lag_s == 0.03


def test_noise_at_standstill_keeps_the_lag() -> None:
    estimator, random = ServoLagEstimator(0.03, BOUNDS), np.random.default_rng(104)
    for cycle in range(1000):
        estimator.on_command(cycle * PERIOD_S, np.ones(6))
        estimator.on_measurement(
            cycle * PERIOD_S + 0.001, np.ones(6) + 1e-4 * random.standard_normal(6)
        )
    assert estimator.estimate is None
    assert estimator.lag_s == 0.03


@pytest.mark.parametrize("seed", [200, 201])
def test_random_input_never_moves_the_lag_out_of_its_bounds(seed: int) -> None:
    random, estimator = np.random.default_rng(seed), ServoLagEstimator(0.5, BOUNDS)
    assert estimator.lag_s == BOUNDS.max_s
    now_s, path = 0.0, motion(seed)
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(1500):
            now_s += float(random.choice([0.007, 0.007, 0.0, -0.01, 0.2, math.nan], p=[
                0.9, 0.06, 0.01, 0.01, 0.01, 0.01]))  # fmt: skip
            now_s = now_s if math.isfinite(now_s) else 0.0
            scale = float(random.choice([1.0, -1.0, 1e12, math.nan], p=[0.97, 0.01, 0.01, 0.01]))
            estimator.on_command(now_s, path(now_s))
            estimator.on_measurement(now_s + 0.001, scale * path(now_s - 0.3))
            assert BOUNDS.min_s <= estimator.lag_s <= BOUNDS.max_s


def test_the_tracking_error_of_a_servo_is_the_expected_one() -> None:
    estimator = ServoLagEstimator(0.03, BOUNDS)
    play(estimator, 105, 0.04, 5.0)
    found = estimator.estimate
    assert isinstance(found, LagEstimate)
    assert found.tracking_error_rad < 2.0 * found.expected_error_rad + 1e-4


def feed(delay: ActuationDelayEstimator, sent_ms: float, *, is_measured: bool = True) -> None:
    """Add 600 fingertips of age 10 ms, and the states of an arm with a lag of 60 ms."""
    lag, latency, last = ServoLagEstimator(0.06, BOUNDS), LatencyMean(), LastExchange()
    lag.estimate = LagEstimate(0.06, 0.001, 0.0, 0.0, 0.0, 0.0) if is_measured else None
    for number in range(1, 601):
        source_ns = 16_000_000 * number
        delay.on_fingertip(0.01)
        last.target = Header(number, source_ns, source_ns, "clock", "planner", 1)
        for late_ms in (0.0, 7.0):
            last.sent_ns = source_ns + round(1e6 * (10.0 + sent_ms + late_ms))
            if (latency_s := latency.add(last, lag)) is not None:
                assert number % REPORTED_TARGETS == 0
                delay.on_latency("left", latency_s)


def test_the_actuation_delay_is_the_first_commands_delay_and_the_lag() -> None:
    delay = ActuationDelayEstimator(0.036, 0.15)
    feed(delay, 5.0)
    assert delay.delay_s == pytest.approx(0.065, abs=1e-3)


@pytest.mark.parametrize(
    ("sent_ms", "is_measured"),
    [(5.0, False), (-500.0, True), (1e6, True)],
    ids=["no lag", "sent before", "too late"],
)
def test_an_implausible_actuation_delay_is_not_used(sent_ms: float, is_measured: bool) -> None:
    delay = ActuationDelayEstimator(0.036, 0.15)
    feed(delay, sent_ms, is_measured=is_measured)
    assert delay.delay_s == 0.036


@pytest.mark.parametrize("lag_s", [BOUNDS.min_s, 0.03, BOUNDS.max_s])
def test_no_lag_extrapolates_a_target_beyond_its_limit(lag_s: float) -> None:
    """The target is limited before the limiter checks the resulting command."""
    speed_m_per_s, max_extrapolation_s = 0.2, 0.06
    target = SheetTarget(
        phase="contact",
        reason="ok",
        valid_at_ns=1_000_000_000,
        world_from_sheet=np.eye(4),
        twist_world=np.array([speed_m_per_s, 0.0, 0.0, 0.0, 0.0, 0.0]),
        stretch_ratio=1.05,
        contact_world_m=np.zeros(3),
        normal_world=np.array([0.0, 0.0, 1.0]),
        contact_sheet_m=np.zeros(2),
        push_depth_m=0.0,
    )
    timing = GoalTiming(lag_s, 1.0 / 60.0, max_extrapolation_s)
    for late_ms in range(-200, 200, 5):
        now_ns = target.valid_at_ns + 1_000_000 * late_ms
        goal = make_goal(target, received_ns=now_ns, now_ns=now_ns, timing=timing)
        moved_m = abs(float(goal.motion.world_from_sheet[0, 3]))
        assert moved_m <= speed_m_per_s * max_extrapolation_s * (1.0 + 1e-9)
