"""Run an experiment: start the graph with a recorder, run a procedure, and stop the graph.

A graph is the set of nodes (processes) and topics that a launch file describes. A procedure is a
coroutine that controls the running graph by a `Driver`.
"""

from __future__ import annotations

import asyncio
import os
import shlex
import signal
import time
from collections.abc import Awaitable, Callable, Collection, Coroutine, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from flexsheet.launch.experiments import ExperimentError, ExperimentInterruptedError, image
from flexsheet.launch.experiments.driver import Driver
from flexsheet.launch.plans.plan import load_graph
from flexsheet.launch.plans.plan_model import ResolvedGraph
from flexsheet.launch.running.precompute import precompute_graph
from flexsheet.launch.running.supervisor import NodeFailedError, RunningGraph
from flexsheet.messages.bag import FLUSH_PERIOD_S, BagReader
from flexsheet.messages.scene import Scene
from flexsheet.messages.topics import TOPICS
from flexsheet.messages.types import Correction, Display, FingerPath, Shading, TwinFinger
from flexsheet.nodes.signals import handle_signals

DEMO_FILE = Path(__file__).resolve().parent.parent / "demo.yaml"
RUNS = Path("runs")
DELIVERY_S = 0.3
RECORD_WAIT_S = 60.0
"""The maximum time to wait for an experiment in the bag while the recorder writes nothing."""

SWITCH_SEED, SWITCH_INTERVAL_S = 1, (0.25, 0.4)
"""The random seed and the range (s) of the times between two switches of the projected image.

The times exceed the latency, and vary the phase between switches and exposures.
"""

Progress = Callable[[str], None]
Procedure = Callable[[Driver, Scene], Awaitable[None]]
Result = TypeVar("Result")


def new_folder(name: str) -> Path:
    """Create and return a new folder for an experiment, such as runs/20261121-164500-stroke."""
    folder = RUNS / f"{datetime.now(UTC):%Y%m%d-%H%M%S}-{name}"
    folder.mkdir(parents=True)
    return folder


def require_scene(plan: ResolvedGraph) -> Scene:
    """Return the scene of a resolved graph; raise ExperimentError if the graph has no scene."""
    scene = plan.scene_message()
    if scene is None:
        raise ExperimentError(
            f'{plan.launch_file}: missing key "scene", which an experiment requires; add the key'
        )
    return scene


async def drive(plan: ResolvedGraph, procedure: Procedure, progress: Progress) -> None:
    """Start a graph, run an experiment's procedure (coroutine) on it, and stop the graph.

    Raises the errors of the procedure, and NodeFailedError if a node fails permanently.
    """
    scene = require_scene(plan)
    async with RunningGraph(plan) as graph:
        progress("starting the nodes")
        await graph.wait_ready()
        driver = Driver(plan, graph.run, lambda: graph.pids, graph.publish_scene)
        async with driver:
            await _run_while_graph_runs(graph, _run_procedure(driver, scene, procedure, progress))


async def _run_procedure(
    driver: Driver, scene: Scene, procedure: Procedure, progress: Progress
) -> None:
    progress("waiting for the soft body and the arms")
    await driver.wait_ready()
    await procedure(driver, scene)
    # Wait until messages caused by the last action have arrived at the recorder.
    await asyncio.sleep(DELIVERY_S)


async def _run_while_graph_runs(graph: RunningGraph, work: Coroutine[Any, Any, None]) -> None:
    """Await `work` while the graph runs; if the graph ends first, raise the reason as an error."""
    task = asyncio.create_task(work)
    end = asyncio.create_task(graph.wait())
    try:
        await asyncio.wait((task, end), return_when=asyncio.FIRST_COMPLETED)
        if not task.done():
            end.result()
            raise ExperimentError(
                f"the nodes exited before the experiment ended; see the logs in {graph.run.logs}"
            )
        task.result()
    finally:
        for each in (task, end):
            each.cancel()
        await asyncio.gather(task, end, return_exceptions=True)


def run_experiment(
    launch_file: Path,
    settings: Sequence[str],
    bag: Path | None,
    procedure: Procedure,
    progress: Progress,
    *,
    apparatus: str | None = None,
    needed: Collection[str] = (),
    check_scene: Callable[[Scene], object] = lambda scene: None,
) -> None:
    """Run an experiment's procedure (coroutine) on the graph of a launch file.

    bag: file to which all topics are recorded, or None if nothing is recorded.
    check_scene: function that raises an error if the experiment does not support the scene.
    settings, apparatus, needed: arguments for `load_graph`.
    """
    plan = load_graph(
        launch_file,
        settings=settings,
        record=bag,
        apparatus=apparatus,
        needed=needed,
    )
    check_scene(require_scene(plan))
    precompute_graph(plan, progress)
    try:
        asyncio.run(_await_interruptible(drive(plan, procedure, progress)))
    except (ExperimentError, NodeFailedError) as error:
        if bag is None or not bag.exists():
            raise
        raise type(error)(
            f"{error}\nrecording until the error: {bag}\n"
            f"to evaluate it: flexsheet bag report {shlex.quote(str(bag))}"
        ) from error
    if bag is not None:
        progress("reading the bag")


