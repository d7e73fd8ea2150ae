"""Complete names in the shell; modules are imported only when they are needed.

If no name matches, the shell completes file names.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

import typer


def topics(incomplete: str) -> list[str]:
    """Complete topic names."""
    from flexsheet.messages.topics import TOPICS

    return _filter(TOPICS, incomplete)


def node_types(incomplete: str) -> list[str]:
    """Complete node types."""
    from flexsheet.nodes import NODES

    return _filter(NODES, incomplete)


def hosts(context: typer.Context, incomplete: str) -> list[str]:
    """Complete the hosts of the launch file on the command line."""
    from flexsheet.launch.plans.documents import BadInputError
    from flexsheet.launch.plans.plan import load_graph

    file = next((word for word in context.args if word.endswith((".yaml", ".yml"))), None)
    try:
        return [] if file is None else _filter(load_graph(Path(file)).hosts, incomplete)
    except BadInputError:
        return []


def tuned_families(incomplete: str) -> list[str]:
    """Complete the method families that `tune` can choose from."""
    from flexsheet.launch.methods.tune import TUNABLES

    return _filter((one.name for one in TUNABLES), incomplete)


def gestures(incomplete: str) -> list[str]:
    """Complete gestures, or else CSV files."""
    from flexsheet.launch.experiments.gestures import GESTURES

    return _filter(GESTURES, incomplete) or files(".csv")(incomplete)


def runs(incomplete: str) -> list[str]:
    """Complete the directories of running graphs."""
    from flexsheet.launch.running.runs import list_live_runs

    return _filter((str(run.directory) for run in list_live_runs()), incomplete)


def families(incomplete: str) -> list[str]:
    """Complete the method families that `chart` can measure."""
    from flexsheet.launch.methods.charts import FAMILIES

    return _filter([*FAMILIES, "system"], incomplete)


def files(*suffixes: str) -> Callable[[str], list[str]]:
    """Make a completion of files with these suffixes, and of the folders beside them."""

    def complete(incomplete: str) -> list[str]:
        folder, _, start = incomplete.rpartition("/")
        parent = Path(folder or ("/" if incomplete.startswith("/") else "."))
        prefix = incomplete[: len(incomplete) - len(start)]
        if not parent.is_dir():
            return []
        matches = sorted(entry for entry in parent.iterdir() if entry.name.startswith(start))
        found = [prefix + entry.name for entry in matches if entry.suffix in suffixes]
        # Without matching files, the shell's own completion of folders is better.
        folders = [f"{prefix}{entry.name}/" for entry in matches if found and entry.is_dir()]
        return found + folders

    return complete


bags = files(".mcap")
yaml_files = files(".yaml", ".yml")


def _filter(names: Iterable[str], incomplete: str) -> list[str]:
    return [name for name in names if name.startswith(incomplete)]
