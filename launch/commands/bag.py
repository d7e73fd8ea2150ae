"""`flexsheet bag`: record, play, recover, export, verify and report on bags."""

from __future__ import annotations

import asyncio
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from flexsheet.launch.commands import complete
from flexsheet.launch.commands.graph import JsonOption, RunOption, run_interruptible, running_graph
from flexsheet.launch.commands.output import (
    BAD_INPUT,
    FAILED,
    OTHER_THAN_LIVE,
    CommandError,
    examples,
    logs_on_stderr,
    print_fields,
    print_json,
    print_table,
    progress_bar,
    words,
)

if TYPE_CHECKING:
    from flexsheet.launch.bags.replay import Verification
    from flexsheet.launch.plans.plan_model import ResolvedGraph
    from flexsheet.launch.running.runs import Run

PROGRESS_PERIOD_S = 0.2
MAX_TOPICS_LISTED = 10

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    help="Record, play and analyse bags, which are MCAP files of recorded topics.",
)

BagArgument = Annotated[
    Path, typer.Argument(metavar="BAG", help="Bag file.", autocompletion=complete.bags)
]
TopicsOption = Annotated[
    list[str] | None,
    typer.Option(
        "--topic",
        help="Topic to use; repeat for several; default: all.",
        autocompletion=complete.topics,
    ),
]


@app.command(
    epilog=examples(
        "flexsheet bag record session.mcap",
        "flexsheet bag record fingers.mcap --topic fingertip --duration 10",
        "flexsheet bag record with-pictures.mcap --include stereo",
    )
)
def record(
    *,
    bag: BagArgument,
    topics: TopicsOption = None,
    include: Annotated[
        list[str] | None,
        typer.Option(
            "--include",
            metavar="TOPIC",
            help="Further topic to record, such as stereo; repeat for several.",
            autocompletion=complete.topics,
        ),
    ] = None,
    also: Annotated[
        list[str] | None, typer.Option("--also", hidden=True, help="Former name of --include.")
    ] = None,
    duration: Annotated[
        float | None,
        typer.Option(
            metavar="SECONDS", help="Duration of the recording, s; default: until Ctrl-C."
        ),
    ] = None,
    run: RunOption = None,
    as_json: JsonOption = False,
) -> None:
    """Record the topics of the running graph until Ctrl-C; default: all topics that are logged."""
    running = running_graph(run)
    if bag.exists():
        raise CommandError(
            f"{bag}: the file exists and is not overwritten; name a new file", BAD_INPUT
        )
    logs_on_stderr()
    included = [*(include or ()), *(also or ())]
    run_interruptible(
        _record(bag, topics=topics or [], include=included, running=running, seconds=duration)
    )
    if as_json:
        print_json({"bag": str(bag)})
    else:
        words.print(f"recorded {bag}", markup=False)


@app.command(
    epilog=examples(
        "flexsheet bag play session.mcap --rate 0.5",
        "flexsheet bag play session.mcap --topic twin/finger_path --launch graph.yaml",
    )
)
def play(
    *,
    bag: BagArgument,
    rate: Annotated[
        float, typer.Option(help="Playback speed as a factor of real time.", min=0.01)
    ] = 1.0,
    start: Annotated[
        float, typer.Option(metavar="SECONDS", help="Start position in the bag, s.", min=0.0)
    ] = 0.0,
    loop: Annotated[bool, typer.Option("--loop", help="Repeat playback until Ctrl-C.")] = False,
    topics: TopicsOption = None,
    launch: Annotated[
        Path | None,
        typer.Option(
            "--launch",
            metavar="FILE",
            help="Launch file to start before playback and stop after it.",
            autocompletion=complete.yaml_files,
        ),
    ] = None,
    into: Annotated[
        Path | None, typer.Option("--into", hidden=True, help="Former name of --launch.")
    ] = None,
    run: RunOption = None,
    as_json: JsonOption = False,
) -> None:
    """Play the topics of a bag that are `external_topics` of the graph's launch file."""
    request = PlayRequest(bag, tuple(topics or ()), rate, start, loop, as_json)
    raise typer.Exit(run_interruptible(_play(request, launch or into, run)))


