"""What can be asked of the console, and what comes of it; all on the node's own loop."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable
from dataclasses import asdict, astuple, dataclass, replace
from enum import Enum, auto
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from flexsheet.messages.base import Message
from flexsheet.messages.errors import FlexsheetError
from flexsheet.messages.methods import chosen
from flexsheet.messages.scene import Scene
from flexsheet.messages.types import Bookmark, Correction, Display, EStop, Frame, Recording, TwinEye
from flexsheet.nodes.console import scenes
from flexsheet.nodes.console.aim import Aim
from flexsheet.nodes.console.finger import Finger
from flexsheet.nodes.console.graph_facts import GraphFacts
from flexsheet.nodes.console.kept import Kept, load_kept, save_kept
from flexsheet.nodes.console.replay import Timeline, bags_in

Floats = NDArray[np.float64]
Publish = Callable[[Message], None]

SETTLE_S = 0.4
"""A slider that rests so long is meant; while it moves, no scene is sent."""

LOOK_EVERY_S = 6.0
PIXELS_EVERY = 3
MAX_DRAWING_S = 5.0
"""The renderer draws many frames in that time, or none."""

CAPTURE_S = 1.0
"""So long after a frame the simulated eye has all that it needs to trace the picture."""

MAX_TRACING_S = 120.0
"""A picture that takes longer never comes."""

DEFAULT_BOOKMARK = "bookmark"
MAX_LABELS = 64
"""Number of requested labels whose late pictures are still shown."""


@dataclass(frozen=True, slots=True)
class Sliders:
    """What the page's sliders say of the scene."""

    young_modulus_pa: float
    stretch_ratio: float
    size_ratio: float

    @staticmethod
    def of(scene: Scene) -> Sliders:
        return Sliders(
            scene.object.material.young_modulus_pa,
            max(scene.sheet.min_stretch_ratio, scenes.MIN_STRETCH_RATIO),
            1.0,
        )


class SceneDesk:
    """The scene that the graph works with: chosen, and changed by the sliders."""

    def __init__(
        self,
        publish: Callable[[Scene], None],
        folder: Path,
        first: Scene,
        sliders: Sliders | None = None,
    ) -> None:
        """sliders: where they stood when the console was ended; None: nobody had moved them."""
        self._publish, self._folder = publish, folder
        self.names = scenes.scene_names(folder)
        self.base, self.moved = first, sliders is not None
        self.sliders = sliders or Sliders.of(first)
        self.scene = self._edited() if self.moved else first
        self._due_s: float | None = None
        self._making_aim: asyncio.Task[None] | None = None

    def choose(self, name: str) -> None:
        """Go over to another of the run's scenes; SceneChoiceError."""
        self.base, self.moved = scenes.load(self._folder, name), False
        self.sliders = Sliders.of(self.base)
        self._send(self.base)

    def slide(self, now_s: float, **changes: float) -> None:
        """One slider was moved; the scene follows once it rests."""
        self.sliders = replace(self.sliders, **changes)
        self._due_s = now_s + SETTLE_S

    def settle(self, now_s: float) -> bool:
        """Send the changed scene if that is due; says whether it was.  SceneChoiceError."""
        if self._due_s is None or now_s < self._due_s:
            return False
        self._due_s = None
        scene, self.moved = self._edited(), True
        self._send(scene)
        return True

    def _edited(self) -> Scene:
        return scenes.edited(self.base, **asdict(self.sliders))

    def _send(self, scene: Scene) -> None:
        self.scene = scene
        self._publish(scene)

    def tell(self) -> None:
        """Say again which scene holds."""
        self._publish(self.scene)

    def make_aim(self, finger: Finger, failed: Callable[[str], None]) -> None:
        """Let the finger point at the present scene's object, as soon as that is worked out."""
        if self._making_aim is not None:
            self._making_aim.cancel()
        finger.use(None)
        self._making_aim = asyncio.create_task(self._make_aim(self.scene, finger, failed))

    async def _make_aim(self, scene: Scene, finger: Finger, failed: Callable[[str], None]) -> None:
        try:
            finger.use(await asyncio.to_thread(Aim, scene))
        except ValueError as error:
            failed(f"the finger cannot be moved over this object: {error}")

    async def close(self) -> None:
        if self._making_aim is not None:
            self._making_aim.cancel()
            await asyncio.gather(self._making_aim, return_exceptions=True)


