"""The page's panels: what can be pressed, moved and read beside the 3D view.

Every callback runs on viser's own thread; it only hands on what was asked, by name, to the node.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from messages.scene import Scene
from messages.types import Correction
from nodes.console import panels
from nodes.console.desk import Desk, Sliders
from nodes.console.history import SERIES, WINDOW_S
from nodes.console.view import LAYERS, View

Floats = NDArray[np.float64]
Ask = Callable[..., None]
"""ask(name, *values): what the viewer wants; may be called from any thread."""

BRAND = (14, 92, 132)
STOP_COLOR = (185, 28, 28)
CORRECTIONS = ("two_pass", "four_triangles", "one_plane", "none")
COLORS = ("#0e5c84", "#b45309", "#b03a2e", "#166534", "#6d28d9")
MAIN_WIDTH, STOP_WIDTH = 380, 320
PLAY_RATES = ("0.1", "0.25", "0.5", "1", "2", "4")
NO_BAG = "(no bag)"


class Page:
    """All panels; the node tells it what to show."""

    def __init__(self, server: viser.ViserServer, ask: Ask, *, with_finger: bool) -> None:
        # Of viser's handles only what its stubs do not tell (that values can be set) is used.
        self._gui: Any = server.gui
        self._ask = ask
        self.view = View(server)
        self.view.on_touch(lambda *ray: ask("touch", *ray), lambda: None)
        self._shown: dict[str, Any] = {}
        self._gui.configure_theme(
            dark_mode=False, show_logo=False, show_share_button=False, brand_color=BRAND
        )
        self._gui.main_panel.dock_right()
        self._gui.main_panel.set_width(MAIN_WIDTH)
        self._add_stop()
        self._problem = self._gui.add_html("")
        tabs = self._gui.add_tab_group()
        with tabs.add_tab("Touch", viser.Icon.HAND_FINGER):
            self._add_touch(with_finger)
        with tabs.add_tab("Graph", viser.Icon.TOPOLOGY_STAR):
            self._add_graph()
        with tabs.add_tab("Eye", viser.Icon.EYE):
            self._add_eye()
        with tabs.add_tab("Record", viser.Icon.PLAYER_RECORD):
            self._add_record()

    def _add_stop(self) -> None:
        """In a window of its own, so that no tab and no scrolling takes it away."""
        panel = self._gui.add_panel()
        with panel.add_tab("Stop", viser.Icon.HAND_STOP):
            stop = self._gui.add_button(
                "E-STOP  (Esc)", color=STOP_COLOR, hint="Stop both arms at once. Key: Escape"
            )
            self._state = self._gui.add_html("")
            self._release = self._gui.add_button(
                "Release the e-stop",
                visible=False,
                hint="The arms must be at rest; then they follow again",
            )
        # At the bottom: viser's own notices come at the top.
        panel.float(x=14, y=-14, width=STOP_WIDTH)
        self._on_press(stop, "stop", "pressed at the console")
        self._on_press(self._release, "release")
        command = self._gui.add_command("E-stop: stop both arms", hotkey="escape")
        command.on_trigger(self._handing("stop", "Escape at the console"))

    def _add_touch(self, with_finger: bool) -> None:
        self._gui.add_markdown(
            "**Drag on the sheet** to stroke the object. Drag beside it to turn the view."
            if with_finger
            else "The finger is measured; it cannot be moved from here."
        )
        if with_finger:
            with self._gui.add_folder("Finger"):
                depth = self._gui.add_slider("Push, mm", 0.0, 50.0, 0.5, 4.0)
                across = self._gui.add_slider("Across, mm", -80.0, 80.0, 1.0, 0.0)
                up = self._gui.add_slider("Up, mm", -80.0, 80.0, 1.0, 0.0)
                lift = self._gui.add_button("Lift the finger (L)", hint="Off the object. Key: L")
            self._on_value(depth, lambda value: self._ask("push", 1e-3 * value))
            for slider in (across, up):
                self._on_value(
                    slider, lambda _: self._ask("place", 1e-3 * across.value, 1e-3 * up.value)
                )
            self._on_press(lift, "lift")
            command = self._gui.add_command("Lift the finger", hotkey="L")
            command.on_trigger(self._handing("lift"))
        with self._gui.add_folder("Object and sheet"):
            self._scene = self._gui.add_dropdown("Scene", ("-",))
            self._stiffness = self._gui.add_slider(
                "Stiffness, kPa", 0.5, 30.0, 0.1, 4.0, hint="Young's modulus of the object"
            )
            self._tension = self._gui.add_slider(
                "Tension, %", 0.5, 12.0, 0.1, 2.0, hint="Least stretch of the sheet"
            )
            self._size = self._gui.add_slider(
                "Size, %", 50, 150, 1, 100, hint="Of the object; its front stays where it is"
            )
        self._on_value(self._scene, lambda name: self._ask("choose", name))
        self._on_value(
            self._stiffness, lambda value: self._ask("slide", "young_modulus_pa", 1e3 * value)
        )
        self._on_value(
            self._tension, lambda value: self._ask("slide", "stretch_ratio", 1.0 + 0.01 * value)
        )
        self._on_value(self._size, lambda value: self._ask("slide", "size_ratio", 0.01 * value))
        with self._gui.add_folder("Show", expand_by_default=False):
            for layer in LAYERS:
                box = self._gui.add_checkbox(layer, True)
                self._on_value(box, partial(self._ask, "show_layer", layer))

    def _add_graph(self) -> None:
        axis: dict[str, Any] = {"stroke": panels.TEXT, "grid": {"stroke": "#e5e7eb", "width": 1}}
        series = tuple(
            {"label": name, "stroke": color, "width": 2, "spanGaps": False}
            for name, color in zip(SERIES, COLORS, strict=True)
        )
        self._gui.add_markdown("**Latency, ms after the exposure**, over the last half minute")
        self._chart = self._gui.add_uplot(
            (np.zeros(1), *(np.full(1, np.nan) for _ in SERIES)),
            ({"label": "s"}, *series),
            scales={"x": {"time": False, "range": (-WINDOW_S, 0.0)}, "y": {"auto": True}},
            axes=(axis, axis),
            legend={"show": True},
            height=210,
        )
        self._tables = self._gui.add_html("")

    def _add_eye(self) -> None:
        self._look = self._gui.add_checkbox(
            "Look through the user's eye", False, hint="A picture every few seconds"
        )
        self._correction = self._gui.add_dropdown("Correction", CORRECTIONS)
        self._on_value(self._look, lambda on: self._ask("look", on))
        self._on_value(self._correction, lambda name: self._ask("correct", name))
        blank = np.full((90, 120, 3), 235, dtype=np.uint8)
        self._pictures = {
            name: self._gui.add_image(blank, label=label, jpeg_quality=80)
            for name, label in (
                ("seen", "What the eye sees of the sheet"),
                ("proper", "What it ought to see"),
                ("frame", "What the projector is given"),
            )
        }

    def _add_record(self) -> None:
        with self._gui.add_folder("Record"):
            self._record = self._gui.add_button("Start recording", icon=viser.Icon.PLAYER_RECORD)
            self._label = self._gui.add_text("Moment", "", hint="What to call it")
            mark = self._gui.add_button("Mark this moment (M)", hint="Key: M")
        with self._gui.add_folder("Replay"):
            self._bag = self._gui.add_dropdown("Bag", (NO_BAG,))
            opened = self._gui.add_button("Show the bag")
            self._play = self._gui.add_button("Play", visible=False)
            self._time = self._gui.add_slider("Time, s", 0.0, 1.0, 0.05, 0.0, visible=False)
            self._rate = self._gui.add_dropdown(
                "Speed", PLAY_RATES, initial_value="1", visible=False
            )
            self._moments = self._gui.add_dropdown("Moments", ("-",), visible=False)
            self._live = self._gui.add_button("Back to the running graph", visible=False)
        self._record.on_click(self._handing("record"))
        mark.on_click(lambda _: self._ask("mark", self._label.value))
        opened.on_click(lambda _: self._ask("open_bag", self._bag.value))
        self._on_press(self._play, "play")
        self._on_press(self._live, "leave")
        self._on_value(self._time, lambda seconds: self._ask("seek", seconds))
        self._on_value(self._rate, lambda rate: self._ask("replay_rate", float(rate)))
        self._on_value(self._moments, self._go_to_moment)
        command = self._gui.add_command("Mark this moment", hotkey="M")
        command.on_trigger(lambda _: self._ask("mark", self._label.value))

    def _go_to_moment(self, told: str) -> None:
        seconds, _, rest = told.partition(" s")
        if rest:
            self._ask("seek", float(seconds))

    def _handing(self, name: str, *values: Any) -> Callable[[Any], None]:
        return lambda event: self._ask(name, *values)

    def _on_press(self, button: Any, name: str, *values: Any) -> None:
        button.on_click(self._handing(name, *values))

    @staticmethod
    def _on_value(handle: Any, changed: Callable[[Any], None]) -> None:
        """Call with the value that a viewer has set; not with what the page is told to show."""

        def on_update(event: Any) -> None:
            if event.client_id is not None:
                changed(event.target.value)

        handle.on_update(on_update)

    def show_scene(self, scene: Scene, names: Sequence[str], sliders: Sliders) -> None:
        """A scene that the graph now works with."""
        self.view.set_scene(scene)
        if names:
            self._scene.options = tuple(names)
            if scene.name in names:
                self._scene.value = scene.name
        self._stiffness.value = 1e-3 * sliders.young_modulus_pa
        self._tension.value = 100.0 * (sliders.stretch_ratio - 1.0)
        self._size.value = round(100.0 * sliders.size_ratio)

    def show_correction(self, correction: Correction) -> None:
        """The one that the scene chose, or a viewer."""
        self._correction.value = correction

    def show_problem(self, text: str) -> None:
        self._set("problem", self._problem, panels.problem(text))

    def show_state(self, html: str, *, stopped: bool, recording: bool) -> None:
        """The banner, and what the buttons say."""
        self._set("state", self._state, html)
        self._release.visible = stopped
        self._record.label = "Stop recording" if recording else "Start recording"
        self._record.color = STOP_COLOR if recording else None

    def show_graph(self, tables: str, columns: tuple[Floats, ...]) -> None:
        self._set("tables", self._tables, tables)
        self._chart.data = columns

    def show_picture(self, name: str, image: NDArray[np.uint8]) -> None:
        self._pictures[name].image = image

    def show_bags(self, names: Sequence[str]) -> None:
        options = tuple(names) or (NO_BAG,)
        if self._bag.options != options:
            self._bag.options = options

    def show_replay(self, desk: Desk, *, opened: bool = False) -> None:
        """The timeline's place; `opened`: it is another bag's, or none any more."""
        timeline = desk.replay.timeline
        if opened:
            for handle in (self._play, self._time, self._rate, self._moments, self._live):
                handle.visible = timeline is not None
            if timeline is not None:
                self._time.max = max(round(timeline.duration_s, 1), 0.1)
                marked = [f"{seconds:.2f} s {label}" for seconds, label in timeline.moments]
                self._moments.options = ("-", *marked)
        if timeline is not None:
            self._time.value = timeline.seconds
            self._play.label = "Pause" if desk.replay.playing else "Play"

    def _set(self, name: str, handle: Any, html: str) -> None:
        """Send HTML only where it has changed."""
        if self._shown.get(name) != html:
            self._shown[name] = handle.content = html
