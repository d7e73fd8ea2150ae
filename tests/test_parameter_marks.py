"""Test marks of parameters: devices, device addresses and calibration files."""

from __future__ import annotations

import json
from pathlib import Path
from typing import ClassVar

import pytest

from flexsheet.launch.plans.documents import BadInputError
from flexsheet.launch.plans.plan import load_graph
from flexsheet.launch.plans.plan_model import ResolvedGraph
from flexsheet.messages.types import ArmState
from flexsheet.nodes.camera.sources import OpenCvSource
from flexsheet.nodes.node import Node, NodeParameters, Output
from flexsheet.nodes.parameter_marks import (
    CameraCalibrationFile,
    DeviceFile,
    DeviceHost,
    DevicePort,
    ParameterMark,
    find_marked,
)


class OwnParameters(NodeParameters):
    controller: DeviceHost = "192.0.2.2"
    controller_port: DevicePort = 502
    serial: DeviceFile | None = "/dev/no-such-tty"
    label: str = "/dev/null is only a text here"
    calibration: str = "not a file"
    optics: CameraCalibrationFile | None = None
    sources: tuple[OpenCvSource, ...] = ()


class OwnBridge(Node):
    """An arm bridge with different parameter names."""

    parameters: OwnParameters
    arm: Output[ArmState]
    opens_devices: ClassVar[bool] = True


def graph_with(folder: Path, host: str = "left", **parameters: object) -> ResolvedGraph:
    path = folder / "graph.yaml"
    bridge = {
        "type": f"{__name__}:OwnBridge",
        "host": host,
        "topics": {"arm": "arm_left"},
        "parameters": parameters,
    }
    hosts = {"main": {"address": "192.0.2.1"}, "left": {"address": "192.0.2.2"}}
    path.write_text(json.dumps({"hosts": hosts, "nodes": {"bridge": bridge}}))
    return load_graph(path)


def test_marks_are_found_in_nested_models_and_unions() -> None:
    sources = (
        OpenCvSource(kind="live", left="/dev/video0", right="rtsp://192.0.2.9/left"),
        OpenCvSource(kind="live", left=0),
    )
    found = find_marked(OwnParameters(sources=sources), ParameterMark.DEVICE_FILE)
    assert found == {
        ("serial",): "/dev/no-such-tty",
        ("sources", 0, "left"): "/dev/video0",
        ("sources", 0, "right"): "rtsp://192.0.2.9/left",
    }
    assert find_marked(OwnParameters(serial=None), ParameterMark.DEVICE_FILE) == {}


def test_device_files_are_those_of_marked_parameters(tmp_path: Path) -> None:
    camera = {"kind": "live", "left": "/dev/video0", "right": "rtsp://192.0.2.9/left"}
    node = graph_with(tmp_path, sources=[camera]).nodes["bridge"]
    assert node.device_files == ("/dev/no-such-tty", "/dev/video0")


def test_a_bridge_is_addressed_by_its_marked_parameters(tmp_path: Path) -> None:
    assert graph_with(tmp_path).nodes["bridge"].device_address == "192.0.2.2:502"


def test_an_own_bridge_may_not_reach_its_arm_across_the_network(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match=r'controller: 192.0.2.2 is the address of host "left"'):
        graph_with(tmp_path, host="main")


def test_a_marked_calibration_file_is_read_when_the_graph_is_loaded(tmp_path: Path) -> None:
    with pytest.raises(BadInputError) as caught:
        graph_with(tmp_path, optics="missing.yaml")
    (problem,) = caught.value.problems
    assert problem.key == ("nodes", "bridge", "parameters", "optics")
    assert str(tmp_path / "missing.yaml") in problem.what
