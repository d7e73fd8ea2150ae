"""Starts a plan's nodes, keeps them running, and leaves nothing behind.

    async with RunningGraph(plan) as graph:
        await graph.wait_ready()
        ...

Every node is a process in a session of its own.  It says through a pipe that it is set up; when it
ends by itself its restart policy decides.  At the end each gets SIGINT, then SIGTERM, then SIGKILL.
No thread is used: exits come as readable pidfds, logs and readiness through pipes.
"""

from __future__ import annotations

import asyncio
import json
import os
import signal
import subprocess
import sys
from collections import deque
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from flexsheet.launch.plans.documents import BadInputError, Problem, read_document
from flexsheet.launch.plans.hosts import clock_node, is_loopback
from flexsheet.launch.plans.plan import load_scene
from flexsheet.launch.plans.plan_model import (
    LAUNCHER,
    MAIN,
    RUN_DIRECTORY,
    ResolvedGraph,
    ResolvedNode,
    ResolvedPort,
)
from flexsheet.launch.running.child import LIFELINE_VARIABLE, NICE_VARIABLE, PARENT_VARIABLE
from flexsheet.launch.running.code_state import git_state
from flexsheet.launch.running.host import HostAgent
from flexsheet.launch.running.keys import KeyWatch, make_rings
from flexsheet.launch.running.priority import min_nice_step, precedence_problem
from flexsheet.launch.running.runs import (
    HOST_FILE,
    RUN_VARIABLE,
    Run,
    create_run,
    is_free,
    local_endpoints,
    local_sources,
    ring_file,
    sweep,
)
from flexsheet.launch.running.starvation import ProcessorTime, starved_s
from flexsheet.messages.base import Header
from flexsheet.messages.bus import Publisher
from flexsheet.messages.clock import SystemClock
from flexsheet.messages.errors import FlexsheetError
from flexsheet.messages.files import write_file
from flexsheet.messages.security import KeyRing, SecurityError
from flexsheet.messages.topics import topic_named
from flexsheet.messages.types import NodeProcess
from flexsheet.nodes.runner import NodeConfig, PortConfig

SOFTWARE = Path(__file__).resolve().parents[2]
STOP_GRACE_S = 3.0
KEYS_PERIOD_S = 1.0
LIVENESS_TURN_S = 0.5
LAST_WORDS_S = 0.5
"""For a hanging node to write where it is."""

LOG_READ_BYTES = 65_536

Report = Callable[[str, str], None]
"""Gets each line of a node's log, and the launcher's own words as those of "launch"."""


class NodeFailedError(FlexsheetError, RuntimeError):
    """A node failed for good: it ended, or was not ready in time, more often than it may."""

    code = "node-failed"
    remedy = (
        "Read the node's log above the text, or in the folder `logs` of the run. Its first error "
        "is the cause."
    )


