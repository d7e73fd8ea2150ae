"""Build, run, record and evaluate node graphs of an encountered-type visual-haptic display.

A name is imported on first use, because importing all names takes long. The message types are in
`flexsheet.messages.types`, and the types of scenes are in `flexsheet.messages.scene`.
"""

from __future__ import annotations

# Importing `typing` would lengthen the time in which an interrupt meets Python's own handler.
TYPE_CHECKING = False
if TYPE_CHECKING:
    from flexsheet.launch.bags.arrays import read_arrays
    from flexsheet.launch.commands.graph import running_graph
    from flexsheet.launch.experiments import ExperimentError
    from flexsheet.launch.experiments.driver import Driver
    from flexsheet.launch.experiments.run import run_experiment
    from flexsheet.launch.plans.documents import BadInputError
    from flexsheet.launch.plans.plan import load_graph, load_scene
    from flexsheet.launch.plans.plan_model import ResolvedGraph
    from flexsheet.launch.running.supervisor import NodeFailedError, RunningGraph
    from flexsheet.launch.running.tools import GraphWriter, read_topic
    from flexsheet.messages.bag import BagError, BagReader, BagWriter, recover
    from flexsheet.messages.base import Header, Message
    from flexsheet.messages.clock import SystemClock, VirtualClock
    from flexsheet.messages.scene import Scene
    from flexsheet.messages.topics import TOPICS, find_topic
    from flexsheet.nodes.node import Input, Node, NodeParameters, Output, periodic

_EXPORTS = {
    "flexsheet.launch.bags.arrays": ("read_arrays",),
    "flexsheet.launch.commands.graph": ("running_graph",),
    "flexsheet.launch.experiments": ("ExperimentError",),
    "flexsheet.launch.experiments.driver": ("Driver",),
    "flexsheet.launch.experiments.run": ("run_experiment",),
    "flexsheet.launch.plans.documents": ("BadInputError",),
    "flexsheet.launch.plans.plan": ("load_graph", "load_scene"),
    "flexsheet.launch.plans.plan_model": ("ResolvedGraph",),
    "flexsheet.launch.running.supervisor": ("NodeFailedError", "RunningGraph"),
    "flexsheet.launch.running.tools": ("GraphWriter", "read_topic"),
    "flexsheet.messages.bag": ("BagError", "BagReader", "BagWriter", "recover"),
    "flexsheet.messages.base": ("Header", "Message"),
    "flexsheet.messages.clock": ("SystemClock", "VirtualClock"),
    "flexsheet.messages.scene": ("Scene",),
    "flexsheet.messages.topics": ("TOPICS", "find_topic"),
    "flexsheet.nodes.node": ("Input", "Node", "NodeParameters", "Output", "periodic"),
}
_MODULES = {name: module for module, names in _EXPORTS.items() for name in names}

__all__ = [
    "TOPICS",
    "BadInputError",
    "BagError",
    "BagReader",
    "BagWriter",
    "Driver",
    "ExperimentError",
    "GraphWriter",
    "Header",
    "Input",
    "Message",
    "Node",
    "NodeFailedError",
    "NodeParameters",
    "Output",
    "ResolvedGraph",
    "RunningGraph",
    "Scene",
    "SystemClock",
    "VirtualClock",
    "find_topic",
    "load_graph",
    "load_scene",
    "periodic",
    "read_arrays",
    "read_topic",
    "recover",
    "run_experiment",
    "running_graph",
]


def __getattr__(name: str) -> object:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    value: object = getattr(import_module(_MODULES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
