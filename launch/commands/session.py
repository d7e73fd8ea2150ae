"""`flexsheet status`, `logs` and `stop`: inspect and stop graphs."""

from __future__ import annotations

import os
import signal
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from flexsheet.launch.commands import options
from flexsheet.launch.commands.arms import describe_arms
from flexsheet.launch.commands.graph import (
    NoGraphError,
    SeveralGraphsError,
    describe_launch,
    receive_until,
    run_interruptible,
    running_graph,
)
from flexsheet.launch.commands.launching import format_log_line, format_log_time
from flexsheet.launch.commands.output import (
    FAILED,
    CommandError,
    examples,
    print_json,
    print_rows,
    words,
)

if TYPE_CHECKING:
    from flexsheet.launch.plans.plan_model import ResolvedGraph, ResolvedNode
    from flexsheet.launch.running.runs import Run
    from flexsheet.messages.types import ArmState, HostStatus, Status

status_app, logs_app, stop_app = (options.make_app() for _ in range(3))

ARM_TOPICS = frozenset({"arm_left", "arm_right"})

STATUS_TIMEOUT_S = 3.0
"""The maximum time to wait for the statuses of all nodes, in seconds.

Each node publishes its status once a second.
"""

STOP_TIMEOUT_S = 20.0
POLL_PERIOD_S = 0.05


@status_app.command(epilog=examples("flexsheet status", "flexsheet status --json"))
def status(run: options.RunOption = None, as_json: options.JsonOption = False) -> None:
    """Show the arms and nodes of the running graph, with message rates, lost messages and notes.

    If messages were skipped or lost, a line under the table names nodes and topics, and explains
    whether this matters.

    The command also prints the problems that the self-checks of the nodes suspect. The exit code is
    1 if a problem is suspected, or if a node does not report its status. If several graphs are
    running, the command prints their number, and which one it shows.
    """
    from flexsheet.launch.running.runs import list_live_runs

    plan, found = running_graph(run)
    live = list_live_runs()
    statuses: dict[str, Status] = {}
    hosts: dict[str, HostStatus] = {}
    arms: dict[str, ArmState] = {}
    arm_topics = plan.writers.keys() & ARM_TOPICS
    handlers: dict[str, Callable[[Any], None]] = {
        "status": lambda message: statuses.update({message.node: message}),
        "host": lambda message: hosts.update({message.host: message}),
        **dict.fromkeys(arm_topics, lambda message: arms.update({message.side: message})),
    }

    def complete() -> bool:
        return (
            plan.nodes.keys() <= statuses.keys()
            and plan.hosts.keys() <= hosts.keys()
            and len(arms) == len(arm_topics)
        )

    run_interruptible(receive_until(plan, found, handlers, complete, STATUS_TIMEOUT_S))
    notes = {
        str(node.arm_side): statuses[node.name].note_text
        for node in plan.nodes.values()
        if node.arm_side and node.name in statuses
    }
    arm_rows = describe_arms(arms, notes) if arm_topics else []
    rows = [describe_node(node, statuses.get(node.name)) for node in plan.nodes.values()]
    suspicions = _list_suspicions(statuses)
    estops = {name: one.estop for name, one in hosts.items() if one.estop is not None}
    if as_json:
        print_json(
            {
                "run": str(found.directory),
                "launch_file": plan.launch_file,
                "plan": plan.hash,
                "running": [str(one.directory) for one in live],
                "arms": arm_rows,
                "nodes": rows,
                "self_checks": suspicions,
                "estop": estops,
            }
        )
    else:
        _print_shown(plan, found, live)
        explanations = explain_counts(rows)
        for row in rows:
            row["publishes"] = [
                describe_output(one) for one in row["outputs"] if one["topic"] != "status"
            ]
            for name in ("inputs", "outputs", "errors"):
                del row[name]
            row["note"] = row.pop("note")  # the longest column is the last one
        if arm_rows:
            print_rows(arm_rows, as_json=False)
            print()
        print_rows(rows, as_json=False)
        for line in explanations:
            words.print(line)
        for host, reason in estops.items():
            words.print(f"e-stop on {host}: {reason}", style="red")
        for one in suspicions:
            if one["suspected"]:
                words.print(f"{one['node']}: {one['text']}", style="yellow")
                words.print(f"  remedy: {one['remedy']}")
    silent = [name for name in plan.nodes if name not in statuses]
    if silent or any(one["suspected"] for one in suspicions):
        raise typer.Exit(FAILED)


