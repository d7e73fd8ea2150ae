"""Complete names on the command line in the user's shell.

Modules are imported only when they are needed, because each completion is a separate process.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from flexsheet.launch.plans.shipped import LAUNCH_FILES, SCENES, find_file, list_shipped

if TYPE_CHECKING:
    from flexsheet.launch.plans.plan_model import ResolvedNode


def _keys_of(module: str, name: str) -> Callable[[str], list[str]]:
    """Return a function that completes the keys of the dictionary `name` in a module."""

    def complete(incomplete: str) -> list[str]:
        return _filter(getattr(import_module(module), name), incomplete)

    return complete


topics = _keys_of("flexsheet.messages.topics", "TOPICS")
node_types = _keys_of("flexsheet.nodes", "NODES")


def hosts(context: typer.Context, incomplete: str) -> list[str]:
    """Return the hosts of the launch file on the command line that match the typed text."""
    from flexsheet.launch.plans.documents import BadInputError
    from flexsheet.launch.plans.plan import load_graph

    found = (find_file(word, LAUNCH_FILES) for word in context.args)
    file = next((path for path in found if path.suffix in (".yaml", ".yml")), None)
    try:
        return [] if file is None else _filter(load_graph(file).hosts, incomplete)
    except BadInputError:
        return []


def tuned_families(incomplete: str) -> list[str]:
    """Return the method families of `flexsheet tune` that match the typed text."""
    from flexsheet.launch.methods.tune import TUNABLES

    return _filter((one.name for one in TUNABLES), incomplete)


def gestures(incomplete: str) -> list[str]:
    """Return the gestures that match the typed text, or matching CSV files if there are none."""
    from flexsheet.launch.experiments.gestures import GESTURES

    return _filter(GESTURES, incomplete) or files(".csv")(incomplete)


def runs(incomplete: str) -> list[str]:
    """Return the run directories of running graphs that match the typed text."""
    from flexsheet.launch.running.runs import list_live_runs

    return _filter((str(run.directory) for run in list_live_runs()), incomplete)


def families(incomplete: str) -> list[str]:
    """Return the method families of `flexsheet chart` that match the typed text."""
    from flexsheet.launch.methods.charts import FAMILIES

    return _filter([*FAMILIES, "system"], incomplete)


def files(*suffixes: str) -> Callable[[str], list[str]]:
    """Return a function that completes paths of folders and of files with the given suffixes."""

    def complete(incomplete: str) -> list[str]:
        folder, _, start = incomplete.rpartition("/")
        parent = Path(folder or ("/" if incomplete.startswith("/") else "."))
        prefix = incomplete[: len(incomplete) - len(start)]
        if not parent.is_dir():
            return []
        matches = sorted(entry for entry in parent.iterdir() if entry.name.startswith(start))
        found = [prefix + entry.name for entry in matches if entry.suffix in suffixes]
        # Without matching files, return nothing, so that the shell completes folders by itself.
        folders = [f"{prefix}{entry.name}/" for entry in matches if found and entry.is_dir()]
        return found + folders

    return complete


bags = files(".mcap")
yaml_files = files(".yaml", ".yml")


def launch_files(incomplete: str) -> list[str]:
    """Return the shipped launch files and the paths of YAML files that match the typed text."""
    return _filter(list_shipped(LAUNCH_FILES), incomplete) + yaml_files(incomplete)


def scenes(incomplete: str) -> list[str]:
    """Return the shipped scenes and the paths of YAML files that match the typed text."""
    return _filter(list_shipped(SCENES), incomplete) + yaml_files(incomplete)


def nodes(incomplete: str) -> list[str]:
    """Return the names of running nodes and of node types that match the typed text."""
    running = [node.name for node in _running_nodes()]
    return list(dict.fromkeys([*_filter(running, incomplete), *node_types(incomplete)]))


def node_parameters(incomplete: str) -> list[str]:
    """Return the parameters (NODE.PARAMETER) of the running graph that match the typed text."""
    found = (f"{node.name}.{name}" for node in _running_nodes() for name in node.parameters)
    return _filter(found, incomplete)


def _running_nodes() -> list[ResolvedNode]:
    from flexsheet.launch.commands.graph import NoGraphError, running_graph

    try:
        return list(running_graph(None)[0].nodes.values())
    except NoGraphError:
        return []


def _filter(names: Iterable[str], incomplete: str) -> list[str]:
    return [name for name in names if name.startswith(incomplete)]
