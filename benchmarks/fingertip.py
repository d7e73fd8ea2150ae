"""Compare the fingertip detection in a region of interest with that in full images.

OPENBLAS_NUM_THREADS=1 python -m benchmarks.fingertip [--json]

Simulated images, 640x480, of a finger in front of the sheet with its hand and small glints ("lab"),
at rest and at 1 m/s. Both methods process the same images in turn. OpenCV uses one thread, and the
times are the processor time of that thread, so that other load has little effect. Prints median and
99th percentile of the time per pair, and the errors. The errors are compared with the Cramer-Rao
bound of the same pixels and with the reported covariance (normalised mean square: 1 is exact).
"""

from __future__ import annotations

import argparse
import gc
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from benchmarks.fingertip_bound import fingertip_bound
from flexsheet.launch.commands.output import print_rows
from flexsheet.launch.plans.plan import load_scene
from flexsheet.messages.scene import Scene
from flexsheet.nodes.arrays import Floats, Image
from flexsheet.nodes.triangulator.fingertip import DetectorConfig, detect_all
from flexsheet.nodes.triangulator.marker import MARKER_METHODS, BlobFilter
from flexsheet.nodes.triangulator.tracking import Gate
from flexsheet.nodes.triangulator.triangulation import StereoGeometry
from flexsheet.nodes.twin.clutter import CLUTTER
from flexsheet.nodes.twin.pixels import TwinCamera

SCENE_FILE = Path(__file__).resolve().parent.parent / "launch" / "scenes" / "cylinder.yaml"
PAIRS, ROUNDS, BOUNDS = 100, 10, 10
SPEEDS_M_PER_S = (0.0, 1.0)
REACH_M = 0.009
"""The maximum error of the predicted position at 60 m/s^2 and 60 Hz, in metres."""

PREDICTION_M = 0.001
"""The standard deviation of the prediction error per axis, in metres."""


@dataclass(frozen=True, slots=True)
class TestShot:
    """An image pair with the true and the predicted position of the fingertip."""

    left: Image
    right: Image
    truth: Floats
    velocity: Floats
    expected: Floats


@dataclass(frozen=True, slots=True)
class Run:
    """The times of all calls (s), and the error (3,), m, and the covariance of each shot.

    Error and covariance are NaN if the fingertip was not found.
    """

    times_s: Floats
    errors_m: Floats
    covariances: Floats


def constant_velocity_path(tip: Floats, velocity: Floats) -> Callable[[float], Floats]:
    """Return the fingertip's path at constant velocity, by the time (s) from mid-exposure."""
    return lambda offset_s: tip + offset_s * velocity


def shots(camera: TwinCamera, speed_m_per_s: float, exposure_s: float) -> list[TestShot]:
    """Make image pairs of fingertips at random points and velocities in the working range."""
    random = np.random.default_rng(1)
    taken = []
    for _ in range(PAIRS):
        tip = random.uniform([-0.08, -0.08, -0.03], [0.08, 0.08, 0.08])
        way = random.standard_normal(3)
        velocity = speed_m_per_s * way / np.linalg.norm(way)
        left, right = camera.picture(constant_velocity_path(tip, velocity), exposure_s=exposure_s)
        taken.append(
            TestShot(left, right, tip, velocity, tip + PREDICTION_M * random.standard_normal(3))
        )
    return taken


def measure(scene: Scene, method: str, taken: list[TestShot]) -> tuple[Run, Run]:
    """Detect the fingertip of each shot in the region of interest and in the full images."""
    geometry = StereoGeometry.of(scene.camera)
    config = DetectorConfig(
        blob_filter=BlobFilter(),
        refine=MARKER_METHODS[method],
        max_reprojection_px=1.5,
    )
    volume = (scene.finger.volume_min_m, scene.finger.volume_max_m)
    times = np.empty((2, ROUNDS, len(taken)))
    errors = np.full((2, len(taken), 3), np.nan)
    covariances = np.full((2, len(taken), 3, 3), np.nan)
    gc.disable()
    for turn in range(ROUNDS):
        for i, shot in enumerate(taken):
            for way, gate in enumerate((Gate(shot.expected, REACH_M), None)):
                start = time.thread_time()
                found = detect_all(
                    shot.left,
                    shot.right,
                    geometry=geometry,
                    config=config,
                    volume=volume,
                    gate=gate,
                )
                reason, measured = found.reason, found.measured
                times[way, turn, i] = time.thread_time() - start
                if reason == "ok" and measured is not None:
                    errors[way, i] = measured.point_world - shot.truth
                    covariances[way, i] = measured.covariance
    gc.enable()
    runs = [Run(times[way].ravel(), errors[way], covariances[way]) for way in (0, 1)]
    return runs[0], runs[1]


def evaluate(run: Run, bound_m: float) -> dict[str, Any]:
    """Return the times (us) and the errors of a run, with the ratio to the bound (m)."""
    found = np.isfinite(run.errors_m[:, 0])
    errors_m = run.errors_m[found]
    rms_m = float(np.sqrt(np.mean(np.sum(errors_m**2, axis=1))))
    normalised = np.mean(
        [
            error @ np.linalg.solve(covariance, error)
            for error, covariance in zip(errors_m, run.covariances[found], strict=True)
        ]
    )
    median_s, p99_s = np.quantile(run.times_s, [0.5, 0.99])
    return {
        "p50_us": 1e6 * float(median_s),
        "p99_us": 1e6 * float(p99_s),
        "found": int(found.sum()),
        "pairs": len(found),
        "rms_mm": 1e3 * rms_m,
        "p99_mm": 1e3 * float(np.quantile(np.linalg.norm(errors_m, axis=1), 0.99)),
        "bound_ratio": rms_m / bound_m,
        "normalised": float(normalised) / 3.0,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--json", action="store_true")
    as_json = parser.parse_args().json
    cv2.setNumThreads(1)
    scene = load_scene(SCENE_FILE)
    exposure_s = scene.camera.exposure_s
    camera = TwinCamera(
        scene.camera, finger_radius_m=scene.finger.radius_m, seed=1, clutter=CLUTTER["lab"]
    )
    rows = []
    for speed_m_per_s in SPEEDS_M_PER_S:
        taken = shots(camera, speed_m_per_s, exposure_s)
        bounds = [
            fingertip_bound(
                camera, constant_velocity_path(shot.truth, shot.velocity), exposure_s=exposure_s
            )
            for shot in taken[:BOUNDS]
        ]
        bound_m = float(np.sqrt(np.mean([np.trace(bound.position_m2) for bound in bounds])))
        for method in MARKER_METHODS:
            for image, run in zip(("region", "whole"), measure(scene, method, taken), strict=True):
                row = {"speed_m_per_s": speed_m_per_s, "method": method, "image": image}
                rows.append(row | evaluate(run, bound_m))
    print_rows(rows, as_json=as_json)


if __name__ == "__main__":
    main()