class Child:
    """One start of a node's process."""

    def __init__(
        self,
        config: NodeConfig,
        run: Run,
        environment: dict[str, str],
        lifeline: int,
        report: Report,
    ) -> None:
        self._loop = asyncio.get_running_loop()
        self._node, self._report = config.name, report
        config_file = run.directory / f"{config.name}.json"
        self.ready: asyncio.Future[None] = self._loop.create_future()
        self.exited: asyncio.Future[int] = self._loop.create_future()
        self._partial = b""
        self._log = (run.logs / f"{config.name}.log").open("ab", buffering=0)
        self._output, output_write = os.pipe()
        self._ready_fd, ready_write = os.pipe()
        self._signs = 0
        self._reports = True
        try:
            with_pipe = config.model_copy(update={"ready_fd": ready_write})
            write_file(config_file, with_pipe.model_dump_json())
            # While Python starts, SIGINT would raise; the node's first statement unblocks it.
            blocked = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
            try:
                self._process = subprocess.Popen(
                    [sys.executable, "-P", "-m", "flexsheet", "--node", str(config_file)],
                    stdin=subprocess.DEVNULL,
                    stdout=output_write,
                    stderr=output_write,
                    start_new_session=True,
                    pass_fds=(ready_write, lifeline),
                    env=environment,
                )
            finally:
                signal.pthread_sigmask(signal.SIG_SETMASK, blocked)
        except BaseException:
            os.close(self._output)
            os.close(self._ready_fd)
            self._log.close()
            raise
        finally:
            os.close(output_write)
            os.close(ready_write)
        self._pidfd = os.pidfd_open(self._process.pid)
        os.set_blocking(self._output, False)
        os.set_blocking(self._ready_fd, False)
        self._loop.add_reader(self._output, self._read_output)
        self._loop.add_reader(self._ready_fd, self._read_life)
        self._loop.add_reader(self._pidfd, self._reap)

    @property
    def pid(self) -> int:
        return self._process.pid

    def signal(self, number: int) -> None:
        """Signal the node and all that it started; nothing if it has ended."""
        if not self.exited.done():
            # Not reaped yet, so the number still is its own.
            os.killpg(self.pid, number)

    def kill_now(self) -> None:
        """Kill and reap without waiting for the loop: for when the loop is being torn down."""
        self.signal(signal.SIGKILL)
        if not self.exited.done():
            self._process.wait()
            self._reap()

    def _read_life(self) -> None:
        signs = os.read(self._ready_fd, 4096)
        self._signs += len(signs)
        if signs and not self.ready.done():
            self.ready.set_result(None)
        if not signs:
            self._loop.remove_reader(self._ready_fd)

    async def silent_for(self, seconds: float, on_starved: Callable[[float], None]) -> None:
        """Until it has given no sign of life for so long, though we have listened all the while.

        What counts is our own turns, not the clock: a launcher that stood still itself (suspended,
        starved) has heard nobody, and that is nobody's fault.  Nor does the time count in which the
        process waited for a processor; `on_starved` is called once with that time when it alone
        has kept the process from being taken for hanging.
        """
        heard, silence_s, waited_s, reported = self._signs, 0.0, 0.0, False
        before = ProcessorTime.of(self.pid)
        while silence_s < seconds:
            await asyncio.sleep(LIVENESS_TURN_S)
            now = ProcessorTime.of(self.pid)
            starved = starved_s(before, now, LIVENESS_TURN_S)
            before, silence_s, waited_s = (
                now,
                silence_s + LIVENESS_TURN_S - starved,
                waited_s + starved,
            )
            if self._signs != heard:
                heard, silence_s, waited_s = self._signs, 0.0, 0.0
            elif not reported and silence_s < seconds <= silence_s + waited_s:
                reported = True
                on_starved(waited_s)

    def end_hanging(self) -> None:
        """Make it write to its log where it hangs (Python's fault handler does), then kill it."""
        self._reports = False
        self.signal(signal.SIGABRT)
        self._loop.call_later(LAST_WORDS_S, self.signal, signal.SIGKILL)

    def _read_output(self) -> bool:
        """Copy a piece of output to the log and report its lines; False when none is left."""
        try:
            piece = os.read(self._output, LOG_READ_BYTES)
        except BlockingIOError:
            return False
        if not piece:
            self._loop.remove_reader(self._output)
            return False
        self._log.write(piece)
        *lines, self._partial = (self._partial + piece).split(b"\n")
        for line in lines:
            self._report_line(line)
        return True

    def _report_line(self, line: bytes) -> None:
        if self._reports:
            self._report(self._node, line.decode(errors="replace"))

    def _reap(self) -> None:
        """The process has ended: end what it started, read the rest of its words, let go."""
        if self.exited.done():
            return
        if self._process.returncode is None:
            # A zombie keeps its group's number from being taken by others.
            os.killpg(self.pid, signal.SIGKILL)
            self._process.wait()
        for fd in (self._pidfd, self._output, self._ready_fd):
            self._loop.remove_reader(fd)
        while self._read_output():
            pass
        if self._partial:
            self._report_line(self._partial)
        for fd in (self._pidfd, self._output, self._ready_fd):
            os.close(fd)
        self._log.close()
        self.exited.set_result(self._process.returncode)


