"""Compute the smallest sheet error that any linear prediction of the drawn hands allows.

    OPENBLAS_NUM_THREADS=1 python -m benchmarks.prediction_bound [--seeds 100-129]
        [--profile modern] [--json]

Each seed draws an apparatus: bandwidth of the voluntary motion, band and amplitude of the tremor,
servo lag of the arms, rate and read-out time of the camera. A hand with these values moves as in
`benchmarks.hand_motion`. The best linear predictor knows the spectrum of the hand and the noise of
the camera (Wiener filter). Its error at the times at which the arms use the prediction is a lower
bound for the mean true Δd of such a hand: the sheet adds no error, and the arms follow every
prediction exactly. The simulated finger of `flexsheet experiment robustness` has another spectrum.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from typing import Any

import numpy as np

from benchmarks.hand_motion import (
    GRID_HZ,
    TremorPeak,
    sample_tremor,
    sample_wander,
)
from benchmarks.tracking_bench import bench_scene
from benchmarks.tracking_regret import autocovariance, marker_covariance
from flexsheet.launch.commands.output import print_rows
from flexsheet.launch.experiments.robustness import apparatus_text, parse_seeds
from flexsheet.launch.plans.apparatus import load_apparatus
from flexsheet.messages.apparatus import Apparatus
from flexsheet.messages.scene import Scene
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.twin.tolerance_table import Profile

NOISE_PX = 0.02
"""Noise of the marker's centre in simulated strokes, px."""
FIXED_S = 0.003
"""Time from the end of the read-out to the command, s: computing and transport."""
SPECTRUM_S, MEMORY_S = 240.0, 1.6
"""Duration of the sampled motion, and of the measurements that the predictor reads, s."""
HORIZONS = 4
"""Number of times within a frame period at which the error is evaluated."""


def sample_hand(truth: Apparatus, random: np.random.Generator) -> Floats:
    """Sample the motion (n, 3) mm at GRID_HZ of a hand with the parameters of an apparatus."""
    finger = truth.finger
    peak = TremorPeak(
        finger.tremor_frequency_hz, finger.tremor_width_hz, 1.0, np.ones(3, dtype=np.complex128)
    )
    wander = sample_wander(finger.voluntary_bandwidth_hz, SPECTRUM_S, random)
    tremor_mm = 1e3 * (finger.tremor_rms_m or 0.0)
    return np.asarray(wander + tremor_mm * sample_tremor((peak,), SPECTRUM_S, random))


def compute_bound_mm(scene: Scene, truth: Apparatus, random: np.random.Generator) -> float:
    """Return the mean absolute error, mm, of the best linear prediction along one axis."""
    rate_hz = truth.camera.rate_hz or scene.camera.rate_hz
    lags_s = [arm.servo_lag_s or 0.0 for arm in (truth.arms.left, truth.arms.right)]
    lag_s = float(np.mean(lags_s))
    first_s = 0.5 * scene.camera.exposure_s + (truth.camera.read_out_s or 0.0) + FIXED_S + lag_s
    max_lag_s = MEMORY_S + first_s + 1.0 / rate_hz
    lags = autocovariance(sample_hand(truth, random), max_lag_s).mean(axis=1)
    grid_s = np.arange(len(lags)) / GRID_HZ
    ages_s = np.arange(round(MEMORY_S * rate_hz)) / rate_hz
    noise_mm2 = float(np.trace(marker_covariance(NOISE_PX))) / 3.0
    covariance = np.interp(np.abs(ages_s[:, None] - ages_s), grid_s, lags)
    covariance[np.diag_indices_from(covariance)] += noise_mm2
    variances = []
    for wait_s in np.linspace(0.0, 1.0 / rate_hz, HORIZONS):
        with_future = np.interp(ages_s + first_s + wait_s, grid_s, lags)
        variances.append(lags[0] - with_future @ np.linalg.solve(covariance, with_future))
    return float(np.sqrt(2.0 / np.pi * np.mean(variances)))


def measure(seeds: Sequence[int], profile: Profile) -> dict[str, Any]:
    """Return the bound of each seed, and median and 95 % value over the seeds, in mm."""
    scene = bench_scene()
    rows = []
    for seed in seeds:
        truth = load_apparatus(apparatus_text(seed, profile, calibrated=False), scene)
        bound_mm = compute_bound_mm(scene, truth, np.random.default_rng([seed, 7]))
        rows.append({"seed": seed, "sheet_mm": bound_mm})
    found = [row["sheet_mm"] for row in rows]
    return {
        "profile": profile.value,
        "sheet_mm": {"median": float(np.median(found)), "p95": float(np.quantile(found, 0.95))},
        "rows": rows,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", default="100-129", metavar="A-B")
    parser.add_argument("--profile", type=Profile, choices=list(Profile), default=Profile.MODERN)
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")
    given = parser.parse_args()
    result = measure(parse_seeds(given.seeds), given.profile)
    if given.json:
        print(json.dumps(result))
    else:
        print_rows([*result["rows"], result["sheet_mm"]], as_json=False)


if __name__ == "__main__":
    main()
