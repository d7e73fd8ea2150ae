"""Test that nodes start as forks of one process, and without it when it fails."""

from __future__ import annotations

import asyncio
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

from flexsheet.launch.running import fork_server, runs
from flexsheet.launch.running.child import PARENT_VARIABLE
from flexsheet.launch.running.fork_server import FLAG, ForkServer
from flexsheet.launch.running.supervisor import FORK_SERVER, RunningGraph
from tests.test_launch_supervisor import LISTENER, beacon, plan_of, processes_of
from tests.waiting import DEADLINE_S, until, wait_until


@pytest.fixture(autouse=True)
def runs_root(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Create a directory of runs for the test, with a short path."""
    folder = Path(tempfile.mkdtemp(prefix="fs-", dir="/tmp"))
    monkeypatch.setenv(runs.ROOT_VARIABLE, str(folder))
    yield folder
    shutil.rmtree(folder)


def server_of(run_id: str) -> psutil.Process:
    (found,) = (one for one in processes_of(run_id) if FLAG in one.cmdline())
    return found


async def test_forked_node_is_a_process_of_the_launcher(tmp_path: Path) -> None:
    plan = plan_of(tmp_path, beacon=beacon(nice=7), listener=LISTENER)
    async with RunningGraph(plan) as graph:
        await graph.wait_ready(DEADLINE_S)
        server = server_of(graph.run.id)
        for name in ("beacon", "listener"):
            pid = graph.pids[name]
            node = psutil.Process(pid)
            assert node.ppid() == os.getpid()
            assert os.getsid(pid) == os.getpgid(pid) == pid
            assert node.cmdline()[-2:] == ["--node", str(graph.run.directory / f"{name}.json")]
            assert FLAG not in node.cmdline()
            # Of the environment in /proc only the start of the fork server is visible.
            assert node.environ() == server.environ()
            opened = {os.readlink(f"/proc/{pid}/fd/{number}") for number in (1, 2)}
            assert len(opened) == 1
            assert opened.pop().startswith("pipe:")
            assert os.readlink(f"/proc/{pid}/fd/0") == os.devnull
        assert server.num_threads() == 1
        assert server.nice() == os.getpriority(os.PRIO_PROCESS, 0)


async def test_graph_survives_its_fork_server(tmp_path: Path) -> None:
    lines: list[str] = []
    plan = plan_of(tmp_path, beacon=beacon(), listener=LISTENER)
    async with RunningGraph(plan, report=lambda _, line: lines.append(line)) as graph:
        await graph.wait_ready(DEADLINE_S)
        before = graph.pids
        server = server_of(graph.run.id)
        server.kill()
        wait_until(lambda: server.status() == psutil.STATUS_ZOMBIE, "the fork server to end")
        graph.kill("beacon")
        async with asyncio.timeout(DEADLINE_S):
            await graph.wait_ready_again("beacon", 1)
        assert graph.pids["listener"] == before["listener"]
        assert graph.restarts == {"beacon": 1, "listener": 0}
        assert any(f"without {FORK_SERVER}" in line for line in lines)


async def test_suspended_fork_server_delays_a_restart_only_briefly(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fork_server, "ANSWER_S", 0.2)
    async with RunningGraph(plan_of(tmp_path, beacon=beacon())) as graph:
        await graph.wait_ready(DEADLINE_S)
        server = server_of(graph.run.id)
        server.suspend()
        graph.kill("beacon")
        async with asyncio.timeout(DEADLINE_S):
            await graph.wait_ready_again("beacon", 1)
        assert not server.is_running()
        # One process: the fork server has not started a second one.
        assert [one.pid for one in processes_of(graph.run.id)] == [graph.pids["beacon"]]


async def test_processes_of_a_killed_node_are_reaped(tmp_path: Path) -> None:
    plan = plan_of(tmp_path, beacon=beacon(parameters={"with_child": True}))
    async with RunningGraph(plan) as graph:
        await graph.wait_ready(DEADLINE_S)
        (child,) = psutil.Process(graph.pids["beacon"]).children()
        graph.kill("beacon")
        async with asyncio.timeout(DEADLINE_S):
            await graph.wait_ready_again("beacon", 1)
        # A process that was not reaped would remain as a zombie of this process.
        await until(lambda: not child.is_running(), "the child to be reaped")


async def test_fork_server_without_its_launcher_ends(tmp_path: Path) -> None:
    with (tmp_path / "log").open("wb") as log:
        server = ForkServer(
            ["clock"],
            [tmp_path / "node.json"],
            environment={**os.environ, PARENT_VARIABLE: "1"},
            lifeline=log.fileno(),
            log=log,
        )
        assert not await server.is_ready()
        await server.stop()
    assert "the launcher has exited" in (tmp_path / "log").read_text()


async def test_forked_process_reports_its_exit_code(tmp_path: Path) -> None:
    config = tmp_path / "node.json"
    config.write_text("{}")
    read, write = os.pipe()
    with (tmp_path / "log").open("wb") as log:
        server = ForkServer(
            ["clock"],
            [config],
            environment={
                **os.environ,
                "OPENBLAS_NUM_THREADS": "1",
                PARENT_VARIABLE: str(os.getpid()),
                "FLEXSHEET_LIFELINE": str(read),
            },
            lifeline=read,
            log=log,
        )
        assert await server.is_ready()
        process = server.fork(config, os.environ, log.fileno(), write)
        assert process is not None
        # An empty configuration is invalid.
        assert process.wait() == 1
        await server.stop()
        assert server.fork(config, os.environ, log.fileno(), write) is None
    os.close(read)
    os.close(write)
    assert "validation errors for ProcessConfig" in (tmp_path / "log").read_text()
    assert not psutil.pid_exists(process.pid)


def test_module_with_a_thread_is_not_forked(tmp_path: Path) -> None:
    # The check concerns the process as a whole, so it runs in a process of its own.
    code = (
        "import os, socket, threading, time\n"
        "from flexsheet.launch.running import fork_server\n"
        "threading.Thread(target=time.sleep, args=(60,), daemon=True).start()\n"
        "ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)\n"
        "ours.send(b'[]')\n"
        "fork_server.serve(theirs.detach())\n"
    )
    ended = subprocess.run(
        [sys.executable, "-c", code],
        check=False,
        env={**os.environ, PARENT_VARIABLE: str(os.getpid())},
        capture_output=True,
        text=True,
        timeout=DEADLINE_S,
    )
    assert ended.returncode == 1
    assert "has started a thread" in ended.stderr
