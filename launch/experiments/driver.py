"""Control a running graph during an experiment: move the simulated finger and set the display.

The driver publishes with the writer name "tools" and subscribes to the topics that it evaluates.
Every wait has a deadline. The timeout error names the awaited condition, the problems that the
nodes report, and an overload of the computer.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Self

import numpy as np

from flexsheet.launch.experiments import ArmsNotReadyError, ExperimentError, OverloadedError
from flexsheet.launch.plans.plan_model import TOOLS, ResolvedGraph
from flexsheet.launch.running.runs import Run
from flexsheet.launch.running.tools import GraphWriter, make_subscriber
from flexsheet.messages.base import Header, Message
from flexsheet.messages.bus import Subscriber
from flexsheet.messages.busy import describe_busy
from flexsheet.messages.scene import Scene
from flexsheet.messages.types import (
    ArmState,
    Correction,
    Display,
    FingerPath,
    Frame,
    HostStatus,
    Shading,
    SheetTarget,
    Skin,
    Status,
    TwinEye,
    TwinFinger,
)
from flexsheet.nodes.twin.finger import FingerPathError, check_speed, join_points

READ = (
    "twin/finger",
    "twin/eye",
    "sheet_target",
    "arm_left",
    "arm_right",
    "skin",
    "soft_body",
    "status",
    "host",
)
WRITTEN = ("twin/finger_path", "display")

# Measurement noise of the finger moves the sheet slightly; below these limits it counts as at rest.
SETTLED_POSITION_M = 1e-3
SETTLED_SPEED_M_PER_S = 0.05
SETTLED_RATE_RAD_PER_S = 0.8
SETTLED_MESSAGES = 100
PIXELS_EVERY = 10
"""The number of frames from one frame with pixels to the next."""

WAIT_S = 20.0
FRAME_WAIT_S = 20.0
"""The maximum time to wait for the next frame, or for the eye's image after the last frame."""

MAX_WAIT_S = 3600.0
"""The maximum time to wait for an image of the simulated eye, although there is progress.

An idle computer needs a few seconds.
"""


@dataclass(slots=True)
class Waiter:
    """A pending wait for a condition, with a deadline.

    progress: type of the messages that postpone the deadline.
    seconds: time (s) to wait after the start, and after each message that postpones the deadline.
    latest_s: latest deadline, in the time of the event loop.
    """

    condition: Callable[[], bool]
    future: asyncio.Future[None]
    deadline: asyncio.Timeout
    progress: type[Message] | None
    seconds: float
    latest_s: float

    def add_message(self, message: Message) -> None:
        """End the wait if its condition is met, or postpone its deadline."""
        if self.deadline.expired() or self.future.done():
            return
        if self.condition():
            self.future.set_result(None)
        elif self.progress is not None and isinstance(message, self.progress):
            until_s = asyncio.get_running_loop().time() + self.seconds
            self.deadline.reschedule(min(until_s, self.latest_s))


