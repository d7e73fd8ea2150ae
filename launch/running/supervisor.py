"""Start the nodes of a graph, restart failed nodes, and end all processes at the end.

    async with RunningGraph(plan) as graph:
        await graph.wait_ready()
        ...

Every process has its own session. A process runs one node, or all nodes that name the same process
in the launch file. It reports through a pipe that its nodes are ready. When it exits, its restart
policy is applied. To stop a process, the launcher sends SIGINT, SIGTERM and finally SIGKILL. The
launcher needs no threads. Its event loop waits for process file descriptors (pidfds), which report
the exit of a process, and for pipes with the logs and heartbeats of processes.
"""

from __future__ import annotations

import asyncio
import json
import os
import signal
import stat
import subprocess
import sys
from collections import deque
from collections.abc import Callable, Collection, Iterable, Mapping
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, Self

from flexsheet.launch.plans.documents import BadInputError, Problem
from flexsheet.launch.plans.hosts import clock_node, is_loopback
from flexsheet.launch.plans.launch_file import is_scene_file, read_launch_file
from flexsheet.launch.plans.needed_nodes import REASON_TEXTS
from flexsheet.launch.plans.plan import load_scene
from flexsheet.launch.plans.plan_model import (
    LAUNCHER,
    MAIN,
    RUN_DIRECTORY,
    ResolvedGraph,
    ResolvedNode,
    ResolvedPort,
    ResolvedProcess,
)
from flexsheet.launch.running.child import LIFELINE_VARIABLE, NICE_VARIABLE, PARENT_VARIABLE
from flexsheet.launch.running.code_state import read_git_state
from flexsheet.launch.running.fork_server import NODE_ARGUMENTS, ForkServer
from flexsheet.launch.running.host import HostAgent, make_output
from flexsheet.launch.running.keys import make_rings
from flexsheet.launch.running.priority import (
    describe_priority_problem,
    find_real_time_priority,
    min_nice_step,
)
from flexsheet.launch.running.runs import (
    HOST_FILE,
    RUN_VARIABLE,
    Run,
    create_run,
    is_free,
    list_live_runs,
    local_endpoints,
    local_sources,
    ring_file,
    sweep,
)
from flexsheet.launch.running.starvation import ProcessorTime, compute_starved_s
from flexsheet.messages.base import Message
from flexsheet.messages.bus import Publisher
from flexsheet.messages.clock import SystemClock
from flexsheet.messages.errors import FlexsheetError
from flexsheet.messages.files import write_file
from flexsheet.messages.scene import Scene
from flexsheet.messages.security import KeyRing
from flexsheet.messages.topics import find_topic
from flexsheet.messages.types import NodeProcess
from flexsheet.nodes import NodeRole
from flexsheet.nodes.node import Output
from flexsheet.nodes.runner import NodeConfig, PortConfig, ProcessConfig

SOFTWARE = Path(__file__).resolve().parents[2]
STOP_GRACE_S = 3.0
LIVENESS_PERIOD_S = 0.5
STACK_DUMP_S = 0.5
"""The time (s) for which a hanging node can log its call stacks before SIGKILL ends it."""

FORK_SERVER = "fork-server"
LOG_READ_BYTES = 65_536
GROUP_REAPS, GROUP_REAP_S = 20, 0.1
"""The number of attempts to reap the child processes of a node, and the time between them (s)."""

Report = Callable[[str, str], None]
"""A function that is called with (node, line) for each log line.

For log lines of the launcher, `node` is "launch".
"""


class NodeFailedError(FlexsheetError, RuntimeError):
    """Raised if a node fails more often than its restart policy allows."""

    remedy = (
        "Read the node's log above this text, or in the folder `logs` of the run. The first error "
        "in it is the cause."
    )


