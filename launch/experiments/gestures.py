"""Evaluate how accurately the fingertip is tracked during gestures of the simulated finger."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicHermiteSpline

from flexsheet.launch.bags.report.strokes import read_followed
from flexsheet.launch.experiments import ExperimentError, find_recorded, stroke
from flexsheet.launch.experiments.driver import Driver
from flexsheet.launch.experiments.lag import estimate_lag_s
from flexsheet.launch.experiments.run import Procedure, Progress
from flexsheet.launch.plans.documents import BadInputError, did_you_mean
from flexsheet.launch.plans.plan import load_graph
from flexsheet.messages.bag import BagReader
from flexsheet.messages.scene import Scene, UnfitGeometryError
from flexsheet.messages.types import FingerPath, Fingertip, TwinFinger
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.models.interpolation import interpolate_path
from flexsheet.nodes.twin import gestures as twin_gestures
from flexsheet.nodes.twin.finger import FingerPathError
from flexsheet.nodes.twin.paths import recorded_path

Times = NDArray[np.int64]

PREDICTION_HORIZONS_S = (0.0, 0.02, 0.05)
"""The evaluated prediction horizons, in seconds.

They are zero, the latency from exposure to arm command, and this latency plus the servo lag of the
arm.
"""

MAX_LAG_S = 0.08
"""The maximum lag (s) in the cross-correlation of measured and true finger motion.

It is less than half the period of the fastest taps, so that a tap is not matched with the next tap.
"""

MIN_SAMPLES = 10
GAP_PERIODS = 2.5
SIGMAS = 3.0

GESTURES: dict[str, Callable[[Scene], FingerPath]] = {
    "stroke-10": partial(stroke.stroke_path, seconds=10.0),
    "stroke-30": partial(stroke.stroke_path, seconds=30.0),
    **twin_gestures.GESTURES,
}
"""The functions that make the finger paths of gestures, with the names of the gestures as keys.

