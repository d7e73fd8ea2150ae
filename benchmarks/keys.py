"""Measure the cost of encryption: a message between processes by tcp, with CURVE and without.

python -m benchmarks.keys [--rounds N] [--seconds S]

As in `benchmarks.messaging`, one process publishes, and one per design receives. The latency is one
way, from before the message is constructed to its handler. The result is the ratio within a round.
Also measured: the cost of a subscriber's checks (writer, plan, order) per message within one
process.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import tempfile
import threading
import timeit
from collections.abc import Callable, Coroutine, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import uvloop

from benchmarks import messaging
from benchmarks.messaging import NODES_USE, PAYLOADS, BusLine, Design, Payload, Sender
from flexsheet.launch.methods.results import machine_name
from flexsheet.messages.base import Header
from flexsheet.messages.bus import Publisher, Source, Subscriber
from flexsheet.messages.security import KeyRing, make_key_pair, write_ring, write_secret
from flexsheet.messages.topics import Topic
from flexsheet.messages.wire import encode, read_envelope
from flexsheet.nodes.node import PortCounts

T = TypeVar("T")
RING_VARIABLE = "FLEXSHEET_BENCHMARK_RING"
WITHOUT, WITH = NODES_USE, "flexsheet_keys"


def listen(topic: Topic, endpoint: str, arrived: Callable[[int, int], bool]) -> None:
    """Subscribe like a node on another host, with the key ring that the environment names."""

    async def run() -> None:
        ended = asyncio.get_running_loop().create_future()

        def on_message(_: Any, header: Header) -> None:
            if not arrived(header.sequence, header.publish_ns) and not ended.done():
                ended.set_result(None)

        keys = KeyRing.load(Path(os.environ[RING_VARIABLE]))
        source = Source(endpoint, "bench", "main")
        subscriber = Subscriber(topic, [source], on_message, PortCounts(), keys=keys)
        subscriber.start()
        await ended
        subscriber.close()

    uvloop.run(run())


DESIGNS = (
    Design(WITHOUT, "tcp on loopback", True, messaging.flexsheet_uvloop),
    Design(WITH, "CURVE, the other's key known", True, listen),
)


class Loop:
    """An event loop in a thread, which runs the ZAP authenticator while the sender blocks."""

    def __init__(self) -> None:
        self.loop = asyncio.new_event_loop()
        self.thread = threading.Thread(target=self.loop.run_forever)
        self.thread.start()

    def do(self, work: Coroutine[Any, Any, T]) -> T:
        return asyncio.run_coroutine_threadsafe(work, self.loop).result()

    def close(self) -> None:
        self.loop.call_soon_threadsafe(self.loop.stop)
        self.thread.join()
        self.loop.close()


@contextmanager
def create_two_rings(folder: Path) -> Iterator[KeyRing]:
    """Create the key rings of two hosts. Child processes use the ring of the second host."""
    public = {}
    for host in ("main", "left"):
        public[host], secret = make_key_pair()
        write_secret(folder / f"{host}.secret", secret)
    for host in public:
        write_ring(
            folder / f"{host}.json",
            host=host,
            secret_file=folder / f"{host}.secret",
            public=public,
        )
    os.environ[RING_VARIABLE] = str(folder / "left.json")
    yield KeyRing.load(folder / "main.json")
    del os.environ[RING_VARIABLE]


async def open_for_thread(topic: Topic, bind: list[str], keys: KeyRing) -> Publisher:
    """Open a publisher for use in another thread.

    The event loop of this thread does not read the socket.
    """
    publisher = Publisher(topic, bind, keys=keys)
    await asyncio.sleep(0)
    asyncio.get_running_loop().remove_reader(publisher._socket.fileno())
    return publisher


class KeyedLine(BusLine):
    """A publisher with keys, which needs a running event loop."""

    def __init__(self, payload: Payload, place: str, ring: KeyRing, loop: Loop) -> None:
        super().__init__(
            DESIGNS[1], payload, place, lambda topic, at: loop.do(open_for_thread(topic, at, ring))
        )
        self._loop = loop

    def close(self) -> None:
        async def closed() -> None:
            self._publisher.close()

        self._loop.do(closed())


def measure(rounds: int, seconds: float, keys: KeyRing, loop: Loop) -> list[dict[str, Any]]:
    """Return the rows of `messaging.measure`, with ratios to the design without keys."""
    place = "tcp://127.0.0.1:*"

    def open_sender(design: Design, payload: Payload, number: int) -> Sender:
        keyed = design.name == WITH
        line = KeyedLine(payload, place, keys, loop) if keyed else BusLine(design, payload, place)
        return Sender(design, payload, line)

    return [
        row
        for payload in PAYLOADS
        for row in messaging.measure(
            payload,
            DESIGNS,
            rounds=rounds,
            seconds=seconds,
            open_sender=open_sender,
            step=lambda: None,
            reference=WITHOUT,
        )
    ]


def cost_of_checks() -> dict[str, float]:
    """Return the time to read a header without and with all checks, us per message."""
    payload = PAYLOADS[0]
    plan, writers = "0123456789abcdef", frozenset({"bench"})
    header = Header(1, 2, 3, "bench", "bench", 1, plan)
    many = [
        [bytes(one) for one in encode(payload.make(0), replace(header, sequence=number))]
        for number in range(1, 20_001)
    ]

    def read() -> None:
        for frames in many:
            read_envelope(frames, payload.topic)

    def accept() -> None:
        subscriber = Subscriber(payload.topic, [], lambda *_: None, PortCounts(), plan=plan)
        for frames in many:
            subscriber.accept(frames, writers)

    return {
        name: min(timeit.repeat(work, number=1, repeat=7)) / len(many) * 1e6
        for name, work in (("read_us", read), ("accept_us", accept))
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--rounds", type=int, default=8)
    parser.add_argument("--seconds", type=float, default=2.0, help="per design and round")
    options = parser.parse_args()
    load = os.getloadavg()[0]
    loop = Loop()
    try:
        with tempfile.TemporaryDirectory() as folder, create_two_rings(Path(folder)) as keys:
            rows = measure(options.rounds, options.seconds, keys, loop)
    finally:
        loop.close()
    report = {
        "machine": machine_name(),
        "load": [load, os.getloadavg()[0]],
        "rounds": options.rounds,
        "latency": rows,
        "checks": cost_of_checks(),
    }
    print(json.dumps(report, indent=1))


if __name__ == "__main__":
    main()
