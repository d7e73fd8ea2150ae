"""`flexsheet bag`: record, play, look into, save, verify and report on bags."""

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

SHOWN_EVERY_S = 0.2
MAX_TOPICS_LISTED = 10

app = typer.Typer(
    add_completion=False, no_args_is_help=True, help="Bags: recordings of topics (MCAP files)."
)

BagArgument = Annotated[
    Path, typer.Argument(metavar="BAG", help="Bag file.", autocompletion=complete.bags)
]
TopicsOption = Annotated[
    list[str] | None,
    typer.Option(
        "--topic", help="Only this topic; may be given again.", autocompletion=complete.topics
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
            help="Record this topic too, for example stereo; may be given again.",
            autocompletion=complete.topics,
        ),
    ] = None,
    also: Annotated[
        list[str] | None, typer.Option("--also", hidden=True, help="Old name of --include.")
    ] = None,
    duration: Annotated[
        float | None, typer.Option(metavar="SECONDS", help="Stop after this time.")
    ] = None,
    run: RunOption = None,
    as_json: JsonOption = False,
) -> None:
    """Record the running graph until Ctrl-C; without --topic all topics logged by default."""
    running = running_graph(run)
    if bag.exists():
        raise CommandError(f"{bag}: exists already; a bag is never written over", BAD_INPUT)
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
    rate: Annotated[float, typer.Option(help="Speed factor.", min=0.01)] = 1.0,
    start: Annotated[
        float, typer.Option(metavar="SECONDS", help="Start at this position in the bag.", min=0.0)
    ] = 0.0,
    loop: Annotated[bool, typer.Option("--loop", help="Repeat until Ctrl-C.")] = False,
    topics: TopicsOption = None,
    launch: Annotated[
        Path | None,
        typer.Option(
            "--launch",
            metavar="FILE",
            help="Start this launch file first, and end it after playing.",
            autocompletion=complete.yaml_files,
        ),
    ] = None,
    into: Annotated[
        Path | None, typer.Option("--into", hidden=True, help="Old name of --launch.")
    ] = None,
    run: RunOption = None,
    as_json: JsonOption = False,
) -> None:
    """Play a bag into a graph: the topics of `external_topics` in its launch file."""
    how = Playing(bag, tuple(topics or ()), rate, start, loop, as_json)
    raise typer.Exit(run_interruptible(_play(how, launch or into, run)))


@app.command(epilog=examples("flexsheet bag info session.mcap"))
def info(bag: BagArgument, as_json: JsonOption = False) -> None:
    """What a bag holds; a bag that was cut off by a crash is read as far as it goes."""
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
    output: Annotated[Path, typer.Argument(metavar="OUTPUT", help="Bag to write.")],
    as_json: JsonOption = False,
) -> None:
    """Write a whole bag from what can be read of a cut or damaged one; the original stays."""
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
            ("saved", f"{report.messages} messages, {report.attachments} attachments"),
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
    """Write what a bag holds for other tools: Foxglove and rerun open the file."""
    from flexsheet.launch.bags.export import export as export_bag

    with progress_bar(f"exporting {bag.name}") as progress:
        result = export_bag(bag, output, topics=topics, progress=progress)
    if result.unreadable:
        listed = ", ".join(result.unreadable[:MAX_TOPICS_LISTED])
        more = len(result.unreadable) - MAX_TOPICS_LISTED
        also = f" and {more} more" if more > 0 else ""
        words.print(f"not exported: {listed}{also} (their types have changed)", markup=False)
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
            help="Name of the node in the bag's launch file.",
            autocompletion=complete.node_types,
        ),
    ],
    bag: BagArgument,
    tolerance: Annotated[
        float, typer.Option(help="Between replayed and recorded numbers.", min=0.0)
    ] = 1e-6,
    as_json: JsonOption = False,
) -> None:
    """Step one node through what it took of its recorded inputs, twice, and compare.

    Exit code 1: the two passes gave different bytes, or the node failed, or it cannot be replayed.
    Exit code 3: they gave the same, but other numbers than the node published live: as from a node
    that reads the clock by itself, or from a bag of code that did not say what its nodes took.
    """
    from flexsheet.launch.bags.replay import verify as verify_node

    logs_on_stderr()
    with progress_bar(f"stepping {node} through {bag.name}, twice") as progress:
        result = verify_node(bag, node, tolerance=tolerance, progress=progress)
    if as_json:
        print_json({**asdict(result), "ok": result.ok})
    else:
        _print_verification(result)
        words.print(_verdict(result), markup=False)
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
        typer.Option("-o", "--output", metavar="FILE.html", help="Page; else beside the bag."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Write one page about a session: what was wrong first, then charts, tables and pictures.

    The page needs no network.  With --json the numbers are printed, and a page is written only
    where one is named.  A bag that was cut off is read as far as it goes.
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
            ("order", "as it took them" if result.as_taken else "as the recorder got them"),
            ("messages in", f"{result.messages_in}, missing {result.missing}"),
            ("messages out", result.messages_out),
            ("same bytes twice", "yes" if result.same_bytes else "NO"),
            ("sha256 of them", result.digest),
            (
                "errors",
                f"{result.errors}{result.last_error and f', the last: {result.last_error}'}",
            ),
        ]
    )
    print()
    print_table(
        ("topic", "recorded", "replayed", "paired", f"beyond {result.tolerance:g}", "worst field"),
        [
            (
                topic,
                one.recorded,
                one.replayed,
                one.compared,
                one.beyond_tolerance,
                _worst(one.worst) if one.compared else "none paired",
            )
            for topic, one in result.topics.items()
        ],
    )


