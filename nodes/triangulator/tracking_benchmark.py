"""Benchmark the tracking methods: measure the error of the predicted finger position."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from flexsheet.messages.scene import Scene
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.methods import Case, Family, Trial
from flexsheet.nodes.triangulator.adaptive import TRACKING_METHODS
from flexsheet.nodes.triangulator.filters import Estimate, Filter
from flexsheet.nodes.triangulator.triangulation import StereoGeometry, measure

TruePath = Callable[[float], Floats]
"""A function that returns the true fingertip position (3,), m, in the world at a given time (s)."""

MARKER_NOISE_PX = 0.01
"""The standard deviation of a marker's centre if the marker is half a metre away. The command
`flexsheet chart marker` determines this value."""

HORIZON_MS = "horizon_ms"
"""The key for the prediction horizon of a benchmark case."""

HORIZONS_S = (0.0, 0.02, 0.05)
"""The times (s) from the exposure to the predicted position. They stand for the exposure itself,
the display of the frame, and the motion of the arms."""

WARM_UP_S = 0.4
SPEED_STEP_S = 0.02
SPEED_MARGIN = 1.5
"""The maximum ratio of a path's speed to the scene's maximum finger speed. It is above 1 because
tremor increases the speed."""
WITHOUT_VELOCITY = ("none",)
"""The methods that do not estimate the velocity, and so cannot predict a moving finger."""


@dataclass(frozen=True, slots=True)
class TruePathCase:
    """A true path of a finger, which starts at the time 0.

    resting: whether the finger has no motion except tremor.
    """

    path: TruePath
    duration_s: float
    resting: bool

    @property
    def speed_m_per_s(self) -> float:
        """Return the 0.9 quantile of the finger's speed, m/s."""
        times = np.arange(WARM_UP_S, self.duration_s, SPEED_STEP_S)
        points = np.array([self.path(float(time)) for time in times])
        distances = np.linalg.norm(np.diff(points, axis=0), axis=1)
        return float(np.quantile(distances, 0.9)) / SPEED_STEP_S


@dataclass(frozen=True, slots=True)
class MeasuredPath:
    """The simulated measurements of a path at n times.

    points, covariances: measured points (n, 3), m, and their covariances (n, 3, 3), m^2.
    truth: true points (n, 3), m, for each prediction horizon (s). Each of these points is the true
        position one horizon after a measurement.
    """

    times_ns: NDArray[np.int64]
    points: Floats
    covariances: Floats
    truth: Mapping[float, Floats]


def measure_path(
    scene: Scene, motion: TruePathCase, *, seed: int, noise_px: float = MARKER_NOISE_PX
) -> MeasuredPath:
    """Simulate how the scene's stereo camera measures a finger's path.

    seed: seed of the random noise.
    noise_px: standard deviation of a marker's centre.
    """
    geometry, random = StereoGeometry.of(scene.camera), np.random.default_rng(seed)
    times = np.arange(0.0, motion.duration_s, 1.0 / scene.camera.rate_hz)
    covariance_px = noise_px**2 * np.eye(2)
    points, covariances, measured_at = [], [], []
    for time in times:
        left, right = geometry.project(motion.path(float(time)))
        found = measure(
            geometry,
            left + noise_px * random.standard_normal(2),
            right + noise_px * random.standard_normal(2),
            covariance=covariance_px,
        )
        if found is not None:
            points.append(found.point_world)
            covariances.append(found.covariance)
            measured_at.append(time)
    at = np.array(measured_at)
    truth = {
        horizon: np.array([motion.path(float(t) + horizon) for t in at]) for horizon in HORIZONS_S
    }
    return MeasuredPath(
        np.round(at * 1e9).astype(np.int64), np.array(points), np.array(covariances), truth
    )


def predict_path(filter_: Filter, seen: MeasuredPath, horizon_s: float) -> Floats:
    """Run a filter over n measurements, and return a prediction (n, 3), m, after each measurement.

    horizon_s: time from a measurement to the predicted position.
    """
    horizons, predicted = np.array([horizon_s]), np.empty_like(seen.points)
    estimate: Estimate | None = None
    for i, at_ns in enumerate(seen.times_ns.tolist()):
        point, covariance = seen.points[i], seen.covariances[i]
        estimate = (
            filter_.initialize(at_ns, point, covariance)
            if estimate is None
            else filter_.update(estimate, at_ns, point, covariance)
        )
        predicted[i] = filter_.predict(estimate, horizons)[0]
    return predicted


def make_tracking_family(
    motions: Callable[[Scene], Mapping[str, TruePathCase]], noise_px: float = MARKER_NOISE_PX
) -> Family:
    """Define the benchmark of the tracking methods.

    motions: function that returns the true paths of a scene by name.
    noise_px: standard deviation of a marker's centre.
    """

    def trials(scene: Scene) -> Iterator[Trial]:
        for name, motion in motions(scene).items():
            seen = measure_path(scene, motion, seed=1, noise_px=noise_px)
            in_scene = (
                motion.resting
                or motion.speed_m_per_s <= SPEED_MARGIN * scene.working_range.speed_m_per_s
            )
            for horizon_s in HORIZONS_S:
                for method in TRACKING_METHODS:
                    just_measured = method == "none" and horizon_s == 0.0
                    in_range = method not in WITHOUT_VELOCITY or motion.resting or just_measured
                    case: Case = {"motion": name, HORIZON_MS: round(1e3 * horizon_s)}
                    trial = _trial(scene, method, case, seen, horizon_s, in_range=in_range)
                    yield replace(trial, in_scene=in_scene)

    return Family(
        name="tracking",
        unit="mm",
        reference="true finger position at the time of use",
        methods=tuple(TRACKING_METHODS),
        trials=trials,
        tolerance=lambda scene: 1e3 * scene.tolerances.sheet_position_m,
    )


def _trial(
    scene: Scene, method: str, case: Case, seen: MeasuredPath, horizon_s: float, *, in_range: bool
) -> Trial:
    """Make a trial that measures the error of predictions and the time of one update.

    Predictions in the first WARM_UP_S seconds are ignored.
    """
    filter_ = TRACKING_METHODS[method](scene.finger.max_speed_m_per_s)
    middle = len(seen.times_ns) // 2
    before = filter_.initialize(
        int(seen.times_ns[middle - 1]), seen.points[middle - 1], seen.covariances[middle - 1]
    )
    horizons = np.array([horizon_s])

    def run() -> Floats:
        after = filter_.update(
            before, int(seen.times_ns[middle]), seen.points[middle], seen.covariances[middle]
        )
        return filter_.predict(after, horizons)

    def error_mm(_: Floats) -> float:
        is_warm = seen.times_ns >= WARM_UP_S * 1e9
        off = (predict_path(filter_, seen, horizon_s) - seen.truth[horizon_s])[is_warm]
        return 1e3 * float(np.sqrt(np.mean(np.sum(off**2, axis=1))))

    return Trial(method=method, case=case, run=run, error=error_mm, in_range=in_range)