def _print_shown(plan: ResolvedGraph, shown: Run, live: Sequence[Run]) -> None:
    """Print which graph is shown, and which other graphs are running.

    live: all running graphs.
    """
    text = f"{plan.launch_file}, run {shown.directory}"
    others = [one for one in live if one.directory != shown.directory]
    if not others or len(others) == len(live):
        words.print(text)
        return
    words.print(f"{len(live)} graphs are running; this is {text}")
    for one in others:
        words.print(f"to show {describe_launch(one)}: flexsheet status --run {one.directory}")


def describe_node(node: ResolvedNode, status: Status | None) -> dict[str, Any]:
    """Return a table row with the status of a node.

    If the status is unknown, the values of the row are None.
    """
    row: dict[str, Any] = {"node": node.name, "host": node.host}
    if status is None:
        unknown = dict.fromkeys(("cpu", "memory_mb", "skipped", "lost"))
        return {
            **row, "state": "silent", **unknown,
            "inputs": [], "outputs": [], "errors": None, "note": "",
        }  # fmt: skip
    return row | {
        "state": status.state,
        "cpu": round(status.cpu_ratio, 3),
        "memory_mb": round(status.resident_bytes / 1e6),
        "skipped": sum(port.dropped for port in status.inputs),
        "lost": sum(port.gaps + port.rejected for port in status.inputs),
        "inputs": [port.model_dump() for port in status.inputs],
        "outputs": [port.model_dump() for port in status.outputs if port.messages],
        "errors": status.errors,
        "note": status.last_error if status.state == "degraded" else status.note_text,
    }


COUNT_TEXTS = {
    "superseded": "skipped: {counts}. A newer message replaced each before the node read it, and "
    "the node needs only the newest. This is normal: a node with a lower rate than a topic always "
    "skips some. If sheet or image are late, `flexsheet doctor`, row `load`, shows whether the "
    "computer is too slow.",
    "overflowed": "skipped: {counts}. The node needed these messages, but was too slow to read "
    "them. Reduce the load of the computer: see `flexsheet doctor`, row `load`.",
    "lost": "lost: {counts}. These messages were lost in transit, or were not valid. This must "
    "not happen: `flexsheet logs {node}` shows the reason.",
}
"""The explanations of message counts.

The placeholders are the counts of all nodes, and the first of these nodes.
"""


