"""Measure how errors, latency and safety of the whole system depend on load, and draw charts.

python -m benchmarks.load --output FOLDER [--factor NAME ...] [--seconds 20] [--quick] [--json]

Each factor is varied alone; the others keep the demo's values. Factors are: busy processes, camera
rate, speed of the finger, stiffness of the object, stretch of the sheet, and delay, jitter and loss
on the cables of the arms. Network factors need root: three computers are simulated by network
namespaces, without soft body and image (`tests/lab.py`). The other factors run `launch/demo.yaml`
with the linear soft body. A level that has a result in the folder is not measured again, so an
interrupted measurement continues.

Each row has the worst state that occurred: within_tolerance, out_of_tolerance, holds (an arm held
its position), stops (an arm stopped), failed (no result). `violations` lists limits that were
exceeded: the joints' speed and range, and the length of the sheet. The exit code is 1 if there is a
violation or a failed level.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import signal
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from ruamel.yaml import YAML

from benchmarks.soak import start_busy_process
from flexsheet.launch.commands.output import print_rows
from flexsheet.launch.experiments import (
    ArmsNotReadyError,
    ExperimentError,
    ExperimentInterruptedError,
)
from flexsheet.launch.experiments.driver import Driver
from flexsheet.launch.experiments.ports import choose_ports
from flexsheet.launch.experiments.run import DEMO_FILE, run_experiment
from flexsheet.launch.experiments.stroke import (
    make_motion,
    percentiles_ms,
    read_recording,
    summarize_sizes,
)
from flexsheet.launch.experiments.sweep import open_sweep, read_rows
from flexsheet.launch.experiments.system_errors import (
    APPROACH_S,
    STROKE,
    make_stroke,
    split_sheet_error,
)
from flexsheet.launch.experiments.trial import read_delays_s
from flexsheet.launch.methods.results import describe_load, machine_name, replace_non_finite
from flexsheet.launch.methods.svg import COLOURS, page_style, save_svg
from flexsheet.launch.methods.system_chart import write_launch_file
from flexsheet.launch.plans.plan import load_scene
from flexsheet.messages.bag import BagReader
from flexsheet.messages.files import write_file
from flexsheet.messages.scene import Scene
from flexsheet.messages.types import ArmState, SheetTarget
from tests.lab_bags import Arm, Span, bags, measure_hold, read_arm, wanted

SCENE_FILE = DEMO_FILE.parent / "scenes" / "cylinder.yaml"
SETTINGS = ("fem_solver.method=linear",)
MAX_EXCESS_RATIO = 0.07
"""Excess of the sheet's length over its maximum, above which the limit counts as violated."""

ARMS = ("left", "right")
RECOVERY_S = 60.0
MEASURED: dict[str, tuple[str, Callable[[Scene], float]]] = {
    "sheet_mm.p95": ("sheet", lambda scene: 1e3 * scene.tolerances.sheet_position_m),
    "hold_mm.p95": ("sheet to its target", lambda scene: 1e3 * scene.tolerances.sheet_position_m),
    "exposure_to_arm_ms.p95": ("exposure to arm", lambda scene: 1e3 * scene.tolerances.latency_s),
}
"""The label and the tolerance of each evaluated value, by the key of the value in a row."""


class State(StrEnum):
    """The worst state that occurred at a level. The members are ordered from best to worst."""

    WITHIN = "within_tolerance"
    OUT = "out_of_tolerance"
    HOLDS = "holds"
    STOPS = "stops"
    FAILED = "failed"


MARKERS = {State.WITHIN: "o", State.OUT: "s", State.HOLDS: "^", State.STOPS: "X"}


@dataclass(frozen=True, slots=True)
class Factor:
    """A quantity that is varied.

    levels: values, in `unit`.
    key: path of the value in the scene file, or None if the scene does not contain the value.
    on_cables: whether the quantity is a property of the network cables of the arms.
    """

    unit: str
    levels: tuple[float, ...]
    key: tuple[str, ...] | None = None
    on_cables: bool = False