class RunningGraph:
    """A plan's nodes as processes.

    host: start only that host's nodes; None: all, which needs all hosts to be this machine.
    report: called with (node, line) for every line of log; all is in `run.logs` anyway.
    """

    def __init__(
        self, plan: ResolvedGraph, *, host: str | None = None, report: Report | None = None
    ) -> None:
        self.plan, self._host, self._report_to = plan, host, report
        self.nodes = plan.nodes_on(host)
        self.exit_codes: dict[str, int] = {}
        self.restarts: dict[str, int] = {node.name: 0 for node in self.nodes}
        self.hangs: dict[str, int] = {node.name: 0 for node in self.nodes}
        self.failure: NodeFailedError | None = None
        self._run: Run | None = None
        self._children: dict[str, Child] = {}
        self._supervisors: dict[str, asyncio.Task[None]] = {}
        self._ready = {node.name: asyncio.Event() for node in self.nodes}
        self._publishers: list[Publisher] = []
        self._agents: dict[str, HostAgent] = {}
        self._rings: dict[str, KeyRing] = {}
        self._keys_watch: asyncio.Task[None] | None = None
        self._lifeline: tuple[int, int] | None = None
        self._stopping = False

    @property
    def run(self) -> Run:
        """The run's directory, logs and identity; there once the graph was started."""
        if self._run is None:
            raise RuntimeError("the graph has not been started")
        return self._run

    @property
    def pids(self) -> dict[str, int]:
        """Process ids of the nodes that run now."""
        return {
            name: child.pid for name, child in self._children.items() if not child.exited.done()
        }

    def is_ready(self, node: str) -> bool:
        """Whether the node's present process has said that it is set up."""
        return self._ready[node].is_set()

    async def __aenter__(self) -> Self:
        try:
            self._start()
        except BaseException:
            await self.stop()
            raise
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        await self.stop()

    async def wait_ready(self, timeout_s: float | None = None) -> None:
        """Until every node is set up; raises NodeFailedError when one cannot be, TimeoutError."""
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
                # Nodes that finished their work before all were ready count as ready.
                end.result()
                return
        finally:
            end.cancel()
            everyone.cancel()
            await asyncio.gather(end, everyone, *waiting, return_exceptions=True)
        late = [name for name, event in self._ready.items() if not event.is_set()]
        raise TimeoutError(f"not ready within {timeout_s} s: {', '.join(late)}")

    async def wait_ready_again(self, node: str, restarts: int) -> None:
        """Until the node was restarted `restarts` times in all and is ready."""
        while self.restarts[node] < restarts or not self._ready[node].is_set():
            if self._supervisors[node].done():
                self._supervisors[node].result()
                raise NodeFailedError(f"{node} has ended")
            await asyncio.sleep(0.02)

    async def wait(self) -> None:
        """Until every node has ended by itself; raises NodeFailedError when one failed for good."""
        pending: set[asyncio.Task[None]] = set(self._supervisors.values())
        while pending:
            done, pending = await asyncio.wait(pending, return_when=asyncio.FIRST_COMPLETED)
            for supervisor in done:
                if not supervisor.cancelled():
                    supervisor.result()

    def kill(self, node: str, number: int = signal.SIGKILL) -> None:
        """Send a signal to a node's process, as trouble would."""
        os.kill(self.pids[node], number)

    def kill_all(self) -> None:
        """Kill all nodes at once, for somebody who will not wait for `stop`."""
        for child in self._children.values():
            child.signal(signal.SIGKILL)

    async def stop(self) -> None:
        """End all nodes (SIGINT, SIGTERM, SIGKILL) and remove sockets; may be called twice."""
        self._stopping = True
        watches = [] if self._keys_watch is None else [self._keys_watch]
        for task in (*self._supervisors.values(), *watches):
            task.cancel()
        try:
            await asyncio.gather(*self._supervisors.values(), *watches, return_exceptions=True)
            await self._end_children()
        finally:
            for child in self._children.values():
                child.kill_now()
            for name, child in self._children.items():
                self.exit_codes[name] = child.exited.result()
            for publisher in self._publishers:
                publisher.close()
            self._publishers.clear()
            for agent in self._agents.values():
                await agent.close()
            if self._lifeline is not None:
                for fd in self._lifeline:
                    os.close(fd)
                self._lifeline = None
            if self._run is not None:
                self._run.end()

    async def _end_children(self) -> None:
        """End the nodes; those that only listen come last, to hear the others' last words."""
        listeners = {
            node.name
            for node in self.nodes
            if all(port.topic == "status" for port in node.outputs) and node.inputs
        }
        speakers = self._children.keys() - listeners
        for names in (speakers, listeners):
            await _end([self._children[name] for name in names if name in self._children])

    def _start(self) -> None:
        _refuse_open_network(self.plan, self._host)
        swept = sweep()
        self._run = create_run()
        if swept:
            self._report(LAUNCHER, f"ended {len(swept)} processes of launchers that are gone")
        _check_ports(self.plan, self._host)
        if self.plan.keys:
            self._rings = make_rings(self.plan, self.run, self._host)
            self._keys_watch = asyncio.create_task(self._watch_keys(), name="keys")
        self._write_run_files()
        self._lifeline = os.pipe()
        if self._host in (None, MAIN):
            self._publish_scene()
        for host in self.plan.hosts if self._host is None else [self._host]:
            self._start_agent(host)
        self._report(LAUNCHER, f"run {self.run.id}, plan {self.plan.hash}: {len(self.nodes)} nodes")
        if problem := precedence_problem(self.nodes):
            self._report(LAUNCHER, problem)
        for node in self.nodes:
            self._supervisors[node.name] = asyncio.create_task(
                self._supervise(node), name=node.name
            )

    def _publish_scene(self) -> None:
        scene = self.plan.scene_message()
        writer = self.plan.writer("scene", LAUNCHER)
        if scene is None or writer is None:
            return
        publisher = Publisher(
            topic_named("scene"),
            local_endpoints(self.run, writer.endpoints),
            keys=self._rings.get(MAIN),
            on_refused=partial(self._report, LAUNCHER),
        )
        self._publishers.append(publisher)
        clock = SystemClock()
        now_ns = clock.now_ns()
        publisher.send(
            scene,
            Header(
                sequence=1,
                source_ns=now_ns,
                publish_ns=now_ns,
                clock_id=clock.id,
                writer=LAUNCHER,
                epoch=now_ns,
                plan=self.plan.hash,
            ),
        )

    def _start_agent(self, host: str) -> None:
        git = json.loads((self.run.directory / "git.json").read_text())
        agent = HostAgent(
            self.plan,
            host,
            run_id=self.run.id,
            code=f"{(git['commit'] or 'unknown')[:12]}{'+' if git['changed'] else ''}",
            processes=partial(self._processes, host),
            pids=lambda: self.pids,
            endpoints=partial(local_endpoints, self.run),
            sources=partial(local_sources, self.run),
            keys=self._rings.get(host),
            on_problem=partial(self._report, LAUNCHER),
            run_directory=self.run.directory,
        )
        self._agents[host] = agent
        agent.start()

    def _processes(self, host: str) -> tuple[NodeProcess, ...]:
        return tuple(
            NodeProcess(
                name=node.name,
                state="ready"
                if self._ready[node.name].is_set()
                else "starting"
                if node.name in self.pids
                else "exited",
                restarts=self.restarts[node.name],
                hangs=self.hangs[node.name],
            )
            for node in self.nodes
            if node.host == host
        )

    async def _watch_keys(self) -> None:
        """Pass on what changes about the keys in the launch file or in our own files of them."""
        watch = KeyWatch(self.plan, self.run, self._rings)
        said = ""
        while True:
            await asyncio.sleep(KEYS_PERIOD_S)
            try:
                changes = watch.look()
            except (BadInputError, SecurityError, OSError) as error:
                if str(error) != said:
                    said = str(error)
                    self._report(LAUNCHER, f"keys stay as they were: {said}")
                continue
            for host, change in changes.items():
                said = ""
                self._report(LAUNCHER, f"keys of {host} are read anew")
                if host == MAIN:
                    for publisher in self._publishers:
                        publisher.renew_keys(change)
                if host in self._agents:
                    self._agents[host].renew_keys(change)

    async def _supervise(self, node: ResolvedNode) -> None:
        """Run the node again and again, as its policy says; NodeFailedError when for good."""
        policy = node.restart
        recent: deque[float] = deque()
        loop = asyncio.get_running_loop()
        while True:
            problem = await self._run_once(node)
            if policy.policy == "never" or (policy.policy == "on_failure" and problem is None):
                if problem is not None:
                    raise self._fail(f"{node.name} {problem}")
                self._ready[node.name].set()
                self._report(LAUNCHER, f"{node.name} finished")
                return
            while recent and recent[0] < loop.time() - policy.window_s:
                recent.popleft()
            if len(recent) >= policy.max_restarts:
                raise self._fail(
                    f"{node.name} {problem or 'ended'}, after {len(recent)} restarts "
                    f"in {policy.window_s:g} s"
                )
            delay_s = min(policy.delay_s * 2 ** len(recent), policy.max_delay_s)
            recent.append(loop.time())
            self._report(
                LAUNCHER, f"{node.name} {problem or 'ended'}; starts again in {delay_s:g} s"
            )
            await asyncio.sleep(delay_s)
            self.restarts[node.name] += 1

    async def _run_once(self, node: ResolvedNode) -> str | None:
        """One life of a node; returns what was wrong with its end, None if nothing was."""
        child = self._spawn(node)
        await asyncio.wait(
            (child.ready, child.exited),
            timeout=node.start_deadline_s,
            return_when=asyncio.FIRST_COMPLETED,
        )
        late = not child.ready.done() and not child.exited.done()
        if late:
            child.signal(signal.SIGKILL)
        elif child.ready.done():
            self._ready[node.name].set()
            self._report(LAUNCHER, f"{node.name} is ready, pid {child.pid}")
        hangs = not late and await self._outlives(child, node)
        # The future must outlive this task's cancellation: `stop` waits for it too.
        code = await asyncio.shield(child.exited)
        self._ready[node.name].clear()
        self.exit_codes[node.name] = code
        if late:
            return f"was not ready within {node.start_deadline_s:g} s"
        if hangs:
            self.hangs[node.name] += 1
            return f"hung: no sign of life for {node.liveness_s:g} s; its log shows where"
        return describe_exit(code)

    async def _outlives(self, child: Child, node: ResolvedNode) -> bool:
        """Whether the process hangs, and so has to be ended; False when it ends by itself."""
        if node.liveness_s is None:
            return False

        def on_starved(waited_s: float) -> None:
            self._report(
                LAUNCHER,
                f"{node.name} is starved, not hung: it waited {waited_s:.1f} s for a processor; "
                "this computer has too much to do",
            )

        silence = asyncio.ensure_future(child.silent_for(node.liveness_s, on_starved))
        try:
            await asyncio.wait((silence, child.exited), return_when=asyncio.FIRST_COMPLETED)
            hangs = silence.done() and not child.exited.done()
        finally:
            silence.cancel()
        if hangs:
            child.end_hanging()
        return hangs

    def _spawn(self, node: ResolvedNode) -> Child:
        assert self._lifeline is not None  # made before any supervisor
        environment = {
            **os.environ,
            RUN_VARIABLE: self.run.id,
            PARENT_VARIABLE: str(os.getpid()),
            LIFELINE_VARIABLE: str(self._lifeline[0]),
            NICE_VARIABLE: str(max(node.nice, min_nice_step())),
            "PYTHONUNBUFFERED": "1",
            "PYTHONFAULTHANDLER": "1",
        }
        # A process per node already uses the cores; threads of BLAS would spin against them.
        for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
            environment.setdefault(variable, "1")
        config = node_config(self.plan, node, self.run)
        child = Child(config, self.run, environment, self._lifeline[0], self._report)
        self._children[node.name] = child
        return child

    def _write_run_files(self) -> None:
        """What a recorder attaches and what tools find the graph by."""
        directory = self.run.directory
        write_file(directory / "launch.yaml", self.plan.launch_text)
        write_file(directory / "scene.yaml", self.plan.scene_text)
        write_file(directory / "git.json", git_state(SOFTWARE))
        if self._host is not None:
            write_file(directory / HOST_FILE, self._host)
        if any(port.topic == "scene" for node in self.nodes for port in node.outputs):
            self._write_scenes(directory / "scenes")
        # Last and at once: tools that look for a graph read this file.
        text = self.plan.model_dump_json(indent=1)
        write_file(self.run.plan_file, text)

    def _write_scenes(self, folder: Path) -> None:
        """The scenes that a node may publish: those beside the plan's own, checked, as JSON."""
        folder.mkdir()
        own = self.plan.scene_file
        for path in [] if own is None else sorted(Path(own).parent.glob("*.yaml")):
            try:
                write_file(folder / f"{path.stem}.json", load_scene(path).model_dump_json())
            except BadInputError as error:
                self._report(LAUNCHER, f"scene {path.name} is left out: {error}")

    def _fail(self, text: str) -> NodeFailedError:
        self.failure = NodeFailedError(f"{text}; its log is {self.run.logs}")
        self._report(LAUNCHER, text)
        return self.failure

    def _report(self, node: str, line: str) -> None:
        if node == LAUNCHER and self._run is not None:
            with (self._run.logs / f"{LAUNCHER}.log").open("a") as log:
                log.write(line + "\n")
        if self._report_to is not None:
            self._report_to(node, line)


