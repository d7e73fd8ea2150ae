"""Drives a running graph as an experimenter would: moves the twin's finger, sets the display.

It is one more participant of the graph: it publishes as the writer "tools" and subscribes to what
it waits for.  Every wait has a deadline, and an error that says what was waited for and how the
nodes were.
"""

from __future__ import annotations

import asyncio
import random
from collections.abc import Callable
from types import TracebackType
from typing import Any, Self

import numpy as np

from launch.experiments import ExperimentError
from launch.plan import RUN_DIRECTORY, TOOLS, Plan
from launch.runs import Run
from messages.base import Header, Message
from messages.bus import Publisher, Subscriber
from messages.clock import SystemClock
from messages.topics import topic_named
from messages.types import (
    ArmState,
    Correction,
    Display,
    FingerPath,
    SheetTarget,
    Status,
    TwinEye,
    TwinFinger,
)
from nodes.node import Output, PortCounts

READ = ("twin/finger", "twin/eye", "sheet_target", "arm_left", "arm_right", "soft_body", "status")
WRITTEN = ("twin/finger_path", "display")

# The measured finger is never quite still, so neither is the sheet; these tell resting from going.
SETTLED_POSITION_M = 1e-3
SETTLED_SPEED_M_PER_S = 0.05
SETTLED_TURN_RAD_PER_S = 0.8
SETTLED_MESSAGES = 100
PIXELS_EVERY = 10
WAIT_S = 20.0
PICTURE_WAIT_S = 40.0


class Driver:
    """See the module's text; use as an async context manager."""

    def __init__(self, plan: Plan, run: Run) -> None:
        self._plan, self._run = plan, run
        self._clock = SystemClock()
        self._subscribers: list[Subscriber] = []
        self._publishers: dict[str, Publisher] = {}
        self._outputs: dict[str, Output[Any]] = {}
        self._newest: dict[str, Message] = {}
        self._notes: dict[str, str] = {}
        self._waiters: list[tuple[Callable[[], bool], asyncio.Future[None]]] = []
        self._settled_since = 0

    async def __aenter__(self) -> Self:
        epoch = random.SystemRandom().getrandbits(32)
        for name in WRITTEN:
            topic = topic_named(name)
            writer = self._plan.writer(name, TOOLS)
            if writer is None:
                raise ExperimentError(f'the launch file lets no tool write "{name}"')
            self._publishers[name] = Publisher(
                topic, [self._endpoint(one) for one in writer.endpoints]
            )
            self._outputs[name] = Output(topic, self._clock, self._send, TOOLS, epoch)
        for name in READ:
            endpoints = [self._endpoint(one) for one in self._plan.endpoints_to_read(name)]
            subscriber = Subscriber(
                topic_named(name), endpoints, self._handler(name), PortCounts(), on_problem=str
            )
            subscriber.start()
            self._subscribers.append(subscriber)
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        for subscriber in self._subscribers:
            subscriber.close()
        for publisher in self._publishers.values():
            publisher.close()

    def _endpoint(self, endpoint: str) -> str:
        return endpoint.replace(RUN_DIRECTORY, str(self._run.directory))

    def _send(self, topic: Any, message: Message, header: Header) -> None:
        self._publishers[topic.name].send(message, header)

    def _handler(self, name: str) -> Callable[[Message, Header], None]:
        def handle(message: Message, header: Header) -> None:
            self._newest[name] = message
            if isinstance(message, Status):
                self._notes[message.node] = message.note or message.last_error
            if isinstance(message, ArmState):
                self._count_settled()
            for condition, future in self._waiters:
                if not future.done() and condition():
                    future.set_result(None)

        return handle

    def _count_settled(self) -> None:
        left, right = self._newest.get("arm_left"), self._newest.get("arm_right")
        target = self._newest.get("sheet_target")
        settled = (
            isinstance(left, ArmState)
            and isinstance(right, ArmState)
            and isinstance(target, SheetTarget)
            and is_settled(left, target)
            and is_settled(right, target)
        )
        self._settled_since = self._settled_since + 1 if settled else 0

    async def wait_for(self, condition: Callable[[], bool], what: str, seconds: float) -> None:
        """Wait until `condition` holds, asked at each message; ExperimentError after `seconds`."""
        if condition():
            return
        future: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        entry = (condition, future)
        self._waiters.append(entry)
        try:
            async with asyncio.timeout(seconds):
                await future
        except TimeoutError:
            notes = "; ".join(f"{node}: {note}" for node, note in self._notes.items() if note)
            raise ExperimentError(
                f"waited {seconds:g} s in vain for {what} (the nodes say: {notes or 'nothing'})"
            ) from None
        finally:
            self._waiters.remove(entry)

    def newest(self, topic: str) -> Message | None:
        return self._newest.get(topic)

    async def wait_until_up(self) -> None:
        """Wait until the soft body answers and both arms follow."""

        def up() -> bool:
            arms = [self._newest.get(name) for name in ("arm_left", "arm_right")]
            following = all(isinstance(arm, ArmState) and arm.mode == "follow" for arm in arms)
            return following and "soft_body" in self._newest

        await self.wait_for(up, "both arms to follow and the soft body to answer", 3 * WAIT_S)

    def move_finger(self, path: FingerPath) -> None:
        self._outputs["twin/finger_path"].publish(path)

    async def follow(self, path: FingerPath) -> None:
        """Send the finger along a path and wait until it is through."""
        self.move_finger(path)

        def done() -> bool:
            finger = self._newest.get("twin/finger")
            return (
                isinstance(finger, TwinFinger)
                and finger.path_label == path.label
                and finger.path_done
            )

        await self.wait_for(
            done, f'the finger to end "{path.label}"', float(path.times_s[-1]) + WAIT_S
        )

    async def wait_settled(self) -> None:
        """Wait until the target rests and both arms are where they are told to be."""
        self._settled_since = 0
        await self.wait_for(
            lambda: self._settled_since >= SETTLED_MESSAGES, "the sheet to come to rest", WAIT_S
        )

    def show(self, display: Display) -> None:
        self._outputs["display"].publish(display)

    async def take_picture(self, label: str, correction: Correction) -> TwinEye:
        """Show the object flat with that correction, and wait for the eye's picture of it."""
        self.show(
            Display(
                correction=correction,
                stereo="mono",
                shading="flat",
                marks=False,
                pixels_every=PIXELS_EVERY,
                label=label,
            )
        )

        def taken() -> bool:
            eye = self._newest.get("twin/eye")
            return isinstance(eye, TwinEye) and eye.label == label

        await self.wait_for(taken, f'the eye\'s picture of "{label}"', PICTURE_WAIT_S)
        # What is not photographed need not be sent with its pixels.
        self.show(Display(correction=correction, stereo="side_by_side"))
        eye = self._newest["twin/eye"]
        assert isinstance(eye, TwinEye)
        return eye


def is_settled(arm: ArmState, target: SheetTarget) -> bool:
    """Whether the arm is where it is told to be, and the target rests."""
    off = arm.world_from_flange[:3, 3] - arm.world_from_flange_commanded[:3, 3]
    return bool(
        arm.mode == "follow"
        and np.linalg.norm(off) < SETTLED_POSITION_M
        and np.linalg.norm(target.twist_world[:3]) < SETTLED_SPEED_M_PER_S
        and np.linalg.norm(target.twist_world[3:]) < SETTLED_TURN_RAD_PER_S
    )