def explain_counts(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return an explanation of each nonzero message count in the table of `flexsheet status`."""
    from flexsheet.messages.topics import Delivery, find_topic

    counts: dict[str, dict[str, dict[str, int]]] = {name: {} for name in COUNT_TEXTS}
    for row in rows:
        for port in row["inputs"]:
            topic, missing = port["topic"], port["gaps"] + port["rejected"]
            every = find_topic(topic).delivery is Delivery.EVERY
            if row["skipped"] and port["dropped"]:
                skipped = counts["overflowed" if every else "superseded"]
                skipped.setdefault(row["node"], {})[topic] = port["dropped"]
            if row["lost"] and missing:
                counts["lost"].setdefault(row["node"], {})[topic] = missing
    return [
        COUNT_TEXTS[name].format(
            counts=", ".join(f"{node} {_describe_counts(one)}" for node, one in nodes.items()),
            node=next(iter(nodes)),
        )
        for name, nodes in counts.items()
        if nodes
    ]


def _describe_counts(counts: Mapping[str, int]) -> str:
    """Return a text with the largest count, its topic, and the sum of the other counts."""
    most = max(counts, key=lambda topic: counts[topic])
    others = sum(counts.values()) - counts[most]
    more = f" and {others} of other topics" if others else ""
    return f"{counts[most]} of {most}{more}"


def describe_output(port: dict[str, Any]) -> str:
    """Describe an output port by its topic and, if the topic is periodic, by its message rate.

    port: statistics of the port in a node's status.
    """
    from flexsheet.messages.topics import find_topic

    topic = find_topic(port["topic"])
    if topic.rate_hz is None or port["messages"] < 2:
        return topic.name
    return f"{topic.name} {port['rate_hz']:.0f} Hz"


def _list_suspicions(statuses: dict[str, Status]) -> list[dict[str, Any]]:
    from flexsheet.messages.notes import SELF_CHECK_REMEDIES, describe_self_check

    return [
        {
            "node": name,
            **check.model_dump(),
            "text": describe_self_check(check),
            "remedy": SELF_CHECK_REMEDIES[check.cause],
        }
        for name, status in statuses.items()
        for check in status.self_checks
    ]


@logs_app.command(
    epilog=examples("flexsheet logs planner", "flexsheet logs arm_left_bridge --follow -n 20")
)
def logs(
    node: Annotated[
        str | None,
        typer.Argument(help="Name of a node of the graph; without it, the nodes are listed."),
    ] = None,
    lines: Annotated[
        int | None, typer.Option("-n", "--lines", min=0, help="Print the last N lines only.")
    ] = None,
    follow: Annotated[
        bool, typer.Option("-f", "--follow", help="Continue to print new lines until Ctrl-C.")
    ] = False,
    run: options.RunOption = None,
    as_json: options.JsonOption = False,
) -> None:
    """Print the log of a node of the running graph with local times, or list the nodes.

    If no graph is running, the log is taken from the newest run.
    """
    from flexsheet.launch.plans.documents import did_you_mean

    found = _newest_run(run)
    known = sorted(one.stem for one in found.logs.glob("*.log"))
    if node is None:
        print_rows([{"node": name} for name in known], as_json=as_json)
        words.print("to print the log of a node: flexsheet logs NODE")
        return
    file = found.logs / f"{node}.log"
    if not file.is_file():
        raise CommandError(
            f'"{node}": {found.logs} contains no log of this node; {did_you_mean(node, known)}'
        )

    def show(line: str) -> None:
        text = line if as_json else f"{format_log_time(line)} {format_log_line(line)[1]}".lstrip()
        print(text, flush=True)

    with file.open(encoding="utf-8", errors="replace") as text:
        for line in deque(text, maxlen=lines):
            show(line.rstrip("\n"))
        if text.tell() == 0:
            words.print(f"the log of {node} has no entries")
        if follow:
            for line in _further_lines(text, found):
                show(line)


def _newest_run(directory: Path | None) -> Run:
    """Return the run in a directory.

    If `directory` is None, return the newest running graph. If no graph is running, return the
    newest run.
    """
    from flexsheet.launch.running.runs import Run, list_live_runs, list_runs

    if directory is not None:
        return Run(directory.resolve().name, directory.resolve())
    runs = list_live_runs() or list_runs()
    if not runs:
        raise NoGraphError(
            "no logs of a graph were found on this computer; start one: flexsheet launch FILE"
        )
    return runs[0]


def _further_lines(text: Any, run: Run) -> Iterator[str]:
    """Yield the lines that are added to an open log file until the run ends."""
    part = ""
    while True:
        alive = run.is_alive()
        part += text.read()
        *whole, part = part.split("\n")
        yield from whole
        if not alive:
            return
        # A file has no event for added lines that Python can await portably.
        time.sleep(POLL_PERIOD_S)


@stop_app.command(epilog=examples("flexsheet stop", "flexsheet stop --all"))
def stop(
    run: options.ChangedRunOption = None,
    stop_all: Annotated[
        bool, typer.Option("--all", help="Stop all graphs of this user on this computer.")
    ] = False,
    as_json: options.JsonOption = False,
) -> None:
    """Stop the running graph in the same way as Ctrl-C in its terminal.

    The exit code is 1 if the graph does not end. In an emergency, use the hard-wired emergency
    stop, and then `flexsheet arms stop`.
    """
    from flexsheet.launch.running.runs import list_live_runs

    live = list_live_runs()
    chosen = [one for one in live if run is None or one.directory == run.resolve()]
    if not chosen:
        raise NoGraphError("no graph is running on this computer, so there is nothing to stop")
    if len(chosen) > 1 and not stop_all:
        raise SeveralGraphsError(chosen)
    for each in chosen:
        os.kill(int(each.id.partition(".")[0]), signal.SIGTERM)
    end_s = time.monotonic() + STOP_TIMEOUT_S
    while any(one.is_alive() for one in chosen) and time.monotonic() < end_s:
        # The launchers are not children of this process, so their end cannot be awaited.
        time.sleep(POLL_PERIOD_S)
    rows = [{"run": str(one.directory), "stopped": not one.is_alive()} for one in chosen]
    print_rows(rows, as_json=as_json)
    if not all(row["stopped"] for row in rows):
        raise typer.Exit(FAILED)
