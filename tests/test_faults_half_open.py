"""Test half-open connections, in which one end has disappeared without notice."""

from __future__ import annotations

import asyncio
import resource
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from pathlib import Path

import pytest
import zmq

from flexsheet.messages import bus
from flexsheet.messages.base import Header
from flexsheet.messages.bus import Publisher, Source, Subscriber
from flexsheet.messages.security import KeyRing
from flexsheet.messages.topics import TOPICS
from flexsheet.messages.types import TwinFinger
from flexsheet.nodes.node import PortCounts
from tests.hosts import hosts
from tests.network import Computers
from tests.test_messages_bus import (
    Connections,
    connected,
    connections,
    finger,
    header,
    pictures,
    stop,
)
from tests.waiting import until

__all__ = ["connections"]

FINGER = TOPICS["twin/finger"]
PORT = 7100
ESTABLISHED = "01"

Stream = tuple[asyncio.StreamReader, asyncio.StreamWriter]


class Relay:
    """A relay to the tcp port of a publisher. Its present connections can become half-open."""

    def __init__(self, publisher: Publisher) -> None:
        (tcp,) = (one for one in publisher.endpoints if one.startswith("tcp:"))
        self.port = int(tcp.rpartition(":")[2])
        self.passed_bytes = 0
        self.gone: list[tuple[Stream, Stream]] = []
        self._standing: list[tuple[Stream, Stream]] = []
        self._tasks: list[asyncio.Task[None]] = []

    async def take(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            far = await asyncio.open_connection("127.0.0.1", self.port)
        except OSError:
            writer.transport.abort()
            return
        self._standing.append(((reader, writer), far))
        for source, drain in ((reader, far[1]), (far[0], writer)):
            self._tasks.append(asyncio.create_task(self._pass_on(source, drain)))

    async def _pass_on(self, source: asyncio.StreamReader, drain: asyncio.StreamWriter) -> None:
        with suppress(ConnectionError):
            while data := await source.read(1 << 16):
                drain.write(data)
                await drain.drain()
                self.passed_bytes += len(data)
        drain.transport.abort()

    async def vanish(self) -> None:
        """Stop serving all present connections without closing them."""
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        self._tasks.clear()
        self.gone += self._standing
        self._standing.clear()

    def wake(self) -> None:
        """Reset all connections that have stopped."""
        for ends in self.gone:
            for _, writer in ends:
                writer.transport.abort()
        self.gone.clear()


@asynccontextmanager
async def relay_to(publisher: Publisher) -> AsyncIterator[tuple[Relay, str]]:
    """Return a relay to a publisher, and the endpoint of the relay."""
    relay = Relay(publisher)
    server = await asyncio.start_server(relay.take, "127.0.0.1", 0)
    try:
        yield relay, f"tcp://127.0.0.1:{server.sockets[0].getsockname()[1]}"
    finally:
        server.close()
        await relay.vanish()
        relay.wake()
        await server.wait_closed()


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Send heartbeats ten times as fast as normal."""
    for option, value in list(bus.HEARTBEATS.items()):
        monkeypatch.setitem(bus.HEARTBEATS, option, value // 10)


@pytest.mark.usefixtures("quick")
async def test_a_reader_that_vanished_is_hung_up_on_and_costs_its_publisher_nothing(
    connections: Connections,
) -> None:
    topic = TOPICS["twin/stereo"]
    publisher = connections.sender(topic, connections.endpoint(), "tcp://127.0.0.1:*")
    async with relay_to(publisher) as (relay, endpoint):
        present, vanished = connections.receiver(topic), connections.receiver(topic, endpoint)
        await connected(publisher, vanished, pictures)
        await until(lambda: present.inbox)
        await relay.vanish()
        number = present.sequences[-1]
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        for _ in range(300):
            for _ in range(10):
                number += 1
                publisher.send(pictures(number % 250), header(number))
            await until(lambda: present.sequences[-1] == number)  # noqa: B023
            present.inbox[:-1] = []
        grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) << 10
        # 3000 of 6 KB were sent; the queue for who does not read holds 65.
        assert grown < 3000 * 6e3 / 2
        assert present.counts.gaps == 0
        for _, (reader, _) in relay.gone:
            # It ends although nobody has closed it from here.
            while await reader.read(1 << 16):
                pass
        relay.wake()
        while not vanished.inbox:
            number += 1
            publisher.send(pictures(number % 250), header(number))
            await asyncio.sleep(0.002)
        await until(lambda: vanished.sequences[-1] == number)


@pytest.mark.usefixtures("quick")
async def test_a_quiet_topics_publisher_that_vanished_is_hung_up_on_for_the_next_one(
    connections: Connections,
) -> None:
    """Heartbeats detect the end of a publisher that rarely sends messages."""
    topic = TOPICS["estop"]
    publisher = connections.sender(topic, "tcp://127.0.0.1:*")
    async with relay_to(publisher) as (relay, endpoint):
        receiver = connections.receiver(topic, endpoint)
        await connected(publisher, receiver, lambda number: stop(str(number)))
        before = relay.passed_bytes
        await until(lambda: relay.passed_bytes > before, "a heartbeat")
        await relay.vanish()
        publisher.send(stop("said into the void"), header(1000))
        publisher.close()
        again = connections.sender(topic, f"tcp://127.0.0.1:{relay.port}")
        again.send(stop("said by the next"), header(1, epoch=2))
        await until(lambda: receiver.inbox)
        relay.wake()
        again.send(stop("and more"), header(2, epoch=2))
        await until(lambda: len(receiver.inbox) == 2)
    assert [message.reason for message, _ in receiver.inbox] == ["said by the next", "and more"]
    assert receiver.counts.rejected == 0


def established(pid: int, port: int) -> int:
    """Return the open connections to a port, as listed by the operating system."""
    rows = [line.split() for line in Path(f"/proc/{pid}/net/tcp").read_text().splitlines()[1:]]
    wanted = f":{port:04X}"
    return sum(row[2].endswith(wanted) and row[3] == ESTABLISHED for row in rows)


async def test_a_power_cut_in_mid_stream_is_detected_and_recovered() -> None:
    """The frequent messages prevent libzmq from detecting missing heartbeats."""
    if why := Computers.missing():
        pytest.skip(why)
    with Computers("main", "left") as computers, hosts("main", "left") as known:
        endpoint = f"tcp://{computers.address['main']}:{PORT}"
        record = known.folder / "heard"
        rings = {name: known.write_ring(name) for name in known.names}
        program = ("-m", "tests.test_faults_half_open")

        def inbox(epoch: int) -> list[int]:
            lines = record.read_text().split("\n")[:-1] if record.exists() else []
            reported = [tuple(map(int, line.split())) for line in lines]
            assert [one for one, _ in reported] == sorted(one for one, _ in reported)
            return [sequence for one, sequence in reported if one == epoch]

        listen = (*program, "listen", str(rings["left"]), endpoint, str(record))
        publish_until = (*program, "speak", str(rings["main"]), endpoint)
        listener = computers.start("left", *listen)
        speaker = computers.start("main", *publish_until, "1")
        try:
            await until(lambda: len(inbox(1)) > 10, "the first to be heard")
            computers.power_cut("main", speaker)
            computers.boot("main")
            speaker = computers.start("main", *publish_until, "2")
            await until(lambda: len(inbox(2)) > 10, "the next one to be heard")
            assert inbox(2) == sorted(set(inbox(2)))
            assert established(listener.pid, PORT) == 1
            computers.plug("main", into_switch=False)
            await until(lambda: not established(listener.pid, PORT), "the listener to hang up")
        finally:
            for process in (listener, speaker):
                process.kill()
                await asyncio.to_thread(process.wait)


async def listen(ring: Path, endpoint: str, record: Path) -> None:
    """Record epoch and sequence number of all received messages, with a timeout of 2 s instead of 5
    s.
    """
    bus.TCP_KEEPALIVE_OPTIONS[zmq.TCP_MAXRT] = 2000
    with record.open("a", buffering=1) as file:

        def receive(_: TwinFinger, header: Header) -> None:
            file.write(f"{header.epoch} {header.sequence}\n")

        source = Source(endpoint, "writer", "main")
        Subscriber(FINGER, [source], receive, PortCounts(), keys=KeyRing.load(ring)).start()
        await asyncio.Event().wait()


async def publish_until(ring: Path, endpoint: str, epoch: int) -> None:
    """Publish messages at 100 Hz."""
    publisher, number = Publisher(FINGER, [endpoint], keys=KeyRing.load(ring)), 0
    while True:
        number += 1
        publisher.send(finger(0.0), header(number, epoch=epoch))
        await asyncio.sleep(0.01)


if __name__ == "__main__":
    what, ring, endpoint, last = sys.argv[1:]
    if what == "listen":
        asyncio.run(listen(Path(ring), endpoint, Path(last)))
    else:
        asyncio.run(publish_until(Path(ring), endpoint, int(last)))
