"""Show the page's tab that controls the finger, the scene and the view."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

from flexsheet.messages.scene import Scene
from flexsheet.nodes.console.controller import Sliders
from flexsheet.nodes.console.controls import Html, Request, make_callback, on_value, show_value
from flexsheet.nodes.console.finger import FingerController
from flexsheet.nodes.console.scene_view import LAYERS, VIEWPOINTS, SceneView
from flexsheet.nodes.console.scenes import MIN_STRETCH_RATIO, max_stretch_ratio

MAX_OFFSET_MM = 80.0
MAX_DEPTH_MM = 50.0
LIFT, LOWER = "Lift the finger (L)", "Lower the finger (L)"


class TouchTab:
    """The tab with the controls of the finger, the scene and the view."""

    def __init__(self, gui: Any, request: Request, view: SceneView, *, with_finger: bool) -> None:
        self._gui, self._request, self._view = gui, request, view
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
            self._finger = Html(gui)
        with gui.add_folder("Object and sheet"):
            self._add_scene()
        with gui.add_folder("View"):
            self._add_view()

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
        self._lift = gui.add_button(
            LOWER, hint="Lower the finger to the object, or lift it. Key: L"
        )
        on_value(self._depth, lambda value: request("push", 1e-3 * value))
        for slider in (self._across, self._up):
            on_value(
                slider, lambda _: request("place", 1e-3 * self._across.value, 1e-3 * self._up.value)
            )
        self._lift.on_click(make_callback(request, "lift"))
        gui.add_command("Lift or lower the finger", hotkey="L").on_trigger(
            make_callback(request, "lift")
        )

    def _add_scene(self) -> None:
        gui, request = self._gui, self._request
        self._scene = gui.add_dropdown("Scene", ("-",), hint="Object and sheet")
        self._stiffness = gui.add_slider(
            "Stiffness, kPa", 0.5, 30.0, 0.1, 4.0, hint="Young's modulus of the object"
        )
        self._tension = gui.add_slider(
            "Tension, %",
            *(_percent(MIN_STRETCH_RATIO), 8.0, 0.1, 2.0),
            hint="Minimum stretch of the sheet, which the scene limits",
        )
        self._size = gui.add_slider(
            "Size, %", 50, 150, 1, 100, hint="Size of the object, whose front side stays in place"
        )
        on_value(self._scene, lambda name: request("choose", name))
        on_value(self._stiffness, lambda value: request("slide", "young_modulus_pa", 1e3 * value))
        on_value(self._tension, lambda value: request("slide", "stretch_ratio", 1.0 + 0.01 * value))
        on_value(self._size, lambda value: request("slide", "size_ratio", 0.01 * value))

    def _add_view(self) -> None:
        seen_from = self._gui.add_button_group(
            "View from", tuple(VIEWPOINTS), hint="Changes only your own view"
        )
        seen_from.on_click(lambda event: self._view.look_from(event.client, event.target.value))
        with self._gui.add_folder("Show", expand_by_default=False):
            for layer in LAYERS:
                box = self._gui.add_checkbox(layer, True)
                on_value(box, partial(self._request, "show_layer", layer))

    def show_scene(self, scene: Scene, base: Scene, names: Sequence[str], sliders: Sliders) -> None:
        """Show the values of a scene in the controls.

        base: scene before it was changed by the sliders. names: names of all scenes. sliders:
            slider positions.
        """
        if names:
            self._scene.options = tuple(names)
            if scene.name in names:
                self._scene.value = scene.name
        self._stiffness.disabled = sliders.young_modulus_pa is None
        if sliders.young_modulus_pa is not None:
            self._stiffness.value = 1e-3 * sliders.young_modulus_pa
        self._tension.max = _percent(max_stretch_ratio(base))
        self._tension.value = _percent(sliders.stretch_ratio)
        self._size.value = round(100.0 * sliders.size_ratio)

    def show_intent(self, finger: FingerController) -> None:
        """Show the finger position that a viewer has requested."""
        if self._with_finger:
            show_value(self._depth, _within(1e3 * finger.intent.depth_m, 0.0, MAX_DEPTH_MM, 1))
            self.show_position(finger)
            self.show_lifted(finger)

    def show_position(self, finger: FingerController) -> None:
        """Show the requested position, limited to the range of the sliders."""
        for slider, value_m in zip((self._across, self._up), finger.position_m, strict=True):
            show_value(slider, _within(1e3 * value_m, -MAX_OFFSET_MM, MAX_OFFSET_MM, 0))

    def show_lifted(self, finger: FingerController) -> None:
        """Set the label of the button that lifts or lowers the finger."""
        label = LOWER if finger.intent.lifted else LIFT
        if self._lift.label != label:
            self._lift.label = label

    def show_finger(self, html: str) -> None:
        self._finger.show(html)


def _within(value: float, low: float, high: float, digits: int) -> float:
    return min(max(round(value, digits), low), high)


def _percent(ratio: float) -> float:
    return round(100.0 * (ratio - 1.0), 1)
