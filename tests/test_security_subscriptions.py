"""A peer with a valid key cannot fill a publisher's memory, nor take its place."""

from __future__ import annotations

import asyncio
import json
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from functools import partial
from itertools import cycle
from pathlib import Path
from random import Random
from typing import Any

import pytest
import zmq

from flexsheet.messages import bus
from flexsheet.messages.bus import Publisher
from tests.test_messages_bus import Room, connected, finger, header, room, until
from tests.test_security import FINGER, Street, street

__all__ = ["room", "street"]

ROOT = Path(__file__).resolve().parent.parent
ATTACK_BYTES = 3_000_000
ATTACKERS = 4
MAX_GROWTH_KB = 48_000

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


class AttackedPublisher:
    """A publisher in a process of its own, whose peak memory is its own."""

    def __init__(self, topic: str, *ring: str) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-c", PUBLISHER, topic, *ring],
            cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        )  # fmt: skip
        assert self._process.stdout is not None
        self.endpoint = self._process.stdout.readline().strip()

    def finish(self) -> dict[str, Any]:
        answer, _ = self._process.communicate("\n", timeout=60)
        report: dict[str, Any] = json.loads(answer)
        return report


def random_messages(size: int) -> Iterator[bytes]:
    random = Random(size)
    for _ in range(ATTACK_BYTES // size):
        yield b"\x01" + random.randbytes(size - 1)


ATTACKS = {
    "long": partial(random_messages, 60_000),
    "longest allowed": partial(random_messages, 450),
    "short": partial(random_messages, 16),
    "empty": lambda: (b"" for _ in range(50_000)),
}


@pytest.mark.parametrize("topic", ["twin/finger", "estop"])
@pytest.mark.parametrize("attack", list(ATTACKS))
def test_what_subscribers_send_does_not_fill_the_memory(
    street: Street, topic: str, attack: str
) -> None:
    publisher = AttackedPublisher(topic, str(street.known.write_ring("main")))
    context = zmq.Context()

    def connect() -> zmq.Socket[bytes]:
        opened = context.socket(zmq.DEALER)
        opened.setsockopt(zmq.PROBE_ROUTER, 1)
        opened.setsockopt(zmq.IMMEDIATE, 1)
        opened.setsockopt(zmq.RCVTIMEO, 20_000)
        opened.setsockopt(zmq.SNDTIMEO, 200)
        street.rings["left"].seek(opened, "main")
        opened.connect(publisher.endpoint)
        return opened

    honest = connect()
    honest.recv()
    attackers = [connect() for _ in range(ATTACKERS)]
    # A socket whose connection is closed has to connect again before it can send the rest.
    with suppress(zmq.Again):
        for attacker, message in zip(cycle(attackers), ATTACKS[attack](), strict=False):
            attacker.send(message)
    for _ in range(500):
        honest.recv()
    report = publisher.finish()
    context.destroy(linger=0)
    assert report["growth_kb"] < MAX_GROWTH_KB
    # ZeroMQ itself closes a connection that sends a frame that is too long.
    assert report["refused"] or attack == "long"


async def test_a_host_has_a_limited_number_of_subscribers(
    room: Room, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bus, "MAX_SUBSCRIBERS_PER_HOST", 3)
    refused: list[str] = []
    publisher = Publisher(FINGER, [room.endpoint()], on_refused=refused.append)
    room.closers.append(publisher.close)
    ears = [room.ear(FINGER) for _ in range(4)]
    number = 0
    while not (refused and all(ear.heard for ear in ears)):
        number += 1
        publisher.send(finger(number), header(number))
        await asyncio.sleep(0.002)
    assert "is the oldest of more than 3" in refused[0]


async def test_subscribers_that_come_and_go_are_forgotten(room: Room) -> None:
    publisher = room.mouth(FINGER)
    for _ in range(20):
        ear = room.ear(FINGER)
        await connected(publisher, ear, finger)
        ear.subscriber.close()

    def only_present() -> bool:
        publisher.send(finger(0.0), header(1))
        return not publisher._subscribers

    await until(only_present)
