"""`flexsheet launch`: start a graph, supervise it, and stop it."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import webbrowser
from collections.abc import Callable, Collection
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from flexsheet.launch.commands import options
from flexsheet.launch.commands.graph import find_node, list_readers
from flexsheet.launch.commands.output import (
    FAILED,
    examples,
    print_json,
    print_json_line,
    print_table,
    progress_words,
    words,
)
from flexsheet.nodes import NodeRole, node_class
from flexsheet.nodes.signals import handle_signals, keyboard_interrupts

if TYPE_CHECKING:
    from flexsheet.launch.plans.plan_model import ResolvedGraph, ResolvedNode
    from flexsheet.launch.running.runs import Run
    from flexsheet.launch.running.supervisor import RunningGraph

app = options.make_app()

LEVEL_STYLES = {"warning": "yellow", "error": "red", "critical": "red"}


@app.command(
    epilog=examples(
        "flexsheet launch demo --browser",
        "flexsheet launch launch/demo.yaml --console --record session.mcap",
        "flexsheet launch demo --scene organ",
        "flexsheet launch launch/lab.yaml --host left",
        "flexsheet launch demo --set planner.prediction_horizon_s=0.02 --dry-run",
    )
)
def launch(
    *,
    launch_file: options.LaunchArgument,
    scene: options.OtherSceneOption = None,
    host: Annotated[
        str | None,
        typer.Option(
            metavar="HOST",
            help="Start only the nodes of this host; default: the nodes of all hosts.",
        ),
    ] = None,
    dry_run: Annotated[
        bool,
        typer.Option(
            "-p",
            "--dry-run",
            help="Check the launch file and print the resolved graph without starting it.",
        ),
    ] = False,
    settings: options.SettingsOption = None,
    apparatus: options.ApparatusOption = None,
    without: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NODE",
            help="Node to omit; repeat the option for several nodes.",
        ),
    ] = None,
    record: Annotated[
        Path | None,
        typer.Option(
            metavar="BAG",
            help="Bag file to which the topics that are marked as logged are recorded.",
        ),
    ] = None,
    console: Annotated[
        bool, typer.Option("--console", help="Add a browser console and a recorder to the graph.")
    ] = False,
    browser: Annotated[
        bool, typer.Option("--browser", help="Like --console, and open its page in the browser.")
    ] = False,
    duration: options.DurationOption = None,
    as_json: options.JsonOption = False,
) -> None:
    """Start the nodes of a launch file and supervise them until Ctrl-C.

    If --json is given, the command prints one line about the run when all nodes are ready. If
    --dry-run is also given, it prints the resolved graph instead.

    The exit code is 0 if the graph was stopped on request, 1 if a node failed, and 2 if the input
    is invalid.
    """
    from flexsheet.launch.plans.plan import load_graph

    plan = load_graph(
        launch_file,
        settings=options.with_scene(settings, scene),
        record=record,
        console=console or browser,
        apparatus=apparatus,
    )
    for name in without or ():
        find_node(plan, name)
    if dry_run:
        if as_json:
            print_json(plan.model_dump(mode="json"))
        else:
            _print_plan(plan, host, without or ())
        return

    def ready(run: Run) -> None:
        if as_json:
            nodes = [node.name for node in plan.nodes_on(host)]
            omitted = {one.name: one.reason for one in plan.omitted if host in (None, one.host)}
            print_json_line(
                {"run": str(run.directory), "plan": plan.hash, "nodes": nodes, "omitted": omitted}
            )
        for node in plan.nodes_on(host):
            # The launcher does not know a free port that the console chooses (0).
            if (
                node.role is NodeRole.CONSOLE
                and node.parameters["page_port"]
                and node.name not in (without or ())
            ):
                words.print(f"console: {page_url(node)}")
                if browser and (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
                    webbrowser.open(page_url(node))

    precompute_tables(plan, host)
    work = run_graph(plan, host, duration, without=without or (), when_ready=ready)
    raise typer.Exit(asyncio.run(work))


def precompute_tables(plan: ResolvedGraph, host: str | None) -> None:
    """Compute the tables that the nodes of a host need, and print the progress; None: all hosts."""
    from flexsheet.launch.running.precompute import precompute_graph

    with keyboard_interrupts(), progress_words() as progress:
        precompute_graph(plan, progress, host=host)


def page_url(console: ResolvedNode) -> str:
    """Return the URL of a console's page. The console node must have a fixed port."""
    return f"http://127.0.0.1:{console.parameters['page_port']}/"


def print_omitted(plan: ResolvedGraph, host: str | None) -> None:
    """Print the omitted nodes of a graph, and the reason for each omission.

    host: host whose nodes are printed. If it is None, the nodes of all hosts are printed.
    """
    from flexsheet.launch.plans.needed_nodes import REASON_TEXTS

    for one in plan.omitted:
        if host in (None, one.host):
            words.print(f"not started: {one.name}; {REASON_TEXTS[one.reason]}")