class Child:
    """A process of the operating system that runs one or more nodes."""

    def __init__(
        self,
        config: ProcessConfig,
        run: Run,
        environment: dict[str, str],
        lifeline: int,
        report: Report,
        *,
        fork_server: ForkServer | None = None,
    ) -> None:
        self._loop = asyncio.get_running_loop()
        self._name, self._report = config.name, report
        name = config.name
        config_file = config_path(run, name)
        self.ready: asyncio.Future[None] = self._loop.create_future()
        self.exited: asyncio.Future[int] = self._loop.create_future()
        self._partial = b""
        self._logs = {
            one: (run.logs / f"{one}.log").open("ab", buffering=0)
            for one in {name, *(node.name for node in config.nodes)}
        }
        self._output, output_write = os.pipe()
        self._ready_fd, ready_write = os.pipe()
        self._beats = 0
        self._reports = True
        try:
            with_pipe = config.model_copy(update={"ready_fd": ready_write})
            write_file(config_file, with_pipe.model_dump_json())
            self._process = (
                None
                if fork_server is None
                else fork_server.fork(config_file, environment, output_write, ready_write)
            ) or _start_python(
                config_file, environment, output_write, pass_fds=(ready_write, lifeline)
            )
        except BaseException:
            os.close(self._output)
            os.close(self._ready_fd)
            self._close_logs()
            raise
        finally:
            os.close(output_write)
            os.close(ready_write)
        self._pidfd = os.pidfd_open(self._process.pid)
        os.set_blocking(self._output, False)
        os.set_blocking(self._ready_fd, False)
        self._loop.add_reader(self._output, self._read_output)
        self._loop.add_reader(self._ready_fd, self._read_heartbeat)
        self._loop.add_reader(self._pidfd, self._reap)

    @property
    def pid(self) -> int:
        return self._process.pid

    def signal(self, number: int) -> None:
        """Send a signal to the process and to the other processes of its group.

        If the process has exited, nothing is sent. Worker processes have their own groups, and end
        when this process ends.
        """
        if not self.exited.done():
            # The process is not reaped yet, so its id cannot belong to another process.
            os.killpg(self.pid, number)

    def kill_now(self) -> None:
        """Kill and reap the process without the event loop, because the loop may be closing."""
        self.signal(signal.SIGKILL)
        if not self.exited.done():
            self._process.wait()
            self._reap()

    def _read_heartbeat(self) -> None:
        beats = os.read(self._ready_fd, 4096)
        self._beats += len(beats)
        if beats and not self.ready.done():
            self.ready.set_result(None)
        if not beats:
            self._loop.remove_reader(self._ready_fd)

    async def wait_until_silent(self, seconds: float, on_starved: Callable[[float], None]) -> None:
        """Wait until the process has sent no heartbeat for `seconds`.

        The launcher checks for heartbeats periodically, and adds up the periods without a
        heartbeat. It does not compare clock times, because a suspended launcher receives no
        heartbeats either.

        The time in which the process waits for a processor core is not counted. If the silence
        would otherwise exceed `seconds`, `on_starved` is called once with this waiting time (s).
        """
        beats, silence_s, waited_s, reported = self._beats, 0.0, 0.0, False
        before = ProcessorTime.read(self.pid)
        while silence_s < seconds:
            await asyncio.sleep(LIVENESS_PERIOD_S)
            now = ProcessorTime.read(self.pid)
            starved = compute_starved_s(before, now, LIVENESS_PERIOD_S)
            before, silence_s, waited_s = (
                now,
                silence_s + LIVENESS_PERIOD_S - starved,
                waited_s + starved,
            )
            if self._beats != beats:
                beats, silence_s, waited_s = self._beats, 0.0, 0.0
            elif not reported and silence_s < seconds <= silence_s + waited_s:
                reported = True
                on_starved(waited_s)

    def end_hanging(self) -> None:
        """Make a hanging process write its call stacks to the log, then kill the process."""
        self._reports = False
        self.signal(signal.SIGABRT)
        self._loop.call_later(STACK_DUMP_S, self.signal, signal.SIGKILL)

    def _read_output(self) -> bool:
        """Copy new output to the log and report its lines. Return False if there is no output."""
        try:
            piece = os.read(self._output, LOG_READ_BYTES)
        except BlockingIOError:
            return False
        if not piece:
            self._loop.remove_reader(self._output)
            return False
        *lines, self._partial = (self._partial + piece).split(b"\n")
        for line in lines:
            self._handle_line(line)
        return True

    def _handle_line(self, line: bytes) -> None:
        """Report an output line, and write it to the log of its node.

        If the line belongs to no node, it is written to the log of the process.
        """
        node = self._find_node(line)
        self._logs[node].write(line + b"\n")
        if self._reports:
            self._report(node, line.decode(errors="replace"))

    def _find_node(self, line: bytes) -> str:
        if len(self._logs) == 1 or not line.startswith(b"{"):
            return self._name
        try:
            node = json.loads(line).get("node")
        except ValueError:
            return self._name
        return node if node in self._logs else self._name

    def _close_logs(self) -> None:
        for log in self._logs.values():
            log.close()

    def _reap(self) -> None:
        """Handle the exit of the process.

        The child processes of this process are killed, its last output is read, and its pipes are
        closed.
        """
        if self.exited.done():
            return
        if self._process.returncode is None:
            # Until the process is reaped, no other process gets the id of its process group.
            os.killpg(self.pid, signal.SIGKILL)
            self._process.wait()
        self._reap_group(GROUP_REAPS)
        for fd in (self._pidfd, self._output, self._ready_fd):
            self._loop.remove_reader(fd)
        while self._read_output():
            pass
        if self._partial:
            self._handle_line(self._partial)
        for fd in (self._pidfd, self._output, self._ready_fd):
            os.close(fd)
        self._close_logs()
        self.exited.set_result(self._process.wait())

    def _reap_group(self, tries: int) -> None:
        """Reap the killed child processes of a node. The launcher has become their parent.

        tries: maximum number of further attempts.
        """
        try:
            while os.waitpid(-self.pid, os.WNOHANG) != (0, 0):
                pass
        except ChildProcessError:
            return
        if tries and not self._loop.is_closed():
            self._loop.call_later(GROUP_REAP_S, self._reap_group, tries - 1)


