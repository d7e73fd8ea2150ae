"""Start the nodes of a graph, restart failed nodes, and end all processes at the end.

    async with RunningGraph(plan) as graph:
        await graph.wait_ready()
        ...

Every process has its own session. A process runs one node, or all nodes that name the same process
in the launch file. It reports through a pipe that its nodes are ready. When it exits, its restart
policy is applied. To stop a process, the launcher sends SIGINT, SIGTERM and finally SIGKILL.
"""

from __future__ import annotations

import asyncio
import json
import os
import signal
import stat
import sys
from collections import deque
from collections.abc import Collection, Iterable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, Literal, Self

from flexsheet.launch.plans.documents import BadInputError, Problem
from flexsheet.launch.plans.hosts import is_loopback
from flexsheet.launch.plans.launch_file import is_scene_file, read_launch_file
from flexsheet.launch.plans.needed_nodes import REASON_TEXTS
from flexsheet.launch.plans.plan import load_scene
from flexsheet.launch.plans.plan_model import (
    LAUNCHER,
    MAIN,
    ResolvedGraph,
    ResolvedNode,
    ResolvedProcess,
)
from flexsheet.launch.running.child import LIFELINE_VARIABLE, NICE_VARIABLE, PARENT_VARIABLE
from flexsheet.launch.running.child_process import Child, Report
from flexsheet.launch.running.commit import read_commit
from flexsheet.launch.running.host import HostAgent
from flexsheet.launch.running.keys import make_rings
from flexsheet.launch.running.node_config import node_config
from flexsheet.launch.running.priority import (
    describe_priority_problem,
    permitted_nice,
    permitted_real_time,
)
from flexsheet.launch.running.runs import (
    HOST_FILE,
    RUN_VARIABLE,
    Run,
    create_run,
    is_free,
    sweep,
)
from flexsheet.messages.errors import FlexsheetError
from flexsheet.messages.files import write_file
from flexsheet.messages.scene import Scene
from flexsheet.messages.types import NodeProcess
from flexsheet.nodes import NodeRole
from flexsheet.nodes.runner import ProcessConfig

STOP_GRACE_S = 3.0


class NodeFailedError(FlexsheetError, RuntimeError):
    """Raised if a node fails more often than its restart policy allows."""

    remedy = (
        "Read the node's log above this text, or in the folder `logs` of the run. The first error "
        "in it is the cause."
    )


