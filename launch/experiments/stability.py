"""Evaluate whether a hand that touches the sheet is stable: `flexsheet experiment stability`.

To render a force, the planner moves the sheet along its normal by an offset that depends on the
finger depth. The slope is the change of the offset divided by the change of the depth. Two
experiments are simulated in the time domain, without running nodes:

- boundary: the critical slope, above which a random hand is not stable. It is compared with the
  prediction from the eigenvalues of the sampled control loop (`nodes.models.hand_loop`).
- map: the stability with the offset that the planner uses for objects of several stiffnesses.
  Random hands are combined with several delays, jitters of the delay, and depths. The planner's
  stability limits of the offset are either used or not.

The random hands are sampled from the ranges in the literature with a separate seed. The limits are
therefore tested with hands that were not used to derive them.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flexsheet.launch.experiments import ExperimentError
from flexsheet.launch.experiments.hand_simulation import Cases, simulate_release
from flexsheet.launch.experiments.run import Progress
from flexsheet.launch.health.compliance import compute_compliance
from flexsheet.messages.scene import Scene
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.models.hand_loop import (
    Hand,
    SampledLoop,
    compute_critical_slope,
)
from flexsheet.nodes.models.sheet.force_models import SheetForceModel, SheetPush
from flexsheet.nodes.planner.compliance import (
    Compliance,
    ObjectCurve,
)
from flexsheet.nodes.planner.hand_bounds import load_or_compute_bounds

HAND_RANGES = {
    "finger": ((0.004, 0.01), (50.0, 800.0), (0.3, 1.2)),
    "wrist": ((0.1, 0.2), (100.0, 400.0), (0.15, 0.5)),
    "arm": ((0.5, 1.5), (100.0, 800.0), (0.15, 0.6)),
}
"""The ranges of mass (kg), stiffness (N/m) and damping ratio of each kind of random hand.

`nodes.models.hand_loop` lists the sources.
"""

DELAYS_S = (0.01, 0.03, 0.05, 0.07, 0.1)
JITTERS_S = (0.0, 0.03)
"""The maximum packet jitters (s); the additional delays are uniformly distributed from zero."""

RATES_HZ = (30.0, 60.0, 120.0)
OBJECT_RATIOS = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0)
DEPTH_FRACTIONS = (0.25, 0.6, 0.95)
GAINS = (1.0, 1.25, 1.5, 2.0, 3.0)
"""The factors by which the sheet's motion is increased to measure the gain margin."""

LINEAR_STIFFNESS_N_PER_M, LINEAR_DEPTH_M = 100.0, 0.02
MAX_BOUNDARY_SLOPE = 1.5
"""The maximum critical slope that is compared with the prediction.

At larger slopes, the finger loses contact with the sheet.
"""

SLOPES = 32
FILTERS = ((math.inf, False), (math.inf, True), (10.0, False))
"""The depth filters: bandwidth (rad/s), and whether the depth is predicted over the delay.

An infinite bandwidth means that the depth is not filtered.
"""


@dataclass(frozen=True, slots=True)
class StabilitySettings:
    """The settings of the experiment.

    hands: number of random hands in each group of HAND_RANGES, sampled with `seed`.
    delays_s, jitters_s: delays of the control loop and their jitter.
    rates_hz: camera rates at which the critical slope is measured.
    object_ratios: factors of the stiffness of the scene's object.
    """

    hands: int = 4
    seed: int = 100
    delays_s: Sequence[float] = DELAYS_S
    rates_hz: Sequence[float] = RATES_HZ
    object_ratios: Sequence[float] = OBJECT_RATIOS
    jitters_s: Sequence[float] = JITTERS_S


def draw_hands(count: int, seed: int) -> list[Hand]:
    """Return random hands: `count` hands from each group of HAND_RANGES.

    Mass and stiffness are log-uniformly distributed, and the damping ratio is uniformly
    distributed.
    """
    rng = np.random.default_rng(seed)
    hands = []
    for masses, stiffnesses, dampings in HAND_RANGES.values():
        for _ in range(count):
            mass = float(np.exp(rng.uniform(*np.log(masses))))
            stiffness = float(np.exp(rng.uniform(*np.log(stiffnesses))))
            damping = 2.0 * float(rng.uniform(*dampings)) * (mass * stiffness) ** 0.5
            hands.append(Hand(mass, damping, stiffness))
    return hands


@dataclass(frozen=True, slots=True)
class Trial:
    """A trial in which a hand in a control loop is released near an equilibrium depth."""

    hand: Hand
    loop: SampledLoop
    depth_m: float
    jitter_s: float = 0.0


