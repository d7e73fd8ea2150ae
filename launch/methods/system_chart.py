"""Measure the speed and accuracy of the whole system for several configurations of its methods.

Processor use and latency are measured in the running graph (`experiments/system_run.py`). The
measurement is repeated in blocks, each with a run of every configuration. Results are medians over
blocks, with the confidence intervals of these medians. Errors are 95 % quantiles that are computed
in simulated time (`experiments/system_errors.py`). The nominal apparatus (set of true hardware
parameters) and random apparatuses are used. Each trial is a separate process.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from flexsheet.launch.experiments import ExperimentError
from flexsheet.launch.experiments.offline import metric_tolerances
from flexsheet.launch.experiments.robustness import apparatus_text
from flexsheet.launch.experiments.run import DEMO_FILE
from flexsheet.launch.experiments.sweep import Row, describe_graph, run_sweep
from flexsheet.launch.methods.blocks import (
    CONFIDENCE,
    bootstrap_median,
    compare_paired,
    find_front,
    order_blocks,
)
from flexsheet.launch.methods.configurations import (
    CONTROL,
    CONTROL_AGAIN,
    Configuration,
    select_configurations,
    write_launch_file,
)
from flexsheet.launch.methods.results import describe_load, machine_name
from flexsheet.launch.plans.plan import load_graph, load_scene
from flexsheet.launch.plans.plan_model import ResolvedGraph
from flexsheet.messages.scene import Scene
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.methods import Interval
from flexsheet.nodes.twin.tolerance_table import Profile

Progress = Callable[[str], None]

NOMINAL = "errors-nominal"
"""The name of the trial that computes errors with hardware that does not deviate from the scene."""

FIRST_SEED = 100
"""The seed of the first random apparatus. Smaller seeds are reserved for development."""

ORDER_SEED = 19
FINGER_SEED = 5200
"""The random seed of the finger's motion in the first block. Each further block uses the next seed.
Other charts use different seeds."""

ERRORS = ("sheet_mm", "image_mm", "force_percent", "fingertip_mm")
LATENCIES = ("exposure_to_arm_ms", "exposure_to_light_ms")
QUANTILES = ("p50", "p95", "p99")
COMPARED = ("cpu_cores", "exposure_to_arm_ms.p50", "exposure_to_light_ms.p50")
"""The keys of the values for which ratios to the control configuration are computed."""


@dataclass(frozen=True, slots=True)
class SceneTrials:
    """The planned trials that measure the whole system in one scene.

    trials: description of each trial, by trial name.
    places: repetition number (block) and configuration of each trial that runs the graph, by trial
        name.
    common: settings that all trials share.
    """

    file: Path
    scene: Scene
    trials: Mapping[str, Mapping[str, Any]]
    places: Mapping[str, tuple[int, str]]
    configurations: tuple[Configuration, ...]
    common: Mapping[str, Any]


def describe_errors(
    launch: Path, configurations: Sequence[Configuration], apparatus: str | None, seconds: float
) -> dict[str, Any]:
    """Return the JSON description of a trial that computes the display errors of configurations.

    All configurations use the same true parameters of the simulated hardware (the apparatus).

    apparatus: value of the option --apparatus. If it is None, the hardware does not deviate from
        the scene.
    seconds: duration of the finger's stroke around the object.
    """
    return {
        "kind": "system errors",
        "launch_file": str(launch),
        "configurations": {one.name: one.describe() for one in configurations},
        "apparatus": apparatus,
        "seconds": seconds,
        "seed": FINGER_SEED,
    }


def plan_trials(
    scene_file: Path,
    folder: Path,
    *,
    blocks: int,
    seconds: float,
    apparatuses: int,
    configurations: Sequence[str] = (),
) -> SceneTrials:
    """Plan the trials that measure the whole system in one scene.

    The first trials compute the display errors. The other trials run the graph, and are repeated in
    blocks. Each block contains all configurations in random order.

    blocks: number of blocks.
    seconds: duration of each stroke of the finger.
    apparatuses: number of random apparatuses (sets of true hardware parameters).
    """
    scene = load_scene(scene_file)
    return plan_configurations(
        scene_file,
        select_configurations(scene, configurations),
        folder,
        blocks=blocks,
        seconds=seconds,
        apparatuses=apparatuses,
    )


def plan_configurations(
    scene_file: Path,
    chosen: Sequence[Configuration],
    folder: Path,
    *,
    blocks: int,
    seconds: float,
    apparatuses: int = 0,
) -> SceneTrials:
    """Plan the trials that measure certain configurations of the system in one scene.

    The runs of the graph are repeated in blocks, and each block contains all configurations. One
    configuration, the control, runs twice in each block. The difference between its two runs shows
    the measurement noise.
    """
    folder.mkdir(parents=True, exist_ok=True)
    launch = write_launch_file(DEMO_FILE, scene_file, folder / "launch.yaml").resolve()
    graph = load_graph(launch)
    settings = {one.name: one.settings(graph) for one in chosen}
    if CONTROL in settings:
        settings[CONTROL_AGAIN] = settings[CONTROL]
    trials: dict[str, Mapping[str, Any]] = {NOMINAL: describe_errors(launch, chosen, None, seconds)}
    for seed in range(FIRST_SEED, FIRST_SEED + apparatuses):
        text = apparatus_text(seed, Profile.MODERN, calibrated=True)
        trials[f"errors-{seed}"] = describe_errors(launch, chosen, text, seconds)
    places = {}
    for block, order in enumerate(order_blocks(list(settings), blocks, seed=ORDER_SEED)):
        for name in order:
            trial = f"block-{block:03d}-{name.replace(', ', '-').replace(' ', '-')}"
            places[trial] = block, name
            trials[trial] = {
                "kind": "system",
                "launch_file": str(launch),
                "settings": [*settings[name], *_set_seed(graph, block)],
                "seconds": seconds,
            }
    common = {
        "experiment": "system",
        **describe_graph(graph, launch, ()),
        "seconds": seconds,
        "configurations": {one.name: one.describe() for one in chosen},
    }
    return SceneTrials(scene_file, load_scene(scene_file), trials, places, tuple(chosen), common)


def _set_seed(graph: ResolvedGraph, block: int) -> list[str]:
    """Return launch settings that give the finger the same random motion in all runs of a block.

    A block is one run of each configuration that is compared.
    """
    seed = FINGER_SEED + block
    return [f"{node.name}.seed={seed}" for node in graph.nodes_of_type("twin_finger")]


def run_scene(planned: SceneTrials, folder: Path, progress: Progress) -> dict[str, Row]:
    """Run the trials that have no result yet, and return all results by trial name.

    Tables that the methods need are computed first.
    """
    for one in planned.configurations:
        one.prepare(planned.scene, progress)
    return run_sweep(folder, planned.common, planned.trials, progress)


def run_system_chart(
    scene_files: Sequence[Path],
    folder: Path,
    progress: Progress,
    *,
    blocks: int,
    seconds: float,
    apparatuses: int,
    configurations: Sequence[str] = (),
) -> dict[str, Any]:
    """Measure the configurations for all scenes, and return the result of `chart system --json`.

    blocks: number of repetitions per scene.
    seconds: duration of each stroke of the finger.
    apparatuses: number of random apparatuses (sets of true hardware parameters).
    """
    points: list[dict[str, Any]] = []
    failed: list[dict[str, str]] = []
    for number, file in enumerate(scene_files, start=1):
        own = folder / file.stem
        planned = plan_trials(
            file,
            own,
            blocks=blocks,
            seconds=seconds,
            apparatuses=apparatuses,
            configurations=configurations,
        )

        def report(text: str, name: str = f"{file.stem} ({number} of {len(scene_files)})") -> None:
            progress(f"{name}: {text}")

        rows = run_scene(planned, own, report)
        failed += [
            {"scene": planned.scene.name, "trial": name, "error": row["error"]}
            for name, row in rows.items()
            if "error" in row
        ]
        points += summarize_scene(planned, rows)
    if not points:
        raise ExperimentError(
            f"all trials failed; see {folder}; the last error: {failed[-1]['error']}"
        )
    return {
        "points": points,
        "front": [
            {"scene": scene, "configuration": name}
            for scene in dict.fromkeys(point["scene"] for point in points)
            for name in find_system_front([one for one in points if one["scene"] == scene])
        ],
        "blocks": blocks,
        "apparatuses": apparatuses,
        "seconds": seconds,
        "confidence": CONFIDENCE,
        "machine": machine_name(),
        "load": describe_load(),
        "failed": failed,
        "folder": str(folder),
    }


def read_value(row: Row, key: str) -> float:
    """Return the value at a dotted key ("sheet_mm.p95") of a result row; NaN if it is missing."""
    found: Any = row
    for part in key.split("."):
        found = None if found is None else found.get(part)
    return float("nan") if found is None else float(found)


def list_tolerances(scene: Scene) -> dict[str, float]:
    """Return the scene's tolerances, by the keys of the corresponding values in a result row."""
    limits = {f"{metric.value}.p95": limit for metric, limit in metric_tolerances(scene).items()}
    return limits | {
        "exposure_to_arm_ms.p95": 1e3 * scene.tolerances.latency_s,
        "exposure_to_light_ms.p95": 1e3 * scene.tolerances.light_latency_s,
    }


