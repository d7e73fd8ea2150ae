"""Test the programs of the documentation that need a bag or a running graph."""

from __future__ import annotations

import asyncio
import json
import os
import subprocess
import sys
import tempfile
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import flexsheet
from flexsheet.launch.experiments.ports import choose_ports
from flexsheet.launch.plans.plan import load_scene
from flexsheet.messages.bag import BagWriter
from flexsheet.messages.base import Header
from flexsheet.messages.scene import Scene
from flexsheet.messages.topics import find_topic
from flexsheet.messages.types import SheetTarget
from tests.doc_pages import DOCS, ROOT, blocks
from tests.fingertips import fingertip
from tests.waiting import DEADLINE_S

GUARD_SCRIPT = """
import asyncio
from pathlib import Path
import flexsheet

async def main():
    graph = flexsheet.RunningGraph(flexsheet.load_graph(Path("runs/guard.yaml")))
    async with graph:
        await graph.wait_ready()
        note, checks = "", ()
        async for status, header in flexsheet.read_topic(graph, "status"):
            if header.writer == "guard":
                note = status.notes[0].detail if status.notes else ""
            elif header.writer == "triangulator":
                checks = status.self_checks
            if note and checks:
                print(note)
                print(max(check.value / check.threshold for check in checks))
                return

asyncio.run(main())
"""

MEASUREMENTS_SCRIPT = """
from pathlib import Path

async def run():
    graph = flexsheet.RunningGraph(flexsheet.load_graph(Path("graph.yaml")))
    async with graph:
        await graph.wait_ready()
        program = asyncio.create_task(main())
        async for eye, _ in flexsheet.read_topic(graph, "eye", count=1):
            print(eye.centre_world_m)
        async for force, _ in flexsheet.read_topic(graph, "force", count=1):
            print(force.force_n)
        program.cancel()

asyncio.run(run())
"""

GUARD_DEMO_SCRIPT = """
from pathlib import Path
import flexsheet

graph = flexsheet.load_graph(Path("runs/guard-demo.yaml"))
guard = graph.nodes["guard"]
print(*(port.topic for port in (*guard.inputs, *guard.outputs)), len(graph.nodes) > 5)
"""


def python_block(page: str, mark: str) -> str:
    """Return the only Python block of a page that contains a text."""
    (text,) = (
        block.text
        for block in blocks(DOCS / page)
        if block.language == "python" and mark in block.text
    )
    return text


def run_script(script: str, cwd: Path, *arguments: str) -> str:
    path = f"{cwd / 'runs'}{os.pathsep}{ROOT}"
    with tempfile.TemporaryDirectory(prefix="fs-", dir="/tmp") as runs:
        done = subprocess.run(
            [sys.executable, "-c", script, *arguments],
            cwd=cwd,
            env={**os.environ, "FLEXSHEET_RUNS": runs, "PYTHONPATH": path},
            capture_output=True, text=True, timeout=DEADLINE_S, check=False,
        )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout


def write_stroke(path: Path, count: int) -> None:
    """Write a bag in which the finger moves by 1 mm in x per message."""
    with BagWriter(path) as bag:
        for number in range(count):
            now_ns = 1_000_000_000 + number * 16_000_000
            for topic, message in (
                ("fingertip", fingertip(np.array([number * 1e-3, 0.0, 0.0]))),
                ("sheet_target", sheet_target(now_ns, push_depth_m=number * 5e-4)),
            ):
                header = Header(number, now_ns, now_ns, "host-1", "test", 1)
                bag.write(find_topic(topic), message, header, log_time_ns=now_ns)


def sheet_target(valid_at_ns: int, push_depth_m: float) -> SheetTarget:
    return SheetTarget(
        phase="contact",
        reason="ok",
        valid_at_ns=valid_at_ns,
        world_from_sheet=np.eye(4),
        twist_world=np.zeros(6),
        stretch_ratio=1.05,
        contact_world_m=np.zeros(3),
        normal_world=np.array([0.0, 0.0, 1.0]),
        contact_sheet_m=np.zeros(2),
        push_depth_m=push_depth_m,
    )


def test_the_plot_script_reads_a_bag(tmp_path: Path) -> None:
    write_stroke(tmp_path / "stroke.mcap", count=20)
    run_script(python_block("other-tools.md", "read_arrays"), tmp_path, "stroke.mcap")
    assert (tmp_path / "stroke.png").stat().st_size > 0
    rows = np.loadtxt(tmp_path / "stroke.csv", delimiter=",", skiprows=1)
    assert rows.shape == (20, 4)
    np.testing.assert_allclose(rows[:, 1], np.arange(20) * 1e-3, atol=1e-9)


