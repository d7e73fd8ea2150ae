"""Publish the state of a host, and latch emergency stops for nodes that start later.

A host is one computer of the graph, and an arm bridge is the node that controls an arm. When a
bridge restarts, the tool or node that published the emergency stop (e-stop) has possibly exited.
Each launcher therefore stores the last e-stop and publishes it to the nodes of its host, until a
permitted writer resets it. If the arms are armed manually, the launcher also stores the e-stop in a
file, so that it survives the exit of all launchers.
"""

from __future__ import annotations

import asyncio
import os
import sys
from collections.abc import Callable, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import psutil
import zmq

from flexsheet.launch.plans.hosts import clock_node, launcher_on
from flexsheet.launch.plans.plan_model import ArmingMode, ResolvedGraph, ResolvedNode, tools_on
from flexsheet.launch.running.estop_file import EStopFile
from flexsheet.launch.running.runs import Run, local_sources
from flexsheet.launch.running.tools import TopicWriters
from flexsheet.messages.base import Header, Message
from flexsheet.messages.bus import Handler, Source, Subscriber
from flexsheet.messages.clock_table import MAX_STAMP_AHEAD_NS, ClockTable
from flexsheet.messages.security import KeyRing
from flexsheet.messages.topics import find_topic
from flexsheet.messages.types import (
    ArmState,
    EStop,
    HostKey,
    HostStatus,
    NodeOmission,
    NodeProcess,
)
from flexsheet.nodes import NodeRole
from flexsheet.nodes.node import PortCounts
from flexsheet.nodes.stop_socket import StopSocket

PERIOD_S = 1.0
REASON_LENGTH = 1000
"""The maximum length (characters) of an e-stop's reason, so that it fits into every message."""

RESET_WITHIN_S = 5.0
"""The time (s) in which all arms must confirm the reset of an e-stop."""

ARMS = ("arm_left", "arm_right")
TOPICS = ("host", "estop", "scene", "twin/apparatus")
"""The topics that the launcher publishes if it is a writer of them."""