@app.command(epilog=examples("flexsheet bag info session.mcap"))
def info(bag: BagArgument, as_json: JsonOption = False) -> None:
    """Print the contents of a bag; a truncated bag is read up to its end."""
    from flexsheet.messages.bag import info as bag_info

    summary = bag_info(bag)
    if as_json:
        print_json({**asdict(summary), "path": str(summary.path)})
        return
    print_fields(
        [
            ("bag", summary.path),
            ("size", f"{summary.size_bytes / 1e6:.2f} MB"),
            ("complete", "yes" if summary.complete else f"no: {summary.problem}"),
            ("duration", f"{summary.duration_s:.3f} s"),
            ("messages", summary.count),
            *(pair for table in summary.metadata.values() for pair in table.items()),
            ("attachments", ", ".join(one.name for one in summary.attachments) or "none"),
        ]
    )
    print()
    print_table(
        ("topic", "message", "count", "rate_hz", "readable"),
        [
            (one.name, one.type, one.count, f"{one.rate_hz:.2f}", "yes" if one.readable else "NO")
            for one in summary.topics
        ],
    )


@app.command(epilog=examples("flexsheet bag recover cut.mcap whole.mcap"))
def recover(
    bag: BagArgument,
    output: Annotated[Path, typer.Argument(metavar="OUTPUT", help="Recovered bag to write.")],
    as_json: JsonOption = False,
) -> None:
    """Write the readable messages of a truncated or damaged bag to a new bag."""
    from flexsheet.messages.bag import recover as recover_bag

    with progress_bar(f"recovering {bag.name}") as progress:
        report = recover_bag(bag, output, progress=progress)
    if as_json:
        print_json({**asdict(report), "output": str(output)})
        return
    print_fields(
        [
            ("bag", output),
            ("from", f"{bag}, {'complete' if report.was_complete else report.problem}"),
            ("recovered", f"{report.messages} messages, {report.attachments} attachments"),
            (
                "lost",
                f"{report.damaged_chunks} damaged chunks, "
                f"{report.orphan_messages} messages of unknown topics",
            ),
        ]
    )


@app.command(
    epilog=examples(
        "flexsheet bag export session.mcap for-foxglove.mcap",
        "flexsheet bag export session.mcap small.mcap --topic fingertip --topic sheet_target",
    )
)
def export(
    bag: BagArgument,
    output: Annotated[Path, typer.Argument(metavar="OUTPUT", help="MCAP file to write.")],
    topics: TopicsOption = None,
    as_json: JsonOption = False,
) -> None:
    """Convert a bag to an MCAP file for Foxglove and Rerun."""
    from flexsheet.launch.bags.export import export as export_bag

    with progress_bar(f"exporting {bag.name}") as progress:
        result = export_bag(bag, output, topics=topics, progress=progress)
    if result.unreadable:
        listed = ", ".join(result.unreadable[:MAX_TOPICS_LISTED])
        more = len(result.unreadable) - MAX_TOPICS_LISTED
        also = f" and {more} more" if more > 0 else ""
        words.print(
            f"not exported: {listed}{also} (recorded with incompatible message types)", markup=False
        )
    if as_json:
        print_json({**asdict(result), "output": str(output)})
        return
    print_table(("channel", "messages"), sorted(result.messages.items()))


