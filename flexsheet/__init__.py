"""Build, run, record and evaluate node graphs of an encountered-type visual-haptic display.

Names are imported on first use, so that `import flexsheet` stays fast.  The message types are in
`flexsheet.messages.types`, the scene's in `flexsheet.messages.scene`.
"""

from __future__ import annotations

# Importing `typing` would lengthen the time in which an interrupt meets Python's own handler.
TYPE_CHECKING = False
if TYPE_CHECKING:
    from launch.experiments import ExperimentError
    from launch.experiments.driver import Driver
    from launch.experiments.run import run_experiment
    from launch.plans.documents import BadInputError
    from launch.plans.plan import load_plan, load_scene
    from launch.plans.planned import Plan
    from launch.running.supervisor import NodeFailedError, RunningGraph
    from launch.running.tools import ToolsWriter, read_topic
    from messages.bag import BagError, BagReader, BagWriter, recover
    from messages.base import Header, Message
    from messages.clock import SystemClock, VirtualClock
    from messages.scene import Scene
    from messages.topics import TOPICS, topic_named
    from nodes.node import Input, Node, NodeParameters, Output, periodic

_MODULES = {
    "BadInputError": "launch.plans.documents",
    "BagError": "messages.bag",
    "BagReader": "messages.bag",
    "BagWriter": "messages.bag",
    "Driver": "launch.experiments.driver",
    "ExperimentError": "launch.experiments",
    "ToolsWriter": "launch.running.tools",
    "Header": "messages.base",
    "Input": "nodes.node",
    "Message": "messages.base",
    "Node": "nodes.node",
    "NodeFailedError": "launch.running.supervisor",
    "NodeParameters": "nodes.node",
    "Output": "nodes.node",
    "Plan": "launch.plans.planned",
    "RunningGraph": "launch.running.supervisor",
    "Scene": "messages.scene",
    "SystemClock": "messages.clock",
    "TOPICS": "messages.topics",
    "VirtualClock": "messages.clock",
    "load_plan": "launch.plans.plan",
    "load_scene": "launch.plans.plan",
    "periodic": "nodes.node",
    "read_topic": "launch.running.tools",
    "recover": "messages.bag",
    "run_experiment": "launch.experiments.run",
    "topic_named": "messages.topics",
}

__all__ = list(_MODULES)


def __getattr__(name: str) -> object:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    value: object = getattr(import_module(_MODULES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
