"""Test the structure of the project: imports follow the layers, and no package uses private
names."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
LAYERS = ("messages", "nodes", "launch")
SHARED_MODULES = {
    "flexsheet.nodes",
    "flexsheet.nodes.arrays",
    "flexsheet.nodes.background",
    "flexsheet.nodes.cache",
    "flexsheet.nodes.methods",
    "flexsheet.nodes.models",
    "flexsheet.nodes.node",
    "flexsheet.nodes.parameter_marks",
    "flexsheet.nodes.worker_processes",
}
TWIN_MAY_SHARE = {"flexsheet.nodes.models.rigid", "flexsheet.nodes.models.shapes"}


def modules(layer: str) -> Iterator[Path]:
    return (ROOT / layer).rglob("*.py")


@cache
def imports_of(path: Path) -> set[str]:
    """Return the dotted names of all imports in a file, including those inside functions."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            names.add(node.module)
            names.update(f"{node.module}.{alias.name}" for alias in node.names)
    return names


def layer_of(name: str) -> str:
    """Return the top-level package of a module of the project; otherwise the first part of the
    name.
    """
    return name.removeprefix("flexsheet.").split(".", maxsplit=1)[0]


@pytest.mark.parametrize("layer", LAYERS)
def test_imports_go_down_only(layer: str) -> None:
    above = LAYERS[LAYERS.index(layer) + 1 :]
    for path in modules(layer):
        upward = {name for name in imports_of(path) if layer_of(name) in above}
        assert not upward, f"{path.relative_to(ROOT)} imports {upward}"


def test_no_node_imports_another_node() -> None:
    for path in modules("nodes"):
        parts = path.relative_to(ROOT).parts
        if len(parts) < 3 or parts[1] == "models":
            continue
        own = f"flexsheet.nodes.{parts[1]}"
        foreign = {
            name
            for name in imports_of(path)
            if name.startswith("flexsheet.nodes.")
            and name not in ("flexsheet.nodes.NodeRole", "flexsheet.nodes.OmissionReason")
            and not any(
                name == room or name.startswith(f"{room}.")
                for room in {own, *SHARED_MODULES} - {"flexsheet.nodes"}
            )
        }
        assert not foreign, f"{path.relative_to(ROOT)} imports {foreign}"


def test_models_know_neither_messages_nor_sockets_nor_files() -> None:
    forbidden = {"messages", "zmq", "asyncio", "time", "pathlib", "os", "structlog"}
    for path in modules("nodes/models"):
        names = {
            name
            for name in imports_of(path)
            if not name.startswith("flexsheet.messages.errors")  # the base class of errors
        }
        found = {layer_of(name) for name in names} & forbidden
        assert not found, f"{path.relative_to(ROOT)} imports {found}"


def test_the_simulator_shares_nothing_with_the_code_it_evaluates() -> None:
    for path in modules("nodes/twin"):
        shared = {
            name
            for name in imports_of(path)
            if name.startswith("flexsheet.nodes.models")
            and not any(name == room or name.startswith(f"{room}.") for room in TWIN_MAY_SHARE)
        }
        assert not shared, f"{path.relative_to(ROOT)} imports {shared}"


def test_no_unfinished_marks() -> None:
    marks = ("TO" + "DO", "FIX" + "ME", "XX" + "X", "HA" + "CK")
    for layer in (*LAYERS, "tests", "benchmarks"):
        for path in modules(layer):
            words = path.read_text().replace("(", " ").replace(":", " ").split()
            found = [mark for mark in marks if mark in words]
            assert not found, f"{path.relative_to(ROOT)}: {found}"
