"""Test `flexsheet arms stop` while other tools use the endpoint, or a process does not respond."""

from __future__ import annotations

import asyncio
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from flexsheet.launch.commands import arms as arms_command
from flexsheet.launch.plans.plan import load_graph
from flexsheet.launch.running import runs, stopping
from flexsheet.launch.running.runs import Run
from flexsheet.launch.running.stopping import (
    KILL_AFTER_S,
    StopAttempt,
    StopOutcome,
    StopPath,
    stop_arms,
)
from flexsheet.messages.notes import Note
from flexsheet.nodes.stop_socket import ANSWER, SUFFIX, StopSocket
from tests.console_parts import status_of
from tests.waiting import DEADLINE_S, wait_until

ROOT = Path(__file__).resolve().parent.parent
FLEXSHEET = [sys.executable, "-m", "flexsheet"]
REASON = "a hand in the sheet"


@pytest.fixture(autouse=True)
def runs_root(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    folder = Path(tempfile.mkdtemp(prefix="fs-", dir="/tmp"))
    monkeypatch.setenv(runs.ROOT_VARIABLE, str(folder))
    yield folder
    shutil.rmtree(folder)


@dataclass
class Graph:
    """Launcher with two substitute bridges."""

    launcher: subprocess.Popen[str]
    run: runs.Run
    hangs: Path

    def log(self) -> str:
        return (self.run.logs / "launch.log").read_text()


@pytest.fixture
def graph(tmp_path: Path) -> Iterator[Graph]:
    hangs = tmp_path / "hangs"
    nodes = {
        side: {
            "type": "tests.launch_nodes:StandInBridge",
            "parameters": {"side": side, "hangs": str(hangs) if side == "left" else None},
            "topics": {"arm": f"arm_{side}"},
            "liveness_s": None,
            "restart": {"delay_s": 0.01},
        }
        for side in ("left", "right")
    }
    (tmp_path / "graph.yaml").write_text(json.dumps({"nodes": nodes}))
    launcher = subprocess.Popen(
        [*FLEXSHEET, "launch", str(tmp_path / "graph.yaml")], stderr=subprocess.PIPE, text=True
    )
    assert launcher.stderr is not None
    try:
        assert any("are ready" in line for line in launcher.stderr)
        yield Graph(launcher, runs.list_live_runs()[0], hangs)
    finally:
        hangs.unlink(missing_ok=True)
        launcher.send_signal(signal.SIGCONT)
        launcher.send_signal(signal.SIGINT)
        launcher.communicate(timeout=DEADLINE_S)


@pytest.fixture
def holder(graph: Graph) -> Iterator[subprocess.Popen[bytes]]:
    """Start a tool that occupies the endpoint of the tools' e-stops and then hangs."""
    code = "import socket, sys, time; s = socket.socket(socket.AF_UNIX); s.bind(sys.argv[1]); "
    code += "s.listen(); print(flush=True); time.sleep(1000)"
    endpoint = graph.run.directory / "tools.estop"
    process = subprocess.Popen([sys.executable, "-c", code, str(endpoint)], stdout=subprocess.PIPE)
    assert process.stdout is not None
    process.stdout.readline()
    process.send_signal(signal.SIGSTOP)
    yield process
    process.kill()
    process.communicate()


def stop_by_command() -> tuple[int, dict[str, Any]]:
    done = subprocess.run(
        [*FLEXSHEET, "arms", "stop", "--reason", REASON, "--json"],
        capture_output=True, text=True, timeout=DEADLINE_S, check=False,
    )  # fmt: skip
    assert "Traceback" not in done.stderr
    return done.returncode, json.loads(done.stdout)


def outcomes(answer: dict[str, Any]) -> set[tuple[str, str, str]]:
    return {(one["path"], one["receiver"], one["outcome"]) for one in answer["paths"]}


@pytest.mark.usefixtures("holder")
def test_a_tool_that_holds_the_endpoint_does_not_hinder_a_stop(graph: Graph) -> None:
    code, answer = stop_by_command()
    assert code == 0
    assert answer["stopped"]
    # Bridges of a busy computer may answer too late; the launcher's word reaches them then.
    assert ("launcher", "launch", "confirmed") in outcomes(answer)
    assert all(one["mode"] == "estop" for one in answer["arms"])
    assert all(REASON in one["faults"][0] for one in answer["arms"])
    assert f"e-stop of tools, latched until it is reset: {REASON}" in graph.log()


@pytest.mark.usefixtures("holder")
def test_a_suspended_launcher_receives_a_stop(graph: Graph) -> None:
    graph.launcher.send_signal(signal.SIGSTOP)
    code, answer = stop_by_command()
    assert code == 0
    assert answer["stopped"]
    wait_until(lambda: "latched until it is reset" in graph.log(), "the launcher to keep the stop")


@pytest.mark.usefixtures("holder")
def test_a_bridge_that_hangs_is_stopped_when_it_resumes(graph: Graph) -> None:
    graph.hangs.touch()
    code, answer = stop_by_command()
    assert code == 0
    assert ("launcher", "launch", "confirmed") in outcomes(answer)
    assert ("node", "left", "silent") in outcomes(answer)
    assert answer["arms"][1]["mode"] == "estop"
    graph.hangs.unlink()
    wait_until(lambda: stop_by_command()[1]["arms"][0]["mode"] == "estop", "it to stop")


def test_the_arms_of_each_of_several_graphs_are_reported(graph: Graph) -> None:
    other = runs.create_run()
    other.plan_file.write_text('{"launch_file": "own.yaml", "nodes": {}}')
    code, answer = stop_by_command()
    assert (code, answer["stopped"]) == (1, False), "nothing confirms the stop of the other graph"
    assert ("launcher", "launch", "confirmed") in outcomes(answer)
    modes = {(arm["run"], arm["mode"]) for arm in answer["arms"]}
    assert modes == {(str(graph.run.directory), "estop"), (str(other.directory), "silent")}


async def test_a_bridge_without_its_arm_states_the_reason() -> None:
    plan = load_graph(ROOT / "launch" / "demo.yaml")
    arms = arms_command._Arms(plan, Run("unused", Path("unused")))
    note = "waiting for the arm: no connection to 127.0.0.1:5099"
    arms.add_status(status_of("arm_left_bridge", notes=(Note(detail=note),)))
    arms.add_status(status_of("planner", notes=(Note(detail="follows the finger"),)))
    rows = arms_command.describe_arms(arms.states, arms.notes)
    assert [row["reason"] for row in rows] == [note, "no message from the bridge"]


def test_without_a_graph_there_is_nothing_to_stop() -> None:
    done = subprocess.run([*FLEXSHEET, "arms", "stop"], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "no graph is running" in done.stderr
    assert "use the hard-wired e-stop" in done.stderr


class Sockets:
    """Stop sockets of this process, whose loop runs while `stop_arms` runs in a thread."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.reasons: list[str] = []
        self.opened: list[StopSocket] = []

    async def open(self, kind: Any, name: str) -> None:
        self.opened.append(StopSocket(self.folder, kind, name, self.reasons.append))
        await self.opened[-1].open()

    async def stop(self, reason: str = REASON) -> list[StopAttempt]:
        return await asyncio.to_thread(stop_arms, [self.folder], reason)


@pytest.fixture
def sockets(runs_root: Path) -> Sockets:
    return Sockets(runs_root)


async def test_all_are_asked_at_once_and_others_may_not_connect(sockets: Sockets) -> None:
    await sockets.open("launcher", "launch")
    await sockets.open("node", "arm_left_bridge")
    for file in sockets.folder.iterdir():
        assert file.stat().st_mode & 0o777 == 0o600
    attempts = await sockets.stop("é" * 10_000)
    assert {(one.path, one.receiver) for one in attempts if one.worked} == {
        (StopPath.LAUNCHER, "launch"),
        (StopPath.NODE, "arm_left_bridge"),
    }
    assert [set(reason) <= {"é", "\ufffd"} for reason in sockets.reasons] == [True, True]
    for one in sockets.opened:
        one.close()
        one.close()
    assert list(sockets.folder.iterdir()) == []


async def test_an_invalid_request_stops_nothing_and_is_answered(sockets: Sockets) -> None:
    await sockets.open("launcher", "launch")
    (file,) = sockets.folder.iterdir()
    held = []
    for content in [b"", b"reset\n", b"\0" * 10_000, b"stop without an end", *([None] * 50)]:
        held.append(socket.socket(socket.AF_UNIX, socket.SOCK_STREAM))
        await asyncio.to_thread(held[-1].connect, str(file))
        if content is not None:
            held[-1].send(content)
    attempts = await sockets.stop()
    assert [one.outcome for one in attempts] == [StopOutcome.CONFIRMED]
    assert sockets.reasons == [REASON]
    for one in (*held, *sockets.opened):
        one.close()


def test_a_socket_of_the_dead_is_absent_and_a_silent_launcher_is_not_killed(
    runs_root: Path,
) -> None:
    dead = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    dead.bind(str(runs_root / "bridge.node.stop"))
    dead.close()
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as silent:
        silent.bind(str(runs_root / "launch.launcher.stop"))
        silent.listen()
        attempts = stop_arms([runs_root], REASON)
    assert {(one.path, one.outcome) for one in attempts} == {
        (StopPath.NODE, StopOutcome.ABSENT),
        (StopPath.LAUNCHER, StopOutcome.SILENT),
    }


@contextmanager
def socket_process(file: Path, more: str = "") -> Iterator[subprocess.Popen[bytes]]:
    """Start a process with a socket for e-stops that runs the code `more` and then hangs."""
    code = "import socket, sys, time; s = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM); "
    code += f"s.bind(sys.argv[1]); s.listen(0); print(flush=True); {more}time.sleep(1000)"
    process = subprocess.Popen([sys.executable, "-c", code, str(file)], stdout=subprocess.PIPE)
    try:
        assert process.stdout is not None
        process.stdout.readline()
        yield process
    finally:
        process.kill()
        process.communicate()


def test_a_bridge_that_hangs_is_killed_where_no_launcher_answers(runs_root: Path) -> None:
    with socket_process(runs_root / "bridge.node.stop") as bridge:
        bridge.send_signal(signal.SIGSTOP)
        attempts = stop_arms([runs_root], REASON)
        assert [(one.path, one.receiver, one.outcome) for one in attempts] == [
            (StopPath.SIGNAL, "bridge", StopOutcome.KILLED)
        ]
        assert bridge.wait(DEADLINE_S) == -signal.SIGKILL


class Receiver:
    """A socket for e-stops of which a thread accepts connections only when it is started."""

    def __init__(self, file: Path) -> None:
        self.listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self.listener.bind(str(file))
        self.listener.listen(0)
        self.may_answer = threading.Event()
        self.thread = threading.Thread(target=self._answer, daemon=True)

    def _answer(self) -> None:
        self.may_answer.wait(DEADLINE_S)
        while True:
            connection, _ = self.listener.accept()
            with connection:
                if connection.recv(1000):
                    connection.send(ANSWER)
                    return


def fill_backlog(file: Path) -> list[socket.socket]:
    """Connect to a socket until its backlog is full, and return the connections."""
    held = []
    while True:
        held.append(socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_NONBLOCK))
        try:
            held[-1].connect(str(file))
        except BlockingIOError:
            return held
        held[-1].shutdown(socket.SHUT_WR)


def test_a_receiver_is_told_as_soon_as_its_backlog_is_not_full(
    runs_root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stopping, "CONTINUE_AFTER_S", DEADLINE_S)
    receiver = Receiver(runs_root / f"launch.launcher{SUFFIX}")
    held = fill_backlog(runs_root / f"launch.launcher{SUFFIX}")
    connect, calls = stopping._Receiver.connect, [receiver.may_answer.set, lambda: None]

    def connect_later(one: Any) -> bool:
        if calls:
            calls.pop()()
        return connect(one)

    monkeypatch.setattr(stopping._Receiver, "connect", connect_later)
    receiver.thread.start()
    attempts = stop_arms([runs_root], REASON)
    assert [one.outcome for one in attempts] == [StopOutcome.CONFIRMED]
    receiver.thread.join()
    for one in (*held, receiver.listener):
        one.close()


def test_a_bridge_with_a_full_backlog_is_killed_where_no_launcher_answers(runs_root: Path) -> None:
    plan = {"nodes": {"bridge": {"outputs": [], "process": f"bridge.node{SUFFIX}"}}}
    (runs_root / "plan.json").write_text(json.dumps(plan))
    # The process is found by its argument, the path of its configuration.
    with socket_process(runs_root / f"bridge.node{SUFFIX}.json") as bridge:
        (runs_root / f"bridge.node{SUFFIX}.json").rename(runs_root / f"bridge.node{SUFFIX}")
        held = fill_backlog(runs_root / f"bridge.node{SUFFIX}")
        attempts = stop_arms([runs_root], REASON)
        assert [(one.path, one.receiver, one.outcome) for one in attempts] == [
            (StopPath.SIGNAL, "bridge", StopOutcome.KILLED)
        ]
        assert bridge.wait(DEADLINE_S) == -signal.SIGKILL
    for one in held:
        one.close()


def test_each_answer_is_timed_when_it_arrives(
    runs_root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second receiver answers only after the answer of the first one was noted."""
    monkeypatch.setattr(stopping, "CONTINUE_AFTER_S", DEADLINE_S)
    first, second = (
        Receiver(runs_root / f"{name}{SUFFIX}") for name in ("launch.launcher", "bridge.node")
    )

    def note(*values: Any) -> StopAttempt:
        second.may_answer.set()
        return StopAttempt(*values)

    monkeypatch.setattr(stopping, "StopAttempt", note)
    first.may_answer.set()
    for one in (first, second):
        one.thread.start()
    attempts = stop_arms([runs_root], REASON)
    assert [(one.receiver, one.outcome) for one in attempts] == [
        ("launch", StopOutcome.CONFIRMED),
        ("bridge", StopOutcome.CONFIRMED),
    ]
    for one in (first, second):
        one.thread.join()
        one.listener.close()


def test_the_answer_of_one_graph_spares_no_bridge_of_another(tmp_path: Path) -> None:
    """Each graph is stopped as if it were the only one."""
    answering, hanging = tmp_path / "a", tmp_path / "b"
    answering.mkdir()
    hanging.mkdir()
    answer = f"c, _ = s.accept(); c.recv(1000); c.send({ANSWER!r}); "
    with (
        socket_process(answering / "launch.launcher.stop", answer),
        socket_process(hanging / "bridge.node.stop"),
    ):
        attempts = stop_arms([answering, hanging], REASON)
        assert {(one.run, one.receiver, one.outcome) for one in attempts} == {
            (answering, "launch", StopOutcome.CONFIRMED),
            (hanging, "bridge", StopOutcome.KILLED),
        }


@pytest.mark.parametrize("process", ["planner", "tracking"])
def test_without_an_answer_the_senders_of_targets_are_killed(runs_root: Path, process: str) -> None:
    planner = {"outputs": [{"topic": "sheet_target"}], "process": process}
    plan = {"nodes": {"planner": planner, "camera": {"outputs": []}}}
    (runs_root / "plan.json").write_text(json.dumps(plan))
    started = {
        name: subprocess.Popen(
            [sys.executable, "-c", "import time; time.sleep(1000)", str(runs_root / f"{name}.json")]
        )
        for name in (process, "camera")
    }
    try:
        for one in started.values():
            # The kernel sets the arguments a moment after the start.
            arguments = Path(f"/proc/{one.pid}/cmdline")
            wait_until(arguments.read_bytes, "the arguments of the process")
        attempts = stop_arms([runs_root], REASON)
        assert [(one.path, one.receiver, one.outcome) for one in attempts] == [
            (StopPath.SIGNAL, "planner", StopOutcome.KILLED)
        ]
        assert started[process].wait(DEADLINE_S) == -signal.SIGKILL
        assert started["camera"].poll() is None
    finally:
        for one in started.values():
            one.kill()
            one.wait()


@pytest.mark.parametrize(
    ("arguments", "sent"),
    [
        ([], ("", "flexsheet arms stop")),
        (["--json", "--reason", "a hand"], ("", "a hand")),
        (["--reason=a=b", "--run", "here"], ("here", "a=b")),
        (["--help"], None),
        (["--reason"], None),
        (["--run=here", "there"], None),
    ],
)
def test_a_stop_is_sent_before_the_command_line_is_imported(
    monkeypatch: pytest.MonkeyPatch, arguments: list[str], sent: tuple[str, str] | None
) -> None:
    """The fast path handles its own options; the command line handles all others."""
    calls: list[tuple[str, str]] = []

    def record(directories: list[Path], reason: str) -> list[StopAttempt]:
        calls.append((" ".join(map(str, directories)), reason))
        return []

    monkeypatch.setattr(stopping, "stop_arms", record)
    monkeypatch.setattr(stopping, "sent_early", [])
    stopping.send_early(arguments)
    assert calls == ([] if sent is None else [sent])
    assert stopping.sent_early == [[] for _ in calls]


def test_a_stop_imports_next_to_nothing() -> None:
    code = "import sys\nfrom flexsheet.launch.running import runs, stopping\nprint(*sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert not {"pydantic", "zmq", "numpy", "psutil"} & set(done.stdout.split())
    assert KILL_AFTER_S < 0.2