class Driver:
    """A connection of an experiment to a running graph, used as an asynchronous context manager."""

    def __init__(
        self,
        plan: ResolvedGraph,
        run: Run,
        pids: Callable[[], Mapping[str, int]] = dict,
        publish_scene: Callable[[Scene], int] | None = None,
        *,
        topics: Iterable[str] = (),
    ) -> None:
        """Create a driver; `async with` connects it to the graph.

        plan, run: attributes of a `RunningGraph`.
        pids: function that returns the process id of each running node, for measurements.
        publish_scene: function that publishes a new scene, and returns the source timestamp of the
            scene.
        topics: topics to read in addition to those of `READ`.
        """
        self._topics = dict.fromkeys((*READ, *topics))
        self._scene = plan.scene_message()
        self._plan, self._run, self.pids = plan, run, pids
        self._publish_scene = publish_scene
        self.on_message: Callable[[Message], None] = lambda message: None
        self._skin_source_ns = 0
        self._writer: GraphWriter | None = None
        self._subscribers: dict[str, Subscriber] = {}
        self._newest: dict[str, Message] = {}
        self._notes: dict[str, str] = {}
        self._hosts: dict[str, HostStatus] = {}
        self._waiters: list[Waiter] = []
        self._settled_since = 0

    async def __aenter__(self) -> Self:
        self._writer = GraphWriter(self._plan, self._run, WRITTEN)
        for name in self._topics:
            self._subscribe(name)
        return self

    async def __aexit__(self, *_: object) -> None:
        for subscriber in self._subscribers.values():
            subscriber.close()
        if self._writer is not None:
            self._writer.close()

    def _subscribe(self, name: str) -> None:
        subscriber = make_subscriber(
            name, self._plan, self._run, self._make_handler(name), on_problem=self._note_problem
        )
        subscriber.start()
        self._subscribers[name] = subscriber

    def _note_problem(self, text: str) -> None:
        self._notes[TOOLS] = text

    def _publish(self, topic: str, message: Message) -> None:
        if self._writer is None:
            raise RuntimeError("the driver is not connected to the graph; use it in `async with`")
        self._writer.publish(topic, message)

    def _make_handler(self, name: str) -> Callable[[Message, Header], None]:
        def handle(message: Message, header: Header) -> None:
            self._newest[name] = message
            self.on_message(message)
            if isinstance(message, Skin):
                # The soft body of the previous scene no longer responds.
                self._skin_source_ns = header.source_ns
                self._newest.pop("soft_body", None)
            if isinstance(message, Status):
                self._notes[message.node] = message.note_text or message.last_error
            if isinstance(message, ArmState):
                self._count_settled()
            if isinstance(message, HostStatus):
                self._hosts[message.host] = message
            for waiter in self._waiters:
                waiter.add_message(message)

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

    async def wait_for(
        self,
        condition: Callable[[], bool],
        description: str,
        seconds: float,
        *,
        progress: type[Message] | None = None,
        error: type[ExperimentError] = ExperimentError,
    ) -> None:
        """Wait until `condition` returns True; it is evaluated when a message arrives.

        description: name of the condition in the error text.
        seconds: time to wait.
        progress: type of the messages that restart this time, up to a total of MAX_WAIT_S.
        error: class of the error that is raised if the condition is not met in time.

        Raises OverloadedError instead if a computer is overloaded.
        """
        if condition():
            return
        loop = asyncio.get_running_loop()
        future: asyncio.Future[None] = loop.create_future()
        begun_s = loop.time()
        try:
            async with asyncio.timeout(seconds) as deadline:
                waiter = Waiter(
                    condition, future, deadline, progress, seconds, begun_s + MAX_WAIT_S
                )
                self._waiters.append(waiter)
                try:
                    await future
                finally:
                    self._waiters.remove(waiter)
        except TimeoutError:
            what = f"timeout: waited {loop.time() - begun_s:.3g} s for {description}"
            raise self.make_timeout_error(what, error) from None

    def make_timeout_error(
        self, what: str, error: type[ExperimentError] = ExperimentError
    ) -> ExperimentError:
        """Make an error that reports a timeout and the status notes of all nodes.

        If a computer is overloaded, the result is an OverloadedError that names the overload.

        what: first part of the error text.
        error: type of the error if no computer is overloaded.
        """
        busy = [text for host in self._hosts.values() if (text := describe_busy(host))]
        notes = "".join(f"\n  {node}: {note}" for node, note in self._notes.items() if note)
        ending = f"notes of the nodes:{notes or ' none'}"
        if not busy:
            return error(f"{what}; {ending}")
        remedy = "end other programs, and check the row `load` of `flexsheet doctor`"
        return OverloadedError("; ".join([what, *busy, remedy, ending]))

    def newest(self, topic: str) -> Message | None:
        """Return the newest message of a topic, or None if none has arrived yet.

        Raises KeyError if the driver does not read the topic.
        """
        if topic not in self._subscribers:
            raise KeyError(
                f"the driver does not read {topic}; give it to the constructor: "
                f'topics=["{topic}"] (it reads {", ".join(self._subscribers) or "nothing"})'
            )
        return self._newest.get(topic)

    async def wait_ready(self) -> None:
        """Wait until both arms are in mode "follow".

        If a node of the graph publishes soft bodies, also wait for the first soft body. Raises
        ArmsNotReadyError if the wait takes longer than three times `WAIT_S`.
        """
        needs_body = bool(self._plan.writers.get("soft_body"))

        def ready() -> bool:
            arms = [self._newest.get(name) for name in ("arm_left", "arm_right")]
            following = all(isinstance(arm, ArmState) and arm.mode == "follow" for arm in arms)
            return following and (not needs_body or "soft_body" in self._newest)

        what = " and a soft body" if needs_body else ""
        waited = f"both arms in mode follow{what}"
        await self.wait_for(ready, waited, 3 * WAIT_S, error=ArmsNotReadyError)

    async def change_scene(self, scene: Scene) -> None:
        """Replace the scene of the graph, and wait until its soft body and both arms are ready."""
        if self._publish_scene is None:
            raise RuntimeError("this driver cannot publish a scene")
        source_ns, self._scene = self._publish_scene(scene), scene
        await self.wait_for(
            lambda: self._skin_source_ns >= source_ns, "the skin of the new object", 3 * WAIT_S
        )
        await self.wait_ready()

    def move_finger(self, path: FingerPath) -> None:
        """Start to move the simulated finger along a path; do not wait for the end.

        Raises FingerPathError if the finger cannot follow the path.
        """
        if problem := path.find_problem():
            raise FingerPathError(f'path "{path.label}": {problem}')
        if self._scene is not None:
            motion = join_points(path.times_s, path.positions_world_m, path.joined_by)
            check_speed(motion, path.times_s, self._scene.finger.max_speed_m_per_s)
        self._publish("twin/finger_path", path)

    async def follow(self, path: FingerPath) -> None:
        """Move the finger along a path, and wait until it has reached the end of the path."""
        self.move_finger(path)
        started = False

        def done() -> bool:
            nonlocal started
            finger = self._newest.get("twin/finger")
            if not isinstance(finger, TwinFinger) or finger.path_label != path.label:
                return False
            started |= not finger.path_done  # an earlier path may have the same label
            return started and finger.path_done

        await self.wait_for(
            done, f'the end of the finger path "{path.label}"', float(path.times_s[-1]) + WAIT_S
        )

    async def wait_settled(self) -> None:
        """Wait until the sheet target is at rest and both arms are at their commanded poses."""
        self._settled_since = 0
        await self.wait_for(
            lambda: self._settled_since >= SETTLED_MESSAGES, "the sheet at rest", WAIT_S
        )

    def show(self, display: Display) -> None:
        self._publish("display", display)

    async def capture_image(
        self, label: str, correction: Correction, shading: Shading = "flat"
    ) -> None:
        """Display the object with an image correction, and wait for the simulated eye's image.

        label: label of the image. shading: "flat" for a sharp outline in measurements, "soft" for
        figures.
        """
        if "frame" not in self._subscribers:
            self._subscribe("frame")
        self.show(
            Display(
                correction=correction,
                stereo="mono",
                shading=shading,
                marks=False,
                pixels_every=PIXELS_EVERY,
                label=label,
            )
        )

        def received() -> bool:
            eye = self._newest.get("twin/eye")
            return isinstance(eye, TwinEye) and eye.label == label

        what = f'the eye\'s image of "{label}"'
        await self.wait_for(received, what, FRAME_WAIT_S, progress=Frame)
        # Stop sending pixels in frames until the next image.
        self.show(Display(correction=correction, stereo="side_by_side"))


def is_settled(arm: ArmState, target: SheetTarget) -> bool:
    """Return whether an arm is at its commanded pose and the sheet target is at rest."""
    error = arm.world_from_flange[:3, 3] - arm.world_from_flange_commanded[:3, 3]
    return bool(
        arm.mode == "follow"
        and np.linalg.norm(error) < SETTLED_POSITION_M
        and np.linalg.norm(target.twist_world[:3]) < SETTLED_SPEED_M_PER_S
        and np.linalg.norm(target.twist_world[3:]) < SETTLED_RATE_RAD_PER_S
    )
