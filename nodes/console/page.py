"""Build the panels of the page with the controls and texts next to the 3D view."""

from __future__ import annotations

from typing import Any

import viser

from flexsheet.nodes.console import banner, panels
from flexsheet.nodes.console.banner import GraphState
from flexsheet.nodes.console.controller import SceneController
from flexsheet.nodes.console.graph_facts import GraphFacts
from flexsheet.nodes.console.scene_view import SceneView
from flexsheet.nodes.console.tabs import EyeTab, RecordTab, Request, TouchTab

BRAND = (14, 92, 132)
STOP_COLOR = (185, 28, 28)
RELEASE, RESET = "Release the stop", "Reset the fault"
MAIN_WIDTH, STOP_WIDTH = 380, 320


class Page:
    """The panels of the page next to the 3D view."""

    def __init__(self, server: viser.ViserServer, request: Request, facts: GraphFacts) -> None:
        """Build the panels.

        request: function that passes a viewer's request to the node.
        facts: properties of the graph, which determine the available controls.
        """
        self._gui: Any = server.gui
        self._request, self._others_may = request, facts.others_may_reset
        self.view = SceneView(server, lambda *ray: request("touch", *ray))
        self._gui.configure_theme(
            dark_mode=False, show_logo=False, show_share_button=False, brand_color=BRAND
        )
        self._gui.main_panel.dock_right()
        self._gui.main_panel.set_width(MAIN_WIDTH)
        self._add_stop()
        self._problem = self._gui.add_html("")
        tabs = self._gui.add_tab_group()
        with tabs.add_tab("Touch", viser.Icon.HAND_FINGER):
            self.touch = TouchTab(self._gui, request, with_finger=facts.simulates_finger)
        with tabs.add_tab("Graph", viser.Icon.TOPOLOGY_STAR):
            self.nodes = self._gui.add_html("")
        with tabs.add_tab("Eye", viser.Icon.EYE):
            self.eye = EyeTab(self._gui, request)
        with tabs.add_tab("Record", viser.Icon.PLAYER_RECORD):
            self.record = RecordTab(self._gui, request)

    def _add_stop(self) -> None:
        panel = self._gui.add_panel()
        with panel.add_tab("Stop", viser.Icon.HAND_STOP):
            stop = self._gui.add_button("E-STOP  (Esc)", color=STOP_COLOR)
            self._state = self._gui.add_html("")
            self._release = self._gui.add_button(RESET, disabled=True)
        # Place the window at the bottom, because viser shows its own notices at the top.
        panel.float(x=14, y=-14, width=STOP_WIDTH)
        # Expand the window, because viser folds panels on small screens.
        panel.expand()
        stop.on_click(lambda _: self._request("stop", "pressed at the console"))
        self._release.on_click(lambda _: self._request("release"))
        command = self._gui.add_command("E-stop: stop both arms", hotkey="escape")
        command.on_trigger(lambda _: self._request("stop", "Escape at the console"))

    def show_scene(self, scenes: SceneController) -> None:
        """Show the present scene and its values."""
        self.view.set_scene(scenes.scene)
        self.touch.show_scene(scenes.scene.name, scenes.base, scenes.names, scenes.sliders)

    def show_problem(self, text: str) -> None:
        """Show an error, or remove the shown error if the text is empty."""
        self._problem.content = panels.problem(text)

    def show_state(self, state: GraphState) -> None:
        """Show the banner, and enable the button that releases the e-stop or resets a fault."""
        self._state.content = banner.render(state)
        # The button is always visible, so that no other control moves under the mouse pointer.
        self._release.disabled = not state.resettable
        label = RESET if state.stopped is None else RELEASE
        if self._others_may:
            label = f"{label}: on {' or '.join(self._others_may)}"
        self._release.label = label