@app.command(
    epilog=examples(
        "flexsheet bag verify planner session.mcap",
        "flexsheet bag verify triangulator session.mcap --tolerance 1e-9 --json",
    )
)
def verify(
    node: Annotated[
        str,
        typer.Argument(
            help="Node name in the bag's launch file.",
            autocompletion=complete.node_types,
        ),
    ],
    bag: BagArgument,
    tolerance: Annotated[
        float,
        typer.Option(
            help="Maximum difference between replayed and recorded values, in their units.", min=0.0
        ),
    ] = 1e-6,
    as_json: JsonOption = False,
) -> None:
    """Replay a node twice with its recorded inputs, and compare its outputs.

    Exit code 1: the two runs differ, the node failed, or it cannot be replayed. Exit code 3: the
    runs are equal but differ from the outputs published live, for example because the node reads
    the system clock.
    """
    from flexsheet.launch.bags.replay import verify as verify_node

    logs_on_stderr()
    with progress_bar(f"replaying {node} twice with {bag.name}") as progress:
        result = verify_node(bag, node, tolerance=tolerance, progress=progress)
    if as_json:
        print_json({**asdict(result), "ok": result.ok})
    else:
        _print_verification(result)
        words.print(_describe_result(result), markup=False)
    if not result.repeatable:
        raise typer.Exit(FAILED)
    if not result.as_live:
        raise typer.Exit(OTHER_THAN_LIVE)