async def _await_interruptible(work: Coroutine[Any, Any, None]) -> None:
    """Await `work`; on SIGINT or SIGTERM, cancel it and raise ExperimentInterruptedError."""
    task = asyncio.create_task(work)
    with handle_signals(task.cancel, signal.SIGINT, signal.SIGTERM):
        try:
            await task
        except asyncio.CancelledError:
            raise ExperimentInterruptedError("interrupted; all nodes are stopped") from None


def make_settings(launch_file: Path, node_type: str, setting: str) -> list[str]:
    """Return launch settings that set a parameter of all nodes of a type, including derived types.

    Each setting has the form "NODE.parameter=value".

    setting: text "parameter=value".
    """
    graph = load_graph(launch_file, needed=tuple(TOPICS))
    return [f"{node.name}.{setting}" for node in graph.nodes_of_type(node_type)]


def make_path_procedure(make_path: Callable[[Scene], FingerPath], progress: Progress) -> Procedure:
    """Make a procedure (coroutine) that moves the finger along a path in the scene."""

    async def procedure(driver: Driver, scene: Scene) -> None:
        path = make_path(scene)
        progress(f"{path.label} ({path.times_s[-1]:.0f} s)")
        await driver.follow(path)

    return procedure


def make_switch_procedure(count: int, progress: Progress) -> Procedure:
    """Make a procedure (coroutine) that switches the projected image between white and black.

    count: number of switches.
    """

    async def procedure(driver: Driver, scene: Scene) -> None:
        random = np.random.default_rng(SWITCH_SEED)
        progress(f"{count} switches of the projected image")
        for number in range(count + 1):
            driver.show(
                Display(
                    correction="two_pass", stereo="mono", pattern="white" if number % 2 else "black"
                )
            )
            await asyncio.sleep(random.uniform(*SWITCH_INTERVAL_S))

    return procedure


def make_image_procedure(
    series: image.Series,
    values: Sequence[float],
    corrections: Sequence[Correction],
    progress: Progress,
    *,
    shading: Shading = "flat",
) -> Procedure:
    """Make a procedure (coroutine) that captures images of the sheet.

    There is one image for each value of a varied quantity and each image correction.

    values: values of the quantity that the experiment `series` varies.
    """

    async def procedure(driver: Driver, scene: Scene) -> None:
        for value in values:
            await driver.follow(series.path(scene, value))
            await driver.wait_settled()
            progress(f"taking images of the sheet {series.name.format(value)}")
            for correction in corrections:
                label = series.label(value, correction)
                await driver.capture_image(label, correction, shading)

    return procedure


def chain_procedures(*procedures: Procedure) -> Procedure:
    """Make a procedure (coroutine) that runs several procedures in sequence on the same graph."""

    async def procedure(driver: Driver, scene: Scene) -> None:
        for each in procedures:
            await each(driver, scene)

    return procedure


def make_evaluation(
    bag: Path, evaluate: Callable[[], Result | None], report: Callable[[Result], None], name: str
) -> Procedure:
    """Make a procedure (coroutine) that evaluates a finished experiment while the graph still runs.

    bag: file that the recorder writes.
    evaluate: function that reads the bag and returns the result; None if the recorder has not yet
        written the experiment.
    report: function that receives the result.
    name: name of the experiment in the error text.
    """

    async def procedure(driver: Driver, scene: Scene) -> None:
        evaluated_bytes, waited_from_s = -1, time.monotonic()
        while True:
            # An evaluation of a large bag can take longer than the recorder needs to write the end.
            written_bytes = os.stat(bag).st_size
            if (result := await asyncio.to_thread(evaluate)) is not None:
                break
            if written_bytes > evaluated_bytes:
                evaluated_bytes, waited_from_s = written_bytes, time.monotonic()
            elif time.monotonic() > waited_from_s + RECORD_WAIT_S:
                raise driver.make_timeout_error(
                    f"timeout: the recorder has written nothing for {RECORD_WAIT_S:g} s, and "
                    f"{name} is not in {bag}"
                )
            await asyncio.sleep(FLUSH_PERIOD_S)
        report(result)

    return procedure


def is_path_recorded(bag: Path, label: str) -> bool:
    """Return whether a bag covers a finger path and the DELIVERY_S seconds after the path ends."""
    done_ns: int | None = None
    for _, finger, header, _ in BagReader(bag, topics=["twin/finger"]):
        if isinstance(finger, TwinFinger) and finger.path_label == label and finger.path_done:
            done_ns = done_ns or header.source_ns
            if header.source_ns >= done_ns + DELIVERY_S * 1e9:
                return True
    return False
