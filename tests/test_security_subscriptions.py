"""Test that a peer cannot fill the memory of a publisher, or prevent the publisher from sending."""

from __future__ import annotations

import asyncio
import json
import socket
import struct
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from itertools import repeat
from pathlib import Path
from random import Random
from typing import Any

import pytest
import zmq

from flexsheet.messages import connection_guard
from flexsheet.messages.connection_guard import THREAD_NAME
from tests.examples import long_except
from tests.test_messages_bus import Connections, connections, header, stop
from tests.test_security import ESTOP, SecuredPublisher, secured
from tests.waiting import until

__all__ = ["connections", "secured"]

ROOT = Path(__file__).resolve().parent.parent
ATTACK_BYTES = 12_000_000
ATTACKERS = 2
MAX_GROWTH_KB = 256_000
"""Memory that is used before the guard's thread runs on a busy computer; the attack would use
0.5 GB."""

MAX_CONNECTIONS_OF_ATTACKER = 12
DEADLINE_S = 60

PUBLISHER = """
import asyncio, json, sys
from pathlib import Path
from flexsheet.messages.base import Header
from flexsheet.messages.bus import Publisher
from flexsheet.messages.security import KeyRing
from flexsheet.messages.topics import TOPICS
from tests.test_messages_bus import finger, stop

def peak_kb():
    status = Path("/proc/self/status").read_text()
    return int(status.partition("VmHWM:")[2].split()[0])

async def main():
    topic = TOPICS[sys.argv[1]]
    make = stop if topic.name == "estop" else (lambda text: finger(float(text)))
    refused = []
    keys = KeyRing(Path(sys.argv[2])) if len(sys.argv) > 2 else None
    publisher = Publisher(topic, ["tcp://127.0.0.1:*"], keys=keys, on_refused=refused.append)
    print(publisher.endpoints[0], flush=True)
    loop = asyncio.get_running_loop()
    finished = loop.run_in_executor(None, sys.stdin.readline)
    before = peak_kb()
    sequence = 0
    while not finished.done():
        sequence += 1
        publisher.send(make(str(sequence)), Header(sequence, 0, 0, "c", "planner", 1))
        await asyncio.sleep(0.002)
    print(json.dumps({"growth_kb": peak_kb() - before, "refused": refused}), flush=True)
    publisher.close()

asyncio.run(main())
"""

ATTACKER_WITH_KEY = """
import sys
from pathlib import Path
from random import Random
import zmq
from flexsheet.messages.security import KeyRing

context = zmq.Context()
opened = context.socket(zmq.XSUB)
opened.setsockopt(zmq.SNDTIMEO, 200)
KeyRing(Path(sys.argv[2])).set_client_keys(opened, "main")
opened.connect(sys.argv[1])
random = Random(1)
try:
    for _ in range(int(sys.argv[3]) // 450):
        opened.send(b"\\x01" + random.randbytes(449))
except zmq.Again:
    pass
opened.close(linger=500)
context.term()
"""

GREETING = struct.pack("<B8xBBB20sB31x", 0xFF, 0x7F, 3, 1, b"NULL", 0)
READY = b"\x05READY\x0bSocket-Type" + struct.pack(">I", 3) + b"SUB"
COMMAND, MORE, LAST = 4, 1, 0


def zmtp_frame(flags: int, body: bytes) -> bytes:
    if len(body) < 256:
        return struct.pack(">BB", flags, len(body)) + body
    return struct.pack(">BQ", flags | 2, len(body)) + body


class AttackedPublisher:
    """A publisher in a separate process, whose peak memory is measured."""

    def __init__(self, topic: str, *ring: str) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-c", PUBLISHER, topic, *ring],
            cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        )  # fmt: skip
        assert self._process.stdout is not None
        self.endpoint = self._process.stdout.readline().strip()

    def finish(self) -> dict[str, Any]:
        answer, _ = self._process.communicate("\n", timeout=DEADLINE_S)
        report: dict[str, Any] = json.loads(answer)
        return report


@contextmanager
def subscribed(
    endpoint: str, secured: SecuredPublisher | None = None
) -> Iterator[zmq.Socket[bytes]]:
    """Return a normal subscriber that has received a message."""
    with zmq.Context() as context, context.socket(zmq.SUB) as opened:
        opened.setsockopt(zmq.LINGER, 0)
        opened.setsockopt(zmq.SUBSCRIBE, b"")
        opened.setsockopt(zmq.RCVTIMEO, 1000 * DEADLINE_S)
        if secured is not None:
            secured.rings["left"].set_client_keys(opened, "main")
        opened.connect(endpoint)
        opened.recv()
        yield opened


def receive_exactly(opened: socket.socket, count: int) -> bytes:
    """Receive `count` bytes. Raises ConnectionResetError if the peer closes the connection."""
    received = b""
    while len(received) < count:
        part = opened.recv(count - len(received))
        if not part:
            raise ConnectionResetError("the publisher closed the connection")
        received += part
    return received