class HostAgent:
    """A part of the launcher that publishes the status of its host and latches e-stops.

    The agent works between the calls of `start` and `close`.

    code: git commit of the running code, which is a part of the published status.
    processes: function that returns the states of the processes of the host's nodes.
    """

    def __init__(
        self,
        plan: ResolvedGraph,
        host: str,
        *,
        run: Run,
        code: str,
        processes: Callable[[], tuple[NodeProcess, ...]],
        keys: KeyRing | None,
        on_problem: Callable[[str], None],
    ) -> None:
        self._plan, self._host, self._run, self._code = plan, host, run, code
        self._processes, self._keys, self._on_problem = processes, keys, on_problem
        self._name = launcher_on(host)
        # Launchers repeat the e-stop, so a restarted launcher gets it from the other launchers.
        self._launchers = {launcher_on(name) for name in plan.hosts}
        writers = {topic: plan.writer(topic, self._name) for topic in TOPICS}
        self._writable = {topic: one for topic, one in writers.items() if one is not None}
        self._writers = TopicWriters(plan, run, self._writable, keys, on_problem)
        self._clock = self._writers.clock
        self._begun_ns = self._clock.now_ns()
        self._clock_table = ClockTable(self._clock.id)
        self._subscribers: list[Subscriber] = []
        self._task: asyncio.Task[None] | None = None
        self._latched: EStop | None = None
        self._engaged_ns = 0
        self._resetting: asyncio.Task[None] | None = None
        self._file = EStopFile(host, list_arms(plan)) if has_manual_arming(plan) else None
        self._stop_socket = StopSocket(run.directory, "launcher", self._name, self._stop)
        self._file_outdated = False
        self._status_error = ""
        nodes = plan.nodes_on(host)
        self._devices, self._folder = list_device_files(nodes), find_recording_folder(nodes)

    async def start(self) -> None:
        """Subscribe to e-stops and start to publish."""
        await self._stop_socket.open()
        stored = None if self._file is None else self._file.read()
        if stored is not None:
            self._on_problem(
                f"an e-stop was engaged before this start: {stored.reason}; the arms do not move "
                "until it is reset: flexsheet arms reset"
            )
            self._engage(stored, self._clock.now_ns())
        others = [
            source
            for source in self._plan.sources_to_read("estop", self._host)
            if source.writer != self._name
        ]
        self._subscribers.append(self._subscribe("estop", others, self._latch_estop))
        measured = self._plan.writer("clocks", clock_node(self._host))
        if measured is not None:
            source = measured.source_for(self._host)
            self._subscribers.append(
                self._subscribe(
                    "clocks", [source], lambda clocks, _: self._clock_table.update(clocks)
                )
            )
        self._task = asyncio.create_task(self._publish_loop(), name=f"host {self._host}")

    def _subscribe(self, topic: str, sources: list[Source], handler: Handler) -> Subscriber:
        subscriber = Subscriber(
            find_topic(topic),
            local_sources(self._run, sources),
            handler,
            PortCounts(),
            on_problem=self._on_problem,
            keys=self._keys,
            plan=self._plan.hash,
        )
        subscriber.start()
        return subscriber

    async def close(self) -> None:
        """Stop publishing, and close all sockets. Further calls have no effect."""
        self._stop_socket.close()
        for task in (self._task, self._resetting):
            if task is not None:
                task.cancel()
                await asyncio.gather(task, return_exceptions=True)
        for subscriber in self._subscribers:
            subscriber.close()
        self._writers.close()

    def _stop(self, reason: str) -> None:
        """Engage an e-stop that `flexsheet arms stop` has sent through the local socket."""
        writer = tools_on(self._host)
        self._on_problem(_describe_estop(writer, reason))
        self._engage(EStop(engaged=True, reason=reason), self._clock.now_ns())

    def _latch_estop(self, estop: EStop, header: Header) -> None:
        now_ns = self._clock.now_ns()
        _, header, clock_problem = self._clock_table.localize(estop, header, now_ns)
        if estop.engaged:
            if self._latched is not None and header.writer in self._launchers:
                return
            if self._latched is None:
                self._on_problem(_describe_estop(header.writer, estop.reason))
            # With a timestamp in the future, every later reset would be ignored as older.
            self._engage(estop, now_ns if clock_problem else min(header.source_ns, now_ns))
        elif header.writer in self._plan.may_reset_estop() and self._latched is not None:
            # A late subscriber receives the last message of each writer in any order, so a reset
            # that arrives last can be older than the stop.
            if header.source_ns < self._engaged_ns:
                return
            if header.source_ns > now_ns + MAX_STAMP_AHEAD_NS:
                clock_problem = clock_problem or "its timestamp is in the future"
            if clock_problem:
                self._on_problem(f"e-stop not reset by {header.writer}: {clock_problem}")
            elif self._resetting is None or self._resetting.done():
                self._resetting = asyncio.create_task(self._reset(header.writer, self._latched))

    def _engage(self, estop: EStop, at_ns: int) -> None:
        before = self._latched
        self._latched = EStop(engaged=True, reason=estop.reason[:REASON_LENGTH])
        self._engaged_ns = max(self._engaged_ns, at_ns)
        self.publish("estop", self._latched)
        if before != self._latched:
            self._update_file()

    async def _reset(self, writer: str, latched: EStop) -> None:
        """Release the e-stop when all arms have confirmed the reset.

        Arms in motion refuse the reset. The result is passed to the function `on_problem`.
        """
        stopped = {topic for topic in ARMS if self._plan.writers.get(topic)}
        all_clear = asyncio.Event()

        def on_state(state: ArmState, _: Header) -> None:
            if not has_estop(state):
                stopped.discard(f"arm_{state.side}")
            if not stopped:
                all_clear.set()

        arms = [
            self._subscribe(topic, list(self._plan.sources_to_read(topic, self._host)), on_state)
            for topic in stopped
        ]
        engaged_before_ns = self._engaged_ns
        try:
            if stopped:
                await asyncio.wait([asyncio.create_task(all_clear.wait())], timeout=RESET_WITHIN_S)
        finally:
            for subscriber in arms:
                subscriber.close()
        if self._latched is not latched or self._engaged_ns != engaged_before_ns:
            self._on_problem(f"e-stop not reset by {writer}: it was engaged again")
        elif stopped:
            self._on_problem(
                f"e-stop not reset by {writer}: {', '.join(sorted(stopped))} did not confirm it "
                f"within {RESET_WITHIN_S:g} s; when their bridges run and the arms are at rest: "
                "flexsheet arms reset"
            )
        else:
            self._on_problem(f"e-stop reset by {writer}")
            self._latched = None
            self._writers.forget("estop")
            self._update_file()

    def _update_file(self) -> None:
        """Write or remove the file of the latched e-stop. If this fails, try again periodically."""
        if self._file is None:
            return
        try:
            if self._latched is None:
                self._file.remove()
            else:
                self._file.write(self._latched)
        except OSError as error:
            if not self._file_outdated:
                effect = "engages it again" if self._latched is None else "does not engage it"
                self._on_problem(
                    f"e-stop: {self._file.path} cannot be written ({error.strerror}); if all "
                    f"launchers exit, the next start {effect}"
                )
            self._file_outdated = True
        else:
            self._file_outdated = False

    def publish(self, topic: str, message: Message | None) -> int | None:
        """Publish a message, and return its source timestamp (ns).

        Returns None if there is no message, or if the launcher is not a writer of the topic.
        """
        if message is None or topic not in self._writable:
            return None
        return self._writers.publish(topic, message).source_ns

    async def _publish_loop(self) -> None:
        while True:
            try:
                self.publish("host", self._status())
            except OSError as error:
                problem = f"the status of this host cannot be read: {error}"
                if problem != self._status_error:
                    self._on_problem(problem)
                self._status_error = problem
            if self._file_outdated:
                self._update_file()
            await asyncio.sleep(PERIOD_S)

    def _status(self) -> HostStatus:
        disk = os.statvfs(self._folder)
        return HostStatus(
            host=self._host,
            run=self._run.id,
            plan_hash=self._plan.hash,
            code=self._code,
            python=python_version(),
            uptime_s=(self._clock.now_ns() - self._begun_ns) * 1e-9,
            load_ratio=os.getloadavg()[0] / (os.cpu_count() or 1),
            disk_free_bytes=disk.f_bavail * disk.f_frsize,
            memory_free_bytes=psutil.virtual_memory().available,
            nodes=self._processes(),
            omitted=tuple(
                NodeOmission(name=one.name, reason=one.reason.value)
                for one in self._plan.omitted
                if one.host == self._host
            ),
            missing_devices=tuple(one for one in self._devices if not os.path.exists(one)),
            software=software(),
            keys=()
            if self._keys is None
            else tuple(HostKey(host=name, key=key) for name, key in self._keys.public.items()),
            estop=None if self._latched is None else self._latched.reason,
        )


