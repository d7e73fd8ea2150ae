"""Provide the nodes, each in its own folder.

In a folder, `node.py` connects the ports, and the other modules contain the computations. `NODES`
lists the node types that a launch file can name. A node class is imported only when it is used, so
that a process does not load the libraries of other nodes.
"""

from __future__ import annotations

from difflib import get_close_matches
from enum import StrEnum
from importlib import import_module
from typing import TYPE_CHECKING

from flexsheet.messages.errors import FlexsheetError

if TYPE_CHECKING:
    from flexsheet.nodes.node import Node


class NodeRole(StrEnum):
    """The role of a node in the graph, by which launcher, `flexsheet doctor` and replay select it.

    A node class declares its role as the attribute `role`. A class that publishes ArmState is an
    arm bridge by default.
    """

    ARM_BRIDGE = "arm_bridge"
    ARM_SIMULATOR = "arm_simulator"
    CAMERA = "camera"
    CLOCK = "clock"
    CONSOLE = "console"
    FINGER_SIMULATOR = "finger_simulator"
    RECORDER = "recorder"
    RENDERER = "renderer"


class OmissionReason(StrEnum):
    """The reason why a node of a launch file is not started.

    rigid_object: the scene's object has no material.
    no_image: the scene has no projector.
    no_reader: no node reads the node's topics.
    no_writer: the nodes that write the node's inputs are omitted.
    """

    RIGID_OBJECT = "rigid_object"
    NO_IMAGE = "no_image"
    NO_READER = "no_reader"
    NO_WRITER = "no_writer"


NODES: dict[str, str] = {
    "camera": "flexsheet.nodes.camera.node:Camera",
    "triangulator": "flexsheet.nodes.triangulator.node:Triangulator",
    "osc_input": "flexsheet.nodes.triangulator.osc_node:OscInput",
    "head_camera": "flexsheet.nodes.camera.head_node:HeadCamera",
    "planner": "flexsheet.nodes.planner.node:Planner",
    "arm_bridge": "flexsheet.nodes.arm_bridge.node:ArmBridge",
    "fem_solver": "flexsheet.nodes.fem_solver.node:FemSolver",
    "renderer": "flexsheet.nodes.renderer.node:Renderer",
    "gauge": "flexsheet.nodes.gauge.node:Gauge",
    "clock": "flexsheet.nodes.clock.node:ClockNode",
    "recorder": "flexsheet.nodes.recorder.node:Recorder",
    "console": "flexsheet.nodes.console.node:Console",
    "twin_finger": "flexsheet.nodes.twin.finger_node:TwinFingerNode",
    "twin_arms": "flexsheet.nodes.twin.arms_node:TwinArmsNode",
    "twin_gauge": "flexsheet.nodes.twin.gauge_node:TwinGauge",
    "twin_eye": "flexsheet.nodes.twin.eye_node:TwinEyeNode",
}


class UnknownNodeError(FlexsheetError, KeyError):
    """Raised if a node type is not in `NODES`. The text suggests a similar type."""

    code = "unknown-node"
    remedy = "`flexsheet node types` prints all names."


class NodeImportError(FlexsheetError, ImportError):
    """Raised if a node class "module:Class" cannot be imported.

    advice: text that states how to correct this error.
    """

    code = "node-import"
    remedy = (
        "Write PYTHONPATH=FOLDER before the command, where FOLDER contains the module of the node, "
        "or install its package. Commands that evaluate a graph or a bag need its nodes, too."
    )

    def __init__(self, name: str, problem: str, advice: str) -> None:
        super().__init__(f'"{name}" cannot be imported: {problem}; {advice}')
        self.problem, self.advice = problem, advice


def node_class(name: str) -> type[Node]:
    """Import and return the class of a node type, which is a name in `NODES` or "module:Class".

    The package name may be missing, as in "nodes.planner.node:Planner" in old launch files and
    bags. Raises UnknownNodeError if the name is unknown, and NodeImportError if the module or the
    class is missing or invalid.
    """
    path = NODES.get(name, name)
    module_name, _, class_name = path.partition(":")
    if class_name and not all(map(str.isidentifier, (*module_name.split("."), class_name))):
        raise UnknownNodeError(f'invalid node type "{name}": expected "package.module:Class"')
    if module_name.startswith("nodes."):
        module_name = f"{__package__}.{module_name.removeprefix('nodes.')}"
    if not class_name:
        near = get_close_matches(name, NODES, n=1)
        hint = f'; did you mean "{near[0]}"?' if near else f"; known nodes: {', '.join(NODES)}"
        hint += '; name a node of your own as "module:Class"'
        raise UnknownNodeError(f'unknown node type "{name}"{hint}')
    try:
        # The module is known only at run time, so the type of the class is not.
        return getattr(import_module(module_name), class_name)  # type: ignore[no-any-return]
    except (ImportError, AttributeError, SyntaxError) as error:
        advice = _describe_import_advice(module_name, class_name, error)
        raise NodeImportError(name, str(error), advice) from error


def _describe_import_advice(module: str, class_name: str, error: Exception) -> str:
    if isinstance(error, ModuleNotFoundError) and error.name:
        if module == error.name or module.startswith(f"{error.name}."):
            return (
                "write PYTHONPATH=FOLDER before the command, where FOLDER contains "
                f"{module.replace('.', '/')}.py, or install the package"
            )
        return f"install the module {error.name}: pip install {error.name.partition('.')[0]}"
    if isinstance(error, AttributeError):
        return f"define the class {class_name} in {module}, or correct its name"
    return f"correct the module {module}"
