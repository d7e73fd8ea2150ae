"""Between page and graph: what viewers ask goes to the desk, what the graph says to the page."""

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
from flexsheet.nodes.console import panels
from flexsheet.nodes.console.banner import GraphState
from flexsheet.nodes.console.controls import Ask
from flexsheet.nodes.console.desk import SETTLE_S, Desk
from flexsheet.nodes.console.history import History
from flexsheet.nodes.console.newest import Newest, Source
from flexsheet.nodes.console.page import Page
from flexsheet.nodes.console.picture import picture_of
from flexsheet.nodes.console.record_tab import NO_BAG
from flexsheet.nodes.console.view import LAYERS

Floats = NDArray[np.float64]

WIDEST_PX = 340
"""Of the small pictures."""

BAGS_EVERY_S = 5.0
LONGEST_STEP_S = 0.2
"""After a pause the finger and the replay go on from where they were."""

SIDES = ("left", "right")
BOOKMARKS_SHOWN = 5
REPLAYED = (
    "what you see is a replay, and the finger is that of the running graph: press "
    '"Back to the running graph" in Record first'
)
MEASURED = "the finger is measured: only a simulated one can be moved from here"
NO_RECORDER = (
    "there is no recorder in this graph that waits to be told: start it with --console, or give "
    "its recorder the parameter start_paused: true"
)


