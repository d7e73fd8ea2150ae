"""Test the delivery of messages between the nodes of one process."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flexsheet.messages.base import Header, Message
from flexsheet.messages.bus import Publisher, Source, Subscriber, compute_queue_length
from flexsheet.messages.local_bus import LocalBus
from flexsheet.messages.topics import TOPICS, Topic
from flexsheet.messages.types import EStop, StereoPair
from flexsheet.messages.wire import INLINE_BYTES, WireError, encode
from flexsheet.nodes.node import PortCounts
from tests.test_messages_bus import finger, header, pictures, stop
from tests.waiting import until

FINGER, ESTOP, STEREO = TOPICS["twin/finger"], TOPICS["estop"], TOPICS["stereo"]
FINGERTIP = TOPICS["fingertip"]


class Reader:
    """A subscriber that records its messages, from its own process or from any endpoint."""

    def __init__(self, topic: Topic, source: str | Source, local: LocalBus | None, **more: Any):
        self.messages: list[tuple[Any, Header]] = []
        self.problems: list[str] = []
        self.counts = PortCounts()
        self.subscriber = Subscriber(
            topic,
            [source],
            lambda *one: self.messages.append(one),
            self.counts,
            on_problem=self.problems.append,
            local=local,
            **more,
        )
        self.subscriber.start()

    @property
    def sequences(self) -> list[int]:
        return [one.sequence for _, one in self.messages]


@contextmanager
def open_publisher(topic: Topic, folder: Path) -> Iterator[tuple[Publisher, LocalBus, str]]:
    endpoint = f"ipc://{folder}/{topic.name.replace('/', '.')}"
    local = LocalBus([endpoint])
    publisher = Publisher(topic, [endpoint], local=local)
    try:
        yield publisher, local, endpoint
    finally:
        publisher.close()


async def turn() -> None:
    """Run the callbacks that are scheduled now."""
    await asyncio.sleep(0)
    await asyncio.sleep(0)


async def test_a_message_is_not_encoded_without_a_reader_in_another_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with open_publisher(FINGER, tmp_path) as (publisher, local, endpoint):
        inside = Reader(FINGER, endpoint, local)
        encoded: list[Message] = []

        def count_encoded(message: Message, *rest: Any, **more: Any) -> Any:
            encoded.append(message)
            return encode(message, *rest, **more)

        monkeypatch.setattr("flexsheet.messages.bus.encode", count_encoded)
        publisher.send(finger(0.1), header(1))
        assert inside.messages == [], "the handler does not run inside of the sender's"
        await turn()
        assert inside.sequences == [1]
        assert encoded == []
        outside = Reader(FINGER, endpoint, None)
        number = 1

        def arrived() -> bool:
            nonlocal number
            number += 1
            publisher.send(finger(0.1 * number), header(number))
            return bool(outside.messages)

        await until(arrived, "a message at the reader with a socket")
        await until(lambda: outside.sequences[-1] == number, "the last message")
        first = outside.sequences[0]
        assert outside.sequences == list(range(first, number + 1))
        assert inside.sequences == list(range(1, number + 1))
        for (near, near_header), (far, far_header) in zip(
            inside.messages[first - 1 :], outside.messages, strict=True
        ):
            assert near_header == far_header
            assert encode(near, near_header) == encode(far, far_header)
        outside.subscriber.close()
        encoded.clear()

        def no_longer_encoded() -> bool:
            nonlocal number
            number, before = number + 1, len(encoded)
            publisher.send(finger(0.0), header(number))
            return len(encoded) == before

        await until(no_longer_encoded, "the end of the subscription")


async def test_large_arrays_are_shared_and_small_ones_copied_all_read_only(tmp_path: Path) -> None:
    with open_publisher(STEREO, tmp_path) as (publisher, local, endpoint):
        first, second = (Reader(STEREO, endpoint, local) for _ in range(2))
        sent = pictures(7)
        assert sent.left.nbytes > INLINE_BYTES
        publisher.send(sent, header(1))
        await turn()
        [(got, _)], [(other, _)] = first.messages, second.messages
        assert got is other, "validated once for all readers"
        assert np.shares_memory(got.left, sent.left)
        with pytest.raises(ValueError, match="read-only"):
            got.left[0, 0] = 1
        sent.left[0, 0] = 9
        assert sent.left.flags.writeable, "the sender's array stays as it was"
    with open_publisher(FINGER, tmp_path) as (publisher, local, endpoint):
        reader = Reader(FINGER, endpoint, local)
        small = finger(0.5)
        publisher.send(small, header(1))
        small.position_world_m[0] = 77.0
        await turn()
        assert reader.messages[0][0].position_world_m[0] == 0.5
        with pytest.raises(ValueError, match="read-only"):
            reader.messages[0][0].position_world_m[0] = 1.0


async def test_delivery_rules_are_those_of_sockets(tmp_path: Path) -> None:
    with open_publisher(STEREO, tmp_path) as (publisher, local, endpoint):
        latest = Reader(STEREO, endpoint, local)
        for number in range(1, 4):
            publisher.send(pictures(number), header(number))
        await turn()
        assert latest.sequences == [3]
        assert latest.counts.dropped == 2
        assert not latest.counts.gaps
    with open_publisher(FINGER, tmp_path) as (publisher, local, endpoint):
        every = Reader(FINGER, endpoint, local)
        length = compute_queue_length(FINGER)
        for number in range(1, length + 4):
            publisher.send(finger(0.0), header(number))
        await turn()
        publisher.send(finger(0.0), header(length + 4))
        await turn()
        assert every.sequences == [*range(1, length + 1), length + 4]
        assert every.counts.gaps == 3
        assert "lost" in every.problems[0]
    with open_publisher(ESTOP, tmp_path) as (publisher, local, endpoint):
        publisher.send(stop("first"), header(1))
        late = Reader(ESTOP, endpoint, local)
        await turn()
        publisher.send(stop("second"), header(2))
        await turn()
        assert late.sequences == [1, 2]
        publisher.forget()
        later = Reader(ESTOP, endpoint, local)
        await turn()
        assert later.sequences == []
        outside = Reader(ESTOP, endpoint, None)
        publisher.send(stop("third"), header(3))
        await until(lambda: 3 in outside.sequences, "the socket's reader")
        outside.subscriber.close()


async def test_invalid_messages_are_rejected_as_from_sockets(tmp_path: Path) -> None:
    with open_publisher(ESTOP, tmp_path) as (publisher, local, endpoint):
        source = Source(endpoint, "writer")
        reader = Reader(
            ESTOP,
            source,
            local,
            plan="p",
            message_filter=lambda message, _: None if message.engaged else "not allowed",
        )
        good = Header(1, 1, 1, "clock", "writer", 5, "p")

        def send(message: Message, **changes: Any) -> None:
            values = {name: getattr(good, name) for name in Header.__slots__}
            publisher.send(message, Header(**values | changes))

        send(stop("a"))
        send(stop("b"), sequence=2, writer="stranger")
        send(stop("c"), sequence=2, plan="other")
        send(stop("d"), sequence=1, epoch=4)
        send(EStop(engaged=False, reason="e"), sequence=2)
        send(EStop.model_construct(engaged="perhaps", reason="f"), sequence=3)
        await turn()
        assert [message.reason for message, _ in reader.messages] == ["a"]
        assert reader.counts.rejected == 5 == len(reader.problems)
        for words in (
            "may write to this endpoint",
            "runs plan",
            "before the writer's last restart",
            "not allowed",
        ):
            assert any(words in problem for problem in reader.problems), words
        assert "EStop.engaged" in reader.problems[-1]
    with open_publisher(FINGERTIP, tmp_path) as (publisher, local, endpoint):
        Reader(FINGERTIP, endpoint, local)
        large = StereoPair(
            device="test",
            exposure_s=0.001,
            dropped_frames=0,
            left=np.zeros((1024, 2048), np.uint8),
            right=np.zeros((1024, 2048), np.uint8),
        )
        with pytest.raises(WireError, match="at most"):
            publisher.send(large, header(1))


async def test_a_failing_or_closed_reader_does_not_stop_the_others(tmp_path: Path) -> None:
    with open_publisher(FINGER, tmp_path) as (publisher, local, endpoint):
        broken, sound = Reader(FINGER, endpoint, local), Reader(FINGER, endpoint, local)
        broken.messages = None  # type: ignore[assignment]  # its handler fails
        publisher.send(finger(0.0), header(1))
        await turn()
        assert "the handler of a message failed" in broken.problems[0]
        assert sound.sequences == [1]
        publisher.send(finger(0.0), header(2))
        sound.subscriber.close()
        await turn()
        assert sound.sequences == [1]
