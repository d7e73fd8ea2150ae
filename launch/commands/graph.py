"""Find the running graph, and run a command's event loop until it is interrupted."""

from __future__ import annotations

import asyncio
import signal
from collections.abc import Coroutine
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from flexsheet.launch.commands import complete
from flexsheet.launch.commands.output import BAD_INPUT, CommandError
from flexsheet.nodes.signals import handle_signals

if TYPE_CHECKING:
    from flexsheet.launch.plans.plan_model import ResolvedGraph
    from flexsheet.launch.running.runs import Run

RunOption = Annotated[
    Path | None,
    typer.Option(
        "--run",
        help="Directory of the run; default: the newest running graph.",
        autocompletion=complete.runs,
    ),
]
ApparatusOption = Annotated[
    str | None,
    typer.Option(
        "--apparatus",
        metavar="FILE|seed:N",
        help="True parameters of the simulation: a file, or a draw such as "
        "seed:7,paper,calibrated; default: the scene.",
    ),
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]


class NoGraphError(CommandError):
    """No graph is running on this computer."""

    code = "no-graph"
    remedy = "Start a graph with `flexsheet launch FILE`, or name the directory of its run (--run)."


def running_graph(directory: Path | None) -> tuple[ResolvedGraph, Run]:
    """Return the graph and run of `directory`, default: of the newest running launcher.

    Raises CommandError for a directory without a plan, NoGraphError if no graph is running.
    """
    from flexsheet.launch.plans.plan_model import ResolvedGraph
    from flexsheet.launch.running.runs import Run, list_live_runs

    if directory is not None:
        run = Run(directory.resolve().name, directory.resolve())
        if not run.plan_file.is_file():
            raise CommandError(
                f"--run {directory}: does not contain plan.json; name the directory of a run",
                BAD_INPUT,
            )
    else:
        ready = [run for run in list_live_runs() if run.plan_file.is_file()]
        if not ready:
            raise NoGraphError("no graph is running; start one with: flexsheet launch FILE")
        run = ready[0]
    return ResolvedGraph.model_validate_json(run.plan_file.read_text()), run


def run_interruptible(work: Coroutine[Any, Any, int]) -> int:
    """Run `work` in an event loop; SIGINT and SIGTERM cancel it and return 0."""

    async def guarded() -> int:
        task = asyncio.ensure_future(work)
        with handle_signals(task.cancel, signal.SIGINT, signal.SIGTERM):
            try:
                return await task
            except asyncio.CancelledError:
                return 0

    return asyncio.run(guarded())
