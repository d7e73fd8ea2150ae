"""Bridge a running graph to ROS 2: publish its topics over DDS.

The bridge reads topics of the graph like a command-line tool. ROS nodes cannot publish in the
graph.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Collection
from functools import partial
from typing import Any

from flexsheet.launch.plans.plan_model import ResolvedGraph
from flexsheet.launch.ros2.dds import RosParticipant
from flexsheet.launch.ros2.mapping import (
    CONTEXT_TOPICS,
    Converter,
    Ros2Error,
    list_ros_topics,
    load_ros_types,
)
from flexsheet.launch.running.runs import Run
from flexsheet.launch.running.tools import make_subscriber
from flexsheet.messages.base import Header, Message
from flexsheet.messages.bus import Problem, Subscriber
from flexsheet.messages.clock import SystemClock
from flexsheet.messages.topics import TOPICS, find_topic


class Ros2Bridge:
    """A bridge between one running graph and one participant of DDS, the middleware of ROS 2.

    topics: flexsheet topics to publish.
    published: number of messages by ROS topic.
    on_problem: function that is called with the text of an error.
    """

    def __init__(
        self,
        plan: ResolvedGraph,
        run: Run,
        participant: RosParticipant,
        *,
        topics: Collection[str],
        on_problem: Problem,
    ) -> None:
        self.published: Counter[str] = Counter()
        self._participant, self._on_problem = participant, on_problem
        self._ros = load_ros_types()
        self._converter = Converter(self._ros)
        self._clock = SystemClock()
        self._topics = frozenset(topics)
        for name in topics:
            for ros_topic, _ in list_ros_topics(TOPICS[name]):
                participant.advertise(ros_topic)
        context = CONTEXT_TOPICS & plan.writers.keys()
        self._subscribers: list[Subscriber] = [
            make_subscriber(name, plan, run, partial(self._on_message, name), on_problem=on_problem)
            for name in sorted(self._topics | context)
        ]

    def start(self) -> None:
        """Connect to the graph. An event loop must be running."""
        for subscriber in self._subscribers:
            subscriber.start()

    def close(self) -> None:
        for subscriber in self._subscribers:
            subscriber.close()
        self._participant.close()

    def _on_message(self, topic: str, message: Any, header: Header) -> None:
        now_ns = self._clock.now_ns()
        shift_ns = time.time_ns() - now_ns
        if header.clock_id != self._clock.id:
            # The offset of the other computer's clock is unknown, but small on a fast network.
            shift_ns += now_ns - header.publish_ns
        self._publish(topic, message, header, shift_ns)

    def _publish(self, topic: str, message: Message, header: Header, shift_ns: int) -> None:
        wanted = self._participant.has_readers if topic in self._topics else lambda _: False
        for ros_topic, made in self._converter.convert(topic, message, header, shift_ns, wanted):
            try:
                self._participant.write(ros_topic, self._ros.encode(ros_topic.ros_type, made))
            except Ros2Error as error:
                self._on_problem(str(error))
                continue
            self.published[ros_topic.name] += 1


def list_default_topics(plan: ResolvedGraph) -> list[str]:
    """Return the topics that are published by default: all topics that bags contain."""
    return [name for name in plan.writers if find_topic(name).logged]
