"""Connect the page with the running graph: execute viewers' requests, and show messages."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from flexsheet.messages.base import Header, Message
from flexsheet.messages.busy import describe_busy
from flexsheet.messages.scene import Scene
from flexsheet.messages.types import (
    ArmState,
    Display,
    EStop,
    Fingertip,
    Frame,
    HostStatus,
    SheetTarget,
    Skin,
    Status,
    TwinEye,
)
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.console import panels
from flexsheet.nodes.console.banner import GraphState
from flexsheet.nodes.console.controller import SETTLE_S, ConsoleController
from flexsheet.nodes.console.latest_messages import LatestMessages
from flexsheet.nodes.console.page import Page
from flexsheet.nodes.console.tabs import Request

MAX_WIDTH_PX = 340
"""The maximum width of the images on the page."""

MAX_STEP_S = 0.2
"""The maximum time step (s) of the finger. The limit prevents jumps after a pause."""

TABLES_PERIOD_S = 0.5
SIDES = ("left", "right")
BOOKMARKS_SHOWN = 5
MEASURED = "this graph measures a real finger, which the console cannot move; move the real finger"
NO_RECORDER = (
    "this graph has no recorder that the console can start; start the graph with --console, or "
    "set the parameter start_paused of its recorder to true"
)


class Operator:
    """The connection of the page with the running graph, in the event loop of the console node."""

    def __init__(
        self,
        server: viser.ViserServer,
        live: LatestMessages,
        controller: ConsoleController,
        request: Request,
        *,
        name: str,
        with_eye: bool,
    ) -> None:
        """Build the page.

        name: name of the console's node.
        with_eye: whether the graph simulates the eye.
        """
        self._name, self._live, self.controller = name, live, controller
        self._with_eye = with_eye
        self._page = Page(server, request, controller.facts)
        self._statuses: dict[str, tuple[Status, float]] = {}
        self._hosts: dict[str, HostStatus] = {}
        self._drawn_scene: Scene | None = None
        self._drawn_skin: Skin | None = None
        self._shown_frame: Frame | None = None
        self._now_s, self._tables_s, self._sent_ns = 0.0, 0.0, 0
        self._finger_shown_s = 0.0
        self._image_s: float | None = None
        self._bookmarks: tuple[str, ...] = ()
        self._on_new_scene()
        self._handlers: dict[str, Callable[..., None]] = {
            "touch": self._touch,
            "place": partial(self._command_finger, controller.finger.move_to),
            "push": partial(self._command_finger, controller.finger.push),
            "lift": partial(self._command_finger, controller.finger.lift_or_lower),
            "stop": controller.stop,
            "release": controller.release,
            "choose": self._choose,
            "slide": self._slide,
            "eye_view": partial(setattr, controller.eye_view, "enabled"),
            "record": self._record,
            "bookmark": self._bookmark,
        }

    def handle_request(self, name: str, *values: Any) -> None:
        """Execute a viewer's request, and show an error on the page if the request fails."""
        try:
            self._handlers[name](*values)
        except ValueError as error:
            self.fail(error)
        else:
            self._page.show_problem("")
        self._show_state()

    def fail(self, error: Exception) -> None:
        """Show an error on the page."""
        self._page.show_problem(str(error))

    def on_message(self, message: Message, header: Header, now_s: float) -> None:
        """Process a message of a topic for which the page needs every message."""
        if isinstance(message, Status):
            self._statuses[message.node] = (message, now_s)
        elif isinstance(message, HostStatus):
            self._hosts[message.host] = message
        elif isinstance(message, EStop):
            self.controller.stopped = message.reason if message.engaged else None
        elif isinstance(message, Display):
            if header.writer != self._name:
                self.controller.eye_view.on_others_display(message)
        elif isinstance(message, TwinEye):
            self.controller.eye_view.on_image(message, now_s)
            self._image_s = now_s
            for name, image in (("seen", message.seen), ("expected", message.expected)):
                self._page.eye.show_image(name, downsample_image(image))

    def advance(self, now_s: float, has_viewers: bool) -> None:
        """Advance finger and sliders by one step, and update the page if it has viewers."""
        step_s = min(now_s - self._now_s, MAX_STEP_S)
        self._now_s, controller = now_s, self.controller
        finger = self._live.latest("fingertip", Fingertip) if has_viewers else None
        measured = finger[0].position_world_m if finger is not None and finger[0].valid else None
        controller.finger.advance(step_s, measured)
        try:
            if controller.scenes.apply_sliders(now_s):
                self._on_new_scene()
        except ValueError as error:
            self.fail(error)
        if has_viewers:
            controller.eye_view.advance(now_s)
            self._draw()
            if now_s >= self._tables_s:
                self._tables_s = now_s + TABLES_PERIOD_S
                self._refresh_tables()

    def _draw(self) -> None:
        scene = self.controller.scenes.scene
        if scene is not self._drawn_scene:
            self._drawn_scene, self._drawn_skin = scene, None
            self._page.show_scene(self.controller.scenes)
        skin = self._skin()
        if skin is not None and skin is not self._drawn_skin:
            self._drawn_skin = skin
            self._page.view.set_skin(skin)
        self._page.view.draw(scene, self._live)
        frame = self._live.latest("frame", Frame)
        if frame is not None and frame[0] is not self._shown_frame and frame[0].pixels:
            self._shown_frame = frame[0]
            self.controller.eye_view.on_frame(frame[0], self._now_s)
            self._page.eye.show_image("frame", downsample_image(frame[0].pixels[0]))

    def _skin(self) -> Skin | None:
        """Return the object's surface mesh, or None before the solver publishes a new one."""
        skin = self._live.latest("skin", Skin)
        return None if skin is None or skin[1].source_ns < self._sent_ns else skin[0]

    def _refresh_tables(self) -> None:
        now_s = self._now_s
        ages = {name: (status, now_s - at_s) for name, (status, at_s) in self._statuses.items()}
        self._page.nodes.content = panels.make_nodes_table(ages)
        self._show_state()
        eye_view = self.controller.eye_view
        self._page.eye.text.content = panels.eye(
            possible=self._with_eye,
            enabled=eye_view.enabled,
            state=eye_view.state,
            waited_s=eye_view.waited_s(now_s),
            ago_s=None if self._image_s is None else now_s - self._image_s,
        )
        finger = self._live.latest("fingertip", Fingertip)
        if now_s >= self._finger_shown_s:
            # A slider that is being moved must not jump back to the last request.
            self._page.touch.show_intent(self.controller.finger)
        self._page.touch.show_finger(panels.finger(None if finger is None else finger[0]))

    def _show_state(self) -> None:
        controller, arms = self.controller, {}
        for side in SIDES:
            entry = self._live.latest(f"arm_{side}", ArmState)
            if entry is not None:
                arms[side] = entry[0]
        sheet = self._live.latest("sheet_target", SheetTarget)
        busy = filter(None, map(describe_busy, self._hosts.values()))
        state = GraphState(
            scene=controller.scenes.scene.name,
            arms=arms,
            estop_reason=controller.stopped,
            sheet=None if sheet is None else sheet[0],
            overload=" ".join(f"{one[:1].upper()}{one[1:]}." for one in busy),
            solver_note="" if self._skin() else self._note(controller.facts.solvers) or "",
        )
        self._page.show_state(state)
        note = self._note(controller.facts.recorders)
        self._page.record.show_state(
            panels.recorder(note, self._bookmarks), recording=controller.recording
        )

    def _note(self, nodes: tuple[str, ...]) -> str | None:
        """Return the status note of the first of `nodes` that has one, or None."""
        found = (self._statuses[name][0].note_text for name in nodes if name in self._statuses)
        return next(found, None)

    def _touch(self, origin: Floats, direction: Floats) -> None:
        self._command_finger(self.controller.finger.touch, origin, direction)
        self._page.touch.show_position(self.controller.finger)

    def _command_finger(self, command: Callable[..., None], *values: Any) -> None:
        """Pass a command to the finger's controller.

        Raises ValueError if the command is refused. The page then shows the unchanged state.
        """
        finger = self.controller.finger
        self._finger_shown_s = self._now_s + SETTLE_S
        try:
            if not self.controller.facts.simulates_finger:
                raise ValueError(MEASURED)
            command(*values)
        except ValueError:
            self._page.touch.show_intent(finger)
            raise
        self._page.touch.show_lifted(finger)

    def _on_new_scene(self) -> None:
        self._sent_ns = round(1e9 * self._now_s)
        self.controller.scenes.make_picker(self.controller.finger, self._page.show_problem)

    def _choose(self, name: str) -> None:
        self.controller.scenes.choose(name)
        self._on_new_scene()

    def _slide(self, name: str, value: float) -> None:
        self.controller.scenes.slide(self._now_s, **{name: value})

    def _record(self) -> None:
        if not self.controller.facts.records_on_request:
            raise ValueError(NO_RECORDER)
        if not self.controller.recording:
            self._bookmarks = ()
        self.controller.record(not self.controller.recording)

    def _bookmark(self, label: str) -> None:
        facts = self.controller.facts
        if not facts.recorders:
            raise ValueError(NO_RECORDER)
        if facts.records_on_request and not self.controller.recording:
            raise ValueError(
                "recording is off, so the bookmark would be lost; start recording first"
            )
        label = self.controller.add_bookmark(label)
        self._bookmarks = (*self._bookmarks, label)[-BOOKMARKS_SHOWN:]


def downsample_image(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Downsample an image (height, width, 3) to a width of at most `MAX_WIDTH_PX`."""
    step = -(-image.shape[1] // MAX_WIDTH_PX)
    return np.ascontiguousarray(image[::step, ::step])
