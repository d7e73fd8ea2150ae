"""Asks every host of a plan how it is, from one of them.

A host whose launcher runs speaks for itself: `host`, `status`, `clocks`, its arm.  Of one that says
nothing is told how far one comes: no way there, nobody at that address, a closed port, a connection
in which nobody speaks, a key that does not fit.
"""

from __future__ import annotations

import asyncio
import errno
import socket
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal

import zmq
from zmq.utils.monitor import parse_monitor_message

from flexsheet.launch.plans.hosts import is_loopback, launcher_on
from flexsheet.launch.plans.plan_model import ResolvedGraph, Writer
from flexsheet.launch.running.runs import Run, local_sources
from flexsheet.messages.base import Header
from flexsheet.messages.bus import Source, Subscriber
from flexsheet.messages.security import KeyRing
from flexsheet.messages.topics import topic_named
from flexsheet.messages.types import ArmState, Clocks, HostStatus, Status
from flexsheet.nodes import NodeRole
from flexsheet.nodes.node import PortCounts

CONNECT_S = 4.0
"""Longer than the three seconds after which the kernel knows that nobody has the address."""

HANDSHAKE_S = 3.0
LEAST_S = 1.2
"""Rates are those of a node's last second, told once a second."""

TURN_S = 0.02
SECURE_SHELL = 22
"""Whether this port is open or closed, who answers is there."""

Reach = Literal[
    "speaks",
    "itself",  # here, and no graph runs
    "no way",
    "absent",
    "dropped",
    "blocked",
    "closed",
    "silent",
    "other key",
    "refuses us",
    "no keys",
    "mute",
    "unasked",  # our own keys cannot be used
]

HANDSHAKES: dict[int, Reach] = {
    zmq.EVENT_HANDSHAKE_SUCCEEDED: "speaks",
    zmq.EVENT_HANDSHAKE_FAILED_AUTH: "refuses us",
    zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL: "no keys",
    zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL: "other key",
}


@dataclass(slots=True)
class Visit:
    """The answers of one host, and the problems that reading them met.

    refused: messages that were not accepted.  failed_handshakes: connections that did not prove
    their key though an earlier one did.
    """

    host: str
    reach: Reach
    status: HostStatus | None = None
    clock_id: str = ""
    nodes: dict[str, Status] = field(default_factory=dict)
    clocks: Clocks | None = None
    arms: dict[str, ArmState] = field(default_factory=dict)
    refused: list[str] = field(default_factory=list)
    failed_handshakes: list[str] = field(default_factory=list)


async def probe_all(
    plan: ResolvedGraph, *, here: str, keys: KeyRing | None, run: Run | None, patience_s: float
) -> dict[str, Visit]:
    """Ask all hosts at once.

    here: the host that asks.  keys: its keys; None where there are none, or none that can be used.
    run: its graph; None: none runs.
    """
    visits = await asyncio.gather(
        *(
            _visit_here(plan, host, run, patience_s)
            if host == here
            else _visit(plan, host, here, keys, patience_s)
            for host in plan.hosts
        )
    )
    return {one.host: one for one in visits}


async def _visit_here(plan: ResolvedGraph, host: str, run: Run | None, patience_s: float) -> Visit:
    if run is None:
        return Visit(host, "itself")
    visit = Visit(host, "speaks")
    await _listen(
        plan,
        visit,
        None,
        lambda writer: local_sources(run, [writer.source_for(host)])[0],
        patience_s,
    )
    if visit.status is None:
        visit.reach = "mute"
    return visit


async def _visit(
    plan: ResolvedGraph, host: str, here: str, keys: KeyRing | None, patience_s: float
) -> Visit:
    writer = plan.writer("host", launcher_on(host))
    # A plan of several hosts has a tcp endpoint for each writer.
    assert writer is not None
    assert writer.tcp is not None
    address, port = plan.hosts[host], int(writer.tcp.rpartition(":")[2])
    reach = await probe_port(address, port)
    if reach != "speaks":
        return Visit(host, reach)
    if keys is None and (plan.keys or not is_loopback(address)):
        return Visit(host, "unasked")
    visit = Visit(host, await _shake_hands(writer.tcp, host, keys))
    if visit.reach == "speaks":
        await _listen(plan, visit, keys, lambda one: one.source_for(here), patience_s)
        if visit.status is None:
            visit.reach = "mute"
    return visit


