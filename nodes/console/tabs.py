"""Show the tabs of the page: touch, eye and record.

Every callback runs on a thread of the library viser, and only passes a request to the node. Handles
of controls have the type Any, because viser's type stubs do not declare that values can be set.
viser transmits only values that have changed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from flexsheet.messages.scene import Scene
from flexsheet.nodes.console.controller import Sliders
from flexsheet.nodes.console.finger import FingerController
from flexsheet.nodes.console.scenes import MIN_STRETCH_RATIO, max_stretch_ratio

MAX_OFFSET_MM = 80.0
MAX_DEPTH_MM = 50.0
LIFT, LOWER = "Lift the finger off the object (L)", "Lower the finger to the object (L)"
IMAGES = (
    ("seen", "Seen by the eye"),
    ("expected", "Expected by the eye"),
    ("frame", "Projector image"),
)
RECORDING_COLOR = (146, 64, 14)
"""The colour of the recording button, which differs from the colour of the e-stop."""

Request = Callable[..., None]
"""A function request(name, *values) that passes a viewer's request to the node.

The function may be called from any thread."""


def on_value(handle: Any, changed: Callable[[Any], None]) -> None:
    """Call `changed` with each value that a viewer sets, but not with values that the node sets."""

    # A coroutine runs in viser's event loop, so that values arrive in order.
    async def on_update(event: Any) -> None:
        if event.client_id is not None:
            changed(event.target.value)

    handle.on_update(on_update)


class TouchTab:
    """The tab with the controls of the finger, the scene and the view."""

    def __init__(self, gui: Any, request: Request, *, with_finger: bool) -> None:
        self._gui, self._request = gui, request
        self._with_finger = with_finger
        gui.add_markdown(
            "**Drag on the sheet** to stroke the object. Drag beside the sheet to rotate the view. "
            "Scroll to zoom."
            if with_finger
            else "The finger is measured, so it cannot be moved here."
        )
        with gui.add_folder("Finger"):
            if with_finger:
                self._add_finger()
            self._finger = gui.add_html("")
        with gui.add_folder("Object and sheet"):
            self._add_scene()

    def _add_finger(self) -> None:
        gui, request = self._gui, self._request
        self._depth = gui.add_slider(
            "Push, mm",
            0.0,
            MAX_DEPTH_MM,
            0.5,
            4.0,
            hint="Depth of the finger below the object's surface",
        )
        self._across = gui.add_slider(
            "Across, mm",
            -MAX_OFFSET_MM,
            MAX_OFFSET_MM,
            1.0,
            0.0,
            hint="Distance of the finger to the right of the centre of the screen",
        )
        self._up = gui.add_slider(
            "Up, mm",
            -MAX_OFFSET_MM,
            MAX_OFFSET_MM,
            1.0,
            0.0,
            hint="Distance of the finger above the centre of the screen",
        )
        self._lift = gui.add_button(LOWER)
        on_value(self._depth, lambda value: request("push", 1e-3 * value))
        for slider in (self._across, self._up):
            on_value(
                slider, lambda _: request("place", 1e-3 * self._across.value, 1e-3 * self._up.value)
            )
        self._lift.on_click(lambda _: request("lift"))
        command = gui.add_command("Lift the finger off the object, or lower it", hotkey="L")
        command.on_trigger(lambda _: request("lift"))

    def _add_scene(self) -> None:
        gui, request = self._gui, self._request
        self._scene = gui.add_dropdown("Scene", ("-",), hint="Object and sheet")
        self._stiffness = gui.add_slider(
            "Stiffness, kPa", 0.5, 30.0, 0.1, 4.0, hint="Young's modulus of the object"
        )
        self._tension = gui.add_slider(
            "Tension, %",
            *(_percent(MIN_STRETCH_RATIO), 8.0, 0.1, 2.0),
            hint="Minimum stretch of the sheet, in percent of its length without tension. A larger "
            "stretch gives a larger tension. The scene limits the value",
        )
        self._size = gui.add_slider(
            "Size, %", 50, 150, 1, 100, hint="Size of the object, whose front side stays in place"
        )
        on_value(self._scene, lambda name: request("choose", name))
        on_value(self._stiffness, lambda value: request("slide", "young_modulus_pa", 1e3 * value))
        on_value(self._tension, lambda value: request("slide", "stretch_ratio", 1.0 + 0.01 * value))
        on_value(self._size, lambda value: request("slide", "size_ratio", 0.01 * value))

    def show_scene(self, name: str, base: Scene, names: Sequence[str], sliders: Sliders) -> None:
        """Show the values of a scene in the controls.

        name: name of the scene.
        base: scene before it was changed by the sliders.
        names: names of all scenes.
        sliders: slider positions.
        """
        if names:
            self._scene.options = tuple(names)
            if name in names:
                self._scene.value = name
        self._stiffness.disabled = sliders.young_modulus_pa is None
        if sliders.young_modulus_pa is not None:
            self._stiffness.value = 1e-3 * sliders.young_modulus_pa
        self._tension.max = _percent(max_stretch_ratio(base))
        self._tension.value = _percent(sliders.stretch_ratio)
        self._size.value = round(100.0 * sliders.size_ratio)

    def show_intent(self, finger: FingerController) -> None:
        """Show the finger position that a viewer has requested."""
        if self._with_finger:
            self._depth.value = _within(1e3 * finger.intent.depth_m, 0.0, MAX_DEPTH_MM, 1)
            self.show_position(finger)
            self.show_lifted(finger)

    def show_position(self, finger: FingerController) -> None:
        """Show the requested position, limited to the range of the sliders."""
        for slider, value_m in zip((self._across, self._up), finger.position_m, strict=True):
            slider.value = _within(1e3 * value_m, -MAX_OFFSET_MM, MAX_OFFSET_MM, 0)

    def show_lifted(self, finger: FingerController) -> None:
        """Set the label of the button that lifts or lowers the finger."""
        self._lift.label = LOWER if finger.intent.lifted else LIFT

    def show_finger(self, html: str) -> None:
        self._finger.content = html


def _within(value: float, low: float, high: float, digits: int) -> float:
    return min(max(round(value, digits), low), high)


def _percent(ratio: float) -> float:
    return round(100.0 * (ratio - 1.0), 1)


class EyeTab:
    """The tab with the images of the simulated eye. An image is hidden until it exists."""

    def __init__(self, gui: Any, request: Request) -> None:
        enabled = gui.add_checkbox(
            "Render images",
            False,
            hint="Render an image every six seconds, which loads the computer",
        )
        on_value(enabled, lambda on: request("eye_view", on))
        self.text = gui.add_html("")
        blank = np.full((3, 4, 3), 235, dtype=np.uint8)
        self._images = {
            name: gui.add_image(blank, label=label, jpeg_quality=85, visible=False)
            for name, label in IMAGES
        }

    def show_image(self, name: str, image: NDArray[np.uint8]) -> None:
        self._images[name].image = image
        self._images[name].visible = True


class RecordTab:
    """The tab for recording."""

    def __init__(self, gui: Any, request: Request) -> None:
        self._record = gui.add_button("Start recording", icon=viser.Icon.PLAYER_RECORD)
        self._label = gui.add_text("Name", "", hint="Label of the next bookmark")
        bookmark = gui.add_button("Add a bookmark (M)")
        self._text = gui.add_html("")
        self._record.on_click(lambda _: request("record"))
        bookmark.on_click(lambda _: request("bookmark", self._label.value))
        command = gui.add_command("Add a bookmark", hotkey="M")
        command.on_trigger(lambda _: request("bookmark", self._label.value))

    def show_state(self, html: str, *, recording: bool) -> None:
        self._text.content = html
        self._record.label = "Stop recording" if recording else "Start recording"
        self._record.color = RECORDING_COLOR if recording else None