async def _end(children: list[Child]) -> None:
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGKILL):
        alive = [child for child in children if not child.exited.done()]
        if not alive:
            return
        for child in alive:
            child.signal(number)
        await asyncio.wait([child.exited for child in alive], timeout=STOP_GRACE_S)


def node_config(plan: ResolvedGraph, node: ResolvedNode, run: Run) -> NodeConfig:
    """What a node's process is told, with the run's directory filled in."""

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
    """An exit code in words; None for a good one."""
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


def _refuse_open_network(plan: ResolvedGraph, host: str | None) -> None:
    if host is not None and host not in plan.hosts:
        raise BadInputError(
            [Problem("--host", (), f'unknown host "{host}"', f"there are: {', '.join(plan.hosts)}")]
        )
    for name, address in plan.hosts.items():
        if not is_loopback(address) and not plan.keys:
            raise BadInputError(
                [
                    read_document(Path(plan.launch_file)).problem(
                        ("hosts", name, "address"),
                        f"{address} is beyond loopback and there are no keys",
                        f"make one on each host (flexsheet keys new {name}) and put all of them "
                        f"here: flexsheet keys install {plan.launch_file} {name} KEY",
                    )
                ]
            )


def _check_ports(plan: ResolvedGraph, host: str | None) -> None:
    """Every TCP port that this launcher's processes will listen on must be free."""
    wanted = [
        (f'topic "{topic}" of {writer.name}', *writer.tcp.removeprefix("tcp://").rsplit(":", 1))
        for topic, writers in plan.writers.items()
        for writer in writers
        if writer.tcp is not None and host in (None, writer.host)
    ]
    wanted += [(node, "127.0.0.1", str(port)) for node, port in plan.listening_nodes(host)]
    problems = [
        Problem(
            plan.launch_file,
            (),
            f"port {port} of {address}, for {what}, is in use",
            "is a graph running already? other ports go by --set NODE.PARAMETER=PORT",
        )
        for what, address, port in wanted
        if not is_free(address.strip("[]"), int(port))
    ]
    if problems:
        raise BadInputError(problems)
