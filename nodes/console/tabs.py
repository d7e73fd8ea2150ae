"""Show the tabs of the page: touch, graph, eye and record.

Every callback runs on a thread of the library viser, and only passes a request to the node. Handles
of controls have the type Any, because viser's type stubs do not declare that values can be set.
viser transmits only values that have changed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from flexsheet.messages.scene import Scene
from flexsheet.messages.types import Correction
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.console import panels
from flexsheet.nodes.console.controller import Replay
from flexsheet.nodes.console.finger import FingerController
from flexsheet.nodes.console.history import SERIES, WINDOW_S, widen_isolated
from flexsheet.nodes.console.scene_view import LAYERS, VIEWPOINTS, SceneView
from flexsheet.nodes.console.scenes import MIN_STRETCH_RATIO, max_stretch_ratio
from flexsheet.nodes.console.state_file import Sliders

MAX_OFFSET_MM = 80.0
MAX_DEPTH_MM = 50.0
LIFT, LOWER = "Lift the finger off the object (L)", "Lower the finger to the object (L)"
CORRECTIONS = ("two_pass", "four_triangles", "one_plane", "none")
IMAGES = (
    ("seen", "Seen by the eye"),
    ("expected", "Expected by the eye"),
    ("frame", "Projector image"),
)
PLAY_RATES = ("0.1", "0.25", "0.5", "1", "2", "4")
NO_BAG = "(no bag)"
NO_BOOKMARK = "-"
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
            self._finger = gui.add_html("")
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

        base: scene before it was changed by the sliders.
        names: names of all scenes.
        sliders: slider positions.
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


class GraphTab:
    """The tab with a chart of latencies and tables of latencies, topics and nodes."""

    def __init__(self, gui: Any) -> None:
        gui.add_html(
            '<p class="fs-words"><b>Latency, ms</b>, during the last half minute. The table below '
            "explains the lines.</p>"
        )
        lines = tuple(
            {"label": name, "stroke": line.color, "width": 2, "dash": line.dash, "spanGaps": False}
            for name, line in zip(SERIES, panels.LINES, strict=True)
        )
        self._chart = gui.add_uplot(
            (np.zeros(1), *(np.full(1, np.nan) for _ in SERIES)),
            ({"label": "s"}, *lines),
            scales=_scales(1.0),
            axes=({}, {}),
            legend={"show": False},
            height=180,
            padding=(10, 24, 0, 0),
        )
        self._tables = gui.add_html("")

    def show(self, tables: str, columns: tuple[Floats, ...]) -> None:
        self._tables.content = tables
        # The chart library uPlot finds no range if one of the series has no value.
        scales = _scales(max_latency_ms(columns))
        if self._chart.scales != scales:
            self._chart.scales = scales
        self._chart.data = widen_isolated(columns)


def _scales(top_ms: float) -> dict[str, Any]:
    return {
        "x": {"time": False, "range": (-WINDOW_S, 0.0)},
        "y": {"auto": False, "range": (0.0, top_ms)},
    }


def max_latency_ms(columns: tuple[Floats, ...]) -> float:
    """Return the upper limit of the latency axis of a chart, ms.

    The limit is the first of the values 1, 2, 5, 10, 20, 50 and so on that no latency exceeds.

    columns: times (n,), s, followed by the latency series (n,), ms.
    """
    values = np.concatenate(columns[1:])
    largest = float(values[np.isfinite(values)].max(initial=1.0))
    decade = 10.0 ** np.floor(np.log10(largest))
    return float(next(step * decade for step in (1, 2, 5, 10) if step * decade >= largest))


class EyeTab:
    """The tab with the images of the simulated eye. An image is hidden until it exists."""

    def __init__(self, gui: Any, request: Request) -> None:
        self._enabled = gui.add_checkbox(
            "Render images",
            False,
            hint="Render an image every six seconds, which loads the computer",
        )
        self._correction = gui.add_dropdown(
            "Correction",
            CORRECTIONS,
            hint="Correction for the sheet's tilt and deflection. The first method is the best",
        )
        on_value(self._enabled, lambda on: request("eye_view", on))
        on_value(self._correction, lambda name: request("correct", name))
        self.text = gui.add_html("")
        blank = np.full((3, 4, 3), 235, dtype=np.uint8)
        self._images = {
            name: gui.add_image(blank, label=label, jpeg_quality=85, visible=False)
            for name, label in IMAGES
        }

    def show_correction(self, correction: Correction) -> None:
        """Show the image correction that is active."""
        self._correction.value = correction

    def show_image(self, name: str, image: NDArray[np.uint8]) -> None:
        self._images[name].image = image
        self._images[name].visible = True


class RecordTab:
    """The tab for recording and replay. The timeline is visible while a bag is shown."""

    def __init__(self, gui: Any, request: Request) -> None:
        self._request = request
        self._seconds_by_option: dict[str, float] = {}
        with gui.add_folder("Record"):
            self._record = gui.add_button("Start recording", icon=viser.Icon.PLAYER_RECORD)
            self._label = gui.add_text("Name", "", hint="Label of the next bookmark")
            bookmark = gui.add_button("Add a bookmark (M)")
            self._text = gui.add_html("")
        with gui.add_folder("Replay"):
            self._bag = gui.add_dropdown("Bag", (NO_BAG,), hint="Newest first")
            opened = gui.add_button("Show the bag")
            self._play = gui.add_button("Play", visible=False)
            self._time = gui.add_slider("Time, s", 0.0, 1.0, 0.05, 0.0, visible=False)
            self._rate = gui.add_dropdown(
                "Speed, times", PLAY_RATES, initial_value="1", visible=False
            )
            self._bookmarks = gui.add_dropdown("Go to", (NO_BOOKMARK,), visible=False)
            self._live = gui.add_button("Back to the running graph", visible=False)
        self._record.on_click(lambda _: request("record"))
        bookmark.on_click(lambda _: request("bookmark", self._label.value))
        opened.on_click(lambda _: request("open_bag", self._bag.value))
        self._play.on_click(lambda _: request("play"))
        self._live.on_click(lambda _: request("leave"))
        on_value(self._time, lambda seconds: request("seek", seconds))
        on_value(self._rate, lambda rate: request("replay_rate", float(rate)))
        on_value(self._bookmarks, self._go_to_bookmark)
        command = gui.add_command("Add a bookmark", hotkey="M")
        command.on_trigger(lambda _: request("bookmark", self._label.value))

    def _go_to_bookmark(self, option: str) -> None:
        seconds = self._seconds_by_option.get(option)
        if seconds is not None:
            self._request("seek", seconds)
            # Reset the choice, so that the same bookmark can be chosen again.
            self._bookmarks.value = NO_BOOKMARK

    def show_state(self, html: str, *, recording: bool) -> None:
        self._text.content = html
        self._record.label = "Stop recording" if recording else "Start recording"
        self._record.color = RECORDING_COLOR if recording else None

    def show_bags(self, names: Sequence[str], recorded: str | None = None) -> None:
        """List the bags in the selection control.

        recorded: bag that has just been recorded; this bag is selected. None selects no bag.
        """
        options = tuple(names) or (NO_BAG,)
        if self._bag.options != options:
            self._bag.options = options
        if recorded is not None:
            self._bag.value = recorded

    def show_replay(self, replay: Replay, *, opened: bool = False) -> None:
        """Show the current time in the replayed bag.

        opened: whether a bag has been opened or closed since the last call.
        """
        timeline = replay.timeline
        if opened:
            for handle in (self._play, self._time, self._rate, self._bookmarks, self._live):
                handle.visible = timeline is not None
            if timeline is not None:
                self._time.max = max(round(timeline.duration_s, 1), 0.1)
                self._seconds_by_option = {
                    f"{seconds:.2f} s {label}": seconds for seconds, label in timeline.bookmarks
                }
                self._bookmarks.options = (NO_BOOKMARK, *self._seconds_by_option)
                self._bookmarks.visible = bool(self._seconds_by_option)
        if timeline is not None:
            self._time.value = round(timeline.seconds, 2)
            self._play.label = "Pause" if replay.playing else "Play"