@contextmanager
def connected_plainly(endpoint: str) -> Iterator[socket.socket]:
    """Open a connection with a plain ZMTP handshake on a TCP socket, without ZeroMQ."""
    address, _, port = endpoint.removeprefix("tcp://").rpartition(":")
    with socket.create_connection((address, int(port)), timeout=DEADLINE_S) as opened:
        opened.sendall(GREETING + zmtp_frame(COMMAND, READY))
        answer = receive_exactly(opened, len(GREETING) + 2)
        receive_exactly(opened, answer[-1])
        # What a closed connection no longer takes in would wait for the kernel's probes.
        opened.settimeout(0.5)
        yield opened


def random_frames(size: int, flags: int) -> Iterator[bytes]:
    random = Random(size)
    while True:
        yield zmtp_frame(flags, b"\x01" + random.randbytes(size - 1))


ATTACKS: dict[str, Callable[[], Iterator[bytes]]] = {
    "long": partial(random_frames, 60_000, LAST),
    "longest allowed": partial(random_frames, 500, LAST),
    "short": partial(random_frames, 16, LAST),
    "the same": lambda: repeat(zmtp_frame(LAST, b"\x01") * 100),
    "one message without end": partial(random_frames, 500, MORE),
    "commands": lambda: repeat(zmtp_frame(COMMAND, b"\x04PING\x00\x00" + bytes(16)) * 20),
}


@pytest.mark.parametrize(
    ("attack", "topic"),
    long_except(
        [*zip(ATTACKS, repeat("twin/finger"), strict=False), ("longest allowed", "estop")],
        *(
            (attack, "twin/finger")
            for attack in ("long", "longest allowed", "one message without end", "commands")
        ),
    ),
)
def test_what_subscribers_send_does_not_fill_the_memory(attack: str, topic: str) -> None:
    publisher = AttackedPublisher(topic)
    with subscribed(publisher.endpoint) as honest:
        sent, frames = 0, ATTACKS[attack]()
        for _ in range(MAX_CONNECTIONS_OF_ATTACKER):
            with suppress(OSError), connected_plainly(publisher.endpoint) as opened:
                while sent < ATTACK_BYTES:
                    frame = next(frames)
                    opened.sendall(frame)
                    sent += len(frame)
        for _ in range(100):
            honest.recv()
        report = publisher.finish()
    assert report["growth_kb"] < MAX_GROWTH_KB
    # ZeroMQ itself closes a connection that sends a frame that is too long.
    assert report["refused"] or attack == "long"


def test_a_host_with_a_key_does_not_fill_the_memory(secured: SecuredPublisher) -> None:
    publisher = AttackedPublisher("twin/finger", str(secured.known.write_ring("main")))
    ring = str(secured.known.write_ring("left"))
    attacker = [sys.executable, "-c", ATTACKER_WITH_KEY, publisher.endpoint, ring]
    with subscribed(publisher.endpoint, secured) as honest:
        attackers = [
            subprocess.Popen([*attacker, str(ATTACK_BYTES // ATTACKERS)], cwd=ROOT)
            for _ in range(ATTACKERS)
        ]
        for _ in range(100):
            honest.recv()
        for process in attackers:
            process.wait(DEADLINE_S)
        report = publisher.finish()
    assert report["growth_kb"] < MAX_GROWTH_KB
    assert report["refused"]


async def test_an_address_has_a_limited_number_of_connections(
    secured: SecuredPublisher, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connection_guard, "MAX_CONNECTIONS_PER_ADDRESS", 3)
    publisher = secured.sender()
    receivers = [secured.receiver(secured.rings["left"]) for _ in range(3)]
    await secured.publish_until(publisher, lambda: all(receiver.inbox for receiver in receivers))
    with socket.create_connection(("127.0.0.1", secured.port), timeout=DEADLINE_S) as fourth:
        await until(lambda: secured.refused)
        # ZeroMQ may have sent its greeting before.
        while await asyncio.to_thread(fourth.recv, 100):
            pass
    assert "has 3 connections already" in secured.refused[0]
    receivers[0].subscriber.close()
    successor = secured.receiver(secured.rings["left"])
    await secured.publish_until(publisher, lambda: successor.inbox)


async def test_the_guard_ends_with_the_last_publisher(connections: Connections) -> None:
    publisher = connections.sender(ESTOP, "tcp://127.0.0.1:*")
    successor = connections.sender(ESTOP, "tcp://127.0.0.1:*")
    publisher.close()
    receiver = connections.receiver(ESTOP, successor.endpoints[0])
    successor.send(stop("after"), header(1))
    await until(lambda: receiver.inbox)
    assert [one.name for one in threading.enumerate()].count(THREAD_NAME) == 1
    successor.close()
    await until(lambda: THREAD_NAME not in [one.name for one in threading.enumerate()])


async def test_latched_messages_reach_late_subscribers_by_tcp_and_ipc(
    connections: Connections,
) -> None:
    publisher = connections.sender(ESTOP, connections.endpoint(), "tcp://127.0.0.1:*")
    publisher.send(stop("before"), header(1))
    for endpoint in publisher.endpoints:
        receiver = connections.receiver(ESTOP, endpoint)
        await until(lambda receiver=receiver: receiver.inbox)
        assert receiver.sequences == [1]