class RunningGraph:
    """A supervisor of the processes that run the nodes of a graph.

    host: host of the nodes to start. If it is None, the nodes of all hosts are started on this
        computer.
    without: names of nodes that are not started.
    report: function that is called with (node, line) for every log line. The folder `run.logs` also
        contains all lines.
    """

    def __init__(
        self,
        plan: ResolvedGraph,
        *,
        host: str | None = None,
        without: Collection[str] = (),
        report: Report | None = None,
    ) -> None:
        self.plan, self._host, self._report_to = plan, host, report
        self.nodes = [node for node in plan.nodes_on(host) if node.name not in without]
        self._processes = {one.name: one for one in plan.processes_on(host, without=without)}
        self.exit_codes: dict[str, int] = {}
        self.restarts: dict[str, int] = {node.name: 0 for node in self.nodes}
        self.hangs: dict[str, int] = {node.name: 0 for node in self.nodes}
        self._run: Run | None = None
        self._children: dict[str, Child] = {}
        self._supervisors: dict[str, asyncio.Task[None]] = {}
        self._ready = {node.name: asyncio.Event() for node in self.nodes}
        self._agents: dict[str, HostAgent] = {}
        self._lifeline: tuple[int, int] | None = None

    @property
    def run(self) -> Run:
        """Return the run, with its directory, logs and id.

        Raises RuntimeError if the graph has not been started.
        """
        if self._run is None:
            raise RuntimeError("the graph has no run before its start; enter its context first")
        return self._run

    @property
    def pids(self) -> dict[str, int]:
        """Return the process ids of the running nodes. Nodes in one process have the same id."""
        return {
            node.name: child.pid
            for name, child in self._children.items()
            if not child.exited.done()
            for node in self._processes[name].nodes
        }

    def is_ready(self, node: str) -> bool:
        """Return whether the current process of a node has reported that it is ready."""
        return self._ready[node].is_set()

    async def __aenter__(self) -> Self:
        try:
            await self._start()
        except BaseException:
            await self.stop()
            raise
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.stop()

    async def wait_ready(self, timeout_s: float | None = None) -> None:
        """Wait until all nodes are ready.

        Raises NodeFailedError if a node fails, and TimeoutError if nodes are not ready after
        `timeout_s`.
        """
        everyone = asyncio.gather(*(event.wait() for event in self._ready.values()))
        end = asyncio.ensure_future(self.wait())
        try:
            await asyncio.wait(
                (everyone, end), timeout=timeout_s, return_when=asyncio.FIRST_COMPLETED
            )
            if everyone.done():
                return
            if end.done():
                # Nodes that finish before all are ready count as ready.
                end.result()
                return
        finally:
            end.cancel()
            everyone.cancel()
            await asyncio.gather(end, everyone, return_exceptions=True)
        late = [name for name, event in self._ready.items() if not event.is_set()]
        raise TimeoutError(
            f"these nodes are not ready after {timeout_s} s: {', '.join(late)}; see their logs"
        )

    async def wait_ready_again(self, node: str, restarts: int) -> None:
        """Wait until the node has been restarted at least `restarts` times and is ready."""
        supervisor = next(
            self._supervisors[name]
            for name, process in self._processes.items()
            if any(one.name == node for one in process.nodes)
        )
        while self.restarts[node] < restarts or not self._ready[node].is_set():
            if supervisor.done():
                supervisor.result()
                raise NodeFailedError(f"node {node} has ended and is not restarted; see its log")
            await asyncio.sleep(0.02)

    async def wait(self) -> None:
        """Wait until all nodes have exited. Raises NodeFailedError if a node fails."""
        pending: set[asyncio.Task[None]] = set(self._supervisors.values())
        while pending:
            done, pending = await asyncio.wait(pending, return_when=asyncio.FIRST_COMPLETED)
            for supervisor in done:
                if not supervisor.cancelled():
                    supervisor.result()

    def kill(self, node: str, number: int = signal.SIGKILL) -> None:
        """Send a signal to the process of a node, in order to simulate a fault."""
        os.kill(self.pids[node], number)

    def warn_of_running_nodes(self) -> None:
        """Report the nodes that have not exited, and the bags that are not closed."""
        if names := list(self.pids):
            self._report(LAUNCHER, f"still stopping: {', '.join(names)}; Ctrl-C again kills them")
        for bag in self._list_open_bags(self._children.values()):
            self._report(LAUNCHER, f"the bag {bag} is not closed yet; wait for it")

    def kill_all(self) -> None:
        """Kill all nodes immediately, without the grace periods of the method `stop`."""
        self._send(signal.SIGKILL, self._children.values())

    def _send(self, number: int, children: Collection[Child]) -> None:
        """Send a signal to processes.

        If the signal is SIGKILL, bags that can become incomplete are reported first.
        """
        for bag in self._list_open_bags(children) if number == signal.SIGKILL else ():
            self._report(
                LAUNCHER,
                f"the bag {bag} may be incomplete, because its recorder is killed; write its "
                f"readable messages to a new bag: flexsheet bag export {bag} -o NEW --format bag",
            )
        for child in children:
            child.signal(number)

    def _list_open_bags(self, children: Collection[Child]) -> list[Path]:
        """Return the bag files that recorders in the given processes have open."""
        pids = {child.pid for child in children}
        recorders = {one.name for one in self.nodes if one.role is NodeRole.RECORDER}
        return [
            file
            for name, pid in self.pids.items()
            if name in recorders and pid in pids
            for file in list_written_files(pid)
        ]

    async def stop(self) -> None:
        """End all nodes by SIGINT, SIGTERM and SIGKILL, and remove sockets.

        This method can be called twice.
        """
        for task in self._supervisors.values():
            task.cancel()
        try:
            await asyncio.gather(*self._supervisors.values(), return_exceptions=True)
            await self._end_children()
        finally:
            for name, child in self._children.items():
                child.kill_now()
                self._set_exit_code(self._processes[name], child.exited.result())
            for agent in self._agents.values():
                await agent.close()
            if self._lifeline is not None:
                for fd in self._lifeline:
                    os.close(fd)
                self._lifeline = None
            if self._run is not None:
                self._run.end()

    async def _end_children(self) -> None:
        """End all processes.

        Simulated arms end after their bridges (the nodes that control them), because bridges send
        stop commands to the arms. Nodes that only read topics end last, to receive the final
        messages.
        """

        def find_turn(process: ResolvedProcess) -> int:
            if all(_only_reads(node) for node in process.nodes):
                return 2
            return int({node.role for node in process.nodes} == {NodeRole.ARM_SIMULATOR})

        turns = {name: find_turn(self._processes[name]) for name in self._children}
        for turn in range(3):
            children = [child for name, child in self._children.items() if turns[name] == turn]
            for number in (signal.SIGINT, signal.SIGTERM, signal.SIGKILL):
                alive = [child for child in children if not child.exited.done()]
                if not alive:
                    break
                self._send(number, alive)
                await asyncio.wait([child.exited for child in alive], timeout=STOP_GRACE_S)

    async def _start(self) -> None:
        _check_network(self.plan, self._host)
        swept = sweep()
        self._run = create_run()
        if swept:
            self._report(LAUNCHER, f"ended {len(swept)} processes of earlier launchers")
        self._lifeline = os.pipe()
        _check_ports(self.plan, self._host)
        rings = make_rings(self.plan, self.run, self._host) if self.plan.keys else {}
        commit = read_commit()
        self._write_run_files(commit)
        for host in self.plan.hosts if self._host is None else [self._host]:
            self._agents[host] = agent = HostAgent(
                self.plan,
                host,
                run=self.run,
                code=(commit or "unknown")[:12],
                processes=partial(self._list_states, host),
                keys=rings.get(host),
                on_problem=partial(self._report, LAUNCHER),
            )
            await agent.start()
            if host == MAIN:
                agent.publish("scene", self.plan.scene_message())
                agent.publish("twin/apparatus", self.plan.apparatus_message())
        self._report(LAUNCHER, f"run {self.run.id}, plan {self.plan.hash}: {len(self.nodes)} nodes")
        for omitted in self.plan.omitted:
            self._report(LAUNCHER, f"{omitted.name} is not started: {REASON_TEXTS[omitted.reason]}")
        if problem := describe_priority_problem(self.nodes):
            self._report(LAUNCHER, problem)
        for name, process in sorted(
            self._processes.items(), key=lambda item: not _records(item[1])
        ):
            self._supervisors[name] = asyncio.create_task(self._supervise(process), name=name)

    def publish_scene(self, scene: Scene) -> int:
        """Replace the scene of the running graph, and return the source timestamp of the message.

        Raises RuntimeError if a node of the graph, such as the console, publishes the scene.
        """
        source_ns = self._agents[MAIN].publish("scene", scene) if MAIN in self._agents else None
        if source_ns is None:
            raise RuntimeError(
                "a node of the graph publishes the scene; omit that node (--without NODE)"
            )
        return source_ns

    def _list_states(self, host: str) -> tuple[NodeProcess, ...]:
        pids = self.pids

        def find_state(node: str) -> Literal["starting", "ready", "exited"]:
            if self._ready[node].is_set():
                return "ready"
            return "starting" if node in pids else "exited"

        return tuple(
            NodeProcess(
                name=node.name,
                state=find_state(node.name),
                restarts=self.restarts[node.name],
                hangs=self.hangs[node.name],
            )
            for node in self.nodes
            if node.host == host
        )

    async def _supervise(self, process: ResolvedProcess) -> None:
        """Run a process, and restart it according to its policy.

        Raises NodeFailedError if the process fails more often than the policy allows.
        """
        policy, name = process.settings.restart, process.name
        recent: deque[float] = deque()
        loop = asyncio.get_running_loop()
        if not _records(process):
            await self._wait_for_recorders()
        while True:
            problem = await self._run_once(process)
            if policy.policy == "never" or (policy.policy == "on_failure" and problem is None):
                if problem is not None:
                    raise self._fail(f"{name} {problem}")
                for node in process.nodes:
                    self._ready[node.name].set()
                self._report(LAUNCHER, f"{name} finished")
                return
            while recent and recent[0] < loop.time() - policy.window_s:
                recent.popleft()
            if len(recent) >= policy.max_restarts:
                raise self._fail(
                    f"{name} {problem or 'ended'}, after {len(recent)} restarts "
                    f"in {policy.window_s:g} s"
                )
            delay_s = min(policy.delay_s * 2 ** (len(recent) - 1), policy.max_delay_s)
            delay_s = delay_s if recent else 0.0
            recent.append(loop.time())
            self._report(LAUNCHER, f"{name} {problem or 'ended'}; next start in {delay_s:g} s")
            await asyncio.sleep(delay_s)
            for node in process.nodes:
                self.restarts[node.name] += 1

    async def _wait_for_recorders(self) -> None:
        """Wait until each recorder is ready or has ended, so that bags contain all messages."""
        for name, process in self._processes.items():
            if _records(process):
                child = self._children[name]
                started: set[asyncio.Future[Any]] = {child.ready, child.exited}
                await asyncio.wait(started, return_when=asyncio.FIRST_COMPLETED)

    async def _run_once(self, process: ResolvedProcess) -> str | None:
        """Run a process until it ends; return a text about its failure, or None if it succeeded."""
        child = self._spawn(process)
        # A process sends its first heartbeat when it is ready.
        late = await _is_silent(child, process.start_deadline_s, child.ready)
        hangs = False
        if late:
            child.signal(signal.SIGKILL)
        elif child.ready.done():
            for node in process.nodes:
                self._ready[node.name].set()
            self._report(LAUNCHER, f"{_describe_process(process)} ready, pid {child.pid}")
            hangs = await _is_silent(child, process.settings.liveness_s)
            if hangs:
                child.end_hanging()
        # `stop` also awaits this future, so cancelling the supervisor task must not cancel it.
        code = await asyncio.shield(child.exited)
        for node in process.nodes:
            self._ready[node.name].clear()
            self.hangs[node.name] += hangs
        self._set_exit_code(process, code)
        if late:
            return f"was not ready within {process.start_deadline_s:g} s"
        if hangs:
            seconds = process.settings.liveness_s
            missing = f"hung: no heartbeat for {seconds:g} s"
            return f"{missing}; its log contains the call stacks"
        if code < 0:
            return f"was ended by {signal.Signals(-code).name}"
        return f"ended with exit code {code}" if code else None

    def _set_exit_code(self, process: ResolvedProcess, code: int) -> None:
        self.exit_codes.update(dict.fromkeys((node.name for node in process.nodes), code))

    def _spawn(self, process: ResolvedProcess) -> Child:
        assert self._lifeline is not None  # made before any supervisor
        config = ProcessConfig(
            name=process.name,
            nodes=tuple(node_config(self.plan, node, self.run) for node in process.nodes),
            realtime_priority=permitted_real_time(process.settings.realtime_priority),
        )
        environment = {
            **os.environ,
            RUN_VARIABLE: self.run.id,
            PARENT_VARIABLE: str(os.getpid()),
            LIFELINE_VARIABLE: str(self._lifeline[0]),
            NICE_VARIABLE: str(permitted_nice(process.settings.nice)),
            "PYTHONUNBUFFERED": "1",
            "PYTHONFAULTHANDLER": "1",
        }
        # The processes of the graph already use all cores; BLAS threads would compete with them.
        for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
            environment.setdefault(variable, "1")
        # The camera node reports a camera that cannot be opened.
        environment.setdefault("OPENCV_LOG_LEVEL", "ERROR")
        if folders := _own_module_folders(node.type for node in self.nodes):
            existing = environment.get("PYTHONPATH")
            environment["PYTHONPATH"] = os.pathsep.join([*folders, *filter(None, [existing])])
        child = Child(config, self.run, environment, self._lifeline[0], self._report)
        self._children[process.name] = child
        return child

    def _write_run_files(self, commit: str | None) -> None:
        """Write the run's files for the recorder and for command-line tools."""
        directory = self.run.directory
        write_file(directory / "launch.yaml", self.plan.launch_text)
        write_file(directory / "scene.yaml", self.plan.scene_text)
        write_file(directory / "git.json", json.dumps({"commit": commit}))
        if self._host is not None:
            write_file(directory / HOST_FILE, self._host)
        if any(port.topic == "scene" for node in self.nodes for port in node.outputs):
            self._write_scenes(directory / "scenes")
        # The plan is written last and atomically, because tools find a graph by this file.
        write_file(self.run.plan_file, self.plan.model_dump_json(indent=1))

    def _write_scenes(self, folder: Path) -> None:
        """Write the scenes that can be selected at run time as JSON files into a folder.

        These are all scenes in the same folder as the scene file of the graph. Nodes that publish
        scenes read the JSON files.
        """
        folder.mkdir()
        own = self.plan.scene_file
        for path in [] if own is None else sorted(Path(own).parent.glob("*.yaml")):
            try:
                if is_scene_file(path):
                    write_file(folder / f"{path.stem}.json", load_scene(path).model_dump_json())
            except BadInputError as error:
                self._report(LAUNCHER, f"scene {path.name} is skipped: {error}")

    def _fail(self, text: str) -> NodeFailedError:
        self._report(LAUNCHER, text)
        return NodeFailedError(f"{text}; its log is in {self.run.logs}")

    def _report(self, node: str, line: str) -> None:
        if node == LAUNCHER and self._run is not None:
            with (self._run.logs / f"{LAUNCHER}.log").open("a") as log:
                log.write(line + "\n")
        if self._report_to is not None:
            self._report_to(node, line)


