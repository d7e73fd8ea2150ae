"""Choose methods with which the whole system meets its tolerances, and verify them in the graph."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from operator import attrgetter
from pathlib import Path
from typing import Any

from flexsheet.launch.experiments import ExperimentError
from flexsheet.launch.experiments.offline import metric_tolerances
from flexsheet.launch.methods.charts import measure_family
from flexsheet.launch.methods.composition import (
    P95_OVER_RMS,
    Combination,
    Composition,
    Figures,
    StageOption,
    SystemMetric,
    compose,
    name_methods,
)
from flexsheet.launch.methods.configurations import Configuration, choose_tuned
from flexsheet.launch.methods.system_chart import (
    NOMINAL,
    plan_configurations,
    read_value,
    run_scene,
)
from flexsheet.launch.methods.tune import (
    REPEATS,
    Choice,
    MethodEvaluation,
    evaluate_methods,
    find_choice,
)
from flexsheet.launch.plans.plan import load_scene
from flexsheet.messages.methods import Methods
from flexsheet.messages.scene import Scene
from flexsheet.nodes.fem_solver.benchmarks import FORCE
from flexsheet.nodes.methods import Point
from flexsheet.nodes.triangulator.tracking_benchmark import HORIZON_MS, make_tracking_family

RENDERED_HZ = 30.0
"""The maximum frame rate (Hz) of the renderer in `launch/demo.yaml`."""

IMAGES = 2
"""The number of images per exposure in which the marker is detected."""

STROKE_S = 10.0
ERROR: Callable[[Point], float] = attrgetter("error")


def list_tolerances(scene: Scene) -> dict[SystemMetric, float]:
    """Return the scene's tolerance of each system metric, in the unit of the metric."""
    limits = {SystemMetric(one.value): limit for one, limit in metric_tolerances(scene).items()}
    return limits | {
        SystemMetric.SKIN: 1e3 * scene.tolerances.skin_m,
        SystemMetric.TO_ARM: 1e3 * scene.tolerances.latency_s,
        SystemMetric.TO_LIGHT: 1e3 * scene.tolerances.light_latency_s,
    }


def measure_tracking(scene: Scene, noise_px: float) -> list[MethodEvaluation]:
    """Measure and evaluate the tracking methods with simulated marker noise.

    noise_px: standard deviation of the marker noise.
    """
    from flexsheet.launch.methods.benchmarks import make_finger_motions

    family = make_tracking_family(make_finger_motions, noise_px)
    points = measure_family(family, scene, repeats=REPEATS, select=attrgetter("in_scene"))
    settings = {name: name for name in family.methods}
    return evaluate_methods(points, settings, tolerance=family.tolerance(scene))


def make_stages(scene: Scene, choices: Sequence[Choice]) -> dict[str, list[StageOption]]:
    """Return, for each processing stage, the methods with the errors that they add to the system.

    A stage is a task, such as tracking, with several measured methods. The tracking methods are
    measured with the noise of each marker method. The tracking error at the time of exposure adds
    to the fingertip's error. The tracking error at the longest prediction horizon adds to the
    sheet's error.

    The two-pass image correction can be used only with the chosen sheet shape, because it was
    measured only with this shape.
    """
    stages: dict[str, list[StageOption]] = {}
    for choice in choices:
        if choice.family == "tracking":
            stages["tracking"] = _list_tracking(scene, choices, choice)
        else:
            stages[choice.family] = [
                _make_option(scene, choices, choice, one) for one in choice.evaluations
            ]
    return stages


def _make_option(
    scene: Scene, choices: Sequence[Choice], choice: Choice, one: MethodEvaluation
) -> StageOption:
    rate_hz, took_ms = scene.camera.rate_hz, 1e3 * one.median_s
    spreads: dict[SystemMetric, float] = {}
    biases: dict[SystemMetric, float] = {}
    given: dict[str, str] = {}
    match choice.family:
        case "marker":
            rate_hz *= IMAGES
            took_ms *= IMAGES
            biases = {SystemMetric.TO_ARM: took_ms, SystemMetric.TO_LIGHT: took_ms}
        case "sheet-force":
            biases = {SystemMetric.FORCE: one.error}
        case "correction":
            rate_hz = RENDERED_HZ
            spreads = {SystemMetric.IMAGE: P95_OVER_RMS * one.error}
            biases = {SystemMetric.TO_LIGHT: took_ms}
            shape = find_choice(choices, "sheet-shape")
            if shape is not None and one.setting == "two_pass":
                given = {"sheet-shape": shape.chosen.method}
        case "soft-body":
            force = _largest(one.points, lambda point: point.extra_metrics.get(FORCE, math.nan))
            biases = {
                SystemMetric.SKIN: one.error,
                SystemMetric.FORCE: force,
                SystemMetric.TO_LIGHT: took_ms,
            }
    return StageOption(
        one.method,
        rate_hz * one.median_s,
        spreads,
        biases,
        given,
        outside=_outside(one),
    )


