"""Measure how tracking fails: error against severity for each kind of disturbance.

OPENBLAS_NUM_THREADS=1 python -m benchmarks.tracking_limits [--quick] [--json] [NAME...]

The simulated finger is tracked for half a second, then disturbed for some time at one severity,
then undisturbed. For the disturbed frames the tables contain the fraction of valid ones and the
reasons of the others. For valid ones they contain the errors in mm and in standard deviations (of
track and calibration together). The recovery time is that from the first undisturbed image to the
next valid fingertip. Takes some ten minutes; with --quick there is one repetition of six.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from benchmarks.tracking_bench import (
    CALIBRATION_FILE,
    WRONG_MARKER_M,
    Frame,
    ObservedFrame,
    Observer,
    TruePathCase,
    bench_scene,
    calibration_covariance,
    path_motion,
    sigmas,
    twin_camera,
)
from flexsheet.launch.commands.output import print_rows
from flexsheet.launch.methods.results import machine_name
from flexsheet.messages.scene import Scene
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.twin.clutter import (
    CLUTTER,
    MARKER_RADIUS_M,
    Clutter,
    FixedPoint,
    Occluder,
    second_marker,
    together,
    touching_highlight,
)
from flexsheet.nodes.twin.finger import minimum_jerk_profile
from flexsheet.nodes.twin.gestures import circle, hover, reach
from flexsheet.nodes.twin.pixels import Sensor, TwinCamera

BEFORE_S, DURING_S, AFTER_S = 0.5, 0.8, 0.8
MOVE_S = 0.4
REPETITIONS = 6
SCREEN_M = 0.05
SETTLED_S = 0.1
"""The time after which a track has started, in seconds."""

AFTERMATH_S = 0.3
"""The time after a gap or a clock step that counts as disturbed, in seconds."""

MAX_DEFOCUS_APERTURE_M = 0.05


@dataclass(frozen=True, slots=True)
class Scenario:
    """The frames of a scenario in the order of true time.

    Frames from begins_s to ends_s are disturbed.

    calibration: None if the scene's optics are exact.
    """

    motion: TruePathCase
    frames: list[Frame]
    begins_s: float
    ends_s: float
    scene: Scene
    calibration: Path | None = CALIBRATION_FILE


Setting = Callable[[Scene, float, int], Scenario]
"""The function that makes the scenario of a failure, by severity and repetition."""


@dataclass(frozen=True, slots=True)
class Failure:
    """A kind of disturbance.

    severities: values from mild to severe. Some kinds have two directions.
    """

    title: str
    severity: str
    severities: tuple[float, ...]
    setting: Setting


@dataclass(frozen=True, slots=True)
class Row:
    """The results at one severity. Errors refer to valid fingertips, and are None without any.

    wrong: number of valid fingertips more than 5 mm from the finger.
    recovery_ms: time from the first undisturbed image to the next valid fingertip, median and
        maximum; None if no frame was lost or the disturbance does not end.
    """

    severity: float
    frames: int
    valid_share: float
    reasons: dict[str, int]
    rms_mm: float | None
    p99_mm: float | None
    max_mm: float | None
    worst_sigmas: float | None
    wrong: int
    recovery_ms: tuple[float, float] | None


@lru_cache(maxsize=6)
def _camera(clutter: Clutter, sensor: Sensor = Sensor()) -> TwinCamera:  # noqa: B008  frozen
    return twin_camera(bench_scene(), together(CLUTTER["lab"], clutter), sensor=sensor)


def clean() -> TwinCamera:
    return _camera(Clutter())


def times(
    scene: Scene, until_s: float, *, since_s: float = 0.0, rate_hz: float = 0.0
) -> list[float]:
    """Return the times (s) of the middles of exposures.

    rate_hz: rate of the images; 0: rate of the camera.
    """
    period_s = 1.0 / (rate_hz or scene.camera.rate_hz)
    return [float(t) for t in np.arange(since_s, until_s - 1e-9, period_s)]


def drawing(scene: Scene, repetition: int) -> TruePathCase:
    """Make a finger that draws circles in front of the sheet at 86 mm/s."""
    motion = path_motion(circle(scene), scene, seed=repetition)
    start_s = 1.5 + 0.7 * repetition
    return lambda time_s: motion(start_s + time_s)


def reaching(scene: Scene, repetition: int) -> TruePathCase:
    """Make a finger that reaches back and forth, at up to 0.35 m/s."""
    motion = path_motion(reach(scene, seed=repetition + 1), scene, seed=repetition)
    return lambda time_s: motion(0.1 + time_s)


def passing(scene: Scene, motion: TruePathCase, change: Callable[[Frame], Frame]) -> Scenario:
    """Make a scenario of an undisturbed finger, disturbed frames, and undisturbed frames again."""
    ends_s = BEFORE_S + DURING_S
    frames = [
        change(frame) if BEFORE_S <= frame.time_s < ends_s else frame
        for frame in (Frame(t, clean()) for t in times(scene, ends_s + AFTER_S))
    ]
    return Scenario(motion, frames, BEFORE_S, ends_s, scene)


def before(camera: TwinCamera) -> Callable[[Frame], Frame]:
    return lambda frame: replace(frame, camera=camera)


def hidden_in_one_view(scene: Scene, edge: float, repetition: int) -> Scenario:
    """Occlude one view by a straight dark edge at a distance from the marker's centre, in radii."""
    middle_m = edge * MARKER_RADIUS_M + SCREEN_M
    ends = [FixedPoint((middle_m, y, 0.0)) for y in (-0.02, 0.02)]
    screen = Occluder(ends[0], ends[1], SCREEN_M, level=30.0, carried=True, views="right")
    camera = _camera(Clutter(occluders=(screen,)))
    return passing(scene, drawing(scene, repetition), before(camera))


