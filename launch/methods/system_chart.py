"""Measure the speed and accuracy of the whole system for several configurations of its methods.

Processor use and latency are measured in the running graph (`experiments/trial.py`). The
measurement is repeated in blocks, each with a run of every configuration in random order, so that
slow changes of the computer affect all configurations equally. Results are medians over blocks,
with bootstrap confidence intervals over whole blocks, because the runs of a block are not
independent (Kalibera and Jones, ISMM 2013). Errors are 95 % quantiles that are computed in
simulated time (`experiments/system_errors.py`). The nominal apparatus (set of true hardware
parameters) and random apparatuses are used. Each trial is a separate process.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from flexsheet.launch.experiments import ExperimentError
from flexsheet.launch.experiments.offline import metric_tolerances
from flexsheet.launch.experiments.robustness import apparatus_text
from flexsheet.launch.experiments.run import DEMO_FILE
from flexsheet.launch.experiments.sweep import Row, describe_graph, run_sweep
from flexsheet.launch.methods.results import describe_load, machine_name
from flexsheet.launch.plans.documents import edit_yaml
from flexsheet.launch.plans.plan import load_graph, load_scene
from flexsheet.launch.plans.plan_model import ResolvedGraph
from flexsheet.launch.running.precompute import (
    precompute_deflection_shapes,
    precompute_force_table,
    precompute_soft_body,
)
from flexsheet.messages.methods import Methods, SoftBodyChoice
from flexsheet.messages.scene import Scene
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.methods import Interval, dominates
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

CONFIDENCE = 0.95
RESAMPLES = 2000
BOOTSTRAP_SEED = 20261123

ERRORS = ("sheet_mm", "image_mm", "force_percent", "fingertip_mm")
LATENCIES = ("exposure_to_arm_ms", "exposure_to_light_ms")
QUANTILES = ("p50", "p95", "p99")

NODE_PARAMETERS: Mapping[str, tuple[str, str]] = {
    "sheet_shape": ("renderer", "sheet_shape"),
    "correction": ("renderer", "correction"),
    "compliance": ("planner", "compliance_mode"),
}
"""For each key of `Methods`, the node type and the node parameter that select the method."""

EXACT = Methods(soft_body=SoftBodyChoice(method="nonlinear_table", skin_spacing_m=0.0045))

PAPER = Methods(
    sheet_shape="four_triangles",
    correction="four_triangles",
    soft_body=SoftBodyChoice(method="linear", skin_spacing_m=0.0045),
    compliance="stiffness",
)
"""The methods of Furukawa et al. 2007, sections III and IV. The soft body is linear FEM, and the
sheet is drawn as four triangles. Stiffness is rendered only by the stretch of the sheet."""

PAPER_PLANNER = {"prediction_horizon_s": 0.0}
"""The parameters of the planner for the methods of Furukawa et al. 2007, which do not compensate
the delay (section V-C)."""


@dataclass(frozen=True, slots=True)
class Configuration:
    """A choice of methods for all nodes, with values of further planner parameters.

    planner: values of the planner parameters, by parameter name.
    """

    name: str
    methods: Methods
    planner: Mapping[str, float] = field(default_factory=dict)

    def settings(self, graph: ResolvedGraph) -> list[str]:
        """Return the settings "node.parameter=value" that apply this configuration to a graph."""
        chosen = [("planner", f"{key}={value}") for key, value in self.planner.items()]
        for key, (node_type, parameter) in NODE_PARAMETERS.items():
            chosen.append((node_type, f"{parameter}={getattr(self.methods, key)}"))
        body = self.methods.soft_body
        chosen.append(("fem_solver", f"method={body.method}"))
        chosen.append(("fem_solver", f"skin_spacing_m={body.skin_spacing_m}"))
        return [
            f"{node.name}.{text}"
            for node_type, text in chosen
            for node in graph.nodes_of_type(node_type)
        ]

    def prepare(self, scene: Scene, progress: Progress) -> None:
        """Compute and cache the tables that the methods need.

        If a table were missing, a node would use another method, and the wrong method would be
        measured. If no table of the soft body is cached, its coarse table is computed.
        """
        if self.methods.sheet_shape == "reduced_order" and scene.projector is not None:
            precompute_deflection_shapes(scene, None, progress)
        if scene.object.material is not None:
            precompute_force_table(scene, None, progress)
            precompute_soft_body(scene, self.methods.soft_body, None, progress)

    def describe(self) -> dict[str, Any]:
        """Return the methods and the planner's parameters for the description of a trial."""
        return {"methods": self.methods.model_dump(mode="json"), "planner": dict(self.planner)}


def list_configurations(scene: Scene) -> list[Configuration]:
    """Return the configurations that are compared for a scene."""
    return [
        Configuration("paper", PAPER, PAPER_PLANNER),
        Configuration("tuned", scene.methods),
        Configuration("most exact", EXACT),
    ]