FACTORS = {
    "busy": Factor("processes", (0, 1, 2, 4, 8)),
    "camera": Factor("Hz", (15, 30, 60, 90, 120), ("camera", "rate_hz")),
    "speed": Factor("m/s", (0.035, 0.1, 0.2, 0.4, 0.7, 1.0)),
    "stiffness": Factor(
        "Pa", (1e3, 4e3, 16e3, 64e3, 256e3), ("object", "material", "young_modulus_pa")
    ),
    "stretch": Factor("ratio", (1.02, 1.05, 1.08), ("sheet", "max_stretch_ratio")),
    "delay": Factor("ms", (0, 5, 10, 20, 40, 80), on_cables=True),
    "jitter": Factor("ms", (0, 5, 10, 20), on_cables=True),
    "loss": Factor("%", (0, 1, 2, 5, 10, 20), on_cables=True),
}
JITTER_DELAY_S = 0.02
"""The delay of the cables while the jitter is varied, in seconds."""


def make_cable(factor: str, level: float) -> dict[str, float]:
    """Return the simulated properties of the arms' cables for a value of a network factor."""
    match factor:
        case "delay":
            return {"delay_s": 1e-3 * level}
        case "jitter":
            return {"delay_s": JITTER_DELAY_S, "jitter_s": 1e-3 * level}
        case _:
            return {"loss": 0.01 * level}


def write_scene(name: str, level: float, target: Path) -> Path:
    """Write the demo's scene with a value of a factor.

    The factor "stretch" sets the minimum and the maximum stretch to the same value.
    """
    yaml = YAML()
    values = yaml.load(SCENE_FILE.read_text())
    key = FACTORS[name].key
    if key is not None:
        entry = values
        for part in key[:-1]:
            entry = entry[part]
        entry[key[-1]] = level
    if name == "stretch":
        values["sheet"]["min_stretch_ratio"] = level
    with target.open("w") as output:
        yaml.dump(values, output)
    return target


def evaluate_stroke(bag: Path) -> dict[str, Any]:
    """Compute latencies, errors and lost messages of the finger stroke that a bag contains.

    Latencies have quantiles p50, p95 and p99. Errors of sheet and fingertip have mean, p95 and max.
    """
    recording = read_recording(bag)
    begin_ns, end_ns = recording.windows_ns[STROKE]
    begin_ns += round(1e9 * APPROACH_S)
    exposures = recording.finger.times_ns
    inside = (exposures >= begin_ns) & (exposures <= end_ns)
    for motion in (recording.fingertip, *recording.measured_edges, *recording.true_edges):
        inside &= motion.covers(exposures)
    times = exposures[inside]
    rows = [
        (message.valid_at_ns, np.array([message.normal_offset_m]))
        for _, message, _, _ in BagReader(bag, topics=["sheet_target"])
        if isinstance(message, SheetTarget)
    ]
    offsets_m = make_motion(rows, "sheet_target").interpolate(times)
    errors = split_sheet_error(recording, offsets_m, times)
    off_m = recording.fingertip.interpolate(times) - recording.finger.interpolate(times)
    to_arm_s, to_light_s = read_delays_s(bag)
    return {
        "exposure_to_arm_ms": percentiles_ms(to_arm_s),
        "exposure_to_light_ms": percentiles_ms(to_light_s),
        "sheet_mm": summarize_sizes(1e3 * np.linalg.norm(errors.sum(axis=0), axis=1)),
        "fingertip_mm": summarize_sizes(1e3 * np.linalg.norm(off_m, axis=1)),
        "drops": recording.drops,
    }