def _verdict(result: Verification) -> str:
    """What it comes to, and where to read on."""
    if result.errors:
        return "the node failed; its last error is above"
    if not result.same_bytes:
        return (
            "not repeatable: the node goes by something that is not in the bag, as the real time "
            "or the order of a set (docs/replay.md)"
        )
    if result.as_live:
        return "repeatable, and as it was live"
    why = (
        f"{result.missing} messages that it took live are not in the bag"
        if result.missing
        else "the code has changed, or the recording began when the node had something to remember"
    )
    return f"repeatable, but other than live: {why} (docs/replay.md)"


def _worst(fields: dict[str, float]) -> str:
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
    wanted = Recorder.further_inputs(parameters, written)
    for name in wanted:
        if name not in plan.writers:
            option = "--include" if name in include else "--topic"
            raise CommandError(f"{option} {name}: nobody writes it in the running graph", BAD_INPUT)
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
            for name in wanted
        ),
        outputs=(),
        plan_hash=plan.hash,
        keys_file=ring_file(run, tools_host(run)) if plan.keys else None,
        run_dir=str(run.directory),
    )
    words.print(f"recording {len(wanted)} topics; Ctrl-C ends", markup=False)
    stop = asyncio.Event()
    work = asyncio.create_task(run_node(config, stop))
    counting = asyncio.create_task(_count_down(bag.name, seconds))
    try:
        await asyncio.wait((work,), timeout=seconds)
    finally:
        # Also when interrupted: the bag is closed in order.
        counting.cancel()
        stop.set()
        await work
    return 0


async def _count_down(what: str, duration_s: float | None) -> None:
    """Shows how much of a recording is left, where that is known."""
    if duration_s is None:
        return
    loop = asyncio.get_running_loop()
    begun_s = loop.time()
    with progress_bar(what) as progress:
        while True:
            progress(min(loop.time() - begun_s, duration_s), duration_s)
            await asyncio.sleep(SHOWN_EVERY_S)


@dataclass(frozen=True, slots=True)
class Playing:
    """What is to be played, and how."""

    bag: Path
    topics: tuple[str, ...]
    rate: float
    start_s: float
    loop: bool
    as_json: bool


async def _play(how: Playing, launch: Path | None, run_directory: Path | None) -> int:
    from flexsheet.launch.plans.plan import load_graph
    from flexsheet.launch.running.supervisor import RunningGraph

    if launch is None:
        plan, run = running_graph(run_directory)
        return await _play_into(how, plan, run)
    plan = load_graph(launch)
    async with RunningGraph(plan) as graph:
        with words.status(f"starting {launch}"):
            await graph.wait_ready()
        return await _play_into(how, plan, graph.run)


async def _play_into(how: Playing, plan: ResolvedGraph, run: Run) -> int:
    from flexsheet.launch.bags.player import play as play_bag
    from flexsheet.launch.bags.player import select_topics
    from flexsheet.messages.bag import BagReader

    selection = select_topics(BagReader(how.bag).topics, plan, how.topics)
    for name, why in selection.left_out.items():
        words.print(f"not played: {name} ({why})", markup=False)
    if not selection.topics:
        raise CommandError(f"{how.bag}: nothing in it can be played into {plan.launch_file}")
    sent = 0
    while True:
        with progress_bar(f"playing {how.bag.name}") as progress:
            sent += await play_bag(
                how.bag,
                plan,
                run,
                topics=selection.topics,
                rate=how.rate,
                start_s=how.start_s,
                progress=progress,
            )
        if not how.loop:
            break
    if how.as_json:
        print_json({"bag": str(how.bag), "messages": sent, "topics": list(selection.topics)})
    else:
        words.print(f"played {sent} messages on {', '.join(selection.topics)}", markup=False)
    return 0
