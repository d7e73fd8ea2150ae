"""Measure the CPU time of each process of an idle graph, in % of one core.

python -m benchmarks.idle [--seconds 30] [--case waiting standing watching] [--json FILE]

The graph has the nodes of `launch/demo.yaml` without twin_finger and twin_eye. The sum excludes
twin_arms, which simulates the arms' controllers.

waiting: the arms are not enabled; the camera delivers no images.
standing: the arms are enabled and hold their positions, with an exchange in each cycle.
watching: as standing, and the camera delivers 60 pairs per second from files, without a finger.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import socket
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rich.console import Console
from rich.table import Table
from ruamel.yaml import YAML

from flexsheet.launch.experiments.run import DEMO_FILE
from flexsheet.launch.experiments.system_run import read_cpu_s
from flexsheet.launch.methods.results import machine_name
from flexsheet.launch.plans.plan import load_graph
from flexsheet.launch.running.supervisor import RunningGraph

LEFT_OUT = ("twin_finger", "twin_eye")
OUTSIDE = "twin_arms"
LAUNCHER = "launcher"
SETTLING_S = 5.0
IMAGES, RATE_HZ, SIZE_PX = 8, 60.0, (480, 640)


def free_ports(count: int) -> list[int]:
    opened = [socket.socket() for _ in range(count)]
    try:
        for one in opened:
            one.bind(("127.0.0.1", 0))
        return [int(one.getsockname()[1]) for one in opened]
    finally:
        for one in opened:
            one.close()


def camera_without_images(folder: Path) -> dict[str, Any]:
    """Make the camera's entry in the launch file without images."""
    return {"type": "camera", "parameters": {"source": "twin"}, "topics": {"twin__stereo": None}}


def camera_with_background(folder: Path) -> dict[str, Any]:
    """Make the camera's entry with files of a dim, noisy background."""
    random = np.random.default_rng(0)
    for side in ("left", "right"):
        for number in range(IMAGES):
            picture = random.normal(40.0, 2.0, SIZE_PX).astype(np.uint8)
            cv2.imwrite(str(folder / f"{side}{number}.bmp"), picture)
    source = {
        "kind": "images",
        "left": str(folder / "left*.bmp"),
        "right": str(folder / "right*.bmp"),
        "rate_hz": RATE_HZ,
        "loop": True,
    }
    return {
        "type": "camera",
        "parameters": {"source": source},
        "topics": {"twin__stereo": None},
    }


@dataclass(frozen=True)
class Case:
    """A case of the measurement.

    camera: function that returns the camera's entry in the launch file, given a folder for images.
    """

    camera: Callable[[Path], dict[str, Any]]
    arming: str


CASES = {
    "waiting": Case(camera_without_images, "manual"),
    "standing": Case(camera_without_images, "auto"),
    "watching": Case(camera_with_background, "auto"),
}


def launch_file(folder: Path, case: Case) -> Path:
    """Write the demo's launch file without the simulators of finger and eye."""
    yaml = YAML()
    values = yaml.load(DEMO_FILE)
    values["scene"] = str((DEMO_FILE.parent / values["scene"]).resolve())
    nodes = values["nodes"]
    for name in LEFT_OUT:
        del nodes[name]
    nodes["camera"] = case.camera(folder)
    calibration = nodes["triangulator"]["parameters"]["calibration"]
    nodes["triangulator"]["parameters"]["calibration"] = str(DEMO_FILE.parent / calibration)
    ports = dict(zip(("left", "right"), free_ports(2), strict=True))
    nodes[OUTSIDE]["parameters"] = {f"{side}_port": port for side, port in ports.items()}
    for side, port in ports.items():
        nodes[f"arm_{side}_bridge"]["parameters"] |= {"port": port, "arming": case.arming}
    path = folder / "idle.yaml"
    yaml.dump(values, path)
    return path


async def measure(case: str, seconds: float) -> dict[str, Any]:
    """Return the CPU time divided by wall time, per process and in total without the simulators."""
    with tempfile.TemporaryDirectory() as folder:
        plan = load_graph(launch_file(Path(folder), CASES[case]))
        async with RunningGraph(plan) as graph:
            await graph.wait_ready()
            await asyncio.sleep(SETTLING_S)
            pids = {**graph.pids, LAUNCHER: os.getpid()}
            loop = asyncio.get_running_loop()
            begun_s, before = loop.time(), read_cpu_s(pids)
            await asyncio.sleep(seconds)
            wall_s, after = loop.time() - begun_s, read_cpu_s(pids)
    percent = {name: 100.0 * (after[name] - before[name]) / wall_s for name in after}
    return {
        "case": case,
        "percent": percent,
        "sum_percent": sum(share for name, share in percent.items() if name != OUTSIDE),
    }


def print_table(report: dict[str, Any]) -> None:
    table = Table(title="CPU time, % of one core", title_justify="left")
    table.add_column("process")
    for result in report["cases"]:
        table.add_column(result["case"], justify="right")
    for name in report["cases"][0]["percent"]:
        shown = f"{name} (outside)" if name == OUTSIDE else name
        table.add_row(shown, *(f"{result['percent'][name]:.1f}" for result in report["cases"]))
    table.add_section()
    table.add_row("all but outside", *(f"{one['sum_percent']:.1f}" for one in report["cases"]))
    Console(file=sys.stdout).print(table)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--case", nargs="+", choices=list(CASES), default=list(CASES))
    parser.add_argument("--json", type=Path, help="JSON file to write")
    options = parser.parse_args()
    report = {
        "command": f"python -m benchmarks.idle --seconds {options.seconds:g}",
        "machine": machine_name(),
        "load": os.getloadavg()[0],
        "cases": [asyncio.run(measure(case, options.seconds)) for case in options.case],
    }
    if options.json is not None:
        options.json.write_text(json.dumps(report, indent=1) + "\n")
    print_table(report)


if __name__ == "__main__":
    main()