def run_level(name: str, level: float, seconds: float, folder: Path) -> dict[str, Any]:
    """Run and evaluate the demo with a value of a factor that is not on the network."""
    scene_file = write_scene(name, level, folder / "scene.yaml")
    launch_file = write_launch_file(DEMO_FILE, scene_file, folder / "launch.yaml")
    bag = folder / "main.mcap"

    async def procedure(driver: Driver, scene: Scene) -> None:
        if name == "speed":
            moved = scene.working_range.model_copy(update={"speed_m_per_s": level})
            scene = scene.model_copy(update={"working_range": moved})
        others = [start_busy_process() for _ in range(int(level) if name == "busy" else 0)]
        try:
            await driver.follow(make_stroke(scene, seconds))
        finally:
            for one in others:
                one.kill()
                one.wait()

    settings = [*choose_ports(launch_file), *SETTINGS]
    run_experiment(launch_file, settings, bag, procedure, partial(print, file=sys.stderr))
    scene = load_scene(scene_file)
    begin_ns, end_ns = read_recording(bag).windows_ns[STROKE]
    begin_ns += round(1e9 * APPROACH_S)
    arms = [read_arm(folder, side, scene, host="main", truth="twin/arms") for side in ARMS]
    return {
        **evaluate_stroke(bag),
        **evaluate_arms(folder, arms, scene, (begin_ns, end_ns), host="main"),
    }


async def run_network_level(name: str, level: float, seconds: float) -> dict[str, Any]:
    """Run three simulated computers with disturbed arm cables, and evaluate the disturbed time."""
    from tests.lab import Lab

    async with Lab() as lab:
        await lab.start_all()
        lab.stroke()
        await lab.until(
            lambda: lab.modes() == {"follow"} and lab.strokes(), "both arms to follow a stroke"
        )
        for side in ARMS:
            await lab.cable(side, **make_cable(name, level))
        loop_time = asyncio.get_running_loop().time
        begin_s = loop_time()
        await asyncio.sleep(seconds)
        end_s = loop_time()
        for side in ARMS:
            await lab.cable(side)
        try:
            await lab.until(
                lambda: lab.modes() == {"follow"}, "both arms to follow", within_s=RECOVERY_S
            )
            recovered_s: float | None = loop_time() - end_s
        except AssertionError:
            recovered_s = None
        for process in lab.launchers.values():
            process.send_signal(signal.SIGINT)
        for process in lab.launchers.values():
            await asyncio.to_thread(process.wait, 40)
        scene = lab.plan().scene_message()
        assert scene is not None
        arms = [read_arm(lab.folder, side, scene) for side in ARMS]
        span = round(1e9 * begin_s), round(1e9 * end_s)
        row = evaluate_arms(lab.folder, arms, scene, span)
    return {**row, "recovered_s": recovered_s}


def evaluate_arms(
    folder: Path, arms: Sequence[Arm], scene: Scene, span: Span, *, host: str | None = None
) -> dict[str, Any]:
    """Compute the sheet's error to its target, the arms' modes and violated limits in a time span.

    host: host with the bags that contain the states of both arms; None: the host of each arm.
    """
    left, right = arms
    hold = measure_hold((left, right), wanted(folder), span)
    lengths_m = [0.0]
    modes: dict[str, float] = {}
    for side, arm in zip(ARMS, arms, strict=True):
        inside = arm.modes[(arm.said_ns >= span[0]) & (arm.said_ns <= span[1])]
        for mode in np.unique(inside):
            share = float(np.mean(inside == mode))
            modes[str(mode)] = max(modes.get(str(mode), 0.0), share)
        for bag in bags(folder, host or side):
            for _, message, _, _ in BagReader(bag, topics=[f"arm_{side}"]):
                if isinstance(message, ArmState):
                    lengths_m.append(message.edge_distance_m or 0.0)
    speed = max(arm.fastest() for arm in arms)
    limit_m = scene.sheet.width_m * (scene.sheet.max_stretch_ratio + MAX_EXCESS_RATIO)
    violations = {
        "joint speed": speed > 1.0,
        "joint range": any(arm.leaves_range() for arm in arms),
        "sheet length": max(lengths_m) > limit_m,
    }
    return {
        "hold_mm": {"p50": hold.quantile_mm(0.5), "p95": hold.quantile_mm(0.95)},
        "followed": hold.followed,
        "modes": modes,
        "joint_speed_ratio": speed,
        "sheet_length_mm": 1e3 * max(lengths_m),
        "violations": [name for name, violated in violations.items() if violated],
    }


