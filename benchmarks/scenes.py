"""Measure start-up time, processor time and memory of the graph of each shipped scene.

python -m benchmarks.scenes [--scene NAME ...] [--seconds 20]

Each scene runs with the nodes of `launch/demo.yaml`, rigid-plane with `launch/rigid.yaml`. The
simulated finger moves in circles on the object, while processor time and memory of each process are
measured. The memory is the proportional set size, so that shared libraries count once. For a
machine with other work, a start-up time is also given relative to that of `rigid-plane`, which
starts after each scene.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import psutil
from ruamel.yaml import YAML

from flexsheet.launch.experiments.driver import Driver
from flexsheet.launch.experiments.finger_paths import gesture_path
from flexsheet.launch.experiments.ports import choose_ports
from flexsheet.launch.experiments.run import DEMO_FILE, require_scene
from flexsheet.launch.experiments.trial import read_cpu_s
from flexsheet.launch.methods.results import machine_name
from flexsheet.launch.plans.plan import load_graph
from flexsheet.launch.plans.plan_model import ResolvedGraph
from flexsheet.launch.running.precompute import precompute_graph
from flexsheet.launch.running.supervisor import RunningGraph

SCENES = DEMO_FILE.parent / "scenes"
SMALLEST = "rigid-plane"
LAUNCH_FILES = {SMALLEST: DEMO_FILE.with_name("rigid.yaml")}
GESTURE = "circle"
APPROACH_S = 3.0
POLL_S = 0.01
SOFT_BODY_S = 600.0
"""The maximum time (s) to wait for the first soft body, with precomputation."""


def write_launch_file(folder: Path, scene: str) -> Path:
    """Write the demo's launch file with another scene and absolute paths."""
    yaml = YAML()
    source = LAUNCH_FILES.get(scene, DEMO_FILE)
    values = yaml.load(source)
    values["scene"] = str(SCENES / f"{scene}.yaml")
    given = values["nodes"]["triangulator"]["parameters"]
    given["calibration"] = str(source.parent / given["calibration"])
    path = folder / f"{scene}.yaml"
    yaml.dump(values, path)
    return path


def load_scene_graph(folder: Path, scene: str) -> ResolvedGraph:
    path = write_launch_file(folder, scene)
    return load_graph(path, settings=choose_ports(path))


async def measure_start_s(plan: ResolvedGraph) -> float:
    """Return the time from the start of the graph until all nodes are ready, s."""
    begun_s = time.monotonic()
    async with RunningGraph(plan) as graph:
        await graph.wait_ready()
        return time.monotonic() - begun_s


async def wait_ready(graph: RunningGraph, processes: dict[str, list[str]]) -> dict[str, float]:
    """Wait until all nodes are ready, and return the processor time (s) of each process."""
    used: dict[str, float] = {}
    ready = asyncio.create_task(graph.wait_ready())
    while len(used) < len(processes) and not (ready.done() and ready.exception()):
        for name in processes.keys() - used.keys():
            if all(map(graph.is_ready, processes[name])):
                used |= read_cpu_s({name: graph.pids[processes[name][0]]})
        await asyncio.sleep(POLL_S)
    await ready
    return used


async def measure(plan: ResolvedGraph, seconds: float) -> dict[str, Any]:
    """Return start-up time, and processor time and memory by process during the gesture."""
    scene = require_scene(plan)
    processes = {one.name: [node.name for node in one.nodes] for one in plan.processes_on(None)}
    begun_s = time.monotonic()
    async with RunningGraph(plan) as graph:
        start_cpu_s = await wait_ready(graph, processes)
        start_s = time.monotonic() - begun_s
        pids = {name: graph.pids[nodes[0]] for name, nodes in processes.items()}
        async with Driver(plan, graph.run) as driver:
            if plan.writers.get("soft_body"):
                await driver.wait_for(
                    lambda: driver.newest("soft_body") is not None, "a soft body", SOFT_BODY_S
                )
            await driver.wait_ready()
            driver.move_finger(gesture_path(GESTURE, scene))
            await asyncio.sleep(APPROACH_S)
            measured_s, before = time.monotonic(), read_cpu_s(pids)
            await asyncio.sleep(seconds)
            wall_s, after = time.monotonic() - measured_s, read_cpu_s(pids)
            memory = {
                name: psutil.Process(pid).memory_full_info().pss for name, pid in pids.items()
            }
    return {
        "scene": scene.name,
        "start_s": start_s,
        "processes": [
            {
                "name": name,
                "nodes": nodes,
                "start_cpu_s": start_cpu_s[name],
                "cores": (after[name] - before[name]) / wall_s,
                "memory_mb": 1e-6 * memory[name],
            }
            for name, nodes in processes.items()
        ],
        "omitted": {one.name: one.reason for one in plan.omitted},
    }


def run_scene(scene: str, seconds: float) -> dict[str, Any]:
    """Measure a scene, and then the start-up time of `rigid-plane` for comparison."""
    with tempfile.TemporaryDirectory() as folder:
        plan = load_scene_graph(Path(folder), scene)
        precompute_graph(plan, lambda text: print(text, file=sys.stderr))
        load = os.getloadavg()[0]
        result = asyncio.run(measure(plan, seconds))
        smallest_s = result["start_s"]
        if scene != SMALLEST:
            smallest_s = asyncio.run(measure_start_s(load_scene_graph(Path(folder), SMALLEST)))
    return {
        **result,
        **{
            key: sum(one[key] for one in result["processes"])
            for key in ("start_cpu_s", "cores", "memory_mb")
        },
        "start_ratio": result["start_s"] / smallest_s,
        "load": load,
    }


def format_markdown(rows: list[dict[str, Any]]) -> str:
    """Return a table with one line per scene."""
    lines = [
        "| scene | cores | of which | memory, MB | start, s | over rigid-plane "
        "| processor time of the start, s | not started |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        parts = ", ".join(
            f"{' + '.join(one['nodes'])} {one['cores']:.2f}" for one in row["processes"]
        )
        lines.append(
            f"| {row['scene']} | {row['cores']:.2f} | {parts} | {row['memory_mb']:.0f} "
            f"| {row['start_s']:.1f} | {row['start_ratio']:.1f} | {row['start_cpu_s']:.1f} "
            f"| {', '.join(row['omitted']) or '-'} |"
        )
    return "\n".join(lines)


def render(path: Path) -> str:
    """Return the table of a recorded measurement, with its machine and command, in Markdown."""
    if not path.exists():
        return f"No measurement is recorded in docs/results/{path.name}."
    recorded = json.loads(path.read_text())
    return (
        f"{format_markdown(recorded['results']['scenes'])}\n\n"
        f"{recorded['machine']}, load {recorded['load']:.1f}; `{recorded['command']}`."
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    names = sorted(path.stem for path in SCENES.glob("*.yaml"))
    parser.add_argument("--scene", nargs="+", choices=names, default=names)
    parser.add_argument("--seconds", type=float, default=20.0)
    options = parser.parse_args()
    rows = [run_scene(scene, options.seconds) for scene in options.scene]
    report = {"machine": machine_name(), "seconds": options.seconds, "scenes": rows}
    print(json.dumps(report, indent=1))


if __name__ == "__main__":
    main()
