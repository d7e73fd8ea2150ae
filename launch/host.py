"""What a launcher says of its host, and the e-stop that it keeps for nodes that come late.

An e-stop is said by whoever sees the danger, and he may be gone when a bridge is started anew: a
tool, a node that has crashed.  Each launcher therefore repeats the last one to its host's nodes, as
a writer of its own, until one who may resets it.
"""

from __future__ import annotations

import asyncio
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import psutil

from launch.plan import launcher_on
from launch.planned import Plan, PlannedNode
from messages.base import Header, Message
from messages.bus import Publisher, Source, Subscriber
from messages.clock import SystemClock
from messages.security import KeyChange, KeyRing
from messages.topics import topic_named
from messages.types import EStop, HostStatus, NodeProcess
from nodes.node import PortCounts

PERIOD_S = 1.0
DEVICES = "/dev/"

Processes = Callable[[], tuple[NodeProcess, ...]]
Endpoints = Callable[[tuple[str, ...]], tuple[str, ...]]
Sources = Callable[[list[Source]], tuple[Source, ...]]


class HostVoice:
    """The launcher's part in the graph, for one host; use between `start` and `close`.

    endpoints, sources: fill in the run's directory.  code: the commit, for `HostStatus`.
    """

    def __init__(
        self,
        plan: Plan,
        host: str,
        *,
        run_id: str,
        code: str,
        processes: Processes,
        endpoints: Endpoints,
        sources: Sources,
        keys: KeyRing | None,
        on_problem: Callable[[str], None],
    ) -> None:
        self._plan, self._host, self._run_id, self._code = plan, host, run_id, code
        self._processes, self._keys, self._on_problem = processes, keys, on_problem
        self._sources = sources
        self._clock = SystemClock()
        self._name, self._epoch = launcher_on(host), self._clock.now_ns()
        # Started anew, it learns from the others; what it knows already is no news from them.
        self._launchers = {launcher_on(name) for name in plan.hosts}
        self._sequence = {"host": 0, "estop": 0}
        self.publishers: dict[str, Publisher] = {}
        for topic in self._sequence:
            writer = plan.writer(topic, self._name)
            if writer is not None:
                self.publishers[topic] = Publisher(
                    topic_named(topic),
                    endpoints(writer.endpoints),
                    keys=keys,
                    on_refused=on_problem,
                )
        self._heard: Subscriber | None = None
        self._task: asyncio.Task[None] | None = None
        self._kept: EStop | None = None
        nodes = plan.nodes_on(host)
        self._devices, self._folder = devices_of(nodes), folder_of(nodes)

    def start(self) -> None:
        """Begin to listen and to speak; needs a running loop."""
        others = [
            source
            for source in self._plan.sources_to_read("estop", self._host)
            if source.writer != self._name
        ]
        self._heard = Subscriber(
            topic_named("estop"),
            self._sources(others),
            self._keep,
            PortCounts(),
            on_problem=self._on_problem,
            keys=self._keys,
            plan=self._plan.hash,
        )
        self._heard.start()
        self._task = asyncio.create_task(self._speak(), name=f"host {self._host}")

    def renew_keys(self, change: KeyChange) -> None:
        """Take over keys that have been read anew."""
        for publisher in self.publishers.values():
            publisher.renew_keys(change)
        if self._heard is not None:
            self._heard.renew_keys(change)

    async def close(self) -> None:
        """Fall silent; may be called twice."""
        if self._task is not None:
            self._task.cancel()
            await asyncio.gather(self._task, return_exceptions=True)
        if self._heard is not None:
            self._heard.close()
        for publisher in self.publishers.values():
            publisher.close()

    def _keep(self, estop: EStop, header: Header) -> None:
        if estop.engaged:
            if self._kept is not None and header.writer in self._launchers:
                return
            if self._kept is None:
                self._on_problem(f"e-stop of {header.writer}, kept until it is reset")
            self._kept = estop
            self._publish("estop", estop)
        elif header.writer in self._plan.may_reset_estop() and self._kept is not None:
            self._on_problem(f"e-stop reset by {header.writer}")
            self._kept = None
            self.publishers["estop"].forget()

    def _publish(self, topic: str, message: Message) -> None:
        if topic not in self.publishers:
            return
        self._sequence[topic] += 1
        now_ns = self._clock.now_ns()
        header = Header(
            sequence=self._sequence[topic],
            source_ns=now_ns,
            publish_ns=now_ns,
            clock_id=self._clock.id,
            writer=self._name,
            epoch=self._epoch,
            plan=self._plan.hash,
        )
        self.publishers[topic].send(message, header)

    async def _speak(self) -> None:
        while True:
            self._publish("host", self._status())
            await asyncio.sleep(PERIOD_S)

    def _status(self) -> HostStatus:
        disk = os.statvfs(self._folder)
        return HostStatus(
            host=self._host,
            run=self._run_id,
            plan_hash=self._plan.hash,
            code=self._code,
            python=".".join(map(str, sys.version_info[:3])),
            uptime_s=(self._clock.now_ns() - self._epoch) * 1e-9,
            load_ratio=os.getloadavg()[0] / (os.cpu_count() or 1),
            disk_free_bytes=disk.f_bavail * disk.f_frsize,
            memory_free_bytes=psutil.virtual_memory().available,
            nodes=self._processes(),
            missing_devices=tuple(one for one in self._devices if not os.path.exists(one)),
        )


def devices_of(nodes: list[PlannedNode]) -> list[str]:
    """Device files that the nodes' parameters name."""

    def texts(value: Any) -> list[str]:
        if isinstance(value, str):
            return [value]
        if isinstance(value, dict):
            value = list(value.values())
        return [text for one in value for text in texts(one)] if isinstance(value, list) else []

    found = [text for node in nodes for text in texts(node.parameters)]
    return sorted({text for text in found if text.startswith(DEVICES)})


def folder_of(nodes: list[PlannedNode]) -> Path:
    """Where the host's recorder writes; the working folder where there is none, or not yet."""
    for node in nodes:
        if node.type == "recorder":
            folder = Path(str(node.parameters["bag"])).parent
            if folder.is_dir():
                return folder
    return Path.cwd()