async def _is_silent(child: Child, seconds: float | None, *ends: asyncio.Future[Any]) -> bool:
    """Wait until a process has exited, or has sent no heartbeat for `seconds`.

    Returns whether the process is silent.

    seconds: maximum time without a heartbeat; None means no limit.
    ends: futures that also end the wait.
    """
    others: tuple[asyncio.Future[Any], ...] = (child.exited, *ends)
    if seconds is None:
        await asyncio.wait(others, return_when=asyncio.FIRST_COMPLETED)
        return False
    silence = asyncio.ensure_future(child.wait_until_silent(seconds))
    try:
        await asyncio.wait((silence, *others), return_when=asyncio.FIRST_COMPLETED)
        return not any(one.done() for one in others)
    finally:
        silence.cancel()


def _own_module_folders(node_types: Iterable[str]) -> list[str]:
    """Return the folder of the running script if it contains modules of node classes.

    Python searches this folder only in the process of the script, not in those of the nodes.
    """
    file = getattr(sys.modules["__main__"], "__file__", None)
    script = Path.cwd() if file is None else Path(file).resolve().parent
    names = {one.partition(":")[0].partition(".")[0] for one in node_types if ":" in one}
    is_own = any((script / f"{one}.py").is_file() or (script / one).is_dir() for one in names)
    return [str(script)] if is_own else []