def test_the_library_script_runs(tmp_path: Path) -> None:
    """The script runs with a graph of one node, which publishes fingertips."""
    script = python_block("library.md", "flexsheet.read_topic")
    (tmp_path / "launch").mkdir()
    (tmp_path / "launch" / "demo.yaml").write_text(
        "nodes: {source: {type: 'tests.launch_nodes:FingertipSource'}}\n"
    )
    assert len(run_script(script, tmp_path).splitlines()) == 30
    assert len([line for line in script.splitlines() if line.strip()]) <= 13


def test_the_script_that_publishes_measurements_runs(tmp_path: Path) -> None:
    """A graph receives the positions of the eyes and the forces that the script publishes."""
    script = python_block("library.md", "flexsheet.GraphWriter").replace("asyncio.run(main())", "")
    (tmp_path / "graph.yaml").write_text(
        "nodes: {source: {type: 'tests.launch_nodes:FingertipSource'}}\n"
    )
    printed = run_script(script + MEASUREMENTS_SCRIPT, tmp_path)
    assert printed.splitlines() == ["[0.  0.1 0.6]", "1.5"]


def test_the_staircase_adapts_the_difference(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A participant who feels differences of at least 20 % gets differences around this value."""
    moduli: list[float] = []

    class Presenter:
        async def change_scene(self, scene: Scene) -> None:
            moduli.append(scene.object.material.young_modulus_pa)

    def answer(question: str) -> str:
        first, second = moduli[-2:] if len(moduli) > 1 else (1.0, 1.0)
        noticed = max(first, second) >= 1.2 * min(first, second)
        return "1" if noticed == (first > second) else "2"

    def run(file: Path, settings: list[str], bag: Path, procedure: Any, progress: Any) -> None:
        asyncio.run(procedure(Presenter(), load_scene(ROOT / "launch/scenes/cylinder.yaml")))

    monkeypatch.setattr(flexsheet, "run_experiment", run)
    monkeypatch.setattr("builtins.input", answer)
    exec(python_block("library.md", "run_experiment"), {})
    increments = [float(line.split(",")[1]) for line in capsys.readouterr().out.splitlines()]
    assert len(increments) == 40
    assert len(moduli) == 80
    assert all(0.15 < one < 0.26 for one in increments[12:])


@pytest.mark.alone
def test_the_script_that_moves_the_finger_runs(tmp_path: Path) -> None:
    (tmp_path / "launch").mkdir()
    launch_file = tmp_path / "launch" / "demo.yaml"
    launch_file.write_text(f"extends: {ROOT / 'launch/demo.yaml'}\n")
    ports: dict[str, dict[str, int]] = defaultdict(dict)
    for setting in choose_ports(launch_file):
        name, _, port = setting.partition("=")
        node, _, key = name.partition(".")
        ports[node][key] = int(port)
    nodes = {node: {"parameters": values} for node, values in ports.items()}
    launch_file.write_text(f"{launch_file.read_text()}nodes: {json.dumps(nodes)}\n")
    printed = run_script(python_block("library.md", "flexsheet.Driver("), tmp_path)
    position_m = [float(one) for one in printed.strip("[]\n ").split()]
    assert position_m == pytest.approx([0.0, 0.0, 0.02], abs=0.003)


def test_the_launch_files_of_the_node_tutorial_run(tmp_path: Path) -> None:
    launch_file, for_demo = (
        block.text
        for block in blocks(DOCS / "write-your-own-node.md")
        if block.language == "yaml" and "guard:" in block.text
    )
    runs = tmp_path / "runs"
    runs.mkdir()
    (runs / "guard.yaml").write_text(launch_file)
    (runs / "guard-demo.yaml").write_text(for_demo)
    (runs / "speed_guard.py").write_text(
        python_block("write-your-own-node.md", "class SpeedGuard(")
        + python_block("write-your-own-node.md", "import asyncio")
    )
    (tmp_path / "launch").symlink_to(ROOT / "launch")
    note, residual = run_script(GUARD_SCRIPT, tmp_path).splitlines()
    assert note.startswith("finger at ")
    assert float(residual) < 0.5, "the triangulator suspects a wrong calibration"
    printed = run_script(GUARD_DEMO_SCRIPT, tmp_path)
    assert printed.split() == ["fingertip", "status", "estop", "True"]