async def probe_port(address: str, port: int) -> Reach:
    """How far one comes towards a port by TCP; "speaks": it takes connections."""
    number = await _connect(address, port)
    if number == 0:
        return "speaks"
    if number == errno.ECONNREFUSED:
        return "closed"
    if number == errno.ENETUNREACH:
        return "no way"
    somebody = await _connect(address, SECURE_SHELL) in (0, errno.ECONNREFUSED)
    if somebody:
        return "blocked"
    return "absent" if number == errno.EHOSTUNREACH else "dropped"


async def _connect(address: str, port: int) -> int:
    """The error number with which connecting ends; 0: it did not fail."""
    family = socket.AF_INET6 if ":" in address else socket.AF_INET
    with socket.socket(family, socket.SOCK_STREAM) as probe:
        probe.setblocking(False)
        try:
            async with asyncio.timeout(CONNECT_S):
                await asyncio.get_running_loop().sock_connect(probe, (address, port))
        except OSError as error:
            # TimeoutError is one, with no number.
            return error.errno or errno.ETIMEDOUT
    return 0


async def _shake_hands(endpoint: str, host: str, keys: KeyRing | None) -> Reach:
    """Whether each end proves to the other that it has its key."""
    opened: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.SUB)
    opened.setsockopt(zmq.LINGER, 0)
    monitor = opened.get_monitor_socket(sum(HANDSHAKES))
    try:
        if keys is not None:
            keys.seek(opened, host)
        opened.connect(endpoint)
        for _ in range(round(HANDSHAKE_S / TURN_S)):
            try:
                event = parse_monitor_message(monitor.recv_multipart(zmq.NOBLOCK))
            except zmq.Again:
                await asyncio.sleep(TURN_S)
                continue
            return HANDSHAKES[int(event["event"])]
    finally:
        opened.disable_monitor()
        monitor.close(linger=0)
        opened.close(linger=0)
    return "silent"


async def _listen(
    plan: ResolvedGraph,
    visit: Visit,
    keys: KeyRing | None,
    source_of: Callable[[Writer], Source],
    patience_s: float,
) -> None:
    """Hear what a host says of itself, until it has said all or patience ends."""

    def take_host(status: HostStatus, header: Header) -> None:
        visit.status, visit.clock_id = status, header.clock_id

    def take_status(status: Status, _: Header) -> None:
        visit.nodes[status.node] = status

    def take_clocks(clocks: Clocks, _: Header) -> None:
        visit.clocks = clocks

    def take_arm(arm: ArmState, _: Header) -> None:
        visit.arms[arm.side] = arm

    handlers: dict[str, Callable[[Any, Header], None]] = {
        "host": take_host,
        "status": take_status,
        "clocks": take_clocks,
        "arm_left": take_arm,
        "arm_right": take_arm,
    }
    subscribers = []
    for topic, handler in handlers.items():
        own = [one for one in plan.writers.get(topic, ()) if one.host == visit.host]
        if own:
            subscribers.append(
                Subscriber(
                    topic_named(topic),
                    [source_of(one) for one in own],
                    handler,
                    PortCounts(),
                    on_problem=visit.refused.append,
                    on_handshake_failed=visit.failed_handshakes.append,
                    keys=keys,
                )
            )
    try:
        for subscriber in subscribers:
            subscriber.start()
        await asyncio.sleep(LEAST_S)
        for _ in range(round(max(0.0, patience_s - LEAST_S) / TURN_S)):
            if _has_said_all(plan, visit):
                break
            await asyncio.sleep(TURN_S)
    finally:
        for subscriber in subscribers:
            subscriber.close()


def _has_said_all(plan: ResolvedGraph, visit: Visit) -> bool:
    nodes = plan.nodes_on(visit.host)
    return (
        visit.status is not None
        and all(node.name in visit.nodes for node in nodes)
        and (visit.clocks is not None or all(node.role is not NodeRole.CLOCK for node in nodes))
        and len(visit.arms) >= sum(node.role is NodeRole.ARM_BRIDGE for node in nodes)
    )
