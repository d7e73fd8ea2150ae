"""Test that unauthorised peers are rejected: unknown keys, forgeries, replays, invalid data."""

from __future__ import annotations

import asyncio
import itertools
import random
import re
import socket
import struct
from collections import Counter
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import msgpack
import numpy as np
import psutil
import pytest
import pytest_asyncio

from flexsheet.messages import bus
from flexsheet.messages.base import Header, Message
from flexsheet.messages.bus import BusError, Publisher, Source, Subscriber
from flexsheet.messages.security import KeyRing, SecurityError
from flexsheet.messages.topics import TOPICS, Topic
from flexsheet.messages.types import EStop, SheetTarget
from flexsheet.messages.wire import encode
from flexsheet.nodes.node import PortCounts
from flexsheet.nodes.runner import NodeConfig, NodeTransport
from tests.hosts import Hosts, hosts
from tests.network import TcpRelay
from tests.test_messages_bus import ForeignPublisher, finger, pictures, stop

PLAN = "0123456789abcdef"
ESTOP, FINGER = TOPICS["estop"], TOPICS["twin/finger"]
HEADER = Header(7, 7_000, 7_001, "main-0001", "planner", 500, PLAN)


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return int(server.getsockname()[1])


@dataclass
class RecordingSubscriber:
    """A subscriber that records its messages and problems."""

    inbox: list[tuple[Any, Header]] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)
    counts: PortCounts = field(default_factory=PortCounts)
    subscriber: Subscriber = field(init=False)

    def record(self, message: Any, header: Header) -> None:
        self.inbox.append((message, header))

    @property
    def sequences(self) -> list[int]:
        return [header.sequence for _, header in self.inbox]


class SecuredPublisher:
    """A publisher of the host `main` at a tcp endpoint, which other processes attack."""

    def __init__(self, known: Hosts) -> None:
        self.known = known
        self.port = free_port()
        self.refused: list[str] = []
        self.cleanups: list[Callable[[], None]] = []
        self.rings = {name: known.ring(name) for name in (*known.names, "stranger")}
        self.sent = 0

    def sender(self, topic: Topic = ESTOP, host: str = "main") -> Publisher:
        publisher = Publisher(
            topic,
            [f"tcp://127.0.0.1:{self.port}"],
            keys=self.rings[host],
            on_refused=self.refused.append,
        )
        self.cleanups.append(publisher.close)
        return publisher

    def receiver(
        self, ring: KeyRing | None, topic: Topic = ESTOP, *, port: int = 0, host: str = "main"
    ) -> RecordingSubscriber:
        receiver = RecordingSubscriber()
        source = Source(f"tcp://127.0.0.1:{port or self.port}", "planner", host)
        subscriber = Subscriber(
            topic, [source], receiver.record, receiver.counts, keys=ring, plan=PLAN,
            on_problem=receiver.problems.append,
        )  # fmt: skip
        subscriber.start()
        self.cleanups.append(subscriber.close)
        receiver.subscriber = subscriber
        return receiver

    async def publish_until(self, publisher: Publisher, until_: Callable[[], object]) -> None:
        """Publish numbered e-stops until a condition is true."""
        while not until_():
            self.sent += 1
            header = replace(HEADER, sequence=self.sent)
            publisher.send(stop(str(self.sent)), header)
            await asyncio.sleep(0.002)


@pytest_asyncio.fixture
async def secured() -> AsyncIterator[SecuredPublisher]:
    with hosts("main", "left") as known:
        secured = SecuredPublisher(known)
        yield secured
        for close in reversed(secured.cleanups):
            close()


async def test_an_unknown_key_receives_nothing_and_is_reported(secured: SecuredPublisher) -> None:
    sender = secured.sender()
    friend, outsider = (
        secured.receiver(secured.rings["left"]),
        secured.receiver(secured.rings["stranger"]),
    )
    without = secured.receiver(None)
    await secured.publish_until(
        sender, lambda: friend.inbox and outsider.problems and secured.refused
    )
    await secured.publish_until(sender, lambda: len(friend.inbox) > 100)
    assert (outsider.inbox, without.inbox) == ([], [])
    assert "rejects the key of this host" in outsider.problems[0]
    assert secured.known.derive_public_key("stranger") in secured.refused[0]


