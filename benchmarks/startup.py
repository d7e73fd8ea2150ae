"""Measure the time of commands, from the start of the process to its end, on this machine.

python -m benchmarks.startup [--rounds 15] [--json]

A graph of one node (the finger simulator, 60 Hz) runs meanwhile. All commands run in turn in every
round. Times are also given relative to an empty program of the same Python.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import random
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from rich.console import Console
from rich.table import Table

from flexsheet.launch.methods.results import machine_name
from flexsheet.launch.plans.plan import load_graph
from flexsheet.launch.running.runs import ROOT_VARIABLE
from flexsheet.launch.running.supervisor import RunningGraph

ROOT = Path(__file__).resolve().parent.parent
GRAPH = "scene: {scene}\nnodes:\n  twin_finger: {{type: twin_finger}}\n"
FLOOR = "python -c pass"
COMMANDS = {
    FLOOR: [sys.executable, "-c", "pass"],
    **{
        f"flexsheet {words}": [sys.executable, "-m", "flexsheet", *words.split()]
        for words in ("--help", "topic list", "topic echo twin/finger --once")
    },
}


def seconds(command: list[str]) -> float:
    begun = time.monotonic()
    subprocess.run(command, cwd=ROOT, check=False, stdout=subprocess.DEVNULL,
                   stderr=subprocess.DEVNULL)  # fmt: skip
    return time.monotonic() - begun


async def measure(rounds: int) -> dict[str, list[float]]:
    """Return the times of each command in each round while the graph runs, s."""
    found: dict[str, list[float]] = {name: [] for name in COMMANDS}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "startup.yaml"
        path.write_text(GRAPH.format(scene=ROOT / "launch" / "scenes" / "cylinder.yaml"))
        async with RunningGraph(load_graph(path)) as graph:
            await graph.wait_ready()
            for _ in range(rounds):
                for name in random.sample(list(COMMANDS), len(COMMANDS)):
                    found[name].append(await asyncio.to_thread(seconds, COMMANDS[name]))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        os.environ[ROOT_VARIABLE] = folder  # use no other graph
        found = asyncio.run(measure(options.rounds))
    rows = [
        {
            "command": name,
            "least_s": min(times),
            "median_s": statistics.median(times),
            "ratio": statistics.median(
                one / floor for one, floor in zip(times, found[FLOOR], strict=True)
            ),
        }
        for name, times in found.items()
    ]
    report = {"machine": machine_name(), "load": os.getloadavg()[0], "commands": rows}
    if options.json:
        print(json.dumps(report, indent=1))
        return
    table = Table(title=f"{report['machine']}; load {report['load']:.1f}", title_justify="left")
    for head in ("command", "least, s", "median, s", "median of ratios"):
        table.add_column(head, justify="left" if head == "command" else "right")
    for row in rows:
        table.add_row(
            str(row["command"]), *(f"{row[key]:.2f}" for key in ("least_s", "median_s", "ratio"))
        )
    Console().print(table)


if __name__ == "__main__":
    main()
