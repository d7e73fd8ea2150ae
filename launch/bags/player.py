"""Play a bag: publish its messages in a running graph of nodes, with the writer name "tools"."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Collection
from dataclasses import dataclass
from pathlib import Path

from flexsheet.launch.plans.plan_model import ResolvedGraph
from flexsheet.launch.running.runs import Run
from flexsheet.launch.running.tools import READER_RECONNECT_S, GraphWriter, list_tool_topics
from flexsheet.messages.bag import BagError, BagReader
from flexsheet.messages.base import Header, Message
from flexsheet.messages.clock import SystemClock
from flexsheet.messages.clock_table import shift_stamps
from flexsheet.messages.topics import Delivery, find_topic

Progress = Callable[[float, float], None]
"""A function that is called with the duration played so far and the total duration (s)."""


NEVER_PLAYED = {
    "status": "it describes the nodes of the recording",
    "arming": "commands to arm the arms are not repeated",
    "estop": "an e-stop or its reset is not repeated",
    "recording": "requests to record are not repeated",
}
"""The topics that are never played, and the reason for each of these topics."""


@dataclass(frozen=True, slots=True)
class TopicSelection:
    """The topics of a bag that will be played, and the reason for each omitted topic."""

    topics: tuple[str, ...]
    left_out: dict[str, str]


def select_topics(
    recorded: Collection[str], plan: ResolvedGraph, wanted: Collection[str]
) -> TopicSelection:
    """Select the topics of a bag that command-line tools are allowed to publish in a graph.

    recorded: topics of the bag.
    wanted: topics to play; empty for all topics.

    Raises BagError if a wanted topic cannot be played.
    """
    writable = list_tool_topics(plan)
    left_out = {}
    chosen = []
    for name in recorded:
        if wanted and name not in wanted:
            continue
        if name in NEVER_PLAYED:
            left_out[name] = NEVER_PLAYED[name]
        elif name in writable:
            chosen.append(name)
        else:
            owner = ", ".join(writer.name for writer in plan.writers.get(name, ()))
            left_out[name] = f"{owner} writes it" if owner else "it is not part of the graph"
    for name in wanted:
        if name not in chosen:
            why = left_out.get(name, "it is not in the bag")
            raise BagError(f'topic "{name}" cannot be played: {why}; omit this topic')
    return TopicSelection(tuple(chosen), left_out)


async def play(
    bag: Path,
    plan: ResolvedGraph,
    run: Run,
    *,
    topics: Collection[str],
    rate: float = 1.0,
    start_s: float = 0.0,
    progress: Progress = lambda played, total: None,
) -> int:
    """Play a bag once, and return the number of published messages.

    First, the last message of each latched topic before `start_s` is published. All timestamps are
    shifted, so that a message has the same age as in the recording.

    rate: playback speed divided by the recorded speed.
    start_s: time in the bag at which playback starts, s.
    progress: function that is called with the duration played so far and the total duration (s).
    """
    summary = BagReader(bag).info()
    begin_ns = summary.start_ns + round(start_s * 1e9)
    total_s = max(0.0, summary.duration_s - start_s)
    clock = SystemClock()
    recorded_clock = summary.metadata.get("recording", {}).get("clock_id")
    writer = GraphWriter(plan, run, topics)
    sent = 0

    def send(name: str, message: Message, header: Header, log_ns: int, due_ns: int) -> None:
        nonlocal sent
        same_clock = recorded_clock in (None, header.clock_id)
        shift_ns = due_ns - log_ns
        source_ns = header.source_ns + shift_ns if same_clock else due_ns
        writer.publish(name, shift_stamps(message, shift_ns), source_ns=max(0, source_ns))
        sent += 1

    try:
        await asyncio.sleep(READER_RECONNECT_S)
        now_ns = clock.now_ns()
        for name, message, header, log_ns in latched_before(bag, topics, begin_ns):
            send(name, message, header, log_ns, now_ns)
        start_ns = clock.now_ns()
        for name, message, header, log_ns in BagReader(bag, topics, start_ns=begin_ns):
            played_ns = log_ns - begin_ns
            due_ns = start_ns + round(played_ns / rate)
            wait_s = (due_ns - clock.now_ns()) * 1e-9
            if wait_s > 0:
                await asyncio.sleep(wait_s)
            send(name, message, header, log_ns, due_ns)
            progress(played_ns * 1e-9, total_s)
        await asyncio.sleep(READER_RECONNECT_S / 2)
    finally:
        writer.close()
    return sent


def latched_before(
    bag: Path, topics: Collection[str], begin_ns: int
) -> list[tuple[str, Message, Header, int]]:
    """Return, for each latched topic, the last message that was recorded before `begin_ns`.

    Each entry is (topic name, message, header, time of recording in ns).
    """
    latched = [name for name in topics if find_topic(name).delivery is Delivery.LATCHED]
    last = {}
    for entry in BagReader(bag, latched, end_ns=begin_ns):
        last[entry[0]] = entry
    return list(last.values())
