"""Measure how much the uncertainty of single apparatus parameters affects the system's errors.

The apparatus is the set of true parameters of the simulated hardware. Sigma is the standard
deviation of a parameter in the tolerance table.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
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
from flexsheet.launch.plans.plan import load_graph
from flexsheet.messages.scene import Scene
from flexsheet.nodes.twin.tolerance_table import NOT_SIMULATED, Profile

SIGMAS = (-3.0, -1.0, 1.0, 3.0)


class EvaluationKind(StrEnum):
    """The method by which the effect of a parameter was evaluated.

    OFFLINE: errors are computed for single poses, without running nodes. The errors of sheet and
        fingertip include the effect of wrong timestamps at the working speed.
    SIMULATED_TIME: the errors of sheet and fingertip are evaluated during strokes of the finger in
        simulated time.
    NOT_MEASURED: the parameter affects only images of a moving sheet or eye.
    NOT_SIMULATED: no simulator node uses the parameter.
    """

    OFFLINE = "offline"
    SIMULATED_TIME = "simulated_time"
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
"""The parameters that have no effect at rest, or no effect on a noise-free image of the marker."""

STROKE_SEEDS = (0, 1, 2)
"""The random seeds of the strokes, for nominal and for changed hardware parameters."""

WITH_IMAGES = frozenset({"finger.marker_shape", "finger.marker_tilt_rad"})
"""The parameters that affect the detection of the marker, which requires rendered images."""

AFFECTED: dict[str, frozenset[Metric]] = {
    "camera": frozenset(Metric),
    "arms": frozenset({Metric.SHEET, Metric.IMAGE, Metric.FORCE}),
    "sheet": frozenset({Metric.SHEET, Metric.IMAGE, Metric.FORCE}),
    "finger": frozenset(Metric),
    "eyes": frozenset({Metric.IMAGE}),
    "projector": frozenset({Metric.IMAGE}),
}
"""The metrics that are affected at rest, by section of the true hardware parameters."""


def evaluation_of(parameter: str) -> EvaluationKind:
    """Return the method by which the effect of a parameter is evaluated."""
    if parameter in NOT_SIMULATED:
        return EvaluationKind.NOT_SIMULATED
    if parameter not in TIMING:
        return EvaluationKind.OFFLINE
    moves_image_only = parameter.partition(".")[0] in ("eyes", "projector")
    return EvaluationKind.NOT_MEASURED if moves_image_only else EvaluationKind.SIMULATED_TIME


def run_sensitivity(
    launch_file: Path,
    settings: Sequence[str],
    folder: Path,
    parameters: Sequence[str],
    progress: Progress,
    *,
    profile: Profile,
    calibrated: bool,
    seconds: float,
    workers: int = 1,
) -> dict[str, Any]:
    """Vary the parameters individually, and return the results of `experiment sensitivity --json`.

    folder: folder in which the results of finished trials are stored.
    seconds: duration of a stroke of the finger.
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
    evaluations = {one: evaluation_of(one) for one in parameters}
    trials = {
        parameter.replace("*", "both"): {
            **common,
            "kind": "sensitivity",
            "parameter": parameter,
            "sigmas": SIGMAS,
            "metrics": sorted(AFFECTED[parameter.partition(".")[0]]),
            "stroke_seeds": STROKE_SEEDS if evaluation is EvaluationKind.SIMULATED_TIME else (),
            "with_images": parameter in WITH_IMAGES,
        }
        for parameter, evaluation in evaluations.items()
        if evaluation in (EvaluationKind.OFFLINE, EvaluationKind.SIMULATED_TIME)
    }
    found = run_sweep(folder, common, trials, progress, workers=workers)
    raise_if_all_failed(found, folder)
    effects = {
        row["parameter"]: row["effects"] for row in found.values() if row.get("effects") is not None
    }
    rows = [
        _make_row(parameter, sigma, evaluation, effects.get(parameter))
        for parameter, evaluation in evaluations.items()
        for sigma in SIGMAS
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


def _make_row(
    parameter: str,
    sigma: float,
    evaluation: EvaluationKind,
    effects: Mapping[str, Mapping[str, float | None]] | None,
) -> Row:
    """Return a result row with the effects of one deviation of a parameter.

    The row contains one effect for each error metric; None if the metric was not evaluated.
    `Evaluation.change_from` defines the effects that are evaluated offline. In simulated time, an
    effect is the mean error minus the mean error with the nominal hardware parameters.

    sigma: size of the deviation, in standard deviations.
    effects: effects on the metrics, by the text of `sigma`; None if the parameter was not
        evaluated.
    """
    row: Row = {"parameter": parameter, "sigma": sigma, "evaluation": evaluation.value}
    row |= {metric.value: None for metric in Metric}
    if effects is None:
        return row
    if evaluation is EvaluationKind.OFFLINE:
        row |= {metric.value: 0.0 for metric in Metric}
    changes = effects[f"{sigma:g}"]
    return row | {key: value for key, value in changes.items() if value is not None}


def rank(scene: Scene, rows: Sequence[Row]) -> list[Row]:
    """Return the parameters, sorted by their worst effect at a deviation of one standard deviation.

    Each result is a dictionary with the keys `parameter`, `share` and `metric`. The value `share`
    is the largest error divided by its tolerance in the scene, and `metric` is the type of this
    error.
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