async def run_graph(
    plan: ResolvedGraph,
    host: str | None,
    duration_s: float | None,
    *,
    without: Collection[str] = (),
    when_ready: Callable[[Run], None] = lambda run: None,
) -> int:
    """Run a graph until a signal arrives, and return the exit code.

    If a second signal arrives, the function logs the nodes that have not exited. If a third signal
    arrives, it kills these nodes.

    duration_s: maximum time after all nodes are ready. If it is None, the time is not limited.
    without: names of nodes that are not started.
    when_ready: function that is called when all nodes are ready.
    """
    from flexsheet.launch.running.supervisor import RunningGraph

    stop_requested = asyncio.Event()
    graph = RunningGraph(plan, host=host, without=without, report=_print_log_line)

    signals = 0

    def on_signal() -> None:
        nonlocal signals
        signals += 1
        stop_requested.set()
        if signals == 2:
            graph.warn_of_running_nodes()
        elif signals > 2:
            graph.kill_all()

    handled = [signal.SIGINT, signal.SIGTERM]
    if signal.getsignal(signal.SIGHUP) != signal.SIG_IGN:
        handled.append(signal.SIGHUP)
    with handle_signals(on_signal, *handled):
        return await _run_until(graph, stop_requested, duration_s, when_ready)


async def _run_until(
    graph: RunningGraph,
    stop_requested: asyncio.Event,
    duration_s: float | None,
    when_ready: Callable[[Run], None],
) -> int:
    """Run a graph until a stop is requested or the duration has passed; return the exit code."""
    from flexsheet.launch.running.supervisor import NodeFailedError
    from flexsheet.launch.running.systemd import beat_watchdog, notify_systemd

    stop = asyncio.create_task(stop_requested.wait())
    watchdog = asyncio.create_task(beat_watchdog())
    try:
        async with graph:
            ready = asyncio.create_task(graph.wait_ready())
            end = asyncio.create_task(graph.wait())
            try:
                await asyncio.wait((ready, end, stop), return_when=asyncio.FIRST_COMPLETED)
                if ready.done():
                    ready.result()
                    notify_systemd("READY=1")
                    words.print(
                        f"[green]all {len(graph.nodes)} nodes are ready[/]; press Ctrl-C to stop",
                        markup=True,
                    )
                    when_ready(graph.run)
                    await asyncio.wait(
                        (end, stop), timeout=duration_s, return_when=asyncio.FIRST_COMPLETED
                    )
                if end.done():
                    end.result()
            finally:
                notify_systemd("STOPPING=1")
                ready.cancel()
                end.cancel()
                await asyncio.gather(ready, end, return_exceptions=True)
    except NodeFailedError as error:
        words.print(f"[red]failed:[/] {error}", markup=True)
        return FAILED
    finally:
        stop.cancel()
        watchdog.cancel()
    words.print("stopped")
    return 0


def _print_log_line(node: str, line: str) -> None:
    style, text = format_log_line(line)
    words.print(f"{node:>16} | {text}", style=style)


def format_log_line(line: str) -> tuple[str, str]:
    """Return the colour style and the readable text of a log line.

    If the line is a JSON record, the text consists of its event, other fields and stack trace.
    """
    try:
        record = json.loads(line)
    except ValueError:
        return "", line
    if not isinstance(record, dict) or "event" not in record:
        return "", line
    style = LEVEL_STYLES.get(str(record.pop("level", "")), "")
    event, trace = record.pop("event"), record.pop("exception", None)
    fields = (
        f" {key}={value}" for key, value in record.items() if key not in ("timestamp", "node")
    )
    return style, f"{event}{''.join(fields)}" + (f"\n{trace}" if trace else "")


def format_log_time(line: str) -> str:
    """Return the local time of a log line, or "" if the line has no time.

    The date is included if it is not today.
    """
    try:
        written = datetime.fromisoformat(json.loads(line)["timestamp"]).astimezone()
    except (ValueError, KeyError, TypeError):
        return ""
    is_today = written.date() == datetime.now().astimezone().date()
    shown = written.time() if is_today else written.replace(tzinfo=None)
    return shown.isoformat(timespec="milliseconds")


def _format_settings(node: ResolvedNode) -> str:
    """Return "name=value" for each parameter of a node that differs from its default."""
    from pydantic_core import to_jsonable_python

    from flexsheet.nodes.node import find_parameters_type

    fields = find_parameters_type(node_class(node.type)).model_fields
    # Defaults are converted to JSON types like the values in plans. A default factory has no fixed
    # value to compare with.
    defaults = {
        name: to_jsonable_python(field.default)
        for name, field in fields.items()
        if field.default_factory is None and not field.is_required()
    }
    return " ".join(
        f"{name}={value}"
        for name, value in node.parameters.items()
        if name != "apparatus" and (name not in defaults or value != defaults[name])
    )


def _print_plan(plan: ResolvedGraph, host: str | None, without: Collection[str]) -> None:
    """Print the nodes and the topics of a graph, and the graph as a Mermaid flowchart.

    without: names of nodes that are not listed, because the launcher does not start them.
    """
    from flexsheet.launch.plans.drawing import mermaid

    words.print(f"plan {plan.hash} of {plan.launch_file}, scene {plan.scene_file or 'none'}")
    if plan.apparatus is not None:
        words.print(
            f"apparatus (true parameters of the simulated hardware): {plan.apparatus['origin']}"
        )
    print_table(
        ("node", "type", "host", "process", "restart", "parameters"),
        [
            (
                node.name,
                node.type,
                f"{node.host} ({plan.hosts[node.host]})",
                node.process,
                node.restart.policy,
                _format_settings(node),
            )
            for node in plan.nodes_on(host)
            if node.name not in without
        ],
    )
    print_omitted(plan, host)
    words.print("to list default parameter values: flexsheet node info TYPE", style="dim")
    print()
    print_table(
        ("topic", "from", "endpoints", "to"),
        [
            (
                topic,
                writer.name,
                " ".join(writer.endpoints),
                " ".join(list_readers(plan, topic)),
            )
            for topic, writers in plan.writers.items()
            for writer in writers
        ],
    )
    print(f"\n{mermaid(plan)}", end="")