def read_value(row: Mapping[str, Any], key: str) -> float | None:
    """Return the value at a key such as "sheet_mm.p95", or None without such a value."""
    outer, _, inner = key.partition(".")
    found = row.get(outer)
    value = found.get(inner) if isinstance(found, dict) else None
    return None if value is None else float(value)


def find_state(row: Mapping[str, Any], scene: Scene) -> State:
    """Return the state of a level, from the arms' modes and the ratios of errors to tolerances."""
    if "error" in row:
        return State.HOLDS if "followed" in row else State.FAILED
    if row["modes"].keys() - {"follow", "hold"}:
        return State.STOPS
    if "hold" in row["modes"]:
        return State.HOLDS
    ratios = list_ratios(row, scene).values()
    return State.OUT if any(one > 1.0 for one in ratios) else State.WITHIN


def list_ratios(row: Mapping[str, Any], scene: Scene) -> dict[str, float]:
    """Return the ratio of each measured value to its tolerance, by the label of the value."""
    found = {
        label: (read_value(row, key), limit(scene)) for key, (label, limit) in MEASURED.items()
    }
    return {label: value / limit for label, (value, limit) in found.items() if value is not None}


def measure_factor(
    name: str,
    levels: Sequence[float],
    seconds: float,
    folder: Path,
    run: Callable[[str, float, float], dict[str, Any]],
) -> list[dict[str, Any]]:
    """Return the rows of all levels of a factor. Levels with a result in the folder are not run."""
    own = folder / name
    open_sweep(own, {"factor": name, "seconds": seconds})
    names = {f"level-{level:g}": level for level in levels}
    rows = read_rows(own, names)
    for row_name, level in names.items():
        if row_name not in rows:
            print(f"{name} {level:g} {FACTORS[name].unit}", file=sys.stderr, flush=True)
            try:
                rows[row_name] = run(name, level, seconds)
            except ExperimentInterruptedError:
                raise
            except ArmsNotReadyError as error:
                rows[row_name] = {"error": str(error)[:600], "followed": 0.0}
            except (ExperimentError, AssertionError) as error:
                rows[row_name] = {"error": str(error)[:600]}
            text = json.dumps(replace_non_finite(rows[row_name]), indent=1)
            write_file(own / f"{row_name}.json", text + "\n")
    scene = load_scene(SCENE_FILE)
    return [
        {
            "factor": name,
            "level": level,
            "unit": FACTORS[name].unit,
            "state": find_state(rows[row_name], scene).value,
            "tolerance_ratios": list_ratios(rows[row_name], scene),
            **rows[row_name],
        }
        for row_name, level in names.items()
    ]


def run_one(name: str, level: float, seconds: float) -> dict[str, Any]:
    """Run one level of any factor in a temporary folder."""
    if FACTORS[name].on_cables:
        return asyncio.run(run_network_level(name, level, seconds))
    with tempfile.TemporaryDirectory(prefix="flexsheet-load-") as folder:
        return run_level(name, level, seconds, Path(folder))


