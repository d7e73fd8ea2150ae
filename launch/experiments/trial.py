"""Run one trial of a sweep: read its description as JSON from stdin, and print its result row.

Run this module as `python -m flexsheet.launch.experiments.trial`.
"""

from __future__ import annotations

import json
import os
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from flexsheet.launch.commands.output import logs_on_stderr
from flexsheet.launch.experiments import stroke
from flexsheet.launch.experiments.node_calibrations import NodeCalibrations
from flexsheet.launch.experiments.offline import Metric, OfflineEvaluator, exceeded_tolerances
from flexsheet.launch.experiments.ports import choose_ports
from flexsheet.launch.experiments.run import (
    make_stroke_procedure,
    require_scene,
    run_experiment,
)
from flexsheet.launch.experiments.simulated_time import LoopSettings, stroke_in_simulated_time
from flexsheet.launch.experiments.system_errors import ErrorEvaluator
from flexsheet.launch.experiments.system_run import run_system
from flexsheet.launch.methods.results import replace_non_finite
from flexsheet.launch.plans.plan import load_graph, load_scene
from flexsheet.messages.apparatus import Apparatus, nominal_apparatus
from flexsheet.messages.bag import BagReader
from flexsheet.messages.errors import FlexsheetError
from flexsheet.messages.methods import Methods
from flexsheet.messages.scene import Scene, require_cylinder
from flexsheet.messages.types import Status, SuspectedCause
from flexsheet.nodes.twin.tolerance_table import Profile, deviate_apparatus

Row = dict[str, Any]

NICENESS = 10
"""The niceness of trials that run no graph. It gives other programs on the computer priority."""


@contextmanager
def _bag_of(trial: Mapping[str, Any]) -> Iterator[Path]:
    """Yield the path of the trial's bag; the bag is temporary if the trial does not name a bag."""
    if trial.get("bag"):
        yield Path(trial["bag"])
        return
    with tempfile.TemporaryDirectory(prefix="flexsheet-trial-") as folder:
        yield Path(folder) / "stroke.mcap"


