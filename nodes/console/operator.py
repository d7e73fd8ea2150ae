"""Connect the page with the running graph: execute viewers' requests, and show messages."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from flexsheet.messages.bag import BagError
from flexsheet.messages.base import Header, Message
from flexsheet.messages.busy import describe_busy
from flexsheet.messages.scene import Scene
from flexsheet.messages.types import (
    ArmState,
    Correction,
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
from flexsheet.nodes.console.history import History
from flexsheet.nodes.console.latest_messages import LatestMessages, MessageSource
from flexsheet.nodes.console.page import Page
from flexsheet.nodes.console.scene_view import LAYERS
from flexsheet.nodes.console.snapshot import compute_snapshot
from flexsheet.nodes.console.tabs import NO_BAG, Request

MAX_WIDTH_PX = 340
"""The maximum width of the images on the page."""

BAG_LIST_PERIOD_S = 5.0
MAX_STEP_S = 0.2
"""The maximum time step (s) of the finger and of the replay. The limit prevents jumps after a
pause."""

SIDES = ("left", "right")
BOOKMARKS_SHOWN = 5
REPLAYED = (
    "the page shows a replay, but the finger is part of the running graph; first press "
    '"Back to the running graph" in the tab Record'
)
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
        with_finger: bool,
        with_eye: bool,
    ) -> None:
        """Build the page.

        name: name of the console's node.
        with_finger: whether the graph simulates the finger, so that the mouse can move the finger.
        with_eye: whether the graph simulates the eye.
        """
        self._name, self._live, self.controller = name, live, controller
        self._with_finger, self._with_eye = with_finger, with_eye
        self._page = Page(
            server, request, with_finger=with_finger, others_may=controller.facts.others_may_reset
        )
        self._history = History()
        self._statuses: dict[str, tuple[Status, float]] = {}
        self._hosts: dict[str, HostStatus] = {}
        self._drawn_scene: Scene | None = None
        self._drawn_skin: Skin | None = None
        self._shown_frame: Frame | None = None
        self._now_s, self._sent_ns = 0.0, 0
        self._bags_s = -BAG_LIST_PERIOD_S
        self._finger_shown_s = 0.0
        self._image_s: float | None = None
        self._bookmarks: tuple[str, ...] = ()
        self._bags_before: set[str] = set()
        self._awaits_bag = False
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
            "show_layer": self._show_layer,
            "eye_view": self._enable_eye_view,
            "correct": self._correct,
            "record": self._record,
            "bookmark": self._bookmark,
            "open_bag": self._open_bag,
            "leave": self._leave,
            "play": controller.replay.play_or_pause,
            "seek": controller.replay.seek,
            "replay_rate": partial(setattr, controller.replay, "rate"),
        }

    @property
    def source(self) -> MessageSource:
        """Return the source of the displayed messages: the replayed bag or the running graph."""
        return self.controller.replay.timeline or self._live

    def handle_request(self, name: str, *values: Any) -> None:
        """Execute a viewer's request, and show an error on the page if the request fails."""
        try:
            self._handlers[name](*values)
        except (ValueError, BagError) as error:
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
        elif isinstance(message, TwinEye) and self.controller.eye_view.on_image(message, now_s):
            self._image_s = now_s
            for name, image in (("seen", message.seen), ("expected", message.expected)):
                self._page.eye.show_image(name, downsample_image(image))

    def advance(self, now_s: float, has_viewers: bool) -> None:
        """Advance finger, sliders and replay by one step, and update the page if it has viewers."""
        step_s = min(now_s - self._now_s, MAX_STEP_S)
        self._now_s, controller = now_s, self.controller
        finger = self._live.latest("fingertip", Fingertip) if has_viewers else None
        measured = finger[0].position_world_m if finger is not None and finger[0].valid else None
        if controller.finger.advance(step_s, measured):
            controller.save_state()
        try:
            if controller.scenes.apply_sliders(now_s):
                self._on_new_scene()
        except ValueError as error:
            self.fail(error)
        if has_viewers:
            controller.eye_view.advance(now_s)
            self._draw(step_s)

    def _draw(self, step_s: float) -> None:
        replay = self.controller.replay
        replay.advance(step_s)
        self._follow_scene()
        self._follow_skin()
        if self._drawn_scene is not None:
            self._page.view.draw(compute_snapshot(self._drawn_scene, self.source))
        self._show_frame()
        if replay.timeline is not None:
            self._page.record.show_replay(replay)

    def _follow_scene(self) -> None:
        recorded = None
        if self.controller.replay.timeline is not None:
            recorded = self.source.latest("scene", Scene)
        scene = self.controller.scenes.scene if recorded is None else recorded[0]
        if scene is not self._drawn_scene:
            self._drawn_scene, self._drawn_skin = scene, None
            self._page.show_scene(scene, self.controller)

    def _follow_skin(self) -> None:
        skin = self.source.latest("skin", Skin)
        if skin is None or (self.source is self._live and skin[1].source_ns < self._sent_ns):
            return  # still the skin of the previous scene
        if skin[0] is not self._drawn_skin:
            self._drawn_skin = skin[0]
            rest = np.asarray(skin[0].vertices_world_m, dtype=np.float64)
            self._page.view.set_skin(rest, skin[0].triangles)

    def _show_frame(self) -> None:
        entry = self._live.latest("frame", Frame)
        if entry is not None:
            self.controller.eye_view.on_frame(entry[0], self._now_s)
        entry = self.source.latest("frame", Frame)
        if entry is None or entry[0] is self._shown_frame or not entry[0].pixels:
            return
        self._shown_frame = entry[0]
        self._page.eye.show_image("frame", downsample_image(entry[0].pixels[0]))

    def refresh_tables(self, now_s: float) -> None:
        """Update the tables, the charts and the banner of the page."""
        ages = {name: (status, now_s - at_s) for name, (status, at_s) in self._statuses.items()}
        self._history.add(now_s, self._live)
        latencies = panels.make_latency_table(self._history.latest_and_max())
        tables = (
            latencies
            + panels.make_topics_table(ages, self.controller.facts.consoles)
            + panels.make_nodes_table(ages)
        )
        self._page.graph.show(tables, self._history.columns())
        self._show_state()
        self._show_eye_status(now_s)
        finger = self.source.latest("fingertip", Fingertip)
        if now_s >= self._finger_shown_s:
            # A slider that is being moved must not jump back to the last request.
            self._page.touch.show_intent(self.controller.finger)
        self._page.touch.show_finger(panels.finger(None if finger is None else finger[0]))
        if self._awaits_bag or now_s >= self._bags_s + BAG_LIST_PERIOD_S:
            self._bags_s = now_s
            self._show_bags()

    def _show_state(self) -> None:
        controller, arms = self.controller, {}
        for side in SIDES:
            entry = self._live.latest(f"arm_{side}", ArmState)
            if entry is not None:
                arms[side] = entry[0]
        timeline, sheet = controller.replay.timeline, self._live.latest("sheet_target", SheetTarget)
        shown = controller.scenes.scene if self._drawn_scene is None else self._drawn_scene
        state = GraphState(
            scene=shown.name,
            arms=arms,
            estop_reason=controller.stopped,
            sheet=None if sheet is None else sheet[0],
            overload=" ".join(
                f"{one[:1].upper()}{one[1:]}."
                for one in map(describe_busy, self._hosts.values())
                if one
            ),
            solver_note=self._solver_note(),
            replay=None if timeline is None else timeline.path.name,
        )
        self._page.show_state(state)
        recorders = [
            self._statuses[name] for name in controller.facts.recorders if name in self._statuses
        ]
        note = recorders[0][0].note_text if recorders else None
        self._page.record.show_state(
            panels.recorder(note, self._bookmarks), recording=controller.recording
        )

    def _solver_note(self) -> str:
        """Return the status note of the soft-body solver while its surface mesh is not available.

        Returns an empty text as soon as the solver has published the surface mesh of the present
        scene.
        """
        skin = self._live.latest("skin", Skin)
        if skin is not None and skin[1].source_ns >= self._sent_ns:
            return ""
        solvers = self.controller.facts.solvers
        notes = (self._statuses[name][0].note_text for name in solvers if name in self._statuses)
        return next(notes, "")

    def _show_eye_status(self, now_s: float) -> None:
        eye_view = self.controller.eye_view
        text = panels.eye(
            possible=self._with_eye,
            enabled=eye_view.enabled,
            state=eye_view.state,
            waited_s=eye_view.waited_s(now_s),
            ago_s=None if self._image_s is None else now_s - self._image_s,
        )
        self._page.eye.text.content = text

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
            if not self._with_finger:
                raise ValueError(MEASURED)
            if self.controller.replay.timeline is not None:
                raise ValueError(REPLAYED)
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

    def _show_layer(self, layer: str, shown: bool) -> None:
        if layer not in LAYERS:
            raise ValueError(f'unknown layer "{layer}"; choose one of: {", ".join(LAYERS)}')
        self._page.view.show_layer(layer, shown)

    def _enable_eye_view(self, enabled: bool) -> None:
        self.controller.eye_view.enabled = enabled
        self.controller.eye_view.request_now()

    def _correct(self, correction: Correction) -> None:
        self.controller.eye_view.chosen_correction = correction
        self.controller.eye_view.request_now()

    def _record(self) -> None:
        if not self.controller.facts.records_on_request:
            raise ValueError(NO_RECORDER)
        if self.controller.recording:
            self.controller.record(False)
            self._awaits_bag = True
            self._show_bags()
        else:
            self._bookmarks, self._bags_before = (), set(self.controller.replay.bags())
            self._awaits_bag = False
            self.controller.record(True)

    def _show_bags(self) -> None:
        """List the bags on the page, and select a bag that has just been recorded."""
        bags = self.controller.replay.bags()
        recorded = next((bag for bag in bags if bag not in self._bags_before), None)
        self._page.record.show_bags(bags, recorded if self._awaits_bag else None)
        self._awaits_bag = self._awaits_bag and recorded is None

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

    def _open_bag(self, name: str) -> None:
        if name == NO_BAG:
            raise ValueError("there is no bag; record a bag first")
        self.controller.replay.open(name)
        self._page.record.show_replay(self.controller.replay, opened=True)

    def _leave(self) -> None:
        self.controller.replay.leave()
        self._page.record.show_replay(self.controller.replay, opened=True)


def downsample_image(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Downsample an image (height, width, 3) to a width of at most `MAX_WIDTH_PX`."""
    step = -(-image.shape[1] // MAX_WIDTH_PX)
    return np.ascontiguousarray(image[::step, ::step])
