"""Run one trial of a sweep: read its description as JSON from stdin, and print its result row.

Run this module as `python -m flexsheet.launch.experiments.trial`.
"""

from __future__ import annotations

import json
import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from flexsheet.launch.commands.output import logs_on_stderr
from flexsheet.launch.experiments import stroke
from flexsheet.launch.experiments.driver import Driver
from flexsheet.launch.experiments.node_calibrations import NodeCalibrations
from flexsheet.launch.experiments.offline import Metric, OfflineEvaluator, exceeded_tolerances
from flexsheet.launch.experiments.ports import choose_ports
from flexsheet.launch.experiments.run import (
    make_path_procedure,
    require_scene,
    run_experiment,
)
from flexsheet.launch.experiments.simulated_time import LoopSettings, stroke_in_simulated_time
from flexsheet.launch.experiments.system_errors import (
    APPROACH_S,
    STROKE,
    ErrorEvaluator,
    make_stroke,
)
from flexsheet.launch.methods.results import replace_non_finite
from flexsheet.launch.plans.plan import load_graph, load_scene
from flexsheet.messages.apparatus import Apparatus, nominal_apparatus
from flexsheet.messages.bag import BagReader
from flexsheet.messages.errors import FlexsheetError
from flexsheet.messages.methods import Methods
from flexsheet.messages.scene import Scene, require_cylinder
from flexsheet.messages.types import Frame, Status, SuspectedCause, TwinFinger
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.twin.tolerance_table import Profile, deviate_apparatus
from flexsheet.nodes.twin.truth import find_display_delay_s

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
        procedure = make_path_procedure(partial(stroke.stroke_path, seconds=seconds), _tell)
        run_experiment(
            launch_file,
            settings,
            bag,
            procedure,
            _tell,
            apparatus=apparatus,
            check_scene=require_cylinder,
        )
        result = stroke.evaluate_stroke(bag, seconds)
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
    from flexsheet.launch.calibration.commission import summarize
    from flexsheet.launch.calibration.commission_steps import open_laboratory

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


def read_cpu_s(pids: Mapping[str, int]) -> dict[str, float]:
    """Return the processor time (s) of each process, including its ended child processes.

    Nodes that share a process have one entry. Its key contains their names, joined by "+".

    pids: process id of each node.
    """
    names: dict[int, list[str]] = {}
    for name, pid in pids.items():
        names.setdefault(pid, []).append(name)
    used: dict[str, float] = {}
    for pid, together in names.items():
        try:
            times = psutil.Process(pid).cpu_times()
        except psutil.NoSuchProcess:
            continue
        total = times.user + times.system + times.children_user + times.children_system
        used["+".join(sorted(together))] = total
    return used


def run_system_trial(trial: Mapping[str, Any]) -> Row:
    """Run a configuration of the graph during a stroke; return processor use and latencies (ms).

    A latency is None if the graph does not have the corresponding output.
    """
    launch_file, seconds = Path(trial["launch_file"]), float(trial["seconds"])
    settings = [*choose_ports(launch_file), *trial["settings"]]
    cores: dict[str, float] = {}

    async def procedure(driver: Driver, scene: Scene) -> None:
        _tell(f"stroke for {seconds:g} s")
        before, start_s = read_cpu_s(driver.pids()), time.monotonic()
        await driver.follow(make_stroke(scene, seconds))
        after, passed_s = read_cpu_s(driver.pids()), time.monotonic() - start_s
        for name in before.keys() & after.keys():
            cores[name] = (after[name] - before[name]) / passed_s

    with _bag_of(trial) as bag:
        run_experiment(launch_file, settings, bag, procedure, _tell)
        to_arm_s, to_light_s = read_delays_s(bag)
    return {
        "cpu_cores": sum(cores.values()),
        "cpu_cores_by_node": dict(sorted(cores.items())),
        "exposure_to_arm_ms": stroke.percentiles_ms(to_arm_s) if len(to_arm_s) else None,
        "exposure_to_light_ms": stroke.percentiles_ms(to_light_s) if len(to_light_s) else None,
    }


def read_delays_s(bag: Path) -> tuple[Floats, Floats]:
    """Return the delays (s) from exposures to arm commands, and from exposures to displayed images.

    Only exposures during the stroke are used. If an exposure causes several commands of the same
    arm or several images, only the first is used. The display times are corrected by the true
    latency of the projector.
    """
    window_ns = 0, 0
    for _, message, header, _ in BagReader(bag, topics=["twin/finger"]):
        if isinstance(message, TwinFinger) and message.path_label == STROKE:
            zero_ns = header.source_ns - round(1e9 * message.path_time_s)
            window_ns = zero_ns + round(1e9 * APPROACH_S), header.source_ns
    to_arm: dict[tuple[str, int], float] = {}
    to_light: dict[int, float] = {}
    apparatus: Apparatus | None = None
    frame: Frame | None = None
    for _, message, header, _ in BagReader(
        bag, topics=("twin/apparatus", "arm_left", "arm_right", "frame")
    ):
        if isinstance(message, Apparatus):
            apparatus = message
        elif isinstance(message, Frame):
            frame = message
        for event, exposure_ns, at_ns in stroke.list_events(message, header):
            if window_ns[0] <= exposure_ns <= window_ns[1]:
                delay_s = 1e-9 * (at_ns - exposure_ns)
                if event is stroke.LatencyEvent.LIGHT:
                    to_light.setdefault(exposure_ns, delay_s)
                elif event in stroke.ARM_EVENTS.values():
                    to_arm.setdefault((event, exposure_ns), delay_s)
    return np.array(list(to_arm.values())), (
        np.array(list(to_light.values())) + find_display_delay_s(frame, apparatus)
    )


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