def _tell(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def run_stroke(trial: Mapping[str, Any], apparatus: str | None) -> Row:
    """Simulate one stroke of the finger in a separate graph.

    Return the measured errors and latencies, and the error causes that the nodes suspected.

    trial: description of the trial. apparatus: value of the option --apparatus, which selects the
    true parameters of the simulated hardware.
    """
    launch_file, seconds = Path(trial["launch_file"]), float(trial["seconds"])
    settings = [*choose_ports(launch_file), *trial.get("settings", ())]
    with _bag_of(trial) as bag:
        procedure = make_stroke_procedure([seconds], _tell)
        run_experiment(
            launch_file,
            settings,
            bag,
            procedure,
            _tell,
            apparatus=apparatus,
            check_scene=require_cylinder,
        )
        recording = stroke.read_recording(bag)
        errors = stroke.stroke_errors(recording, seconds)
        result = stroke.stroke_result(recording, errors, seconds, bag)
        flagged = read_flags(bag)
    if not trial.get("bag"):
        result["bag"] = None
    return {**result, "flagged": flagged}


def read_flags(bag: Path) -> list[SuspectedCause]:
    """Read from a bag which causes of errors the self-checks of the nodes suspected.

    Each cause is listed once, in the order of the first report.
    """
    found: dict[SuspectedCause, None] = {}
    for _, message, _, _ in BagReader(bag, topics=["status"]):
        if isinstance(message, Status):
            found.update({check.cause: None for check in message.self_checks if check.suspected})
    return list(found)


def run_robustness_trial(trial: Mapping[str, Any]) -> Row:
    """Return the display errors with random true parameters of the simulated hardware.

    The errors of the sheet are measured in motion, and the errors of image and force at rest.
    """
    if trial.get("commission_folder"):
        return _run_commissioned_trial(trial)
    apparatus_file, launch_file = trial["apparatus"], Path(trial["launch_file"])
    plan = load_graph(launch_file, settings=trial["settings"], apparatus=apparatus_file)
    scene, apparatus = require_scene(plan), plan.apparatus_message()
    assert apparatus is not None
    moving = run_stroke(trial, apparatus_file)
    metrics = frozenset({Metric.IMAGE, Metric.FORCE})
    resting = OfflineEvaluator(scene, NodeCalibrations.of(plan)).evaluate(apparatus, metrics)
    figures = _join_figures(moving, resting.figures())
    return {
        "seed": trial["seed"],
        **figures,
        "out_of_tolerance": exceeded_tolerances(scene, figures),
        "flagged": moving["flagged"],
        "valid_ratio": moving["valid_ratio"],
        "latency_ms": moving["latency_ms"],
        "drops": moving["drops"],
        "bag": moving["bag"],
    }


def _join_figures(moving: Row, resting: Mapping[str, float | None]) -> Row:
    return {
        "sheet_mm": moving["true_delta_d_mm"]["mean"],
        "sheet_deg": moving["true_delta_theta_deg"]["mean"],
        "image_mm": resting[Metric.IMAGE],
        "force_percent": resting[Metric.FORCE],
        "fingertip_mm": moving["fingertip_mm"]["mean"],
    }


def _run_commissioned_trial(trial: Mapping[str, Any]) -> Row:
    """Commission (calibrate and verify) a simulated laboratory; return the errors of its display.

    The verification runs in simulated time, without a graph. Its result also contains the predicted
    errors, and whether the laboratory's own report rates the result as good.
    """
    from flexsheet.launch.commands.commission import summarize
    from flexsheet.launch.commands.commission_steps import open_laboratory

    os.setpriority(os.PRIO_PROCESS, 0, max(os.getpriority(os.PRIO_PROCESS, 0), NICENESS))
    folder, base = Path(trial["commission_folder"]), Path(trial["launch_file"])
    plan = load_graph(base, settings=trial["settings"])
    assert plan.scene_file is not None
    lab, devices = open_laboratory(
        folder,
        base,
        Path(plan.scene_file),
        trial["apparatus"],
        seconds=float(trial["seconds"]),
        seed=int(trial["seed"]),
        simulated_time=True,
    )
    for name in lab.pending():
        _tell(f"step {name}")
        lab.run(name, devices.steps[name])
    result = summarize(lab)
    found = result["verification"]
    figures = _join_figures(found["stroke"], found["at_rest"]["after"])
    keys = ("name", "seconds", "cpu_seconds", "residual", "unit", "within_limit")
    steps = [{key: one[key] for key in keys} for one in result["steps"]]
    return {
        "seed": trial["seed"],
        **figures,
        "out_of_tolerance": exceeded_tolerances(load_scene(lab.scene_copy), figures),
        "flagged": found["flagged"],
        "at_rest": found["at_rest"]["after"],
        "at_working_speed": found["at_working_speed"],
        "measured_delta_d_mm": found["stroke"]["delta_d_mm"]["mean"],
        "predicted": found["predicted"],
        "doubts": found["doubts"],
        "commission": {
            "steps": steps,
            "cpu_seconds": sum(one["cpu_seconds"] for one in steps),
            "above_limit": [one["name"] for one in steps if not one["within_limit"]],
        },
    }


def run_sensitivity_trial(trial: Mapping[str, Any]) -> Row:
    """Return how much given deviations of one hardware parameter change the display errors.

    No graph is run. If the trial has `stroke_seeds`, the errors are measured during strokes of the
    finger in simulated time. Otherwise, they are computed by `OfflineEvaluator`.
    """
    plan = load_graph(Path(trial["launch_file"]), settings=trial["settings"])
    scene, calibrations = require_scene(plan), NodeCalibrations.of(plan)
    apparatuses = {
        f"{sigma:g}": deviate_apparatus(
            scene,
            trial["parameter"],
            sigma,
            profile=Profile(trial["profile"]),
            calibrated=trial["calibrated"],
        )
        for sigma in trial["sigmas"]
    }
    effects: dict[str, Any]
    if trial["stroke_seeds"]:

        def mean_errors(apparatus: Apparatus) -> dict[Metric, float]:
            return _mean_stroke_errors(scene, apparatus, calibrations, trial)

        before = mean_errors(nominal_apparatus(scene))
        effects = {
            key: {metric: value - before[metric] for metric, value in mean_errors(one).items()}
            for key, one in apparatuses.items()
        }
    else:
        evaluator = OfflineEvaluator(scene, calibrations)
        metrics = frozenset(Metric(name) for name in trial["metrics"])
        speed_m_per_s = scene.working_range.speed_m_per_s
        nominal = evaluator.evaluate(nominal_apparatus(scene), metrics, speed_m_per_s)
        effects = {
            key: evaluator.evaluate(one, metrics, speed_m_per_s).change_from(nominal)
            for key, one in apparatuses.items()
        }
    return {"parameter": trial["parameter"], "effects": effects}


def _mean_stroke_errors(
    scene: Scene, apparatus: Apparatus, calibrations: NodeCalibrations, trial: Mapping[str, Any]
) -> dict[Metric, float]:
    """Return mean errors (mm) of sheet and fingertip over finger strokes in simulated time."""
    strokes = [
        stroke_in_simulated_time(
            scene,
            apparatus,
            LoopSettings(
                seed=seed, calibrations=calibrations, with_images=bool(trial["with_images"])
            ),
            float(trial["seconds"]),
        )
        for seed in trial["stroke_seeds"]
    ]
    return {
        metric: sum(one[key]["mean"] for one in strokes) / len(strokes)
        for metric, key in ((Metric.SHEET, "true_delta_d_mm"), (Metric.FINGERTIP, "fingertip_mm"))
    }


def run_system_trial(trial: Mapping[str, Any]) -> Row:
    """Run one configuration of the graph, and return its processor use and latencies."""
    launch_file = Path(trial["launch_file"])
    settings = [*choose_ports(launch_file), *trial["settings"]]
    with _bag_of(trial) as bag:
        return run_system(launch_file, settings, bag, float(trial["seconds"]), _tell)


def run_system_errors_trial(trial: Mapping[str, Any]) -> Row:
    """Compute the errors of several configurations with the same simulated hardware parameters."""
    plan = load_graph(Path(trial["launch_file"]), apparatus=trial["apparatus"])
    scene = require_scene(plan)
    apparatus = plan.apparatus_message() or nominal_apparatus(scene)
    evaluator = ErrorEvaluator(
        scene, apparatus, NodeCalibrations.of(plan), float(trial["seconds"]), int(trial["seed"])
    )
    return {
        name: evaluator.evaluate(Methods.model_validate(one["methods"]), one["planner"])
        for name, one in trial["configurations"].items()
    }


KINDS: dict[str, Callable[[Mapping[str, Any]], Row]] = {
    "robustness": run_robustness_trial,
    "sensitivity": run_sensitivity_trial,
    "system": run_system_trial,
    "system errors": run_system_errors_trial,
}


def main() -> int:
    """Read a trial from stdin, run it, and print its result row as the last line of stdout.

    Returns the exit code.
    """
    logs_on_stderr()
    trial = json.load(sys.stdin)
    try:
        row = KINDS[trial["kind"]](trial)
    except FlexsheetError as error:
        _tell(f"{error}")
        return 1
    print(json.dumps(replace_non_finite(row), allow_nan=False), flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
