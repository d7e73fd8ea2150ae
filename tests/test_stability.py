"""Test the control loop of hand and sheet: predicted bounds, simulation, filter and watchdog."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from flexsheet.launch.experiments.hand_simulation import (
    CAMERA_RESOLUTION_M,
    HeldOffset,
    simulate_release,
)
from flexsheet.launch.experiments.stability import (
    StabilitySettings,
    Trial,
    draw_hands,
    find_critical_slopes,
    make_cases,
    measure_map,
)
from flexsheet.nodes.models.hand_loop import (
    HANDS,
    LIMITING_HANDS,
    Hand,
    OffsetBoundsTable,
    SampledLoop,
    compute_critical_slope,
    compute_decays_per_s,
    compute_filter_gains,
    make_loop_matrices,
)
from flexsheet.nodes.planner.oscillation_watchdog import FADE_S, OscillationWatchdog
from flexsheet.nodes.planner.sheet_force import make_force_model
from flexsheet.nodes.planner.stabilized_offset import StabilizedOffset
from tests.examples import long_except
from tests.hand_bounds import make_bounds_60_hz
from tests.test_planner import SCENE

PERIOD_S = 1.0 / 60.0
WRIST = HANDS["wrist"]


@pytest.fixture(scope="module")
def bounds() -> OffsetBoundsTable:
    return make_bounds_60_hz()


def test_without_offset_the_decay_is_that_of_the_hand() -> None:
    loop = SampledLoop(PERIOD_S, 0.044)
    (decay,) = compute_decays_per_s(WRIST, loop, sheet_stiffness_n_per_m=100.0, slopes=np.zeros(1))
    assert decay == pytest.approx(0.5 * WRIST.damping_ns_per_m / WRIST.mass_kg, rel=1e-6)


@pytest.mark.parametrize("delay_s", [0.0, PERIOD_S, 0.044, 3.0 * PERIOD_S])
def test_the_state_over_a_period_is_that_of_small_steps(delay_s: float) -> None:
    # The motion by the matrix equals an explicit integration with the same rule.
    hand, slope, stiffness = WRIST, 0.4, 100.0
    loop = SampledLoop(PERIOD_S, delay_s, bandwidth_rad_per_s=12.0, lead_s=0.02)
    (matrix,) = make_loop_matrices(
        hand, loop, sheet_stiffness_n_per_m=stiffness, slopes=np.array([slope])
    )
    steps, periods = 400, 60
    step_s = PERIOD_S / steps
    x, v = 1e-3, 0.0
    filtered = speed = y = 0.0
    alpha, beta = compute_filter_gains(loop.bandwidth_rad_per_s, PERIOD_S)
    queue: list[tuple[int, float, float]] = []
    held = rate = 0.0
    state = np.zeros(len(matrix))
    state[0] = x
    for n in range(steps * periods):
        if n % steps == 0:
            assert x == pytest.approx(state[0], abs=1e-5)
            assert v == pytest.approx(state[1], abs=4e-4)
            state = matrix @ state
            before, error = y, x - filtered - PERIOD_S * speed
            filtered += PERIOD_S * speed + alpha * error
            speed += beta / PERIOD_S * error
            y = filtered + loop.lead_s * speed
            queue.append((n + round(delay_s / step_s), slope * y, slope * (y - before) / PERIOD_S))
        while queue and queue[0][0] <= n:
            _, held, rate = queue.pop(0)
        acceleration = (
            -(hand.stiffness_n_per_m + stiffness) * x - hand.damping_ns_per_m * v + stiffness * held
        ) / hand.mass_kg
        v += step_s * acceleration
        x += step_s * v
        held += step_s * rate


@pytest.mark.parametrize("towards", long_except([True, False], True))
def test_the_predicted_boundary_is_that_of_the_simulation(towards: bool) -> None:
    hands = draw_hands(1, 7)
    trials = [
        Trial(hand, SampledLoop(PERIOD_S, delay_s, bandwidth, lead_s), 0.02)
        for hand in hands
        for delay_s, bandwidth, lead_s in (
            (0.03, math.inf, 0.03),
            (0.07, math.inf, 0.07),
            (0.1, math.inf, 0.1),
            (0.07, 10.0, 0.03),
        )
    ]
    simulated = find_critical_slopes(trials, towards_finger=towards)
    compared = np.isfinite(simulated)
    assert compared.sum() >= 3
    predicted = [
        compute_critical_slope(
            trial.hand, trial.loop, sheet_stiffness_n_per_m=100.0, towards_finger=towards
        )
        for trial in trials
    ]
    np.testing.assert_allclose(np.array(predicted)[compared], simulated[compared], rtol=0.2)


def test_hands_of_low_damping_determine_the_bounds() -> None:
    loops = [SampledLoop(PERIOD_S, delay_s, bandwidth) for delay_s, bandwidth in
             ((0.04, 16.0), (0.08, 5.0), (0.12, 10.0))]  # fmt: skip

    def least(hands: tuple[Hand, ...], loop: SampledLoop, towards: bool) -> float:
        return min(
            compute_critical_slope(
                hand, loop, sheet_stiffness_n_per_m=120.0, towards_finger=towards, max_slope=1.0
            )
            for hand in hands
        )

    for loop in loops:
        for towards in (True, False):
            among_all = least(tuple(HANDS.values()), loop, towards)
            assert least(LIMITING_HANDS, loop, towards) <= 1.02 * among_all


def test_bounds_fall_with_delay_and_stiffness_and_end_with_the_table(
    bounds: OffsetBoundsTable,
) -> None:
    for slopes in (bounds.max_advances, bounds.max_retreats):
        assert (np.diff(slopes, axis=0) <= 0.0).all()
        assert (np.diff(slopes, axis=2) <= 0.0).all()
    beyond = bounds.at_delay(0.5)
    assert beyond.max_advance(4.5, np.array([100.0])) == 0.0
    assert beyond.max_retreat(4.5, np.array([100.0])) == 0.0


def test_a_prediction_of_the_depth_permits_less_than_none() -> None:
    loop = SampledLoop(PERIOD_S, 0.044)
    for towards in (True, False):
        light = HANDS["relaxed finger"]
        without, with_lead = (
            compute_critical_slope(
                light, one, sheet_stiffness_n_per_m=100.0, towards_finger=towards
            )
            for one in (loop, replace(loop, lead_s=0.044))
        )
        assert with_lead < 0.5 * without


def test_a_passive_sheet_lets_every_hand_come_to_rest_without_energy() -> None:
    trials = [Trial(hand, SampledLoop(PERIOD_S, 0.05), 0.02) for hand in draw_hands(3, 5)]
    motion = simulate_release(
        make_cases(trials, np.ones(1)),
        force=lambda indented_m: 100.0 * indented_m,
        offset=np.zeros_like,
        period_s=PERIOD_S,
        seconds=4.0,
    )
    assert motion.stable.all()
    assert motion.energy_ratio.max() < 1e-3


def test_jitter_delays_measurements_and_drops_those_that_are_overtaken() -> None:
    delay_s, jitter_s, steps = 0.02, 0.05, 64
    step_s = PERIOD_S / steps
    loop = SampledLoop(PERIOD_S, delay_s)
    cases = make_cases([Trial(WRIST, loop, 0.0, jitter_s)], np.ones(1))
    held = HeldOffset(cases, lambda depths_m: depths_m, PERIOD_S, step_s)
    lags = []
    for step in range(200 * steps):
        if step % steps == 0:
            held.sample(step, np.array([0.001 * step / steps]))
        lags.append(step * step_s - PERIOD_S * float(held.advance(step)[0]) / 0.001)
    # The depth rises at a constant rate, so that the lag is the delay of the newest measurement.
    settled = np.array(lags[10 * steps :])
    resolution_s = PERIOD_S * CAMERA_RESOLUTION_M / 0.001
    assert settled.min() >= delay_s - step_s - resolution_s
    assert settled.max() <= delay_s + jitter_s + step_s + resolution_s
    changes = np.flatnonzero(np.abs(np.diff(settled)) > resolution_s + step_s) + 1
    measured = np.round((changes * step_s - settled[changes]) / PERIOD_S)
    assert (np.diff(measured) > 0).all()
    assert len(changes) < 185


def run_coupled(
    slope: float, *, hand: Hand, bandwidth: float, seconds: float, delay_s: float = 0.05
) -> tuple[StabilizedOffset, list[float], list[float]]:
    """Simulate a hand with `StabilizedOffset`, and return hand, depths and weights of the
    watchdog.
    """
    controller = StabilizedOffset()
    stiffness, rest_m = 100.0, 0.02
    steps = 64
    step_s = PERIOD_S / steps
    x, v = rest_m - 1e-3, 0.0
    held, rate = 0.0, 0.0
    queue: list[tuple[int, float, float]] = []
    depths, weights = [], []
    # The hand pushes so that it rests at `rest_m` against a passive sheet.
    push_n = stiffness * rest_m
    for n in range(round(seconds / step_s)):
        if n % steps == 0:
            offset, speed = controller.update(
                x,
                lambda depth: slope * (depth - rest_m),
                step_s=PERIOD_S,
                bandwidth_rad_per_s=bandwidth,
                delay_s=delay_s,
            )
            queue.append((n + round(delay_s / step_s), offset, speed))
            depths.append(x)
            weights.append(controller.watchdog.weight)
        while queue and queue[0][0] <= n:
            _, held, rate = queue.pop(0)
        force = stiffness * max(x - held, 0.0)
        pull = push_n - hand.stiffness_n_per_m * (x - rest_m)
        v += step_s / hand.mass_kg * (pull - hand.damping_ns_per_m * v - force)
        x = min(max(x + step_s * v, 1e-6), 0.06)
        held += step_s * rate
    return controller, depths, weights


def test_the_watchdog_stops_an_oscillation_without_bounds() -> None:
    hand = HANDS["wrist of low damping"]
    controller, depths, weights = run_coupled(-1.2, hand=hand, bandwidth=math.inf, seconds=6.0)
    assert controller.watchdog.triggers == 1
    first = next(n for n, weight in enumerate(weights) if weight < 1.0)
    assert weights[first + math.ceil(FADE_S / PERIOD_S)] == 0.0
    # Afterwards the sheet is passive, and the hand comes to rest.
    assert np.ptp(depths[-60:]) < 2e-4
    assert (np.diff(weights[first:]) <= 0.0).all()


def test_the_watchdog_permits_what_the_bounds_permit(bounds: OffsetBoundsTable) -> None:
    permitted = bounds.at_delay(0.05)
    slope = -float(permitted.max_advance(4.5, np.array([100.0]))[0])
    for hand in HANDS.values():
        controller, depths, _ = run_coupled(slope, hand=hand, bandwidth=4.5, seconds=6.0)
        assert controller.watchdog.triggers == 0
        assert np.ptp(depths[-30:]) < 2e-4


def test_a_person_who_pushes_rhythmically_does_not_trigger_the_watchdog() -> None:
    watchdog = OscillationWatchdog()
    rng = np.random.default_rng(4)
    for n in range(900):
        time_s = n * PERIOD_S
        depth = 0.015 + 0.006 * math.sin(2.0 * math.pi * 2.0 * time_s) * min(1.0, time_s / 5.0)
        # A sheet that retreats late takes energy from the person.
        late = 0.015 + 0.006 * math.sin(2.0 * math.pi * 2.0 * (time_s - 0.05)) * min(
            1.0, time_s / 5.0
        )
        watchdog.update(depth + rng.normal(0.0, 5e-5), 0.5 * late, PERIOD_S)
    assert watchdog.triggers == 0


@pytest.mark.parametrize("end_m", [0.0005, 0.006])
def test_a_person_who_holds_and_withdraws_slowly_does_not_trigger_the_watchdog(
    end_m: float,
) -> None:
    watchdog, rng = OscillationWatchdog(), np.random.default_rng(2)
    filtered, offsets = 0.0, [0.0] * 3
    for n in range(300):
        s = min(max((n * PERIOD_S - 3.0) / 0.8, 0.0), 1.0)
        depth = 0.012 + (end_m - 0.012) * s**3 * (10.0 - 15.0 * s + 6.0 * s * s)
        measured = depth + rng.normal(0.0, 1e-4)
        # The sheet retreats by a fraction of the filtered depth, three periods late.
        filtered += 0.25 * (measured - filtered)
        offsets.append(0.3 * filtered)
        watchdog.update(measured, offsets[-4], PERIOD_S)
    assert watchdog.triggers == 0


def test_the_watchdog_is_ready_again_after_the_contact() -> None:
    controller, *_ = run_coupled(
        -1.2, hand=HANDS["wrist of low damping"], bandwidth=math.inf, seconds=6.0
    )
    arguments = {"step_s": PERIOD_S, "bandwidth_rad_per_s": math.inf, "delay_s": 0.05}
    assert controller.update(0.0, lambda depth: depth, **arguments) == (0.0, 0.0)
    assert controller.watchdog.weight == 1.0
    assert controller.watchdog.triggers == 1


def test_the_offset_of_a_moving_finger_is_that_of_the_simulation() -> None:
    # Planner and simulation filter the depth by code of their own.
    loop = SampledLoop(PERIOD_S, 0.0, 8.0)
    cases = make_cases([Trial(WRIST, loop, 0.0)], np.ones(1))
    held = HeldOffset(cases, lambda depths_m: 0.7 * depths_m, PERIOD_S, PERIOD_S)
    controller = StabilizedOffset()
    for n in range(240):
        depth = CAMERA_RESOLUTION_M * round((0.01 + 0.05 * PERIOD_S * n) / CAMERA_RESOLUTION_M)
        held.sample(n, np.array([depth]))
        offset, _ = controller.update(
            depth,
            lambda filtered: 0.7 * filtered,
            step_s=PERIOD_S,
            bandwidth_rad_per_s=8.0,
            delay_s=0.0,
        )
        assert offset == pytest.approx(min(float(held.advance(n)[0]), depth), abs=1e-12)
    # The filter does not lag behind a constant rate.
    assert offset == pytest.approx(0.7 * depth, abs=2e-5)


def test_a_sheet_that_retreats_stays_with_a_finger_that_leaves() -> None:
    controller = StabilizedOffset()
    for depth in [0.02] * 60 + list(np.linspace(0.02, 0.0005, 6)):
        offset, _ = controller.update(
            depth,
            lambda filtered: 0.9 * filtered,
            step_s=PERIOD_S,
            bandwidth_rad_per_s=4.5,
            delay_s=0.05,
        )
        assert offset <= depth


def test_the_planners_bounds_keep_drawn_hands_stable(tmp_path: Path) -> None:
    depths = SCENE.working_range.push_depth_m * np.linspace(0.0, 1.0, 12)
    rows = measure_map(
        SCENE,
        make_force_model(SCENE.sheet),
        np.column_stack([depths, 58.0 * depths]),
        StabilitySettings(
            hands=1, seed=300, delays_s=(0.055,), object_ratios=(4.0,), jitters_s=(0.03,)
        ),
        lambda text: None,
        cache_dir=tmp_path,
    )
    bounded = [row for row in rows if row["kind"] == "bounded"]
    assert {row["jitter_ms"] for row in bounded} == {30.0}
    assert all(row["stable"] for row in bounded)
    assert any(not row["stable"] for row in rows if row["kind"] == "predicted")