@app.command(
    epilog=examples(
        "flexsheet bag report session.mcap",
        "flexsheet bag report session.mcap -o session.html",
        "flexsheet bag report session.mcap --json",
    )
)
def report(
    bag: BagArgument,
    output: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--output",
            metavar="FILE.html",
            help="HTML file to write; default: next to the bag.",
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Write an HTML report on a recording: faults, charts, tables and images.

    The page needs no network connection. With --json, prints the values, and writes a page only if
    --output is given. A truncated bag is read up to its end.
    """
    from flexsheet.launch.bags.report.write import default_output
    from flexsheet.launch.bags.report.write import report as report_on

    page = output if as_json else output or default_output(bag)
    with progress_bar(f"reading {bag.name}") as progress:
        result = report_on(bag, page, progress)
    if as_json:
        print_json(result)
        return
    for finding in result["findings"]:
        words.print(f"{finding['gravity']}: {finding['text']}", markup=False)
    print(page)


def _print_verification(result: Verification) -> None:
    print_fields(
        [
            ("node", result.node),
            ("input order", "as the node read it" if result.by_execution_log else "as recorded"),
            ("input messages", f"{result.messages_in}, missing {result.missing}"),
            ("output messages", result.messages_out),
            ("equal in both runs", "yes" if result.same_bytes else "NO"),
            ("sha256 of outputs", result.digest),
            (
                "errors",
                f"{result.errors}{result.last_error and f', last error: {result.last_error}'}",
            ),
        ]
    )
    print()
    print_table(
        (
            "topic",
            "recorded",
            "replayed",
            "compared",
            f"above {result.tolerance:g}",
            "field of maximum error",
        ),
        [
            (
                topic,
                one.recorded,
                one.replayed,
                one.compared,
                one.beyond_tolerance,
                _format_worst(one.worst) if one.compared else "none compared",
            )
            for topic, one in result.topics.items()
        ],
    )


def _describe_result(result: Verification) -> str:
    """Describe the result of a verification, with the likely cause of a difference."""
    if result.errors:
        return "the node failed; see its last error above"
    if not result.same_bytes:
        return (
            "not repeatable: the node depends on data outside the bag, such as the system time or "
            "the order of a set (docs/replay.md)"
        )
    if result.as_live:
        return "repeatable, and equal to the live outputs"
    why = (
        f"{result.missing} messages that the node read are not in the bag"
        if result.missing
        else "the code has changed, or the recording started after the node had stored state"
    )
    return f"repeatable, but different from the live outputs: {why} (docs/replay.md)"


def _format_worst(fields: dict[str, float]) -> str:
    if not fields:
        return "all equal"
    name = max(fields, key=lambda field: fields[field])
    return f"{name} {fields[name]:.3g}"


async def _record(
    bag: Path,
    *,
    topics: list[str],
    include: list[str],
    running: tuple[ResolvedGraph, Run],
    seconds: float | None,
) -> int:
    """Run a recorder node in this process, connected to the running graph."""
    from flexsheet.launch.plans.plan_model import RUN_DIRECTORY
    from flexsheet.launch.running.runs import local_sources, ring_file
    from flexsheet.launch.running.tools import tools_host
    from flexsheet.messages.topics import TOPICS
    from flexsheet.nodes.node import further_port
    from flexsheet.nodes.recorder.node import Recorder
    from flexsheet.nodes.recorder.parameters import RUN_FILES, RecorderParameters
    from flexsheet.nodes.runner import NodeConfig, PortConfig, run_node

    plan, run = running
    parameters = RecorderParameters(
        bag=bag,
        topics=tuple(topics),
        include=tuple(include),
        attach=tuple(run.directory / file.relative_to(RUN_DIRECTORY) for file in RUN_FILES),
    )
    written = [topic for topic in TOPICS.values() if topic.name in plan.writers]
    names = Recorder.further_inputs(parameters, written)
    for name in names:
        if name not in plan.writers:
            option = "--include" if name in include else "--topic"
            raise CommandError(
                f"{option} {name}: the topic has no writer in the running graph", BAD_INPUT
            )
    config = NodeConfig(
        name="bag_record",
        type="recorder",
        parameters=parameters.model_dump(mode="json"),
        inputs=tuple(
            PortConfig(
                port=further_port(name),
                topic=name,
                endpoints=local_sources(run, plan.sources_to_read(name, tools_host(run))),
            )
            for name in names
        ),
        outputs=(),
        plan_hash=plan.hash,
        keys_file=ring_file(run, tools_host(run)) if plan.keys else None,
        run_dir=str(run.directory),
    )
    words.print(f"recording {len(names)} topics; press Ctrl-C to stop", markup=False)
    stop = asyncio.Event()
    work = asyncio.create_task(run_node(config, stop))
    countdown = asyncio.create_task(_show_remaining(bag.name, seconds))
    try:
        await asyncio.wait((work,), timeout=seconds)
    finally:
        # Close the bag properly after an interruption, too.
        countdown.cancel()
        stop.set()
        await work
    return 0


async def _show_remaining(label: str, duration_s: float | None) -> None:
    """Show the remaining time of a recording of known duration."""
    if duration_s is None:
        return
    loop = asyncio.get_running_loop()
    begun_s = loop.time()
    with progress_bar(label) as progress:
        while True:
            progress(min(loop.time() - begun_s, duration_s), duration_s)
            await asyncio.sleep(PROGRESS_PERIOD_S)


@dataclass(frozen=True, slots=True)
class PlayRequest:
    """Bag to play, with the topics, speed and start position."""

    bag: Path
    topics: tuple[str, ...]
    rate: float
    start_s: float
    loop: bool
    as_json: bool


async def _play(request: PlayRequest, launch: Path | None, run_directory: Path | None) -> int:
    from flexsheet.launch.plans.plan import load_graph
    from flexsheet.launch.running.supervisor import RunningGraph

    if launch is None:
        plan, run = running_graph(run_directory)
        return await _play_into(request, plan, run)
    plan = load_graph(launch)
    async with RunningGraph(plan) as graph:
        with words.status(f"starting {launch}"):
            await graph.wait_ready()
        return await _play_into(request, plan, graph.run)


async def _play_into(request: PlayRequest, plan: ResolvedGraph, run: Run) -> int:
    from flexsheet.launch.bags.player import play as play_bag
    from flexsheet.launch.bags.player import select_topics
    from flexsheet.messages.bag import BagReader

    selection = select_topics(BagReader(request.bag).topics, plan, request.topics)
    for name, why in selection.left_out.items():
        words.print(f"not played: {name}: {why}", markup=False)
    if not selection.topics:
        raise CommandError(
            f"{request.bag}: contains no topic that can be played into {plan.launch_file}"
        )
    sent = 0
    while True:
        with progress_bar(f"playing {request.bag.name}") as progress:
            sent += await play_bag(
                request.bag,
                plan,
                run,
                topics=selection.topics,
                rate=request.rate,
                start_s=request.start_s,
                progress=progress,
            )
        if not request.loop:
            break
    if request.as_json:
        print_json({"bag": str(request.bag), "messages": sent, "topics": list(selection.topics)})
    else:
        words.print(f"played {sent} messages on {', '.join(selection.topics)}", markup=False)
    return 0
