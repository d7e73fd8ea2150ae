"""Provide the nodes, each in its own folder.

In a folder, `node.py` connects the ports, and the other modules contain the computations. `NODES`
lists the node types that a launch file can name. A node class is imported only when it is used, so
that a process does not load the libraries of other nodes.
"""

from __future__ import annotations

import os
from difflib import get_close_matches
from enum import StrEnum
from importlib import import_module
from pathlib import Path
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
    """Raised if a node class "module:Class" cannot be imported.

    advice: text that states how to correct this error.
    """

    def __init__(self, name: str, problem: str, advice: str) -> None:
        super().__init__(f'"{name}" cannot be imported: {problem}; {advice}')
        self.problem, self.advice = problem, advice


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
        problem, advice = _describe_import_error(module_name, error)
        raise NodeImportError(name, problem, advice) from error
    try:
        # The module is known only at run time, so the type of the class is not.
        return getattr(module, class_name)  # type: ignore[no-any-return]
    except AttributeError as error:
        advice = f"define the class {class_name} in {module_name}, or correct its name"
        raise NodeImportError(name, str(error), advice) from error


def _describe_import_error(module: str, error: BaseException) -> tuple[str, str]:
    """Return the text of an error during an import, and an instruction to correct the error."""
    missing = error.name if isinstance(error, ModuleNotFoundError) else None
    if missing and (module == missing or module.startswith(f"{missing}.")):
        return str(error), (
            "write PYTHONPATH=FOLDER before the command, where FOLDER contains "
            f"{module.replace('.', '/')}.py, or install the package"
        )
    text = error.msg if isinstance(error, SyntaxError) else str(error)
    problem = f"{_locate_error(module, error)}: {type(error).__name__}: {text}"
    if missing:
        return problem, f"install the module {missing}: pip install {missing.partition('.')[0]}"
    return problem, f"correct the module {module}"


def _locate_error(module: str, error: BaseException) -> str:
    """Return "file:line" of an error during the import of a module, or the name of the module.

    If a library raises the error, the result is the line of the module that calls the library.
    """
    import traceback  # imported here, because it is slow and only needed after an error
    from sysconfig import get_paths

    if isinstance(error, SyntaxError) and error.filename:
        return f"{error.filename}:{error.lineno}"
    kinds = ("stdlib", "platstdlib", "purelib", "platlib")
    folders = (*map(get_paths().get, kinds), Path(__file__).parents[1])
    libraries = tuple(f"{folder}{os.sep}" for folder in folders)
    # The first two frames are `node_class` and `import_module`.
    frames = [
        frame
        for frame in traceback.extract_tb(error.__traceback__)[2:]
        if not frame.filename.startswith("<")
    ]
    own = [frame for frame in frames if not frame.filename.startswith(libraries)]
    if not frames:
        return module
    last = (own or frames)[-1]
    return f"{last.filename}:{last.lineno}"
