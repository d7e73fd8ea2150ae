"""Test the plan of a graph with a console."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from flexsheet.launch.plans.documents import BadInputError
from flexsheet.launch.plans.plan import load_graph
from flexsheet.nodes.console.graph_facts import GraphFacts
from tests.console_parts import ROOT

Floats = NDArray[np.float64]


@pytest.fixture
def graph(tmp_path: Path) -> Path:
    file = tmp_path / "graph.yaml"
    file.write_text(
        f"scene: {ROOT / 'launch/scenes/cylinder.yaml'}\n"
        "nodes:\n  twin_finger: {type: twin_finger}\n"
    )
    return file


def test_a_console_is_added_and_writes_the_scene(graph: Path) -> None:
    plan = load_graph(graph, console=True, settings=["console.page_port=8123"])
    assert [writer.name for writer in plan.writers["scene"]] == ["console"]
    assert plan.nodes["console"].nice > 0
    assert plan.nodes["console"].parameters["page_port"] == 8123
    assert plan.listening_nodes(None) == [("console", 8123)]
    assert plan.nodes["recorder"].parameters["start_paused"]
    read = {port.topic for port in plan.nodes["console"].inputs}
    assert {"status", "estop", "display"} <= read
    assert "arm_left" not in read, "which nobody writes here"
    assert "recording" in {port.topic for port in plan.nodes["recorder"].inputs}
    without = load_graph(graph)
    assert [writer.name for writer in without.writers["scene"]] == ["launch"]


def test_the_files_console_and_recorder_remain(graph: Path, tmp_path: Path) -> None:
    text = graph.read_text()
    graph.write_text(text + "  page: {type: console, parameters: {page_port: 9}}\n")
    plan = load_graph(graph, console=True, record=tmp_path / "a.mcap")
    assert "console" not in plan.nodes
    assert plan.nodes["page"].parameters["page_port"] == 9
    assert not plan.nodes["recorder"].parameters["start_paused"]
    graph.write_text(text.replace("twin_finger: {type: twin_finger}", "fem_solver: {type: x:Y}"))
    with pytest.raises(BadInputError):
        load_graph(graph, console=True)


def test_the_console_knows_whether_something_records(graph: Path, tmp_path: Path) -> None:
    def facts(**options: Any) -> GraphFacts:
        file = tmp_path / "plan.json"
        file.write_text(load_graph(graph, **options).model_dump_json())
        return GraphFacts.from_plan(file, "console")

    on_request = GraphFacts(recorders=("recorder",), records_on_request=True, simulates_finger=True)
    assert facts(console=True) == on_request
    always = facts(console=True, record=tmp_path / "a.mcap")
    assert always == replace(on_request, records_on_request=False)


def test_a_requested_image_has_the_priority_of_a_frame() -> None:
    """With a lower priority, the first eye view took 90 s on two busy cores."""
    nodes = load_graph(ROOT / "launch" / "demo.yaml", console=True).nodes
    assert nodes["twin_eye"].nice <= nodes["renderer"].nice


def test_only_the_nodes_that_the_arms_need_have_real_time_priority() -> None:
    """Without a graphics card, image and browser share the processor with the arms."""
    nodes = load_graph(ROOT / "launch" / "demo.yaml", console=True).nodes
    image = ("renderer", "fem_solver", "twin_eye", "console")
    assert {nodes[name].realtime_priority for name in image if name in nodes} == {None}
    assert nodes["planner"].realtime_priority == 10