def off_the_edge(scene: Scene, distance_px: float, repetition: int) -> Scenario:
    """Crop the right view at a distance from the marker's centre."""
    motion = drawing(scene, repetition)
    right = clean().eyes[1]

    def cut(frame: Frame) -> Frame:
        x_px = float(right.see(motion(frame.time_s))[0][0])
        return replace(frame, right_from_column=round(x_px - distance_px))

    return passing(scene, motion, cut)


def with_a_second_mark(scene: Scene, distance_mm: float, repetition: int) -> Scenario:
    camera = _camera(second_marker((1e-3 * distance_mm, 0.0, 0.0)))
    return passing(scene, drawing(scene, repetition), before(camera))


def hidden_beside_a_second_mark(scene: Scene, distance_mm: float, repetition: int) -> Scenario:
    """Hide the finger's marker while a second marker is always in view."""
    camera = _camera(second_marker((1e-3 * distance_mm, 0.0, 0.0)))
    stage = passing(
        scene, drawing(scene, repetition), lambda frame: replace(frame, camera=camera, marker=False)
    )
    frames = [
        replace(frame, camera=camera) if frame.time_s > 0.5 * BEFORE_S else frame
        for frame in stage.frames
    ]
    return replace(stage, frames=frames)


def touched_by_a_highlight(scene: Scene, overlap: float, repetition: int) -> Scenario:
    camera = _camera(touching_highlight(overlap))
    return passing(scene, drawing(scene, repetition), before(camera))


def beyond_the_volume(scene: Scene, beyond_mm: float, repetition: int) -> Scenario:
    """Move a resting finger to the right, beyond the volume by a distance, and back."""
    still = path_motion(hover(scene), scene, seed=repetition)
    way_m = float(scene.finger.volume_max_m[0]) + 1e-3 * beyond_mm
    leaves_s, returns_s = BEFORE_S + MOVE_S, BEFORE_S + MOVE_S + DURING_S

    def motion(time_s: float) -> Floats:
        out, _ = minimum_jerk_profile(float(np.clip((time_s - BEFORE_S) / MOVE_S, 0.0, 1.0)))
        back, _ = minimum_jerk_profile(float(np.clip((time_s - returns_s) / MOVE_S, 0.0, 1.0)))
        return np.asarray(still(1.0 + time_s) + np.array([way_m * (out - back), 0.0, 0.0]))

    frames = [Frame(t, clean()) for t in times(scene, returns_s + MOVE_S + AFTER_S)]
    return Scenario(motion, frames, leaves_s, returns_s, scene)


def with_a_short_baseline(scene: Scene, baseline_mm: float, repetition: int) -> Scenario:
    """Use a rig of perfect optics with a short baseline."""
    rig = scene.camera.right_from_left.copy()
    rig[:3, 3] *= 1e-3 * baseline_mm / np.linalg.norm(rig[:3, 3])
    short = scene.model_copy(
        update={"camera": scene.camera.model_copy(update={"right_from_left": rig})}
    )
    camera = _exact_camera(baseline_mm, short)
    frames = [Frame(t, camera) for t in times(scene, BEFORE_S + DURING_S)]
    motion = drawing(scene, repetition)
    return Scenario(motion, frames, SETTLED_S, np.inf, short, calibration=None)


_EXACT: dict[float, TwinCamera] = {}


