"""`flexsheet launch`: start a graph, keep it running, end it."""

from __future__ import annotations

import asyncio
import json
import signal
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from flexsheet.launch.commands import complete
from flexsheet.launch.commands.graph import JsonOption
from flexsheet.launch.commands.output import (
    FAILED,
    examples,
    print_json,
    print_json_line,
    print_table,
    words,
)
from flexsheet.nodes.signals import handle_signals

if TYPE_CHECKING:
    from flexsheet.launch.plans.planned import Plan, PlannedNode
    from flexsheet.launch.running.runs import Run
    from flexsheet.launch.running.supervisor import RunningGraph

app = typer.Typer(add_completion=False)

LEVEL_STYLES = {"warning": "yellow", "error": "red", "critical": "red"}


@app.command(
    epilog=examples(
        "flexsheet launch launch/demo.yaml",
        "flexsheet launch launch/demo.yaml --console --record session.mcap",
        "flexsheet launch lab.yaml --host arm_left",
        "flexsheet launch launch/demo.yaml --set planner.prediction_horizon_s=0.02 --dry-run",
    )
)
def launch(
    *,
    file: Annotated[Path, typer.Argument(help="Launch file.", autocompletion=complete.yaml_files)],
    host: Annotated[
        str | None,
        typer.Option(
            help="Start only this host's nodes; all of them without it.",
            autocompletion=complete.hosts,
        ),
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Check the file, print the plan, start nothing.")
    ] = False,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="NODE.PARAM=VALUE", help="Over what the file says."),
    ] = None,
    record: Annotated[
        Path | None, typer.Option(metavar="BAG", help="Record the logged topics to this bag.")
    ] = None,
    console: Annotated[
        bool, typer.Option("--console", help="With a page in the browser, and a recorder for it.")
    ] = False,
    duration: Annotated[
        float | None, typer.Option(metavar="SECONDS", help="Stop by itself, counted from ready.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Start the nodes of a launch file and keep them running until Ctrl-C.

    With --json the plan is printed, or once all nodes are ready one line about the run.

    Exit codes: 0 stopped as asked, 1 a node failed for good, 2 the input is wrong.
    """
    from flexsheet.launch.plans.plan import load_plan

    plan = load_plan(file, settings=settings or (), record=record, console=console)
    if dry_run:
        if as_json:
            print_json(plan.model_dump(mode="json"))
        else:
            _print_plan(plan, host)
        return

    def ready(run: Run) -> None:
        if as_json:
            print_json_line(about_run(plan, run, host))

    raise typer.Exit(asyncio.run(run_graph(plan, host, duration, when_ready=ready)))


def about_run(plan: Plan, run: Run, host: str | None) -> dict[str, Any]:
    """What a script wants to know of a graph that is ready."""
    nodes = [node.name for node in plan.nodes_on(host)]
    return {"run": str(run.directory), "plan": plan.hash, "nodes": nodes}


async def run_graph(
    plan: Plan,
    host: str | None,
    duration_s: float | None,
    *,
    when_ready: Callable[[Run], None] = lambda run: None,
) -> int:
    """Run the plan's nodes until a signal, or `duration_s` after they are ready; the exit code."""
    from flexsheet.launch.running.supervisor import RunningGraph

    asked_to_stop = asyncio.Event()
    graph = RunningGraph(plan, host=host, report=_say)

    def on_signal() -> None:
        if asked_to_stop.is_set():
            graph.hurry()
        asked_to_stop.set()

    with handle_signals(on_signal, *_ending_signals()):
        return await _run_until(graph, asked_to_stop, duration_s, when_ready)


def _ending_signals() -> list[int]:
    """The signals that end a graph; `nohup` ignores SIGHUP, and so it stays ignored."""
    hung_up = [] if signal.getsignal(signal.SIGHUP) == signal.SIG_IGN else [signal.SIGHUP]
    return [signal.SIGINT, signal.SIGTERM, *hung_up]


async def _run_until(
    graph: RunningGraph,
    asked_to_stop: asyncio.Event,
    duration_s: float | None,
    when_ready: Callable[[Run], None],
) -> int:
    """Run the graph until `asked_to_stop`, or `duration_s` after it is ready; the exit code."""
    from flexsheet.launch.running.notify import keep_telling, tell
    from flexsheet.launch.running.supervisor import NodeFailedError

    stop = asyncio.create_task(asked_to_stop.wait())
    turning = asyncio.create_task(keep_telling())
    try:
        async with graph:
            ready = asyncio.create_task(graph.wait_ready())
            end = asyncio.create_task(graph.wait())
            try:
                await asyncio.wait((ready, end, stop), return_when=asyncio.FIRST_COMPLETED)
                if ready.done():
                    ready.result()
                    tell("READY=1")
                    words.print(f"[green]all {len(graph.nodes)} nodes are ready[/]; Ctrl-C ends")
                    when_ready(graph.run)
                    await asyncio.wait(
                        (end, stop), timeout=duration_s, return_when=asyncio.FIRST_COMPLETED
                    )
                if end.done():
                    end.result()
            finally:
                tell("STOPPING=1")
                ready.cancel()
                end.cancel()
                await asyncio.gather(ready, end, return_exceptions=True)
    except NodeFailedError as error:
        words.print(f"[red]failed:[/] {error}", markup=True)
        return FAILED
    finally:
        stop.cancel()
        turning.cancel()
    words.print("stopped")
    return 0


def _say(node: str, line: str) -> None:
    """One line of a node's log for people: JSON from structlog is put into words."""
    style, text = "", line
    if line.startswith("{"):
        try:
            record = json.loads(line)
        except ValueError:
            record = None
        if isinstance(record, dict) and "event" in record:
            style = LEVEL_STYLES.get(str(record.pop("level", "")), "")
            record.pop("timestamp", None)
            record.pop("node", None)
            event = record.pop("event")
            trace = record.pop("exception", None)
            text = " ".join([str(event), *(f"{key}={value}" for key, value in record.items())])
            if trace:
                text += f"\n{trace}"
    words.print(f"{node:>16} | {text}", style=style, markup=False)


def _settings(node: PlannedNode) -> str:
    """The parameters that are not what they would be without the launch file."""
    from pydantic_core import to_jsonable_python

    from flexsheet.nodes import node_class
    from flexsheet.nodes.node import parameters_of

    fields = parameters_of(node_class(node.type)).model_fields
    # As they are written into a plan; a default that is made anew each time is no default here.
    defaults = {
        name: to_jsonable_python(field.default)
        for name, field in fields.items()
        if field.default_factory is None and not field.is_required()
    }
    return " ".join(
        f"{name}={value}"
        for name, value in node.parameters.items()
        if name not in defaults or value != defaults[name]
    )


def _print_plan(plan: Plan, host: str | None) -> None:
    words.print(f"plan {plan.hash} of {plan.launch_file}, scene {plan.scene_file or 'none'}")
    print_table(
        (
            "node",
            "type",
            "host",
            "restart",
            "parameters",
        ),
        [
            (
                node.name,
                node.type,
                f"{node.host} ({plan.hosts[node.host]})",
                node.restart.policy,
                _settings(node),
            )
            for node in plan.nodes_on(host)
        ],
    )
    words.print("parameters that are not shown: flexsheet node describe TYPE", style="dim")
    print()
    print_table(
        ("topic", "from", "endpoints", "to"),
        [
            (
                topic,
                writer.name,
                " ".join(writer.endpoints),
                " ".join(
                    node.name
                    for node in plan.nodes.values()
                    if any(port.topic == topic for port in node.inputs)
                ),
            )
            for topic, writers in plan.writers.items()
            for writer in writers
        ],
    )