The gestures are the finger strokes of Furukawa et al. 2007, and models of human motions.
"""


def gesture_path(name: str, scene: Scene) -> FingerPath:
    """Return the finger path of a gesture on the scene's object; its label is the gesture's name.

    Raises ExperimentError if the gesture does not fit the object.
    """
    try:
        return GESTURES[name](scene).model_copy(update={"label": name})
    except (FingerPathError, UnfitGeometryError) as error:
        raise ExperimentError(f'scene "{scene.name}": {error}') from None


def finger_path(launch_file: Path, name_or_file: str, settings: Sequence[str] = ()) -> FingerPath:
    """Return a finger path in the scene of a launch file.

    name_or_file: name of a gesture, or CSV file with a recorded path.
    settings: launch settings "node.parameter=value". "scene=FILE" replaces the scene.

    Raises BadInputError if the name is unknown, FingerPathError if the recorded path is invalid,
    and ExperimentError if the launch file has no scene.
    """
    scene = load_graph(launch_file, settings=settings).scene_message()
    if scene is None:
        raise ExperimentError(
            f'{launch_file}: missing key "scene", which a finger path requires; add the key'
        )
    if name_or_file in GESTURES:
        return gesture_path(name_or_file, scene)
    file = Path(name_or_file)
    if not file.suffix and not file.exists():
        raise BadInputError.single(
            name_or_file,
            (),
            "neither a gesture nor a file",
            f"{did_you_mean(name_or_file, list(GESTURES))} A recorded finger is a CSV file",
        )
    return recorded_path(file, scene)


def make_gestures_procedure(names: Sequence[str], progress: Progress) -> Procedure:
    async def procedure(driver: Driver, scene: Scene) -> None:
        for i, name in enumerate(names):
            path = gesture_path(name, scene)
            progress(f"{name} ({path.times_s[-1]:.0f} s), {i + 1} of {len(names)}")
            await driver.follow(path)

    return procedure


@dataclass(frozen=True, slots=True)
class TrueFinger:
    """The true finger motion at n camera exposures.

    times_ns (n,): times of the exposures.
    positions, velocities (n, 3): fingertip positions (m) and velocities (m/s).
    """

    times_ns: Times
    positions: Floats
    velocities: Floats

    def interpolate(self, times_ns: Times) -> Floats:
        """Return the finger positions (k, 3) at k other times, by cubic Hermite interpolation.

        At a camera rate of 60 Hz, the interpolation error is at most 45 um in the fastest taps and
        13 um in slower taps. In other motions, it is at most 8 um. Positions in gaps between
        exposures, and outside the recording, are NaN.
        """
        zero = self.times_ns[0]
        seconds = (self.times_ns - zero) * 1e-9
        query = (times_ns - zero) * 1e-9
        result = np.asarray(
            CubicHermiteSpline(seconds, self.positions, self.velocities, extrapolate=False)(query)
        )
        steps = np.diff(seconds)
        piece = np.clip(np.searchsorted(seconds, query, side="right") - 1, 0, len(steps) - 1)
        exact = np.isin(times_ns, self.times_ns)
        result[(steps[piece] > GAP_PERIODS * np.median(steps)) & ~exact] = np.nan
        return result


@dataclass(frozen=True, slots=True)
class GestureRecording:
    """The data of recorded gestures, read from a bag; all times are in ns on the same clock.

    truth: true finger motion.
    fingertips: fingertip messages that were measured at the exposures `times_ns`.
    windows_ns: start and end of each gesture.
    """

    truth: TrueFinger
    times_ns: Times
    fingertips: list[Fingertip]
    windows_ns: dict[str, tuple[int, int]]


def read_gestures(bag: Path) -> GestureRecording:
    """Read the true finger motion and the measured fingertips from a bag.

    The time window of a gesture excludes the motion to its first point, and the time after its last
    point.
    """
    truths: dict[int, TwinFinger] = {}
    tips: dict[int, Fingertip] = {}
    for _, message, header, _ in BagReader(bag, topics=["fingertip", "twin/finger"]):
        match message:
            case TwinFinger():
                truths[header.source_ns] = message
            case Fingertip():
                tips[header.source_ns] = message
            case _:
                pass
    if len(truths) < MIN_SAMPLES:
        raise ExperimentError(
            f"{bag}: contains {len(truths)} messages of twin/finger, at least {MIN_SAMPLES} are "
            "required; record this topic with a simulated finger"
        )
    on_path: dict[str, list[int]] = {}
    for at_ns in sorted(truths):
        finger = truths[at_ns]
        if finger.path_label and finger.path_time_s >= 0.0 and not finger.path_done:
            on_path.setdefault(finger.path_label, []).append(at_ns)
    times = sorted(truths)
    tip_times = sorted(tips)
    return GestureRecording(
        truth=TrueFinger(
            np.array(times, dtype=np.int64),
            np.array([truths[time].position_world_m for time in times]),
            np.array([truths[time].velocity_world_m_per_s for time in times]),
        ),
        times_ns=np.array(tip_times, dtype=np.int64),
        fingertips=[tips[time] for time in tip_times],
        windows_ns={label: (at[0], at[-1]) for label, at in on_path.items()},
    )


def jump_sigmas(errors: Floats, covariances: Floats) -> Floats:
    """Return the jumps (n-1,) between consecutive position estimates, in standard deviations.

    A jump is the change of the position error from one estimate to the next. The finger's motion is
    therefore excluded. Each jump is divided by its standard deviation in the direction of the jump.
    The errors of different estimates are assumed to be independent.

    errors: errors (n, 3) of the n estimates, m.
    covariances: covariances (n, 3, 3) of the estimates, m^2.
    """
    jumps = np.diff(errors, axis=0)
    lengths = np.linalg.norm(jumps, axis=1)
    along = jumps / np.maximum(lengths, 1e-300)[:, None]
    both = covariances[1:] + covariances[:-1]
    sigma = np.sqrt(np.einsum("ni,nij,nj->n", along, both, along))
    return np.asarray(np.divide(lengths, sigma, out=np.zeros_like(lengths), where=lengths > 0.0))


def error_mm(errors: Floats) -> dict[str, float | None]:
    """Return rms, 99 % quantile and maximum (mm) of the lengths of n error vectors (n, 3) in m.

    All values are None if there are no errors.
    """
    if len(errors) == 0:
        return {"rms": None, "p99": None, "max": None}
    lengths = 1e3 * np.linalg.norm(errors, axis=1)
    return {
        "rms": float(np.sqrt((lengths**2).mean())),
        "p99": float(np.quantile(lengths, 0.99)),
        "max": float(lengths.max()),
    }


def predict_positions(tips: Sequence[Fingertip], lead_s: float) -> Floats:
    """Return the predicted fingertip positions (n, 3), in m, at `lead_s` after the exposures.

    tips: n fingertip messages with predicted paths.
    """
    if lead_s == 0.0:
        return _stack_rows([tip.position_world_m for tip in tips])
    return _stack_rows(
        [
            interpolate_path(tip.predicted_path_world_m, tip.prediction_step_s, lead_s)[0]
            for tip in tips
        ]
    )


def _stack_rows(points: Sequence[Floats]) -> Floats:
    """Stack n points (3,) as rows of an array (n, 3); n can be 0."""
    return np.array(points, dtype=np.float64).reshape(len(points), 3)


def gesture_result(recorded: GestureRecording, name: str) -> dict[str, Any]:
    """Return the tracking errors (mm) and delays (ms) in one gesture; unknown values are None.

    missing: number of exposures for which no fingertip was published.
    reasons: number of invalid fingertips for each reason.
    jump: differences between the errors of consecutive valid fingertips.
    """
    begin_ns, end_ns = find_recorded(recorded.windows_ns, "gesture", name)
    exposures = recorded.truth.times_ns
    exposed = exposures[(exposures >= begin_ns) & (exposures <= end_ns)]
    inside = np.flatnonzero((recorded.times_ns >= begin_ns) & (recorded.times_ns <= end_ns))
    tips = [recorded.fingertips[i] for i in inside]
    velocities = recorded.truth.velocities[np.isin(exposures, exposed)]
    truth = recorded.truth.interpolate(recorded.times_ns[inside])
    valid = np.array([tip.valid for tip in tips], dtype=np.bool_)
    usable = np.flatnonzero(valid & np.isfinite(truth).all(axis=1))
    good = [tips[i] for i in usable]
    true, times = truth[usable], recorded.times_ns[inside][usable]
    errors = predict_positions(good, 0.0) - true
    return {
        "gesture": name,
        "seconds": float((end_ns - begin_ns) * 1e-9),
        "peak_speed_m_per_s": float(np.linalg.norm(velocities, axis=1).max()),
        "fingertips": len(tips),
        "missing": len(np.setdiff1d(exposed, recorded.times_ns)),
        "valid_ratio": float(valid.mean()) if tips else None,
        "reasons": dict(Counter(tip.reason for tip in tips if not tip.valid)),
        "error_mm": error_mm(errors),
        "measured_error_mm": error_mm(_stack_rows([tip.measured_world_m for tip in good]) - true),
        "jump": _summarize_jumps(errors, good),
        "prediction": [
            _evaluate_prediction(recorded.truth, times, good, lead)
            for lead in PREDICTION_HORIZONS_S
        ],
    }


def _summarize_jumps(errors: Floats, tips: Sequence[Fingertip]) -> dict[str, Any]:
    """Summarize the jumps between consecutive position estimates of the fingertip.

    Return the largest jump in standard deviations and in mm, and the number of jumps above SIGMAS
    standard deviations.

    errors: (n, 3), errors of the n position estimates, m.
    """
    if len(tips) < 2:
        return {"max_sigmas": None, "max_mm": None, "beyond_3_sigmas": 0}
    sigmas = jump_sigmas(errors, np.array([tip.covariance[:3, :3] for tip in tips]))
    return {
        "max_sigmas": float(sigmas.max()),
        "max_mm": float(1e3 * np.linalg.norm(np.diff(errors, axis=0), axis=1).max()),
        "beyond_3_sigmas": int((sigmas > SIGMAS).sum()),
    }


def _evaluate_prediction(
    truth: TrueFinger, times_ns: Times, tips: Sequence[Fingertip], lead_s: float
) -> dict[str, Any]:
    """Return the error and lag of positions predicted for `lead_s` after each exposure."""
    ahead_ns = times_ns + round(lead_s * 1e9)
    true = truth.interpolate(ahead_ns)
    known = np.isfinite(true).all(axis=1)
    follower, leader, at_ns = predict_positions(tips, lead_s)[known], true[known], ahead_ns[known]
    lag = None
    if len(at_ns) >= MIN_SAMPLES and (at_ns[-1] - at_ns[0]) * 1e-9 > 4.0 * MAX_LAG_S:
        lag = estimate_lag_s((at_ns - at_ns[0]) * 1e-9, follower, leader, max_lag_s=MAX_LAG_S)
    return {
        "horizon_ms": lead_s * 1e3,
        **error_mm(follower - leader),
        "lag_ms": None if lag is None else lag * 1e3,
    }


def gestures_result(bag: Path, names: Sequence[str]) -> dict[str, Any]:
    """Evaluate a bag, and return the results of `experiment gestures --json`.

    followed: errors of the sheet for each path; None if the bag does not contain the arms or the
    scene.
    """
    recorded = read_gestures(bag)
    followed = {run["path"]: run for run in read_followed(bag)}
    results = [{**gesture_result(recorded, name), "followed": followed.get(name)} for name in names]
    return {"gestures": results, "bag": str(bag)}
