"""What can be asked of the console, and what comes of it; all on the node's own loop."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from messages.base import Message
from messages.scene import Scene
from messages.types import Correction, Display, EStop, Moment, Recording, TwinEye
from nodes.console import scenes
from nodes.console.aim import Aim
from nodes.console.finger import Finger
from nodes.console.replay import Timeline, bags_in

Floats = NDArray[np.float64]
Publish = Callable[[Message], None]

SETTLE_S = 0.4
"""A slider that rests so long is meant; while it moves, no scene is sent."""

LOOK_EVERY_S = 6.0
PIXELS_EVERY = 3
LOOK_PATIENCE_S = 5.0


@dataclass(frozen=True, slots=True)
class Sliders:
    """What the page's sliders say of the scene."""

    young_modulus_pa: float
    stretch_ratio: float
    size_ratio: float

    @staticmethod
    def of(scene: Scene) -> Sliders:
        return Sliders(
            scene.object.material.young_modulus_pa, max(scene.sheet.min_stretch_ratio, 1.005), 1.0
        )


class SceneDesk:
    """The scene that the graph works with: chosen, and changed by the sliders."""

    def __init__(self, publish: Publish, folder: Path, first: Scene) -> None:
        self._publish, self._folder = publish, folder
        self.names = scenes.scene_names(folder)
        self._base = self.scene = first
        self.sliders = Sliders.of(first)
        self._due_s: float | None = None
        self._making_aim: asyncio.Task[None] | None = None

    def choose(self, name: str) -> None:
        """Go over to another of the run's scenes; SceneChoiceError."""
        self._base = scenes.load(self._folder, name)
        self.sliders = Sliders.of(self._base)
        self._send(self._base)

    def slide(self, now_s: float, **changes: float) -> None:
        """One slider was moved; the scene follows once it rests."""
        self.sliders = replace(self.sliders, **changes)
        self._due_s = now_s + SETTLE_S

    def settle(self, now_s: float) -> bool:
        """Send the changed scene if that is due; says whether it was.  SceneChoiceError."""
        if self._due_s is None or now_s < self._due_s:
            return False
        self._due_s = None
        given = self.sliders
        self._send(
            scenes.edited(
                self._base,
                young_modulus_pa=given.young_modulus_pa,
                stretch_ratio=given.stretch_ratio,
                size_ratio=given.size_ratio,
            )
        )
        return True

    def _send(self, scene: Scene) -> None:
        self.scene = scene
        self._publish(scene)

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


class Look:
    """Through the user's eye: asks the renderer for a frame with its pixels, now and then.

    What another has set for the display is put back when nobody looks any more.
    """

    def __init__(self, publish: Publish) -> None:
        self._publish = publish
        self.wanted = False
        self.correction: Correction = "two_pass"
        self._number = 0
        self._asked_s: float | None = None
        self._again_s = 0.0
        self._others: Display | None = None

    @property
    def label(self) -> str:
        return f"console {self._number}"

    def heed(self, display: Display) -> None:
        """Another one's display message."""
        if not display.label.startswith("console "):
            self._others = display

    def advance(self, now_s: float) -> None:
        """Ask for the next picture if it is time, or give the last one up."""
        if self._asked_s is not None:
            if now_s > self._asked_s + LOOK_PATIENCE_S:
                self._put_back(now_s)
        elif self.wanted and now_s >= self._again_s:
            self._number += 1
            self._asked_s = now_s
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

    def got(self, eye: TwinEye, now_s: float) -> bool:
        """A picture has come; says whether it is ours."""
        if eye.label != self.label:
            return False
        self._put_back(now_s)
        return True

    def _put_back(self, now_s: float) -> None:
        self._asked_s, self._again_s = None, now_s + LOOK_EVERY_S
        self._publish(self._others or Display(correction=self.correction, stereo="side_by_side"))


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

    def advance(self, duration_s: float) -> None:
        """Play on; stops at the end."""
        if self.timeline is None or not self.playing:
            return
        self.seek(self.timeline.seconds + self.rate * duration_s)
        if self.timeline.seconds >= self.timeline.duration_s:
            self.playing = False


class Desk:
    """All of it together, and what needs no state: stop, mark, record."""

    def __init__(
        self, publish: Publish, *, scenes_folder: Path, bags: Path, first: Scene, finger: Finger
    ) -> None:
        self._publish = publish
        self.scenes = SceneDesk(publish, scenes_folder, first)
        self.finger = finger
        self.look = Look(publish)
        self.replay = Replay(bags)
        self.recording = False
        self.stopped: str | None = None

    def stop(self, reason: str) -> None:
        self.stopped = reason
        self._publish(EStop(engaged=True, reason=reason))

    def release(self) -> None:
        self.stopped = None
        self._publish(EStop(engaged=False, reason="reset at the console"))

    def record(self, running: bool) -> None:
        self.recording = running
        self._publish(Recording(running=running))

    def mark(self, label: str) -> None:
        self._publish(Moment(label=label.strip() or "moment"))
