"""Writing into a graph from outside of it, as the writer "tools" that every plan foresees."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from launch.planned import MAIN, TOOLS, Plan, local_endpoints, local_sources
from launch.runs import Run, ring_file
from messages.base import Header, Message
from messages.bus import Handler, Problem, Publisher, Subscriber
from messages.clock import SystemClock
from messages.security import KeyRing
from messages.topics import topic_named
from messages.types import HostStatus, Status

READER_RECONNECT_S = 1.0
"""Readers look for a writer that was not there at most every half second."""


@dataclass(slots=True)
class Counts:
    """What a tool's subscriber has lost or refused."""

    dropped: int = 0
    gaps: int = 0
    rejected: int = 0


def topics_for_tools(plan: Plan) -> list[str]:
    """Topics that a tool may write in this plan."""
    return [topic for topic in plan.writers if plan.writer(topic, TOOLS) is not None]


def keys_of(plan: Plan, run: Run) -> KeyRing | None:
    """The keys of the main host, where tools are; None where the plan has none."""
    return KeyRing(ring_file(run, MAIN)) if plan.keys else None


def subscriber_to(
    topic: str,
    plan: Plan,
    run: Run,
    on_message: Handler,
    *,
    on_problem: Problem,
    unopened: bool = False,
) -> Subscriber:
    """A subscriber, not yet started, to all writers of a topic in a running graph."""
    wanted = topic_named(topic)
    return Subscriber(
        wanted,
        local_sources(run, plan.sources_to_read(topic)),
        on_message,
        Counts(),
        on_problem=on_problem,
        unopened=unopened,
        keys=keys_of(plan, run),
        # Who does not run our plan must be seen most of all.
        plan=None if wanted.message in (Status, HostStatus) else plan.hash,
    )


class ToolsWriter:
    """Publishers for some topics of a running graph; needs a running loop.

    Raises BadInputError for a topic that is a node's, BusError when another tool writes it now.
    """

    def __init__(self, plan: Plan, run: Run, topics: Iterable[str]) -> None:
        self._clock = SystemClock()
        self._epoch, self._plan = self._clock.now_ns(), plan.hash
        keys = keys_of(plan, run)
        self._sequences: dict[str, int] = {}
        self._publishers: dict[str, Publisher] = {}
        try:
            for name in topics:
                writer = plan.writer(name, TOOLS)
                if writer is None:
                    from launch.documents import BadInputError, Problem

                    owners = ", ".join(one.name for one in plan.writers.get(name, ()))
                    what = f"is written by {owners}" if owners else "is not part of the graph"
                    raise BadInputError(
                        [
                            Problem(
                                plan.launch_file,
                                ("from_tools",),
                                f'topic "{name}" {what}',
                                f'list it in "from_tools"; open are: '
                                f"{', '.join(topics_for_tools(plan))}",
                            )
                        ]
                    )
                endpoints = local_endpoints(run, writer.endpoints)
                self._publishers[name] = Publisher(topic_named(name), endpoints, keys=keys)
        except BaseException:
            self.close()
            raise

    def publish(self, topic: str, message: Message, *, source_ns: int | None = None) -> None:
        """Send a message with the next sequence number, stamped now (or as `source_ns` says)."""
        self._sequences[topic] = self._sequences.get(topic, 0) + 1
        now_ns = self._clock.now_ns()
        self._publishers[topic].send(
            message,
            Header(
                sequence=self._sequences[topic],
                source_ns=now_ns if source_ns is None else source_ns,
                publish_ns=now_ns,
                clock_id=self._clock.id,
                writer=TOOLS,
                epoch=self._epoch,
                plan=self._plan,
            ),
        )

    def close(self) -> None:
        for publisher in self._publishers.values():
            publisher.close()
