"""`flexsheet bag`: record, play, export and verify bags, and write reports on them."""

from __future__ import annotations

import asyncio
from dataclasses import asdict
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from flexsheet.launch.commands import options
from flexsheet.launch.commands.graph import (
    NoGraphError,
    choose_run,
    run_interruptible,
    run_node_here,
    running_graph,
)
from flexsheet.launch.commands.launching import precompute_tables, print_omitted
from flexsheet.launch.commands.output import (
    FAILED,
    NOT_GOOD,
    CommandError,
    examples,
    logs_on_stderr,
    print_fields,
    print_json,
    print_outcome,
    print_result,
    print_table,
    progress_bar,
    words,
)

if TYPE_CHECKING:
    from flexsheet.launch.bags.replay import Verification
    from flexsheet.launch.plans.plan_model import ResolvedGraph
    from flexsheet.launch.running.runs import Run

PROGRESS_PERIOD_S = 0.2

app = options.make_app("Record, play and analyse bags, which are MCAP files of recorded topics.")


@app.command(
    epilog=examples(
        "flexsheet bag record",
        "flexsheet bag record -o session.mcap --include stereo",
        "flexsheet bag record -o fingers.mcap --topic fingertip --duration 10",
        "flexsheet bag record -o hour.mcap --max-bag-duration 600 --max-bag-size 500",
    )
)
def record(
    *,
    bag: Annotated[Path | None, typer.Argument(help="Bag file to write; same as --output.")] = None,
    output: Annotated[
        Path | None,
        options.output_file("Bag file to write; default: runs/DATE-TIME.mcap.", "BAG"),
    ] = None,
    topics: options.TopicsOption = None,
    include: Annotated[
        list[str] | None,
        typer.Option(
            metavar="TOPIC",
            help="Topic to record in addition to the default topics, such as stereo; repeat the "
            "option for several topics.",
        ),
    ] = None,
    max_size_mb: Annotated[
        float | None,
        typer.Option(
            "-b",
            "--max-bag-size",
            metavar="MB",
            min=1.0,
            help="Maximum size of a file, MB; when it is reached, recording continues in "
            "BAG-2.mcap, BAG-3.mcap and so on.",
        ),
    ] = None,
    max_duration_s: Annotated[
        float | None,
        typer.Option(
            "-d",
            "--max-bag-duration",
            metavar="SECONDS",
            min=1.0,
            help="Maximum duration of a file, s; when it is reached, recording continues in a new "
            "file.",
        ),
    ] = None,
    duration: options.DurationOption = None,
    run: options.RunOption = None,
    as_json: options.JsonOption = False,
) -> None:
    """Record topics of the running graph until Ctrl-C.

    By default, all topics that are marked as logged are recorded.
    """
    running = running_graph(run)
    target = output or bag or Path("runs") / f"{datetime.now():%Y%m%d-%H%M%S}.mcap"
    if target.exists():
        raise CommandError(f"{target}: the file exists and is not overwritten; name a new file")
    logs_on_stderr()
    parameters = {
        "bag": target,
        "topics": topics or (),
        "include": include or (),
        "max_bag_bytes": None if max_size_mb is None else round(1e6 * max_size_mb),
        "max_bag_duration_s": max_duration_s,
    }
    run_interruptible(_record(parameters, *running, duration))
    bags = sorted(target.parent.glob(f"{target.stem}-*{target.suffix}"))
    bags = [target, *(one for one in bags if one.stem.removeprefix(f"{target.stem}-").isdigit())]
    print_outcome(
        {"bag": str(target), "bags": [str(one) for one in bags]},
        f"recorded {', '.join(map(str, bags))}",
        as_json=as_json,
    )