class LookState(Enum):
    """What the next picture through the user's eye waits for."""

    RESTING = auto()
    DRAWING = auto()
    TRACING = auto()


class Look:
    """Through the user's eye: asks the renderer for a frame with its pixels, now and then.

    Once such a frame is drawn, the simulated eye traces its picture, which takes a second of a
    processor and on a busy computer many: no other picture is asked for meanwhile.  What another
    has set for the display is put back as soon as the eye has what it needs; where nobody has, the
    correction of the scene, or the one that was picked at the console.
    """

    def __init__(self, publish: Publish, scene: Scene) -> None:
        self._publish = publish
        self.wanted = False
        self.picked: Correction | Literal["auto"] = "auto"
        self.state = LookState.RESTING
        self._by_scene = scene.methods.correction
        self._holds = self._borrowed = False
        self._number = 0
        self._labels: deque[str] = deque(maxlen=MAX_LABELS)
        self._since_s, self._again_s = 0.0, 0.0
        self._others: Display | None = None

    @property
    def label(self) -> str:
        """Label of the newest request."""
        return f"console {self._number}"

    @property
    def correction(self) -> Correction:
        """As picked at the console, else as the scene says."""
        return chosen(self.picked, self._by_scene, "two_pass")

    def waited_s(self, now_s: float) -> float:
        """Return how long the present state has lasted."""
        return now_s - self._since_s

    def follow(self, scene: Scene) -> None:
        """Go over to a scene's correction; a renderer that was once told heeds no scene's."""
        self._by_scene = scene.methods.correction
        if self._holds and not self._borrowed:
            self._put_back()

    def on_others_display(self, display: Display) -> None:
        """Store the display message of another writer, to restore it after the next picture."""
        self._others, self._holds = display, False

    def advance(self, now_s: float) -> None:
        """Ask for the next picture if it is time, or give the last one up."""
        waited_s = self.waited_s(now_s)
        match self.state:
            case LookState.RESTING:
                if self.wanted and now_s >= self._again_s:
                    self._ask(now_s)
            case LookState.DRAWING:
                if waited_s > MAX_DRAWING_S:
                    self._rest(now_s)
            case LookState.TRACING:
                if self._borrowed and waited_s > CAPTURE_S:
                    self._put_back()
                if waited_s > MAX_TRACING_S:
                    self._rest(now_s)

    def _ask(self, now_s: float) -> None:
        self._number += 1
        self._labels.append(self.label)
        self._enter(LookState.DRAWING, now_s)
        self._borrowed = True
        self._publish(
            Display(
                correction=self.correction,
                stereo="mono",
                marks=False,
                pixels_every=PIXELS_EVERY,
                label=self.label,
            )
        )

    def again(self) -> None:
        """Do not wait for the next turn."""
        self._again_s = 0.0

    def on_frame(self, frame: Frame, now_s: float) -> None:
        """Take a frame that was drawn; the eye traces the first one with the pixels asked for."""
        if self.state is LookState.DRAWING and frame.label == self.label and frame.pixels:
            self._enter(LookState.TRACING, now_s)

    def got(self, eye: TwinEye, now_s: float) -> bool:
        """A picture has come; says whether it was for the console, however late."""
        if eye.label == self.label and self.state is not LookState.RESTING:
            self._rest(now_s)
        return eye.label in self._labels

    def _enter(self, state: LookState, now_s: float) -> None:
        self.state, self._since_s = state, now_s

    def _rest(self, now_s: float) -> None:
        self._enter(LookState.RESTING, now_s)
        self._again_s = now_s + LOOK_EVERY_S
        if self._borrowed:
            self._put_back()

    def _put_back(self) -> None:
        self._borrowed, self._holds = False, self._others is None
        own = Display(correction=self.correction, stereo="side_by_side", label="console rests")
        self._publish(self._others or own)