def summarize_scene(planned: SceneTrials, rows: Mapping[str, Row]) -> list[dict[str, Any]]:
    """Summarize each configuration of a scene as a point of the chart.

    A configuration is omitted if all its runs failed.
    """
    nominal: Mapping[str, Any] = _good(rows, NOMINAL)
    speeds: dict[str, list[Row]] = {}
    for name, (_, configuration) in planned.places.items():
        speeds.setdefault(configuration, []).append(_good(rows, name))
    seeds = [name for name in planned.trials if name.startswith("errors-") and name != NOMINAL]
    random = [_good(rows, name) for name in seeds]
    return [
        summarize_configuration(
            planned.scene,
            one.name,
            {name: {i: row for i, row in enumerate(own) if row} for name, own in speeds.items()},
            nominal[source],
            [row[source] for row in random if source in row],
        )
        for one in (*planned.configurations, Configuration(CONTROL_AGAIN, planned.scene.methods))
        if (source := CONTROL if one.name == CONTROL_AGAIN else one.name) in nominal
        and any(speeds.get(one.name, ()))
    ]


def _good(rows: Mapping[str, Row], name: str) -> Row:
    """Return the result row of a trial, or an empty row if the trial failed."""
    row = rows.get(name, {})
    return {} if "error" in row else row