class Operator:
    """Runs on the node's own loop, but for the page's callbacks."""

    def __init__(
        self,
        server: viser.ViserServer,
        live: Newest,
        desk: Desk,
        ask: Ask,
        *,
        name: str,
        with_finger: bool,
        with_eye: bool,
    ) -> None:
        """Build the page.

        name: of the console's node.  with_finger: the graph simulates the finger, and the mouse
        moves it.  with_eye: the graph simulates the eye.
        """
        self._name, self._live, self.desk = name, live, desk
        self._with_finger, self._with_eye = with_finger, with_eye
        self._page = Page(
            server, ask, with_finger=with_finger, others_may=desk.facts.others_may_reset
        )
        self._history = History()
        self._statuses: dict[str, tuple[Status, float]] = {}
        self._hosts: dict[str, HostStatus] = {}
        self._drawn_scene: Scene | None = None
        self._drawn_skin: Skin | None = None
        self._pictured: Frame | None = None
        self._now_s, self._sent_ns = 0.0, 0
        self._bags_s = -BAGS_EVERY_S
        self._finger_shown_s = 0.0
        self._looked_s: float | None = None
        self._bookmarks: tuple[str, ...] = ()
        self._bags_before: set[str] = set()
        self._awaits_bag = False
        self._take_up_scene()
        self._asked: dict[str, Callable[..., None]] = {
            "touch": self._touch,
            "place": partial(self._command_finger, desk.finger.place),
            "push": partial(self._command_finger, desk.finger.push),
            "lift": partial(self._command_finger, desk.finger.lift_or_lower),
            "stop": desk.stop,
            "release": desk.release,
            "choose": self._choose,
            "slide": self._slide,
            "show_layer": self._show_layer,
            "look": self._look,
            "correct": self._correct,
            "record": self._record,
            "bookmark": self._bookmark,
            "open_bag": self._open_bag,
            "leave": self._leave,
            "play": self._play,
            "seek": desk.replay.seek,
            "replay_rate": self._set_rate,
        }

    @property
    def source(self) -> Source:
        """What is shown: a bag, or else the running graph."""
        return self.desk.replay.timeline or self._live

    def heed(self, what: str, *values: Any) -> None:
        """Do what a viewer wants; what cannot be done is said on the page."""
        try:
            self._asked[what](*values)
        except (ValueError, BagError) as error:
            self.fail(error)
        else:
            self._page.show_problem("")
        self._show_state()

    def fail(self, error: Exception) -> None:
        """Say on the page that something could not be done."""
        self._page.show_problem(str(error))

    def hear(self, message: Message, header: Header, now_s: float) -> None:
        """Take what must not be missed."""
        if isinstance(message, Status):
            self._statuses[message.node] = (message, now_s)
        elif isinstance(message, HostStatus):
            self._hosts[message.host] = message
        elif isinstance(message, EStop):
            self.desk.stopped = message.reason if message.engaged else None
        elif isinstance(message, Display):
            if header.writer != self._name:
                self.desk.look.on_others_display(message)
        elif isinstance(message, TwinEye) and self.desk.look.got(message, now_s):
            self._looked_s = now_s
            for name, image in (("seen", message.seen), ("expected", message.expected)):
                self._page.eye.show_picture(name, smaller(image))

    def advance(self, now_s: float, looking: bool) -> None:
        """Go on with what moves by itself, and draw it where somebody looks."""
        step_s = min(now_s - self._now_s, LONGEST_STEP_S)
        self._now_s, desk = now_s, self.desk
        finger = self._live.newest("fingertip", Fingertip) if looking else None
        seen = finger[0].position_world_m if finger is not None and finger[0].valid else None
        if desk.finger.advance(step_s, seen):
            desk.keep()
        try:
            if desk.scenes.settle(now_s):
                self._take_up_scene()
        except ValueError as error:
            self.fail(error)
        if looking:
            desk.look.advance(now_s)
            self._draw(step_s)

    def _draw(self, step_s: float) -> None:
        replay = self.desk.replay
        replay.advance(step_s)
        self._follow_scene()
        self._follow_skin()
        if self._drawn_scene is not None:
            self._page.view.draw(picture_of(self._drawn_scene, self.source))
        self._show_frame()
        if replay.timeline is not None:
            self._page.record.show_replay(replay)

    def _follow_scene(self) -> None:
        """Draw what the scene holds anew when it is another one."""
        recorded = None
        if self.desk.replay.timeline is not None:
            recorded = self.source.newest("scene", Scene)
        scene = self.desk.scenes.scene if recorded is None else recorded[0]
        if scene is not self._drawn_scene:
            self._drawn_scene, self._drawn_skin = scene, None
            self._page.show_scene(scene, self.desk)

    def _follow_skin(self) -> None:
        skin = self.source.newest("skin", Skin)
        if skin is None or (self.source is self._live and skin[1].source_ns < self._sent_ns):
            return  # still that of the scene before
        if skin[0] is not self._drawn_skin:
            self._drawn_skin = skin[0]
            rest = np.asarray(skin[0].vertices_world_m, dtype=np.float64)
            self._page.view.set_skin(rest, skin[0].triangles)

    def _show_frame(self) -> None:
        entry = self._live.newest("frame", Frame)
        if entry is not None:
            self.desk.look.on_frame(entry[0], self._now_s)
        entry = self.source.newest("frame", Frame)
        if entry is None or entry[0] is self._pictured or not entry[0].pixels:
            return
        self._pictured = entry[0]
        self._page.eye.show_picture("frame", smaller(entry[0].pixels[0]))

    def tell(self, now_s: float) -> None:
        """Tables, charts, banner."""
        ages = {name: (status, now_s - at_s) for name, (status, at_s) in self._statuses.items()}
        self._history.take(now_s, self._live)
        latencies = panels.latency_table(self._history.newest_and_worst())
        tables = (
            latencies
            + panels.topics_table(ages, self.desk.facts.sampling_readers)
            + panels.nodes_table(ages)
        )
        self._page.graph.show(tables, self._history.columns())
        self._show_state()
        self._tell_eye(now_s)
        finger = self.source.newest("fingertip", Fingertip)
        if now_s >= self._finger_shown_s:
            # Not while a slider moves: it is ahead of what has been asked for.
            self._page.touch.show_intent(self.desk.finger)
        self._page.touch.show_finger(panels.finger(None if finger is None else finger[0]))
        if self._awaits_bag or now_s >= self._bags_s + BAGS_EVERY_S:
            self._bags_s = now_s
            self._show_bags()

    def _show_state(self) -> None:
        desk, arms = self.desk, {}
        for side in SIDES:
            entry = self._live.newest(f"arm_{side}", ArmState)
            if entry is not None:
                arms[side] = entry[0]
        timeline, sheet = desk.replay.timeline, self._live.newest("sheet_target", SheetTarget)
        shown = desk.scenes.scene if self._drawn_scene is None else self._drawn_scene
        state = GraphState(
            scene=shown.name,
            arms=arms,
            estop_reason=desk.stopped,
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
            self._statuses[name] for name in desk.facts.recorders if name in self._statuses
        ]
        note = recorders[0][0].note if recorders else None
        self._page.record.show_state(
            panels.recorder(note, self._bookmarks), recording=desk.recording
        )

    def _solver_note(self) -> str:
        """What the soft body's solver reports while it has no skin of this scene; else nothing."""
        skin = self._live.newest("skin", Skin)
        if skin is not None and skin[1].source_ns >= self._sent_ns:
            return ""
        solvers = self.desk.facts.solvers
        return next(
            (self._statuses[name][0].note for name in solvers if name in self._statuses), ""
        )

    def _tell_eye(self, now_s: float) -> None:
        look = self.desk.look
        text = panels.eye(
            possible=self._with_eye,
            wanted=look.wanted,
            state=look.state,
            waited_s=look.waited_s(now_s),
            ago_s=None if self._looked_s is None else now_s - self._looked_s,
        )
        self._page.eye.show_words(text)

    def _touch(self, origin: Floats, direction: Floats) -> None:
        self._command_finger(self.desk.finger.touch, origin, direction)
        self._page.touch.show_position(self.desk.finger)

    def _command_finger(self, command: Callable[..., None], *values: Any) -> None:
        """Give the finger a command; if it is refused, show what holds.  ValueError."""
        finger = self.desk.finger
        self._finger_shown_s = self._now_s + SETTLE_S
        try:
            if not self._with_finger:
                raise ValueError(MEASURED)
            if self.desk.replay.timeline is not None:
                raise ValueError(REPLAYED)
            command(*values)
        except ValueError:
            self._page.touch.show_intent(finger)
            raise
        self._page.touch.show_lifted(finger)

    def _take_up_scene(self) -> None:
        """A scene was sent since the last picture."""
        self._sent_ns = round(1e9 * self._now_s)
        self.desk.scenes.make_aim(self.desk.finger, self._page.show_problem)

    def _choose(self, name: str) -> None:
        self.desk.scenes.choose(name)
        self._take_up_scene()

    def _slide(self, name: str, value: float) -> None:
        self.desk.scenes.slide(self._now_s, **{name: value})

    def _show_layer(self, layer: str, shown: bool) -> None:
        if layer not in LAYERS:
            raise ValueError(f'there is no layer "{layer}"; there are: {", ".join(LAYERS)}')
        self._page.view.show_layer(layer, shown)

    def _look(self, wanted: bool) -> None:
        self.desk.look.wanted = wanted
        self.desk.look.again()

    def _correct(self, correction: Correction) -> None:
        self.desk.look.picked = correction
        self.desk.look.again()

    def _record(self) -> None:
        if not self.desk.facts.records_on_request:
            raise ValueError(NO_RECORDER)
        if self.desk.recording:
            self.desk.record(False)
            self._awaits_bag = True
            self._show_bags()
        else:
            self._bookmarks, self._bags_before = (), set(self.desk.replay.bags())
            self._awaits_bag = False
            self.desk.record(True)

    def _show_bags(self) -> None:
        """List the bags, the newest first; one that was just recorded is chosen."""
        bags = self.desk.replay.bags()
        made = next((bag for bag in bags if bag not in self._bags_before), None)
        self._page.record.show_bags(bags, made if self._awaits_bag else None)
        self._awaits_bag = self._awaits_bag and made is None

    def _bookmark(self, label: str) -> None:
        facts = self.desk.facts
        if not facts.recorders:
            raise ValueError(NO_RECORDER)
        if facts.records_on_request and not self.desk.recording:
            raise ValueError(
                "nothing is recorded now, so a bookmark would be lost: start recording first"
            )
        label = self.desk.add_bookmark(label)
        self._bookmarks = (*self._bookmarks, label)[-BOOKMARKS_SHOWN:]

    def _open_bag(self, name: str) -> None:
        if name == NO_BAG:
            raise ValueError("there is no bag to show yet: record one first")
        self.desk.replay.open(name)
        self._page.record.show_replay(self.desk.replay, opened=True)

    def _leave(self) -> None:
        self.desk.replay.leave()
        self._page.record.show_replay(self.desk.replay, opened=True)

    def _play(self) -> None:
        self.desk.replay.play_or_pause()

    def _set_rate(self, rate: float) -> None:
        self.desk.replay.rate = rate


def smaller(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Every nth pixel of a picture, so that it is at most `WIDEST_PX` wide."""
    step = -(-image.shape[1] // WIDEST_PX)
    return np.ascontiguousarray(image[::step, ::step])
