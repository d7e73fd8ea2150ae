"""Read and write topics of a running graph from command-line tools and experiments.

On the main host, tools are allowed to write the topics that no node writes. On other hosts, they
are allowed to write only e-stops. Tools authenticate with the keys of their host.
"""

from __future__ import annotations

import asyncio
import itertools
import logging
from collections.abc import AsyncIterator, Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

from flexsheet.launch.plans.plan_model import MAIN, ResolvedGraph, Writer, tools_on
from flexsheet.launch.running.runs import Run, local_endpoints, local_sources, ring_file
from flexsheet.messages.base import Header, Message
from flexsheet.messages.bus import Handler, Problem, Publisher, Subscriber
from flexsheet.messages.clock import SystemClock
from flexsheet.messages.security import KeyRing
from flexsheet.messages.topics import find_topic
from flexsheet.messages.types import HostStatus, Status

if TYPE_CHECKING:
    from flexsheet.launch.plans.documents import BadInputError

_log = logging.getLogger("flexsheet.bus")

READER_RECONNECT_S = 1.0
"""The time (s) in which all subscribers connect to a new writer.

Subscribers try to connect every 0.5 s.
"""


@dataclass(slots=True)
class ToolCounts:
    """The numbers of messages that the subscriber of a tool has lost or rejected."""

    dropped: int = 0
    gaps: int = 0
    rejected: int = 0


def tools_host(run: Run) -> str:
    """Return the host name in the launch file whose keys and permissions command-line tools use.

    This is the host whose nodes were started on this computer. If the nodes of all hosts were
    started, it is `MAIN`.
    """
    return run.host or MAIN


def list_tool_topics(plan: ResolvedGraph, host: str = MAIN) -> list[str]:
    """Return the topics of the graph that command-line tools on a host are allowed to write."""
    return [topic for topic in plan.writers if plan.writer(topic, tools_on(host)) is not None]


def load_tool_keys(plan: ResolvedGraph, run: Run) -> KeyRing | None:
    """Return the authentication keys of this host, or None if the graph uses no keys."""
    return KeyRing.load(ring_file(run, tools_host(run))) if plan.keys else None


def make_subscriber(
    topic: str,
    plan: ResolvedGraph,
    run: Run,
    on_message: Handler,
    *,
    on_problem: Problem,
    raw: bool = False,
) -> Subscriber:
    """Return a subscriber to all writers of a topic in a running graph.

    The caller must start the subscriber.

    raw: whether `on_message` receives undecoded messages.
    on_problem: function that is called with the text of an error.
    """
    definition = find_topic(topic)
    return Subscriber(
        definition,
        local_sources(run, plan.sources_to_read(topic, tools_host(run))),
        on_message,
        ToolCounts(),
        on_problem=on_problem,
        raw=raw,
        keys=load_tool_keys(plan, run),
        # Status messages of other plans are accepted, so that the tool can report them.
        plan=None if definition.message in (Status, HostStatus) else plan.hash,
    )


class Graph(Protocol):
    """A graph to which a tool can connect, such as a RunningGraph."""

    @property
    def plan(self) -> ResolvedGraph: ...

    @property
    def run(self) -> Run: ...


async def read_topic(
    graph: Graph, topic: str, count: int | None = None
) -> AsyncIterator[tuple[Message, Header]]:
    """Yield the messages of a topic of a running graph, with their headers, as they arrive.

    If the caller is slow, messages wait in a queue.

    count: number of messages. If it is None, the number is not limited.

    Raises KeyError if the topic does not exist.
    """
    # Import the module here, so that commands that do not call this function start faster.
    import structlog

    arrived: asyncio.Queue[tuple[Message, Header]] = asyncio.Queue()
    subscriber = make_subscriber(
        topic,
        graph.plan,
        graph.run,
        lambda message, header: arrived.put_nowait((message, header)),
        on_problem=structlog.get_logger().warning,
    )
    subscriber.start()
    try:
        for _ in itertools.count() if count is None else range(count):
            yield await arrived.get()
    finally:
        subscriber.close()


def find_tool_writer(plan: ResolvedGraph, run: Run, topic: str) -> Writer:
    """Return the writer of a topic that stands for the tools on this host.

    Raises BadInputError if tools on this host are not allowed to write the topic.
    """
    host = tools_host(run)
    writer = plan.writer(topic, tools_on(host))
    if writer is None:
        raise _make_refusal(plan, topic, host)
    return writer


class TopicWriters:
    """Publishers of topics, which add sequence numbers and timestamps to the messages.

    They require a running event loop.

    writers: writers of the plan by topic name.
    on_refused: function that is called with a text for each refused connection.

    The constructor raises BusError if another process is already writing a topic.
    """

    def __init__(
        self,
        plan: ResolvedGraph,
        run: Run,
        writers: Mapping[str, Writer],
        keys: KeyRing | None,
        on_refused: Problem = _log.warning,
    ) -> None:
        self.clock = SystemClock()
        self._epoch, self._plan, self._writers = self.clock.now_ns(), plan.hash, writers
        self._sequences = dict.fromkeys(writers, 0)
        self._publishers: dict[str, Publisher] = {}
        try:
            for name, writer in writers.items():
                endpoints = local_endpoints(run, writer.endpoints)
                self._publishers[name] = Publisher(
                    find_topic(name), endpoints, keys=keys, on_refused=on_refused
                )
        except BaseException:
            self.close()
            raise

    def publish(self, topic: str, message: Message, *, source_ns: int | None = None) -> Header:
        """Send a message with the next sequence number, and return its header.

        source_ns: source timestamp of the data. If it is None, the present time is used.
        """
        self._sequences[topic] += 1
        now_ns = self.clock.now_ns()
        header = Header(
            sequence=self._sequences[topic],
            source_ns=now_ns if source_ns is None else source_ns,
            publish_ns=now_ns,
            clock_id=self.clock.id,
            writer=self._writers[topic].name,
            epoch=self._epoch,
            plan=self._plan,
        )
        self._publishers[topic].send(message, header)
        return header

    def forget(self, topic: str) -> None:
        """Discard the message that is stored for late subscribers of a latched topic."""
        self._publishers[topic].forget()

    def close(self) -> None:
        for publisher in self._publishers.values():
            publisher.close()


class GraphWriter(TopicWriters):
    """A publisher of topics for tools outside the running graph.

    It requires a running event loop.

    The constructor raises BadInputError if tools are not allowed to write a topic. It raises
    BusError if another tool is already writing the topic.
    """

    def __init__(self, plan: ResolvedGraph, run: Run, topics: Iterable[str]) -> None:
        writers = {name: find_tool_writer(plan, run, name) for name in topics}
        super().__init__(plan, run, writers, load_tool_keys(plan, run))


def _make_refusal(plan: ResolvedGraph, topic: str, host: str) -> BadInputError:
    """Return the error that is raised if tools on a host are not allowed to write a topic."""
    from flexsheet.launch.plans import documents

    may = ", ".join(list_tool_topics(plan, host))
    if topic in list_tool_topics(plan):
        key: tuple[str, ...] = ("hosts", host)
        what = f'topic "{topic}" cannot be written by tools on host "{host}"'
        remedy = f'run the tool on host "{MAIN}" ({plan.hosts[MAIN]}); tools here may write: {may}'
    else:
        key = ("external_topics",)
        owners = ", ".join(one.name for one in plan.writers.get(topic, ()))
        what = f'topic "{topic}" '
        what += f"is written by {owners}" if owners else "is not part of the graph"
        remedy = f'list it in "external_topics"; tools may now write: {may}'
    return documents.BadInputError.single(plan.launch_file, key, what, remedy)
