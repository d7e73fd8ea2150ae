"""Execute the viewers' requests in the console node's event loop.

The "eye view" is the image that the user sees. A simulated camera at the user's eye computes it
from the projected frame by ray tracing.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from enum import Enum, auto
from pathlib import Path

from pydantic import BaseModel

from flexsheet.messages.base import Message
from flexsheet.messages.errors import FlexsheetError
from flexsheet.messages.files import write_file
from flexsheet.messages.scene import Scene
from flexsheet.messages.types import Bookmark, Display, EStop, Frame, Recording, TwinEye
from flexsheet.nodes.console import scenes
from flexsheet.nodes.console.finger import FingerController
from flexsheet.nodes.console.graph_facts import GraphFacts
from flexsheet.nodes.console.picking import SurfacePicker

Publish = Callable[[Message], None]

SETTLE_S = 0.4
"""The time (s) for which no slider must move before the changed scene is published."""

EYE_VIEW_PERIOD_S = 6.0
PIXELS_EVERY = 3
MAX_DRAWING_S = 5.0
"""The maximum time (s) to wait for a frame from the renderer."""

CAPTURE_S = 1.0
"""The maximum time (s) after a frame until the simulated eye has received all its inputs."""

MAX_TRACING_S = 120.0
"""The maximum time (s) to wait for the ray-traced image of the eye view."""

DEFAULT_BOOKMARK = "bookmark"


@dataclass(frozen=True, slots=True)
class Sliders:
    """The positions of the sliders on the console page.

    young_modulus_pa: Young's modulus of the object; None if the object is rigid.
    stretch_ratio: minimum stretch ratio of the sheet.
    size_ratio: size of the object, relative to its size in the selected scene.
    """

    young_modulus_pa: float | None
    stretch_ratio: float
    size_ratio: float

    @staticmethod
    def from_scene(scene: Scene) -> Sliders:
        """Return the slider positions that correspond to an unchanged scene."""
        material = scene.object.material
        return Sliders(
            None if material is None else material.young_modulus_pa,
            max(scene.sheet.min_stretch_ratio, scenes.MIN_STRETCH_RATIO),
            1.0,
        )


class SceneController:
    """A controller that selects and changes the scene of the graph when viewers request it."""

    def __init__(self, publish: Callable[[Scene], None], folder: Path, first: Scene) -> None:
        """Create the controller with the scene `first`.

        publish: function that publishes a scene.
        folder: folder with the selectable scenes.
        """
        self._publish, self._folder = publish, folder
        self.names = scenes.list_scene_names(folder)
        self.base = self.scene = first
        self.sliders = Sliders.from_scene(first)
        self._due_s: float | None = None
        self._picker_task: asyncio.Task[None] | None = None

    def choose(self, name: str) -> None:
        """Choose another scene of the run; raise SceneChoiceError if the name is unknown."""
        self.base = self.scene = scenes.load(self._folder, name)
        self.sliders = Sliders.from_scene(self.base)
        self._publish(self.scene)

    def slide(self, now_s: float, **changes: float) -> None:
        """Store new slider positions by name. `apply_sliders` changes the scene later.

        now_s: current time.
        """
        self.sliders = replace(self.sliders, **changes)
        self._due_s = now_s + SETTLE_S

    def apply_sliders(self, now_s: float) -> bool:
        """Change the scene if the sliders have stopped moving; return whether it has changed.

        Raises SceneChoiceError if the slider positions are invalid.
        """
        if self._due_s is None or now_s < self._due_s:
            return False
        self._due_s = None
        self.scene = scenes.edit_scene(self.base, **asdict(self.sliders))
        self._publish(self.scene)
        return True

    def make_picker(self, finger: FingerController, failed: Callable[[str], None]) -> None:
        """Create the picker, which converts mouse positions to points on the virtual object.

        finger: controller that moves the finger to the selected points.
        failed: function that receives an error text if no points can be selected on the object.

        The method returns before a background thread has created the picker.
        """
        if self._picker_task is not None:
            self._picker_task.cancel()
        finger.use(None)
        self._picker_task = asyncio.create_task(self._make_picker(self.scene, finger, failed))

    async def _make_picker(
        self, scene: Scene, finger: FingerController, failed: Callable[[str], None]
    ) -> None:
        try:
            finger.use(await asyncio.to_thread(SurfacePicker, scene))
        except ValueError as error:
            failed(f"the finger cannot be moved over this object: {error}; choose another scene")

    async def close(self) -> None:
        if self._picker_task is not None:
            self._picker_task.cancel()
            await asyncio.gather(self._picker_task, return_exceptions=True)


class EyeViewState(Enum):
    """The states of a request for an eye view."""

    RESTING = auto()
    DRAWING = auto()
    TRACING = auto()


class EyeViewRequester:
    """A requester of eye views, which are simulated images at the user's eye.

    Only one view is requested at a time, because ray tracing is slow. For each view, the renderer
    draws one frame and publishes its pixels. From this frame, the simulated eye computes the view.
    Afterwards, the previous display settings are restored. If no other node has sent display
    settings, the image correction of the scene is restored.
    """

    def __init__(self, publish: Publish, scene: Scene) -> None:
        self._publish = publish
        self.enabled = False
        self.state = EyeViewState.RESTING
        self._correction = scene.methods.correction
        self._owns_display = self._borrowed = False
        self._number = 0
        self._since_s, self._next_s = 0.0, 0.0
        self._others_display: Display | None = None

    @property
    def label(self) -> str:
        """Return the label of the newest request. The requested frame has the same label."""
        return f"console {self._number}"

    def waited_s(self, now_s: float) -> float:
        """Return the time (s) since the state of the request last changed."""
        return now_s - self._since_s

    def on_scene(self, scene: Scene) -> None:
        """Apply the image correction that a new scene specifies.

        If the console has sent display settings, the renderer ignores the correction in later
        scenes. In this case, this method publishes display settings with the new correction.
        """
        self._correction = scene.methods.correction
        if self._owns_display and not self._borrowed:
            self._restore_display()

    def on_others_display(self, display: Display) -> None:
        """Store the display settings that another node has published.

        An eye view changes the display settings, and restores these settings when it is finished.
        """
        self._others_display, self._owns_display = display, False

    def advance(self, now_s: float) -> None:
        """Request the next eye view if it is due, and abandon a request that takes too long."""
        waited_s = self.waited_s(now_s)
        match self.state:
            case EyeViewState.RESTING:
                if self.enabled and now_s >= self._next_s:
                    self._request(now_s)
            case EyeViewState.DRAWING:
                if waited_s > MAX_DRAWING_S:
                    self._rest(now_s)
            case EyeViewState.TRACING:
                if self._borrowed and waited_s > CAPTURE_S:
                    self._restore_display()
                if waited_s > MAX_TRACING_S:
                    self._rest(now_s)

    def _request(self, now_s: float) -> None:
        self._number += 1
        self._enter(EyeViewState.DRAWING, now_s)
        self._borrowed = True
        self._publish(
            Display(
                correction=self._correction,
                stereo="mono",
                marks=False,
                pixels_every=PIXELS_EVERY,
                label=self.label,
            )
        )

    def on_frame(self, frame: Frame, now_s: float) -> None:
        """Enter the state TRACING if a frame contains the pixels that this console requested.

        In this state, the simulated eye computes the view from the frame.
        """
        if self.state is EyeViewState.DRAWING and frame.label == self.label and frame.pixels:
            self._enter(EyeViewState.TRACING, now_s)

    def on_image(self, eye: TwinEye, now_s: float) -> None:
        """End the request if an image of the simulated eye answers it."""
        if eye.label == self.label and self.state is not EyeViewState.RESTING:
            self._rest(now_s)

    def _enter(self, state: EyeViewState, now_s: float) -> None:
        self.state, self._since_s = state, now_s

    def _rest(self, now_s: float) -> None:
        self._enter(EyeViewState.RESTING, now_s)
        self._next_s = now_s + EYE_VIEW_PERIOD_S
        if self._borrowed:
            self._restore_display()

    def _restore_display(self) -> None:
        self._borrowed, self._owns_display = False, self._others_display is None
        own = Display(correction=self._correction, stereo="side_by_side", label="console rests")
        self._publish(self._others_display or own)


class ConsoleState(BaseModel):
    """The state with which a restarted console continues.

    scene: newest published scene.
    recording: whether a viewer has requested a recording.
    """

    scene: Scene
    recording: bool = False


class ReleaseError(FlexsheetError, ValueError):
    """The error raised if the console's host is not permitted to reset an e-stop.

    The text names the hosts that are permitted to reset the e-stop.
    """

    remedy = (
        "Reset the e-stop on a host that the text names, or set `hosts.NAME.may_reset_estop` for "
        "this host in the launch file on all hosts."
    )


class ConsoleController:
    """The controller of the console, which publishes e-stops, recording requests and bookmarks.

    plan_file: plan in the directory of the run, which also contains the scenes.

    After a restart, the console continues with the saved scene and recording request.
    """

    def __init__(
        self,
        publish: Publish,
        plan_file: Path,
        finger: FingerController,
        facts: GraphFacts | None = None,
    ) -> None:
        self._publish, self.finger, self.facts = publish, finger, facts or GraphFacts()
        self._state_file = plan_file.with_name("console-state.json")
        try:
            state = ConsoleState.model_validate_json(self._state_file.read_bytes())
        except FileNotFoundError:
            state = ConsoleState(scene=scenes.first_scene(plan_file))
        self.recording = state.recording
        folder = plan_file.with_name("scenes")
        self.scenes = SceneController(self._send_scene, folder, state.scene)
        self.eye_view = EyeViewRequester(publish, state.scene)
        self.stopped: str | None = None

    def begin(self) -> None:
        """Publish the scene and an active recording request again after a restart of the console.

        The messages of the previous console process were lost when it exited.
        """
        self._publish(self.scenes.scene)
        if self.recording:
            self._publish(Recording(running=True))

    def stop(self, reason: str) -> None:
        """Engage the e-stop of both arms for the given reason."""
        self.stopped = reason
        self._publish(EStop(engaged=True, reason=reason))

    def release(self) -> None:
        """Reset the e-stop. Raises ReleaseError if the nodes ignore resets from this host."""
        if others := self.facts.others_may_reset:
            raise ReleaseError(
                "the host of this console may not reset an e-stop; "
                f"use {' or '.join(others)}, or set may_reset_estop of this host in the launch file"
            )
        self.stopped = None
        self._publish(EStop(engaged=False, reason="reset at the console"))

    def record(self, running: bool) -> None:
        """Request that the recorder starts or stops a recording, and save this request."""
        self.recording = running
        self._publish(Recording(running=running))
        self._save_state()

    def add_bookmark(self, label: str) -> str:
        """Publish a bookmark, and return its label; replace an empty label by a default label."""
        label = label.strip() or DEFAULT_BOOKMARK
        self._publish(Bookmark(label=label))
        return label

    def _send_scene(self, scene: Scene) -> None:
        self._publish(scene)
        self.eye_view.on_scene(scene)
        self._save_state()

    def _save_state(self) -> None:
        state = ConsoleState(scene=self.scenes.scene, recording=self.recording)
        write_file(self._state_file, state.model_dump_json())