def _exact_camera(baseline_mm: float, scene: Scene) -> TwinCamera:
    if baseline_mm not in _EXACT:
        _EXACT.clear()
        _EXACT[baseline_mm] = TwinCamera(
            scene.camera,
            finger_radius_m=scene.finger.radius_m,
            seed=1,
            clutter=CLUTTER["lab"],
        )
    return _EXACT[baseline_mm]


def out_of_focus(scene: Scene, defocus_px: float, repetition: int) -> Scenario:
    motion = drawing(scene, repetition)
    depth_m = clean().eyes[0].see(motion(BEFORE_S))[1]
    aperture = Sensor(aperture_m=MAX_DEFOCUS_APERTURE_M)
    sensor = aperture.out_of_focus(defocus_px, round(depth_m, 2), scene.camera.left.fx_px)
    return passing(scene, motion, before(_camera(Clutter(), sensor)))


def is_overexposed(scene: Scene, exposure: float, repetition: int) -> Scenario:
    camera = _camera(Clutter(), Sensor(exposure=exposure))
    return passing(scene, drawing(scene, repetition), before(camera))


def slowed(scene: Scene, rate_hz: float, repetition: int) -> Scenario:
    """Reduce the camera's rate for the remaining time."""
    ends_s = BEFORE_S + 2.0 * DURING_S
    moments = times(scene, BEFORE_S) + times(scene, ends_s, since_s=BEFORE_S, rate_hz=rate_hz)
    frames = [Frame(t, clean()) for t in moments]
    return Scenario(reaching(scene, repetition), frames, BEFORE_S, np.inf, scene)


def interrupted(scene: Scene, gap_ms: float, repetition: int) -> Scenario:
    """Interrupt the images. The frames after the gap are evaluated."""
    again_s = BEFORE_S + 1e-3 * gap_ms
    moments = times(scene, BEFORE_S) + times(scene, again_s + AFTER_S, since_s=again_s)
    frames = [Frame(t, clean()) for t in moments]
    return Scenario(reaching(scene, repetition), frames, again_s, again_s + AFTERMATH_S, scene)


def stepped(scene: Scene, step_ms: float, repetition: int) -> Scenario:
    """Step the camera's clock forwards or backwards."""
    start_s = 10.0  # so that no stamp is negative
    frames = [
        Frame(t, clean(), stamp_s=start_s + t + (1e-3 * step_ms if t >= BEFORE_S else 0.0))
        for t in times(scene, BEFORE_S + AFTER_S)
    ]
    motion = drawing(scene, repetition)
    return Scenario(motion, frames, BEFORE_S, BEFORE_S + AFTERMATH_S, scene)


FAILURES: dict[str, Failure] = {
    "one-view": Failure(
        "The mark is hidden in one view",
        "edge of what hides it, mark radii from its centre",
        (2.5, 2.0, 1.75, 1.5, 1.25, 1.0, 0.5, 0.0, -1.5),
        hidden_in_one_view,
    ),
    "edge": Failure(
        "The mark leaves one view",
        "from its centre to the picture's edge, px",
        (10.0, 8.0, 6.0, 5.0, 4.0, 3.0, 0.0, -5.0),
        off_the_edge,
    ),
    "two-marks": Failure(
        "A second mark comes and goes",
        "its distance, mm",
        (60.0, 30.0, 20.0, 15.0, 10.0, 8.0, 6.0, 4.0),
        with_a_second_mark,
    ),
    "hidden": Failure(
        "The mark is hidden, another is not",
        "distance of the other, mm",
        (60.0, 30.0, 20.0, 15.0, 12.0, 10.0, 8.0),
        hidden_beside_a_second_mark,
    ),
    "highlight": Failure(
        "A highlight runs into the mark",
        "overlap, share of the mark's diameter",
        (-1.0, -0.5, -0.25, -0.1, 0.0, 0.1, 0.25, 0.5, 0.75, 1.0),
        touched_by_a_highlight,
    ),
    "volume": Failure(
        "The finger leaves the volume",
        "how far beyond its side, mm",
        (-10.0, -3.0, -1.0, 1.0, 3.0, 10.0, 40.0),
        beyond_the_volume,
    ),
    "baseline": Failure(
        "The baseline is too short for the depth",
        "baseline, mm, at a depth of 0.5 m",
        (120.5, 60.0, 30.0, 15.0, 8.0, 4.0, 2.0),
        with_a_short_baseline,
    ),
    "defocus": Failure(
        "The lens is out of focus",
        "spread of a point, px",
        (0.3, 0.7, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0),
        out_of_focus,
    ),
    "saturated": Failure(
        "The picture saturates",
        "exposure, as a multiple of the right one",
        (1.0, 1.2, 1.5, 2.0, 2.5, 3.0, 4.0, 8.0),
        is_overexposed,
    ),
    "rate": Failure(
        "The frame rate falls",
        "frames a second",
        (60.0, 30.0, 20.0, 15.0, 12.0, 9.0, 6.0),
        slowed,
    ),
    "gap": Failure(
        "No pictures come",
        "for so long, ms",
        (33.0, 50.0, 100.0, 150.0, 250.0, 500.0, 1000.0),
        interrupted,
    ),
    "clock": Failure(
        "The camera's clock steps",
        "by so much, ms",
        (-5000.0, -500.0, -100.0, -20.0, 20.0, 50.0, 100.0, 500.0, 5000.0),
        stepped,
    ),
}