def _records(process: ResolvedProcess) -> bool:
    return any(node.role is NodeRole.RECORDER for node in process.nodes)


def _only_reads(node: ResolvedNode) -> bool:
    return bool(node.inputs) and all(port.topic == "status" for port in node.outputs)


def _describe_process(process: ResolvedProcess) -> str:
    names = [node.name for node in process.nodes]
    if names == [process.name]:
        return f"{process.name} is"
    return f"{process.name} ({', '.join(names)}) is"


def list_written_files(pid: int) -> list[Path]:
    """Return the regular files that a process has open for writing.

    The result is empty if the process has ended.
    """
    files = []
    with suppress(OSError):
        for entry in Path(f"/proc/{pid}/fd").iterdir():
            # The process may have closed the file since.
            with suppress(OSError):
                # The permissions of an entry are the access mode of its descriptor.
                if entry.lstat().st_mode & stat.S_IWUSR:
                    files.append(entry.readlink())
    return [file for file in files if file.is_file()]


def _check_network(plan: ResolvedGraph, host: str | None) -> None:
    if host is not None and host not in plan.hosts:
        raise BadInputError.single(
            "--host", (), f'unknown host "{host}"', f"choose one of: {', '.join(plan.hosts)}"
        )
    for name, address in plan.hosts.items():
        if not is_loopback(address) and not plan.keys:
            raise read_launch_file(Path(plan.launch_file)).error(
                ("hosts", name, "address"),
                f"connections to {address} must be encrypted, but the hosts have no keys",
                f"create a key on each host (flexsheet keys {name}) and install all "
                f"of them: flexsheet keys {name} --install {plan.launch_file} --key KEY",
            )


def _check_ports(plan: ResolvedGraph, host: str | None) -> None:
    """Raise BadInputError if a TCP port of this launcher's processes is in use."""
    users = [(node, "127.0.0.1", port) for node, port in plan.listening_nodes(host)]
    for topic, writers in plan.writers.items():
        for writer in writers:
            if writer.tcp is not None and host in (None, writer.host):
                address, _, port = writer.tcp.removeprefix("tcp://").rpartition(":")
                users.append((f'topic "{topic}" of {writer.name}', address.strip("[]"), int(port)))
    problems = [
        Problem(
            plan.launch_file,
            (),
            f"port {port} of {address}, for {what}, is in use",
            "stop the other program or graph (flexsheet stop), or choose another port "
            "(--set NODE.PARAMETER=PORT)",
        )
        for what, address, port in users
        if not is_free(address, port)
    ]
    if problems:
        raise BadInputError(problems)
