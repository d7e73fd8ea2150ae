"""Show the page's tab that records bags, adds bookmarks and replays bags."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import viser

from flexsheet.nodes.console.controller import Replay
from flexsheet.nodes.console.controls import Html, Request, make_callback, on_value, show_value

PLAY_RATES = ("0.1", "0.25", "0.5", "1", "2", "4")
NO_BAG = "(no bag)"
NO_BOOKMARK = "-"
RECORDING_COLOR = (146, 64, 14)
"""The colour of the recording button, which differs from the colour of the e-stop."""


class RecordTab:
    """The controls for recording and replay. The timeline is visible while a bag is shown."""

    def __init__(self, gui: Any, request: Request) -> None:
        self._request = request
        self._seconds_by_option: dict[str, float] = {}
        with gui.add_folder("Record"):
            self._record = gui.add_button("Start recording", icon=viser.Icon.PLAYER_RECORD)
            self._label = gui.add_text("Name", "", hint="Label of the next bookmark")
            bookmark = gui.add_button("Add a bookmark (M)", hint="Key: M")
            self._text = Html(gui)
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
        self._record.on_click(make_callback(request, "record"))
        bookmark.on_click(lambda _: request("bookmark", self._label.value))
        opened.on_click(lambda _: request("open_bag", self._bag.value))
        self._play.on_click(make_callback(request, "play"))
        self._live.on_click(make_callback(request, "leave"))
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
        self._text.show(html)
        self._record.label = "Stop recording" if recording else "Start recording"
        self._record.color = RECORDING_COLOR if recording else None

    def show_bags(self, names: Sequence[str], recorded: str | None = None) -> None:
        """List the bags in the selection control.

        recorded: bag that has just been recorded, which is then selected; None selects no bag.
        """
        options = tuple(names) or (NO_BAG,)
        if self._bag.options != options:
            self._bag.options = options
        if recorded is not None:
            show_value(self._bag, recorded)

    def show_replay(self, replay: Replay, *, opened: bool = False) -> None:
        """Show the current time in the replayed bag.

        opened: whether the shown bag has changed.
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
