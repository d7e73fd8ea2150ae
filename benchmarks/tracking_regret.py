"""Measure the regret of the tracking: its error relative to its best model and to a bound.

    OPENBLAS_NUM_THREADS=1 python -m benchmarks.tracking_regret [--seeds 100-101] [--json]
        [--recording FILE] [--output docs/charts]

The truth is `benchmarks.hand_motion`, which shares nothing with the tracking. Seeds 0 to 99 are
for development. The least possible error is that of the best linear predictor (Wiener), built from
the autocovariance of another, long recording of the same hand and the true measurement noise; it
reads MAX_TAPS_S of measurements and knows no single axis from another. A recorded finger (t_s,
x_mm, y_mm, z_mm) is interpolated by a spline and has no such bound. --output writes
`tracking-regret.json`, from which `make docs` makes the tables of docs/tracking.md.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.signal import lfilter

from benchmarks.hand_motion import (
    GRID_HZ,
    draw_tremor,
    sample_strokes,
    sample_tremor,
    sample_wander,
)
from benchmarks.tracking_bench import ROOT, bench_scene
from flexsheet.launch.methods.results import describe_load, machine_name
from flexsheet.launch.running.commit import read_commit
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.triangulator.adaptive import AdaptiveBank, BankEstimate, predict_by_model
from flexsheet.nodes.triangulator.triangulation import StereoGeometry, measure

FILE_NAME = "tracking-regret.json"
RECORDING = ROOT.parent / "shared" / "data" / "finger" / "reach_and_grip.csv"

TREMOR_BANDS_HZ = ((5.0, 7.0), (6.0, 9.0), (8.0, 12.0))
TREMOR_MM = (0.02, 0.05, 0.15)
VOLUNTARY = ("1 Hz", "2 Hz", "3 Hz", "strokes")
NOISES_PX = (0.01, 0.1)
RATES_HZ = (60, 30, 15)
HORIZONS_S = (0.044, 0.1)

DURATION_S, WARM_UP_S, SPECTRUM_S = 10.0, 1.5, 120.0
MAX_TAPS_S, MAX_TAPS = 1.6, 90


@dataclass(frozen=True, slots=True)
class Hand:
    """A hand: name, true path (n, 3), mm, at GRID_HZ, and autocovariance by axis (lags, 3).

    A recorded hand has no autocovariance.
    """

    motion: str
    band: str
    tremor_mm: float | None
    path: Floats
    autocovariance: Floats | None


@dataclass(frozen=True, slots=True)
class Regret:
    """The conditions of one case, and the RMS error (mm) of the tracking and of each reference.

    error_mm: error of the tracking, under the key "adaptive".
    bank_mm: error of the best single model of the bank, chosen in hindsight.
    wiener_mm: error of the predictor that knows the spectrum, or None for a recorded hand.
    """

    motion: str
    band: str
    tremor_mm: float | None
    noise_px: float
    rate_hz: int
    horizon_ms: int
    seed: int
    error_mm: Mapping[str, float]
    bank_mm: float
    wiener_mm: float | None


def draw_hands(seed: int) -> Iterator[Hand]:
    """Draw hands with each voluntary motion, tremor band and amplitude."""
    path_s = DURATION_S + 2.0 * HORIZONS_S[-1]
    spectrum = {
        key: autocovariance(part, MAX_TAPS_S + 2.0 * HORIZONS_S[-1])
        for key, part in _sample_parts(seed, SPECTRUM_S, 1).items()
    }
    parts = _sample_parts(seed, path_s, 0)
    for motion, band, tremor_mm in product(VOLUNTARY, TREMOR_BANDS_HZ, TREMOR_MM):
        yield Hand(
            motion=motion,
            band=_band_name(band),
            tremor_mm=tremor_mm,
            path=parts[motion] + tremor_mm * parts[_band_name(band)],
            autocovariance=spectrum[motion] + tremor_mm**2 * spectrum[_band_name(band)],
        )


def _band_name(band_hz: tuple[float, float]) -> str:
    return f"{band_hz[0]:.0f}-{band_hz[1]:.0f} Hz"


def _sample_parts(seed: int, duration_s: float, realization: int) -> dict[str, Floats]:
    """Sample each tremor (of unit size) and each voluntary motion of a hand, (n, 3) mm."""
    parts = {}
    for index, band in enumerate(TREMOR_BANDS_HZ):
        random = np.random.default_rng([seed, realization, index])
        parts[f"{_band_name(band)}"] = sample_tremor(draw_tremor(band, seed), duration_s, random)
    for index, motion in enumerate(VOLUNTARY):
        random = np.random.default_rng([seed, realization, 50 + index])
        parts[motion] = (
            sample_strokes(duration_s, random)
            if motion == "strokes"
            else sample_wander(float(motion.removesuffix(" Hz")), duration_s, random)
        )
    return parts


def autocovariance(path: Floats, max_lag_s: float) -> Floats:
    """Return the autocovariance by axis (lags, 3), mm^2, of a path (n, 3) in mm at GRID_HZ."""
    lags = round(max_lag_s * GRID_HZ) + 1
    spectrum = np.abs(np.fft.rfft(path - path.mean(axis=0), axis=0)) ** 2
    return np.asarray(np.fft.irfft(spectrum, axis=0)[:lags] / len(path))


def read_recording(file: Path) -> Hand:
    """Read a recorded finger.

    Raises ValueError if the file lacks a column.
    """
    table = np.genfromtxt(file, delimiter=",", names=True)
    names = ("t_s", "x_mm", "y_mm", "z_mm")
    if table.dtype.names is None or not set(names) <= set(table.dtype.names):
        raise ValueError(f"{file}: columns {table.dtype.names}: {', '.join(names)} are needed")
    times = table["t_s"] - table["t_s"][0]
    points = np.stack([table[name] for name in names[1:]], axis=1)
    grid = np.arange(0.0, times[-1], 1.0 / GRID_HZ)
    return Hand(file.stem, "-", None, CubicSpline(times, points)(grid), None)


def marker_covariance(noise_px: float) -> Floats:
    """Return the covariance (3, 3) mm^2 of a point in the middle of the default scene's screen."""
    geometry = StereoGeometry.of(bench_scene().camera)
    covariance_px = noise_px**2 * np.eye(2)
    left, right = geometry.project(np.zeros(3))
    found = measure(geometry, left, right, covariance=covariance_px)
    assert found is not None
    return 1e6 * found.covariance