def _describe_estop(writer: str, reason: str) -> str:
    return f"e-stop of {writer}, latched until it is reset: {reason}"


def has_estop(state: ArmState) -> bool:
    """Return whether the node that controls an arm has engaged an e-stop."""
    return state.mode == "estop" or state.estop_engaged


def list_arms(plan: ResolvedGraph) -> list[str]:
    """Return the network addresses of the arms.

    If an arm has no address, the text "HOST/NODE" is returned for it. It names the node that
    controls the arm.
    """
    bridges = [node for node in plan.nodes.values() if node.role is NodeRole.ARM_BRIDGE]
    return [bridge.device_address or f"{bridge.host}/{bridge.name}" for bridge in bridges]


def has_manual_arming(plan: ResolvedGraph) -> bool:
    """Return whether at least one arm of the graph moves only after a user's command."""
    return any(node.arming is ArmingMode.MANUAL for node in plan.nodes.values())


def python_version() -> str:
    return ".".join(map(str, sys.version_info[:3]))


def software() -> str:
    """Return a text with the versions of libraries. The versions should be equal on all hosts."""
    try:
        own = version("flexsheet")
    except PackageNotFoundError:
        own = "not installed"
    return f"flexsheet {own}, pyzmq {zmq.pyzmq_version()}, libzmq {zmq.zmq_version()}"


def list_device_files(nodes: Sequence[ResolvedNode]) -> list[str]:
    """Return the sorted paths of the device files that the nodes open."""
    return sorted({file for node in nodes for file in node.device_files})


def find_recording_folder(nodes: list[ResolvedNode]) -> Path:
    """Return the folder of the recorder's bag file.

    The free disk space of this folder is reported. If there is no recorder, or if the recorder's
    folder does not exist, the working folder is returned.
    """
    for node in nodes:
        if node.role is NodeRole.RECORDER:
            folder = Path(str(node.parameters["bag"])).parent
            if folder.is_dir():
                return folder
    return Path.cwd()
