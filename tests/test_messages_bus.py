"""Test the bus: deliveries, losses, rejections and restarts."""

from __future__ import annotations

import asyncio
import socket
import sys
from asyncio.subprocess import PIPE
from collections.abc import AsyncIterator, Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import pytest_asyncio
import zmq

from flexsheet.messages.bag import BagReader, BagWriter
from flexsheet.messages.base import Header, Message
from flexsheet.messages.bus import BusError, Publisher, Subscriber, compute_queue_length
from flexsheet.messages.local_bus import LocalBus
from flexsheet.messages.topics import TOPICS, Delivery, Topic
from flexsheet.messages.types import EStop, StereoPair, TwinArms, TwinFinger
from flexsheet.messages.wire import WireError, encode
from flexsheet.nodes.node import PortCounts
from tests.waiting import until


def header(sequence: int, writer: str = "writer", epoch: int = 1) -> Header:
    return Header(sequence, 1000 * sequence, 1000 * sequence + 1, "clock", writer, epoch)


def stop(reason: str) -> EStop:
    return EStop(engaged=True, reason=reason)


def finger(x: float) -> TwinFinger:
    return TwinFinger(
        path_label="line",
        path_done=False,
        path_time_s=x,
        position_world_m=np.array([x, 0.0, 0.0]),
        velocity_world_m_per_s=np.zeros(3),
    )


def pictures(value: int) -> StereoPair:
    image = np.full((48, 64), value, np.uint8)
    return StereoPair(device="test", exposure_s=0.001, dropped_frames=0, left=image, right=image)


class RecordingSubscriber:
    """A subscriber that records its messages."""

    def __init__(self, topic: Topic, endpoints: list[str]) -> None:
        self.inbox: list[tuple[Any, Header]] = []
        self.problems: list[str] = []
        self.counts = PortCounts()
        self.extra: Callable[[Message], None] = lambda message: None
        self.subscriber = Subscriber(
            topic, endpoints, self.receive, self.counts, on_problem=self.problems.append
        )
        self.subscriber.start()

    def receive(self, message: Message, header: Header) -> None:
        self.inbox.append((message, header))
        self.extra(message)

    @property
    def sequences(self) -> list[int]:
        return [header.sequence for _, header in self.inbox]


class ForeignPublisher:
    """A publisher that sends arbitrary frames to all connections."""

    def __init__(self, endpoint: str) -> None:
        self._socket: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.PUB)
        self._socket.bind(endpoint)

    def send(self, *frames: Any) -> None:
        self._socket.send_multipart(frames)

    def close(self) -> None:
        self._socket.close(linger=0)


