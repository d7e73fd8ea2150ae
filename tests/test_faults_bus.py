"""Test slow readers, message storms and forged messages over real sockets."""

from __future__ import annotations

import asyncio
import random
from dataclasses import replace
from typing import Any

import numpy as np
import psutil
import pytest
import zmq

from flexsheet.messages.base import Header
from flexsheet.messages.bus import compute_queue_length
from flexsheet.messages.topics import TOPICS, Delivery
from flexsheet.messages.types import StereoPair
from flexsheet.messages.wire import encode
from tests.fingertips import fingertip
from tests.test_messages_bus import Connections, connected, connections, finger, header
from tests.waiting import until

__all__ = ["connections"]


async def test_a_stuck_reader_slows_no_other_and_fills_no_memory(connections: Connections) -> None:
    """One subscriber never reads. The publisher does not block, and another subscriber receives all
    messages.
    """
    topic = TOPICS["twin/stereo"]
    publisher, receiver = connections.sender(topic), connections.receiver(topic)
    receiver.extra = lambda _: receiver.inbox.append(
        (None, receiver.inbox.pop()[1])
    )  # pictures are not kept
    stuck: Any = zmq.Context.instance().socket(zmq.SUB)
    stuck.setsockopt(zmq.SUBSCRIBE, b"")
    stuck.setsockopt(zmq.RCVHWM, compute_queue_length(topic))
    stuck.connect(connections.endpoint())
    connections.cleanups.append(lambda: stuck.close(linger=0))
    last = await connected(publisher, receiver, large_pictures)
    process = psutil.Process()
    before = process.memory_info().rss
    for number in range(last + 1, last + 2001):
        publisher.send(large_pictures(number), header(number))
        if (number - last) % 10 == 0:
            await until(lambda: receiver.inbox and receiver.sequences[-1] == number)  # noqa: B023
    assert len(receiver.inbox) + receiver.counts.dropped == 2000
    assert receiver.counts.gaps == 0
    # All have 200 MB; the queues of publisher and reader hold 65 each.
    assert process.memory_info().rss - before < 60 << 20


def large_pictures(number: int) -> StereoPair:
    """Make a message of 100 KB."""
    left, right = (np.full((200, 250), number % 250, np.uint8) for _ in range(2))
    return StereoPair(device="test", exposure_s=0.001, dropped_frames=0, left=left, right=right)


@pytest.mark.parametrize("name", ["sheet_target", "twin/finger"])
async def test_a_storm_is_dropped_on_latest_topics_and_reported_on_others(
    connections: Connections, name: str
) -> None:
    """Messages arrive at a hundred times the rate of the topic."""
    topic = replace(TOPICS["twin/finger"], delivery=TOPICS[name].delivery, rate_hz=(30, 150))
    publisher, receiver = connections.sender(topic), connections.receiver(topic)
    start = await connected(publisher, receiver, finger) + 1
    count = 15_000
    for number in range(start, start + count):
        publisher.send(finger(0.0), header(number))
    number = start + count
    while not receiver.inbox or receiver.sequences[-1] < start + count:
        publisher.send(finger(1.0), header(number))
        number += 1
        await asyncio.sleep(0.002)
    handled, lost = len(receiver.inbox), receiver.counts.dropped + receiver.counts.gaps
    assert handled + lost == receiver.sequences[-1] - start + 1
    assert lost > 0
    assert receiver.sequences == sorted(receiver.sequences)
    reported = any("lost" in problem for problem in receiver.problems)
    assert reported == (topic.delivery is Delivery.EVERY and receiver.counts.gaps > 0)


async def test_of_thousands_of_forgeries_over_a_socket_none_is_accepted(
    connections: Connections,
) -> None:
    """The messages are malformed, of another type, from an earlier start, or repeated."""
    topic = TOPICS["fingertip"]
    endpoint = connections.endpoint("forger")
    forger = connections.raw(zmq.PUB, endpoint)
    receiver = connections.receiver(topic, endpoint)
    message = fingertip(np.zeros(3))
    forged = Header(7, 1000, 2000, "clock", "planner", 1, "plan")

    def send(frames: list[Any]) -> None:
        forger.send_multipart([bytes(one) for one in frames])

    number = 1 << 40
    while not receiver.inbox:
        number += 1
        send(encode(message, header(number, epoch=5)))
        await asyncio.sleep(0.001)
    chance, sent = random.Random(7), 0
    for _ in range(1000):
        send(change_frames(encode(message, forged), chance))
        send(encode(message, header(chance.randrange(1, number), epoch=5)))
        send(encode(message, header(number, epoch=4)))
        sent += 3
        if sent % 60 == 0:
            await asyncio.sleep(0.001)
    inbox = {(one.writer, one.epoch, one.sequence) for _, one in receiver.inbox}
    number += 1
    while ("writer", 5, number) not in inbox:
        send(encode(message, header(number, epoch=5)))
        await asyncio.sleep(0.001)
        inbox = {(one.writer, one.epoch, one.sequence) for _, one in receiver.inbox}
    assert receiver.counts.rejected > sent // 3
    ours = [one for _, one in receiver.inbox if one.writer == "writer"]
    assert [one.sequence for one in ours] == sorted({one.sequence for one in ours})
    assert {one.epoch for one in ours} == {5}


def change_frames(frames: list[Any], chance: random.Random) -> list[bytes]:
    """Return frames with bytes flipped, cut, inserted or repeated, or with a repeated frame."""
    changed = [bytes(one) for one in frames]
    for _ in range(chance.randrange(1, 4)):
        place = chance.randrange(len(changed))
        frame = changed[place]
        at, end = sorted(chance.randrange(len(frame) + 1) for _ in range(2))
        match chance.randrange(5):
            case 0:
                flipped = bytes(one ^ 1 << chance.randrange(8) for one in frame[at : at + 1])
                changed[place] = frame[:at] + flipped + frame[at + 1 :]
            case 1:
                changed[place] = frame[:at] + frame[end:]
            case 2:
                changed[place] = frame[:at] + chance.randbytes(8) + frame[at:]
            case 3:
                changed[place] = frame[:end] + frame[at:]
            case _:
                changed.insert(place, frame)
    return changed
