"""What the shell offers at TAB where a name is wanted; what is needed is imported only then.

Where nothing fits the shell offers files.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

import typer


def topics(incomplete: str) -> list[str]:
    from flexsheet.messages.topics import TOPICS

    return _fitting(TOPICS, incomplete)


def node_types(incomplete: str) -> list[str]:
    from flexsheet.nodes import NODES

    return _fitting(NODES, incomplete)


def hosts(context: typer.Context, incomplete: str) -> list[str]:
    """Hosts of the launch file that is named already."""
    from flexsheet.launch.plans.documents import BadInputError
    from flexsheet.launch.plans.plan import load_graph

    file = next((word for word in context.args if word.endswith((".yaml", ".yml"))), None)
    try:
        return [] if file is None else _fitting(load_graph(Path(file)).hosts, incomplete)
    except BadInputError:
        return []


def tuned_families(incomplete: str) -> list[str]:
    from flexsheet.launch.methods.tune import TUNABLES

    return _fitting((one.name for one in TUNABLES), incomplete)


def gestures(incomplete: str) -> list[str]:
    from flexsheet.launch.experiments.gestures import GESTURES

    return _fitting(GESTURES, incomplete) or files(".csv")(incomplete)


def runs(incomplete: str) -> list[str]:
    """Directories of the graphs that run."""
    from flexsheet.launch.running.runs import live_runs

    return _fitting((str(run.directory) for run in live_runs()), incomplete)


def families(incomplete: str) -> list[str]:
    from flexsheet.launch.methods.charts import FAMILIES

    return _fitting(FAMILIES, incomplete)


def files(*suffixes: str) -> Callable[[str], list[str]]:
    """Files of these suffixes and the folders on the way to them."""

    def complete(incomplete: str) -> list[str]:
        folder, _, start = incomplete.rpartition("/")
        place = Path(folder or ("/" if incomplete.startswith("/") else "."))
        prefix = incomplete[: len(incomplete) - len(start)]
        if not place.is_dir():
            return []
        near = sorted(entry for entry in place.iterdir() if entry.name.startswith(start))
        found = [prefix + entry.name for entry in near if entry.suffix in suffixes]
        # Of folders alone the shell itself knows better how to go on within them.
        folders = [f"{prefix}{entry.name}/" for entry in near if found and entry.is_dir()]
        return found + folders

    return complete


bags = files(".mcap")
yaml_files = files(".yaml", ".yml")


def _fitting(names: Iterable[str], incomplete: str) -> list[str]:
    return [name for name in names if name.startswith(incomplete)]