@pytest.mark.parametrize("impostor", ["left", "stranger", "without"])
async def test_only_the_host_of_the_plan_is_accepted(
    secured: SecuredPublisher, impostor: str
) -> None:
    """Another host, even one in the launch file, uses the endpoint of `main` without the key of
    `main`.
    """
    if impostor == "without":
        sender: Publisher = Publisher(ESTOP, [f"tcp://127.0.0.1:{secured.port}"])
        secured.cleanups.append(sender.close)
    else:
        sender = secured.sender(host=impostor)
    receiver = secured.receiver(secured.rings["left"])
    await secured.publish_until(sender, lambda: receiver.problems)
    await secured.publish_until(sender, partial(next, iter([False] * 50 + [True])))
    assert receiver.inbox == []
    sender.close()
    right = secured.sender()
    await secured.publish_until(right, lambda: receiver.inbox)


async def test_a_flood_from_strangers_does_not_keep_the_friend_from_hearing(
    secured: SecuredPublisher,
) -> None:
    sender, receiver = secured.sender(), secured.receiver(secured.rings["left"])
    await secured.publish_until(sender, lambda: receiver.inbox)
    chance = random.Random(1)
    greeting = b"\xff" + bytes(8) + b"\x7f\x03\x01"
    openers = [b"", b"GET / HTTP/1.1\r\n\r\n", greeting, greeting + b"CURVE".ljust(20, b"\0")]
    openers.append(greeting + b"NULL".ljust(20, b"\0") + bytes(32))
    for number in range(400):
        with socket.create_connection(("127.0.0.1", secured.port)) as outsider:
            printed = openers[number % len(openers)] + chance.randbytes(chance.randrange(2000))
            outsider.sendall(printed)
        if number % 20 == 0:
            await secured.publish_until(sender, partial(next, iter([False, True])))
    receiver.inbox.clear()
    await secured.publish_until(sender, lambda: len(receiver.inbox) > 20)
    assert receiver.counts.rejected == 0
    assert {header.writer for _, header in receiver.inbox} == {"planner"}