@app.command(
    epilog=examples(
        "flexsheet bag play session.mcap -r 0.5",
        "flexsheet bag play session.mcap --launch replay",
    )
)
def play(
    *,
    bag: options.BagArgument,
    rate: Annotated[
        float,
        typer.Option(
            "-r",
            "--rate",
            metavar="FACTOR",
            min=0.01,
            help="Playback speed relative to the recording; 2 is twice as fast.",
        ),
    ] = 1.0,
    start: Annotated[
        float,
        typer.Option(
            metavar="SECONDS", help="Time in the bag at which playback starts, s.", min=0.0
        ),
    ] = 0.0,
    topics: options.TopicsOption = None,
    launch: Annotated[
        Path | None,
        typer.Option(
            help="Launch file of a graph to start before playback and stop after it.",
            **options.LAUNCH_FILE,
        ),
    ] = None,
    run: options.ChangedRunOption = None,
    as_json: options.JsonOption = False,
) -> None:
    """Publish the messages of a bag to a running graph, or to a graph that --launch starts.

    Only topics that the launch file lists under `external_topics` are played.
    """

    from flexsheet.launch.bags.player import NEVER_PLAYED, select_topics
    from flexsheet.launch.bags.player import play as play_bag
    from flexsheet.messages.bag import BagReader

    async def play_into(plan: ResolvedGraph, found: Run) -> int:
        selection = select_topics(BagReader(bag).topics, plan, tuple(topics or ()))
        for name, why in selection.left_out.items():
            words.print(f"not played: {name}: {why}")
        if not selection.topics:
            raise CommandError(
                f"{bag}: contains no topic that can be played into {plan.launch_file}; play it "
                "into a graph without the nodes that write these topics: "
                f"flexsheet bag play {bag} --launch replay",
                FAILED,
            )
        refused = selection.left_out.keys() - NEVER_PLAYED.keys()
        if launch is None and any(map(plan.writers.get, refused)):
            words.print(
                "to play topics that a node writes, use a launch file without this node that "
                "lists them under external_topics, such as --launch replay"
            )
        with progress_bar(f"playing {bag.name}") as progress:
            sent = await play_bag(
                bag, plan, found, topics=selection.topics, rate=rate, start_s=start,
                progress=progress,
            )  # fmt: skip
        print_outcome(
            {"bag": str(bag), "messages": sent, "topics": list(selection.topics)},
            f"played {sent} messages on {', '.join(selection.topics)}",
            as_json=as_json,
        )
        return 0

    async def start_and_play(plan: ResolvedGraph) -> int:
        from flexsheet.launch.running.supervisor import RunningGraph

        print_omitted(plan, None)
        async with RunningGraph(plan) as graph:
            with words.status(f"starting {plan.launch_file}"):
                await graph.wait_ready()
            return await play_into(plan, graph.run)

    if launch is not None:
        from flexsheet.launch.plans.plan import load_graph

        new_plan = load_graph(launch)
        precompute_tables(new_plan, None)
        raise typer.Exit(run_interruptible(start_and_play(new_plan)))
    try:
        running = running_graph(choose_run(run))
    except NoGraphError as error:
        raise NoGraphError(
            f"{error}; or let this command start one: flexsheet bag play {bag} --launch replay"
        ) from error
    raise typer.Exit(run_interruptible(play_into(*running)))


