"""Read the state of every host of a graph over the network, from one of the graph's hosts.

A running launcher publishes the state of its host on the topics `host`, `status`, `clocks`, and the
topics of its arms. If no message arrives from another host, the probe finds the step at which the
connection fails.
"""

from __future__ import annotations

import asyncio
import errno
import os
import socket
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

import zmq
from zmq.utils.monitor import parse_monitor_message

from flexsheet.launch.plans.hosts import is_loopback, launcher_on
from flexsheet.launch.plans.plan_model import ResolvedGraph, Writer
from flexsheet.launch.running.runs import Run, local_sources
from flexsheet.messages.base import Header
from flexsheet.messages.bus import Source, Subscriber
from flexsheet.messages.security import KeyRing
from flexsheet.messages.topics import find_topic
from flexsheet.messages.types import ArmState, Clocks, HostStatus, Status
from flexsheet.nodes import NodeRole
from flexsheet.nodes.node import PortCounts

CONNECT_S = 4.0
"""The time limit (s) of a connection attempt.

The kernel needs 3 s to report that no host has the address.
"""

HANDSHAKE_S = 3.0
MIN_LISTEN_S = 1.2
"""The minimum time (s) for which messages from a host are read.

Nodes publish their message rates once per second.
"""

POLL_PERIOD_S = 0.02


class Reachability(StrEnum):
    """The result of an attempt to connect to the launcher of a host."""

    RESPONDING = "responding"
    LOCAL = "local"
    """The host is this computer, and no graph is running on it."""
    UNREACHABLE = "unreachable"
    CLOSED = "closed"
    """The host is on, but no program listens at the port."""
    KEY_MISMATCH = "key_mismatch"
    """The key of the host differs from the host's key in the launch file of this computer."""
    KEY_REJECTED = "key_rejected"
    """The host rejects the key of this computer, or does not encrypt."""
    SILENT = "silent"
    """The host accepts connections, but no status message of the host arrived."""
    OWN_KEY_INVALID = "own_key_invalid"
    """The host is on, but this computer has no usable key with which it could connect."""


HANDSHAKES: dict[int, Reachability] = {
    zmq.EVENT_HANDSHAKE_SUCCEEDED: Reachability.RESPONDING,
    zmq.EVENT_HANDSHAKE_FAILED_AUTH: Reachability.KEY_REJECTED,
    zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL: Reachability.KEY_REJECTED,
    zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL: Reachability.KEY_MISMATCH,
}


@dataclass(slots=True)
class HostProbe:
    """The messages that were received from one host, and the problems that occurred meanwhile.

    problem: reason of the system why the host cannot be reached.
    refused: reasons why messages were rejected.
    failed_handshakes: texts about connections that failed after an earlier successful connection.
    """

    host: str
    reachability: Reachability
    problem: str = ""
    status: HostStatus | None = None
    clock_id: str = ""
    nodes: dict[str, Status] = field(default_factory=dict)
    clocks: Clocks | None = None
    arms: dict[str, ArmState] = field(default_factory=dict)
    refused: list[str] = field(default_factory=list)
    failed_handshakes: list[str] = field(default_factory=list)


async def probe_all(
    plan: ResolvedGraph, *, here: str, keys: KeyRing | None, run: Run | None, timeout_s: float
) -> dict[str, HostProbe]:
    """Read the state of all hosts of a graph concurrently, and return the results by host name.

    here: name of this host.
    keys: key ring of this host; None if no key can be used.
    run: running graph on this host; None if no graph runs here.
    timeout_s: maximum time for which messages of a host are read.
    """
    probes = await asyncio.gather(
        *(
            _probe_local(plan, host, run, timeout_s)
            if host == here
            else _probe_remote(plan, host, here, keys, timeout_s)
            for host in plan.hosts
        )
    )
    return {probe.host: probe for probe in probes}


async def _probe_local(
    plan: ResolvedGraph, host: str, run: Run | None, timeout_s: float
) -> HostProbe:
    if run is None:
        return HostProbe(host, Reachability.LOCAL)

    def find_source(writer: Writer) -> Source:
        return local_sources(run, [writer.source_for(host)])[0]

    probe = HostProbe(host, Reachability.RESPONDING)
    await _listen(plan, probe, None, find_source, timeout_s)
    return probe


