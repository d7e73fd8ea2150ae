"""Measure the accuracy of a fingertip near the sheet, compared with its Cramer-Rao bound.

OPENBLAS_NUM_THREADS=1 python -m benchmarks.fingertip_accuracy [--places 120]

The simulated finger moves at 20 mm/s with tremor. The test positions are uniformly distributed: 60
mm to each side of the screen's centre, and 40 mm to both sides of its plane. The node's fingertips
are evaluated from single pairs (before tracking) and tracked:

- with the shipped calibration, which gives the total error;
- with the rig's true optics, which give the error from pixels only. It is compared with the
  Cramer-Rao bound (`benchmarks.fingertip_bound`), as rms per axis over all positions.

Takes two minutes.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.fingertip_bound import fingertip_bound
from benchmarks.tracking_bench import (
    CALIBRATION_FILE,
    Frame,
    ObservedFrame,
    Observer,
    TruePathCase,
    bench_scene,
    twin_camera,
)
from flexsheet.launch.methods.results import machine_name
from flexsheet.messages.calibration import load_calibration, save_calibration
from flexsheet.messages.scene import Scene
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.twin.clutter import CLUTTER
from flexsheet.nodes.twin.finger import TREMOR_BAND_HZ, SineSum
from flexsheet.nodes.twin.gestures import TREMOR_HAND_M
from flexsheet.nodes.twin.rig import make_true_camera

LOW_M, HIGH_M = (-0.06, -0.06, -0.04), (0.06, 0.06, 0.04)
SPEED_M_PER_S = 0.02
FRAMES = 14
"""The number of frames at each position. The first frames confirm the track."""

SETTLED_FRAMES = 5
APART_S = 2.0
"""The time between two positions in seconds. The track is lost in this time."""


@dataclass(frozen=True, slots=True)
class TestPositions:
    """A motion in which the finger passes several positions slowly."""

    places: Floats
    ways: Floats
    tremor: SineSum

    @staticmethod
    def drawn(count: int, seed: int) -> TestPositions:
        random = np.random.default_rng(seed)
        ways = random.standard_normal((count, 3))
        ways /= np.linalg.norm(ways, axis=1, keepdims=True)
        return TestPositions(
            random.uniform(LOW_M, HIGH_M, (count, 3)), ways, SineSum.drawn(TREMOR_BAND_HZ, random)
        )

    def at(self, time_s: float) -> Floats:
        place = min(int(time_s / APART_S + 0.5), len(self.places) - 1)
        along_m = SPEED_M_PER_S * (time_s - place * APART_S)
        shake = np.sqrt(0.5) * TREMOR_HAND_M * self.tremor.at(time_s)[0]
        return np.asarray(self.places[place] + along_m * self.ways[place] + shake)

    def moments(self, period_s: float) -> list[float]:
        steps = np.arange(FRAMES) * period_s
        return [
            place * APART_S + float(step) for place in range(len(self.places)) for step in steps
        ]


def exact_calibration(scene: Scene, folder: Path) -> Path:
    """Write a calibration file of the rig's true optics."""
    rig = make_true_camera(scene.camera)
    true = load_calibration(CALIBRATION_FILE).model_copy(
        update={"left": rig.left, "right": rig.right, "right_from_left": rig.right_from_left}
    )
    save_calibration(true, folder / "true.yaml")
    return folder / "true.yaml"


async def follow(scene: Scene, walk: TestPositions, calibration: Path) -> list[ObservedFrame]:
    camera = twin_camera(scene, CLUTTER["lab"])
    frames = [Frame(t, camera) for t in walk.moments(1.0 / scene.camera.rate_hz)]
    observer = await Observer(scene, calibration=calibration).start()
    return await observer.follow(frames, walk.at)


def bound_m2(scene: Scene, walk: TestPositions) -> Floats:
    """Return the minimum variance per axis (3,), m^2, as the mean over all positions."""
    camera = twin_camera(scene, CLUTTER["lab"])

    def around(place: int) -> TruePathCase:
        return lambda offset_s: walk.at(place * APART_S + offset_s)

    bounds = [
        fingertip_bound(camera, around(place), exposure_s=scene.camera.exposure_s)
        for place in range(len(walk.places))
    ]
    return np.asarray(np.mean([np.diag(bound.position_m2) for bound in bounds], axis=0))


def single_errors(seen: Sequence[ObservedFrame]) -> Floats:
    """Return the errors (n, 3) m of single pairs with a measured point."""
    return np.array(
        [
            one.fingertip.measured_world_m - one.truth
            for one in seen
            if one.fingertip is not None and one.reason in ("ok", "unconfirmed")
        ]
    )


def tracked_errors(seen: Sequence[ObservedFrame]) -> Floats:
    """Return the errors (n, 3) m of valid fingertips of settled tracks."""
    settled = [one for place, one in enumerate(seen) if place % FRAMES >= SETTLED_FRAMES]
    return np.array([one.error_m for one in settled if one.valid])


def summary(errors_m: Floats) -> dict[str, Any]:
    """Return quantiles of the error's norm and the rms error per axis, mm."""
    off_mm = 1e3 * np.linalg.norm(errors_m, axis=1)
    return {
        "frames": len(errors_m),
        "rms_mm": float(np.sqrt(np.mean(off_mm**2))),
        "p99_mm": float(np.quantile(off_mm, 0.99)),
        "max_mm": float(off_mm.max()),
        "axes_mm": [1e3 * float(v) for v in np.sqrt(np.mean(errors_m**2, axis=0))],
    }


def measure(places: int, *, seed: int = 1) -> dict[str, Any]:
    scene, walk = bench_scene(), TestPositions.drawn(places, seed)
    shipped = asyncio.run(follow(scene, walk, CALIBRATION_FILE))
    with tempfile.TemporaryDirectory() as folder:
        exact = asyncio.run(follow(scene, walk, exact_calibration(scene, Path(folder))))
    least = np.sqrt(bound_m2(scene, walk))
    pixels = summary(single_errors(exact))
    return {
        "machine": machine_name(),
        "places": places,
        "pictures": len(shipped),
        "valid_share": sum(one.valid for one in shipped) / len(shipped),
        "shipped_calibration_single": summary(single_errors(shipped)),
        "shipped_calibration_tracked": summary(tracked_errors(shipped)),
        "true_optics_single": pixels,
        "true_optics_tracked": summary(tracked_errors(exact)),
        "bound_axes_mm": [1e3 * float(v) for v in least],
        "bound_rms_mm": 1e3 * float(np.sqrt(np.sum(least**2))),
        "ratio_axes": [float(v) for v in np.array(pixels["axes_mm"]) / (1e3 * least)],
        "ratio": pixels["rms_mm"] / (1e3 * float(np.sqrt(np.sum(least**2)))),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n", maxsplit=1)[0])
    parser.add_argument("--places", type=int, default=120)
    print(json.dumps(measure(parser.parse_args().places), indent=1))


if __name__ == "__main__":
    main()
