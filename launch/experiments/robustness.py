"""Evaluate the system with many random sets of true hardware parameters.

Each set represents a laboratory whose simulated hardware deviates randomly from the scene file. The
set is called an apparatus.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from flexsheet.launch.experiments import ExperimentError
from flexsheet.launch.experiments.offline import Metric
from flexsheet.launch.experiments.run import require_scene
from flexsheet.launch.experiments.sweep import (
    Progress,
    Row,
    describe_graph,
    raise_if_all_failed,
    run_sweep,
)
from flexsheet.launch.plans.plan import load_graph
from flexsheet.nodes.twin.tolerance_table import Profile

METRICS = ("sheet_mm", "sheet_deg", "image_mm", "force_percent", "fingertip_mm")
MAX_TRIALS = 10_000
_RANGE = re.compile(r"(\d{1,9})(?:-(\d{1,9}))?")


def parse_seeds(text: str) -> list[int]:
    """Parse random seeds from the text "A-B" (both included) or "A".

    Raises ExperimentError if the text is invalid.
    """
    match = _RANGE.fullmatch(text.strip())
    if match is None:
        raise ExperimentError(f'--seeds "{text}": expected A-B, such as 0-9, or one whole number')
    first, last = int(match[1]), int(match[2] or match[1])
    if last < first:
        raise ExperimentError(f'--seeds "{text}": {last} is less than {first}; give {last}-{first}')
    if last - first >= MAX_TRIALS:
        raise ExperimentError(f'--seeds "{text}": more than {MAX_TRIALS} seeds; divide the range')
    return list(range(first, last + 1))


def apparatus_text(seed: int, profile: Profile, *, calibrated: bool) -> str:
    """Return a value of the option --apparatus that makes the hardware parameters random."""
    return f"seed:{seed},{profile.value}{',calibrated' if calibrated else ''}"


def run_robustness(
    launch_file: Path,
    settings: Sequence[str],
    folder: Path,
    seeds: Sequence[int],
    progress: Progress,
    *,
    profile: Profile,
    calibrated: bool,
    seconds: float,
    workers: int = 1,
    commissioned: bool = False,
) -> dict[str, Any]:
    """Evaluate a random laboratory per seed; return the results of `experiment robustness --json`.

    commissioned: whether each simulated laboratory is calibrated before the evaluation. If true,
        the true hardware initially has the errors of uncalibrated devices, and a separate folder
        contains the calibrated scene and launch file. The evaluation then runs in simulated time,
        and the calibrated camera defines the world frame.
    """
    if commissioned and calibrated:
        raise ExperimentError(
            "--commissioned and --calibrated cannot be combined, because each of them selects "
            "calibrated devices; use only one"
        )
    plan = load_graph(launch_file, settings=settings)
    require_scene(plan)
    common = {
        "experiment": "robustness",
        **describe_graph(plan, launch_file, settings),
        "profile": profile.value,
        "calibrated": calibrated,
        "commissioned": commissioned,
        "seconds": seconds,
    }
    trials = {}
    for seed in seeds:
        name = f"seed-{seed:05d}"
        trials[name] = {
            "kind": "robustness",
            "seed": seed,
            "launch_file": common["launch_file"],
            "settings": common["settings"],
            "apparatus": apparatus_text(seed, profile, calibrated=calibrated),
            "seconds": seconds,
            "commission_folder": str(folder.resolve() / f"{name}-lab") if commissioned else None,
        }
    rows = run_sweep(folder, common, trials, progress, workers=workers)
    raise_if_all_failed(rows, folder)
    found = [row for row in rows.values() if "error" not in row]
    failed = [
        {"seed": trials[name]["seed"], "error": row["error"]}
        for name, row in rows.items()
        if "error" in row
    ]
    return {
        "profile": profile.value,
        "calibrated": calibrated,
        "commissioned": commissioned,
        "rows": found,
        "failed": failed,
        "summary": summarize(found),
        "measured": {
            **dict.fromkeys(
                ("sheet_mm", "sheet_deg", "fingertip_mm"),
                "simulated time" if commissioned else "graph",
            ),
            **dict.fromkeys(("image_mm", "force_percent"), "offline"),
        },
        "out_of_tolerance": [row["seed"] for row in found if row["out_of_tolerance"]],
        "flagged": [row["seed"] for row in found if row["flagged"]],
        "out_of_tolerance_not_flagged": [
            row["seed"] for row in found if row["out_of_tolerance"] and not row["flagged"]
        ],
        "folder": str(folder),
        **({"commissioning": summarize_commissioning(found)} if commissioned else {}),
    }


def summarize_commissioning(rows: Sequence[Row]) -> dict[str, Any]:
    """Compare the errors that the reports of simulated laboratories predict with the true errors.

    confusion: number of laboratories for each combination of report (good or not) and true errors
        (within tolerance or not), in total and for each metric.
    stated_over_true: quantiles of the ratio of predicted rms error to true error.
    covered: fraction of true errors below the predicted 95 % quantile.
    """
    predictions = {}
    for metric in Metric:
        cases = [
            (row["predicted"][metric], row[metric], metric in row["out_of_tolerance"])
            for row in rows
            if metric in row["predicted"] and row[metric]
        ]
        if not cases:
            continue
        ratios = [stated["typical"] / true for stated, true, _ in cases]
        predictions[metric.value] = {
            "stated_over_true": {
                "p05": float(np.quantile(ratios, 0.05)),
                "median": float(np.median(ratios)),
                "p95": float(np.quantile(ratios, 0.95)),
            },
            "covered": float(np.mean([true <= stated["limit_95"] for stated, true, _ in cases])),
            "predicted_limit_95": float(np.median([stated["limit_95"] for stated, _, _ in cases])),
            **_count_confusion([(stated["within"], not bad) for stated, _, bad in cases]),
        }
    steps = [step for row in rows for step in row["commission"]["steps"]]
    names = dict.fromkeys(step["name"] for step in steps)
    return {
        "confusion": _count_confusion(
            [(not row["doubts"], not row["out_of_tolerance"]) for row in rows]
        ),
        "predictions": predictions,
        "cpu_seconds": float(np.median([row["commission"]["cpu_seconds"] for row in rows])),
        "steps": {
            name: {
                "cpu_seconds": float(
                    np.median([one["cpu_seconds"] for one in steps if one["name"] == name])
                ),
                "above_limit": [
                    row["seed"] for row in rows if name in row["commission"]["above_limit"]
                ],
            }
            for name in names
        },
    }


def _count_confusion(cases: Sequence[tuple[bool, bool]]) -> dict[str, int]:
    """Count the simulated laboratories by two flags: (reported as good, truly good)."""
    return {
        "good_and_within": cases.count((True, True)),
        "good_but_exceeded": cases.count((True, False)),
        "doubted_but_within": cases.count((False, True)),
        "doubted_and_exceeded": cases.count((False, False)),
    }


def summarize(rows: Sequence[Row]) -> dict[str, dict[str, float | None]]:
    """Summarize the trials for each metric.

    A summary contains the median, the 95 % quantile and the maximum of the metric, and the seed of
    the maximum. It also contains the number of trials that have the metric, and the number of
    trials that are out of tolerance. The key `not_flagged` is the number of trials out of tolerance
    in which no node suspected an error of the hardware. If no trial has the metric, the statistics
    are None.
    """
    summary: dict[str, dict[str, float | None]] = {}
    for metric in METRICS:
        known = [(row[metric], row["seed"]) for row in rows if row[metric] is not None]
        values = np.array([value for value, _ in known])
        worst = max(known, default=(None, None))
        exceeded = [row for row in rows if metric in row["out_of_tolerance"]]
        summary[metric] = {
            "median": float(np.median(values)) if known else None,
            "p95": float(np.quantile(values, 0.95)) if known else None,
            "worst": worst[0],
            "worst_seed": worst[1],
            "trials": len(known),
            "out_of_tolerance": len(exceeded),
            "not_flagged": sum(not row["flagged"] for row in exceeded),
        }
    return summary
