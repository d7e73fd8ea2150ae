"""Interrupts of the whole graph and of the demo, at any moment; beside other tests."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from flexsheet.launch.experiments.run import DEMO_FILE
from tests.test_graph import free_ports, on_ports, processes_of_run
from tests.waiting import DEADLINE_S

pytestmark = pytest.mark.timeout(600)


@pytest.fixture
def runs_folder() -> Iterator[Path]:
    """A folder for runs with a path so short that sockets fit whatever the user's name is."""
    with tempfile.TemporaryDirectory(prefix="fs", dir="/tmp") as folder:
        yield Path(folder)


def start(runs: Path, *arguments: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "flexsheet", *arguments],
        cwd=runs,
        env={**os.environ, "FLEXSHEET_RUNS": str(runs)},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )


def read_until(process: subprocess.Popen[str], words: str) -> None:
    """Read its words on stderr until `words` come; the test's own limit is the deadline."""
    assert process.stderr is not None
    for line in process.stderr:
        if words in line:
            return
    raise AssertionError(f'it ended without saying "{words}"')


def end(process: subprocess.Popen[str], number: int) -> tuple[int, str]:
    process.send_signal(number)
    assert process.stderr is not None
    rest = process.stderr.read()
    process.stderr.close()
    return process.wait(timeout=DEADLINE_S), rest


def assert_nothing_is_left(runs: Path) -> None:
    folders = [entry for entry in runs.iterdir() if "." in entry.name and entry.is_dir()]
    assert folders
    for folder in folders:
        assert processes_of_run(folder.name) == []
        assert not [entry for entry in folder.iterdir() if entry.is_socket()]


@pytest.mark.parametrize(
    "words",
    [
        "run ",
        *(
            pytest.param(words, marks=pytest.mark.long)
            for words in ("is ready", "all 10 nodes are ready")
        ),
    ],
)
def test_ctrl_c_at_any_moment_leaves_nothing(runs_folder: Path, words: str) -> None:
    """SIGINT as the first process starts, in the middle of start-up, and when all are up."""
    settings = [part for setting in on_ports(free_ports()) for part in ("--set", setting)]
    launcher = start(runs_folder, "launch", str(DEMO_FILE), *settings)
    read_until(launcher, words)
    code, rest = end(launcher, signal.SIGINT)
    assert code == 0, rest
    assert_nothing_is_left(runs_folder)


@pytest.mark.parametrize(
    ("number", "words"),
    [
        (signal.SIGINT, "starting the nodes"),
        *(
            pytest.param(number, "waiting for the soft body", marks=pytest.mark.long)
            for number in (signal.SIGINT, signal.SIGTERM)
        ),
    ],
)
def test_an_interrupted_demo_leaves_nothing(runs_folder: Path, number: int, words: str) -> None:
    settings = [part for setting in on_ports(free_ports()) for part in ("--set", setting)]
    settings += ["--set", "fem_solver.method=linear"]
    # Shapes of the sheet are computed before the nodes start, which takes a minute.
    settings += ["--set", "renderer.sheet_shape=four_triangles"]
    demo = start(runs_folder, "demo", "--output", str(runs_folder / "demo"), *settings)
    read_until(demo, words)
    code, rest = end(demo, number)
    assert code == 1, rest
    assert "interrupted" in rest
    assert "Traceback" not in rest
    assert_nothing_is_left(runs_folder)
