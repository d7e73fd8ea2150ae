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
    """The role of a node in the graph.

    The launcher, `flexsheet doctor` and the replay of bags use the role to find nodes, for example
    the recorder. A node class declares its role as the attribute `role`. A class that publishes
    ArmState is an arm bridge by default.
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
    "planner": "flexsheet.nodes.planner.node:Planner",
    "arm_bridge": "flexsheet.nodes.arm_bridge.node:ArmBridge",
    "fem_solver": "flexsheet.nodes.fem_solver.node:FemSolver",
    "renderer": "flexsheet.nodes.renderer.node:Renderer",
    "clock": "flexsheet.nodes.clock.node:ClockNode",
    "recorder": "flexsheet.nodes.recorder.node:Recorder",
    "console": "flexsheet.nodes.console.node:Console",
    "twin_finger": "flexsheet.nodes.twin.finger_node:TwinFingerNode",
    "twin_arms": "flexsheet.nodes.twin.arms_node:TwinArmsNode",
    "twin_eye": "flexsheet.nodes.twin.eye_node:TwinEyeNode",
}


class UnknownNodeError(FlexsheetError, KeyError):
    """Raised if a node type is not in `NODES`. The text suggests a similar type."""


class NodeImportError(FlexsheetError, ImportError):
    """Raised if a node class "module:Class" cannot be imported."""


def node_class(name: str) -> type[Node]:
    """Import and return the class of a node type, which is a name in `NODES` or "module:Class".

    Raises UnknownNodeError if the name is unknown, and NodeImportError if the module or the
    class is missing or invalid.
    """
    path = NODES.get(name, name)
    module_name, _, class_name = path.partition(":")
    if class_name and not all(map(str.isidentifier, (*module_name.split("."), class_name))):
        raise UnknownNodeError(f'invalid node type "{name}": expected "package.module:Class"')
    if not class_name:
        near = get_close_matches(name, NODES, n=1)
        hint = f'; did you mean "{near[0]}"?' if near else f"; known nodes: {', '.join(NODES)}"
        hint += '; name a node of your own as "module:Class"'
        raise UnknownNodeError(f'unknown node type "{name}"{hint}')
    try:
        module = import_module(module_name)
    except (Exception, SystemExit) as error:  # the module can raise anything
        raise NodeImportError(
            f'"{name}" cannot be imported: {type(error).__name__}: {error}; write '
            "PYTHONPATH=FOLDER before the command, where FOLDER contains the module, or correct "
            f'the module: python -c "import {module_name}" prints the traceback'
        ) from error
    try:
        # The module is known only at run time, so the type of the class is not.
        return getattr(module, class_name)  # type: ignore[no-any-return]
    except AttributeError as error:
        raise NodeImportError(
            f'"{name}" cannot be imported: {error}; define the class {class_name} in '
            f"{module_name}, or correct its name"
        ) from error
