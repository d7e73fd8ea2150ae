"""Find the running graph, receive its messages, and run the event loop of a command."""

from __future__ import annotations

import asyncio
import signal
from collections.abc import Callable, Coroutine, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from flexsheet.launch.commands.output import BAD_INPUT, FAILED, CommandError, words
from flexsheet.nodes.signals import handle_signals

if TYPE_CHECKING:
    from flexsheet.launch.plans.plan_model import ResolvedGraph, ResolvedNode
    from flexsheet.launch.running.runs import Run
    from flexsheet.messages.bus import Subscriber
    from flexsheet.nodes.runner import NodeConfig


class NoGraphError(CommandError):
    """Raised if no graph is running on this computer."""

    def __init__(self, text: str) -> None:
        super().__init__(text, FAILED)


class SeveralGraphsError(CommandError):
    """Raised if several graphs are running, and a command does not state which one it changes."""

    def __init__(self, runs: Sequence[Run]) -> None:
        choices = "".join(f"\n  --run {one.directory} ({describe_launch(one)})" for one in runs)
        super().__init__(
            f"{len(runs)} graphs are running, so --run is required; choose one:{choices}", BAD_INPUT
        )


def describe_launch(run: Run) -> str:
    """Return the launch file of a run, or "starting" if the run has no plan yet.

    If the run contains the nodes of one host, the host is added.
    """
    host = "" if run.host is None else f", host {run.host}"
    return f"{run.launch_file or 'starting'}{host}"


def choose_run(directory: Path | None) -> Path | None:
    """Return the run directory of the graph that a command changes, or None if no graph is running.

    directory: value of the option --run.

    Raises SeveralGraphsError if `directory` is None and several graphs of this user are running.
    """
    from flexsheet.launch.running.runs import list_live_runs

    if directory is not None:
        return directory
    live = list_live_runs()
    if len(live) > 1:
        raise SeveralGraphsError(live)
    return None


class ConnectedGraph(NamedTuple):
    """A graph that another process runs: its resolved graph, and its run."""

    plan: ResolvedGraph
    run: Run


def running_graph(directory: Path | None = None) -> ConnectedGraph:
    """Return the resolved graph and the run that belong to a run directory.

    If `directory` is None, the newest running graph is used. Raises CommandError if the directory
    contains no plan, and NoGraphError if no graph is running.
    """
    from flexsheet.launch.plans.plan_model import ResolvedGraph
    from flexsheet.launch.running.runs import Run, list_live_runs

    if directory is not None:
        run = Run(directory.resolve().name, directory.resolve())
        if not run.plan_file.is_file():
            raise CommandError(
                f"--run {directory}: the folder does not contain plan.json; name a run directory"
            )
    else:
        live = list_live_runs()
        ready = [run for run in live if run.plan_file.is_file()]
        if live and not ready:
            raise NoGraphError("the graph is starting; repeat the command in a few seconds")
        if not ready:
            raise NoGraphError("no graph is running; start one with: flexsheet launch FILE")
        run = ready[0]
    return ConnectedGraph(ResolvedGraph.model_validate_json(run.plan_file.read_text()), run)


def find_node(plan: ResolvedGraph, name: str) -> ResolvedNode:
    """Return a node of a graph; raise CommandError if the graph has no such node."""
    from flexsheet.launch.plans.documents import did_you_mean

    if name not in plan.nodes:
        raise CommandError(
            f'"{name}": unknown node of {plan.launch_file}; {did_you_mean(name, list(plan.nodes))}'
        )
    return plan.nodes[name]


def list_readers(plan: ResolvedGraph, topic: str) -> list[str]:
    """Return the names of the nodes that read a topic."""
    return [
        node.name
        for node in plan.nodes.values()
        if any(port.topic == topic and port.endpoints for port in node.inputs)
    ]


@contextmanager
def receiving(subscribers: Sequence[Subscriber]) -> Iterator[None]:
    """Receive messages with the given subscribers until the context ends.

    An event loop must be running.
    """
    try:
        for each in subscribers:
            each.start()
        yield
    finally:
        for each in subscribers:
            each.close()


async def run_node_here(config: NodeConfig, duration_s: float | None) -> None:
    """Run a node in this process until the task is cancelled or the duration has passed."""
    from flexsheet.nodes.runner import run_node

    stop = asyncio.Event()
    work = asyncio.create_task(run_node(config, stop))
    try:
        await asyncio.wait((work,), timeout=duration_s)
    finally:
        # Also after an interruption, wait until the node has ended.
        stop.set()
        await work


async def receive_until(
    plan: ResolvedGraph,
    run: Run,
    handlers: Mapping[str, Callable[[Any], None]],
    done: Callable[[], bool],
    timeout_s: float,
) -> bool:
    """Pass received messages to handlers until `done` returns True; return False on a timeout.

    handlers: for each topic name, the function that receives the messages of the topic.
    """
    from flexsheet.launch.running.tools import make_subscriber

    satisfied = asyncio.Event()

    def make_handler(handle: Callable[[Any], None]) -> Callable[[Any, Any], None]:
        def receive(message: Any, _: Any) -> None:
            handle(message)
            if done():
                satisfied.set()

        return receive

    subscribers = [
        make_subscriber(topic, plan, run, make_handler(handle), on_problem=words.print)
        for topic, handle in handlers.items()
    ]
    with receiving(subscribers):
        try:
            async with asyncio.timeout(timeout_s):
                await satisfied.wait()
        except TimeoutError:
            return False
    return True


def run_interruptible(work: Coroutine[Any, Any, int]) -> int:
    """Run a coroutine and return its exit code; return 0 if SIGINT or SIGTERM cancels it."""

    async def guarded() -> int:
        task = asyncio.ensure_future(work)
        with handle_signals(task.cancel, signal.SIGINT, signal.SIGTERM):
            try:
                return await task
            except asyncio.CancelledError:
                return 0

    return asyncio.run(guarded())