async def _probe_remote(
    plan: ResolvedGraph, host: str, here: str, keys: KeyRing | None, timeout_s: float
) -> HostProbe:
    writer = plan.writer("host", launcher_on(host))
    # A graph of several hosts has a TCP endpoint for each writer.
    assert writer is not None
    assert writer.tcp is not None
    address, port = plan.hosts[host], int(writer.tcp.rpartition(":")[2])
    if number := await connect(address, port):
        closed = number == errno.ECONNREFUSED
        reachability = Reachability.CLOSED if closed else Reachability.UNREACHABLE
        return HostProbe(host, reachability, problem=os.strerror(number))
    if keys is None and (plan.keys or not is_loopback(address)):
        return HostProbe(host, Reachability.OWN_KEY_INVALID)
    probe = HostProbe(host, await _try_handshake(writer.tcp, host, keys))
    if probe.reachability is Reachability.RESPONDING:
        await _listen(plan, probe, keys, lambda one: one.source_for(here), timeout_s)
    return probe


async def connect(address: str, port: int) -> int:
    """Connect to a TCP port; return 0, or the error number if the connection fails."""
    family = socket.AF_INET6 if ":" in address else socket.AF_INET
    with socket.socket(family, socket.SOCK_STREAM) as probe:
        probe.setblocking(False)
        try:
            async with asyncio.timeout(CONNECT_S):
                await asyncio.get_running_loop().sock_connect(probe, (address, port))
        except OSError as error:
            # A TimeoutError is an OSError without an error number.
            return error.errno or errno.ETIMEDOUT
    return 0


async def _try_handshake(endpoint: str, host: str, keys: KeyRing | None) -> Reachability:
    opened: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.SUB)
    opened.setsockopt(zmq.LINGER, 0)
    monitor = opened.get_monitor_socket(sum(HANDSHAKES))
    try:
        if keys is not None:
            keys.set_client_keys(opened, host)
        opened.connect(endpoint)
        for _ in range(round(HANDSHAKE_S / POLL_PERIOD_S)):
            try:
                event = parse_monitor_message(monitor.recv_multipart(zmq.NOBLOCK))
            except zmq.Again:
                await asyncio.sleep(POLL_PERIOD_S)
                continue
            return HANDSHAKES[int(event["event"])]
    finally:
        opened.disable_monitor()
        monitor.close(linger=0)
        opened.close(linger=0)
    return Reachability.SILENT


async def _listen(
    plan: ResolvedGraph,
    probe: HostProbe,
    keys: KeyRing | None,
    find_source: Callable[[Writer], Source],
    timeout_s: float,
) -> None:
    """Read messages of a host until all expected messages have arrived or `timeout_s` has passed.

    If no status message of the host arrives, the reachability of the probe becomes SILENT.

    find_source: function that returns the endpoint at which a given publisher can be read.
    timeout_s: maximum time for which messages are read.
    """

    def on_host(status: HostStatus, header: Header) -> None:
        probe.status, probe.clock_id = status, header.clock_id

    def on_status(status: Status, _: Header) -> None:
        probe.nodes[status.node] = status

    def on_clocks(clocks: Clocks, _: Header) -> None:
        probe.clocks = clocks

    def on_arm(arm: ArmState, _: Header) -> None:
        probe.arms[arm.side] = arm

    handlers: dict[str, Callable[[Any, Header], None]] = {
        "host": on_host,
        "status": on_status,
        "clocks": on_clocks,
        "arm_left": on_arm,
        "arm_right": on_arm,
    }
    subscribers = []
    for topic, handler in handlers.items():
        own = [one for one in plan.writers.get(topic, ()) if one.host == probe.host]
        if own:
            subscribers.append(
                Subscriber(
                    find_topic(topic),
                    [find_source(one) for one in own],
                    handler,
                    PortCounts(),
                    on_problem=probe.refused.append,
                    on_handshake_failed=probe.failed_handshakes.append,
                    keys=keys,
                )
            )
    try:
        for subscriber in subscribers:
            subscriber.start()
        await asyncio.sleep(MIN_LISTEN_S)
        for _ in range(round(max(0.0, timeout_s - MIN_LISTEN_S) / POLL_PERIOD_S)):
            if _is_complete(plan, probe):
                break
            await asyncio.sleep(POLL_PERIOD_S)
    finally:
        for subscriber in subscribers:
            subscriber.close()
    if probe.status is None:
        probe.reachability = Reachability.SILENT


def _is_complete(plan: ResolvedGraph, probe: HostProbe) -> bool:
    nodes = plan.nodes_on(probe.host)
    return (
        probe.status is not None
        and all(node.name in probe.nodes for node in nodes)
        and (probe.clocks is not None or all(node.role is not NodeRole.CLOCK for node in nodes))
        and len(probe.arms) >= sum(node.role is NodeRole.ARM_BRIDGE for node in nodes)
    )