async def run_scenario(stage: Scenario) -> list[ObservedFrame]:
    observer = await Observer(stage.scene, calibration=stage.calibration).start()
    return await observer.follow(stage.frames, stage.motion)


def measure(name: str, severity: float, *, repetitions: int = REPETITIONS) -> Row:
    """Measure one severity of one disturbance."""
    scene = bench_scene()
    shown: list[ObservedFrame] = []
    recoveries_ms: list[float] = []
    added = np.zeros((3, 3))
    for repetition in range(repetitions):
        stage = FAILURES[name].setting(scene, severity, repetition)
        if stage.calibration is not None:
            added = calibration_covariance(scene)
        seen = asyncio.run(run_scenario(stage))
        shown += [one for one in seen if stage.begins_s <= one.frame.time_s < stage.ends_s]
        after = [one for one in seen if one.frame.time_s >= stage.ends_s]
        if name in ("gap", "clock"):  # these are over when the next picture comes
            after = [one for one in seen if one.frame.time_s >= stage.begins_s]
        if after:
            recoveries_ms.append(recovery_ms(after))
    return evaluate(severity, shown, recoveries_ms, added)


def recovery_ms(after: Sequence[ObservedFrame]) -> float:
    """Return the time to the first valid fingertip in ms, or infinity without any."""
    back_s = next((one.frame.time_s for one in after if one.valid), np.inf)
    return 1e3 * (back_s - after[0].frame.time_s)


def evaluate(
    severity: float, shown: Sequence[ObservedFrame], recoveries_ms: Sequence[float], added: Floats
) -> Row:
    valid = [one for one in shown if one.valid]
    errors_mm = 1e3 * np.array([float(np.linalg.norm(one.error_m)) for one in valid])
    some = len(valid) > 0
    return Row(
        severity=severity,
        frames=len(shown),
        valid_share=len(valid) / len(shown),
        reasons=dict(Counter(one.reason for one in shown if not one.valid).most_common()),
        rms_mm=float(np.sqrt(np.mean(errors_mm**2))) if some else None,
        p99_mm=float(np.quantile(errors_mm, 0.99)) if some else None,
        max_mm=float(errors_mm.max()) if some else None,
        worst_sigmas=max(sigmas(one, added) for one in valid) if some else None,
        wrong=int((errors_mm > 1e3 * WRONG_MARKER_M).sum()),
        recovery_ms=(
            (float(np.median(recoveries_ms)), max(recoveries_ms)) if recoveries_ms else None
        ),
    )


def sweep(names: Iterable[str], repetitions: int) -> dict[str, list[Row]]:
    results: dict[str, list[Row]] = {}
    for name in names:
        rows = []
        for severity in FAILURES[name].severities:
            print(f"\r{name} {severity:g}      ", end="", file=sys.stderr, flush=True)
            rows.append(measure(name, severity, repetitions=repetitions))
        results[name] = rows
    print(file=sys.stderr)
    return results


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n", maxsplit=1)[0])
    parser.add_argument("names", nargs="*", default=list(FAILURES), metavar="NAME")
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args()
    for name in given.names:
        if name not in FAILURES:
            parser.error(f'no failure "{name}"; there are: {", ".join(FAILURES)}')
    results = sweep(given.names, 1 if given.quick else REPETITIONS)
    printed = {name: [asdict(row) for row in rows] for name, rows in results.items()}
    if given.json:
        slowest = {
            name: max((row.recovery_ms[1] for row in rows if row.recovery_ms), default=None)
            for name, rows in results.items()
        }
        print(
            json.dumps({"machine": machine_name(), "max_recovery_ms": slowest, "failures": printed})
        )
    else:
        for name, each in printed.items():
            print(f"\n{FAILURES[name].title}; severity: {FAILURES[name].severity}")
            print_rows(each, as_json=False)


if __name__ == "__main__":
    main()