@app.command(epilog=examples("flexsheet bag info session.mcap"))
def info(bag: options.BagArgument, as_json: options.JsonOption = False) -> None:
    """Print the topics, metadata and attachments of a bag, even if it is truncated."""
    from flexsheet.messages.bag import info as bag_info

    summary = bag_info(bag)
    if as_json:
        print_json({**asdict(summary), "path": str(summary.path)})
        return
    print_fields(
        [
            ("bag", summary.path),
            ("size", f"{summary.size_bytes / 1e6:.2f} MB"),
            (
                "complete",
                "yes (the content of the messages is not checked)"
                if summary.complete
                else f"no: {summary.problem}",
            ),
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


@app.command(
    epilog=examples(
        "flexsheet bag export session.mcap -o for-foxglove.mcap",
        "flexsheet bag export session.mcap -o small.mcap --topic fingertip --topic sheet_target",
        "flexsheet bag export session.mcap -o for-ros --format ros2",
        "flexsheet bag export cut.mcap -o whole.mcap --format bag",
    )
)
def export(
    *,
    bag: options.BagArgument,
    output: Annotated[
        Path,
        options.output_file("MCAP file, or folder of a ROS 2 bag (--format ros2), to write."),
    ],
    form: Annotated[
        Literal["foxglove", "ros2", "bag"],
        typer.Option(
            "--format",
            help="foxglove: MCAP for Foxglove and Rerun; ros2: ROS 2; bag: complete bag with the "
            "readable messages of a truncated or damaged bag.",
        ),
    ] = "foxglove",
    topics: options.TopicsOption = None,
    as_json: options.JsonOption = False,
) -> None:
    """Convert a bag for the viewers Foxglove and Rerun or for ROS 2, or repair a damaged bag."""
    if form == "bag":
        from flexsheet.messages.bag import recover

        if topics:
            raise CommandError("--format bag copies all topics; omit --topic")
        with progress_bar(f"repairing {bag.name}") as progress:
            report = recover(bag, output, progress=progress)
        print_result({**asdict(report), "output": str(output)}, as_json=as_json)
        return
    from flexsheet.launch.bags.export import export as export_bag

    with progress_bar(f"exporting {bag.name}") as progress:
        result = export_bag(bag, output, form, topics=topics, progress=progress)
    if result.unreadable:
        listed = ", ".join(result.unreadable)
        words.print(f"not exported: {listed} (recorded with incompatible message types)")
    if as_json:
        print_json({**asdict(result), "output": str(result.output)})
        return
    print_table(("channel", "messages"), sorted(result.messages.items()))


@app.command(
    epilog=examples(
        "flexsheet bag verify session.mcap planner",
        "flexsheet bag verify session.mcap triangulator --tolerance 1e-9 --json",
    )
)
def verify(
    bag: options.BagArgument,
    node: Annotated[
        str,
        typer.Argument(help="Name of a node of the graph that was recorded."),
    ],
    tolerance: Annotated[
        float,
        typer.Option(
            help="Maximum difference between replayed and recorded values, in their units.", min=0.0
        ),
    ] = 1e-6,
    as_json: options.JsonOption = False,
) -> None:
    """Run a node twice on its recorded inputs, and compare the outputs.

    The exit code is 1 if the two runs have different outputs, if the node fails, or if the node
    cannot be replayed. The exit code is 3 if the two runs have the same outputs, but these differ
    from the recorded outputs. A possible reason is that the node reads the system clock.
    """
    from flexsheet.launch.bags.replay import verify as verify_node

    logs_on_stderr()
    with progress_bar(f"replaying {node} twice with {bag.name}") as progress:
        result = verify_node(bag, node, tolerance=tolerance, progress=progress)
    if as_json:
        print_json({**asdict(result), "ok": result.ok})
    else:
        _print_verification(result)
        words.print(_describe_result(result))
        if result.bag_problem:
            words.print(f"only the readable part was compared: {result.bag_problem}")
    if not result.repeatable:
        raise typer.Exit(FAILED)
    if not result.as_live:
        raise typer.Exit(NOT_GOOD)


@app.command(
    epilog=examples(
        "flexsheet bag report session.mcap",
        "flexsheet bag report session.mcap -o session.html",
        "flexsheet bag report session.mcap --json",
    )
)
def report(
    bag: options.BagArgument,
    output: Annotated[
        Path | None,
        options.output_file("HTML file to write; default: bag path with the suffix .html."),
    ] = None,
    as_json: options.JsonOption = False,
) -> None:
    """Write an HTML report on a recording: problems, a chart over time, and numbers.

    A JSON file with the numbers, with the suffix .report.json, is written beside the page. With
    --json, the numbers are printed, and files are written only if --output is given. If the bag is
    truncated, the report covers its readable part.
    """
    from flexsheet.launch.bags.report import report as report_on

    page = output if as_json else output or bag.with_suffix(".html")
    with progress_bar(f"reading {bag.name}") as progress:
        result = report_on(bag, page, progress)
    if as_json:
        print_json(result)
        return
    for finding in result["findings"]:
        words.print(f"{finding['gravity']}: {finding['text']}")
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
        else "the code has changed, or the node already had internal state when the recording began"
    )
    return f"repeatable, but different from the live outputs: {why} (docs/replay.md)"


def _format_worst(fields: dict[str, float]) -> str:
    if not fields:
        return "all equal"
    name = max(fields, key=lambda field: fields[field])
    return f"{name} {fields[name]:.3g}"


async def _record(
    given: dict[str, Any], plan: ResolvedGraph, run: Run, seconds: float | None
) -> int:
    """Record topics of the running graph in this process; always return 0, the exit code.

    given: values of the recorder's parameters.
    seconds: duration of the recording. If it is None, the duration is not limited.
    """
    from flexsheet.launch.plans.plan_model import RUN_DIRECTORY
    from flexsheet.launch.running.runs import local_sources, ring_file
    from flexsheet.launch.running.tools import tools_host
    from flexsheet.messages.topics import TOPICS
    from flexsheet.nodes.node import further_port
    from flexsheet.nodes.recorder.node import Recorder
    from flexsheet.nodes.recorder.parameters import RUN_FILES, RecorderParameters
    from flexsheet.nodes.runner import NodeConfig, PortConfig

    attached = tuple(run.directory / file.relative_to(RUN_DIRECTORY) for file in RUN_FILES)
    parameters = RecorderParameters.model_validate({**given, "attach": attached})
    written = [topic for topic in TOPICS.values() if topic.name in plan.writers]
    names = Recorder.further_inputs(parameters, written)
    for name in names:
        if name not in plan.writers:
            option = "--include" if name in parameters.include else "--topic"
            raise CommandError(
                f"{option} {name}: the topic has no writer in the running graph; "
                "`flexsheet topic list` lists its topics"
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
    words.print(f"recording {len(names)} topics; press Ctrl-C to stop")
    countdown = asyncio.create_task(_show_remaining(parameters.bag.name, seconds))
    try:
        await run_node_here(config, seconds)
    finally:
        countdown.cancel()
    return 0


async def _show_remaining(label: str, duration_s: float | None) -> None:
    if duration_s is None:
        return
    loop = asyncio.get_running_loop()
    begun_s = loop.time()
    with progress_bar(label) as progress:
        while True:
            progress(min(loop.time() - begun_s, duration_s), duration_s)
            await asyncio.sleep(PROGRESS_PERIOD_S)