def write_launch_file(launch_file: Path, scene_file: Path, target: Path) -> Path:
    """Write a copy of a launch file with another scene, and return its path.

    Relative paths become absolute in the copy, and recording is disabled.
    """
    with edit_yaml(launch_file, target) as launch:
        launch["scene"] = str(scene_file.resolve())
        launch.pop("record", None)
        for spec in launch["nodes"].values():
            given = spec.get("parameters", {})
            for parameter, value in given.items():
                file = launch_file.parent / str(value)
                if isinstance(value, str) and file.is_file():
                    given[parameter] = str(file.resolve())
    return target


@dataclass(frozen=True, slots=True)
class SceneTrials:
    """The planned trials that measure the whole system in one scene.

    trials: description of each trial, by trial name.
    runs: names of the trials that run the graph, one for each block, by configuration.
    common: settings that all trials share.
    """

    scene: Scene
    trials: Mapping[str, Mapping[str, Any]]
    runs: Mapping[str, Sequence[str]]
    common: Mapping[str, Any]


def plan_trials(
    scene_file: Path,
    configurations: Sequence[Configuration],
    folder: Path,
    *,
    blocks: int,
    seconds: float,
    apparatuses: int,
) -> SceneTrials:
    """Plan the trials that measure configurations of the whole system in one scene.

    The first trials compute the display errors. The other trials run the graph, and are repeated in
    blocks. Each block contains all configurations in random order.

    blocks: number of blocks.
    seconds: duration of each stroke of the finger.
    apparatuses: number of random apparatuses (sets of true hardware parameters).
    """
    folder.mkdir(parents=True, exist_ok=True)
    launch = write_launch_file(DEMO_FILE, scene_file, folder / "launch.yaml").resolve()
    graph = load_graph(launch)
    described = {one.name: one.describe() for one in configurations}
    errors = {
        "kind": "system errors",
        "launch_file": str(launch),
        "configurations": described,
        "apparatus": None,
        "seconds": seconds,
        "seed": FINGER_SEED,
    }
    trials: dict[str, Mapping[str, Any]] = {NOMINAL: errors}
    for seed in range(FIRST_SEED, FIRST_SEED + apparatuses):
        text = apparatus_text(seed, Profile.MODERN, calibrated=True)
        trials[f"errors-{seed}"] = {**errors, "apparatus": text}
    runs: dict[str, list[str]] = {one.name: [] for one in configurations}
    random = np.random.default_rng(ORDER_SEED)
    for block in range(blocks):
        # The finger has the same random motion in all runs of a block.
        seeds = [
            f"{node.name}.seed={FINGER_SEED + block}" for node in graph.nodes_of_type("twin_finger")
        ]
        for index in random.permutation(len(configurations)):
            one = configurations[index]
            trial = f"block-{block:03d}-{one.name.replace(' ', '-')}"
            runs[one.name].append(trial)
            trials[trial] = {
                "kind": "system",
                "launch_file": str(launch),
                "settings": [*one.settings(graph), *seeds],
                "seconds": seconds,
            }
    common = {
        "experiment": "system",
        **describe_graph(graph, launch, ()),
        "seconds": seconds,
        "configurations": described,
    }
    return SceneTrials(load_scene(scene_file), trials, runs, common)