class TamperingProxy(TcpRelay):
    """A proxy between two hosts that can store, change, repeat and replay data."""

    def __init__(self, target_port: int) -> None:
        super().__init__(target_port)
        self.tamper: Callable[[bytes], bytes] = lambda data: data
        self.kept: list[bytes] = []
        self.connections = 0

    async def _relay(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.connections += 1
        await super()._relay(reader, writer)

    async def _pass_on(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        to_subscriber = writer.get_extra_info("sockname")[1] == self.port
        with suppress(ConnectionError):
            while data := await reader.read(1 << 16):
                if to_subscriber:
                    self.kept.append(data)
                    data = self.tamper(data)
                writer.write(data)
        writer.transport.abort()


async def test_changed_repeated_or_replayed_data_are_rejected(
    secured: SecuredPublisher, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bus, "REOPEN_DELAY_S", 0.02)
    sender = secured.sender()
    chance = random.Random(2)

    def flip(data: bytes) -> bytes:
        # Not in the length at the front: then it would wait for more until a heartbeat is due.
        place = chance.randrange(len(data) // 2, len(data))
        return data[:place] + bytes([data[place] ^ 1 << chance.randrange(8)]) + data[place + 1 :]

    async with TamperingProxy(secured.port) as meddler:
        receiver = secured.receiver(secured.rings["left"], port=meddler.port)
        await secured.publish_until(sender, lambda: len(receiver.inbox) > 20)
        earlier = list(meddler.kept)
        tricks: tuple[Callable[[bytes], bytes], ...] = (
            flip,
            lambda data: data + data,
            lambda data: chance.choice(earlier),
        )
        for trick in tricks:
            meddler.tamper = trick
            before = meddler.connections
            await secured.publish_until(sender, lambda: meddler.connections >= before + 3)  # noqa: B023
        meddler.tamper = lambda data: data
        done = len(receiver.inbox)
        await secured.publish_until(sender, lambda: len(receiver.inbox) > done + 5)
    for message, header in receiver.inbox:
        assert message == stop(str(header.sequence))
    assert receiver.sequences == sorted(set(receiver.sequences)), "each at most once, in order"
    assert receiver.counts.rejected == 0, "ZeroMQ's own seal catches it, before any message is made"


async def test_a_recorded_connection_cannot_be_replayed(secured: SecuredPublisher) -> None:
    """Both ends create new session keys, so that recorded bytes cannot open another connection."""
    sender = secured.sender()
    sent: list[bytes] = []

    class Recorder(TcpRelay):
        async def _pass_on(
            self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
        ) -> None:
            to_publisher = writer.get_extra_info("peername")[1] == secured.port
            with suppress(ConnectionError):
                while data := await reader.read(1 << 16):
                    if to_publisher:
                        sent.append(data)
                    writer.write(data)
            writer.transport.abort()

    async with Recorder(secured.port) as wire:
        receiver = secured.receiver(secured.rings["left"], port=wire.port)
        await secured.publish_until(sender, lambda: len(receiver.inbox) > 5)
    reader, writer = await asyncio.open_connection("127.0.0.1", secured.port)
    writer.write(b"".join(sent))
    answer = bytearray()

    async def listen() -> None:
        with suppress(ConnectionError):
            while data := await reader.read(1 << 16):
                answer.extend(data)

    # ZeroMQ hangs up; until then the publisher goes on.
    listening = asyncio.create_task(listen())
    await secured.publish_until(sender, listening.done)
    writer.close()
    # Greeting (64 bytes) and WELCOME (170 bytes in a frame) at most: no message.
    assert len(answer) < 300


async def test_a_subscription_that_is_too_long_ends_the_connection(
    secured: SecuredPublisher,
) -> None:
    publisher = Publisher(FINGER, ["tcp://127.0.0.1:*"])
    secured.cleanups.append(publisher.close)
    reader, writer = await asyncio.open_connection(
        "127.0.0.1", int(publisher.endpoints[0].rpartition(":")[2])
    )
    greeting = struct.pack("<B8xBBB20sB31x", 0xFF, 0x7F, 3, 1, b"NULL", 0)
    ready = b"\x05READY\x0bSocket-Type" + struct.pack(">I", 3) + b"SUB"
    writer.write(greeting + struct.pack(">BB", 4, len(ready)) + ready)
    size = bus.MAX_SUBSCRIPTION_BYTES + 1
    writer.write(struct.pack(">BQ", 2, size) + b"\x01".ljust(size, b"x"))
    with suppress(ConnectionResetError):
        while await reader.read(1000):
            pass
    writer.close()


async def test_messages_of_250_mib_are_counted_and_others_continue(
    secured: SecuredPublisher,
) -> None:
    """Each topic has a size limit. Larger messages are rejected, and their memory is freed."""
    foreign = ForeignPublisher(f"tcp://127.0.0.1:{secured.port}")
    secured.cleanups.append(foreign.close)
    receiver = RecordingSubscriber()
    subscriber = Subscriber(
        ESTOP, [f"tcp://127.0.0.1:{secured.port}"], receiver.record, receiver.counts,
        on_problem=receiver.problems.append,
    )  # fmt: skip
    subscriber.start()
    secured.cleanups.append(subscriber.close)
    number = 0

    async def publish_until(until_: Callable[[], object]) -> None:
        nonlocal number
        while not until_():
            number += 1
            foreign.send(*plain(encode(stop("good"), replace(HEADER, sequence=number))))
            await asyncio.sleep(0.002)

    await publish_until(lambda: receiver.inbox)
    process = psutil.Process()
    before = process.memory_info().rss
    for count in range(1, 3):
        foreign.send(bytes(250 << 20))
        await publish_until(lambda: receiver.counts.rejected == count)  # noqa: B023
        inbox = len(receiver.inbox)
        await publish_until(lambda: len(receiver.inbox) > inbox)  # noqa: B023
    assert "at most 1048576 are allowed" in receiver.problems[0]
    assert process.memory_info().rss - before < 300 << 20


async def test_nothing_is_sent_beyond_loopback_without_keys() -> None:
    for address in ("192.0.2.1", "0.0.0.0", "*", "[::]", "eth0", "example.org"):
        words = re.escape(f"other hosts can reach tcp://{address}:7777, but there are no keys")
        with pytest.raises(BusError, match=words):
            Publisher(FINGER, [f"tcp://{address}:7777"])
        subscriber = Subscriber(FINGER, [f"tcp://{address}:7777"], lambda *_: None, PortCounts())
        with pytest.raises(BusError, match=words):
            subscriber.start()


async def test_a_host_without_a_key_in_the_plan_is_not_connected_to(
    secured: SecuredPublisher,
) -> None:
    with pytest.raises(SecurityError, match='host "right" has no key'):
        secured.receiver(secured.rings["left"], host="right")


# In bulk, where sockets would only take time: all that a host with a good key could try.

OTHERS = ("stroker", "arm_left_bridge", "tools", "", "planner ", "PLANNER", "planner\0", "é" * 50)


def target() -> SheetTarget:
    return SheetTarget(
        phase="contact",
        reason="ok",
        valid_at_ns=5,
        world_from_sheet=np.eye(4),
        twist_world=np.zeros(6),
        stretch_ratio=1.05,
        contact_world_m=np.zeros(3),
        normal_world=np.array([0.0, 0.0, 1.0]),
        contact_sheet_m=np.zeros(2),
        push_depth_m=0.0,
    )


def plain(frames: list[Any]) -> list[bytes]:
    return [bytes(frame) for frame in frames]


def forgeries(message: Message, chance: random.Random) -> Iterator[tuple[str, list[bytes]]]:
    """Yield an infinite sequence of forged messages that a receiver of the message with HEADER must
    reject.
    """
    other: Message = stop("x") if not isinstance(message, EStop) else finger(1.0)
    good = plain(encode(message, HEADER))
    head = msgpack.unpackb(good[0], strict_map_key=False)
    needed = {name for name, one in type(message).model_fields.items() if one.is_required()}
    odd: tuple[Any, ...] = (None, -1, 1.5, b"", "", [], {}, True, 2**63, float("nan"), [[]] * 9)

    def packed(values: list[Any]) -> list[bytes]:
        return [msgpack.packb(values), *good[1:]]

    def with_header(**changes: Any) -> list[bytes]:
        newer = {"sequence": chance.randrange(8, 1 << 40), "source_ns": chance.randrange(1 << 60)}
        return plain(encode(message, replace(HEADER, **{**newer, **changes})))

    while True:
        number = chance.randrange(1 << 62)
        yield "another writer", with_header(writer=chance.choice(OTHERS))
        yield "a name of a writer", with_header(writer=f"planner{number}")
        yield "another plan", with_header(plan=f"{number:016x}"[-16:])
        yield "no plan", with_header(plan="")
        yield "replayed", with_header(sequence=chance.randrange(0, 7))
        yield "before the start", with_header(epoch=chance.randrange(0, 500))
        yield "of another boot", with_header(clock_id="main-0000", epoch=number)
        yield "of another type", plain(encode(other, replace(HEADER, sequence=number)))
        yield "cut", [good[0][: chance.randrange(len(good[0]))], *good[1:]]
        yield "garbage", [chance.randbytes(chance.randrange(1, 300)), *good[1:]]
        yield "too many frames", [*with_header()[:1], *good[1:], chance.randbytes(5)]
        yield "old protocol", packed(["flexsheet/1", *head[1:9], head[10]])
        place = chance.randrange(len(head) - 1)
        yield "odd header", packed([*head[:place], chance.choice(odd), *head[place + 1 :]])
        yield "a fingerprint", packed([*head[:2], chance.randbytes(8), *head[3:]])
        names = list(head[10])
        wrong = dict(head[10])
        wrong[chance.choice(names)] = chance.choice((None, [1], {"a": 1}, [None]))
        yield "a wrong field", packed([*head[:3], number + 8, *head[4:10], wrong])
        wrong = {**head[10], f"extra{number}": 1}
        yield "an extra field", packed([*head[:3], number + 9, *head[4:10], wrong])
        wrong = dict(head[10])
        del wrong[chance.choice([name for name in names if name in needed])]
        yield "a field less", packed([*head[:3], number + 10, *head[4:10], wrong])


@pytest.mark.parametrize("topic", ["estop", "sheet_target", "stereo"])
def test_of_a_hundred_thousand_forgeries_none_is_accepted(topic: str) -> None:
    message = {"estop": stop("good"), "sheet_target": target(), "stereo": pictures(3)}[topic]
    receiver = RecordingSubscriber()
    subscriber = Subscriber(
        TOPICS[topic],
        [],
        receiver.record,
        receiver.counts,
        plan=PLAN,
        on_problem=receiver.problems.append,
    )
    writers = frozenset({"planner"})

    def offer(frames: list[bytes]) -> None:
        envelope = subscriber.accept(frames, writers)
        if envelope is not None:
            subscriber.deliver(envelope)

    offer(plain(encode(message, replace(HEADER, clock_id="main-0000", sequence=1))))
    offer(plain(encode(message, HEADER)))
    assert len(receiver.inbox) == 2
    tried: Counter[str] = Counter()
    accepted: Counter[str] = Counter()
    for kind, frames in itertools.islice(forgeries(message, random.Random(topic)), 34_000):
        tried[kind] += 1
        offer(frames)
        accepted[kind] += len(receiver.inbox) - 2
        del receiver.inbox[2:]
    assert accepted.total() == 0, {kind: n for kind, n in accepted.items() if n}
    assert receiver.counts.rejected == tried.total() == 34_000
    assert len(receiver.problems) <= 12, "each cause is reported once"
    assert len(subscriber._writers_seen) == 1, "nobody makes it remember more"
    offer(plain(encode(message, replace(HEADER, sequence=2**63 - 1))))
    assert len(receiver.inbox) == 3, "the true writer is heard on"


def test_the_newest_again_is_silent_where_it_is_latched_and_a_replay_where_not() -> None:
    for topic, message, rejected in ((ESTOP, stop("a"), 0), (FINGER, finger(1.0), 1)):
        receiver = RecordingSubscriber()
        subscriber = Subscriber(
            topic, [], receiver.record, receiver.counts, on_problem=receiver.problems.append
        )
        frames = plain(encode(message, HEADER))
        assert subscriber.accept(frames, None) is not None
        assert subscriber.accept(frames, None) is None
        assert receiver.counts.rejected == rejected


def test_a_restart_and_a_reboot_are_followed() -> None:
    receiver = RecordingSubscriber()
    subscriber = Subscriber(
        FINGER, [], receiver.record, receiver.counts, on_problem=receiver.problems.append
    )

    def takes(clock_id: str, epoch: int, sequence: int) -> bool:
        header = replace(HEADER, clock_id=clock_id, epoch=epoch, sequence=sequence)
        return subscriber.accept(plain(encode(finger(0.0), header)), None) is not None

    assert takes("boot-1", 900, 5)
    assert takes("boot-1", 901, 1)
    assert not takes("boot-1", 900, 6)
    assert takes("boot-2", 3, 1)
    assert not takes("boot-1", 902, 1)
    assert takes("boot-2", 4, 1)
    assert receiver.counts.gaps == 0


def node_config(**keys: Any) -> NodeConfig:
    return NodeConfig(
        name="bridge", type="arm_bridge", parameters={}, inputs=(), outputs=(), plan_hash=PLAN,
        run_dir="", **keys,
    )  # fmt: skip


def test_who_may_reset_an_estop() -> None:
    links = NodeTransport(node_config(estop_resetters=("tools",)), None)
    objection = links._message_filter(ESTOP)
    assert objection is not None
    reset = EStop(engaged=False, reason="")
    arm, tools = replace(HEADER, writer="arm_left_bridge"), replace(HEADER, writer="tools")
    assert "may not reset" in str(objection(reset, arm))
    assert objection(reset, tools) is None
    assert objection(stop("all may stop"), arm) is None
    assert links._message_filter(FINGER) is None
    assert NodeTransport(node_config(), None)._message_filter(ESTOP) is None


def test_a_forbidden_message_is_counted_and_not_handed_over() -> None:
    receiver = RecordingSubscriber()
    subscriber = Subscriber(
        ESTOP, [], receiver.record, receiver.counts, on_problem=receiver.problems.append,
        message_filter=lambda message, header: None if message.engaged else "not so",
    )  # fmt: skip
    for number, engaged in enumerate((True, False, True), start=8):
        message = EStop(engaged=engaged, reason="")
        envelope = subscriber.accept(plain(encode(message, replace(HEADER, sequence=number))), None)
        assert envelope is not None
        subscriber.deliver(envelope)
    assert [message.engaged for message, _ in receiver.inbox] == [True, True]
    assert (receiver.counts.rejected, receiver.problems) == (
        1,
        ['topic "estop": a message was refused: not so'],
    )
