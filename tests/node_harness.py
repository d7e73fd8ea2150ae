"""Run one node in a test, with a virtual clock, and collect its messages."""

from __future__ import annotations

from typing import Any, Generic, TypeVar

from flexsheet.messages.base import Header, Message
from flexsheet.messages.clock import Clock, VirtualClock
from flexsheet.messages.topics import Topic
from flexsheet.nodes.node import Node, NodeParameters

N = TypeVar("N", bound=Node)
M = TypeVar("M", bound=Message)
C = TypeVar("C", bound=Clock)


class NodeHarness(Generic[N, C]):
    """A node with a virtual clock, and its published messages as (topic, message, header)."""

    def __init__(
        self,
        node_class: type[N],
        parameters: NodeParameters,
        clock: C,
        *,
        name: str = "node",
        topics: dict[str, str] | None = None,
    ) -> None:
        self.clock = clock
        self.published: list[tuple[Topic, Message, Header]] = []
        self.node = node_class(
            parameters, name=name, clock=clock, send=self._collect, topics=topics
        )

    def _collect(self, topic: Topic, message: Message, header: Header) -> None:
        self.published.append((topic, message, header))

    def messages(self, kind: type[M]) -> list[tuple[M, Header]]:
        """Return the published messages of one type, with their headers."""
        return [
            (message, header) for _, message, header in self.published if isinstance(message, kind)
        ]

    async def step(
        self, port: str, message: Message, *, age_ms: float = 0.0, sequence: int = 1
    ) -> None:
        """Deliver a message with a source timestamp that is `age_ms` old, and wait for its
        handler.
        """
        now_ns = self.clock.now_ns()
        header = Header(sequence, now_ns - int(1e6 * age_ms), now_ns, self.clock.id, "test", 1)
        await self.node.step(port, message, header)
        assert self.node.errors == 0, self.node.last_error


def build_node(
    node_class: type[N], parameters: NodeParameters, **options: Any
) -> NodeHarness[N, VirtualClock]:
    """Build a node with a virtual clock that starts at 1000 ns."""
    return NodeHarness(node_class, parameters, VirtualClock(1_000, clock_id="clock"), **options)