def predict_with_spectrum(
    measured: Floats, autocovariance: Floats, variances: Floats, rate_hz: int, horizon_s: float
) -> Floats:
    """Predict points (n, 3) by the best linear predictor for each axis, from known statistics."""
    step = round(GRID_HZ / rate_hz)
    ages = np.arange(min(round(MAX_TAPS_S * rate_hz), MAX_TAPS))
    predicted = np.empty_like(measured)
    for axis in range(3):
        lagged = autocovariance[:, axis]
        covariance = lagged[step * np.abs(ages[:, None] - ages)] + variances[axis] * np.eye(
            len(ages)
        )
        weights = np.linalg.solve(covariance, lagged[step * ages + round(horizon_s * GRID_HZ)])
        predicted[:, axis] = lfilter(weights, [1.0], measured[:, axis])
    return predicted


def compare_predictions(
    hand: Hand, noise_px: float, rate_hz: int, seed: int, step_s: dict[str, list[float]]
) -> Iterator[Regret]:
    """Measure a hand, and compare the predictions at each horizon.

    step_s: receives the time of each update with its predictions, under the key "adaptive".
    """
    step = round(GRID_HZ / rate_hz)
    count = (len(hand.path) - round(HORIZONS_S[-1] * GRID_HZ)) // step
    variances, axes = np.linalg.eigh(marker_covariance(noise_px))
    random = np.random.default_rng([seed, rate_hz, round(1000 * noise_px)])
    # Axes of the noise, in which the hand's own are as arbitrary as in the world.
    noise = random.standard_normal((count, 3)) * np.sqrt(variances)
    measured = hand.path[: count * step : step] + noise
    truth = [hand.path[round(h * GRID_HZ) :][: count * step : step] for h in HORIZONS_S]
    times_ns = np.round(np.arange(count) * 1e9 / rate_hz).astype(np.int64)
    covariance = 1e-6 * (axes * variances) @ axes.T
    is_warm = times_ns >= WARM_UP_S * 1e9

    def rms_mm(predicted: Floats, horizon: int) -> float:
        off = (predicted - truth[horizon])[is_warm]
        return float(np.sqrt(np.mean(np.sum(off**2, axis=1))))

    world_m = 1e-3 * measured @ axes.T
    bank = AdaptiveBank(max_speed_m_per_s=1.5)
    estimate: BankEstimate | None = None
    predicted = np.empty((len(HORIZONS_S), count, 3))
    by_model: list[Floats] = []
    durations = step_s.setdefault("adaptive", [])
    for i, at_ns in enumerate(times_ns.tolist()):
        begin_s = time.perf_counter()
        estimate = (
            bank.initialize(at_ns, world_m[i], covariance)
            if estimate is None
            else bank.update(estimate, at_ns, world_m[i], covariance)
        )
        predicted[:, i] = bank.predict(estimate, np.array(HORIZONS_S))
        durations.append(time.perf_counter() - begin_s)
        by_model.append(predict_by_model(estimate, np.array(HORIZONS_S)))
    models = 1e3 * np.array(by_model) @ axes  # (count, horizons, models, 3)
    for horizon, horizon_s in enumerate(HORIZONS_S):
        wiener_mm = None
        if hand.autocovariance is not None:
            known = predict_with_spectrum(
                measured, hand.autocovariance, variances, rate_hz, horizon_s
            )
            wiener_mm = rms_mm(known, horizon)
        yield Regret(
            motion=hand.motion,
            band=hand.band,
            tremor_mm=hand.tremor_mm,
            noise_px=noise_px,
            rate_hz=rate_hz,
            horizon_ms=round(1e3 * horizon_s),
            seed=seed,
            error_mm={"adaptive": rms_mm(1e3 * predicted[horizon] @ axes, horizon)},
            bank_mm=min(
                rms_mm(models[:, horizon, model], horizon) for model in range(models.shape[2])
            ),
            wiener_mm=wiener_mm,
        )


