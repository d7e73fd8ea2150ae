"""Test that SIGINT at any time of a launcher's start leaves nothing."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import tempfile
import time
from functools import partial
from pathlib import Path

import pytest

from flexsheet.launch.running import runs
from tests.test_launch_supervisor import (
    FLEXSHEET,
    LISTENER,
    assert_nothing_left,
    beacon,
    runs_root,
    set_sigint,
    start_command,
    started,
    wait_for_words,
    write,
)
from tests.waiting import DEADLINE_S

__all__ = ["runs_root", "started"]


@pytest.fixture(scope="module")
def start_up_s(tmp_path_factory: pytest.TempPathFactory) -> float:
    """Measure the present time of a launcher from its start until its nodes are ready."""
    folder = Path(tempfile.mkdtemp(prefix="fs-", dir="/tmp"))
    path = write(tmp_path_factory.mktemp("graph"), {"beacon": beacon(), "listener": LISTENER})
    begun_s = time.monotonic()
    process = subprocess.Popen(
        [*FLEXSHEET, "launch", str(path)],
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, runs.ROOT_VARIABLE: str(folder)},
        preexec_fn=partial(set_sigint, signal.SIG_DFL, blocked=False),  # noqa: PLW1509
    )
    try:
        wait_for_words(process, "are ready")
        return time.monotonic() - begun_s
    finally:
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=DEADLINE_S)
        shutil.rmtree(folder)


FRACTIONS = [
    *(pytest.param(0.1 * i, marks=() if i == 5 else pytest.mark.long) for i in range(1, 11)),
    None,
]


@pytest.mark.parametrize("fraction", FRACTIONS)
def test_interrupted_at_any_moment_the_command_leaves_nothing(
    tmp_path: Path,
    runs_root: Path,
    started: list[subprocess.Popen[str]],
    start_up_s: float,
    fraction: float | None,
) -> None:
    """SIGINT comes after a fraction of the start-up, or after it (None).

    SIGINT is blocked until the first statement, which excludes the interpreter's own start.
    """
    path = write(tmp_path, {"beacon": beacon(), "listener": LISTENER})
    process = start_command(started, "launch", str(path), blocked=True)
    if fraction is None:
        wait_for_words(process, "are ready")
    else:
        # The moment of the interrupt is what varies: there is no condition to wait for.
        time.sleep(fraction * start_up_s)
    process.send_signal(signal.SIGINT)
    _, printed = process.communicate(timeout=DEADLINE_S)
    # Before the loop runs there is nothing to stop, and the default action ends the process.
    assert process.returncode in ((0,) if fraction is None else (0, -signal.SIGINT)), printed
    assert "Traceback" not in printed
    assert "Exception ignored" not in printed
    assert_nothing_left(runs_root)
