"""Test the supervisor: nodes start, restart, and leave nothing."""

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
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import psutil
import pytest
import zmq
from mcap.writer import MCAP0_MAGIC

from flexsheet.launch.commands.launching import run_graph
from flexsheet.launch.plans.documents import BadInputError
from flexsheet.launch.plans.plan import load_graph
from flexsheet.launch.plans.plan_model import ResolvedGraph
from flexsheet.launch.running import priority, runs, supervisor
from flexsheet.launch.running.priority import permitted_nice, permitted_real_time
from flexsheet.launch.running.supervisor import NodeFailedError, RunningGraph
from flexsheet.messages.bag import BagReader
from tests.waiting import DEADLINE_S, until, wait_until

ROOT = Path(__file__).resolve().parent.parent
FLEXSHEET = [sys.executable, "-m", "flexsheet"]
# Of this process's own: ports follow from names, and tests may run beside each other.
NET = f"127.{1 + os.getpid() % 250}.{os.getpid() // 250 % 250}"
HOSTS = {"main": {"address": f"{NET}.1"}, "left": {"address": f"{NET}.2"}}


@pytest.fixture(autouse=True)
def runs_root(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Create a directory of runs for the test, with a short path."""
    folder = Path(tempfile.mkdtemp(prefix="fs-", dir="/tmp"))
    monkeypatch.setenv(runs.ROOT_VARIABLE, str(folder))
    yield folder
    shutil.rmtree(folder)


def beacon(**keys: Any) -> dict[str, Any]:
    return {"type": "tests.launch_nodes:Beacon", **keys}


def plan_of(folder: Path, **nodes: dict[str, Any]) -> ResolvedGraph:
    return load_graph(write(folder, nodes))


def write(folder: Path, nodes: dict[str, Any], **more: Any) -> Path:
    path = folder / "graph.yaml"
    # JSON is YAML.
    path.write_text(json.dumps({"nodes": nodes, **more}))
    return path


LISTENER = {"type": "tests.launch_nodes:Listener"}


def processes_of(run_id: str) -> list[psutil.Process]:
    """Return all processes with the run's tag."""
    found = []
    for process in psutil.process_iter():
        try:
            if process.environ().get(runs.RUN_VARIABLE) == run_id:
                found.append(process)
        except psutil.Error:
            continue
    return found


def sockets_in(folder: Path) -> list[Path]:
    return [path for path in folder.rglob("*") if path.is_socket()]


def assert_nothing_left(folder: Path) -> None:
    for run in runs.list_runs():
        assert processes_of(run.id) == []
        assert not run.is_alive()
    assert sockets_in(folder) == []


def session_niceness(pid: int) -> int | None:
    """Return the niceness of a session; None if the kernel does not weight sessions."""
    autogroup = Path(f"/proc/{pid}/autogroup")
    return int(autogroup.read_text().split()[-1]) if autogroup.exists() else None


async def test_a_nice_node_has_low_priority_as_a_process_and_as_a_session(tmp_path: Path) -> None:
    plan = plan_of(tmp_path, beacon=beacon(), quiet=beacon(nice=7, topics={"twin__finger": None}))
    async with RunningGraph(plan) as graph:
        await graph.wait_ready()
        own = os.getpriority(os.PRIO_PROCESS, 0)
        for name, more in (("beacon", 0), ("quiet", 7)):
            pid = graph.pids[name]
            assert psutil.Process(pid).nice() == min(own + more, 19)
            assert session_niceness(pid) in (None, min(own + more, 19))


async def test_a_node_has_high_priority_if_the_user_may_raise_it(tmp_path: Path) -> None:
    plan = plan_of(tmp_path, beacon=beacon(nice=-7))
    async with RunningGraph(plan) as graph:
        await graph.wait_ready()
        given = permitted_nice(-7)
        pid = graph.pids["beacon"]
        own = os.getpriority(os.PRIO_PROCESS, 0)
        assert psutil.Process(pid).nice() == own + given
        assert session_niceness(pid) in (None, own + given)
        log = (graph.run.logs / "launch.log").read_text()
        assert ("may not set the `nice`" in log) is (given == 0)


async def test_a_ready_node_has_its_real_time_priority_if_the_user_may_set_it(
    tmp_path: Path,
) -> None:
    plan = plan_of(tmp_path, beacon=beacon(realtime_priority=7), listener=LISTENER)
    async with RunningGraph(plan) as graph:
        await graph.wait_ready()
        granted = permitted_real_time(7) is not None
        pid = graph.pids["beacon"]
        policies = {os.sched_getscheduler(int(one)) for one in os.listdir(f"/proc/{pid}/task")}
        assert policies == {os.SCHED_RR if granted else os.SCHED_OTHER}
        assert os.sched_getparam(pid).sched_priority == (7 if granted else 0)
        assert os.sched_getscheduler(graph.pids["listener"]) == os.SCHED_OTHER
        log = (graph.run.logs / "launch.log").read_text()
        permitted = priority._may_set_real_time(7)
        assert ("may not set the `nice` or `realtime_priority`" in log) is not permitted


def test_the_processes_find_node_classes_beside_the_script(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "own.py").touch()
    (tmp_path / "package").mkdir()
    script = str(tmp_path / "script.py")
    monkeypatch.setattr(sys.modules["__main__"], "__file__", script, raising=False)
    assert supervisor._own_module_folders(["own:Guard"]) == [str(tmp_path)]
    assert supervisor._own_module_folders(["package.guard:Guard"]) == [str(tmp_path)]
    assert supervisor._own_module_folders(["planner", "elsewhere:Guard"]) == []


async def test_a_graph_comes_up_and_leaves_nothing(tmp_path: Path, runs_root: Path) -> None:
    # ZeroMQ's own descriptors come with the first socket and stay.
    zmq.Context.instance().socket(zmq.PUB).close()
    descriptors, threads = len(os.listdir("/proc/self/fd")), threading.active_count()
    plan = plan_of(tmp_path, beacon=beacon(), listener=LISTENER)
    async with RunningGraph(plan) as graph:
        await graph.wait_ready(DEADLINE_S)
        assert graph.pids.keys() == {"beacon", "listener"}
        assert all(os.getsid(pid) == pid for pid in graph.pids.values())
        assert [run.id for run in runs.list_live_runs()] == [graph.run.id]
        assert len(sockets_in(runs_root)) == 7
    assert graph.exit_codes == {"beacon": 0, "listener": 0}
    assert_nothing_left(runs_root)
    wait_until(lambda: len(os.listdir("/proc/self/fd")) <= descriptors, "ZeroMQ's descriptors")
    assert threading.active_count() == threads
    assert (graph.run.logs / "launch.log").read_text().startswith(f"run {graph.run.id}")


async def test_nodes_of_one_process_share_its_fate(tmp_path: Path, runs_root: Path) -> None:
    shared: dict[str, Any] = {"process": "chain", "restart": {"delay_s": 0.01}}
    crash = {"type": "tests.launch_nodes:Crash", **shared}
    bag = tmp_path / "run.mcap"
    path = write(tmp_path, {"beacon": beacon(**shared), "ear": LISTENER | shared, "crash": crash})
    async with RunningGraph(load_graph(path, record=bag)) as graph:
        await graph.wait_ready(DEADLINE_S)
        before = graph.pids
        assert before["beacon"] == before["ear"] == before["crash"] != before["recorder"]
        assert (graph.run.directory / "chain.json").exists()
        graph.kill("ear")
        async with asyncio.timeout(DEADLINE_S):
            await graph.wait_ready_again("beacon", 1)
        assert graph.restarts == {"beacon": 1, "ear": 1, "crash": 1, "recorder": 0}
        assert graph.pids["beacon"] == graph.pids["crash"] != before["beacon"]
        assert graph.pids["recorder"] == before["recorder"]

        def read_log(name: str) -> str:
            return (graph.run.logs / f"{name}.log").read_text()

        assert read_log("crash").count("crash is set up") == 2
        assert read_log("chain").count("a line without a node") == 2
        assert "set up" not in read_log("ear") + read_log("chain")
        # The listener publishes after ten fingers, which come from its own process.
        await until_stopped(graph)
    assert graph.exit_codes == dict.fromkeys(("beacon", "ear", "crash", "recorder"), 0)
    recorded = [(topic, header.writer) for topic, _, header, _ in BagReader(bag)]
    assert {("twin/finger", "beacon"), ("estop", "ear")} <= set(recorded)
    assert_nothing_left(runs_root)


async def until_stopped(graph: RunningGraph) -> None:
    """Wait until the launcher has latched an e-stop of the graph."""
    log = graph.run.logs / "launch.log"
    await until(lambda: "e-stop of ear" in log.read_text(), "the listener's e-stop")


async def test_a_node_that_fails_at_the_start_ends_its_process(tmp_path: Path) -> None:
    shared: dict[str, Any] = {"process": "chain", "restart": {"policy": "never"}}
    crash = {"type": "tests.launch_nodes:Crash", "parameters": {"fails": True}, **shared}
    plan = plan_of(tmp_path, beacon=beacon(**shared), crash=crash)
    async with RunningGraph(plan) as graph:
        with pytest.raises(NodeFailedError, match="chain ended with exit code 1"):
            await graph.wait_ready(DEADLINE_S)
        assert "the setup fails" in (graph.run.logs / "crash.log").read_text()


async def test_a_killed_node_comes_back_and_the_others_stay(tmp_path: Path) -> None:
    plan = plan_of(tmp_path, beacon=beacon(restart={"delay_s": 0.01}), listener=LISTENER)
    async with RunningGraph(plan) as graph:
        await graph.wait_ready(DEADLINE_S)
        before = graph.pids
        graph.kill("beacon")
        async with asyncio.timeout(DEADLINE_S):
            await graph.wait_ready_again("beacon", 1)
        assert graph.pids["beacon"] != before["beacon"]
        assert graph.pids["listener"] == before["listener"]
        assert graph.restarts == {"beacon": 1, "listener": 0}


async def test_crashes_are_answered_with_growing_delays_and_then_an_end(tmp_path: Path) -> None:
    restart = {"delay_s": 0.02, "max_delay_s": 0.05, "max_restarts": 4}
    plan = plan_of(tmp_path, beacon=beacon(parameters={"crash_after": 2}, restart=restart))
    printed: list[str] = []
    async with RunningGraph(plan, report=lambda node, line: printed.append(line)) as graph:
        with pytest.raises(NodeFailedError, match="beacon ended with exit code 3, after 4 restart"):
            await asyncio.wait_for(graph.wait(), DEADLINE_S)
    delays = [line.split("next start in ")[1] for line in printed if "next start in" in line]
    assert delays == ["0 s", "0.02 s", "0.04 s", "0.05 s"]
    assert graph.exit_codes == {"beacon": 3}


async def test_a_node_that_may_not_restart_fails_for_good(tmp_path: Path) -> None:
    plan = plan_of(
        tmp_path, beacon=beacon(parameters={"exit_code": 5}, restart={"policy": "never"})
    )
    async with RunningGraph(plan) as graph:
        with pytest.raises(NodeFailedError, match="beacon ended with exit code 5"):
            await asyncio.wait_for(graph.wait(), DEADLINE_S)
    assert graph.restarts == {"beacon": 0}


async def test_a_node_that_has_done_its_work_ends_the_graph_in_order(tmp_path: Path) -> None:
    plan = plan_of(tmp_path, beacon=beacon(parameters={"exit_code": 0}))
    async with RunningGraph(plan) as graph:
        await asyncio.wait_for(graph.wait(), DEADLINE_S)
        await asyncio.wait_for(graph.wait_ready(), DEADLINE_S)
    assert graph.exit_codes == {"beacon": 0}


async def test_always_means_after_a_good_end_too(tmp_path: Path) -> None:
    restart = {"policy": "always", "delay_s": 0.0, "max_restarts": 1}
    plan = plan_of(tmp_path, beacon=beacon(parameters={"exit_code": 0}, restart=restart))
    async with RunningGraph(plan) as graph:
        with pytest.raises(NodeFailedError, match="beacon ended, after 1 restarts"):
            await asyncio.wait_for(graph.wait(), DEADLINE_S)


async def test_a_node_that_is_not_ready_in_time_is_ended(tmp_path: Path, runs_root: Path) -> None:
    plan = plan_of(
        tmp_path,
        beacon=beacon(
            parameters={"ready_after_s": 1000}, start_deadline_s=0.3, restart={"policy": "never"}
        ),
    )
    async with RunningGraph(plan) as graph:
        with pytest.raises(NodeFailedError, match=r"was not ready within 0\.3 s"):
            await asyncio.wait_for(graph.wait_ready(), DEADLINE_S)
        assert graph.pids == {}
    assert_nothing_left(runs_root)


@pytest.mark.alone
async def test_a_hung_node_is_killed_with_a_stack_trace_and_restarted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One process is stopped, and the loop of another hangs; the third is healthy."""
    monkeypatch.setattr(supervisor, "STOP_GRACE_S", 0.2)  # of the unreachable node, at the end
    quiet = {"topics": {"twin__finger": None}, "liveness_s": 2.0, "restart": {"delay_s": 0.01}}
    plan = plan_of(
        tmp_path,
        stopped=beacon(**quiet),
        stuck=beacon(**quiet, parameters={"unreachable": True}),
        beacon=beacon(liveness_s=2.0),
    )
    printed: list[str] = []
    async with RunningGraph(plan, report=lambda node, line: printed.append(line)) as graph:
        await graph.wait_ready(DEADLINE_S)
        graph.kill("stopped", signal.SIGSTOP)
        async with asyncio.timeout(DEADLINE_S):
            for name in ("stopped", "stuck"):
                await graph.wait_ready_again(name, 1)
        assert graph.hangs["stopped"] == graph.hangs["stuck"] == 1
        assert graph.restarts["beacon"] == graph.hangs["beacon"] == 0
        assert "launch_nodes.py" in (graph.run.logs / "stuck.log").read_text()
    reported = "hung: no heartbeat for 2 s; its log contains the call stacks; next start in 0 s"
    assert f"stuck {reported}" in printed
    assert not any("launch_nodes.py" in line for line in printed)


def any_has(lines: list[str], words: str) -> bool:
    return any(words in line for line in lines)


@pytest.mark.alone
async def test_silence_that_the_launcher_itself_was_absent_for_is_no_hang(tmp_path: Path) -> None:
    plan = plan_of(tmp_path, beacon=beacon(liveness_s=2.0))
    async with RunningGraph(plan) as graph:
        await graph.wait_ready(DEADLINE_S)
        # Both are suspended, as when somebody stops a whole machine, for longer than it may be.
        graph.kill("beacon", signal.SIGSTOP)
        time.sleep(2.5)  # noqa: ASYNC251 - the loop shall stand still
        graph.kill("beacon", signal.SIGCONT)
        await asyncio.sleep(1.0)
        assert graph.hangs == graph.restarts == {"beacon": 0}


async def test_waiting_for_ready_has_a_deadline_of_its_own(tmp_path: Path) -> None:
    plan = plan_of(tmp_path, beacon=beacon(parameters={"ready_after_s": 1000}))
    async with RunningGraph(plan) as graph:
        with pytest.raises(TimeoutError, match="beacon"):
            await graph.wait_ready(0.05)


async def test_a_node_that_ignores_signals_is_killed_with_its_children(
    tmp_path: Path, runs_root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(supervisor, "STOP_GRACE_S", 0.2)
    plan = plan_of(tmp_path, beacon=beacon(parameters={"unreachable": True, "with_child": True}))
    async with RunningGraph(plan) as graph:
        await graph.wait_ready(DEADLINE_S)
        # The node and its child process.
        assert len(processes_of(graph.run.id)) == 2
    assert graph.exit_codes == {"beacon": -signal.SIGKILL}
    wait_until(lambda: not processes_of(graph.run.id), "the killed child to be gone")
    assert_nothing_left(runs_root)


@pytest.mark.parametrize("delay_s", [0.0, 0.05, 0.2, 0.4])
async def test_cancelled_at_any_moment_nothing_stays(
    tmp_path: Path, runs_root: Path, delay_s: float
) -> None:
    plan = plan_of(tmp_path, beacon=beacon(), listener=LISTENER)

    async def use() -> None:
        async with RunningGraph(plan) as graph:
            await graph.wait_ready()
            await asyncio.sleep(1000)

    task = asyncio.create_task(use())
    await asyncio.sleep(delay_s)
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    assert_nothing_left(runs_root)


async def test_a_port_in_use_is_named_before_anything_starts(
    tmp_path: Path, runs_root: Path
) -> None:
    nodes = {"beacon": beacon(host="left"), "listener": LISTENER}
    plan = load_graph(write(tmp_path, nodes, hosts=HOSTS))
    endpoint = plan.writers["twin/finger"][0].tcp
    assert endpoint is not None
    with socket.create_server((HOSTS["left"]["address"], int(endpoint.rpartition(":")[2]))):
        with pytest.raises(BadInputError, match="stop the other program"):
            await RunningGraph(plan).__aenter__()
        # The other host's launcher does not bind it.
        async with RunningGraph(plan, host="main") as graph:
            await graph.wait_ready(DEADLINE_S)
    assert_nothing_left(runs_root)


def contains_estop(bag: Path) -> bool:
    """Return whether the listener received ten messages of the beacon, which it reports by an
    e-stop."""
    return "estop" in BagReader(bag).topics


@pytest.mark.long
async def test_two_launchers_of_two_hosts_make_one_graph(tmp_path: Path) -> None:
    nodes = {"beacon": beacon(host="left"), "listener": LISTENER}
    plan = load_graph(write(tmp_path, nodes, hosts=HOSTS), record=tmp_path / "a.mcap")
    async with RunningGraph(plan, host="main") as main:
        await main.wait_ready(DEADLINE_S)
        async with RunningGraph(plan, host="left") as left:
            await left.wait_ready(DEADLINE_S)
            assert main.pids.keys() == {"listener", "recorder", "clock_main"}
            assert left.pids.keys() == {"beacon", "clock_left"}
            inbox = partial(contains_estop, tmp_path / "a.mcap")
            await asyncio.to_thread(wait_until, inbox, "the listener to hear the beacon")


async def test_addresses_beyond_loopback_are_rejected_without_keys(tmp_path: Path) -> None:
    hosts = {"main": {"address": "192.0.2.1"}}
    plan = load_graph(write(tmp_path, {"beacon": beacon()}, hosts=hosts))
    expected = r"graph\.yaml:1: hosts\.main\.address: connections to 192\.0\.2\.1 must be encrypted"
    with pytest.raises(BadInputError, match=expected):
        await RunningGraph(plan).__aenter__()


async def test_an_unknown_host_is_rejected(tmp_path: Path) -> None:
    plan = plan_of(tmp_path, beacon=beacon())
    with pytest.raises(BadInputError, match="unknown host"):
        await RunningGraph(plan, host="left").__aenter__()


async def test_the_directory_of_runs_must_be_ours(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    target = tmp_path / "target"
    target.mkdir()
    (tmp_path / "link").symlink_to(target)
    monkeypatch.setenv(runs.ROOT_VARIABLE, str(tmp_path / "link"))
    with pytest.raises(runs.RunDirectoryError, match="belongs to another user"):
        await RunningGraph(plan_of(tmp_path, beacon=beacon())).__aenter__()


@pytest.fixture
def started() -> Iterator[list[subprocess.Popen[str]]]:
    """Start commands for a test; remaining ones are killed with their nodes."""
    processes: list[subprocess.Popen[str]] = []
    yield processes
    left = [process for process in processes if process.poll() is None]
    for process in left:
        process.kill()
        process.communicate()
    if left:
        runs.sweep()


def set_sigint(action: signal.Handlers, *, blocked: bool) -> None:
    """Set SIGINT in a child before it runs, since children inherit an ignored SIGINT."""
    signal.signal(signal.SIGINT, action)
    how = signal.SIG_BLOCK if blocked else signal.SIG_UNBLOCK
    signal.pthread_sigmask(how, {signal.SIGINT})


def start_command(
    started: list[subprocess.Popen[str]],
    *arguments: str,
    sigint: signal.Handlers = signal.SIG_DFL,
    blocked: bool = False,
) -> subprocess.Popen[str]:
    process = subprocess.Popen(
        [*FLEXSHEET, *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd="/",
        preexec_fn=partial(set_sigint, sigint, blocked=blocked),  # noqa: PLW1509
    )
    started.append(process)
    return process


def wait_for_words(process: subprocess.Popen[str], words: str) -> None:
    assert process.stderr is not None
    seen = []
    for line in process.stderr:
        seen.append(line)
        if words in line:
            return
    pytest.fail(f'"{words}" was never said: {"".join(seen)}')


@pytest.mark.parametrize("arguments", [["launch", "graph.yaml"], ["--node", "config.json"]])
def test_an_interrupt_from_before_the_first_statement_ends_commands_and_nodes(
    started: list[subprocess.Popen[str]], arguments: list[str]
) -> None:
    process = start_command(started, *arguments, blocked=True)
    process.send_signal(signal.SIGINT)
    _, printed = process.communicate(timeout=DEADLINE_S)
    assert (process.returncode, printed) == (-signal.SIGINT, "")


def ignores_sigint(pid: int) -> bool:
    status = Path(f"/proc/{pid}/status").read_text()
    mask = next(line.split()[1] for line in status.splitlines() if line.startswith("SigIgn:"))
    return bool(int(mask, 16) >> (signal.SIGINT - 1) & 1)


@pytest.mark.parametrize("ready", [False, True])
def test_an_interrupt_that_is_ignored_by_inheritance_ends_a_graph(
    tmp_path: Path, runs_root: Path, started: list[subprocess.Popen[str]], ready: bool
) -> None:
    """Start it as a background job of a shell script, which ends it by `kill -INT`."""
    path = write(tmp_path, {"beacon": beacon(), "listener": LISTENER})
    process = start_command(started, "launch", str(path), sigint=signal.SIG_IGN)
    if ready:
        wait_for_words(process, "are ready")
    else:
        wait_until(lambda: not ignores_sigint(process.pid), "the first statements")
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=DEADLINE_S)
    assert process.returncode == (0 if ready else -signal.SIGINT)
    assert_nothing_left(runs_root)


@pytest.mark.parametrize(
    ("signals", "grace_s", "complete"),
    [(1, DEADLINE_S, True), (2, DEADLINE_S, True), (3, DEADLINE_S, False), (1, 0.2, False)],
)
async def test_an_unfinished_bag_is_reported_before_its_recorder_is_killed(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    signals: int,
    grace_s: float,
    complete: bool,
) -> None:
    monkeypatch.setattr(supervisor, "STOP_GRACE_S", grace_s)
    bag, mark = tmp_path / "run.mcap", tmp_path / "mark"
    recorder = {
        "type": "tests.launch_nodes:SlowRecorder",
        "parameters": {"bag": str(bag), "closes_after": str(mark)},
    }
    started: list[runs.Run] = []
    plan = plan_of(tmp_path, beacon=beacon(), recorder=recorder)
    graph = asyncio.create_task(run_graph(plan, None, None, when_ready=started.append))
    await until(lambda: started, "the nodes to be ready")
    log, own_log = (started[0].logs / f"{name}.log" for name in ("launch", "recorder"))

    async def interrupt(log: Path, words: str) -> None:
        os.kill(os.getpid(), signal.SIGINT)
        await until(lambda: words in log.read_text(), words)

    unfinished = f"flexsheet bag export {bag} -o NEW --format bag"
    if grace_s < DEADLINE_S:
        await interrupt(log, unfinished)
    else:
        await interrupt(own_log, "waiting before the bag is closed")
    if signals >= 2:
        await interrupt(log, f"the bag {bag} is not closed yet")
        assert "still stopping: recorder; Ctrl-C again kills them" in log.read_text()
        assert not graph.done()
    if signals >= 3:
        await interrupt(log, unfinished)
    if complete:
        mark.touch()
    assert await graph == 0
    assert (unfinished in log.read_text()) is not complete
    assert bag.read_bytes().endswith(MCAP0_MAGIC) is complete


@pytest.mark.alone
def test_a_killed_launcher_leaves_no_node_behind(
    tmp_path: Path,
    runs_root: Path,
    started: list[subprocess.Popen[str]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(runs, "ORPHAN_GRACE_S", 0.2)
    nodes = {
        "beacon": beacon(parameters={"with_child": True}),
        "listener": LISTENER,
        "unreachable": {
            "type": "tests.launch_nodes:Beacon",
            "parameters": {"unreachable": True},
            "topics": {"twin__finger": None},
        },
    }
    process = start_command(started, "launch", str(write(tmp_path, nodes)))
    wait_for_words(process, "are ready")
    (run,) = runs.list_live_runs()
    # Three nodes and a child process.
    assert len(processes_of(run.id)) == 4
    process.kill()
    process.communicate(timeout=DEADLINE_S)
    wait_until(lambda: len(processes_of(run.id)) <= 2, "the nodes that listen to end")
    # Who ends in order removes its own.
    assert not [path for path in sockets_in(runs_root) if path.name.startswith(("beac", "listen"))]
    runs.sweep()
    wait_until(lambda: not processes_of(run.id), "the unreachable node and the child to end")
    assert_nothing_left(runs_root)


@pytest.mark.alone
def test_only_orphans_are_killed(tmp_path: Path) -> None:
    """The processes are an orphan without lifeline, one of a live launcher, and one without a
    tag."""
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead_run = f"{dead.pid}.1.1"
    dead.wait()
    own_run = runs.create_run()
    tags = {"orphan": dead_run, "living": own_run.id, "stranger": None}
    processes = {}
    for name, tag in tags.items():
        environment = {**os.environ, **({runs.RUN_VARIABLE: tag} if tag else {})}
        processes[name] = subprocess.Popen(["sleep", "1000"], env=environment)
    try:
        wait_until(lambda: len(runs.find_orphans()) == 1, "sleep to be started")
        assert runs.sweep() == [processes["orphan"].pid]
        assert processes["orphan"].poll() is not None
        assert processes["living"].poll() is None
        assert processes["stranger"].poll() is None
        assert own_run.is_alive()
    finally:
        for process in processes.values():
            process.kill()
            process.wait()


def test_old_runs_are_tidied_up(runs_root: Path) -> None:
    for i in range(runs.MAX_FINISHED_RUNS + 3):
        (runs_root / f"1.{i}.1").mkdir(parents=True)
    runs.sweep()
    assert len(runs.list_runs()) == runs.MAX_FINISHED_RUNS


def test_foreign_packages_on_the_path_do_not_win(tmp_path: Path) -> None:
    """Put a foreign package named launch on the path, as ROS 2 does."""
    for name in ("launch", "nodes", "messages"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text("raise RuntimeError('the foreign one')\n")
    path = write(tmp_path, {"beacon": beacon(), "listener": LISTENER})
    environment = {**os.environ, "PYTHONPATH": f"{tmp_path}{os.pathsep}{ROOT}"}
    done = subprocess.run(
        [*FLEXSHEET, "launch", str(path), "--duration", "0.1"],
        env=environment, cwd=tmp_path, capture_output=True, text=True, timeout=DEADLINE_S,
        check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "all 2 nodes are ready" in done.stderr