def run_system_chart(
    scene_files: Sequence[Path],
    folder: Path,
    progress: Progress,
    *,
    blocks: int,
    seconds: float,
    apparatuses: int,
    list_configurations: Callable[[Scene], Sequence[Configuration]] = list_configurations,
) -> dict[str, Any]:
    """Measure the configurations for all scenes, and return the result of `chart system --json`.

    Tables that the methods need are computed first. Trials that already have a result in `folder`
    are not repeated.

    blocks: number of repetitions per scene.
    seconds: duration of each stroke of the finger.
    apparatuses: number of random apparatuses (sets of true hardware parameters).
    """
    points: list[dict[str, Any]] = []
    failed: list[dict[str, str]] = []
    for number, file in enumerate(scene_files, start=1):
        own, scene = folder / file.stem, load_scene(file)
        configurations = list_configurations(scene)
        planned = plan_trials(
            file, configurations, own, blocks=blocks, seconds=seconds, apparatuses=apparatuses
        )

        def report(text: str, name: str = f"{file.stem} ({number} of {len(scene_files)})") -> None:
            progress(f"{name}: {text}")

        for one in configurations:
            one.prepare(scene, report)
        rows = run_sweep(own, planned.common, planned.trials, report)
        failed += [
            {"scene": scene.name, "trial": name, "error": row["error"]}
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


def bootstrap_median(values: Floats) -> Interval | None:
    """Return the median of n measured values, with its bootstrap confidence interval.

    values: values (n,) of independent runs, one from each block of the measurement. NaN means that
        a run failed.

    Returns None if no value is finite. If only one value is finite, the limits of the interval are
    infinite.
    """
    known = values[np.isfinite(values)]
    if len(known) == 0:
        return None
    median = float(np.median(known))
    if len(known) == 1:
        return Interval(median, -np.inf, np.inf)
    picks = np.random.default_rng(BOOTSTRAP_SEED).integers(len(known), size=(RESAMPLES, len(known)))
    tails = (0.5 - 0.5 * CONFIDENCE, 0.5 + 0.5 * CONFIDENCE)
    low, high = np.quantile(np.median(known[picks], axis=1), tails)
    return Interval(median, float(low), float(high))


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
    good = {name: row for name, row in rows.items() if "error" not in row}
    random = [row for name, row in good.items() if name.startswith("errors-") and name != NOMINAL]
    points = []
    for name, trials in planned.runs.items():
        speeds = [good[trial] for trial in trials if trial in good]
        if speeds and name in good.get(NOMINAL, {}):
            errors = good[NOMINAL][name]
            points.append(
                summarize_configuration(
                    planned.scene,
                    name,
                    speeds,
                    errors,
                    [row[name] for row in random if name in row],
                )
            )
    return points


def summarize_configuration(
    scene: Scene, name: str, speeds: Sequence[Row], errors: Row, random: Sequence[Row]
) -> dict[str, Any]:
    """Summarize one configuration as one point of the chart.

    speeds: processor use and latencies of each run of the graph.
    errors: errors with hardware that does not deviate from the scene.
    random: errors with each random apparatus (set of true hardware parameters).
    """

    def estimate(key: str) -> Interval | None:
        if key.partition(".")[0] in ERRORS:
            value = read_value(errors, key)
            return Interval(value, value, value) if np.isfinite(value) else None
        return bootstrap_median(np.array([read_value(row, key) for row in speeds]))

    def summarize_latency(key: str) -> dict[str, float] | None:
        found = {quantile: estimate(f"{key}.{quantile}") for quantile in QUANTILES}
        return {quantile: one.value for quantile, one in found.items() if one is not None} or None

    tolerances = list_tolerances(scene)
    found = {key: estimate(key) for key in ("cpu_cores", *tolerances)}
    intervals = {key: one for key, one in found.items() if one is not None}
    ratios = {
        key: Interval(*(value / limit for value in (one.value, one.low, one.high)))
        for key, limit in tolerances.items()
        if (one := intervals.get(key)) is not None
    }
    failing = [key for key, one in ratios.items() if upper_limit(one) > 1.0]
    nodes = dict.fromkeys(key for row in speeds for key in row["cpu_cores_by_node"])
    by_node = {key: [row["cpu_cores_by_node"].get(key, np.nan) for row in speeds] for key in nodes}
    drawn = {key: np.array([read_value(row, f"{key}.p95") for row in random]) for key in ERRORS}
    return {
        "scene": scene.name,
        "configuration": name,
        "cpu_cores": intervals["cpu_cores"].value if "cpu_cores" in intervals else None,
        "cpu_cores_by_node": {key: float(np.nanmedian(cores)) for key, cores in by_node.items()},
        **{key: summarize_latency(key) for key in LATENCIES},
        **{key: one.value if (one := found[f"{key}.p95"]) else None for key in ERRORS},
        "meets_tolerances": not failing,
        "failing": failing,
        "spread": {key: asdict(one) for key, one in intervals.items()},
        "tolerance_ratios": {key: asdict(one) for key, one in ratios.items()},
        "budget": errors["budget"],
        "random_apparatuses": {
            "runs": len(random),
            "within_tolerances": sum(
                all(not read_value(row, key) > limit for key, limit in tolerances.items())
                for row in random
            ),
            **{
                key: {"median": float(np.nanmedian(values)), "max": float(np.nanmax(values))}
                for key, values in drawn.items()
                if np.isfinite(values).any()
            },
        },
        "runs": len(speeds),
    }


def upper_limit(one: Interval) -> float:
    """Return the upper limit of an interval, or its central value if the limit is infinite."""
    return one.high if np.isfinite(one.high) else one.value


def worst_ratio(point: Mapping[str, Any]) -> Interval:
    """Return the largest ratio of an error (not a latency) to its tolerance for a chart point."""
    ratios = [
        Interval(**one)
        for key, one in point["tolerance_ratios"].items()
        if key.partition(".")[0] in ERRORS
    ]
    return max(ratios, key=lambda one: one.value)


def find_system_front(points: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the names of a scene's configurations that no other configuration dominates.

    The compared costs are the latency from the camera's exposure to the arm's motion, the number of
    used processor cores, and the largest error-to-tolerance ratio.
    """
    costs = {
        point["configuration"]: [
            Interval(**point["spread"]["exposure_to_arm_ms.p95"]),
            Interval(**point["spread"]["cpu_cores"]),
            worst_ratio(point),
        ]
        for point in points
    }
    return [
        name
        for name, own in costs.items()
        if not any(dominates(other, own) for key, other in costs.items() if key != name)
    ]
