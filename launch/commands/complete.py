"""Complete names on the command line in the user's shell.

If no name matches, the shell completes file names. Modules are imported only when they are needed,
because each completion is a separate process.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

import typer

from flexsheet.launch.plans.shipped import LAUNCH_FILES, SCENES, find_file, list_shipped


def topics(incomplete: str) -> list[str]:
    """Return the topic names that start with `incomplete`."""
    from flexsheet.messages.topics import TOPICS

    return _filter(TOPICS, incomplete)


def node_types(incomplete: str) -> list[str]:
    """Return the node types that start with `incomplete`."""
    from flexsheet.nodes import NODES

    return _filter(NODES, incomplete)


def hosts(context: typer.Context, incomplete: str) -> list[str]:
    """Return the host names that start with `incomplete`, from the launch file on the command
    line."""
    from flexsheet.launch.plans.documents import BadInputError
    from flexsheet.launch.plans.plan import load_graph

    found = (find_file(word, LAUNCH_FILES) for word in context.args)
    file = next((path for path in found if path.suffix in (".yaml", ".yml")), None)
    try:
        return [] if file is None else _filter(load_graph(file).hosts, incomplete)
    except BadInputError:
        return []


def tuned_families(incomplete: str) -> list[str]:
    """Return the names of method families of `flexsheet tune` that start with `incomplete`."""
    from flexsheet.launch.methods.tune import TUNABLES

    return _filter((one.name for one in TUNABLES), incomplete)


def gestures(incomplete: str) -> list[str]:
    """Return the gesture names that start with `incomplete`, or paths of CSV files if none
    matches."""
    from flexsheet.launch.experiments.gestures import GESTURES

    return _filter(GESTURES, incomplete) or files(".csv")(incomplete)


def runs(incomplete: str) -> list[str]:
    """Return the run directories of running graphs that start with `incomplete`."""
    from flexsheet.launch.running.runs import list_live_runs

    return _filter((str(run.directory) for run in list_live_runs()), incomplete)


def families(incomplete: str) -> list[str]:
    """Return the names of method families of `flexsheet chart` that start with `incomplete`."""
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
    """Return the names of shipped launch files and the paths of YAML files that match
    `incomplete`."""
    return _filter(list_shipped(LAUNCH_FILES), incomplete) + yaml_files(incomplete)


def scenes(incomplete: str) -> list[str]:
    """Return the names of shipped scenes and the paths of YAML files that match `incomplete`."""
    return _filter(list_shipped(SCENES), incomplete) + yaml_files(incomplete)


def nodes(incomplete: str) -> list[str]:
    """Return the names of running nodes and of node types that start with `incomplete`."""
    from flexsheet.launch.commands.graph import NoGraphError, running_graph

    try:
        running = list(running_graph(None)[0].nodes)
    except NoGraphError:
        running = []
    return list(dict.fromkeys([*_filter(running, incomplete), *node_types(incomplete)]))


def node_parameters(incomplete: str) -> list[str]:
    """Return the parameters of the running graph, as NODE.PARAMETER, that start with
    `incomplete`."""
    from flexsheet.launch.commands.graph import NoGraphError, running_graph

    try:
        plan, _ = running_graph(None)
    except NoGraphError:
        return []
    return _filter(
        (f"{node.name}.{name}" for node in plan.nodes.values() for name in node.parameters),
        incomplete,
    )


def _filter(names: Iterable[str], incomplete: str) -> list[str]:
    return [name for name in names if name.startswith(incomplete)]
