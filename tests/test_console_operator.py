"""Test that the page shows the state of the node after each request."""

from __future__ import annotations

import json
from collections.abc import AsyncIterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flexsheet.messages.base import Header, Message
from flexsheet.messages.notes import Note
from flexsheet.messages.types import Bookmark, Display, FingerPath, Recording
from flexsheet.nodes.console.access_control import start_server
from flexsheet.nodes.console.controller import (
    MAX_DRAWING_S,
    SETTLE_S,
    ConsoleController,
    EyeViewState,
)
from flexsheet.nodes.console.finger import FingerController
from flexsheet.nodes.console.graph_facts import GraphFacts
from flexsheet.nodes.console.latest_messages import LatestMessages
from flexsheet.nodes.console.operator import Operator
from flexsheet.nodes.console.tabs import LIFT, LOWER
from tests.console_parts import status_of
from tests.scenes import load_cylinder

EYE = np.array([0.1, 0.05, 0.5])
TICK_S = 0.04


@dataclass
class Bench:
    """A page without a viewer, and the messages that its node has sent."""

    operator: Operator
    sent: list[Message] = field(default_factory=list)
    now_s: float = 0.0

    @property
    def touch(self) -> Any:
        return self.operator._page.touch

    def run(self, seconds: float = 20.0) -> None:
        """Advance the time in steps of the node's period."""
        end_s = self.now_s + seconds
        while self.now_s < end_s:
            self.now_s += TICK_S
            self.operator.advance(self.now_s, has_viewers=True)

    async def change_scene(self, name: str, value: float) -> None:
        """Move a slider of the scene, and wait until the new object is ready."""
        self.operator.handle_request("slide", name, value)
        self.run(2.0 * SETTLE_S)
        await self.know_object()

    async def know_object(self) -> None:
        task = self.operator.controller.scenes._picker_task
        assert task is not None
        await task

    def depth_m(self) -> float:
        """Return the depth of the finger in the cylinder's side, along its path."""
        tips = [one.positions_world_m[0] for one in self.sent if isinstance(one, FingerPath)]
        solid = self.operator.controller.scenes.scene.object
        away = (tips[-1] - solid.world_from_object.position_m)[1:]
        return float(solid.geometry.radius_m - np.linalg.norm(away))  # type: ignore[union-attr]  # a cylinder

    def assert_agreement(self) -> None:
        intent = self.operator.controller.finger.intent
        assert self.touch._depth.value == pytest.approx(1e3 * intent.depth_m, abs=0.05)
        shown = self.touch._across.value, self.touch._up.value
        wanted = 1e3 * np.array(self.operator.controller.finger.position_m)
        assert shown == pytest.approx(wanted, abs=0.51)
        assert self.touch._lift.label == (LOWER if intent.lifted else LIFT)


@pytest.fixture
async def bench(tmp_path: Path) -> AsyncIterator[Bench]:
    (tmp_path / "plan.json").write_text(
        json.dumps({"scene": json.loads(load_cylinder().model_dump_json())})
    )
    sent: list[Message] = []
    server = start_server(0, "test")
    finger = FingerController(sent.append)
    facts = GraphFacts(
        recorders=("tape",), records_on_request=True, solvers=("body",), simulates_finger=True
    )
    controller = ConsoleController(sent.append, tmp_path / "plan.json", finger, facts)
    newest = LatestMessages(lambda topic, error: pytest.fail(str(error)))
    operator = Operator(server, newest, controller, pytest.fail, name="page", with_eye=False)
    bench = Bench(operator, sent)
    await bench.know_object()
    yield bench
    await controller.scenes.close()
    server.stop()


async def test_the_push_slider_means_what_it_shows(bench: Bench) -> None:
    bench.run(1.0)
    bench.assert_agreement()
    assert bench.touch._lift.label == LOWER
    for name, value in (("young_modulus_pa", 9e3), ("stretch_ratio", 1.04), ("size_ratio", 1.1)):
        bench.touch._depth.value = 18.0
        bench.operator.handle_request("push", 0.018)
        bench.run()
        assert bench.depth_m() == pytest.approx(0.018, abs=3e-4)
        await bench.change_scene(name, value)
        bench.touch._depth.value = 8.0
        bench.operator.handle_request("push", 0.008)
        bench.run()
        assert bench.depth_m() == pytest.approx(0.008, abs=3e-4)
        bench.assert_agreement()


async def test_lifted_the_finger_comes_down_where_the_sliders_are(bench: Bench) -> None:
    bench.operator.handle_request("touch", EYE, np.array([0.02, 0.01, 0.0]) - EYE)
    bench.run()
    bench.assert_agreement()
    assert bench.touch._across.value == 20.0
    bench.operator.handle_request("lift")
    bench.touch._across.value, bench.touch._up.value = -10.0, 0.0
    bench.operator.handle_request("place", -0.010, 0.0)
    bench.run()
    assert bench.depth_m() < -0.02
    bench.assert_agreement()
    bench.touch._depth.value = 6.0
    bench.operator.handle_request("push", 0.006)
    bench.run()
    assert bench.depth_m() == pytest.approx(0.006, abs=3e-4)
    assert bench.sent[-1].positions_world_m[0, 0] == pytest.approx(-0.010)  # type: ignore[attr-defined]  # a path
    bench.assert_agreement()


async def test_after_a_rejected_command_the_page_shows_what_holds(bench: Bench) -> None:
    bench.operator.handle_request("push", 0.006)
    bench.touch._depth.value = 30.0
    bench.operator.handle_request("push", float("nan"))
    bench.assert_agreement()
    assert bench.touch._depth.value == 6.0


async def test_the_record_button_starts_and_stops_the_recorder(bench: Bench) -> None:
    record = bench.operator._page.record
    bench.operator.handle_request("bookmark", "too early")
    assert "start recording first" in bench.operator._page._problem.content
    assert not bench.sent
    bench.operator.handle_request("record")
    bench.operator.handle_request("bookmark", "touch")
    assert bench.sent == [Recording(running=True), Bookmark(label="touch")]
    assert record._record.label == "Stop recording"
    bench.operator.handle_request("record")
    assert bench.sent[-1] == Recording(running=False)
    assert record._record.label == "Start recording"


def display(label: str) -> Display:
    return Display(correction="one_plane", stereo="anaglyph", label=label)


@pytest.mark.parametrize(("writer", "restored"), [("page", False), ("another", True)])
async def test_own_display_messages_are_known_by_their_writer(
    bench: Bench, writer: str, restored: bool
) -> None:
    """Labels do not identify messages: another writer can use the console's labels."""
    eye_view = bench.operator.controller.eye_view
    others = display("console 1")
    bench.operator.on_message(others, Header(1, 1, 1, "clock", writer, 1), 0.0)
    eye_view.enabled = True
    bench.run(0.5)
    assert eye_view.state is EyeViewState.DRAWING
    bench.run(2.0 * MAX_DRAWING_S)
    assert (bench.sent[-1] is others) == restored


async def test_notes_come_from_the_nodes_of_the_plan_with_any_names(bench: Bench) -> None:
    for name, note in (("tape", "recording to a.mcap"), ("body", "meshes, 3 s left")):
        bench.operator.on_message(
            status_of(name, notes=(Note(detail=note),)), Header(1, 1, 1, "clock", name, 1), 0.0
        )
    bench.run(0.5)
    assert "recording to a.mcap" in bench.operator._page.record._text.content
    assert "meshes, 3 s left" in bench.operator._page._state.content
