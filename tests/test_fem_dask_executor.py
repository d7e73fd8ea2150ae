"""Test the computation of a table by the workers of a dask scheduler in real processes."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
import psutil
import pytest

from flexsheet.messages.errors import describe_error
from flexsheet.nodes.cache import CheckpointStore
from flexsheet.nodes.fem_solver.dask_executor import SchedulerError, connect_workers
from flexsheet.nodes.fem_solver.mesh.solid import boundary_faces
from flexsheet.nodes.fem_solver.precompute_table import LostWorkersError, solve_all
from flexsheet.nodes.fem_solver.snapshots import SamplePoint, SnapshotJob, solve_snapshot
from tests.solids import box

ROOT = Path(__file__).resolve().parents[1]


class Lab:
    """A scheduler of `distributed`, with workers that are started one by one."""

    def __init__(self) -> None:
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.address = f"tcp://127.0.0.1:{probe.getsockname()[1]}"
        self._processes: list[subprocess.Popen[str]] = []
        host, port = "127.0.0.1", self.address.rsplit(":", 1)[1]
        self.scheduler = self._start(
            "scheduler", "--host", host, "--port", port, say="Scheduler at"
        )

    def add_worker(self) -> subprocess.Popen[str]:
        return self._start(
            "worker", self.address, "--nthreads", "1", "--no-nanny", say="Registered to"
        )

    def _start(self, command: str, *options: str, say: str) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            [sys.executable, "-m", f"distributed.cli.dask_{command}", *options, "--no-dashboard"],
            cwd=ROOT,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
            stderr=subprocess.PIPE,
            text=True,
        )
        self._processes.append(process)
        assert process.stderr is not None
        lines = process.stderr
        for line in lines:
            if say in line:
                break
        else:
            raise AssertionError(f"the {command} ended with {process.wait()}")
        threading.Thread(target=lines.read, daemon=True).start()
        return process

    def close(self) -> None:
        for process in self._processes:
            process.kill()
            process.wait()
            assert process.stderr is not None
            process.stderr.close()


@pytest.fixture
def lab() -> Iterator[Lab]:
    one = Lab()
    yield one
    one.close()


def job(depth_m: float = 0.0005) -> SnapshotJob:
    """Return a job: a block of 30 x 30 x 20 mm, fixed at its bottom, pushed at the centre of its
    top."""
    nodes, elements = box((4, 4, 2), (0.03, 0.03, 0.02))
    faces = boundary_faces(elements)
    return SnapshotJob(
        nodes=nodes,
        elements=elements,
        fixed=np.isclose(nodes[:, 2], 0.0),
        faces=faces[np.isclose(nodes[faces, 2], 0.02).all(axis=1)],
        sample=SamplePoint(np.array([0.015, 0.015, 0.02]), np.array([0.0, 0.0, 1.0])),
        poisson_ratio=0.45,
        finger_radius_m=0.007,
        depths_m=(depth_m, 2.0 * depth_m),
    )


def test_a_scheduler_without_workers_is_an_error_with_a_remedy(lab: Lab) -> None:
    with (
        pytest.raises(SchedulerError, match=r"dask worker tcp://127\.0\.0\.1"),
        connect_workers(lab.address, connect_s=0.3),
    ):
        pass


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:9", "127.0.0.1", "post://127.0.0.1:8786"])
def test_no_scheduler_is_an_error_with_a_remedy(address: str) -> None:
    with (
        pytest.raises(SchedulerError, match=r"no scheduler answers.*omit --scheduler"),
        connect_workers(address),
    ):
        pass


def test_jobs_of_a_lost_worker_move_to_others_and_a_lost_scheduler_is_reported(
    lab: Lab, tmp_path: Path
) -> None:
    first = lab.add_worker()
    parts = CheckpointStore(tmp_path / "parts")
    jobs = {"first": job(), "second": job(0.001)}
    tasks = {name: partial(solve_snapshot, one) for name, one in jobs.items()}
    with connect_workers(lab.address, connect_s=2.0) as executor:
        # it is given the first push, and never ends it
        psutil.Process(first.pid).suspend()
        counts: list[int] = []

        def lose(count: int) -> None:
            counts.append(count)
            if len(counts) == 2:
                first.send_signal(signal.SIGKILL)
                lab.add_worker()

        answers = solve_all(tasks, executor, parts, lose)
        for name, one in jobs.items():
            answer, here = answers[name], solve_snapshot(one)
            assert np.allclose(answer.moved, here.moved, atol=1e-9)
            assert answer.reached == here.reached == 2

        def leave(count: int) -> None:
            if count == 2:
                lab.scheduler.kill()

        tasks["third"] = partial(solve_snapshot, job(0.002))
        with pytest.raises(LostWorkersError, match="loads the finished snapshots"):
            solve_all(tasks, executor, parts, leave)


def test_the_missing_package_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(ModuleNotFoundError) as caught, connect_workers("tcp://127.0.0.1:9"):
        pass
    assert "flexsheet[cluster]" in describe_error(caught.value)