class Connections:
    """A factory of publishers and subscribers, which closes them after the test."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.cleanups: list[Callable[[], None]] = []

    def endpoint(self, name: str = "a") -> str:
        return f"ipc://{self.folder}/{name}"

    def sender(self, topic: Topic, *endpoints: str) -> Publisher:
        publisher = Publisher(topic, endpoints or (self.endpoint(),))
        self.cleanups.append(publisher.close)
        return publisher

    def receiver(self, topic: Topic, *endpoints: str) -> RecordingSubscriber:
        receiver = RecordingSubscriber(topic, list(endpoints or (self.endpoint(),)))
        self.cleanups.append(receiver.subscriber.close)
        return receiver

    def raw(self, kind: int, endpoint: str) -> zmq.Socket[bytes]:
        """Open a ZeroMQ socket that does not use the flexsheet protocol."""
        opened: zmq.Socket[bytes] = zmq.Context.instance().socket(kind)
        opened.setsockopt(zmq.LINGER, 0)
        opened.bind(endpoint)
        self.cleanups.append(lambda: opened.close(linger=0))
        return opened


@pytest_asyncio.fixture
async def connections(tmp_path_factory: pytest.TempPathFactory) -> AsyncIterator[Connections]:
    connections = Connections(tmp_path_factory.mktemp("s"))
    yield connections
    for close in reversed(connections.cleanups):
        close()


async def connected(
    publisher: Publisher, receiver: RecordingSubscriber, make: Callable[[int], Message]
) -> int:
    """Send numbered messages until the first is received; return the number of the last one."""
    number = 0
    while not receiver.inbox:
        number += 1
        publisher.send(make(number), header(number))
        await asyncio.sleep(0.002)
    await until(lambda: receiver.sequences[-1] == number)
    receiver.inbox.clear()
    receiver.counts.gaps = receiver.counts.dropped = 0
    return number


@pytest.mark.parametrize("transport", ["ipc", "tcp"])
async def test_every_delivers_all_in_order(connections: Connections, transport: str) -> None:
    topic = TOPICS["twin/finger"]
    where = connections.endpoint() if transport == "ipc" else "tcp://127.0.0.1:*"
    publisher = connections.sender(topic, where)
    receiver = connections.receiver(topic, *publisher.endpoints)
    start = await connected(publisher, receiver, finger) + 1
    for number in range(start, start + 700):
        publisher.send(finger(number), header(number))
    await until(lambda: len(receiver.inbox) == 700)
    assert receiver.sequences == list(range(start, start + 700))
    assert receiver.inbox[3][0].path_time_s == start + 3
    assert receiver.counts == PortCounts()
    assert receiver.problems == []


async def test_every_counts_and_reports_an_overflow(connections: Connections) -> None:
    topic = replace(TOPICS["twin/finger"], max_bytes=1 << 28)  # a queue of 16
    assert compute_queue_length(topic) == 16
    publisher = connections.sender(topic)
    receiver = connections.receiver(topic)
    start = await connected(publisher, receiver, finger) + 1
    total = 20_000
    for number in range(start, start + total):  # the loop is not run meanwhile: nobody reads
        publisher.send(finger(number), header(number))
    await until(lambda: len(receiver.inbox) > 0)
    last = start + total
    while (
        not receiver.inbox or receiver.sequences[-1] < start + total
    ):  # a last one that gets through
        publisher.send(finger(0.0), header(last))
        last += 1
        await asyncio.sleep(0.002)
    first_loss = receiver.counts.gaps
    assert first_loss > 0
    assert len(receiver.inbox) + receiver.counts.gaps == receiver.sequences[-1] - start + 1
    assert receiver.sequences == sorted(receiver.sequences)
    assert "messages of writer were lost" in receiver.problems[0]


async def test_what_has_just_left_its_writer_waits_for_no_newer(
    connections: Connections, monkeypatch: pytest.MonkeyPatch
) -> None:
    topic = TOPICS["stereo"]
    publisher = connections.sender(topic)
    receiver = connections.receiver(topic)
    start = await connected(publisher, receiver, pictures) + 1
    now = SimpleNamespace(monotonic_ns=lambda: header(start).publish_ns)
    monkeypatch.setattr("flexsheet.messages.bus.time", now)
    for number in range(start, start + 40):
        publisher.send(pictures(number % 250), header(number))
    await until(lambda: receiver.inbox and receiver.sequences[-1] == start + 39)
    assert receiver.sequences[0] == start
    assert receiver.sequences == sorted(receiver.sequences)
    assert len(receiver.inbox) + receiver.counts.dropped == 40


async def test_latest_hands_over_the_newest_and_counts_the_rest(connections: Connections) -> None:
    topic = TOPICS["stereo"]
    publisher = connections.sender(topic)
    receiver = connections.receiver(topic)
    start = await connected(publisher, receiver, pictures) + 1
    for number in range(start, start + 40):
        publisher.send(pictures(number % 250), header(number))
    await until(lambda: receiver.inbox and receiver.sequences[-1] == start + 39)
    assert len(receiver.inbox) + receiver.counts.dropped == 40
    assert receiver.counts.dropped > 0
    assert receiver.counts.gaps == 0
    message, _ = receiver.inbox[-1]
    assert (message.left == (start + 39) % 250).all()
    # A full queue skips messages too. Earlier, these messages counted as lost.
    receiver.counts.dropped = 0
    publisher.send(pictures(0), header(start + 50))
    await until(lambda: receiver.sequences[-1] == start + 50)
    assert (receiver.counts.dropped, receiver.counts.gaps) == (10, 0)
    assert not message.left.flags.writeable


async def test_latest_keeps_the_newest_of_each_writer(connections: Connections) -> None:
    topic = replace(TOPICS["estop"], delivery=Delivery.LATEST)
    one, two = (
        connections.sender(topic, connections.endpoint("1")),
        connections.sender(topic, connections.endpoint("2")),
    )
    receiver = connections.receiver(topic, connections.endpoint("1"), connections.endpoint("2"))
    number = 0
    while {h.writer for _, h in receiver.inbox} != {"one", "two"}:
        number += 1
        one.send(stop("1"), header(number, "one"))
        two.send(stop("2"), header(number, "two"))
        await asyncio.sleep(0.002)
    receiver.inbox.clear()
    for _ in range(10):
        number += 1
        one.send(stop("1"), header(number, "one"))
        two.send(stop("2"), header(number, "two"))
    await until(
        lambda: (
            {(h.writer, h.sequence) for _, h in receiver.inbox}
            >= {("one", number), ("two", number)}
        )
    )


async def test_latched_reaches_late_subscribers_once(connections: Connections) -> None:
    topic = TOPICS["estop"]
    publisher = connections.sender(topic)
    publisher.send(stop("first"), header(1))
    publisher.send(stop("second"), header(2))
    early = connections.receiver(topic)
    await until(lambda: early.inbox)
    late = connections.receiver(topic)
    await until(lambda: late.inbox)
    publisher.send(stop("third"), header(3))
    await until(lambda: early.sequences[-1] == 3 and late.sequences[-1] == 3)
    assert early.sequences == late.sequences == [2, 3]
    assert early.counts == late.counts == PortCounts()
    assert early.problems == late.problems == []


async def test_latched_over_many_late_subscribers(connections: Connections) -> None:
    topic = TOPICS["scene"]
    topic = replace(topic, message=EStop)
    publisher = connections.sender(topic)
    publisher.send(stop("x"), header(1))
    receivers = [connections.receiver(topic) for _ in range(20)]
    await until(lambda: all(receiver.inbox for receiver in receivers))
    assert [receiver.sequences for receiver in receivers] == [[1]] * 20


async def test_subscriber_before_publisher_and_restart_is_no_gap(connections: Connections) -> None:
    topic = TOPICS["estop"]
    receiver = connections.receiver(topic)
    first = connections.sender(topic)
    first.send(stop("a"), header(7, epoch=1))
    await until(lambda: len(receiver.inbox) == 1)
    first.close()
    second = connections.sender(topic)
    second.send(stop("b"), header(1, epoch=2))
    await until(lambda: len(receiver.inbox) == 2)
    assert [message.reason for message, _ in receiver.inbox] == ["a", "b"]
    assert receiver.counts == PortCounts()


async def test_many_restarts_in_a_row(connections: Connections) -> None:
    topic = TOPICS["estop"]
    receiver = connections.receiver(topic)
    for epoch in range(1, 16):
        publisher = connections.sender(topic)
        publisher.send(stop("a"), header(1, epoch=epoch))
        await until(partial(has_epoch, receiver, epoch), f"start {epoch}")
        publisher.close()
    assert len(receiver.inbox) == 15
    assert receiver.counts == PortCounts()


def has_epoch(receiver: RecordingSubscriber, epoch: int) -> bool:
    return bool(receiver.inbox) and receiver.inbox[-1][1].epoch == epoch


async def test_gap_is_counted(connections: Connections) -> None:
    topic = TOPICS["estop"]
    publisher = connections.sender(topic)
    publisher.send(stop("a"), header(1))
    receiver = connections.receiver(topic)
    await until(lambda: receiver.inbox)
    publisher.send(stop("b"), header(5))
    await until(lambda: len(receiver.inbox) == 2)
    assert receiver.counts.gaps == 3
    assert len(receiver.problems) == 1
    assert '"estop"' in receiver.problems[0]


async def test_failing_handler_does_not_stop_the_reader(connections: Connections) -> None:
    topic = TOPICS["estop"]
    publisher = connections.sender(topic)
    publisher.send(stop("a"), header(1))
    receiver = connections.receiver(topic)

    def fail(message: Message) -> None:
        raise ZeroDivisionError("handler's own fault")

    receiver.extra = fail
    await until(lambda: receiver.inbox)
    publisher.send(stop("b"), header(2))
    await until(lambda: len(receiver.inbox) == 2)
    assert "handler's own fault" in receiver.problems[0]


async def test_close_within_the_handler(connections: Connections) -> None:
    topic = TOPICS["twin/finger"]
    publisher = connections.sender(topic)
    receiver = connections.receiver(topic)
    start = await connected(publisher, receiver, finger) + 1
    receiver.extra = lambda message: receiver.subscriber.close()
    for number in range(start, start + 20):
        publisher.send(finger(number), header(number))
    await until(lambda: receiver.inbox)
    for _ in range(20):
        await asyncio.sleep(0)
    assert len(receiver.inbox) == 1
    receiver.subscriber.close()


async def test_bad_messages_are_rejected_and_good_ones_pass(connections: Connections) -> None:
    topic = TOPICS["estop"]
    foreign = connections.raw(zmq.PUB, connections.endpoint())
    receiver = connections.receiver(topic)
    good = encode(stop("fine"), header(1))
    number = 1
    while not receiver.inbox:
        foreign.send_multipart(encode(stop("fine"), header(number)))
        number += 1
        await asyncio.sleep(0.002)
    bad: list[list[Any]] = [
        [b"hello"],
        [b""],
        [good[0], b"one frame too many"],
        [good[0][:-3]],
        [b"\xff" * 1000],
        encode(finger(1.0), header(2)),
        [bytes(good[0]) + b" " * topic.max_bytes],
    ]
    for frames in bad:
        foreign.send_multipart(frames)
    foreign.send_multipart(encode(stop("still fine"), header(number)))
    await until(lambda: receiver.inbox[-1][0].reason == "still fine")
    assert receiver.counts.rejected == len(bad)
    assert len(receiver.problems) == 4  # malformed, frames, type, size: each once
    assert all('topic "estop": a message was refused' in problem for problem in receiver.problems)


async def test_many_times_too_large_a_frame_is_counted_and_ends_nothing(
    connections: Connections,
) -> None:
    topic = TOPICS["estop"]
    foreign = connections.raw(zmq.PUB, connections.endpoint())
    receiver = connections.receiver(topic)
    number = 0
    while not receiver.inbox:
        number += 1
        foreign.send_multipart(encode(stop("fine"), header(number)))
        await asyncio.sleep(0.002)
    foreign.send(bytes(10 * topic.max_bytes))
    foreign.send_multipart(encode(stop("after"), header(number + 1)))
    await until(lambda: receiver.inbox[-1][0].reason == "after")
    assert receiver.counts.rejected == 1
    assert "at most" in receiver.problems[0]


async def test_too_large_a_message_is_rejected_at_the_sender(connections: Connections) -> None:
    publisher = connections.sender(replace(TOPICS["stereo"], max_bytes=5000))
    with pytest.raises(WireError, match=r"StereoPair.*at most 5000"):
        publisher.send(pictures(1), header(1))


async def test_endpoint_in_use(connections: Connections) -> None:
    topic = TOPICS["twin/arms"]
    connections.sender(topic)
    with pytest.raises(BusError, match=r'topic "twin/arms": ipc://.* is in use'):
        connections.sender(topic)
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        with pytest.raises(BusError, match=r'topic "twin/arms": tcp://.* is in use'):
            connections.sender(topic, f"tcp://127.0.0.1:{taken.getsockname()[1]}")


async def test_stale_ipc_file_of_a_killed_writer_is_replaced(connections: Connections) -> None:
    dead = socket.socket(socket.AF_UNIX)
    dead.bind(connections.endpoint().removeprefix("ipc://"))
    dead.close()
    connections.sender(TOPICS["estop"])


@pytest.mark.parametrize(
    ("endpoint", "words"),
    [
        ("ipc:///" + "x" * 200, "has 201 bytes, but the system allows only 107"),
        ("ipc:///no/such/folder/a", "cannot be bound"),
        ("tcp://127.0.0.1:99999", "the port must be a number from 1 to 65535"),
        (
            "tcp://192.0.2.1:7777",
            "other hosts can reach tcp://192.0.2.1:7777, but there are no keys",
        ),
        ("nonsense", "expected ipc"),
    ],
)
async def test_impossible_endpoints(connections: Connections, endpoint: str, words: str) -> None:
    with pytest.raises(BusError, match=words) as caught:
        connections.sender(TOPICS["estop"], endpoint)
    assert '"estop"' in str(caught.value)


async def test_impossible_connections(connections: Connections) -> None:
    for endpoint in ("ipc:///" + "x" * 200, "nonsense", "tcp://127.0.0.1:x"):
        with pytest.raises(BusError, match=r'topic "estop"'):
            connections.receiver(TOPICS["estop"], endpoint)


async def test_zero_copy_frames_outlive_the_socket(connections: Connections) -> None:
    topic = TOPICS["stereo"]
    publisher = connections.sender(topic)
    receiver = connections.receiver(topic)
    number = await connected(publisher, receiver, pictures)
    image = np.random.default_rng(1).integers(0, 255, (480, 640), np.uint8)
    pair = StereoPair(device="t", exposure_s=0.0, dropped_frames=0, left=image, right=image)
    publisher.send(pair, header(number + 1))
    await until(lambda: receiver.inbox)
    publisher.close()
    receiver.subscriber.close()
    message: StereoPair = receiver.inbox[-1][0]
    assert np.array_equal(message.left, image)
    with pytest.raises(ValueError, match="read-only"):
        message.right[0, 0] = 1
    with pytest.raises(ValueError, match=r"WRITEABLE|writeable"):
        message.right.setflags(write=True)


def test_queue_lengths_are_bounded_for_every_topic() -> None:
    for topic in TOPICS.values():
        assert 16 <= compute_queue_length(topic) <= 1000


async def test_twice_started(connections: Connections) -> None:
    receiver = connections.receiver(TOPICS["estop"])
    with pytest.raises(BusError, match="was called twice; call it once"):
        receiver.subscriber.start()


def has_received(receiver: RecordingSubscriber, number: int) -> bool:
    return bool(receiver.inbox) and receiver.sequences[-1] == number


def arms() -> TwinArms:
    return TwinArms(
        joints_left_rad=np.zeros(6),
        joints_right_rad=np.zeros(6),
        world_from_flange_left=np.eye(4),
        world_from_flange_right=np.eye(4),
    )


@pytest.mark.parametrize("delivery", [Delivery.EVERY, Delivery.LATEST, Delivery.LATCHED])
async def test_bursts_never_leave_a_message_lying(
    connections: Connections, delivery: Delivery
) -> None:
    """Every message of a burst is delivered, although the sockets are edge-triggered."""
    topic = replace(TOPICS["twin/arms"], delivery=delivery)
    publisher = connections.sender(topic)
    receiver = connections.receiver(topic)
    number = await connected(publisher, receiver, lambda _: arms())
    first = number + 1
    random = np.random.default_rng(3)
    for _ in range(300):
        for _ in range(int(random.integers(1, 5))):
            number += 1
            publisher.send(arms(), header(number))
            if random.random() < 0.5:
                await asyncio.sleep(0)
        await until(partial(has_received, receiver, number), "delivery")
    assert receiver.counts.gaps == receiver.counts.rejected == 0
    assert len(receiver.inbox) + receiver.counts.dropped == number - first + 1
    assert receiver.counts.dropped == 0 or delivery is Delivery.LATEST


async def test_unopened_frames_of_every_message_for_the_recorder(
    connections: Connections, tmp_path: Path
) -> None:
    topic = TOPICS["stereo"]
    publisher = connections.sender(topic)
    bag = BagWriter(tmp_path / "a.mcap")
    connections.cleanups.append(bag.close)
    inbox: list[int] = []

    def record(frames: list[Any], header: Header) -> None:
        bag.write_frames(topic, frames, header, header.publish_ns)
        inbox.append(header.sequence)

    problems: list[str] = []
    receiver = Subscriber(
        topic, [connections.endpoint()], record, PortCounts(), on_problem=problems.append, raw=True
    )
    receiver.start()
    connections.cleanups.append(receiver.close)
    number = 0
    while not inbox:
        number += 1
        publisher.send(pictures(number), header(number))
        await asyncio.sleep(0.002)
    for _ in range(40):  # on a latest topic, and yet none is left out
        number += 1
        publisher.send(pictures(number), header(number))
    await until(lambda: inbox[-1] == number)
    assert inbox == list(range(inbox[0], number + 1))
    assert problems == []
    bag.close()
    for _, message, head, _ in BagReader(tmp_path / "a.mcap"):
        assert isinstance(message, StereoPair)
        assert (message.left == head.sequence).all()


def make_ending_subscriber(
    connections: Connections, endpoint: str, local: LocalBus | None = None
) -> tuple[list[str], PortCounts]:
    """Return a list to which a subscriber adds the reason of each e-stop, and "end" at each end of
    a connection.
    """
    seen: list[str] = []
    counts = PortCounts()
    subscriber = Subscriber(
        TOPICS["estop"],
        [endpoint],
        lambda message, _: seen.append(message.reason),
        counts,
        on_disconnected=lambda: seen.append("end"),
        local=local,
    )
    subscriber.start()
    connections.cleanups.append(subscriber.close)
    return seen, counts


PUBLISH_AND_WAIT = """
import sys, time, zmq
socket = zmq.Context.instance().socket(zmq.XPUB)
socket.bind(sys.argv[1])
print(socket.getsockopt_string(zmq.LAST_ENDPOINT), flush=True)
socket.recv()
socket.send(bytes.fromhex(sys.argv[2]))
time.sleep(600)
"""


@pytest.mark.parametrize("transport", ["ipc", "tcp"])
async def test_the_end_of_a_killed_writer_is_reported_after_its_last_message(
    connections: Connections, transport: str
) -> None:
    (frame,) = encode(stop("a"), header(1))
    endpoint = connections.endpoint() if transport == "ipc" else "tcp://127.0.0.1:*"
    writer = await asyncio.create_subprocess_exec(
        sys.executable, "-c", PUBLISH_AND_WAIT, endpoint, bytes(frame).hex(), stdout=PIPE
    )
    try:
        assert writer.stdout is not None
        endpoint = (await writer.stdout.readline()).decode().strip()
        seen, counts = make_ending_subscriber(connections, endpoint)
        await until(lambda: seen)
    finally:
        writer.kill()
        await writer.wait()
    await until(lambda: len(seen) > 1)
    restarted = connections.sender(TOPICS["estop"], endpoint)
    restarted.send(stop("b"), header(1, epoch=2))
    await until(lambda: "b" in seen)
    assert seen == ["a", "end", "b"]
    assert counts == PortCounts()


@pytest.mark.parametrize("transport", ["ipc", "tcp", "local"])
async def test_an_interrupted_publisher_disconnects_its_readers_and_goes_on(
    connections: Connections, transport: str
) -> None:
    endpoint = "tcp://127.0.0.1:*" if transport == "tcp" else connections.endpoint()
    local = LocalBus([endpoint]) if transport == "local" else None
    publisher = Publisher(TOPICS["estop"], [endpoint], local=local)
    connections.cleanups.append(publisher.close)
    seen, counts = make_ending_subscriber(connections, publisher.endpoints[0], local)
    for number in range(1, 4):
        reason = f"stop {number}"
        publisher.send(stop(reason), header(number))
        await until(lambda reason=reason: reason in seen)
        publisher.interrupt()
        await until(lambda number=number: seen.count("end") == number)
    messages = [one for one in seen if one != "end"]
    assert messages == ["stop 1", "stop 2", "stop 3"]
    assert seen.index("end") == 1
    assert counts == PortCounts()


async def test_latched_messages_reach_late_subscribers_by_tcp_and_ipc(
    connections: Connections,
) -> None:
    publisher = connections.sender(TOPICS["estop"], connections.endpoint(), "tcp://127.0.0.1:*")
    publisher.send(stop("before"), header(1))
    for endpoint in publisher.endpoints:
        receiver = connections.receiver(TOPICS["estop"], endpoint)
        await until(lambda receiver=receiver: receiver.inbox)
        assert receiver.sequences == [1]
