"""Measure how much the uncertainty of each single apparatus parameter affects the system's errors.

The apparatus is the set of true parameters of the simulated hardware. Sigma is the standard
deviation of a parameter in the tolerance table.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import StrEnum
from pathlib import Path
from typing import Any

from flexsheet.launch.experiments.offline import Metric, metric_tolerances
from flexsheet.launch.experiments.run import require_scene
from flexsheet.launch.experiments.sweep import (
    Progress,
    Row,
    describe_graph,
    raise_if_all_failed,
    run_sweep,
)
from flexsheet.launch.plans.apparatus import format_apparatus
from flexsheet.launch.plans.plan import load_graph
from flexsheet.messages.apparatus import nominal_apparatus
from flexsheet.messages.files import write_file
from flexsheet.messages.scene import Scene
from flexsheet.nodes.twin.tolerance_table import (
    NOT_SIMULATED,
    Profile,
    deviate_apparatus,
)

SIGMAS = (-3.0, -1.0, 1.0, 3.0)


class EvaluationKind(StrEnum):
    """The method by which the effect of a parameter was evaluated.

    offline: without running nodes; errors of sheet and fingertip at the working speed, errors of
    image and force at rest. graph: in motion, with running nodes. not_measured: the effect occurs
    only in motion, and no graph was run. not_simulated: no simulator node uses the parameter.
    """

    OFFLINE = "offline"
    GRAPH = "graph"
    NOT_MEASURED = "not_measured"
    NOT_SIMULATED = "not_simulated"


TIMING = frozenset(
    {
        "camera.rate_hz",
        "camera.read_out_s",
        "camera.exposure_jitter_s",
        "arms.*.servo_lag_s",
        "arms.*.command_latency_s",
        "arms.*.controller_period_s",
        "arms.*.controller_jitter_s",
        "arms.*.backlash_rad",
        "finger.marker_shape",
        "finger.marker_tilt_rad",
        "finger.tremor_frequency_hz",
        "finger.tremor_width_hz",
        "finger.tremor_rms_m",
        "finger.voluntary_bandwidth_hz",
        "eyes.sway_m",
        "eyes.sway_frequency_hz",
        "eyes.interocular_offset_m",
        "projector.latency_offset_s",
    }
)
"""The parameters without effect at rest, or on a noise-free image of the marker.