class Replay:
    """A bag that is shown in place of the running graph; nothing of it is sent to anybody."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.timeline: Timeline | None = None
        self.playing = False
        self.rate = 1.0

    def bags(self) -> list[str]:
        return bags_in(self._folder)

    def open(self, name: str) -> None:
        """Show a bag of the folder from its beginning; BagError."""
        self.timeline = Timeline(self._folder / name)
        self.playing = True

    def leave(self) -> None:
        """Back to the running graph."""
        self.timeline, self.playing = None, False

    def seek(self, seconds: float) -> None:
        """Show that moment; beyond the bag: its nearest end."""
        if self.timeline is not None:
            self.timeline.seconds = float(np.clip(seconds, 0.0, self.timeline.duration_s))

    def play_or_pause(self) -> None:
        """Play from here, at the end from the beginning; or stay where it is."""
        if self.timeline is not None and self.timeline.seconds >= self.timeline.duration_s:
            self.seek(0.0)
        self.playing = not self.playing

    def advance(self, duration_s: float) -> None:
        """Play on; stops at the end."""
        if self.timeline is None or not self.playing:
            return
        self.seek(self.timeline.seconds + self.rate * duration_s)
        if self.timeline.seconds >= self.timeline.duration_s:
            self.playing = False


@dataclass(frozen=True, slots=True)
class Files:
    """Where a console reads and writes: the run's plan and scenes, bags, and what it keeps."""

    plan: Path
    scenes: Path
    bags: Path
    kept: Path


class ReleaseError(FlexsheetError, ValueError):
    """An e-stop that this console's host may not reset; the sentence says whose hosts may."""

    code = "release"
    remedy = (
        "Reset the e-stop on a host that the text names, or set `hosts.NAME.may_reset_estop` for "
        "this host in the launch file on all hosts."
    )


class Desk:
    """All of it together, and what needs no state: stop, mark, record.

    A console that is started again goes on with the scene, the sliders and the recording that its
    run had; warn is told why it cannot.
    """

    def __init__(
        self,
        publish: Publish,
        files: Files,
        finger: Finger,
        warn: Callable[[str], None],
        facts: GraphFacts | None = None,
    ) -> None:
        self._files, self.facts = files, facts or GraphFacts()
        kept = first_state(files, warn)
        self.recording, sliders = kept.recording, kept.sliders
        given = None if sliders is None else Sliders(*sliders)
        self.scenes = SceneDesk(self._send_scene, files.scenes, kept.base, given)
        self.finger = finger
        if kept.finger is not None:
            finger.restore(kept.finger)
        self.look = Look(publish, self.scenes.scene)
        self.replay = Replay(files.bags)
        self._publish = publish
        self.stopped: str | None = None

    def begin(self) -> None:
        """Say what holds, as a latched word dies with who said it."""
        self.scenes.tell()
        if self.recording:
            self._publish(Recording(running=True))

    def stop(self, reason: str) -> None:
        self.stopped = reason
        self._publish(EStop(engaged=True, reason=reason))

    def release(self) -> None:
        """Reset the e-stop; ReleaseError where nobody would take it."""
        if others := self.facts.others_may_reset:
            raise ReleaseError(
                f"this console's host may not reset an e-stop; do it on "
                f"{' or '.join(others)}, or let it: may_reset_estop in the launch file"
            )
        self.stopped = None
        self._publish(EStop(engaged=False, reason="reset at the console"))

    def record(self, running: bool) -> None:
        self.recording = running
        self._publish(Recording(running=running))
        self.keep()

    def add_bookmark(self, label: str) -> str:
        """Publish a bookmark, and return its label."""
        label = label.strip() or DEFAULT_BOOKMARK
        self._publish(Bookmark(label=label))
        return label

    def _send_scene(self, scene: Scene) -> None:
        self._publish(scene)
        self.look.follow(scene)
        self.keep()

    def keep(self) -> None:
        """Write down what a console that is started again goes on with."""
        desk = self.scenes
        kept = Kept(
            base=desk.base,
            sliders=astuple(desk.sliders) if desk.moved else None,
            recording=self.recording,
            finger=self.finger.intent if self.finger.commanded else None,
        )
        save_kept(self._files.kept, kept)


def first_state(files: Files, warn: Callable[[str], None]) -> Kept:
    """Return what the console before this one kept, else the first scene alone."""
    try:
        kept = load_kept(files.kept)
    except scenes.SceneChoiceError as error:
        warn(str(error))
        kept = None
    return kept or Kept(base=scenes.first_scene(files.plan))