def make_cases(trials: Sequence[Trial], gains: Floats) -> Cases:
    """Return the simulated cases of all combinations of trials and gains.

    The gain multiplies the sheet's motion around the equilibrium. The cases of one trial are
    consecutive.
    """

    def repeat(values: Iterable[float]) -> Floats:
        return np.repeat(np.fromiter(values, dtype=np.float64), len(gains))

    return Cases(
        mass_kg=repeat(one.hand.mass_kg for one in trials),
        damping_ns_per_m=repeat(one.hand.damping_ns_per_m for one in trials),
        stiffness_n_per_m=repeat(one.hand.stiffness_n_per_m for one in trials),
        delay_s=repeat(one.loop.delay_s for one in trials),
        jitter_s=repeat(one.jitter_s for one in trials),
        depth_m=repeat(one.depth_m for one in trials),
        gain=np.tile(gains, len(trials)),
        bandwidth_rad_per_s=repeat(one.loop.bandwidth_rad_per_s for one in trials),
        lead_s=repeat(one.loop.lead_s for one in trials),
    )


def find_critical_slopes(trials: Sequence[Trial], *, towards_finger: bool) -> Floats:
    """Return the smallest slope at which the hand of each trial becomes unstable.

    The slope is the change of the sheet's offset divided by the change of the finger depth. The
    force of the sheet is proportional to its indentation. The result is NaN if the hand is stable
    up to a slope of 1.5, or unstable already at the smallest tested slope. All trials must have the
    same camera period.

    towards_finger: whether the slopes are negative, so that the sheet moves towards the finger.
    """
    slopes = np.geomspace(0.03, MAX_BOUNDARY_SLOPE, SLOPES)
    motion = simulate_release(
        make_cases(trials, -slopes if towards_finger else slopes),
        force=lambda indented_m: LINEAR_STIFFNESS_N_PER_M * indented_m,
        offset=lambda depths_m: depths_m - LINEAR_DEPTH_M,
        period_s=trials[0].loop.period_s,
    )
    result = np.full(len(trials), np.nan)
    for number, row in enumerate(motion.decays.reshape(len(trials), -1)):
        unstable = np.flatnonzero(~row)
        if len(unstable) and unstable[0] > 0:
            # Return the geometric mean of the last stable and first unstable slope (ratio 1.13).
            result[number] = float(np.sqrt(slopes[unstable[0]] * slopes[unstable[0] - 1]))
    return result


def measure_boundary(settings: StabilitySettings, progress: Progress) -> list[dict[str, Any]]:
    """Compare simulated with predicted stability limits, and return table rows.

    The limit is the critical slope: the change of the sheet's offset per change of the finger depth
    above which a hand is unstable. There is one row per hand and control loop for which the
    simulation finds a limit.
    """
    hands = draw_hands(settings.hands, settings.seed)
    rows: list[dict[str, Any]] = []
    for rate_hz, towards in product(settings.rates_hz, (True, False)):
        progress(f"boundary at {rate_hz:g} Hz, sheet {'advance' if towards else 'retreat'}")
        trials = [
            Trial(
                hand,
                SampledLoop(1.0 / rate_hz, delay_s, bandwidth, delay_s if predicted else 0.0),
                LINEAR_DEPTH_M,
            )
            for hand, delay_s, (bandwidth, predicted) in product(hands, settings.delays_s, FILTERS)
        ]
        simulated = find_critical_slopes(trials, towards_finger=towards)
        for trial, measured in zip(trials, simulated, strict=True):
            if not np.isfinite(measured):
                continue
            predicted = compute_critical_slope(
                trial.hand,
                trial.loop,
                sheet_stiffness_n_per_m=LINEAR_STIFFNESS_N_PER_M,
                towards_finger=towards,
                max_slope=2.0 * MAX_BOUNDARY_SLOPE,
            )
            rows.append(
                {
                    **_describe(trial.hand, trial.loop.delay_s),
                    "rate_hz": rate_hz,
                    "filter_bandwidth_rad_per_s": _finite(trial.loop.bandwidth_rad_per_s),
                    "predicted_depth": trial.loop.lead_s > 0.0,
                    "towards_finger": towards,
                    "simulated_slope": float(measured),
                    "predicted_slope": predicted,
                    "error_percent": 100.0 * (predicted / float(measured) - 1.0),
                }
            )
    return rows


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _describe(hand: Hand, delay_s: float) -> dict[str, float]:
    return {
        "mass_kg": hand.mass_kg,
        "damping_ns_per_m": hand.damping_ns_per_m,
        "stiffness_n_per_m": hand.stiffness_n_per_m,
        "delay_ms": 1e3 * delay_s,
    }