Errors of sheet and fingertip in a running graph show their effects, except for those of eyes and
projector.
"""

AFFECTED: dict[str, frozenset[Metric]] = {
    "camera": frozenset(Metric),
    "arms": frozenset({Metric.SHEET, Metric.IMAGE, Metric.FORCE}),
    "sheet": frozenset({Metric.SHEET, Metric.IMAGE, Metric.FORCE}),
    "finger": frozenset(Metric),
    "gauge": frozenset(),
    "eyes": frozenset({Metric.IMAGE}),
    "projector": frozenset({Metric.IMAGE}),
}
"""The metrics that each section of the apparatus affects at rest."""


def evaluation_of(parameter: str, *, with_graph: bool) -> EvaluationKind:
    """Return the method by which the effect of a parameter is evaluated."""
    if parameter in NOT_SIMULATED:
        return EvaluationKind.NOT_SIMULATED
    if parameter not in TIMING:
        return EvaluationKind.OFFLINE
    in_motion = with_graph and parameter.partition(".")[0] not in ("eyes", "projector")
    return EvaluationKind.GRAPH if in_motion else EvaluationKind.NOT_MEASURED


def run_sensitivity(
    launch_file: Path,
    settings: Sequence[str],
    folder: Path,
    parameters: Sequence[str],
    progress: Progress,
    *,
    profile: Profile,
    calibrated: bool,
    with_graph: bool,
    seconds: float,
    workers: int = 1,
    scheduler: str | None = None,
) -> dict[str, Any]:
    """Vary the parameters one by one and return the results of `experiment sensitivity --json`.

    folder: where the results of finished trials are stored. with_graph: also run the graph for
    parameters whose effect occurs only in motion. seconds: duration of a stroke.
    """
    plan = load_graph(launch_file, settings=settings)
    scene = require_scene(plan)
    common = {
        "experiment": "sensitivity",
        **describe_graph(plan, launch_file, settings),
        "profile": profile.value,
        "calibrated": calibrated,
        "seconds": seconds,
    }
    evaluations = {one: evaluation_of(one, with_graph=with_graph) for one in parameters}
    folder.mkdir(parents=True, exist_ok=True)
    trials: dict[str, dict[str, Any]] = {}
    for parameter, evaluation in evaluations.items():
        if evaluation is EvaluationKind.OFFLINE:
            trials[_trial_name(parameter)] = {
                **common,
                "kind": "sensitivity",
                "parameter": parameter,
                "sigmas": SIGMAS,
                "metrics": sorted(AFFECTED[parameter.partition(".")[0]]),
            }
        elif evaluation is EvaluationKind.GRAPH:
            for sigma in SIGMAS:
                name = _trial_name(parameter, sigma)
                apparatus = deviate_apparatus(
                    scene, parameter, sigma, profile=profile, calibrated=calibrated
                )
                file = folder / f"{name}.yaml"
                write_file(file, format_apparatus(apparatus))
                trials[name] = _stroke_trial(common, file)
    if EvaluationKind.GRAPH in evaluations.values():
        file = folder / "nominal.yaml"
        write_file(file, format_apparatus(nominal_apparatus(scene)))
        trials["nominal"] = _stroke_trial(common, file)
    found = run_sweep(folder, common, trials, progress, workers=workers, scheduler=scheduler)
    raise_if_all_failed(found, folder)
    rows = [
        row
        for parameter, evaluation in evaluations.items()
        for row in _make_rows(parameter, evaluation, found)
    ]
    return {
        "profile": profile.value,
        "calibrated": calibrated,
        "rows": rows,
        "ranking": rank(scene, rows),
        "failed": [
            {"trial": name, "error": row["error"]} for name, row in found.items() if "error" in row
        ],
        "tolerances": {metric.value: limit for metric, limit in metric_tolerances(scene).items()},
        "folder": str(folder),
    }


def _trial_name(parameter: str, sigma: float | None = None) -> str:
    name = parameter.replace("*", "both")
    return name if sigma is None else f"{name}-at-{sigma:+g}"


def _stroke_trial(common: dict[str, Any], apparatus_file: Path) -> dict[str, Any]:
    return {**common, "kind": "stroke", "apparatus": str(apparatus_file.resolve())}


def _make_rows(parameter: str, evaluation: EvaluationKind, found: dict[str, Row]) -> list[Row]:
    """Return the results of a parameter, one row per deviation; a metric without value is None.

    Without a graph, an effect is the mean change of single vectors, pixels and pushes. With a graph
    it is the mean error minus the mean error with the nominal apparatus.
    """
    rows = []
    for sigma in SIGMAS:
        row: Row = {"parameter": parameter, "sigma": sigma, "evaluation": evaluation.value}
        row |= dict.fromkeys(Metric)
        if evaluation is EvaluationKind.OFFLINE:
            effects = found[_trial_name(parameter)].get("effects")
            if effects is not None:
                row |= dict.fromkeys(Metric, 0.0)
                row |= {
                    key: value for key, value in effects[f"{sigma:g}"].items() if value is not None
                }
        elif evaluation is EvaluationKind.GRAPH:
            nominal, one = found["nominal"], found[_trial_name(parameter, sigma)]
            if "error" not in nominal and "error" not in one:
                for metric, key in (
                    (Metric.SHEET, "true_delta_d_mm"),
                    (Metric.FINGERTIP, "fingertip_mm"),
                ):
                    row[metric] = one[key]["mean"] - nominal[key]["mean"]
        rows.append({getattr(key, "value", key): value for key, value in row.items()})
    return rows


def rank(scene: Scene, rows: Sequence[Row]) -> list[Row]:
    """Return the measured parameters, sorted by their worst effect at a deviation of one sigma.

    share: ratio of that effect to the scene's tolerance of the metric. The largest is first.
    """
    limits = metric_tolerances(scene)
    ranked = []
    for parameter in dict.fromkeys(row["parameter"] for row in rows):
        shares = [
            (row[metric] / limit, metric.value)
            for row in rows
            if row["parameter"] == parameter and abs(row["sigma"]) == 1.0
            for metric, limit in limits.items()
            if row[metric] is not None
        ]
        if shares:
            share, metric = max(shares)
            ranked.append({"parameter": parameter, "share": share, "metric": metric})
    return sorted(ranked, key=lambda row: -row["share"])