def _largest(points: Sequence[Point], value: Callable[[Point], float]) -> float:
    """Return the largest absolute value of a quantity over the measurements of a method.

    Measurements outside the range in which the method is valid are ignored, as are NaN and infinite
    values. The result is 0 if no value remains.

    value: function that returns the quantity of a measurement.
    """
    found = [abs(value(point)) for point in points if point.in_range]
    return max((one for one in found if math.isfinite(one)), default=0.0)


def _list_tracking(scene: Scene, choices: Sequence[Choice], tracking: Choice) -> list[StageOption]:
    marker = find_choice(choices, "marker")
    if marker is None:
        return [_make_tracking(scene, one, {}) for one in tracking.evaluations]
    found = []
    for source in marker.evaluations:
        if not math.isfinite(source.error):
            continue
        known = source.method == marker.chosen.method
        evaluations = tracking.evaluations if known else measure_tracking(scene, source.error)
        found += [_make_tracking(scene, one, {"marker": source.method}) for one in evaluations]
    return found


def _make_tracking(scene: Scene, one: MethodEvaluation, given: Mapping[str, str]) -> StageOption:
    horizons = [point.case[HORIZON_MS] for point in one.points]
    first, last = min(horizons), max(horizons)
    fingertip, sheet = (
        P95_OVER_RMS * _largest([p for p in one.points if p.case[HORIZON_MS] == horizon], ERROR)
        for horizon in (first, last)
    )
    took_ms = 1e3 * one.median_s
    return StageOption(
        one.method,
        scene.camera.rate_hz * one.median_s,
        {SystemMetric.FINGERTIP: fingertip, SystemMetric.SHEET: sheet},
        {SystemMetric.TO_ARM: took_ms, SystemMetric.TO_LIGHT: took_ms},
        given,
        outside=_outside(one),
    )


def _outside(one: MethodEvaluation) -> float:
    """Return the fraction of the measured cases in which a method is not valid.

    If the error of the method is unknown, the result is 1.
    """
    return len(one.outside) / one.cases if math.isfinite(one.error) else 1.0


def choose_methods(choices: Sequence[Choice], methods: Mapping[str, str]) -> list[Choice]:
    """Replace the chosen method in the tuning result of each method family.

    methods: name of the new method, by method family.
    """
    return [
        replace(
            choice,
            chosen=next(one for one in choice.evaluations if one.method == methods[choice.family]),
            composed=True,
        )
        for choice in choices
    ]


def make_methods(scene: Scene, choices: Sequence[Choice]) -> Methods:
    """Return the methods for a configuration of the scene.

    If there is no choice for a method family, the method in the scene is used. If the scene does
    not choose a method either, the default is used.
    """
    chosen = {choice.key: choice.chosen.setting for choice in choices}
    return Methods.model_validate(choose_tuned(scene).model_dump() | chosen)


def tune_system(
    scene_file: Path,
    choices: Sequence[Choice],
    folder: Path,
    progress: Callable[[str], None],
    *,
    margin: float,
    runs: int,
) -> tuple[Composition, list[Choice]]:
    """Find the cheapest combination of methods with which the whole system meets its tolerances.

    Return the result of the search, and the tuning results with the methods of this combination.

    choices: tuning result of each method family, with its measured methods.
    runs: number of runs per combination. The largest 95 % quantile of these runs is used.

    Raises ExperimentError if a run of a combination fails.
    """
    scene = load_scene(scene_file)
    progress("measuring the tracking with the noise of each marker method")
    stages = make_stages(scene, choices)

    def run_graph(combination: Combination) -> Figures:
        chosen = choose_methods(choices, name_methods(combination))
        configuration = Configuration("proposal", make_methods(scene, chosen))
        name = "-".join(name_methods(combination).values()).replace(" ", "").replace(",", "")
        return run_proposal(scene_file, configuration, folder / name, progress, runs=runs)

    composition = compose(stages, list_tolerances(scene), run_graph, margin=margin)
    return composition, choose_methods(choices, name_methods(composition.chosen))


def run_proposal(
    scene_file: Path,
    configuration: Configuration,
    folder: Path,
    progress: Callable[[str], None],
    *,
    runs: int,
) -> Figures:
    """Measure the errors and latencies of the system with one configuration of methods.

    The errors are 95 % quantiles over a finger stroke in simulated time. For the latencies, the
    graph is run `runs` times, and the largest 95 % quantile of these runs is returned.
    """
    planned = plan_configurations(
        scene_file, [configuration], folder, blocks=runs, seconds=STROKE_S
    )
    rows = run_scene(planned, folder, progress)
    good = [row for row in rows.values() if "error" not in row]
    if len(good) < len(rows):
        last: Any = next(row for row in rows.values() if "error" in row)
        raise ExperimentError(f"a run failed: {last['error']}; see {folder}")
    speeds = [row for name, row in rows.items() if name in planned.places]
    errors = rows[NOMINAL][configuration.name]
    figures = {
        metric: max(
            (
                read_value(row, f"{metric.value}.p95")
                for row in (errors, *speeds)
                if metric.value in row
            ),
            default=math.nan,
        )
        for metric in SystemMetric
        if metric is not SystemMetric.SKIN
    }
    return {metric: value for metric, value in figures.items() if math.isfinite(value)}