def measure_map(
    scene: Scene,
    model: SheetForceModel,
    curve: Floats,
    settings: StabilitySettings,
    progress: Progress,
    *,
    cache_dir: Path | None = None,
) -> list[dict[str, Any]]:
    """Simulate random hands that push objects of several stiffnesses; return table rows.

    There is one row per object, hand, delay, jitter and kind of control loop. The kinds are:

    - "bounded": the planner's control loop, with stability limits of the sheet's offset and a
      filter of the finger depth.
    - "unbounded": a control loop without limits and filter.
    - "predicted": as "unbounded", but with the depth extrapolated over the delay.

    The jitter is a random additional delay. The planner's limits are computed for the mean delay,
    which is the constant delay plus half of the maximum jitter.
    """
    material = scene.object.material
    if material is None:
        raise ExperimentError(
            f'scene "{scene.name}": the object is rigid; give a scene with the key object.material'
        )
    hands = draw_hands(settings.hands, settings.seed + 1)
    table = load_or_compute_bounds(scene.camera.rate_hz, cache_dir)
    period_s = 1.0 / scene.camera.rate_hz
    rows: list[dict[str, Any]] = []
    for ratio in settings.object_ratios:
        # At equal Poisson's ratio, the force is proportional to Young's modulus.
        scaled = ObjectCurve.from_rows(curve * np.array([1.0, ratio]))
        object_pa = ratio * material.young_modulus_pa
        progress(f"object with Young's modulus {object_pa:.3g} Pa")
        for delay_s, jitter_s in product(settings.delays_s, settings.jitters_s):
            fitted = compute_compliance(
                scene, model, scaled, bounds=table.at_delay(delay_s + 0.5 * jitter_s)
            )
            bandwidth, suffices = fitted.choose_bandwidth_rad_per_s()
            loops = [SampledLoop(period_s, delay_s, bandwidth)]
            for row in _simulate_pushes(fitted, hands, loops, jitter_s):
                rows.append(
                    {"object_pa": object_pa, "kind": "bounded", "warned": not suffices} | row
                )
        fitted = compute_compliance(scene, model, scaled)
        for kind, jitter_s in product(("unbounded", "predicted"), settings.jitters_s):
            loops = [
                SampledLoop(period_s, delay_s, lead_s=delay_s if kind == "predicted" else 0.0)
                for delay_s in settings.delays_s
            ]
            for row in _simulate_pushes(fitted, hands, loops, jitter_s):
                rows.append({"object_pa": object_pa, "kind": kind, "warned": False} | row)
    return rows


def _simulate_pushes(
    fitted: Compliance, hands: Sequence[Hand], loops: Sequence[SampledLoop], jitter_s: float
) -> list[dict[str, Any]]:
    """Simulate pushes, and return a table row for each hand and control loop.

    A row is marked as stable if the hand is stable at all depths.
    """
    indented_m = np.linspace(0.0, 2.0 * fitted.max_depth_m, 400)
    push = SheetPush(fitted.stretch_ratio, fitted.finger_radius_m)
    forces_n = fitted.model.evaluate(push, indented_m).force_n
    depths_m = np.linspace(0.0, fitted.max_depth_m, 400)
    offsets_m = fitted.normal_offset_m(depths_m)

    def offset(at_m: Floats) -> Floats:
        # Beyond the last tabulated depth, the sheet moves as far as the finger.
        beyond = np.maximum(at_m - depths_m[-1], 0.0)
        return np.asarray(np.interp(at_m, depths_m, offsets_m) + beyond)

    trials = [
        Trial(hand, loop, fraction * fitted.max_depth_m, jitter_s)
        for hand, loop, fraction in product(hands, loops, DEPTH_FRACTIONS)
    ]
    motion = simulate_release(
        make_cases(trials, np.array(GAINS)),
        force=lambda at_m: np.asarray(np.interp(at_m, indented_m, forces_n)),
        offset=offset,
        period_s=loops[0].period_s,
    )
    stable: NDArray[np.bool_] = np.all(
        motion.stable.reshape(-1, len(DEPTH_FRACTIONS), len(GAINS)), axis=1
    )
    rows = []
    for (hand, loop), gains in zip(product(hands, loops), list(stable), strict=True):
        unstable = np.flatnonzero(~gains)
        margin = GAINS[-1] if len(unstable) == 0 else (0.0, *GAINS)[unstable[0]]
        rows.append(
            {
                **_describe(hand, loop.delay_s),
                "jitter_ms": 1e3 * jitter_s,
                "filter_bandwidth_rad_per_s": _finite(loop.bandwidth_rad_per_s),
                "advance_per_depth": fitted.centre.advance_per_depth,
                "stable": bool(gains[0]),
                "margin": float(margin),
            }
        )
    return rows


def stability_result(
    scene: Scene,
    model: SheetForceModel,
    curve: Floats,
    settings: StabilitySettings,
    progress: Progress,
) -> dict[str, Any]:
    """Simulate hands on the sheet; return the result of `flexsheet experiment stability --json`.

    The first simulation finds the critical slope, above which a hand is unstable. The slope is the
    change of the sheet's offset divided by the change of the finger depth. The second simulation
    tests whether hands are stable with objects of several stiffnesses.
    """
    boundary = measure_boundary(settings, progress)
    rows = measure_map(scene, model, curve, settings, progress)
    errors = np.abs([row["error_percent"] for row in boundary])
    bounded = [row for row in rows if row["kind"] == "bounded"]
    unbounded = [row for row in rows if row["kind"] != "bounded"]
    return {
        "scene": scene.name,
        "seed": settings.seed,
        "cases": {"bounded": len(bounded), "unbounded": len(unbounded)},
        "unstable": {
            "bounded": sum(not row["stable"] for row in bounded),
            "unbounded": sum(not row["stable"] for row in unbounded),
        },
        "rows": bounded,
        "without_bounds": unbounded,
        "boundary_error_percent": float(np.percentile(errors, 95.0)) if len(errors) else None,
        "boundary_median_percent": float(np.median(errors)) if len(errors) else None,
        "boundary": boundary,
    }