def measure_all(seeds: Sequence[int], recording: Path | None) -> dict[str, Any]:
    """Return the result of `--json`: machine, commit, time of a step by method, and all cases."""
    commit = read_commit()
    cases: list[Regret] = []
    step_s: dict[str, list[float]] = {}
    for seed in seeds:
        for hand in draw_hands(seed):
            for rate_hz, noise_px in product(RATES_HZ, NOISES_PX):
                cases += compare_predictions(hand, noise_px, rate_hz, seed, step_s)
    if recording is not None:
        hand = read_recording(recording)
        for rate_hz, noise_px in product(RATES_HZ, NOISES_PX):
            cases += compare_predictions(hand, noise_px, rate_hz, seeds[0], step_s)
    return {
        "machine": machine_name(),
        "load": describe_load(),
        "commit": commit,
        "seeds": list(seeds),
        "median_step_s": {name: statistics.median(each) for name, each in step_s.items()},
        "cases": [_rounded(asdict(case)) for case in cases],
    }


def _rounded(case: dict[str, Any]) -> dict[str, Any]:
    case["error_mm"] = {name: float(f"{error:.4g}") for name, error in case["error_mm"].items()}
    for key in ("bank_mm", "wiener_mm"):
        case[key] = None if case[key] is None else float(f"{case[key]:.4g}")
    return case


def _parse_seeds(text: str) -> list[int]:
    first, _, last = text.partition("-")
    return list(range(int(first), int(last or first) + 1))


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n", maxsplit=1)[0])
    parser.add_argument("--seeds", type=_parse_seeds, default=_parse_seeds("100-101"))
    parser.add_argument("--recording", type=Path, default=RECORDING if RECORDING.exists() else None)
    parser.add_argument("--json", action="store_true", help="print the result")
    parser.add_argument("--output", type=Path, help=f"folder to write {FILE_NAME} into")
    given = parser.parse_args()
    result = measure_all(given.seeds, given.recording)
    lines = [json.dumps(case) for case in result.pop("cases")]
    text = json.dumps(result, indent=1).removesuffix("\n}")
    text += ',\n "cases": [\n  ' + ",\n  ".join(lines) + "\n ]\n}\n"
    if given.output is not None:
        (given.output / FILE_NAME).write_text(text, encoding="utf-8")
    if given.json or given.output is None:
        print(text, end="")


if __name__ == "__main__":
    main()