def draw_rows(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Draw the ratios of errors and latency to the tolerances. Markers show the states."""
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    names = list(dict.fromkeys(row["factor"] for row in rows))
    labels = [label for label, _ in MEASURED.values()]
    with page_style():
        columns = min(len(names), 4)
        lines = -(-len(names) // columns)
        figure = Figure(figsize=(3.2 * columns, 2.8 * lines + 0.8), layout="constrained")
        grid = figure.subplots(lines, columns, squeeze=False).ravel()
        for axes, name in zip(grid, names, strict=False):
            own = [row for row in rows if row["factor"] == name]
            for colour, label in zip(COLOURS, labels, strict=False):
                points = [
                    (row["level"], row["tolerance_ratios"][label], row)
                    for row in own
                    if label in row["tolerance_ratios"]
                ]
                axes.plot([one[0] for one in points], [one[1] for one in points], color=colour)
                for level, ratio, row in points:
                    edge = "red" if row["violations"] else colour
                    marker = MARKERS[State(row["state"])]
                    axes.plot(level, ratio, marker, color=colour, markeredgecolor=edge)
            axes.axhline(1.0, linestyle=":", color="0.5")
            axes.set(xlabel=f"{name}, {own[0]['unit']}", yscale="log")
        for axes in grid[len(names) :]:
            axes.set_visible(False)
        figure.supylabel("95 % value over its tolerance")
        figure.legend(
            handles=[
                *(
                    Line2D([], [], color=colour, label=label)
                    for colour, label in zip(COLOURS, labels, strict=False)
                ),
                *(
                    Line2D([], [], linestyle="", marker=marker, color="0.5", label=state.value)
                    for state, marker in MARKERS.items()
                ),
            ],
            loc="outside lower center",
            ncols=4,
        )
        save_svg(figure, path)


def render(path: Path) -> str:
    """Return the levels of each factor by their state, from a recorded result, in Markdown."""
    record = json.loads(path.read_text(encoding="utf-8"))
    rows = record["results"]["rows"]
    heads = ("factor", *(state.value.replace("_", " ") for state in State), "beyond its tolerance")
    lines = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    for name in dict.fromkeys(row["factor"] for row in rows):
        own = [row for row in rows if row["factor"] == name]
        cells = [
            ", ".join(f"{row['level']:g}" for row in own if row["state"] == state) or "-"
            for state in State
        ]
        beyond = {label for row in own for label, one in row["tolerance_ratios"].items() if one > 1}
        cells.append(", ".join(sorted(beyond)) or "-")
        lines.append(f"| {name}, {own[0]['unit']} | {' | '.join(cells)} |")
    violated = sorted({one for row in rows for one in row.get("violations", ())})
    return "\n".join(
        [
            *lines,
            "",
            f"Violated limits: {', '.join(violated) or 'none'}. {record['machine']}; "
            f"`{record['command']}`.",
            "",
        ]
    )


def select_levels(factor: Factor, *, quick: bool) -> tuple[float, ...]:
    """Return all levels of a factor, or with `quick` the first and the last one."""
    return (factor.levels[0], factor.levels[-1]) if quick else factor.levels


def main() -> int:
    from tests.lab import missing

    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--output", type=Path, required=True, help="folder of all results")
    parser.add_argument("--factor", nargs="+", choices=list(FACTORS), default=list(FACTORS))
    parser.add_argument("--seconds", type=float, default=20.0, help="duration of each level")
    parser.add_argument("--quick", action="store_true", help="only the first and the last level")
    parser.add_argument("--json", action="store_true", help="print the rows as JSON")
    given = parser.parse_args()
    factors = list(given.factor)
    if (why := missing()) and any(FACTORS[name].on_cables for name in factors):
        print(f"the factors of the network are skipped: {why}", file=sys.stderr)
        factors = [name for name in factors if not FACTORS[name].on_cables]
    if busy := describe_load():
        print(busy, file=sys.stderr)
    rows = [
        row
        for name in factors
        for row in measure_factor(
            name,
            select_levels(FACTORS[name], quick=given.quick),
            given.seconds,
            given.output,
            run_one,
        )
    ]
    report = {"machine": machine_name(), "cores": os.cpu_count(), "rows": rows}
    write_file(given.output / "load.json", json.dumps(replace_non_finite(report), indent=1) + "\n")
    draw_rows(rows, given.output / "load.svg")
    if given.json:
        print(json.dumps(replace_non_finite(report), indent=1))
    else:
        shown = ("factor", "level", "unit", "state", "followed", "tolerance_ratios", "violations")
        print_rows([{key: row.get(key) for key in shown} for row in rows], as_json=False)
    bad = any(row.get("violations") or row["state"] == State.FAILED.value for row in rows)
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
