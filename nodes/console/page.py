"""The page's panels: what can be pressed, moved and read beside the 3D view."""

from __future__ import annotations

from typing import Any

import viser

from flexsheet.messages.scene import Scene
from flexsheet.nodes.console import banner, panels
from flexsheet.nodes.console.banner import GraphState
from flexsheet.nodes.console.controls import Ask, Html, handing
from flexsheet.nodes.console.desk import Desk
from flexsheet.nodes.console.eye_tab import EyeTab
from flexsheet.nodes.console.graph_tab import GraphTab
from flexsheet.nodes.console.record_tab import RecordTab
from flexsheet.nodes.console.touch_tab import TouchTab
from flexsheet.nodes.console.view import View

BRAND = (14, 92, 132)
STOP_COLOR = (185, 28, 28)
RELEASE, RESET = "Release the stop", "Reset the fault"
MAIN_WIDTH, STOP_WIDTH = 380, 320


class Page:
    """All panels; the node tells it what to show."""

    def __init__(
        self, server: viser.ViserServer, ask: Ask, *, with_finger: bool, others_may: tuple[str, ...]
    ) -> None:
        """others_may: hosts that may reset an e-stop where the console's may not; empty: it may."""
        self._gui: Any = server.gui
        self._ask, self._others_may = ask, others_may
        self.view = View(server)
        self.view.on_touch(lambda *ray: ask("touch", *ray), lambda: None)
        self._gui.configure_theme(
            dark_mode=False, show_logo=False, show_share_button=False, brand_color=BRAND
        )
        self._gui.main_panel.dock_right()
        self._gui.main_panel.set_width(MAIN_WIDTH)
        self._add_stop()
        self._problem = Html(self._gui)
        tabs = self._gui.add_tab_group()
        with tabs.add_tab("Touch", viser.Icon.HAND_FINGER):
            self.touch = TouchTab(self._gui, ask, self.view, with_finger=with_finger)
        with tabs.add_tab("Graph", viser.Icon.TOPOLOGY_STAR):
            self.graph = GraphTab(self._gui)
        with tabs.add_tab("Eye", viser.Icon.EYE):
            self.eye = EyeTab(self._gui, ask)
        with tabs.add_tab("Record", viser.Icon.PLAYER_RECORD):
            self.record = RecordTab(self._gui, ask)

    def _add_stop(self) -> None:
        """In a window of its own, so that no tab and no scrolling takes it away."""
        panel = self._gui.add_panel()
        with panel.add_tab("Stop", viser.Icon.HAND_STOP):
            stop = self._gui.add_button(
                "E-STOP  (Esc)", color=STOP_COLOR, hint="Stop both arms at once. Key: Escape"
            )
            self._state = Html(self._gui)
            self._release = self._gui.add_button(
                RELEASE, disabled=True, hint="The arms must be at rest"
            )
        # At the bottom: viser's own notices come at the top.
        panel.float(x=14, y=-14, width=STOP_WIDTH)
        # On a telephone viser would fold it.
        panel.expand()
        stop.on_click(handing(self._ask, "stop", "pressed at the console"))
        self._release.on_click(handing(self._ask, "release"))
        command = self._gui.add_command("E-stop: stop both arms", hotkey="escape")
        command.on_trigger(handing(self._ask, "stop", "Escape at the console"))

    def show_scene(self, scene: Scene, desk: Desk) -> None:
        """A scene that the graph now works with, or that a bag holds."""
        self.view.set_scene(scene)
        self.touch.show_scene(scene, desk.scenes.base, desk.scenes.names, desk.scenes.sliders)
        self.eye.show_correction(desk.look.correction)

    def show_problem(self, text: str) -> None:
        self._problem.show(panels.problem(text))

    def show_state(self, state: GraphState) -> None:
        """The banner, and whether there is an e-stop to release or a fault to reset."""
        self._state.show(banner.render(state))
        # Always there, so that nothing moves under the pointer.
        self._release.disabled = not state.resettable
        label = RESET if state.stopped is None else RELEASE
        if self._others_may:
            label = f"{label}: on {' or '.join(self._others_may)}"
        if self._release.label != label:
            self._release.label = label