def _start_python(
    config_file: Path, environment: dict[str, str], output: int, *, pass_fds: tuple[int, int]
) -> subprocess.Popen[bytes]:
    # During the start of Python, SIGINT would raise KeyboardInterrupt. The first statement
    # of the process unblocks the signal.
    blocked = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        return subprocess.Popen(
            [*NODE_ARGUMENTS, "--node", str(config_file)],
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=output,
            start_new_session=True,
            pass_fds=pass_fds,
            env=environment,
        )
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, blocked)


def _own_module_folders(node_types: Iterable[str]) -> list[str]:
    """Return the folder of the running script if it contains modules of node classes.

    Python searches this folder only in the process of the script, not in those of the nodes.
    """
    file = getattr(sys.modules["__main__"], "__file__", None)
    script = Path.cwd() if file is None else Path(file).resolve().parent
    names = {one.partition(":")[0].partition(".")[0] for one in node_types if ":" in one}
    is_own = any((script / f"{one}.py").is_file() or (script / one).is_dir() for one in names)
    return [str(script)] if is_own else []


class RunningGraph:
    """A supervisor of the processes that run the nodes of a graph.

    host: host of the nodes to start. If it is None, the nodes of all hosts are started on this
        computer.
    without: names of nodes that are not started.
    report: function that is called with (node, line) for every log line. The folder `run.logs` also
        contains all lines.
    port_options: command-line options that set TCP ports, by parameter "node.name". Errors about
        occupied ports recommend these options. For other parameters, they recommend --set.
    """

    def __init__(
        self,
        plan: ResolvedGraph,
        *,
        host: str | None = None,
        without: Collection[str] = (),
        report: Report | None = None,
        port_options: Mapping[str, str] | None = None,
    ) -> None:
        self.plan, self._host, self._report_to = plan, host, report
        self._port_options = port_options
        self.nodes = [node for node in plan.nodes_on(host) if node.name not in without]
        self._processes = {one.name: one for one in plan.processes_on(host, without=without)}
        self.exit_codes: dict[str, int] = {}
        self.restarts: dict[str, int] = {node.name: 0 for node in self.nodes}
        self.hangs: dict[str, int] = {node.name: 0 for node in self.nodes}
        self.failure: NodeFailedError | None = None
        self._run: Run | None = None
        self._children: dict[str, Child] = {}
        self._supervisors: dict[str, asyncio.Task[None]] = {}
        self._ready = {node.name: asyncio.Event() for node in self.nodes}
        self._publishers: dict[str, Publisher] = {}
        self._outputs: dict[str, Output[Message]] = {}
        self._epoch_ns = 0
        self._agents: dict[str, HostAgent] = {}
        self._rings: dict[str, KeyRing] = {}
        self._lifeline: tuple[int, int] | None = None
        self._fork_server: ForkServer | None = None
        self._stopping = False

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
            self._start()
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
        waiting = [asyncio.ensure_future(event.wait()) for event in self._ready.values()]
        everyone = asyncio.ensure_future(asyncio.gather(*waiting))
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
            await asyncio.gather(end, everyone, *waiting, return_exceptions=True)
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
                f"readable messages to a new bag: flexsheet bag recover {bag} -o NEW",
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
        self._stopping = True
        for task in self._supervisors.values():
            task.cancel()
        try:
            await asyncio.gather(*self._supervisors.values(), return_exceptions=True)
            await self._end_children()
        finally:
            for child in self._children.values():
                child.kill_now()
            for name, child in self._children.items():
                self._set_exit_code(self._processes[name], child.exited.result())
            for publisher in self._publishers.values():
                publisher.close()
            self._publishers.clear()
            for agent in self._agents.values():
                await agent.close()
            if self._fork_server is not None:
                await self._fork_server.stop()
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
        readers = {
            name
            for name, process in self._processes.items()
            if all(_only_reads(node) for node in process.nodes)
        }
        arms = {
            name
            for name, process in self._processes.items()
            if {node.role for node in process.nodes} == {NodeRole.ARM_SIMULATOR}
        }
        others = self._children.keys() - readers - arms
        for names in (others, arms, readers):
            await self._terminate(
                [self._children[name] for name in names if name in self._children]
            )

    async def _terminate(self, children: list[Child]) -> None:
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGKILL):
            alive = [child for child in children if not child.exited.done()]
            if not alive:
                return
            self._send(number, alive)
            await asyncio.wait([child.exited for child in alive], timeout=STOP_GRACE_S)

    def _start(self) -> None:
        _check_network(self.plan, self._host)
        swept = sweep()
        self._run = create_run()
        if swept:
            self._report(LAUNCHER, f"ended {len(swept)} processes of earlier launchers")
        self._lifeline = os.pipe()
        if self._processes:
            # The fork server imports modules while this process prepares the run.
            self._start_fork_server()
        _check_ports(self.plan, self._host, self._port_options)
        if self.plan.keys:
            self._rings = make_rings(self.plan, self.run, self._host)
        self._write_run_files()
        if self._host in (None, MAIN):
            self._publish_latched("scene", self.plan.scene_message())
            self._publish_latched("twin/apparatus", self.plan.apparatus_message())
        for host in self.plan.hosts if self._host is None else [self._host]:
            self._start_agent(host)
        self._report(LAUNCHER, f"run {self.run.id}, plan {self.plan.hash}: {len(self.nodes)} nodes")
        for omitted in self.plan.omitted:
            self._report(LAUNCHER, f"{omitted.name} is not started: {REASON_TEXTS[omitted.reason]}")
        if problem := describe_priority_problem(self.nodes):
            self._report(LAUNCHER, problem)
        for name, process in self._processes.items():
            self._supervisors[name] = asyncio.create_task(self._supervise(process), name=name)

    def publish_scene(self, scene: Scene) -> int:
        """Replace the scene of the running graph, and return the source timestamp of the message.

        Raises RuntimeError if a node of the graph, such as the console, publishes the scene.
        """
        source_ns = self._publish_latched("scene", scene)
        if source_ns is None:
            raise RuntimeError(
                "a node of the graph publishes the scene; omit that node (--without NODE)"
            )
        return source_ns

    def _publish_latched(self, topic: str, message: Message | None) -> int | None:
        """Publish a message that later subscribers also receive.

        Returns the source timestamp (ns) of the message. Returns None if there is no message, or if
        the launcher is not a writer of the topic.
        """
        writer = self.plan.writer(topic, LAUNCHER)
        if message is None or writer is None:
            return None
        if topic not in self._outputs:
            self._publishers[topic] = publisher = Publisher(
                find_topic(topic),
                local_endpoints(self.run, writer.endpoints),
                keys=self._rings.get(MAIN),
                on_refused=partial(self._report, LAUNCHER),
            )
            clock = SystemClock()
            self._epoch_ns = self._epoch_ns or clock.now_ns()
            self._outputs[topic] = make_output(
                publisher, clock, writer=LAUNCHER, epoch=self._epoch_ns, plan=self.plan.hash
            )
        return self._outputs[topic].publish(message).source_ns

    def _start_agent(self, host: str) -> None:
        git = json.loads((self.run.directory / "git.json").read_text())
        agent = HostAgent(
            self.plan,
            host,
            run=self.run,
            code=f"{(git['commit'] or 'unknown')[:12]}{'+' if git['changed'] else ''}",
            processes=partial(self._list_states, host),
            pids=lambda: self.pids,
            keys=self._rings.get(host),
            on_problem=partial(self._report, LAUNCHER),
        )
        self._agents[host] = agent
        agent.start()

    def _list_states(self, host: str) -> tuple[NodeProcess, ...]:
        pids = self.pids
        return tuple(
            NodeProcess(
                name=node.name,
                state="ready"
                if self._ready[node.name].is_set()
                else "starting"
                if node.name in pids
                else "exited",
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

    async def _run_once(self, process: ResolvedProcess) -> str | None:
        """Run a process until it ends; return a text about its failure, or None if it succeeded."""
        child = await self._spawn(process)
        late = await self._is_late(child, process)
        if late:
            child.signal(signal.SIGKILL)
        elif child.ready.done():
            for node in process.nodes:
                self._ready[node.name].set()
            self._report(LAUNCHER, f"{_describe_process(process)} ready, pid {child.pid}")
        hangs = not late and await self._detect_hang(child, process)
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
        return describe_exit(code)

    async def _is_late(self, child: Child, process: ResolvedProcess) -> bool:
        """Wait until a process is ready, exits, or exceeds its start deadline.

        Returns whether the process exceeded the deadline. Waiting time for a processor core does
        not count.
        """
        on_starved = partial(self._report_starved, f"{process.name} is not ready yet")
        # A process sends its first heartbeat when it is ready.
        deadline = asyncio.ensure_future(
            child.wait_until_silent(process.start_deadline_s, on_starved)
        )
        try:
            await asyncio.wait(
                (child.ready, child.exited, deadline), return_when=asyncio.FIRST_COMPLETED
            )
        finally:
            deadline.cancel()
        return not child.ready.done() and not child.exited.done()

    def _set_exit_code(self, process: ResolvedProcess, code: int) -> None:
        self.exit_codes.update(dict.fromkeys((node.name for node in process.nodes), code))

    async def _detect_hang(self, child: Child, process: ResolvedProcess) -> bool:
        """Monitor a process until it exits or hangs; if it hangs, end it and return True."""
        liveness_s = process.settings.liveness_s
        if liveness_s is None:
            return False
        on_starved = partial(
            self._report_starved, f"{process.name} sends no heartbeat but does not hang"
        )
        silence = asyncio.ensure_future(child.wait_until_silent(liveness_s, on_starved))
        try:
            await asyncio.wait((silence, child.exited), return_when=asyncio.FIRST_COMPLETED)
            hangs = silence.done() and not child.exited.done()
        finally:
            silence.cancel()
        if hangs:
            child.end_hanging()
        return hangs

    def _report_starved(self, what: str, waited_s: float) -> None:
        self._report(
            LAUNCHER,
            f"{what}: it waited {waited_s:.1f} s for a processor core; this computer is "
            "overloaded, run fewer programs on it",
        )

    async def _spawn(self, process: ResolvedProcess) -> Child:
        assert self._lifeline is not None  # made before any supervisor
        nice = {NICE_VARIABLE: str(max(process.settings.nice, min_nice_step()))}
        config = ProcessConfig(
            name=process.name,
            nodes=tuple(node_config(self.plan, node, self.run) for node in process.nodes),
            realtime_priority=find_real_time_priority(process.settings.realtime_priority),
        )
        server = self._fork_server
        if server is not None and not await server.is_ready():
            if self._fork_server is not None:
                self._fork_server = None
                server.close()
                self._report(LAUNCHER, f"nodes are started without {FORK_SERVER}; see its log")
            server = None
        child = Child(
            config,
            self.run,
            {**self._environment(), **nice},
            self._lifeline[0],
            self._report,
            fork_server=server,
        )
        self._children[process.name] = child
        return child

    def _environment(self) -> dict[str, str]:
        assert self._lifeline is not None
        environment = {
            **os.environ,
            RUN_VARIABLE: self.run.id,
            PARENT_VARIABLE: str(os.getpid()),
            LIFELINE_VARIABLE: str(self._lifeline[0]),
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
        return environment

    def _start_fork_server(self) -> None:
        assert self._lifeline is not None
        with (self.run.logs / f"{FORK_SERVER}.log").open("ab", buffering=0) as log:
            self._fork_server = ForkServer(
                {node.type for node in self.nodes},
                [config_path(self.run, name) for name in self._processes],
                environment=self._environment(),
                lifeline=self._lifeline[0],
                log=log,
            )

    def _write_run_files(self) -> None:
        """Write the run's files for the recorder and for command-line tools."""
        directory = self.run.directory
        write_file(directory / "launch.yaml", self.plan.launch_text)
        write_file(directory / "scene.yaml", self.plan.scene_text)
        write_file(directory / "git.json", read_git_state(SOFTWARE))
        if self._host is not None:
            write_file(directory / HOST_FILE, self._host)
        if any(port.topic == "scene" for node in self.nodes for port in node.outputs):
            self._write_scenes(directory / "scenes")
        # The plan is written last and atomically, because tools find a graph by this file.
        text = self.plan.model_dump_json(indent=1)
        write_file(self.run.plan_file, text)

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
        self.failure = NodeFailedError(f"{text}; its log is in {self.run.logs}")
        self._report(LAUNCHER, text)
        return self.failure

    def _report(self, node: str, line: str) -> None:
        if node == LAUNCHER and self._run is not None:
            with (self._run.logs / f"{LAUNCHER}.log").open("a") as log:
                log.write(line + "\n")
        if self._report_to is not None:
            self._report_to(node, line)


def config_path(run: Run, process: str) -> Path:
    """Return the path of the configuration file of a process."""
    return run.directory / f"{process}.json"


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
    try:
        entries = list(Path(f"/proc/{pid}/fd").iterdir())
    except OSError:
        return []
    files = []
    for entry in entries:
        # The process may have closed the file since.
        with suppress(OSError):
            # The permissions of an entry are the access mode of its descriptor.
            if entry.lstat().st_mode & stat.S_IWUSR:
                files.append(entry.readlink())
    return [file for file in files if file.is_file()]


def node_config(plan: ResolvedGraph, node: ResolvedNode, run: Run) -> NodeConfig:
    """Return the configuration of a node in a run.

    In the endpoints, the placeholder of the run's directory is replaced by its path.
    """

    def outputs(planned: tuple[ResolvedPort, ...]) -> tuple[PortConfig, ...]:
        return tuple(
            PortConfig(
                port=port.port, topic=port.topic, endpoints=local_endpoints(run, port.endpoints)
            )
            for port in planned
        )

    def inputs(planned: tuple[ResolvedPort, ...]) -> tuple[PortConfig, ...]:
        return tuple(
            PortConfig(
                port=port.port,
                topic=port.topic,
                endpoints=local_sources(
                    run,
                    [
                        source
                        for source in plan.sources_to_read(port.topic, node.host)
                        if source.endpoint in port.endpoints
                    ],
                ),
            )
            for port in planned
        )

    return NodeConfig(
        name=node.name,
        type=node.type,
        parameters=_fill_run(node.parameters, run),
        inputs=inputs(node.inputs),
        outputs=outputs(node.outputs),
        plan_hash=plan.hash,
        run_dir=str(run.directory),
        keys_file=ring_file(run, node.host) if plan.keys else None,
        estop_resetters=plan.may_reset_estop(),
        clocks=_clocks_port(plan, node.host, run),
    )


def _clocks_port(plan: ResolvedGraph, host: str, run: Run) -> PortConfig | None:
    writer = plan.writer("clocks", clock_node(host))
    if writer is None:
        return None
    endpoints = local_sources(run, [writer.source_for(host)])
    return PortConfig(port="clocks", topic="clocks", endpoints=endpoints)


def describe_exit(code: int) -> str | None:
    """Return a text about the failure that an exit code indicates, or None if the code is 0."""
    if code == 0:
        return None
    if code < 0:
        return f"was ended by {signal.Signals(-code).name}"
    return f"ended with exit code {code}"


def _fill_run(value: Any, run: Run) -> Any:
    if isinstance(value, str) and value.startswith(f"{RUN_DIRECTORY}/"):
        return str(run.directory / value.removeprefix(f"{RUN_DIRECTORY}/"))
    if isinstance(value, dict):
        return {key: _fill_run(item, run) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_fill_run(item, run) for item in value]
    return value


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
                f"create a key on each host (flexsheet keys new {name}) and install all "
                f"of them: flexsheet keys install {plan.launch_file} {name} KEY",
            )


def _name_port_options(plan: ResolvedGraph, port: int, options: Mapping[str, str]) -> str:
    """Return the command-line options by which the user can change an occupied TCP port.

    The options, which are a part of an error text, cover all nodes that listen on the port or
    connect to it. The result is empty if no parameter contains the port.

    port: number of the port.
    options: option for each parameter "node.name" that has a special option. For other parameters,
        the option is --set.
    """
    names = [
        options.get(f"{node.name}.{name}", f"--set {node.name}.{name}=PORT")
        for node in plan.nodes.values()
        for name, value in node.parameters.items()
        if value == port and (port in node.listen_ports or node.device_address)
    ]
    return f": {' '.join(names)}" if names else ""


def _list_ports(plan: ResolvedGraph, host: str | None) -> list[tuple[str, str, int]]:
    """Return the user, the address and the number of each TCP port of a launcher's processes."""
    topics = [
        (f'topic "{topic}" of {writer.name}', *writer.tcp.removeprefix("tcp://").rsplit(":", 1))
        for topic, writers in plan.writers.items()
        for writer in writers
        if writer.tcp is not None and host in (None, writer.host)
    ]
    return [(what, address.strip("[]"), int(port)) for what, address, port in topics] + [
        (node, "127.0.0.1", port) for node, port in plan.listening_nodes(host)
    ]


def _find_port_users() -> dict[tuple[str, int], Run]:
    """Return a mapping from (address, TCP port) to the running graph that uses the port.

    Only graphs of this user are found.
    """
    users: dict[tuple[str, int], Run] = {}
    for run in list_live_runs():
        try:
            plan = ResolvedGraph.model_validate_json(run.plan_file.read_text())
        except (OSError, ValueError):
            # The graph is starting, has ended, or belongs to another version of flexsheet.
            continue
        users |= {(address, port): run for _, address, port in _list_ports(plan, run.host)}
    return users


def _check_ports(
    plan: ResolvedGraph, host: str | None, port_options: Mapping[str, str] | None = None
) -> None:
    """Raise BadInputError if a TCP port of this launcher's processes is in use.

    port_options: see `RunningGraph`.
    """
    used = [one for one in _list_ports(plan, host) if not is_free(*one[1:])]
    if not used:
        return
    users = _find_port_users()

    def make_problem(what: str, address: str, port: int) -> Problem:
        text = f"port {port} of {address}, for {what}, is in use"
        remedy = "stop the other program"
        if (run := users.get((address, port))) is not None:
            text += f" by the running graph of {run.launch_file}"
            remedy = f"stop it: flexsheet stop --run {run.directory}"
        options = _name_port_options(plan, port, port_options or {})
        return Problem(plan.launch_file, (), text, f"{remedy}, or choose another port{options}")

    raise BadInputError([make_problem(*one) for one in used])