def summarize_configuration(
    scene: Scene,
    name: str,
    rows: Mapping[str, Mapping[int, Row]],
    errors: Row,
    random: Sequence[Row],
) -> dict[str, Any]:
    """Summarize one configuration as one point of the chart.

    The measurements are repeated in blocks, each with a run of every configuration. Each run is
    compared with the run of the control configuration in the same block. Blocks in which one of
    these runs failed are omitted from this comparison.

    rows: processor use and latencies by configuration and block.
    errors: errors with hardware that does not deviate from the scene.
    random: errors with each random apparatus (set of true hardware parameters).
    """
    own, control = rows[name], rows.get(CONTROL, {})
    blocks = sorted(own)

    def estimate(key: str) -> Interval | None:
        if key.partition(".")[0] in ERRORS:
            value = read_value(errors, key)
            return Interval(value, value, value) if np.isfinite(value) else None
        return bootstrap_median(np.array([read_value(own[block], key) for block in blocks]))

    def summarize_latency(key: str) -> dict[str, float] | None:
        found = {quantile: estimate(f"{key}.{quantile}") for quantile in QUANTILES}
        known = {quantile: one.value for quantile, one in found.items() if one is not None}
        return known or None

    tolerances = list_tolerances(scene)
    intervals = {key: estimate(key) for key in tolerances}
    ratios = {key: one and scale(one, 1.0 / tolerances[key]) for key, one in intervals.items()}
    failing = [key for key, one in ratios.items() if one is not None and upper_limit(one) > 1.0]
    cores = estimate("cpu_cores")
    shared = sorted(set(own) & set(control))
    return {
        "scene": scene.name,
        "configuration": name,
        "cpu_cores": None if cores is None else cores.value,
        "cpu_cores_by_node": _median_by_key([own[block]["cpu_cores_by_node"] for block in blocks]),
        **{key: summarize_latency(key) for key in LATENCIES},
        **{key: _value(intervals[f"{key}.p95"]) for key in ERRORS},
        "meets_tolerances": not failing,
        "failing": failing,
        "spread": {
            key: asdict(one)
            for key, one in {"cpu_cores": cores, **intervals}.items()
            if one is not None
        },
        "tolerance_ratios": {key: asdict(one) for key, one in ratios.items() if one is not None},
        "ratio_to_control": {
            key: asdict(one)
            for key in COMPARED
            if (
                one := compare_paired(
                    *(
                        np.array([read_value(of[block], key) for block in shared])
                        for of in (own, control)
                    )
                )
            )
            is not None
        },
        "budget": errors["budget"],
        "random_apparatuses": {
            "runs": len(random),
            "within_tolerances": sum(
                all(not read_value(row, key) > limit for key, limit in tolerances.items())
                for row in random
            ),
            **{
                key: {"median": float(np.median(values)), "max": float(values.max())}
                for key in ERRORS
                if len(values := _known([read_value(row, f"{key}.p95") for row in random]))
            },
        },
        "runs": len(own),
    }


def upper_limit(one: Interval) -> float:
    """Return the upper limit of an interval, or its central value if the limit is infinite."""
    return one.high if np.isfinite(one.high) else one.value


def scale(one: Interval, factor: float) -> Interval:
    """Return an interval with its value and limits multiplied by a factor."""
    return Interval(one.value * factor, one.low * factor, one.high * factor)


def _value(one: Interval | None) -> float | None:
    return None if one is None else one.value


def _known(values: Sequence[float]) -> Floats:
    array = np.array(values, dtype=np.float64)
    return array[np.isfinite(array)]


def _median_by_key(rows: Sequence[Mapping[str, float]]) -> dict[str, float]:
    keys = dict.fromkeys(key for row in rows for key in row)
    return {key: float(np.median([row[key] for row in rows if key in row])) for key in keys}


def worst_ratio(point: Mapping[str, Any]) -> Interval:
    """Return the largest ratio of an error (not a latency) to its tolerance for a chart point."""
    ratios = [
        Interval(**one)
        for key, one in point["tolerance_ratios"].items()
        if key.partition(".")[0] in ERRORS
    ]
    return max(ratios, key=lambda one: one.value)


def find_system_front(points: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the names of a scene's configurations that are on the Pareto front.

    The compared costs are the latency from the camera's exposure to the arm's motion, the number of
    used processor cores, and the largest error-to-tolerance ratio.
    """
    costs = {}
    for point in points:
        if point["configuration"] == CONTROL_AGAIN:
            continue
        spread = point["spread"]
        costs[point["configuration"]] = [
            Interval(**spread["exposure_to_arm_ms.p95"]),
            Interval(**spread["cpu_cores"]),
            worst_ratio(point),
        ]
    return find_front(costs)
