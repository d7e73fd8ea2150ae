"""Test the roles of nodes, which depend on class declarations and ports, not on type names."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from flexsheet.launch.plans.plan import load_graph
from flexsheet.launch.plans.plan_model import ResolvedGraph
from flexsheet.launch.running.host import find_recording_folder, list_arms
from flexsheet.messages.types import ArmState
from flexsheet.nodes import NODES, NodeRole, node_class
from flexsheet.nodes.node import Node, NodeParameters, Output, find_role
from flexsheet.nodes.recorder.node import Recorder


class OwnBridge(Node):
    """Bridge of another class, with other parameters."""

    parameters: NodeParameters
    arm: Output[ArmState]


class OwnRecorder(Recorder):
    """Recorder of another class."""


def plan_with(folder: Path, bridge: dict[str, object], **more: object) -> ResolvedGraph:
    path = folder / "graph.yaml"
    nodes = {"bridge": {"topics": {"arm": "arm_left"}, **bridge}, **more}
    path.write_text(json.dumps({"nodes": nodes}))
    return load_graph(path)


@pytest.mark.parametrize(
    "bridge",
    [
        {"type": f"{__name__}:OwnBridge"},
        {
            "type": "flexsheet.nodes.arm_bridge.node:ArmBridge",
            "topics": {"arm": "arm_left", "other_arm": None, "scene": None, "sheet_target": None},
            "parameters": {"side": "left", "host": "127.0.0.1", "port": 5020},
        },
    ],
    ids=["own class", "module:Class"],
)
def test_a_bridge_keeps_its_estop_file_whatever_its_type_is_called(
    tmp_path: Path, bridge: dict[str, object]
) -> None:
    plan = plan_with(tmp_path, bridge)
    assert plan.nodes["bridge"].role is NodeRole.ARM_BRIDGE
    assert plan.nodes["bridge"].arm_side == "left"
    assert len(list_arms(plan)) == 1


def test_arms_of_different_bridges_do_not_share_an_estop_file(tmp_path: Path) -> None:
    own = {"type": f"{__name__}:OwnBridge"}
    plan = plan_with(tmp_path, own, second={**own, "topics": {"arm": "arm_right"}})
    assert len(set(list_arms(plan))) == 2


def test_a_recorder_of_another_class_is_one(tmp_path: Path) -> None:
    own = {"type": f"{__name__}:OwnBridge"}
    bag = tmp_path / "a.mcap"
    recorder = {"type": f"{__name__}:OwnRecorder", "parameters": {"bag": str(bag)}}
    plan = plan_with(tmp_path, own, recorder=recorder)
    assert find_recording_folder(plan.nodes_on(None)) == tmp_path


def test_the_shipped_nodes_have_their_roles() -> None:
    roles = {name: find_role(node_class(name)) for name in NODES}
    assert {name: role for name, role in roles.items() if role is not None} == {
        "arm_bridge": NodeRole.ARM_BRIDGE,
        "camera": NodeRole.CAMERA,
        "clock": NodeRole.CLOCK,
        "console": NodeRole.CONSOLE,
        "recorder": NodeRole.RECORDER,
        "renderer": NodeRole.RENDERER,
        "twin_arms": NodeRole.ARM_SIMULATOR,
        "twin_finger": NodeRole.FINGER_SIMULATOR,
    }
